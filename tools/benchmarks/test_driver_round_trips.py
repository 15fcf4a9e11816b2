"""Readings a second of the drivers over a pseudo-terminal, beside the clients that a user would otherwise take.

Each instrument has a process of its own, so that no client competes with it for the interpreter. Prints, asserts no
time.
"""

import statistics
import struct
import subprocess
import sys
import warnings

import pytest
from pymodbus.client import ModbusSerialClient

from bench.base import Stopwatch, WallClock
from drivers.dynamixel import DynamixelMX28
from drivers.flintec_dad141 import FlintecDAD141
from drivers.roboteq import RoboteqSupply

pytestmark = [
    pytest.mark.benchmark,
    pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals"),
]

SERVER = """
import os, tty
import numpy as np
from bench.base import WallClock
from sim_devices.instruments.dynamixel import EmulatedMX28
from sim_devices.instruments.flintec_dad141 import EmulatedDAD141
from sim_devices.instruments.roboteq import EmulatedRoboteq
from sim_devices.wire.canopen_slcan import CanopenSlcanServer
from sim_devices.wire.dynamixel2 import Dynamixel2Server
from sim_devices.wire.modbus_rtu import ModbusRtuServer
from sim_devices.world import World

class Nothing:
    current = 0.0
    def apply(self, voltage): pass
    def advance(self, dt): pass

world = World(Nothing(), WallClock())
server = {server}
ours, theirs = os.openpty()
tty.setraw(ours)
tty.setraw(theirs)
print(os.ttyname(theirs), flush=True)
while True:
    os.write(ours, server.receive(os.read(ours, 4096)))
"""
SERVO = "Dynamixel2Server([EmulatedMX28('servo', world)])"
CELL = "ModbusRtuServer(EmulatedDAD141('load', world, lambda: 12.0, rng=np.random.default_rng(1), zero_tracking=0))"
SUPPLY = "CanopenSlcanServer(EmulatedRoboteq('supply', world, Nothing()))"

ROUND_TRIPS, REPEATS = 500, 3
PATIENCE = 2.0
"""Longest wait for an answer on a busy machine, s."""


@pytest.fixture
def serve():
    """Serve an instrument by a process of its own; return the path of its line."""
    processes = []

    def start(server):
        command = [sys.executable, "-c", SERVER.format(server=server)]
        processes.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        return processes[-1].stdout.readline().strip()

    yield start
    for process in processes:
        process.kill()
        process.wait()
        process.stdout.close()


def rate(take):
    """Return calls a second, after some that warm up."""
    for _ in range(20):
        take()
    watch = Stopwatch()
    for _ in range(ROUND_TRIPS):
        take()
    return ROUND_TRIPS / watch.seconds()


@pytest.fixture
def compare(capsys):
    """Print the median rates of clients, each a function that opens it and returns what reads and what closes it."""

    def compare(title, clients):
        rates = {name: [] for name in clients}
        for _ in range(REPEATS):
            # In turn, so that a disturbance meets all of them.
            for name, connect in clients.items():
                take, close = connect()
                rates[name].append(rate(take))
                close()
        medians = {name: statistics.median(found) for name, found in rates.items()}
        with capsys.disabled():
            print(f"\n{title}, medians of {REPEATS} × {ROUND_TRIPS} round trips:")
            for name, median in medians.items():
                print(f"  {name:34}{median:7.0f}/s  x{next(iter(medians.values())) / median:.2f}")

    return compare


def test_feedback_of_a_servo_beside_the_makers_software(serve, compare):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=DeprecationWarning, module="dynamixel_sdk")
        sdk = pytest.importorskip("dynamixel_sdk", reason="dynamixel-sdk is not installed")
    path = serve(SERVO)

    def ours():
        settings = DynamixelMX28.Settings(port=path, baudrate=1_000_000, position_limits=(0.0, 6.0), timeout=PATIENCE)
        servo = DynamixelMX28.connect("servo", settings, WallClock())
        return servo.measure, servo.close

    def by_sdk():
        handler, port = sdk.PacketHandler(2.0), sdk.PortHandler(path)
        assert port.setBaudRate(1_000_000)

        def take():
            # It waits for 35 ms, which a busy machine may take from the servo's process.
            while (answer := handler.readTxRx(port, 1, 126, 21))[1] == sdk.COMM_RX_TIMEOUT:
                pass
            assert answer[1:] == (sdk.COMM_SUCCESS, 0)

        return take, port.closePort

    compare("feedback of 21 bytes", {"DynamixelMX28.measure": ours, "dynamixel-sdk readTxRx": by_sdk})


def test_readings_of_a_load_cell_beside_clients_of_modbus(serve, compare):
    path = serve(CELL)

    def ours(**keys):
        settings = FlintecDAD141.Settings(
            port=path, timeout=PATIENCE, force_limits=(-50.0, 50.0), stale_after=0.0, **keys
        )
        cell = FlintecDAD141.connect("load", settings, WallClock())
        return cell.glance, cell.close

    def weights(words):
        return struct.unpack(">ffH", struct.pack(">5H", *words))

    def by_pymodbus():
        client = ModbusSerialClient(path, baudrate=115200, timeout=PATIENCE)
        assert client.connect()
        return lambda: weights(client.read_holding_registers(0x3500, count=5, device_id=1).registers), client.close

    def by_minimalmodbus():
        minimalmodbus = pytest.importorskip("minimalmodbus", reason="needs the package minimalmodbus")
        client = minimalmodbus.Instrument(path, 1)
        client.serial.baudrate, client.serial.timeout = 115200, PATIENCE
        return lambda: weights(client.read_registers(0x3500, 5)), client.serial.close

    compare(
        "the combined block of a DAD 141.1",
        {
            "FlintecDAD141.glance, no pause": lambda: ours(pause=0.0),
            "FlintecDAD141.glance": ours,
            "pymodbus, no pause": by_pymodbus,
            "minimalmodbus": by_minimalmodbus,
        },
    )


def test_requests_of_a_supply_beside_canopen(serve, compare):
    canopen = pytest.importorskip("canopen")
    path = serve(SUPPLY)

    def ours():
        settings = RoboteqSupply.Settings(
            port=path, output="average", voltage_limits=(0, 12), heartbeat=60, timeout=10.0
        )
        supply = RoboteqSupply.connect("supply", settings, WallClock())
        return supply.glance, supply.close

    def by_canopen():
        network = canopen.Network()
        network.connect(interface="slcan", channel=path, bitrate=125_000, sleep_after_open=0)
        node = network.add_node(1, canopen.ObjectDictionary())
        node.sdo.RESPONSE_TIMEOUT = 10.0
        return lambda: node.sdo.upload(0x210D, 2), network.disconnect

    compare(
        "a reading of a supply, by process data and by one SDO",
        {"RoboteqSupply.glance": ours, "canopen, an SDO upload": by_canopen},
    )
