"""What a task knows of where it is carried out: a console for its words, and who hears how far it is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from rich.console import Console

from bench.base.printing import PlainConsole

Report = Callable[[int, int | None, str], None]

COLLECTIONS = 100_000, 20, 50
"""Thresholds of the garbage collection, see `gc.set_threshold`. A task loads hundreds of thousands of objects that
stay, and makes rows by the thousand that are no garbage. Source: measured, an export takes a quarter longer by those
of Python."""


@dataclass(frozen=True)
class _Surroundings:
    console: Console
    report: Report | None


_surroundings: _Surroundings | None = None


@contextmanager
def task_surroundings(console: Console, report: Report | None) -> Iterator[None]:
    """Let tasks of this process print on a console and report; without `report` they draw their own progress."""
    global _surroundings
    former, _surroundings = _surroundings, _Surroundings(console, report)
    try:
        yield
    finally:
        _surroundings = former


def task_console() -> Console:
    """Return the console for what a task prints: it arrives on the console of the `Workers`."""
    return PlainConsole() if _surroundings is None else _surroundings.console


def report(completed: int, total: int | None, text: str) -> None:
    """Say how far the task of this process is; nothing happens outside of a worker process.

    Parameters
    ----------
    completed, total : int
        Steps that are done, and all of them; None if that is not known.
    text : str
        What is being done.
    """
    if _surroundings is not None and _surroundings.report is not None:
        _surroundings.report(completed, total, text)
