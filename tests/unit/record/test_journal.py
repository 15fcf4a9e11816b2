import hashlib
import json
import math
import sqlite3
from contextlib import suppress

import numpy as np
import pytest
from cases import cases
from hypothesis import given, settings, strategies as st

from bench.base import ConfigurationError, DataError, Stopwatch
from bench.devices import Settled, Signal
from bench.record import FILE_NAME, SCHEMA, Event, Journal, Record, StepRecord, add_model

SIGNALS = (Signal("tec_temperature", "°C", "object temperature"), Signal("force", "N", "force", 4))


def record(step, *values, setpoints=None, label="", phase="rise"):
    return StepRecord(
        step, float(step), step + 0.5, phase, label, Settled.DWELL, setpoints or {"tec": 20.0 + step}, values
    )


def write(path, steps=3, signals=SIGNALS, meta=None, finish=True, ticks=2, flushed=True):
    journal = Journal(path, signals, meta or {"rig": "vo2"}, flushed=flushed)
    journal.event(Event(0.0, "INFO", "phase", "rise"))
    for step in range(steps):
        for tick in range(ticks):
            journal.telemetry(step + 0.1 * tick, step, [20.0 + step + 0.1 * tick] * len(signals))
        journal.step(record(step, *(20.0 + step for _ in signals)))
    if finish:
        journal.finish(status="completed", reason="", finished=float(steps), safe_state={"tec": "safe"})
    journal.close()


def change(path, *statements):
    db = sqlite3.connect(path)
    for statement in statements:
        db.execute(statement)
    db.commit()
    db.close()


def digest(folder):
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def intact(tmp_path_factory):
    path = tmp_path_factory.mktemp("intact") / FILE_NAME
    write(path, steps=40, ticks=5)
    return path.read_bytes()


