"""Connections over Modbus TCP, which all devices of a process on one instrument share.

A LabJack T7 accepts two connections on port 502 (T-series datasheet, 6.0 Ethernet), and a rig has more devices on it.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import serial

from bench.base import DeferredModule
from bench.rig import EMULATED
from drivers.modbus import ModbusClient, TcpClient

if TYPE_CHECKING:
    from drivers import pymodbus_client
else:
    pymodbus_client = DeferredModule("drivers.pymodbus_client")

_UNIT = 1  # LabJack takes any


def _open_client(port: str, timeout: float) -> ModbusClient:
    if port.startswith(EMULATED):
        line: Any = serial.serial_for_url(port, timeout=timeout)
        return TcpClient(line, _UNIT)
    host, _, number = port.removeprefix("tcp://").rpartition(":")
    return pymodbus_client.connect_tcp(host.strip("[]"), int(number), timeout, _UNIT)


class Connection:
    """A connection to an instrument, in use by one or several devices; made by `share`.

    Attributes
    ----------
    lock : threading.RLock
        Held for each request, as devices may be read by several threads.
    timeout : float
        Longest wait for a reply, s: the longest that one of its devices asked for.
    ended : bool
        Whether it has been closed, for all its devices.
    """

    def __init__(self, port: str, timeout: float) -> None:
        self.lock = threading.RLock()
        self.client = _open_client(port, timeout)
        self.timeout = timeout
        self._port = port
        self._users = 0
        self.ended = False

    @property
    def has_one_user(self) -> bool:
        """Whether one device alone uses it."""
        return self._users == 1

    @property
    def is_open(self) -> bool:
        """Whether requests can be sent."""
        return self.client.is_open

    def close(self) -> None:
        """End the use by one device; the last one closes the connection."""
        with _registry:
            self._users -= 1
            is_last = self._users <= 0
            if is_last:
                self._leave_registry()
        if is_last:
            self._close_client()

    def end(self) -> None:
        """Close the connection for all its devices, after the request under way; each has to share another one."""
        self._leave_registry()
        self._close_client()

    def acquire(self) -> None:
        """Begin the use by one more device."""
        self._users += 1

    def wait_for_reply(self, timeout: float) -> None:
        """Wait for a reply so long at most from now on, s."""
        with self.lock:
            self.timeout = timeout
            self.client.wait_for(timeout)

    def _leave_registry(self) -> None:
        with _registry:
            self.ended = True
            if _connections.get(self._port) is self:
                del _connections[self._port]

    def _close_client(self) -> None:
        # Never within the registry: who holds this lock may be about to end the connection.
        with self.lock:
            self.client.close()


_registry = threading.RLock()
_connections: dict[str, Connection] = {}


def share(port: str, timeout: float) -> Connection:
    """Return the open connection of this process to an instrument, or open one.

    Parameters
    ----------
    port : str
        Address as `tcp://HOST:PORT` or `emulated://NAME`.
    timeout : float
        Longest wait for a connection or a reply, s; of devices that differ, the longest counts for all.

    Raises
    ------
    OSError
        If no connection can be made.
    """
    with _registry:
        connection = _connections.get(port)
        if connection is None or not connection.is_open:
            connection = _connections[port] = Connection(port, timeout)
        connection.acquire()
    if timeout > connection.timeout:
        connection.wait_for_reply(timeout)
    return connection
