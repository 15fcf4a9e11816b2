"""Runs on an emulated rig do not depend on how busy the machine is; `make busy` shows more of it."""

import subprocess
import sys

import pytest
from busy_machine import run

from bench.record import Record


@pytest.mark.slow
class TestBusyMachine:
    def test_a_scaled_clock_slows_down_and_says_so(self, tmp_path, warmly):
        # The laboratory's hundreds of seconds in some milliseconds: no machine keeps up.
        with warmly():
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
