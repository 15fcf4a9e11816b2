import math

import numpy as np
import pytest

from sim_devices.plants.mckibben import McKibbenMuscle, McKibbenParameters

PLAIN = McKibbenParameters()


def make(parameters=PLAIN, seed=1):
    return McKibbenMuscle(parameters, np.random.default_rng(seed))


def test_geometry():
    assert PLAIN.braid_diameter == pytest.approx(6.47e-3, abs=1e-5)
    assert math.degrees(math.acos(PLAIN.rest_length / PLAIN.thread_length)) == pytest.approx(32.9, abs=0.1)


def test_large_move_leaves_the_memory_of_small_ones():
    once, bit_by_bit = make(), make()
    for muscle in (once, bit_by_bit):
        muscle.apply(2.0)
        muscle.advance(30.0)
    once.hang(9.0)
    once.advance(0.1)
    for load in np.linspace(0.0, 9.0, 361):
        bit_by_bit.hang(float(load))
        bit_by_bit.advance(0.1)
    assert once.length == pytest.approx(bit_by_bit.length, abs=1e-11)


class TestPressure:
    def test_time_constant_and_steady_pressure(self):
        muscle = make(McKibbenParameters(pressure_band=0.0))
        muscle.apply(2.0)
        for k in range(1, 40):
            muscle.advance(0.1)
            assert muscle.pressure == pytest.approx(1e5 * -math.expm1(-0.1 * k / 0.3))
        assert muscle.voltage == 2.0
        assert muscle.current == pytest.approx(0.2e-3)

    def test_regulator_lags_by_its_band(self):
        muscle = make()
        for voltage, expected in (
            (2.0, 0.9875e5),
            (2.04, 1.0075e5),
            (2.0, 1.0075e5),
            (1.0, 0.5125e5),
            (0.0, 0.0125e5),
        ):
            muscle.apply(voltage)
            muscle.advance(30.0)
            assert muscle.pressure == pytest.approx(expected)

    def test_exhaust_speeds_up_emptying_only(self):
        muscle = make(McKibbenParameters(pressure_band=0.0))
        muscle.blow(True)
        muscle.apply(2.0)
        muscle.advance(0.3)
        assert muscle.pressure == pytest.approx(1e5 * -math.expm1(-1.0))
        muscle.advance(30.0)
        muscle.apply(1.0)
        muscle.advance(0.1)
        assert muscle.pressure == pytest.approx(0.5e5 * (1.0 + math.exp(-1.0)))
        muscle.blow(False)
        muscle.advance(0.3)
        assert muscle.pressure == pytest.approx(0.5e5 * (1.0 + math.exp(-2.0)))

    def test_supply_statistics(self):
        muscle = make(McKibbenParameters(contact_count=1, supply_sd=500.0), seed=3)
        muscle.apply(2.0)
        muscle.advance(60.0)
        pressure = np.empty(4000)
        for k in range(pressure.size):
            muscle.advance(5.0)
            pressure[k] = muscle.pressure - 0.9875e5
        # A first-order lag of 0.3 s takes away 1.5 % of it.
        assert pressure.std() == pytest.approx(500.0 * math.sqrt(10.0 / 10.3), rel=0.06)
        assert np.mean(pressure[:-2] * pressure[2:]) / pressure.var() == pytest.approx(math.exp(-1.0), abs=0.08)
