"""The parent of a process: whether it lives, and how it is ended."""

from __future__ import annotations

import os
import select
import signal
import sys
from contextlib import suppress

SIGKILL: int = getattr(signal, "SIGKILL", signal.SIGTERM)
"""What ends a process that does not listen; on Windows SIGTERM does."""


class ParentProcess:
    """The parent of this process; no other one is taken for it that has its number once it is gone.

    Parameters
    ----------
    number : int
        Its number.

    Attributes
    ----------
    descriptor : int or None
        Becomes readable when it dies, where the system has such a thing. The end of a channel alone does not do: a
        forked child of the parent keeps it open.
    """

    def __init__(self, number: int) -> None:
        self._number = number
        self.descriptor: int | None = None
        if hasattr(os, "pidfd_open"):
            with suppress(OSError):
                descriptor = os.pidfd_open(number)
                # The parent of an orphan is another process.
                if os.getppid() == number:
                    self.descriptor = descriptor

    def has_died(self) -> bool:
        """Return whether it is known to be dead; on Windows only its channel says that."""
        if self.descriptor is not None:
            return bool(select.select([self.descriptor], [], [], 0.0)[0])
        return sys.platform != "win32" and os.getppid() != self._number

    def await_end(self, seconds: float) -> bool:
        """Wait until it is dead, for so many wall-clock seconds at most; return whether it is known to be."""
        if self.descriptor is not None:
            select.select([self.descriptor], [], [], seconds)
        return self.has_died()

    def send(self, number: int | None) -> None:
        """Send it a signal, None for one that the system lacks; on Windows it is ended at once by any.

        There it is called only while the channel is open, so that the number is its own.
        """
        if number is None or self.has_died():
            return
        with suppress(OSError):
            if self.descriptor is not None:
                signal.pidfd_send_signal(self.descriptor, number)
            else:
                os.kill(self._number, number)
