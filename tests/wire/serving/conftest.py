"""Servers in processes of their own, and how clients talk to them."""

import json
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
import serial

from bench.base import Stopwatch

LONG = 60.0
"""Wall-clock time (s) that a busy machine may take for an answer."""


@pytest.fixture
def emulate(tmp_path):
    """Run `bench rig emulate` with any options; give its process and what it wrote to its endpoints file."""

    @contextmanager
    def run(*arguments, file=tmp_path / "endpoints.json"):
        command = [sys.executable, "-P", "-m", "bench", "rig", "emulate", *map(str, arguments), "--json", str(file)]
        with (tmp_path / "output.txt").open("ab") as output:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT)
        try:
            waited = Stopwatch()
            while not file.exists():
                try:
                    process.wait(0.05)
                except subprocess.TimeoutExpired:
                    assert waited.seconds() < 240.0, "the server was not ready in time"
                else:
                    pytest.fail((tmp_path / "output.txt").read_text())
            yield process, json.loads(Path(file).read_text())
        finally:
            process.terminate()
            process.wait(LONG)

    return run


@pytest.fixture
def opened():
    """Open a line as a client does; all are closed at the end."""
    lines = []

    def open_line(address, timeout=LONG, **options):
        lines.append(serial.serial_for_url(address, timeout=timeout, **options))
        return lines[-1]

    yield open_line
    for line in lines:
        line.close()


@pytest.fixture
def connect():
    """Connect to a TCP address as `tcp://127.0.0.1:PORT`; all connections are closed at the end."""
    import socket

    sockets = []

    def connect_to(address):
        host, port = address.partition("://")[2].rsplit(":", 1)
        sockets.append(socket.create_connection((host, int(port)), timeout=LONG))
        return sockets[-1]

    yield connect_to
    for each in sockets:
        each.close()
