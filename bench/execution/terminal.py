"""The terminal before and during a run: its rehearsal, progress with time left and readings, and questions."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from datetime import timedelta
from types import TracebackType
from typing import Self

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.control import Control
from rich.progress import Progress, Task, TaskID
from rich.progress_bar import ProgressBar
from rich.segment import ControlType
from rich.table import Table
from rich.text import Text

from bench.base import (
    Expectation,
    PatienceDisplay,
    Remaining,
    RemainingTime,
    Stopwatch,
    format_duration,
    report,
    say_at_once,
    wall_time,
)
from bench.devices import Signal
from bench.record import Event, StepRecord

_REFRESH = 0.1
"""Wall-clock seconds between two redraws of the readings."""

_GAP = "  "
"""Between two parts of the progress of a run."""

_LEAST_BAR = 10
"""Columns below which a bar says nothing."""

_STATE = 7
"""Columns of the word that says that the run stands still, so that the bar does not move for it."""


_rehearsing = threading.Event()
"""Set while nothing moves, as a run is rehearsed."""


class _RunProgress(Progress):
    """A bar of a run with what there is to read beside it, folded where the terminal is narrow.

    Nothing is cut. Name, phase, steps and times come first; the bar takes what they leave of a line, and readings
    that do not fit beside them take lines of their own.
    """

    def get_renderables(self) -> Iterator[RenderableType]:
        """Yield what is drawn."""
        for task in self.tasks:
            yield _Line(task)


class _Line:
    """One task of `_RunProgress`, as wide as the terminal is when it is drawn."""

    def __init__(self, task: Task) -> None:
        self._task = task

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        task, width = self._task, options.max_width
        names = [(task.description, "bold"), (f"{task.fields['phase']:{_STATE}}", "")]
        facts = [(task.fields["steps"], "green"), *((text, "") for text in task.fields["times"])]
        readings = [(text, "cyan") for text in task.fields["readings"]]
        names, facts, readings = ([part for part in parts if part[0]] for parts in (names, facts, readings))
        whole = _joined([*names, *facts, *readings])
        if whole.cell_len + len(_GAP) + _LEAST_BAR <= width:
            yield self._with_bar(names, [*facts, *readings], width)
            return
        if _joined([*names, *facts]).cell_len + len(_GAP) + _LEAST_BAR <= width:
            yield self._with_bar(names, facts, width)
        else:
            yield from _folded([*names, *facts], width)
        yield from _folded(readings, width)

    def _with_bar(self, before: _Parts, after: _Parts, width: int) -> Table:
        left, right = _joined(before), _joined(after)
        room = width - left.cell_len - right.cell_len - len(_GAP) * (bool(before) + bool(after))
        bar = ProgressBar(
            total=self._task.total,
            completed=self._task.completed,
            width=room,
            pulse=self._task.total is None,
            animation_time=self._task.get_time(),
        )
        line = Table.grid(padding=(0, len(_GAP), 0, 0), pad_edge=False)
        line.add_row(left, bar, right)
        return line


_Parts = Sequence[tuple[str, str]]
"""Texts that are not broken, each with its style."""


def _joined(parts: _Parts) -> Text:
    line = Text()
    for text, style in parts:
        if line:
            line.append(" " if line.plain.endswith(",") else _GAP)
        line.append(text, style)
    return line


def _folded(parts: _Parts, width: int) -> Iterator[Text]:
    """Yield lines of parts, as many in each as fit."""
    line: list[tuple[str, str]] = []
    for part in parts:
        if line and _joined([*line, part]).cell_len > width:
            yield _joined(line)
            line = []
        line.append(part)
    if line:
        yield _joined(line)


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
        progress = _RunProgress(console=self._console, transient=False, disable=not self._console.is_terminal)
        total = 1.0 if self._remaining is not None else None
        task = progress.add_task(self._title, total=total, phase=self._phase, steps="", times=(), readings=())
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
        _rehearsing.clear()
        self._since_start = Stopwatch()
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
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
                # A line of a log is not folded.
                soft_wrap=not self._console.is_terminal,
            )
            if self.ask_again is not None:
                self.ask_again()

    def _show(self, t: float, steps: int, values: Sequence[float]) -> None:
        self._since_redraw = Stopwatch()
        times, completed = [f"t {format_duration(t)}"], 0.0
        if self._remaining is not None:
            left = self._remaining.at(t, self._since_start.seconds())
            completed = left.share
            times[-1] += ","
            times += [f"{_left(left)},", f"ends {_time_of_day(left.wall)}"]
            if math.isfinite(left.at_most) and _time_of_day(left.at_most) != _time_of_day(left.wall):
                times[-1] += ","
                times.append(f"at the latest {_time_of_day(left.at_most)}")
        readings = [
            f"{signal.name} {signal.display.number(values[i])} {signal.display.unit}".rstrip()
            for i, signal in self._shown
        ]
        self.latest = "  ".join(readings)
        with self.lock:
            if not self._is_still:
                self._progress.update(
                    self._task,
                    completed=completed,
                    steps=f"{steps}/{self._steps or '?'}",
                    times=times,
                    readings=readings,
                )
        report(steps, self._steps or None, _joined([(text, "") for text in (*times, *readings)]).plain)


def say_what_ctrl_c_does(text: str) -> None:
    """Say to the operator what was understood of Ctrl-C or a signal: nothing moves in a rehearsal, which it ends."""
    say_at_once("ending the rehearsal; nothing has moved" if _rehearsing.is_set() else text)


class RehearsalDisplay(PatienceDisplay):
    """Shows from its third second on that a rehearsal goes on, and how far; an `Observer` of the engine.

    Parameters
    ----------
    title : str
        What is rehearsed, and where.
    console : Console
        Console to draw on; if it is no terminal, one line is printed.
    """

    def __init__(self, title: str, console: Console) -> None:
        super().__init__(title, console)
        self._since_redraw = Stopwatch()

    def __enter__(self) -> Self:
        _rehearsing.set()
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # What ends a rehearsal ends all: it is said in another thread, which may come later.
        if kind is None:
            _rehearsing.clear()
        with suppress(OSError):
            self.stop()

    def telemetry(self, t: float, step: int, values: Sequence[float]) -> None:  # noqa: ARG002 - as of all
        """Show how far it is."""
        if self._since_redraw.seconds() > _REFRESH:
            self._since_redraw = Stopwatch()
            self.describe(f"{step} steps, laboratory {format_duration(t)}")

    def step(self, record: StepRecord) -> None:
        """Show how far it is."""
        self.telemetry(record.finished, record.step + 1, record.values)

    def event(self, event: Event) -> None:
        """Show nothing: the result of the rehearsal says what it found."""


def _left(left: Remaining) -> str:
    """Return what is left of a run in laboratory time, and what that takes where its clock is not the wall's."""
    text = f"left {format_duration(left.laboratory)}"
    if math.isclose(left.laboratory, left.wall, rel_tol=0.1, abs_tol=1.0):
        return text
    return f"{text} laboratory ≈ {_roughly(left.wall)}"


def _roughly(seconds: float) -> str:
    for most, unit, name in ((100.0, 1.0, "s"), (6000.0, 60.0, "min")):
        if seconds < most:
            return f"{seconds / unit:.0f} {name}"
    return f"{seconds / 3600.0:.1f} h"


def _time_of_day(seconds: float) -> str:
    """Return the local time of day that many wall-clock seconds from now; with the date if that is another day."""
    now = wall_time()
    end = (now + timedelta(seconds=seconds)).astimezone()
    return end.strftime("%H:%M" if end.date() == now.astimezone().date() else "%Y-%m-%d %H:%M")
