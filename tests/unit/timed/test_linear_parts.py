"""The linear part beside scipy's integrator."""

import numpy as np
import pytest
from cases import cases
from scipy.integrate import solve_ivp

from bench.models import FilterState, LinearPart, logarithmic_creep

LAGS = {
    "none": (0.0, 0.0),
    "lag": (0.02, 0.0),
    "resonance": (0.0025, 1.6e-4),
    "critical": (0.02, 1e-4),
    "slow": (0.2, 1e-4),
}


def record(rng, samples=60):
    """Return uneven times and an input."""
    return np.cumsum(rng.uniform(0.001, 0.03, samples)), np.cumsum(rng.normal(size=samples))


@cases("name", list(LAGS))
@cases("delay", [0.0, 0.0137])
def test_responses_on_uneven_times_are_those_of_the_differential_equations(name, delay):
    t, u = record(np.random.default_rng(1))
    first, second = LAGS[name]
    times, strengths = logarithmic_creep(0.05, 0.05, 0.5)
    found, _ = LinearPart(delay, LAGS[name], times, strengths).respond(t, u[:, None])

    def slope(moment, state, start, rate):
        value = u[start] + rate * (moment - t[start])
        fast = [0.0, 0.0]
        if second > 0.0:
            fast = [state[1], (value - state[0] - first * state[1]) / second]
        elif first > 0.0:
            fast = [(value - state[0]) / first, 0.0]
        return np.concatenate([fast, (value - state[2:]) / times])

    moments = t - delay
    expected = np.full(t.size, u[0] * (1.0 + strengths.sum()))
    state = np.concatenate([[u[0], 0.0], np.full(times.size, u[0])])
    for k in range(t.size - 1):
        rate = (u[k + 1] - u[k]) / (t[k + 1] - t[k])
        solution = solve_ivp(
            slope, (t[k], t[k + 1]), state, "DOP853", args=(k, rate), rtol=1e-11, atol=1e-13, dense_output=True
        )
        inside = (moments >= t[k]) & (moments <= t[k + 1])
        for place in np.flatnonzero(inside):
            at = solution.sol(moments[place])
            direct = u[k] + rate * (moments[place] - t[k])
            expected[place] = (at[0] if first > 0.0 else direct) + strengths @ at[2:]
        state = solution.y[:, -1]
    np.testing.assert_allclose(found[:, 0], expected, atol=1e-8)


def test_columns_are_filtered_alone_and_a_state_goes_on():
    rng = np.random.default_rng(2)
    t, u = record(rng)
    part = LinearPart(0.0, (0.0025, 1.6e-4), *logarithmic_creep(0.05, 0.05, 0.5))
    both, _ = part.respond(t, np.column_stack([u, -2.0 * u]))
    np.testing.assert_allclose(both[:, 1], -2.0 * both[:, 0], atol=1e-12)
    _, (value, rate, crept) = part.respond(t[:30], u[:30, None])
    state = FilterState(value[0], rate[0], tuple(crept[:, 0]))
    np.testing.assert_allclose(part.respond(t[29:], u[29:, None], state)[0][:, 0], both[29:, 0], atol=1e-12)


def test_creep_is_nearly_logarithmic():
    times, strengths = logarithmic_creep(0.1, 0.01, 100.0)
    t = np.geomspace(0.1, 6.0, 40)
    crept = 1.0 - np.exp(-t[:, None] / times)
    slope = np.diff(crept @ strengths) / np.diff(np.log10(t))
    assert slope == pytest.approx(np.full(slope.size, 0.1), rel=0.03)


@cases(
    "arguments",
    [
        {"delay": -1.0},
        {"lag": (0.0, 1.0)},
        {"lag": (-1.0, 0.0)},
        {"creep_times": [0.0], "creep_strengths": [1.0]},
        {"creep_times": [1.0]},
    ],
)
def test_an_unstable_or_incomplete_part_is_refused(arguments):
    with pytest.raises(ValueError, match="expected"):
        LinearPart(**arguments)
