"""Lines in a rig file: what devices take from them, and what is refused before anything moves."""

import pytest
from cases import cases

from bench.base import ConfigurationError
from bench.rig import load_rig

SUPPLY = "examples/shared-line.toml"


def settings_of(file):
    return {entry.name: entry.settings for entry in file.devices}


def test_a_device_has_the_keys_of_its_line(buses):
    settings = settings_of(load_rig(buses, {"lines.cells.timeout": "0.3", "devices.servo2.timeout": "0.05"}))
    for name in ("load1", "load2"):
        assert (settings[name].port, settings[name].line) == ("emulated://load1+load2", "cells")
        assert (settings[name].baudrate, settings[name].timeout) == (115200, 0.3)
    assert [settings[f"servo{number}"].timeout for number in (1, 2, 3)] == [0.1, 0.05, 0.1]


def test_the_address_stands_for_its_placeholder_everywhere():
    settings = settings_of(load_rig(SUPPLY))["supply"]
    assert settings.setpoint.command == "#01SET {value:.3f}"
    assert settings.output.off == ("#01OUT 0",)
    assert settings.identity == "#01,EXAMPLE,PS-485,{any}"
    assert settings.signals["voltage"].reply == "#01,V,{value}"
    assert settings_of(load_rig(SUPPLY, {"devices.plate.address": "7"}))["plate"].identity_query == "#7ID?"


@cases(
    ("rig", "changes", "expected"),
    [
        (
            "buses",
            {"devices.load2.line": '"bus"'},
            r"devices\.load2\.line = 'bus': .*cells, servos, tecs, heaters, can",
        ),
        ("buses", {"devices.load2.address": "1"}, r"devices\.load2\.address = 1: devices\.load1 .* line cells"),
        ("buses", {"devices.servo3.id": "253"}, r"devices\.servo3\.id = 253: .*252"),
        (
            "buses",
            {"devices.load2.baudrate": "9600"},
            r"devices\.load2\.baudrate = 9600: stands in lines\.cells as well, as 115200",
        ),
        (
            "buses",
            {"devices.load2.echo": "true"},
            r"lines\.cells\.echo: one value .* False for load1, True for load2",
        ),
        (
            "buses",
            {"lines.tecs.port": '"emulated://load1+load2"'},
            r"devices\.tec1\.port = .*: is that of lines\.cells",
        ),
        ("buses", {"lines.cells.party": '"E"'}, r"devices\.load1\.party: there is no such key"),
        ("buses", {"lines.cells.timeout": "0.5"}, r"lines\.cells\.timeout = 0\.5: .* timeout of 0\.429 s at most"),
        ("buses", {"devices.load2.timeout": "3.0"}, r"devices\.load2\.timeout = 3: when load2 falls silent"),
        (
            "buses",
            {"lines.cells.timeout": "0.4", "safety.rate": "1.0"},
            r"0\.4: .* not asked for 1\.4 s; allowed are 1 s with safety\.rate = 1, so .* 0\.286 s",
        ),
        (
            "buses",
            {"safety.rate": "0.4"},
            r"allowed are 0 s with safety\.rate = 0\.4, so a safety\.rate of 2 Hz at least",
        ),
        ("supply", {"devices.plate.address": '""'}, r"devices\.plate\.line = 'bus': needs the key address"),
        (
            "supply",
            {"devices.meter": '{driver = "scpi-sensor", port = "x", identity = "{address}", signals = {}}'},
            r"devices\.meter.*\{address\} stands in its messages, so the key address is needed",
        ),
        ("supply", {"lines.bus.port": '"visa://GPIB0::3::INSTR"'}, r"line = 'bus': a VISA resource|needs pyvisa"),
        ("supply", {"lines.bus.timeout": "1.0"}, r"lines\.bus\.timeout = 1: .* at most"),
    ],
)
def test_what_cannot_be_is_refused(buses, rig, changes, expected):
    with pytest.raises(ConfigurationError, match=expected):
        load_rig(buses if rig == "buses" else SUPPLY, changes)


def test_a_line_without_a_device_and_a_device_without_a_line_are_refused(tmp_path, buses):
    file = tmp_path / "rig.toml"
    file.write_text(f'extends = "{buses}"\nwithout = ["emulation"]\n[lines.spare]\nport = "/dev/ttyUSB7"\n')
    with pytest.raises(ConfigurationError, match=r"lines\.spare: no device is on it"):
        load_rig(str(file))
    file.write_text(f'extends = "{buses}"\nwithout = ["lines"]\n')
    with pytest.raises(
        ConfigurationError,
        match=r"devices\.load1\.line = 'cells': there is no such line; the rig has no \[lines\.NAME\]",
    ):
        load_rig(str(file))


def test_a_driver_without_an_address_is_refused_on_a_line(tmp_path):
    file = tmp_path / "rig.toml"
    file.write_text(
        '[rig]\ntitle = "x"\n[lines.bus]\nport = "/dev/ttyUSB7"\nbaudrate = 9600\n'
        '[devices.a]\ndriver = "unaddressed:Unaddressed"\nline = "bus"\n'
    )
    (tmp_path / "unaddressed.py").write_text(
        "from drivers.serial_line import SerialSettings\n"
        "from drivers.twin import TwinSensor\n"
        "class Unaddressed(TwinSensor):\n"
        "    Settings = SerialSettings\n"
    )
    with pytest.raises(ConfigurationError, match=r"devices\.a\.line = 'bus': its driver knows no address"):
        load_rig(str(file))


def test_an_emulated_line_of_what_is_not_there_is_refused(connected):
    expected = r"load1\.port = 'emulated://load1\+load9'.*emulated://load1, "
    with pytest.raises(ConfigurationError, match=expected), connected(lines__cells__port="emulated://load1+load9"):
        pass


def test_a_number_called_line_is_still_a_number():
    settings = settings_of(load_rig("sma"))
    assert settings["fan"].line == 0
