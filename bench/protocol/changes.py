"""Parameters that were changed while a run was paused: as the record has them, and as they are made again."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Self

from bench.base import parse_json

PARAMETER = "parameter"
"""Kind of the event that records a change."""

_TEXT = re.compile(r"(?P<name>\w+) = (?P<value>.+) \(was (?P<former>.+)\), from the reading of step (?P<step>\d+) on")


@dataclass(frozen=True)
class ParameterChange:
    """A parameter that was changed.

    The protocol sees it with the reading of the step that was at work or came next, however long the pause was.

    Attributes
    ----------
    step : int
        The step.
    name : str
        The parameter.
    value, former
        What it was set to, and what it was before, as JSON holds them.
    """

    step: int
    name: str
    value: Any
    former: Any

    def __str__(self) -> str:
        """Return it as the record has it."""
        value, former = (json.dumps(each, ensure_ascii=False) for each in (self.value, self.former))
        return f"{self.name} = {value} (was {former}), from the reading of step {self.step} on"

    @classmethod
    def read(cls, text: str) -> Self:
        """Return one from the text of its event; raises ValueError if it is none."""
        found = _TEXT.fullmatch(text)
        if found is None:
            raise ValueError(f"{text!r} is not a change of a parameter")
        return cls(int(found["step"]), found["name"], parse_json(found["value"]), parse_json(found["former"]))

    @classmethod
    def among(cls, events: Iterable[tuple[str, str]]) -> tuple[Self, ...]:
        """Return the changes among events, of which kind and text are given, in their order."""
        return tuple(cls.read(text) for kind, text in events if kind == PARAMETER)
