import json
from dataclasses import replace
from datetime import date
from pathlib import Path

import pytest
from cases import cases

from bench.base import ConfigurationError, VirtualClock
from bench.devices import DeviceDescription, Identity, Limits, PositionSensor, Signal, TECAmplifier
from bench.rig import (
    Interlock,
    Rig,
    RigDescription,
    SafetyTable,
    calibration_warnings,
    check_start,
    load_rig,
    packaged_rigs,
    shortened_absences,
)

SUPPLY = Path(__file__).parents[3] / "examples" / "bench-supply.toml"


class Heater(TECAmplifier):
    heats = True


class Cooler(TECAmplifier):
    heats = False


def signals(**units):
    return tuple(Signal(name, unit, name) for name, unit in units.items())


IDENTITY = Identity("Test", "1", "1", "1")
TEC = DeviceDescription(
    name="tec",
    kind=Heater,
    identity=IDENTITY,
    signals=signals(tec_temperature="°C", tec_current="A"),
    setpoint_signal=Signal("tec_setpoint", "°C", "temperature"),
    limits=Limits(15.0, 95.0, "°C"),
    watchdog=5.0,
    safe_within=1.0,
)
COOLER = replace(TEC, kind=Cooler)
PSD = DeviceDescription("psd", PositionSensor, IDENTITY, signals(psd_position="m"), None, None, 2.0, 1.0)
HOT = Interlock(signal="tec_temperature", high=100.0)
DERIVED = """
[derived.twice]
expression = "2 * tec_current"
unit = "A"

[derived.excess]
expression = "twice - offset"
constants = { offset = "1 A" }
unit = "A"
"""


