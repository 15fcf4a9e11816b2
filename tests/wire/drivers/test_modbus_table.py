"""Modbus RTU instruments that a table describes."""

import struct

import pytest
from cases import cases
from pydantic import ValidationError

from bench.base import ConfigurationError, DeviceConnectionError, DeviceError, DeviceRestartedError, VirtualClock
from bench.contracts import (
    ActuatorContract,
    RestartedActuatorContract,
    SafeOverAFreshLineContract,
    SilentInstrumentContract,
)
from bench.devices import Limits
from bench.rig import load_rig
from drivers.modbus_rtu import Register
from drivers.modbus_table import ModbusActuator, ModbusSensor
from drivers.table import Reading, Setpoint
from sim_devices import protocol_emulated
from sim_devices.wire.modbus import ILLEGAL_ADDRESS, RegisterError
from sim_devices.wire.modbus_rtu import ModbusRtuServer


class Heater(
    ModbusActuator,
    identity={"at": 0x00, "value": 1410},
    serial_number_at=0x01,
    setup=[{"at": 0x30, "value": 5}],
    output={"at": 0x21},
):
    """A heater with a thermometer."""

    temperature = Reading(0x10, "°C", (-20.0, 150.0), "temperature", kind="I16", scale=0.1)
    power = Reading(0x12, "W", (-1.0, 60.0), "power")
    heat = Setpoint(0x20, "W", (0.0, 50.0), "power to hold", kind="U16", scale=0.1)
    ramp = Register(0x30, int, "U16", "time of the ramp")


class HeaterTwin:
    """The registers of the heater, one word each."""

    def __init__(self):
        self.words = {0x00: 1410, 0x01: 0x0001, 0x02: 0x0002, 0x10: 215}
        self.answering, self.written = True, []
        self.power_cycle()

    def power_cycle(self):
        self.words |= {0x20: 0, 0x21: 0, 0x30: 1}

    @property
    def output(self):
        return 0.1 * self.words[0x20] if self.words[0x21] else 0.0

    def read_registers(self, address, count):
        self.words[0x12], self.words[0x13] = struct.unpack(">2H", struct.pack(">f", self.output))
        try:
            return [self.words[address + each] for each in range(count)]
        except KeyError:
            raise RegisterError(ILLEGAL_ADDRESS, "no such register") from None

    def write_registers(self, address, values):
        self.written.append((address, *values))
        self.words[address] = values[0]


class Server(ModbusRtuServer):
    """The line of the heater, which can be cut; what is sent then is gone."""

    plugged_in = True

    def receive(self, data):
        return super().receive(data) if self.plugged_in else b""


@pytest.fixture
def clock():
    return VirtualClock()


@pytest.fixture
def twin():
    return HeaterTwin()


@pytest.fixture
def server(twin):
    return Server(twin, 3)


@pytest.fixture
def connect(server, clock):
    port = protocol_emulated.register("heater", server, clock)
    yield lambda kind=Heater, **changes: kind.connect("heater", kind.Settings(port=port, address=3, **changes), clock)
    protocol_emulated.unregister(port)


@pytest.fixture
def device(connect):
    return connect()


@pytest.fixture
def set_points():
    return 10.0, 30.0


@pytest.fixture
def output(twin):
    return lambda: twin.output


class TestContract(ActuatorContract):
    driven = "power"

    @pytest.fixture
    def effects(self, twin):
        return lambda: twin.output

    @pytest.fixture
    def sent(self, twin):
        return lambda: list(twin.written)


class TestRestart(RestartedActuatorContract):
    @pytest.fixture
    def restart(self, twin):
        return twin.power_cycle


class TestSilence(SilentInstrumentContract):
    @pytest.fixture
    def unplug(self, server):
        return lambda: setattr(server, "plugged_in", False)


class TestFreshLine(SafeOverAFreshLineContract):
    @pytest.fixture
    def cut(self, device, server):
        def cut():
            device._line._client._port.close()
            server.plugged_in = False

        return cut

    @pytest.fixture
    def mend(self, server):
        return lambda: setattr(server, "plugged_in", True)


def test_rows_are_registers(device, twin):
    assert str(device.identity) == "unknown Modbus instrument 1410, serial number 65538, firmware unknown"
    assert device.temperature == pytest.approx(21.5)
    twin.words[0x10] = 0x10000 - 105
    assert device.glance() == {"heater_temperature": pytest.approx(-10.5), "heater_power": 0.0}
    assert device.reading_limits["heater_temperature"] == Limits(-20.0, 150.0, "°C")
    twin.words[0x10] = 1501
    with pytest.raises(DeviceError, match=r"temperature is 150\.1 °C, outside of -20 to 150 °C"):
        device.measure()


def test_a_register_is_an_attribute_and_is_read_back(device, twin, monkeypatch):
    assert device.ramp == 5
    device.ramp = 7
    assert twin.words[0x30] == 7
    monkeypatch.setattr(twin, "write_registers", lambda *_: None)
    with pytest.raises(DeviceError, match="time of the ramp reads back 7 after 8 was written"):
        device.ramp = 8


