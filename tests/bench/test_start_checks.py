import math
from dataclasses import replace

import pytest

from bench.clock import VirtualClock
from bench.devices import Limits
from bench.errors import ConfigurationError
from bench.interlocks import Interlock
from bench.rig import Rig
from bench.rig_file import SafetyTable, load_rig, packaged_rigs
from bench.start_checks import DeviceDescription, RigDescription, check_start

TEC = DeviceDescription("tec", ("tec_temperature", "tec_current"), Limits(15.0, 95.0, "°C"), watchdog=5.0, heats=True)
PSD = DeviceDescription("psd", ("psd_position",), watchdog=2.0)
UNITS = {
    "tec_setpoint": "°C",
    "tec_temperature": "°C",
    "tec_current": "A",
    "psd_position": "m",
    "curvature": "1/m",
    "overheating": "K",
}
SOURCES = {"curvature": ("psd_position",), "overheating": ("twice",), "twice": ("tec_temperature",)}
HOT = Interlock(signal="tec_temperature", high=100.0)


@pytest.fixture
def check():
    file = load_rig("vo2")

    def check(*interlocks, devices=(TEC, PSD), interval=0.2, key="safety.rate", **safety):
        return check_start(
            replace(file, interlocks=interlocks, safety=SafetyTable(**safety)),
            RigDescription(tuple(devices), UNITS, SOURCES),
            interval=interval,
            interval_key=key,
        )

    return check


def refused(check, *interlocks, **keys):
    with pytest.raises(ConfigurationError) as caught:
        check(*interlocks, **keys)
    lines = str(caught.value).splitlines()
    assert all(line.startswith("vo2.toml: ") for line in lines)
    return [line.removeprefix("vo2.toml: ") for line in lines]


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

    def test_of_the_longest_measurement_of_any_device(self, check):
        assert check(HOT, devices=[TEC, replace(PSD, longest_measurement=0.8)]) == ()
        (line,) = refused(check, HOT, devices=[replace(TEC, longest_measurement=0.9), PSD])
        assert line.startswith("devices.tec: a measurement takes 0.9 s, but psd goes to its safe state after 2 s")

    @pytest.mark.parametrize("watchdog", [None, 0.0])
    def test_without_a_watchdog_there_is_no_bound(self, check, watchdog):
        devices = [replace(TEC, heats=False, watchdog=watchdog), replace(PSD, watchdog=watchdog)]
        assert check(devices=devices, interval=60.0) == ()


class TestADeviceThatHeats:
    @pytest.mark.parametrize("watchdog", [None, 0.0])
    def test_without_a_watchdog(self, check, watchdog):
        devices = [replace(TEC, watchdog=watchdog)]
        (line,) = refused(check, HOT, devices=devices)
        assert line.startswith("devices.tec: it heats and has no watchdog")
        assert line.endswith("or safety.unattended = false if an operator is present")
        (warning,) = check(HOT, devices=devices, unattended=False)
        assert warning.startswith("vo2.toml: devices.tec: it heats and has no watchdog")
        assert warning.endswith("accepted, as safety.unattended = false")

    def test_without_an_interlock(self, check):
        (line,) = refused(check)
        assert line.startswith(
            "devices.tec: it heats, and no interlock of level safe or hold limits it; expected one on "
            "tec_temperature, tec_current or a signal derived from them, or with setpoint = 'tec'"
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
            Interlock(signal="overheating", high=60.0),
            Interlock(signal="overheating", high=60.0, level="hold"),
            Interlock(signal="curvature", high=1.0, setpoint="tec"),
        ],
        ids=lambda each: f"{each.signal}-{each.level}-{each.setpoint}",
    )
    def test_an_interlock_on_it_directly_or_by_a_derived_signal(self, check, interlock):
        assert check(interlock) == ()

    def test_one_that_does_not_heat_needs_neither(self, check):
        assert check(devices=[replace(TEC, heats=False, watchdog=None)]) == ()

    def test_all_problems_are_said_at_once(self, check):
        lines = refused(check, devices=[replace(TEC, watchdog=None), PSD], interval=5.0)
        assert len(lines) == 3


class TestInterlocks:
    @pytest.mark.parametrize(
        ("keys", "expected"),
        [
            ({"signal": "tec_temp", "high": 5.0}, "signal = 'tec_temp': there is no such signal; there are: tec_set"),
            ({"signal": "curvature", "minus": "curve", "high": 5.0}, "minus = 'curve': there is no such signal"),
            (
                {"signal": "tec_temperature", "minus": "tec_current", "high": 5.0},
                "minus = 'tec_current': it is in A and tec_temperature in °C; expected one unit",
            ),
            ({"signal": "tec_current", "high": 5.0, "unit": "mA"}, "unit = 'mA': tec_current is in A"),
            (
                {"signal": "tec_temperature", "minus": "tec_setpoint", "high": 5.0, "unit": "mK"},
                "unit = 'mK': tec_temperature - tec_setpoint is in K or °C",
            ),
            (
                {"signal": "psd_position", "high": 5.0, "setpoint": "psd"},
                "setpoint = 'psd': there is no such device that takes a set-point; there are: tec",
            ),
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


def description(rig):
    return RigDescription(
        tuple(DeviceDescription.of(device) for device in rig.devices.values()),
        {signal.name: signal.unit for signal in rig.signals},
        {name: derived.sources for name, derived in rig.derived.items()},
    )


@pytest.mark.parametrize("name", sorted(name for name in packaged_rigs() if "hardware" not in name))
def test_the_packaged_rigs_can_be_left_to_themselves(name):
    file = load_rig(name)
    rig = Rig(file, VirtualClock(), seed=0)
    try:
        found = description(rig)
    finally:
        rig.close()
    # As the drivers declare it, and as if each declared what the rig file says.
    watchdogs = {entry.name: getattr(entry.settings, "watchdog", None) for entry in file.devices}
    heaters = {"tec", "supply"}
    strict = tuple(
        replace(each, watchdog=each.watchdog or watchdogs[each.name], heats=each.heats or each.name in heaters)
        for each in found.devices
    )
    assert {each.name for each in strict if each.heats}
    assert not any(math.isnan(each.watchdog) for each in strict if each.watchdog)
    for devices in (found.devices, strict):
        looks = replace(found, devices=devices)
        assert check_start(file, looks, interval=1.0 / file.safety.rate, interval_key="safety.rate") == ()
