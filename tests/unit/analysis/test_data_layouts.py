"""What the layout of a file is taken for where it is not obvious, and the commands that read it."""

import gzip
import io
import re

import numpy as np
import pytest
from cases import cases
from hypothesis import assume, given, settings, strategies as st
from lab_tables import WITH_UNITS, U, Y, body, check, number, table, write

from bench.analysis import ReadingOptions, read_columns
from bench.analysis.tables.reading.heads import is_unit, make_heads, split_unit
from bench.base import BenchError, ConfigurationError, DataError


class TestRefused:
    def refused(self, folder, content, *words, names=("U", "y"), error=DataError, **options):
        with pytest.raises(error) as caught:
            read_columns(write(folder, content), names, options=ReadingOptions(**options))
        for word in words:
            assert word in str(caught.value), str(caught.value)

    def test_commas_that_delimit_or_are_decimal(self, tmp_path):
        text = "1,234\n2,345\n3,456\n"
        self.refused(tmp_path, text, "line 1", "--format delimiter=comma, or --format decimal=comma", names=("1",))
        path = write(tmp_path, text)
        whole = read_columns(path, ("1", "2"), options=ReadingOptions(delimiter="comma")).values
        np.testing.assert_array_equal(whole["2"], [234.0, 345.0, 456.0])
        parts = read_columns(path, ("1",), options=ReadingOptions(decimal="comma")).values
        np.testing.assert_array_equal(parts["1"], [1.234, 2.345, 3.456])

    @cases(
        ("text", "words"),
        [
            ("U,y\n1,5,2,25\n1,7,2,50\n", ["line 2", "where it is both, save the file with another"]),
            (table(heads=("U", "y", "y")), ["has 2 columns 'y'", "by its number: 2 or 3"]),
            ("U\ty\n1.5\t2.5\n1.5\t1,234.5\n", ["line 3, row 2, column y", "thousands are not read"]),
            (
                table(";", ",") + "2,0;1.234;5,5\n",
                ["line 42, row 41, column U: '1.234' is not a number", "--format decimal=."],
            ),
            (b"U,y\n1,2\n\x81,3\n", ["--format encoding=NAME"]),
            ("U y\n1 0.5 2\n2 0.7 3\n", ["line 1: the header does not fit the 3 columns", "by number, 1 to 3"]),
        ],
    )
    def test_what_is_wrong_is_named(self, tmp_path, text, words):
        self.refused(tmp_path, text, *words)

    def test_one_column_of_decimal_commas(self, tmp_path):
        columns = read_columns(write(tmp_path, "target\n0,5\n1,25\n"), ("target",))
        np.testing.assert_array_equal(columns.values["target"], [0.5, 1.25])
        assert columns.assumptions == "one column, decimal comma"

    @cases("head", ["Kraft, N", "Kraft,N", "a,b", "x, y, z", "1 May, by me", ""])
    def test_one_column_of_decimal_commas_below_a_comma(self, tmp_path, head):
        text = f"{head}\n1,05\n2\n3,15\n"
        self.refused(tmp_path, text, "a comma may stand between columns or be the decimal sign", names=("1",))
        columns = read_columns(write(tmp_path, text), ("1",), options=ReadingOptions(decimal="comma"))
        np.testing.assert_array_equal(columns.values["1"], [1.05, 2.0, 3.15])

    @cases("head", ["time,force", "t,counts", "U (V),y (mm)", "t,y\ns,mm"])
    def test_whole_numbers_below_two_names_are_two_columns(self, tmp_path, head):
        columns = read_columns(write(tmp_path, f"{head}\n1,5\n2,10\n0,15\n"), ("1", "2"))
        np.testing.assert_array_equal(columns.values["2"], [5.0, 10.0, 15.0])

    @cases("head", ["x, y, z", "time,force,position", "Weg, mm; Kraft, N", "made on 3 May, by me", ""])
    @cases("delimiter", [";", "\t", "|", "  "])
    def test_commas_of_a_head_delimit_no_decimal_commas(self, tmp_path, head, delimiter):
        rows = [(0.5, 1.05), (2.5, 2.15), (1.5, 3.25)]
        body = "".join(delimiter.join(map(str, row)).replace(".", ",") + "\n" for row in rows)
        columns = read_columns(write(tmp_path, f"{head}\n{body}"), ("1", "2"))
        np.testing.assert_array_equal(np.transpose([*columns.values.values()]), rows)

    def test_a_decimal_comma_after_whole_numbers(self, tmp_path):
        text = "U;y\n" + "1;2\n" * 2000 + "1,5;2\n"
        self.refused(tmp_path, text, "line 2002, row 2001, column U: '1,5' is not a number", "--format decimal=,")
        columns = read_columns(write(tmp_path, text), ("U",), options=ReadingOptions(decimal=","))
        assert columns.values["U"][-1] == 1.5

    @cases(
        ("options", "words"),
        [
            ({"delimiter": "some"}, "--format delimiter=some: expected a character"),
            ({"delimiter": "5"}, "--format delimiter=5"),
            ({"decimal": ";"}, "--format decimal=;: expected point or comma"),
            ({"encoding": "klingon"}, "--format encoding=klingon is unknown"),
            ({"skip_lines": -1}, "--format skip=-1"),
            ({"table": "0"}, "--format table=0"),
            ({"interval": "0.1"}, "--format interval=0.1: expected a time > 0 with its unit"),
            ({"time_unit": "weeks"}, "--format time-unit=weeks: expected d, h, min"),
            ({"table": "run"}, "--format table=run: the tables of a text file have numbers"),
        ],
    )
    def test_options_that_are_wrong(self, tmp_path, options, words):
        self.refused(tmp_path, table(), words, error=ConfigurationError, **options)

    def test_options_that_do_not_apply(self, tmp_path):
        with pytest.raises(ConfigurationError, match=r"--format decimal does not apply: .* is a run"):
            read_columns(tmp_path, ("U",), options=ReadingOptions(decimal=","))


