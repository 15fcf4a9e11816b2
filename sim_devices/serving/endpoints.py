"""The server's ends of lines: pseudo-terminals, and TCP or Unix sockets. Nothing here waits."""

from __future__ import annotations

import os
import socket
import struct
import sys
from abc import ABC, abstractmethod
from contextlib import suppress
from pathlib import Path

_LARGEST_READ = 1024
HAS_PSEUDO_TERMINALS = hasattr(os, "openpty")


class End(ABC):
    """The server's end of one line."""

    @abstractmethod
    def fileno(self) -> int:
        """Return the descriptor to wait on."""

    @abstractmethod
    def read(self) -> bytes | None:
        """Return what has arrived; None if nothing has, and no bytes if the other end is gone."""

    @abstractmethod
    def write(self, data: bytes) -> int:
        """Send bytes; return how many were taken.

        Raises `OSError` if the other end is gone.
        """

    @abstractmethod
    def close(self) -> None:
        """Close it."""

    @property
    def baudrate(self) -> float | None:
        """Speed that the client has set, Bd; None if the line has none."""
        return None


class PseudoTerminal(End):
    """A serial port without hardware (POSIX): clients open `path`, one after the other.

    Raises OSError if the system has none left.
    """

    def __init__(self) -> None:
        import tty

        self._master, self._slave = os.openpty()
        # Raw before anybody opens it. This slave stays open: without it, a client that closes its own makes reads
        # from the master fail.
        tty.setraw(self._master)
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)

    def fileno(self) -> int:
        """Return the descriptor to wait on."""
        return self._master

    def read(self) -> bytes | None:
        """Return what has arrived, or None."""
        try:
            return os.read(self._master, _LARGEST_READ) or None
        except BlockingIOError:
            return None

    def write(self, data: bytes) -> int:
        """Send bytes; return how many the terminal has taken."""
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """Close both ends; the path is gone."""
        os.close(self._master)
        os.close(self._slave)

    @property
    def baudrate(self) -> float | None:
        """Speed that the client has set, Bd; None if it is none of the named ones."""
        import termios

        code = termios.tcgetattr(self._slave)[5]
        return _named_speeds().get(code)

    def forget_unread(self) -> None:
        """Drop what the client has not read; it must not reach the next client."""
        import termios

        termios.tcflush(self._slave, termios.TCIFLUSH)


def _named_speeds() -> dict[int, float]:
    import termios

    names = (name for name in dir(termios) if name.startswith("B") and name[1:].isdigit())
    return {getattr(termios, name): float(name[1:]) for name in names if name != "B0"}


class Connection(End):
    """An accepted connection."""

    def __init__(self, accepted: socket.socket) -> None:
        self._socket = accepted
        accepted.setblocking(False)
        if accepted.family != getattr(socket, "AF_UNIX", None):
            accepted.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            accepted.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)

    def fileno(self) -> int:
        """Return the descriptor to wait on."""
        return self._socket.fileno()

    def read(self) -> bytes | None:
        """Return what has arrived; None if nothing has, and no bytes if the client is gone."""
        try:
            return self._socket.recv(_LARGEST_READ)
        except BlockingIOError:
            return None
        except OSError:
            return b""

    def write(self, data: bytes) -> int:
        """Send bytes; return how many were taken."""
        try:
            return self._socket.send(data)
        except BlockingIOError:
            return 0

    @property
    def is_over(self) -> bool:
        """Whether the client has closed it and nothing is left to read."""
        try:
            return self._socket.recv(1, socket.MSG_PEEK) == b""
        except BlockingIOError:
            return False
        except OSError:
            return True

    def close(self) -> None:
        """Close it."""
        self._socket.close()

    def reset(self) -> None:
        """Close it at once: the client is told so by a reset, and what is under way is lost."""
        with suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _NO_LINGER)
        self._socket.close()


# Two shorts in winsock, two ints elsewhere.
_NO_LINGER = struct.pack("hh" if sys.platform == "win32" else "ii", 1, 0)


class Listener:
    """Accepts connections at an address.

    Parameters
    ----------
    address : tuple of (str, int), or Path
        Host and port of TCP, port 0 for one that the system chooses; or a Unix socket.

    Raises
    ------
    OSError
        If the address is taken or not of this machine.
    """

    def __init__(self, address: tuple[str, int] | Path) -> None:
        self._path: Path | None = None
        if isinstance(address, Path):
            self._socket = socket.socket(socket.AF_UNIX)
            try:
                self._socket.bind(str(address))
                self._socket.listen(16)
            except OSError:
                self._socket.close()
                raise
            self._path = address
        else:
            family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
            self._socket = socket.create_server(address, family=family, backlog=16)
        self._socket.setblocking(False)

    @property
    def address(self) -> tuple[str, int] | Path:
        """Where clients connect: host and port, or the path of a Unix socket."""
        if self._path is not None:
            return self._path
        host, port = self._socket.getsockname()[:2]
        return host, port

    def fileno(self) -> int:
        """Return the descriptor to wait on."""
        return self._socket.fileno()

    def accept(self) -> Connection | None:
        """Return the next connection, or None if nobody waits."""
        try:
            return Connection(self._socket.accept()[0])
        except OSError:
            return None  # nobody, or one who went away before

    def close(self) -> None:
        """Stop listening, and remove a Unix socket."""
        self._socket.close()
        if self._path is not None:
            self._path.unlink(missing_ok=True)


def socket_address(scheme: str, address: tuple[str, int] | Path) -> str:
    """Return an address as text: `tcp://127.0.0.1:5020`, `socket://[::1]:5020`, `unix:/run/bench.sock`."""
    if isinstance(address, Path):
        return f"unix:{address}"
    host, port = address
    return f"{scheme}://[{host}]:{port}" if ":" in host else f"{scheme}://{host}:{port}"
