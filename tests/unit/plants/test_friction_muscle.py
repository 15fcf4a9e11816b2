"""What the braided and the coiled muscle share: their contacts, their loops, and the equations as they read."""

import copy
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from cases import cases
from scipy.optimize import brentq

from sim_devices.plants.coiled_polymer import CoiledPolymerMuscle, CoiledPolymerParameters
from sim_devices.plants.friction_muscle import contact_table
from sim_devices.plants.mckibben import McKibbenMuscle, McKibbenParameters

LOADS = (0.98, 2.94, 4.90, 6.86, 8.82)
# The set-points of a damped oscillation, V, in steps of 0.3 V.
EXTREMES = (0.0, 3.0, 0.3, 2.7, 0.6, 2.4, 0.9, 2.1, 1.2, 1.8, 1.5)
VOLTAGES = [0.0] + [
    float(v) for a, b in itertools.pairwise(EXTREMES) for v in np.linspace(a, b, round(abs(b - a) / 0.3) + 1)[1:]
]


@dataclass(frozen=True)
class Case:
    """A muscle and its numbers; a range of a loop is that of its widest place, in parts of its height."""

    kind: Callable[..., Any]
    plain: Any
    smooth: Any
    """Parameters without friction."""
    contact_stiffness: float
    """Stiffness of all contacts, N/mm."""
    settled: float
    """Time after which hardly anything moves any more, s."""
    lag: float
    """What is left of the resting force then, N."""
    highest_force: float
    """Force at constant length and 3 V, N."""
    travel: tuple[float, float]
    """Range of the length at constant load, mm."""
    loops_at_load: tuple[float, float, float]
    """Narrowest and widest loop at constant load, and how much the loop grows with the load at least."""
    loops_at_voltage: tuple[float, float]
    """Narrowest and widest loop at constant voltage."""
    ramp: float
    """Time of a change of the voltage that is spread over many steps, s."""
    rate_effect: float
    """How much the length after it depends on the steps, m."""

    def make(self, parameters=None, seed=1):
        return self.kind(parameters or self.plain, np.random.default_rng(seed))

    def reset(self, muscle):
        muscle.hang(0.3)
        for voltage in (3.0, 0.0):
            muscle.apply(voltage)
            muscle.advance(2.0 * self.settled)


MCKIBBEN = Case(
    McKibbenMuscle,
    McKibbenParameters(),
    smooth=McKibbenParameters(friction=0.0, friction_coefficient=0.0, friction_jam=0.0, pressure_band=0.0),
    contact_stiffness=1.2,
    settled=30.0,
    lag=1e-6,
    highest_force=16.6,
    travel=(-17.9, 5.3),
    loops_at_load=(0.10, 0.20, 1.2),
    loops_at_voltage=(0.10, 0.25),
    ramp=10.0,
    rate_effect=1e-10,
)
COILED = Case(
    CoiledPolymerMuscle,
    CoiledPolymerParameters(),
    smooth=CoiledPolymerParameters(friction=0.0, friction_load=0.0, friction_coils=0.0),
    contact_stiffness=0.6,
    settled=60.0,
    lag=1e-4,
    highest_force=8.7,
    travel=(-7.1, 6.5),
    loops_at_load=(0.07, 0.22, 1.5),
    loops_at_voltage=(0.05, 0.20),
    ramp=200.0,
    # The yield force depends on the arm's tension.
    rate_effect=2e-5,
)


def name(case):
    return case.kind.__name__


@pytest.fixture(scope="module", params=[MCKIBBEN, COILED], ids=name)
def case(request):
    return request.param


mckibben = pytest.mark.parametrize("case", [MCKIBBEN], indirect=True, ids=name)
coiled = pytest.mark.parametrize("case", [COILED], indirect=True, ids=name)


def test_contacts_are_those_of_the_population(case):
    stiffness, weight, share = contact_table(replace(case.plain, contact_count=100_000))
    assert stiffness.sum() == pytest.approx(case.contact_stiffness)
    assert np.ptp(stiffness) == 0.0
    assert weight.sum() == pytest.approx(1.0)
    assert np.log(weight).std() == pytest.approx(0.8, rel=0.02)
    assert share.mean() == pytest.approx(1.0)
    assert share.min() >= 0.0
    assert share.std() == pytest.approx(1.0 / math.sqrt(3.0), rel=0.02)


