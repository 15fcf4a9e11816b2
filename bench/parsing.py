"""JSON and TOML of files that somebody else may have written: whatever is wrong with them is a ValueError."""

from __future__ import annotations

import json
import tomllib
from typing import Any

_TOO_DEEP = "it is nested too deeply"


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
