"""What the tests of several drivers share: the class `Script` of a module at its `PORT`, and a TCP port."""

import socket
import threading
from contextlib import contextmanager

import pytest

from bench.base import VirtualClock
from sim_devices.protocol_emulated import register, unregister


@pytest.fixture
def clock():
    return VirtualClock()


@pytest.fixture
def script(request, clock):
    """The scripted instrument at the other end of a driver's line: the class `Script` of a module, at its `PORT`."""
    script, name = request.module.Script(), request.module.PORT.removeprefix("emulated://")
    register(name, script, clock)
    yield script
    unregister(name)


@contextmanager
def _tcp_port(server):
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve():
            while True:
                try:
                    connection, _ = listener.accept()
                except OSError:
                    return
                with connection:
                    while data := connection.recv(4096):
                        connection.sendall(server.receive(data))

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        try:
            yield listener.getsockname()[1]
        finally:
            # This wakes the thread on Linux; closing alone does elsewhere.
            try:
                listener.shutdown(socket.SHUT_RDWR)
            except OSError:
                listener.close()
            thread.join(10)


@pytest.fixture(scope="session")
def tcp_port():
    """Serve an instrument, one client at a time, on the TCP port whose number this context manager gives."""
    return _tcp_port
