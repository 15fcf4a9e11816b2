"""What is wrong with the table of a text instrument."""

import pytest
from cases import cases

from bench.base import ConfigurationError
from bench.rig import load_rig

RIG = """
[rig]
title = "one supply"

[devices.supply]
driver = "scpi-actuator"
port = "emulated://supply"
identity = "EXAMPLE,{any}"
error_query = "SYST:ERR?"

[devices.supply.signals.voltage]
query = "MEAS:VOLT?"
unit = "V"

[devices.supply.setpoint]
command = "VOLT {value:.3f}"
query = "VOLT?"
unit = "V"
limits = [0.0, 30.0]

[devices.supply.output]
on = ["OUTP ON"]
off = ["OUTP OFF"]
query = "OUTP?"

[emulation]
laboratory = "scpi"
"""

WRONG = {
    "setpoint.command=VOLT {volts}": ("setpoint.command = 'VOLT {volts}'", "allowed: {value}"),
    "setpoint.command=VOLT 5": ("setpoint.command", "{value} is missing"),
    "setpoint.command=VOLT {value:q}": ("setpoint.command", "Unknown format code 'q'"),
    "setpoint.command=VOLT {value:%}": ("setpoint.command", "no number"),
    "setpoint.command=VOLT {value": ("setpoint.command", "a brace of the message itself is doubled"),
    "setpoint.limits=[30.0, 0.0]": ("setpoint.limits", "expected the lower limit first"),
    "setpoint.limits=[0.0, 29.99999]": ("setpoint.command", "writes the limit 29.99999 as 30;"),
    "setpoint.limits=30": ("setpoint.limits",),
    "setpoint.unit=volt-ish": ("setpoint.unit = 'volt-ish': is no unit",),
    "setpoint.scale=0": ("setpoint.scale = 0", "a number other than 0"),
    "setpoint.reply=VOLT": ("setpoint.reply", "{value} is missing"),
    'setpoint.arrival={signal = "current", tolerance = 0.1}': ("setpoint", "'current': there is no such signal"),
    "signals.voltage.reply=VOLT": ("signals.voltage.reply = 'VOLT': has no placeholder",),
    "signals.voltage.reply={number}": ("signals", "{number} is no placeholder here"),
    "signals.voltage.query=MEAS {value}?": ("signals.voltage.query", "{value} is no placeholder here"),
    "signals.voltage.limits=[2.0, 2.0]": ("signals.voltage.limits", "expected the lower limit first"),
    'signals.current={query = "MEAS:VOLT?", unit = "A", reply = "{any}{value}"}': (
        "signals",
        "voltage and current have the same query 'MEAS:VOLT?'",
    ),
    "signals.voltage.reply={unit}{value}": ("signals.voltage.reply", "{unit} is expected directly behind the number"),
    "signals.voltage.reply={value}5": ("signals.voltage.reply", "has no number that can be told"),
    "signals.voltage.reply={any}5{value}": ("signals.voltage.reply", "has no number that can be told"),
    'signals.voltage={query = "V?", unit = "V", scale = 1e-3, reply = "{value}{unit}"}': (
        "signals.voltage.reply",
        "scale is not needed",
    ),
    "decimal=;": ("decimal = ';'",),
    "identity={value}": ("identity = '{value}'", "allowed: {any}"),
    "write_terminator= ": ("write_terminator",),
    "encoding=utf-16": ("encoding = 'utf-16'", "extends ASCII"),
    "port=tcp://192.0.2.5": ("port = 'tcp://192.0.2.5'", "tcp://HOST:PORT"),
    "output.off=[]": ("output.off",),
    'setup=["A\\nB"]': ("setup.0", "cannot be printed"),
    "colour=red": ("colour: there is no such key",),
}  # fmt: skip
"""Wrong keys, and what the message has to say."""


