"""Numbers with fitting SI prefixes, for axes, titles and tables."""

from __future__ import annotations

import math
from collections.abc import Sequence

_PREFIXABLE = ("m", "A", "V", "N", "W")
_PREFIXES = {"": 1.0, "m": 1e3, "µ": 1e6, "n": 1e9}
_DIGITS = 3
"""Most digits after the point of a number whose unit can take a prefix."""


def fitting_prefix(unit: str, *numbers: float, least: float = 1.0) -> tuple[float, str]:
    """Return factor and unit with the largest SI prefix in which the greatest number (in `unit`) reaches `least`.

    Units that take no prefix, such as °C or 1/m, are returned with the factor 1.
    """
    greatest = max(map(abs, numbers), default=0.0)
    if unit in _PREFIXABLE and greatest > 0.0:
        # Rounding must not decide about a limit such as 1e-4 m.
        fits = (prefix for prefix, factor in _PREFIXES.items() if greatest * factor >= least * (1.0 - 1e-9))
        prefix = next(fits, "n")
        return _PREFIXES[prefix], prefix + unit
    return 1.0, unit


def format_numbers(numbers: Sequence[float | None], unit: str, precision: int) -> list[str]:
    """Return numbers as texts with one common prefix, and at the end their unit, empty for plain numbers.

    Parameters
    ----------
    numbers : sequence of float or None
        In `unit`; None becomes a dash.
    unit : str
        Unit without prefix; `1` for a plain number.
    precision : int
        Digits after the point that are worth showing in `unit`.
    """
    factor, shown = fitting_prefix(unit, *(number for number in numbers if number is not None), least=0.1)
    digits = max(precision - round(math.log10(factor)), 0)
    if unit in _PREFIXABLE:
        digits = min(digits, _DIGITS)
    texts = ["–" if number is None else f"{factor * number:.{digits}f}" for number in numbers]
    return [*texts, "" if shown == "1" else shown]


def with_unit(name: str, unit: str) -> str:
    """Return the label of an axis: the name and, unless it is a plain number, the unit."""
    return f"{name} / {unit}" if unit not in ("", "1") else name


def header_with_unit(name: str, unit: str) -> str:
    """Return a column header such as `force [N]`; the name alone where there is no unit."""
    return f"{name} [{unit}]" if unit else name