class TestRoundTrip:
    def test_what_is_not_flushed_is_committed_all_the_same(self, tmp_path):
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {"rig": "vo2"}, flushed=False)
        for step in range(3):
            journal.step(record(step, 20.0, 1.0))
            # By another connection, as after the death of the process.
            with Record(tmp_path) as run:
                assert len(run.steps()) == step + 1
        journal.close()

    def test_everything_comes_back(self, tmp_path):
        meta = {"rig": "vo2", "parameters": {"low": 21.0, "note": "10 µm"}, "command": ["bench", "run"], "seed": 3}
        write(tmp_path / FILE_NAME, meta=meta)
        with Record(tmp_path) as run:
            assert run.meta["schema"] == SCHEMA
            assert {key: run.meta[key] for key in meta} == meta
            assert run.signals == SIGNALS
            assert run.status == "completed"
            assert run.meta["safe_state"] == {"tec": "safe"}
            assert run.meta["finished"] == 3.0
            steps = run.steps()
            assert len(steps) == 3
            np.testing.assert_array_equal(steps["step"], [0, 1, 2])
            np.testing.assert_array_equal(steps["finished"], [0.5, 1.5, 2.5])
            np.testing.assert_array_equal(steps["force"], [20.0, 21.0, 22.0])
            assert list(run.step_records()) == [record(step, 20.0 + step, 20.0 + step) for step in range(3)]
            ticks = run.telemetry()
            assert len(ticks) == 6
            np.testing.assert_array_equal(ticks["step"], [0, 0, 1, 1, 2, 2])
            assert run.events() == [Event(0.0, "INFO", "phase", "rise")]

    @cases("value", [math.nan, math.inf, -math.inf])
    def test_what_is_not_finite(self, tmp_path, value):
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {"odd": value})
        journal.telemetry(0.0, 0, (value, 1.0))
        journal.step(record(0, value, 1.0))
        journal.close()
        with Record(tmp_path) as run:
            np.testing.assert_array_equal(run.steps()["tec_temperature"], [value])
            np.testing.assert_array_equal(run.telemetry()["tec_temperature"], [value])
            np.testing.assert_array_equal(next(run.step_records()).values, (value, 1.0))
            np.testing.assert_array_equal(run.meta["odd"], value)

    def test_numbers_of_numpy_are_numbers(self, tmp_path):
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {})
        journal.telemetry(0.0, 0, (np.float32(1.5), np.int64(2)))
        journal.step(record(0, np.float32(1.5), np.int64(2), setpoints={"tec": np.int64(20), "hv": np.float32(0.5)}))
        journal.close()
        with Record(tmp_path) as run:
            (entry,) = run.step_records()
            assert entry.values == (1.5, 2.0)
            assert entry.setpoints == {"tec": 20.0, "hv": 0.5}
            assert run.telemetry()["force"][0] == 2.0

    def test_units(self, tmp_path):
        write(tmp_path / FILE_NAME)
        with Record(tmp_path) as run:
            assert run.unit("force") == "N"
            assert run.unit("started") == run.unit("finished") == run.unit("t") == "s"
            assert run.unit("step") == "1"

    def test_without_signals_and_without_steps(self, tmp_path):
        write(tmp_path / FILE_NAME, steps=0, signals=())
        with Record(tmp_path) as run:
            assert len(run.steps()) == len(run.telemetry()) == 0
            assert list(run.step_records()) == []

    @cases(
        "name", ['a"b', "a b", "5", "Größe °C", "select", "a'b", "a;DROP TABLE steps;--", "%s", "?", "[x]", "a.b", ""]
    )
    def test_signals_with_odd_names(self, tmp_path, name):
        write(tmp_path / FILE_NAME, signals=(Signal(name, "m", "odd"), SIGNALS[0]))
        with Record(tmp_path) as run:
            assert run.signals[0].name == name
            np.testing.assert_array_equal(run.steps()[name], [20.0, 21.0, 22.0])
            np.testing.assert_array_equal(run.telemetry()[name][:2], [20.0, 20.1])

    @cases("name", ["step", "t", "T", "Phase", "setpoints", "label", "tick", "finished"])
    def test_signals_named_like_its_own_columns_are_refused(self, tmp_path, name):
        with pytest.raises(ConfigurationError, match=name):
            Journal(tmp_path / FILE_NAME, (Signal(name, "m", "odd"),), {})
        assert not (tmp_path / FILE_NAME).exists()

    def test_signals_that_differ_only_in_case_are_refused(self, tmp_path):
        with pytest.raises(ConfigurationError, match="Force"):
            Journal(tmp_path / FILE_NAME, (*SIGNALS, Signal("Force", "N", "odd")), {})

    def test_texts_that_no_encoding_holds(self, tmp_path):
        # A file name of another encoding on the command line comes as such a text.
        meta = {"command": ["bench", "m\udce4rz.toml", "µ"]}
        write(tmp_path / FILE_NAME, meta=meta)
        with Record(tmp_path) as run:
            assert run.meta["command"] == meta["command"]

    @settings(max_examples=25, deadline=None)
    @given(data=st.data())
    def test_any_values(self, tmp_path_factory, data):
        folder = tmp_path_factory.mktemp("any")
        rows = data.draw(st.lists(st.tuples(st.floats(), st.floats()), max_size=5))
        text = data.draw(st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\x00")))
        journal = Journal(folder / FILE_NAME, SIGNALS, {"text": text})
        for step, row in enumerate(rows):
            journal.step(record(step, *row, label=text))
        journal.event(Event(0.0, "INFO", "note", text))
        journal.close()
        with Record(folder) as run:
            np.testing.assert_array_equal([entry.values for entry in run.step_records()], rows or [])
            assert all(entry.label == text for entry in run.step_records())
            assert run.meta["text"] == text
            assert run.events()[0].text == text


class TestDurability:
    def test_is_never_overwritten(self, tmp_path):
        path = tmp_path / FILE_NAME
        write(path)
        before = digest(tmp_path)
        with pytest.raises(ConfigurationError, match="never overwritten"):
            Journal(path, SIGNALS, {})
        assert digest(tmp_path) == before

    def test_settings_of_the_database(self, tmp_path):
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {})
        assert journal._keeper.store._db.execute("PRAGMA journal_mode").fetchone() == ("wal",)
        assert journal._keeper.store._db.execute("PRAGMA synchronous").fetchone() == (2,)
        journal.close()

    def test_can_be_read_while_it_is_written(self, tmp_path):
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {})
        with Record(tmp_path) as run:
            assert run.status == "unfinished"
            for step in range(5):
                journal.step(record(step, 1.0, 2.0))
                assert len(run.steps()) == step + 1
        journal.finish(status="completed", reason="", finished=5.0, safe_state={})
        journal.close()
        with Record(tmp_path) as run:
            assert run.status == "completed"

    def test_writing_goes_on_while_somebody_reads_slowly(self, tmp_path):
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {})
        for step in range(3):
            journal.step(record(step, 1.0, 2.0))
        with Record(tmp_path) as run:
            rows = run.step_records()
            next(rows)
            journal.step(record(3, 1.0, 2.0))
            add_model(tmp_path, "m", 1.0, {})
            journal.finish(status="completed", reason="", finished=5.0, safe_state={})
            journal.close()
            assert len(list(rows)) == 2
            assert len(run.steps()) == 4

    def test_reading_changes_nothing(self, tmp_path):
        write(tmp_path / FILE_NAME)
        before = digest(tmp_path)
        assert list(before) == [FILE_NAME]
        for path in (tmp_path, tmp_path / FILE_NAME):
            with Record(path) as run:
                run.steps(), run.telemetry(), run.events(), list(run.step_records())
        assert digest(tmp_path) == before

    def test_reading_an_unfinished_one_changes_no_record(self, tmp_path):
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {})
        journal.step(record(0, 1.0, 2.0))
        before = digest(tmp_path)
        with Record(tmp_path) as run:
            assert len(run.steps()) == 1
        after = digest(tmp_path)
        assert {name: after[name] for name in (FILE_NAME, FILE_NAME + "-wal")} == {
            name: before[name] for name in (FILE_NAME, FILE_NAME + "-wal")
        }
        journal.close()