@cases("change", WRONG)
def test_a_wrong_key_is_one_clear_message_before_anything_is_opened(change, tmp_path):
    (tmp_path / "rig.toml").write_text(RIG)
    key, _, value = change.partition("=")
    with pytest.raises(ConfigurationError) as raised:
        load_rig(str(tmp_path / "rig.toml"), {f"devices.supply.{key}": value})
    message = str(raised.value)
    assert len(message.splitlines()) == 1
    assert message.startswith(f"{tmp_path / 'rig.toml'}: devices.supply.")
    for part in WRONG[change]:
        assert part in message


def test_without_pyvisa_a_visa_address_says_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "rig.toml").write_text(RIG)
    monkeypatch.setattr("drivers.scpi.transport.importlib.util.find_spec", lambda _: None)
    with pytest.raises(ConfigurationError, match=r"devices\.supply\.port = .* pip install '.+\[visa\]'"):
        load_rig(str(tmp_path / "rig.toml"), {"devices.supply.port": "visa://ASRL1::INSTR"})


def test_a_table_without_changes_is_right(tmp_path):
    (tmp_path / "rig.toml").write_text(RIG)
    assert load_rig(str(tmp_path / "rig.toml")).emulated


WRONG_PHYSICS = {
    'supply_volt={noise = 1.0}': ("supply_volt: there is no such signal", "supply_voltage"),
    'supply_voltage={expression = "supply_voltage"}': ("in a circle; give one a time_constant",),
    'supply_voltage={expression = "supply_output + room"}': ("there is no room",),
    'supply_voltage={expression = "2 +"}': ("supply_voltage: ", "is not an arithmetic expression"),
    'supply_voltage={expression = "r * supply_output", constants = { r = "2 ohm" }}': ("not in unit = 'V'",),
    'supply_voltage={time_constant = -1.0}': ("time_constant",),
    'supply_voltage={lag = 1.0}': ("lag: there is no such key",),
}  # fmt: skip


@cases("change", WRONG_PHYSICS)
def test_wrong_physics_is_one_clear_message(change, tmp_path):
    (tmp_path / "rig.toml").write_text(RIG + "\n[emulation.signals]\n")
    key, _, value = change.partition("=")
    with pytest.raises(ConfigurationError) as raised:
        load_rig(str(tmp_path / "rig.toml"), {f"emulation.signals.{key}": value})
    assert str(raised.value).startswith(f"{tmp_path / 'rig.toml'}: emulation.signals")
    for part in WRONG_PHYSICS[change]:
        assert part in str(raised.value)


def test_a_signal_in_another_unit_than_the_output_needs_an_expression(tmp_path):
    (tmp_path / "rig.toml").write_text(RIG)
    with pytest.raises(ConfigurationError, match="supply_voltage: needs an expression over supply_output"):
        load_rig(str(tmp_path / "rig.toml"), {"devices.supply.signals.voltage.unit": "A"})


def test_two_instruments_do_not_share_an_emulated_port(tmp_path):
    second = (
        RIG.partition("[devices.supply]")[2].partition("[emulation]")[0].replace("devices.supply", "devices.other")
    )
    (tmp_path / "rig.toml").write_text(f"{RIG}\n[devices.other]{second}")
    with pytest.raises(ConfigurationError, match="supply and other have the same port emulated://supply"):
        load_rig(str(tmp_path / "rig.toml"))


def test_with_a_decimal_comma_no_comma_separates_numbers(tmp_path):
    both = 'query = "BOTH?"\nreply = "{voltage:.1f},{current:.1f}"\nunit = "V"'
    signals = f"[devices.supply.signals.voltage]\n{both}\n[devices.supply.signals.current]\n{both}"
    begin, rest = RIG.split("[devices.supply.signals.voltage]")
    (tmp_path / "rig.toml").write_text(begin + signals + rest.partition('unit = "V"')[2])
    load_rig(str(tmp_path / "rig.toml"))
    with pytest.raises(ConfigurationError, match=r"signals\.voltage\.reply = .*, decimal = ',': .* has no number"):
        load_rig(str(tmp_path / "rig.toml"), {"devices.supply.decimal": ","})
