import math
import sys

import numpy as np
import pytest
from cases import cases
from hypothesis import given, strategies as st

from bench.base import ConfigurationError, VirtualClock
from bench.base.registry import RegisteredPart
from bench.control import Playback
from bench.protocol import (
    Dwell,
    FixedRate,
    Messages,
    Note,
    Phase,
    ProtocolParameters,
    Settled,
    Step,
    UntilSteady,
    find_protocol,
    packaged_protocols,
    parameter,
    plan,
    protocol,
)
from bench.rig import Rig, load_rig


class Parameters(ProtocolParameters):
    low: float = parameter(20.0, unit="°C", low=-20, high=150, help="where to begin")
    count: int = parameter(5, unit="1", low=1, help="how many steps")
    slow: float = parameter(1.0, unit="s", high=60, help="hold")
    free: float = parameter(0.0, unit="V", help="anything")
    title: str = parameter("x", unit="", help="a text")
    needed: float = parameter(..., unit="A", low=0, high=4, help="must be said")


@protocol(needs=("tec",))
def ramp(parameters: Parameters) -> Messages:
    """Climb in steps of one kelvin.

    More about it.
    """
    yield Phase("climb")
    for i in range(parameters.count):
        yield Step({"tec": parameters.low + i}, Dwell(parameters.slow))
    yield Note("there")


class Nothing(ProtocolParameters):
    pass


def define(function, needs=("tec",)):
    function.__annotations__ = {"parameters": Nothing}
    function.__doc__ = "A protocol."
    return protocol(needs=needs)(function)


class TestParse:
    def test_texts_become_numbers(self):
        parameters = ramp.parse({"low": "-3.5", "count": "7", "needed": "1e0", "title": "12"})
        assert parameters.low == -3.5
        assert parameters.count == 7
        assert parameters.needed == 1.0
        assert parameters.title == "12"
        assert parameters.slow == 1.0

    def test_an_unknown_name_lists_the_known(self):
        with pytest.raises(ConfigurationError) as caught:
            ramp.parse({"lwo": "3", "needed": "1"})
        assert "there is no parameter 'lwo'; did you mean low?" in str(caught.value)

    @cases(
        ("name", "value", "allowed"),
        [
            ("low", "151", "-20 to 150 °C"),
            ("low", "nan", "-20 to 150 °C"),
            ("low", "", "-20 to 150 °C"),
            ("count", "2.5", "≥ 1"),
            ("slow", "-inf", "≤ 60 s"),
            ("free", "nan", "any number V"),
            ("free", "inf", "any number V"),
        ],
    )
    def test_a_wrong_value_names_what_is_allowed(self, name, value, allowed):
        with pytest.raises(ConfigurationError) as caught:
            ramp.parse({"needed": "1", name: value})
        message = str(caught.value)
        assert f"protocol ramp: parameter {name} = {value!r} is not allowed" in message
        assert f"allowed: {allowed}" in message

    def test_a_missing_one_is_named(self):
        with pytest.raises(
            ConfigurationError,
            match=r"parameter needed is missing \(nor does .*\[protocols\.ramp\] needed = .*; allowed: 0 to 4 A",
        ):
            ramp.parse({})

    def test_all_that_is_wrong_is_said_at_once(self):
        with pytest.raises(ConfigurationError) as caught:
            ramp.parse({"low": "1000", "cuont": "3"})
        assert len(str(caught.value).splitlines()) == 3

    @given(st.dictionaries(st.text(max_size=8), st.text(max_size=8), max_size=4))
    def test_any_text_gives_parameters_or_a_configuration_error(self, settings):
        try:
            assert isinstance(ramp.parse(settings), Parameters)
        except ConfigurationError as error:
            assert str(error)  # noqa: PT017 - either way is right


