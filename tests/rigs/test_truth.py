"""The true state of a laboratory: looking at it changes nothing."""

import math

import pytest

from bench.clock import VirtualClock
from bench.rig import Rig
from bench.rig_file import load_rig, packaged_rigs

RIGS = sorted(name for name in packaged_rigs() if "hardware" not in name)


@pytest.mark.parametrize("name", RIGS)
def test_it_feeds_no_watchdog(name):
    """An output that its instrument switches off without its host goes off as well while somebody looks."""
    rig = Rig(load_rig(name), VirtualClock(), seed=0)
    try:
        watched = {
            each: device.watchdog for each, device in rig.actuators.items() if device.heats and device.watchdog
        }
        for each in watched:
            limits = rig.actuators[each].limits
            rig.actuators[each].set(0.75 * limits.low + 0.25 * limits.high)
        left = on = outputs(rig, watched)
        end = rig.clock.now() + 3.0 * max(watched.values(), default=0.0)
        while rig.clock.now() < end:
            rig.clock.sleep(0.05)
            left = outputs(rig, watched)
        # Not every output is named after its device.
        assert on or name not in ("vo2", "hybrid")
        assert not left
    finally:
        rig.close()


def outputs(rig, devices):
    """Return the true outputs of some devices that are on."""
    truth = rig.laboratory.truth()
    return {
        name
        for name, each in truth.items()
        if each.is_output and name.startswith(tuple(devices)) and not math.isclose(each.value, 0.0, abs_tol=1e-6)
    }
