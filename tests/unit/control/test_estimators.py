"""The estimate of a disturbance against the closed form of its filter, and against filterpy."""

import math

import numpy as np
import pytest
from cases import cases
from filterpy.kalman import KalmanFilter
from hypothesis import given, strategies as st

from bench.control import DisturbanceEstimator

variances = st.floats(1e-6, 1e6)


class TestAgainstClosedForm:
    @given(variances, st.floats(1e-3, 1e3))
    def test_the_gain_settles_where_the_riccati_equation_says(self, q, ratio):
        r = q * ratio
        estimator = DisturbanceEstimator(walk_variance=q, reading_variance=r)
        for _ in range(400):
            estimator.update(0.0)
        predicted = 0.5 * (q + math.sqrt(q * q + 4.0 * q * r))
        assert estimator.gain == pytest.approx(predicted / (predicted + r), rel=1e-9)
        assert estimator.uncertainty == pytest.approx(math.sqrt(predicted * r / (predicted + r)), rel=1e-9)

    @given(st.lists(st.floats(-1e3, 1e3) | st.none(), min_size=1, max_size=30), st.floats(0.01, 100.0))
    def test_each_update_is_that_of_filterpy(self, values, q):
        reference = KalmanFilter(dim_x=1, dim_z=1)
        reference.x, reference.P, reference.H = np.zeros(1), np.array([[25.0]]), np.eye(1)
        estimator = DisturbanceEstimator(walk_variance=q, reading_variance=1.0, initial_variance=25.0)
        for value in values:
            gain = estimator.gain
            reference.predict(Q=np.array([[q]]))
            reference.update(value)
            if value is not None:
                assert gain == pytest.approx(reference.K[0, 0], rel=1e-12)
            assert estimator.update(value) == pytest.approx(reference.x[0], rel=1e-12, abs=1e-12)
            assert estimator.uncertainty == pytest.approx(math.sqrt(reference.P[0, 0]), rel=1e-12)

    def test_the_first_reading_fixes_the_value(self):
        estimator = DisturbanceEstimator(walk_variance=3.0, reading_variance=1.0)
        assert estimator.value == 0.0
        assert estimator.update(42.0) == pytest.approx(42.0, rel=1e-8)

    def test_the_uncertainty_is_that_of_a_random_walk_seen_through_noise(self):
        rng = np.random.default_rng(5)
        estimator = DisturbanceEstimator(walk_variance=0.5, reading_variance=2.0)
        walk = np.cumsum(math.sqrt(0.5) * rng.standard_normal(20_000))
        readings = walk + math.sqrt(2.0) * rng.standard_normal(walk.size)
        errors = np.array([estimator.update(z) for z in readings]) - walk
        assert errors[100:].std() == pytest.approx(estimator.uncertainty, rel=0.03)


class TestMissingReadings:
    def test_only_the_uncertainty_takes_note(self):
        estimator = DisturbanceEstimator(walk_variance=4.0, reading_variance=1.0)
        estimator.update(10.0)
        before = estimator.uncertainty
        for n in range(1, 6):
            assert estimator.update(None) == pytest.approx(10.0, rel=1e-8)
            assert estimator.uncertainty == pytest.approx(math.sqrt(before**2 + 4.0 * n), rel=1e-9)
        assert estimator.update(20.0) > 19.0

    @cases("value", [math.nan, math.inf, -math.inf])
    def test_a_nan_is_refused_and_leaves_no_trace(self, value):
        estimator = DisturbanceEstimator(walk_variance=4.0, reading_variance=1.0)
        estimator.update(10.0)
        with pytest.raises(ValueError, match="value: expected a finite number or None"):
            estimator.update(value)
        assert estimator.update(10.0) == pytest.approx(10.0, rel=1e-8)


class TestStability:
    """A controller that takes the estimate away from its next target: e goes on by 1 - K g."""

    @staticmethod
    def gain(q):
        predicted = 0.5 * (q + math.sqrt(q * q + 4.0 * q))
        return predicted / (predicted + 1.0)

    @staticmethod
    def errors(q, g, count=200):
        estimator = DisturbanceEstimator(walk_variance=q, reading_variance=1.0)
        for _ in range(200):
            estimator.update(0.0)
        model, errors = 0.0, []
        for _ in range(count):
            output = g * model
            errors.append(1.0 - output)
            model = 1.0 - estimator.update(output - model)
        return np.abs(errors)

    @given(st.floats(0.01, 100.0), st.floats(0.02, 0.97))
    def test_within_the_bound_the_error_dies_out(self, q, part):
        errors = self.errors(q, 2.0 * part / self.gain(q))
        assert errors[-1] < errors[0] * max(abs(1.0 - 2.0 * part), 0.05) ** 100 + 1e-6

    @cases("q", [0.1, 3.0, 30.0])
    def test_beyond_the_bound_it_grows(self, q):
        assert self.errors(q, 2.1 / self.gain(q))[-1] > 1e3
        assert self.errors(q, -0.1 / self.gain(q))[-1] > 1e3


@cases("wrong", [0.0, -1.0, math.nan, math.inf])
def test_variances_are_positive(wrong):
    with pytest.raises(ValueError, match="positive"):
        DisturbanceEstimator(walk_variance=wrong, reading_variance=1.0)
    with pytest.raises(ValueError, match="positive"):
        DisturbanceEstimator(walk_variance=1.0, reading_variance=wrong)
    with pytest.raises(ValueError, match="initial_variance"):
        DisturbanceEstimator(walk_variance=1.0, reading_variance=1.0, initial_variance=wrong)
