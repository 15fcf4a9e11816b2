"""What an operator is asked during a run, and what may be answered."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

RESUME = "resume"
ABORT = "abort"
STEP = "step"
NOTE = "note"
SET = "set"
OFF = "off"

NOBODY = "nobody"
"""Answer where no operator is present."""

AT_A_PAUSE = (RESUME, STEP, NOTE, SET, OFF, ABORT)
AT_A_PROMPT = (RESUME, ABORT)

MEANINGS: Mapping[str, str] = {
    RESUME: "go on",
    STEP: "carry one step out, then pause again",
    NOTE: "TEXT: write a note into the record",
    SET: "NAME=VALUE: change a parameter",
    OFF: "switch the outputs off and wait",
    ABORT: "end the run in the safe state",
}

_SHORT = {"r": RESUME, "s": STEP, "n": NOTE, "o": OFF, "a": ABORT, "end": ABORT, "e": ABORT}

_WITH_TEXT = (NOTE, SET)


@dataclass(frozen=True)
class Question:
    """What the operator is asked.

    Attributes
    ----------
    text : str
        Why it is asked, such as what to do by hand.
    commands : tuple of str
        What may be answered.
    title : str
        State of the run meanwhile, such as `PAUSED`.
    parameters : mapping of str to str
        Parameters that may be changed, with value, unit and what is allowed.
    problem : str
        What was wrong with the answer before; empty if nothing was.
    """

    text: str
    commands: tuple[str, ...] = AT_A_PAUSE
    title: str = "PAUSED"
    parameters: Mapping[str, str] = field(default_factory=dict)
    problem: str = ""

    def answer(self, line: str) -> str:
        """Return an answer as the engine takes it: a command, and what belongs to it after a space.

        Raises ValueError if it is none; says what is allowed.
        """
        first, _, rest = line.strip().partition(" ")
        command = _SHORT.get(first.lower(), first.lower())
        if command not in self.commands:
            raise ValueError(f"please answer {', '.join(self.shown)}")
        rest = rest.strip()
        if command in _WITH_TEXT and not rest:
            raise ValueError(f"{command} {MEANINGS[command]}")
        return f"{command} {rest}" if command in _WITH_TEXT else command

    @property
    def shown(self) -> tuple[str, ...]:
        """The commands with their short forms."""
        short = {command: letter for letter, command in reversed(_SHORT.items()) if len(letter) == 1}
        return tuple(f"{short[each]} ({each})" if each in short else each for each in self.commands)