class TestHelp:
    def test_says_everything(self):
        entries = {entry.name: entry for entry in ramp.help()}
        assert list(entries) == ["low", "count", "slow", "free", "title", "needed"]
        low = entries["low"]
        assert (low.default, low.unit, low.allowed, low.text) == ("20.0", "°C", "-20 to 150", "where to begin")
        assert entries["count"].allowed == "≥ 1"
        assert entries["slow"].allowed == "≤ 60"
        assert entries["needed"].default == "must be given"

    def test_name_and_summary(self):
        assert ramp.name == "ramp"
        assert ramp.summary == "Climb in steps of one kelvin"
        assert ramp.description.endswith("More about it.")
        assert ramp.needs == ("tec",)


class TestDefinition:
    def test_underscores_become_dashes(self):
        def slow_ramp(parameters):
            yield Note("x")

        assert define(slow_ramp).name == "slow-ramp"

    def test_wrong_forms_are_refused(self):
        def untyped(parameters):
            """Do."""
            yield Note("x")

        def silent(parameters: Nothing) -> Messages:
            yield Note("x")

        def two(parameters: Nothing, more: Nothing) -> Messages:
            """Do."""
            yield Note("x")

        def extra(parameters: Nothing, more) -> Messages:
            """Do."""
            yield Note("x")

        def no_generator(parameters: Nothing) -> Messages:
            """Do."""

        for function in (untyped, silent, two, extra, no_generator):
            with pytest.raises(TypeError, match=function.__name__):
                protocol(needs=())(function)

    def test_needs_is_a_sequence_of_names_not_a_text(self):
        def soak(parameters):
            yield Note("x")

        with pytest.raises(TypeError, match="needs"):
            define(soak, needs="tec")


class TestMessages:
    @cases("seconds", [-1.0, math.nan, math.inf])
    def test_dwell_refuses(self, seconds):
        with pytest.raises(ValueError, match="finite number ≥ 0"):
            Dwell(seconds)

    @cases(
        "keys",
        [
            {"drift": 0.0},
            {"noise": 0.0},
            {"timeout": 0.0},
            {"minimum": -1.0},
            {"minimum": 10.0, "timeout": 10.0},
        ],
    )
    def test_until_steady_refuses(self, keys):
        with pytest.raises(ValueError, match="UntilSteady"):
            UntilSteady("a", **{"drift": 1.0, "noise": 1.0, "timeout": 10.0, **keys})


