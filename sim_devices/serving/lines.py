"""The line of one served instrument: its clients, the time that bytes take, and the faults of a cable."""

from __future__ import annotations

import math
import selectors
from collections import deque
from collections.abc import Collection, Iterable, Iterator
from enum import Enum
from typing import Protocol

from bench.clock import Stopwatch
from sim_devices.serving.clock import ServedClock
from sim_devices.serving.endpoints import Connection, End, Listener, PseudoTerminal, socket_address
from sim_devices.wire import WireServer
from sim_devices.wire.modbus_tcp import FramingError, ModbusTcpInstrument

_BITS_PER_BYTE = 10  # 8N1: a start and a stop bit
_SLICE = 64  # bytes that are served at once, so that a flood of bursts moves the clock no further than a few of them
_MOST_BYTES = 4096  # that wait on either way
_UNREAD_SECONDS = 1.0  # of wall-clock time after which a terminal forgets what nobody reads


class Watched(Protocol):
    """What a selector waits on."""

    def fileno(self) -> int:
        """Return the descriptor."""


class Stream(Protocol):
    """The instrument's end of a line or connection."""

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the client, in pieces of any size; return what the instrument sends."""


class Cable(Enum):
    """The state of a line."""

    WHOLE = "whole"
    UNPLUGGED = "unplugged"
    """What is sent either way is lost; connections stay, as with a cable that was pulled."""
    CUTTING = "cut at the next answer"
    CUT = "cut"
    """As unplugged; TCP connections are reset, and new ones are closed at once."""
    HANGING = "hanging"
    """Nothing is served; what was asked is answered, late, once the line is whole again."""


class Channel:
    """Bytes on their way between one client and one instrument.

    Parameters
    ----------
    end : End
        The server's end.
    stream : Stream
        The instrument's end.
    clock : ServedClock
        The clock of the laboratory.
    baudrate : float
        Speed of the line where the client sets none, Bd; inf for bytes that take no time.
    """

    def __init__(self, end: End, stream: Stream, clock: ServedClock, baudrate: float) -> None:
        self.end = end
        self.stream = stream
        self.is_over = False
        self._clock = clock
        self._baudrate = baudrate
        self._arriving: deque[tuple[float, bytes]] = deque()
        self._leaving: deque[tuple[float, bytes]] = deque()
        self._arrived_at = self._left_at = -math.inf
        self._blocked: Stopwatch | None = None

    @property
    def takes_bytes(self) -> bool:
        """Whether there is room for more from the client."""
        return not self.is_over and sum(len(data) for _, data in self._arriving) < _MOST_BYTES and self.has_room

    @property
    def has_room(self) -> bool:
        """Whether there is room for more to the client."""
        return sum(len(data) for _, data in self._leaving) < _MOST_BYTES

    @property
    def is_leaving(self) -> bool:
        """Whether something is on its way to the client."""
        return bool(self._leaving)

    @property
    def is_blocked(self) -> bool:
        """Whether the client does not read what is due."""
        return self._blocked is not None

    def next_due(self) -> float:
        """Return the laboratory time (s) at which bytes arrive or leave next; infinity if none are on their way."""
        arriving = max(self._arriving[0][0], self._clock.now()) if self._arriving and self.has_room else math.inf
        leaving = self._leaving[0][0] if self._leaving and self._blocked is None else math.inf
        return min(arriving, leaving)

    def read(self) -> None:
        """Take what the client has sent."""
        data = self.end.read()
        if data is None:
            return
        if not data:
            self.is_over = True
            return
        self._arrived_at = max(self._clock.now(), self._arrived_at) + self._duration(data)
        self._arriving.append((self._arrived_at, data))

    def serve(self) -> Iterator[bytes]:
        """Hand over what has arrived, piece by piece, and yield each answer; stop while the clock is ahead."""
        while self._arriving and self.has_room and not self._clock.is_ahead:
            instant, data = self._arriving[0]
            if instant > self._clock.now():
                break
            piece, rest = data[:_SLICE], data[_SLICE:]
            if rest:
                self._arriving[0] = instant, rest
            else:
                self._arriving.popleft()
            try:
                answer = self.stream.receive(piece)
            except (FramingError, ConnectionResetError):
                self.is_over = True
                break
            if answer:
                yield answer

    def send(self, data: bytes) -> None:
        """Put bytes on their way to the client."""
        self._left_at = max(self._clock.now(), self._left_at) + self._duration(data)
        self._leaving.append((self._left_at, data))

    def lose(self) -> None:
        """Lose all that is on its way."""
        self._arriving.clear()
        self._leaving.clear()
        self._blocked = None

    def flush(self) -> None:
        """Deliver what is due; what a terminal's client does not read for a second is lost."""
        while self._leaving and self._leaving[0][0] <= self._clock.paced:
            instant, data = self._leaving[0]
            try:
                count = self.end.write(data)
            except OSError:
                self.is_over = True
                return
            if count == len(data):
                self._leaving.popleft()
                self._blocked = None
                continue
            self._leaving[0] = instant, data[count:]
            if self._blocked is None or count:
                self._blocked = Stopwatch()
            if self._blocked.seconds() > _UNREAD_SECONDS and isinstance(self.end, PseudoTerminal):
                self.end.forget_unread()
                self._leaving.clear()
                self._blocked = None
            return

    def close(self) -> None:
        """Close both ends."""
        self.end.close()
        close = getattr(self.stream, "close", None)
        if close is not None:
            close()

    def _duration(self, data: bytes) -> float:
        if math.isinf(self._baudrate):
            return 0.0
        return len(data) * _BITS_PER_BYTE / (self.end.baudrate or self._baudrate)


