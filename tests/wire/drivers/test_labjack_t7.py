"""The T7 driver: its settings, its bytes, and what it makes of wrong devices and broken lines."""

import logging
import math
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from cases import cases
from modbus_tcp import ModbusTcpServer
from refusals import blamed
from still_plant import Still

from bench.base import DeviceConnectionError, DeviceError, LimitError, VirtualClock
from drivers import modbus_tcp
from drivers.labjack_t7 import T7HighVoltageSupply, T7PositionSensor, T7Switch, T7Thermistor, registers
from drivers.labjack_t7.registers import (
    AIN,
    AIN_NEGATIVE_CH,
    AIN_RANGE,
    TDAC,
    TEST,
    TEST_FLOAT32,
    LabJackT7,
    Packet,
    Span,
    Target,
)
from sim_devices.instruments.labjack_t7 import EmulatedT7
from sim_devices.protocol_emulated import register, unregister
from sim_devices.transducers.piezo_amplifier import PiezoAmplifier
from sim_devices.wire.modbus import DEVICE_FAILURE, RegisterError
from sim_devices.wire.modbus_tcp import ModbusTcpInstrument
from sim_devices.world import World

Settings = T7PositionSensor.Settings
SwitchSettings = T7Switch.Settings
ThermistorSettings = T7Thermistor.Settings
SupplySettings = T7HighVoltageSupply.Settings

ALL_LINES = 0x7FFFFF
OWNER = ("read", 46178, 2)
RATIOMETRIC = {"readout": "ratiometric", "channels": (2, 3), "position_limits": (0.0, 0.035)}


class Load:
    def lead(self, start: float, target: float, steps: int, time_constant: float) -> None:
        pass


class Bench:
    """A T7 whose inputs are the numbers in `volts`."""

    def __init__(self) -> None:
        self.volts = dict.fromkeys(range(14), 0.0)
        self.clock = VirtualClock()
        self.world = World(Still(), self.clock)
        inputs: dict[int, Callable[[], float]] = {channel: lambda c=channel: self.volts[c] for channel in range(14)}
        self.t7 = EmulatedT7(self.world, inputs, rng=np.random.default_rng(3))
        self.server = ModbusTcpServer(self.t7)
        self.devices: list[T7PositionSensor | T7Switch | T7Thermistor | T7HighVoltageSupply] = []

    def _connected(self, kind, name, settings):
        made = kind.connect(name, kind.Settings(port=self.server.address, **settings), self.clock)
        self.devices.append(made)
        return made

    def sensor(self, **settings) -> T7PositionSensor:
        return self._connected(T7PositionSensor, "psd", settings)

    def switch(self, **settings) -> T7Switch:
        return self._connected(T7Switch, "fan", {"line": 5} | settings)

    def thermistor(self, **settings) -> T7Thermistor:
        return self._connected(T7Thermistor, "base", settings)

    def supply(self, **settings) -> T7HighVoltageSupply:
        """A supply on line 5 whose status output, at AIN2, follows `self.volts`."""
        return self._connected(T7HighVoltageSupply, "hv", {"line": 5} | settings)

    def wire(self) -> PiezoAmplifier:
        """Wire an amplifier to TDAC0, to line 5 and to AIN0, 1 and 2."""
        amplifier = PiezoAmplifier(self.world, Load(), scale_error=0.0, rng=np.random.default_rng(8))
        t7 = self.t7
        t7._sources |= {0: amplifier.voltage_monitor, 1: amplifier.current_monitor, 2: amplifier.status}
        t7.add_follower(lambda: amplifier.drive(t7.tdac_volts(0), t7.dio_level(5, pulled_down=True)))
        return amplifier

    def guarded(self) -> int:
        """The lines that the watchdog drives when it runs out."""
        on = self.t7.read_value(61600) and self.t7.read_value(61630)
        return ~int(self.t7.read_value(61636)) & ALL_LINES if on else 0


@pytest.fixture(autouse=True)
def _no_connection_stays() -> Iterator[None]:
    """See that what opens a connection in a test releases it, also after an error."""
    yield
    left = dict(modbus_tcp._connections)
    for connection in left.values():
        connection.end()
    assert not left


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    with bench.server:
        yield bench
        for device in bench.devices:
            device.close()


class Scripted:
    """A server of one connection that expects bytes and answers bytes; None closes the connection."""

    def __init__(self, *exchanges: tuple[str, str | None]) -> None:
        self._exchanges = [
            (bytes.fromhex(sent), None if reply is None else bytes.fromhex(reply)) for sent, reply in exchanges
        ]
        self.received: list[bytes] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> "Scripted":
        self._thread.start()
        return self

    def __exit__(self, *details) -> None:
        self._thread.join()

    def _serve(self) -> None:
        with self._listener:
            client, _ = self._listener.accept()
            with client:
                client.settimeout(60)
                for expected, reply in self._exchanges:
                    self.received.append(client.recv(4096))
                    assert self.received[-1] == expected
                    if reply is None:
                        return
                    client.sendall(reply)
                client.recv(1)  # until the driver hangs up


class Altered:
    """A T7 of which some registers read differently."""

    def __init__(self, instrument: EmulatedT7, alter: Callable[[int, list[int]], list[int]]) -> None:
        self._instrument = instrument
        self._alter = alter

    def read_registers(self, address: int, count: int) -> list[int]:
        return self._alter(address, self._instrument.read_registers(address, count))

    def write_registers(self, address: int, values: list[int]) -> None:
        self._instrument.write_registers(address, values)


class Recorded(Altered):
    """A T7 that keeps what was asked of it."""

    def __init__(self, instrument: EmulatedT7) -> None:
        super().__init__(instrument, lambda _, words: words)
        self.requests: list[tuple[str, int, int]] = []

    def read_registers(self, address: int, count: int) -> list[int]:
        self.requests.append(("read", address, count))
        return super().read_registers(address, count)

    def write_registers(self, address: int, values: list[int]) -> None:
        self.requests.append(("write", address, len(values)))
        super().write_registers(address, values)


# Settings


@cases(
    ("given", "kept"),
    [
        ("tcp://192.168.1.207:502", "tcp://192.168.1.207:502"),
        ("192.168.1.207", "tcp://192.168.1.207:502"),
        ("t7.local:1502", "tcp://t7.local:1502"),
        ("tcp://t7", "tcp://t7:502"),
        ("tcp://[fe80::1]:502", "tcp://[fe80::1]:502"),
        ("host:65535", "tcp://host:65535"),
    ],
)
def test_address_is_completed(given, kept):
    assert Settings(port=given).port == kept


CURRENTS = {"readout": "currents", "channels": (0, 1)}
BEYOND_A_VOLT = {"steinhart_hart": (5e-3, -1e-5, 1e-5), "reference_ohms": 1.0, "temperature_limits": (-100.0, 0.0)}