class TestTelemetryThatWaits:
    """Ticks that come one right after another are written together; nothing else that is written waits."""

    @pytest.fixture
    def journal(self, tmp_path):
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {})
        yield journal
        with suppress(sqlite3.ProgrammingError):  # closed already
            journal.close()

    def record_until_some_wait(self, journal):
        """Record ticks, the force of each its number; return how many there are, some of them not yet written."""
        with Record(journal.path) as run:
            for tick in range(1000):
                journal.telemetry(0.1 * tick, 0, (1.0, float(tick)))
                if run.count("telemetry") < tick + 1:
                    return tick + 1
        raise AssertionError("no tick ever waited")

    @pytest.mark.parametrize(
        "write",
        [
            lambda journal: journal.step(record(0, 1.0, 2.0)),
            lambda journal: journal.event(Event(1.0, "INFO", "note", "something")),
            lambda journal: journal.finish(status="completed", reason="", finished=1.0, safe_state={}),
            lambda journal: journal.close(),
        ],
        ids=["step", "event", "finish", "close"],
    )
    def test_are_written_with_what_comes_next(self, journal, tmp_path, write):
        count = self.record_until_some_wait(journal)
        with Record(tmp_path) as run:
            assert len(run.telemetry()) < count
        write(journal)
        with Record(tmp_path) as run:
            ticks = run.telemetry()
        np.testing.assert_array_equal(ticks["force"], np.arange(count))

    def test_do_not_wait_for_ever(self, journal, tmp_path):
        # More ticks alone bring them into the file, as soon as a tenth of a wall-clock second is over.
        waited = Stopwatch()
        with Record(tmp_path) as run:
            count = 0
            while len(run.telemetry()) == 0:
                assert waited.seconds() < 60.0
                journal.telemetry(0.1 * count, 0, (1.0, float(count)))
                count += 1
            ticks = run.telemetry()
        np.testing.assert_array_equal(ticks["force"], np.arange(len(ticks)))

    def test_a_step_and_the_ticks_before_it_survive_together(self, journal, tmp_path):
        count = self.record_until_some_wait(journal)
        journal.step(record(0, 1.0, 2.0))
        # A copy of the files is what another process would find if this one died now.
        copy = tmp_path / "copy"
        copy.mkdir()
        for path in tmp_path.glob(FILE_NAME + "*"):
            (copy / path.name).write_bytes(path.read_bytes())
        with Record(copy) as run:
            assert run.status == "unfinished"
            assert len(run.telemetry()) == count
            assert len(run.steps()) == 1


