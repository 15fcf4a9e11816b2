"""JSON and TOML: what somebody else wrote, where whatever is wrong is a ValueError, and what the bench writes itself.

JSON has no number that is not finite (RFC 8259, section 6): where the bench has none, its files have null.
"""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.errors import DataError

_TOO_DEEP = "it is nested too deeply"
_WITH_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")


def parse_json(text: str | bytes) -> Any:  # noqa: ANN401 - anything that JSON can hold
    """Return what a text of JSON says; raise ValueError, which says what is wrong, if it is none."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None


def parse_toml(text: str) -> dict[str, Any]:
    """Return what a text of TOML says; raise ValueError, which says what is wrong, if it is none."""
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None


def json_text(content: Any, *, indent: int | None = None) -> str:  # noqa: ANN401 - anything that JSON can hold
    """Return a text of JSON, with null for a number that is not finite; raise TypeError for what JSON cannot hold."""
    try:
        return json.dumps(content, indent=indent, ensure_ascii=False, allow_nan=False)
    except ValueError:
        return json.dumps(_finite(content), indent=indent, ensure_ascii=False, allow_nan=False)


def write_json_file(path: Path, content: Any) -> None:  # noqa: ANN401 - anything that JSON can hold
    """Write a file of JSON for people too; raises DataError if that cannot be."""
    try:
        path.write_text(f"{json_text(content, indent=1)}\n", encoding="utf-8")
    except OSError as error:
        raise DataError(f"{path} cannot be written: {error.strerror or error}") from None


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
