"""A journal that cannot be written, is damaged or is removed: no row that it has acknowledged is lost."""

import json
import os
import shutil
import signal
import sqlite3
import sys
import tempfile
import threading
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest

from bench.base import ConfigurationError, DataError, RecordError, Stopwatch
from bench.devices import Settled, Signal
from bench.record import (
    FILE_NAME,
    NAME as MIRROR_NAME,
    RECOVERED_NAME,
    Event,
    Journal,
    Record,
    StepRecord,
    background,
    keeping,
    opening,
    recover,
    store,
)
from bench.record.mirror import elsewhere, read_mirror
from bench.record.rows import split
from bench.record.store import Store
from bench.rig import Holder, Locks

SIGNALS = (Signal("tec_temperature", "°C", "object temperature"), Signal("force", "N", "force", 4))
STATUS = {"status": "completed", "reason": "", "finished": 9.0, "safe_state": {"tec": "safe"}}

pytestmark = pytest.mark.usefixtures("other_disk")


@pytest.fixture
def other_disk(tmp_path_factory, monkeypatch):
    """A folder for temporary files of the test's own."""
    folder = tmp_path_factory.mktemp("temporary")
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.fixture(params=[None, 30.0], ids=["caller", "background"])
def journal(request, tmp_path):
    """A journal that the caller writes, and one that a thread of its own writes."""
    made = Journal(tmp_path / FILE_NAME, SIGNALS, {"rig": "vo2"}, {"rig.toml": b"[rig]"}, patience=request.param)
    yield made
    made.close()


def add(journal, count=1):
    """Record steps, each with a tick and an event; return how many there are now."""
    for step in range(journal.steps, journal.steps + count):
        journal.telemetry(float(step), step, (1.0, float(step)))
        journal.event(Event(float(step), "INFO", "note", f"step {step}"))
        journal.step(StepRecord(step, step, step + 0.5, "", "", Settled.DWELL, {"tec": 20.0}, (20.0, float(step))))
    return journal.steps


def log_of(folder):
    """Return the write-ahead log of the journal in a folder."""
    return folder / f"{FILE_NAME}-wal"


@contextmanager
def locked(path):
    """Have another program write into a journal for as long as it likes."""
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        yield
        other.execute("ROLLBACK")


def assert_whole(path, count, status="completed"):
    with Record(path) as run:
        np.testing.assert_array_equal(run.steps()["force"], np.arange(count))
        np.testing.assert_array_equal(run.telemetry()["force"], np.arange(count))
        assert [event.text for event in run.events() if event.kind == "note"] == [f"step {i}" for i in range(count)]
        assert run.files() == {"rig.toml": b"[rig]"}
        assert run.status == status


def files_of(folder):
    return sorted(path.name for path in folder.iterdir())


def overwrite_pages(path, content=b"\xa5"):
    """Overwrite the middle of a file, as a failing disk or another program does."""
    size = path.stat().st_size
    with path.open("r+b") as file:
        file.seek(size // 2 // 4096 * 4096)
        file.write(content * 8192)


class TestAnotherProgramWrites:
    def test_rows_wait_in_the_second_file(self, journal, tmp_path):
        add(journal, 2)
        with locked(journal.path):
            waited = Stopwatch()
            add(journal, 20)
            assert waited.seconds() < 60.0
            with Record(tmp_path) as run:
                assert len(run.steps()) == 2
            # What is acknowledged is in a file.
            steps = [each.row[0] for each in read_mirror(tmp_path / MIRROR_NAME) if each.table == "steps"]
            assert steps == list(range(22))
        assert "locked" in "".join(journal.take_notices())
        journal.finish(**STATUS)
        journal.close()
        assert_whole(tmp_path, 22)
        assert files_of(tmp_path) == [FILE_NAME]

    def test_they_go_into_the_journal_while_the_run_goes_on(self, journal, tmp_path):
        with locked(journal.path):
            add(journal, 3)
        waited = Stopwatch()
        found = 0
        while found < 3:
            assert waited.seconds() < 60.0
            count = add(journal)
            with Record(tmp_path) as run:
                found = len(run.steps())
        assert any("can be written again" in text for text in journal.take_notices())
        journal.finish(**STATUS)
        journal.close()
        assert_whole(tmp_path, count)

    def test_a_run_that_ends_meanwhile_is_not_completed(self, journal, tmp_path, monkeypatch):
        monkeypatch.setattr(keeping, "_LAST_WAIT", 0.05)
        with locked(journal.path):
            add(journal, 3)
            with pytest.raises(RecordError, match="bench recover-journal"):
                journal.finish(**STATUS)
            with Record(tmp_path) as run:
                assert run.status == "unfinished"
            journal.close()
        found = recover(tmp_path)
        assert found.is_complete
        assert_whole(found.copy, 3, "failed")

    def test_a_run_that_died_meanwhile_is_written_on(self, tmp_path):
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {}, {"rig.toml": b"[rig]"})
        with locked(journal.path):
            add(journal, 3)
            copy = shutil.copytree(tmp_path, tmp_path / "died")
        journal.close()
        with Record(copy) as run:
            assert len(run.steps()) == 0
            assert run.missing.ranges == {"steps": ((0, 2),), "telemetry": ((1, 3),), "events": ((1, 3),)}
        with Locks(Holder.of_this_process("heater", "a run")) as locks:
            locks.take_folder(copy)
            # Of a run that goes on every row is there.
            with Record(copy) as run:
                assert run.remark() == ""
        journal = Journal.reopen(copy)
        assert (journal.steps, journal.ticks) == (3, 3)
        add(journal, 2)
        journal.finish(**STATUS)
        journal.close()
        assert_whole(copy, 5)


