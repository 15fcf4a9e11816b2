"""The terminal before and during a run: its rehearsal, progress with time left and readings, and questions."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import timedelta
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.control import Control
from rich.errors import LiveError
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn
from rich.segment import ControlType
from rich.table import Column

from bench.clock import Stopwatch, wall_time
from bench.devices import Signal
from bench.journal import Event, StepRecord
from bench.printing import print_plain
from bench.remaining_time import Expectation, RemainingTime
from bench.units import format_duration
from bench.workers import report

_REFRESH = 0.1
"""Wall-clock seconds between two redraws of the readings."""

_UNSEEN = 2.0
"""Longest rehearsal that needs no display, s of wall-clock time."""


class ProgressDisplay:
    """A bar with steps, laboratory time, what is left, and the current readings; an `Observer` of the engine.

    Times are laboratory times from the start of the run; the end is a time of day. A worker process has the bar drawn
    by its bench.

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
    expectation : Expectation, optional
        When the steps are expected to end; without it only the time that has passed is shown.
    factor : float
        Laboratory seconds in a second of the wall clock; infinite where only the computer limits them.
    """

    def __init__(
        self,
        console: Console,
        title: str,
        signals: Sequence[Signal],
        shown: Sequence[str],
        expectation: Expectation | None = None,
        factor: float = math.inf,
    ) -> None:
        self._console = console
        self._shown = [(i, signal) for i, signal in enumerate(signals) if signal.name in shown]
        self._steps = expectation.steps if expectation is not None else 0
        self._remaining = RemainingTime(expectation, factor) if expectation is not None else None
        self._title = title
        self._phase = ""
        self._progress, self._task = self._make_bar()
        self._is_still = False
        self.lock = threading.RLock()
        """Held by whoever writes to the console, as the operator may be asked there."""
        self.latest = ""
        """The newest readings."""
        self.is_over = False
        """Whether nothing is shown any more."""
        self.ask_again: Callable[[], None] | None = None
        """Called after something was printed while the bar stands still: the question has to stay the last line."""
        self._since_start = Stopwatch()
        self._since_redraw = Stopwatch()

    def _make_bar(self) -> tuple[Progress, TaskID]:
        progress = Progress(
            # Names and phases are the protocol's: no markup.
            TextColumn("{task.description}", style="bold", markup=False),
            # Wide enough for the word that says that the run stands still.
            TextColumn("{task.fields[phase]}", markup=False, table_column=Column(min_width=7, no_wrap=True)),
            BarColumn(bar_width=None),
            TextColumn("{task.fields[steps]}", style="green", markup=False),
            TextColumn("{task.fields[times]}", markup=False),
            TextColumn("{task.fields[readings]}", style="cyan", markup=False),
            console=self._console,
            transient=False,
            disable=not self._console.is_terminal,
        )
        total = 1.0 if self._remaining is not None else None
        task = progress.add_task(self._title, total=total, phase=self._phase, steps="", times="", readings="")
        return progress, task

    def stand_still(self, state: str) -> None:
        """Leave the bar as it stands, under a word for the state of the run, so that the operator can be asked."""
        with self.lock:
            if not self._is_still:
                self._is_still = True
                self._progress.update(self._task, phase=state)
                self._progress.stop()

    def go_on(self) -> None:
        """Draw a new bar below what was printed since the last one stands still."""
        with self.lock:
            if self._is_still and not self.is_over:
                self._progress, self._task = self._make_bar()
                self._is_still = False
                self._progress.start()

    def __enter__(self) -> Self:
        self._since_start = Stopwatch()
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # The terminal may be gone by now.
        with suppress(OSError), self.lock:
            self.is_over = True
            if not self._is_still:
                self._progress.refresh()
                self._progress.stop()

    def telemetry(self, t: float, step: int, values: Sequence[float]) -> None:
        """Show the readings of a tick, at most ten times a second."""
        if self._since_redraw.seconds() > _REFRESH:
            self._show(t, step, values)

    def step(self, record: StepRecord) -> None:
        """Advance the bar."""
        if self._remaining is not None:
            self._remaining.step(record.step + 1, record.finished)
        if self._since_redraw.seconds() > _REFRESH or record.step + 1 == self._steps:
            self._show(record.finished, record.step + 1, record.values)

    def event(self, event: Event) -> None:
        """Show the phase beside the bar, and print warnings, errors and notes."""
        if self._remaining is not None:
            if event.kind == "pause":
                self._remaining.pause(event.t)
            elif event.kind == "resume":
                self._remaining.resume(event.t)
            elif event.kind == "prompt":
                self._remaining.prompt(event.t)
        with self.lock:
            self._show_event(event)

    def _show_event(self, event: Event) -> None:
        if event.kind == "phase":
            self._phase = event.text
            self._progress.update(self._task, phase=event.text)
        elif self._is_still and event.kind in ("pause", "prompt"):
            pass  # the question says it
        elif event.level != "INFO" or event.kind in ("note", "remark", "resume"):
            if self.ask_again is not None and self._console.is_terminal:
                # Over the prompt, and the line above it that says for how long.
                erased = ControlType.CARRIAGE_RETURN, (ControlType.ERASE_IN_LINE, 2)
                self._console.control(Control(*erased, (ControlType.CURSOR_UP, 1), *erased))
            style = {"INFO": "dim", "WARN": "yellow", "ERROR": "bold red"}[event.level]
            self._console.print(
                f"{format_duration(event.t):>10}  {event.kind}: {event.text}",
                style=style,
                highlight=False,
                markup=False,
            )
            if self.ask_again is not None:
                self.ask_again()

    def _show(self, t: float, steps: int, values: Sequence[float]) -> None:
        self._since_redraw = Stopwatch()
        times, completed = f"t {format_duration(t)}", 0.0
        if self._remaining is not None:
            left = self._remaining.at(t, self._since_start.seconds())
            completed = left.share
            times += f"  left {format_duration(left.laboratory)}, ends {_time_of_day(left.wall)}"
            if math.isfinite(left.at_most):
                times += f", at most {_time_of_day(left.at_most)}"
        readings = [f"{signal.name} {values[i]:.{signal.precision}f} {signal.unit}" for i, signal in self._shown]
        self.latest = "  ".join(readings)
        with self.lock:
            if not self._is_still:
                self._progress.update(
                    self._task,
                    completed=completed,
                    steps=f"{steps}/{self._steps or '?'}",
                    times=times,
                    readings=self.latest,
                )
        report(steps, self._steps or None, "  ".join([times, *readings]))


class RehearsalDisplay:
    """Shows from its third second on that a rehearsal goes on, and how far; an `Observer` of the engine.

    Parameters
    ----------
    console : Console
        Console to draw on; if it is no terminal, one line is printed.
    title : str
        What is rehearsed, and where.
    """

    def __init__(self, console: Console, title: str) -> None:
        self._console = console
        self._title = title
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            TextColumn("{task.fields[times]}", style="green", markup=False),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task(title, total=None, times="")
        self._since_start = Stopwatch()
        self._since_redraw = Stopwatch()
        self._shown = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(OSError):
            self._progress.stop()

    def telemetry(self, t: float, step: int, values: Sequence[float]) -> None:  # noqa: ARG002 - as of all
        """Show how far it is."""
        if self._since_redraw.seconds() < _REFRESH:
            return
        self._since_redraw = Stopwatch()
        if not self._shown and self._since_start.seconds() > _UNSEEN:
            self._shown = True
            if not self._console.is_terminal:
                print_plain(self._console, f"{self._title} …")
            # A compilation draws on the same console.
            with suppress(LiveError):
                self._progress.start()
        self._progress.update(self._task, times=f"{step} steps, {format_duration(t)} of laboratory time; Ctrl-C ends")

    def step(self, record: StepRecord) -> None:
        """Show how far it is."""
        self.telemetry(record.finished, record.step + 1, record.values)

    def event(self, event: Event) -> None:
        """Show nothing: the result of the rehearsal says what it found."""


def _time_of_day(seconds: float) -> str:
    """Return the local time of day that many wall-clock seconds from now; with the date if that is another day."""
    now = wall_time()
    end = (now + timedelta(seconds=seconds)).astimezone()
    return end.strftime("%H:%M:%S" if end.date() == now.astimezone().date() else "%Y-%m-%d %H:%M")
