import os
import struct
import sys

import numpy as np
import pytest
from cases import cases
from hypothesis import example, given, settings, strategies as st

from bench.analysis import ReadingOptions, read_columns, write_csv
from bench.analysis.tables.data import Quantity, check_variation
from bench.base import ConfigurationError, DataError
from bench.devices import Settled, Signal
from bench.record import FILE_NAME, Journal, StepRecord

# What reads the files of libraries is a process of its own.
pytestmark = pytest.mark.usefixtures("warm_popen")


@pytest.fixture
def table(tmp_path):
    def write(text, encoding="utf-8"):
        path = tmp_path / "data.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode(encoding))
        return path

    return write


def wrong(path, *expected, names=("force", "length"), **keys):
    with pytest.raises(DataError) as caught:
        read_columns(path, names, **keys)
    for part in (path.name, *expected):
        assert part in str(caught.value), str(caught.value)
    assert caught.value.exit_code == 3


class TestRight:
    def test_columns_that_are_not_asked_for_may_hold_anything(self, table):
        path = table("force,remark\n1,good\n2,\n3,nan\n")
        np.testing.assert_array_equal(read_columns(path, ["force"]).values["force"], [1.0, 2.0, 3.0])

    def test_the_exact_header_wins(self, table):
        path = table("force,force [kN]\n1,2\n")
        assert read_columns(path, ["force"]).values["force"][0] == 1.0
        assert read_columns(path, ["force [kN]"]).units == {"force [kN]": "kN"}

    @settings(deadline=None)
    @given(rows=st.lists(st.tuples(st.floats(-9.8e37, 9.8e37), st.floats(-1, 1)), min_size=1))
    def test_what_is_written_is_read_to_the_last_digit(self, tmp_path_factory, rows):
        path = tmp_path_factory.getbasetemp() / "written.csv"
        array = np.array(rows)
        write_csv(path, [("a, b [m]", array[:, 0]), ("c", array[:, 1])])
        columns = read_columns(path, ["a, b", "c"])
        np.testing.assert_array_equal(columns.values["a, b"], array[:, 0])
        np.testing.assert_array_equal(columns.values["c"], array[:, 1])

    def test_writing_where_it_cannot(self, tmp_path):
        with pytest.raises(DataError, match="cannot be written"):
            write_csv(tmp_path / "absent" / "a.csv", [("a", [1.0])])


class TestTrouble:
    def test_no_file(self, tmp_path):
        wrong(tmp_path / "absent.csv", "does not exist")

    @pytest.mark.skipif(sys.platform == "win32", reason="Windows has no named pipes among files")
    def test_a_pipe_gives_its_rows_only_once(self, tmp_path):
        os.mkfifo(tmp_path / "pipe.csv")
        wrong(tmp_path / "pipe.csv", "is a pipe or a device")

    @cases("text", ["", "\n", " , ,\n", "\ufeff"])
    def test_empty(self, table, text):
        wrong(table(text), "is empty; expected a header line")

    @cases("text", ["force,length\n", "force,length\n\n\n"])
    def test_header_only(self, table, text):
        wrong(table(text), "has 0 rows of data; at least 1 are needed")

    def test_too_few_rows(self, table):
        path = table("force,length\n" + "1,2\n" * 9)
        wrong(path, "has 9 rows of data; at least 10 are needed", at_least=10)
        assert len(read_columns(path, ["force"], at_least=9).values["force"]) == 9

    def test_a_missing_column_lists_those_that_are_there(self, table):
        wrong(table("Force [N],length\n1,2\n"), "has no column 'force'; did you mean Force [N]?")

    def test_no_header_says_how_columns_are_named(self, table):
        wrong(table(" , ,\n1,2.5,3\n"), "has no header line; name columns by number, 1 to 3")

    @cases(
        ("cell", "expected"),
        [
            ("  ", "is empty"),
            ("abc", "'abc' is not a number"),
            ("1;5", "'1;5' is not a number"),
            ('"1,5"', "'1,5' is not a number"),
            ("12 N", "'12 N' is not a number"),
            ("1_000", "'1_000' is not a number"),
            ("0x10", "'0x10' is not a number"),
            ("NaN", "NaN is not a finite number"),
            ("#DIV/0!", "'#DIV/0!' is not a number"),
        ],
    )
    def test_a_cell(self, table, cell, expected):
        wrong(table(f"force,length\n1,2\n3,4\n5,{cell}\n7,8\n"), "row 3, column length", expected)

    @cases(
        "content",
        [
            b"\xff\xfef\x00o\x00r\x00c\x00e\x00",
            b"force,length\n1,\xb5\n",
            b"force,length\n1,\x00\n",
            b'force,length\n1,"2\n3,4\n',
            b"force,length\n" + b"1" * 200_000 + b",2\n",
        ],
    )
    def test_what_is_no_csv(self, table, content):
        wrong(table(content))

    def test_a_folder_that_is_no_run(self, tmp_path):
        wrong(tmp_path, "is not a run")

    @settings(deadline=None, max_examples=200)
    @given(st.binary(max_size=60), st.booleans())
    @example(b'"', True)
    def test_any_bytes_are_read_or_are_a_data_error(self, tmp_path_factory, content, header):
        path = tmp_path_factory.getbasetemp() / "any.csv"
        path.write_bytes(b"a,b\n" * header + content)
        try:
            columns = read_columns(path, ["a", "b"])
        except DataError as error:
            assert "any.csv" in str(error)  # noqa: PT017 - either way is right
        else:
            assert all(np.isfinite(values).all() for values in columns.values.values())


