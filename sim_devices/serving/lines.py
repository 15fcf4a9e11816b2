"""The line of one served instrument: its clients, and the time that bytes take."""

from __future__ import annotations

import math
import selectors
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Protocol

from bench.base import Stopwatch
from sim_devices.serving.clock import ServedClock
from sim_devices.serving.endpoints import Connection, End, Listener, PseudoTerminal, socket_address
from sim_devices.wire import Stream, TcpServer, WireServer
from sim_devices.wire.modbus_tcp import FramingError

_BITS_PER_BYTE = 10  # 8N1: a start and a stop bit
_SLICE = 64  # bytes that are served at once, so that a flood of bursts moves the clock no further than a few of them
_MOST_BYTES = 4096  # that wait on either way
_UNREAD_SECONDS = 1.0  # of wall-clock time after which a terminal forgets what nobody reads


class Watched(Protocol):
    """What a selector waits on."""

    def fileno(self) -> int:
        """Return the descriptor."""


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
        self.is_ended = False
        """Whether the instrument has ended it; what it had sent is still delivered."""
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
        by_itself = self.stream.next_unsolicited() if self.has_room else math.inf
        return min(arriving, leaving, by_itself)

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
        while self._arriving and self.has_room and not (self._clock.is_ahead or self.is_ended):
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
                self.is_ended = True
                break
            if answer:
                yield answer

    def hear(self) -> None:
        """Put what the instrument sends without a request on its way."""
        if self.is_ended or not self.has_room:
            return
        try:
            sent = self.stream.unsolicited()
        except (FramingError, ConnectionResetError):
            self.is_ended = True
        else:
            if sent:
                self.send(sent)

    def send(self, data: bytes) -> None:
        """Put bytes on their way to the client."""
        self._left_at = max(self._clock.now(), self._left_at) + self._duration(data)
        self._leaving.append((self._left_at, data))

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
    server : WireServer or TcpServer
        The instrument's side: of a serial line, or of one on TCP.
    end : PseudoTerminal or Listener
        Where clients come in.
    clock : ServedClock
        The clock of the laboratory.
    baudrate : float
        Speed of a serial line where the client sets none, Bd; inf for bytes that take no time.
    is_cut : callable
        Whether the line is dead, so that connections to a serial one on TCP are ended and refused.
    """

    def __init__(
        self,
        name: str,
        server: WireServer | TcpServer,
        end: PseudoTerminal | Listener,
        clock: ServedClock,
        baudrate: float,
        is_cut: Callable[[], bool],
    ) -> None:
        self.name = name
        self._server = server
        self._clock = clock
        self._baudrate = baudrate
        self._is_cut = is_cut
        self._listener = end if isinstance(end, Listener) else None
        self._channels: list[Channel] = []
        if isinstance(end, PseudoTerminal):
            self._channels.append(self._channel(end))
            self.address = end.path
        else:
            self.address = socket_address("socket" if isinstance(server, WireServer) else "tcp", end.address)

    def watched(self) -> Iterator[tuple[Watched, int]]:
        """Yield what to wait on, and for what."""
        if self._listener is not None:
            yield self._listener, selectors.EVENT_READ
        for channel in self._channels:
            wanted = selectors.EVENT_READ * channel.takes_bytes | selectors.EVENT_WRITE * channel.is_blocked
            if wanted:
                yield channel.end, wanted

    def next_due(self) -> float:
        """Return the laboratory time (s) at which there is something to do; infinity if nothing is known."""
        return min((channel.next_due() for channel in self._channels), default=math.inf)

    def serve(self, ready: Collection[Watched]) -> None:
        """Take what has arrived, let the instrument answer, and deliver what is due; never waits."""
        for channel in self._channels:
            if channel.end in ready:
                channel.read()
            for answer in channel.serve():
                channel.send(answer)
            channel.hear()
        if not self._channels and isinstance(self._server, WireServer):
            # Without a client nobody hears it.
            self._server.unsolicited()
        for channel in self._channels:
            channel.flush()
            ended = channel.is_ended or (isinstance(self._server, WireServer) and self._is_cut())
            if ended and isinstance(channel.end, Connection) and not channel.is_leaving:
                channel.end.reset()
                channel.is_over = True
        self._drop(channel for channel in self._channels if channel.is_over)
        if self._listener is not None and self._listener in ready:
            self._accept(self._listener)

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
            if isinstance(self._server, WireServer) and (self._channels or self._is_cut()):
                raise ConnectionRefusedError
            self._channels.append(self._channel(accepted))
        except ConnectionRefusedError:
            accepted.reset()

    def _drop(self, channels: Iterable[Channel]) -> None:
        for channel in [*channels]:
            self._channels.remove(channel)
            channel.close()
