"""The fine loop at 20 kHz through the real drivers of the T7, by hand, through the engine, and in compiled blocks.

CPU time on the virtual clock; prints, asserts no time.
"""

import time

import numpy as np
import pytest
from numba import njit

from bench.base import Interrupts, VirtualClock
from bench.control import Trace
from bench.execution.context import trace_signals
from bench.execution.engine import Engine
from bench.execution.station.local import LocalStation
from bench.models import Polynomial, PrandtlIshlinskii
from bench.protocol import FixedRate, ProtocolParameters, protocol
from bench.record import FILE_NAME, Journal, Record
from bench.rig import Rig, load_rig
from rigs.hybrid.control import make_fine
from rigs.hybrid.design import Design
from rigs.hybrid.model import PUBLISHED_DYNAMICS, HybridModel
from rigs.hybrid.notch_loop import NotchLoopParameters, notch

pytestmark = pytest.mark.benchmark

RATE, COUNT = 20e3, 20_000
STEP = 5e-6
BLOCK = 50
REPEATS = 7
GAIN = 0.26e-6
"""Of the piezo, m/V."""
DEFLECTION = "displacement_position"


class Nothing(ProtocolParameters):
    pass


def make_controller():
    hysteresis = PrandtlIshlinskii(
        np.arange(15) * 40.0 / 15,
        np.array([150.0, *np.linspace(30.0, 2.0, 14)]) * 1e-9,
        input_range=(-40.0, 40.0),
    )
    polynomial = Polynomial([-7.363e-6 * 25.0], (-25.0, 25.0))
    model = HybridModel(Design().network(), polynomial, hysteresis, PUBLISHED_DYNAMICS)
    parameters = NotchLoopParameters(rate=RATE, integral=300.0, stroke=9e-6)
    return make_fine(model, lambda t: STEP if t >= 0.05 else 0.0, parameters)


@njit
def _step(readings, out, section, state, wanted, gain):
    """Integrate the error of each reading and filter by the notch; a set-point for each reading."""
    b0, b1, b2, _, a1, a2 = section
    for k in range(len(out)):
        if k < len(readings):
            state[0] += gain * (wanted[k] - readings[k, 0])
        filtered = b0 * state[0] + state[1]
        state[1] = b1 * state[0] - a1 * filtered + state[2]
        state[2] = b2 * state[0] - a2 * filtered
        out[k, 0] = min(max(filtered, -40.0), 40.0)


class CompiledLoop:
    """An integral and a notch that step a block of samples a call, with the delay that a block has."""

    def __init__(self):
        self._section = notch(2 * np.pi * 693.7, RATE, 0.03)
        self._state = np.zeros(3)
        self.trace = Trace()

    def step_block(self, times, readings, out):
        wanted = np.where(times >= 0.05, STEP, 0.0)
        _step(readings, out, self._section, self._state, wanted, 60.0 / RATE / GAIN)


def through_the_engine(folder, record_every, block=0):
    """Return the CPU time of the run, s, and the deflection (m) in the end."""

    @protocol(needs=("piezo", DEFLECTION), controls=DEFLECTION)
    def fine(parameters: Nothing):
        """Follow a step."""
        yield FixedRate(
            controller=CompiledLoop() if block else make_controller(),
            rate=RATE,
            duration=COUNT / RATE,
            inputs=(DEFLECTION,),
            actuators=("piezo",),
            record_every=record_every,
            block=block,
        )

    folder.mkdir()
    with Rig(load_rig("hybrid"), VirtualClock(), 1) as rig:
        journal = Journal(folder / FILE_NAME, (*rig.signals, *trace_signals(fine, rig.description, {})), {})
        start = time.process_time()
        outcome = Engine(LocalStation(rig), journal, (), Interrupts()).run(fine, Nothing())
        seconds = time.process_time() - start
        journal.close()
        assert outcome.status == "completed", outcome.reason
        with Record(folder) as record:
            deflection = record.steps()[DEFLECTION][-1]
        return seconds, deflection


def by_hand():
    """Return the same of a loop that calls sensor, controller and amplifier, and nothing else."""
    with Rig(load_rig("hybrid"), VirtualClock(), 1) as rig:
        sensor, supply = rig.devices["displacement"], rig.devices["piezo"]
        controller, clock = make_controller(), rig.clock
        supply.set(0.0)
        start = clock.now()
        begin = time.process_time()
        for k in range(COUNT):
            clock.sleep_until(start + k / RATE)
            (voltage,) = controller.update(clock.now() - start, (sensor.glance()[DEFLECTION],))
            if voltage != supply.setpoint:
                supply.set(voltage)
        seconds = time.process_time() - begin
        clock.sleep_until(start + COUNT / RATE)
        return seconds, sensor.measure()[DEFLECTION]


def test_a_second_of_the_fine_loop(tmp_path, capsys):
    ways = {
        "by hand": lambda _: by_hand(),
        "engine, every sample recorded": lambda folder: through_the_engine(folder, 1),
        "engine, one of 100": lambda folder: through_the_engine(folder, 100),
        f"engine, compiled blocks of {BLOCK}, one of 100": lambda folder: through_the_engine(folder, 100, BLOCK),
    }
    found = {name: [] for name in ways}
    for repeat in range(1 + REPEATS):
        for number, (name, way) in enumerate(ways.items()):
            seconds, deflection = way(tmp_path / f"{number}-{repeat}")
            assert deflection == pytest.approx(STEP, abs=0.1e-6), name
            # The first compiles.
            if repeat:
                found[name].append(1e6 * seconds / COUNT)
    with capsys.disabled():
        print(f"\n20 kHz fine loop, CPU time a sample, median and least of {REPEATS}:")
        for name, costs in found.items():
            cost = np.median(costs)
            print(f"  {name}: {cost:.1f} and {min(costs):.1f} µs, {1e6 / RATE / cost:.1f} times real time")