@cases(
    ("settings", "key", "wrong"),
    [
        *((Settings, "port", {"port": port}) for port in ("serial:///dev/ttyUSB0", "host:0", "host:65536", "")),
        (Settings, "range", {"range": 5.0}),
        (Settings, "channels", {"channels": (14,)}),
        (Settings, "channels", {"channels": (0, 1)}),
        (Settings, "channels", {"channels": (3, 3), "readout": "currents"}),
        (Settings, "channels", {"channels": (3,), "readout": "currents"}),
        (Settings, "samples / sample_rate", {"samples": 200}),  # 0.2 s at 1 kHz
        (Settings, "timeout", {"samples": 60, "timeout": 0.05}),
        (Settings, "volts_per_metre", {"volts_per_metre": 0.0}),
        (Settings, "position_limits", {"position_limits": (1e-6, -1e-6)}),
        (Settings, "position_limits", CURRENTS | {"position_limits": (-96e-6, 0.0)}),
        (Settings, "position_limits", CURRENTS | {"position_limits": (0.0, 96e-6), "metres_per_metre": -185.0}),
        (Settings, "channels", RATIOMETRIC | {"channels": (2,)}),
        (Settings, "channels", RATIOMETRIC | {"channels": (2, 3, 4)}),
        (Settings, "range", RATIOMETRIC | {"range": 1.0}),
        (Settings, "zero_position", RATIOMETRIC | {"zero_position": 0.036}),
        (Settings, "position_limits", RATIOMETRIC | {"position_limits": (-1e-6, 0.035)}),
        (Settings, "position_limits", RATIOMETRIC | {"position_limits": (0.0, 0.035), "zero_position": 0.01}),
        (SwitchSettings, "line", {"line": 23}),
        (SwitchSettings, "watchdog", {"watchdog": 2.5}),
        (ThermistorSettings, "channels", {"channels": (2,)}),
        (ThermistorSettings, "channels", {"channels": (2, 2)}),
        (ThermistorSettings, "range", {"range": 1.0}),
        # Rises; is constant; rises at the cold, and at the hot end; is negative; rises in between.
        *(
            (ThermistorSettings, "steinhart_hart", {"steinhart_hart": coefficients})
            for coefficients in ((1e-3, -2e-4, 0), (1e-3, 0, 0), (1e-3, 2.3e-4, -1e-6), (4e-3, -1e-5, 1e-7),
                                 (-2e-3, 2.3e-4, 8.8e-8))
        ),
        (ThermistorSettings, "steinhart_hart", BEYOND_A_VOLT),
        (ThermistorSettings, "temperature_limits", {"temperature_limits": (20.0, 20.0)}),
        # Where the divider tells it from a broken wire.
        (ThermistorSettings, "temperature_limits", {"temperature_limits": (-60.0, 20.0)}),
        (ThermistorSettings, "temperature_limits", {"temperature_limits": (0.0, 250.0)}),
        (SupplySettings, "channels", {"channels": (0, 1)}),
        (SupplySettings, "channels", {"channels": (0, 1, 1)}),
        (SupplySettings, "range", {"range": 1.0}),  # the status output gives 5 V
        *((SupplySettings, "analog_output", {"analog_output": name}) for name in ("dac2", "tdac23", "xtdac1")),
        (SupplySettings, "voltage_limits", {"voltage_limits": (1.0, 40.0)}),
        (SupplySettings, "voltage_limits", {"voltage_limits": (0.0, 0.0)}),
        (SupplySettings, "voltage_limits", {"gain": 2.0}),  # -20 V at tdac0
        (SupplySettings, "voltage_limits", {"analog_output": "dac0"}),  # -2 V
        (SupplySettings, "voltage_limits", {"analog_output": "dac0", "offset_volts": 3.5}),
        (SupplySettings, "volts_per_volt", {"volts_per_volt": 4.0}),  # the monitor would be over its range
        (SupplySettings, "volts_per_volt", {"volts_per_volt": -4.0}),
        # Taken by the LJTick-DAC.
        (SupplySettings, "line", {"line": 0}),
        (SupplySettings, "line", {"line": 13, "analog_output": "tdac12"}),
    ],
)  # fmt: skip
def test_wrong_settings_are_refused_by_their_key(settings, key, wrong):
    right = {"port": "host"} | ({"line": 5} if settings in (SwitchSettings, SupplySettings) else {})
    settings(**right)
    assert blamed(settings, right | wrong) == {key}


def test_a_switch_needs_a_line():
    assert blamed(SwitchSettings, {"port": "host"}) == {"line"}


def test_limits_may_be_the_whole_stroke():
    for zero in (0.0, 0.005, 0.01, 0.012, 0.0175, 0.03, 0.035):
        limits = (round(-zero, 6), round(0.035 - zero, 6))
        made = Settings(port="host", **RATIOMETRIC | {"zero_position": zero, "position_limits": limits})
        assert made.position_limits == limits


@cases(
    ("right", "rest"),
    [
        ({}, 0.0),
        ({"analog_output": "dac1", "offset_volts": 2.5, "line": 0}, 2.5),
        ({"analog_output": "tdac22", "gain": -4.0}, 0.0),
        ({"voltage_limits": (-40.0, 0.0)}, 0.0),
        ({"line": 1, "analog_output": "tdac2"}, 0.0),
    ],
)
def test_settings_of_a_high_voltage_supply(right, rest):
    assert SupplySettings(**{"port": "host", "line": 5} | right).sent(0.0) == rest


# Bytes


def test_byte_vectors():
    exchanges = (
        ("0001 0000 0006 01 03 d73c 0002", "0001 0000 0007 01 03 04 0011 2233"),  # TEST
        ("0002 0000 0006 01 03 d754 0002", "0002 0000 0007 01 03 04 c61c 3c00"),  # TEST_FLOAT32
        ("0003 0000 0006 01 03 0000 0002", "0003 0000 0007 01 03 04 4020 0000"),  # AIN0
        # AIN0_RANGE, written and read back in one packet, by LabJack's function 76; and USER_RAM39_U32
        (
            "0004 0000 0012 01 4c 01 9c40 02 3dcc cccd 00 9c40 02 00 b462 02",
            "0004 0000 000a 01 4c 3dcc cccd 0000 0000",
        ),
    )
    with Scripted(*exchanges) as server:
        t7 = LabJackT7("psd", server.address, 2.0)
        assert t7.read_integer(TEST) == 0x00112233
        assert t7.read(TEST_FLOAT32) == [-9999.0]
        assert t7.read(AIN) == [2.5]
        t7.set({AIN_RANGE.of(0): 0.1})
        t7.close()
    assert len(server.received) == len(exchanges)


def test_byte_vectors_of_a_ratiometric_sensor():
    volts = "4020 0000 40a0 0000"  # 2.5 and 5 V
    exchanges = (
        ("0001 0000 0006 01 03 0004 0004", f"0001 0000 000b 01 03 08 {volts}"),  # AIN2, AIN3
        (  # AIN2_EF_READ_A, B and C, of two inputs each, and USER_RAM39_U32
            "0002 0000 0012 01 4c 00 1b5c 04 00 1c88 04 00 1db4 04 00 b462 02",
            f"0002 0000 001e 01 4c {volts} 4024 0000 40a4 0000 401c 0000 409c 0000 0000 0000",
        ),
    )
    with Scripted(*exchanges) as server:
        settings = Settings(port=server.address, **RATIOMETRIC | {"zero_position": 0.0, "position_limits": (0, 0.02)})
        t7 = LabJackT7("slide", server.address, 2.0)
        sensor = T7PositionSensor("slide", settings, VirtualClock(), t7)
        assert sensor.glance() == {"slide_position": pytest.approx(0.0175)}
        assert sensor.measure() == {"slide_position": pytest.approx(0.0175)}
        sensor.close()
    assert len(server.received) == len(exchanges)


