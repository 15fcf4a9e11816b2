"""A journal that cannot be written, is damaged or is removed: no row that it has acknowledged is lost."""

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import threading
from collections import namedtuple
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from bench.base import ConfigurationError, IncompleteRecordWarning, RecordError, Stopwatch
from bench.devices import Settled, Signal
from bench.record import (
    FILE_NAME,
    NAME as SECOND_NAME,
    Event,
    Journal,
    Record,
    StepRecord,
    keeping,
    opening,
    recover,
)
from bench.record.second_file import places, read_second_file
from bench.record.store import Store
from bench.rig import Holder, Locks

SIGNALS = (Signal("tec_temperature", "°C", "object temperature"), Signal("force", "N", "force", 4))
STATUS = {"status": "completed", "reason": "", "finished": 9.0, "safe_state": {"tec": "safe"}}

pytestmark = pytest.mark.usefixtures("other_disk")


def new_journal(folder, patience=None):
    return Journal(folder / FILE_NAME, SIGNALS, {"rig": "vo2"}, {"rig.toml": b"[rig]"}, patience=patience)


@pytest.fixture(params=[None, 30.0], ids=["caller", "background"])
def journal(request, tmp_path):
    """A journal that the caller writes, and one that a thread of its own writes."""
    made = new_journal(tmp_path, request.param)
    yield made
    made.close()


def add(journal, count=1):
    """Record steps, each with a tick and an event; return how many there are now."""
    for step in range(journal.steps, journal.steps + count):
        journal.telemetry(float(step), step, (1.0, float(step)))
        journal.event(Event(float(step), "INFO", "note", f"step {step}"))
        journal.step(StepRecord(step, step, step + 0.5, "", "", Settled.DWELL, {"tec": 20.0}, (20.0, float(step))))
    return journal.steps


def steps_in(second):
    """Return the numbers of the steps in a second file."""
    return [row.columns[0] for row in read_second_file(second) if row.table == "steps"]


@contextmanager
def locked(path):
    """Have another program write into a journal for as long as it likes."""
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        yield
        other.execute("ROLLBACK")


@contextmanager
def failing(problem="disk I/O error"):
    """Have SQLite take no row."""

    def write(_store, _rows):
        raise sqlite3.OperationalError(problem)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Store, "write", write)
        yield


def assert_whole(path, count, status="completed"):
    with Record(path) as run:
        np.testing.assert_array_equal(run.steps()["force"], np.arange(count))
        np.testing.assert_array_equal(run.telemetry()["force"], np.arange(count))
        assert [event.text for event in run.events() if event.kind == "note"] == [f"step {i}" for i in range(count)]
        assert run.files() == {"rig.toml": b"[rig]"}
        assert run.status == status


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


