"""Tables with names, values and summaries around them; and what a message says that would help."""

import json

import numpy as np
import pytest
from cases import cases
from lab_tables import ROWS, U, Y, body, check, matlab, parquet, table, write

from bench.analysis import ColumnNames, ReadingOptions, read_columns, read_dataset
from bench.base import DataError

# What reads the files of libraries is a process of its own.
pytestmark = pytest.mark.usefixtures("warm_popen")

LINES = body().splitlines(keepends=True)
BODY, TABLE = body(), table()


def read(folder, content, names=("U", "y"), **options):
    return read_columns(write(folder, content), names, options=ReadingOptions(**options))


def refused(folder, content, names=("U", "y"), name="data.txt", **options):
    path = write(folder, content, name)
    with pytest.raises(DataError) as caught:
        read_columns(path, names, options=ReadingOptions(**options))
    assert str(path) in str(caught.value)
    return str(caught.value).replace(str(path), name)


LABVIEW = (
    "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\nX_Columns\tOne\nDate\t2024/03/05\n"
    "Time\t12:00:00.12\n***End_of_Header***\t\n\t\t\nChannels\t2\t\nSamples\t40\t40\nDate\t2024/03/05\t2024/03/05\n"
    "Y_Unit_Label\tVolts\tum\nX_Dimension\tTime\tTime\nX0\t0.0E+0\t0.0E+0\nDelta_X\t0.050000\t0.050000\n"
    "***End_of_Header***\t\t\nX_Value\tU\ty\tComment\n"
)


class TestNamesAndValues:
    @cases("decimal", [".", ","])
    @cases("end", ["\n", "\t\n"])
    def test_the_header_of_labview_is_no_table(self, tmp_path, decimal, end):
        content = LABVIEW.replace("0.0", "0" + decimal + "0") + BODY.replace(",", "\t").replace("\n", end).replace(
            ".", decimal
        )
        columns = read(tmp_path, content)
        check(columns)
        assert columns.assumptions.endswith("15 lines above the header")

    def test_a_table_by_its_number_counts_names_and_values(self, tmp_path):
        content = LABVIEW + BODY.replace(",", "\t")
        check(read(tmp_path, content, table="2"))
        assert read(tmp_path, content, ("2",), table="1").values["2"].tolist() == [0.0, 0.05]

    def test_a_short_table_of_numbers_above_a_long_one_is_a_table(self, tmp_path):
        content = "a,b\n" + "1,2\n" * 10 + "\n" + TABLE
        said = "2 tables, of rows × columns: 1 from line 2 (10 × 2), 2 from line 14 (40 × 3)"
        assert refused(tmp_path, content, ("1",)) == f"data.txt: has {said}; choose one with --format table=N, 1 to 2"
        message = refused(tmp_path, content)
        assert f"has no column 'U'; there are: a, b (or a number, 1 to 2); the file has {said}: choose" in message
        assert message.endswith(
            "another one with --format table=N, or leave out the lines above it with --format skip=N"
        )
        for options in ({"table": "2"}, {"skip_lines": 12}):
            check(read(tmp_path, content, **options))


SUMMARIES = {
    "total": ("Total,600,3\n", 1),
    "after a blank line": ("\nmean,2.5,1.3\n", 1),
    "after two blank lines": ("\n\nmean,2.5,1.3\nmax,2.5,1.3\n", 2),
    "several": ("\nmean,2.5,1.3\nstd,0.5,0.3\n", 2),
    "with a remark": ("mean,2.5,1.3\nend of measurement\n", 2),
    "without numbers": ("end,of,measurement\n", 1),
    "in quotes": ('"Total",600,3\n', 1),
    "behind an empty cell": (",mean,3\n", 1),
}


