"""`--json`: checked before anything is done, written at the end, and what a command exits with if that fails."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from every_command import every_command

from bench.base import InterlockError

COMMANDS = [
    ["run", "creep", "--rig", "vo2", "--clock", "virtual"],
    ["run", "--from", "RUN"],
    ["resume", "RUN"],
    ["study", "vo2"],
    ["safe", "vo2"],
    ["rig", "emulate", "vo2"],
]

needs_full = pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full, a disk that is always full")


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_a_file_that_cannot_be_written_is_refused_before_anything_is_done(bench, tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    code, out, err = bench(*command, "--json", "none/result.json")
    assert (code, out) == (2, "")
    assert err == "error: --json none/result.json cannot be written: there is no folder none\n"
    assert [*tmp_path.iterdir()] == []


def test_every_command_that_writes_json_checks_it():
    for name, command in every_command():
        for option in command.params:
            if option.name == "json_file":
                assert option.callback is not None, name


def test_the_folder_of_a_run_is_checked_before_its_rehearsal(bench, tmp_path):
    taken = tmp_path / "taken"
    taken.touch()
    code, out, err = bench("run", "creep", "--rig", "vo2", "--clock", "x1000", "--out", taken / "runs")
    assert (code, out) == (2, "")
    assert err == f"error: --out {taken / 'runs'}: the folder cannot be made in {taken}\n"


@needs_full
def test_a_disk_that_is_full_after_the_work_does_not_say_that_nothing_has_moved(bench, tmp_path):
    arguments = ["run", "creep", "--rig", "vo2", "--set", "duration=25", "--clock", "virtual", "--out", tmp_path]
    code, out, err = bench(*arguments, "--json", "/dev/full")
    assert code == 1
    assert "completed: " in out
    assert err == "error: --json /dev/full cannot be written: No space left on device; the work is done\n"
    # And the next command in this process is none the worse for it.
    assert bench(*arguments)[0] == 0


@needs_full
def test_the_exit_code_of_the_work_stays(bench, tmp_path):
    code, _, err = bench(
        "run", "creep", "--rig", "vo2", "--set", "duration=25", "--clock", "virtual", "--out", tmp_path,
        "--override", 'interlocks=[{signal="tec_temperature", high=60.0}]', "--json", "/dev/full",
    )  # fmt: skip
    assert "error: --json /dev/full cannot be written" in err
    assert "interlock" in err
    assert code == InterlockError.exit_code


def test_a_dash_is_the_standard_output_and_texts_go_to_the_standard_error(bench):
    code, out, err = bench("rehearse", "creep", "--rig", "vo2", "--json", "-")
    assert code == 0
    assert json.loads(out)["status"] == "completed"
    assert "rehearsed on vo2" in err
    assert not Path("-").exists()
    # The next command of this process prints where it did.
    _, out, err = bench("list")
    assert "vo2" in out
    assert err == ""


@pytest.mark.parametrize(
    "command",
    [["list"], ["show", "models"], ["runs", "."], ["safe", "vo2"], ["rig", "check", "vo2"]],
    ids=" ".join,
)
def test_nothing_else_goes_to_the_standard_output(bench, tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    _, out, err = bench(*command, "--json", "-")
    json.loads(out)
    assert err
    assert [*tmp_path.iterdir()] == []


@needs_full
@pytest.mark.usefixtures("warm_popen")
def test_a_standard_output_that_is_full():
    command = [sys.executable, "-m", "bench", "list", "--json", "-"]
    with (
        Path("/dev/full").open("wb") as full,
        subprocess.Popen(command, stdout=full, stderr=subprocess.PIPE, text=True, encoding="utf-8") as child,
    ):
        _, err = child.communicate(timeout=120)
    assert child.returncode == 1
    assert err.endswith("error: --json - cannot be written: No space left on device; the work is done\n")
