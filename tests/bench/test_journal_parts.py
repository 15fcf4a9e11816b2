"""The parts of a journal by themselves: second file, keeper, thread, SQLite file, and reading damaged ones."""

import json
import math
import os
import sqlite3
import sys
import tempfile
import threading
from collections import namedtuple
from contextlib import closing

import numpy as np
import pytest

from bench.base import ConfigurationError, DataError, IncompleteRecordWarning, RecordError
from bench.devices import Settled, Signal
from bench.record import (
    BLACK_BOX_NAME,
    FILE_NAME,
    NAME as MIRROR_NAME,
    RECOVERED_NAME,
    SCHEMA,
    Ending,
    Event,
    Journal,
    Record,
    StepRecord,
    abandon,
    add_model,
    background,
    keeping,
    opening,
    recover,
    take_in,
)
from bench.record.background import Background
from bench.record.keeping import RESERVE_NAME, Keeper
from bench.record.mirror import Mirror, elsewhere, read_mirror
from bench.record.rows import TABLES, checksum, checksums, entry, meta_row, split, ticks
from bench.record.store import Store

SIGNALS = (Signal("force", "N", "force"),)
STATUS = {"status": "completed", "reason": "", "finished": 9.0, "safe_state": {}}


@pytest.fixture(autouse=True)
def other_disk(tmp_path_factory, monkeypatch):
    folder = tmp_path_factory.mktemp("temporary")
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.fixture
def synced(monkeypatch):
    """The files that were made durable, by their names, in order."""
    files, sync = [], Mirror.sync
    monkeypatch.setattr(Mirror, "sync", lambda self: files.append(self.path.name) or sync(self))
    return files


def step(number, started=None):
    first = float(number if started is None else started)
    return StepRecord(number, first, first + 0.5, "", "", Settled.DWELL, {"tec": 20.0}, (float(number),))


def note(number):
    return entry("events", (number, float(number), "INFO", "note", f"event {number}"))


def new_store(tmp_path):
    store = Store(tmp_path / FILE_NAME)
    head = [entry("meta", meta_row("schema", SCHEMA)), entry("signals", (0, "force", "N", "force", 3))]
    store.create(["force"], head)
    return store, head


@pytest.fixture
def keeper(tmp_path):
    store, head = new_store(tmp_path)
    keeper = Keeper(store)
    keeper.begin(head)
    yield keeper
    keeper.close(is_whole=True)


def stored(keeper_or_store):
    store = getattr(keeper_or_store, "store", keeper_or_store)
    return [each.row[0] for each in store.entries() if each.table == "events"]


def refuse(monkeypatch, store, problem="database is locked"):
    """Have a store refuse every row; return how to let it take them again."""

    def write(_entries):
        raise sqlite3.OperationalError(problem)

    monkeypatch.setattr(store, "write", write)
    return lambda: monkeypatch.undo()


class At:
    """A stopwatch that has run for so long."""

    def __init__(self, seconds):
        self.seconds = lambda: seconds


