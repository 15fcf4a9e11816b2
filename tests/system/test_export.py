"""A run for other programs: each column has its type, and times of day have one base."""

import csv
import json
import shutil
import sqlite3
import tracemalloc
from contextlib import closing
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from written_run import META, SIGNALS, write_run

from bench.analysis import export_run, write_csv
from bench.analysis.export.bluesky_documents import documents
from bench.analysis.report.recorded_run import summarize
from bench.devices import Settled
from bench.record import FILE_NAME, Event, Journal, Record, StepRecord, recover

EPOCH = datetime(2000, 1, 1, tzinfo=UTC)
STEPS = 20


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("runs") / "run", steps=STEPS)


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("runs") / "run", steps=STEPS, finished=False)


class TestParquet:
    @pytest.fixture
    def tables(self, run, tmp_path, bench):
        import pyarrow.parquet as pq

        code, _, _ = bench("runs", "export", run, "--format", "parquet", "--out", tmp_path)
        assert code == 0
        return {name: pq.read_table(tmp_path / f"{name}.parquet") for name in ("readings", "telemetry", "events")}

    def test_columns_have_their_types(self, tables):
        types = {field.name: str(field.type) for field in tables["readings"].schema}
        assert types == {
            "step": "int64", "started [s]": "double", "finished [s]": "double", "time": "timestamp[us, tz=UTC]",
            "phase": "string", "label": "string", "settled": "bool", "settling": "string",
            "commanded plate [°C]": "double", "plate_setpoint [°C]": "double", "plate [°C]": "double",
            "tip [m]": "double", "lateness [s]": "double",
        }  # fmt: skip
        telemetry = {field.name: str(field.type) for field in tables["telemetry"].schema}
        assert (telemetry["step"], telemetry["phase"], telemetry["t [s]"]) == ("int64", "string", "double")

    def test_the_schema_has_units_and_metadata(self, tables):
        field = tables["telemetry"].schema.field("tip [m]")
        assert field.metadata == {b"name": b"tip", b"unit": b"m", b"description": b"position"}
        metadata = json.loads(tables["readings"].schema.metadata[b"bench"])
        assert metadata["parameters"] == META["parameters"]
        assert metadata["status"] == "completed"
        assert [signal["unit"] for signal in metadata["signals"]] == ["°C", "°C", "m", "s"]

    def test_values_are_those_of_the_record(self, tables, run):
        readings = tables["readings"].to_pydict()
        with Record(run) as record:
            steps = record.steps()
        assert readings["step"] == list(range(STEPS))
        assert readings["tip [m]"] == steps["tip"].tolist()
        assert readings["settled"] == [True] * STEPS
        assert readings["phase"] == ["loops"] * STEPS
        assert readings["commanded plate [°C]"] == steps["plate_setpoint"].tolist()
        assert readings["time"][3] == EPOCH + timedelta(seconds=32.0)
        assert tables["telemetry"].to_pydict()["phase"] == ["loops"] * STEPS
        assert [kind for kind in tables["events"].to_pydict()["kind"] if kind == "interlock"] == ["interlock"]


def test_csv_says_what_numbers_and_words_are(run, tmp_path, bench):
    code, out, _ = bench("runs", "export", run, "--format", "csv", "--out", tmp_path)
    assert code == 0
    assert [line.rpartition("/")[2] for line in out.split()] == [
        "readings.csv", "telemetry.csv", "events.csv", "metadata.json",
    ]  # fmt: skip
    with (tmp_path / "readings.csv").open(encoding="utf-8") as file:
        row = next(csv.DictReader(file))
    assert (row["step"], row["settled"], row["settling"]) == ("0", "true", "dwell")
    assert row["time"] == "2000-01-01T00:00:08.000000Z"
    assert json.loads((tmp_path / "metadata.json").read_text())["seed"] == 3


@pytest.fixture(scope="module")
def found(run):
    with Record(run) as record:
        return list(documents(record))


