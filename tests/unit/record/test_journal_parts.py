"""The parts of a journal by themselves: second file, reading damaged rows, writing on, recovering."""

import json
import math
import os
import shutil
import sqlite3
import sys
import warnings
from contextlib import closing

import numpy as np
import pytest
from cases import cases

from bench.base import ConfigurationError, DataError, IncompleteRecordWarning
from bench.devices import Settled, Signal
from bench.record import (
    BLACK_BOX_NAME,
    FILE_NAME,
    NAME as SECOND_NAME,
    RECOVERED_NAME,
    Ending,
    Event,
    Journal,
    Record,
    StepRecord,
    abandon,
    add_model,
    opening,
    recover,
    take_in,
)
from bench.record.rows import TABLES, Row, checksum, checksums, meta
from bench.record.second_file import SecondFile, places, read_second_file
from bench.record.store import Store

SIGNALS = (Signal("force", "N", "force"),)
STATUS = {"status": "completed", "reason": "", "finished": 9.0, "safe_state": {}}
pytestmark = pytest.mark.usefixtures("other_disk")


def step(number, started=None):
    first = float(number if started is None else started)
    return StepRecord(number, first, first + 0.5, "", "", Settled.DWELL, {"tec": 20.0}, (float(number),))


def note(number):
    return Row("events", (number, float(number), "INFO", "note", f"event {number}"))


def step_row(number):
    return Row("steps", (number, 50.0, 50.5, "", "", "dwell", "{}", 1.0, "[]"))


def unfinished(tmp_path, *waiting):
    """Write two steps of a run that did not end, and rows that wait in its second file."""
    store = Store(tmp_path / FILE_NAME)
    store.create(["force"], [*meta({"schema": 3, "identity": "one"}), Row("signals", (0, "force", "N", "force", 3))])
    store.write([step_row(0), step_row(1)])
    store.close()
    if waiting:
        file = SecondFile(tmp_path / SECOND_NAME, "one")
        file.append(waiting)
        file.close()


class TestSecondFile:
    def write(self, path, *numbers, identity="one"):
        file = SecondFile(path, identity)
        for number in numbers:
            file.append([note(number)])
        file.close()
        return path

    def events(self, path, identity="one"):
        return [row.columns[0] for row in read_second_file(path, identity) if row.table == "events"]

    def test_a_damaged_line_is_left_out(self, tmp_path):
        path = self.write(tmp_path / SECOND_NAME, 1, 2, 3)
        data = path.read_bytes()
        for place in range(data.index(b"event 2") - 40, data.index(b"event 2") + 5):
            path.write_bytes(data[:place] + bytes([data[place] ^ 0x41]) + data[place + 1 :])
            assert {1, 3} >= {*self.events(path)} >= {3}

    def test_one_that_is_cut_off(self, tmp_path):
        path = self.write(tmp_path / SECOND_NAME, 1, 2)
        data = path.read_bytes()
        for length in range(len(data) * 2 // 3 + 9, len(data) - 1):
            path.write_bytes(data[:length])
            assert self.events(path) == [1]

    def test_every_row_comes_back_as_it_was_kept(self, tmp_path):
        rows = [
            Row("meta", ("run", '"µ"')),
            Row("signals", (0, "force", "N", "a load cell", 3)),
            Row("steps", (0, 0.0, 0.5, "up", "", "dwell", '{"tec": 1.5}', 1e-300, -math.inf, "[0.25]")),
            Row("telemetry", (1, 0.1 + 0.2, 0, np.float64(1.5), math.nan)),
            Row("events", (1, 0.5, "INFO", "note", "a\nnew line")),
            Row("files", ("a.bin", "digest", bytes(range(256)))),
        ]
        assert [row.table for row in rows] == [*TABLES]
        file = SecondFile(tmp_path / SECOND_NAME, "one")
        file.append(rows)
        file.close()
        for row, read in zip(rows, [*read_second_file(file.path, "one")][1:], strict=True):
            np.testing.assert_equal(read, row)

    @pytest.mark.skipif(sys.platform == "win32", reason="needs links and users of POSIX")
    @pytest.mark.parametrize("forged", ["link", "second name", "of another user"])
    @pytest.mark.parametrize("where", [0, 1])
    def test_nothing_of_another_user_is_followed_or_believed(self, tmp_path, forged, where):
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {})
        with Record(tmp_path) as record:
            identity = record.identity
        path = self.write(places(tmp_path / FILE_NAME)[where], 1, identity=identity)
        assert path.stat().st_mode & 0o777 == 0o600
        theirs = tmp_path / "theirs"
        if forged == "of another user":
            if os.geteuid() != 0:
                pytest.skip("needs root, who can give files away")
            os.chown(path, 65534, -1)
        elif forged == "link":
            path.rename(theirs)
            path.symlink_to(theirs)
        else:
            theirs.hardlink_to(path)
        content = path.read_bytes()
        assert self.events(path, identity) == []
        # In the folder of the run it is said; elsewhere anybody could have it said.
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            with Record(tmp_path) as record:
                assert ("is not read" in record.missing.damage) is (where == 0) is bool(said)
        with pytest.raises(FileExistsError):
            SecondFile(path, identity)
        assert path.read_bytes() == content
        journal.close()


