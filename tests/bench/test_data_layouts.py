"""One table in the layouts in which people have it: each is read to equal values, or refused with what would help."""

import gzip
import io
from datetime import datetime, timedelta

import numpy as np
import pytest
from cases import cases
from hypothesis import given, settings, strategies as st

from bench.analysis import ReadingOptions, read_columns
from bench.analysis.tables.reading.heads import is_unit, make_heads, split_unit
from bench.base import BenchError, ConfigurationError, DataError

ROWS = 40
U = np.round(2.0 + 1.75 * np.sin(0.3 * np.arange(ROWS)), 4)
Y = np.round(-3.5 + 12.25 * np.cos(0.3 * np.arange(ROWS)), 3)
TIME = np.arange(ROWS) * 0.05


def number(value, decimal="."):
    return f"{value:.6g}".replace(".", decimal)


def body(delimiter=",", decimal=".", columns=(TIME, U, Y)):
    return "".join(
        delimiter.join(number(value, decimal) for value in row) + "\n" for row in zip(*columns, strict=True)
    )


def table(delimiter=",", decimal=".", heads=("time", "U", "y")):
    return delimiter.join(heads) + "\n" + body(delimiter, decimal)


WITH_UNITS = ("time [s]", "U [V]", "y [µm]")
UNITS = ("V", "µm")
PREAMBLE = "Oscilloscope 5000\nSerial,A12\nSample rate,20\n\n"
QUOTED = (
    ",".join(['"time"', '"U"', '"y, filtered"'])
    + "\n"
    + "".join(f'"{number(t)}","{number(u)}","{number(y)}"\n' for t, u, y in zip(TIME, U, Y, strict=True))
)
QUOTED_COMMA = '"time","U","y"\n' + "".join(
    f'"{number(t, ",")}","{number(u, ",")}","{number(y, ",")}"\n' for t, u, y in zip(TIME, U, Y, strict=True)
)

LAYOUTS = {
    # name: (content, names of columns, units or None, words of the line)
    "plain": (table(), ("U", "y"), None, "comma-separated"),
    "semicolon": (table(";"), ("U", "y"), None, "semicolon-separated"),
    "tab": (table("\t"), ("U", "y"), None, "tab-separated"),
    "bar": (table("|"), ("U", "y"), None, "separated by |"),
    "names, units and remarks": (
        "time\tU\ty\ns\tV\tµm\n\t\tfiltered\n" + body("\t"), ("U", "y"), UNITS, "units from a row"
    ),
    "unit row, and a number in the preamble": (
        "x-axis,1,2\ntime,U,y\ns,V,µm\n" + body(), ("U", "y"), UNITS, "1 line above the header, units from a row"
    ),
    "runs of blanks": (table("   "), ("U", "y"), None, "separated by blanks"),
    "aligned blanks": (
        "".join("  " + line.replace(",", "    ") + "  \n" for line in table().splitlines()),
        ("U", "y"), None, "separated by blanks",
    ),
    "comma and blank": (table(", "), ("U", "y"), None, "comma-separated"),
    "semicolon, decimal comma": (table(";", ","), ("U", "y"), None, "semicolon-separated, decimal comma"),
    "tab, decimal comma": (table("\t", ","), ("U", "y"), None, "tab-separated, decimal comma"),
    "blanks, decimal comma": (table("  ", ","), ("U", "y"), None, "separated by blanks, decimal comma"),
    "quoted": (QUOTED, ("U", "y, filtered"), None, "comma-separated"),
    "quoted, decimal comma": (QUOTED_COMMA, ("U", "y"), None, "comma-separated, decimal comma"),
    "byte-order mark": (table(heads=WITH_UNITS).encode("utf-8-sig"), ("U", "y"), UNITS, "comma-separated"),
    "latin-1": (table(";", ",", WITH_UNITS).encode("latin-1"), ("U", "y"), UNITS, "cp1252"),
    "cp1252": (table("\t", heads=("t [s]", "U [V]", "y [°C]")).encode("cp1252"), ("U", "y"), ("V", "°C"), "cp1252"),
    "UTF-16": (table("\t", ",", WITH_UNITS).encode("utf-16"), ("U", "y"), UNITS, "UTF-16, tab-separated"),
    "UTF-16 without a mark": (table(heads=WITH_UNITS).encode("utf-16-le"), ("U", "y"), UNITS, "UTF-16-LE"),
    "CRLF": (table().replace("\n", "\r\n"), ("U", "y"), None, ""),
    "CR": (table().replace("\n", "\r"), ("U", "y"), None, ""),
    "number sign": ("# sample 3\n#2026\n" + table(), ("U", "y"), None, "2 lines of comment"),
    "percent": ("% sample 3, 2 V\n" + table("\t"), ("U", "y"), None, "1 line of comment"),
    "solidi": ("// sample 3\n\n" + table(";"), ("U", "y"), None, "1 line of comment"),
    "semicolons": ("; sample 3\n" + table(), ("U", "y"), None, "1 line of comment"),
    "comments between": (
        table().replace("\n0.1,", "\n# paused\n0.1,"), ("U", "y"), None, "1 line of comment",
    ),
    "header in a comment": ("# sample 3\n# time U y\n" + body(" "), ("U", "y"), None, "header from a comment"),
    "preamble": (PREAMBLE + table(), ("U", "y"), None, "3 lines above the header"),
    "unit row": ("time;U;y\ns;V;µm\n" + body(";", ","), ("U", "y"), UNITS, "units from a row"),
    "unit row in brackets": ("time\tU\ty\n[s]\t[V]\t[µm]\n" + body("\t"), ("U", "y"), UNITS, "units from a row"),
    "units in brackets": (table(heads=WITH_UNITS), ("U", "y"), UNITS, ""),
    "units in brackets, blanks": (table("  ", heads=WITH_UNITS), ("U", "y"), UNITS, "separated by blanks"),
    "units in parentheses": (table(heads=("time (s)", "U (V)", "y (μm)")), ("U", "y"), UNITS, ""),
    "units after a solidus": (table(heads=("time/s", "U/V", "y / um")), ("U", "y"), UNITS, ""),
    "units after an underscore": (table(heads=("time_s", "U_V", "y_um")), ("U", "y"), UNITS, ""),
    "no header": (body(), ("2", "3"), None, "no header"),
    "no header, decimal comma": (body("\t", ","), ("2", "3"), None, "decimal comma, no header"),
    "by number": (table(heads=("x", "x", "x")), ("2", "3"), None, ""),
    "trailing empty columns": (
        table().replace("\n", "," * 2000 + "\n"), ("U", "y"), None, "comma-separated",
    ),
    "trailing empty rows": (table() + ",,\n" * 5, ("U", "y"), None, ""),
    "remark below": (table() + "\nend of measurement\n", ("U", "y"), None, "1 line below the table left out"),
    "gzip": (gzip.compress(table(";", ",").encode()), ("U", "y"), None, "gzip, semicolon-separated"),
}  # fmt: skip


