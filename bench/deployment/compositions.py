"""Models of several parts as C: two operators, and an operator with a linear part behind it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from bench.base import ConfigurationError, DataError
from bench.deployment.c_source import Real, Source, constants, parts_of, rendered
from bench.deployment.operators import Starts, operator_source
from bench.models import (
    Hammerstein,
    Linear,
    Operator,
    Polynomial,
    PolynomialPlays,
    Summed,
    TwoStage,
    bring_responses,
    passages,
    split_delay,
)

_SAMPLES = 4.0
"""Least number of samples within the rise time of a linear part. Source: Åström and Wittenmark, Computer-Controlled
Systems, 1997, section 2.9: 4 to 10."""
_MET = {"double": 1e-10, "float": 1e-5}
"""Part of the range of the output within which a target counts as met. Source: that of the packaged inverse of
two-stage models; of float what its rounding leaves."""


def _two_stage_source(whole: TwoStage, real: Real, name: str) -> Source:
    """Return a two-stage model as C; raises DataError if a stage falls, or there is no C for it."""
    for label, stage in whole.operators.items():
        if not stage.rises():
            raise DataError(
                f"{label} falls with its input somewhere: the inverse of a two-stage model needs stages that rise"
            )
    cold = whole.initial_state()
    hot, _ = whole.step(cold, whole.first.input_range[1], whole.pretension)
    states = [cold, cold, cold, hot]
    first = operator_source(
        _with_memory(whole.first), _starts(whole.first, [s.first for s in states]), real, f"{name}_h1", name
    )
    second = operator_source(
        whole.second, _starts(whole.second, [s.second for s in states]), real, f"{name}_h2", name
    )
    (low, high), (least, greatest) = whole.first.input_range, whole.second.output_range()
    numbers = {
        "inputs": np.array([[s.voltage, s.force, s.blocked, s.argument] for s in states]),
        "low": low, "high": high, "least": least, "greatest": greatest,
        "tolerance": _MET[real] * (greatest - least),
    }  # fmt: skip
    return _joined("two_stage.c.in", "coupled.h.in", [first, second], numbers, {}, 4, real, name)


def _summed_source(model: Summed, real: Real, name: str) -> Source:
    """Return the sum of two operators as C; raises DataError if there is no C for one."""
    cold = model.initial_state()
    hot, _ = model.step(cold, model.by_voltage.input_range[1], model.pretension)
    states = [cold, cold, cold, hot]
    by_force = operator_source(
        model.by_force, _starts(model.by_force, [s.by_force for s in states]), real, f"{name}_h3", name
    )
    by_voltage = operator_source(
        model.by_voltage, _starts(model.by_voltage, [s.by_voltage for s in states]), real, f"{name}_h4", name
    )
    return _joined("summed.c.in", "coupled.h.in", [by_force, by_voltage], {}, {}, 0, real, name)


class Composition(NamedTuple):
    """How a model from voltage and force to length is written, and its ranges.

    Attributes
    ----------
    source : callable
        Takes model, type of the numbers, and name.
    ranges : callable
        Takes the model; returns the ranges of voltage, force and length.
    """

    source: Callable[[Any, Real, str], Source]
    ranges: Callable[[Any], list[tuple[float, float]]]


def _two_stage_ranges(model: TwoStage) -> list[tuple[float, float]]:
    return [model.first.input_range, model.second.input_range, model.second.output_range()]


def _summed_ranges(model: Summed) -> list[tuple[float, float]]:
    (low, high), (least, greatest) = model.by_force.output_range(), model.by_voltage.output_range()
    return [model.by_voltage.input_range, model.by_force.input_range, (low - greatest, high - least)]


COUPLED: Mapping[type[Any], Composition] = {
    TwoStage: Composition(_two_stage_source, _two_stage_ranges),
    Linear: Composition(
        lambda model, real, name: _two_stage_source(model.two_stage, real, name),
        lambda model: _two_stage_ranges(model.two_stage),
    ),
    Summed: Composition(_summed_source, _summed_ranges),
}


def hammerstein_source(model: Hammerstein, starts: Starts, real: Real, period: float | None, name: str) -> Source:
    """Return an operator with a linear part as C.

    Raises ConfigurationError without a period or if it does not suit the linear part, DataError if the model cannot
    be exported.
    """
    if model.is_viscous:
        raise DataError(
            "a model with viscous terms cannot be exported: what the input does next decides them; identify one "
            "without them, such as with -o dynamics=lag"
        )
    if period is None:
        raise ConfigurationError("--period: a model with time needs one, in s; the linear part is discretized for it")
    linear = model.linear
    rise = _rise_time(*linear.lag)
    if rise > 0.0 and period > rise / _SAMPLES:
        raise ConfigurationError(
            f"--period {period:g}: too long for the linear part, which rises within {rise:.4g} s; take at most "
            f"{rise / _SAMPLES:.4g} s, or identify a model without time"
        )
    late, part = split_delay(linear.delay, period)
    times, periods = np.array([part * period, period]), np.full(2, period)
    passed = np.stack([passages(lag, times, periods) for lag in linear.lags], axis=1)
    ahead, _ = model.ahead(model.initial_state())
    try:
        bring_responses(ahead.linear, np.array([0.0, period, 2.0 * period]), np.zeros(3), None, lambda value: value)
    except ValueError as error:
        raise ConfigurationError(f"--period {period:g}: {error}") from None
    operator = operator_source(model.static, starts, real, f"{name}_h", name)
    numbers = {
        "passages": passed,
        "strengths": linear.strengths,
        "bias": model.static.bias,
        "part": part,
        "gain": linear.gain,
        "effect": linear.gain - float(passed[1, :, 2] @ linear.strengths),
    }
    words = {"creep": linear.creep_times.size, "late": late, "period": f"{period:g}"}
    reals = 2 * (2 * len(linear.lags) + 1) + late + 3
    return _joined("hammerstein.c.in", "hammerstein.h.in", [operator], numbers, words, reals, real, name)


def _joined(
    template: str,
    header: str,
    parts: list[Source],
    numbers: dict[str, Any],
    words: dict[str, Any],
    reals: int,
    real: Real,
    name: str,
) -> Source:
    own = parts_of(template)
    declared, size = constants(numbers, real)
    names = real, f"{name}_of", name
    return Source(
        "".join(part.states + part.functions for part in parts) + rendered(own["head"], *names, words),
        rendered(parts_of(header)["head"], *names, words),
        "".join(part.code for part in parts)
        + rendered(own["code"].replace("/*@constants*/\n", declared), *names, words),
        size + sum(part.constants for part in parts),
        sum(part.state for part in parts) + reals * (4 if real == "float" else 8) + 8 * ("late" in words),
        1000 + sum(part.machine for part in parts),
        "; ".join(part.step for part in parts),
        "; ".join(part.inverse for part in parts),
    )


def _starts(operator: Operator[Any], states: list[Any]) -> Starts:
    if operator.memoryless:
        states = [(operator.input_range[0], operator.input_range[0])] * 4
    first, second, third, fourth = states
    return first, second, third, fourth


def _with_memory(operator: Operator[Any]) -> Operator[Any]:
    """Return a polynomial as one beside a play without weight, so that its C has a state as every other."""
    if type(operator) is not Polynomial:
        return operator
    low, high = operator.input_range
    return PolynomialPlays(operator.series, np.array([high - low]), np.zeros(1), (low, high), operator.bias)


def _rise_time(first: float, second: float) -> float:
    """Return the rise time of 1 / (1 + first s + second s²), s; the book's, of one time constant or of two poles."""
    if second == 0.0:
        return first
    frequency, damping = 1.0 / math.sqrt(second), 0.5 * first / math.sqrt(second)
    if damping >= 1.0:
        return first
    angle = math.acos(damping)
    return math.exp(angle / math.tan(angle)) / frequency
