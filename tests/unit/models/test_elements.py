"""Operators of elements against independent oracles: differential equations, definitions written out, brute force."""

import copy
import math
import pickle
from itertools import pairwise

import numpy as np
import pytest
from cases import cases
from hypothesis import given, settings, strategies as st
from scipy.integrate import solve_ivp

from bench.models import (
    BoucWen,
    Duhem,
    GeneralizedPrandtlIshlinskii,
    KrasnoselskiiPokrovskii,
    MaxwellSlip,
    PrandtlIshlinskii,
    Reach,
)
from bench.models.inverses.branch_inverse import BranchInverse
from bench.models.inverses.inverse import NumericalInverse

RANGE = (-2.0, 3.0)


def bouc_wen(exponent=1.0, beta=1.5, gamma=0.5):
    return BoucWen(1.2, -0.7, 0.3, beta, gamma, exponent, 2.5, 0.1, RANGE, "V", "µm")


def duhem():
    return Duhem([0.8, 0.1, -0.2], [0.3, -0.1, 0.05], 2.5, 0.4, 0.0, RANGE, "A", "T")


def maxwell_slip(sign=1.0):
    return MaxwellSlip([0.2, 0.7, 1.5], sign * np.array([2.0, 0.0, 1.0]), sign * 0.3, 0.5, 0.2, RANGE, "mm", "N")


def generalized(sign=1.0, ordered=True):
    offsets = (0.45, -0.3) if ordered else (-0.3, 0.45)
    return GeneralizedPrandtlIshlinskii(
        [0.0, 0.2, 0.5],
        sign * np.array([0.6, 0.3, 0.4]),
        1.5,
        offsets[0],
        1.5,
        offsets[1],
        0.2,
        0.0,
        RANGE,
        "V",
        "µm",
    )


def kp(seed=0):
    weights = np.random.default_rng(seed).uniform(0.0, 1.0, 10)
    return KrasnoselskiiPokrovskii([-2.0, -1.0, 0.0, 1.5], weights, 1.25, 0.2, RANGE, "V", "µm")


OPERATORS = [
    bouc_wen(), bouc_wen(1.7), bouc_wen(3.0, 30.0, 10.0), bouc_wen(1.0, 0.4, -1.1), duhem(), maxwell_slip(),
    maxwell_slip(-1.0), generalized(), generalized(-1.0), generalized(ordered=False), kp(),
]  # fmt: skip
values = st.lists(st.floats(*RANGE), min_size=1, max_size=12)
some = st.sampled_from(OPERATORS)


