"""pymodbus behind the calls of `drivers.modbus.ModbusClient`, for real lines."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from pymodbus.exceptions import ConnectionException, ModbusException, ModbusIOException
from pymodbus.pdu import ModbusPDU

from drivers.modbus import (
    FEEDBACK,
    LONGEST_REPLY,
    SHORTEST_REPLY,
    ModbusClient,
    NoReplyError,
    RefusedError,
    UnexpectedReplyError,
    crc16,
    is_reply_to,
    reply_length,
)
from drivers.serial_line import MOST_STRAY, SerialSettings, settle_line


class _Request(ModbusPDU):
    """Any request, for pymodbus to frame and send."""

    def __init__(self, request: bytes, unit: int) -> None:
        super().__init__(dev_id=unit)
        self.function_code = request[0]
        self._body = request[1:]

    def encode(self) -> bytes:
        """Return what follows the function."""
        return self._body


class PymodbusClient(ModbusClient):
    """A client of pymodbus that is connected.

    Parameters
    ----------
    client : pymodbus.client.ModbusTcpClient or pymodbus.client.ModbusSerialClient
        The client; it must not repeat requests.
    unit : int
        Unit identifier or address of the instrument.
    """

    def __init__(self, client: ModbusTcpClient | ModbusSerialClient, unit: int) -> None:
        self._client = client
        self._unit = unit
        self._closed = False

    def request(self, request: bytes, expected: int) -> bytes:
        """Send a request, from its function on, and return its reply, of an `expected` number of bytes.

        Raises `NoReplyError` or `UnexpectedReplyError`, besides what the base class says.
        """
        if self._closed:
            # pymodbus would open the line again by itself.
            raise ConnectionError("the line is closed")
        try:
            response = self._client.execute(False, _Request(request, self._unit))
        except ModbusIOException as error:
            raise NoReplyError(str(error)) from error
        except ModbusException as error:
            raise ConnectionError(error.string) from error
        if response.isError():
            raise RefusedError(response.exception_code)
        function = response.function_code
        # What another function answers may not be written again as it was read.
        reply = request[:1] + response.encode() if function == request[0] else b""
        if len(reply) != expected:
            raise UnexpectedReplyError(request, expected, function, len(reply))
        return reply

    def wait_for(self, seconds: float) -> None:
        """Wait so long for a reply from now on, s."""
        self._client.comm_params.timeout_connect = seconds

    def close(self) -> None:
        """Release the line; may be called again. A request after it raises ConnectionError."""
        self._closed = True
        self._client.close()  # type: ignore[no-untyped-call]

    @property
    def is_open(self) -> bool:
        """Whether the line can be used."""
        return self._client.is_socket_open()


class _Feedback(ModbusPDU):
    """The reply to LabJack's function 76."""

    function_code = FEEDBACK
    values = b""

    def encode(self) -> bytes:
        """Return what follows the function."""
        return self.values

    def decode(self, data: bytes) -> None:
        """Keep what follows the function."""
        self.values = data


def connect_tcp(host: str, port: int, timeout: float, unit: int) -> PymodbusClient:
    """Return a client of Modbus TCP that is connected, and knows LabJack's function 76; timeout in s.

    Raises ConnectionError if there is no connection.
    """
    # TCP repeats lost packets by itself: repeating a request would only delay the report of a dead device.
    client = ModbusTcpClient(host, port=port, timeout=timeout, retries=0)
    client.register(_Feedback)
    if not client.connect():  # type: ignore[no-untyped-call]
        raise ConnectionError
    return PymodbusClient(client, unit)


