"""Starts the guardian and gives it one end of the channel."""

from __future__ import annotations

import os
import secrets
import socket
import subprocess
import sys
from collections.abc import Sequence
from typing import BinaryIO

from bench.base import GuardianError
from bench.execution.guardian.channel import Channel

_START = 30.0
"""Longest wait for a guardian to connect, s, where a descriptor cannot be inherited."""

_GUARDIAN = "bench.execution.guardian"

_WINDOWS = sys.platform == "win32"


def start_guardian(log: BinaryIO) -> tuple[subprocess.Popen[bytes], Channel]:
    """Start a guardian in a session of its own; return the process and the bench's end of the channel.

    What fails before it can answer is written to `log`, not to where the bench writes: who reads there would wait
    for the end of the guardian as well.

    Raises GuardianError if it does not start.
    """
    if _WINDOWS:
        return _start_by_port(log)
    ours, theirs = socket.socketpair()
    with theirs:
        process = start_module(_GUARDIAN, str(theirs.fileno()), stderr=log, pass_fds=(theirs.fileno(),))
    return process, Channel(ours)


def inherited(arguments: Sequence[str]) -> socket.socket:
    """Return the guardian's end of the channel from its command line: a descriptor, or a port and a token."""
    if len(arguments) == 1:
        return socket.socket(fileno=int(arguments[0]))
    connection = socket.create_connection(("127.0.0.1", int(arguments[0])), timeout=_START)
    connection.sendall(arguments[1].encode())
    return connection


def _start_by_port(log: BinaryIO) -> tuple[subprocess.Popen[bytes], Channel]:
    """Start a guardian that connects to a port of this process, as Windows hands sockets on to no child by itself."""
    token = secrets.token_hex(16)
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(_START)
        process = start_module(_GUARDIAN, str(server.getsockname()[1]), token, stderr=log)
        try:
            while True:
                connection, _ = server.accept()
                connection.settimeout(_START)
                # Another program may connect first.
                if connection.recv(len(token), socket.MSG_WAITALL) == token.encode():
                    return process, Channel(connection)
                connection.close()
        except OSError as error:
            process.kill()
            raise GuardianError(f"the guardian does not start: {error}") from None


def start_module(
    module: str,
    *arguments: str,
    stdin: int = subprocess.DEVNULL,
    stderr: BinaryIO | None = None,
    pass_fds: Sequence[int] = (),
) -> subprocess.Popen[bytes]:
    """Start a module of the bench in a process with a session of its own.

    `arguments` are those of its command line, `stdin` is as of `subprocess.Popen`, to `stderr` goes what goes wrong
    (where this process writes it if not given), and `pass_fds` are descriptors that it gets. Raises GuardianError if
    it cannot be started.
    """
    # The modules of the rig have to be found as here; -P keeps the working folder out of the way of ours.
    path = os.pathsep.join(entry for entry in sys.path if entry)
    flags = 0
    if sys.platform == "win32":
        flags = subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW
    try:
        return subprocess.Popen(  # noqa: S603 - this interpreter
            [sys.executable, "-P", "-m", module, *arguments],
            stdin=stdin,
            stdout=subprocess.DEVNULL,
            stderr=stderr,
            env={**os.environ, "PYTHONPATH": path},
            pass_fds=pass_fds,
            bufsize=0,
            start_new_session=True,
            creationflags=flags,
        )
    except OSError as error:
        raise GuardianError(f"the process {module} cannot be started: {error}") from None
