"""Texts that are no tables: JSON, SVG, HTML and the like."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from bench.analysis.tables.reading.text import WHAT_IS_READ
from bench.base import DataError, end_of_json

_MARKUP = re.compile(r"\s*<(?:\?xml|!doctype|svg|html|table)\b", re.IGNORECASE)
_JSON = re.compile(r'\s*(?:\{\s*["}]|\[\s*["{[])')
_BELOW = "; of a table below it, leave out the lines above with --format skip=N"
_OTHERS = {"%PDF-": "PDF", "%!PS": "PostScript", "{\\rtf": "RTF"}


def check_format(path: Path, lines: Sequence[str]) -> None:
    """Check that the first lines of a text may be those of a table.

    Raises DataError that names the format if they are of another one.
    """
    text = "".join(lines)
    kind = next((name for start, name in _OTHERS.items() if text.startswith(start)), None)
    if _MARKUP.match(text):
        kind = _markup(text)
    elif _is_json(text):
        kind = "JSON"
    if kind is not None:
        raise DataError(f"{path}: is {kind}, not a table; {WHAT_IS_READ}{_BELOW if kind == 'XML' else ''}")


def _markup(text: str) -> str:
    folded = text.casefold()
    if "<svg" in folded:
        return "SVG"
    return "HTML" if "<html" in folded or "<table" in folded else "XML"


def _is_json(text: str) -> bool:
    """Return whether a text begins with JSON, perhaps cut off, that is not the first lines above a table."""
    if not _JSON.match(text):
        return False
    text = text.strip()
    try:
        end = end_of_json(text)
    except ValueError as error:
        return getattr(error, "pos", 0) >= len(text) - 1
    rest = text[end:]
    return not rest.strip() or _JSON.match(rest) is not None