class SerialClient(PymodbusClient):
    """pymodbus's client of a serial line to one instrument.

    Parameters
    ----------
    port : serial.SerialBase
        The open port.
    settings : SerialSettings
        Its address, speed and timeout.
    unit : int
        Address of the instrument, 1 to 247.
    parity : str
        N, E or O.
    """

    def __init__(self, port: Any, settings: SerialSettings, unit: int, parity: str) -> None:  # noqa: ANN401
        self._line = _BlockingClient(port, settings, parity)
        super().__init__(self._line, unit)

    def request(self, request: bytes, expected: int) -> bytes:
        """Send a request, from its function on, and return its reply; others are skipped.

        Raises `NoReplyError` or `UnexpectedReplyError`, besides what the base class says.
        """
        self._line.expect(request, expected)
        try:
            return super().request(request, expected)
        except NoReplyError as error:
            if (stray := self._line.stray) is not None:
                raise UnexpectedReplyError(request, expected, stray[1], len(stray) - 3) from None
            heard = self._line.heard
            raise NoReplyError(str(error), b"" if heard[:1] == bytes((self._unit,)) else heard) from error

    def settle(self, silence: float) -> None:
        """Discard what comes until nothing has come for `silence` seconds; raises `OSError` if that does not end."""
        try:
            self._line.settle(silence)
        except ConnectionException as error:
            raise ConnectionError(error.string) from error


class _BlockingClient(ModbusSerialClient):
    """pymodbus's client of a serial line, with a receiver that waits for bytes instead of looking for them.

    pymodbus looks whether bytes have come, sleeps for a millisecond or more, and looks again whether more have:
    two naps for each reply. The head of a reply says how long it is, so that the port itself can wait for
    exactly that, be it a serial port, a pseudo-terminal, a socket or an emulated line.
    """

    def __init__(self, port: Any, settings: SerialSettings, parity: str) -> None:  # noqa: ANN401
        # Sending again is left to the caller, which lets late replies pass first.
        super().__init__(
            settings.port, baudrate=settings.baudrate, parity=parity, timeout=settings.timeout, retries=0
        )
        self.socket: Any = port
        # Of the present request, from `expect` and `send` on.
        self._received: int
        self.heard = b""
        self._request: bytes
        self._expected: int
        self.stray: bytes | None = None

    def expect(self, request: bytes, expected: int) -> None:
        """Say what is asked for next, so that a late reply of another form can be skipped."""
        self._request, self._expected, self.stray = request, expected, None

    def connect(self) -> bool:
        """Return whether the line is open; a line that was lost stays closed."""
        return self.socket is not None

    def send(self, request: bytes, addr: tuple[Any, ...] | None = None) -> int:  # noqa: ARG002 - pymodbus's form
        """Send a request, and discard what came before it."""
        with self._line_errors():
            self._discard()
            self._received, self.heard = 0, b""
            sent: int = self.socket.write(request)
        return sent

    def recv(self, size: int | None) -> bytes:  # noqa: ARG002 - pymodbus's form
        """Wait for a reply, up to the timeout, and return what has come of it."""
        if self._received > LONGEST_REPLY:
            return b""  # it never becomes a reply
        reply = self._frame()
        while self._received <= LONGEST_REPLY and self._is_stray(reply):
            self.stray = reply
            reply = self._frame()
        return reply

    def _frame(self) -> bytes:
        with self._line_errors():
            reply: bytes = self.socket.read(SHORTEST_REPLY)
            if len(reply) == SHORTEST_REPLY and (missing := reply_length(reply) - SHORTEST_REPLY) > 0:
                reply += self.socket.read(missing)
        self._received += len(reply)
        self.heard += reply
        return reply

    def _is_stray(self, frame: bytes) -> bool:
        """Return whether this is a good reply, and none to the present request."""
        return (
            len(frame) >= SHORTEST_REPLY
            and crc16(frame[:-2]) == frame[-2:]
            and not is_reply_to(self._request, self._expected, frame)
        )

    def settle(self, silence: float) -> None:
        """Discard what comes until nothing has come for `silence` seconds."""
        with self._line_errors():
            settle_line(self.socket, silence)

    def _discard(self) -> None:
        # A socket says only that something is waiting, not how much; hence byte by byte at worst.
        for _ in range(MOST_STRAY):
            if not (waiting := self.socket.in_waiting):
                return
            self.socket.read(waiting)

    @contextmanager
    def _line_errors(self) -> Iterator[None]:
        """Turn what the port raises into what pymodbus raises."""
        if self.socket is None:
            raise ConnectionException("the line is closed")
        try:
            yield
        except OSError as error:
            self.close()  # type: ignore[no-untyped-call]
            raise ConnectionException(str(error)) from error