def write(folder, content, name="data.txt"):
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def check(columns, names, units=None):
    np.testing.assert_array_equal(columns.values[names[0]], U)
    np.testing.assert_array_equal(columns.values[names[1]], Y)
    if units is not None:
        assert tuple(columns.units.values()) == units


@cases("name", LAYOUTS)
def test_a_layout_is_read(tmp_path, name):
    content, names, units, words = LAYOUTS[name]
    columns = read_columns(write(tmp_path, content), names)
    check(columns, names, units)
    assert words in columns.assumptions


@cases("name", ["semicolon, decimal comma", "plain", "preamble", "gzip"])
def test_a_column_by_its_number(tmp_path, name):
    check(read_columns(write(tmp_path, LAYOUTS[name][0]), ("2", "3")), ("2", "3"))


class TestOtherFormats:
    def matlab(self, path, content):
        from scipy.io import savemat

        savemat(path, content)
        return path

    def test_matlab_vectors(self, tmp_path):
        path = self.matlab(tmp_path / "data.mat", {"U": U, "y": Y[:, None], "note": "sample 3"})
        columns = read_columns(path, ("U", "y"))
        check(columns, ("U", "y"))
        assert columns.assumptions == "MATLAB"

    def test_matlab_matrix_by_number(self, tmp_path):
        path = self.matlab(tmp_path / "data.mat", {"data": np.column_stack([TIME, U, Y])})
        check(read_columns(path, ("2", "3")), ("2", "3"))

    def test_matlab_structures(self, tmp_path):
        path = self.matlab(tmp_path / "data.mat", {"first": {"U": U, "y": Y}, "second": {"U": Y, "y": U}})
        check(read_columns(path, ("first.U", "first.y")), ("first.U", "first.y"))
        check(read_columns(path, ("y", "U"), options=ReadingOptions(table="second")), ("y", "U"))
        with pytest.raises(DataError, match=r"has no column 'U'; it has: first\.U"):
            read_columns(path, ("U", "y"))
        with pytest.raises(DataError, match="--table third: has no such variable; it has: first, second"):
            read_columns(path, ("U", "y"), options=ReadingOptions(table="third"))

    def test_matlab_columns_of_other_lengths(self, tmp_path):
        path = self.matlab(tmp_path / "data.mat", {"U": U, "y": Y[:-1]})
        with pytest.raises(DataError, match="columns differ in length: U 40, y 39"):
            read_columns(path, ("U", "y"))

    @cases(
        "content",
        [b"\x89HDF\r\n\x1a\n" + bytes(100), b"MATLAB 7.3 MAT-file, Platform: GLNXA64" + b" " * 86 + b"\0\2IM"],
    )
    def test_matlab_7_3_says_how_to_save_it(self, tmp_path, content):
        with pytest.raises(DataError, match=r"data\.mat is a MATLAB file of version 7\.3 .*'-v7'"):
            read_columns(write(tmp_path, content, "data.mat"), ("U", "y"))

    def spreadsheet(self, path, sheets):
        import openpyxl

        book = openpyxl.Workbook()
        book.remove(book.active)
        for title, rows in sheets.items():
            sheet = book.create_sheet(title)
            for row in rows:
                sheet.append(row)
        book.save(path)
        return path

    def rows(self):
        return [[float(value) for value in row] for row in zip(TIME, U, Y, strict=True)]

    def test_spreadsheet(self, tmp_path):
        rows = [["Sample 3"], [], ["time", "U", "y"], ["s", "V", "µm"], *self.rows()]
        path = self.spreadsheet(tmp_path / "data.xlsx", {"run": rows})
        columns = read_columns(path, ("U", "y"))
        check(columns, ("U", "y"), UNITS)
        assert columns.assumptions == "sheet run, 1 line above the header, units from a row"

    def test_sheets_are_chosen(self, tmp_path):
        rows = [["time", "U", "y"], *self.rows()]
        path = self.spreadsheet(tmp_path / "data.xlsx", {"notes": [["nothing"]], "run": rows})
        with pytest.raises(DataError, match="has 2 sheets: notes, run; choose one with --table"):
            read_columns(path, ("U", "y"))
        for chosen in ("run", "2"):
            check(read_columns(path, ("U", "y"), options=ReadingOptions(table=chosen)), ("U", "y"))
        with pytest.raises(DataError, match="sheet notes: has no numbers"):
            read_columns(path, ("U", "y"), options=ReadingOptions(table="notes"))

    def test_a_wrong_cell_of_a_sheet(self, tmp_path):
        path = self.spreadsheet(tmp_path / "d.xlsx", {"run": [["U", "y"], [1.0, 2.0], [3.0, "bad"], [5.0, None]]})
        with pytest.raises(DataError, match="sheet run, row 3, column y: 'bad' is not a number"):
            read_columns(path, ("U", "y"))

    def test_parquet(self, tmp_path):
        import pyarrow as pa
        import pyarrow.parquet as pq

        pq.write_table(pa.table({"U [V]": U, "y [µm]": Y, "note": ["x"] * ROWS}), tmp_path / "data.parquet")
        check(read_columns(tmp_path / "data.parquet", ("U", "y")), ("U", "y"), UNITS)
        with pytest.raises(DataError, match="has no column 'force'; it has: U"):
            read_columns(tmp_path / "data.parquet", ("force",))
        with pytest.raises(DataError, match="cannot be read as Parquet"):
            read_columns(tmp_path / "data.parquet", ("note",))

    @cases(
        ("name", "content", "words"),
        [
            ("data.xls", b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(600), "save it as .xlsx or CSV"),
            ("data.ods", b"PK\x03\x04" + bytes(600), "save it as .xlsx or CSV"),
            ("data.xlsx", b"PK\x03\x04" + bytes(600), "cannot be read as a spreadsheet"),
            ("data.mat", b"nothing of the kind" * 20, "cannot be read as a MATLAB file"),
            ("data.parquet", b"PAR1" + bytes(600), "cannot be read as Parquet"),
            ("data.png", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\x80\x90", "is no table of text"),
            ("data.gz", b"\x1f\x8b" + bytes(60), "cannot be read"),
        ],
    )
    def test_what_is_damaged_or_not_read(self, tmp_path, name, content, words):
        with pytest.raises(DataError, match=words) as caught:
            read_columns(write(tmp_path, content, name), ("U", "y"))
        assert name in str(caught.value)


MOMENTS = {
    "date and time": lambda s: f"2026-11-25 23:59:{s:06.3f}",
    "with a zone": lambda s: f"2026-11-26T00:59:{s:06.3f}+01:00",
    "in universal time": lambda s: f"2026-11-25T23:59:{s:06.3f}Z",
    "time of day": lambda s: f"23:59:{s:06.3f}",
    "hours without a zero": lambda s: f"7:05:{s:06.3f}",
    "elapsed": lambda s: f"112:05:{s:06.3f}",
}


class TestDatesAndTimes:
    """Of a column of dates or times the seconds since its first row are read."""

    @cases("name", MOMENTS)
    @cases("layout", ["{},{},{}", '"{}";"{}";"{}"'])
    def test_text(self, tmp_path, name, layout):
        rows = [layout.format(MOMENTS[name](t), u, y) for t, u, y in zip(TIME, U, Y, strict=True)]
        head = layout.format("time", "U", "y")
        columns = read_columns(write(tmp_path, "\n".join([head, *rows]) + "\n"), ("U", "y", "time"))
        check(columns, ("U", "y"))
        assert columns.units["time"] == "s"
        assert columns.assumptions.endswith("time: dates and times, in s since the first row")
        np.testing.assert_allclose(columns.values["time"], TIME, atol=1e-6)

    def test_seconds_with_a_decimal_comma(self, tmp_path):
        rows = [f"23:59:{t:06.3f}\t{u}\t{y}".replace(".", ",") for t, u, y in zip(TIME, U, Y, strict=True)]
        columns = read_columns(write(tmp_path, "\n".join(["time\tU\ty", *rows])), ("U", "y", "time"))
        check(columns, ("U", "y"))
        np.testing.assert_allclose(columns.values["time"], TIME, atol=1e-6)

    def test_spreadsheet_and_parquet(self, tmp_path):
        import openpyxl
        import pyarrow as pa
        import pyarrow.parquet as pq

        start = datetime.fromisoformat("2026-11-25 23:59")
        moments = [start + timedelta(seconds=float(t)) for t in TIME]
        book = openpyxl.Workbook()
        for row in [("time", "U", "y"), *zip(moments, U.tolist(), Y.tolist(), strict=True)]:
            book.active.append(row)
        book.save(tmp_path / "data.xlsx")
        pq.write_table(pa.table({"time": moments, "U": U, "y": Y}), tmp_path / "data.parquet")
        for name in ("data.xlsx", "data.parquet"):
            columns = read_columns(tmp_path / name, ("U", "y", "time"))
            check(columns, ("U", "y"))
            assert columns.units["time"] == "s"
            np.testing.assert_allclose(columns.values["time"], TIME, atol=1e-5)

    @cases("cell", ["23:59", "late", "", "2026-11-25 23:61:00"])
    def test_another_cell_among_them_is_named(self, tmp_path, cell):
        rows = [f"23:59:{t:06.3f},{u},{y}" for t, u, y in zip(TIME, U, Y, strict=True)]
        rows[5] = f"{cell},1,2"
        path = write(tmp_path, "\n".join(["time,U,y", *rows]) + "\n")
        with pytest.raises(DataError, match=r"row 6, column time: .* is no date and time"):
            read_columns(path, ("U", "time"))

    def test_they_are_no_numbers_elsewhere(self, tmp_path):
        path = write(tmp_path, "time,U\n0,1\n1,2\n23:59:01,3\n")
        with pytest.raises(DataError, match="row 3, column time: '23:59:01' is not a number"):
            read_columns(path, ("U", "time"))


class TestRefused:
    def refused(self, folder, content, *words, names=("U", "y"), error=DataError, **options):
        with pytest.raises(error) as caught:
            read_columns(write(folder, content), names, options=ReadingOptions(**options))
        for word in words:
            assert word in str(caught.value), str(caught.value)

    def test_commas_that_delimit_or_are_decimal(self, tmp_path):
        text = "1,234\n2,345\n3,456\n"
        self.refused(tmp_path, text, "line 1", "--delimiter comma, or --decimal comma", names=("1",))
        path = write(tmp_path, text)
        whole = read_columns(path, ("1", "2"), options=ReadingOptions(delimiter="comma")).values
        np.testing.assert_array_equal(whole["2"], [234.0, 345.0, 456.0])
        parts = read_columns(path, ("1",), options=ReadingOptions(decimal="comma")).values
        np.testing.assert_array_equal(parts["1"], [1.234, 2.345, 3.456])

    def test_twice_as_many_cells_as_heads(self, tmp_path):
        self.refused(tmp_path, "U,y\n1,5,2,25\n1,7,2,50\n", "line 2", "where it is both, save the file with another")

    def test_one_column_of_decimal_commas(self, tmp_path):
        columns = read_columns(write(tmp_path, "target\n0,5\n1,25\n"), ("target",))
        np.testing.assert_array_equal(columns.values["target"], [0.5, 1.25])
        assert columns.assumptions == "one column, decimal comma"

    def test_more_columns_than_heads(self, tmp_path):
        text = "U y\n1 0.5 2\n2 0.7 3\n"
        self.refused(tmp_path, text, "line 1: the header does not fit the 3 columns", "by number, 1 to 3")
        np.testing.assert_array_equal(read_columns(write(tmp_path, text), ("2",)).values["2"], [0.5, 0.7])

    def test_two_columns_of_one_name(self, tmp_path):
        self.refused(tmp_path, table(heads=("U", "y", "y")), "has 2 columns 'y'", "by its number: 2 or 3")

    def test_separators_of_thousands(self, tmp_path):
        self.refused(tmp_path, "U\ty\n1.5\t2.5\n1.5\t1,234.5\n", "line 3, row 2, column y", "thousands are not read")

    def test_points_among_decimal_commas(self, tmp_path):
        text = table(";", ",") + "2,0;1.234;5,5\n"
        self.refused(tmp_path, text, "line 42, row 41, column U: '1.234' is not a number", "--decimal .")

    def test_a_decimal_comma_after_whole_numbers(self, tmp_path):
        text = "U;y\n" + "1;2\n" * 2000 + "1,5;2\n"
        self.refused(tmp_path, text, "line 2002, row 2001, column U: '1,5' is not a number", "--decimal ,")
        columns = read_columns(write(tmp_path, text), ("U",), options=ReadingOptions(decimal=","))
        assert columns.values["U"][-1] == 1.5

    def test_a_preamble_that_looks_like_data(self, tmp_path):
        text = "Sample rate;1000\n1,5;2,5\n3,5;4,5\n"
        self.refused(tmp_path, text, names=("first",))
        columns = read_columns(write(tmp_path, text), ("1",), options=ReadingOptions(skip_lines=1))
        np.testing.assert_array_equal(columns.values["1"], [1.5, 3.5])

    def test_another_encoding(self, tmp_path):
        content = table(heads=("time", "U", "Länge")).encode("mac-roman")
        self.refused(tmp_path, content, "has no column 'Länge'", names=("U", "Länge"))
        options = ReadingOptions(encoding="mac-roman")
        check(read_columns(write(tmp_path, content), ("U", "Länge"), options=options), ("U", "Länge"))
        self.refused(tmp_path, b"U,y\n1,2\n\x81,3\n", "--encoding")
        self.refused(tmp_path, content, "--encoding", encoding="utf-8")

    @cases(
        ("options", "words"),
        [
            ({"delimiter": "some"}, "--delimiter 'some': expected a character"),
            ({"delimiter": "5"}, "--delimiter"),
            ({"decimal": ";"}, "--decimal ';': expected point or comma"),
            ({"encoding": "klingon"}, "--encoding 'klingon' is unknown"),
            ({"skip_lines": -1}, "--skip-lines -1"),
            ({"table": "0"}, "--table '0'"),
            ({"table": "run"}, "--table 'run': the tables of a text file have numbers"),
        ],
    )
    def test_options_that_are_wrong(self, tmp_path, options, words):
        self.refused(tmp_path, table(), words, error=ConfigurationError, **options)

    def test_options_that_do_not_apply(self, tmp_path):
        with pytest.raises(ConfigurationError, match=r"--decimal does not apply: .* is a run"):
            read_columns(tmp_path, ("U",), options=ReadingOptions(decimal=","))


BREAKS = {
    "blank line and header": (table(), "\n" + table()),
    "title": (table(), "\nsecond sweep\n\n" + table()),
    "header again": (table(), table()),
    "other columns": (table(), "U,y\n" + body(columns=(U, Y))),
    "comment": ("# one\n" + table(" "), "\n# two\n# time U y\n" + body(" ")),
    "two blank lines": (body(" "), "\n\n" + body(" ")),
}


class TestSeveralTables:
    @cases("name", BREAKS)
    def test_a_table_is_chosen(self, tmp_path, name):
        first, second = BREAKS[name]
        path = write(tmp_path, first + second)
        names = ("2", "3") if name == "two blank lines" else ("U", "y")
        with pytest.raises(
            DataError, match=r"has 2 tables, whose data begin in the lines .*; choose one with --table, 1"
        ):
            read_columns(path, names)
        for number_ in ("1", "2"):
            columns = read_columns(path, names, options=ReadingOptions(table=number_))
            check(columns, names)
            assert f"table {number_}" in columns.assumptions
        with pytest.raises(DataError, match="--table 3: it has 2 tables"):
            read_columns(path, names, options=ReadingOptions(table="3"))

    def test_a_blank_line_alone_does_not_end_a_table(self, tmp_path):
        path = write(tmp_path, table().replace("\n0.1,", "\n\n0.1,"))
        check(read_columns(path, ("U", "y")), ("U", "y"))

    def test_a_table_behind_the_lines_that_are_looked_at(self, tmp_path):
        path = write(tmp_path, "a b\n" + "1.5 2.5\n" * 3000 + "\n" + table())
        check(read_columns(path, ("U", "y"), options=ReadingOptions(table="2")), ("U", "y"))


class TestHeads:
    @cases(
        ("head", "name", "unit"),
        [
            ("force (N)", "force", "N"),
            ("force (raw)", "force (raw)", ""),
            ("force[N]", "force", "N"),
            ("x[0]", "x[0]", ""),
            ("U / V", "U", "V"),
            ("v / (m/s)", "v", "m/s"),
            ("curvature (1/m)", "curvature", "1/m"),
            ("speed m/s", "speed m/s", ""),
            ("T/°C", "T", "°C"),
            ("T [degC]", "T", "°C"),
            ("field (kA/m)", "field", "kA/m"),
            ("voltage_V", "voltage_V", ""),
        ],
    )
    def test_a_unit_in_a_head(self, head, name, unit):
        assert split_unit(head) == (name, unit)

    @cases(
        ("texts", "units"),
        [
            (("time_s", "voltage_V", "displacement_um"), ["s", "V", "µm"]),
            (("x_m", "x_d"), ["", ""]),
            (("x_s", "x_V"), ["", ""]),
            (("time_s", "displacement_um", "remark"), ["", "", ""]),
            (("x_1", "x_2"), ["", ""]),
        ],
    )
    def test_units_after_underscores_only_where_all_have_one(self, texts, units):
        assert [head.unit for head in make_heads(texts)] == units

    @cases("text", ["V", "µm", "μm", "kA/m", "1/m", "m/s²", "m/s^2", "°C", "%", "N m", "N·m", "-"])
    def test_units(self, text):
        assert is_unit(text)

    @cases("text", ["voltage", "U1", "raw", "0", "channel 1", "run", ""])
    def test_what_is_no_unit(self, text):
        assert not is_unit(text)


NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
DIALECTS = st.fixed_dictionaries(
    {
        "delimiter": st.sampled_from([",", ";", "\t", " ", "   "]),
        "decimal": st.sampled_from([".", ","]),
        "ending": st.sampled_from(["\n", "\r\n", "\r"]),
        "encoding": st.sampled_from(["utf-8", "utf-8-sig", "cp1252", "utf-16", "utf-16-le"]),
        "comments": st.lists(st.sampled_from(["# made by hand", "% 1, 2; 3", "// µ"]), max_size=3),
        "unit_row": st.booleans(),
        "header": st.booleans(),
        "compressed": st.booleans(),
    }
)


@settings(deadline=None, max_examples=150)
@given(
    dialect=DIALECTS,
    values=st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS), min_size=2, max_size=12),
)
def test_what_is_written_in_a_dialect_is_read_to_the_last_digit(tmp_path_factory, dialect, values):
    delimiter, decimal = dialect["delimiter"], dialect["decimal"]
    if delimiter == decimal:
        delimiter = ";"
    lines = [*dialect["comments"]]
    if dialect["header"]:
        lines.append(delimiter.join(("first", "second", "third")))
        if dialect["unit_row"]:
            lines.append(delimiter.join(("V", "µm", "s")))
    lines += [delimiter.join(repr(value).replace(".", decimal) for value in row) for row in values]
    content = (dialect["ending"].join(lines) + dialect["ending"]).encode(dialect["encoding"])
    path = tmp_path_factory.getbasetemp() / "dialect.dat"
    path.write_bytes(gzip.compress(content) if dialect["compressed"] else content)
    names = ("first", "second", "third") if dialect["header"] else ("1", "2", "3")
    columns = read_columns(path, names)
    for name, expected in zip(names, np.array(values).T, strict=True):
        np.testing.assert_array_equal(columns.values[name], expected)
    if dialect["header"] and dialect["unit_row"]:
        assert columns.units == {"first": "V", "second": "µm", "third": "s"}


