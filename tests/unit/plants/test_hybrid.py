import copy
import dataclasses
import math
from functools import cached_property

import numpy as np
import pytest
from cases import cases
from hypothesis import given, settings, strategies as st
from plant_outputs import snapshot
from scipy.integrate import solve_ivp
from scipy.signal import TransferFunction, lsim

from bench.base import VirtualClock
from bench.devices import TECMode
from sim_devices.instruments.meerstetter_tec import EmulatedTEC
from sim_devices.plants import _hybrid_kernels as kernels
from sim_devices.plants.hybrid import HybridCantilever
from sim_devices.plants.hybrid_parameters import (
    Bimorph,
    HybridParameters,
    piezo_dynamics,
    piezo_sensitivity,
    thermal_sensitivity,
)
from sim_devices.world import World

LIVELY = HybridParameters()
PLAIN = HybridParameters(ambient_sd=0.0)
PURE = dataclasses.replace(PLAIN, creep_share=0.0)
LONG = 10_000.0  # s, 23 time constants of the block


def make(parameters=PLAIN, seed=1):
    return HybridCantilever(parameters, np.random.default_rng(seed))


def settled(current, parameters=PLAIN):
    plant = make(parameters)
    plant.drive(current)
    plant.advance(LONG)
    return plant


def slope(temperatures, current, p):
    """Rates of block end, block front, back face, actuator face and ten elements: Kirchhoff's laws, written out."""
    end, front, back, face = temperatures[:4]
    beam = temperatures[4:]
    room, kelvin = p.ambient_temperature, 273.15
    joule = p.resistance * current**2 / 2
    part = 15e-3 / 10
    conductance = (1.4 * 0.2e-3 + 381.5 * 0.1e-3) * 2e-3 / part
    capacity = (7500 * 420 * 0.2e-3 + 8960 * 386 * 0.1e-3) * 2e-3 * part
    area = np.full(10, 2 * (2e-3 + 0.3e-3) * part)
    area[-1] += 2e-3 * 0.3e-3
    along = conductance * np.diff(beam)
    heat = -30.0 * (0.75 + 0.25 * (np.abs(beam - room) / 10) ** 0.25) * area * (beam - room)
    heat[0] += (face - beam[0]) / 6.0
    heat[:-1] += along
    heat[1:] -= along
    through = p.conductance * (back - face)
    glue = (back - front) / 2.5
    rates = [
        ((room - end) / 23.0 + (front - end) / 0.148) / 23.14,
        ((room - front) / 23.0 + (room - front) / 46.3 + (end - front) / 0.148 + glue) / 23.14,
        (-p.seebeck * (back + kelvin) * current + joule - through - glue) / 0.09,
        (p.seebeck * (face + kelvin) * current + joule + through + (beam[0] - face) / 6.0 - 2e-3 * (face - room))
        / 0.55,
    ]
    return np.concatenate([rates, heat / capacity])


class TestGeometry:
    def test_sensitivities_of_the_paper_s_strip(self):
        assert thermal_sensitivity(Bimorph()) == pytest.approx(-7.363e-6, rel=1e-3)
        assert piezo_sensitivity(Bimorph()) == pytest.approx(0.2687e-6, rel=1e-3)

    @given(st.floats(0.02e-3, 1e-3), st.floats(0.02e-3, 1e-3), st.floats(1e-12, 50e-12), st.floats(1e-12, 50e-12))
    def test_thermal_sensitivity_is_that_of_a_bimetal(self, ep, ec, sp, sc):
        strip = Bimorph(piezo_thickness=ep, passive_thickness=ec, piezo_compliance=sp, passive_compliance=sc)
        # Timoshenko, "Analysis of bi-metal thermostats", J. Opt. Soc. Am. 11(3), 1925, eq. 4, and L²/2.
        m, n = ep / ec, sc / sp
        curvature = 6 * (3.3e-6 - 17e-6) * (1 + m) ** 2
        curvature /= (ep + ec) * (3 * (1 + m) ** 2 + (1 + m * n) * (m**2 + 1 / (m * n)))
        assert thermal_sensitivity(strip) == pytest.approx(curvature * 15e-3**2 / 2, rel=1e-9)
        # An electric field strains as a temperature does, by d31 times voltage over thickness.
        volts = strip.piezo_coefficient / ep / (3.3e-6 - 17e-6)
        assert piezo_sensitivity(strip) == pytest.approx(-volts * thermal_sensitivity(strip), rel=1e-9)