def test_the_set_up_is_written_before_the_output_goes_on(device, twin):
    twin.written.clear()
    device.set(12.34)
    assert twin.written == [(0x30, 5), (0x20, 123), (0x21, 1)]
    assert device.heat == pytest.approx(12.3)
    twin.written.clear()
    device.set(20.0)
    assert twin.written == [(0x20, 200)]
    twin.words[0x20] = 100
    with pytest.raises(DeviceError, match="reads its set-point back as 10 W, not 20 W"):
        device.measure()


def test_an_output_that_is_off_or_neither_is_found(device, twin):
    device.set(20.0)
    twin.words[0x21] = 9
    with pytest.raises(DeviceError, match="has 9 for its output, expected 1 or 0"):
        device.glance()
    twin.words[0x21] = 0
    with pytest.raises(DeviceError, match="its output is off although it was switched on") as raised:
        device.glance()
    assert not isinstance(raised.value, DeviceRestartedError)


def test_switching_off_is_sent_although_the_instrument_cannot_answer(device, twin, server, monkeypatch):
    device.set(20.0)
    receive = server.receive
    monkeypatch.setattr(server, "receive", lambda data: receive(data) and b"")
    with pytest.raises(DeviceError, match="does not confirm that its output is off"):
        device.safe()
    assert twin.output == 0.0


def test_an_output_that_stays_on_is_told(device, twin, monkeypatch):
    device.set(20.0)
    monkeypatch.setattr(twin, "write_registers", lambda *_: None)
    with pytest.raises(DeviceError, match="does not confirm that its output is off"):
        device.safe()


def test_the_low_word_may_come_first(connect, twin):
    class Swapped(ModbusSensor, low_word_first=True):
        power = Reading(0x40, "W", None, "power")

    twin.words[0x41], twin.words[0x40] = struct.unpack(">2H", struct.pack(">f", 12.5))
    assert connect(Swapped).measure() == {"heater_power": 12.5}


def test_what_is_no_number_is_an_error(connect, twin):
    class Meter(ModbusSensor):
        power = Reading(0x40, "W", None, "power")

    def deliver(value):
        twin.words[0x40], twin.words[0x41] = struct.unpack(">2H", struct.pack(">f", value))

    deliver(12.5)
    meter = connect(Meter)
    for value in (float("nan"), float("inf")):
        deliver(value)
        for read in (meter.measure, meter.glance, lambda: meter.power):
            with pytest.raises(DeviceError, match=f"^heater: power is {value}, no number"):
                read()


def test_another_instrument_is_refused(connect, device, twin):
    twin.words[0x02] = 3
    with pytest.raises(DeviceError, match="is another instrument now"):
        device.reconnect()
    twin.words[0x00] = 1411
    with pytest.raises(DeviceConnectionError, match="has 1411 in register 0x0000, expected 1410; check the address"):
        connect()
    del twin.words[0x00]
    with pytest.raises(DeviceConnectionError, match=r"refuses: .*illegal data address.*; check the address"):
        connect()


def test_a_rig_file_can_have_the_table(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    (entry,) = load_rig(str(path)).devices
    assert entry.driver is ModbusActuator
    assert entry.settings.signals["temperature"].at == 0x10
    with pytest.raises(ConfigurationError, match=r"devices\.heater\.setpoint.*does not fit into a register U16"):
        load_rig(str(path), {"devices.heater.setpoint.limits": [-1.0, 50.0]})


RIG = """
[rig]
title = "a heater"
[devices.heater]
driver = "modbus-actuator"
port = "/dev/ttyUSB0"
[devices.heater.signals.temperature]
at = 0x10
kind = "I16"
scale = 0.1
unit = "°C"
[devices.heater.setpoint]
at = 0x20
kind = "U16"
unit = "W"
limits = [0.0, 50.0]
[devices.heater.output]
at = 0x21
"""

WRONG = {
    "limits of a register": (
        {"setpoint": {"at": 1, "kind": "U16", "unit": "W", "limits": [-5, 5]}},
        "does not fit",
    ),
    "an address": ({"output": {"at": 70000}}, "65535"),
    "on and off": ({"output": {"at": 1, "on": 0}}, "on and off are both 0"),
    "an arrival": (
        {"setpoint": {"at": 1, "unit": "W", "limits": [0, 5], "arrival": {"signal": "x", "tolerance": 1}}},
        "there is no such signal",
    ),
    "a value": ({"setup": [{"at": 1, "value": 70000}]}, "70000 does not fit into a register U16"),
}


@cases("case", list(WRONG))
def test_a_wrong_key_is_refused(case):
    changes, expected = WRONG[case]
    with pytest.raises(ValidationError, match=expected):
        Heater.Settings(port="emulated://heater", **changes)
