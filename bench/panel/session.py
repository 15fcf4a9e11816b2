"""Hands on a rig, as a run: with its lock, limits, interlocks, journal and safe state."""

from __future__ import annotations

import io
from typing import Any

from rich.console import Console

from bench.base import Interrupts
from bench.execution import Run, RunResult, carry_out
from bench.operator import Desk
from bench.protocol import ByHand, Messages, ProtocolDefinition, ProtocolParameters, protocol


class _Log(io.StringIO):
    """Takes what a run prints for the log of the panel."""

    def __init__(self, desk: Desk) -> None:
        super().__init__()
        self._desk = desk

    def write(self, text: str) -> int:
        for line in text.splitlines():
            if line.strip():
                self._desk.say(line.rstrip())
        return len(text)


def protocol_of(desk: Desk) -> ProtocolDefinition:
    """Return the protocol that takes the commands of a desk."""

    @protocol(needs=())
    def by_hand(parameters: ProtocolParameters) -> Messages:  # noqa: ARG001 - of this form
        """Let an operator move the rig by hand."""
        yield ByHand(desk=desk)

    return by_hand


def carry_out_by_hand(desk: Desk, interrupts: Interrupts, **asked: Any) -> RunResult:  # noqa: ANN401 - of `Run`
    """Connect a rig, carry the commands of a desk out, and leave every device in its safe state.

    `asked` are fields of a `Run`. Raises what `bench.execution.carry_out` does before anything moves.
    """
    run = Run(protocol=protocol_of(desk), settings={}, recording=False, rehearse=False, **asked)
    return carry_out(run, Console(file=_Log(desk), width=200), interrupts)
