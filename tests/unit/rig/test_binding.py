"""Slots: what a rig file binds, what protocols take from it, and what is refused before anything moves."""

import pytest
from cases import cases
from heater_laboratory import CLOSED

from bench.base import ConfigurationError, VirtualClock
from bench.cli import main
from bench.devices import Servo, Signal, TECAmplifier
from bench.protocol import Dwell, ProtocolParameters, Step, UntilSteady, find_protocol, from_slot, parameter, protocol
from bench.rig import Rig, RoleTable, load_rig

ROLES = """
[roles.drive]
device = "tec"
reading = "tec_temperature"
unit = "°C"
range = [30.0, 60.0]
rest = 30.0
dwell = 4.0
increment = 5.0

[roles.drive.reset]
drift = 0.02
noise = 0.01
timeout = 90.0

[roles.response]
signal = "probe_temperature"
unit = "°C"
"""


class Parameters(ProtocolParameters):
    low: float = parameter(from_slot("drive", "low"), unit="@drive", help="where it begins")
    middle: float = parameter(
        from_slot("drive", lambda drive: drive.at(0.5), "the middle"), unit="@drive", help="then"
    )
    speed: float = parameter(from_slot("drive", "rate", fallback=2.0), unit="@drive/s", help="how fast")
    count: int = parameter(3, unit="1", low=1, high=9, help="how often")


def go(parameters, slots):
    """Go there."""
    yield Step({slots["drive"].device: parameters.low}, slots["drive"].settle(1.0))


go.__annotations__ = {"parameters": Parameters, "slots": dict}


def define(**needs):
    return protocol(needs=needs)(go)


PLAIN = define(drive=TECAmplifier, response=Signal)


def refused(path, definition=PLAIN, settings=None):
    """Load, parse and connect; return the one message, which names the file. Nothing has moved."""
    CLOSED.clear()
    with pytest.raises(ConfigurationError) as caught:  # noqa: PT012 - each of these may refuse
        file = load_rig(path)
        definition.parse(settings or {}, file.roles, file.protocols.get(definition.name), path=path)
        rig = Rig(file, VirtualClock(), 1)
        try:
            rig.description.slots(definition)
        finally:
            assert rig.devices["tec"].calls == []
            rig.close()
    (line,) = str(caught.value).splitlines()
    assert line.startswith(f"{path}: ")
    assert caught.value.exit_code == 2
    return line


