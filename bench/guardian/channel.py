"""The channel between bench and guardian: numbered requests and replies as JSON, with their length before them.

Over one pair of connected sockets. JSON keeps every float to the last bit; nan and infinity are allowed. Nothing that
is received is ever executed.
"""

from __future__ import annotations

import json
import selectors
import socket
import struct
from typing import Any

from bench import errors
from bench.errors import BenchError, DeviceError

_HEAD = struct.Struct(">I")
_LONGEST = 1 << 20
"""Longest message, bytes; a block of samples is far shorter."""

Message = dict[str, Any]


class ChannelError(Exception):
    """The other side is gone, or what it sends is no message."""


class Channel:
    """One end of the channel.

    Parameters
    ----------
    connection : socket.socket
        Connected; the channel closes it.
    """

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        self._socket = connection
        self._received = bytearray()

    def fileno(self) -> int:
        """Return the descriptor, for a selector."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close this end; the other one sees it at once."""
        self._socket.close()

    def send(self, message: Message) -> None:
        """Send a message; raise `ChannelError` if the other side is gone, or takes nothing more.

        It never waits: one that does not read is as good as gone.
        """
        body = json.dumps(message).encode()
        if len(body) > _LONGEST:
            raise ChannelError(f"a message of {len(body)} bytes; {_LONGEST} are allowed")
        frame = _HEAD.pack(len(body)) + body
        try:
            if self._socket.send(frame) != len(frame):
                raise ChannelError("the other side does not read")
        except OSError as error:
            raise ChannelError(f"the other side is gone: {error}") from None

    def receive(self) -> list[Message]:
        """Return the messages that have come; raise `ChannelError` if the other side is gone."""
        gone = False
        while not gone:
            try:
                chunk = self._socket.recv(65536)
            except BlockingIOError:
                break
            except OSError as error:
                raise ChannelError(f"the other side is gone: {error}") from None
            gone = not chunk
            self._received += chunk
        messages = []
        while (message := self._next()) is not None:
            messages.append(message)
        if gone and not messages:
            raise ChannelError("the other side is gone")
        return messages

    def wait(self, seconds: float) -> bool:
        """Wait until something has come, for so many wall-clock seconds at most; return whether it has."""
        with selectors.DefaultSelector() as selector:
            selector.register(self._socket, selectors.EVENT_READ)
            return bool(selector.select(seconds))

    def _next(self) -> Message | None:
        if len(self._received) < _HEAD.size:
            return None
        (length,) = _HEAD.unpack_from(self._received)
        if length > _LONGEST:
            raise ChannelError(f"a message of {length} bytes was announced; {_LONGEST} are allowed")
        end = _HEAD.size + length
        if len(self._received) < end:
            return None
        body = bytes(self._received[_HEAD.size : end])
        del self._received[:end]
        try:
            message = json.loads(body)
        except ValueError as error:
            raise ChannelError(f"no JSON: {error}") from None
        if not isinstance(message, dict):
            raise ChannelError("a message is an object of JSON")
        return message


def to_message(error: BaseException) -> Message:
    """Return an error as a message."""
    known = isinstance(error, BenchError)
    text = str(error) if known else f"{type(error).__name__}: {error}"
    return {
        "kind": type(error).__name__ if known else BenchError.__name__,
        "text": text,
        "device": error.device if isinstance(error, DeviceError) else None,
    }


def to_error(message: Message) -> BenchError:
    """Return the error that a message stands for."""
    kind = getattr(errors, message["kind"], BenchError)
    text, device = message["text"], message["device"]
    if device is not None:
        error: BenchError = kind(device, text.removeprefix(f"{device}: "))
        return error
    made: BenchError = kind(text)
    return made
