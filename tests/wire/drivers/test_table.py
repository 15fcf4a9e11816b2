"""Devices whose table stands in their class."""

import pickle

import numpy as np
import pytest
from cases import cases

from bench.base import ConfigurationError, DeviceError, DeviceRestartedError, LimitError, VirtualClock
from bench.devices import Limits, TemperatureSensor
from bench.rig import load_rig
from drivers.scpi import SCPIActuator, SCPISensor
from drivers.table import Reading, Setpoint
from sim_devices import protocol_emulated
from sim_devices.wire.text import LineServer

OUTPUT = {"on": ["HEAT ON"], "off": ["HEAT OFF"], "query": "HEAT?"}


class Oven(SCPIActuator, TemperatureSensor, identity="Example,Oven,{any}", output=OUTPUT):
    """A small oven."""

    temperature = Reading("T?", "°C", (-10.0, 300.0), "temperature inside", reply="{value} C")
    current = Reading("I?", "A", None, "current of the heater", scale=1e-3)
    power = Setpoint("P {value:.1f}", "W", (0.0, 50.0), "power of the heater", query="P?")


class OvenTwin(LineServer):
    def __init__(self):
        self.power, self.on, self.asked = 0.0, False, []
        self.temperature = 22.5

    def answer(self, message):
        self.asked.append(message)
        match message.split():
            case ["*IDN?"]:
                return "Example,Oven,7,1.0"
            case ["T?"]:
                return f"{self.temperature} C"
            case ["I?"]:
                return "250"
            case ["P", value]:
                self.power = float(value)
            case ["P?"]:
                return f"{self.power}"
            case ["HEAT", state]:
                self.on = state == "ON"
            case ["HEAT?"]:
                return f"{self.on:d}"
        return None


@pytest.fixture
def twin():
    return OvenTwin()


@pytest.fixture
def connect(twin):
    clock = VirtualClock()
    port = protocol_emulated.register("oven", twin, clock)
    yield lambda kind=Oven, **changes: kind.connect("oven", kind.Settings(port=port, **changes), clock)
    protocol_emulated.unregister(port)


@pytest.fixture
def oven(connect):
    return connect()


def test_a_row_is_a_signal_and_an_attribute(oven, twin):
    assert [(each.name, each.unit, each.description) for each in oven.signals] == [
        ("oven_temperature", "°C", "temperature inside"),
        ("oven_current", "A", "current of the heater"),
    ]
    assert oven.measure() == oven.glance() == {"oven_temperature": 22.5, "oven_current": 0.25}
    twin.asked.clear()
    assert oven.current == 0.25
    assert twin.asked == ["I?"]
    assert isinstance(oven, TemperatureSensor)
    assert Oven.current.__doc__ == "Current of the heater, A."


def test_ranges_of_rows_are_the_limits_of_readings_and_set_points(oven, twin):
    assert oven.reading_limits == {"oven_temperature": Limits(-10.0, 300.0, "°C")}
    assert oven.limits == Limits(0.0, 50.0, "W")
    twin.temperature = 301.0
    for read in (oven.measure, oven.glance, lambda: oven.temperature):
        with pytest.raises(DeviceError, match="oven: temperature is 301 °C, outside of -10 to 300 °C"):
            read()


def test_a_set_point_is_assigned_and_read_back(oven, twin):
    oven.power = 20.0
    assert (twin.power, twin.on, oven.setpoint) == (20.0, True, 20.0)
    twin.power = 19.0
    assert oven.power == 19.0
    with pytest.raises(LimitError, match="set-point 51 W is outside of 0 to 50 W"):
        oven.power = 51.0
    assert twin.power == 19.0


@pytest.mark.parametrize("first", ["temperature", "power", "glance", "measure"])
def test_a_restart_is_found_and_nothing_is_set_after_it(oven, twin, first):
    oven.power = 20.0
    twin.power, twin.on = 0.0, False
    with pytest.raises(DeviceRestartedError, match="it has restarted"):
        getattr(oven, first)()
    for act in (oven.glance, lambda: oven.temperature, lambda: oven.set(5.0), lambda: oven.power):
        with pytest.raises(DeviceRestartedError, match="it has restarted"):
            act()
        assert (twin.power, twin.on) == (0.0, False)
    oven.safe()