class TestParameters:
    def test_wrong_commands_are_refused_and_change_nothing(self):
        plant = make()
        before = snapshot(plant)
        for command, value in (
            (plant.apply, 60.1),
            (plant.apply, math.nan),
            (plant.drive, -0.41),
            (plant.drive, math.nan),
            (plant.regulate, -300.0),
            (plant.step_ambient, -400.0),
            (plant.step_ambient, math.nan),
            (plant.advance, -1.0),
            (plant.advance, math.inf),
        ):
            with pytest.raises(ValueError, match="must"):
                command(value)
        with pytest.raises(ValueError, match="current_limit"):
            plant.regulate(25.0, -1.0)
        plant.advance(1.0)
        assert snapshot(plant) == before


class TestHeat:
    def test_rests_where_it_starts(self):
        plant = make()
        before = snapshot(plant)
        assert before.deflection == 0.0
        plant.advance(3600.0)
        assert snapshot(plant) == before

    @cases(
        ("current", "deflection", "tip"),
        [(-0.1, 101e-6, -14.1), (0.1, -175e-6, 19.8), (-0.05, 59e-6, None), (-0.025, 32e-6, None)],
    )
    def test_swing(self, current, deflection, tip):
        plant = settled(current)
        assert plant.deflection == pytest.approx(deflection, rel=0.01)
        assert abs(plant.deflection) > 100e-6 or tip is None
        if tip is not None:
            assert plant.tip_temperature - 22.0 == pytest.approx(tip, abs=0.2)
        assert plant.deflection == plant.thermal_deflection

    def test_strongest_cooling(self):
        parameters = dataclasses.replace(PLAIN, maximum_current=0.6)
        base = [settled(-current, parameters).base_temperature for current in (0.40, 0.43, 0.46)]
        assert base[1] < base[0]
        assert base[1] < base[2]

    def test_agrees_with_a_general_integrator_over_an_hour(self):
        plant = make()
        currents = [0.1, -0.1, 0.03, -0.15, 0.15, 0.0]
        temperatures = np.full(14, 22.0)
        worst = 0.0
        for current in currents:
            plant.drive(current)
            times = np.array([0.05, 0.2, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 600.0])
            exact = solve_ivp(
                lambda _, y, current=current: slope(y, current, PLAIN),
                (0.0, 600.0),
                temperatures,
                method="LSODA",
                t_eval=times,
                rtol=1e-10,
                atol=1e-10,
            ).y
            for place, dt in enumerate(np.diff(times, prepend=0.0)):
                plant.advance(float(dt))
                ours = plant._rise + 22.0
                worst = max(worst, float(np.abs(ours - exact[:, place]).max()))
            assert plant.base_temperature == pytest.approx(exact[3, -1], abs=1e-6)
            assert plant.tip_temperature == pytest.approx(exact[-1, -1], abs=1e-6)
            assert plant.sink_temperature == pytest.approx(exact[1, -1], abs=1e-6)
            temperatures = exact[:, -1]
        assert worst < 5e-4

    def test_energy_is_kept_on_the_way(self):
        plant = make()
        stored = plant.stored_heat
        gained = 0.0
        for current in (0.1, -0.15, 0.15, 0.0):
            plant.drive(current)
            for step in range(2000):
                plant.advance(0.5 * PLAIN.step)
                power = plant.current * plant.tec_voltage - plant.heat_to_air
                plant.advance(0.5 * PLAIN.step)
                gained += PLAIN.step * power
                if step > 500:
                    # What convection has beyond its linear part is extrapolated; all else balances to rounding.
                    assert abs(plant.stored_heat - stored - gained) < 1e-7
        assert abs(plant.stored_heat) > 0.3
        linear = make(dataclasses.replace(PLAIN, convection_share=0.0))
        linear.drive(0.15)
        for _ in range(500):
            before = linear.stored_heat
            linear.advance(0.5 * PLAIN.step)
            power = linear.current * linear.tec_voltage - linear.heat_to_air
            linear.advance(0.5 * PLAIN.step)
            assert abs((linear.stored_heat - before) / PLAIN.step - power) < 1e-9