class TestRuns:
    @pytest.fixture
    def run(self, tmp_path):
        def write(*rows):
            signals = (Signal("tec_temperature", "°C", "t"), Signal("curvature", "1/m", "c"))
            journal = Journal(tmp_path / FILE_NAME, signals, {})
            for step, row in enumerate(rows):
                for tick in range(5):
                    journal.telemetry(step * 8.0 + tick, step, (row[0] + tick, row[1]))
                journal.step(StepRecord(step, step * 8.0, step * 8.0 + 8.0, "", "", Settled.DWELL, {}, row))
            journal.close()
            return tmp_path

        return write

    def test_columns_and_units(self, run):
        path = run((21.0, 0.0), (22.0, -3.0))
        for source in (path, path / FILE_NAME):
            columns = read_columns(source, ["tec_temperature", "curvature", "finished", "step"])
            np.testing.assert_array_equal(columns.values["curvature"], [0.0, -3.0])
            np.testing.assert_array_equal(columns.values["finished"], [8.0, 16.0])
            assert columns.units == {"tec_temperature": "°C", "curvature": "1/m", "finished": "s", "step": ""}

    def test_a_missing_column(self, run):
        path = run((21.0, 0.0))
        with pytest.raises(
            DataError, match="has no column 'force'; there are: step, started, finished, tec_temperature"
        ):
            read_columns(path, ["force"])

    def test_what_was_read_within_the_steps(self, run):
        path, names = run((21.0, 0.0), (22.0, -3.0)), ["tec_temperature", "t"]
        with pytest.raises(DataError, match=r"has 2 rows of data; .* --format table=telemetry takes the 10 readings"):
            read_columns(path, names[:1], at_least=4)
        with pytest.raises(
            ConfigurationError, match=r"--format table=ticks: .* is a run; expected steps or telemetry"
        ):
            read_columns(path, names, options=ReadingOptions(table="ticks"))
        columns = read_columns(path, names, at_least=4, options=ReadingOptions(table="telemetry"))
        assert columns.values["tec_temperature"].tolist() == [
            21.0,
            22.0,
            23.0,
            24.0,
            25.0,
            22.0,
            23.0,
            24.0,
            25.0,
            26.0,
        ]
        assert columns.values["t"].tolist() == [*range(5), *range(8, 13)]
        assert columns.units == {"tec_temperature": "°C", "t": "s"}

    def test_a_gap(self, run):
        path = run((21.0, 0.0), (22.0, float("nan")), (23.0, float("nan")))
        with pytest.raises(DataError, match="step 1, column curvature: there is no value"):
            read_columns(path, ["tec_temperature", "curvature"])

    def test_too_few_steps(self, run):
        with pytest.raises(DataError, match="has 0 rows of data"):
            read_columns(run(), ["curvature"])
        with pytest.raises(DataError, match="is not a run"):
            read_columns(run.__closure__[0].cell_contents / "absent.sqlite", ["curvature"])


def test_a_constant_column_is_refused():
    with pytest.raises(DataError, match=r"data\.csv: column force is 3 in all 20 rows, so nothing can be identified"):
        check_variation("data.csv", Quantity("force", "N", np.full(20, 3.0)))
    with pytest.raises(DataError, match="column force varies by 1e-300 only"):
        check_variation("data.csv", Quantity("force", "N", np.array([*np.zeros(19), 1e-300])))


def test_a_damaged_page_of_a_parquet_file_is_refused(tmp_path):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "m.parquet"
    values = [float(i) for i in range(100)]
    pq.write_table(pa.table({"u": values}), path, write_page_checksum=True, compression="none", use_dictionary=False)
    assert read_columns(path, ["u"]).values["u"].tolist() == values
    content = bytearray(path.read_bytes())
    content[content.index(struct.pack("<d", 50.0)) + 6] ^= 1
    path.write_bytes(content)
    with pytest.raises(DataError, match="cannot be read"):
        read_columns(path, ["u"])


@cases(
    ("name", "unit", "header"),
    [
        ("force", "N", "force [N]"),
        ("force [N]", "N", "force [N]"),
        ("force (N)", "N", "force [N]"),
        ("T / degC", "°C", "T [°C]"),
        ("force (upper)", "N", "force (upper) [N]"),
        ("force [N]", "kg", "force [N] [kg]"),
        ("force (N)", "", "force (N)"),
    ],
)
def test_a_unit_stands_in_a_head_once(name, unit, header):
    assert Quantity(name, unit, np.zeros(2)).header == header
