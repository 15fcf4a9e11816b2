"""Wire servers: the bytes that go to an emulated instrument, and those that come back."""

from __future__ import annotations

from typing import Protocol


class WireServer(Protocol):
    """The serial side of an emulated instrument."""

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the host, in pieces of any size; return what the instrument sends."""
