"""Round trips to served instruments from another process, beside a server that only echoes."""

import os
import socket
import statistics
import subprocess
import sys
import tty
from contextlib import contextmanager

import pytest
import serial

from bench.base import Stopwatch
from sim_devices.serving.process import serve

ROUND_TRIPS = 2000
PATIENCE = 60.0

REQUESTS = {
    ("vo2", "tec"): (b"#0115AB?VR03E801B97B\r", 20),
    ("sma", "stage"): (bytes.fromhex("fffffd00 01 0700 02 8400 0400 1d15"), 15),
    ("sma", "load_cell"): (bytes.fromhex("01 03 3500 0005 8a05"), 15),
    ("sma", "supply"): (b"t6018400D210300000000\r", 24),
}
"""A reading of each instrument, and the bytes of its answer: temperature, position, weights, voltage."""

ECHO = """
import os, sys
while True:
    os.write(int(sys.argv[1]), os.read(int(sys.argv[1]), 4096))
"""


@contextmanager
def echoing_terminal():
    master, slave = os.openpty()
    for end in (master, slave):
        tty.setraw(end)
    server = subprocess.Popen([sys.executable, "-c", ECHO, str(master)], pass_fds=(master,))
    try:
        yield os.ttyname(slave)
    finally:
        server.terminate()
        server.wait()
        os.close(master)
        os.close(slave)


def round_trips(path, request, length, *, before=b""):
    """Return the wall-clock times of round trips, ms."""
    times = []
    with serial.Serial(path, 115_200, timeout=PATIENCE) as line:
        if before:
            line.write(before)
            line.read_until(before[-1:])
            line.timeout = 0.5
            line.read(1000)
            line.timeout = PATIENCE
        for _ in range(ROUND_TRIPS):
            watch = Stopwatch()
            line.write(request)
            answer = line.read(length)
            times.append(1e3 * watch.seconds())
            assert len(answer) == length
    return times[ROUND_TRIPS // 10 :]


def round_trips_over_tcp(url):
    """Return those of a Modbus TCP client that reads PRODUCT_ID, ms."""
    host, port = url.removeprefix("tcp://").rsplit(":", 1)
    times = []
    with socket.create_connection((host, int(port)), PATIENCE) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for _ in range(ROUND_TRIPS):
            watch = Stopwatch()
            connection.sendall(bytes.fromhex("0001 0000 0006 01 03 ea60 0002"))
            answer = connection.recv(100)
            times.append(1e3 * watch.seconds())
            assert len(answer) == 13
    return times[ROUND_TRIPS // 10 :]


def said(name, times):
    median, last = statistics.median(times), statistics.quantiles(times, n=100)[98]
    return f"{name:14} median {median:6.3f} ms, 99th percentile {last:6.3f} ms"


@pytest.mark.benchmark
def test_round_trips_between_two_processes(capsys):
    lines = []
    with echoing_terminal() as path:
        lines.append(said("echo", round_trips(path, b"x" * 20, 20)))
    for rig_name in ("vo2", "sma"):
        with serve(rig_name, clock="x1") as rig:
            for (of_rig, instrument), (request, length) in REQUESTS.items():
                if of_rig != rig_name:
                    continue
                # The adapter is opened, and the heartbeat is off: it would stand between the answers.
                before = b"\rC\rS4\rO\rt60182B17100000000000\r" if instrument == "supply" else b""
                lines.append(said(instrument, round_trips(rig.port(instrument), request, length, before=before)))
            if rig_name == "sma":
                lines.append(said("t7 over TCP", round_trips_over_tcp(rig.port("t7"))))
    with capsys.disabled():
        print(
            "\nRound trips between two processes, of serial lines over a pseudo-terminal (goal: median of 1 ms)",
            *lines,
            sep="\n",
        )
