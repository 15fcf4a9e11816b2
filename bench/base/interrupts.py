"""Signals of the operating system and the operator's keyboard during a run."""

from __future__ import annotations

import os
import queue
import signal
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import Self

from bench.base.clock import Stopwatch

STACKS: int | None = getattr(signal, "SIGRTMIN", getattr(signal, "SIGINFO", None))
"""Signal at which a guarded run writes where its threads stand, where the system has it; any other run ignores it.
It is one that nobody sends to end a process."""

_NOT_ENDING = frozenset(
    getattr(signal, name)
    for name in (
        # A pause.
        "SIGINT",
        # They cannot be caught, or mean that the process itself is broken.
        *("SIGKILL", "SIGSTOP", "SIGABRT", "SIGBUS", "SIGEMT", "SIGFPE", "SIGILL", "SIGSEGV", "SIGSYS", "SIGTRAP"),
        # They do not end it: by themselves, or as Python ignores them.
        *("SIGCHLD", "SIGCLD", "SIGCONT", "SIGINFO", "SIGPIPE", "SIGTSTP", "SIGTTIN", "SIGTTOU", "SIGURG"),
        *("SIGWINCH", "SIGXFSZ"),
    )
    if hasattr(signal, name)
)

ENDING = frozenset(signal.valid_signals()) - _NOT_ENDING - {STACKS}
"""Numbers of the signals that would end a process, and can be caught."""

_UNHEARD = 2.0
"""Wall-clock time within which a run has to begin to end when it was asked to, s."""

_UNFINISHED = 30.0
"""Wall-clock time for its end from then on, s: safe state, rescue and record."""

_LAST_WORDS = 1.0
"""Longest wait for a terminal at the end, s."""


class Interrupts:
    """Turns Ctrl-C and the signals of the system into requests that the engine looks at.

    The first Ctrl-C asks for a pause, the second for the end at once, as does every signal that would end the
    process, with a guardian as without one. Nothing is raised inside of a device's transaction. A run that does not
    begin to end within 2 s, as its protocol computes for ever or a write hangs, is left by a thread of its own.

    Use it as a context manager, from before the first device is opened; the former handlers come back at the end. In
    a thread other than the main one it watches nothing, as Python runs handlers in the main thread only.

    Parameters
    ----------
    notify : callable
        Says to the operator what was understood; called in a thread of its own, as a terminal may hang.
    """

    def __init__(self, notify: Callable[[str], None] = lambda _: None) -> None:
        self._pause = False
        self.abort_reason: str | None = None
        """Why to end at once; None while there is no reason."""
        self._notify = notify
        self._leave: Callable[[str], None] | None = None
        self._former: dict[int, object] = {}
        self._former_wakeup = -1
        self._presses = 0
        self._ending = threading.Event()
        self._over = threading.Event()
        self._words: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._threads: list[threading.Thread] = []
        self._sockets: tuple[socket.socket, ...] = ()

    @property
    def pause_requested(self) -> bool:
        """Whether to pause; the engine clears it."""
        return self._pause

    @pause_requested.setter
    def pause_requested(self, wanted: bool) -> None:
        self._pause = wanted
        self._presses = int(wanted)

    def abort_requested(self) -> bool:
        """Return whether the run has to end at once."""
        return self.abort_reason is not None

    def acknowledge(self) -> None:
        """Note that the run has begun to end."""
        self._ending.set()

    def finish(self) -> None:
        """Note that the run is over and every device safe: what is left to do may be left at any time."""
        self._ending.clear()

    def leave_by(self, leave: Callable[[str], None]) -> None:
        """Set what ends the process, from another thread and with a reason, if the run does not come to its end."""
        self._leave = leave

    def __enter__(self) -> Self:
        if threading.current_thread() is not threading.main_thread():
            return self
        ours, theirs = socket.socketpair()
        for each in (ours, theirs):
            each.setblocking(False)
        self._sockets = ours, theirs
        self._install(signal.SIGINT, self._interrupt)
        for number in ENDING:
            self._install(number, self._terminate)
        if STACKS is not None:
            self._install(STACKS, signal.SIG_IGN)
        # Python's handlers wait for the main thread, these bytes do not.
        self._former_wakeup = signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)
        for work in (self._listen, self._speak):
            thread = threading.Thread(target=work, name="interrupts", daemon=True)
            thread.start()
            self._threads.append(thread)
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        if not self._sockets:
            return
        signal.set_wakeup_fd(self._former_wakeup, warn_on_full_buffer=False)
        for number, handler in self._former.items():
            signal.signal(number, handler)  # type: ignore[arg-type]  # as signal.signal returned it
        ours, theirs = self._sockets
        theirs.close()
        listening, speaking = self._threads[:2]
        listening.join(_LAST_WORDS)
        self._words.put(None)
        speaking.join(_LAST_WORDS)
        ours.close()

    def _install(self, number: int, handler: Callable[[int, FrameType | None], None] | signal.Handlers) -> None:
        former = signal.getsignal(number)
        # What was told to be ignored stays so: `nohup bench run …` outlives its terminal.
        if former is not signal.SIG_IGN:
            signal.signal(number, handler)
            self._former[number] = signal.SIG_DFL if former is None else former

    def _interrupt(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002 - signal's form
        if self._pause:
            self.abort_reason = "Ctrl-C, twice"
        else:
            self._pause = True

    def _terminate(self, number: int, frame: FrameType | None) -> None:  # noqa: ARG002 - signal's form
        self.abort_reason = signal_name(number)

    def _listen(self) -> None:
        """Hear the signals beside the main thread, which may be unable to."""
        ours = self._sockets[0]
        ours.setblocking(True)
        with suppress(OSError):
            while numbers := ours.recv(64):
                for number in numbers:
                    self._hear(number)

    def _hear(self, number: int) -> None:
        if number not in self._former:
            return
        if number == signal.SIGINT:
            self._presses += 1
            if self._presses < 2:
                self._words.put("pausing; Ctrl-C again ends at once")
                return
            reason = "Ctrl-C, twice"
            self._words.put("ending at once, in the safe state")
        else:
            reason = signal_name(number)
        if len(self._threads) == 2:
            watch = threading.Thread(target=self._watch_the_end, args=(reason,), name="end", daemon=True)
            self._threads.append(watch)
            watch.start()

    def _watch_the_end(self, reason: str) -> None:
        since = Stopwatch()
        while not self._over.wait(0.1):
            if since.seconds() > (_UNFINISHED if self._ending.is_set() else _UNHEARD):
                break
        else:
            return
        if self._leave is not None:
            self._leave(reason)

    def _speak(self) -> None:
        while (words := self._words.get()) is not None:
            # The terminal may be gone.
            with suppress(Exception):
                self._notify(words)


def signal_name(number: int) -> str:
    """Return the name of a signal; those that a system numbers only have one of their own."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def say_at_once(text: str) -> None:
    """Write to the terminal without its console, whose locks the interrupted code may hold."""
    os.write(2, f"\n{text}\n".encode())
