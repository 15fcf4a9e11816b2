"""Texts for messages: counts, unknown names, and files that cannot be read."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

_FEW = 8
"""Names that a message lists; of more it gives the closest, or where to look."""


def closest(name: str, known: Iterable[str], where: str = "") -> str:
    """Return what helps with a name that there is not: the closest one, few of them, or where all are listed.

    Parameters
    ----------
    name : str
        What was asked for.
    known : iterable of str
        What there is.
    where : str
        What lists all of them, such as "`bench list`"; without it, a message lists them.
    """
    names = list(known)
    lower = {each.lower(): each for each in names}
    found = difflib.get_close_matches(name.lower(), lower, n=1)
    if found:
        return f"did you mean {lower[found[0]]}?"
    if len(names) > _FEW and where:
        return f"{where} shows all {len(names)}"
    return f"there are: {', '.join(names) or 'none'}"


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, such as `1 run` and `2 runs`."""
    return f"{count} {noun}{'s' * (count != 1)}"


def reason(error: Exception) -> str:
    """Return why a file cannot be read or written, in the words of the system and without its number."""
    return getattr(error, "strerror", None) or str(error)