@cases("table", ["meta", "signals", "steps", "telemetry", "events", "files"])
def test_a_row_whose_checksum_does_not_fit_is_told_and_left_out(tmp_path, table):
    journal = Journal(tmp_path / FILE_NAME, SIGNALS, {"rig": "vo2"}, {"a.txt": b"a", "b.txt": b"b"})
    for number in range(4):
        journal.telemetry(number, number, (1.0,))
        journal.step(step(number))
        journal.event(Event(float(number), "INFO", "note", f"event {number}"))
    journal.finish(**STATUS)
    journal.close()
    key, wanted, column = {
        "meta": ("key", "'rig'", "value"), "signals": ("position", 0, "unit"), "steps": ("step", 1, "force"),
        "telemetry": ("tick", 3, "force"), "events": ("event", 2, "text"), "files": ("name", "'b.txt'", "content"),
    }[table]  # fmt: skip
    with closing(sqlite3.connect(tmp_path / FILE_NAME)) as db, db:
        (rows,) = db.execute(f"SELECT count(*) FROM {table}").fetchone()
        db.execute(f"UPDATE {table} SET {column} = 7 WHERE {key} = {wanted}")
    found = recover(tmp_path)
    state = found.tables[table]
    # Metadata and signals are there twice.
    added = int(table in ("meta", "signals"))
    assert (state.good, state.added, state.missing) == (rows - 1, added, 1 - added)
    assert state.first_bad == str(wanted).strip("'")
    assert [name for name, other in found.tables.items() if other.missing] == [table] * (1 - added)
    assert found.copy is not None


@pytest.mark.parametrize("change", ["UPDATE meta SET value = x'ff' WHERE key = 'rig'", "a name that is no text"])
def test_a_journal_with_bytes_that_are_no_text_is_a_message(tmp_path, change):
    journal = Journal(tmp_path / FILE_NAME, SIGNALS, {"rig": "vo2"})
    journal.finish(**STATUS)
    journal.close()
    path = tmp_path / FILE_NAME
    if change.startswith("UPDATE"):
        with closing(sqlite3.connect(path)) as db, db:
            db.execute(change)
    else:
        path.write_bytes(path.read_bytes().replace(b"CREATE TABLE telemetry", b"CREATE TABLE \xdf\xdf\xdfemetry"))
    with pytest.raises(DataError, match=r"not a readable journal|damaged"), Record(tmp_path) as record:
        record.telemetry()
    assert recover(tmp_path).is_complete


