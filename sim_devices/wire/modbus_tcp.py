"""Modbus TCP as LabJack speaks it, for any emulated instrument that is a bank of registers.

A small server of our own rather than pymodbus's, which was tried in its version 3.16: of several requests in
one segment it answers the first only, and after a frame with a foreign protocol identifier it keeps waiting
with the bytes in its buffer, so that the client is no longer served and gets no error. It also shares its framing
with the client that the drivers use, where a misunderstanding would hide on both ends of the wire. A round
trip takes 0.03 to 0.1 ms, no more than with that server. One thread serves all clients in turn: no event
loop, nothing to leak.

Sources: MODBUS Application Protocol Specification V1.1b3; MODBUS Messaging on TCP/IP Implementation Guide
V1.0b, section 3.1 (MBAP header).
"""

from __future__ import annotations

import selectors
import socket
import struct
import threading
from collections.abc import Callable
from types import TracebackType

from sim_devices.wire.modbus import FEEDBACK, RegisterBank, answer, feedback

_HEADER = struct.Struct(">HHHB")  # transaction, protocol (0), bytes that follow, unit
_MOST_BYTES = 1034  # unit identifier and the longest PDU of a T7, whose packets have up to 1040 bytes
_FUNCTIONS = {FEEDBACK: feedback}


class FramingError(Exception):
    """The bytes are no Modbus TCP, and where the next frame begins cannot be known."""


class ModbusTcpInstrument:
    """An instrument on TCP that accepts a few connections at a time.

    Parameters
    ----------
    bank : RegisterBank
        The instrument.
    connections : int
        How many connections it accepts: a T7 two on port 502 (T-series datasheet, 6.0 Ethernet). That it refuses one
        more, and does not end the oldest instead, is an assumption.
    """

    def __init__(self, bank: RegisterBank, *, connections: int = 2) -> None:
        self.bank = bank
        self._most = connections
        self._open: list[ModbusTcpStream] = []

    def connect(self) -> ModbusTcpStream:
        """Open a connection.

        Raises `ConnectionRefusedError` if as many as the instrument accepts are open.
        """
        if len(self._open) >= self._most:
            raise ConnectionRefusedError(f"connection refused: the instrument has {self._most} open already")
        stream = ModbusTcpStream(self.bank, self._open.remove)
        self._open.append(stream)
        return stream


class ModbusTcpStream:
    """The instrument's end of one connection: bytes in, bytes out.

    Parameters
    ----------
    closed : callable
        Called once with the connection when it ends.
    """

    def __init__(self, bank: RegisterBank, closed: Callable[[ModbusTcpStream], None] = lambda _: None) -> None:
        self._bank = bank
        self._closed = closed
        self._received = b""
        self._is_open = True

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the client, in pieces of any size; return the replies to whole frames.

        Raises
        ------
        FramingError
            If the header is not one of Modbus; the connection is closed.
        ConnectionResetError
            If the connection is closed.
        """
        if not self._is_open:
            raise ConnectionResetError("the connection is closed")
        received = self._received + data if self._received else data
        replies = b""
        begin, size = 0, len(received)
        while size - begin >= _HEADER.size:
            transaction, protocol, length, unit = _HEADER.unpack_from(received, begin)
            if protocol != 0 or not 2 <= length <= _MOST_BYTES:
                self.close()
                raise FramingError(f"protocol {protocol}, length {length}")
            end = begin + _HEADER.size + length - 1
            if size < end:
                break
            reply = answer(self._bank, received[begin + _HEADER.size : end], _FUNCTIONS)
            # Any unit is echoed: a device on TCP is addressed by its port.
            replies += _HEADER.pack(transaction, 0, len(reply) + 1, unit) + reply
            begin = end
        self._received = received[begin:]
        return replies

    def close(self) -> None:
        """End the connection; may be called again."""
        if self._is_open:
            self._is_open = False
            self._closed(self)


class ModbusTcpServer:
    """Serves an emulated instrument to as many clients as it accepts; it closes the connection of one more.

    Parameters
    ----------
    port : int
        Port to listen on; 0 lets the system choose.

    Notes
    -----
    `start` and `close` may be called by a `with` statement. A request that makes the instrument wait, such as
    a burst of conversions, makes the other clients wait too, as it does on the instruments themselves.
    """

    _SEND_TIMEOUT = 1.0  # a client that does not read its replies for so long is dropped

    def __init__(self, bank: RegisterBank, *, port: int = 0) -> None:
        self._instrument = ModbusTcpInstrument(bank)
        self._port = port
        self._thread: threading.Thread | None = None

    @property
    def address(self) -> str:
        """Where clients connect, as `tcp://127.0.0.1:PORT`."""
        return f"tcp://127.0.0.1:{self._port}"

    @property
    def port(self) -> int:
        """The port, 0 before `start` if the system is to choose."""
        return self._port

    def start(self) -> ModbusTcpServer:
        """Listen and serve; clients can connect when this returns.

        Raises
        ------
        RuntimeError
            If the server runs already.
        OSError
            If the port is taken.
        """
        if self._thread is not None:
            raise RuntimeError(f"the server at {self.address} runs already")
        self._listener = socket.create_server(("127.0.0.1", self._port))
        self._port = self._listener.getsockname()[1]
        self._waker, wakened = socket.socketpair()
        self._thread = threading.Thread(
            target=self._serve, args=(self._listener, wakened), name=f"modbus {self._port}", daemon=True
        )
        self._thread.start()
        return self

    def close(self) -> None:
        """Drop all clients and stop listening; nothing is left when this returns. May be called again."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._waker.close()
            thread.join()

    def __enter__(self) -> ModbusTcpServer:
        return self.start()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _serve(self, listener: socket.socket, wakened: socket.socket) -> None:
        clients: dict[socket.socket, ModbusTcpStream] = {}
        with selectors.DefaultSelector() as selector, listener, wakened:
            selector.register(listener, selectors.EVENT_READ)
            selector.register(wakened, selectors.EVENT_READ)
            while True:
                for key, _ in selector.select():
                    ready = key.fileobj
                    if ready is wakened:
                        for client, stream in clients.items():
                            client.close()
                            stream.close()
                        return
                    if ready is listener:
                        self._accept(listener, selector, clients)
                        continue
                    assert isinstance(ready, socket.socket)
                    if not self._exchange(ready, clients[ready]):
                        selector.unregister(ready)
                        clients.pop(ready).close()
                        ready.close()

    def _accept(
        self,
        listener: socket.socket,
        selector: selectors.BaseSelector,
        clients: dict[socket.socket, ModbusTcpStream],
    ) -> None:
        try:
            client, _ = listener.accept()
        except OSError:
            return  # the client went away before it was let in
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.settimeout(self._SEND_TIMEOUT)
        try:
            clients[client] = self._instrument.connect()
        except ConnectionRefusedError:
            client.close()
            return
        selector.register(client, selectors.EVENT_READ)

    @staticmethod
    def _exchange(client: socket.socket, stream: ModbusTcpStream) -> bool:
        """Serve what has arrived; return whether the connection goes on."""
        try:
            data = client.recv(4096)
            if data:
                client.sendall(stream.receive(data))
        except (OSError, FramingError):
            return False
        return bool(data)