class TestRefused:
    @cases(
        ("old", "new", "expected"),
        [
            ('"tec"', '"oven"', "roles.drive.device = 'oven' is not a device of this rig; there are: tec"),
            ('"probe_temperature"', '"spot"', "roles.response.signal = 'spot': there is no such signal; there are: "),
            ('"probe_temperature"\nunit = "°C"', '"tec_current"\nunit = "V"', "response.unit = 'V': tec_current is"),
            ("drift = 0.02\nnoise = 0.01\n", "", "roles.drive.reset: expected either drift and noise, or seconds"),
            ("noise = 0.01", "noise = 0.01\nseconds = 5", "roles.drive.reset: expected either drift and noise, or"),
            ("drift = 0.02", 'drift = 0.02\nsignal = "gone"', "roles.drive.reset.signal = 'gone': there is no such"),
            ('device = "tec"', 'device = "tec"\nsignal = "tec_temperature"', "roles.drive: expected either device"),
            ('device = "tec"\nreading = "tec_temperature"\n', "", "roles.drive: expected either device (and"),
            ('"probe_temperature"', '"probe_temperature"\nreading = "x"', "roles.response: reading belongs to a"),
            ("[30.0, 60.0]", "[60.0, 30.0]", "roles.drive.range = [60.0, 30.0]: expected two numbers, the lower one"),
            ("rest = 30.0", "resting = 30.0", "roles.drive.resting: there is no such key; did you mean rest?"),
            ("rest = 30.0", 'prompt = "Set {x}"', "roles.drive.prompt = 'Set {x}'"),
            ("rest = 30.0", 'prompt = "Set {"', "roles.drive.prompt = 'Set {': only {value} and {unit} can stand in"),
            ("dwell = 4.0", "dwell = 0", "roles.drive.dwell = 0: expected a number > 0 (hold at each set-point"),
        ],
    )
    def test_what_the_file_says(self, rig_file, old, new, expected):
        assert old in ROLES
        assert expected in refused(rig_file(append=ROLES.replace(old, new)))

    def test_a_slot_that_is_not_bound(self, rig_file):
        path = rig_file(append=ROLES)
        assert refused(path, define(drive=TECAmplifier, fine=Servo, load=Signal)) == (
            f"{path}: protocol go needs [roles.fine], [roles.load]; the file binds: drive, response"
        )

    def test_a_slot_of_the_wrong_kind(self, rig_file):
        path = rig_file(append=ROLES)
        assert refused(path, define(drive=Servo)) == (
            f"{path}: roles.drive: protocol go needs a Servo, and device 'tec' is none; fitting devices: none"
        )
        assert refused(path, define(drive=TECAmplifier, response=TECAmplifier)) == (
            f"{path}: roles.response: protocol go needs a TECAmplifier, and signal 'probe_temperature' is none; "
            "fitting devices: tec"
        )

    @cases(
        ("table", "expected"),
        [
            ("cuont = 3", "protocols.go.cuont: there is no such parameter; did you mean count?"),
            ("count = 30", "protocols.go.count: protocol go: parameter count = 30 is not allowed; allowed: 1 to 9"),
            ("low = 'warm'", "protocols.go.low: protocol go: parameter low = 'warm' is not allowed"),
        ],
    )
    def test_the_table_of_a_protocol(self, rig_file, table, expected):
        path = rig_file(append=f"{ROLES}\n[protocols.go]\n{table}\n")
        assert refused(path).startswith(f"{path}: {expected}")

    def test_a_wrong_value_names_the_unit_of_the_slot(self, rig_file):
        file = load_rig(rig_file(append=ROLES))
        with pytest.raises(ConfigurationError, match=r"low = 'warm' is not allowed; allowed: any number °C \("):
            PLAIN.parse({"low": "warm"}, file.roles, path=file.path)

    def test_without_a_rig_the_unit_is_that_of_the_slot(self):
        with pytest.raises(ConfigurationError) as caught:
            PLAIN.parse({"low": "warm", "speed": "fast"})
        assert "low = 'warm' is not allowed; allowed: any number, in the unit of the drive (" in str(caught.value)
        assert "speed = 'fast' is not allowed; allowed: any number, in the unit of the drive per second (" in str(
            caught.value
        )

    def test_what_is_set_is_not_blamed_on_the_file(self, rig_file):
        file = load_rig(rig_file(append=f"{ROLES}\n[protocols.go]\ncount = 5\n"))
        with pytest.raises(ConfigurationError, match=r"^protocol go: parameter count = '30' is not allowed"):
            PLAIN.parse({"count": "30"}, file.roles, file.protocols["go"], path=file.path)

    def test_what_the_rig_does_not_say_must_be_given(self, rig_file):
        file = load_rig(rig_file(append=ROLES.replace("range = [30.0, 60.0]\n", "")))
        with pytest.raises(
            ConfigurationError, match=r"parameter low is missing \(the rig file does not say `low` of d"
        ):
            PLAIN.parse({"middle": "4"}, file.roles)
        assert PLAIN.parse({"low": "30", "middle": "4"}, file.roles).low == 30.0