def test_byte_vectors_of_a_switch(monkeypatch):
    monkeypatch.setattr("secrets.randbelow", lambda _: 0x12345677)
    exchanges = (
        ("0001 0000 0006 01 03 d73c 0002", "0001 0000 0007 01 03 04 0011 2233"),  # TEST
        ("0002 0000 0006 01 03 d754 0002", "0002 0000 0007 01 03 04 c61c 3c00"),  # TEST_FLOAT32
        ("0003 0000 0006 01 03 ea60 0002", "0003 0000 0007 01 03 04 40e0 0000"),  # PRODUCT_ID 7
        ("0004 0000 0006 01 03 ea64 0002", "0004 0000 0007 01 03 04 3f80 0000"),  # FIRMWARE 1
        ("0005 0000 0006 01 03 ea7c 0002", "0005 0000 0007 01 03 04 1c03 dcb9"),  # SERIAL
        ("0006 0000 0006 01 03 b462 0002", "0006 0000 0007 01 03 04 0000 0000"),  # USER_RAM39_U32
        ("0007 0000 000b 01 10 b462 0002 04 1234 5678", "0007 0000 0006 01 10 b462 0002"),
        ("0008 0000 0006 01 03 ea7c 0002", "0008 0000 0007 01 03 04 1c03 dcb9"),  # SERIAL
        # DIO5 low, then DIO_DIRECTION and DIO_STATE
        (
            "0009 0000 0014 01 4c 01 07d5 01 0000 00 0b22 02 00 0af0 02 00 b462 02",
            "0009 0000 000e 01 4c 0000 0020 007f ffdf 1234 5678",
        ),
        (  # WATCHDOG_ENABLE, _TIMEOUT_S, _STRICT_ENABLE, _DIO_ENABLE, _STATE, _DIRECTION, _INHIBIT
            "000a 0000 0022 01 4c 00 f0a0 02 00 f0a4 02 00 f0aa 02 00 f0be 02 00 f0c0 02 00 f0c2 02 00 f0c4 02"
            " 00 b462 02",
            "000a 0000 0022 01 4c" + 14 * " 0000" + " 1234 5678",
        ),
        # Only what differs; it is off, so that it need not be switched off.
        (
            "000b 0000 0012 01 4c 01 f0a4 02 0000 0003 00 f0a4 02 00 b462 02",
            "000b 0000 000a 01 4c 0000 0003 1234 5678",
        ),  # WATCHDOG_TIMEOUT_S
        (
            "000c 0000 0012 01 4c 01 f0be 02 0000 0001 00 f0be 02 00 b462 02",
            "000c 0000 000a 01 4c 0000 0001 1234 5678",
        ),  # WATCHDOG_DIO_ENABLE
        (
            "000d 0000 0012 01 4c 01 f0c2 02 0000 0020 00 f0c2 02 00 b462 02",
            "000d 0000 000a 01 4c 0000 0020 1234 5678",
        ),  # WATCHDOG_DIO_DIRECTION
        (
            "000e 0000 0012 01 4c 01 f0c4 02 007f ffdf 00 f0c4 02 00 b462 02",
            "000e 0000 000a 01 4c 007f ffdf 1234 5678",
        ),  # _DIO_INHIBIT
        (
            "000f 0000 0012 01 4c 01 f0a0 02 0000 0001 00 f0a0 02 00 b462 02",
            "000f 0000 000a 01 4c 0000 0001 1234 5678",
        ),  # WATCHDOG_ENABLE
        # DIO5 high
        (
            "0010 0000 0014 01 4c 01 07d5 01 0001 00 0b22 02 00 0af0 02 00 b462 02",
            "0010 0000 000e 01 4c 0000 0020 007f ffff 1234 5678",
        ),
        ("0011 0000 000a 01 4c 00 0af0 02 00 b462 02", "0011 0000 000a 01 4c 007f ffff 1234 5678"),  # glance
        (
            "0012 0000 000a 01 4c 00 0af0 02 00 b462 02",
            "0012 0000 000a 01 4c 007f ffff 1234 5678",
        ),  # close: on, so nothing changes
    )
    with Scripted(*exchanges) as server:
        settings = SwitchSettings(port=server.address, line=5, watchdog=3)
        switch = T7Switch.connect("fan", settings, VirtualClock())
        switch.set(1.0)
        assert switch.glance() == {"fan_state": 1.0}
        switch.close()
    assert len(server.received) == len(exchanges)


def test_byte_vectors_of_a_thermistor():
    exchanges = (
        ("0001 0000 0006 01 03 0004 0004", "0001 0000 000b 01 03 08 3fa0 0000 4020 0000"),  # AIN2 1.25 V, AIN3 2.5 V
        (  # AIN2_EF_READ_A, B and C, of two inputs each, and USER_RAM39_U32
            "0002 0000 0012 01 4c 00 1b5c 04 00 1c88 04 00 1db4 04 00 b462 02",
            "0002 0000 001e 01 4c 3fa0 0000 4020 0000 3fb0 0000 4024 0000 3f90 0000 401c 0000 0000 0000",
        ),
    )
    with Scripted(*exchanges) as server:
        settings = ThermistorSettings(port=server.address, channels=(2, 3))
        t7 = LabJackT7("base", server.address, 2.0)
        sensor = T7Thermistor("base", settings, VirtualClock(), t7)
        assert sensor.glance() == {"base_temperature": pytest.approx(25.0, abs=2e-3)}  # 10 kΩ
        assert sensor.measure() == {"base_temperature": pytest.approx(25.0, abs=2e-3)}
        sensor.close()
    assert len(server.received) == len(exchanges)


def test_byte_vectors_of_a_high_voltage_supply():
    off, on = "0000 0000 0000 0000 0000 0000", "3f80 0000 3f00 0000 40a0 0000"  # 0, 0, 0 V and 1, 0.5, 5 V
    exchanges = (
        ("0001 0000 000b 01 10 7530 0002 04 0000 0000", "0001 0000 0006 01 10 7530 0002"),  # TDAC0 0 V
        # DIO5 high, then DIO_DIRECTION and DIO_STATE
        (
            "0002 0000 0014 01 4c 01 07d5 01 0001 00 0b22 02 00 0af0 02 00 b462 02",
            "0002 0000 000e 01 4c 0000 0020 007f ffff 0000 0000",
        ),
        ("0003 0000 0006 01 03 0000 0006", f"0003 0000 000f 01 03 0c {on}"),  # AIN0, AIN1, AIN2
        ("0004 0000 000b 01 10 7530 0002 04 3f80 0000", "0004 0000 0006 01 10 7530 0002"),  # TDAC0 1 V
        ("0005 0000 000b 01 10 7530 0002 04 bf80 0000", "0005 0000 0006 01 10 7530 0002"),  # TDAC0 -1 V
        ("0006 0000 000a 01 4c 00 0000 06 00 b462 02", f"0006 0000 0012 01 4c {on} 0000 0000"),  # glance
        ("0007 0000 000b 01 10 7530 0002 04 0000 0000", "0007 0000 0006 01 10 7530 0002"),  # safe: TDAC0 0 V
        # DIO5 low
        (
            "0008 0000 0014 01 4c 01 07d5 01 0000 00 0b22 02 00 0af0 02 00 b462 02",
            "0008 0000 000e 01 4c 0000 0020 007f ffdf 0000 0000",
        ),
        ("0009 0000 0006 01 03 0000 0006", f"0009 0000 000f 01 03 0c {off}"),
        (
            "000a 0000 000a 01 4c 00 0af0 02 00 b462 02",
            "000a 0000 000a 01 4c 007f ffff 0000 0000",
        ),  # close: on, so nothing changes
    )
    with Scripted(*exchanges) as server:
        settings = SupplySettings(port=server.address, line=5)
        t7 = LabJackT7("hv", server.address, 2.0)
        supply = T7HighVoltageSupply("hv", settings, VirtualClock(), t7)
        supply.set(20.0).wait()
        supply.set(-20.0)
        assert supply.glance() == {"hv_voltage": 20.0, "hv_current": 5e-3}
        supply.safe()
        supply.close()
    assert len(server.received) == len(exchanges)


def test_byte_vectors_of_dac1():
    exchanges = (("0001 0000 000b 01 10 03ea 0002 04 4060 0000", "0001 0000 0006 01 10 03ea 0002"),)  # DAC1 3.5 V
    with Scripted(*exchanges) as server:
        settings = SupplySettings(port=server.address, line=5, analog_output="dac1", offset_volts=2.5)
        t7 = LabJackT7("hv", server.address, 2.0)
        supply = T7HighVoltageSupply("hv", settings, VirtualClock(), t7)
        supply._send(20.0)
        t7.close()
    assert len(server.received) == len(exchanges)


def test_devices_of_one_instrument_share_a_connection(bench):
    sensor, switch, other = bench.sensor(), bench.switch(), bench.sensor()
    with socket.create_connection(("127.0.0.1", bench.server.port), timeout=60) as second:
        second.sendall(bytes.fromhex("0001 0000 0006 01 03 d73c 0002"))
        assert second.recv(100) == bytes.fromhex("0001 0000 0007 01 03 04 0011 2233")
    bench.volts[0] = 1.0
    for device in (sensor, switch):
        device.close()
        assert other.measure()["psd_position"] == pytest.approx(10e-6, abs=1e-8)
    other.close()
    with pytest.raises(DeviceConnectionError, match="closed"):
        other.measure()
    assert bench.sensor().measure()


# Setting up


def test_connect_sets_the_inputs_up(bench):
    bench.sensor(
        readout="currents",
        channels=(4, 7),
        range=1.0,
        resolution_index=6,
        settling_us=50.0,
        samples=25,
        sample_rate=2000.0,
    )
    for channel in (4, 7):
        assert bench.t7.read_value(40000 + 2 * channel) == 1.0
        assert bench.t7.read_value(41000 + channel) == 199
        assert bench.t7.read_value(41500 + channel) == 6
        assert bench.t7.read_value(42000 + 2 * channel) == 50.0
        assert bench.t7.read_value(9000 + 2 * channel) == 3
        assert bench.t7.read_value(9300 + 2 * channel) == 25
        assert bench.t7.read_value(10200 + 2 * channel) == 2000.0
    assert bench.t7.read_value(4008) == 50.0
    assert bench.t7.read_value(4010) == 6


def test_one_sample_needs_no_burst(bench):
    bench.volts[0] = 1.0
    sensor = bench.sensor(samples=1)
    assert bench.t7.read_value(9000) == 0
    assert sensor.measure()["psd_position"] == pytest.approx(10e-6, abs=1e-8)
    assert bench.clock.now() == 0.0


