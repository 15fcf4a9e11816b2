"""Numbers with units: as they are typed, and as they are shown."""

import pytest
from cases import cases

from bench.base import ConfigurationError, Display, in_si, percent, read_quantity, significant
from bench.devices import Limits
from bench.operator import SetPoint, parse_command
from bench.protocol import find_protocol
from bench.rig import load_rig


class TestReading:
    @cases(
        ("text", "unit", "expected"),
        [
            ("3", "K", 3.0),
            ("1e-3", "m", 1e-3),
            ("3K", "K", 3.0),
            ("3 °C", "K", 3.0),
            ("2 K/min", "K/s", 2.0 / 60.0),
            ("2 °C/min", "K/s", 2.0 / 60.0),
            ("350K", "°C", 76.85),
            ("54 °C", "°C", 54.0),
            ("300 µm", "m", 300e-6),
            ("300um", "m", 300e-6),
            ("0.5min", "s", 30.0),
            ("20 mA", "A", 0.02),
            ("30 deg", "rad", 0.5235987756),
            ("5 %", "1", 0.05),
            ("2 1/m", "1/m", 2.0),
            ("2 1/mm", "1/m", 2000.0),
        ],
    )
    def test_a_number_is_in_the_unit_that_is_wanted(self, text, unit, expected):
        assert read_quantity(text, unit) == pytest.approx(expected, rel=1e-9)

    @cases(("text", "unit"), [("3V", "K"), ("three", "K"), ("5 m", "s"), ("3 K", "1"), ("2 K", "K/s")])
    def test_another_kind_is_refused(self, text, unit):
        with pytest.raises(ValueError, match=f"not '{text}'"):
            read_quantity(text, unit)

    @cases(("text", "expected"), [("3 ms", 3e-3), ("5 mm", 5e-3), ("80 °C", 80.0), ("3 K", 3.0), ("4 Hz", 4.0)])
    def test_without_a_unit_that_is_wanted_it_is_in_si(self, text, expected):
        assert in_si(text) == pytest.approx(expected, rel=1e-12)


class TestTyped:
    def test_parameters_take_units(self):
        definition, roles = find_protocol("damped-oscillation"), load_rig("vo2").roles
        given = {"increment": "3K", "high": "350 K", "dwell": "0.1min", "half_cycles": "8"}
        found = definition.parse(given, roles)
        assert (found.increment, found.high, found.dwell, found.half_cycles) == pytest.approx((3.0, 76.85, 6.0, 8))

    def test_every_wrong_unit_is_named_at_once(self):
        definition, roles = find_protocol("damped-oscillation"), load_rig("vo2").roles
        with pytest.raises(ConfigurationError) as error:
            definition.parse({"increment": "3V", "dwell": "5 m"}, roles)
        lines = str(error.value).splitlines()
        assert ["increment" in lines[0], "dwell" in lines[1], len(lines)] == [True, True, 2]

    def test_lists_take_units(self):
        definition, roles = find_protocol("length-voltage"), load_rig("sma").roles
        assert definition.parse({"loads": "1000 mN, 2"}, roles).loads == pytest.approx((1.0, 2.0))

    def test_values_of_a_rig_file_take_units(self):
        rig = load_rig(
            "vo2", {"roles.drive.increment": "3 K", "roles.drive.rest": "300 K", "roles.drive.dwell": "1min"}
        )
        drive = rig.roles["drive"]
        assert (drive.increment, drive.rest, drive.dwell) == pytest.approx((3.0, 26.85, 60.0))

    def test_commands_of_the_panel_take_units(self):
        limits = {"tec": Limits(10.0, 95.0, "°C"), "stage": Limits(-0.01, 0.01, "m")}
        assert parse_command("set stage 3mm", limits) == SetPoint("stage", pytest.approx(3e-3))
        assert parse_command("ramp tec 60 °C 2 K/min", limits) == SetPoint("tec", 60.0, pytest.approx(2.0 / 60.0))
        with pytest.raises(ConfigurationError, match="expected set DEVICE VALUE"):
            parse_command("set stage 3 V", limits)


class TestShown:
    @cases(
        ("unit", "precision", "extent", "value", "shown"),
        [
            ("m", 9, 1e-4, 20.132e-6, "20.132 µm"),
            ("m", 9, 1.5e-2, 2.6199e-3, "2.620 mm"),
            ("m", 9, None, 8.0486e-05, "80.486 µm"),
            ("A", 3, 0.2, 0.0871, "87 mA"),
            ("A", 3, 4.4, -0.0001, "-0.00010 A"),
            ("1/m", 2, None, 1835.7712345678, "1835.77 1/m"),
            ("1", 3, None, 0.25, "0.250"),
            ("m/s", 5, None, 0.00123, "1.23 mm/s"),
            ("m", 9, 1e-4, 2.3e-9, "0.0023 µm"),
        ],
    )
    def test_a_signal_has_one_unit(self, unit, precision, extent, value, shown):
        assert Display.of(unit, precision, extent).text(value) == shown

    def test_a_small_percentage_is_not_zero(self):
        assert [percent(value) for value in (0.0, 12.3456, 0.0012)] == ["0.00 %", "12.35 %", "0.0012 %"]


@cases(
    ("value", "digits", "text"),
    [(1887.2, 3, "1890"), (26.74, 3, "26.7"), (0.012345, 2, "0.012"), (123456.0, 2, "120000"), (3.0e7, 3, "3e+07")],
)
def test_significant_digits_without_an_exponent_for_what_people_read(value, digits, text):
    assert significant(value, digits) == text
    assert significant(-value, digits) == f"-{text}"