class TestSummaries:
    @cases("names", [("U", "y"), ("time", "U", "y"), ("2", "3")])
    @cases("name", SUMMARIES)
    def test_a_summary_ends_the_table(self, tmp_path, name, names):
        below, lines = SUMMARIES[name]
        columns = read(tmp_path, TABLE + below, names)
        check(columns, names[-2:])
        assert columns.assumptions == f"comma-separated, {lines} line{'s' * (lines != 1)} below the table left out"

    def test_a_text_in_another_column(self, tmp_path):
        columns = read(tmp_path, TABLE + "600,3,total\n", ("time", "U"))
        assert columns.values["U"].size == ROWS
        assert "1 line below the table left out" in columns.assumptions
        # In a column that is asked for, it is a wrong cell.
        assert "line 42, row 41, column y: 'total' is not a number" in refused(tmp_path, TABLE + "600,3,total\n")

    def test_below_dates_and_decimal_commas(self, tmp_path):
        rows = "".join("05.03.2024;" + line.replace(",", ";").replace(".", ",") for line in LINES)
        columns = read(tmp_path, "day;time;U;y\n" + rows + "mean;1,0;2,0;3,0\n")
        check(columns)
        assert "1 line below the table left out" in columns.assumptions

    def test_of_a_table_above_another(self, tmp_path):
        content = TABLE + "Total,600,3\n\n" + TABLE.replace("time", "t") + "Total,600,3\n"
        assert "1 from line 2 (40 × 3), 2 from line 45 (40 × 3);" in refused(tmp_path, content)
        for chosen in ("1", "2"):
            columns = read(tmp_path, content, table=chosen)
            check(columns)
            assert "1 line below the table left out" in columns.assumptions

    def test_names_and_values_behind_two_blank_lines_are_those_of_the_next_table(self, tmp_path):
        content = TABLE + "\n\nGain,5,2\nt,U,y\n" + BODY
        check(read(tmp_path, content, table="1"))
        columns = read(tmp_path, content, table="2")
        check(columns)
        assert columns.assumptions == "table 2, comma-separated, 1 line above the header"

    @cases("mark", ["n/a", "OVLD", "--", "NaN", ""])
    def test_a_missing_value_ends_no_table(self, tmp_path, mark):
        columns = read(tmp_path, TABLE.replace("\n1.95,", f"\n{mark},"))
        check(columns)
        assert columns.assumptions == "comma-separated"

    def test_text_within_the_table_stays_and_is_said(self, tmp_path):
        columns = read(tmp_path, TABLE.replace("\n1,", "\npaused,"))
        check(columns)
        assert columns.assumptions == "comma-separated, text in a column of numbers in line 22"

    def test_a_channel_that_fails_ends_no_table(self, tmp_path):
        states = ["0"] * 50 + ["off"] * 30
        values = zip([*U, *U], [*Y, *Y], states, strict=True)
        columns = read(tmp_path, "U,y,state\n" + "".join(f"{u},{y},{state}\n" for u, y, state in values))
        np.testing.assert_array_equal(columns.values["y"], [*Y, *Y])
        assert columns.assumptions == "comma-separated, text in columns of numbers in 30 lines, first in line 52"


class TestExponents:
    @cases(("decimal", "letter"), [(".", "D"), (".", "d"), (",", "D")])
    def test_of_fortran_are_read(self, tmp_path, decimal, letter):
        rows = "".join(f"{u:16.8E}{y:16.8E}\n" for u, y in zip(U, Y, strict=True))
        content = "  U  y\n" + rows.replace("E", letter).replace(".", decimal)
        columns = read(tmp_path, content)
        check(columns)
        assert columns.assumptions.endswith("exponents with D")

    def test_in_quotes_and_without_a_point(self, tmp_path):
        rows = "".join(f'"{u:.8E}","{y:.8E}"\n' for u, y in zip(U, Y, strict=True))
        check(read(tmp_path, "U,y\n" + rows.replace("E", "D")))
        assert "'1D5' is not a number" in refused(tmp_path, TABLE.replace("\n1,", "\n1D5,"), ("time",))