@settings(deadline=None, max_examples=150)
@given(
    st.text("0123456789.,;:#%/ \t\n\"'abe[]()V-+µ", max_size=200), st.sampled_from([None, ",", ";", "tab", "blanks"])
)
def test_any_text_is_read_or_refused(tmp_path_factory, text, delimiter):
    path = tmp_path_factory.getbasetemp() / "any.txt"
    path.write_text(text, encoding="utf-8")
    try:
        columns = read_columns(path, ("1",), options=ReadingOptions(delimiter=delimiter))
    except BenchError as error:
        assert "any.txt" in str(error)  # noqa: PT017 - either way is right
    else:
        assert np.isfinite(columns.values["1"]).all()


def test_numbers_are_no_heads_where_another_delimiter_makes_all_of_them_numbers(tmp_path):
    columns = read_columns(write(tmp_path, "1,0;0,0;1,1\n1e-14;0,0;0,0\n1e-14;0,0;0,0\n"), ("1", "3"))
    assert columns.values["1"].tolist() == [1.0, 1e-14, 1e-14]
    assert columns.values["3"].tolist() == [1.1, 0.0, 0.0]


def test_many_rows_are_read_as_numpy_reads_them(tmp_path):
    array = np.random.default_rng(0).normal(size=(20_000, 3))
    text = io.StringIO()
    np.savetxt(text, array, delimiter="\t", header="t\tu\ty")
    columns = read_columns(write(tmp_path, text.getvalue()), ("u", "y"))
    np.testing.assert_array_equal(columns.values["u"], array[:, 1])
    np.testing.assert_array_equal(columns.values["y"], array[:, 2])
    assert columns.assumptions == "tab-separated, header from a comment, 1 line of comment"


