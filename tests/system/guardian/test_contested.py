"""Two benches on one served rig: the second is refused before it sends a byte, and the first is not disturbed."""

import json
import socket
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest
from benches import TOOLS

from bench.base import Stopwatch, WallClock
from bench.record import Record

pytestmark = pytest.mark.usefixtures("warm_popen")

PROTOCOL = f"{TOOLS / 'hanging_protocols.py'}:cycle"
# A busy machine keeps server and client waiting by the wall clock.
OVERRIDES = {
    "emulation.disturbances": "false",
    "devices.tec.watchdog": "600",
    "devices.tec.timeout": "10",
    "devices.psd.timeout": "60",
}
LONGEST = 200.0
"""Longest wait for anything here, s."""


def bench_run(*options):
    command = [sys.executable, "-P", "-m", "bench", "run", PROTOCOL, "--rig", "vo2", "--no-rehearse"]
    command += ["--clock", "wall", *options]
    return subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def result(process):
    said, _ = process.communicate(timeout=LONGEST)
    return process.returncode, " ".join(said.split())


def await_first_step(folder, process):
    waited = Stopwatch()
    while process.poll() is None and waited.seconds() < LONGEST:
        for path in folder.glob("*/journal.sqlite"):
            with Record(path) as record:
                if len(record.steps()["step"]):
                    return
        WallClock().sleep(0.1)
    pytest.fail(f"it took no step: {result(process)}")


@contextmanager
def fresh_line():
    """Yield the address of a line where nobody has connected, and check that nobody did."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.0)
        yield "tcp://127.0.0.1:{1}".format(*server.getsockname())
        with pytest.raises(BlockingIOError):
            server.accept()


def endpoints(rig, path, **ports):
    """Write the endpoints of a served rig with other names of its lines; return the options that attach to them."""
    content = json.loads(rig.endpoints_file.read_text())
    for instrument, port in ports.items():
        content["instruments"][instrument]["port"] = port
    path.write_text(json.dumps(content))
    return "--attach", str(path)


@pytest.mark.seeds
def test_the_second_bench_is_refused_and_the_first_one_is_not_disturbed(emulated_rig, tmp_path):
    rig = emulated_rig("vo2", clock="x2", overrides=OVERRIDES)
    enough, contested, undisturbed, refused = (tmp_path / name for name in ("enough", "first", "alone", "second"))
    first = bench_run(
        "--attach", str(rig.endpoints_file), "--out", str(contested), "--set", f"until={enough}", *overrides()
    )
    try:
        await_first_step(contested, first)
        link = tmp_path / "link"
        tec = rig.port("tec")
        if tec.startswith("/"):
            link.symlink_to(tec)
            tec = str(link)
        t7 = rig.port("psd")
        assert "127.0.0.1" in t7
        with fresh_line() as psd_line, fresh_line() as tec_line:
            others = [
                ("line", endpoints(rig, tmp_path / "same.json")),
                (f"line {tec}", endpoints(rig, tmp_path / "link.json", tec=tec, psd=psd_line)),
                (
                    "line tcp://localhost",
                    endpoints(
                        rig,
                        tmp_path / "name.json",
                        tec=tec_line.replace("tcp", "socket"),
                        psd=t7.replace("127.0.0.1", "localhost"),
                    ),
                ),
            ]
            benches = [(line, bench_run(*attach, "--out", str(refused))) for line, attach in others]
            for line, bench in benches:
                code, said = result(bench)
                assert code == 2, said
                assert "rig vo2 is in use" in said
                assert line in said
                assert f"process {first.pid}" in said
        assert rig.control.state()["tec_output"] == 1.0
        assert first.poll() is None
        enough.touch()
        code, said = result(first)
        assert code == 0, said
    finally:
        first.kill()
        first.communicate()
    assert not any(refused.glob("*/journal.sqlite"))
    assert rig.control.state()["tec_output"] == 0.0

    alone = bench_run("--clock", "virtual", "--out", str(undisturbed), "--set", f"until={enough}", *overrides())
    code, said = result(alone)
    assert code == 0, said
    assert_equal_within_noise(contested, undisturbed)


def overrides():
    return [text for key, value in OVERRIDES.items() for text in ("--override", f"{key}={value}")]


def assert_equal_within_noise(contested, undisturbed):
    (path,), (expected_path,) = (folder.glob("*/journal.sqlite") for folder in (contested, undisturbed))
    with Record(path) as record, Record(expected_path) as expected:
        assert record.status == expected.status == "completed"
        assert [each.text for each in record.events() if each.level in ("WARN", "ERROR")] == []
        # Not even a request that had to be repeated.
        assert [each.text for each in record.events() if each.kind in ("line", "requests")] == []
        found, wanted = record.steps(), expected.steps()
        assert list(found["step"]) == list(range(len(found["step"])))
        assert len(found["step"]) >= len(wanted["step"]) == 4
        for setpoint in (30.0, 34.0):
            # The first cycle comes from the plate at rest.
            rows = (found["tec_setpoint"] == setpoint) & (found["step"] >= 2)
            same = (wanted["tec_setpoint"] == setpoint) & (wanted["step"] >= 2)
            assert np.all(np.abs(found["tec_temperature"][rows] - wanted["tec_temperature"][same]) < 0.05)
            # Ten conversions of 5 mV rms, at 0.1 V/µm.
            assert np.all(np.abs(found["psd_position"][rows] - wanted["psd_position"][same]) < 8 * 5e-8 / 10**0.5)
        ticks = record.telemetry()
        assert np.all(np.isfinite([ticks[name] for name in ("tec_temperature", "tec_current", "psd_position")]))
        assert set(ticks["step"]) <= set(found["step"]) | {0.0}
        assert np.all((ticks["tec_temperature"] > 20.0) & (ticks["tec_temperature"] < 36.0))
