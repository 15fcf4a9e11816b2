"""How far a long computation is: said where it computes, and shown on the terminal by who has started it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from threading import Event, Thread
from typing import TypeAlias

from rich.console import Console
from rich.errors import LiveError

from bench.base.printing import print_plain

Listener: TypeAlias = Callable[[str, float], None]
"""Takes what is being done, such as `fitting`, and the share of it that is done, 0 to 1."""

_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


@contextmanager
def shares_to(listener: Listener) -> Iterator[None]:
    """Give the shares that are said within this block to a listener, in the thread that computes.

    What the listener says itself goes to the one before.
    """
    before = _listener.get()

    def told(what: str, share: float) -> None:
        token = _listener.set(before)
        try:
            listener(what, share)
        finally:
            _listener.reset(token)

    token = _listener.set(told)
    try:
        yield
    finally:
        _listener.reset(token)


def say_share(what: str, share: float) -> None:
    """Say which share of a computation is done, 0 to 1; nothing happens if nobody listens."""
    listener = _listener.get()
    if listener is not None:
        listener(what, min(max(share, 0.0), 1.0))


PATIENCE = 2.0
"""Seconds of work after which a terminal shows that it goes on."""


class PatienceDisplay:
    """A bar with the time that has passed and the time that is left, as far as what computes says its share.

    Nothing is drawn in the first seconds. If the console is no terminal, what is done is printed once in its place.

    Parameters
    ----------
    text : str
        What is done, where what computes says nothing.
    console : Console
        Console of the bar.
    patience : float
        Seconds after which it is drawn.
    """

    def __init__(self, text: str, console: Console, patience: float = PATIENCE) -> None:
        # Not at the start of each command: most show no bar.
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
        from rich.table import Column

        self._console = console
        self._progress = Progress(
            # Names are the user's: no markup, and none is cut.
            TextColumn("{task.description}", markup=False, table_column=Column(overflow="fold")),
            BarColumn(),
            TimeElapsedColumn(),
            TextColumn("left, about:"),
            TimeRemainingColumn(),
            console=console,
            transient=True,
        )
        self._text, self._patience, self._stage = text, patience, ""
        self._task = self._progress.add_task(text, total=None)
        self._done = Event()
        self._thread = Thread(target=self._draw_later, daemon=True)

    def start(self) -> None:
        """Begin to wait."""
        self._thread.start()

    def stop(self) -> None:
        """Take the bar away."""
        self._done.set()
        self._thread.join()
        # A bar that was not drawn would end with an empty line where the console is no terminal.
        if self._progress.live.is_started:
            self._progress.stop()

    def say(self, stage: str, share: float) -> None:
        """Show a stage of the work, and the share of it that is done, 0 to 1; a share never falls.

        What follows a colon in the name of a stage may change while it goes on.
        """
        if stage.partition(":")[0] != self._stage:
            self._stage = stage.partition(":")[0]
            self._progress.reset(self._task, total=1.0)
        done = self._progress.tasks[0].completed
        self._progress.update(self._task, completed=max(share, done), description=f"{self._text}: {stage}")

    def describe(self, text: str) -> None:
        """Show how far the work is where nothing says its share."""
        self._progress.update(self._task, description=f"{self._text}: {text}")

    def _draw_later(self) -> None:
        if self._done.wait(self._patience):
            return
        if self._console.is_terminal:
            # Rich draws one display beside another only from version 14.1 on.
            with suppress(LiveError):
                self._progress.start()
        else:
            print_plain(self._console, f"{self._text} …")


@contextmanager
def show_patience(text: str, console: Console) -> Iterator[None]:
    """Show on a terminal that work goes on, once it has taken more than two seconds, and how much of it is left."""
    if not console.is_terminal:
        yield
        return
    display = PatienceDisplay(text, console)
    display.start()
    try:
        with shares_to(display.say):
            yield
    finally:
        display.stop()