class TestPlan:
    def test_counts_and_sums(self):
        expected = plan(ramp, ramp.parse({"needed": "1", "slow": "2.5"}))
        assert expected.steps == 5
        assert expected.seconds == expected.at_most == 12.5
        assert expected.extremes == {"tec": (20.0, 24.0)}

    def test_until_steady_counts_between_minimum_and_timeout(self):
        def settle(parameters):
            yield Step({}, UntilSteady("a", drift=1.0, noise=1.0, timeout=300.0, minimum=8.0))
            yield Step({}, Dwell(2.0))

        expected = plan(define(settle), Nothing())
        assert (expected.seconds, expected.at_most) == (10.0, 302.0)

    def test_a_setpoint_that_was_sent_is_known(self):
        def chase(parameters):
            reading = yield Step({"tec": 40.0, "supply": 5.0}, Dwell(1.0))
            while reading["tec_setpoint"] < 43.0:
                reading = yield Step({"tec": reading["tec_setpoint"] + reading["supply_setpoint"] / 5}, Dwell(1.0))

        expected = plan(define(chase), Nothing())
        assert (expected.complete, expected.steps) == (True, 4)
        assert expected.extremes["tec"] == (40.0, 43.0)
        assert expected.finished == (1.0, 2.0, 3.0, 4.0)

    @cases(
        "decide",
        [
            lambda reading: reading["curvature"] < 100.0,
            lambda reading: 1.0 / float(reading["tec_temperature"]),
            lambda reading: math.floor(reading["tec_temperature"]),
            lambda reading: range(round(reading["tec_temperature"])),
            lambda reading: f"{math.log10(reading['tec_temperature']):.1f}",
            lambda reading: max(reading["tec_temperature"], 1.0),
            lambda reading: "psd_position" in reading.values,
            lambda reading: dict(reading.values),
            lambda reading: len(reading.values),
            lambda reading: Dwell(reading["tec_temperature"]),
        ],
    )
    def test_the_plan_ends_where_a_reading_decides(self, decide):
        def search(parameters):
            yield Phase("before")
            reading = yield Step({"tec": 40.0}, Dwell(2.0))
            assert (reading.step, reading.settled) == (0, Settled.DWELL)
            decide(reading)
            yield Step({"tec": 400.0}, Dwell(2.0))

        expected = plan(define(search), Nothing())
        assert (expected.complete, expected.steps, expected.seconds) == (False, 1, 2.0)
        assert expected.at_most == math.inf
        assert expected.extremes == {"tec": (40.0, 40.0)}

    def test_the_plan_ends_where_a_reading_is_sent(self):
        def copy(parameters):
            reading = yield Step({"tec": 40.0}, Dwell(2.0))
            yield Step({"tec": 2.0 * reading["tec_temperature"] - 40.0}, Dwell(2.0))

        assert (plan(define(copy), Nothing()).complete, plan(define(copy), Nothing()).steps) == (False, 1)

    def test_a_reading_that_decides_nothing_leaves_the_plan_complete(self):
        said = []

        def watch(parameters):
            before = yield Step({"tec": 40.0}, Dwell(2.0))
            after = yield Step({"tec": 50.0}, Dwell(2.0))
            slope = np.mean([after["curvature"], -before["curvature"]]) / (after.time - before.time) ** 2
            said.append(f"{slope:.3f} {abs(2 * slope)}")
            yield Note(said[-1])

        expected = plan(define(watch), Nothing())
        assert (expected.complete, expected.steps, expected.at_most) == (True, 2, 4.0)
        assert said == ["unknown unknown"]

    @cases("caught", [Exception, BaseException])
    def test_a_protocol_that_catches_everything_gets_no_reading_either(self, caught):
        def stubborn(parameters):
            reading = yield Step({"tec": 40.0}, Dwell(1.0))
            try:
                float(reading["curvature"])
            except caught:
                yield Step({"tec": 50.0}, Dwell(1.0))
            finally:
                1 / 0  # noqa: B018 - fails on the way out

        expected = plan(define(stubborn), Nothing())
        assert (expected.complete, expected.steps, expected.extremes) == (False, 1, {"tec": (40.0, 40.0)})

    def test_where_a_controller_leaves_its_actuator_is_not_known(self):
        def go(parameters):
            yield Step({"tec": 40.0, "supply": 1.0}, Dwell(1.0))
            reading = yield fast_loop()
            assert reading["supply_setpoint"] == 1.0
            float(reading["tec_setpoint"])

        assert not plan(define(go), Nothing()).complete

    @cases("message", [lambda: Step({}, Dwell(0.0)), lambda: Note("still here"), lambda: fast_loop()])
    def test_a_protocol_that_never_ends_is_refused(self, monkeypatch, message):
        monkeypatch.setattr(sys.modules["bench.protocol.planning"], "LONGEST", 1_000)

        def endless(parameters):
            while True:
                yield message()

        with pytest.raises(ConfigurationError, match="endless does not end within 1000"):
            plan(define(endless), Nothing())

    def test_parameters_that_do_not_fit_together(self):
        def broken(parameters):
            raise ValueError("settling must be shorter than duration")
            yield

        with pytest.raises(ConfigurationError, match="protocol broken: settling must be shorter"):
            plan(define(broken), Nothing())

    @cases("nonsense", [None, 42, "tec", {"tec": 20.0}, Step])
    def test_nonsense_is_found_before_anything_moves(self, nonsense):
        def odd(parameters):
            yield Step({"tec": 20.0}, Dwell(1.0))
            yield nonsense

        with pytest.raises(ConfigurationError, match="protocol odd yielded"):
            plan(define(odd), Nothing())

    @cases("value", [math.nan, math.inf, "warm", None])
    def test_a_setpoint_that_is_no_number_is_found_before_anything_moves(self, value):
        def odd(parameters):
            yield Step({"tec": 20.0}, Dwell(1.0))
            yield Step({"tec": value}, Dwell(1.0))

        with pytest.raises(ConfigurationError, match=r"protocol odd: .*tec"):
            plan(define(odd), Nothing())


