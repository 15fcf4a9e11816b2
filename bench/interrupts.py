"""Signals of the operating system and the operator's keyboard during a run."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from types import FrameType, TracebackType
from typing import Self

_ABORTING = ("SIGTERM", "SIGHUP", "SIGBREAK")


class Interrupts:
    """Turns Ctrl-C and the signals of the system into requests that the engine looks at.

    The first Ctrl-C asks for a pause at the next step, the second for the end at once; SIGTERM and SIGHUP ask
    for the end at once. Nothing is raised inside of a device's transaction. Use it as a context manager; the
    former handlers come back at the end. In a thread other than the main one it watches nothing, as Python
    has it.

    Parameters
    ----------
    notify : callable
        Tells the operator what was understood. Called at any point of the program: it must not wait for
        a lock, as the lines that were interrupted may hold it; printing through a console does.

    Attributes
    ----------
    pause_requested : bool
        Whether to pause at the next step; the engine clears it.
    abort_reason : str or None
        Why to end at once.
    """

    def __init__(self, notify: Callable[[str], None] = lambda _: None) -> None:
        self.pause_requested = False
        self.abort_reason: str | None = None
        self._notify = notify
        self._former: dict[int, object] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._install(signal.SIGINT, self._interrupt)
            for name in _ABORTING:
                number = getattr(signal, name, None)
                if number is not None:
                    self._install(number, self._terminate)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._former.items():
            signal.signal(number, handler)  # type: ignore[arg-type]  # as signal.signal returned it

    def _install(self, number: int, handler: Callable[[int, FrameType | None], None]) -> None:
        former = signal.getsignal(number)
        # What was told to be ignored stays so: `nohup bench run …` outlives its terminal.
        if former is not signal.SIG_IGN:
            signal.signal(number, handler)
            self._former[number] = signal.SIG_DFL if former is None else former

    def _tell(self, text: str) -> None:
        # Nothing may be raised here, as a signal arrives at any point of the program.
        with suppress(Exception):
            self._notify(text)

    def abort_requested(self) -> bool:
        """Return whether the run has to end at once."""
        return self.abort_reason is not None

    def _interrupt(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002 - signal's form
        if self.pause_requested:
            self.abort_reason = "Ctrl-C, twice"
            self._tell("ending at once, in the safe state")
        else:
            self.pause_requested = True
            self._tell("pausing at the next step; Ctrl-C again ends at once")

    def _terminate(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002 - signal's form
        self.abort_reason = signal.Signals(number).name
