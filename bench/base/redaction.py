"""Targets of messages without their secrets, as they are recorded and shown."""

from __future__ import annotations

import urllib.parse
from collections.abc import Sequence

OPTION = "--notify"
"""The option of a command that names a target."""


def redacted(target: str) -> str:
    """Return a target without what may be secret: the path of a webhook, and the arguments of a command."""
    if target.lower().startswith(("http://", "https://")):
        parts = urllib.parse.urlsplit(target)
        return f"{parts.scheme}://{parts.hostname or ''}/…"
    if target.lower().startswith("mailto:"):
        return target
    program, separator, _ = target.strip().partition(" ")
    return f"{program} …" if separator else program


def redacted_command(words: Sequence[str]) -> list[str]:
    """Return a command of the bench as it is recorded: its targets of messages are `redacted`."""
    kept: list[str] = []
    for word in words:
        option, equals, target = word.partition("=")
        if kept and kept[-1] == OPTION:
            word = redacted(word)
        elif option == OPTION and equals:
            word = f"{option}={redacted(target)}"
        kept.append(word)
    return kept
