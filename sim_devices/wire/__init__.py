"""Wire servers: the bytes that go to an emulated instrument, and those that come back."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Protocol

import numpy as np


class Stream(Protocol):
    """The instrument's end of a serial line, or of one connection on TCP."""

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the client, in pieces of any size; return what the instrument sends."""

    def unsolicited(self) -> bytes:
        """Return what the client gets without a request since the last call, up to the clock's present time."""

    def next_unsolicited(self) -> float:
        """Return the laboratory time (s) at which that next is something; infinity if never."""


class Connection(Stream, Protocol):
    """The instrument's end of a connection on TCP."""

    @property
    def is_open(self) -> bool:
        """Whether the instrument has not ended it."""

    def close(self) -> None:
        """End it; may be called again."""


class Answering:
    """What a fault of a line has to know of the answers of an instrument.

    Attributes
    ----------
    protocol : str
        Name of what is spoken on the line, for people.
    has_addresses : bool
        Whether an answer says whose it is, or which request it belongs to.
    is_text : bool
        Whether numbers are written with a decimal point.
    """

    protocol: str = "serial"
    has_addresses: bool = False
    is_text: bool = False

    def answer_begins(self, sent: bytes) -> int:  # noqa: ARG002
        """Return where, in what is sent upon a request, the instrument's own answer begins: after an adapter's."""
        return 0

    def corrupted(self, answer: bytes, rng: np.random.Generator) -> bytes:
        """Return an answer with a wrong bit."""
        place, bit = int(rng.integers(len(answer))), int(rng.integers(8))
        return answer[:place] + bytes((answer[place] ^ 1 << bit,)) + answer[place + 1 :]

    def readdressed(self, answer: bytes) -> bytes:
        """Return an answer as it comes from another address, whole in all else; what is no answer stays as it is."""
        return answer


class WireServer(Answering, ABC):
    """The serial side of an emulated instrument.

    Attributes
    ----------
    hears_others : bool
        Whether it is on the line itself, so that on a shared one it hears what others send.
    """

    hears_others: bool = True

    @abstractmethod
    def receive(self, data: bytes) -> bytes:
        """Take bytes from the host, in pieces of any size; return what the instrument sends."""

    def unsolicited(self) -> bytes:
        """Return what the instrument has sent by itself since the last call, up to the clock's present time."""
        return b""

    def next_unsolicited(self) -> float:
        """Return the laboratory time (s) at which it will next send something by itself; infinity if never."""
        return math.inf


class TcpServer(Answering, ABC):
    """The side of an instrument on TCP."""

    @abstractmethod
    def connect(self) -> Connection:
        """Open a connection; raises `ConnectionRefusedError` if the instrument takes no more."""