def test_the_settings_say_otherwise_key_by_key(connect, twin):
    oven = connect(setpoint={"limits": [0.0, 30.0]}, signals={"temperature": {"limits": [0.0, 20.0]}})
    assert oven.limits == Limits(0.0, 30.0, "W")
    assert oven.reading_limits == {"oven_temperature": Limits(0.0, 20.0, "°C")}
    assert oven.current == 0.25
    oven.power = 10.0
    assert twin.power == 10.0
    for settings in (Oven.Settings(port="a"), Oven.Settings.model_validate({"port": "a"})):
        assert settings.setpoint.limits == (0.0, 50.0)
        assert settings.signals["temperature"].limits == (-10.0, 300.0)
    more = connect(signals={"heat": {"query": "P?", "unit": "W"}})
    assert [each.name for each in more.signals] == ["oven_temperature", "oven_current", "oven_heat"]


def test_a_subclass_has_the_rows_of_its_base(connect):
    class Larger(Oven):
        current = Reading("I?", "A", (0.0, 0.5), "current of the heater", scale=1e-3)
        asked_for = Reading("P?", "W", None, "power that was asked for")

    names = [each.name for each in connect(Larger).signals]
    assert names == ["oven_temperature", "oven_current", "oven_asked_for"]
    assert "oven_current" in connect(Larger).reading_limits
    assert [each.name for each in connect(Oven).signals] == names[:2]


def test_settings_can_be_sent_to_another_process():
    settings = Oven.Settings(port="emulated://oven")
    assert pickle.loads(pickle.dumps(settings)) == settings


WRONG_ROWS = [
    (lambda: Reading("T? {x}", "°C", None, "temperature"), "signals.temperature.query = 'T? {x}'"),
    (lambda: Reading("T?", "degreez", None, "temperature"), "signals.temperature.unit = 'degreez'"),
    (lambda: Reading("T?", "°C", (5.0, 1.0), "temperature"), "signals.temperature.limits"),
    (lambda: Reading("T?", "°C", None, "temperature", replies="{value}"), "signals.temperature.replies"),
    (lambda: Reading("T?", "°C", None, "temperature", scale=0.0), "signals.temperature.scale"),
]


@cases(("row", "expected"), WRONG_ROWS)
def test_a_wrong_row_is_one_message_before_anything_is_opened(row, expected, tmp_path, monkeypatch):
    class Wrong(SCPISensor):
        temperature = row()

    monkeypatch.setattr(f"{__name__}.Oven", Wrong)
    path = tmp_path / "rig.toml"
    path.write_text(f'[rig]\ntitle = "x"\n[devices.oven]\ndriver = "{__name__}:Oven"\nport = "emulated://oven"\n')
    with pytest.raises(ConfigurationError) as raised:
        load_rig(str(path))
    assert f"devices.oven.{expected}" in str(raised.value)
    assert len(str(raised.value).splitlines()) == 1


def test_a_class_that_makes_no_sense_is_refused_when_it_is_made():
    with pytest.raises(TypeError, match=r"Typo: 'identiy' is no key of its settings; allowed: .*identity, "):

        class Typo(SCPISensor, identiy="X"):
            pass

    for name, owner in (("limits", "GeneralActuator"), ("setpoint", "GeneralActuator"), ("name", "Device")):
        with pytest.raises((TypeError, RuntimeError)) as raised:
            type("Hiding", (Oven,), {name: Reading("T?", "°C", None, "temperature")})
        # Python 3.11 wraps what a row raises when it is given its name.
        said = str(raised.value.__cause__ or raised.value)
        assert f"Hiding.{name}: {owner} has this name already; choose another" in said
    with pytest.raises(TypeError, match="Two has 2 set-points; a device has one"):

        class Two(Oven):
            other = Setpoint("Q {value:.1f}", "W", (0.0, 50.0), "another")


def test_lines_come_in_pieces_and_what_is_too_long_is_dropped():
    twin = OvenTwin()
    assert twin.receive(b"T") == b""
    assert twin.receive(b"?\nI?\nP 3\nP?") == b"22.5 C\n250\n"
    assert twin.receive(b"\n") == b"3.0\n"
    twin.receive(b"x" * 10_000)
    assert twin.receive(b"\nT?\n") == b"22.5 C\n"
    assert np.isclose(twin.power, 3.0)
