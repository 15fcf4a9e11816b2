"""Units: those that are known, and numbers and durations as texts for axes, titles and tables."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Self

_PREFIXABLE = ("m", "A", "V", "N", "W", "m/s")
_PREFIXES = {"": 1.0, "m": 1e3, "µ": 1e6, "n": 1e9}
_DIGITS = 3
"""Most digits after the point of a number whose unit can take a prefix."""
_QUANTITY = re.compile(
    r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)\s*((?:(?<=\s)1/)?[A-Za-z°µμΩ%][^,;]*?)\s*", re.ASCII | re.IGNORECASE
)


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


def difference_unit(unit: str) -> str:
    """Return the unit of differences of a quantity: a difference of temperatures is in K."""
    return unit.replace("°C", "K")


def significant(value: float, digits: int) -> str:
    """Return a number with so many significant digits, without an exponent from 1e-4 to 1e6."""
    return f"{float(f'{value:.{digits}g}'):g}"


def prefixed(value: float, unit: str, digits: int = 4) -> str:
    """Return a value in `unit` with so many significant digits, its own prefix and its unit, as of an error."""
    factor, shown = fitting_prefix(unit, value)
    return f"{significant(factor * value, digits)} {'' if shown == '1' else shown}".rstrip()


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


@dataclass(frozen=True)
class Display:
    """How the values of one quantity are shown, wherever that is: in one unit, with so many digits.

    Attributes
    ----------
    factor : float
        From the unit of the values to the one that is shown.
    unit : str
        What is shown; empty for a plain number.
    digits : int
        After the point.
    """

    factor: float
    unit: str
    digits: int

    @classmethod
    def of(cls, unit: str, precision: int, extent: float | None = None) -> Self:
        """Return how values are shown.

        Parameters
        ----------
        unit : str
            Theirs.
        precision : int
            Digits after the point that are worth showing in it.
        extent : float, optional
            Greatest magnitude that they can have; judged by the digits if it is not known.
        """
        factor, shown = fitting_prefix(unit, extent or 10.0 ** (3 - precision))
        digits = max(precision - round(math.log10(factor)), 0)
        return cls(factor, "" if shown == "1" else shown, min(digits, _DIGITS) if unit in _PREFIXABLE else digits)

    def number(self, value: float | None) -> str:
        """Return a value without its unit; a dash for None."""
        if value is None:
            return "–"
        # No zero has a sign.
        return f"{round(self.factor * value, self.digits) + 0.0:.{self.digits}f}"

    def bare(self, value: float) -> str:
        """Return a limit or a reading beside one, without its unit: six significant digits, no zeros at the end."""
        return f"{self.factor * value:g}"

    def between(self, low: float, high: float) -> str:
        """Return a range with its unit, such as `5 to 60 °C`; `≤ 60 °C` where one end is infinite."""
        if math.isinf(low):
            ends = "any" if math.isinf(high) else f"≤ {self.bare(high)}"
        else:
            ends = f"≥ {self.bare(low)}" if math.isinf(high) else f"{self.bare(low)} to {self.bare(high)}"
        return f"{ends} {self.unit}".rstrip()

    def text(self, value: float) -> str:
        """Return a value with its unit, and with two digits that are not zero, as of a small error."""
        scaled = abs(self.factor * value)
        needed = 1 - math.floor(math.log10(scaled)) if 0.0 < scaled < math.inf else 0
        digits = needed if self.digits < needed <= self.digits + _DIGITS else self.digits
        return f"{replace(self, digits=digits).number(value)} {self.unit}".rstrip()


def percent(value: float) -> str:
    """Return a percentage as a text with two digits after the point, or with two that are not zero."""
    return Display(1.0, "%", 2).text(value)


def format_duration(seconds: float) -> str:
    """Return a time in s as `h:mm:ss`; what is unknown or infinite as `?`."""
    if not math.isfinite(seconds):
        return "?"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"


def with_unit(name: str, unit: str) -> str:
    """Return the label of an axis: the name and, unless it is a plain number, the unit; a fraction in parentheses."""
    shown = f"({unit})" if "/" in unit else unit
    return f"{name} / {shown}" if unit not in ("", "1") else name


def header_with_unit(name: str, unit: str) -> str:
    """Return a column header such as `force [N]`; the name alone where there is no unit."""
    return f"{name} [{unit}]" if unit else name


@cache
def unit_registry() -> Any:  # noqa: ANN401 - the library's registry has no useful type
    """Return the registry of known units."""
    # It takes a second to import, which only rigs that need it should pay for.
    from pint import UnitRegistry

    return UnitRegistry()


def quantity(key: str, text: str) -> Any:  # noqa: ANN401 - a quantity of the library's
    """Return a number and its unit, such as `300e-6 m`; °C count as K.

    Raises
    ------
    ValueError
        If the text is not that, or the scale of the unit does not begin at 0; names `key`.
    """
    number, _, unit = text.strip().partition(" ")
    try:
        import numpy as np

        # Its numbers divide by zero without an exception.
        found = unit_registry().Quantity(np.float64(number), unit.replace("°C", "K") or "1")
        origin = unit_registry().Quantity(0.0, found.units).to_base_units().magnitude
    except Exception as error:
        raise ValueError(f"{key} = {text!r}: expected a number and a unit, such as '300e-6 m': {error}") from None
    if not math.isfinite(found.magnitude) or origin != 0.0:
        raise ValueError(f"{key} = {text!r}: expected a finite number and a unit whose scale begins at 0")
    return found


def is_quantity(text: str) -> bool:
    """Return whether a text is a number with a unit behind it, such as `3K` or `300 µm`."""
    return _with_its_unit(text) is not None


def _with_its_unit(text: str) -> re.Match[str] | None:
    try:
        float(text)
    except ValueError:
        return _QUANTITY.fullmatch(text)
    # Also `1e3`, which is no number of the unit e3.
    return None


def read_quantity(text: str, unit: str) -> float:
    """Return the number in `unit` that a text stands for, such as `300 µm` or `3K`; a number alone is in `unit`.

    Where `unit` is K or K/s, °C counts as K: it is of a difference.

    Raises
    ------
    ValueError
        If the text is neither, or its unit is of another kind; says what is expected.
    """
    found = _with_its_unit(text)
    try:
        if found is None:
            return float(text)
        number, given = float(found[1]), found[2]
        if unit == "°C":
            given = "degC" if given in ("C", "°C") else given
        else:
            given = re.sub("°?C\\b|degC", "K", given) if unit.startswith("K") else given
        wanted = "degC" if unit == "°C" else unit.replace("%", "percent") or "1"
        return float(unit_registry().Quantity(number, given.replace("%", "percent")).to(wanted).magnitude)
    except Exception:
        shown = "a plain number" if unit in ("", "1") else f"a number in {unit}, or one with a unit of this kind"
        raise ValueError(f"expected {shown}, not {text!r}") from None


def in_si(text: str) -> float:
    """Return the number that a text such as `3 ms` stands for, in SI units; temperatures in °C.

    Raises ValueError if it is none.
    """
    found = _with_its_unit(text)
    with suppress(Exception):
        if found is not None:
            given = found[2].replace("%", "percent").replace("°C", "K")
            return float(unit_registry().Quantity(float(found[1]), given).to_base_units().magnitude)
    raise ValueError(f"expected a number and a unit, such as 3 ms, not {text!r}") from None


def check_unit(unit: str) -> str:
    """Return a unit that is known; a plain number has the unit 1.

    Raises
    ------
    ValueError
        If there is no such unit, or its scale does not begin at 0.
    """
    try:
        quantity("unit", f"1 {unit}")
        if not unit.strip():
            raise ValueError
    except ValueError:
        raise ValueError("is no unit; expected one such as V, mA, °C, Pa, 1/m, or 1 for a plain number") from None
    return unit


def in_unit(number: float, sent: str, wanted: str) -> float:
    """Return a number with the unit that an instrument sent, such as `mV`, in another unit.

    `C` is °C where a temperature is wanted.

    Raises
    ------
    ValueError
        If the unit is unknown, is not of the same kind, or may have another prefix: of a text in capitals, `M` may be
        milli (IEEE 488.2, 7.7.3) and `P` pico.
    """
    registry = unit_registry()
    target = wanted.replace("°C", "degC")
    try:
        source = "degC" if target in ("degC", "K") and sent in ("C", "°C") else sent
        if len(source) > 1 and source.isascii() and source.isupper() and source[0].lower() + source[1:] in registry:
            raise ValueError(f"may be {source[0].lower() + source[1:]}")
        found = registry.Quantity(number, source).to(target).magnitude
    except Exception as error:
        raise ValueError(f"{sent!r} is no unit that is read as {wanted}: {error}") from None
    return float(found)


def per_square(output_unit: str, input_unit: str, greatest: float) -> tuple[float, str]:
    """Return factor and unit of a density over the square of an input, such as `µm/V²` or `1/(m K²)`.

    Parameters
    ----------
    output_unit, input_unit : str
        Units; empty if unknown. Differences of °C are K.
    greatest : float
        Greatest density in these units, which decides the prefix of the output.
    """
    squared = f"{'K' if input_unit == '°C' else input_unit}²" if input_unit not in ("", "1") else ""
    factor, output = fitting_prefix(output_unit, greatest)
    above, _, below = output.partition("/")
    if not squared:
        return factor, output
    if any(sign in below for sign in "/()") or "/" in squared:
        return factor, f"({output})/({squared.removesuffix('²')})²"
    return factor, f"{above or '1'}/({below} {squared})" if below else f"{output or '1'}/{squared}"
