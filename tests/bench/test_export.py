"""A run for other programs: each column has its type, and times of day have one base."""

import csv
import json
import shutil
from datetime import UTC, datetime, timedelta

import pytest
from written_run import META, write_run

from bench.journal import FILE_NAME, Record
from bench.results.bluesky_documents import documents

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

        code, _, _ = bench("export", run, "--format", "parquet", "--out", tmp_path)
        assert code == 0
        return {name: pq.read_table(tmp_path / f"{name}.parquet") for name in ("readings", "telemetry", "events")}

    def test_columns_have_their_types(self, tables):
        types = {field.name: str(field.type) for field in tables["readings"].schema}
        assert types == {
            "step": "int64",
            "started [s]": "double",
            "finished [s]": "double",
            "time": "timestamp[us, tz=UTC]",
            "phase": "string",
            "label": "string",
            "settled": "bool",
            "settling": "string",
            "commanded plate [°C]": "double",
            "plate_setpoint [°C]": "double",
            "plate [°C]": "double",
            "tip [m]": "double",
            "lateness [s]": "double",
        }
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
    code, out, _ = bench("export", run, "--format", "csv", "--out", tmp_path)
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

    def test_a_router_fills_a_catalogue_with_them(self, found):
        event_model = pytest.importorskip("event_model")
        rows = {}

        class Router(event_model.DocumentRouter):
            def descriptor(self, document):
                self.streams = {**getattr(self, "streams", {}), document["uid"]: document}

            def event(self, document):
                descriptor = self.streams[document["descriptor"]]
                assert document["data"].keys() == descriptor["data_keys"].keys()
                rows.setdefault(descriptor["name"], []).append(document)

        router = Router()
        for name, document in found:
            router(name, document)
        assert {name: len(entries) for name, entries in rows.items()} == {
            "primary": STEPS, "telemetry": STEPS, "events": 3,
        }  # fmt: skip
        assert [entry["seq_num"] for entry in rows["primary"]] == list(range(1, STEPS + 1))

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
        code, _, _ = bench("export", run, "--format", "bluesky", "--out", tmp_path)
        assert code == 0
        lines = (tmp_path / "documents.jsonl").read_text(encoding="utf-8").splitlines()
        assert [tuple(json.loads(line)) for line in lines] == found

    def test_an_unfinished_run_has_no_stop(self, unfinished):
        with Record(unfinished) as record:
            names = [name for name, _ in documents(record)]
        assert names[0] == "start"
        assert "stop" not in names


def test_an_unfinished_run_is_exported_as_far_as_it_is(unfinished, tmp_path, bench):
    code, _, _ = bench("export", unfinished, "--format", "csv", "--out", tmp_path)
    assert code == 0
    assert json.loads((tmp_path / "metadata.json").read_text())["status"] == "unfinished"

    def test_each_line_is_strict_json_where_a_number_is_missing(self, run, tmp_path, bench, edit_journal):
        copy = tmp_path / "run"
        shutil.copytree(run, copy)
        edit_journal(copy / FILE_NAME, "UPDATE steps SET tip = NULL WHERE step = 0")
        edit_journal(copy / FILE_NAME, "UPDATE steps SET tip = 1e999 WHERE step = 1")
        assert bench("export", copy, "--format", "bluesky", "--out", tmp_path)[0] == 0

        def refuse(constant):
            raise ValueError(constant)

        lines = (tmp_path / "documents.jsonl").read_text(encoding="utf-8").splitlines()
        found = [json.loads(line, parse_constant=refuse) for line in lines]
        rows = [document["data"] for name, document in found if name == "event" and "plate" in document["data"]]
        assert ["tip" in row for row in rows[:3]] == [False, False, True]
