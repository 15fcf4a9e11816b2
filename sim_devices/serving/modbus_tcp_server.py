"""One Modbus TCP instrument on a loopback port, served by a thread of this process: for tests of drivers."""

from __future__ import annotations

import selectors
import socket
import threading
from types import TracebackType

from sim_devices.wire.modbus import RegisterBank
from sim_devices.wire.modbus_tcp import FramingError, ModbusTcpInstrument, ModbusTcpStream


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
        except (OSError, FramingError):  # of the client, or of the instrument's end
            return False
        return bool(data)
