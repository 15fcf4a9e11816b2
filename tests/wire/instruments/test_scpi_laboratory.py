"""The plant of lags, and the laboratory of text instruments around it."""

import math

import pytest
from hypothesis import given, settings, strategies as st

from sim_devices.plants.lag_network import Lag, LagNetwork


def network():
    """A voltage that follows its set-point, a temperature that follows it, and a strain that follows at once."""
    return LagNetwork(
        {"output": 0.0},
        {
            "strain": Lag(("temperature",), lambda v: 1e-5 * (v["temperature"] - 20.0), 0.0, None),
            "temperature": Lag(("voltage",), lambda v: 20.0 + v["voltage"] ** 2, 10.0, None),
            "voltage": Lag(("output",), lambda v: v["output"], 0.5, 0.0),
        },
    )


def state(plant):
    return [plant.value(name) for name in ("voltage", "temperature", "strain")]


def test_it_begins_at_rest():
    plant = network()
    assert state(plant) == [0.0, 20.0, 0.0]
    plant.advance(3600.0)
    assert state(plant) == [0.0, 20.0, 0.0]


def test_a_lag_is_exact():
    plant = network()
    plant.set("output", 4.0)
    for t in (0.1, 0.5, 2.0):
        plant.advance(t)
    assert plant.value("voltage") == pytest.approx(4.0 * (1.0 - math.exp(-2.6 / 0.5)), rel=1e-12)


def test_a_cascade_is_close_to_its_solution():
    plant = network()
    plant.set("output", 4.0)
    plant.advance(7.0)
    # x' = (20 + V(t)^2 - x) / 10 with V = 4 (1 - exp(-t / 0.5)), by its three exponentials.
    t, slow, fast = 7.0, 1.0 / 10.0, 1.0 / 0.5
    rise = 1.0 - math.exp(-slow * t)
    term = slow / (slow - fast) * (math.exp(-fast * t) - math.exp(-slow * t))
    square = slow / (slow - 2.0 * fast) * (math.exp(-2.0 * fast * t) - math.exp(-slow * t))
    expected = 20.0 + 16.0 * (rise - 2.0 * term + square)
    assert plant.value("temperature") == pytest.approx(expected, abs=2e-4)
    assert plant.value("strain") == pytest.approx(1e-5 * (expected - 20.0), abs=1e-8)


@settings(max_examples=30, deadline=None)
@given(parts=st.lists(st.floats(0.0, 3.0), min_size=1, max_size=20))
def test_how_the_time_is_divided_does_not_matter(parts):
    pieces, whole = network(), network()
    for plant in (pieces, whole):
        plant.set("output", 3.0)
    for part in parts:
        pieces.advance(part)
        state(pieces)
    whole.advance(sum(parts))
    assert state(pieces) == pytest.approx(state(whole), rel=1e-9)


def test_a_circle_needs_a_lag_and_a_beginning():
    def target(values):
        return 1.0 + 0.5 * values["a"]

    with pytest.raises(ValueError, match="a depend on each other in a circle; give one a time_constant"):
        LagNetwork({}, {"a": Lag(("a",), target, 0.0, None)})
    with pytest.raises(ValueError, match="give one an initial value"):
        LagNetwork({}, {"a": Lag(("a",), target, 1.0, None)})
    plant = LagNetwork({}, {"a": Lag(("a",), target, 1.0, 0.0)})
    plant.advance(3.0)
    # x' = 1 - x / 2
    assert plant.value("a") == pytest.approx(2.0 * (1.0 - math.exp(-1.5)), abs=1e-3)
    plant.advance(100.0)
    assert plant.value("a") == pytest.approx(2.0, rel=1e-6)
