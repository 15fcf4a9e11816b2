"""Another user of the computer is neither followed nor believed, and cannot read what is private."""

import json
import os
import shutil
import signal
import socket
import stat
import sys
import tempfile
import traceback
from pathlib import Path

import pytest

from bench.base import BenchError
from bench.devices import Signal
from bench.record import FILE_NAME, Event, Journal, Record, recover
from bench.record.mirror import Mirror, elsewhere, read_mirror
from bench.record.rows import entry
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
    places = [str(path) for path in elsewhere(journal)]
    forged = own(shared, THEM) / "rows"

    def forge():
        with_rows = Mirror(forged, "0123")
        with_rows.append([entry("events", (number, 0.0, "INFO", "note", "forged")) for number in range(1, 9)])
        with_rows.close()
        for place in places:
            Path(place).unlink(missing_ok=True)
            Path(place).with_name("second").unlink(missing_ok=True)
            plant(kind, Path(place), forged.read_bytes(), own(shared) / "file")

    def record():
        journal.parent.mkdir()
        made = Journal(journal, SIGNALS, {})
        made.event(Event(0.0, "INFO", "note", "ours"))
        problems = []
        for place in places:
            try:
                Mirror(Path(place), "0123").append([entry("events", (2, 0.0, "INFO", "note", "ours"))])
            except OSError as error:
                problems.append(str(error))
        with Record(journal) as record:
            remark = record.remark()
        added = recover(journal).tables["events"].added
        made.close()
        return {
            "remark": remark,
            "added": added,
            "problems": problems,
            "read": [len(list(read_mirror(Path(p)))) for p in places],
        }

    as_user(THEM, forge)
    said = as_user(US, record)["value"]
    assert (said["remark"], said["added"], said["read"]) == ("", 0, [0, 0])
    assert len(said["problems"]) == 2
    assert "ours" not in forged.read_text(errors="replace")
    assert untouched(shared)


def test_second_files_and_rescued_folders_are_not_read(shared):
    journal = own(shared) / "run" / FILE_NAME

    def record():
        journal.parent.mkdir()
        made = Journal(journal, SIGNALS, {})
        for place in elsewhere(journal):
            file = Mirror(place, "0123")
            file.append([entry("events", (1, 0.0, "INFO", "note", "ours"))])
            file.close()
        journal.rename(journal.with_name("other"))
        try:
            made.event(Event(0.0, "INFO", "note", "ours"))
        except BenchError:
            made.close()
        return [str(path) for path in shared.iterdir()]

    def read(paths):
        readable = []
        for path in map(Path, paths):
            try:
                path.read_bytes() if path.is_file() else list(path.iterdir())
            except PermissionError:
                continue
            readable.append(str(path))
        return readable

    left = as_user(US, record)["value"]
    kinds = {(stat.S_IFMT(Path(path).stat().st_mode), stat.S_IMODE(Path(path).stat().st_mode)) for path in left}
    assert kinds == {(stat.S_IFREG, 0o600), (stat.S_IFDIR, 0o700)}
    assert as_user(THEM, read, left)["value"] == []


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