class TestDocuments:
    def test_event_model_takes_them(self, found):
        event_model = pytest.importorskip("event_model")
        for name, document in found:
            event_model.schema_validators[event_model.DocumentNames[name]].validate(document)
        counts = {"start": 1, "descriptor": 3, "event": 2 * STEPS + 3, "stop": 1}
        assert {name: [each for each, _ in found].count(name) for name in counts} == counts

    def test_times_have_one_base(self, found):
        start, end = (document["time"] for name, document in found if name in ("start", "stop"))
        assert start == EPOCH.timestamp()
        assert end == start + 8.0 * STEPS
        assert all(start <= document["time"] <= end for _, document in found)

    def test_kinds_of_values_are_kept(self, found):
        keys = next(document for name, document in found if name == "descriptor")["data_keys"]
        assert {name: keys[name]["dtype"] for name in ("step", "settled", "phase", "tip")} == {
            "step": "integer", "settled": "boolean", "phase": "string", "tip": "number",
        }  # fmt: skip
        assert keys["tip"]["units"] == "m"
        data = next(document for name, document in found if name == "event")["data"]
        assert data["settled"] is True
        assert isinstance(data["step"], int)

    def test_they_are_lines_that_databroker_reads(self, run, found, tmp_path, bench):
        code, _, _ = bench("runs", "export", run, "--format", "bluesky", "--out", tmp_path)
        assert code == 0
        lines = (tmp_path / "documents.jsonl").read_text(encoding="utf-8").splitlines()
        assert [tuple(json.loads(line)) for line in lines] == found

    def test_an_unfinished_run_has_no_stop(self, unfinished):
        with Record(unfinished) as record:
            names = [name for name, _ in documents(record)]
        assert names[0] == "start"
        assert "stop" not in names


def test_an_unfinished_run_is_exported_as_far_as_it_is(unfinished, tmp_path, bench):
    code, _, _ = bench("runs", "export", unfinished, "--format", "csv", "--out", tmp_path)
    assert code == 0
    assert json.loads((tmp_path / "metadata.json").read_text())["status"] == "unfinished"


class TestFormulas:
    FORMULA = '=HYPERLINK("http://example.com","x")'

    @pytest.fixture
    def noted(self, tmp_path):
        folder = tmp_path / "run"
        folder.mkdir()
        journal = Journal(folder / FILE_NAME, SIGNALS, {**META, "overrides": {}})
        for text in (self.FORMULA, "+1+cmd|' /C calc'!A0", "-2+3", "@SUM(A1)", "\t=1", "-5.0", "plain"):
            journal.event(Event(0.0, "INFO", "note", text))
        values = (-1.0, -2.0, -3e-6, 0.0)
        journal.step(StepRecord(0, 0.0, 1.0, "=phase", "-5", Settled.DWELL, {"plate": -1.0}, values))
        journal.close()
        return folder

    def rows(self, folder, name):
        with (folder / f"{name}.csv").open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))

    def test_are_texts_for_a_spreadsheet(self, noted, tmp_path, bench):
        assert bench("runs", "export", noted, "--format", "csv", "--out", tmp_path)[0] == 0
        texts = [row["text"] for row in self.rows(tmp_path, "events")]
        assert texts[0] == f"'{self.FORMULA}"
        assert [text[0] for text in texts] == ["'"] * 5 + ["-", "p"]
        (reading,) = self.rows(tmp_path, "readings")
        # Numbers are none, nor texts that are numbers.
        assert (reading["phase"], reading["label"], reading["plate [°C]"]) == ("'=phase", "-5", "-2.0")

    def test_are_as_they_were_recorded_where_that_is_asked_for(self, noted, tmp_path, bench):
        assert bench("runs", "export", noted, "--format", "csv", "--formulas", "--out", tmp_path)[0] == 0
        assert self.rows(tmp_path, "events")[0]["text"] == self.FORMULA

    def test_of_a_name_in_a_head_is_one_too(self, tmp_path):
        write_csv(tmp_path / "a.csv", [("=1+1", [1.0]), ("b", [-2.0])])
        assert (tmp_path / "a.csv").read_text().splitlines() == ["'=1+1,b", "1.0,-2.0"]


