"""Operators of elements: CPU time of a fit by name, of a sample, of a step and of a stream. Asserts no time."""

import time

import numpy as np
import pytest

from bench.identification import identify
from bench.models import BoucWen

pytestmark = pytest.mark.benchmark

MODELS = ("bouc-wen", "duhem", "generalized-prandtl-ishlinskii", "krasnoselskii-pokrovskii", "maxwell-slip")


def cpu(function):
    """Return the CPU time of a call, s, and its result; the first call, which may compile, is left out."""
    function()
    start = time.process_time()
    result = function()
    return time.process_time() - start, result


@pytest.mark.parametrize("rows", [3000, 8000])
def test_fit_evaluate_and_step(capsys, rows):
    phase = np.linspace(0.0, 1.0, rows)
    inputs = np.sin(2 * np.pi * 20 * phase) * (1.0 - 0.9 * phase)
    plant = BoucWen(1.0, 0.6, 0.3, 3.0, 1.0, 1.5, 0.5)
    outputs = plant.evaluate(inputs)
    outputs += 0.01 * np.ptp(outputs) * np.random.default_rng(0).normal(size=rows)
    lines = [f"{rows} rows of a Bouc-Wen plant with 1 % noise, CPU time"]
    for name in MODELS:
        seconds, found = cpu(lambda name=name: identify(name, inputs, outputs))
        operator = found.model
        sample, _ = cpu(lambda operator=operator: operator.evaluate(inputs))

        def steps(operator=operator):
            state = operator.initial_state()
            for value in inputs[:1000].tolist():
                state, _ = operator.step(state, value)

        step, _ = cpu(steps)
        stream = operator.stream()
        streamed, _ = cpu(lambda stream=stream: [stream.step(value) for value in inputs[:1000].tolist()])
        lines.append(
            f"{name:32s} fit {seconds:6.2f} s, RMS {found.errors.rms_percent:5.2f} %, "
            f"{1e9 * sample / rows:6.0f} ns a sample, {1e3 * step:5.1f} µs a step, {1e3 * streamed:5.2f} µs streamed"
        )
        assert found.errors.rms_percent < 10.0
    with capsys.disabled():
        print("\n" + "\n".join(lines))
