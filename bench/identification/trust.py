"""Whether a fit can be trusted: what is refused before it, and what is warned of after it, with the remedy.

What passes may still be poor on other inputs: only samples that were left out of a fit say how good it is there.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.base import Floats
from bench.identification.advice import Advice
from bench.identification.choose.splits import record_of
from bench.identification.fit.least_squares import Fit
from bench.models import Operator

if TYPE_CHECKING:
    from bench.identification.by_name import FitProblem

# Fewest samples, and least part of them, that an unknown initial memory must leave. Derivation: the standard
# deviation of ten samples is known to a quarter of it; one part in twenty is a choice.
_FEWEST, _LEAST_PART = 10, 0.05
# Fewest free coefficients. Derivation: a loop has two branches that differ, beside its slope.
_FEWEST_FREE = 3
# Least explained part of the variance of the outputs. Derivation: below, more is left than is explained.
_LEAST_EXPLAINED = 0.5
# Fewest samples for each free coefficient. Derivation: with three, the variance of a prediction at them is a third of
# that of the noise.
_SAMPLES_EACH = 3
# Greatest condition number. Derivation: that of the normal matrix is its square, and 1e-12 the tolerance of a fit.
_CONDITION = 1e6
# Times by which the greatest error of the first samples must exceed that of the others. Derivation: one normal error
# exceeds twice the greatest of a hundred others, 2.7 standard deviations, in one of 1e7 cases.
_FIRST = 2.0
# Least part of the plane that the inputs must reach, and of their range that the plane must hold: at all, and of a
# fit that is not good. Source: a choice; of a plane of which less than half is reached most is unknown, and a fit
# that is good needs no warning of inputs beyond.
_PLANE_REACHED, _INPUTS_HELD, _HELD_OF_POOR = 0.5, 0.2, 0.95
# Of a butterfly the loops on the two halves of the range turn in opposite directions: least ratio of their areas,
# least area in standard deviations, and the explained part of the variance from which on a fit is good as it is.
# Derivation: a normal area exceeds five standard deviations by chance in one of 1e6 cases; what a good fit leaves is
# 7 % of the outputs' standard deviation, √0.005; the ratio is a choice.
_AREAS, _DEVIATIONS, _GOOD = 0.2, 5.0, 0.995


def check_record(inputs: Floats, outputs: Floats, skip: int) -> None:
    """Check that the samples that count, from `skip` on, say anything of a model.

    Raises ValueError if inputs or outputs are constant.
    """
    for name, values in (("inputs", inputs[skip:]), ("outputs", outputs[skip:])):
        if values.size and np.ptp(values) <= 1e-12 * np.abs(values).max():
            raise ValueError(
                f"{name}: constant at {values[0]:g} in all {values.size} samples that count; a model needs a record "
                "in which both input and output vary"
            )


def check_skipped(samples: int, skip: int, coefficients: int, estimable: bool) -> None:
    """Check that leaving out the first `skip` samples, of unknown memory, leaves enough for so many coefficients.

    Raises ValueError if hardly any are left, or less than half and fewer than coefficients.
    """
    left = samples - skip
    if left < max(_FEWEST, _LEAST_PART * samples) or left < min(coefficients, 0.5 * samples):
        raise ValueError(_too_few(samples, left, estimable))


def check_interpolation(problem: FitProblem, found: Fit) -> None:
    """Check that a fit to what an unknown memory left has more samples than coefficients that the data determine.

    Raises ValueError if it has not.
    """
    samples, left = (int(np.count_nonzero(problem.weights[first:])) for first in (0, problem.skip))
    if left <= found.certificate.determined + 1.0:
        estimable = problem.spec.estimate_state is not None
        raise ValueError(f"{_too_few(samples, left, estimable)}; or fewer coefficients")


def _too_few(samples: int, left: int, estimable: bool) -> str:
    others = "--initial estimate, negative or positive" if estimable else "--initial negative or positive"
    return (
        f"initial: 'skip' leaves {left} of {samples} samples, as the inputs leave the memory unknown up to there; "
        f"use {others} instead"
    )


def judge_fit(
    problem: FitProblem, found: Fit, errors: Floats, *, initial: str | None, smoothing: float
) -> list[Advice]:
    """Return why a fit should not be trusted; nothing if there is no reason.

    `errors`, shape (N,), are the measured less the modelled outputs, output units; those of skipped samples too. Rows
    after the last that is fitted are not looked at.
    """
    record = record_of(problem.weights)
    errors, inputs, outputs = errors[record], problem.inputs[record], problem.outputs[record]
    problem = replace(problem, inputs=inputs, outputs=outputs, weights=problem.weights[record])
    weights = problem.weights[problem.skip :]
    measured, left = problem.outputs[problem.skip :], errors[problem.skip :]
    mean = weights @ measured / weights.sum()
    explained = 1.0 - float(weights @ left**2) / float(weights @ (measured - mean) ** 2)
    signed = not problem.spec.constrained or not problem.template.nonnegative().any()
    return [
        *_plane(problem, explained),
        *_unit(problem.template),
        *([] if explained >= _GOOD else _free(found, signed)),
        *_explained(explained, problem.template, signed),
        *([] if signed or explained >= _GOOD else _butterfly(problem, left)),
        *_samples(int(np.count_nonzero(weights)), found, smoothing),
        *_condition(found),
        *_first(problem, errors, initial),
    ]


def _free(found: Fit, signed: bool) -> list[Advice]:
    free, count = found.certificate.passive, found.coefficients.size
    if free >= min(_FEWEST_FREE, count):
        return []
    remedy = (
        "a larger record" if signed else "-o orientation=auto, -o reversible=polynomial or --model preisach-signed"
    )
    text = f"free coefficients: only {free} of {count}, so that the model hardly answers to its input"
    return [Advice("few-free", text, f"try {remedy}")]


def _explained(explained: float, template: Operator[Any], signed: bool) -> list[Advice]:
    if explained >= _LEAST_EXPLAINED:
        return []
    if template.memoryless:
        remedy = "a model with memory, such as --model preisach"
    elif signed:
        remedy = "-o reversible=polynomial, or more levels"
    else:
        remedy = "--model preisach-signed, for outputs that rise and fall, or -o reversible=polynomial"
    text = (
        f"the model explains {max(explained, 0.0):.0%} of the variance of the output (R² < 0.5), which may not "
        "depend on this input at all"
    )
    return [Advice("unexplained", text, f"try {remedy}")]


def _samples(samples: int, found: Fit, smoothing: float) -> list[Advice]:
    free, count = found.certificate.passive, found.coefficients.size
    # With smoothing more coefficients are free than the data have to determine.
    if samples >= count and (smoothing or samples >= _SAMPLES_EACH * free):
        return []
    remedy = "fewer --levels" if smoothing else "fewer --levels, --smoothing or --cross-validate"
    text = (
        f"{samples} samples are few for {count} coefficients, {free} of them free: on other inputs the errors will "
    )
    return [Advice("few-samples", f"{text}be larger than these", f"use {remedy}")]


def _condition(found: Fit) -> list[Advice]:
    condition = found.certificate.condition
    if condition <= _CONDITION:
        return []
    text = f"the condition is {condition:.1g} (> 1e6), so that the coefficients follow the noise"
    return [
        Advice(
            "condition", f"{text}, and outputs for other inputs may be far off", "use fewer --levels or --smoothing"
        )
    ]


def _first(problem: FitProblem, errors: Floats, initial: str | None) -> list[Advice]:
    """Return whether the samples that the initial memory reaches are much worse than the others."""
    if problem.template.memoryless or initial == "skip":
        return []
    first = problem.template.unknown_until(problem.inputs)
    reached, others = np.abs(errors[problem.skip : first]), np.abs(errors[max(first, problem.skip) :])
    if not reached.size or others.size < _FEWEST or reached.max() <= _FIRST * others.max():
        return []
    estimable = problem.spec.estimate_state is not None and initial != "estimate"
    span = float(np.ptp(problem.outputs)) / 100.0
    last = problem.skip + int(np.flatnonzero(reached > others.max())[-1]) + 1
    text = (
        f"the largest errors stand in the first {last} samples, which the initial memory reaches "
        f"({reached.max() / span:.2g} % of the range; {others.max() / span:.2g} % where it does not)"
    )
    return [Advice("initial-memory", text, f"try --initial {'estimate or skip' if estimable else 'skip'}")]


def _plane(problem: FitProblem, explained: float) -> list[Advice]:
    """Return whether inputs and plane do not match; a plane within the inputs is none if its fit is good."""
    plane = problem.template.plane
    if plane is None:
        return []
    least, greatest = float(problem.inputs.min()), float(problem.inputs.max())
    shared = max(min(plane[1], greatest) - max(plane[0], least), 0.0)
    held = _INPUTS_HELD if explained >= _GOOD else _HELD_OF_POOR
    if shared >= _PLANE_REACHED * (plane[1] - plane[0]) and shared >= held * (greatest - least):
        return []
    unit = f" {problem.template.input_unit}".rstrip()
    ends = f"{plane[0]:g} to {plane[1]:g}{unit}"
    text = f"the plane from {ends} does not match the inputs, {least:g} to {greatest:g}{unit}"
    return [Advice("plane", text, f"give --plane {least:g} {greatest:g}, or leave it out")]


def _unit(template: Operator[Any]) -> list[Advice]:
    unit = template.input_unit.strip()
    if not unit or not template.input_units or unit in template.input_units:
        return []
    text = f"the reversible part of this model is for an input in {template.input_units[0]}; this one is in {unit}"
    return [Advice("unit", text, "use --model preisach -o reversible=polynomial")]


def _butterfly(problem: FitProblem, errors: Floats) -> list[Advice]:
    """Return whether the loops over the lower and the upper half of the inputs turn in opposite directions."""
    u, y = problem.inputs[problem.skip :], problem.outputs[problem.skip :]
    middle = 0.5 * float(u.min() + u.max())
    # From the end straight back to the beginning, so that what depends on the input alone leaves no area.
    u, y = np.append(u, u[0]), np.append(y, y[0])
    means = 0.5 * (y[1:] + y[:-1]) - y.mean()
    noise = float(np.sqrt(np.mean(errors**2)))
    areas, floors = [], []
    for half in (np.minimum(u, middle), np.maximum(u, middle)):
        steps = np.diff(half)
        areas.append(float(means @ steps))
        floors.append(_DEVIATIONS * noise * float(np.sqrt(steps @ steps)))
    small, large = sorted(map(abs, areas))
    clear = all(abs(area) > floor for area, floor in zip(areas, floors, strict=True))
    if areas[0] * areas[1] >= 0.0 or small < _AREAS * large or not clear:
        return []
    text = (
        "the loops over the low and the high inputs turn in opposite directions (a butterfly), which coefficients of "
    )
    return [Advice("butterfly", f"{text}one sign cannot give", "use --model preisach-signed")]