class TestMirror:
    def test_half_of_an_entry_is_taken_off_again(self, tmp_path):
        file = Mirror(tmp_path / MIRROR_NAME)
        file.append([note(1)])
        real = file._file

        class Full:
            def __getattr__(self, name):
                return getattr(real, name)

            def write(self, data):
                return real.write(data[: len(data) // 2])

        file._file = Full()
        with pytest.raises(OSError, match="takes no more"):
            file.append([note(2)])
        file._file = real
        file.append([note(3)])
        assert [each.row[0] for each in file.entries()] == [1, 3]
        file.append([note(4)])
        assert [each.row[0] for each in read_mirror(file.path)] == [1, 3, 4]
        file.close()

    def test_what_is_there_stays(self, tmp_path):
        for number in (1, 2):
            file = Mirror(tmp_path / MIRROR_NAME)
            file.append([note(number)])
            file.close()
        assert [each.row[0] for each in read_mirror(tmp_path / MIRROR_NAME)] == [1, 2]

    @pytest.mark.parametrize("spoilt", ["head", "payload", "end"])
    def test_a_damaged_entry_is_left_out(self, tmp_path, spoilt):
        path = tmp_path / MIRROR_NAME
        file = Mirror(path)
        file.append([note(1)])
        first = path.stat().st_size
        file.append([note(2), ticks([(1, 0.5, 0, 2.0), (2, 1.5, 0, 3.0)])])
        file.close()
        data = bytearray(path.read_bytes())
        place = {"head": 4, "payload": first - 3, "end": len(data) - 3}[spoilt]
        data[place] ^= 0x41
        path.write_bytes(data)
        found = [(each.table, each.row[0]) for each in split(read_mirror(path))]
        rest = [("telemetry", 1), ("telemetry", 2)]
        assert found == ([("events", 1), ("events", 2)] if spoilt == "end" else [("events", 2), *rest])

    def test_one_that_is_cut_off(self, tmp_path):
        path = tmp_path / MIRROR_NAME
        file = Mirror(path)
        file.append([note(1), note(2)])
        file.close()
        data = path.read_bytes()
        for length in range(len(data) // 2, len(data)):
            path.write_bytes(data[:length])
            assert [each.row[0] for each in read_mirror(path)] == [1]

    def test_where_others_are(self, tmp_path, other_disk):
        first, late = elsewhere(tmp_path / FILE_NAME)
        assert (first.parent, first.suffix, late.suffix) == (other_disk, ".mirror", ".late")
        assert len(first.stem) == len("bench-") + 24
        assert elsewhere(tmp_path / "other.sqlite")[0] != first

    def test_every_row_comes_back_as_it_was_kept(self, tmp_path):
        rows = {
            "meta": ("run", '"µ"'),
            "signals": (0, "force", "N", "a load cell", 3),
            "steps": (0, 0.0, 0.5, "up", "", "dwell", '{"tec": 1.5}', 1.0, None, "[0.25]"),
            "telemetry": (1, 0.25, 0, 1.5, None),
            "events": (1, 0.5, "INFO", "note", "text with = and four"),
            "files": ("a.bin", "digest", bytes(range(256))),
        }
        assert rows.keys() == set(TABLES)
        file = Mirror(tmp_path / "rows.mirror")
        file.append([entry(table, row) for table, row in rows.items()])
        file.close()
        read = {each.table: each.row for each in read_mirror(file.path)}
        for table, row in rows.items():
            # A missing number is nan in the file.
            np.testing.assert_equal(read[table], tuple(math.nan if value is None else value for value in row))

    @pytest.mark.parametrize("count", [1, 3, 4, 20])
    def test_ticks_are_kept_alike_one_by_one_and_together(self, count):
        rows = [(i, 0.1 * i, 0, -0.0, math.nan, math.inf) for i in range(count)]
        together = ticks(rows).payload
        assert together == b"".join(ticks([row]).payload for row in rows)
        # Neither the sign of a zero nor that of a nan is kept.
        assert together == ticks([(*row[:3], 0.0, -math.nan, math.inf) for row in rows]).payload

    def test_rows_of_another_journal_are_left_out(self, tmp_path):
        path = tmp_path / "rows.mirror"
        for identity, number in (("", 1), ("one", 2), ("other", 3), ("one", 4)):
            file = Mirror(path, identity)
            file.append([note(number)])
            file.append([note(number + 10)])
            file.close()
        for identity, numbers in (("one", [2, 12, 4, 14]), ("other", [3, 13]), ("", [1, 11]), ("none of them", [])):
            assert [each.row[0] for each in read_mirror(path, identity) if each.table == "events"] == numbers

    @pytest.mark.skipif(sys.platform == "win32", reason="needs links and users of POSIX")
    @pytest.mark.parametrize("forged", ["link", "second name", "of another user"])
    def test_elsewhere_nothing_of_another_user_is_followed_or_believed(self, tmp_path, monkeypatch, forged):
        path, _ = elsewhere(tmp_path / FILE_NAME)
        file = Mirror(path)
        file.append([note(1)])
        file.close()
        assert path.stat().st_mode & 0o077 == 0
        assert [each.row[0] for each in read_mirror(path)] == [1]
        theirs = tmp_path / "theirs"
        if forged == "of another user" and os.geteuid() == 0:
            os.chown(path, 65534, -1)
        elif forged == "of another user":
            monkeypatch.setattr(os, "geteuid", lambda: 65533)
        elif forged == "link":
            path.rename(theirs)
            path.symlink_to(theirs)
        else:
            theirs.hardlink_to(path)
        assert list(read_mirror(path)) == []
        content = path.read_bytes()
        with pytest.raises(OSError, match=r"link|not a file of this user"):
            Mirror(path)
        assert path.read_bytes() == content


class TestKeeper:
    def test_rows_that_wait_are_durable_in_the_second_file_and_are_written_first(self, keeper, monkeypatch, synced):
        again = refuse(monkeypatch, keeper.store)
        keeper._tried = At(1.0)
        keeper.keep([note(1)])
        assert synced == [MIRROR_NAME]
        assert keeper.why == "database is locked"
        assert keeper.notices == ["the journal cannot be written (database is locked); rows wait in a second file"]
        keeper.keep([note(2)])  # so soon it is not tried again
        assert [each.row[0] for each in read_mirror(keeper.second_file) if each.table == "events"] == [1, 2]
        again()
        keeper._tried = At(0.49)
        keeper.keep([note(3)])
        assert stored(keeper) == []
        keeper._tried = At(0.5)
        keeper.keep([note(4)])
        assert stored(keeper) == [1, 2, 3, 4]
        assert keeper.why == ""
        assert keeper.notices[1:] == ["the journal can be written again; 3 rows were waiting"]

    @pytest.mark.parametrize(("problem", "reconnects"), [("database is locked", 0), ("disk I/O error", 1)])
    def test_a_file_is_opened_anew_after_a_failure_of_the_disk(self, keeper, monkeypatch, problem, reconnects):
        again, opened = refuse(monkeypatch, keeper.store, problem), []
        keeper.keep([note(1)])
        again()
        monkeypatch.setattr(keeper.store, "reconnect", lambda: opened.append(1))
        keeper._tried = At(1.0)
        keeper.keep([note(2)])
        assert len(opened) == reconnects
        assert stored(keeper) == [1, 2]

    def test_what_is_no_fault_of_the_disk_is_raised(self, keeper, monkeypatch):
        def write(_entries):
            raise sqlite3.IntegrityError("wrong")

        monkeypatch.setattr(keeper.store, "write", write)
        with pytest.raises(sqlite3.IntegrityError):
            keeper.keep([note(1)])

    def test_a_second_file_that_takes_nothing_has_one_elsewhere(self, keeper, monkeypatch, synced, other_disk):
        refuse(monkeypatch, keeper.store)

        def full(_entries):
            raise OSError(28, "No space left on device")

        keeper._mirror.append = full
        for number in (1, 2):
            keeper.keep([note(number)])
        (path,) = other_disk.iterdir()
        assert keeper.second_file == path
        assert [each.row[0] for each in read_mirror(path)] == [1, 2]
        assert synced == [path.name] * 2
        assert f"rows wait in {path}" in keeper.notices[-1]
        assert not keeper._is_whole

    def test_a_second_file_that_cannot_be_made_durable_has_one_elsewhere(self, keeper, monkeypatch, other_disk):
        again = refuse(monkeypatch, keeper.store)
        keeper._tried = At(1.0)
        broken = keeper._mirror

        def sync(self, original=Mirror.sync):
            if self is broken:
                raise OSError(5, "Input/output error")
            original(self)

        monkeypatch.setattr(Mirror, "sync", sync)
        keeper.keep([note(1)])
        (path,) = other_disk.iterdir()
        assert [each.row[0] for each in read_mirror(path)] == [1]
        assert not keeper._is_whole
        again()

    def test_rows_that_are_nowhere_end_the_run(self, keeper, monkeypatch):
        refuse(monkeypatch, keeper.store, "disk I/O error")

        def full(*_):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(Mirror, "append", full)
        with pytest.raises(RecordError, match=r"cannot be written: disk I/O .*; its second file neither: .*No space"):
            keeper.keep([note(1)])
        monkeypatch.undo()

    def test_what_waits_is_tried_again_while_nothing_happens(self, keeper, monkeypatch):
        again = refuse(monkeypatch, keeper.store)
        keeper.keep([note(1)])
        again()
        for seconds, found in ((0.49, []), (0.5, [1])):
            keeper._tried = At(seconds)
            keeper.fold_in()
            assert stored(keeper) == found

    def test_the_log_is_folded_in_now_and_then(self, keeper, monkeypatch):
        folded = []
        monkeypatch.setattr(keeper.store, "fold_in", lambda: folded.append(1))
        for seconds, anyway, count in ((29.9, False, 0), (30.0, False, 1), (1.0, True, 2)):
            keeper._folded = At(seconds)
            keeper.fold_in(anyway=anyway)
            assert len(folded) == count
        keeper.fold_in()
        assert len(folded) == 2

    @pytest.mark.parametrize(
        ("total", "free", "is_short"),
        [
            (1 << 40, 64 << 20, False),
            (1 << 40, (64 << 20) - 1, True),
            (100 << 20, 5 << 20, False),
            (100 << 20, 5e6, True),
        ],
    )
    def test_a_disk_that_is_nearly_full(self, keeper, monkeypatch, total, free, is_short):
        usage = namedtuple("usage", "total used free")
        monkeypatch.setattr(keeping.shutil, "disk_usage", lambda _: usage(total, 0, int(free)))
        keeper._looked = At(0.99)
        keeper.keep([note(1)])
        assert not keeper.is_short
        for number in (2, 3):
            keeper._looked = At(1.0)
            keeper.keep([note(number)])
            assert keeper.is_short is is_short
        told = [each for each in keeper.notices if "nearly full" in each]
        assert told == [f"the disk is nearly full ({int(free) >> 20} MB free): recordings stop"] * is_short

    def test_space_is_kept_and_given_back(self, keeper):
        reserve = keeper.store.path.parent / RESERVE_NAME
        assert reserve.stat().st_size == 1 << 18
        keeper.make_room()
        assert not reserve.exists()

    def test_the_end_waits_for_others(self, keeper, monkeypatch):
        waits = []
        monkeypatch.setattr(keeper.store, "wait_for_others", waits.append)
        keeper.keep([note(1)])
        assert keeper.end({"events": 1}) == ""
        assert waits == [5.0, 0.0]
        assert keeper.end({"events": 2}) == "table events has 1 rows of 2"

    def test_the_end_of_one_whose_rows_still_wait(self, keeper, monkeypatch):
        again = refuse(monkeypatch, keeper.store)
        keeper.keep([note(1)])
        assert keeper.end({"events": 1}) == "database is locked"
        again()
        assert keeper.end({"events": 1}) == ""
        assert stored(keeper) == [1]

    def test_closing_writes_what_waits_and_is_done_once(self, tmp_path, monkeypatch):
        store, head = new_store(tmp_path)
        keeper = Keeper(store)
        keeper.begin(head)
        again = refuse(monkeypatch, store)
        keeper.keep([note(1)])
        again()
        closed, close = [], store.close
        monkeypatch.setattr(store, "close", lambda: closed.append(1) or close())
        for _ in range(2):
            keeper.close(is_whole=True)
        assert closed == [1]
        assert sorted(path.name for path in tmp_path.iterdir()) == [FILE_NAME]
        with closing(sqlite3.connect(tmp_path / FILE_NAME)) as db:
            assert db.execute("SELECT count(*) FROM events").fetchone() == (1,)

    def test_one_that_is_not_whole_keeps_its_second_file(self, tmp_path):
        store, head = new_store(tmp_path)
        keeper = Keeper(store)
        keeper.begin(head)
        keeper.close(is_whole=False)
        assert {path.name for path in tmp_path.iterdir()} == {FILE_NAME, MIRROR_NAME}

    def test_one_that_is_removed_goes_on_with_every_row(self, keeper, other_disk):
        keeper.keep([note(1)])
        keeper._mirror.append = lambda _: (_ for _ in ()).throw(OSError("full"))
        keeper.keep([note(2)])
        keeper.store.path.unlink()
        with pytest.raises(RecordError, match="was removed while the run went on; everything so far is in"):
            keeper.keep([note(3)])
        assert stored(keeper) == [1, 2, 3]
        assert keeper.store.path.parent.parent == other_disk


class TestBackground:
    def test_an_idle_thread_folds_the_log_in(self, keeper, monkeypatch):
        folded = threading.Event()
        monkeypatch.setattr(background, "_IDLE", 0.01)
        monkeypatch.setattr(keeper, "fold_in", folded.set)
        thread = Background(keeper, 30.0)
        # One that hangs with its disk does not keep the process from ending.
        assert thread._thread.daemon
        assert folded.wait(30.0)
        assert thread.stop()

    def test_what_is_late_is_durable_elsewhere(self, keeper, monkeypatch, synced, other_disk):
        held, keep = threading.Event(), keeper.keep
        monkeypatch.setattr(keeper, "keep", lambda entries: held.wait(30.0) and keep(entries))
        thread = Background(keeper, 0.05)
        for number in (1, 2):
            thread.keep([note(number)])
        (path,) = other_disk.iterdir()
        assert path.suffix == ".late"
        assert synced == [path.name] * 2
        assert [each.row[0] for each in read_mirror(path)] == [1, 2]
        assert [each for each in keeper.notices if "is slow" in each] == [
            f"the disk of the journal is slow; rows that wait are in {path} as well"
        ]
        held.set()
        assert thread.stop()
        assert stored(keeper) == [1, 2]
        assert [each.path for each in keeper.spare] == [path]

    def test_what_is_late_and_nowhere_else_ends_the_run(self, keeper, monkeypatch):
        held, keep = threading.Event(), keeper.keep
        monkeypatch.setattr(keeper, "keep", lambda entries: held.wait(30.0) and keep(entries))
        thread = Background(keeper, 0.05)

        def full(self, _entries):
            raise OSError(28, "No space left on device", str(self.path))

        monkeypatch.setattr(Mirror, "append", full)
        with pytest.raises(RecordError, match=r"is not written in time, nor .*\.late"):
            thread.keep([note(1)])
        monkeypatch.undo()
        held.set()
        assert thread.stop()

    def test_a_failure_is_raised_by_the_next_call(self, keeper, monkeypatch):
        def fail(_entries):
            raise RecordError("gone")

        monkeypatch.setattr(keeper, "keep", fail)
        thread = Background(keeper, 30.0)
        with pytest.raises(RecordError, match="gone"):
            thread.keep([note(1)])
        assert thread.stop()
        assert thread.failure is None


class TestStore:
    def test_rows_are_written_all_or_none(self, tmp_path):
        store, _ = new_store(tmp_path)
        wrong = entry("events", (2, 2.0, "INFO", "note"))
        with pytest.raises(sqlite3.Error):
            store.write([note(1), wrong])
        assert stored(store) == []
        store.write([note(1), note(2)])
        store.write([note(3)])
        assert stored(store) == [1, 2, 3]
        store.close()

    def test_rows_that_come_again_are_the_same(self, tmp_path):
        store, _ = new_store(tmp_path)
        for _ in range(2):
            store.write([note(1)])
        assert stored(store) == [1]
        store.close()

    def test_what_is_forgotten(self, tmp_path):
        store, _ = new_store(tmp_path)
        store.write([entry("meta", meta_row("status", "failed"))])
        store.forget(["status", "reason"])
        assert [each.row[0] for each in store.entries() if each.table == "meta"] == ["schema"]
        store.close()

    def test_a_closed_one_has_no_companions(self, tmp_path):
        store, _ = new_store(tmp_path)
        store.write([note(1)])
        store.close()
        assert [path.name for path in tmp_path.iterdir()] == [FILE_NAME]

    def test_where_it_was_made(self, tmp_path):
        store, _ = new_store(tmp_path)
        assert store.loss() == ""
        store.path.unlink()
        assert store.loss() == "removed"
        store.path.write_bytes(b"")
        assert store.loss() == "replaced"
        store.close()


@pytest.mark.parametrize("table", ["meta", "signals", "steps", "telemetry", "events", "files"])
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
    assert (state.good, state.missing, state.first_bad) == (rows - 1, 1, str(wanted).strip("'"))
    assert [name for name, other in found.tables.items() if other.missing] == [table]
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
    if change.startswith("UPDATE"):
        assert recover(tmp_path).copy is not None
    else:
        with pytest.raises(DataError, match="nothing of it is readable"):
            recover(tmp_path)


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


def test_a_second_file_of_another_journal_is_not_believed(tmp_path, other_disk):
    for name in ("mine", "other"):
        folder = tmp_path / name
        folder.mkdir()
        journal = Journal(folder / FILE_NAME, SIGNALS, {})
        journal.event(Event(0.0, "INFO", "note", name))
        content = {path: path.read_bytes() for path in folder.iterdir()}
        journal.close()
        for path, data in content.items():
            path.write_bytes(data)
    forged, _ = elsewhere(tmp_path / "mine" / FILE_NAME)
    file = Mirror(forged, "0123456789abcdef0123456789abcdef")
    file.append([entry("events", (9, 9.0, "INFO", "note", "forged"))])
    file.close()
    with Record(tmp_path / "mine") as record:
        assert "forged" not in record.remark()
        assert record.remark() == ""
    assert recover(tmp_path / "mine").tables["events"].added == 0
    with pytest.raises(ConfigurationError, match="of another journal"):
        recover(tmp_path / "mine", [tmp_path / "other" / MIRROR_NAME])
    # Where the journal has lost its number, the file beside it has it.
    for name in (FILE_NAME, f"{FILE_NAME}-wal", f"{FILE_NAME}-shm"):
        (tmp_path / "mine" / name).unlink(missing_ok=True)
    assert recover(tmp_path / "mine").tables["events"].added == 1
    journal = Journal.reopen(tmp_path / "mine" / RECOVERED_NAME)
    journal.close()


class TestReading:
    def write(self, tmp_path, *entries):
        store, _ = new_store(tmp_path)
        store.write(list(entries))
        store.close()
        return Record(tmp_path)

    def test_a_step_that_is_none_has_a_good_checksum_all_the_same(self, tmp_path):
        row = (0, 0.0, 0.5, "", "", "nonsense", "{}", 1.0, "[]")
        with (
            self.write(tmp_path, entry("steps", row)) as record,
            pytest.raises(DataError, match="is damaged: step 0: "),
        ):
            list(record.step_records())

    def test_ticks_that_are_no_numbers(self, tmp_path):
        row = entry("telemetry", (1, "soon", 0, 2.0))
        with self.write(tmp_path, row) as record, pytest.raises(DataError, match="is damaged: table telemetry: "):
            record.telemetry()

    def test_rows_that_only_a_second_file_has_are_counted_by_their_numbers(self, tmp_path):
        with _unfinished(tmp_path):
            pass
        file = Mirror(tmp_path / MIRROR_NAME)
        file.append([entry("steps", (n, 50.0, 50.5, "", "", "dwell", "{}", 1.0, "[]")) for n in (1, 2, 3)])
        file.close()
        with Record(tmp_path) as record:
            assert record.missing.ranges == {"steps": ((2, 3),)}
            assert "bench recover-journal" in record.remark()

    def test_checksums_of_many_rows_are_those_of_each(self):
        rows = np.array([[1.0, np.nan, -0.0], [np.inf, 2.5, -3.0]])
        assert checksums(rows) == [checksum(tuple(row)) for row in rows.tolist()]
        several = ticks([tuple(map(float, (n, n, 0, n))) for n in range(1, 40)])
        assert [each.payload for each in split([several])] == [ticks([row]).payload for row in several.rows]
        assert several.payload == b"".join(each.payload for each in split([several]))


def _unfinished(tmp_path):
    """Write two steps of a run that did not end."""
    store, _ = new_store(tmp_path)
    store.write([entry("steps", (n, 50.0, 50.5, "", "", "dwell", "{}", 1.0, "[]")) for n in (0, 1)])
    return closing(store)


class TestWritingOn:
    def test_a_run_whose_end_waits_is_not_written_on(self, tmp_path):
        with _unfinished(tmp_path):
            pass
        file = Mirror(tmp_path / MIRROR_NAME)
        file.append([entry("meta", meta_row("status", "completed"))])
        file.close()
        with pytest.raises(ConfigurationError, match=r"a run that has ended, of which rows wait in a second file"):
            take_in(tmp_path)

    def test_what_waits_is_taken_in_and_numbered_on(self, tmp_path):
        with _unfinished(tmp_path):
            pass
        file = Mirror(tmp_path / MIRROR_NAME)
        file.append([entry("steps", (n, 50.0, 50.5, "", "", "dwell", "{}", 1.0, "[]")) for n in (1, 2)])
        file.append([note(1)])
        file.close()
        path, signals, counts, lost = take_in(tmp_path)
        assert (path, signals[0].name) == (tmp_path / FILE_NAME, "force")
        assert counts == {"steps": 3, "telemetry": 0, "events": 1}
        assert lost == {}
        with Record(tmp_path) as record:
            assert len(record.steps()) == 3

    @pytest.mark.parametrize("waits", [True, False])
    def test_one_that_cannot_be_written_on(self, tmp_path, monkeypatch, waits):
        with _unfinished(tmp_path):
            pass
        if waits:
            file = Mirror(tmp_path / MIRROR_NAME)
            file.append([entry("steps", (2, 50.0, 50.5, "", "", "dwell", "{}", 1.0, "[]"))])
            file.close()

        def refuse(*_):
            raise sqlite3.OperationalError("attempt to write a readonly database")

        monkeypatch.setattr(Store, "write" if waits else "forget", refuse)
        with pytest.raises(DataError, match=r"cannot be written on: .*readonly"):
            Journal.reopen(tmp_path)

    def test_the_end_of_one_whose_thread_hangs(self, tmp_path):
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {"rig": "vo2"})
        journal.step(step(0))
        abandon(journal.path, Ending("aborted", "it hangs", {"tec": "safe"}))
        assert not (tmp_path / RESERVE_NAME).exists()
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
    def test_a_journal_of_another_schema_is_refused(self, tmp_path):
        store = Store(tmp_path / FILE_NAME)
        store.create(["force"], [entry("meta", meta_row("schema", 2)), entry("signals", (0, "force", "N", "", 3))])
        store.close()
        with pytest.raises(DataError, match="has schema version 2; this bench reads version 3"):
            recover(tmp_path)

    def test_a_copy_that_cannot_be_written(self, tmp_path):
        with _unfinished(tmp_path):
            pass
        (tmp_path / MIRROR_NAME).unlink(missing_ok=True)
        file = Mirror(tmp_path / MIRROR_NAME)
        file.append([entry("steps", (2, 50.0, 50.5, "", "", "dwell", "{}", 1.0, "[]"))])
        file.close()
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
        with _unfinished(tmp_path):
            pass
        for number in (1, 2):
            add_model(tmp_path, f"film {number}", 5.0, {"unit": "°C"})
        text = (tmp_path / "models" / "film 1.json").read_text(encoding="utf-8")
        assert "°C" in text
        assert json.loads(text)["unit"] == "°C"
        with Record(tmp_path) as record:
            assert list(record.models()) == ["film 1", "film 2"]

    def test_one_that_cannot_be_written(self, tmp_path):
        with _unfinished(tmp_path):
            pass
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


def test_a_model_is_kept_beside_the_journal(tmp_path):
    journal = Journal(tmp_path / FILE_NAME, SIGNALS, {})
    journal.keep_model("film", 3.0, {"order": 21})
    journal.close()
    with Record(tmp_path) as record:
        assert record.models() == {"film": {"order": 21}}


@pytest.mark.parametrize("problem", ["disk I/O error", "database disk image is malformed"])
def test_a_journal_that_cannot_be_opened_is_named(tmp_path, monkeypatch, problem):
    with _unfinished(tmp_path):
        pass

    def refuse(*_):
        raise sqlite3.OperationalError(problem)

    monkeypatch.setattr(opening, "_connected", refuse)
    with pytest.raises(DataError, match=f"is not a readable journal: {problem}"):
        Record(tmp_path)


def test_readers_are_waited_for_at_the_beginning_and_nobody_later(tmp_path, monkeypatch):
    waits, create, forget = [], Store.create, Store.forget

    def wait_of(store):
        return store._db.execute("PRAGMA busy_timeout").fetchone()[0]

    monkeypatch.setattr(Store, "create", lambda self, *a: waits.append(wait_of(self)) or create(self, *a))
    monkeypatch.setattr(Store, "forget", lambda self, *a: waits.append(wait_of(self)) or forget(self, *a))
    for opened in (lambda: Journal(tmp_path / FILE_NAME, SIGNALS, {}), lambda: Journal.reopen(tmp_path)):
        journal = opened()
        assert wait_of(journal._keeper.store) == 0
        journal.close()
    assert waits == [10_000, 10_000]