def test_a_copy_without_its_second_file_is_written_on_and_rescued(tmp_path, other_disk):
    journal = Journal(tmp_path / FILE_NAME, SIGNALS, {}, {"rig.toml": b"[rig]"})
    add(journal, 3)
    journal.close()
    assert files_of(tmp_path) == [FILE_NAME]
    journal = Journal.reopen(tmp_path)
    add(journal, 2)
    shutil.rmtree(tmp_path)
    with pytest.raises(RecordError, match="was removed"):
        add(journal, 1)
    journal.close()
    with Record(journal.path) as run:
        assert run.steps()["step"].tolist()[:5] == list(range(5))
        assert run.files() == {"rig.toml": b"[rig]"}
    assert journal.path.is_relative_to(other_disk)


class TestNoSpace:
    @pytest.fixture
    def full(self):
        """Have no file of this process grow beyond a size."""
        resource = pytest.importorskip("resource")
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        former = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)

        def limit(size):
            resource.setrlimit(resource.RLIMIT_FSIZE, (limits[0] if size is None else size, limits[1]))

        yield limit
        limit(None)
        signal.signal(signal.SIGXFSZ, former)

    def test_rows_wait_on_another_disk(self, journal, tmp_path, full):
        add(journal, 40)
        full((tmp_path / MIRROR_NAME).stat().st_size)
        count = add(journal, 20)
        beside, _ = elsewhere(tmp_path / FILE_NAME)
        assert {each.row[0] for each in read_mirror(beside) if each.table == "steps"} >= set(range(count - 20, count))
        full(None)
        journal.finish(**STATUS)
        journal.close()
        assert_whole(tmp_path, count)
        assert files_of(tmp_path) == [FILE_NAME]
        assert not beside.exists()

    def test_one_that_stays_full_is_not_completed(self, journal, tmp_path, full):
        add(journal, 3)
        full(4096)
        count = add(journal, 3)
        with pytest.raises(RecordError, match="is not whole"):
            journal.finish(**STATUS)
        journal.close()
        full(None)
        found = recover(tmp_path)
        assert found.is_complete
        assert_whole(found.copy, count, "failed")

    def test_one_without_space_for_the_log_is_written_all_the_same(self, tmp_path, full):
        full(1 << 20)
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {}, {"rig.toml": b"[rig]"})
        assert log_of(tmp_path).stat().st_size < 1 << 17
        count = add(journal, 5)
        full(None)
        journal.finish(**STATUS)
        journal.close()
        assert_whole(tmp_path, count)

    def test_the_log_takes_no_space_of_a_disk_that_is_nearly_full(self, tmp_path, monkeypatch):
        usage = shutil.disk_usage(tmp_path)
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=store._ROOM * store._LOG_SIZE // 2))
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {})
        assert log_of(tmp_path).stat().st_size < 1 << 17
        journal.close()

    def test_space_is_kept_for_the_end(self, journal, tmp_path):
        reserve = tmp_path / keeping.RESERVE_NAME
        assert reserve.stat().st_size >= 1 << 18
        journal.make_room()
        assert not reserve.exists()

    def test_recordings_stop_first(self, journal, monkeypatch):
        stopped = []
        journal.when_short = lambda: stopped.append(journal.steps)
        monkeypatch.setattr(keeping, "_BETWEEN_LOOKS", 0.0)
        add(journal, 3)
        assert stopped == []
        monkeypatch.setattr(keeping, "_SHORT", 1 << 62)
        monkeypatch.setattr(keeping, "_SHORT_PART", 1.0)
        add(journal, 3)
        assert len(stopped) == 1
        assert any("nearly full" in text for text in journal.take_notices())


