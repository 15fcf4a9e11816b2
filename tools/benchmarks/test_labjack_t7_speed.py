"""The CPU time of the T7 in process: a request, and a loop at 20 kHz. Asserts no time."""

import time
from statistics import median

import numpy as np
import pytest

from bench.base import VirtualClock
from bench.rig import Rig, load_rig
from drivers.labjack_t7.registers import AIN, TEST, LabJackT7, Span

pytestmark = pytest.mark.benchmark

RATE = 20e3
BLOCK = 50


def microseconds(call, count=2000, repeats=9):
    """Return the CPU time of a call, µs: the median of some blocks."""
    blocks = []
    for _ in range(repeats):
        start = time.process_time()
        for _ in range(count):
            call()
        blocks.append((time.process_time() - start) / count)
    return 1e6 * median(blocks)


@pytest.fixture
def rig():
    with Rig(load_rig("hybrid"), VirtualClock(), 1) as rig:
        yield rig


def test_a_request(rig, capsys):
    instrument = LabJackT7("t7", rig.devices["displacement"]._settings.port, 1.0)
    test, conversion, two = Span.of(TEST), Span.of(AIN), (Span.of(TEST), Span.of(AIN))
    assert instrument.read_span(test) == (0x00112233,)
    found = {
        "a constant": microseconds(lambda: instrument.read_span(test)),
        "a conversion": microseconds(lambda: instrument.read_span(conversion)),
        "both by function 76": microseconds(lambda: instrument.read_spans(two)),
        "a set-point": microseconds(lambda: rig.devices["piezo"]._send(0.0)),
    }
    instrument.close()
    with capsys.disabled():
        print("\nT7 in process, µs a request: ", ", ".join(f"{name} {value:.1f}" for name, value in found.items()))


def test_twenty_kilohertz(rig, capsys):
    sensor, supply, clock = rig.devices["displacement"], rig.devices["piezo"], rig.clock
    supply.set(0.0)
    count, start = 0, clock.now()

    def sample():
        nonlocal count
        count += 1
        clock.sleep_until(start + count / RATE)
        supply.set(1e5 * sensor.glance()["displacement_position"])

    cost = microseconds(sample)
    assert supply.setpoint != 0.0
    with capsys.disabled():
        print(f"\nreading and writing at 20 kHz: {cost:.1f} µs a sample, {1e6 / RATE / cost:.1f} times real time")


def test_blocks_of_samples(rig, capsys):
    sensor, supply, clock = rig.devices["displacement"], rig.devices["piezo"], rig.clock
    supply.set(0.0)
    count, start = 0, clock.now()
    found = {}
    for name, amplitude in (("constant", 0.0), ("below a step of the DAC", 2e-3), ("sine of 5 V at 400 Hz", 5.0)):
        setpoints = amplitude * np.sin(2 * np.pi * np.arange(BLOCK) / BLOCK)

        def block(setpoints=setpoints):
            nonlocal count
            clock.sleep_until(start + count / RATE)
            count += BLOCK
            assert supply.play(setpoints, 1 / RATE, sensor).shape == (BLOCK, 1)

        found[name] = microseconds(block, 40) / BLOCK
    with capsys.disabled():
        costs = (f"{name} {cost:.1f} µs ({1e6 / RATE / cost:.1f} times)" for name, cost in found.items())
        print(f"\nblocks of {BLOCK} at 20 kHz, CPU time a sample:", ", ".join(costs))