class TestRoom:
    def test_temperature_wanders_as_the_parameters_say(self):
        plant = make(dataclasses.replace(LIVELY, step=1.0, ambient_time=20.0), seed=3)
        values = []
        for _ in range(40_000):
            plant.advance(1.0)
            values.append(plant.ambient_temperature)
        values = np.array(values)
        assert values.mean() == pytest.approx(22.0, abs=0.02)
        assert values.std() == pytest.approx(0.15, rel=0.05)
        deviation = values - values.mean()
        correlation = np.mean(deviation[20:] * deviation[:-20]) / values.var()
        assert correlation == pytest.approx(math.exp(-1.0), abs=0.05)

    def test_a_step_of_the_room_moves_everything_in_the_end(self):
        plant = make()
        plant.step_ambient(3.0)
        plant.step_ambient(2.0)
        assert plant.ambient_temperature == 27.0
        assert plant.tip_temperature == 22.0
        plant.advance(LONG)
        assert plant.tip_temperature == pytest.approx(27.0, abs=1e-6)
        assert plant.sink_temperature == pytest.approx(27.0, abs=1e-6)
        d = 5.0
        bent = thermal_sensitivity(PLAIN.bimorph) * (d + 0.006 * d**2 - 1e-4 * d**3)
        assert plant.deflection == pytest.approx(bent, rel=1e-6)
        assert plant.heat_to_air == pytest.approx(0.0, abs=1e-9)


def normalised(parameters=PLAIN, offset=0.0):
    """D(s)/D(0) as printed, in scipy's form."""
    quadratic = [1.0, 34.1 * (1 + offset), 1.9e7 * (1 + offset) ** 2]
    denominator = np.polymul([1.0, 1274.0], quadratic)
    numerator = np.array([1.0, 2.58e4, 2.4e8])
    return TransferFunction(numerator / 2.4e8 * denominator[-1], denominator)


