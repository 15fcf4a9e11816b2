"""Instruments from documents: their rigs run emulated, and answers in the forms that the manuals print are read."""

from pathlib import Path

import pytest
from cases import cases

from bench.base import ConfigurationError, DeviceConnectionError, DeviceError, VirtualClock
from bench.rig import Rig, load_rig
from sim_devices import protocol_emulated
from sim_devices.wire import WireServer

FOLDER = Path(__file__).parents[3] / "examples" / "instruments"
FILES = sorted(file.name for file in FOLDER.glob("*.toml"))


class Printed(WireServer):
    """An instrument that answers as its manual prints."""

    def __init__(self, answers, end):
        self.answers, self.end = answers, end
        self.received = b""

    def receive(self, data):
        *messages, self.received = (self.received + data).split(self.end)
        answers = (self.answers.get(message.decode()) for message in messages)
        return b"".join(answer.encode() + self.end for answer in answers if answer is not None)


@pytest.fixture
def connect(request):
    def connect(name, answers, **changes):
        (entry,) = load_rig(str(FOLDER / name)).devices
        clock = VirtualClock()
        server = Printed(answers, entry.settings.read_terminator.encode())
        port = protocol_emulated.register("printed", server, clock)
        request.addfinalizer(lambda: protocol_emulated.unregister("printed"))
        return entry.driver.connect(entry.name, entry.settings.model_copy(update={"port": port, **changes}), clock)

    return connect


# The identities are printed; numbers are in the form of the manual, where it prints none.
TED4015 = {
    # 3.1.1, with TED4015 in the place of ITC4020.
    "*IDN?": "THORLABS,TED4015,E12345678,1.4.0/2.0.3/1.6.0",
    "SYST:ERR?": '+0,"No error"',
    "SOUR:TEMP? MIN": "-5.500000E+01",
    "SOUR:TEMP? MAX": "1.500000E+02",
    "MEAS:TEMP?": "2.50012E+01",
    "MEAS:CURR3?": "-1.2E-01",
}
KEITHLEY = {
    # Model 2000, page 4-43, and the ASCII data format of the 2182, figure 15-1.
    "*IDN?": "KEITHLEY INSTRUMENTS INC., MODEL 2182A, 1234567, A08  /A02",
    "SYST:ERR?": "0, No error",
    "READ?": "+1.23456789E-02VDC",
}
KEYSIGHT = {
    # E3632A User's Guide, page 99.
    "*IDN?": "HEWLETT-PACKARD,E3632A,0,1.1-5.0-1.0",
    "SYST:ERR?": '+0,"No error"',
    "VOLT? MIN": "+0.00000000E+00",
    # Page 88: of the selected range, which is that of 15 V at first.
    "VOLT? MAX": "+1.54500000E+01",
    "MEAS:VOLT?": "+1.20012000E+00",
    "MEAS:CURR?": "+5.99870000E-02",
}


@cases(
    ("name", "answers", "serial_number", "values"),
    [
        ("thorlabs-ted4015.toml", TED4015, "E12345678", {"plate_temperature": 25.0012, "plate_current": -0.12}),
        ("keithley-2182a.toml", KEITHLEY, "1234567", {"meter_voltage": 1.23456789e-2}),
        ("keysight-e3632a.toml", KEYSIGHT, "0", {"supply_voltage": 1.20012, "supply_current": 0.059987}),
        # The table of 5-6.
        ("keyence-lk-g5000.toml", {"MS,01": "MS,01,+01.2345"}, "unknown", {"laser_position": 1.2345e-3}),
        ("keyence-lk-g5000.toml", {"MS,01": "MS,01,-00.0120"}, "unknown", {"laser_position": -12e-6}),
        ("keyence-lk-g5000.toml", {"MS,01": "MS,01,-00001.2"}, "unknown", {"laser_position": -1.2e-3}),
    ],
)
def test_answers_as_the_manuals_print_them_are_read(connect, name, answers, serial_number, values):
    device = connect(name, answers)
    assert device.identity.serial_number == serial_number
    assert device.measure() == pytest.approx(values, rel=1e-9)
    protocol_emulated.unregister("printed")


def test_limits_beyond_the_selected_range_are_refused_on_connecting(connect):
    (entry,) = load_rig(str(FOLDER / "keysight-e3632a.toml"), {"devices.supply.setpoint.limits": "[0, 20]"}).devices
    with pytest.raises(ConfigurationError, match=r"limits = 0 to 20 V: the instrument takes 0 to 15\.45 V"):
        connect("keysight-e3632a.toml", KEYSIGHT, setpoint=entry.settings.setpoint)


@cases(
    ("name", "answers", "changed"),
    [
        # Overflow, and a reading of its temperature.
        ("keithley-2182a.toml", KEITHLEY, {"READ?": "+9.9E37"}),
        ("keithley-2182a.toml", KEITHLEY, {"READ?": "+2.31234567E+01C"}),
        # No value, out of range, and errors (5-5, 5-6).
        ("keyence-lk-g5000.toml", {"MS,01": "MS,01,+00.0000"}, {"MS,01": "MS,01,XXXXXXXX"}),
        ("keyence-lk-g5000.toml", {"MS,01": "MS,01,+00.0000"}, {"MS,01": "MS,01,+FFFFFFF"}),
        ("keyence-lk-g5000.toml", {"MS,01": "MS,01,+00.0000"}, {"MS,01": "MS,01,-FFFFFFF"}),
        ("keyence-lk-g5000.toml", {"MS,01": "MS,01,+00.0000"}, {"MS,01": "ER,MS,50"}),
        ("keyence-lk-g5000.toml", {"MS,01": "MS,01,+00.0000"}, {"MS,01": "MS,02,+00.0000"}),
    ],
)
def test_what_stands_for_no_value_is_an_error(connect, name, answers, changed):
    answers = dict(answers)
    device = connect(name, answers)
    device.measure()
    answers.update(changed)
    with pytest.raises(DeviceError, match="answered"):
        device.measure()
    protocol_emulated.unregister("printed")


def test_a_supply_whose_serial_number_is_always_0_says_that_it_has_none(connect):
    with pytest.raises(DeviceConnectionError, match="does not tell its serial number"):
        connect("keysight-e3632a.toml", KEYSIGHT, serial_number="US12345678")


@pytest.mark.parametrize("name", FILES)
def test_its_emulated_rig_measures_within_its_limits_and_is_safe(name):
    with Rig(load_rig(str(FOLDER / name)), VirtualClock(), seed=0) as rig:
        rig.clock.sleep(1.0)
        first = rig.measure()
        assert first
        for device in rig.devices.values():
            assert device.identity.model
            if hasattr(device, "set"):
                low, high = device.limits.low, device.limits.high
                device.set(0.5 * (low + high)).wait()
                rig.clock.sleep(60.0)
                assert rig.measure()[f"{device.name}_setpoint"] == pytest.approx(0.5 * (low + high))
                device.safe()
