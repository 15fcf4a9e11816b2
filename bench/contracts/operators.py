"""What every hysteresis operator promises; see `bench.models.Operator`."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.base import parse_json
from bench.models import Operator, Reach

_SEED = 1
_ROUNDING = 1e-9


class OperatorContract:
    """The contract of every operator of one input and one output.

    A subclass provides the fixture `operator`: one whose coefficients are not zero, so that it has an output.
    """

    @pytest.fixture
    def inputs(self, operator: Operator[Any]) -> NDArray[np.float64]:
        """Return a sequence with reversals of many sizes in the operating range."""
        low, high = operator.input_range
        return np.random.default_rng(_SEED).uniform(low, high, 40)

    @pytest.fixture
    def scale(self, operator: Operator[Any]) -> float:
        """Return the largest output, by which errors are judged."""
        largest = max(map(abs, operator.output_range()))
        assert math.isfinite(largest)
        assert largest > 0.0, "the operator has no output; give it coefficients"
        return largest

    def test_the_operating_range_increases(self, operator: Operator[Any]) -> None:
        """The operating range has two finite ends."""
        low, high = operator.input_range
        assert -math.inf < low < high < math.inf

    def test_a_sequence_may_be_cut_anywhere(
        self, operator: Operator[Any], inputs: NDArray[np.float64], scale: float
    ) -> None:
        """`evaluate`, `advance`, `step`, `value` and a stream agree, wherever the sequence is cut."""
        whole = operator.evaluate(inputs)
        assert whole.shape == inputs.shape
        assert np.isfinite(whole).all()
        middle = operator.advance(operator.initial_state(), inputs[:17])
        np.testing.assert_allclose(operator.evaluate(inputs[17:], middle), whole[17:], atol=_ROUNDING * scale)
        state, stream = operator.initial_state(), operator.stream()
        for value, expected in zip(inputs.tolist(), whole.tolist(), strict=True):
            state, output = operator.step(state, value)
            assert output == pytest.approx(expected, abs=_ROUNDING * scale)
            assert stream.step(value) == pytest.approx(expected, abs=_ROUNDING * scale)
            if not operator.memoryless:
                assert operator.present_input(state) == value
                assert operator.value(state) == pytest.approx(expected, abs=_ROUNDING * scale)

    def test_the_rate_does_not_matter(
        self, operator: Operator[Any], inputs: NDArray[np.float64], scale: float
    ) -> None:
        """The output after a move does not depend on the number of samples on the way."""
        fine = np.concatenate([inputs[:1], *(np.linspace(a, b, 8)[1:] for a, b in pairwise(inputs))])
        np.testing.assert_allclose(operator.evaluate(fine)[::7], operator.evaluate(inputs), atol=1e-6 * scale)

    def test_the_output_is_linear_in_the_coefficients(
        self, operator: Operator[Any], inputs: NDArray[np.float64], scale: float
    ) -> None:
        """The regressor times the coefficients, and the bias, are the output."""
        outputs = operator.evaluate(inputs)
        product = operator.regressor(inputs).product(operator.coefficients)
        np.testing.assert_allclose(operator.bias + product, outputs, atol=_ROUNDING * scale)
        double = operator.with_coefficients(2.0 * operator.coefficients, operator.bias)
        np.testing.assert_allclose(double.evaluate(inputs) - operator.bias, 2.0 * product, atol=_ROUNDING * scale)

    def test_the_shape_is_within_its_bounds(self, operator: Operator[Any], inputs: NDArray[np.float64]) -> None:
        """The shape parameters lie in their bounds, and setting them to what they are changes nothing."""
        shape = operator.shape_parameters()
        assert len(shape.names) == len(shape.values) == len(shape.low) == len(shape.high)
        assert all(low <= value <= high for low, value, high in zip(shape.low, shape.values, shape.high, strict=True))
        np.testing.assert_array_equal(operator.with_shape(shape.values).evaluate(inputs), operator.evaluate(inputs))
        assert operator.nonnegative().shape == operator.coefficients.shape

    def test_operator_and_state_are_written_and_read(
        self, operator: Operator[Any], inputs: NDArray[np.float64]
    ) -> None:
        """Operator and state come back from JSON, and go on to the same outputs."""
        again: Any = type(operator).from_json(parse_json(json.dumps(operator.to_json())))
        state = operator.advance(operator.initial_state(), inputs[:17])
        read = again.state_from_json(parse_json(json.dumps(operator.state_to_json(state))))
        np.testing.assert_array_equal(again.evaluate(inputs[17:], read), operator.evaluate(inputs[17:], state))

    def test_an_input_that_is_no_number_is_refused(self, operator: Operator[Any]) -> None:
        """Neither `step` nor `evaluate` takes a nan."""
        for refused in (
            lambda: operator.step(operator.initial_state(), math.nan),
            lambda: operator.evaluate([math.nan]),
        ):
            with pytest.raises(ValueError, match=r"finite|nan"):
                refused()

    def test_the_inverse_meets_what_can_be_reached(
        self, operator: Operator[Any], inputs: NDArray[np.float64], scale: float
    ) -> None:
        """From any memory the inverse finds the input of an output that a single move reaches."""
        inverse = operator.inverse()
        state = operator.initial_state()
        for value in inputs[:12].tolist():
            state = operator.advance(state, [value])
            target = operator.step(state, float(np.mean(operator.input_range)))[1]
            found = inverse.invert(state, target)
            assert found.reach is Reach.MET
            assert found.outputs[-1] == pytest.approx(target, abs=1e-6 * scale)