class TestPiezo:
    def test_loop_at_a_tenth_of_a_hertz(self):
        plant = make()
        count = 20_000
        voltage = 40.0 * np.sin(2 * np.pi * np.arange(1, count + 1) / count)
        for _ in range(2):
            response = []
            for value in voltage:
                plant.apply(float(value))
                plant.advance(10.0 / count)
                response.append(plant.piezo_deflection)
        assert min(response) == pytest.approx(-9.3e-6, abs=0.1e-6)
        assert max(response) == pytest.approx(10.1e-6, abs=0.1e-6)
        # Falling through zero the strip is still bent up, rising down.
        assert response[count // 2 - 1] - response[-1] == pytest.approx(2.66e-6, abs=0.05e-6)

    def test_poles_and_steady_share(self):
        poles, shares = piezo_dynamics(PLAIN)
        assert poles[0] == pytest.approx(-17.05 + 4358.9j, abs=0.05)
        assert poles[0].imag / (2 * np.pi) == pytest.approx(693.7, abs=0.05)
        assert poles[1] == np.conj(poles[0])
        assert poles[2] == -1274.0
        assert np.array_equal(poles[3:], [-1.0, -0.1, -0.01])
        assert shares.sum() == pytest.approx(1.036, abs=1e-12)
        shifted, _ = piezo_dynamics(dataclasses.replace(PLAIN, resonance_offset=0.03))
        assert shifted[0] == pytest.approx(1.03 * poles[0], rel=1e-12)

    @cases("offset", [0.0, 0.03, -0.03])
    def test_agrees_with_scipy_at_any_spacing(self, offset):
        # Voltages at multiples of 50 µs, looked at only when they change.
        rng = np.random.default_rng(4)
        gaps = rng.integers(1, 400, size=60)
        levels = rng.uniform(-40.0, 40.0, size=60)
        plant = make(dataclasses.replace(PURE, resonance_offset=offset))
        drive, seen = [], []
        for gap, level in zip(gaps, levels, strict=True):
            plant.apply(float(level))
            drive += [plant._fast[kernels.DRIVE]] * gap
            plant.advance(50e-6 * gap)
            seen.append(plant.piezo_deflection)
        drive.append(drive[-1])
        times = 50e-6 * np.arange(len(drive))
        _, exact, _ = lsim(normalised(offset=offset), drive, times, interp=False)
        assert np.allclose(seen, exact[np.cumsum(gaps)], rtol=0.0, atol=1e-14)

    def test_creep(self):
        plant = make()
        plant.apply(40.0)
        plant.advance(0.5)
        early = plant.piezo_deflection
        seconds = np.array([0.5, 1.0, 5.0, 20.0, 100.0, 1000.0])
        drive = plant._fast[kernels.DRIVE]
        for t, dt in zip(seconds, np.diff(seconds, prepend=0.5), strict=True):
            plant.advance(float(dt))
            expected = 1.0 + 0.012 * sum(1.0 - math.exp(-t / tau) for tau in (1.0, 10.0, 100.0))
            assert plant.piezo_deflection / drive == pytest.approx(expected, rel=1e-4)
        assert 1.02 < plant.piezo_deflection / early < 1.036

    def test_grows_with_the_beam_s_temperature(self):
        cold, warm = make(), make()
        warm.step_ambient(10.0)
        for plant in (cold, warm):
            plant.advance(LONG)
            plant.apply(20.0)
            plant.advance(1.0)
        assert warm.piezo_deflection / cold.piezo_deflection == pytest.approx(1.03, rel=1e-6)
        assert warm.deflection == warm.thermal_deflection + warm.piezo_deflection


class TestHysteresis:
    @cached_property
    def constants(self):
        return make()._fast_coefficients

    @given(st.floats(-1.8e-6, 1.8e-6), st.floats(-80.0, 80.0).filter(lambda change: abs(change) > 0.1))
    @settings(max_examples=40, deadline=None)
    def test_solves_the_bouc_wen_equation(self, lag, change):
        sign = math.copysign(1.0, change)

        def slope(_, h):
            return 0.30 * 0.283 * sign - 0.040 * h - 0.006 * sign * np.abs(h)

        exact = solve_ivp(slope, (0.0, abs(change)), [lag * 1e6], rtol=1e-9, atol=1e-9, max_step=0.5).y[0, -1]
        # To a picometre or two: where h changes its sign the slope has a kink, which the integrator steps over.
        assert kernels.hysteresis(lag, change, self.constants) * 1e6 == pytest.approx(exact, abs=2e-6)

    @given(st.floats(-1.8e-6, 1.8e-6), st.floats(-80.0, 80.0), st.floats(0.0, 1.0))
    def test_does_not_depend_on_the_steps_of_a_way(self, lag, change, share):
        once = kernels.hysteresis(lag, change, self.constants)
        twice = kernels.hysteresis(lag, share * change, self.constants)
        twice = kernels.hysteresis(twice, change - share * change, self.constants)
        assert twice == pytest.approx(once, abs=1e-18)


# What happens at which multiple of 1 ms, off and on the grid of 10 ms.
EVENTS = [
    (0, "drive", 0.1),
    (0, "apply", 10.0),
    (7, "apply", -20.0),
    (13, "drive", -0.15),
    (40, "step_ambient", 5.0),
    (55, "apply", 30.0),
    (101, "drive", 0.05),
    (200, "regulate", 30.0),
    (333, "apply", 0.0),
    (700, "release", None),
    (1000, "drive", 0.1),
]


def play(parameters, cuts):
    """Carry out the events up to 1.2 s, advancing in between to further times as well."""
    plant = make(parameters)
    times = sorted({*cuts, *(0.001 * e[0] for e in EVENTS), 1.2})
    now, events = 0.0, list(EVENTS)
    for time in times:
        plant.advance(time - now)
        now = time
        while events and 0.001 * events[0][0] <= now:
            _, name, value = events.pop(0)
            getattr(plant, name)(*([] if value is None else [value]))
    return plant


class TestTime:
    @given(st.lists(st.floats(0.0, 1.2), max_size=60))
    @settings(max_examples=40, deadline=None)
    def test_cutting_time_does_not_change_the_trajectory(self, cuts):
        whole, cut = play(LIVELY, []), play(LIVELY, cuts)
        assert np.allclose(snapshot(whole), snapshot(cut), rtol=1e-12, atol=1e-15)
        assert whole.deflection == pytest.approx(cut.deflection, abs=1e-15)

    def test_a_voltage_that_is_led_goes_in_even_steps_at_the_middles_of_the_lag(self):
        led, by_hand, cut = make(LIVELY), make(LIVELY), make(LIVELY)
        for plant in (led, by_hand, cut):
            plant.advance(0.0123456)
            plant.apply(2.0)
            plant.advance(1e-3)
        for plant in (led, cut):
            plant.lead(2.0, 3.0, 4, 20e-6)
        led.advance(0.02)
        for _ in range(2000):
            cut.advance(1e-5)
        now = 0.0
        for step in range(1, 5):
            instant = 20e-6 * math.log(4.0 / (4.5 - step))
            by_hand.advance(instant - now)
            by_hand.apply(2.0 + 0.25 * step)
            now = instant
        by_hand.advance(0.02 - now)
        assert led.piezo_voltage == cut.piezo_voltage == by_hand.piezo_voltage == 3.0
        for each in (led, cut):
            assert each.deflection == pytest.approx(by_hand.deflection, rel=1e-10)

    def test_a_voltage_ahead_of_the_lag_waits_for_it(self):
        plant = make(PURE)
        plant.apply(2.0)
        plant.lead(1.0, 3.0, 2, 20e-6)
        assert plant.piezo_voltage == 2.0
        plant.advance(7e-6)
        assert plant.piezo_voltage == 2.0
        plant.advance(1.0)
        assert plant.piezo_voltage == 3.0
        plant.lead(3.0, 0.0, 2, 20e-6)
        plant.apply(5.0)
        plant.advance(1.0)
        assert plant.piezo_voltage == 5.0
        with pytest.raises(ValueError, match="voltage must lie within"):
            plant.lead(0.0, 61.0, 1, 20e-6)

    def test_a_current_acts_at_once_on_the_grid_and_else_from_the_next_point(self):
        plant = make()
        plant.drive(0.1)
        assert plant.current == 0.1
        plant.advance(0.013)
        rising = plant.base_temperature
        assert rising > 22.0
        plant.drive(0.0)
        assert plant.current == 0.1
        plant.advance(0.007)
        assert plant.current == 0.0
        late = copy.deepcopy(plant)
        late.drive(0.1)
        assert late.current == 0.1
        for each in (plant, late):
            each.advance(0.001)
        assert late.base_temperature > plant.base_temperature > rising

    def test_a_voltage_acts_at_once_at_any_time(self):
        plant = make(PURE)
        plant.advance(0.0123456)
        plant.apply(10.0)
        assert plant.piezo_voltage == 10.0
        assert plant.piezo_deflection == pytest.approx(0.0, abs=1e-18)
        other = make(PURE)
        other.apply(10.0)
        for _ in range(100):
            plant.advance(1e-4)
            other.advance(1e-4)
            assert plant.piezo_deflection == pytest.approx(other.piezo_deflection, abs=1e-15)

    def test_deflection_has_no_staircase(self):
        plant = make(LIVELY)
        plant.drive(-0.15)
        plant.advance(8.0)
        deflection = []
        for _ in range(4000):
            plant.advance(50e-6)
            deflection.append(plant.deflection)
        moves = np.diff(deflection)
        assert moves.mean() / 50e-6 > 3e-6
        # A 20 kHz loop sees a straight line: no step differs from its neighbour by a hundredth of a nanometre.
        assert np.abs(np.diff(moves)).max() < 1e-11
        assert moves.min() > 0.0


class TestTemperatureControl:
    def test_reaches_the_target_from_either_side(self):
        plant = make(LIVELY)
        for target in (30.0, 15.0, 22.0):
            plant.regulate(target, 0.15)
            plant.advance(120.0)
            assert plant.base_temperature == pytest.approx(target, abs=0.02)

    def test_stays_within_the_current_limit(self):
        plant = make()
        plant.regulate(60.0, 0.1)
        for _ in range(100):
            plant.advance(0.05)
            assert plant.current == 0.1
        # No wind-up: the loop leaves its limit as soon as the target is near.
        plant.advance(300.0)
        reached = plant.base_temperature
        assert reached < 50.0
        plant.regulate(reached - 2.0, 0.1)
        plant.advance(1.0)
        assert plant.current < 0.1
        plant.regulate(-100.0)
        plant.advance(300.0)
        assert abs(plant.current) <= PLAIN.maximum_current


class TestBehindAController:
    def make(self):
        clock = VirtualClock()
        plant = make()
        return plant, EmulatedTEC("tec", World(plant, clock), plant.peltier), clock

    def test_a_current_beyond_the_rating_is_held_at_it(self):
        plant, tec, _ = self.make()
        tec.select_mode(TECMode.CURRENT)
        for asked, held in ((4.0, PLAIN.maximum_current), (-4.0, -PLAIN.maximum_current)):
            tec.set(asked)
            assert plant.current == held
