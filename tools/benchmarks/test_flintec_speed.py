"""Round trips over a pseudo-terminal, beside the clients a user would otherwise take. Prints, asserts no time."""

import struct
import sys
from collections.abc import Callable

import numpy as np
import pytest
from pymodbus.client import ModbusSerialClient

from bench.base import Stopwatch, VirtualClock, WallClock
from drivers.flintec_dad141 import FlintecDAD141
from sim_devices import protocol_emulated
from sim_devices.instruments.flintec_dad141 import EmulatedDAD141
from sim_devices.wire.modbus_rtu import ModbusRtuServer
from sim_devices.world import World

pytestmark = [
    pytest.mark.benchmark,
    pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals"),
]

BAUDRATE = 115200
FORCE = 12.0


class Still:
    def advance(self, dt: float) -> None:
        pass


def served() -> tuple[ModbusRtuServer, VirtualClock]:
    """Return an instrument whose own time does not pass, so that it costs all clients the same."""
    clock = VirtualClock()
    world = World(Still(), clock)
    instrument = EmulatedDAD141(
        "load", world, lambda: FORCE, rng=np.random.default_rng(1), noise=0.0, zero_tracking=0
    )
    return ModbusRtuServer(instrument), clock


def rate(take: Callable[[], float], seconds: float = 0.5, repeats: int = 5) -> float:
    """Return readings in a second: the median of a few runs."""
    take()
    rates = []
    for _ in range(repeats):
        watch, count = Stopwatch(), 0
        while (elapsed := watch.seconds()) < seconds:
            assert take() == FORCE
            count += 1
        rates.append(count / elapsed)
    return float(np.median(rates))


def of_driver(port: str, clock=None, **settings) -> float:
    settings = FlintecDAD141.Settings(
        port=port, baudrate=BAUDRATE, timeout=2.0, force_limits=(-50.0, 50.0), stale_after=0.0, **settings
    )
    cell = FlintecDAD141.connect("load", settings, clock or WallClock())
    try:
        return rate(lambda: cell.glance()["load_force"])
    finally:
        cell.close()


def of_pymodbus(port: str) -> float:
    client = ModbusSerialClient(port, baudrate=BAUDRATE, timeout=2.0)
    assert client.connect()

    def take() -> float:
        words = client.read_holding_registers(0x3500, count=5, device_id=1).registers
        return struct.unpack(">ffH", struct.pack(">5H", *words))[0]

    try:
        return rate(take)
    finally:
        client.close()


def of_minimalmodbus(port: str) -> float:
    minimalmodbus = pytest.importorskip("minimalmodbus", reason="needs the package minimalmodbus")
    client = minimalmodbus.Instrument(port, 1)
    client.serial.baudrate = BAUDRATE
    client.serial.timeout = 2.0

    def take() -> float:
        return struct.unpack(">ffH", struct.pack(">5H", *client.read_registers(0x3500, 5)))[0]

    try:
        return rate(take)
    finally:
        client.serial.close()


def test_round_trips(capsys, pseudo_terminal):
    server, clock = served()
    with pseudo_terminal(server) as path:
        rows = [
            ("this driver, no pause", of_driver(path, pause=0.0)),
            ("this driver, pause of Modbus", of_driver(path)),
            ("pymodbus as it is, no pause", of_pymodbus(path)),
            ("minimalmodbus, pause of Modbus", of_minimalmodbus(path)),
        ]
    port = protocol_emulated.register("load", served()[0], clock)
    try:
        rows.append(("this driver, emulated://", of_driver(port, clock)))
    finally:
        protocol_emulated.unregister("load")
    best = rows[0][1]
    with capsys.disabled():
        print(f"\nreadings of the combined block in a second, over a pseudo-terminal ({BAUDRATE} Bd by name)")
        for name, each in rows:
            print(f"  {name:32s} {each:8.0f}/s  {1e3 / each:6.3f} ms  x{best / each:.1f}")
