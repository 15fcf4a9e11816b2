"""The two-stage model: its path convention, its reset, its symmetries, and the models beside it."""

import dataclasses
import json
import math

import numpy as np
import pytest
from cases import cases
from hypothesis import given, settings, strategies as st

from bench.models import (
    Linear,
    Polynomial,
    PrandtlIshlinskii,
    Preisach,
    Summed,
    TwoStage,
    model_from_json,
    uniform_levels,
)


def preisach(low, high, least, greatest, seed, order=12, zeros=0.6, units=("", "")):
    """A rising operator with many zero densities, from `least` to `greatest`."""
    rng = np.random.default_rng(seed)
    levels = uniform_levels(low, high, order)
    density = rng.random(order * (order + 1) // 2)
    density[rng.random(density.size) < zeros] = 0.0
    total = density @ Preisach(levels, density).cell_areas()
    density *= 0.5 * (greatest - least) / total
    return Preisach(levels, density, 0.5 * (least + greatest), input_unit=units[0], output_unit=units[1])


def plays(low, high, gain, seed, bias=0.0, units=("", "")):
    rng = np.random.default_rng(seed)
    half, middle = 0.5 * (high - low), 0.5 * (high + low)
    weights = np.append(0.4, rng.random(7) * (rng.random(7) < 0.6)) * gain
    return PrandtlIshlinskii(
        half * np.arange(8) / 8,
        weights,
        bias,
        middle,
        input_range=(low, high),
        input_unit=units[0],
        output_unit=units[1],
    )


def wire(seed=0, first="preisach", second="preisach"):
    one = {
        "preisach": lambda: preisach(0.0, 3.0, 0.3, 11.2, seed, units=("V", "N")),
        "plays": lambda: plays(0.0, 3.0, 2.5, seed, 5.0, units=("V", "N")),
    }[first]()
    two = {
        "preisach": lambda: preisach(-11.5, 11.5, -1.0, 5.0, seed + 1, units=("N", "mm")),
        "plays": lambda: plays(-11.5, 11.5, 0.2, seed + 1, units=("N", "mm")),
    }[second]()
    return TwoStage(one, two, 0.3)


KINDS = [("preisach", "preisach"), ("plays", "preisach"), ("preisach", "plays"), ("plays", "plays")]


def random_path(rng, count):
    """Voltages and forces of which at times only one moves."""
    voltages, forces = rng.uniform(0.0, 3.0, count), rng.uniform(0.0, 11.0, count)
    for n in range(1, count):
        choice = rng.integers(4)
        if choice == 0:
            voltages[n] = voltages[n - 1]
        elif choice == 1:
            forces[n] = forces[n - 1]
    return voltages, forces


def test_force_moves_before_voltage():
    model = wire()
    state, _ = model.step(model.initial_state(), 1.0, 4.0)
    both, length = model.step(state, 2.2, 8.0)
    forced, _ = model.step(state, 1.0, 8.0)
    after, expected = model.step(forced, 2.2, 8.0)
    assert (both, length) == (after, expected)
    # The excursion is remembered: the maximum of u is at the new force and the old voltage.
    excursion = 8.0 - model.first.value(state.first)
    assert excursion in both.second.extrema
    heated, _ = model.step(state, 2.2, 4.0)
    other, different = model.step(heated, 2.2, 8.0)
    assert other.argument == both.argument
    assert abs(different - length) > 1e-3


def test_together_moves_the_argument_straight():
    model = wire()
    state, _ = model.step(model.initial_state(), 1.0, 4.0)
    after, length = model.step(state, 2.2, 8.0, together=True)
    second = state.second.step(after.argument)
    assert after.second == second
    assert length == model.second.value(second)
    blocked = model.first.value(state.first.step(2.2))
    assert after.argument == 8.0 - blocked
    moved, same = model.move(state, 2.2, after.argument)
    assert (moved.second, same) == (after.second, length)
    assert moved.force == pytest.approx(8.0, abs=1e-14)


def test_definition():
    model = wire()
    voltages, forces = np.array([0.0, 1.0, 3.0, 3.0, 0.5]), np.array([1.0, 1.0, 1.0, 6.0, 6.0])
    start = model.initial_state()
    # Only one input moves at a time, so the order plays no part.
    blocked = model.first.evaluate(voltages, start.first)
    expected = model.second.evaluate(forces - blocked, start.second)
    assert model.evaluate(voltages, forces) == pytest.approx(expected, abs=1e-13)


def test_reset_starts_the_second_stage_on_its_ascending_branch():
    model = wire()
    state = model.initial_state()
    assert (state.voltage, state.force) == (0.0, 0.3)
    assert state.blocked == pytest.approx(0.3)
    assert state.argument == 0.3 - state.blocked
    fresh = model.second.initial_state()
    assert state.second == fresh.step(state.argument)
    assert state.second.rising
    assert state.length == model.second.value(state.second)
    # H1 is where negative saturation is.
    assert model.first.value(state.first) == model.first.value(model.first.initial_state())


@settings(max_examples=60)
@given(st.integers(0, 10_000), st.sampled_from(KINDS), st.booleans())
def test_sequences_equal_steps(seed, kinds, together):
    rng = np.random.default_rng(seed)
    model = wire(seed % 7, *kinds)
    voltages, forces = random_path(rng, 25)
    state, lengths = model.initial_state(), []
    for v, f in zip(voltages, forces, strict=True):
        state, length = model.step(state, v, f, together=together)
        lengths.append(length)
        assert length == state.length
    assert model.evaluate(voltages, forces, together=together) == pytest.approx(lengths, abs=1e-12)
    after = model.advance(voltages, forces, together=together)
    for name in ("voltage", "force", "blocked", "argument", "length"):
        assert getattr(after, name) == pytest.approx(getattr(state, name), abs=1e-12)
    # Both have the same future.
    again = random_path(rng, 10)
    assert model.evaluate(*again, after) == pytest.approx(model.evaluate(*again, state), abs=1e-12)
    # The path may be cut anywhere.
    half = model.advance(voltages[:12], forces[:12], together=together)
    rest = model.evaluate(voltages[12:], forces[12:], half, together=together)
    assert rest == pytest.approx(lengths[12:], abs=1e-12)


@settings(max_examples=60)
@given(st.integers(0, 10_000), st.sampled_from(KINDS))
def test_length_rises_with_force_and_falls_with_voltage(seed, kinds):
    rng = np.random.default_rng(seed)
    model = wire(seed % 7, *kinds)
    state = model.advance(*random_path(rng, 12))
    forces = np.linspace(state.force, 12.0, 60)
    assert (np.diff(model.evaluate(np.full(60, state.voltage), forces, state)) >= -1e-12).all()
    voltages = np.linspace(state.voltage, 3.0, 60)
    assert (np.diff(model.evaluate(voltages, np.full(60, state.force), state)) <= 1e-12).all()


@cases("kinds", KINDS)
def test_nothing_depends_on_how_finely_a_move_is_sampled(kinds):
    model = wire(3, *kinds)
    start = model.advance([2.0, 0.7], [3.0, 5.0])
    coarse = model.step(start, 2.6, 5.0)[1]
    fine = model.evaluate(np.linspace(0.7, 2.6, 101), np.full(101, 5.0), start)
    assert fine[-1] == pytest.approx(coarse, abs=1e-12)


def test_repeated_samples_leave_the_state_alone():
    model = wire()
    state = model.advance([2.0, 0.7], [3.0, 5.0])
    again, length = model.step(state, state.voltage, state.force)
    assert again == state
    assert length == state.length


def test_states_and_models_are_immutable():
    model = wire()
    state = model.initial_state()
    with pytest.raises(dataclasses.FrozenInstanceError):
        state.force = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        model.pretension = 1.0


def test_summed_is_the_difference_of_two_operators():
    model = Summed(
        preisach(0.0, 11.5, 0.0, 5.0, 1, units=("N", "mm")), preisach(0.0, 3.0, 0.0, 4.0, 2, units=("V", "mm")), 0.3
    )
    rng = np.random.default_rng(5)
    voltages, forces = random_path(rng, 30)
    start = model.initial_state()
    expected = model.by_force.evaluate(forces, start.by_force) - model.by_voltage.evaluate(voltages)
    assert model.evaluate(voltages, forces) == pytest.approx(expected, abs=1e-13)
    state = start
    for v, f, length in zip(voltages, forces, expected, strict=True):
        state, stepped = model.step(state, v, f)
        assert stepped == pytest.approx(length, abs=1e-12)
    assert model.advance(voltages, forces) == state
    assert (start.voltage, start.force) == (0.0, 0.3)
    assert (model.voltage_unit, model.force_unit, model.length_unit) == ("V", "N", "mm")
    # The loop over the voltage is the same at every force, but for a shift.
    loop = np.array([0.0, 3.0, 1.0, 2.0, 0.0])
    near, far = (model.evaluate(loop, np.full(5, force)) for force in (1.0, 9.0))
    assert np.ptp(far - near) < 1e-12


def test_linear_is_a_two_stage_model_with_a_line():
    second = preisach(-13.5, 13.5, -1.0, 5.0, 1, units=("N", "mm"))
    model = Linear(3.83, -2.95, second, (0.0, 3.0), 0.3, "V")
    voltages, forces = np.array([0.0, 1.0, 3.0, 3.0, 0.5]), np.array([1.0, 1.0, 1.0, 6.0, 6.0])
    state = model.initial_state()
    expected = second.evaluate(forces - 3.83 * voltages + 2.95, state.second)
    assert model.evaluate(voltages, forces) == pytest.approx(expected, abs=1e-12)
    assert state.argument == pytest.approx(0.3 + 2.95)
    assert model.step(state, 1.0, 4.0)[1] == model.two_stage.step(state, 1.0, 4.0)[1]
    assert model.advance(voltages, forces).length == pytest.approx(expected[-1], abs=1e-12)
    assert (model.voltage_unit, model.force_unit, model.length_unit) == ("V", "N", "mm")


@cases(
    "model",
    [
        *(wire(2, *kinds) for kinds in KINDS),
        Summed(preisach(0.0, 11.5, 0.0, 5.0, 1), plays(0.0, 3.0, 1.0, 2), 0.3),
        Linear(3.83, -2.95, preisach(-13.5, 13.5, -1.0, 5.0, 1, units=("N", "mm")), (0.0, 3.0), 0.3, "V"),
    ],
)
def test_json(model):
    again = model_from_json(json.loads(json.dumps(model.to_json())))
    assert type(again) is type(model)
    assert again.to_json() == model.to_json()
    voltages, forces = random_path(np.random.default_rng(1), 20)
    assert np.array_equal(again.evaluate(voltages, forces), model.evaluate(voltages, forces))
    units = ("voltage_unit", "force_unit", "length_unit", "pretension")
    assert [getattr(again, u) for u in units] == [getattr(model, u) for u in units]


def test_units_come_from_the_stages():
    model = wire()
    assert (model.voltage_unit, model.force_unit, model.length_unit) == ("V", "N", "mm")


def line(units):
    return Polynomial([1.0], (0.0, 1.0), 0.0, *units)


@cases(
    ("make", "message"),
    [
        (lambda: TwoStage(line(("V", "N")), line(("kg", "mm"))), "second: expected the unit 'N', got 'kg'"),
        (lambda: TwoStage(line(("V", "N")), line(("", "mm")), math.nan), "pretension: expected a finite"),
        (lambda: Summed(line(("N", "mm")), line(("V", "m"))), "by_voltage: expected the unit 'mm', got 'm'"),
        (lambda: Linear(-1.0, 0.0, line(("N", "mm")), (0.0, 3.0)), "slope: expected a number >= 0"),
        (lambda: Linear(1.0, 0.0, line(("N", "mm")), (3.0, 0.0)), "input_range: expected strictly"),
        (lambda: wire().step(wire().initial_state(), math.inf, 1.0), "voltage: expected a finite"),
        (lambda: wire().step(wire().initial_state(), 1.0, math.nan), "force: expected a finite"),
        (lambda: wire().move(wire().initial_state(), 1.0, math.nan), "argument: expected a finite"),
        (lambda: wire().evaluate([1.0], [1.0, 2.0]), "forces: expected 1 values"),
        (lambda: wire().advance([], []), "voltages: expected at least one"),
        (lambda: model_from_json({"type": "three"}), "expected a model of the kind .*'two-stage'"),
        (lambda: model_from_json({"type": "two-stage"}), "two-stage: expected the key 'first'"),
    ],
)
def test_wrong_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