class TestUnusable:
    def test_no_run(self, tmp_path):
        with pytest.raises(DataError, match=f"is not a run: there is no {FILE_NAME}"):
            Record(tmp_path)
        with pytest.raises(DataError, match="is not a run"):
            Record(tmp_path / "absent.sqlite")
        with pytest.raises(DataError, match="is not a run"):
            add_model(tmp_path, "m", 0.0, {})

    @cases("content", [b"", b"no database at all", b"SQLite format 3\x00" + b"\xff" * 5000])
    def test_no_journal(self, tmp_path, content):
        path = tmp_path / "x.sqlite"
        path.write_bytes(content)
        with pytest.raises(DataError, match=r"x\.sqlite is not a readable journal"):
            Record(path)

    @cases("version", [0, 1, 2, 4, "3", None])
    def test_another_schema(self, tmp_path, version):
        path = tmp_path / FILE_NAME
        write(path)
        db = sqlite3.connect(path)
        if version is None:
            db.execute("DELETE FROM meta WHERE key = 'schema'")
        else:
            db.execute("UPDATE meta SET value = ? WHERE key = 'schema'", (json.dumps(version),))
        db.commit()
        db.close()
        with pytest.raises(DataError, match=r"schema version .*; this bench reads version 3"):
            Record(path)

    @cases(
        "statement",
        [
            "UPDATE meta SET value = '{'",
            "UPDATE meta SET value = x'80'",
            "UPDATE meta SET value = 7",
            "DROP TABLE signals",
            "DROP TABLE steps",
            "ALTER TABLE steps DROP COLUMN force",
            "ALTER TABLE telemetry RENAME COLUMN force TO other",
            "ALTER TABLE events RENAME COLUMN kind TO other",
            "UPDATE steps SET setpoints = 'tec'",
            "UPDATE steps SET force = 'heavy'",
            "UPDATE steps SET label = CAST(x'ff' AS TEXT)",
            "DROP TABLE telemetry",
            "DROP TABLE events",
        ],
    )
    def test_a_damaged_one_raises_data_errors_only(self, tmp_path, statement):
        path = tmp_path / FILE_NAME
        write(path)
        db = sqlite3.connect(path)
        db.execute(statement)
        db.commit()
        db.close()
        with pytest.raises(DataError, match=FILE_NAME), Record(path) as run:
            run.steps(), run.telemetry(), run.events(), list(run.step_records())

    @settings(max_examples=60, deadline=None)
    @given(data=st.data())
    def test_any_damage_raises_data_errors_only(self, tmp_path_factory, intact, data):
        path = tmp_path_factory.mktemp("damage") / FILE_NAME
        content = bytearray(intact)
        start = data.draw(st.integers(0, len(content) - 1))
        if data.draw(st.booleans()):
            del content[start:]
        else:
            content[start : start + 600] = data.draw(st.binary(min_size=600, max_size=600))
        path.write_bytes(bytes(content))
        try:
            with Record(path) as run:
                run.steps(), run.telemetry(), run.events(), list(run.step_records())
        except DataError:
            pass


class TestModels:
    def test_a_model_is_kept_beside_its_run(self, tmp_path):
        write(tmp_path / FILE_NAME)
        before = digest(tmp_path)
        add_model(tmp_path, "preisach", 3.0, {"order": 20})
        add_model(tmp_path, "a/b: ü", 3.0, {"order": 1})
        add_model(tmp_path / FILE_NAME, "preisach", 4.0, {"order": 21})
        assert before == {FILE_NAME: hashlib.sha256((tmp_path / FILE_NAME).read_bytes()).hexdigest()}
        assert json.loads((tmp_path / "models" / "preisach.json").read_text())["order"] == 21
        assert len(list((tmp_path / "models").iterdir())) == 2
        with Record(tmp_path) as run:
            # The newest last.
            assert list(run.models().items()) == [("a/b: ü", {"order": 1}), ("preisach", {"order": 21})]
            assert len(run.steps()) == 3

    @cases("content", ["{", '{"kept": 3}', '{"kept": {"position": "x"}}'])
    def test_a_damaged_one_is_named(self, tmp_path, content):
        write(tmp_path / FILE_NAME)
        add_model(tmp_path, "good", 1.0, {})
        (tmp_path / "models" / "bad.json").write_text(content)
        with Record(tmp_path) as run, pytest.raises(DataError, match=r"model file .*bad\.json is damaged"):
            run.models()