class TestEachOperator:
    @given(some, values, values)
    def test_a_sequence_may_be_cut_anywhere(self, operator, first, second):
        state = operator.initial_state()
        whole = operator.evaluate(first + second)
        middle = operator.advance(state, first)
        np.testing.assert_allclose(operator.evaluate(second, middle), whole[len(first) :], atol=1e-12)
        one_by_one = []
        for value in first + second:
            state, output = operator.step(state, value)
            one_by_one.append(output)
            assert operator.present_input(state) == value
            assert operator.value(state) == pytest.approx(output, abs=1e-12)
        np.testing.assert_allclose(one_by_one, whole, atol=1e-12)
        assert state == pytest.approx(operator.advance(operator.initial_state(), first + second), abs=1e-12)

    @given(some, values, values)
    def test_a_stream_equals_a_sequence(self, operator, history, inputs):
        start = operator.advance(operator.initial_state(), history)
        stream = operator.stream(start)
        assert stream.state == start
        assert stream.value == operator.value(start)
        outputs = [stream.step(value) for value in inputs]
        np.testing.assert_allclose(outputs, operator.evaluate(inputs, start), atol=1e-12)
        assert stream.value == outputs[-1]
        state = stream.state
        assert state == pytest.approx(operator.advance(start, inputs), abs=1e-12)
        # A copy goes on by itself.
        for again in (pickle.loads(pickle.dumps(stream)), copy.deepcopy(stream)):
            assert again.state == state
            again.step(0.3)
        for value in (math.nan, math.inf):
            with pytest.raises(ValueError, match="value: expected a finite number"):
                stream.step(value)
        assert stream.state == state

    @settings(max_examples=60)
    @given(some, values, st.floats(*RANGE))
    def test_the_inverse_meets_what_can_be_reached(self, operator, history, goal):
        state = operator.advance(operator.initial_state(), history)
        target = operator.step(state, goal)[1]
        inverse = operator.inverse()
        found = inverse.invert(state, target)
        scale = max(map(abs, operator.output_range()))
        assert found.reach is Reach.MET
        assert found.outputs[-1] == pytest.approx(target, abs=1e-10 * scale)
        assert operator.evaluate(found.setpoints, state)[-1] == found.outputs[-1]
        assert found.state == pytest.approx(operator.advance(state, found.setpoints), abs=1e-12)

    @cases("operator", OPERATORS)
    def test_what_cannot_be_reached_is_clamped_and_said(self, operator):
        low, high = operator.output_range()
        state = operator.initial_state()
        for target, reach in ((high + 1.0, Reach.TOO_HIGH), (low - 1.0, Reach.TOO_LOW)):
            found = operator.inverse().invert(state, target)
            assert found.reach is reach
            assert RANGE[0] <= found.setpoints[-1] <= RANGE[1]

    @cases("operator", OPERATORS)
    def test_wrong_numbers_are_refused(self, operator):
        state = operator.initial_state()
        with pytest.raises(ValueError, match="value: expected a finite number"):
            operator.step(state, np.nan)
        with pytest.raises(ValueError, match="state: expected"):
            operator.evaluate([0.0], (*state, 1.0))
        with pytest.raises(ValueError, match="coefficients: expected"):
            operator.with_coefficients([1.0] * 50, 0.0)

    @cases("operator", OPERATORS)
    def test_saturation_does_not_depend_on_the_past(self, operator):
        for direction in (-1, 1):
            saturated = operator.saturated_state(direction)
            end = RANGE[int(direction > 0)]
            assert operator.present_input(saturated) == end
            far = RANGE[int(direction < 0)]
            # From far beyond the other end, as often as it takes.
            reached = operator.advance(operator.initial_state(), [far + 10.0 * (far - end), end])
            if not isinstance(operator, (BoucWen, Duhem)):
                assert saturated == pytest.approx(reached, abs=1e-12)