@pytest.fixture
def describe(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('extends = "vo2"\n' + DERIVED)
    file = replace(load_rig(str(path)), path="mine.toml")
    found = (TEC.setpoint_signal, *TEC.signals, *PSD.signals, *signals(curvature="1/m", twice="A", excess="A"))

    def describe(*interlocks, devices=(TEC, PSD), **safety):
        guarded = replace(file, interlocks=interlocks, safety=SafetyTable(**safety))
        return RigDescription(guarded, {device.name: device for device in devices}, found)

    return describe


@pytest.fixture
def check(describe):
    def check(*interlocks, interval=0.2, key="safety.rate", **keys):
        description = describe(*interlocks, **keys)
        return check_start(description, interval=interval, interval_key=key)

    return check


def refused_of(call):
    with pytest.raises(ConfigurationError) as caught:
        call()
    return str(caught.value).splitlines()


def refused(check, *interlocks, **keys):
    lines = refused_of(lambda: check(*interlocks, **keys))
    assert all(line.startswith("mine.toml: ") for line in lines)
    return [line.removeprefix("mine.toml: ") for line in lines]


def test_a_rig_that_is_guarded_starts_without_a_warning(check):
    assert check(HOT) == ()
    assert check(HOT, unattended=False) == ()


class TestIntervals:
    def test_of_the_requests(self, check):
        assert check(HOT, interval=0.8, key="telemetry.period") == ()
        assert refused(check, HOT, interval=0.81, key="telemetry.period") == [
            "telemetry.period: instruments are asked each 0.81 s only, but psd goes to its safe state after 2 s of "
            "silence; 0.8 s, 0.4 of its watchdog, is allowed at most"
        ]

    def test_a_share_that_is_rounded_is_allowed(self, check):
        for watchdog in (0.1, 0.7, 1.1, 2.3, 5.0):
            assert check(HOT, devices=[replace(TEC, watchdog=watchdog)], interval=0.4 * watchdog) == ()
            assert check(HOT, devices=[replace(TEC, watchdog=watchdog)], interval=2.0 * watchdog / 5.0) == ()

    @pytest.mark.parametrize("watchdog", [None, 0.0])
    def test_without_a_watchdog_there_is_no_bound(self, check, watchdog):
        devices = [replace(COOLER, watchdog=watchdog), replace(PSD, watchdog=watchdog)]
        assert check(devices=devices, interval=60.0) == ()


def test_a_key_that_is_cut_short_is_said_with_the_time_that_counts_and_the_cause(describe):
    devices = [TEC, replace(PSD, watchdog=None)]

    def shortened(guarded, reconnect):
        return shortened_absences(describe(HOT, devices=devices, reconnect=reconnect), guarded=guarded)

    said = "safety.reconnect = 10: the line of tec may be lost for"
    assert shortened(guarded=False, reconnect=10.0) == (f"{said} 3 s at most, 0.6 of the watchdog of tec, 5 s",)
    assert shortened(guarded=True, reconnect=10.0) == (f"{said} 2 s at most, as an interlock needs its readings",)
    assert shortened(guarded=False, reconnect=3.0) == shortened(guarded=True, reconnect=2.0) == ()


class TestADeviceThatHeats:
    def test_no_key_is_advised_that_the_driver_does_not_have(self, check, tmp_path):
        (tmp_path / "bench-supply.toml").write_text(SUPPLY.read_text())
        file = load_rig(str(tmp_path / "bench-supply.toml"))
        with Rig(file, VirtualClock(), 0) as rig:
            (problem,) = refused_of(lambda: check_start(rig.description, interval=0.2, interval_key="safety.rate"))
        assert "devices.supply: it heats and has no watchdog" in problem
        assert "expected a driver that has one" in problem
        (problem,) = refused(check, HOT, devices=[replace(TEC, watchdog=None)])
        assert "expected its key watchdog" in problem

    @pytest.mark.parametrize("watchdog", [None, 0.0])
    def test_without_a_watchdog(self, check, watchdog):
        devices = [replace(TEC, watchdog=watchdog)]
        (line,) = refused(check, HOT, devices=devices)
        assert line.startswith("devices.tec: it heats and has no watchdog")
        assert line.endswith("or safety.unattended = false if an operator is present")
        (warning,) = check(HOT, devices=devices, unattended=False)
        assert warning.startswith("mine.toml: devices.tec: it heats and has no watchdog")
        assert warning.endswith("accepted, as safety.unattended = false")

    def test_without_an_interlock(self, check):
        (line,) = refused(check)
        assert line.startswith(
            "devices.tec: it heats, and no interlock of level safe or hold limits it; expected one on "
            "tec_current, tec_temperature or a signal derived from them, or with setpoint = 'tec'"
        )
        assert len(check(unattended=False)) == 1

    @pytest.mark.parametrize(
        "interlock",
        [
            Interlock(signal="curvature", high=1.0),
            Interlock(signal="tec_setpoint", high=60.0),
            Interlock(signal="tec_temperature", high=100.0, level="warn"),
            Interlock(signal="tec_temperature", high=100.0, level="pause"),
            Interlock(signal="tec_temperature", stale=10.0),
        ],
        ids=lambda each: f"{each.signal}-{each.level}-{each.stale}",
    )
    def test_an_interlock_that_does_not_end_its_heating_is_none(self, check, interlock):
        (line,) = refused(check, interlock)
        assert "no interlock" in line

    @pytest.mark.parametrize(
        "interlock",
        [
            Interlock(signal="tec_current", low=-1.0),
            Interlock(signal="tec_temperature", fastest=5.0),
            Interlock(signal="excess", high=60.0),
            Interlock(signal="excess", high=60.0, level="hold"),
            Interlock(signal="curvature", high=1.0, setpoint="tec"),
        ],
        ids=lambda each: f"{each.signal}-{each.level}-{each.setpoint}",
    )
    def test_an_interlock_on_it_directly_or_by_a_derived_signal(self, check, interlock):
        assert check(interlock) == ()

    def test_one_that_does_not_heat_needs_neither(self, check):
        assert check(devices=[replace(COOLER, watchdog=None)]) == ()

    def test_all_problems_are_said_at_once(self, check):
        lines = refused(check, devices=[replace(TEC, watchdog=None), PSD], interval=5.0)
        assert len(lines) == 3


class TestInterlocks:
    @pytest.mark.parametrize(
        ("keys", "expected"),
        [
            ({"signal": "tec_temp", "high": 5.0}, "signal = 'tec_temp': there is no such signal"),
            ({"signal": "curvature", "minus": "curve", "high": 5.0}, "minus = 'curve': there is no such signal"),
            ({"signal": "tec_temperature", "minus": "tec_current", "high": 5.0}, "minus = 'tec_current': it is in"),
            ({"signal": "tec_current", "high": 5.0, "unit": "mA"}, "unit = 'mA': tec_current is in A"),
            (
                {"signal": "tec_temperature", "minus": "tec_setpoint", "high": 5.0, "unit": "mK"},
                "unit = 'mK': tec_temperature - tec_setpoint is in K or °C",
            ),
            ({"signal": "psd_position", "high": 5.0, "setpoint": "psd"}, "setpoint = 'psd': there is no such"),
            (
                {
                    "signal": "tec_temperature",
                    "setpoint": "tec",
                    "stuck": {"moved": 90.0, "follows": 1.0, "within": 9.0},
                },
                "stuck.moved = 90: tec takes 15 to 95 °C, so that it never acts",
            ),
            ({"signal": "tec_setpoint", "high": 99.0}, "high = 99: tec takes 15 to 95 °C, so that it never acts"),
            ({"signal": "tec_setpoint", "low": 10.0}, "low = 10: tec takes 15 to 95 °C, so that it never acts"),
        ],
    )
    def test_that_do_not_fit(self, check, keys, expected):
        (line,) = refused(check, HOT, Interlock(**keys))
        assert line.startswith(f"interlocks.1.{expected}")

    def test_that_fit(self, check):
        assert (
            check(
                HOT,
                Interlock(signal="tec_temperature", minus="tec_setpoint", high=5.0, unit="K", settle=60.0),
                Interlock(signal="tec_setpoint", high=90.0, unit="°C"),
                Interlock(signal="tec_setpoint", minus="tec_temperature", high=300.0),
                Interlock(signal="psd_position", setpoint="tec", stuck={"moved": 80, "follows": 1e-6, "within": 9}),
            )
            == ()
        )


@cases("name", sorted(name for name in packaged_rigs() if "hardware" not in name))
def test_the_packaged_rigs_can_be_left_to_themselves(name):
    file = load_rig(name)
    rig = Rig(file, VirtualClock(), seed=0)
    rig.close()
    # As the drivers declare it, and as if each declared what the rig file says.
    watchdogs = {entry.name: getattr(entry.settings, "watchdog", None) for entry in file.devices}
    kinds = {"tec": Heater, "supply": Heater}
    declared = rig.description.devices
    strict = {
        name: replace(each, watchdog=each.watchdog or watchdogs[name], kind=kinds.get(name, each.kind))
        for name, each in declared.items()
    }
    assert Heater in {each.kind for each in strict.values()}
    for devices in (declared, strict):
        description = replace(rig.description, devices=devices)
        assert check_start(description, interval=1.0 / file.safety.rate, interval_key="safety.rate") == ()


class TestCalibrations:
    def rig(self, tmp_path, lines):
        path = tmp_path / "mine.toml"
        path.write_text(f'extends = "vo2"\n[devices.psd]\n{lines}\n')
        return load_rig(str(path))

    @cases("day", ["2027-03-01", '"2027-03-01"'])
    def test_is_due_from_its_day_on(self, tmp_path, day):
        file = self.rig(tmp_path, f"calibrated = 2026-03-01\ncalibration_due = {day}")
        assert calibration_warnings(file, date(2027, 2, 28)) == ()
        (warning,) = calibration_warnings(file, date(2027, 3, 1))
        assert "devices.psd: its calibration was due on 2027-03-01" in warning
        (warning,) = calibration_warnings(file, date(2026, 2, 28))
        assert "devices.psd: its calibration is dated 2026-03-01, after today" in warning
        # As the record of a run has it.
        assert json.loads(json.dumps(file.content))["devices"]["psd"]["calibration_due"] == "2027-03-01"

    def test_of_a_calibrated_signal_is_due_after_its_interval(self, tmp_path):
        record = {
            "signal": "psd_position", "unit": "m", "serial_number": "", "date": "2026-03-01", "interval_days": 90,
            "reference": "goniometer 12", "reference_unit": "°", "reference_uncertainty": 0.01, "low": -1, "high": 1,
            "coefficients": [0], "covariance": [[0]], "degrees_of_freedom": 8, "repeatability": 0.01, "readings": 9,
        }  # fmt: skip
        (tmp_path / "psd.json").write_text(json.dumps(record))
        path = tmp_path / "mine.toml"
        path.write_text(
            'extends = "vo2"\n[derived.tip_angle]\nkind = "calibrated"\nsource = "psd_position"\n'
            'calibration = "psd.json"\n[derived.curvature]\nsource = "tip_angle"\n'
        )
        file = load_rig(str(path))
        # It comes before what comes from it.
        assert list(file.derived) == ["tip_angle", "curvature"]
        assert calibration_warnings(file, date(2026, 5, 29)) == ()
        (warning,) = calibration_warnings(file, date(2026, 5, 30))
        assert "derived.tip_angle: the calibration of psd_position by goniometer 12 was due on 2026-05-30" in warning
        (warning,) = calibration_warnings(file, date(2026, 2, 28))
        assert "is dated 2026-03-01, after today" in warning

    @cases(
        ("lines", "message"),
        [
            ('calibrated = "last spring"', r"devices\.psd\.calibrated"),
            ("calibrated = 2026-03-01\ncalibration_due = 2026-03-01", "expected a day after 2026-03-01"),
        ],
    )
    def test_bad_days(self, tmp_path, lines, message):
        with pytest.raises(ConfigurationError, match=message):
            self.rig(tmp_path, lines)
