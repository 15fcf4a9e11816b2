"""Round trips to served instruments, from this process to another one."""

import struct
import time
from statistics import median

import pytest
import serial

from sim_devices.serving.process import serve

REQUESTS = {
    "stage": (bytes.fromhex("fffffd0001030001194e"), 14),
    "load_cell": (bytes.fromhex("010300000001840a"), 5),
    "supply": (b"V\r", 6),
}
"""A request of each serial line of `sma`, and the length of its answer at least."""


@pytest.mark.benchmark
def test_round_trips(capsys):
    """Median round trips, ms: over a pseudo-terminal and over TCP, wall-clock time."""
    import socket

    with serve("sma") as rig, capsys.disabled():
        print()
        for name, (request, length) in REQUESTS.items():
            with serial.Serial(rig.port(name), 57600, timeout=10) as line:

                def ask(line=line, request=request, length=length):
                    line.write(request)
                    assert len(line.read(length)) == length
                    line.read(line.in_waiting)

                print(f"{name:>10}: {measured(ask):.3f} ms on a pseudo-terminal")
        host, port = rig.port("t7").removeprefix("tcp://").rsplit(":", 1)
        with socket.create_connection((host, int(port))) as connection:

            def read():
                connection.sendall(struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 60000, 2))
                assert len(connection.recv(100)) == 13

            print(f"{'t7':>10}: {measured(read):.3f} ms over TCP")


def measured(ask, count=500):
    durations = []
    for _ in range(count):
        begin = time.perf_counter()
        ask()
        durations.append(1e3 * (time.perf_counter() - begin))
    return median(durations)