@pytest.mark.parametrize("table", ["steps", "telemetry", "events"])
@pytest.mark.parametrize("number", [1, 2, 4])
def test_rows_that_are_gone_from_a_completed_record_are_told(tmp_path, table, number):
    journal = Journal(tmp_path / FILE_NAME, SIGNALS, {})
    for i in range(5):
        journal.telemetry(i, i, (1.0,))
        journal.step(step(i))
        journal.event(Event(float(i), "INFO", "note", f"event {i}"))
    journal.finish(**STATUS)
    journal.close()
    read = {"steps": Record.steps, "telemetry": Record.telemetry, "events": Record.events}[table]
    with Record(tmp_path) as record:
        assert record.remark() == record.damage() == ""
        assert len(read(record)) == 5
    with closing(sqlite3.connect(tmp_path / FILE_NAME)) as db, db:
        key = {"steps": "step", "telemetry": "tick", "events": "event"}[table]
        db.execute(f"DELETE FROM {table} WHERE {key} = {number}")
    with pytest.warns(IncompleteRecordWarning):
        opened = Record(tmp_path)
    with opened as record:
        assert record.missing.ranges == {table: ((number, number),)}
        assert len(read(record)) == 4
        assert table in record.damage()


def test_a_second_file_of_another_journal_is_not_believed(tmp_path):
    Journal(tmp_path / FILE_NAME, SIGNALS, {}).close()
    for path in (*places(tmp_path / FILE_NAME), tmp_path / "named"):
        file = SecondFile(path, "0123456789abcdef0123456789abcdef")
        file.append([note(9)])
        file.close()
    with Record(tmp_path) as record:
        assert (record.remark(), record.events()) == ("", [])
    assert recover(tmp_path).copy is None
    with pytest.raises(ConfigurationError, match="of another journal"):
        recover(tmp_path, [tmp_path / "named"])
    # A new run in this place has none.
    (tmp_path / FILE_NAME).unlink()
    Journal(tmp_path / FILE_NAME, SIGNALS, {}).close()
    assert not any(path.exists() for path in places(tmp_path / FILE_NAME))


class TestReading:
    @pytest.mark.parametrize(
        ("table", "columns", "problem"),
        [
            ("steps", (2, 0.0, 0.5, "", "", "nonsense", "{}", 1.0, "[]"), "step 2: "),
            ("telemetry", (1, "soon", 0, 2.0), "table telemetry: "),
        ],
    )
    def test_a_row_that_is_none_has_a_good_checksum_all_the_same(self, tmp_path, table, columns, problem):
        unfinished(tmp_path)
        with closing(sqlite3.connect(tmp_path / FILE_NAME)) as db, db:
            marks = "?, " * len(columns)
            db.execute(f"INSERT INTO {table} VALUES ({marks} ?)", (*columns, checksum(columns)))
        with Record(tmp_path) as record, pytest.raises(DataError, match=f"is damaged: {problem}"):
            list(record.step_records()) if table == "steps" else record.telemetry()

    def test_rows_that_only_a_second_file_has_are_read_and_said(self, tmp_path):
        unfinished(tmp_path, *map(step_row, (1, 2, 4)), *meta({"status": "failed", "rig": "vo2"}))
        with pytest.warns(IncompleteRecordWarning) as said:
            opened = Record(tmp_path)
        with opened as record:
            assert record.steps()["step"].tolist() == [0, 1, 2, 4]
            assert (record.status, record.meta["rig"]) == ("failed", "vo2")
            assert record.missing.ranges == {"steps": ((3, 3),)}
        first, second = (str(each.message) for each in said)
        assert f"lacks 4 rows that its second file {tmp_path / SECOND_NAME} has" in first
        assert "lacks rows that were recorded: steps 3" in second
        assert first in record.remark()

    def test_a_second_file_with_other_columns_is_an_error(self, tmp_path):
        unfinished(tmp_path, Row("steps", (2, 1.0)))
        for read in (Record, recover):
            with pytest.raises(DataError, match="fit"):
                read(tmp_path)

    def test_checksums_of_many_rows_are_those_of_each(self):
        rows = np.array([[1.0, np.nan, -0.0], [np.inf, 2.5, -3.0]])
        assert checksums(rows) == [checksum(tuple(row)) for row in rows.tolist()]
        # Neither the sign of a zero nor that of a nan is kept.
        assert checksum((0.0, None)) == checksum((-0.0, -math.nan))


