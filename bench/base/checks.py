"""Checks of numbers that enter the core; each error names the argument and what was expected."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def samples(name: str, values: ArrayLike) -> Floats:
    """Return `values` as a contiguous 1-D float64 array, non-empty and finite, or raise ValueError."""
    try:
        array = np.ascontiguousarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected a sequence of numbers ({error})") from None
    if array.ndim != 1 or np.ndim(values) != 1:
        raise ValueError(f"{name}: expected one dimension, got shape {np.shape(values)}")
    if array.size == 0:
        raise ValueError(f"{name}: expected at least one value, got none")
    finite = np.isfinite(array)
    if not finite.all():
        at = int(np.argmin(finite))
        raise ValueError(f"{name}: expected finite numbers, got {array[at]} at index {at}")
    return array


def counted(name: str, values: ArrayLike, count: int, what: str = "values") -> Floats:
    """Return `values` as `samples` does, `count` of them; `what` says in the error what was expected."""
    array = samples(name, values)
    if array.size != count:
        raise ValueError(f"{name}: expected {count} {what}, got {array.size}")
    return array


def increasing(name: str, values: ArrayLike, least: int = 2) -> Floats:
    """Return `values` as `samples` does, strictly increasing and at least `least` long."""
    array = samples(name, values)
    if array.size < least:
        raise ValueError(f"{name}: expected at least {least} values, got {array.size}")
    steps = np.diff(array)
    if not (steps > 0).all():
        at = int(np.argmax(steps <= 0))
        raise ValueError(
            f"{name}: expected strictly increasing values, got {array[at]} then {array[at + 1]} at index {at}"
        )
    return array


def plays(thresholds: ArrayLike, weights: ArrayLike) -> tuple[Floats, Floats]:
    """Return both as arrays: thresholds that increase from 0, and a weight for each; ValueError otherwise."""
    increase = increasing("thresholds", thresholds, least=1)
    if increase[0] != 0.0:
        raise ValueError(f"thresholds: expected the first to be 0, got {increase[0]}")
    return increase, counted("weights", weights, increase.size, "values, one for each play")


def number(name: str, value: Any) -> float:  # noqa: ANN401 - an unchecked argument
    """Return `value` as a finite float; a text is refused, even if it spells a number."""
    try:
        if isinstance(value, str):
            raise TypeError
        result = float(value)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name}: expected a number, got {value!r}") from None
    if not math.isfinite(result):
        raise ValueError(f"{name}: expected a finite number, got {result}")
    return result


def positive(name: str, value: Any) -> float:  # noqa: ANN401
    """Return `value` as `number` does, > 0."""
    result = number(name, value)
    if not result > 0.0:
        raise ValueError(f"{name}: expected a positive number, got {result}")
    return result


def frozen(array: Floats) -> Floats:
    """Return a read-only copy."""
    copy = array.copy()
    copy.flags.writeable = False
    return copy


def json_field(document: Mapping[str, Any], key: str, kind: str) -> Any:  # noqa: ANN401
    """Return `document[key]`, or raise a ValueError that names the key."""
    if not isinstance(document, Mapping) or key not in document:
        raise ValueError(f"{kind}: expected the key {key!r}")
    return document[key]
