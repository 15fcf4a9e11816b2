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

from bench.base import BenchError, DeviceError, errors, parse_json

_HEAD = struct.Struct(">I")
_LONGEST = 1 << 24
"""Longest message, bytes; a block of 40 000 samples takes some 2 MB."""

LONGEST_ANSWER = 15.0
"""Longest time for the answer to a request, s, beyond that for which a line may be away."""

Message = dict[str, Any]

STILL_AT_IT: Message = {"n": 0}
"""What the guardian says each second until it replies: a stopped one is told from one that waits for a line."""


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
        self._unsent = bytearray()

    @property
    def is_sending(self) -> bool:
        """Whether the system has not taken all of a message yet; `flush` goes on when the socket can be written."""
        return bool(self._unsent)

    def fileno(self) -> int:
        """Return the descriptor, for a selector."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close this end; the other one sees it at once."""
        self._socket.close()

    def send(self, message: Message) -> None:
        """Send a message; raise `ChannelError` if the other side is gone, or has not taken the message before.

        It never waits: what the system does not take at once is sent by `flush` and `wait`.
        """
        if self._unsent:
            raise ChannelError("the other side does not read")
        body = json.dumps(message).encode()
        if len(body) > _LONGEST:
            raise ChannelError(f"a message of {len(body)} bytes; {_LONGEST} are allowed")
        self._unsent += _HEAD.pack(len(body)) + body
        self.flush()

    def flush(self) -> None:
        """Send what is left of a message, as far as the system takes it; raise `ChannelError` if nobody is there."""
        try:
            while self._unsent:
                del self._unsent[: self._socket.send(self._unsent)]
        except BlockingIOError:
            pass
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
        """Wait until something has come, for so many wall-clock seconds at most; return whether it has.

        Raises `ChannelError` if a message is on its way still, and nobody is there to take it.
        """
        with selectors.DefaultSelector() as selector:
            selector.register(self._socket, selectors.EVENT_READ | selectors.EVENT_WRITE * self.is_sending)
            ready = selector.select(seconds)
        self.flush()
        return any(events & selectors.EVENT_READ for _, events in ready)

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
            message = parse_json(body)
        except ValueError as error:
            raise ChannelError(f"no JSON: {error}") from None
        if not isinstance(message, dict):
            raise ChannelError("a message is an object of JSON")
        return message


_KINDS: dict[str, type[BenchError]] = {
    name: kind for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, BenchError)
}
"""The errors that both sides know, by name."""


def to_message(error: BaseException) -> Message:
    """Return an error as a message.

    One of a class of its own, of a driver, say, goes as the nearest class that both sides know.
    """
    known = isinstance(error, BenchError)
    device, text = (error.device, error.text) if isinstance(error, DeviceError) else (None, str(error))
    return {
        "kind": next((kind.__name__ for kind in type(error).__mro__ if kind in _KINDS.values()), BenchError.__name__),
        "text": text if known else f"{type(error).__name__}: {text}",
        "device": device,
    }


def to_error(message: Message) -> BenchError:
    """Return the error that a message stands for."""
    kind = _KINDS[message["kind"]]
    device, text = message["device"], message["text"]
    made: BenchError = kind(*((text,) if device is None else (device, text)))
    return made
