"""Runs on an emulated rig do not depend on how busy the machine is.

`python tests/bench/test_busy_machine.py --runs 50 --busy 16`, or `make busy`, carries many virtual runs out beside
many busy processes, compares their journals bit by bit, and shows the pace of a run at x100. The tests do less.
"""

import argparse
import hashlib
import json
import os
import struct
import subprocess
import sys
import tempfile
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from bench.compilation_display import MESSAGE
from bench.journal import Record

SHORT = ["--set", "hot=70", "--set", "cool=50", "--set", "duration=8"]


@contextmanager
def busy(processes):
    """Keep the processors busy."""
    with ExitStack() as stack:
        for _ in range(processes):
            loop = stack.enter_context(subprocess.Popen([sys.executable, "-S", "-c", "while True: pass"]))
            stack.callback(loop.kill)
        yield


def run(rig, clock, folder, cache=None):
    """Carry a short run out in a process of its own; return the folder of its record and what it printed."""
    folder.mkdir(parents=True)
    command = ["run", "creep", "--rig", rig, "--clock", clock, *SHORT, "--seed", "3", "--out", str(folder)]
    result = subprocess.run(
        [sys.executable, "-c", f"from bench.cli import main; main({command!r})"],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=280,
        env=os.environ | ({"NUMBA_CACHE_DIR": str(cache)} if cache else {}),
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    (record,) = folder.iterdir()
    return record, result.stdout, result.stderr


def fingerprint(folder):
    """Return a hash of every bit of the readings and set-points of a run, and of their times."""
    digest = hashlib.sha256()
    with Record(folder) as record:
        assert record.status == "completed"
        for table in (record.steps(), record.telemetry()):
            assert len(table) > 0
            for name, column in table.columns.items():
                digest.update(name.encode() + column.tobytes())
        for step in record.step_records():
            digest.update(json.dumps(dict(step.setpoints)).encode() + struct.pack("<dd", step.started, step.finished))
    return digest.hexdigest()


@pytest.mark.slow
class TestBusyMachine:
    @pytest.mark.seeds
    def test_virtual_runs_are_equal_to_the_last_bit(self, tmp_path):
        """The first of them compiles, in the middle of the load, and says so."""
        with busy(1):
            loaded, _, first = run("vo2", "virtual", tmp_path / "loaded", tmp_path / "cache")
        alone, _, second = run("vo2", "virtual", tmp_path / "alone", tmp_path / "cache")
        assert fingerprint(loaded) == fingerprint(alone)
        assert [text.count(MESSAGE) for text in (first, second)] == [1, 0]

    def test_a_scaled_clock_slows_down_and_says_so(self, tmp_path):
        # The laboratory's hundreds of seconds in some milliseconds: no machine keeps up.
        folder, out, _ = run("vo2", "x100000", tmp_path / "runs")
        assert "clock: x100000 asked for, x" in out.replace("1e+05", "100000")
        with Record(folder) as record:
            (event,) = (event for event in record.events() if event.kind == "clock")
            assert event.text.endswith("reached")


@pytest.mark.slow
@pytest.mark.parametrize("rigs", ["vo2 sma mckibben", "coiled-polymer hybrid"])
def test_an_open_laboratory_has_compiled_its_loops(rigs):
    """Otherwise a driver would wait for an answer while its instrument compiles.

    Each kernel has its versions, compiled or from the cache, when the laboratory is open; using it adds none. The two
    muscles that share their kernels are opened in processes of their own.
    """
    script = f"""
import gc
import bench
from numba.core.registry import CPUDispatcher

def versions():
    kernels = [each for each in gc.get_objects() if isinstance(each, CPUDispatcher)]
    return {{str(each.py_func): len(each.overloads) for each in kernels if each.overloads}}

for name in {rigs!r}.split():
    with bench.open_rig(name) as rig:
        compiled = versions()
        assert compiled
        for actuator in rig.actuators.values():
            limits = actuator.limits
            actuator.set(limits.high if limits.high == 1.0 else limits.low + 0.6 * (limits.high - limits.low))
        for _ in range(5):
            rig.clock.sleep(0.5)
            rig.glance()
        rig.measure()
        assert versions() == compiled, set(versions().items()) - set(compiled.items())
print("done")
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=280, check=False)
    assert result.stdout == "done\n", result.stderr


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rig", default="vo2")
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--busy", type=int, default=16, help="busy processes")
    parser.add_argument("--clock", default="x100", help="clock of the last run")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        first = None
        with busy(arguments.busy):
            for n in range(arguments.runs):
                found = fingerprint(run(arguments.rig, "virtual", Path(folder, str(n)))[0])
                first = first or found
                print(f"run {n + 1} of {arguments.runs}: {found[:16]}", flush=True)
                if found != first:
                    sys.exit("the runs differ")
            record, _, _ = run(arguments.rig, arguments.clock, Path(folder, "paced"))
        with Record(record) as journal:
            print("clock:", next(event.text for event in journal.events() if event.kind == "clock"))
    print(f"{arguments.runs} runs beside {arguments.busy} busy processes are equal to the last bit")


if __name__ == "__main__":
    main()