def overwrite_pages(path, content=b"\xa5"):
    """Overwrite the middle of a file, as a failing disk or another program does."""
    size = path.stat().st_size
    with path.open("r+b") as file:
        file.seek(size // 2 // 4096 * 4096)
        file.write(content * 8192)


def mount(stack, folder, *what):
    """Mount something on a folder until a stack ends; skip the test where nobody may."""
    if subprocess.run(["mount", *what, str(folder)], capture_output=True, check=False).returncode:
        pytest.skip("nothing may be mounted")
    stack.callback(subprocess.run, ["umount", "-l", str(folder)], check=True)


def test_a_healthy_run_makes_no_second_file(journal, tmp_path, other_disk):
    for _ in range(30):
        count = add(journal)
        assert not {*names_in(tmp_path)} - {FILE_NAME, f"{FILE_NAME}-wal", f"{FILE_NAME}-shm"}
    journal.finish(**STATUS)
    journal.close()
    assert (names_in(tmp_path), names_in(other_disk)) == ([FILE_NAME], [])
    assert_whole(tmp_path, count)


class TestAnotherProgramWrites:
    def test_rows_wait_in_the_second_file(self, journal, tmp_path):
        add(journal, 2)
        with locked(journal.path):
            add(journal, 20)
            assert steps_in(tmp_path / SECOND_NAME) == list(range(2, 22))
            assert (tmp_path / SECOND_NAME).stat().st_mode & 0o777 == 0o600
        assert "locked" in "".join(journal.take_notices())
        journal.finish(**STATUS)
        journal.close()
        assert_whole(tmp_path, 22)
        assert names_in(tmp_path) == [FILE_NAME]

    def test_they_go_into_the_journal_while_the_run_goes_on(self, journal, tmp_path):
        with locked(journal.path):
            add(journal, 3)
        waited = Stopwatch()
        while (tmp_path / SECOND_NAME).exists():
            assert waited.seconds() < 60.0
            count = add(journal)
        assert any("can be written again" in text for text in journal.take_notices())
        with closing(sqlite3.connect(journal.path)) as db:
            assert db.execute("SELECT count(*) FROM steps").fetchone() == (count,)
        journal.finish(**STATUS)
        journal.close()
        assert_whole(tmp_path, count)

    def test_a_run_that_ends_meanwhile_is_not_completed(self, journal, tmp_path, monkeypatch):
        monkeypatch.setattr(keeping, "OTHERS", 0.05)
        with locked(journal.path):
            add(journal, 3)
            with pytest.raises(RecordError, match=f"{SECOND_NAME}; `bench runs repair"):
                journal.finish(**STATUS)
            journal.close()
        with pytest.warns(IncompleteRecordWarning, match="its second file"):
            assert_whole(tmp_path, 3, "failed")
        found = recover(tmp_path)
        assert found.is_complete
        assert [found.tables[table].added for table in ("steps", "telemetry", "events")] == [3, 3, 3]
        assert_whole(found.copy, 3, "failed")

    def test_a_run_that_died_meanwhile_is_read_whole_and_written_on(self, tmp_path):
        journal = new_journal(tmp_path)
        with locked(journal.path):
            add(journal, 3)
            copy = shutil.copytree(tmp_path, tmp_path / "died")
        journal.close()
        before = (copy / FILE_NAME).read_bytes()
        with pytest.warns(IncompleteRecordWarning, match="lacks 9 rows that its second file"):
            assert_whole(copy, 3, "unfinished")
        assert (copy / FILE_NAME).read_bytes() == before
        with Locks(Holder.of_this_process("heater", "a run")) as locks:
            locks.take_folder(copy)
            # Of a run that goes on the journal alone is read.
            with Record(copy) as run:
                assert (run.remark(), len(run.steps())) == ("", 0)
            # As `bench resume` does.
            journal = Journal.reopen(copy)
        assert not (copy / SECOND_NAME).exists()
        assert (journal.steps, journal.ticks) == (3, 3)
        add(journal, 2)
        journal.finish(**STATUS)
        journal.close()
        assert_whole(copy, 5)

    def test_ticks_alone_wait_there_too(self, journal, tmp_path):
        waited = Stopwatch()
        with locked(journal.path):
            tick = 0
            while not [row for row in read_second_file(tmp_path / SECOND_NAME) if row.table == "telemetry"]:
                assert waited.seconds() < 60.0
                journal.telemetry(float(tick), 0, (1.0, float(tick)))
                tick += 1


class TestADiskThatTakesNothing:
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

    def test_rows_wait_beside_and_then_elsewhere(self, journal, tmp_path, monkeypatch):
        add(journal, 2)
        beside, elsewhere = places(journal.path)
        with failing():
            add(journal, 2)
            assert steps_in(beside) == [2, 3]
            # A second file that somebody has removed is made again, with every row that waits.
            beside.unlink()
            add(journal, 1)
            assert steps_in(beside) == [2, 3, 4]
            write = os.write
            inode = beside.stat().st_ino

            def half(file, data):
                return write(file, data[: len(data) // 2] if os.fstat(file).st_ino == inode else data)

            monkeypatch.setattr(os, "write", half)
            add(journal, 1)
            assert (beside.exists(), steps_in(elsewhere)) == (False, [2, 3, 4, 5])
            assert any(str(elsewhere) in text for text in journal.take_notices())
        journal.finish(**STATUS)
        journal.close()
        assert_whole(tmp_path, 6)
        assert not elsewhere.exists()

    def test_a_full_disk_that_stays_full_is_not_completed(self, journal, tmp_path, full):
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

    @pytest.mark.skipif(sys.platform != "linux" or os.geteuid() != 0, reason="mounts")
    @pytest.mark.parametrize("how", ["full", "read-only"])
    def test_a_disk_of_its_own(self, tmp_path, how):
        disk = tmp_path / "disk"
        disk.mkdir()
        with ExitStack() as mounted:
            if how == "full":
                mount(mounted, disk, "-t", "tmpfs", "-o", "size=1m", "tmpfs")
            journal = new_journal(disk, 30.0)
            add(journal, 3)
            if how == "full":
                with suppress(OSError), (disk / "filling").open("wb", buffering=0) as file:
                    while True:
                        file.write(bytes(4096))
                count = add(journal, 60)
                (disk / "filling").unlink()
            else:
                with ExitStack() as while_it_lasts, Path(__file__).open("rb") as broken:
                    # What is open already could be written on.
                    for entry in Path("/proc/self/fd").iterdir():
                        if os.path.realpath(entry).startswith(str(disk)):
                            os.dup2(broken.fileno(), int(entry.name))
                    mount(while_it_lasts, disk, "--bind", str(disk))
                    subprocess.run(["mount", "-o", "remount,bind,ro", str(disk)], check=True)
                    count = add(journal, 3)
            assert {*range(max(5, count - 20), count)} <= {*steps_in(places(journal.path)[1])}
            journal.finish(**STATUS)
            journal.close()
            assert_whole(disk, count)

    def test_rows_that_are_nowhere_end_the_run(self, journal, tmp_path, monkeypatch):
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
        (tmp_path / SECOND_NAME).mkdir()
        with (
            failing(),
            pytest.raises(RecordError, match="cannot be written: disk I/O error; its second file neither"),
        ):
            add(journal, 1)

    def test_what_is_no_fault_of_the_disk_is_raised(self, journal):
        with pytest.raises((TypeError, ValueError, sqlite3.Error)):
            journal.event(Event(0.0, "INFO", "note", b"no text"))
        add(journal, 1)

    def test_recordings_stop_first(self, journal, monkeypatch):
        stopped = []
        journal.when_short = lambda: stopped.append(journal.steps)
        monkeypatch.setattr(keeping, "_BETWEEN_LOOKS", 0.0)
        usage = namedtuple("usage", "total used free")
        free = [64 << 20]
        monkeypatch.setattr(keeping.shutil, "disk_usage", lambda _: usage(1 << 40, 0, free[0]))
        add(journal, 3)
        assert stopped == []
        free[0] -= 1
        add(journal, 3)
        assert len(stopped) == 1
        assert any("nearly full" in text for text in journal.take_notices())


class TestRemovedAndDamaged:
    @pytest.mark.parametrize(("how", "waits"), [("folder", True), ("file", False), ("replaced", True)])
    def test_one_that_is_gone_is_in_the_second_file(self, journal, tmp_path, other_disk, how, waits):
        count = add(journal, 5)
        if waits:
            with failing("database is locked"):
                count = add(journal, 1)
        if how == "folder":
            shutil.rmtree(tmp_path)
        else:
            for path in tmp_path.glob(f"{FILE_NAME}*"):
                path.unlink()
        if how == "replaced":
            journal.path.write_text("another file")
        expected = places(journal.path)[how == "folder"]
        with pytest.raises(RecordError, match=f"while the run went on; everything so far is in {expected}"):
            add(journal, 10_000)
        count = journal.steps
        journal.event(Event(9.0, "ERROR", "error", "the journal was removed"))
        with pytest.raises(RecordError, match="is not whole: it was re"):
            journal.finish(**{**STATUS, "status": "failed"})
        journal.close()
        found = recover(tmp_path, out=other_disk / "copy.sqlite")
        assert found.is_complete
        with Record(found.copy) as run:
            assert run.steps()["step"].tolist()[:count] == list(range(count))
            assert (run.status, run.meta["safe_state"]) == ("failed", {"tec": "safe"})
            assert run.events()[-1].text == "the journal was removed"
            assert run.files() == {"rig.toml": b"[rig]"}

    @pytest.mark.parametrize("content", [b"\xa5", b"\0"], ids=["noise", "zeros"])
    def test_overwritten_pages_are_noticed_at_the_end(self, journal, tmp_path, content):
        add(journal, 300)
        with closing(sqlite3.connect(tmp_path / FILE_NAME)) as db:
            db.execute("PRAGMA wal_checkpoint(FULL)").fetchall()
        overwrite_pages(tmp_path / FILE_NAME, content)
        with pytest.raises(RecordError, match="is not whole"):
            journal.finish(**STATUS)
        journal.close()

    def test_rows_that_are_missing_are_noticed_at_the_end(self, journal, tmp_path):
        add(journal, 5)
        with closing(sqlite3.connect(tmp_path / FILE_NAME)) as db, db:
            db.execute("DELETE FROM steps WHERE step = 2")
        with pytest.raises(RecordError, match="table steps has 4 rows of 5"):
            journal.finish(**STATUS)
        with pytest.warns(IncompleteRecordWarning), Record(tmp_path) as run:
            assert run.status == "failed"


class TestSlowDisk:
    @pytest.fixture
    def gate(self, monkeypatch):
        """Have the disk answer once this is set."""
        gate, write = threading.Event(), Store.write
        monkeypatch.setattr(Store, "write", lambda store, rows: gate.wait(60.0) and write(store, rows))
        yield gate
        gate.set()

    def test_what_is_late_is_durable_elsewhere(self, gate, tmp_path):
        journal = new_journal(tmp_path, 0.01)
        count = add(journal, 4)
        beside, elsewhere = places(journal.path)
        assert (steps_in(elsewhere), beside.exists()) == (list(range(count)), False)
        assert [text for text in journal.take_notices() if "does not answer" in text]
        gate.set()
        journal.finish(**STATUS)
        journal.close()
        assert_whole(tmp_path, count)
        assert not elsewhere.exists()

    def test_ticks_do_not_wait_for_it(self, gate, tmp_path):
        journal = new_journal(tmp_path, 60.0)
        waited = Stopwatch()
        for tick in range(1000):
            journal.telemetry(0.001 * tick, 0, (1.0, float(tick)))
        assert waited.seconds() < 30.0
        gate.set()
        journal.finish(**STATUS)
        journal.close()
        with Record(tmp_path) as run:
            np.testing.assert_array_equal(run.telemetry()["force"], np.arange(1000))

    def test_a_single_tick_waits_for_no_other_row(self, tmp_path, monkeypatch):
        written, write = threading.Event(), Store.write
        monkeypatch.setattr(Store, "write", lambda store, rows: (write(store, rows), written.set()))
        with closing(new_journal(tmp_path, 60.0)) as journal:
            journal.telemetry(0.0, 0, (1.0, 2.0))
            assert written.wait(60.0)

    def test_a_disk_that_does_not_answer_ends_the_run(self, gate, tmp_path, monkeypatch):
        monkeypatch.setattr(keeping, "_LAST_WAIT", 0.05)
        before = {*threading.enumerate()}
        journal = new_journal(tmp_path, 0.01)
        count = add(journal, 1)
        with pytest.raises(RecordError, match="does not answer"):
            journal.finish(**STATUS)
        journal.close()
        found = recover(tmp_path)
        assert_whole(found.copy, count, "failed")
        gate.set()
        waited = Stopwatch()
        while {*threading.enumerate()} - before:
            assert waited.seconds() < 60.0
        journal.close()


def test_a_copy_without_its_companion_lacks_little(journal, tmp_path, monkeypatch):
    monkeypatch.setattr(keeping, "_BETWEEN_LOOKS", 0.0)
    count = add(journal, 5)
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
        before = names_in(tmp_path)
        assert_whole(tmp_path, count)
        assert names_in(tmp_path) == before

    def test_one_with_a_companion_is_read_from_a_copy(self, tmp_path, other_disk):
        journal = new_journal(tmp_path)
        count = add(journal, 3)
        with Record(tmp_path) as run:
            assert len(run.steps()) == count
            assert str(other_disk) in run.remark()
            assert len(names_in(other_disk)) == 1
        assert names_in(other_disk) == []
        journal.close()


def test_one_whose_process_died_while_it_was_closed_is_read_from_a_copy(tmp_path, other_disk):
    journal = new_journal(tmp_path)
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
    assert f"{FILE_NAME}-journal" in names_in(copy)


@pytest.mark.skipif(sys.platform == "win32", reason="forks")
@pytest.mark.filterwarnings("ignore::bench.base.IncompleteRecordWarning")
@pytest.mark.parametrize("state", ["healthy", "locked by turns"])
@pytest.mark.parametrize("patience", [None, 30.0], ids=["caller", "background"])
def test_kills_at_random_moments_lose_no_acknowledged_step(tmp_path, patience, state):
    generator = np.random.default_rng(7)
    for trial in range(3):
        folder = tmp_path / str(trial)
        folder.mkdir()
        reader, writer = os.pipe()
        child = os.fork()
        if child == 0:
            try:
                keeping._BETWEEN_TRIES = 0.0
                journal = new_journal(folder, patience)
                while True:
                    os.write(writer, add(journal).to_bytes(4, "big"))
                    if state != "healthy":
                        with locked(journal.path):
                            for _ in range(3):
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
            # A frame that the kill cut off may have held rows, as far as a reader can tell.
            assert "lacks rows" not in str(run.missing)
            assert run.steps()["step"].tolist()[:acknowledged] == list(range(acknowledged))
            assert len(run.steps()) <= acknowledged + 1
        journal = Journal.reopen(folder)
        count = add(journal, 2)
        journal.finish(**STATUS)
        journal.close()
        assert names_in(folder) == [FILE_NAME]
        with Record(folder) as run:
            assert run.status == "completed"
            assert run.steps()["step"].tolist() == list(range(count))


def test_a_journal_is_not_made_in_a_folder_that_is_missing(tmp_path):
    with pytest.raises(ConfigurationError, match="cannot be made"):
        Journal(tmp_path / "absent" / FILE_NAME, SIGNALS, {})
    assert not (tmp_path / "absent").exists()
