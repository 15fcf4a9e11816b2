"""An slcan adapter on a serial line: python-can opens and closes its channel; frames pass as lines of text.

Several nodes share an adapter: it is opened once, and a frame goes to the node whose number ends its identifier.

Sources: LAWICEL CAN232 manual V3; CiA 301, 7.3.5, for the identifiers of a node.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from can import CanError
from can.interfaces.slcan import slcanBus

from drivers.serial_line import (
    OpenPort,
    SerialSettings,
    Share,
    cannot_open,
    longest_wait,
    patience_of,
    patient,
    shared_port,
)

_MOST_READS = 4096
_LONGEST_LINE = 64
_NODE = 0x7F  # bits of an identifier that are the number of its node
_ACKNOWLEDGEMENTS = frozenset((b"z\r", b"z\rz\r", b"\r"))
_BEGINNINGS = b"tTrRzZVNF"
"""How lines of an adapter begin. Source: LAWICEL CAN232 manual V3, commands."""


class SlcanAdapter(slcanBus):
    """The slcan adapter of python-can, in lines instead of messages, which reads what has arrived, not byte by byte.

    The only wait is the port's own, so the port decides which clock it uses, and how long a busy computer waits. An
    empty read means silence for the whole wait. Adapters differ in how they acknowledge a line: by a carriage
    return, by a line feed, or not at all. So an acknowledgement is not waited for.

    Raises `DeviceConnectionError` if it cannot be opened.

    Attributes
    ----------
    refusals : int
        How often the adapter has answered with BEL since it was opened.
    strange : bytes
        What came last that is no line of an adapter.
    transmit : callable
        Sends a line, which has its end.
    inboxes : dict of int to deque
        The lines that have come for each node of several that share it.
    """

    transmit: Callable[[bytes], object]

    def __init__(self, device: str, settings: SerialSettings, bitrate: int) -> None:
        self.refusals = 0
        self.strange = b""
        self.inboxes: dict[int, deque[bytes]] = {}
        self._lines: deque[bytes] = deque()
        self._rest = b""
        self._settings = settings
        try:
            super().__init__(
                settings.port,
                tty_baudrate=settings.baudrate,
                bitrate=bitrate,
                sleep_after_open=0,
                timeout=settings.timeout,
            )
        except BaseException as error:
            self._abandon()
            if isinstance(error, CanError | OSError | ValueError):
                raise cannot_open(device, settings.port, error) from None
            raise
        # An echo is a frame of the host's, which is nobody's here.
        self._port = patient(self.serialPortOrig, settings)
        self.transmit = self._port.write

    @property
    def patience(self) -> float:
        """How long an answer is waited for at present, s."""
        return patience_of(self._port, self._settings)

    def line(self) -> bytes | None:
        """Return the next line with a standard data frame, without its end; None after silence for the timeout."""
        lines = self._lines
        for _ in range(_MOST_READS):
            if lines:
                return lines.popleft()
            received = self._arrived() or self._port.read(1)
            if not received:
                return None
            self._take(received)
        return None

    def lines(self) -> list[bytes]:
        """Return the lines with a standard data frame that have arrived, without their ends."""
        received = self._arrived()
        if received and (self._rest or received not in _ACKNOWLEDGEMENTS):
            self._take(received)
        if not self._lines:
            return []
        lines = [*self._lines]
        self._lines.clear()
        return lines

    def matched(self, pattern: re.Pattern[bytes]) -> tuple[bytes, ...]:
        """Return the groups of all that has arrived, if it has this form; none otherwise, and `line` returns it."""
        if self._lines or self._rest:
            return ()
        received = self._arrived()
        found = pattern.fullmatch(received)
        if found is not None:
            return found.groups()
        self._take(received)
        return ()

    def release(self) -> None:
        """Close the channel and the port, in any state."""
        with suppress(CanError, OSError):
            self.shutdown()
        self._abandon()

    def _write(self, string: str) -> None:
        """Send a line within the time-out; python-can's own waits for the last byte, however long it takes."""
        port = self.serialPortOrig
        if port.write_timeout is None:
            port.write_timeout, port.exclusive = longest_wait(self._settings), True
        port.write(string.encode() + self.LINE_TERMINATOR)

    def _abandon(self) -> None:
        port = getattr(self, "serialPortOrig", None)
        if port is not None:
            port.close()

    def _arrived(self) -> bytes:
        try:
            received: bytes = self._port.read_all()
        except OSError:
            raise
        except Exception as error:  # pyserial passes on those of a port that is closed
            raise OSError(str(error)) from error
        return received

    def _take(self, received: bytes) -> None:
        """Divide what has come into lines, and keep those with a frame."""
        text = self._rest + received
        if b"\n" in text:
            text = text.replace(b"\n", b"\r")
        if b"\a" in text:
            self.refusals += text.count(b"\a")
            text = text.replace(b"\a", b"\r")
        *lines, rest = text.split(b"\r")
        self._rest = rest if len(rest) <= _LONGEST_LINE else b""
        self._lines.extend([line for line in lines if line[:1] == b"t"])
        self.strange = next((line for line in lines if line[:1] not in _BEGINNINGS), self.strange)


