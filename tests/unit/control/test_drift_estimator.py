import math

import numpy as np
import pytest
from cases import cases
from hypothesis import given, settings, strategies as st

from bench.control import DriftEstimator, agility_for


def line_fit(times, values, noise):
    """Least-squares slope and its standard deviation."""
    times = np.asarray(times) - np.mean(times)
    weight = np.sum(times**2)
    return float(times @ np.asarray(values) / weight), noise / math.sqrt(weight)


def batch(times, values, noise, agility):
    """The same model solved in one piece: generalized least squares for value and drift at every reading."""
    n = len(times)
    precision = np.zeros((2 * n, 2 * n))
    right = np.zeros(2 * n)
    for k in range(n):
        precision[2 * k, 2 * k] += 1.0 / noise**2
        right[2 * k] += values[k] / noise**2
    for k in range(1, n):
        dt = times[k] - times[k - 1]
        transition = np.zeros((2, 2 * n))
        transition[:, 2 * k : 2 * k + 2] = np.eye(2)
        transition[:, 2 * k - 2 : 2 * k] = -np.array([[1.0, dt], [0.0, 1.0]])
        covariance = agility**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        precision += transition.T @ np.linalg.solve(covariance, transition)
    solution = np.linalg.solve(precision, right)
    return float(solution[-1]), math.sqrt(np.linalg.inv(precision)[-1, -1])


class TestAgainstExactSolutions:
    @cases("times", [np.arange(8.0), [0.0, 0.1, 0.5, 2.0, 2.2, 7.0]])
    def test_a_steadfast_drift_is_the_least_squares_line(self, times):
        rng = np.random.default_rng(3)
        values = 50.0 + 0.3 * np.asarray(times) + 0.01 * rng.standard_normal(len(times))
        estimator = DriftEstimator(noise=0.01, agility=1e-9)
        for t, value in zip(times, values, strict=True):
            estimator.update(t, value)
        slope, deviation = line_fit(times, values, 0.01)
        assert estimator.drift == pytest.approx(slope, abs=1e-3 * deviation)
        assert estimator.uncertainty == pytest.approx(deviation, rel=1e-3)

    @cases("seed", range(5))
    def test_a_wandering_drift_is_the_generalized_least_squares_solution(self, seed):
        rng = np.random.default_rng(seed)
        times = np.cumsum(rng.uniform(0.2, 3.0, 12))
        values = np.cumsum(rng.standard_normal(12)) * 0.05 + 20.0
        estimator = DriftEstimator(noise=0.02, agility=0.05)
        for t, value in zip(times, values, strict=True):
            estimator.update(t, value)
        drift, deviation = batch(times, values, 0.02, 0.05)
        assert estimator.uncertainty == pytest.approx(deviation, rel=1e-5)
        assert estimator.drift == pytest.approx(drift, abs=1e-4 * deviation)

    def test_two_readings(self):
        estimator = DriftEstimator(noise=0.5, agility=1e-6)
        estimator.update(10.0, 1.0)
        estimator.update(12.0, 5.0)
        assert estimator.drift == pytest.approx(2.0, rel=1e-6)
        assert estimator.uncertainty == pytest.approx(0.5 * math.sqrt(2) / 2.0, rel=1e-6)

    @settings(max_examples=40)
    @given(st.floats(1e-9, 1e3), st.floats(0.05, 10.0))
    def test_scales_with_its_unit(self, scale, period):
        plain = DriftEstimator(noise=0.01, agility=0.02)
        scaled = DriftEstimator(noise=0.01 * scale, agility=0.02 * scale)
        for k in range(6):
            value = math.sin(k) * 0.05
            plain.update(k * period, value)
            scaled.update(k * period, value * scale)
        assert scaled.drift == pytest.approx(plain.drift * scale, rel=1e-3, abs=1e-4 * scale)
        assert scaled.uncertainty == pytest.approx(plain.uncertainty * scale, rel=1e-3)


class TestSteadiness:
    def test_nothing_is_known_before_two_readings(self):
        estimator = DriftEstimator(noise=0.01, agility=0.02)
        assert math.isnan(estimator.drift)
        assert estimator.uncertainty == math.inf
        assert not estimator.is_steady(1e9)
        estimator.update(0.0, 50.0)
        assert math.isnan(estimator.drift)
        assert not estimator.is_steady(1e9)

    def test_a_ramp_is_never_steady(self):
        estimator = DriftEstimator(noise=0.001, agility=0.02)
        for k in range(200):
            estimator.update(k * 0.5, 0.1 * k * 0.5)
            assert not estimator.is_steady(0.02)
        assert estimator.drift == pytest.approx(0.1, rel=1e-3)

    @cases("noise", [0.002, 0.01, 0.05])
    @cases("period", [0.1, 0.5, 2.0, 5.0, 20.0])
    def test_a_signal_at_rest_is_declared_steady(self, period, noise):
        limit = 0.02
        estimator = DriftEstimator(noise=noise, agility=agility_for(drift=limit, noise=noise, period=period))
        for k in range(600):
            estimator.update(k * period, 50.0)
        assert estimator.uncertainty == pytest.approx(0.4 * limit, rel=0.5)
        assert estimator.is_steady(limit)

    @cases("tau", [1.0, 4.0])
    @cases("period", [0.5, 2.0, 5.0])
    def test_a_settling_signal_is_not_declared_steady_too_early(self, period, tau):
        limit, noise, amplitude = 0.02, 0.01, 30.0
        allowed_from = tau * math.log(amplitude / tau / limit)
        agility = agility_for(drift=limit, noise=noise, period=period)
        early, declared = 0, []
        for seed in range(60):
            rng = np.random.default_rng(seed)
            estimator = DriftEstimator(noise=noise, agility=agility)
            for k in range(1, 400):
                t = k * period
                value = 60.0 - amplitude * math.exp(-t / tau) + noise * rng.standard_normal()
                estimator.update(t, value)
                if estimator.is_steady(limit):
                    declared.append(t)
                    early += t < allowed_from
                    break
        assert len(declared) == 60
        assert early <= 3
        assert np.median(declared) < allowed_from + 10.0 + 5.0 * period


class TestErrors:
    @cases("noise", [0.0, -1.0, math.nan, math.inf])
    def test_parameters(self, noise):
        with pytest.raises(ValueError, match="positive"):
            DriftEstimator(noise=noise, agility=1.0)
        with pytest.raises(ValueError, match="positive"):
            DriftEstimator(noise=1.0, agility=noise)

    @cases(("t", "value"), [(2.0, math.nan), (2.0, math.inf), (math.nan, 1.0), (math.inf, 1.0), (1.5, 1.0)])
    def test_readings(self, t, value):
        estimator = DriftEstimator(noise=1.0, agility=1.0)
        estimator.update(2.0, 1.0)
        with pytest.raises(ValueError, match=r"value: expected a finite|t: expected|not before 2\.0"):
            estimator.update(t, value)

    def test_two_readings_at_one_time_say_nothing_of_the_drift(self):
        estimator = DriftEstimator(noise=0.01, agility=0.02)
        estimator.update(1.0, 5.0)
        estimator.update(1.0, 5.0)
        assert not estimator.is_steady(0.02)