class TestWritingOn:
    def test_what_waits_is_taken_in_and_numbered_on(self, tmp_path):
        unfinished(tmp_path, step_row(1), step_row(2), note(1))
        with pytest.warns(IncompleteRecordWarning):
            path, signals, counts, lost = take_in(tmp_path)
        assert (path, signals[0].name) == (tmp_path / FILE_NAME, "force")
        assert counts == {"steps": 3, "telemetry": 0, "events": 1}
        assert lost == {}
        assert [each.name for each in tmp_path.iterdir()] == [FILE_NAME]
        with Record(tmp_path) as record:
            assert len(record.steps()) == 3

    @cases("length", [0, 1, 40])
    def test_a_second_file_that_a_kill_cut_off_at_its_beginning_goes(self, tmp_path, length):
        unfinished(tmp_path, step_row(2))
        path = tmp_path / SECOND_NAME
        path.write_bytes(path.read_bytes()[:length])
        Journal.reopen(tmp_path).close()
        assert [each.name for each in tmp_path.iterdir()] == [FILE_NAME]

    def test_a_second_file_of_another_journal_stays(self, tmp_path):
        unfinished(tmp_path)
        SecondFile(tmp_path / SECOND_NAME, "two").close()
        Journal.reopen(tmp_path).close()
        assert (tmp_path / SECOND_NAME).exists()

    @pytest.mark.filterwarnings("ignore::bench.base.IncompleteRecordWarning")
    @pytest.mark.parametrize("waits", [True, False])
    def test_one_that_cannot_be_written_on(self, tmp_path, monkeypatch, waits):
        unfinished(tmp_path, *[step_row(2)] * waits)

        def refuse(*_):
            raise sqlite3.OperationalError("attempt to write a readonly database")

        monkeypatch.setattr(Store, "write" if waits else "forget", refuse)
        with pytest.raises(DataError, match=r"cannot be written on: .*readonly"):
            Journal.reopen(tmp_path)
        assert (tmp_path / SECOND_NAME).exists() is waits

    def test_the_end_of_one_whose_thread_hangs(self, tmp_path):
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {"rig": "vo2"})
        journal.step(step(0))
        abandon(journal.path, Ending("aborted", "it hangs", {"tec": "safe"}))
        with Record(tmp_path) as record:
            assert (record.status, record.meta["reason"]) == ("aborted", "it hangs")
            assert record.meta["safe_state"] == {"tec": "safe"}
        # What it would have said of itself later stays.
        abandon(journal.path, Ending("failed", "again", {}))
        with Record(tmp_path) as record:
            assert record.meta["reason"] == "it hangs"
        journal.close()

    def test_the_end_of_one_whose_process_died_is_what_its_guardian_says(self, tmp_path):
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {"rig": "vo2"})

        def found(*lines):
            (tmp_path / BLACK_BOX_NAME).write_text("\n".join(lines), encoding="utf-8")
            with Record(tmp_path) as record:
                return record.status, record.reason, record.safe_state

        begin = '{"what": "begin"}'
        failed = '{"what": "failed", "reason": "it hung", "safe": {"tec": "no answer"}}'
        nothing = ("unfinished", "", {})
        assert found(begin) == nothing
        assert found(begin, failed) == ("failed", "it hung", {"tec": "no answer"})
        assert found(begin, failed, '{"what": "end", "safe": {"tec": "safe"}}')[2] == {"tec": "safe"}
        # A guardian that was killed; one that ended as the bench asked for it; a run that was taken up again.
        assert found(begin, failed, '{"what": "end", "sa')[2] == {"tec": "no answer"}
        assert found(begin, '{"what": "end", "safe": {"tec": "safe"}}') == nothing
        assert found(begin, failed, "[]", begin) == nothing
        journal.finish(status="completed", reason="", finished=1.0, safe_state={"tec": "safe"})
        journal.close()
        assert found(begin, failed) == ("completed", "", {"tec": "safe"})

    def test_signals_with_a_null_character_are_refused(self, tmp_path):
        with pytest.raises(ConfigurationError, match="may not have a null character"):
            Journal(tmp_path / FILE_NAME, (Signal("a\0b", "N", ""),), {})


