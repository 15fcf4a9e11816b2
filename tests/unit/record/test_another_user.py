"""Another user of the computer is neither followed nor believed, and cannot read what is private."""

import json
import os
import shutil
import signal
import socket
import sys
import tempfile
import traceback
from pathlib import Path

import pytest

from bench.base import BenchError
from bench.devices import Signal
from bench.record import FILE_NAME, Event, Journal, Record, recover
from bench.record.rows import Row
from bench.record.second_file import SecondFile, places, read_second_file
from bench.rig import Holder, Locks

pytestmark = pytest.mark.skipif(
    sys.platform == "win32" or os.geteuid() != 0, reason="needs root, who can act as other users"
)

US, THEM = 65532, 65533
SIGNALS = (Signal("force", "N", "force"),)
LINE = "/dev/ttyBENCH"
PRECIOUS = "precious"


def as_user(number, act, *given):
    """Act as another user, in a process of its own; return what comes back as JSON, or raise what was raised."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        # A pipe or a link that is followed may keep it waiting.
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(60)
        try:
            os.setgroups([])
            os.setgid(number)
            os.setuid(number)
            os.umask(0o022)
            said = {"value": act(*given)}
        except BenchError as error:
            said = {"error": str(error)}
        except BaseException:
            said = {"defect": traceback.format_exc()}
        os.write(writer, json.dumps(said).encode())
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        content = pipe.read()
    os.waitpid(child, 0)
    assert content, "it was kept waiting"
    said = json.loads(content)
    assert "defect" not in said, said["defect"]
    return said


@pytest.fixture
def shared(monkeypatch):
    """A folder to which everybody may write, for temporary files and locks; beside it one of each user."""
    # Others have to get there.
    root = Path(tempfile.mkdtemp(dir="/tmp"))
    root.chmod(0o755)
    folder = root / "shared"
    folder.mkdir()
    folder.chmod(0o1777)
    for user in (US, THEM):
        (root / str(user)).mkdir()
        os.chown(root / str(user), user, user)
    (root / str(US) / "file").write_text(PRECIOUS)
    os.chown(root / str(US) / "file", US, US)
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.setenv("ACTUATOR_BENCH_LOCKS", str(folder))
    yield folder
    shutil.rmtree(root)


def own(shared, user=US):
    return shared.parent / str(user)


def lock_of(shared):
    """Return the file of the lock of the line."""
    with Locks(Holder.of_this_process("ours", "test")) as locks:
        locks.take_lines([LINE])
        (path,) = shared.iterdir()
    return path


def plant(kind, path, content=b"", target=None):
    """Put something of one's own in the place of a file of somebody else."""
    if kind == "link":
        path.symlink_to(target)
    elif kind == "dangling link":
        path.symlink_to(target.with_name("made"))
    elif kind == "pipe":
        os.mkfifo(path)
        path.chmod(0o666)
    elif kind == "folder":
        path.mkdir()
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as one:
            one.bind(str(path))
    else:
        mode = {"file": 0o666, "unreadable file": 0o600, "second name": 0o666}[kind]
        path.write_bytes(content)
        path.chmod(mode)
        if kind == "second name":
            path.with_name("second").hardlink_to(path)


PLANTED = ("link", "dangling link", "pipe", "folder", "socket", "file", "unreadable file", "second name")


def untouched(shared):
    """Return whether nothing of ours was written to, nor made, through a link."""
    assert (own(shared) / "file").read_text() == PRECIOUS
    return not (own(shared) / "made").exists()


@pytest.mark.parametrize("kind", PLANTED)
def test_what_is_planted_for_a_lock_is_neither_followed_nor_believed(shared, kind):
    forged = json.dumps({"rig": "theirs", "doing": "forged", "user": "x", "host": "y", "process": 1, "since": "z"})
    path = lock_of(shared)
    as_user(THEM, plant, kind, path, forged.encode(), own(shared) / "file")
    before = path.lstat()

    def take():
        with Locks(Holder.of_this_process("ours", "test")) as locks:
            locks.take_lines([LINE])
        return True

    said = as_user(US, take)
    # A file that can be opened can be locked; everything else is told.
    assert kind == "file" or str(path) in said["error"]
    assert "forged" not in str(said)
    assert untouched(shared)
    after = path.lstat()
    assert (after.st_ino, after.st_size, after.st_mode) == (before.st_ino, before.st_size, before.st_mode)


@pytest.mark.parametrize("kind", PLANTED)
def test_what_is_planted_for_a_second_file_is_neither_followed_nor_believed(shared, kind):
    journal = own(shared) / "run" / FILE_NAME
    _, place = places(journal)
    forged = own(shared, THEM) / "rows"

    def record():
        journal.parent.mkdir()
        made = Journal(journal, SIGNALS, {})
        made.event(Event(0.0, "INFO", "note", "ours"))
        with Record(journal) as record:
            return record.identity

    def forge():
        with_rows = SecondFile(forged, identity)
        with_rows.append([Row("events", (number, 0.0, "INFO", "note", "forged")) for number in range(1, 9)])
        with_rows.close()
        plant(kind, place, forged.read_bytes(), own(shared) / "file")

    def read():
        problem = ""
        try:
            SecondFile(place, identity)
        except OSError as error:
            problem = str(error)
        with Record(journal) as record:
            remark, count = record.remark(), len(record.events())
        return [problem, remark, count, recover(journal).tables["events"].added, len(list(read_second_file(place)))]

    identity = as_user(US, record)["value"]
    as_user(THEM, forge)
    problem, *said = as_user(US, read)["value"]
    assert said == ["", 1, 0, 0]
    assert str(place) in problem
    assert untouched(shared)


def test_second_files_are_not_read_by_others(shared):
    journal = own(shared) / "run" / FILE_NAME

    def record():
        journal.parent.mkdir()
        made = Journal(journal, SIGNALS, {})
        shutil.rmtree(journal.parent)
        try:
            made.event(Event(0.0, "INFO", "note", "ours"))
        except BenchError:
            made.close()
        return [str(path) for path in shared.iterdir()]

    def read(path):
        try:
            return Path(path).read_text()
        except PermissionError:
            return "refused"

    (left,) = as_user(US, record)["value"]
    assert "ours" in Path(left).read_text()
    assert as_user(THEM, read, left)["value"] == "refused"


def test_a_lock_of_ours_is_honoured_and_not_removed_by_others(shared):
    def take_and_hold():
        locks = Locks(Holder.of_this_process("theirs", "test"))
        locks.take_lines([LINE])
        # It goes with the process.
        return True

    path = lock_of(shared)

    def remove():
        try:
            path.unlink()
        except PermissionError:
            return "refused"
        return "removed"

    with Locks(Holder.of_this_process("ours", "test")) as locks:
        locks.take_lines([LINE])
        assert "in use" in as_user(THEM, take_and_hold)["error"]
        assert as_user(THEM, remove)["value"] == "refused"