def test_a_setting_that_is_not_taken_is_noticed(bench):
    def alter(address: int, words: list[int]) -> list[int]:
        return [5] if address == 41500 else words

    with (
        ModbusTcpServer(Altered(bench.t7, alter)) as server,
        pytest.raises(DeviceError, match="AIN0_RESOLUTION_INDEX reads back 5 after 4"),
    ):
        T7PositionSensor.connect("psd", Settings(port=server.address), bench.clock)


# Wrong devices


@cases(
    ("alter", "message"),
    [
        (lambda _, words: words[::-1], "swapped order"),
        (lambda _, words: [(w & 0xFF) << 8 | w >> 8 for w in words], "bytes of a word in swapped"),
        (lambda _, words: [0] * len(words), "is not a LabJack T-series: register TEST is 0x00000000"),
        (lambda address, words: [0] * len(words) if address == 55124 else words, "TEST_FLOAT32 is 0"),
        (lambda address, words: [0x4080, 0] if address == 60000 else words, "LabJack T4, not a T7"),
        (lambda address, words: [0x4100, 0] if address == 60000 else words, "LabJack T8, not a T7"),
        (lambda address, words: [0x4348, 0] if address == 60000 else words, "LabJack Digit"),
        (lambda address, words: [0x4110, 0] if address == 60000 else words, "another product.*is 9"),
    ],
)
def test_a_wrong_device_is_refused(bench, alter, message):
    with (
        ModbusTcpServer(Altered(bench.t7, alter)) as server,
        pytest.raises(DeviceConnectionError, match=message) as raised,
    ):
        T7PositionSensor.connect("psd", Settings(port=server.address), bench.clock)
    assert server.address in str(raised.value)
    assert bench.t7.flash_writes == bench.t7.read_value(2850) == 0


def test_a_device_without_test_registers_is_refused(bench):
    def refuse(address: int, words: list[int]) -> list[int]:
        raise RegisterError(2, "not here")

    with (
        ModbusTcpServer(Altered(bench.t7, refuse)) as server,
        pytest.raises(DeviceConnectionError, match=r"is not a LabJack T-series.*exception 2"),
    ):
        T7PositionSensor.connect("psd", Settings(port=server.address), bench.clock)


# Broken lines


def test_a_dead_address_is_named(caplog, capfd):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with (
        caplog.at_level(logging.DEBUG),
        pytest.raises(DeviceConnectionError, match=rf"psd: cannot connect to tcp://127.0.0.1:{port}"),
    ):
        T7PositionSensor.connect("psd", Settings(port=f"127.0.0.1:{port}"), VirtualClock())
    assert not caplog.records
    assert capfd.readouterr() == ("", "")


def test_a_silent_host_costs_one_timeout():
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        with pytest.raises(DeviceConnectionError, match=rf"no reply from tcp://127.0.0.1:{port} within 0.1 s"):
            T7PositionSensor.connect("psd", Settings(port=f"127.0.0.1:{port}", timeout=0.1), VirtualClock())


def test_a_lost_connection_is_masked_and_counted(bench):
    bench.wire()
    lost = ModbusTcpInstrument(bench.t7)
    address = register("t7-lost", lost, bench.clock)
    supply = T7HighVoltageSupply.connect("hv", SupplySettings(port=address, line=5), bench.clock)
    psd = T7PositionSensor.connect("psd", Settings(port=address, channels=(3,)), bench.clock)
    calls = psd.measure, psd.glance, supply.measure, supply.glance, lambda: supply.set(10.0), lambda: supply.set(5.0)
    for count, call in enumerate(calls, 1):
        lost.end_connections()
        call()
        assert psd.repeats + supply.repeats == count
    assert bench.t7.tdac_volts(0) == pytest.approx(5.0 / 20.0, abs=1e-3)
    psd.close()
    supply.close()
    unregister(address)


class TestUseByAnother:
    """Another program has no owner number of ours; it may be on another computer."""

    def another(self, bench, monkeypatch):
        with monkeypatch.context() as patch:
            patch.setattr(registers, "_owners", {})
            return bench.switch(line=6)

    def test_one_that_answers_keeps_its_instrument(self, bench, monkeypatch):
        fan = bench.switch(line=6)
        with monkeypatch.context() as patch:
            sleep = bench.clock.sleep

            def go_on(seconds):
                sleep(seconds)
                if bench.clock.now() > 2.0:
                    fan.glance()

            patch.setattr(bench.clock, "sleep", go_on)
            with pytest.raises(DeviceError, match="in use by another program, on this or another computer"):
                self.another(bench, monkeypatch)
        fan.set(1.0)
        assert fan.measure() == {"fan_state": 1.0}

    def test_one_that_died_is_not_waited_for_for_long(self, bench, monkeypatch):
        fan = bench.switch(line=6)
        before = bench.clock.now()
        self.another(bench, monkeypatch).measure()
        assert 2.0 < bench.clock.now() - before < 10.0
        with pytest.raises(DeviceError, match="another program has taken the LabJack T7"):
            fan.glance()

    def test_one_that_has_left_is_not_asked(self, bench, monkeypatch):
        psd, fan = bench.sensor(channels=(3,)), bench.switch(line=6)
        fan.close()
        # The other device uses it still.
        psd.measure()
        psd.close()
        before = bench.clock.now()
        self.another(bench, monkeypatch)
        assert bench.clock.now() - before < 1.0


def test_another_program_that_takes_the_instrument_is_told(bench):
    bench.wire()
    supply, psd, fan = bench.supply(), bench.sensor(channels=(3,)), bench.switch(line=6)
    bench.t7.write_value(46178, 4711)
    for call in (supply.glance, supply.measure, psd.measure, fan.glance, fan.measure, lambda: fan.set(1.0)):
        with pytest.raises(DeviceError, match="another program has taken the LabJack T7"):
            call()
    supply.safe()
    fan.safe()


def test_another_instrument_at_the_address_is_refused(bench):
    psd = bench.sensor()
    bench.server.close()
    other = EmulatedT7(bench.world, {}, rng=np.random.default_rng(3), serial_number=470054321)
    with (
        ModbusTcpServer(other, port=bench.server.port),
        pytest.raises(DeviceError, match=r"psd: is another instrument now: .* 470054321; it was 470012345"),
    ):
        psd.glance()


def test_a_host_that_hangs_up_in_the_middle():
    with Scripted(("0001 0000 0006 01 03 d73c 0002", None)) as server:
        t7 = LabJackT7("psd", server.address, 1.0)
        with pytest.raises(DeviceConnectionError, match="connection broke"):
            t7.read_integer(TEST)


# Bad signals


@cases("volts", [10.0, -10.0, 10.4, -20.0, 30.0])
def test_over_range(bench, volts):
    sensor = bench.sensor(position_limits=(-1.0, 1.0))
    bench.volts[0] = volts
    for take in (sensor.measure, sensor.glance):
        with pytest.raises(
            DeviceError,
            match=r"^psd: AIN0 reads \S+ V and is over its range of ±10 V; bring what is measured back into it$",
        ):
            take()


def test_one_clipped_conversion_spoils_a_mean(bench):
    sensor = bench.sensor()
    readings = iter([0.0] * 4 + [12.0] + [0.0] * 5)
    bench.t7._sources[0] = lambda: next(readings)
    with pytest.raises(DeviceError, match="over its range"):
        sensor.measure()


def test_light_lost(bench):
    sensor = bench.sensor(readout="currents", channels=(0, 1), minimum_sum_volts=1.0)
    bench.volts[0] = bench.volts[1] = 0.49
    for take in (sensor.measure, sensor.glance):
        with pytest.raises(DeviceError, match=r"light lost: .* 0.98 V, less than 1 V; check the laser"):
            take()
    bench.volts[0] = bench.volts[1] = 0.51
    assert sensor.measure()["psd_position"] == pytest.approx(0.0, abs=1e-7)


@cases("words", [[0xC61C, 0x3C00], [0x7FC0, 0x0000], [0x7F80, 0x0000]])
def test_an_invalid_conversion_is_no_reading(bench, words):
    def alter(address: int, actual: list[int]) -> list[int]:
        return words if address == 7600 else actual

    with ModbusTcpServer(Altered(bench.t7, alter)) as server:
        sensor = T7PositionSensor.connect("psd", Settings(port=server.address), bench.clock)
        with pytest.raises(DeviceError, match="no valid conversion"):
            sensor.measure()
        sensor.close()


