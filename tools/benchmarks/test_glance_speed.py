"""The CPU time of a glance of a whole rig, after the pause of a tick and without one. Asserts no time."""

import os
import time
from statistics import median

import pytest

from bench.base import VirtualClock
from bench.rig import Rig, load_rig

GLANCES = 100
BATCHES = 15


@pytest.fixture
def one_core():
    """Stay on one core, whose caches keep what the calls need."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(allowed)})
    yield
    os.sched_setaffinity(0, allowed)


def microseconds(call, clock, pause):
    """Return the CPU time of a call behind a pause (s), the pause included, µs: the median of batches."""
    batches = []
    for _ in range(BATCHES):
        start = time.thread_time()
        for _ in range(GLANCES):
            clock.sleep(pause)
            call()
        batches.append((time.thread_time() - start) / GLANCES)
    return 1e6 * median(batches)


@pytest.mark.benchmark
@pytest.mark.usefixtures("one_core")
@pytest.mark.parametrize("name", ["vo2", "sma", "hybrid"])
def test_a_glance_of_the_whole_rig(name, capsys):
    with Rig(load_rig(name), VirtualClock(), 1) as rig:
        clock, period = rig.clock, rig.file.telemetry.period
        tick = microseconds(rig.glance, clock, period)
        whole = microseconds(rig.glance, clock, 0.0)
        parts = {name: microseconds(device.glance, clock, 0.0) for name, device in rig.devices.items()}
        assert set(rig.glance()) == {signal.name for signal in rig.signals}
    with capsys.disabled():
        devices = ", ".join(f"{device} {cost:.0f}" for device, cost in parts.items())
        print(f"\nglance of {name}: {tick:.0f} µs every {period:g} s, {whole:.0f} µs without a pause; {devices}")
