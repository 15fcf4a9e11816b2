"""A bench is killed, stopped and hung; its outputs go off. The tight figures: `make kill-safe`."""

import json
import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from benches import IN_TIME, LONG, is_on, seconds_until
from kill_safe import PROTOCOLS, SETPOINTS, TRIALS, carry_out, find_guardians

from sim_devices.serving.process import serve

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(300),
    pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="it looks for processes as on Linux"),
]


def check(rig, title, folder):
    folder.mkdir()
    trial = TRIALS[title]
    found = carry_out(rig, trial, folder, random.Random(title).uniform(0.0, 0.5))
    # On a busy machine everything takes longer, and no exit code changes.
    assert not found.problem or found.problem.startswith("after "), found.problem
    assert found.seconds < trial.within + IN_TIME


@pytest.mark.parametrize("title", TRIALS)
def test_it_goes_wrong(vo2, title, tmp_path):
    check(vo2, title, tmp_path / "runs")


@pytest.mark.parametrize("name", [name for name in SETPOINTS if name != "vo2"])
def test_it_is_killed_on_every_rig(name, tmp_path):
    with serve(name, clock="x1") as rig:
        check(rig, "SIGKILL", tmp_path / "runs")


@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGTERM])
def test_a_run_that_loses_its_guardian_ends_and_says_so(vo2, sent, tmp_path):
    command = [
        sys.executable,
        "-P",
        "-m",
        "bench",
        "run",
        f"{PROTOCOLS}:hold",
        "--rig",
        "vo2",
        "--out",
        str(tmp_path),
    ]
    command += ["--attach", str(vo2.endpoints_file), "--set", f"setpoints={json.dumps(SETPOINTS['vo2'])}"]
    run = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        seconds_until(lambda: is_on(vo2) or run.poll() is not None)
        (guardian,) = find_guardians(run.pid)
        os.kill(guardian, sent)
        said, _ = run.communicate(timeout=LONG)
        assert run.returncode == 7, said
        assert "guardian" in said
        # One that is killed leaves it to the rescue, or to the watchdog of the TEC.
        assert seconds_until(lambda: not is_on(vo2)) < IN_TIME
    finally:
        run.kill()
        run.wait()
        vo2.control.power_cycle("tec")