class TestRemovedAndDamaged:
    @pytest.mark.parametrize("how", ["removed", "replaced"])
    def test_one_that_is_gone_is_written_anew(self, journal, tmp_path, other_disk, how):
        count = add(journal, 5)
        shutil.rmtree(tmp_path)
        if how == "replaced":
            tmp_path.mkdir()
            journal.path.write_text("another file")
        with pytest.raises(
            RecordError, match=rf"was {how} while the run went on; everything so far is in {other_disk}"
        ):
            add(journal, 1)
        journal.make_room()
        journal.event(Event(9.0, "ERROR", "error", "the journal was removed"))
        journal.finish(**{**STATUS, "status": "failed"})
        assert journal.path.is_relative_to(other_disk)
        with Record(journal.path) as run:
            assert run.steps()["step"].tolist()[:count] == list(range(count))
            assert run.status == "failed"
            assert run.meta["safe_state"] == {"tec": "safe"}

    def test_one_that_cannot_be_written_anew_says_so(self, journal, tmp_path, monkeypatch):
        add(journal, 5)
        shutil.rmtree(tmp_path)
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
        with pytest.raises(RecordError, match=r"was removed while the run went on; .* could not be written anew"):
            add(journal, 1)

    @pytest.mark.parametrize("content", [b"\xa5", b"\0"], ids=["noise", "zeros"])
    def test_overwritten_pages_are_noticed_at_the_end(self, journal, tmp_path, content):
        count = add(journal, 300)
        journal.make_room()
        journal._keeper.fold_in(anyway=True)
        overwrite_pages(tmp_path / FILE_NAME, content)
        with pytest.raises(RecordError, match="is not whole"):
            journal.finish(**STATUS)
        journal.close()
        found = recover(tmp_path)
        assert found.is_complete
        assert found.problem
        assert found.copy == tmp_path / RECOVERED_NAME
        assert_whole(found.copy, count, "failed")

    def test_rows_that_are_missing_are_noticed_at_the_end(self, journal, tmp_path):
        add(journal, 5)
        with closing(sqlite3.connect(tmp_path / FILE_NAME)) as db, db:
            db.execute("DELETE FROM steps WHERE step = 2")
        with pytest.raises(RecordError, match="table steps has 4 rows of 5"):
            journal.finish(**STATUS)
        with Record(tmp_path) as run:
            assert run.status == "failed"


class TestSlowDisk:
    def test_what_is_late_is_durable_elsewhere(self, tmp_path, monkeypatch):
        gate = threading.Event()
        write = Store.write

        def stall(store, entries):
            gate.wait(60.0)
            write(store, entries)

        monkeypatch.setattr(Store, "write", stall)
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {}, {"rig.toml": b"[rig]"}, patience=0.01)
        count = add(journal, 4)
        _, late = elsewhere(journal.path)
        assert [each.row[0] for each in read_mirror(late) if each.table == "steps"] == list(range(count))
        assert any("is slow" in text for text in journal.take_notices())
        gate.set()
        journal.finish(**STATUS)
        journal.close()
        assert_whole(tmp_path, count)
        assert not late.exists()

    def test_ticks_do_not_wait_for_it(self, tmp_path, monkeypatch):
        gate = threading.Event()
        write = Store.write
        monkeypatch.setattr(Store, "write", lambda store, entries: gate.wait(60.0) and write(store, entries))
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {}, patience=60.0)
        waited = Stopwatch()
        for tick in range(1000):
            journal.telemetry(0.001 * tick, 0, (1.0, float(tick)))
        assert waited.seconds() < 30.0
        gate.set()
        journal.finish(**STATUS)
        journal.close()
        with Record(tmp_path) as run:
            np.testing.assert_array_equal(run.telemetry()["force"], np.arange(1000))

    def test_a_disk_that_does_not_answer_ends_the_run(self, tmp_path, monkeypatch):
        gate = threading.Event()
        write = Store.write
        monkeypatch.setattr(Store, "write", lambda store, entries: gate.wait(60.0) and write(store, entries))
        monkeypatch.setattr(background, "_LAST_WAIT", 0.05)
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {}, patience=0.01)
        add(journal, 1)
        with pytest.raises(RecordError, match="does not answer"):
            journal.finish(**STATUS)
        journal.close()
        gate.set()
        journal._background._thread.join(60.0)
        monkeypatch.undo()
        journal.close()


