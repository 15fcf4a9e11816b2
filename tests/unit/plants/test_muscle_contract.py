"""What every muscle promises, whatever drives it, and what every heated one does."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from cases import cases
from hypothesis import given, settings, strategies as st
from plant_outputs import snapshot

from sim_devices.plants.coiled_polymer import CoiledPolymerMuscle, CoiledPolymerParameters
from sim_devices.plants.mckibben import McKibbenMuscle, McKibbenParameters
from sim_devices.plants.sma import SMAParameters, SMAWire, grain_table

# One grain's worth of transformation strain: closer the wire of 2000 grains cannot meet an imposed length, m.
GRAIN = 0.045 * 105e-3 / 2000
AREA = 0.25 * math.pi * 0.20e-3**2
# Grains whose detwinning stress is cut off at 5 MPa: all of them orient at that one stress.
CUT_OFF = np.count_nonzero(grain_table(SMAParameters())[3] == 5.0)


def coarseness_of_the_wire(force):
    together = CUT_OFF if math.isclose(force, 5e6 * AREA, rel_tol=1e-6) else 0
    return (1.5 + together) * GRAIN


@dataclass(frozen=True)
class Case:
    """A muscle and what is particular to it."""

    kind: Callable[..., Any]
    plain: Any
    """Parameters without noise."""
    lively: Any
    """Parameters with noise."""
    start: dict[str, float]
    """Outputs at the start that are not the same in every muscle."""
    settled: float
    """Time after which nothing moves any more, s."""
    highest_voltage: float
    """Highest voltage of a random past, V."""
    past_load: float
    """Largest load of a random past, N."""
    largest_load: float
    """Largest load, N."""
    too_heavy: float
    too_far: float
    """A load, N, and a place, m, that are refused."""
    places: tuple[float, float]
    """Where its end may be held, from slack to tight, m."""
    slack: float
    """Where the cold muscle is slack and the hot one is not, m."""
    reaches_its_limit: bool = True
    """Whether it comes to its largest load at `places`."""
    coarseness: Callable[[float], float] = lambda _force: 1e-12
    """How closely it meets an imposed length, m, from its force, N."""
    rounding: float = 0.0
    """How closely its force is the one imposed, N."""
    expansion: float = 0.0
    """Elongation as it is heated, m/V²: 85 K at 3 V."""
    slackening: float = 0.0
    """Loss of force as it is heated at constant length, N/V²: the expansion times wire and frame, 9.03 kN/m."""
    jump: dict[str, float] = field(default_factory=dict)
    """What is not kept to 1e-8 where load and servo take turns."""
    # Heated muscles only: specimen with a single element, rise at 3 V (K), time constants (s), resistance (ohm).
    single: dict[str, int] = field(default_factory=dict)
    rise: float = math.nan
    time_constant: float = math.nan
    fan_time_constant: float = math.nan
    resistance: float = math.nan

    def make(self, parameters=None, seed=1):
        return self.kind(parameters or self.plain, np.random.default_rng(seed))

    def with_past(self, data):
        muscle = self.make()
        steps = st.tuples(st.floats(0.0, self.highest_voltage), st.floats(0.0, self.past_load))
        for voltage, load in data.draw(st.lists(steps, max_size=5), label="past"):
            muscle.apply(voltage)
            muscle.hang(load)
            muscle.advance(self.settled)
        return muscle

    def voltages(self, data):
        return data.draw(st.lists(st.floats(0.0, self.highest_voltage), min_size=2, max_size=8), label="voltages")


SMA = Case(
    SMAWire,
    plain=SMAParameters(),
    lively=SMAParameters(grain_count=200, ambient_sd=0.3),
    start={"temperature": 25.0, "ambient_temperature": 25.0},
    settled=120.0,
    highest_voltage=5.0,
    past_load=18.0,
    # 600 MPa in 0.20 mm.
    largest_load=600e6 * AREA,
    too_heavy=19.0,
    too_far=0.2,
    places=(-3e-3, 4e-3),
    slack=-1e-3,
    reaches_its_limit=False,
    coarseness=coarseness_of_the_wire,
    rounding=1e-12,
    expansion=6.6e-6 * 105e-3 * 85.0 / 9.0,
    slackening=6.6e-6 * 105e-3 * 85.0 / 9.0 * 9.03e3,
    # One grain of 2000 more or less is worth some 0.02 N.
    jump={
        "force": 0.02,
        "length": 2.0 * GRAIN,
        "position": 2.0 * GRAIN,
        "martensite_fraction": 1e-3,
        "oriented_fraction": 1e-3,
    },
    single={"grain_count": 1},
    rise=85.0,
    time_constant=5.0,
    fan_time_constant=2.0,
    resistance=3.05,
)
COILED = Case(
    CoiledPolymerMuscle,
    plain=CoiledPolymerParameters(),
    lively=CoiledPolymerParameters(ambient_sd=0.3),
    start={"temperature": 25.0, "ambient_temperature": 25.0},
    settled=200.0,
    highest_voltage=3.8,
    past_load=12.0,
    largest_load=15.0,
    too_heavy=15.1,
    too_far=0.06,
    places=(-8e-3, 8e-3),
    slack=-4e-3,
    single={"contact_count": 1},
    rise=95.0,
    time_constant=8.0,
    fan_time_constant=3.0,
    resistance=12.0,
)
MCKIBBEN = Case(
    McKibbenMuscle,
    plain=McKibbenParameters(),
    lively=McKibbenParameters(supply_sd=500.0),
    start={"pressure": 0.0},
    settled=30.0,
    highest_voltage=5.0,
    past_load=20.0,
    largest_load=40.0,
    too_heavy=41.0,
    too_far=0.06,
    places=(-20e-3, 8e-3),
    slack=-4e-3,
)


@pytest.fixture(scope="module", params=[SMA, COILED, MCKIBBEN], ids=lambda case: case.kind.__name__)
def case(request):
    return request.param


heated = pytest.mark.parametrize("case", [SMA, COILED], indirect=True, ids=lambda case: case.kind.__name__)


class TestSpecimen:
    def test_specimen_does_not_depend_on_the_session(self, case):
        def run(parameters, seed):
            muscle = case.make(parameters, seed)
            muscle.hang(5.0)
            muscle.apply(2.0)
            muscle.advance(20.0)
            return snapshot(muscle)

        assert run(case.plain, 1) == run(case.plain, 2)
        assert run(replace(case.plain, specimen_seed=7), 1).length != run(case.plain, 1).length

    def test_starts_unloaded_and_at_its_resting_length(self, case):
        muscle = case.make()
        start = dict.fromkeys(("voltage", "current", "force", "length", "position"), 0.0) | case.start
        before = snapshot(muscle)
        assert {name: getattr(before, name) for name in start} == pytest.approx(start, abs=1e-12, rel=0.0)
        assert before.force == 0.0
        muscle.advance(3600.0)
        assert snapshot(muscle) == before


class TestDirections:
    """From a random past, one input is moved monotonically."""

    @given(st.data(), st.booleans())
    @settings(max_examples=60, deadline=None)
    def test_voltage_contracts(self, case, data, falling):
        muscle = case.with_past(data)
        muscle.hang(data.draw(st.floats(0.0, case.past_load), label="load"))
        voltages = sorted(case.voltages(data), reverse=falling)
        lengths = []
        for voltage in voltages:
            muscle.apply(voltage)
            muscle.advance(case.settled)
            lengths.append(muscle.length)
        # The first voltage may be reached from either side.
        backwards = 1e-11 + case.expansion * np.abs(np.diff(np.square(voltages)))
        assert np.all(np.diff(lengths) * (1 if falling else -1) >= -backwards)

    @given(st.data(), st.booleans())
    @settings(max_examples=60, deadline=None)
    def test_load_elongates(self, case, data, falling):
        muscle = case.with_past(data)
        muscle.apply(data.draw(st.floats(0.0, case.highest_voltage), label="voltage"))
        muscle.advance(case.settled)
        loads = data.draw(st.lists(st.floats(0.0, case.largest_load), min_size=2, max_size=8), label="loads")
        lengths = []
        for load in sorted(loads, reverse=falling):
            muscle.hang(load)
            muscle.advance(case.settled)
            lengths.append(muscle.length)
        assert np.all(np.diff(lengths) * (-1 if falling else 1) >= -1e-11)

    @given(st.data())
    @settings(max_examples=40, deadline=None)
    def test_voltage_pulls_at_constant_length(self, case, data):
        muscle = case.with_past(data)
        muscle.clamp(data.draw(st.floats(-6e-3, 4e-3), label="place"))
        muscle.advance(case.settled)
        voltages = sorted(case.voltages(data))
        forces = []
        for voltage in voltages:
            muscle.apply(voltage)
            muscle.advance(case.settled)
            forces.append(muscle.force)
        backwards = 1e-7 + case.jump.get("force", 0.0) + case.slackening * np.diff(np.square(voltages))
        assert np.all(np.diff(forces) >= -backwards)

    @given(st.data(), st.booleans())
    @settings(max_examples=40, deadline=None)
    def test_nothing_changes_while_nothing_changes(self, case, data, held):
        muscle = case.with_past(data)
        muscle.advance(3.0 * case.settled)
        if held:
            muscle.clamp(muscle.position)
            muscle.advance(case.settled)
        before = snapshot(muscle)
        muscle.advance(3600.0)
        assert snapshot(muscle) == before


class TestClamped:
    @given(st.data())
    @settings(max_examples=30, deadline=None)
    def test_imposed_length_is_met_or_the_muscle_is_slack(self, case, data):
        muscle = case.make()
        steps = st.tuples(st.floats(*case.places), st.floats(0.0, 3.0), st.integers(1, 150))
        for place, voltage, count in data.draw(st.lists(steps, min_size=1, max_size=8), label="steps"):
            muscle.clamp(place)
            muscle.apply(voltage)
            for _ in range(count):
                muscle.advance(0.1)
                assert muscle.position == pytest.approx(place, abs=1e-15)
                over = muscle.length + muscle.force / case.plain.series_stiffness - place
                coarseness = case.coarseness(muscle.force)
                if muscle.force == 0.0:
                    # Slack: longer than the room it has.
                    assert over >= -coarseness
                elif muscle.force < case.largest_load or not case.reaches_its_limit:
                    assert abs(over) <= coarseness
                assert 0.0 <= muscle.force <= case.largest_load
                assert muscle.force < case.largest_load - 0.01 or case.reaches_its_limit

    def test_slack_muscle_carries_nothing_and_tightens_when_driven(self, case):
        muscle = case.make()
        muscle.clamp(case.slack)
        muscle.advance(case.settled)
        assert muscle.force == 0.0
        assert muscle.length > muscle.position
        muscle.apply(3.0)
        muscle.advance(case.settled)
        assert muscle.force > 5.0
        assert muscle.length < muscle.position

    @cases("voltage", [0.0, 3.0])
    def test_overstretched_muscle_stays_at_the_limit(self, case, voltage):
        muscle = case.make()
        muscle.clamp(50e-3)
        muscle.apply(voltage)
        for seconds in (0.1, case.settled):
            muscle.advance(seconds)
            assert muscle.force == pytest.approx(case.largest_load, abs=case.rounding)
            assert muscle.position == pytest.approx(50e-3)

    @cases("voltage", [0.0, 1.5, 3.0])
    @cases("load", [0.5, 4.9, 10.0])
    def test_changing_between_load_and_servo_is_continuous(self, case, load, voltage):
        def assert_kept(before):
            for name, value in before._asdict().items():
                assert getattr(muscle, name) == pytest.approx(value, abs=case.jump.get(name, 1e-8)), name

        muscle = case.make()
        muscle.hang(load)
        muscle.apply(voltage)
        muscle.advance(3.0 * case.settled)
        before = snapshot(muscle)
        muscle.clamp(muscle.position)
        assert snapshot(muscle) == before
        muscle.advance(1.0)
        assert_kept(before)
        held = snapshot(muscle)
        muscle.hang(held.force)
        assert snapshot(muscle) == held
        muscle.advance(1.0)
        assert_kept(held)
        assert muscle.force == pytest.approx(held.force, abs=1e-9)


def test_full_drive_under_the_pretension_erases_the_memory(case):
    script = np.random.default_rng(3)
    results = []
    for _ in range(4):
        muscle = case.make()
        for _ in range(6):
            if script.random() < 0.5:
                muscle.hang(float(script.uniform(0.0, 9.0)))
            else:
                muscle.clamp(float(script.uniform(*case.places)))
            muscle.apply(float(script.uniform(0.0, 3.0)))
            muscle.advance(float(script.uniform(1.0, 30.0)))
        muscle.hang(0.3)
        for voltage in (3.0, 0.0):
            muscle.apply(voltage)
            muscle.advance(case.settled)
        results.append(snapshot(muscle))
    for result in results[1:]:
        assert result == pytest.approx(results[0], abs=1e-9)


@heated
class TestHeat:
    @cases("voltage", [0.6, 1.5, 3.0])
    def test_time_constant(self, case, voltage):
        muscle = case.make()
        muscle.apply(voltage)
        rise = case.rise * (voltage / 3.0) ** 2
        for k in range(1, 300):
            muscle.advance(0.1)
            expected = 25.0 + rise * -math.expm1(-0.1 * k / case.time_constant)
            assert muscle.temperature == pytest.approx(expected, abs=1e-9)
        muscle.advance(600.0)
        assert muscle.temperature == pytest.approx(25.0 + rise, abs=1e-9)
        assert muscle.voltage == voltage
        assert muscle.current == pytest.approx(voltage / case.resistance)
        muscle.apply(0.0)
        muscle.advance(600.0)
        assert muscle.temperature == pytest.approx(25.0, abs=1e-9)

    def test_fan(self, case):
        muscle = case.make()
        muscle.apply(3.0)
        muscle.advance(600.0)
        muscle.apply(0.0)
        muscle.blow(True)
        muscle.advance(case.fan_time_constant)
        assert muscle.temperature == pytest.approx(25.0 + case.rise / math.e)
        muscle.blow(False)
        muscle.advance(case.time_constant)
        assert muscle.temperature == pytest.approx(25.0 + case.rise / math.e**2)
        # More heat loss is less rise too.
        muscle.apply(3.0)
        muscle.blow(True)
        muscle.advance(200.0)
        assert muscle.temperature == pytest.approx(25.0 + case.rise * case.fan_time_constant / case.time_constant)

    def test_ambient_statistics(self, case):
        parameters = replace(case.plain, **case.single, ambient_sd=0.3)
        muscle = case.make(parameters, seed=3)
        ambient = np.empty(6000)
        for k in range(ambient.size):
            muscle.advance(12.0)
            ambient[k] = muscle.ambient_temperature - 25.0
        assert ambient.std() == pytest.approx(0.3, rel=0.06)
        assert np.mean(ambient[:-10] * ambient[10:]) / ambient.var() == pytest.approx(math.exp(-1.0), abs=0.06)
        starts = [case.make(parameters, seed=seed).ambient_temperature for seed in range(300)]
        assert np.std(starts) == pytest.approx(0.3, rel=0.15)


class TestTime:
    # Whole microseconds, from one call to many, that add up to what the other plant does at once.
    pieces = st.lists(st.integers(0, 700_000), min_size=1, max_size=12)

    @given(st.data(), st.integers(0, 2**32 - 1))
    @settings(max_examples=60, deadline=None)
    def test_splitting_advance_changes_nothing(self, case, data, seed):
        commands = st.one_of(
            st.tuples(st.just("apply"), st.floats(0.0, 3.0)),
            st.tuples(st.just("hang"), st.floats(0.0, 9.0)),
            st.tuples(st.just("clamp"), st.floats(*case.places)),
            st.tuples(st.just("blow"), st.booleans()),
        )
        whole, split = case.make(case.lively, seed), case.make(case.lively, seed)
        script = st.lists(st.tuples(commands, self.pieces), min_size=1, max_size=8)
        for (name, argument), parts in data.draw(script, label="script"):
            getattr(whole, name)(argument)
            getattr(split, name)(argument)
            whole.advance(sum(parts) * 1e-6)
            for part in parts:
                split.advance(part * 1e-6)
            assert snapshot(split) == snapshot(whole)

    def test_one_seed_one_trajectory(self, case):
        def run(seed):
            muscle = case.make(case.lively, seed)
            rows = []
            for k in range(60):
                muscle.apply(1.5 + math.sin(0.7 * k))
                (muscle.clamp if k % 20 < 10 else muscle.hang)(1e-3 if k % 20 < 10 else 3.0)
                muscle.advance(3.0)
                rows.append(snapshot(muscle))
            return rows

        assert run(1) == run(1)
        assert run(1) != run(2)


class TestRefusals:
    @cases("dt", [-1e-9, math.nan, math.inf])
    def test_advance(self, case, dt):
        with pytest.raises(ValueError, match="dt must"):
            case.make().advance(dt)

    @cases("command", ["apply", "hang", "clamp"])
    @cases("side", ["below", "above", "not a number"])
    def test_commands(self, case, command, side):
        name, lowest, highest = {
            "apply": ("voltage", -0.1, 5.1),
            "hang": ("load_newton", -0.1, case.too_heavy),
            "clamp": ("length_metre", -case.too_far, case.too_far),
        }[command]
        muscle = case.make()
        before = snapshot(muscle)
        with pytest.raises(ValueError, match=f"{name} must lie"):
            getattr(muscle, command)({"below": lowest, "above": highest, "not a number": math.nan}[side])
        muscle.advance(1.0)
        assert snapshot(muscle) == before