# A ratiometric sensor


def test_a_ratiometric_position(bench):
    sensor = bench.sensor(
        readout="ratiometric", channels=(6, 4), stroke=0.05, zero_position=0.02, position_limits=(-0.02, 0.03)
    )
    for supply in (4.6, 5.0, 5.4):
        for share in (0.15, 0.42, 0.9 - 1e-3):
            bench.volts[6], bench.volts[4] = share * supply, supply
            expected = 0.05 * (share - 0.1) / 0.8 - 0.02
            assert sensor.measure()["psd_position"] == pytest.approx(expected, abs=2e-5)
            assert sensor.glance()["psd_position"] == pytest.approx(expected, abs=2e-5)


def test_the_mean_of_a_ratiometric_sensor_is_the_ratio_of_the_means(bench):
    sensor = bench.sensor(**RATIOMETRIC, samples=2)
    outputs, supplies = iter([1.0, 3.0]), iter([4.6, 5.4])
    bench.t7._sources |= {2: lambda: next(outputs), 3: lambda: next(supplies)}
    assert sensor.measure()["psd_position"] == pytest.approx(0.035 * (2.0 / 5.0 - 0.1) / 0.8, abs=1e-5)


# A thermistor


@cases(
    ("ohms", "celsius"),
    # The table of a thermistor of 10 kΩ at 25 °C with these coefficients, in steps of 1 Ω or 0.1 %.
    [(32650.0, 0.0), (10000.0, 25.0), (3603.0, 50.0), (678.3, 100.0)],
)
def test_temperature_of_a_thermistor(bench, ohms, celsius):
    sensor = bench.thermistor(channels=(6, 4), resolution_index=8)
    for excitation in (2.05, 2.5, 2.95):
        bench.volts[6], bench.volts[4] = excitation * ohms / (ohms + 10e3), excitation
        for take in (sensor.measure, sensor.glance):
            assert take()["base_temperature"] == pytest.approx(celsius, abs=0.05)


def test_another_thermistor_and_divider(bench):
    # Beta 3435 K at 1 kΩ and 25 °C.
    a, b = 1 / 298.15 - math.log(1e3) / 3435.0, 1 / 3435.0
    sensor = bench.thermistor(reference_ohms=2e3, excitation_volts=5.0, steinhart_hart=(a, b, 0.0))
    bench.volts[0], bench.volts[1] = 5.0 / 3, 5.0
    assert sensor.measure()["base_temperature"] == pytest.approx(25.0, abs=0.01)


# A high-voltage supply


@contextmanager
def recorded_supply(bench) -> Iterator[tuple[T7HighVoltageSupply, Recorded]]:
    recorded = Recorded(bench.t7)
    with ModbusTcpServer(recorded) as server:
        yield (
            T7HighVoltageSupply.connect("hv", SupplySettings(port=server.address, line=5), bench.clock),
            recorded,
        )


def test_requests_of_a_high_voltage_supply(bench):
    bench.wire()
    with recorded_supply(bench) as (supply, recorded):

        def asked(call: Callable[[], object]) -> list[tuple[str, int, int]]:
            recorded.requests.clear()
            call()
            return list(recorded.requests)

        send, look = ("write", 30000, 2), ("read", 0, 6)
        enable = [("write", 2005, 1), ("read", 2850, 2), ("read", 2800, 2), OWNER]
        assert asked(lambda: supply.set(10.0)) == [send, *enable, look, send]
        assert asked(lambda: supply.set(11.0)) == [send]
        assert asked(supply.glance) == [look, OWNER]
        assert asked(supply.measure) == [("read", 7000, 6), ("read", 7300, 6), ("read", 7600, 6), OWNER]
        bench.clock.sleep(0.099)
        assert asked(lambda: supply.set(12.0)) == [send]
        bench.clock.sleep(0.001)
        assert asked(lambda: supply.set(13.0)) == [look, OWNER, send]
        assert asked(lambda: supply.set(0.1)) == [send]
        bench.clock.sleep(0.05)
        assert asked(supply.safe) == [send, *enable, look]
        supply.close()


def test_connect_switches_off_and_guards_the_enable_line(bench):
    amplifier = bench.wire()
    bench.t7.write_value(30000, 2.0)
    bench.t7.write_value(2005, 1)
    bench.clock.sleep(1.0)
    bench.world.advance()
    assert amplifier.voltage == pytest.approx(40.0, abs=0.02)
    supply = bench.supply(watchdog=2)
    assert not amplifier.on
    assert bench.t7.tdac_volts(0) == 0.0
    assert bench.guarded() == 1 << 5
    assert not int(bench.t7.read_value(61632)) >> 5 & 1
    assert bench.t7.read_value(61604) == 2
    assert math.isnan(supply.setpoint)


def test_the_amplifier_is_switched_on_at_zero(bench):
    bench.wire()
    seen: list[tuple[float, bool]] = []
    bench.t7.write_value(30000, 2.0)  # as another program left it
    supply = bench.supply()
    bench.t7.write_value(30000, 2.0)
    bench.t7.add_follower(lambda: seen.append((bench.t7.tdac_volts(0), bench.t7.dio_level(5))))
    supply.set(20.0)
    assert [volts for volts, on in seen if on] == [0.0] * (len(seen) - 3) + [pytest.approx(1.0, abs=1e-3)]


@pytest.mark.parametrize("looks", [0, 1, 30])
def test_an_amplifier_may_take_its_time_to_go_on(bench, looks):
    supply = bench.supply()
    answers = iter([0.0] * looks)
    bench.t7._sources[2] = lambda: next(answers, 5.0)
    supply.set(10.0)
    assert bench.clock.now() == pytest.approx(0.01 * looks)
    assert bench.t7.tdac_volts(0) == pytest.approx(0.5, abs=1e-3)


def test_an_amplifier_that_does_not_go_on_is_told(bench):
    supply = bench.supply()
    with pytest.raises(
        DeviceError,
        match=r"^hv: the amplifier does not report that it is on 0\.5 s after DIO5, its enable line, was switched "
        r"on; check its power, its own protection and interlocks, and the wire from its status output to AIN2$",
    ):
        supply.set(10.0)
    assert supply.setpoint == 0.0
    assert not bench.t7.dio_level(5)
    assert bench.t7.tdac_volts(0) == 0.0
    assert supply.measure()["hv_voltage"] == pytest.approx(0.0, abs=0.02)


def test_an_amplifier_that_does_not_go_off_is_told(bench):
    bench.volts[2] = 5.0
    with pytest.raises(
        DeviceError,
        match=r"^hv: the amplifier reports that it is on although DIO5, its enable line, was switched off; check the "
        r"wiring, and that no other program uses the line$",
    ):
        bench.supply()


def test_an_amplifier_that_somebody_else_switches_on_is_told(bench):
    bench.wire()
    supply = bench.supply()
    bench.t7.write_value(2005, 1)
    for take in (supply.measure, supply.glance):
        with pytest.raises(
            DeviceError, match=r"^hv: the amplifier reports that it is on although DIO5, its enable line"
        ):
            take()
    supply.safe()
    supply.measure()


def test_an_output_that_keeps_its_voltage_is_told(bench):
    bench.wire()
    supply = bench.supply()
    supply.set(40.0)
    bench.t7._sources[0] = lambda: 1.7
    with pytest.raises(
        DeviceError,
        match=r"^hv: the output is at 34 V although it was switched off; keep away from it and switch the amplifier "
        r"off by hand$",
    ):
        supply.safe()
    assert not bench.t7.dio_level(5)
    assert bench.t7.tdac_volts(0) == 0.0


def test_an_output_may_take_its_time_to_discharge(bench):
    bench.wire()
    supply = bench.supply()
    supply.set(40.0)
    answers = iter([1.8, 1.0, 0.5, 0.1])
    bench.t7._sources[0] = lambda: next(answers, 0.0)
    supply.safe()
    assert bench.clock.now() == pytest.approx(0.04)


WENT_OFF = r"^hv: the amplifier went off by itself, while DIO5, its enable line, "


def test_a_safe_state_that_cannot_be_confirmed_is_part_of_the_message(bench):
    amplifier = bench.wire()
    supply = bench.supply()
    supply.set(30.0)
    amplifier.trip()
    bench.t7._sources[0] = lambda: 1.5
    with pytest.raises(
        DeviceError, match=WENT_OFF + r"is on: .*; that it is safe could not be confirmed \(hv: the output"
    ):
        supply.measure()
    assert not bench.t7.dio_level(5)


