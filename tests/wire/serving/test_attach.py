"""`bench run --attach`: a protocol against served instruments gives what it gives in process."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from bench.analysis import RunFolder
from bench.rig import ControlClient

pytestmark = pytest.mark.usefixtures("warm_popen")

CREEP = ["--set", "start=22", "--set", "hot=26", "--set", "cool=22", "--set", "duration=2.6", "--set", "interval=0.2",
         "--set", "settling=1"]  # fmt: skip
"""10 s of laboratory time: the faster it has to pass, the less a process may be kept waiting."""


def overrides(values):
    return [f"--override=devices.{key}={value}" for key, value in values.items()]


VO2 = overrides({"tec.watchdog": 600, "tec.timeout": 10, "psd.timeout": 60})
"""A busy machine keeps server and client waiting by the wall clock."""
SMA = overrides({
    "supply.watchdog": 60, "supply.heartbeat": 60, "supply.timeout": 10, "load_cell.timeout": 10,
    "wire_end.timeout": 60, "stage.watchdog": 0, "stage.timeout": 10, "fan.watchdog": 600, "fan.timeout": 60,
})  # fmt: skip


def terminal(path, flags):
    return os.open(path, flags | os.O_NOCTTY)


def readings(folder):
    record = RunFolder(next(folder.iterdir()))
    assert record.status == "completed"
    return {name: np.asarray(record.readings[name]) for name in ("tec_temperature", "curvature")}


@pytest.mark.slow
def test_creep_gives_what_it_gives_in_process(bench, emulate, tmp_path):
    # Its watchdog then leaves 150 s of the wall clock.
    with emulate("vo2", "--clock", "x4"):
        ports = tmp_path / "endpoints.json"
        served, inside = tmp_path / "served", tmp_path / "inside"
        code, out, err = bench(
            "run", "creep", "--rig", "vo2", "--attach", ports, "--no-rehearse", *CREEP, *VO2, "--out", served
        )
        assert (code, err) == (0, "")
        assert "completed: 29 steps" in out
    assert bench("run", "creep", "--rig", "vo2", "--clock", "virtual", *CREEP, "--out", inside)[0] == 0
    one, other = readings(served), readings(inside)
    assert len(one["curvature"]) == len(other["curvature"])
    # Noise of one reading: 0.35 1/m of the detector, and what 5 mK rms of the film make on the slope.
    for target in (26.0, 22.0):
        served_last, inside_last = (
            each["curvature"][abs(each["tec_temperature"] - target) < 0.1][-4:] for each in (one, other)
        )
        assert len(served_last) == len(inside_last) == 4
        assert np.mean(served_last) == pytest.approx(np.mean(inside_last), abs=3.0)


@pytest.mark.slow
def test_a_prompt_is_carried_out_by_the_server(bench, emulate, tmp_path):
    with emulate("sma", "--clock", "x1", "--override", "emulation.supply_watchdog=60"):
        code, _, err = bench(
            "run", "calibration-load", "--rig", "sma", "--attach", tmp_path / "endpoints.json", "--no-rehearse",
            "--out", tmp_path / "runs", "--set", "weights=4.9", "--set", "readings=2", "--set", "dwell=0.2", *SMA,
        )  # fmt: skip
        assert (code, err) == (0, "")
        run = RunFolder(next((tmp_path / "runs").iterdir()))
        assert np.mean(run.readings["load_cell_force"]) == pytest.approx(4.9, abs=0.05)


@pytest.mark.slow
def test_a_schedule_of_faults_happens_in_the_server_and_stands_in_its_log(bench, emulate, tmp_path):
    faults, log = tmp_path / "faults.jsonl", tmp_path / "state.jsonl"
    faults.write_text(
        '{"at": 1.0, "fault": "displaced-spot", "values": {"metres": 5e-6}, "duration": 4.0}\n'
        '{"at": 3.0, "fault": "tec-over-current"}\n'
    )
    with emulate("vo2", "--clock", "x1", "--state", log) as (_, endpoints):
        code, _, err = bench(
            "run", "creep", "--rig", "vo2", "--attach", tmp_path / "endpoints.json", "--no-rehearse", *CREEP, *VO2,
            "--faults", faults, "--out", tmp_path / "runs",
        )  # fmt: skip
        assert code not in (0, 7)
        assert "tec: " in err
        with ControlClient(endpoints["control"]) as control:
            control.advance(6.0)
            events = control.events()
            assert control.state()["tec_output"] == 0.0
    assert [(each["fault"], each["what"]) for each in events] == [
        ("displaced-spot", "begins"), ("tec-over-current", "begins"), ("displaced-spot", "ends"),
    ]  # fmt: skip
    assert events[1]["time"] - events[0]["time"] == pytest.approx(2.0)
    assert events[2]["time"] - events[0]["time"] == pytest.approx(4.0)
    logged = [json.loads(line) for line in log.read_text().splitlines()]
    assert [{key: each[key] for key in events[0]} for each in logged if "fault" in each] == events


@pytest.mark.slow
def test_a_run_ends_when_its_server_is_killed(emulate, tmp_path):
    with emulate("vo2", "--clock", "x1") as (server, endpoints):
        command = [sys.executable, "-P", "-m", "bench", "run", "creep", "--rig", "vo2", "--set", "duration=3000",
                   "--attach", str(tmp_path / "endpoints.json"), "--no-rehearse", *VO2,
                   "--out", str(tmp_path / "runs")]  # fmt: skip
        run = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        with ControlClient(endpoints["control"]) as control:
            while not control.state()["tec_output"]:
                assert run.poll() is None
                control.wait(control.time() + 0.1)
        # A terminal that is open keeps its name from the servers of other tests, at which the run would arrive.
        with open(endpoints["instruments"]["tec"]["port"], opener=terminal):
            server.kill()
            _, err = run.communicate(timeout=240)
    # Nothing answers any more, so that the safe state cannot be confirmed.
    assert run.returncode == 7
    assert "tec is NOT in its safe state" in err
    (folder,) = (tmp_path / "runs").iterdir()
    assert RunFolder(folder).status == "failed"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "cannot be read"),
        ("{", "is not an endpoints file of `bench rig emulate --json`"),
        ("[]", "is not an endpoints file of `bench rig emulate --json`"),
        ("{}", "is not an endpoints file of `bench rig emulate --json`: factor: is missing"),
    ],
)
def test_a_file_that_is_none_is_one_message(bench, tmp_path, text, words):
    file = tmp_path / "ports.json"
    if text is not None:
        file.write_text(text)
    code, _, err = bench("run", "creep", "--rig", "vo2", "--attach", file)
    assert (code, len(err.splitlines())) == (2, 1)
    assert words in err


def test_a_file_of_another_server_or_rig_is_one_message(bench, vo2, tmp_path):
    content = json.loads(vo2.endpoints_file.read_text())
    file = tmp_path / "ports.json"
    for change, words in (
        ({"server": "0123"}, "is out of date"),
        ({"control": "tcp://127.0.0.1:1"}, "is out of date: its server does not answer at tcp://127.0.0.1:1"),
        ({"rig": "sma"}, "serves sma, not vo2"),
    ):
        file.write_text(json.dumps(content | change))
        code, _, err = bench("run", "creep", "--rig", "vo2", "--attach", file)
        assert (code, len(err.splitlines())) == (2, 1)
        assert words in err


def test_a_clock_or_seed_of_its_own_is_refused(bench, vo2):
    for option in (["--clock", "x20"], ["--seed", "3"]):
        code, _, err = bench("run", "creep", "--rig", "vo2", "--attach", vo2.endpoints_file, *option)
        assert code == 2
        assert "--attach: clock and seed are the server's" in err
    code, _, err = bench("run", "creep", "--rig", "vo2-hardware", "--attach", vo2.endpoints_file)
    assert code == 2
    assert "has no emulated laboratory" in err