class TestFiles:
    GOOD = """
from bench.protocol import Dwell
from bench.protocol import Messages, ProtocolParameters, Step, parameter, protocol

class Parameters(ProtocolParameters):
    target: float = parameter(60.0, unit="°C", low=0, high=90, help="where")

@protocol(needs=("tec",))
def soak(parameters: Parameters) -> Messages:
    \"\"\"Hold.\"\"\"
    yield Step({"tec": parameters.target}, Dwell(1.0))
"""
    SECOND = GOOD + GOOD.split("@", 1)[1].replace("soak", "other").join(("@", ""))

    def write(self, tmp_path, text, name="mine.py"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return str(path)

    def test_one_protocol(self, tmp_path):
        definition = find_protocol(self.write(tmp_path, self.GOOD))
        assert definition.name == "soak"
        assert plan(definition, definition.parse({})).extremes == {"tec": (60.0, 60.0)}

    def test_by_name(self, tmp_path):
        path = self.write(tmp_path, self.SECOND)
        assert find_protocol(f"{path}:other").name == "other"
        with pytest.raises(ConfigurationError, match=r"choose one by .*mine\.py:NAME; it has: soak, other"):
            find_protocol(path)
        with pytest.raises(ConfigurationError, match="has no protocol 'third'; it has: soak, other"):
            find_protocol(f"{path}:third")

    def test_a_folder_with_a_colon(self, tmp_path):
        folder = tmp_path / "a:b"
        folder.mkdir()
        path = self.write(folder, self.GOOD)
        assert find_protocol(path).name == "soak"
        assert find_protocol(f"{path}:soak").name == "soak"

    def test_two_files_of_one_name(self, tmp_path):
        for folder, target in (("a", "30.0"), ("b", "40.0")):
            (tmp_path / folder).mkdir()
            path = self.write(tmp_path / folder, self.GOOD.replace("60.0", target))
            definition = find_protocol(path)
            assert definition.parse({}).target == float(target)

    def test_imported_protocols_do_not_count(self, tmp_path):
        text = "from protocols.creep import creep\n" + self.GOOD
        assert find_protocol(self.write(tmp_path, text)).name == "soak"

    def test_none_within(self, tmp_path):
        with pytest.raises(ConfigurationError, match="it has: none"):
            find_protocol(self.write(tmp_path, "x = 1\n"))

    def test_no_file(self, tmp_path):
        with pytest.raises(ConfigurationError, match="does not exist"):
            find_protocol(str(tmp_path / "absent.py"))
        (tmp_path / "folder.py").mkdir()
        with pytest.raises(ConfigurationError, match=r"folder\.py"):
            find_protocol(str(tmp_path / "folder.py"))

    @cases(
        "text",
        [
            "def broken(:\n",
            "undefined_name\n",
            "raise ValueError('no')\n",
            "{}['key']\n",
            "raise RuntimeError\n",
            GOOD.replace('"""Hold."""', ""),
            GOOD.replace("low=0", "low='a'"),
            GOOD.replace("Parameters) -> Messages", "int) -> Messages"),
            GOOD.replace(
                "class Parameters(ProtocolParameters):", "class Parameters(ProtocolParameters):\n    y: object()\n"
            ),
        ],
    )
    def test_every_kind_of_error_names_the_file(self, tmp_path, text):
        with pytest.raises(ConfigurationError, match=r"mine\.py"):
            find_protocol(self.write(tmp_path, text))

    def test_not_text(self, tmp_path):
        path = tmp_path / "mine.py"
        path.write_bytes(b"\xff\xfe\x00\x01")
        with pytest.raises(ConfigurationError, match=r"mine\.py"):
            find_protocol(str(path))


class BoundProtocols:
    """What a rig makes of a protocol: its defaults and its slots."""

    def __init__(self, rig):
        self.rig = rig

    def parse(self, definition, settings=None):
        file = self.rig.file
        return definition.parse(settings or {}, file.roles, file.protocols.get(definition.name), path=file.path)

    def slots(self, definition):
        return self.rig.description.slots(definition)

    def plan(self, definition, settings=None):
        return plan(definition, self.parse(definition, settings), self.slots(definition))


@pytest.fixture(scope="module")
def vo2():
    with Rig(load_rig("vo2"), VirtualClock(), 0) as rig:
        yield BoundProtocols(rig)


class TestPackaged:
    def test_names(self):
        protocols = packaged_protocols().protocols
        assert list(protocols) == sorted(protocols)
        assert {"creep", "damped-oscillation", "random-validation"} <= set(protocols)
        for definition in protocols.values():
            assert definition.summary
            assert all(entry.text and not entry.text.endswith(".") for entry in definition.help())

    def test_an_unknown_name_lists_the_known(self):
        with pytest.raises(ConfigurationError) as caught:
            find_protocol("damped-osculation")
        assert "there is no protocol 'damped-osculation'" in str(caught.value)
        assert "damped-oscillation" in str(caught.value)
        assert "path/to/file.py" in str(caught.value)

    def test_two_of_one_name_are_refused(self, tmp_path, monkeypatch):
        package = tmp_path / "twin_protocols"
        package.mkdir()
        (package / "__init__.py").write_text("")
        for module in ("one", "two"):
            (package / f"{module}.py").write_text(TestFiles.GOOD, encoding="utf-8")
        monkeypatch.syspath_prepend(str(tmp_path))
        twins = RegisteredPart("protocols", "twins", "twin-package", "twin_protocols")
        monkeypatch.setattr("bench.base.registry.entries", lambda _: {"twins": twins})
        with pytest.raises(ConfigurationError, match="two protocols are named soak: one of package twin-package"):
            packaged_protocols()

    def test_a_module_that_cannot_be_imported_is_named_and_skipped(self, tmp_path, monkeypatch):
        package = tmp_path / "broken_protocols"
        package.mkdir()
        (package / "__init__.py").write_text("")
        (package / "good.py").write_text(TestFiles.GOOD, encoding="utf-8")
        (package / "bad.py").write_text("import no_such_module\n")
        monkeypatch.syspath_prepend(str(tmp_path))
        broken = RegisteredPart("protocols", "broken", "a-package", "broken_protocols")
        gone = RegisteredPart("protocols", "gone", "b-package", "no_such_package")
        monkeypatch.setattr("bench.base.registry.entries", lambda _: {"broken": broken, "gone": gone})
        packaged = packaged_protocols()
        assert list(packaged.protocols) == ["soak"]
        assert packaged.packages == {"soak": "a-package"}
        assert any("broken_protocols.bad" in problem and "no_such_module" in problem for problem in packaged.problems)
        assert any("b-package" in problem and "no_such_package" in problem for problem in packaged.problems)

    def test_damped_oscillation(self, vo2):
        definition = find_protocol("damped-oscillation")
        expected = vo2.plan(definition)
        assert 3300 <= expected.steps <= 3500
        assert expected.extremes["tec"] == (21.0, 84.0)
        assert expected.seconds == pytest.approx(8.0 * expected.steps)
        assert expected.at_most == pytest.approx(expected.seconds + 292.0)

    def test_random_validation(self, vo2):
        definition = find_protocol("random-validation")
        expected = vo2.plan(definition)
        assert expected.steps == 600
        low, high = expected.extremes["tec"]
        assert 21.0 <= low < 40.0
        assert 72.0 < high <= 84.0

    def test_creep(self, vo2):
        definition = find_protocol("creep")
        expected = vo2.plan(definition)
        assert (expected.complete, expected.steps) == (True, 1 + 2 * (1 + 120))
        assert 2 * 60.0 <= expected.seconds <= expected.at_most < math.inf
        assert expected.extremes["tec"] == (25.0, 80.0)

    @cases("settling", ["60", "3600"])
    def test_creep_that_settles_too_long(self, vo2, settling):
        definition = find_protocol("creep")
        with pytest.raises(
            ConfigurationError, match=f"settling = {settling} s is not allowed with interval = 0.5 s and dur"
        ):
            vo2.plan(definition, {"settling": settling})

    @pytest.mark.parametrize("name", ["creep", "damped-oscillation", "random-validation"])
    @given(data=st.data())
    def test_whatever_is_allowed_has_a_plan_or_a_configuration_error(self, vo2, name, data):
        definition = find_protocol(name)
        settings = {}
        for field, info in definition.parameters.model_fields.items():
            low = next((m.ge for m in info.metadata if getattr(m, "ge", None) is not None), -20)
            high = next((m.le for m in info.metadata if getattr(m, "le", None) is not None), 150)
            if field in ("count", "half_cycles"):
                settings[field] = str(data.draw(st.integers(low, 20), label=field))
            elif field in ("increment", "interval", "dwell"):
                settings[field] = str(data.draw(st.floats(0.5, high), label=field))
            elif field == "duration":
                settings[field] = str(data.draw(st.floats(low, 100.0), label=field))
            elif info.annotation is int:
                settings[field] = str(data.draw(st.integers(low, high), label=field))
            else:
                settings[field] = str(data.draw(st.floats(low, high), label=field))
        try:
            expected = vo2.plan(definition, settings)
        except ConfigurationError as error:
            assert str(error).startswith(f"protocol {name}")  # noqa: PT017 - either way is right
        else:
            for low, high in expected.extremes.values():
                assert -20.0 <= low <= high <= 150.0


def fast_loop(**keys):
    return FixedRate(
        **{
            "controller": Playback(lambda t: 30.0 + t),
            "rate": 100.0,
            "duration": 12.0,
            "inputs": ("probe_temperature",),
            "actuators": ("tec",),
            **keys,
        }
    )


class TestFixedRate:
    def test_the_dry_run_counts_its_duration_and_watches_its_signals(self):
        def go(parameters):
            yield Step({"tec": 20.0}, Dwell(3.0))
            yield fast_loop()
            yield fast_loop(duration=0.5, inputs=("a", "b"), actuators=("tec", "supply"), watched=("c",))

        expected = plan(define(go), Nothing())
        assert expected.steps == 3
        assert expected.seconds == expected.at_most == 15.5
        assert expected.watched == {"probe_temperature", "tec_setpoint", "a", "b", "c", "supply_setpoint"}
        # What a controller will ask for is not known beforehand.
        assert expected.extremes == {"tec": (20.0, 20.0)}

    def test_what_it_may_ask_for_is_among_the_extremes(self):
        def go(parameters):
            yield Step({"tec": 20.0}, Dwell(3.0))
            yield fast_loop(limits=((15.0, 18.0),))
            yield fast_loop(actuators=("tec", "supply"), limits=((16.0, 40.0), (-1.0, 1.0)))

        assert plan(define(go), Nothing()).extremes == {"tec": (15.0, 40.0), "supply": (-1.0, 1.0)}

    def test_limits_are_for_each_actuator(self):
        with pytest.raises(ValueError, match="limits for each of 1 actuators, got 2"):
            fast_loop(limits=((0.0, 1.0), (0.0, 1.0)))

    def test_it_is_not_carried_out(self):
        class Untouched:
            def update(self, _, __):
                raise AssertionError("was asked")

        def go(parameters):
            yield fast_loop(controller=Untouched())

        assert plan(define(go), Nothing()).steps == 1

    @cases(
        "keys",
        [
            {"rate": 0.0},
            {"rate": math.nan},
            {"duration": 0.0},
            {"duration": math.nan},
            {"record_every": 0},
            {"record_every": -1},
        ],
    )
    def test_nonsense_is_refused(self, keys):
        with pytest.raises(ValueError, match="FixedRate: expected rate, duration > 0 and record_every ≥ 1"):
            fast_loop(**keys)

        def go(parameters):
            yield fast_loop(**keys)

        with pytest.raises(ConfigurationError, match="protocol go: FixedRate: expected rate, duration > 0"):
            plan(define(go), Nothing())
