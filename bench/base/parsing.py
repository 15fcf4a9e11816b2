"""JSON and TOML: what somebody else wrote, where whatever is wrong is a ValueError, and what the bench writes itself.

JSON has no number that is not finite (RFC 8259, section 6): where the bench has none, its files have null.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.base.whole_files import write_result

_TOO_DEEP = "it is nested too deeply"
_WITH_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_BARE = re.compile(r"[A-Za-z0-9_-]+")
_MOST_DIGITS = 308
"""Digits of a whole number that a double can hold (IEEE 754: up to 1.8e308)."""


def parse_json(text: str | bytes) -> Any:  # noqa: ANN401 - anything that JSON can hold
    """Return what a text of JSON says; raise ValueError, which says what is wrong, if it is none.

    A key that comes twice in a table, and a number beyond those that a double can hold, are wrong too: a reader would
    take one of two values, or infinity, in silence.
    """
    try:
        return _DECODER.decode(text.decode() if isinstance(text, bytes) else text)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None


def parse_toml(text: str) -> dict[str, Any]:
    """Return what a text of TOML says; raise ValueError, which says what is wrong, if it is none.

    So is a number beyond those that a double can hold.
    """
    try:
        content = tomllib.loads(text, parse_float=_real)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    waiting: list[Any] = [content]
    while waiting:
        value = waiting.pop()
        if isinstance(value, dict):
            waiting += value.values()
        elif isinstance(value, list):
            waiting += value
        elif isinstance(value, int) and abs(value) >= 10**_MOST_DIGITS:
            raise ValueError(f"a whole number has more than {_MOST_DIGITS} digits")
    return content


def toml_value(value: object) -> str:
    """Return a text, number, list or table as TOML has it in one line."""
    if isinstance(value, Mapping):
        pairs = [
            f"{key if _BARE.fullmatch(key) else toml_value(key)} = {toml_value(of)}" for key, of in value.items()
        ]
        return f"{{ {', '.join(pairs)} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, float) and not math.isfinite(value):
        return str(float(value))
    # The scalars of TOML are otherwise those of JSON.
    return json.dumps(value, ensure_ascii=False)


def end_of_json(text: str) -> int:
    """Return where the JSON ends that a text begins with; raise ValueError, with its `pos`, where it goes wrong."""
    try:
        return json.JSONDecoder().raw_decode(text)[1]
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None


def _whole(text: str) -> int:
    if len(text.lstrip("-")) > _MOST_DIGITS:
        raise ValueError(f"a whole number has more than {_MOST_DIGITS} digits")
    return int(text)


def _real(text: str) -> float:
    value = float(text)
    if math.isinf(value) and "inf" not in text:
        raise ValueError(f"{text[:40]} is beyond the numbers that can be held")
    return value


def _table(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        twice, _ = Counter(key for key, _ in pairs).most_common(1)[0]
        raise ValueError(f"the key {twice[:40]!r} comes twice")
    return table


_DECODER = json.JSONDecoder(parse_int=_whole, parse_float=_real, object_pairs_hook=_table)


def json_text(content: Any, *, indent: int | None = None) -> str:  # noqa: ANN401 - anything that JSON can hold
    """Return a text of JSON, with null for a number that is not finite; raise TypeError for what JSON cannot hold."""
    try:
        return json.dumps(content, indent=indent, ensure_ascii=False, allow_nan=False)
    except ValueError:
        return json.dumps(_finite(content), indent=indent, ensure_ascii=False, allow_nan=False)


def write_json_file(path: Path, content: Any) -> None:  # noqa: ANN401 - anything that JSON can hold
    """Write a file of JSON for people too; raises DataError if that cannot be."""
    write_result(path, f"{json_text(content, indent=1)}\n")


def _finite(content: Any) -> Any:  # noqa: ANN401 - anything that JSON can hold
    if isinstance(content, float):
        return content if math.isfinite(content) else None
    if isinstance(content, Mapping):
        return {key: _finite(value) for key, value in content.items()}
    return [_finite(each) for each in content] if isinstance(content, list | tuple) else content


def comma_remark(value: object) -> str:
    """Return what to add to an error about a text that is a number but for its decimal comma; empty for any other."""
    if isinstance(value, str) and _WITH_COMMA.fullmatch(value.strip()):
        return f"; the decimal sign is a point: {value.strip().replace(',', '.')}"
    return ""
