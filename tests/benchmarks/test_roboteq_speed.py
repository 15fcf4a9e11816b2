"""Round trips of the Roboteq driver over a pseudo-terminal, beside those of the stock `canopen` client."""

import os
import statistics
import subprocess
import sys
import tty

import pytest

from bench.clock import Stopwatch, VirtualClock, WallClock
from drivers.roboteq import RoboteqSupply
from drivers.roboteq.supply import _VOLTS
from sim_devices.instruments.roboteq import EmulatedRoboteq
from sim_devices.protocol_emulated import register, unregister
from sim_devices.wire.canopen_slcan import CanopenSlcanServer
from sim_devices.world import World

ROUND_TRIPS = 1000
BATCHES = 5

SERVER = """
import os, sys
from bench.clock import WallClock
from sim_devices.instruments.roboteq import EmulatedRoboteq
from sim_devices.wire.canopen_slcan import CanopenSlcanServer
from sim_devices.world import World

class Nothing:
    current = 0.0
    def apply(self, voltage): pass
    def advance(self, dt): pass

end = int(sys.argv[1])
server = CanopenSlcanServer(EmulatedRoboteq("supply", World(Nothing(), WallClock()), Nothing()))
while True:
    os.write(end, server.receive(os.read(end, 4096)))
"""


class Nothing:
    current = 0.0

    def apply(self, voltage):
        pass

    def advance(self, dt):
        pass


@pytest.fixture
def terminal():
    """A pseudo-terminal whose other end is the emulator in a process of its own."""
    master, slave = os.openpty()
    for end in (master, slave):
        tty.setraw(end)
    server = subprocess.Popen([sys.executable, "-c", SERVER, str(master)], pass_fds=(master,))
    yield os.ttyname(slave)
    server.terminate()
    server.wait()
    os.close(master)
    os.close(slave)


def rate(read):
    for _ in range(20):
        assert read() == 240
    watch = Stopwatch()
    for _ in range(ROUND_TRIPS):
        read()
    return ROUND_TRIPS / watch.seconds()


def rate_of_the_driver(port, clock):
    settings = RoboteqSupply.Settings(port=port, output="average", voltage_limits=(0, 12), heartbeat=60, timeout=10.0)
    supply = RoboteqSupply.connect("supply", settings, clock)
    try:
        return rate(lambda: supply._line.read(_VOLTS, 2))
    finally:
        supply.close()


def rate_of_canopen(canopen, port):
    network = canopen.Network()
    network.connect(interface="slcan", channel=port, bitrate=125_000, sleep_after_open=0)
    try:
        node = network.add_node(1, canopen.ObjectDictionary())
        node.sdo.RESPONSE_TIMEOUT = 10.0
        return rate(lambda: int.from_bytes(node.sdo.upload(0x210D, 2), "little"))
    finally:
        network.disconnect()


@pytest.mark.benchmark
def test_round_trips_beside_the_stock_client(terminal, capsys):
    """One object read again and again: an expedited SDO upload is one frame each way."""
    canopen = pytest.importorskip("canopen")
    ours, theirs = [], []
    for _ in range(BATCHES):
        ours.append(rate_of_the_driver(terminal, WallClock()))
        theirs.append(rate_of_canopen(canopen, terminal))
    clock = VirtualClock()
    device = EmulatedRoboteq("supply", World(Nothing(), clock), Nothing())
    port = register("benchmark-supply", CanopenSlcanServer(device), clock)
    try:
        within = statistics.median(rate_of_the_driver(port, clock) for _ in range(BATCHES))
    finally:
        unregister("benchmark-supply")
    mine, stock = statistics.median(ours), statistics.median(theirs)
    with capsys.disabled():
        print(
            f"\nSDO round trips over a pseudo-terminal: driver {mine:.0f}/s, canopen {stock:.0f}/s, "
            f"ratio {mine / stock:.2f}; driver in process {within:.0f}/s"
        )
