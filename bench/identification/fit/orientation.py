"""Whether the output of a model rises or falls with its input: found from the data before anything is fitted.

A model whose coefficients must not be negative has an output that rises. Of a sensor with the other sign the output
falls: the same class then is fitted to the opposite output, and its coefficients are the opposite ones, <= 0.
"""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

import numpy as np

from bench.base import Floats
from bench.models import ModelSpec, Operator

Orientation: TypeAlias = Literal["auto", "rising", "falling"]
Sign: TypeAlias = Literal[1, -1]

ORIENTATIONS: tuple[Orientation, ...] = ("auto", "rising", "falling")
# Derivation: of the coefficients, as these words say.
SIGNS: dict[Orientation, Sign] = {"rising": 1, "falling": -1}
NAMES: dict[Sign, Orientation] = {1: "rising", -1: "falling"}

# Correlation of input and output from which on it decides for a model all whose parts rise with the input.
# Derivation: a rising line then explains half of the variance of the outputs, 0.7².
_CLEAR = 0.7
# Part of the variance of the outputs by which a falling model must be better than a rising one. Derivation: a
# thousand times the tolerance of a fit, 1e-12.
_ROUNDING = 1e-9


def has_orientation(spec: ModelSpec, template: Operator[Any]) -> bool:
    """Return whether a model has coefficients of constrained sign, so that it can only rise or only fall."""
    return spec.constrained and bool(template.nonnegative().any())


def possible_signs(
    wanted: Orientation,
    name: str,
    spec: ModelSpec,
    template: Operator[Any],
    inputs: Floats,
    outputs: Floats,
    weights: Floats,
) -> tuple[Sign, ...]:
    """Return the signs of the output to fit a model with: both if "auto" is wanted and the data leave it open.

    They leave it open where the correlation is low, and where the model has parts of free sign: a linear part may
    rise while the hysteresis falls, as with the force of a spring with friction over its length.

    Parameters
    ----------
    wanted : {"auto", "rising", "falling"}
        What was asked for.
    name : str
        The model's name, for messages.
    spec, template
        The model.
    inputs, outputs, weights : ndarray, shape (N,)
        The measured sequence; weight 0 where a sample does not count.

    Raises ValueError if the model has no orientation to choose, or it cannot fall.
    """
    if not has_orientation(spec, template):
        if wanted != "auto":
            raise ValueError(f"orientation: {name} has coefficients of either sign; leave {wanted!r} out")
        return (1,)
    units = np.where(template.nonnegative(), 1.0, 0.0)
    if wanted == "auto":
        rising = template.with_coefficients(units, 0.0)
        correlation = _correlation(inputs, outputs, weights)
        if abs(correlation) >= _CLEAR and template.nonnegative().all() and rising.rises():
            return (1,) if correlation > 0.0 else (-1,)
    if wanted != "rising":
        try:
            template.with_coefficients(-units, 0.0)
        except ValueError as error:
            if wanted == "falling":
                raise ValueError(f"orientation: {name} cannot fall: {error}") from None
            return (1,)
    return (SIGNS[wanted],) if wanted != "auto" else (1, -1)


def better_sign(rising: float, falling: float, outputs: Floats, weights: Floats) -> Sign:
    """Return which of two fits to take by their costs, the weighted sums of squares; rising if they are equal."""
    mean = float(weights @ outputs) / float(weights.sum())
    return -1 if falling < rising - _ROUNDING * float(weights @ (outputs - mean) ** 2) else 1


def _correlation(inputs: Floats, outputs: Floats, weights: Floats) -> float:
    """Return the weighted correlation coefficient, 0 of something constant."""
    total = float(weights.sum())
    u, y = inputs - weights @ inputs / total, outputs - weights @ outputs / total
    size = float(np.sqrt((weights @ u**2) * (weights @ y**2)))
    # The quotient of a sequence that is constant but for rounding means nothing.
    floor = 1e-12 * float(np.sqrt((weights @ inputs**2) * (weights @ outputs**2)))
    return float(weights @ (u * y)) / size if size > floor else 0.0