class TestAgainstDifferentialEquations:
    @cases("exponent", [1.2, 1.7, 2.5])
    def test_a_move_over_zero_is_that_of_its_pieces(self, exponent):
        # The slope of z has a kink there.
        operator = bouc_wen(exponent)
        moves = [operator.present_input(operator.initial_state()), *np.random.default_rng(0).uniform(*RANGE, 200)]
        pieces = np.concatenate([np.linspace(a, b, 65)[1:] for a, b in pairwise(moves)])
        np.testing.assert_allclose(operator.evaluate(pieces)[63::64], operator.evaluate(moves[1:]), atol=1e-10)

    @cases(("exponent", "beta", "gamma"), [(1.0, 1.5, 0.5), (1.0, 0.4, -1.1), (1.7, 4.0, 2.0), (3.0, 30.0, 10.0)])
    def test_bouc_wen(self, exponent, beta, gamma):
        operator = bouc_wen(exponent, beta, gamma)
        inputs, z, outputs = [1.7, -1.2, 0.8, -2.0, 3.0, 0.1, 0.2], 0.0, []
        for before, after in zip([operator.origin, *inputs], inputs, strict=False):
            sign = np.sign(after - before)

            def slope(_, z, sign=sign):
                return sign * (1.0 - abs(z / 2.5) ** exponent * (beta * np.sign(z * sign) + gamma))

            z = solve_ivp(slope, (0.0, abs(after - before)), [z], rtol=1e-11, atol=1e-13).y[0, -1]
            outputs.append(0.3 + 1.2 * (after - 0.1) - 0.7 * z)
        np.testing.assert_allclose(operator.evaluate(inputs), outputs, atol=1e-9)

    def test_duhem(self):
        operator = duhem()
        curve, g_inside = np.polynomial.Chebyshev([0.0, 0.8, 0.1, -0.2]), np.polynomial.Chebyshev([0.3, -0.1, 0.05])
        inputs = [1.7, -1.2, 0.8, -2.0, 3.0, 0.1, 0.2, 5.5, 4.0, -6.0, -3.0, 0.4]

        def f(x):
            inside = np.clip(x, -1.0, 1.0)
            return curve(inside) + curve.deriv()(inside) * (x - inside)

        def g(x):
            return g_inside(np.clip(x, -1.0, 1.0))

        x = (2.0 * np.array([0.0, *inputs]) - 1.0) / 5.0
        y, outputs = f(x[0]), []
        for before, after in pairwise(x):
            sign = np.sign(after - before)

            def slope(x, y, sign=sign):
                return 2.5 * sign * (f(x) - y) + g(x)

            y = solve_ivp(slope, (before, after), [y], rtol=1e-11, atol=1e-13, max_step=0.01).y[0, -1]
            outputs.append(0.4 + y)
        np.testing.assert_allclose(operator.evaluate(inputs), outputs, atol=1e-9)

    @cases("exponent", [1.7, 8.0, 100.0])
    def test_bouc_wen_that_stiffens_without_end_stays_finite(self, exponent):
        operator = BoucWen(0.0, 1.0, 0.0, 0.0, -1.0, exponent, 1.0, 0.0, RANGE)
        outputs = operator.evaluate(np.random.default_rng(0).uniform(*RANGE, 50))
        assert 1e3 < np.abs(outputs).max() <= 1e6

    def test_bouc_wen_stays_below_its_bound(self):
        operator = BoucWen(0.0, 1.0, 0.0, 3.0, 1.0, 2.0, 2.0, 0.0, RANGE)
        outputs = operator.evaluate(np.random.default_rng(0).uniform(-500.0, 500.0, 200))
        assert np.abs(outputs).max() == pytest.approx(2.0 * 4.0**-0.5, rel=1e-9)


class TestAgainstTheirDefinitions:
    @given(values)
    def test_maxwell_slip_block_by_block(self, inputs):
        operator = maxwell_slip()
        places, outputs = [0.2] * 3, []
        for u in inputs:
            # A block is pulled along where its spring is longer than its slip.
            places = [min(max(p, u - slip), u + slip) for p, slip in zip(places, operator.slips, strict=True)]
            springs = [k * (u - p) for k, p in zip(operator.stiffnesses, places, strict=True)]
            outputs.append(0.5 + 0.3 * (u - 0.2) + sum(springs))
        np.testing.assert_allclose(operator.evaluate(inputs), outputs, atol=1e-12)
        assert np.abs(springs).max() <= (operator.stiffnesses * operator.slips).max() + 1e-12

    @given(values)
    def test_stops_are_what_plays_leave(self, inputs):
        stops = MaxwellSlip([0.5, 1.0], [2.0, 1.0], 0.0)
        plays = PrandtlIshlinskii([0.0, 0.5, 1.0], [3.0, 0.0, 0.0])
        parts = PrandtlIshlinskii([0.0, 0.5, 1.0], [0.0, 2.0, 1.0])
        np.testing.assert_allclose(
            stops.evaluate(inputs), plays.evaluate(inputs) - parts.evaluate(inputs), atol=1e-12
        )

    @given(values)
    def test_with_straight_envelopes_plays_are_plain(self, inputs):
        operator = GeneralizedPrandtlIshlinskii(
            [0.0, 0.2, 0.5], [0.6, 0.3, 0.4], 1e-4, 0.0, 1e-4, 0.0, 0.2, 0.5, RANGE
        )
        plain = PrandtlIshlinskii([0.0, 0.5, 1.25], np.array([0.6, 0.3, 0.4]) / 2.5, 0.2, 0.5)
        np.testing.assert_allclose(operator.evaluate(inputs), plain.evaluate(inputs), atol=1e-7)

    @settings(max_examples=20)
    @given(values)
    def test_kernels_by_brute_force(self, inputs):
        operator, outputs = kp(), []
        nodes, width = operator.nodes.tolist(), operator.width
        kernels = {(a, b): -1.0 for a in nodes for b in nodes if b <= a}
        present = RANGE[0]
        for value in inputs:
            # In small steps, each kernel on its own branch, as Krasnosel'skii and Pokrovskii draw them.
            for u in np.linspace(present, value, 12)[1:]:
                for (a, b), kappa in kernels.items():
                    ramp = float(np.interp(u, [a, a + width] if u > present else [b, b + width], [-1.0, 1.0]))
                    kernels[a, b] = max(ramp, kappa) if u > present else min(ramp, kappa)
                present = float(u)
            outputs.append(0.2 + sum(w * k for w, k in zip(operator.weights, kernels.values(), strict=True)))
        np.testing.assert_allclose(operator.evaluate(inputs), outputs, atol=1e-12)

    @given(values, st.integers(0, 100))
    def test_kernels_rise(self, history, seed):
        operator = kp(seed)
        state = operator.advance(operator.initial_state(), history)
        up = operator.evaluate(np.linspace(operator.present_input(state), RANGE[1], 50), state)
        assert (np.diff(up) >= -1e-12).all()