class TestWhatWouldHelp:
    @cases(
        ("cell", "said"),
        [
            ("n/a", "'n/a' is not a number"),
            ("OVLD", "'OVLD' is not a number"),
            ("--", "'--' is not a number"),
            ("bad 5", "'bad 5' is not a number"),
            ("NaN", "NaN is not a finite number"),
            ("-Inf", "-Inf is not a finite number"),
            ("1.5e400", "1.5e400 is not a finite number"),
            ("", "is empty; expected a number"),
        ],
    )
    def test_a_wrong_cell_among_numbers(self, tmp_path, cell, said):
        content = TABLE.replace(f",{Y[20]:.3f}\n", f",{cell}\n", 1)
        row = 1 + int(list(Y).index(Y[20]))
        remedy = f"to leave out the rows that have it, say --format missing={cell or 'empty'}"
        assert refused(tmp_path, content) == f"data.txt: line {row + 1}, row {row}, column y: {said}; {remedy}"
        found = read(tmp_path, content, missing=f"-1e9|{cell or 'empty'}")
        np.testing.assert_array_equal([*found.values.values()], np.delete([U, Y], row - 1, axis=1))
        assert found.assumptions.endswith(f"1 of {ROWS} rows left out, as a value is missing")

    def test_rows_without_a_value_leave_the_others_at_their_times(self, tmp_path):
        lines = TABLE.splitlines(keepends=True)
        lines[4], lines[9] = f"0.15,-9999,{Y[3]}\n", "late,1.0,2.0\n"
        path = write(tmp_path, "".join(lines))
        with pytest.raises(DataError, match=r"--format missing=-9999\|late"):
            read_dataset([path], ColumnNames("U", "y", time="time"), ReadingOptions(missing="-9999"))
        for options, columns in (({"interval": "50ms"}, {}), ({}, {"time": "time"})):
            missing = ReadingOptions(missing="-9999.0|late", **options)
            data = read_dataset([path], ColumnNames("U", "y", **columns), missing)
            gone = [3, 8] if columns else [3]
            np.testing.assert_allclose(data.times, np.delete(0.05 * np.arange(ROWS), gone), atol=1e-9)
            np.testing.assert_array_equal(data.inputs[:3], U[:3])

    def test_a_clock_without_a_time_in_a_row_goes_on_past_midnight(self, tmp_path):
        clock = ["23:59:58", "--", "00:00:02", *(f"00:00:{second:02}" for second in range(4, 34, 2))]
        path = write(tmp_path, "time,U,y\n" + "".join(f"{at},{n},{n % 3}\n" for n, at in enumerate(clock)))
        data = read_dataset([path], ColumnNames("U", "y", time="time"), ReadingOptions(missing="--"))
        np.testing.assert_array_equal(data.times, 2.0 * np.array([0, *range(2, len(clock))]))

    def test_a_text_in_the_first_row(self, tmp_path):
        message = refused(tmp_path, "time,U,y\nSequence,Volt,5\n" + BODY)
        assert "line 2, row 1, column U: 'Volt' is not a number; if line 2 is above the data" in message
        assert "leave it out with --format skip=N; to leave out the rows that have it, say" in message

    def test_a_column_of_texts(self, tmp_path):
        content = "day,U,y\n" + "".join(f"Tuesday,{u},{y}\n" for u, y in zip(U, Y, strict=True))
        assert "most rows have no number in this column: choose another" in refused(tmp_path, content, ("day",))

    def test_another_minus(self, tmp_path):
        assert "replace '−' by '-' in the file" in refused(tmp_path, TABLE.replace("-", "−"))

    @cases(("header", "names"), [("time:U:y\n", ("U",)), ("time:U:y\n", ("2",)), ("", ("1",))])
    def test_another_delimiter(self, tmp_path, header, names):
        content = header + BODY.replace(",", ":")
        assert refused(tmp_path, content, names).endswith("if ':' stands between columns, say --format delimiter=:")
        check(read(tmp_path, content, ("2", "3"), delimiter=":"), ("2", "3"))

    @cases(
        ("encoding", "heads"),
        [("shift_jis", "時間,電圧,変位"), ("cp1251", "время,вход,выход"), ("gb18030", "时间,电压,位移")],
    )
    def test_another_encoding(self, tmp_path, encoding, heads):
        content = (heads + "\n" + BODY).encode(encoding)
        names = heads.split(",")[1:]
        message = refused(tmp_path, content, names)
        assert f"--format encoding={encoding}" in message
        check(read(tmp_path, content, names, encoding=encoding), names)

    def test_another_encoding_where_no_name_tells_it(self, tmp_path):
        message = refused(tmp_path, ("時間,電圧,変位\n" + BODY).encode("shift_jis"))
        assert "was read as cp1252: if names look wrong, say --format encoding=NAME, such as shift_jis" in message
        assert "--format encoding=NAME" not in refused(tmp_path, ("t,U (V),x (µm)\n" + BODY).encode("cp1252"))

    @cases(
        "above",
        [
            "".join(f"note line {line} about things\n" for line in range(1500)),
            "a note about things\n" * 1500,
            "# a note\n" * 1500,
        ],
    )
    def test_many_lines_above_the_table(self, tmp_path, above):
        assert "--format skip=N" in refused(tmp_path, above + TABLE)
        check(read(tmp_path, above + TABLE, skip_lines=1500))

    def test_no_header(self, tmp_path):
        message = refused(tmp_path, BODY)
        assert message.endswith(
            "by number, 1 to 3; if a header stands further down, leave out the lines above it with --format skip=N"
        )


