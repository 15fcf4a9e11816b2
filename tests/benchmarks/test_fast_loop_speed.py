"""The fine loop at 20 kHz through the engine, beside a plain loop of the same calls. Prints, asserts no time."""

import numpy as np
import pytest

from bench.clock import Stopwatch, VirtualClock
from bench.engine import Engine
from bench.hysteresis import Polynomial, PrandtlIshlinskii
from bench.interrupts import Interrupts
from bench.journal import FILE_NAME, Journal
from bench.protocol import FixedRate, ProtocolParameters, protocol
from bench.rig import Rig
from bench.rig_file import load_rig
from bench.runs import trace_signals
from rigs.hybrid.control import make_fine
from rigs.hybrid.design import Design
from rigs.hybrid.model import PUBLISHED_DYNAMICS, HybridModel

pytestmark = pytest.mark.benchmark

RATE, COUNT = 20e3, 20_000
STEP = 5e-6
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
    return make_fine(model, lambda t: STEP if t >= 0.05 else 0.0, rate=RATE)


def through_the_engine(folder, record_every):
    """Return the seconds of the run and the deflection (m) in the end."""

    @protocol(needs=("piezo", DEFLECTION), controls=DEFLECTION)
    def fine(parameters: Nothing):
        """Follow a step."""
        yield FixedRate(
            controller=make_controller(),
            rate=RATE,
            duration=COUNT / RATE,
            inputs=(DEFLECTION,),
            actuators=("piezo",),
            record_every=record_every,
        )

    folder.mkdir()
    with Rig(load_rig(__import__("os").environ.get("BRIG", "hybrid-direct")), VirtualClock(), 1) as rig:
        journal = Journal(folder / FILE_NAME, (*rig.signals, *trace_signals(fine, rig, {})), {})
        watch = Stopwatch()
        outcome = Engine(rig, journal, (), Interrupts()).run(fine, Nothing())
        seconds = watch.seconds()
        journal.close()
        assert outcome.status == "completed", outcome.reason
        return seconds, rig.laboratory.plant.deflection


def by_hand():
    """Return the same of a loop that calls sensor, controller and amplifier, and nothing else."""
    with Rig(load_rig(__import__("os").environ.get("BRIG", "hybrid-direct")), VirtualClock(), 1) as rig:
        sensor, supply = rig.devices["displacement"], rig.devices["piezo"]
        controller, clock = make_controller(), rig.clock
        start = clock.now()
        watch = Stopwatch()
        for k in range(COUNT):
            clock.sleep_until(start + k / RATE)
            (voltage,) = controller.update(clock.now() - start, (sensor.glance()[DEFLECTION],))
            if voltage != supply.setpoint:
                supply.set(voltage)
        seconds = watch.seconds()
        clock.sleep_until(start + COUNT / RATE)
        deflection = sensor.measure() and rig.laboratory.plant.deflection
        supply.safe()
        return seconds, deflection


def test_a_second_of_the_fine_loop(tmp_path, capsys):
    by_hand()
    plain, all_recorded, few_recorded = [], [], []
    for k in range(5):
        seconds, by_itself = by_hand()
        plain.append(seconds)
        seconds, deflection = through_the_engine(tmp_path / f"all{k}", 1)
        all_recorded.append(seconds)
        few_recorded.append(through_the_engine(tmp_path / f"few{k}", 100)[0])
        assert by_itself == pytest.approx(STEP, abs=0.1e-6)
        assert deflection == pytest.approx(STEP, abs=5e-6)
    with capsys.disabled():
        print(f"\n20 kHz fine loop on the virtual clock: plain {COUNT / np.median(plain):.0f} samples/s", end="")
        for name, seconds in (("every sample", all_recorded), ("one of 100", few_recorded)):
            print(
                f"; engine that records {name} {COUNT / np.median(seconds):.0f} samples/s, "
                f"ratio {np.median(seconds) / np.median(plain):.2f}",
                end="",
            )
        print()
