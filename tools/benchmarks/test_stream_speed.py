"""Streams beside steps of immutable states, and the leap of an inverse beside a walk. Prints, asserts no time."""

import time

import numpy as np
import pytest

from bench.models import PrandtlIshlinskii, Preisach, QuadraticTerm, TwoStage, uniform_levels

pytestmark = pytest.mark.benchmark


def per_call(function, values):
    """Return the median wall time of a call over a long sequence, s."""
    times = []
    for start in range(0, len(values), 250):
        block = values[start : start + 250]
        begin = time.perf_counter()
        for value in block:
            function(value)
        times.append((time.perf_counter() - begin) / len(block))
    return float(np.median(times))


def stepping(operator):
    """Return a function that steps an operator by immutable states."""
    state = operator.initial_state()

    def step(value):
        nonlocal state
        state, _ = operator.step(state, value)

    return step


def preisach(order, low=0.0, high=1.0):
    rng = np.random.default_rng(order)
    density = rng.uniform(0.0, 1.0, order * (order + 1) // 2)
    return Preisach(uniform_levels(low, high, order), density, 0.1, QuadraticTerm(0.5, 0.1, low), (low, high))


def test_streams(capsys):
    rng = np.random.default_rng(0)
    inputs = rng.uniform(0.0, 1.0, 20_000).tolist()
    nested = (0.5 + np.linspace(0.5, 0.0, 2000) * np.where(np.arange(2000) % 2, -1.0, 1.0)).tolist()
    thresholds = np.linspace(0.0, 1.0, 100)
    cases = [
        ("Preisach, M = 20", preisach(20), inputs),
        ("Preisach, M = 200", preisach(200), inputs),
        ("Preisach, M = 20, 2000 corners", preisach(20), nested),
        ("100 plays", PrandtlIshlinskii(thresholds, rng.uniform(0.0, 1.0, 100), origin=0.5), inputs),
    ]
    rows = []
    for name, operator, values in cases:
        stream = operator.stream()
        outputs = [stream.step(value) for value in values]
        np.testing.assert_array_equal(outputs, operator.evaluate(values))
        rows.append((name, per_call(stepping(operator), values), per_call(operator.stream().step, values)))
    model = TwoStage(preisach(50), preisach(50, -7.0, 1.0), 0.2)
    pairs = list(zip(inputs[:5000], rng.uniform(0.0, 0.5, 5000).tolist(), strict=True))
    state, stream = model.initial_state(), model.stream()

    def step(pair):
        nonlocal state
        state, _ = model.step(state, *pair)

    rows.append(("two stages", per_call(step, pairs), per_call(lambda pair: stream.step(*pair), pairs)))
    with capsys.disabled():
        print("\none sample: step of a state, of a stream")
        for name, single, streamed in rows:
            print(f"  {name:32s} {single * 1e6:6.2f} µs  {streamed * 1e6:5.2f} µs  x{single / streamed:.0f}")


def test_inverse_streams(capsys):
    rows = []
    for order in (20, 100, 400):
        operator = preisach(order)
        low, high = operator.output_range()
        t = np.arange(100_000)
        smooth = 0.5 * (low + high) + 0.45 * (high - low) * np.sin(t / 150.0) * (1.0 - 0.5 * t / t.size)
        jumps = np.random.default_rng(1).uniform(low, high, 20_000)
        inverse = operator.inverse()
        for name, targets in (("smooth", smooth), ("jumps", jumps)):
            state = operator.initial_state()

            def invert(target, inverse=inverse):
                nonlocal state
                state = inverse.invert(state, target).state

            inverse.follow(targets)
            begin = time.perf_counter()
            found = inverse.follow(targets)
            sequence = (time.perf_counter() - begin) / targets.size
            stream = inverse.stream()
            np.testing.assert_array_equal([stream.step(each) for each in targets.tolist()], found.setpoints)
            worst = np.abs(operator.evaluate(found.setpoints) - targets).max() / (high - low)
            assert worst < 1e-12
            single = per_call(invert, targets[:3000].tolist())
            streamed = per_call(inverse.stream().step, targets.tolist())
            rows.append((order, name, single, streamed, sequence, worst))
    with capsys.disabled():
        print("\none target: inversion from a state, by a stream, in a sequence; residual, of the range")
        for order, name, single, streamed, sequence, worst in rows:
            print(
                f"  M={order:3d} {name:7s} {single * 1e6:6.2f} µs  {streamed * 1e6:5.2f} µs"
                f"  x{single / streamed:3.0f}  {sequence * 1e9:5.0f} ns  {worst:.0e}"
            )