BREAKS = {
    "title": (table(), "\nsecond sweep\n\n" + table(heads=("t", "U", "y"))),
    "other columns": (table(), "U,y\n" + body(columns=(U, Y))),
    "comment": ("# one\n" + table(" "), "\n# two\n# t U y\n" + body(" ")),
    "two blank lines": (body(" "), "\n\n" + body(" ")),
}


class TestSeveralTables:
    @cases("name", BREAKS)
    def test_a_table_is_chosen(self, tmp_path, name):
        first, second = BREAKS[name]
        path = write(tmp_path, first + second)
        names = ("2", "3") if name == "two blank lines" else ("U", "y")
        with pytest.raises(
            DataError, match=r"has 2 tables, .* 1 from line .*; choose one with --format table=N, 1 to 2"
        ):
            read_columns(path, names)
        for number_ in ("1", "2"):
            columns = read_columns(path, names, options=ReadingOptions(table=number_))
            check(columns, names)
            assert f"table {number_}" in columns.assumptions
        with pytest.raises(DataError, match="--format table=3: it has 2 tables"):
            read_columns(path, names, options=ReadingOptions(table="3"))

    def test_a_table_behind_the_lines_that_are_looked_at(self, tmp_path):
        path = write(tmp_path, "a b\n" + "1.5 2.5\n" * 3000 + "\n" + table())
        check(read_columns(path, ("U", "y"), options=ReadingOptions(table="2")), ("U", "y"))


