"""Standard output and standard error as commands use them: a failed print destroys no work."""

from __future__ import annotations

import io
import os
import stat
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

_PATIENCE = 10.0
"""Longest wait at the end for a pipe that nobody reads, s of wall-clock time without progress."""

_PART = 4096
"""Bytes that are written at once: PIPE_BUF of Linux."""

_UNREAD = "nobody reads it"


class Output(io.TextIOBase):
    """A standard stream whose writes never raise; a pipe is written by a thread, so that they never wait either.

    After the first failure, what is written is dropped. Characters that the encoding lacks become escapes.

    The stream is None for a descriptor that is closed.

    `failure` says why something could not be written; it is empty if all was.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self.failure = ""
        self._stream = stream
        self._waiting: deque[memoryview] = deque()
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        with suppress(OSError, ValueError, AttributeError):
            stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
        self._pipe = _pipe_of(stream)

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """Encoding of the stream."""
        return getattr(self._stream, "encoding", None) or "utf-8"

    def isatty(self) -> bool:
        """Return whether it is a terminal."""
        try:
            return self._stream is not None and self._stream.isatty()
        except ValueError:
            return False

    def fileno(self) -> int:
        """Return the descriptor; raise OSError if there is none."""
        if self._stream is None:
            raise OSError("the stream is closed")
        return self._stream.fileno()

    def writable(self) -> bool:
        """Return True: what cannot be written is dropped."""
        return True

    def write(self, text: str) -> int:
        """Write a text; return its length."""
        if self._stream is None or self.failure:
            return len(text)
        if self._pipe is None:
            self._attempt(lambda stream: stream.write(text))
            return len(text)
        content = text.replace("\n", os.linesep).encode(self.encoding, "backslashreplace")
        with self._changed:
            if content:
                self._waiting.append(memoryview(content))
            self._changed.notify_all()
        if self._thread is None:
            self._thread = threading.Thread(target=self._pass_on, args=(self._pipe,), name="output", daemon=True)
            self._thread.start()
        return len(text)

    def flush(self) -> None:
        """Write what a buffer holds; of a pipe, the thread does."""
        if self._stream is not None and self._pipe is None and not self.failure:
            self._attempt(lambda stream: stream.flush())

    def finish(self) -> str:
        """Wait until all is written, or cannot be; return why not."""
        self.flush()
        with self._changed:
            while self._waiting and not self.failure:
                if not self._changed.wait(_PATIENCE):
                    self.failure = _UNREAD
        return self.failure

    def _attempt(self, do: Callable[[TextIO], object]) -> None:
        assert self._stream is not None
        try:
            do(self._stream)
        except (OSError, ValueError) as error:
            self.failure = getattr(error, "strerror", None) or str(error)
            # Python would try once more at its end, and complain.
            with suppress(OSError, ValueError, AttributeError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())

    def _pass_on(self, pipe: int) -> None:
        """Write what waits, in the thread of a pipe."""
        while True:
            with self._changed:
                while not self._waiting:
                    self._changed.wait()
                content = self._waiting[0]
            try:
                # In parts: what a slow reader has taken of them counts as progress.
                written = os.write(pipe, content[:_PART])
            except OSError as error:
                written, failure = 0, error.strerror or str(error)
            else:
                failure = ""
            with self._changed:
                if failure:
                    self.failure = failure
                    self._waiting.clear()
                elif written == len(content):
                    self._waiting.popleft()
                else:
                    self._waiting[0] = content[written:]
                self._changed.notify_all()


@contextmanager
def standard_streams() -> Iterator[None]:
    """Let commands print without harm; at the end, what could not be printed is said on the standard error."""
    former = sys.stdout, sys.stderr
    output, errors = Output(sys.stdout), Output(sys.stderr)
    sys.stdout, sys.stderr = output, errors
    try:
        yield
    finally:
        if failure := output.finish():
            errors.write(f"the standard output cannot be written: {failure}; the work is done\n")
        errors.finish()
        sys.stdout, sys.stderr = former


def write_out(text: str) -> str:
    """Write to the standard output what a program reads; return why it could not be written, or an empty text."""
    sys.stdout.write(text)
    if isinstance(sys.stdout, Output):
        failure, sys.stdout.failure = sys.stdout.finish(), ""
        return failure
    sys.stdout.flush()
    return ""


def _pipe_of(stream: TextIO | None) -> int | None:
    """Return the descriptor of a stream that is a pipe or a socket, or None."""
    try:
        descriptor = stream.fileno()  # type: ignore[union-attr]
        mode = os.fstat(descriptor).st_mode
    except (OSError, ValueError, AttributeError):
        return None
    return descriptor if stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode) else None
