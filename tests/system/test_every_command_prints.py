"""Every command with streams that lack characters, take nothing or are closed: its work is the same."""

import io
import math
import os
import shutil
import sys
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from every_command import every_command

from bench.cli import main

CREEP = ["--set", "duration=2", "--set", "settling=1"]
COLUMNS = ["--input", "u", "--output", "y"]
MODEL = ["--model", "polynomial", "-o", "degree=3"]
# What each command does in a folder with measurements, a model and a run; an error of those that serve or take long.
COMMANDS = {
    "list": [],
    "show": ["vo2"],
    "run": ["creep", "--rig", "vo2", "--clock", "virtual", "--no-rehearse", *CREEP, "--out", "new"],
    "rehearse": ["creep", "--rig", "vo2", *CREEP],
    "study FILE": ["campaign.toml", "--dry-run"],
    "resume": ["run"],
    "runs list": ["."],
    "safe": ["vo2"],
    "rig clear": ["vo2"],
    "rig check": ["vo2"],
    "panel": ["no-rig"],
    "identify": ["m.csv", *COLUMNS, *MODEL, "--time", "none", "--out", "new.json"],
    "predict": ["model.json", "m.csv", "--input", "u", "--out", "new.csv"],
    "invert": ["model.json", "targets.csv", "--column", "y", "--out", "new.csv"],
    "model design": ["--levels", "5"],
    "model test": ["model.json", "--data", "m.csv", *COLUMNS],
    "rig calibrate": ["run", "--sensor", "psd_position", "--uncertainty", "1e-9", "--interval", "365"],
    "report": ["missing"],
    "runs export": ["run", "--format", "csv", "--out", "new"],
    "runs import": ["m.csv", *COLUMNS, "--out", "new"],
    "view": ["missing"],
    "runs repair": ["run"],
    "runs compare": ["run", "run"],
    "model twin": ["run", "--rig", "vo2", "--out", "new.toml"],
    "model deploy": ["model.json", "--c", "exported"],
    "model tune": ["model.json", "--rig", "missing", "--out", "new.toml"],
    "new": ["rig", "bench-of-mine"],
    "study vo2": ["--workers", "0"],
    "rig emulate": ["no-rig"],
    "rig find": ["no-rig"],
    "rig torture": ["no-rig"],
}
# What nobody reads and descriptors that are closed: `test_streams.py`, with processes.
STREAMS = ("ascii", "full", "none")


def test_every_command_is_in_the_table():
    registered = {"study hybrid", "study muscles", "study sma"}
    assert set(COMMANDS) == {name for name, _ in every_command()} - registered


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """A folder with what the commands read."""
    folder = tmp_path_factory.mktemp("prepared")
    rows = [(math.sin(0.1 * i), math.sin(0.1 * i - 0.3)) for i in range(100)]
    (folder / "m.csv").write_text("u,y\n" + "".join(f"{u:.5f},{y:.5f}\n" for u, y in rows))
    (folder / "targets.csv").write_text("y\n0.1\n0.2\n0.3\n")
    (folder / "campaign.toml").write_text('[[runs]]\nprotocol = "creep"\nrigs = ["vo2"]\nseeds = [0, 1]\n')
    before = Path.cwd()
    os.chdir(folder)
    try:
        assert carried_out(["identify", "m.csv", *COLUMNS, *MODEL, "--time", "none", "--out", "model.json"])[0] == 0
        assert carried_out(["run", *COMMANDS["run"]])[0] == 0
        next((folder / "new").iterdir()).rename(folder / "run")
        (folder / "new").rmdir()
    finally:
        os.chdir(before)
    return folder


def carried_out(words, output=None, errors=None, **streams):
    """Carry a command out with these streams; return its exit code, and what was printed to streams that keep it."""
    output, errors = output or io.StringIO(), errors or io.StringIO()
    former = sys.stdin, sys.stdout, sys.stderr
    sys.stdin, sys.stdout, sys.stderr = (
        streams.get("stdin", io.StringIO()), streams.get("stdout", output), streams.get("stderr", errors)
    )  # fmt: skip
    try:
        with pytest.raises(SystemExit) as ended:
            main(words)
    finally:
        sys.stdin, sys.stdout, sys.stderr = former
    return ended.value.code or 0, text_of(output), text_of(errors)


def text_of(stream):
    if isinstance(stream, io.StringIO):
        return stream.getvalue()
    with suppress(OSError, ValueError):
        stream.flush()
    # /dev/full never ends.
    is_kept = isinstance(stream.name, str) and Path(stream.name).is_file()
    return Path(stream.name).read_text(encoding=stream.encoding) if is_kept else ""


def words_of(command):
    """Return the words of a command; the name of a campaign file stands for itself."""
    return [word for word in command.split() if word != "FILE"]


def written(folder):
    """Return the files that a command has left; the folder of a run, which is named after its start, is RUN."""
    return {
        Path(*("RUN" if part.endswith(tuple("0123456789")) else part for part in path.relative_to(folder).parts))
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.fixture(scope="module")
def as_usual(prepared, tmp_path_factory):
    """Return how a command ends with streams that keep everything, and the files that it leaves."""
    known = {}

    def ends(command, monkeypatch):
        if command not in known:
            folder = tmp_path_factory.mktemp("usual") / "work"
            shutil.copytree(prepared, folder)
            monkeypatch.chdir(folder)
            known[command] = (*carried_out([*words_of(command), *COMMANDS[command]]), written(folder))
        return known[command]

    return ends


@pytest.mark.parametrize("streams", STREAMS)
@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_does_its_work(prepared, as_usual, tmp_path, monkeypatch, command, streams):
    if streams == "full" and not Path("/dev/full").exists():
        pytest.skip("needs /dev/full, a disk that is always full")
    expected, usual_output, usual_errors, files = as_usual(command, monkeypatch)
    folder = tmp_path / "work"
    shutil.copytree(prepared, folder)
    monkeypatch.chdir(folder)
    with ExitStack() as stack:
        given = {}
        if streams == "full":
            given["output"] = open("/dev/full", "w", encoding="utf-8")  # noqa: PTH123, SIM115 - closed below
            stack.callback(close, given["output"])
        elif streams == "none":
            given = dict.fromkeys(("stdin", "stdout", "stderr"))
        else:
            for name in ("output", "errors"):
                given[name] = stack.enter_context((tmp_path / name).open("w", encoding=streams))
        code, output, errors = carried_out([*words_of(command), *COMMANDS[command]], **given)
    assert code == expected, errors
    assert "Traceback" not in output + errors
    assert written(folder) == files
    if streams == "full":
        assert ("the standard output cannot be written: " in errors) == bool(usual_output)
    elif streams == "ascii":
        # A character that is missing is written as an escape.
        assert (bool(output), bool(errors)) == (bool(usual_output), bool(usual_errors))
        assert errors == "" or errors.count("\n") == usual_errors.count("\n")
        assert "cannot be written" not in errors.replace(usual_errors, "")


def close(stream):
    with suppress(OSError):
        stream.close()
