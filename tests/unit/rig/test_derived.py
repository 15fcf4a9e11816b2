"""Derived signals: expressions with units, and classes of one's own beside the rig file."""

import math
import sys
from pathlib import Path

import heater_laboratory
import pytest
from cases import cases
from heater_laboratory import RIG
from hypothesis import given, settings, strategies as st
from pydantic import ValidationError

from bench.base import ConfigurationError, DeviceError, VirtualClock
from bench.rig import Expression, Rig, load_rig

UNITS = {"a": "V", "b": "V", "c": "1", "t": "°C", "x": "m", "p": "mbar"}
VALUES = {"a": 2.0, "b": 0.5, "c": 3.0, "t": 40.0, "x": 1e-3, "p": 250.0}


def compute(expression, unit, values=None, **constants):
    table = {"expression": expression, "unit": unit, "constants": constants}
    return Expression.model_validate(table).bind("s", UNITS).compute(VALUES | (values or {}))


class TestValues:
    @cases(
        ("expression", "unit", "constants", "expected"),
        [
            ("gain * (a - b)", "1", {"gain": "2.5e-3 1/V"}, 3.75e-3),
            ("2 * x / (length ** 2 + x ** 2)", "1/m", {"length": "300e-6 m"}, 2e-3 / (9e-8 + 1e-6)),
            ("p * area", "N", {"area": "1 cm**2"}, 2.5),
            ("scale * c", "1", {"scale": 1.5}, 4.5),
            ("-a ** 2", "V**2", {}, -4.0),
            ("2 ** -c", "1", {}, 0.125),
            ("log(a / b)", "1", {}, math.log(4.0)),
            ("sin(c) + cos(c) * tan(c)", "1", {}, 2 * math.sin(3.0)),
            ("atan(x / length)", "1", {"length": "1 mm"}, math.pi / 4),
            ("abs(b - a)", "V", {}, 1.5),
            ("min(a, b, largest)", "V", {"largest": "100 mV"}, 0.1),
            ("max(a)", "V", {}, 2.0),
            ("  a\n", "V", {}, 2.0),
        ],
    )
    def test_value(self, expression, unit, constants, expected):
        assert compute(expression, unit, **constants) == pytest.approx(expected, rel=1e-14)

    @cases(
        ("expression", "unit", "expected"),
        [("t", "°C", 40.0), ("t", "K", 40.0), ("t - room", "K", 15.0), ("t", "mK", 4e4), ("t * t", "K**2", 1600.0)],
    )
    def test_temperatures_are_differences_without_an_offset(self, expression, unit, expected):
        constants = {"room": "25 °C"} if "room" in expression else {}
        assert compute(expression, unit, **constants) == pytest.approx(expected, rel=1e-14)

    @cases("unit", ["degC", "degF"])
    def test_a_scale_with_an_offset_is_refused(self, unit):
        with pytest.raises(ValueError, match=f"unit = '1 {unit}': expected .* a unit whose scale begins at 0"):
            compute("t", unit)

    def test_what_is_zero_for_equal_sources_can_be_divided_by(self):
        assert compute("1 / (a - b)", "1/V") == pytest.approx(1 / 1.5)
        assert compute("log(a / b - 1)", "1") == pytest.approx(math.log(3.0))

    def test_signal_and_sources(self):
        table = {"expression": "k * a - max(b, a)", "unit": "mV", "constants": {"k": 2}, "precision": 1}
        derived = Expression.model_validate(table).bind("net_drive", UNITS)
        assert derived.sources == ("a", "b")
        signal = derived.signal
        assert (signal.name, signal.unit, signal.description, signal.precision) == ("net_drive", "mV", "net drive", 1)


numbers = st.floats(-1e3, 1e3).map(lambda value: round(value, 3))
terms = st.recursive(
    st.sampled_from(["a", "b"]) | numbers.map(lambda value: f"{value!r} * a"),
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from("+-"), inner).map(lambda part: "({} {} {})".format(*part)),
        st.tuples(numbers, inner).map(lambda part: f"{part[0]!r} * {part[1]}"),
        st.tuples(inner, inner).map(lambda part: f"sqrt(abs({part[0]} * {part[1]}))"),
        st.tuples(inner, inner, inner).map(lambda part: "max({}, min({}, {}))".format(*part)),
        inner.map(lambda part: f"-abs({part})"),
    ),
    max_leaves=12,
)