@pytest.fixture(scope="module")
def long_runs(tmp_path_factory):
    """Two runs of several blocks of rows, one with twice as many ticks as the other."""
    folders = []
    for count in (20_000, 40_000):
        folder = tmp_path_factory.mktemp(f"long-{count}")
        journal = Journal(folder / FILE_NAME, SIGNALS, {**META, "overrides": {}}, flushed=False)
        for i in range(count):
            journal.telemetry(0.01 * i, 0, (50.0, 50.0 + (i == count // 3), 1e-6 * (i % 100), 0.0))
        values = (50.0, 50.0, 1e-6, 0.0)
        journal.step(StepRecord(0, 0.0, 0.01 * count, "loops", "", Settled.DWELL, {"plate": 50.0}, values))
        journal.finish(status="completed", reason="", finished=0.01 * count, safe_state={"plate": "safe"})
        journal.close()
        folders.append(folder)
    return folders


def peak(work):
    """Return the peak of the memory of Python and numpy that work takes, bytes."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


class TestLongRuns:
    @pytest.mark.slow
    @pytest.mark.parametrize("kind", ["csv", "parquet"])
    def test_an_export_takes_no_more_memory_for_more_rows(self, run, long_runs, tmp_path, kind):
        export_run(run, kind, tmp_path / "first")
        short, long = (peak(lambda each=each: export_run(each, kind, tmp_path / each.name)) for each in long_runs)
        assert long - short < 10 * 20_000

    def test_a_summary_of_the_telemetry_has_its_extremes_and_no_more_rows(self, long_runs):
        for run, count in zip(long_runs, (20_000, 40_000), strict=True):
            with Record(run) as record:
                summary = summarize(record, [("plate", "plate_setpoint")])
                whole = record.telemetry()
            assert summary.count == count
            assert len(summary.shown) <= 20_000
            assert bool(summary.remark) == (count > 20_000)
            for name in ("plate", "tip", "lateness"):
                assert summary.extremes[name] == (whole[name].min(), whole[name].max())
                assert (summary.shown[name].min(), summary.shown[name].max()) == summary.extremes[name]
            assert summary.differences["plate", "plate_setpoint"] == (0.0, 1.0)
            assert (summary.shown["t"][0], summary.shown["t"][-1]) == (whole["t"][0], whole["t"][-1])
            assert (np.diff(summary.shown["t"]) > 0.0).all()

    @pytest.mark.slow
    def test_a_summary_takes_no_more_memory_for_more_rows(self, long_runs):
        def read(run):
            with Record(run) as record:
                summarize(record)

        short, long = (peak(lambda run=run: read(run)) for run in long_runs)
        # The rows of the whole table take more than 100 bytes each.
        assert long - short < 20 * 20_000

    @pytest.mark.slow
    def test_a_page_says_that_a_figure_has_not_every_tick(self, long_runs, tmp_path, bench):
        for run, is_whole in zip(long_runs, (True, False), strict=True):
            assert bench("report", run, "--out", tmp_path / run.name)[0] == 0
            page = (tmp_path / run.name / "report.html").read_text(encoding="utf-8")
            assert ("ticks" in page and "are drawn" in page) is not is_whole

    @pytest.mark.slow
    def test_recovery_takes_no_more_memory_for_more_rows(self, long_runs, tmp_path):
        short, long = (peak(lambda run=run: recover(damaged(run, tmp_path / run.name))) for run in long_runs)
        assert long - short < 10 * 20_000


def damaged(run, folder):
    """Return a copy of a run that lacks a row."""
    copy = shutil.copytree(run, folder)
    with closing(sqlite3.connect(copy / FILE_NAME)) as db, db:
        db.execute("DELETE FROM telemetry WHERE tick = 1000")
    return copy


def test_a_damaged_record_leaves_the_files_that_are_there(run, tmp_path, bench):
    out = tmp_path / "out"
    assert bench("runs", "export", run, "--format", "csv", "--out", out)[0] == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    copy = shutil.copytree(run, tmp_path / "run")
    with closing(sqlite3.connect(copy / FILE_NAME)) as db, db:
        db.execute("UPDATE telemetry SET t = 5 WHERE tick = 15")
    for kind in ("csv", "parquet", "bluesky"):
        assert bench("runs", "export", copy, "--format", kind, "--out", out)[0] == 3
    left = {path.name: path.read_bytes() for path in out.iterdir()}
    assert {name: left[name] for name in before if name != "readings.csv"} == {
        name: content for name, content in before.items() if name != "readings.csv"
    }
    assert not [name for name in left if name.endswith(".part")]