MODEL = ("--model", "polynomial", "--degree", "3")


class TestCommands:
    """Identify from a file of decimal commas, and apply the model to the same values in other layouts."""

    COLUMNS = ("--input", "U", "--output", "y")
    CONTENT = table(";", ",", WITH_UNITS)

    @pytest.fixture
    def model(self, bench, tmp_path):
        path = tmp_path / "model.json"
        file = write(tmp_path, self.CONTENT)
        code, out, err = bench("identify", file, *self.COLUMNS, *MODEL, "--out", path)
        # A cubic polynomial explains little of these numbers, which is said.
        assert (code, err.count("\n")) == (0, 1)
        assert "read data.txt: semicolon-separated, decimal comma\n" in out
        return path

    def test_the_model_is_that_of_plain_numbers(self, bench, model, tmp_path):
        plain = write(tmp_path, table(heads=WITH_UNITS), "plain.csv")
        again = tmp_path / "again.json"
        bench("identify", plain, *self.COLUMNS, *MODEL, "--out", again)
        assert again.read_text() == model.read_text().replace("data.txt", "plain.csv")

    @pytest.mark.parametrize("command", ["identify", "predict", "invert", "compare"])
    def test_options_of_the_layout(self, bench, model, tmp_path, command):
        content = "written by hand; 3 4\n" + "\n".join("5,6;7,8;9,1" for _ in range(20)) + "\n\ntime;U\n"
        content += "".join(f"{number(u, ',')};{number(y, ',')}\n" for u, y in zip(U, Y, strict=True))
        file = write(tmp_path, content.encode("utf-16"), "other.dat")
        options = (
            "--delimiter", ";", "--decimal", "comma", "--encoding", "utf-16", "--skip-lines", "1", "--table", "2"
        )  # fmt: skip
        arguments = {
            "identify": ("identify", file, "--input", "1", "--output", "2", *MODEL),
            "predict": ("predict", model, file, "--input", "1", "--output", "2", "--out", tmp_path / "p.csv"),
            "invert": ("invert", model, file, "--column", "2", "--out", tmp_path / "i.csv"),
            "compare": ("compare", model, "--data", file, "--input", "1", "--output", "2"),
        }[command]
        code, out, err = bench(*arguments, *options)
        assert code == 0, err
        assert "read other.dat: UTF-16, table 2, semicolon-separated, decimal comma\n" in out
        code, _, err = bench(*arguments, *options[:-2])
        assert code == 3
        assert "has 2 tables" in err
        assert "--table" in err

    @pytest.mark.parametrize(
        ("command", "option", "name", "exit_code"),
        [
            *((command, "--json", "none/a", 2) for command in ("identify", "predict", "invert", "compare")),
            *((command, "--out", "none/a", 3) for command in ("identify", "predict", "invert")),
            *((command, "--figures", "data.txt/a", 3) for command in ("identify", "compare")),
        ],
    )
    def test_outputs_are_checked_first(self, bench, model, tmp_path, command, option, name, exit_code):
        absent = tmp_path / "absent.csv"
        arguments = {
            "identify": ("identify", absent, *self.COLUMNS, *MODEL),
            "predict": ("predict", model, absent, "--input", "U"),
            "invert": ("invert", model, absent, "--column", "y"),
            "compare": ("compare", model, "--data", absent),
        }[command]
        if command == "predict" and option != "--out":
            arguments += ("--out", tmp_path / "p.csv")
        found, out, err = bench(*arguments, option, tmp_path / name)
        assert (found, out) == (exit_code, "")
        assert f"error: {option} " in err
        assert "absent.csv" not in err

    def test_wrong_options_are_one_message(self, bench, tmp_path):
        file = write(tmp_path, self.CONTENT)
        code, _, err = bench("identify", file, *self.COLUMNS, *MODEL, "--decimal", "dot")
        assert (code, err) == (2, "error: --decimal 'dot': expected point or comma\n")
        code, _, err = bench("compare", file, file, "--decimal", "comma")
        assert code == 2
        assert "for models, with --data" in err

    def test_from_python(self, tmp_path):
        import bench

        file = write(tmp_path, self.CONTENT)
        found = bench.identify(
            file, "polynomial", degree=3, input="2", output="3", decimal=",", delimiter="semicolon"
        )
        np.testing.assert_array_equal(found.inputs, U)
        assert found.file.operator.output_unit == "µm"