class TestHeads:
    @cases(
        ("head", "name", "unit"),
        [
            ("force (N)", "force", "N"),
            ("Ch1,V", "Ch1", "V"),
            ("x,y", "x,y", ""),
            ("strain / µε", "strain", "µstrain"),
            ("a [b] [c]", "a [b]", "c"),
            ("[N]", "[N]", ""),
            ("force []", "force", ""),
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
            (("time_s", "displacement_um", "remark"), ["s", "", ""]),
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


NUMBERS = st.floats(-9.8e37, 9.8e37)
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


MODEL = ("--model", "polynomial", "-o", "degree=3")


class TestCommands:
    """Identify from a file of decimal commas, and apply the model to the same values in other layouts."""

    COLUMNS = ("--input", "U", "--output", "y")
    CONTENT = table(";", ",", WITH_UNITS)

    @pytest.fixture
    def model(self, bench, tmp_path):
        path = tmp_path / "model.json"
        file = write(tmp_path, self.CONTENT)
        code, out, err = bench("identify", file, *self.COLUMNS, *MODEL, "--out", path)
        assert code == 0, err
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
            "--format", "delimiter=;,decimal=comma,encoding=utf-16,skip=1", "--format", "table=2",
        )  # fmt: skip
        arguments = {
            "identify": ("identify", file, "--input", "1", "--output", "2", *MODEL),
            "predict": ("predict", model, file, "--input", "1", "--output", "2", "--out", tmp_path / "p.csv"),
            "invert": ("invert", model, file, "--column", "2", "--out", tmp_path / "i.csv"),
            "compare": ("model", "test", model, "--data", file, "--input", "1", "--output", "2"),
        }[command]
        code, out, err = bench(*arguments, *options)
        assert code == 0, err
        assert "read other.dat: UTF-16, table 2, semicolon-separated, decimal comma\n" in out
        code, _, err = bench(*arguments, *options[:-2])
        assert code == 3
        assert "has 2 tables" in err
        assert "--format table=N" in err

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
            "compare": ("model", "test", model, "--data", absent),
        }[command]
        if command == "predict" and option != "--out":
            arguments += ("--out", tmp_path / "p.csv")
        found, out, err = bench(*arguments, option, tmp_path / name)
        assert (found, out) == (exit_code, "")
        assert f"error: {option} " in err
        assert "absent.csv" not in err

    def test_wrong_options_are_one_message(self, bench, tmp_path):
        file = write(tmp_path, self.CONTENT)
        code, _, err = bench("identify", file, *self.COLUMNS, *MODEL, "--format", "decimal=dot")
        assert (code, err) == (2, "error: --format decimal=dot: expected point or comma\n")

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

    @pytest.mark.parametrize("command", ["identify", "runs import"])
    @pytest.mark.parametrize("end", [{}, {301: 'again"'}, {301: 'again" and off'}], ids=["open", "closed", "stray"])
    def test_a_quote_that_is_not_closed_in_its_line_is_refused(self, bench, tmp_path, command, end):
        path = self.write(tmp_path / "a.csv", {201: '"5 N hung on', **end})
        columns = ["--input", "u", "--output", "y"]
        options = (
            ["--model", "polynomial", "-o", "degree=1"]
            if command == "identify"
            else ["--time", "t", "--out", tmp_path / "runs"]
        )
        code, _, err = bench(*command.split(), path, *columns, *options)
        assert code == 3
        assert "a.csv: line 201: a quotation mark opens a cell" in err

    @cases("remark", ['"5 N, hung on"', '5" disc', '"a ""b"" c"', "a\x0bb\x0cc\x1cd", "a\u2028b\x85c", ""])
    def test_what_stays_in_its_cell_costs_no_row(self, tmp_path, remark):
        path = self.write(tmp_path / "a.csv", {201: remark})
        read = read_columns(path, ["t", "u", "y"])
        assert [len(column) for column in read.values.values()] == [self.ROWS] * 3

    @cases("remark", ["a\0b", "fine\n1.0"])
    def test_what_breaks_a_table_is_refused(self, tmp_path, remark):
        path = self.write(tmp_path / "a.csv", {201: remark})
        with pytest.raises(DataError, match=r"a\.csv"):
            read_columns(path, ["t", "u", "y"])

    @cases(
        ("remark", "rows", "said"),
        [("a\rb", 0, "1 line beside them"), ("fine\n\n\n1,2,3,fine", 1, "joined in order")],
    )
    def test_rows_behind_a_break_are_joined(self, tmp_path, remark, rows, said):
        read = read_columns(self.write(tmp_path / "a.csv", {201: remark}), ["t", "u", "y"])
        assert [len(column) for column in read.values.values()] == [self.ROWS + rows] * 3
        assert said in read.assumptions

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


_MARKS = "\u200f\u202e\u2066\u200b\xad([{<)]}>*?~^='’_/+-$€½٣１dex \xa0\t.,;#|%"


@settings(max_examples=400, deadline=None)
@given(st.data())
def test_a_cell_with_a_character_that_is_no_part_of_a_number_is_refused(tmp_path_factory, data):
    delimiter, decimal = data.draw(st.sampled_from([(";", ","), (";", "."), ("\t", "."), ("\t", ","), (",", ".")]))
    has_heads = data.draw(st.booleans())
    rows = [[f"{0.5 * i + 0.25 * j}".replace(".", decimal) for j in range(3)] for i in range(12)]
    row, place = data.draw(st.integers(0, 11)), data.draw(st.integers(0, 2))
    marks = st.text([mark for mark in _MARKS if mark != delimiter], max_size=3)
    before, after = data.draw(marks), data.draw(marks)
    wrong = before + rows[row][place] + after
    strict = re.fullmatch(rf"[+-]?(\d+({decimal}\d*)?|{decimal}\d+)(e[+-]?\d+)?".replace(".", r"\."), wrong.strip())
    assume(strict is None and not wrong.lstrip().startswith(("#", "%", "//", ";")))
    rows[row][place] = wrong
    lines = [["a", "b", "c"]] * has_heads + rows
    path = write(tmp_path_factory.mktemp("cells"), "".join(delimiter.join(line) + "\n" for line in lines))
    try:
        found = read_columns(path, ("1", "2", "3"))
    except DataError:
        return
    # What is left out, or taken for heads, is said.
    assert all(len(column) == 11 for column in found.values.values()), (wrong, found)
    assert re.search(r"1 line|heads from line 1", found.assumptions), (wrong, found)
