"""A worker process: carries out one task after another, until the bench closes its end of the pipe or is gone."""

from __future__ import annotations

import gc
import io
import os
import pickle
import queue
import signal
import sys
import threading
import traceback
from contextlib import suppress
from typing import IO

from bench.base.errors import BenchError
from bench.base.printing import PlainConsole
from bench.base.workers.messages import Message, Progress, Result, Welcome, Words, receive, send
from bench.base.workers.task import COLLECTIONS, task_surroundings


def main() -> None:
    """Carry out what comes by standard input."""
    orders, results = _take_pipes()
    outbox = _Outbox(results)
    inbox: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    try:
        welcome: Welcome = receive(orders)
    except EOFError:
        return
    sys.argv = welcome.command
    gc.set_threshold(*COLLECTIONS)
    threading.Thread(target=_listen, args=(orders, inbox), name="orders", daemon=True).start()
    console = PlainConsole(file=_Speaker(outbox), width=welcome.width, force_terminal=False)
    with task_surroundings(console, lambda *how_far: outbox.put(Progress(*how_far))):
        while (order := inbox.get()) is not None:
            outbox.put(_carry_out(order))


def _take_pipes() -> tuple[IO[bytes], IO[bytes]]:
    """Return the pipes from and to the bench; what a task reads or prints must not touch them."""
    orders, results = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    os.dup2(2, 1)
    return orders, results


def _listen(orders: IO[bytes], inbox: queue.SimpleQueue[bytes | None]) -> None:
    """Pass orders on; end what is going on when there are no more."""
    try:
        while True:
            inbox.put(receive(orders))
    except EOFError:
        inbox.put(None)
    # A run has a handler for it, and brings its devices into the safe state; all else may be left at once.
    if sys.platform == "win32":
        signal.raise_signal(signal.SIGTERM)
    else:
        # Wakes the main thread as well.
        os.kill(os.getpid(), signal.SIGTERM)


def _carry_out(order: bytes) -> Result:
    try:
        return Result(pickle.dumps(pickle.loads(order)()), is_error=False)  # noqa: S301 - from our own bench
    except Exception as error:
        return Result(_packed(error), is_error=True)


def _packed(error: Exception) -> bytes:
    """Return an exception in a form that the bench can read, with its traceback if it is not of the bench."""
    if not isinstance(error, BenchError):
        error.add_note("in a worker process:\n" + "".join(traceback.format_exception(error)))
    try:
        content = pickle.dumps(error)
        pickle.loads(content)  # noqa: S301 - of a moment ago
    except Exception:
        replacement = RuntimeError(f"{type(error).__name__}: {error}")
        for note in getattr(error, "__notes__", ()):
            replacement.add_note(note)
        return pickle.dumps(replacement)
    return content


class _Outbox:
    """The pipe to the bench, for several threads."""

    def __init__(self, pipe: IO[bytes]) -> None:
        self._pipe = pipe
        self._lock = threading.Lock()

    def put(self, message: Message) -> None:
        """Send a message; a bench that is gone hears nothing more."""
        with self._lock, suppress(OSError):
            send(self._pipe, message)


class _Speaker(io.StringIO):
    """Sends whole lines to the bench."""

    def __init__(self, outbox: _Outbox) -> None:
        super().__init__()
        self._outbox = outbox
        self._begun = ""

    def write(self, text: str) -> int:
        """Send the lines that `text` completes."""
        *lines, self._begun = (self._begun + text).split("\n")
        if lines:
            self._outbox.put(Words("\n".join(lines)))
        return len(text)