@settings(max_examples=200, deadline=None)
@given(text=terms, a=numbers, b=numbers)
def test_any_expression_agrees_with_python(text, a, b):
    functions = {"sqrt": math.sqrt, "abs": abs, "min": min, "max": max, "a": a, "b": b}
    expected = eval(text, {"__builtins__": {}}, functions)
    found = compute(text, "mV", {"a": a, "b": b})
    assert found == pytest.approx(1e3 * expected, rel=1e-9, abs=1e-6)


class TestRefused:
    @cases(
        ("expression", "reason"),
        [
            ("a +", "is not an arithmetic expression"),
            ("a = b", "is not an arithmetic expression"),
            ("(" * 300 + "a" + ")" * 300, "is not an arithmetic expression"),
            ("a.__class__.__mro__", "is no arithmetic"),
            ("[a, b]", "is no arithmetic"),
            ("a % b", "is no arithmetic"),
            ("'a' * 1000000000", "\"'a'\" is no arithmetic"),
            ("1j * a", "'1j' is no arithmetic"),
            ("f'{a}'", "is no arithmetic"),
            ("eval(a)", "'eval(a)' is none of the functions"),
            ("(a.conjugate)()", "is none of the functions"),
            ("sqrt * a", "'sqrt' is a function and needs its arguments"),
        ],
    )
    def test_what_is_no_arithmetic(self, expression, reason):
        with pytest.raises(ValidationError) as caught:
            Expression(expression=expression, unit="V")
        assert reason in str(caught.value)

    @cases(
        ("expression", "unit", "reason"),
        [
            ("a", "m", "'a' is in V, not in unit = 'm'"),
            ("a * b", "V", "is in V², not in unit = 'V'"),
            ("a + 1", "V", "'a + 1': Cannot convert"),
            ("max(a, x)", "V", "Cannot convert"),
            ("2 ** x", "1", "Cannot convert"),
            ("x ** c", "m", "a power of m needs a number as its exponent"),
            ("sqrt(a, b)", "V", "'sqrt(a, b)'"),
            ("a", "bogus", "unit = '1 bogus': expected a number and a unit"),
        ],
    )
    def test_a_unit_or_number_of_arguments_that_does_not_fit(self, expression, unit, reason):
        with pytest.raises(ValueError, match=r".") as caught:
            compute(expression, unit)
        assert reason in str(caught.value)

    @cases("value", ["3V", "V", "nan V", "inf V", "1 bogus", "", "1 degC"])
    def test_a_constant_that_is_no_quantity(self, value):
        with pytest.raises(ValueError, match=r"constants.k = .*: expected a (finite )?number and a unit"):
            compute("k * a", "V", k=value)


class TestNoValue:
    """What has no value for a reading ends the run as a device does that fails; nothing hangs."""

    @cases(
        ("expression", "unit", "values", "shown"),
        [
            ("a / b", "1", {"b": 0.0}, "a = 2, b = 0"),
            ("(a - b) ** 0.5", "V**0.5", {"b": 5.0}, "math domain error"),
            ("log(c - 3)", "1", {}, "c = 3"),
            ("exp(1000 * c)", "1", {}, "math range error"),
            ("c ** 9 ** 9 ** 9", "1", {}, "math range error"),
        ],
    )
    def test_is_a_fault_of_the_signal(self, expression, unit, values, shown):
        with pytest.raises(DeviceError, match=r"s: .* has no value for") as caught:
            compute(expression, unit, values)
        assert shown in str(caught.value)
        assert caught.value.device == "s"


HALF = '\n[derived.half]\nexpression = "0.5 * tec_temperature"\nunit = "K"\n'
SUM = '\n[derived.total]\nexpression = "half + probe_temperature - tec_setpoint + tec_setpoint"\nunit = "mK"\n'