class TestRecovering:
    def test_the_copy_of_the_heading_is_as_new_as_the_heading(self, tmp_path):
        """Each way that the metadata changes: the run is resumed, ends, its thread hangs, a copy is repaired."""

        def damaged():
            with closing(sqlite3.connect(tmp_path / FILE_NAME)) as db, db:
                before = dict(db.execute("SELECT key, value FROM meta"))
                db.execute("UPDATE meta SET checksum = 0")
            (tmp_path / RECOVERED_NAME).unlink(missing_ok=True)
            with Record(recover(tmp_path).copy) as record:
                after = {key: json.dumps(value) for key, value in record.meta.items()}
            shutil.move(tmp_path / RECOVERED_NAME, tmp_path / FILE_NAME)
            assert {**after, "recovered": 0} == {**before, "recovered": 0}
            return after

        Journal(tmp_path / FILE_NAME, SIGNALS, {"rig": "vo2"}).close()
        assert "status" not in damaged()
        abandon(tmp_path / FILE_NAME, Ending("aborted", "it hangs", {}))
        assert "aborted" in damaged()["status"]
        Journal.reopen(tmp_path).close()
        assert "status" not in damaged()
        Journal.reopen(tmp_path, {"resumes": [1]}).close()
        assert damaged()["resumes"] == "[1]"
        journal = Journal.reopen(tmp_path)
        journal.finish(**STATUS)
        journal.close()
        assert "completed" in damaged()["status"]

    @pytest.mark.parametrize("cell", [None, "text", 3])
    def test_a_damaged_copy_of_the_heading_takes_nothing_from_a_whole_one(self, tmp_path, cell):
        unfinished(tmp_path, step_row(2))
        with closing(sqlite3.connect(tmp_path / FILE_NAME)) as db, db:
            db.execute("CREATE TABLE other AS SELECT ? AS line", (cell,))
            db.execute("DROP TABLE heading")
            db.execute("ALTER TABLE other RENAME TO heading")
        with Record(recover(tmp_path).copy) as record:
            assert record.meta["identity"] == "one"

    def test_a_journal_of_another_schema_is_refused(self, tmp_path):
        unfinished(tmp_path)
        with closing(Store(tmp_path / FILE_NAME)) as store:
            store.write(meta({"schema": 2}))
        with pytest.raises(DataError, match="has schema version 2; this bench reads version 3"):
            recover(tmp_path)

    def test_a_damaged_row_is_not_copied(self, tmp_path):
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {"rig": "vo2"})
        with closing(sqlite3.connect(tmp_path / FILE_NAME)) as db, db:
            db.execute("""UPDATE meta SET value = '"vo3"' WHERE key = 'rig'""")
        journal.finish(**STATUS)
        journal.close()
        with Record(recover(tmp_path).copy) as record:
            assert (record.meta["rig"], record.status) == ("vo2", "completed")

    def test_the_end_is_recorded_though_the_signals_cannot_be_read(self, tmp_path):
        Journal(tmp_path / FILE_NAME, SIGNALS, {"rig": "vo2"}).close()
        with closing(sqlite3.connect(tmp_path / FILE_NAME)) as db:
            (page,) = db.execute("SELECT rootpage FROM sqlite_master WHERE name = 'signals'").fetchone()
        with (tmp_path / FILE_NAME).open("r+b") as file:
            file.seek(4096 * (page - 1))
            file.write(b"\xa5" * 4096)
        abandon(tmp_path / FILE_NAME, Ending("aborted", "it hangs", {}))
        with Record(recover(tmp_path).copy) as record:
            assert (record.signals, record.status) == (SIGNALS, "aborted")

    def test_a_copy_that_cannot_be_written(self, tmp_path):
        unfinished(tmp_path, step_row(2))
        with pytest.raises(ConfigurationError, match=r"cannot be written: .*name another one by --out"):
            recover(tmp_path, out=tmp_path / "no folder" / "copy.sqlite")
        recovery = recover(tmp_path)
        assert recovery.tables["steps"].added == 1
        assert recovery.is_complete

    def test_rows_about_a_damaged_page_are_read_one_by_one(self, tmp_path):
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {})
        for tick in range(4000):
            journal.telemetry(0.1 * tick, 0, (float(tick),))
        journal.finish(**STATUS)
        journal.close()
        with closing(sqlite3.connect(tmp_path / FILE_NAME)) as db:
            pages = db.execute("PRAGMA page_count").fetchone()[0]
        with (tmp_path / FILE_NAME).open("r+b") as file:
            for share in (0.4, 0.6):
                file.seek(4096 * round(share * pages))
                file.write(b"\xa5" * 4096)
        recovery = recover(tmp_path)
        kept = recovery.tables["telemetry"]
        assert 3000 < kept.good < 4000
        assert kept.good + kept.missing == 4000
        with Record(recovery.copy) as record:
            found = record.telemetry()["force"]
        assert found.size == kept.good
        # What lies between two pages that are damaged is kept as well.
        assert np.isin([2000.0], found).all()