class TestFoldingIn:
    def test_a_copy_without_its_companion_lacks_little(self, journal, tmp_path, monkeypatch):
        monkeypatch.setattr(keeping, "_BETWEEN_FOLDS", 0.0)
        monkeypatch.setattr(keeping, "_BETWEEN_LOOKS", 0.0)
        count = add(journal, 5)
        journal.make_room()
        (tmp_path / "copy").mkdir()
        shutil.copyfile(tmp_path / FILE_NAME, tmp_path / "copy" / FILE_NAME)
        with Record(tmp_path / "copy") as run:
            assert len(run.steps()) >= count - 1


class TestReadOnlyMedium:
    @pytest.fixture(autouse=True)
    def _is_read_only(self, monkeypatch):
        monkeypatch.setattr(opening.os, "access", lambda *_: False)

    def test_a_closed_journal(self, journal, tmp_path):
        count = add(journal, 3)
        journal.finish(**STATUS)
        journal.close()
        before = files_of(tmp_path)
        assert_whole(tmp_path, count)
        assert files_of(tmp_path) == before

    def test_one_with_a_companion_is_read_from_a_copy(self, tmp_path, other_disk):
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {}, {"rig.toml": b"[rig]"})
        count = add(journal, 3)
        with Record(tmp_path) as run:
            assert len(run.steps()) == count
            assert str(other_disk) in run.remark()
            assert len(files_of(other_disk)) == 1
        assert files_of(other_disk) == []
        journal.close()


def test_one_whose_process_died_while_it_was_closed_is_read_from_a_copy(tmp_path, other_disk):
    journal = Journal(tmp_path / FILE_NAME, SIGNALS, {}, {"rig.toml": b"[rig]"})
    count = add(journal, 3)
    journal.close()
    with closing(sqlite3.connect(tmp_path / FILE_NAME, isolation_level=None)) as db:
        # What SQLite would undo stands in a companion while it changes the file.
        db.execute("PRAGMA cache_size=1")
        db.execute("BEGIN IMMEDIATE")
        db.execute("UPDATE steps SET label = hex(zeroblob(20000))")
        copy = shutil.copytree(tmp_path, other_disk / "died")
        db.execute("ROLLBACK")
    with Record(copy) as run:
        assert "was not closed" in run.remark()
        assert len(run.steps()) == count
    assert f"{FILE_NAME}-journal" in files_of(copy)


@pytest.mark.skipif(sys.platform == "win32", reason="forks")
@pytest.mark.parametrize("patience", [None, 30.0], ids=["caller", "background"])
def test_kills_at_random_moments_lose_no_acknowledged_step(tmp_path, patience):
    generator = np.random.default_rng(7)
    for trial in range(5):
        folder = tmp_path / str(trial)
        folder.mkdir()
        reader, writer = os.pipe()
        child = os.fork()
        if child == 0:
            try:
                journal = Journal(folder / FILE_NAME, SIGNALS, {}, {"rig.toml": b"[rig]"}, patience=patience)
                while True:
                    os.write(writer, add(journal).to_bytes(4, "big"))
            finally:
                os._exit(1)
        os.close(writer)
        wanted = int(generator.integers(1, 60))
        told = b""
        while len(told) < 4 * wanted:
            told += os.read(reader, 4 * wanted - len(told))
        os.kill(child, signal.SIGKILL)
        while more := os.read(reader, 4096):
            told += more
        os.close(reader)
        os.waitpid(child, 0)
        acknowledged = int.from_bytes(told[-4:], "big")
        with Record(folder) as run:
            assert run.steps()["step"].tolist()[:acknowledged] == list(range(acknowledged))
            assert len(run.steps()) <= acknowledged + 1
        journal = Journal.reopen(folder)
        add(journal, 2)
        count = journal.steps
        journal.finish(**STATUS)
        journal.close()
        with Record(folder) as run:
            assert run.status == "completed"
            assert run.steps()["step"].tolist() == list(range(count))