@pytest.mark.parametrize("refused", [30000, 2005, 0])
def test_safe_tries_everything_and_tells_the_first_failure(bench, refused):
    amplifier = bench.wire()

    class Refusing(Altered):
        refusing = False

        def check(self, address: int) -> None:
            if self.refusing and address == refused:
                raise RegisterError(DEVICE_FAILURE, "no")

        def write_registers(self, address: int, values: list[int]) -> None:
            self.check(address)
            super().write_registers(address, values)

        def read_registers(self, address: int, count: int) -> list[int]:
            self.check(address)
            return super().read_registers(address, count)

    instrument = Refusing(bench.t7, lambda _, words: words)
    with ModbusTcpServer(instrument) as server:
        supply = T7HighVoltageSupply.connect("hv", SupplySettings(port=server.address, line=5), bench.clock)
        supply.set(30.0)
        bench.clock.sleep(0.1)
        instrument.refusing = True
        with pytest.raises(DeviceError, match=rf"hv: Modbus exception 4 .* register {refused}"):
            supply.safe()
        bench.clock.sleep(0.1)
        bench.world.advance()
        assert amplifier.voltage == pytest.approx(0.0, abs=1e-6)
        assert supply.setpoint == 0.0
        instrument.refusing = False
        supply.safe()
        supply.close()


def test_closing_a_high_voltage_supply(bench):
    bench.wire()
    bench.supply(watchdog=2).close()
    assert bench.guarded() == 0
    supply = bench.supply(watchdog=2)
    supply.set(30.0)
    supply.close()
    assert bench.t7.dio_level(5)
    bench.clock.sleep(2.0)
    bench.world.advance()
    assert not bench.t7.dio_level(5)


# A switch


@pytest.mark.parametrize("active_high", [True, False])
def test_connect_puts_the_line_under_the_watchdog(bench, active_high):
    bench.switch(line=5, active_high=active_high, watchdog=7)
    assert bench.guarded() == 1 << 5
    assert int(bench.t7.read_value(61632)) >> 5 & 1 == (not active_high)
    assert int(bench.t7.read_value(61634)) >> 5 & 1
    assert bench.t7.read_value(61604) == 7
    assert bench.t7.read_value(61610) == 0


def test_connect_keeps_what_else_is_under_the_watchdog(bench):
    kept = {61604: 30, 61630: 1, 61632: 0b0110, 61634: 0b0011, 61636: ALL_LINES & ~0b0111, 61640: 1, 61642: 0.5}
    for address, value in (kept | {61600: 1}).items():
        bench.t7.write_value(address, value)
    bench.switch(line=5, watchdog=60)
    assert bench.t7.read_value(61600) == 1
    assert bench.guarded() == 0b10_0111
    for address, value in (kept | {61634: 0b10_0011, 61636: ALL_LINES & ~0b10_0111}).items():
        assert bench.t7.read_value(address) == value


def test_what_a_watchdog_that_is_off_was_set_to_is_not_taken_over(bench):
    for address, value in ((61604, 1), (61630, 1), (61636, 0)):
        bench.t7.write_value(address, value)
    bench.switch(line=5, watchdog=60)
    assert bench.guarded() == 1 << 5
    assert bench.t7.read_value(61604) == 60


def test_connecting_twice_writes_the_flash_memory_once(bench):
    bench.switch(line=5, watchdog=7)
    assert bench.t7.flash_writes == 5  # time, lines, direction, inhibit; then on
    bench.switch(line=5, watchdog=7)
    assert bench.t7.flash_writes == 5
    bench.t7.power_cycle()
    assert bench.t7.read_value(61604) == 7
    assert bench.guarded() == 1 << 5
    bench.switch(line=5, watchdog=7)
    assert bench.t7.flash_writes == 5


def test_a_watchdog_is_off_while_its_settings_change_and_each_is_written_by_itself(bench):
    bench.switch(line=5, watchdog=7)
    recorded = Recorded(bench.t7)
    with ModbusTcpServer(recorded) as server:
        switch = T7Switch.connect("fan", SwitchSettings(port=server.address, line=5, watchdog=9), bench.clock)
        writes = [entry for entry in recorded.requests if entry[0] == "write" and entry[1] >= 61600]
        assert writes == [("write", 61600, 2), ("write", 61604, 2), ("write", 61600, 2)]
        switch.close()
    assert bench.t7.read_value(61604) == 9


def test_a_strict_watchdog_is_refused(bench):
    for address, value in ((61604, 10), (61610, 1), (61612, 77), (61600, 1)):
        bench.t7.write_value(address, value)
    with pytest.raises(DeviceError, match=r"fan: the watchdog .* strict mode.*WATCHDOG_ENABLE_DEFAULT"):
        bench.switch()
    assert bench.t7.read_value(61600) == bench.t7.read_value(61610) == 1


def test_a_setting_of_the_watchdog_that_is_not_taken_leaves_it_running_for_others(bench):
    bench.switch(line=1, watchdog=30)

    def alter(address: int, words: list[int]) -> list[int]:
        return [0, 0] if address == 61636 and bench.t7.read_value(61600) == 0 else words

    with (
        ModbusTcpServer(Altered(bench.t7, alter)) as server,
        pytest.raises(DeviceError, match="fan: WATCHDOG_DIO_INHIBIT_DEFAULT reads back 0 after 8"),
    ):
        T7Switch.connect("fan", SwitchSettings(port=server.address, line=5), bench.clock)
    assert bench.guarded() & 0b10
    assert bench.t7.deadline() < math.inf


def test_closing_the_last_switch_that_is_off_disables_the_watchdog(bench):
    fan, pump = bench.switch(line=5), bench.switch(line=6)
    fan.close()
    assert bench.guarded() == 1 << 6
    pump.close()
    assert bench.t7.read_value(61600) == 0
    assert bench.guarded() == 0
    bench.clock.sleep(100.0)
    bench.t7.world.advance()
    assert not bench.t7.dio_level(5)
    assert not bench.t7.dio_level(6)


def test_closing_a_switch_keeps_the_watchdog_of_an_analog_output(bench):
    for address, value in ((61604, 4), (61640, 1), (61642, 0.0), (61600, 1)):
        bench.t7.write_value(address, value)
    bench.t7.write_value(1000, 3.0)
    bench.switch(line=5, watchdog=60).close()
    bench.clock.sleep(4.0)
    bench.t7.world.advance()
    assert bench.t7.dac_volts(0) == 0.0


@pytest.mark.parametrize(("active_high", "stuck"), [(True, ALL_LINES), (False, 0)])
def test_a_line_that_does_not_go_off_is_told(bench, active_high, stuck):
    def alter(address: int, words: list[int]) -> list[int]:
        return [stuck >> 16, stuck & 0xFFFF] if address == 2800 else words

    with ModbusTcpServer(Altered(bench.t7, alter)) as server:
        settings = SwitchSettings(port=server.address, line=5, active_high=active_high)
        with pytest.raises(DeviceError, match="fan: DIO5 is on right after it was switched off; check the wiring"):
            T7Switch.connect("fan", settings, bench.clock)


def test_a_line_that_does_not_go_on_is_told(bench):
    def alter(address: int, words: list[int]) -> list[int]:
        return [words[0], words[1] & ~(1 << 5)] if address == 2800 else words

    with ModbusTcpServer(Altered(bench.t7, alter)) as server:
        switch = T7Switch.connect("fan", SwitchSettings(port=server.address, line=5), bench.clock)
        with pytest.raises(DeviceError, match="fan: DIO5 is off right after it was switched on; check the wiring"):
            switch.set(1.0)
        switch.close()


def test_a_line_that_became_an_input_is_told(bench):
    switch = bench.switch()
    switch.set(1.0)
    bench.t7.read_value(2005)
    with pytest.raises(DeviceError, match="fan: DIO5 is an input and drives nothing"):
        switch.measure()
    switch.safe()
    assert switch.measure() == {"fan_state": 0.0}
    assert not bench.t7.dio_level(5)


