"""Heads of columns: names, units, and the column that is meant."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from bench.base import DataError, closest

_SYMBOL = (
    r"(?:[yzafpnµμumcdhkMGTP]?(?:m|g|s|A|K|mol|cd|V|N|W|J|Pa|Hz|Ω|Ω|[Oo]hm|C|F|T|H|bar|eV|Oe|G|Wb|S|rad|l|L|strain|ε)"
    r"|°C|ºC|°F|°|º|deg|degC|deg_?C|celsius|rpm|min|h|d|%|‰|psi|lbf|inch|in|mil|counts?|a\.u\.|arb\. ?u\."
    r"|[Vv]olts?|VOLT|[Dd]ays?|[Hh]ours?|hr|[Mm]inutes?|[Ss]ec(?:ond)?s?|msec|Am|emu)"
)
_FACTOR = rf"{_SYMBOL}(?:\^?[-−]?[1-9]|[²³]|⁻[¹²³])?"
_UNIT = rf"(?:1|{_FACTOR})(?:\s?[/*·⋅.]\s?\(?{_FACTOR}\)?|\s{_FACTOR})*|1|-"
_SPELLINGS = {
    "degC": "°C", "deg_C": "°C", "ºC": "°C", "celsius": "°C", "º": "°", "us": "µs", "msec": "ms", "hr": "h",
    "µε": "µstrain", "ε": "strain", **dict.fromkeys(("volt", "volts"), "V"),
    **dict.fromkeys(("sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("minute", "minutes"), "min"), **dict.fromkeys(("hour", "hours"), "h"),
    **dict.fromkeys(("day", "days"), "d"),
}  # fmt: skip

SECONDS = {"d": 86400.0, "h": 3600.0, "min": 60.0, "s": 1.0, "ms": 1e-3, "µs": 1e-6, "ns": 1e-9}
"""Seconds in each unit that a column of times may have."""

_TIME_HEAD = re.compile(r"(t|\w*time|elapsed|timestamp)[_ ](d|days?|h|hours?|min|s|secs?|ms|us|µs|ns)", re.IGNORECASE)
"""Head of a column of times whose unit stands behind its name."""

_TIME_NAME = re.compile(r"t|ts|times?|time ?stamp|date[ /]?time|x_value", re.IGNORECASE)
"""Names of a column of times. Source of `X_Value`: NI, "Specification for the LabVIEW Measurement File (.lvm)"."""

_BEHIND = re.compile(r"(.+?)(?:[ _](?=\w+_per_)|, ?| in )(?![\d-])(\S+)")
"""A head whose unit is spelled out, or stands behind a comma or an `in`."""

_BRACKETS = ("[", "]"), ("(", ")"), ("<", ">"), ("{", "}")

_ADDED = re.compile(r"\s*[(\[<{][^()\[\]<>{}]*[)\]>}]$|\s*(?:, ?| in )\S+$")
"""What stands behind the name of a column, with a unit that is known or not."""


class NoColumnError(DataError):
    """A column that a table does not have; `known` are those that it has."""

    def __init__(self, text: str, known: Sequence[str] = ()) -> None:
        super().__init__(text)
        self.known = tuple(known)


@dataclass(frozen=True)
class Head:
    """Head of a column."""

    text: str  # as it stands in the file
    # Its parts; the unit is empty where there is none.
    name: str
    unit: str


@cache
def _unit_pattern() -> re.Pattern[str]:
    # At its first use, as it takes 20 ms to compile.
    return re.compile(_UNIT)


def is_unit(text: str) -> bool:
    """Return whether a text is a unit, such as `V`, `µm` or `m/s²`; a plain `1` or `-` counts."""
    return _unit_pattern().fullmatch(text.strip()) is not None


def split_unit(head: str) -> tuple[str, str]:
    """Return name and unit of a head such as `force [N]`, `force (N)` or `force / N`; the unit may be empty.

    What stands in brackets after a blank is a unit; elsewhere only what is known to be one.
    """
    head = head.strip()
    for opening, closing in _BRACKETS:
        name, bracket, rest = head.rpartition(opening)
        if not (bracket and rest.endswith(closing) and name.strip()):
            continue
        unit = rest[:-1].strip()
        if (opening == "[" and name.endswith(" ")) or is_unit(unit):
            # As in U / (V).
            return name.rstrip().removesuffix(" /").rstrip(), spelled(unit)
    for place in (match.start() for match in re.finditer("/", head)):
        name, unit = head[:place].rstrip(), head[place + 1 :].strip()
        # In `speed m/s` the part before the solidus is a unit too.
        words = name.split()
        if words and is_unit(unit) and (len(words) == 1 or not is_unit(words[-1])):
            return name, spelled(unit)
    behind = _BEHIND.fullmatch(head)
    unit = behind[2].replace("_per_", "/") if behind else ""
    return (behind[1], spelled(unit)) if behind and is_unit(unit) else (head, "")


def make_heads(texts: Sequence[str], units: Sequence[str] = ()) -> tuple[Head, ...]:
    """Return heads from their texts and those of a unit row, if there is one.

    A unit after an underscore, as in `voltage_V`, is taken only if every head has one and one of them has more than
    one letter: `x_m` alone may mean anything.
    """
    if units:
        padded = [*units, *[""] * len(texts)]
        return tuple(
            Head(text.strip(), text.strip(), bare_unit(unit)) for text, unit in zip(texts, padded, strict=False)
        )
    heads = tuple(Head(text.strip(), *split_unit(text)) for text in texts)
    filled = [head for head in heads if head.text]
    ends = [head.text.rpartition("_") for head in filled]
    if (
        len(filled) > 1
        and not any(head.unit for head in filled)
        and all(name and is_unit(unit) and unit.isalpha() for name, _, unit in ends)
        and any(len(unit) > 1 for _, _, unit in ends)
    ):
        return tuple(
            Head(head.text, head.text.rpartition("_")[0], spelled(head.text.rpartition("_")[2])) for head in heads
        )
    return tuple(_of_time(head) for head in heads)


def _of_time(head: Head) -> Head:
    """Return the head of a column of times with the unit behind its name."""
    match = None if head.unit else _TIME_HEAD.fullmatch(head.text)
    return head if match is None else Head(head.text, match[1], spelled(match[2].lower()))


def bare_unit(text: str) -> str:
    """Return a unit of a unit row without its brackets; a dash is no unit."""
    text = text.strip()
    if (text[:1], text[-1:]) in _BRACKETS:
        text = text[1:-1].strip()
    return "" if text in ("-", "") else spelled(text)


def find_place(path: Path, heads: Sequence[Head], columns: int, name: str) -> int:
    """Return the index of the column that a name or a number from 1 means.

    `heads` is empty where the table has no header. The name is a head, a head without its unit, or a number.

    Raises NoColumnError if there is no such column; DataError if there are several.
    """
    wanted = _folded(name.strip())
    texts = [_folded(head.text) for head in heads]
    places = [i for i, text in enumerate(texts) if text == wanted]
    places = places or [i for i, head in enumerate(heads) if _folded(head.name) == wanted]
    if not places:
        # A unit that is not known as one; the last part of `S.part`.
        last = [{text.rpartition(".")[2], _folded(heads[i].name).rpartition(".")[2]} for i, text in enumerate(texts)]
        loose = [i for i, text in enumerate(texts) if wanted in (*_without_unit(text), *last[i])]
        places = loose if len(loose) == 1 else []
    if len(places) == 1:
        return places[0]
    if len(places) > 1:
        numbers = " or ".join(str(place + 1) for place in places)
        raise DataError(
            f"{path}: has {len(places)} columns {name!r}; name one with its unit, as in the header, or by its "
            f"number: {numbers}"
        )
    if name.isdecimal() and 1 <= int(name) <= columns:
        return int(name) - 1
    if not heads:
        raise NoColumnError(
            f"{path}: has no column {name!r}, as it has no header line; name columns by number, 1 to {columns}",
            [str(number + 1) for number in range(columns)],
        )
    known = [head.text for head in heads if head.text]
    raise NoColumnError(
        f"{path}: has no column {name!r}; {closest(name, known)} (or a number, 1 to {columns})", known
    )


def with_times(
    names: Sequence[str],
    times: Sequence[str],
    heads: Sequence[Head],
    find: Callable[[str], int],
    moments: Collection[int] = (),
) -> list[str]:
    """Return names of columns, and that of the column of times if `times` asks for it and there is one.

    It is the first of `times` that `find` finds. Otherwise it is the first column with a name of times, then the
    first with a unit of time, then the first with dates and times, which `moments` lists. A column with another unit
    holds no times.
    """
    units = ["" if place in moments else head.unit for place, head in enumerate(heads)]
    may_be = [unit in ("", *SECONDS) for unit in units]
    for name in times:
        with suppress(DataError):
            place = find(name)
            if place >= len(heads) or may_be[place]:
                return [*names, name]
    rules = (
        [may_be[i] and _TIME_NAME.fullmatch(head.name) is not None for i, head in enumerate(heads)],
        [unit in SECONDS for unit in units],
        [place in moments for place in range(len(heads))],
    )
    found = next((rule.index(True) for rule in rules if times and True in rule), None)
    if found is None:
        return list(names)
    text = heads[found].text
    return [*names, text if [head.text for head in heads].count(text) == 1 and text else str(found + 1)]


def spelled(unit: str) -> str:
    """Return a unit as it is spelled here."""
    unit = unit.replace("μ", "µ").replace("Ω", "Ω")
    unit = _SPELLINGS.get(unit, _SPELLINGS.get(unit.lower(), unit))
    # An instrument that has no µ writes u.
    return re.sub(r"\bu(?=(?:m|A|V|s|N|W|F|H|strain)\b)", "µ", unit)


def _without_unit(text: str) -> tuple[str, ...]:
    name, _, last = text.rpartition(" ")
    return (_ADDED.sub("", text), *((name.rstrip(),) if is_unit(last) else ()))


def _folded(text: str) -> str:
    return text.replace("μ", "µ").replace("º", "°")
