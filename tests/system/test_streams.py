"""A failed print destroys no work: encodings that lack characters, full disks, readers that are gone."""

import io
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest

from bench.cli import streams
from bench.cli.streams import Output

pytestmark = pytest.mark.usefixtures("warm_popen")

IDENTIFY = ["identify", "m.csv", "--input", "u", "--output", "y", "--model", "preisach", "--levels", "5",
            "--out", "model.json"]  # fmt: skip
CREEP = ["--set", "duration=4", "--set", "settling=2"]
COMMANDS = {
    "identify": IDENTIFY,
    "run": ["run", "creep", "--rig", "vo2", "--clock", "virtual", *CREEP, "--out", "runs"],
}


def swing(i, late):
    """Return a sine that decays, of which nothing has to be advised."""
    return math.exp(-0.01 * i) * math.sin(0.2 * i - late)


@pytest.fixture
def folder(tmp_path):
    rows = (f"{swing(i, 0.0):.4f},{swing(i, 0.3):.4f}" for i in range(200))
    (tmp_path / "m.csv").write_text("\n".join(["u,y", *rows, ""]))
    return tmp_path


def check(folder, command, code, err):
    assert code == 0, err
    assert "Traceback" not in err
    if command == "identify":
        assert (folder / "model.json").stat().st_size > 0
    if command == "run":
        assert len([*folder.glob("runs/*/journal.sqlite")]) == 1


def start(folder, command, **settings):
    arguments = [sys.executable, "-P", "-m", "bench", *COMMANDS[command]]
    return subprocess.Popen(arguments, cwd=folder, stdin=subprocess.DEVNULL, **settings)


@pytest.mark.parametrize(("command", "encoding"), [("identify", "cp1252"), ("run", "ascii")])
def test_an_encoding_that_lacks_characters(folder, command, encoding):
    # As Windows redirects into a file.
    environment = {**os.environ, "PYTHONIOENCODING": encoding}
    with (folder / "log").open("wb") as log:
        process = start(folder, command, stdout=log, stderr=subprocess.PIPE, env=environment)
        err = process.communicate(timeout=240)[1].decode(encoding)
    check(folder, command, process.returncode, err)
    assert err == ""
    assert (folder / "log").stat().st_size > 100


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full, a disk that is always full")
def test_a_disk_that_is_full(folder):
    command = "identify"
    with Path("/dev/full").open("wb") as full:
        process = start(folder, command, stdout=full, stderr=subprocess.PIPE, text=True)
        err = process.communicate(timeout=240)[1]
    check(folder, command, process.returncode, err)
    assert err == "the standard output cannot be written: No space left on device; the work is done\n"


@pytest.mark.skipif(sys.platform == "win32", reason="has another message")
def test_a_reader_that_is_gone(folder):
    command = "run"
    process = start(folder, command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    with process:
        process.stdout.close()
        err = process.stderr.read()
    check(folder, command, process.returncode, err)
    assert err == "the standard output cannot be written: Broken pipe; the work is done\n"


@pytest.mark.skipif(sys.platform == "win32", reason="needs a shell")
def test_descriptors_that_are_closed(folder):
    arguments = ["sh", "-c", 'exec "$@" >&- 2>&- <&-', "sh", sys.executable, "-P", "-m", "bench", *IDENTIFY]
    finished = subprocess.run(arguments, cwd=folder, capture_output=True, text=True, timeout=240, check=False)
    check(folder, "identify", finished.returncode, finished.stderr)


def test_a_pipe_that_nobody_reads_does_not_keep_the_process(monkeypatch):
    monkeypatch.setattr(streams, "_PATIENCE", 0.1)
    reader, writer = os.pipe()
    with os.fdopen(reader, "rb"), os.fdopen(writer, "w", encoding="utf-8") as pipe:
        output = Output(pipe)
        output.write("x" * 10_000_000)
        assert output.finish() == "nobody reads it"
        # Nothing more is tried.
        output.write("y")


def test_a_pipe_that_is_read_slowly_gets_all(monkeypatch):
    reader, writer = os.pipe()
    content = "".join(f"line {i} σ\n" for i in range(20_000))
    with os.fdopen(reader, encoding="utf-8") as other, os.fdopen(writer, "w", encoding="utf-8") as pipe:
        output = Output(pipe)
        output.write(content)
        assert other.read(10) == content[:10]
        rest = other.read(len(content) - 10)
        assert output.finish() == ""
    assert rest == content[10:].replace("\n", os.linesep)


def test_a_stream_that_fails_later_is_named_once():
    class Failing(io.StringIO):
        def flush(self):
            raise OSError(5, "Input/output error")

    output = Output(Failing())
    output.write("text")
    assert output.finish() == output.finish() == "Input/output error"