def test_devices_on_one_connection_are_read_in_one_request(bench):
    sensor, thermistor = bench.sensor(channels=[0]), bench.thermistor(channels=[3, 4])
    bench.volts |= {0: 1.0, 3: 1.2, 4: 2.5}
    assert sensor.joins(thermistor)
    assert not sensor.joins(bench.switch())
    requests = []
    client = sensor._line._client
    send = client.request
    client.request = lambda request, expected: requests.append(request) or send(request, expected)
    values = sensor.joined([thermistor])()
    assert len(requests) == 1
    one_by_one = sensor.glance() | thermistor.glance()
    assert len(requests) == 3
    assert values == {name: pytest.approx(value, abs=1e-2, rel=1e-3) for name, value in one_by_one.items()}
    bench.volts[3] = 2.5
    with pytest.raises(DeviceError, match=r"^base: thermistor open"):
        sensor.joined([thermistor])()


# At the bounds of the map


def test_registers_are_used_in_their_direction_alone():
    for use, register_ in ((Target, AIN), (Span, TDAC)):
        with pytest.raises(ValueError, match="can only be"):
            use.of(register_)


def test_details_of_refusals_are_those_of_the_maker():
    """The errors of an input in labjack/ljm_constants, ljm_constants.json."""
    assert set(registers._DETAILS) == set(range(2370, 2377))


def without_a_line(kind, **settings):
    """Return a device that converts voltages, and has nothing to read them with."""
    return kind("psd", kind.Settings(port="host", **settings), VirtualClock(), None)


def test_other_readouts_are_converted_row_by_row():
    sensor = without_a_line(T7PositionSensor, channels=(0, 1), readout="currents", minimum_sum_volts=0.5)
    rows = np.array([[0.25, 0.25], [3.0, 5.0]])
    np.testing.assert_allclose(sensor.converted(rows)[:, 0], [0.0, 0.037 / 2 * 2.0 / 8.0 / 185.0])
    with pytest.raises(DeviceError, match="light lost"):
        sensor.converted(np.array([[0.25, 0.25], [0.2, 0.2]]))


def test_a_row_beyond_the_calibration_is_an_error():
    sensor = without_a_line(T7PositionSensor, volts_per_metre=2.0, zero_volts=1.0, position_limits=(-0.5, 1.0))
    np.testing.assert_array_equal(sensor.converted(np.array([[0.0], [2.0], [3.0]])), [[-0.5], [0.5], [1.0]])
    for beyond in (-0.1, 3.1):
        with pytest.raises(DeviceError, match=r"outside of its calibrated range -0\.5 to 1 m"):
            sensor.converted(np.array([[1.0], [beyond]]))


# Blocks of samples


@pytest.fixture
def in_process(bench) -> Iterator[str]:
    """Return the address of the T7 in this process; its amplifier is wired, and AIN3 follows its voltage."""
    amplifier = bench.wire()
    bench.t7._sources[3] = lambda: amplifier.voltage / 10.0
    address = register("t7-in-process", ModbusTcpInstrument(bench.t7), bench.clock)
    yield address
    for device in bench.devices:
        device.close()
    bench.devices.clear()
    unregister("t7-in-process")


def connected(bench, address, kind, **settings):
    device = kind.connect(
        {T7HighVoltageSupply: "hv"}.get(kind, "psd"), kind.Settings(port=address, **settings), bench.clock
    )
    bench.devices.append(device)
    return device


def test_a_block_is_what_single_samples_are(bench, in_process):
    supply = connected(bench, in_process, T7HighVoltageSupply, line=5)
    sensor = connected(
        bench, in_process, T7PositionSensor, channels=(3,), volts_per_metre=1.0, position_limits=(-9.0, 9.0)
    )
    supply.set(0.0)
    setpoints = np.linspace(-40.0, 40.0, 120)
    begin = bench.clock.now()
    found = supply.play(setpoints, 1e-3, sensor)
    assert found.shape == (120, 1)
    # A sample is read before its set-point is sent, the amplifier lags by less than a period.
    np.testing.assert_allclose(found[2:, 0], setpoints[1:-1] / 10.0, atol=0.05)
    assert supply.setpoint == 40.0
    assert 0.119 <= bench.clock.now() - begin <= 0.121
    assert bench.t7.tdac_volts(0) == pytest.approx(2.0, abs=2e-3)


def test_a_block_is_sent_in_as_few_requests_as_can_be(bench, in_process):
    supply = connected(bench, in_process, T7HighVoltageSupply, line=5)
    sensor = connected(bench, in_process, T7PositionSensor, channels=(3,), position_limits=(-1.0, 1.0))
    supply.set(0.0)
    requests, client = [], supply._line._client
    send = client.request
    client.request = lambda request, expected: requests.append(request) or send(request, expected)
    supply.play(np.zeros(103), 1e-4, sensor)
    read, write, wait = "00 0006 02", "01 7530 02 00000000", "01 f096 02 00000064"
    sample = bytes.fromhex(read + write + wait)
    assert requests == [
        *[b"\x4c" + (51 * sample)[:-8]] * 2,
        b"\x4c" + sample[:-8],
    ]
    assert LabJackT7.most_played(sensor.conversions) == 51
    assert LabJackT7.most_played(supply.conversions) == 51
    two = connected(bench, in_process, T7PositionSensor, channels=(3, 5), readout="currents")
    assert LabJackT7.most_played(two.conversions) == 1032 // 24


def test_a_block_beyond_the_limits_is_not_sent(bench, in_process):
    supply = connected(bench, in_process, T7HighVoltageSupply, line=5)
    sensor = connected(bench, in_process, T7PositionSensor, channels=(3,), position_limits=(-1.0, 1.0))
    for beyond in (40.1, -40.1):
        with pytest.raises(LimitError, match=f"{beyond:g}"):
            supply.play(np.array([0.0, beyond, 0.0]), 1e-3, sensor)
    assert not bench.t7.dio_level(5)
    # At the limits it is, and an amplifier that is off is switched on.
    supply.play(np.array([40.0, -40.0]), 1e-3, sensor)
    assert bench.t7.dio_level(5)


def test_a_block_looks_at_the_status_from_time_to_time(bench, in_process):
    supply = connected(bench, in_process, T7HighVoltageSupply, line=5)
    sensor = connected(bench, in_process, T7PositionSensor, channels=(3,), position_limits=(-1.0, 1.0))
    supply.set(0.0)
    bench.t7._sources[2] = lambda: 0.0
    supply.play(np.zeros(2), 1e-3, sensor)
    bench.clock.sleep(0.1)
    with pytest.raises(DeviceError, match="went off by itself"):
        supply.play(np.zeros(2), 1e-3, sensor)


def test_a_clipped_sample_of_a_block_is_told(bench, in_process):
    supply = connected(bench, in_process, T7HighVoltageSupply, line=5)
    sensor = connected(bench, in_process, T7PositionSensor, channels=(3,), position_limits=(-1.0, 1.0))
    readings = iter([0.0, 0.0, 12.0, 0.0])
    bench.t7._sources[3] = lambda: next(readings)
    with pytest.raises(DeviceError, match="over its range"):
        supply.play(np.zeros(4), 1e-3, sensor)


@cases(
    ("period", "can"),
    [
        (1e-6, True),
        (0.9e-6, False),
        (1.5e-6, False),
        (5e-5, True),
        (1.00001e-3, False),
        (0.019, True),
        (0.0201, False),
    ],
)
def test_periods_that_can_be_played(bench, in_process, period, can):
    supply = connected(bench, in_process, T7HighVoltageSupply, line=5)
    sensor = connected(bench, in_process, T7PositionSensor, channels=(3,))
    assert supply.can_play(sensor, period) is can


def test_what_can_be_played_with(bench, in_process):
    supply = connected(bench, in_process, T7HighVoltageSupply, line=5, timeout=60.0)
    sensor = connected(bench, in_process, T7PositionSensor, channels=(3,))
    assert supply.can_play(sensor, 0.1)
    assert not supply.can_play(sensor, 0.100001)
    assert not supply.can_play(connected(bench, in_process, T7Switch, line=6), 0.1)
    assert not supply.can_play(bench.sensor(), 0.1)


def test_a_block_over_a_connection_that_has_ended(bench, in_process):
    supply = connected(bench, in_process, T7HighVoltageSupply, line=5)
    sensor = connected(bench, in_process, T7PositionSensor, channels=(3,), position_limits=(-1.0, 1.0))
    supply.set(0.0)
    supply._line._connection.end()
    assert supply.play(np.zeros(3), 1e-3, sensor).shape == (3, 1)
    # One that ends meanwhile is not played again, as part of it may have been.
    supply._line._client.feedback = lambda *_: (_ for _ in ()).throw(OSError("gone"))
    with pytest.raises(DeviceConnectionError, match="gone"):
        supply.play(np.zeros(3), 1e-3, sensor)