class TestFiles:
    def test_what_a_run_was_given_comes_back(self, tmp_path):
        files = {"rig.toml": b"[rig]\n", "reference": bytes(range(256)) * 40, "empty": b""}
        Journal(tmp_path / FILE_NAME, SIGNALS, {}, files).close()
        with Record(tmp_path) as run:
            assert run.files() == files
            assert list(run.files()) == list(files)

    def test_a_changed_one_is_named(self, tmp_path):
        Journal(tmp_path / FILE_NAME, SIGNALS, {}, {"a": b"1", "b": b"2"}).close()
        change(tmp_path / FILE_NAME, "UPDATE files SET content = x'33' WHERE name = 'b'")
        with Record(tmp_path) as run, pytest.raises(DataError, match="table files, row b: its checksum does not fit"):
            run.files()


class TestChecksums:
    @cases(
        ("statement", "row"),
        [
            ("UPDATE steps SET force = force + 1e-12 WHERE step = 1", "table steps, row 1"),
            ("UPDATE steps SET label = 'x' WHERE step = 2", "table steps, row 2"),
            ("UPDATE steps SET phase = label, label = phase WHERE step = 2", "table steps, row 2"),
            ("UPDATE steps SET force = NULL WHERE step = 0", "table steps, row 0"),
            ("UPDATE telemetry SET t = t + 0.1 WHERE tick = 3", "table telemetry, row 3"),
            ("UPDATE telemetry SET checksum = checksum + 1 WHERE tick = 4", "table telemetry, row 4"),
            ("UPDATE events SET text = 'fall'", "table events, row 1"),
            ("UPDATE meta SET value = '\"sma\"' WHERE key = 'rig'", "table meta, row rig"),
            ("UPDATE signals SET unit = 'mN' WHERE position = 1", "table signals, row 1"),
        ],
    )
    def test_a_row_that_was_changed_is_named(self, tmp_path, statement, row):
        write(tmp_path / FILE_NAME)
        change(tmp_path / FILE_NAME, statement)
        with pytest.raises(DataError, match=f"is damaged: {row}: its checksum does not fit"), Record(tmp_path) as run:
            run.steps(), run.telemetry(), run.events(), list(run.step_records())

    def test_rows_are_checked_however_they_are_read(self, tmp_path):
        write(tmp_path / FILE_NAME)
        change(tmp_path / FILE_NAME, "UPDATE steps SET force = 0 WHERE step = 1")
        with Record(tmp_path) as run:
            for read in (run.steps, lambda: list(run.step_records())):
                with pytest.raises(DataError, match="table steps, row 1"):
                    read()
            assert len(run.telemetry()) == 6


class TestReopening:
    def test_rows_are_numbered_on(self, tmp_path):
        write(tmp_path / FILE_NAME, finish=False)
        journal = Journal.reopen(tmp_path)
        assert (journal.steps, journal.ticks, journal.signals) == (3, 6, SIGNALS)
        journal.event(Event(3.0, "INFO", "note", "resumed"))
        journal.telemetry(3.0, 3, (23.0, 23.0))
        journal.step(record(3, 23.0, 23.0))
        journal.finish(status="completed", reason="", finished=4.0, safe_state={})
        journal.close()
        with Record(tmp_path) as run:
            assert run.status == "completed"
            assert [entry.step for entry in run.step_records()] == [0, 1, 2, 3]
            assert len(run.telemetry()) == 7
            assert [event.text for event in run.events()] == ["rise", "resumed"]
            assert run.meta["counts"] == {"steps": 4, "telemetry": 7, "events": 2}

    def test_a_run_that_has_ended_is_not_written_on(self, tmp_path):
        write(tmp_path / FILE_NAME)
        with pytest.raises(ConfigurationError, match="a run that was completed"):
            Journal.reopen(tmp_path)

    def test_a_damaged_one_is_not_written_on(self, tmp_path):
        write(tmp_path / FILE_NAME, finish=False)
        change(tmp_path / FILE_NAME, "UPDATE steps SET force = 1 WHERE step = 1")
        with pytest.raises(DataError, match="table steps, row 1"):
            Journal.reopen(tmp_path)