class TestDefaults:
    def test_settings_before_table_before_roles_before_protocol(self, rig_file):
        file = load_rig(rig_file(append=f"{ROLES}\n[protocols.go]\nmiddle = 41.0\ncount = 5\n"))
        assert vars(PLAIN.parse({}, file.roles)) == {"low": 30.0, "middle": 45.0, "speed": 2.0, "count": 3}
        table = file.protocols["go"]
        assert vars(PLAIN.parse({}, file.roles, table)) == {"low": 30.0, "middle": 41.0, "speed": 2.0, "count": 5}
        found = PLAIN.parse({"middle": "42", "low": "31"}, file.roles, table)
        assert vars(found) == {"low": 31.0, "middle": 42.0, "speed": 2.0, "count": 5}

    def test_a_slot_has_what_the_rig_says(self, rig_file):
        with Rig(load_rig(rig_file(append=ROLES)), VirtualClock(), 1) as rig:
            drive, response = rig.description.slots(PLAIN).values()
        assert (drive.device, drive.signal, drive.unit, drive.setpoint_unit) == ("tec", "tec_temperature", "°C", "°C")
        assert (drive.setpoint_signal, drive.rate_unit) == ("tec_setpoint", "K/s")
        assert (response.device, response.signal, response.setpoint_unit) == ("", "probe_temperature", "")
        assert drive.settle(1.0) == UntilSteady("tec_temperature", drift=0.02, noise=0.01, timeout=90.0, minimum=1.0)
        assert response.settle(2.0) == Dwell(2.0)

    def test_the_first_signal_of_a_device_is_its_reading(self, rig_file):
        text = ROLES.replace('reading = "tec_temperature"\n', "")
        with Rig(load_rig(rig_file(append=text)), VirtualClock(), 1) as rig:
            assert rig.description.slots(PLAIN)["drive"].signal == "tec_temperature"

    def test_a_reset_of_a_fixed_time(self, rig_file):
        text = ROLES.replace("drift = 0.02\nnoise = 0.01\n", "seconds = 20\nsetpoint = 25\n")
        with Rig(load_rig(rig_file(append=text)), VirtualClock(), 1) as rig:
            drive = rig.description.slots(PLAIN)["drive"]
        assert [drive.settle(least) for least in (5.0, 30.0)] == [Dwell(20.0), Dwell(30.0)]
        assert drive.table.saturating == 25.0

    def test_a_part_of_the_range(self):
        table = RoleTable(device="x", range=(-1.0, 2.0))
        assert [table.at(part) for part in (0.0, 0.5, 1.0)] == [-1.0, 0.5, 2.0]
        assert (table.low, table.high, table.saturating) == (-1.0, 2.0, -1.0)
        assert RoleTable(device="x").at(0.5) is None

    @pytest.mark.parametrize(
        ("rig", "expected"),
        [
            ("vo2", {"low": ("21.0", "°C"), "center": ("54.0", "°C"), "increment": ("0.35", "K")}),
            ("sma", {"low": ("0.0", "V"), "center": ("1.5", "V"), "load": ("4.9", "N")}),
            (None, {"low": ("the rig's: `low` of drive", "unit of drive")}),
        ],
    )
    def test_help_with_a_rig_shows_its_defaults_and_units(self, rig, expected, capsys):
        command = ["run", "damped-oscillation", *(["--rig", rig] if rig else []), "--help"]
        with pytest.raises(SystemExit) as stopped:
            main(command)
        assert not stopped.value.code
        printed = capsys.readouterr().out.split("parameters")[-1]
        assert all(unit in printed for unit in ("°C",) * (rig == "vo2") + ("4.9",) * (rig == "sma"))
        definition = find_protocol("damped-oscillation")
        file = load_rig(rig) if rig else None
        entries = definition.help(file.roles, file.protocols.get(definition.name)) if file else definition.help()
        shown = {entry.name: (entry.default, entry.unit) for entry in entries}
        assert {name: shown[name] for name in expected} == expected

    def test_a_parameter_of_a_slot_that_the_rig_does_not_bind_is_left_out(self):
        definition = find_protocol("damped-oscillation")
        shown = {rig: {entry.name for entry in definition.help(load_rig(rig).roles)} for rig in ("vo2", "sma")}
        assert shown["sma"] - shown["vo2"] == {"load"}