class Line:
    """The line of one instrument, with its clients.

    Parameters
    ----------
    name : str
        Name of the instrument in the laboratory.
    server : WireServer or ModbusTcpInstrument
        The instrument's side: of a serial line, or of one on TCP.
    end : PseudoTerminal or Listener
        Where clients come in.
    clock : ServedClock
        The clock of the laboratory.
    baudrate : float
        Speed of a serial line where the client sets none, Bd; inf for bytes that take no time.

    Attributes
    ----------
    cable : Cable
        The state of the line.
    """

    def __init__(
        self,
        name: str,
        server: WireServer | ModbusTcpInstrument,
        end: PseudoTerminal | Listener,
        clock: ServedClock,
        baudrate: float,
    ) -> None:
        self.name = name
        self.cable = Cable.WHOLE
        self._server = server
        self._clock = clock
        self._baudrate = baudrate
        self._corrupt_next = self._drop_next = False
        self._listener = end if isinstance(end, Listener) else None
        self._channels: list[Channel] = []
        if isinstance(end, PseudoTerminal):
            self._channels.append(self._channel(end))
            self.address = end.path
        else:
            self.address = socket_address("socket" if isinstance(server, WireServer) else "tcp", end.address)

    def watched(self) -> Iterator[tuple[Watched, int]]:
        """Yield what to wait on, and for what."""
        if self.cable is Cable.HANGING:
            return
        if self._listener is not None:
            yield self._listener, selectors.EVENT_READ
        for channel in self._channels:
            wanted = selectors.EVENT_READ * channel.takes_bytes | selectors.EVENT_WRITE * channel.is_blocked
            if wanted:
                yield channel.end, wanted

    def next_due(self) -> float:
        """Return the laboratory time (s) at which there is something to do; infinity if nothing is known."""
        if self.cable is Cable.HANGING:
            return math.inf
        by_itself = self._server.next_unsolicited() if isinstance(self._server, WireServer) else math.inf
        return min((by_itself, *(channel.next_due() for channel in self._channels)))

    def serve(self, ready: Collection[Watched]) -> None:
        """Take what has arrived, let the instrument answer, and deliver what is due; never waits."""
        if self.cable is Cable.HANGING:
            return
        for channel in self._channels:
            if channel.end in ready:
                channel.read()
            for answer in channel.serve():
                self._send(channel, answer)
        # Without a client, or with one that does not read, nobody hears it.
        if isinstance(self._server, WireServer) and (unsolicited := self._server.unsolicited()):
            for channel in self._channels:
                if channel.has_room:
                    self._send(channel, unsolicited)
        for channel in self._channels:
            channel.flush()
        if self.cable is Cable.CUT and not any(channel.is_leaving for channel in self._channels):
            self._lose_connections()
        self._drop(channel for channel in self._channels if channel.is_over)
        if self._listener is not None and self._listener in ready:
            self._accept(self._listener)

    def break_off(self, cable: Cable) -> None:
        """Bring the line into another state; what is on its way is lost unless it only hangs."""
        self.cable = cable
        if cable is Cable.UNPLUGGED:
            for channel in self._channels:
                channel.lose()

    def mend(self) -> None:
        """Make the line whole; answers that a hanging one owes are given now."""
        self.cable = Cable.WHOLE
        self._corrupt_next = self._drop_next = False

    def corrupt_next_answer(self) -> None:
        """Flip a bit of the next answer."""
        self._corrupt_next = True

    def drop_next_answer(self) -> None:
        """Lose the next answer; the instrument has acted all the same."""
        self._drop_next = True

    def restart(self) -> None:
        """Lose what is on its way, and connections on TCP: the instrument has lost its power."""
        if isinstance(self._server, WireServer):
            for channel in self._channels:
                channel.lose()
        else:
            self._lose_connections()

    def close(self) -> None:
        """Close every end; ports and paths are free again."""
        if self._listener is not None:
            self._listener.close()
        for channel in self._channels:
            channel.close()
        self._channels.clear()

    def _channel(self, end: PseudoTerminal | Connection) -> Channel:
        if isinstance(self._server, WireServer):
            return Channel(end, self._server, self._clock, self._baudrate)
        return Channel(end, self._server.connect(), self._clock, math.inf)

    def _send(self, channel: Channel, answer: bytes) -> None:
        if self.cable in (Cable.UNPLUGGED, Cable.CUT):
            return
        if self._drop_next:
            self._drop_next = False
            return
        if self._corrupt_next:
            self._corrupt_next = False
            middle = len(answer) // 2
            answer = answer[:middle] + bytes((answer[middle] ^ 1,)) + answer[middle + 1 :]
        if self.cable is Cable.CUTTING:
            self.cable = Cable.CUT
            answer = answer[: len(answer) // 2]
        channel.send(answer)

    def _accept(self, listener: Listener) -> None:
        """Let the next client in, or turn it away if there are as many as the instrument takes."""
        accepted = listener.accept()
        if accepted is None:
            return
        # A client that reconnects has gone before it came, even if nothing was read of it since.
        self._drop(
            channel for channel in self._channels if isinstance(channel.end, Connection) and channel.end.is_over
        )
        try:
            if self.cable is Cable.CUT or (isinstance(self._server, WireServer) and self._channels):
                raise ConnectionRefusedError
            self._channels.append(self._channel(accepted))
        except ConnectionRefusedError:
            accepted.reset()

    def _drop(self, channels: Iterable[Channel]) -> None:
        for channel in [*channels]:
            self._channels.remove(channel)
            channel.close()

    def _lose_connections(self) -> None:
        for channel in self._channels:
            if isinstance(channel.end, Connection):
                channel.end.reset()
        self._drop(channel for channel in self._channels if isinstance(channel.end, Connection))
