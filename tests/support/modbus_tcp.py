"""A Modbus TCP instrument on a loopback port, served by threads of this process."""

import socket
import socketserver
import threading
from contextlib import suppress

from sim_devices.wire.modbus_tcp import FramingError, ModbusTcpInstrument


class ModbusTcpServer(socketserver.ThreadingTCPServer):
    """Serves a bank of registers at `address`, within a `with` statement, to the clients that it takes."""

    allow_reuse_address = True

    def __init__(self, bank, port=0):
        self._instrument = ModbusTcpInstrument(bank)
        self._streams = {}
        super().__init__(("127.0.0.1", port), None)
        self.port = self.server_address[1]
        self.address = f"tcp://127.0.0.1:{self.port}"

    def __enter__(self):
        threading.Thread(target=self.serve_forever, args=(0.01,)).start()
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        """Drop all clients and stop listening; may be called again."""
        self.shutdown()
        for client in list(self._streams):
            with suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)
        self.server_close()

    def verify_request(self, client, _address):
        """Let a client in before the next one; one more than the instrument takes is hung up on."""
        try:
            self._streams[client] = self._instrument.connect()
        except ConnectionRefusedError:
            return False
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return True

    def finish_request(self, client, _address):
        """Serve a client, in a thread of its own, until either end hangs up."""
        stream = self._streams[client]
        with suppress(OSError, FramingError):
            while data := client.recv(4096):
                client.sendall(stream.receive(data))
        stream.close()
        del self._streams[client]
