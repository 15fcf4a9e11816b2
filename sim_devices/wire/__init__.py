"""Wire servers: the bytes that go to an emulated instrument, and those that come back."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar


class WireServer(ABC):
    """The serial side of an emulated instrument.

    Attributes
    ----------
    protocol : str
        Name of what is spoken on the line, for people.
    """

    protocol: ClassVar[str] = "serial"

    @abstractmethod
    def receive(self, data: bytes) -> bytes:
        """Take bytes from the host, in pieces of any size; return what the instrument sends."""

    def unsolicited(self) -> bytes:
        """Return what the instrument has sent by itself since the last call, up to the clock's present time."""
        return b""

    def next_unsolicited(self) -> float:
        """Return the laboratory time (s) at which it will next send something by itself; infinity if never."""
        return math.inf