class TestModels:
    def test_a_model_file_is_readable_text(self, tmp_path):
        unfinished(tmp_path)
        for number in (1, 2):
            add_model(tmp_path, f"film {number}", 5.0, {"unit": "°C"})
        text = (tmp_path / "models" / "film 1.json").read_text(encoding="utf-8")
        assert "°C" in text
        assert json.loads(text)["unit"] == "°C"
        with Record(tmp_path) as record:
            assert list(record.models()) == ["film 1", "film 2"]

    def test_one_that_cannot_be_written(self, tmp_path):
        unfinished(tmp_path)
        (tmp_path / "models").write_text("a file in its place")
        with pytest.raises(DataError, match=r"model file .* cannot be written"):
            add_model(tmp_path, "film", 5.0, {})


def test_events_and_steps_are_numbered_by_the_journal(tmp_path):
    journal = Journal(tmp_path / FILE_NAME, SIGNALS, {})
    journal.event(Event(0.0, "INFO", "note", "one"))
    journal.step(step(0, started=3.0))
    journal.telemetry(0.5, 0, (1.0,))
    assert (journal.steps, journal.ticks) == (1, 1)
    journal.finish(**STATUS)
    journal.close()
    with Record(tmp_path) as record:
        assert record.meta["counts"] == {"steps": 1, "telemetry": 1, "events": 1}
        assert [each.text for each in record.events()] == ["one"]


@pytest.mark.parametrize("problem", ["disk I/O error", "database disk image is malformed"])
def test_a_journal_that_cannot_be_opened_is_named(tmp_path, monkeypatch, problem):
    unfinished(tmp_path)

    def refuse(*_):
        raise sqlite3.OperationalError(problem)

    monkeypatch.setattr(opening, "_connected", refuse)
    with pytest.raises(DataError, match=f"is not a readable journal: {problem}"):
        Record(tmp_path)
