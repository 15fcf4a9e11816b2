"""Round trips of the Roboteq driver over a pseudo-terminal, beside those of the stock `canopen` client."""

import os
import statistics
import subprocess
import sys
import time
import tty

import can
import pytest

from bench.base import Stopwatch, VirtualClock, WallClock
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
from bench.base import WallClock
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


def cpu_microseconds(function):
    """Return the CPU time of a call, µs: the least of a few runs."""
    times = []
    for _ in range(2 * BATCHES):
        begin = time.process_time()
        for _ in range(ROUND_TRIPS):
            function()
        times.append((time.process_time() - begin) / ROUND_TRIPS)
    return 1e6 * min(times)


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


@pytest.mark.benchmark
def test_cpu_in_process_beside_the_stock_client(capsys):
    """A glance is a SYNC, process data and a command; the stock client reads its frames in a thread of its own."""
    canopen = pytest.importorskip("canopen")
    clock = VirtualClock()
    device = EmulatedRoboteq("supply", World(Nothing(), clock), Nothing(), watchdog=0.0)
    address = register("cpu-supply", CanopenSlcanServer(device), clock)
    try:
        settings = RoboteqSupply.Settings(port=address, output="average", voltage_limits=(0, 12), watchdog=0)
        supply = RoboteqSupply.connect("supply", settings, clock)
        supply.set(6.0).wait()
        one = cpu_microseconds(lambda: supply._line.read(_VOLTS, 2))
        glance = cpu_microseconds(supply.glance)
        supply.close()
        stock = cpu_of_canopen(canopen, address)
    finally:
        unregister(address)
    with capsys.disabled():
        print(
            f"\nCPU in process: a request {one:.1f} µs, a glance {glance:.1f} µs; "
            f"a request by canopen and python-can {stock:.1f} µs"
        )


def cpu_of_canopen(canopen, address):
    """Return the CPU time of a request of the stock client without its thread, µs."""
    bus = can.interface.Bus(interface="slcan", channel=address, bitrate=125_000, sleep_after_open=0)
    network = canopen.Network(bus)

    class Client(canopen.sdo.SdoClient):
        def read_response(self):
            while self.responses.empty():
                message = bus.recv(0)
                if message is not None:
                    network.notify(message.arbitration_id, message.data, message.timestamp)
            return self.responses.get_nowait()

    client = Client(0x601, 0x581, canopen.ObjectDictionary())
    client.network = network
    network.subscribe(0x581, client.on_response)
    try:
        return cpu_microseconds(lambda: client.upload(0x210D, 2))
    finally:
        bus.shutdown()