@cases("wrong", [{"contact_count": 0}, {"friction": -0.1}, {"rated_voltage": 6.0}])
def test_wrong_parameters_are_refused(case, wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        replace(case.plain, **wrong)


def widest(up, down):
    """Widest distance of two branches over their common abscissa, in parts of their range; rows x and y, x rising."""
    low, high = max(up[0][0], down[0][0]), min(up[0][-1], down[0][-1])
    x = np.linspace(low, high, 50)
    return np.max(np.abs(np.interp(x, *up) - np.interp(x, *down))) / np.ptp(np.append(up[1], down[1]))


def voltage_loop(values):
    top = VOLTAGES.index(3.0)
    bottom = top + 9
    return widest(
        (VOLTAGES[: top + 1], values[: top + 1]), (VOLTAGES[bottom : top - 1 : -1], values[bottom : top - 1 : -1])
    )


@pytest.fixture(scope="module")
def loops_at_load(case):
    """Length, mm, one row a load and one column a voltage."""
    muscle = case.make()
    travel = []
    for load in LOADS:
        case.reset(muscle)
        muscle.hang(load)
        for voltage in VOLTAGES:
            muscle.apply(voltage)
            muscle.advance(case.settled)
            travel.append(muscle.length * 1e3)
            assert muscle.force == pytest.approx(load)
    return np.array(travel).reshape(len(LOADS), -1)


@pytest.fixture(scope="module")
def loops_at_voltage(case):
    """Force, N, and length, m, of loops between 0.3 and 10.5 N, one for each of some rising voltages."""
    loops = []
    for voltage in (0.0, 0.6, 1.2, 1.8, 2.4, 3.0):
        muscle = case.make()
        case.reset(muscle)
        muscle.apply(voltage)
        muscle.advance(2.0 * case.settled)
        loaded = copy.deepcopy(muscle)
        loaded.hang(10.5)
        loaded.advance(case.settled)
        up = np.linspace(muscle.position, loaded.position, 12)
        force, length = [], []
        for place in [*up, *up[-2::-1]]:
            muscle.clamp(float(place))
            muscle.advance(case.settled)
            force.append(muscle.force)
            length.append(muscle.length)
        loops.append((force, length))
    return loops


class TestRanges:
    def test_force_at_constant_length(self, case):
        muscle = case.make()
        case.reset(muscle)
        muscle.clamp(muscle.position)
        force = []
        for voltage in VOLTAGES:
            muscle.apply(voltage)
            muscle.advance(case.settled)
            force.append(muscle.force)
        top = VOLTAGES.index(3.0)
        assert force[0] == pytest.approx(0.3, abs=case.lag)
        assert max(force) == force[top] == pytest.approx(case.highest_force, abs=0.2)
        # Coming down, the same voltage holds more force than going up.
        assert 0.04 < voltage_loop(force) < 0.08
        assert force[top + 5] > np.interp(VOLTAGES[top + 5], VOLTAGES[: top + 1], force[: top + 1])

    def test_length_at_constant_load(self, case, loops_at_load):
        shortest, longest = case.travel
        assert loops_at_load.min() == pytest.approx(shortest, abs=0.2)
        assert loops_at_load.max() == pytest.approx(longest, abs=0.2)
        assert np.all(np.diff(loops_at_load, axis=0) > 0.0)
        # The loops differ with the load.
        loops = [voltage_loop(row) for row in loops_at_load]
        narrowest, widest_loop, growth = case.loops_at_load
        assert narrowest < loops[0] < loops[-1] < widest_loop
        assert loops[-1] > growth * loops[0]

    @coiled
    def test_touching_coils_contract_less(self, loops_at_load):
        # The coils touch under the lightest load: the last volts contract the muscle less than under the next.
        contraction = loops_at_load[:, VOLTAGES.index(2.7)] - loops_at_load[:, VOLTAGES.index(3.0)]
        assert contraction[0] < 0.5 * contraction[2]

    def test_length_against_force_at_constant_voltage(self, case, loops_at_voltage):
        narrowest, widest_loop = case.loops_at_voltage
        for force, length in loops_at_voltage:
            assert force[0] == pytest.approx(0.3, abs=case.lag)
            assert force[11] == pytest.approx(10.5, abs=0.05)
            assert np.all(np.diff(force[:12]) > 0.0)
            assert np.all(np.diff(force[11:]) <= 0.0)
            loop = widest((force[:12], length[:12]), (force[:10:-1], length[:10:-1]))
            assert narrowest < loop < widest_loop

    @mckibben
    def test_loss_grows_with_pressure(self, loops_at_voltage):
        # Pressure presses the threads together: per travel, the loop's loss grows with it.
        loss = [np.trapezoid(force, length) / np.ptp(length) for force, length in loops_at_voltage]
        assert loss[-1] > 2.0 * loss[1] > 2.0 * loss[0] > 0.0

    def test_loops_hardly_depend_on_the_rate(self, case):
        lengths = []
        for parts in (1, 40):
            muscle = case.make()
            muscle.hang(4.0)
            for begin, end in ((0.0, 2.8), (2.8, 0.9), (0.9, 1.9)):
                for voltage in np.linspace(begin, end, parts + 1)[1:]:
                    muscle.apply(float(voltage))
                    muscle.advance(case.ramp / parts)
                muscle.advance(200.0)
            lengths.append(muscle.length)
        assert lengths[0] == pytest.approx(lengths[1], abs=case.rate_effect)


def braid_force(parameters, pressure, length):
    """Chou and Hannaford 1996, in the braid's angle and diameter: N from Pa and m."""
    angle = math.acos(length / parameters.thread_length)
    diameter = parameters.thread_length * math.sin(angle) / (parameters.turns * math.pi)
    return pressure * math.pi * diameter**2 / 4.0 * (3.0 * math.cos(angle) ** 2 - 1.0) / math.sin(angle) ** 2


def coil(parameters, temperature, x):
    """Stiffness (N/m), free contraction (m) and tension (N) of the coil and its contact, as they read."""
    p = parameters

    def contraction(celsius):
        soft = math.log(1.0 + math.exp((celsius - p.softening) / p.softening_width))
        return p.expansion * celsius + p.expansion_above * p.softening_width * soft

    cold = 1.0 / (1.0 + math.exp((temperature - p.softening) / p.softening_width))
    stiffness = cold * p.cold_stiffness + (1.0 - cold) * p.hot_stiffness
    freed = contraction(temperature) - contraction(p.ambient_temperature)
    touch = p.coil_contact * (p.coil_length - x) ** 2 if x < p.coil_length else 0.0
    return stiffness, freed, stiffness * (x + freed), touch


class TestWithoutFriction:
    @mckibben
    @cases("voltage", [0.6, 1.5, 3.0])
    @cases("load", [1.0, 4.9, 10.0])
    def test_force_is_that_of_the_braid_and_the_bladder(self, case, voltage, load):
        muscle = case.make(case.smooth)
        muscle.hang(load)
        muscle.apply(voltage)
        muscle.advance(60.0)
        assert muscle.pressure == pytest.approx(0.5e5 * voltage)
        x = muscle.length
        elastic = 300.0 * x + 0.12e6 * x**3 + 0.22e6 * max(x, 0.0) ** 2
        assert braid_force(case.smooth, muscle.pressure, 110e-3 + x) + elastic == pytest.approx(load, abs=1e-8)

    @coiled
    @cases("voltage", [0.0, 1.5, 3.0])
    @cases("load", [0.5, 4.9, 10.0])
    def test_force_is_that_of_the_coil(self, case, voltage, load):
        muscle = case.make(case.smooth)
        muscle.hang(load)
        muscle.apply(voltage)
        muscle.advance(600.0)
        assert muscle.temperature == pytest.approx(25.0 + 95.0 * (voltage / 3.0) ** 2)
        # Without friction the muscle as made is at its resting length.
        _, _, tension, touch = coil(case.smooth, muscle.temperature, muscle.length)
        assert tension - touch == pytest.approx(load, abs=1e-8)
        assert (touch > 0.0) == (muscle.length < -6e-3)

    def test_nothing_is_remembered(self, case):
        muscle = case.make(case.smooth)
        lengths = []
        for load, voltage in ((9.0, 3.0), (0.0, 0.0), (2.0, 1.0)):
            muscle.hang(load)
            muscle.apply(voltage)
            muscle.advance(5.0 * case.settled)
            muscle.hang(4.0)
            muscle.apply(2.0)
            muscle.advance(10.0 * case.settled)
            lengths.append(muscle.length)
        assert lengths == pytest.approx([lengths[0]] * 3, abs=1e-11)


class NaiveMuscle:
    """A muscle's equations as they read, with a state of its own; SI units."""

    search: tuple[float, float]
    """Where the length is looked for, m."""
    length_step: float
    drive_step: float

    def __init__(self, muscle, drive):
        self.p = muscle.parameters
        stiffness, self.weight, self.share = contact_table(self.p)
        self.stiffness = stiffness * 1e3
        self.rest = muscle._coefficients["rest"] * 1e-3
        self.x = muscle.length + self.rest
        self.contacts = muscle._parts.forces.copy()
        self.drive = drive
        self.arm = 0.0
        self.force = muscle.force
        self.position = muscle.position

    def settle(self, drive, seconds, load=None, position=None):
        def excess(x):
            wanted = load if position is None else (position + self.rest - x) * self.p.series_stiffness
            return self.trial(x, drive, seconds)[0] - wanted

        x = brentq(excess, *self.search, xtol=1e-15)
        force = load
        if position is not None:
            force = (position + self.rest - x) * self.p.series_stiffness
            if force < 0.0:
                x = brentq(lambda x: self.trial(x, drive, seconds)[0], *self.search, xtol=1e-15)
                force = 0.0
        _, self.contacts, self.arm = self.trial(x, drive, seconds)
        self.x, self.drive, self.force = x, drive, force
        self.position = x - self.rest + force / self.p.series_stiffness if position is None else position

    def follow(self, command, value, drive):
        """Reach load or position, and then pressure or temperature in 0.1 s, in the plant's sub-steps."""
        imposed = "load" if command == "hang" else "position"
        begin, largest = (self.force, 0.1) if command == "hang" else (self.position, self.length_step)
        parts = math.ceil(abs(value - begin) / largest)
        for k in range(1, parts + 1):
            self.settle(self.drive, 0.0, **{imposed: begin + (value - begin) * k / parts})
        begin = self.drive
        parts = max(math.ceil(abs(drive - begin) / self.drive_step - 1e-9), 1)
        for k in range(1, parts + 1):
            self.settle(begin + (drive - begin) * k / parts, 0.1 / parts, **{imposed: value})

    def assert_agrees(self, muscle):
        assert muscle.length == pytest.approx(self.x - self.rest, abs=1e-11)
        assert muscle.force == pytest.approx(self.force, abs=1e-6)
        assert muscle.position == pytest.approx(self.position, abs=1e-11)
        assert muscle._parts.forces == pytest.approx(self.contacts, abs=1e-7)


class NaiveMcKibben(NaiveMuscle):
    search = (-0.08, 0.02)
    length_step = 0.25e-3
    drive_step = 2e3

    def trial(self, x, pressure, _seconds):
        p = self.p
        jam = p.jam * x**2 if x > 0.0 else 0.0
        surface = math.pi * p.braid_diameter * p.rest_length
        most = self.weight * (p.friction + p.friction_coefficient * surface * pressure + p.friction_jam * jam)
        moved = x - self.x - self.share * p.slip * (pressure - self.drive)
        contacts = np.clip(self.contacts + self.stiffness * moved, -most, most)
        smooth = braid_force(p, pressure, p.rest_length + x) + p.bladder_stiffness * x + p.bladder_cube * x**3 + jam
        return smooth + contacts.sum(), contacts, 0.0


class NaiveCoiledPolymer(NaiveMuscle):
    search = (-0.05, 0.05)
    length_step = 0.1e-3
    drive_step = 1.0

    def trial(self, x, temperature, seconds):
        p = self.p
        stiffness, freed, tension, touch = coil(p, temperature, x)
        # The arm between two springs' ends that part evenly.
        left, mean = 1.0, 1.0
        if seconds > 0.0:
            left = math.exp(-seconds / p.arm_time)
            mean = (1.0 - left) * p.arm_time / seconds
        arm = left * self.arm + mean * p.arm_stiffness * (x - self.x)
        most = p.friction * stiffness / p.cold_stiffness + p.friction_coils * touch
        most += p.friction_load * max(tension + arm, 0.0)
        moved = x - self.x - self.share * p.slip * (freed - coil(p, self.drive, 0.0)[1])
        contacts = np.clip(self.contacts + self.stiffness * moved, -self.weight * most, self.weight * most)
        return tension - touch + arm + contacts.sum(), contacts, arm


class TestAgainstTheNaiveEquations:
    def test_mckibben(self):
        muscle = MCKIBBEN.make(replace(MCKIBBEN.plain, supply_sd=500.0), seed=5)
        naive = NaiveMcKibben(muscle, muscle.pressure)
        script = np.random.default_rng(8)
        slack = 0
        for k in range(120):
            if k % 12 == 0:
                command, value = "hang", float(script.uniform(0.0, 9.0))
                if script.random() < 0.5:
                    command, value = "clamp", float(script.uniform(-14e-3, 5e-3))
                getattr(muscle, command)(value)
            if k % 17 == 0:
                muscle.apply(float(script.uniform(0.0, 3.0)))
            muscle.advance(0.1)
            naive.follow(command, value, muscle.pressure)
            naive.assert_agrees(muscle)
            slack += muscle.force == 0.0
        assert slack > 0

    def test_coiled_polymer(self):
        muscle = COILED.make(replace(COILED.plain, ambient_sd=0.3), seed=5)
        naive = NaiveCoiledPolymer(muscle, muscle.temperature)
        script = np.random.default_rng(8)
        slack = touching = 0
        for k in range(300):
            if k % 25 == 0 and k < 225:
                command, value = "hang", float(script.uniform(0.0, 5.0))
                if script.random() < 0.5:
                    command, value = "clamp", float(script.uniform(-8e-3, 5e-3))
                getattr(muscle, command)(value)
            if k == 225:
                command, value = "hang", 0.5
                muscle.hang(value)
            if k % 60 == 0:
                muscle.apply(5.0 if k >= 180 else float(script.uniform(0.0, 5.0)))
            muscle.advance(0.1)
            naive.follow(command, value, muscle.temperature)
            naive.assert_agrees(muscle)
            slack += muscle.force == 0.0
            touching += naive.x < COILED.plain.coil_length
        assert slack > 0
        assert touching > 0
