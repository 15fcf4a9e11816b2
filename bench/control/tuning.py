"""Numbers of controllers: defaults in proportion to the ranges of a model, and what a rig puts in their place.

What is a length or a rate for one actuator means nothing for another. So numbers with units have defaults that are
fractions of the ranges of the model at hand, and a rig file may replace each of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, NamedTuple, TypeVar

from bench.base import closest
from bench.models import Operator

T = TypeVar("T")


class Spans(NamedTuple):
    """Widths of the ranges of a model: of its input and of its output, in their units, both > 0."""

    input: float
    output: float

    @classmethod
    def of(cls, model: Operator[Any]) -> Spans:
        """Return those of a model."""
        low, high = model.input_range
        least, greatest = model.output_range()
        return cls(high - low, greatest - least)


def tuned(default: T, options: Mapping[str, Any]) -> T:
    """Return numbers of a controller with some of them replaced.

    Parameters
    ----------
    default : dataclass
        The numbers.
    options : mapping
        By field: a number, or for a field that is itself such a dataclass a mapping by its fields.

    Raises
    ------
    ValueError
        If there is no such field, or a value is not allowed.
    """
    known = [field.name for field in fields(default)]  # type: ignore[arg-type]
    changes: dict[str, Any] = {}
    for name, value in options.items():
        if name not in known:
            raise ValueError(f"{name}: there is no such number; {closest(name, known)}")
        inner = getattr(default, name)
        nested = is_dataclass(inner)
        if nested and not isinstance(value, Mapping):
            raise ValueError(f"{name} = {value!r}: expected a table of numbers")
        if not nested and (isinstance(value, bool) or not isinstance(value, int | float)):
            raise ValueError(f"{name} = {value!r}: expected a number")
        changes[name] = tuned(inner, value) if nested else value
    changed: T = replace(default, **changes)  # type: ignore[type-var]
    return changed