class TestOnARig:
    def test_several_sources_and_chains(self, rig_file):
        with Rig(load_rig(rig_file(append=HALF + SUM)), VirtualClock(), 1) as rig:
            rig.devices["tec"].set(40.0)
            values = rig.measure()
            assert values["half"] == pytest.approx(0.5 * values["tec_temperature"])
            assert values["total"] == pytest.approx(1e3 * (values["half"] + values["probe_temperature"]))
            assert [signal.unit for signal in rig.signals][-2:] == ["K", "mK"]

    def test_the_best_reading_of_all_that_a_chain_comes_from(self, rig_file):
        chain = '\n[derived.doubled]\nexpression = "2 * half"\nunit = "K"\n'
        with Rig(load_rig(rig_file(append=HALF + chain)), VirtualClock(), 1) as rig:
            rig.devices["tec"].measure_error = DeviceError("tec", "was measured")
            with pytest.raises(DeviceError, match="was measured"):
                rig.sample(["doubled"])
            assert set(rig.quick_reader(["doubled"])()) >= {"tec_temperature", "half", "doubled"}

    @cases(
        ("old", "new", "key"),
        [
            ("tec_temperature", "tec_temprature", "half.expression: 'tec_temprature': there is no such signal"),
            ("tec_temperature", "half", "derived.half.expression: 'half': there is no such signal"),
            ("tec_temperature", "total", "or it comes from this one; there are: tec_setpoint"),
            ('unit = "K"', 'unit = "V"', "derived.half.expression = '0.5 * tec_temperature' is in K, not in unit"),
            ('unit = "K"', 'unit = "V"\nunits = 3', "derived.half.units: there is no such key; did you mean unit?"),
            ('unit = "K"', "", "derived.half.unit: is missing (unit of the result; 1 for a plain number)"),
            ("0.5 * tec", "tec.value + tec", "derived.half.expression = 'tec.value + tec_temperature': 'tec"),
            ('unit = "K"', 'unit = "K"\nconstants = { k = "5 K2" }', "derived.half.constants.k = '5 K2'"),
            ('unit = "K"', 'unit = "K"\nkind = "no_such:Class"', "derived.half.kind = 'no_such:Class'"),
            ('unit = "K"', 'unit = "K"\nkind = "math:sqrt"', "kind = 'math:sqrt': is not a DerivedSignal"),
        ],
    )
    def test_one_message_that_names_file_and_key(self, rig_file, old, new, key):
        assert old in HALF
        path = rig_file(append=HALF.replace(old, new) + SUM)
        with pytest.raises(ConfigurationError) as caught, Rig(load_rig(path), VirtualClock(), 1):
            pass
        (line,) = str(caught.value).splitlines()
        assert line.startswith(f"{path}: ")
        assert key in line

    def test_a_fault_at_run_time_ends_a_reading(self, rig_file):
        inverse = '\n[derived.inverse]\nexpression = "1 / (tec_current - tec_current)"\nunit = "1/A"\n'
        expected = pytest.raises(DeviceError, match=r"inverse: .* has no value for tec_current = 0")
        with Rig(load_rig(rig_file(append=inverse)), VirtualClock(), 1) as rig, expected:
            rig.measure()


OWN_CLASS = """
from bench.rig import Derived, DerivedSignal
from bench.devices import Signal


class Smallest(DerivedSignal):
    first: str
    second: str

    @property
    def sources(self):
        return (self.first, self.second)

    def bind(self, name, units):
        if units[self.first] != units[self.second]:
            raise ValueError(f"second = {self.second!r}: is in {units[self.second]}; {units[self.first]} is expected")
        signal = Signal(name, units[self.first], "the smaller one", 2)
        return Derived(signal, self.sources, lambda values: min(values[self.first], values[self.second]))
"""
OWN = """
[derived.smaller]
kind = "own_signals_of_this_test:Smallest"
first = "tec_temperature"
second = "probe_temperature"
"""
READ = """
import sys
from bench.base import VirtualClock
from bench.rig import Rig
from bench.rig import load_rig

with Rig(load_rig(sys.argv[1]), VirtualClock(), 1) as rig:
    values = rig.measure()
    assert values["smaller"] == min(values["tec_temperature"], values["probe_temperature"])
    print(rig.signals[-1])
"""


class TestOwnClass:
    def test_beside_the_rig_file_without_a_search_path(self, rig_file, tmp_path, warm_process):
        """Signals, drivers and laboratory are modules beside the rig file, and the process runs elsewhere."""
        (tmp_path / "own_signals_of_this_test.py").write_text(OWN_CLASS)
        (tmp_path / "heater_laboratory.py").write_text(Path(heater_laboratory.__file__).read_text("utf-8"), "utf-8")
        elsewhere = tmp_path / "elsewhere"
        elsewhere.mkdir()
        done = warm_process([sys.executable, "-c", READ, rig_file(append=OWN)], elsewhere, None)
        assert done.returncode == 0, done.stderr
        assert "name='smaller', unit='°C', description='the smaller one'" in done.stdout

    def test_its_refusal_names_file_and_key(self, rig_file, tmp_path):
        (tmp_path / "own_signals_of_this_test.py").write_text(OWN_CLASS)
        path = rig_file(append=OWN.replace("probe_temperature", "tec_current"), text=RIG)
        with pytest.raises(ConfigurationError, match=r"derived.smaller.second = 'tec_current': is in A;"):
            Rig(load_rig(path), VirtualClock(), 1)