class TestRecovering:
    @pytest.fixture
    def damaged(self, tmp_path):
        """A journal without a second file, of which some pages are overwritten."""
        journal = Journal(tmp_path / FILE_NAME, SIGNALS, {}, {"rig.toml": b"[rig]"})
        add(journal, 400)
        journal.finish(**STATUS)
        journal.close()
        overwrite_pages(tmp_path / FILE_NAME)
        return tmp_path / FILE_NAME

    def test_what_is_lost_is_counted_and_the_rest_is_kept(self, bench, damaged, tmp_path):
        before = damaged.read_bytes()
        code, out, err = bench("recover-journal", tmp_path, "--json", tmp_path / "found.json")
        assert (code, err) == (8, "")
        assert "repaired copy" in out
        found = json.loads((tmp_path / "found.json").read_text())
        assert damaged.read_bytes() == before
        assert not found["is_complete"]
        # As the copy says; the journal itself says that it was completed.
        assert found["status"] == "failed"
        lost = 0
        with Record(Path(found["copy"])) as run:
            rows = {"steps": len(run.steps()), "telemetry": len(run.telemetry()), "events": len(run.events())}
            for table, count in rows.items():
                state = found["tables"][table]
                assert state["good"] == count == 400 - state["missing"]
                assert bool(state["first_bad"]) == bool(state["missing"])
                lost += state["missing"]
            assert run.status == "failed"
            assert run.meta["recovered"]["from"] == str(damaged)
        assert 0 < lost < 600
        code, _, err = bench("recover-journal", tmp_path)
        assert code == 2
        assert "exists already" in err

    def test_a_flipped_bit_is_one_row(self, tmp_path, journal):
        add(journal, 50)
        journal.finish(**STATUS)
        journal.close()
        path = tmp_path / FILE_NAME
        content = bytearray(path.read_bytes())
        content[content.rindex(b"step 17") + 6] ^= 1
        path.write_bytes(bytes(content))
        with Record(path) as run, pytest.raises(DataError, match=r"table events, row 18: .*recover-journal"):
            run.events()
        found = recover(path)
        assert found.tables["events"].first_bad == "18"
        assert [state.missing for state in found.tables.values()].count(0) == 5

    def test_a_whole_one_is_left_alone(self, bench, tmp_path, journal):
        add(journal, 3)
        journal.finish(**STATUS)
        journal.close()
        code, out, _ = bench("recover-journal", tmp_path / FILE_NAME)
        assert code == 0
        assert "the journal is whole" in out
        assert files_of(tmp_path) == [FILE_NAME]

    def test_from_the_second_file_alone(self, tmp_path, journal):
        count = add(journal, 5)
        second = tmp_path / "elsewhere.mirror"
        shutil.copyfile(tmp_path / MIRROR_NAME, second)
        journal.close()
        (tmp_path / FILE_NAME).write_bytes(b"nothing")
        found = recover(tmp_path, [second])
        assert found.is_complete
        assert_whole(found.copy, count, "unfinished")

    def test_what_is_no_journal(self, bench, tmp_path):
        code, _, err = bench("recover-journal", tmp_path)
        assert (code, err.count("\n")) == (3, 1)
        (tmp_path / FILE_NAME).write_bytes(b"nothing")
        code, _, err = bench("recover-journal", tmp_path)
        assert code == 3
        assert "nothing of it is readable" in err
        code, _, err = bench("recover-journal", tmp_path, "--second", tmp_path / "absent")
        assert code == 2


def test_damage_to_the_second_file_leaves_the_other_rows(tmp_path, journal):
    add(journal, 50)
    path = tmp_path / MIRROR_NAME
    whole = list(split(read_mirror(path)))
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 16
    path.write_bytes(bytes(content[:-5]))
    left = list(split(read_mirror(path)))
    assert len(whole) - 3 <= len(left) < len(whole)
    assert [entry for entry in whole if entry in left] == left


def test_a_journal_is_not_made_in_a_folder_that_is_missing(tmp_path):
    with pytest.raises(ConfigurationError, match="cannot be made"):
        Journal(tmp_path / "absent" / FILE_NAME, SIGNALS, {})
