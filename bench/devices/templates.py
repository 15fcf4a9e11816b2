"""Messages to and from a text instrument, in which placeholders stand for numbers, units and text.

==========  =========================================================================================================
`{value}`   the number, with a format of Python's in what is sent; of several numbers, each has the name of its signal
`{unit}`    after a number: the unit in which the instrument sends it, such as mV, which is converted
`{any}`     any text
==========  =========================================================================================================

A number is read whole or not at all: what `{any}` stands for may not continue it. A comma between two digits may
be a decimal sign unless the sign is known, and letters behind a number may be a unit. Sources: IEEE 488.2-1992 (NR1,
NR2 and NR3), SCPI-99 volume 1, 7.2.1 (9.9E37 is infinity, 9.91E37 not a number).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from string import Formatter
from types import MappingProxyType
from typing import Literal

from bench.base import fitting_prefix, in_unit

VALUE = "value"
"""The placeholder of a number where there is only one."""

UNIT = "unit"
"""The placeholder of the unit that follows a number."""

ANY = "any"
"""The placeholder of any text."""

ANY_TEXT = f"{{{ANY}}}"
"""The form of a message that may be anything."""

Decimal = Literal[".", ","]
"""The decimal sign of an instrument."""

_NOT_A_NUMBER = 9.9e37
"""From here on a number of SCPI stands for infinity or for no number."""

_LETTER = r"(?:[^\W\d_]|[°%/])"
_THOUSANDS = re.compile(r"[0-9][.,'\s][0-9]{3}(?![0-9])")
_EXPONENT = r"[eE][-+]?[0-9]"
_NO_UNITS: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True)
class Template:
    """A message with placeholders for numbers, for their units, and for text that does not matter.

    Parameters
    ----------
    text : str
        The message; the placeholder of a number may carry a format of Python's, as in `VOLT {value:.3f}`.
    decimal : {".", ","}, optional
        The decimal sign. If it is not given it is the point, and a number that a comma may continue is not read.

    Raises
    ------
    ValueError
        If the text is empty, has a placeholder without a name or with a format that is none, one stands twice, or a
        number could not be told from what is beside it.
    """

    text: str
    decimal: Decimal | None = None

    def __post_init__(self) -> None:
        if not self.text.strip():
            raise ValueError("is empty; expected a message to or from the instrument")
        if len(set(self.names)) < len(self.names):
            raise ValueError("each number may stand once only")
        names = [name for _, name, _ in self._parts]
        for i, (text, name, _) in enumerate(self._parts):
            if i > 0 and name not in (None, ANY, UNIT) and names[i - 1] not in (None, ANY) and not text:
                raise ValueError("text or a space is expected between two numbers")
            if name == UNIT and (i == 0 or names[i - 1] in (None, ANY, UNIT) or text.strip()):
                raise ValueError("{unit} is expected directly behind the number whose unit it is")
        units = dict.fromkeys(self.names, "V")
        try:
            message = self.fill(dict.fromkeys(self.names, 0.5), ";", units)
        except (ValueError, IndexError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"a number cannot be written so: {error}; expected a format such as {{value:.3f}}"
            ) from None
        if self.match(message, units) is None:
            raise ValueError(
                f"{message!r} has no number that can be told from what is beside it; expected other text between them"
            )

    @cached_property
    def _parts(self) -> tuple[tuple[str, str | None, str], ...]:
        """Literal text, the name of the placeholder after it, and its format."""
        try:
            parts = [(text, name, spec or "") for text, name, spec, _ in Formatter().parse(self.text.strip())]
        except ValueError as error:
            raise ValueError(f"{error}; a brace of the message itself is doubled: {{{{ or }}}}") from None
        for _, name, _ in parts:
            if name is not None and not name.isidentifier():
                raise ValueError(f"{{{name}}} is no placeholder; expected a name such as {{value}}")
        return tuple(parts)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers, in their order."""
        return tuple(name for _, name, _ in self._parts if name not in (None, ANY, UNIT))

    @property
    def has_units(self) -> bool:
        """Whether the unit of a number is read."""
        return any(name == UNIT for _, name, _ in self._parts)

    def check(self, allowed: Iterable[str], needed: Iterable[str] = ()) -> None:
        """Raise `ValueError` for a placeholder that is not allowed, or one that is missing."""
        known = set(allowed)
        found = [name for _, name, _ in self._parts if name is not None]
        shown = ", ".join(f"{{{name}}}" for name in sorted(known)) or "none"
        for name in found:
            if name not in known:
                raise ValueError(f"{{{name}}} is no placeholder here; allowed: {shown}")
        for name in needed:
            if name not in found:
                raise ValueError(f"the placeholder {{{name}}} is missing, which stands for the number")

    def fill(self, values: Mapping[str, float], any_text: str = "", units: Mapping[str, str] = _NO_UNITS) -> str:
        """Return the message with these numbers.

        Numbers without a format are written as `+1.23456789E+00`; one with a `{unit}` has the SI prefix that fits it.
        """
        written = []
        unit = ""
        following = [name for _, name, _ in self._parts[1:]]
        for (text, name, spec), after in zip(self._parts, [*following, None], strict=True):
            written.append(text)
            if name == ANY:
                written.append(any_text)
            elif name == UNIT:
                written.append(unit)
            elif name is not None:
                number = values[name]
                if after == UNIT:
                    factor, shown = fitting_prefix(units[name], number)
                    # As instruments write it, whose messages are mostly ASCII.
                    number, unit = number * factor, shown.replace("µ", "u").replace("°", "")
                shown = format(number, spec or "+.8E")
                written.append(shown.replace(".", ",") if self.decimal == "," else shown)
        return "".join(written)

    def match(self, message: str, units: Mapping[str, str] = _NO_UNITS) -> dict[str, float] | None:
        """Return the numbers of a message by name; None if it is not of this form, or a number is none or not clear.

        A number that comes with its unit is returned in that of `units`.
        """
        found = self._pattern.fullmatch(message.strip())
        try:
            return None if found is None else self._numbers(found, units)
        except ValueError:
            return None

    def _numbers(self, found: re.Match[str], units: Mapping[str, str]) -> dict[str, float]:
        """Return the numbers of a message that has the form; raise `ValueError` if one is none."""
        texts = found.groupdict()
        numbers: dict[str, float] = {}
        for i, name in enumerate(self.names):
            number = float(texts[name].replace(",", "."))
            if abs(number) >= _NOT_A_NUMBER:
                raise ValueError("is it out of its range?")
            sent = texts.get(f"unit{i}")
            numbers[name] = number if sent is None else in_unit(number, sent, units[name])
        return numbers

    def doubt(self, message: str, units: Mapping[str, str] = _NO_UNITS) -> str:
        """Return why a number is not read from a message that nearly has the form, and what to do; else nothing."""
        message = message.strip()
        found = self._pattern.fullmatch(message)
        if found is not None:
            try:
                self._numbers(found, units)
            except ValueError as error:
                return str(error)
            return ""
        signs: tuple[Decimal, ...] = (".", ",")
        if any(template(self.text, other).match(message, units) for other in signs if other != self.decimal):
            sign = "point" if self.decimal == "," else "comma"
            return f'its {sign} may be a decimal sign: set the key decimal to "." or ","'
        if _THOUSANDS.search(message):
            return "thousands that are separated are not read: have the instrument send plain numbers"
        if self._compiled(guarded=False).fullmatch(message):
            return "{any} may stand for a part of the number, or for its unit: write {unit}, or the text itself"
        return ""

    @cached_property
    def _pattern(self) -> re.Pattern[str]:
        return self._compiled(guarded=True)

    def _compiled(self, *, guarded: bool) -> re.Pattern[str]:
        """Return the pattern of the message; without guards, `{any}` may stand for a part of a number."""
        parts: list[str] = []
        numbers = 0
        names = [None, *(name for _, name, _ in self._parts), None, None]
        texts = [*(text for text, _, _ in self._parts), ""]
        for i, (text, name, _) in enumerate(self._parts):
            before, after = names[i], names[i + 2]
            parts.append(r"\s+".join(re.escape(piece) for piece in re.split(r"\s+", text)))
            if name == ANY:
                is_before_number = after not in (None, ANY) and not texts[i + 1].strip()
                parts.append(self._any_before_number if guarded and is_before_number else ".*")
            elif name == UNIT:
                parts.append(rf"\s*(?P<unit{numbers - 1}>{_LETTER}+)(?!{_LETTER}|[0-9^*])\s*")
            elif name is not None:
                numbers += 1
                begin, end = "", ""
                if guarded and before == ANY:
                    begin = self._begin
                if guarded:
                    end = self._end(texts[i + 1].strip() if after == ANY else None)
                parts.append(rf"\s*{begin}(?P<{name}>{self._number(end)})\s*")
        return re.compile("".join(parts), re.IGNORECASE | re.DOTALL)

    @property
    def _begin(self) -> str:
        """What may not stand before a number that follows any text: the rest of a longer one."""
        comma = "" if self.decimal == "." else "(?<![0-9],)"
        return rf"(?<![0-9.+-])(?<![0-9.][eE]){comma}"

    @property
    def _any_before_number(self) -> str:
        """Any text directly before a number: it ends with neither a sign nor a part of a longer number."""
        comma = "," if self.decimal == "." else "(?<![0-9]),"
        return rf"(?:.*(?:[^\s0-9.,+-]|{comma}|[0-9.](?=\s)))?"

    def _end(self, text: str | None) -> str:
        """Return what may not follow a number; `text` is that between it and any text, None where none follows."""
        ends = ["[0-9.]", _EXPONENT]
        if self.decimal == "," or (self.decimal is None and text in ("", ",")):
            ends.append(",[0-9]")
        if text == "":
            ends.append(rf"\s*{_LETTER}")
        return "|".join(ends)

    def _number(self, end: str) -> str:
        """Return the pattern of a number behind which `end` may not stand; no comma continues an exponent."""
        sign = "," if self.decimal == "," else r"\."
        mantissa = rf"[-+]?(?:[0-9]+{sign}?[0-9]*|{sign}[0-9]+)"
        if not end:
            return rf"{mantissa}(?:{_EXPONENT}+)?"
        of_exponent = end.replace("|,[0-9]", "")
        return rf"{mantissa}(?:{_EXPONENT}+(?!{of_exponent})|(?!{end}))"


@cache
def template(text: str, decimal: Decimal | None = None) -> Template:
    """Return the template of a text, made once; raises as `Template`."""
    return Template(text, decimal)
