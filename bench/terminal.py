"""The terminal during a run: progress with ETA and readings, and the question at a pause."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import suppress
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from bench.clock import Stopwatch
from bench.devices import Signal
from bench.journal import Event, StepRecord
from bench.running import ABORT, RESUME
from bench.workers import report

_REFRESH = 0.1
"""Wall-clock seconds between two redraws of the readings."""


class ProgressDisplay:
    """A progress bar with ETA and the current readings; an `Observer` of the engine.

    In a worker process the bench draws the bar.

    Parameters
    ----------
    console : Console
        Console to draw on; if it is no terminal, only events are printed.
    title : str
        Name of the protocol.
    signals : sequence of Signal
        Signals of the engine's values, in their order.
    shown : sequence of str
        Signals whose readings are shown beside the bar.
    steps : int
        Planned number of steps.
    """

    def __init__(
        self, console: Console, title: str, signals: Sequence[Signal], shown: Sequence[str], steps: int
    ) -> None:
        self._console = console
        self._shown = [(i, signal) for i, signal in enumerate(signals) if signal.name in shown]
        self._progress = Progress(
            # Names and phases are the protocol's: no markup.
            TextColumn("{task.description}", style="bold", markup=False),
            TextColumn("{task.fields[phase]}", markup=False),
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[readings]}", style="cyan", markup=False),
            console=console,
            transient=False,
            disable=not console.is_terminal,
        )
        self._task: TaskID = self._progress.add_task(title, total=steps or None, phase="", readings="")
        self._since_redraw = Stopwatch()

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # The terminal may be gone by now.
        with suppress(OSError):
            self._progress.refresh()
            self._progress.stop()

    def telemetry(self, t: float, step: int, values: Sequence[float]) -> None:
        """Show the readings of a tick, at most ten times a second."""
        if self._since_redraw.seconds() > _REFRESH:
            self._since_redraw = Stopwatch()
            self._show(step, self._readings(t, values))

    def step(self, record: StepRecord) -> None:
        """Advance the bar."""
        if self._since_redraw.seconds() > _REFRESH or record.step + 1 == self._progress.tasks[0].total:
            self._since_redraw = Stopwatch()
            self._show(record.step + 1, self._readings(record.finished, record.values))

    def event(self, event: Event) -> None:
        """Show the phase beside the bar, and print warnings, errors and notes."""
        if event.kind == "phase":
            self._progress.update(self._task, phase=event.text)
        elif event.level != "INFO" or event.kind in ("note", "resume"):
            style = {"INFO": "dim", "WARN": "yellow", "ERROR": "bold red"}[event.level]
            self._console.print(
                f"{_duration(event.t):>10}  {event.kind}: {event.text}", style=style, highlight=False, markup=False
            )

    def _show(self, completed: int, readings: str) -> None:
        self._progress.update(self._task, completed=completed, readings=readings)
        total = self._progress.tasks[0].total
        report(completed, None if total is None else int(total), readings)

    def _readings(self, t: float, values: Sequence[float]) -> str:
        parts = [f"{signal.name} {values[i]:.{signal.precision}f} {signal.unit}" for i, signal in self._shown]
        return "  ".join([f"t {_duration(t)}", *parts])


def ask_operator(console: Console, question: str) -> str:
    """Ask at a pause or a prompt how to go on; return `resume` or `abort`."""
    console.print(f"{escape(question)} [bold]r[/] resumes, [bold]a[/] ends the run in the safe state (then Enter)")
    for line in sys.stdin:
        answer = line.strip().lower()
        if answer in ("r", RESUME):
            return RESUME
        if answer in ("a", ABORT):
            return ABORT
        console.print("please answer r (resume) or a (abort)")
    return ABORT


def _duration(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"