# Answers that belong to nothing


class Spoiling(ModbusTcpInstrument):
    """A T7 in this process whose next answers are altered."""

    def __init__(self, bank):
        super().__init__(bank)
        self.alter: list[Callable[[bytes], bytes]] = []

    def connect(self):
        stream = super().connect()
        receive = stream.receive

        def altered(data: bytes) -> bytes:
            answer = receive(data)
            return self.alter.pop(0)(answer) if self.alter and answer else answer

        stream.receive = altered
        return stream


@pytest.fixture
def spoiling(bench) -> Iterator[Spoiling]:
    bench.wire()
    spoiling = Spoiling(bench.t7)
    register("t7-spoiling", spoiling, bench.clock)
    yield spoiling
    for device in bench.devices:
        device.close()
    bench.devices.clear()
    unregister("t7-spoiling")


def with_byte(place: int, value: int) -> Callable[[bytes], bytes]:
    return lambda answer: answer[:place] + bytes((value,)) + answer[place + 1 :]


@cases("place", [0, 1, 2, 3, 5, 6, 7, 8])
def test_an_answer_that_belongs_to_nothing_is_asked_for_again(bench, spoiling, place):
    address = "emulated://t7-spoiling"
    supply = connected(bench, address, T7HighVoltageSupply, line=5)
    sensor = connected(bench, address, T7PositionSensor, channels=(3,))
    calls = [(sensor, sensor.glance), (supply, lambda: supply.set(10.0))]
    calls.append((sensor, lambda: sensor._line.write(AIN_NEGATIVE_CH.of(9), 199)))
    if place < 8:  # of function 76, what follows the function is a value
        calls.append((supply, lambda: supply._output.switch(True)))
    supply.set(5.0)
    for device, call in calls:
        spoiling.alter = [with_byte(place, 0x55)]
        before = device.repeats
        call()
        assert device.repeats == before + 1
    assert bench.t7.tdac_volts(0) == pytest.approx(0.5, abs=1e-3)
    if place < 8:  # a block may have been played in part
        spoiling.alter = [with_byte(place, 0x55)]
        with pytest.raises(DeviceConnectionError):
            supply.play(np.zeros(3), 1e-3, sensor)
    supply.close()
    sensor.close()


def test_two_answers_that_belong_to_nothing_are_enough(bench, spoiling):
    sensor = connected(bench, "emulated://t7-spoiling", T7PositionSensor, channels=(3,))
    right = Span.of(TEST)
    for take in (lambda: sensor._line.read_span(right), lambda: sensor._line.write(AIN_NEGATIVE_CH.of(9), 199)):
        sensor._line.read_integer(TEST)
        # Over the other connection come serial number and owner first, by which the instrument is known.
        spoiling.alter = [with_byte(7, 0x55), lambda answer: answer, lambda answer: answer, with_byte(8, 0x55)]
        with pytest.raises(DeviceConnectionError, match="no reply from emulated://t7-spoiling"):
            take()
        assert spoiling.alter == []


def test_a_refusal_upon_a_repeated_request_is_told(bench, spoiling):
    sensor = connected(bench, "emulated://t7-spoiling", T7PositionSensor, channels=(3,))
    spoiling.alter = [with_byte(7, 0x55)]
    with pytest.raises(DeviceError, match=r"exception 4 \(device failure\) on writing register 40018.* 2370 "):
        sensor._line.write(AIN_RANGE.of(9), 5.0)
    assert sensor.repeats == 1


def test_longest_patience_of_the_devices_counts_for_all(bench, in_process):
    quick = connected(bench, in_process, T7PositionSensor, channels=(3,), timeout=0.1, samples=1)
    assert quick._line._connection.timeout == 0.1
    slow = connected(bench, in_process, T7Switch, line=6, timeout=2.0)
    assert quick._line._connection is slow._line._connection
    assert quick._line._client._port.timeout == 2.0
    connected(bench, in_process, T7Switch, line=7, timeout=0.5)
    assert quick._line._connection.timeout == 2.0
    with slow._line.in_haste():
        assert quick._line._client._port.timeout == 0.5
    assert quick._line._client._port.timeout == 2.0


def test_devices_that_are_read_together_have_limits_of_their_own(bench, in_process):
    volts = {"volts_per_metre": 1.0, "position_limits": (-9.0, 9.0)}
    wide = connected(bench, in_process, T7PositionSensor, channels=(4,), **volts)
    fine = connected(bench, in_process, T7PositionSensor, channels=(5,), range=1.0, **volts)
    pair = connected(bench, in_process, T7PositionSensor, channels=(8, 6), readout="currents")
    for device, name in ((wide, "wide"), (fine, "fine"), (pair, "pair")):
        device._signal = f"{name}_position"
    glance = wide.joined([fine, pair])
    bench.volts |= {4: 0.5, 5: 0.25, 8: 1.0, 6: 1.5}
    expected = {
        "wide_position": pytest.approx(0.5, abs=1e-2),
        "fine_position": pytest.approx(0.25, abs=1e-2),
        "pair_position": pytest.approx(0.037 / 2 * 0.5 / 2.5 / 185.0, rel=2e-2),
    }
    assert glance() == expected
    # Over the range of the fine one, but not over its own.
    bench.volts[4] = 5.0
    assert glance() == expected | {"wide_position": pytest.approx(5.0, abs=1e-2)}
    bench.volts[5] = 1.5
    with pytest.raises(DeviceError, match=r"AIN5 reads \S+ V and is over its range of ±1 V"):
        glance()
    bench.volts |= {4: 0.5, 5: 0.25, 6: 9.995}
    with pytest.raises(DeviceError, match=r"AIN6 reads \S+ V and is over its range of ±10 V"):
        glance()


def test_a_register_is_set_over_another_connection_if_the_former_has_ended(bench, in_process):
    sensor = connected(bench, in_process, T7PositionSensor, channels=(3,))
    for act in (
        lambda: sensor._line.write(AIN_NEGATIVE_CH.of(9), 199),
        lambda: sensor._line.send(Target.of(TDAC), 1.0),
        lambda: sensor._line.read_span(Span.of(TEST)),
        lambda: sensor._line.read_packet(Packet.of([Span.of(TEST)])),
    ):
        sensor._line._connection.end()
        act()
        assert not sensor._line._connection.ended
        assert sensor.repeats == 0
    assert bench.t7.tdac_volts(0) == pytest.approx(1.0, abs=2e-3)


def test_a_safe_state_does_not_ask_whose_the_instrument_is(bench, in_process):
    sensor = connected(bench, in_process, T7PositionSensor, channels=(3,))
    sensor._line.write(registers._OWNER, 1 + sensor._line._owner % 9)
    packet = Packet.of([Span.of(TEST)])
    with sensor._line.in_haste(unchecked=True):
        assert sensor._line.read_packet(packet) == (0x00112233,)
    with pytest.raises(DeviceError, match="another program has taken the LabJack T7"):
        sensor._line.read_packet(packet)


def test_every_request_of_a_closed_device_says_so(bench, in_process):
    supply = connected(bench, in_process, T7HighVoltageSupply, line=5)
    sensor = connected(bench, in_process, T7PositionSensor, channels=(3,))
    supply.set(0.0)
    supply.close()
    line, span = supply._line, Span.of(TEST)
    assert not line._connection.ended  # the sensor still uses it
    for act in (
        lambda: line.write(AIN_NEGATIVE_CH.of(9), 199),
        lambda: line.send(Target.of(TDAC), 1.0),
        lambda: line.read_span(span),
        lambda: line.read_packet(Packet.of([span])),
        lambda: line.play(sensor.conversions, TDAC, np.zeros(2), 100),
    ):
        with pytest.raises(DeviceConnectionError, match="was closed by its device; connect again"):
            act()
    assert bench.t7.tdac_volts(0) == 0.0


def test_a_connection_that_the_instrument_refuses_is_no_matter_of_the_cable(bench):
    taken = [socket.create_connection(("127.0.0.1", int(bench.server.address.rpartition(":")[2]))) for _ in range(2)]
    try:
        with pytest.raises(DeviceConnectionError, match="a T7 takes two at a time: end other users of it"):
            bench.switch()
    finally:
        for each in taken:
            each.close()