class NodePort(Share):
    """An adapter as one of the nodes behind it has it; it is used like the adapter itself."""

    def __init__(self, shared: OpenPort, device: str, node: int) -> None:
        super().__init__(shared, device)
        self._adapter: SlcanAdapter = shared.port
        self._inboxes = self._adapter.inboxes
        self._inbox: deque[bytes] = deque(maxlen=_MOST_READS)
        self._inboxes[node] = self._inbox

    @property
    def refusals(self) -> int:
        """How often the adapter has answered with BEL since it was opened."""
        return self._adapter.refusals

    @property
    def strange(self) -> bytes:
        """What came last that is no line of an adapter."""
        return self._adapter.strange

    @property
    def patience(self) -> float:
        """How long an answer is waited for at present, s."""
        return self._adapter.patience

    def transmit(self, line: bytes) -> None:
        """Send a line, which has its end."""
        with self._in_turn():
            self.requests += 1
            self._adapter.transmit(line)

    def line(self) -> bytes | None:
        """Return the next line with a standard data frame, empty if it is another node's; None after silence."""
        if self._inbox:
            return self._inbox.popleft()
        with self._in_turn():
            line = self._adapter.line()
        self._note(line)
        if line is None:
            return None
        self._deliver(line)
        return self._inbox.popleft() if self._inbox else b""

    def lines(self) -> list[bytes]:
        """Return the lines with a standard data frame of this node that have arrived."""
        with self._in_turn():
            for line in self._adapter.lines():
                self._deliver(line)
        found = [*self._inbox]
        self._inbox.clear()
        return found

    def matched(self, pattern: re.Pattern[bytes]) -> tuple[bytes, ...]:
        """Return the groups of all that has arrived, if it has this form; none otherwise, and `line` returns it."""
        if self._inbox:
            return ()
        with self._in_turn():
            return self._adapter.matched(pattern)

    def release(self) -> None:
        """Leave the adapter, in any state; its channel is closed with the last node."""
        self.close()

    def _deliver(self, line: bytes) -> None:
        # A damaged line, and what a node sends that is none of the rig, is nobody's.
        with suppress(ValueError, KeyError):
            self._inboxes[int(line[1:4], 16) & _NODE].append(line)


def open_adapter(device: str, settings: SerialSettings, bitrate: int, node: int) -> SlcanAdapter | NodePort:
    """Open the adapter of a node, or join those that share it; raises what `SlcanAdapter` raises."""
    if not settings.line:
        return SlcanAdapter(device, settings, bitrate)

    def open_it() -> tuple[SlcanAdapter, Callable[[], object]]:
        adapter = SlcanAdapter(device, settings, bitrate)
        return adapter, adapter.release

    return NodePort(shared_port(settings.port, device, open_it), device, node)
