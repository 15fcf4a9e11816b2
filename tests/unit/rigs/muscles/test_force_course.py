"""The load cell's conversions that wait for a request give what they give when each is made at its instant."""

import numpy as np
import pytest

from bench.base import VirtualClock
from rigs.muscles.laboratory import (
    LOAD,
    STAGE,
    CoiledPolymerLaboratory,
    ForceCourse,
    McKibbenLaboratory,
    SMALaboratory,
)

LABORATORIES = (SMALaboratory, McKibbenLaboratory, CoiledPolymerLaboratory)
FAULTS = ("force.drifting", "force.noisy", "force.stuck", "broken-muscle", "load_cell.freeze")
WEIGHT, FILTER = 0x3500, 0x2106


def readings(kind, seed, steps=120):
    """Return what a script of random acts, at random instants, reads of weight and status."""
    script = np.random.default_rng(seed)
    clock = VirtualClock()
    laboratory = kind(kind.Settings(), clock, seed)
    cell = laboratory.load_cell
    read = []
    laboratory.operate(LOAD, 4.9)
    for _ in range(steps):
        clock.sleep(float(10.0 ** script.uniform(-3.0, 1.7)))
        act = script.integers(10)
        if act == 0:
            laboratory.operate(LOAD, float(script.uniform(0.5, 8.0)))
        elif act == 1:
            laboratory.operate(STAGE, 0.0)
        elif act == 2:
            laboratory.servo.write_item(64, 1)
            laboratory.servo.write_item(116, int(script.integers(2000, 2400)))
        elif act == 3:
            laboratory.supply.write_object(0x2000, int(script.integers(0, 300)), 1)
        elif act == 4:
            # Most end while nobody looks.
            laboratory.inject(FAULTS[script.integers(len(FAULTS))], duration=float(script.uniform(0.05, 5.0)))
        elif act == 5:
            cell.write_registers(FILTER, [0, int(script.integers(0, 9))])
        elif act == 6:
            # Others may ask for long before the cell is.
            laboratory.t7.convert(0)
        elif act == 7:
            cell.power_cycle()
        if act >= 7 and cell.answering:
            read.append((clock.now(), *cell.read_registers(WEIGHT, 5)))
    return read


@pytest.mark.parametrize("kind", LABORATORIES)
@pytest.mark.parametrize("seed", range(4))
def test_conversions_that_wait_are_those_made_at_their_instants(kind, seed, monkeypatch):
    waited = readings(kind, seed)
    monkeypatch.setattr(ForceCourse, "is_known", property(lambda _: False))
    assert readings(kind, seed) == waited
    assert len({row[1:] for row in waited}) > 10


@pytest.mark.parametrize("kind", LABORATORIES)
def test_many_readings_of_others_lose_none(kind, monkeypatch):
    def weights():
        clock = VirtualClock()
        laboratory = kind(kind.Settings(), clock, 1)
        laboratory.operate(LOAD, 4.9)
        read = []
        for number in range(1500):
            clock.sleep(0.06)
            laboratory.t7.convert(0)
            if number % 499 == 498:
                read.append(laboratory.load_cell.read_registers(WEIGHT, 5))
        return read

    waited = weights()
    monkeypatch.setattr(ForceCourse, "is_known", property(lambda _: False))
    assert weights() == waited
