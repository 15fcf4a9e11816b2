"""CPU time of a reading in process: a TEC by one request and by five, a load cell, a text instrument.

Prints, asserts a ratio.
"""

import time
from binascii import crc_hqx
from collections.abc import Callable

import numpy as np
import pytest

from bench.base import VirtualClock
from drivers.flintec_dad141 import FlintecDAD141
from drivers.meerstetter import MeerstetterTEC
from drivers.scpi import SCPISensor
from sim_devices import protocol_emulated
from sim_devices.instruments.flintec_dad141 import EmulatedDAD141
from sim_devices.instruments.meerstetter_tec import EmulatedTEC
from sim_devices.instruments.scpi import EmulatedTextInstrument, Meter
from sim_devices.wire import WireServer
from sim_devices.wire.mecom import MeComServer
from sim_devices.wire.modbus_rtu import ModbusRtuServer
from sim_devices.wire.text import TextServer
from sim_devices.world import World

pytestmark = pytest.mark.benchmark

READINGS = 2000


class Block:
    """A block of metal that no output changes, so that the plant costs nothing."""

    plate_temperature = 25.0
    sink_temperature = 22.0
    current = 0.1
    voltage = 0.2

    def advance(self, dt: float) -> None:
        pass

    def regulate(self, target_celsius: float, current_limit: float = 4.0) -> None:
        pass

    def terminals(self) -> tuple[float, float, float, float]:
        return self.plate_temperature, self.sink_temperature, self.current, self.voltage

    def drive(self, current_ampere: float) -> None:
        pass

    def release(self) -> None:
        pass


def cpu_time(take: Callable[[], object]) -> float:
    """Return the CPU time of one reading in µs: the least of a few runs."""
    take()
    times = []
    for _ in range(7):
        begin = time.process_time()
        for _ in range(READINGS):
            take()
        times.append((time.process_time() - begin) / READINGS)
    return 1e6 * min(times)


def of_tec(server: Callable[[EmulatedTEC], WireServer]) -> float:
    clock, block = VirtualClock(), Block()
    device = EmulatedTEC("tec", World(block, clock), block, rng=np.random.default_rng(1))
    port = protocol_emulated.register("speed-tec", server(device), clock)
    try:
        settings = MeerstetterTEC.Settings(
            port=port, temperature_limits=(10, 95), current_limit=3.0, voltage_limit=12.0
        )
        return cpu_time(MeerstetterTEC.connect("tec", settings, clock).glance)
    finally:
        protocol_emulated.unregister("speed-tec")


def of_load_cell() -> float:
    clock = VirtualClock()
    cell = EmulatedDAD141("load", World(Block(), clock), lambda: 1.0, rng=np.random.default_rng(1), zero_tracking=0)
    port = protocol_emulated.register("speed-load", ModbusRtuServer(cell), clock)
    try:
        settings = FlintecDAD141.Settings(port=port, force_limits=(-5.0, 50.0))
        return cpu_time(FlintecDAD141.connect("load", settings, clock).glance)
    finally:
        protocol_emulated.unregister("speed-load")


def of_meter() -> float:
    clock = VirtualClock()
    signals = {"current": {"query": "MEAS:CURR?", "unit": "A"}}
    settings = SCPISensor.Settings(port="emulated://speed-meter", identity="EXAMPLE,{any}", signals=signals)
    meter = EmulatedTextInstrument(
        "meter", World(Block(), clock), settings, {"current": Meter(lambda: 0.1)}, np.random.default_rng(1)
    )
    protocol_emulated.register("speed-meter", TextServer(meter), clock)
    try:
        return cpu_time(SCPISensor.connect("meter", settings, clock).glance)
    finally:
        protocol_emulated.unregister("speed-meter")


class OldFirmware(WireServer):
    """A device that does not know `?VX`: it takes the request for one that makes no sense."""

    def __init__(self, device: EmulatedTEC) -> None:
        self._server = MeComServer(device)

    def receive(self, data: bytes) -> bytes:
        if b"?VX" in data:
            body = data[:-5].replace(b"?VX", b"?VZ")
            data = body + b"%04X\r" % crc_hqx(body, 0)
        return self._server.receive(data)


def test_readings_in_process(capsys):
    rows = [
        ("TEC, one request", of_tec(MeComServer)),
        ("TEC, five requests", of_tec(OldFirmware)),
        ("load cell, one request", of_load_cell()),
        ("text instrument, one query", of_meter()),
    ]
    with capsys.disabled():
        print("\nCPU time of a reading on an emulated line")
        for name, microseconds in rows:
            print(f"  {name:26s} {microseconds:6.1f} µs")
    assert rows[1][1] > 2.0 * rows[0][1]