RECORDS = [{"U": float(u), "y": float(y)} for u, y in zip(U, Y, strict=True)]


class TestOtherFormats:
    @cases("names", [("U", "y"), ("1", "2"), ("2", "3")])
    @cases(
        ("content", "kind"),
        [
            (json.dumps({"U": U.tolist(), "y": Y.tolist()}), "JSON"),
            (json.dumps(RECORDS, indent=1), "JSON"),
            (json.dumps(RECORDS * 20, indent=1), "JSON"),
            ("\n".join(map(json.dumps, RECORDS)), "JSON"),
            ("[[1, 2], [3, 4]]", "JSON"),
            ('<?xml version="1.0"?>\n<svg>\n' + '<path d="M 1 2\nL 3 4\nL 5 6"/>\n' * 30 + "</svg>", "SVG"),
            ("<!DOCTYPE html>\n<html><table><tr><td>1</td></tr></table></html>", "HTML"),
            ('<?xml version="1.0"?>\n<data>1</data>', "XML"),
            ("%PDF-1.4\n1 2 3\n", "PDF"),
        ],
    )
    def test_what_is_no_table(self, tmp_path, content, kind, names):
        message = refused(tmp_path, content, names, "file.txt")
        assert message.startswith(
            f"file.txt: is {kind}, not a table; text, .gz of text, .mat, .h5, .tdms, .npz, .parquet, .json and "
            "spreadsheets"
        )

    @cases("above", ['{"sample": 3}\n', '{"sample": {\n"a": 3}}\n', "[[Data]]\n", "[Header]\n"])
    def test_what_stands_above_a_table(self, tmp_path, above):
        check(read(tmp_path, above + TABLE))

    def test_what_stands_above_a_table_is_left_out(self, tmp_path):
        content = '<?xml version="1.0"?>\n' + TABLE
        assert "with --format skip=N" in refused(tmp_path, content)
        check(read(tmp_path, content, skip_lines=1))

    @cases(("name", "save"), [("d.mat", matlab), ("d.parquet", parquet)])
    def test_matlab_and_parquet(self, tmp_path, name, save):
        path = write(tmp_path, save(U=U, y=np.where(np.arange(ROWS) == 4, np.nan, Y)), name)
        with pytest.raises(DataError, match=r"row 5, column y: nan is not .*say --format missing=nan"):
            read_columns(path, ("U", "y"))
        found = read_columns(path, ("U", "y"), options=ReadingOptions(missing="nan"))
        np.testing.assert_array_equal([*found.values.values()], np.delete([U, Y], 4, axis=1))