class TestNoRowVanishes:
    """A row of the file is read, or the file is refused with its line, or a note counts the row."""

    ROWS = 400

    def write(self, path, changes):
        lines = ["t,u,y,remark", *(f"{i / 10:.1f},{i % 50},{i % 7},fine" for i in range(self.ROWS))]
        for line, remark in changes.items():
            lines[line - 1] = lines[line - 1].replace("fine", remark)
        path.write_bytes("\n".join([*lines, ""]).encode())
        return path

    @pytest.mark.parametrize("command", ["identify", "import"])
    @pytest.mark.parametrize("end", [{}, {301: 'again"'}, {301: 'again" and off'}], ids=["open", "closed", "stray"])
    def test_a_quote_that_is_not_closed_in_its_line_is_refused(self, bench, tmp_path, command, end):
        path = self.write(tmp_path / "a.csv", {201: '"5 N hung on', **end})
        columns = ["--input", "u", "--output", "y"]
        options = (
            ["--model", "polynomial", "--degree", "1"]
            if command == "identify"
            else ["--time", "t", "--out", tmp_path / "runs"]
        )
        code, _, err = bench(command, path, *columns, *options)
        assert code == 3
        assert "a.csv: line 201: a quotation mark opens a cell" in err

    @cases("remark", ['"5 N, hung on"', '5" disc', '"a ""b"" c"', "a\x0bb\x0cc\x1cd", "a\u2028b\x85c", ""])
    def test_what_stays_in_its_cell_costs_no_row(self, tmp_path, remark):
        path = self.write(tmp_path / "a.csv", {201: remark})
        read = read_columns(path, ["t", "u", "y"])
        assert [len(column) for column in read.values.values()] == [self.ROWS] * 3

    @cases("remark", ["a\0b", "a\rb", "fine\nt,u,y,remark", "fine\n1.0", "fine\n\n\n1,2,3,fine"])
    def test_what_breaks_a_table_is_refused(self, tmp_path, remark):
        path = self.write(tmp_path / "a.csv", {201: remark})
        with pytest.raises(DataError, match=r"a\.csv"):
            read_columns(path, ["t", "u", "y"])

    def test_a_comment_among_the_rows_is_counted_whatever_it_quotes(self, tmp_path):
        path = self.write(tmp_path / "a.csv", {201: 'fine\n# "5 N hung on'})
        read = read_columns(path, ["t", "u", "y"])
        assert [len(column) for column in read.values.values()] == [self.ROWS] * 3
        assert "1 line of comment" in read.assumptions


@pytest.mark.parametrize("delimiter", [",", "\t", " ", "|", ";"])
@pytest.mark.parametrize("wrong", ["5.5 5 6 7", "5 .5 6 7", "5 6 7 8 9"])
def test_a_row_of_more_numbers_than_columns_is_refused(tmp_path, delimiter, wrong):
    """A decimal comma, or a blank within a number, would move all that follow into other columns."""
    rows = [f"{i}.5 {2 * i}.25 {3 * i}.125" for i in range(30)]
    rows[20] = wrong
    path = write(tmp_path, ("\n".join(["time u y", *rows]) + "\n").replace(" ", delimiter).encode())
    with pytest.raises(DataError, match=r"line 22, row 21: has \d cells; the table has 3 columns"):
        read_columns(path, ["u", "y"])


def test_a_remark_behind_the_last_column_is_left_alone(tmp_path):
    rows = [f"{i}.5,{2 * i}.25,{3 * i}.125" + ",looks odd" * (i == 20) for i in range(30)]
    path = write(tmp_path, ("\n".join(["time,u,y", *rows]) + "\n").encode())
    assert read_columns(path, ["y"]).values["y"].tolist() == [3 * i + 0.125 for i in range(30)]
