"""CPU time of a sample's readings on the hybrid: its sensors in one compiled call, and one after the other.

Prints, asserts a ratio.
"""

import time

import pytest

from bench.base import VirtualClock
from bench.rig import Rig, load_rig

pytestmark = pytest.mark.benchmark

SIGNALS = ("displacement_position", "base_temperature", "tip_temperature")
SAMPLES, RUNS, PERIOD = 300, 15, 5e-3


def cpu_time(read, clock):
    """Return the CPU time of one sample in µs."""
    begun = time.process_time()
    for _ in range(SAMPLES):
        clock.sleep(PERIOD)
        read()
    return 1e6 * (time.process_time() - begun) / SAMPLES


def test_a_scan_costs_less_than_single_conversions(capsys):
    with Rig(load_rig("hybrid"), VirtualClock(), 5) as one, Rig(load_rig("hybrid"), VirtualClock(), 5) as other:
        other.laboratory.t7.scan_by(None)
        readers = {"in one call": (one.quick_reader(SIGNALS), one.clock)}
        readers["one by one"] = other.quick_reader(SIGNALS), other.clock
        times = {name: [] for name in readers}
        for _ in range(RUNS):
            for name, (read, clock) in readers.items():
                times[name].append(cpu_time(read, clock))
    least = {name: min(each) for name, each in times.items()}
    with capsys.disabled():
        print("\na sample's readings: " + ", ".join(f"{each:.1f} µs {name}" for name, each in least.items()))
    assert least["in one call"] < 0.9 * least["one by one"]