class TestTheExactInverse:
    @cases("make", [maxwell_slip, generalized])
    def test_serves_operators_that_rise_or_fall(self, make):
        for sign in (1.0, -1.0):
            assert isinstance(make(sign).inverse(), BranchInverse)
        mixed = make().with_coefficients(np.linspace(-1.0, 1.0, make().coefficients.size), 0.0)
        assert type(mixed.inverse()) is NumericalInverse

    def test_does_not_serve_envelopes_that_cross(self):
        assert type(generalized(ordered=False).inverse()) is NumericalInverse

    @settings(max_examples=40)
    @given(st.sampled_from([maxwell_slip(), maxwell_slip(-1.0), generalized(), generalized(-1.0)]), values, values)
    def test_agrees_with_the_numerical_one(self, operator, history, inputs):
        state = operator.advance(operator.initial_state(), history)
        targets = operator.evaluate(inputs, state)
        exact = operator.inverse().follow(targets, state)
        numerical = NumericalInverse(operator).follow(targets, state)
        assert exact.met.all()
        np.testing.assert_allclose(exact.outputs, targets, atol=1e-12)
        np.testing.assert_allclose(numerical.outputs, targets, atol=1e-12)

    def test_a_plateau_is_held(self):
        slider = MaxwellSlip([1.0], [2.0], 0.0)
        state = slider.advance(slider.initial_state(), [1.0])
        found = slider.inverse().invert(state, 2.0)
        assert (found.setpoints, found.reach) == ((1.0,), Reach.MET)


@cases(
    ("make", "words"),
    [
        (lambda: BoucWen(beta=-1.0), "beta: expected a number >= 0"),
        (lambda: BoucWen(exponent=0.5), "exponent: expected a number >= 1"),
        (lambda: BoucWen(scale=0.0), "scale: expected a positive number"),
        (lambda: Duhem([1.0], [1.0, 2.0]), "slope: expected 1 values"),
        (lambda: Duhem([1.0], [1.0], 0.0), "rate: expected a positive number"),
        (lambda: MaxwellSlip([0.0, 1.0], [1.0, 1.0]), "slips: expected values > 0"),
        (lambda: MaxwellSlip([1.0], [1.0, 1.0]), "stiffnesses: expected 1 values"),
        (lambda: GeneralizedPrandtlIshlinskii([0.1], [1.0]), "thresholds: expected the first to be 0"),
        (lambda: GeneralizedPrandtlIshlinskii([0.0], [1.0], 0.0), "rising_steepness: expected a positive number"),
        (lambda: KrasnoselskiiPokrovskii([0.0, 1.0], [1.0], 1.0), "weights: expected 3 values for 2 nodes"),
        (lambda: KrasnoselskiiPokrovskii([0.0], [1.0], -1.0), "width: expected a positive number"),
    ],
)
def test_impossible_parameters_are_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()
