"""How a run ended whose bench could not say it: what its guardian has left in the folder of the run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bench.base import parse_json

BLACK_BOX_NAME = "guardian.jsonl"
"""The guardian's own record, lines of JSON: `what` happened, `at` which time of day."""

BEGIN, FAILED, END = "begin", "failed", "end"
"""Kinds of its lines: the guardian of a run begins, the bench has hung or is gone, the guardian ends."""


@dataclass(frozen=True)
class Ending:
    """How a run ended.

    Attributes
    ----------
    status : str
        `failed`.
    reason : str
        What became of the bench.
    safe_state : mapping of str to str
        By device: `safe`, or what went wrong.
    """

    status: str
    reason: str
    safe_state: Mapping[str, str]


def ending_of(folder: Path) -> Ending | None:
    """Return how a run ended by its guardian; None if that has nothing to say, as of a run that goes on.

    Parameters
    ----------
    folder : Path
        Folder of the run.

    Returns
    -------
    Ending or None
        Of the process that carried the run out last.
    """
    found: Ending | None = None
    try:
        lines = (folder / BLACK_BOX_NAME).read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return None
    for line in lines:
        note = _note(line)
        if note.get("what") == BEGIN:
            found = None
        elif note.get("what") == FAILED:
            found = Ending("failed", str(note.get("reason", "")), _states(note))
        elif note.get("what") == END and found is not None:
            found = replace(found, safe_state=_states(note) or found.safe_state)
    return found


def _note(line: str) -> Mapping[str, Any]:
    """Return a line; nothing if it is torn, as the last one of a guardian that was killed may be."""
    try:
        note = parse_json(line)
    except ValueError:
        return {}
    return note if isinstance(note, dict) else {}


def _states(note: Mapping[str, Any]) -> Mapping[str, str]:
    states = note.get("safe")
    return {str(name): str(state) for name, state in states.items()} if isinstance(states, dict) else {}
