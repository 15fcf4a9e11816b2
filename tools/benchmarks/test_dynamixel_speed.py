"""Round trips of the servo's feedback block, over a pty and in process, beside the maker's software.

Prints, asserts no time.
"""

import statistics
import subprocess
import sys
import time
import warnings

import pytest
import serial

from bench.base import VirtualClock, WallClock
from drivers.dynamixel import DynamixelMX28
from sim_devices import protocol_emulated
from sim_devices.instruments.dynamixel import EmulatedMX28
from sim_devices.wire.dynamixel2 import Dynamixel2Server
from sim_devices.world import World

pytestmark = pytest.mark.benchmark

# The servo has a process of its own, so that no client competes with it for the interpreter.
SERVO = """
import math, os, sys, tty
from bench.base import WallClock
from sim_devices.instruments.dynamixel import EmulatedMX28
from sim_devices.wire.dynamixel2 import Dynamixel2Server
from sim_devices.world import World

class Nothing:
    def advance(self, dt):
        pass

server = Dynamixel2Server([EmulatedMX28("servo", World(Nothing(), WallClock()))])
ours, theirs = os.openpty()
tty.setraw(ours)
tty.setraw(theirs)
print(os.ttyname(theirs), flush=True)
while True:
    os.write(ours, server.receive(os.read(ours, 4096)))
"""

ROUND_TRIPS = 2000
REPEATS = 5


@pytest.fixture
def port():
    with subprocess.Popen([sys.executable, "-c", SERVO], stdout=subprocess.PIPE, text=True) as process:
        yield process.stdout.readline().strip()
        process.kill()


def round_trips(function):
    """Return round trips a second."""
    start = time.perf_counter()
    for _ in range(ROUND_TRIPS):
        function()
    return ROUND_TRIPS / (time.perf_counter() - start)


def test_feedback_over_a_pty(port, capsys):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=DeprecationWarning, module="dynamixel_sdk")
        sdk = pytest.importorskip("dynamixel_sdk", reason="dynamixel-sdk is not installed")
    settings = DynamixelMX28.Settings(port=port, baudrate=1_000_000, position_limits=(0.0, 6.0), timeout=2.0)
    servo = DynamixelMX28.connect("servo", settings, WallClock())
    handler, sdk_port = sdk.PacketHandler(2.0), sdk.PortHandler(port)
    assert sdk_port.setBaudRate(1_000_000)

    timeouts = 0

    def by_sdk():
        nonlocal timeouts
        # It waits for 35 ms, which a busy machine may take from the servo's process.
        while (answer := handler.readTxRx(sdk_port, 1, 126, 21))[1] == sdk.COMM_RX_TIMEOUT:
            timeouts += 1
        data, result, error = answer
        assert (len(data), result, error) == (21, sdk.COMM_SUCCESS, 0)

    ours, theirs = [], []
    for _ in range(REPEATS):
        # In turn, so that a disturbance meets both.
        ours.append(round_trips(servo.measure))
        theirs.append(round_trips(by_sdk))
    servo.close()
    sdk_port.closePort()
    ratio = statistics.median(ours) / statistics.median(theirs)
    with capsys.disabled():
        print(f"\nfeedback of 21 bytes over a pty, medians of {REPEATS} × {ROUND_TRIPS}:")
        print(f"  DynamixelMX28.measure       {statistics.median(ours):7.0f} round trips/s")
        print(f"  dynamixel-sdk readTxRx      {statistics.median(theirs):7.0f} round trips/s ({timeouts} timeouts)")
        print(f"  ratio                       {ratio:7.2f}")


class Nothing:
    def advance(self, dt):
        pass


def cpu_microseconds(function):
    """Return the CPU time of a call, µs: the least of a few runs."""
    times = []
    for _ in range(2 * REPEATS):
        begin = time.process_time()
        for _ in range(ROUND_TRIPS):
            function()
        times.append((time.process_time() - begin) / ROUND_TRIPS)
    return 1e6 * min(times)


def test_feedback_in_process(capsys):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=DeprecationWarning, module="dynamixel_sdk")
        sdk = pytest.importorskip("dynamixel_sdk", reason="dynamixel-sdk is not installed")

    class UrlPort(sdk.PortHandler):
        def setupPort(self, cflag_baud):
            self.ser = serial.serial_for_url(self.port_name, baudrate=cflag_baud, timeout=0)
            self.is_open = True
            self.tx_time_per_byte = 1e4 / cflag_baud
            return True

    clock = VirtualClock()
    address = protocol_emulated.register(
        "speed-servo", Dynamixel2Server([EmulatedMX28("servo", World(Nothing(), clock))]), clock
    )
    try:
        settings = DynamixelMX28.Settings(port=address, baudrate=1_000_000, position_limits=(0.0, 6.0))
        servo = DynamixelMX28.connect("servo", settings, clock)
        handler, port = sdk.PacketHandler(2.0), UrlPort(address)
        assert port.setBaudRate(1_000_000)
        ours = cpu_microseconds(servo.measure)
        theirs = cpu_microseconds(lambda: handler.readTxRx(port, 1, 126, 21))
        servo.close()
        port.closePort()
    finally:
        protocol_emulated.unregister(address)
    with capsys.disabled():
        print(f"\nfeedback in process, CPU: DynamixelMX28.measure {ours:.1f} µs, dynamixel-sdk {theirs:.1f} µs")
