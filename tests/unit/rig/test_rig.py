import tomllib
from contextlib import ExitStack

import pytest
from cases import cases
from heater_laboratory import CLOSED, RIG, HeaterLaboratory, HeaterTEC
from hypothesis import given, settings, strategies as st

from bench.base import ConfigurationError, DeviceConnectionError, DeviceError, VirtualClock, WallClock
from bench.rig import DashboardLayout, Rig, load_rig

DRIVER, LABORATORY = '"heater_laboratory:HeaterTEC"', '"heater_laboratory:HeaterLaboratory"'
SPOT = """
[devices.spot]
driver = "heater_laboratory:Spot"
port = "emulated://spot"
"""
DERIVED = """
[derived.curvature]
kind = "cantilever-curvature"
source = "spot_position"
length = 300e-6
"""
DASHBOARD = """
[dashboard]
input = "tec_temperature"
output = "probe_temperature"
input_range = [0.0, 100.0]
output_range = [0.0, 100.0]
plane = [30.0, 70.0]
"""
LOOP = """
[[dashboard.loops]]
input = "probe_temperature"
output = "tec_current"
input_range = [0.0, 100.0]
output_range = [-2.0, 2.0]
"""


@pytest.fixture(autouse=True)
def _closed():
    CLOSED.clear()
    yield
    assert HeaterLaboratory.opened == 0


def wrong(path, *expected, overrides=None):
    """Load and connect a rig that is wrong; the message has all that is expected, and no traceback behind it."""
    with pytest.raises(ConfigurationError) as caught, Rig(load_rig(path, overrides), VirtualClock(), 1):
        pass
    message = str(caught.value)
    for part in (*expected, "heater"):
        assert part in message, message
    assert caught.value.exit_code == 2
    return message


class TestRight:
    def test_loads_and_connects(self, rig_file):
        file = load_rig(rig_file())
        assert file.name == "heater"
        assert file.emulated
        assert [entry.name for entry in file.devices] == ["tec", "probe"]
        assert file.devices[0].driver is HeaterTEC
        with Rig(file, VirtualClock(), 1) as rig:
            assert [signal.name for signal in rig.signals] == [
                "tec_setpoint",
                "tec_temperature",
                "tec_sink_temperature",
                "tec_current",
                "tec_voltage",
                "probe_temperature",
            ]
            assert list(rig.actuators) == ["tec"]
            assert set(rig.measure()) == set(rig.glance()) == {signal.name for signal in rig.signals}
            assert rig.devices["tec"].calls == []
        assert CLOSED == ["probe", "tec"]

    def test_the_text_is_kept_as_it_is(self, rig_file):
        path = rig_file(append="# µ\n")
        assert load_rig(path).text == RIG + "# µ\n"

    def test_a_byte_order_mark_does_no_harm(self, tmp_path):
        path = tmp_path / "heater.toml"
        path.write_text(RIG, encoding="utf-8-sig")
        assert load_rig(str(path)).name == "heater"

    def test_overrides(self, rig_file):
        path = rig_file()
        file = load_rig(
            path,
            {
                "telemetry.period": "2",
                "rig.title": "another",
                "devices.tec.temperature_limits": "[0, 50]",
                "emulation.noise": "0",
            },
        )
        assert file.telemetry.period == 2.0
        assert file.rig.title == "another"
        assert file.devices[0].settings.temperature_limits == (0.0, 50.0)
        assert file.laboratory_settings.noise == 0.0
        assert load_rig(path).rig.title == "a heated plate"

    def test_further_loops(self, rig_file):
        loops = DASHBOARD + LOOP + LOOP.replace("tec_current", "tec_voltage")
        with Rig(load_rig(rig_file(append=loops)), VirtualClock(), 1) as rig:
            first, second = rig.file.dashboard.loops
            table = rig.file.dashboard.model_dump(mode="json")
        assert (first.input, first.output, first.output_range) == ("probe_temperature", "tec_current", (-2.0, 2.0))
        assert second.output == "tec_voltage"
        layout = DashboardLayout.model_validate(table)
        assert list(layout.plots) == ["", "loops.0.", "loops.1."]
        assert [loop.output for loop in layout.loops] == ["tec_current", "tec_voltage"]


class TestFile:
    def test_none(self, tmp_path):
        with pytest.raises(ConfigurationError, match=r"there is no rig 'vo3'; did you mean vo2\?.*path/to/rig.toml"):
            load_rig("vo3")
        wrong(str(tmp_path / "heater.toml"), "cannot be read")

    @cases(
        ("content", "expected"),
        [
            (None, ("cannot be read",)),
            (b"", ("rig: is missing", "devices: is missing")),
            (f"{RIG}\nperiod = \n".encode(), ("not valid TOML", "line")),
            (f"{RIG}\n[rig]\ntitle = 'x'\n".encode(), ("not valid TOML",)),
            (RIG.encode("utf-16"), ("cannot be read", "utf-8")),
            (b"[rig]\ntitle = 'x'\n[devices]\n", ("devices", "at least 1")),
        ],
    )
    def test_what_is_no_rig_file(self, tmp_path, content, expected):
        path = tmp_path / "heater.toml"
        path.mkdir() if content is None else path.write_bytes(content)
        wrong(str(path), *expected)


class TestUnknownKeys:
    @cases(
        ("old", "new", "key", "allowed"),
        [
            (
                "[rig]",
                "titel = 1\n[rig]",
                "titel",
                "rig, devices, lines, roles, protocols, derived, uncertainty, interlocks, telemetry, safety, "
                "dashboard, emulation",
            ),
            ("[rig]", "[tele-metry]\n[rig]", "tele-metry", "telemetry"),
            ("[rig]", "[rig]\ntitel = 'x'", "rig.titel", "title"),
            ('port = "emulated://heater"', 'prot = "x"\nport = "emulated://heater"', "devices.tec.prot", "port"),
            ("high = 90.0", "high = 90.0\nhihg = 3.0", "interlocks.0.hihg", "high"),
            ("noise = 0.002", "noise = 0.002\nnoize = 1", "emulation.noize", "noise"),
        ],
    )
    def test_at_each_level(self, rig_file, old, new, key, allowed):
        message = wrong(rig_file((old, new)), f"{key}: there is no such key", allowed)
        assert len(message.splitlines()) == 1

    @cases(
        ("text", "expected"),
        [
            (DASHBOARD + "level = 3\n", ("dashboard.level: there is no such key", "levels")),
            (
                DASHBOARD + LOOP.replace("output_range", "outputs"),
                ("dashboard.loops.0.outputs: there is no such key", "dashboard.loops.0.output_range: is missing"),
            ),
            (
                DERIVED.replace("length", "lenght"),
                ("derived.curvature.lenght: there is no such key", "derived.curvature.length: is missing"),
            ),
            (DERIVED.replace("[derived.curvature]", "[derived.my-curve]") + "x = 1\n", ("derived.my-curve.x",)),
        ],
    )
    def test_in_tables_that_are_added(self, rig_file, text, expected):
        wrong(rig_file(append=text), *expected)


class TestWrongValues:
    @cases(
        ("old", "new", "expected"),
        [
            ('"a heated plate"', "5", ("rig.title = 5", "a text")),
            ("period = 0.5", "period = 0.0", ("telemetry.period = 0.0", "0.01")),
            ("high = 90.0", "high = 90.0\nlow = 95.0", ("interlocks.0", "low must be below high", "95", "90")),
            ("[10.0, 95.0]", "[10.0]", ("devices.tec.temperature_limits",)),
            ("[10.0, 95.0]", "'warm'", ("devices.tec.temperature_limits = 'warm'", "allowed set-points, °C")),
            ("noise = 0.002", "noise = 2", ("emulation.noise = 2", "≤ 1", "noise of one reading")),
            ("temperature_limits = [10.0, 95.0]", "", ("devices.tec.temperature_limits: is missing",)),
            (f"driver = {DRIVER}", "", ("devices.tec.driver", "expected module:class")),
            (DRIVER, "5", ("devices.tec.driver = 5", "expected module:class")),
            (DRIVER, '"no_such:X"', ("devices.tec.driver = 'no_such:X'", "cannot be loaded")),
            (DRIVER, '"a..b:X"', ("devices.tec.driver = 'a..b:X'",)),
            (DRIVER, '"heater_laboratory:Gone"', ("has no Gone",)),
            (DRIVER, '"heater_laboratory:RIG"', ("devices.tec.driver", "not a class")),
            (DRIVER, '"heater_laboratory:NoSettings"', ("devices.tec.driver", "Settings")),
            (DRIVER, '"heater_laboratory:NoDriver"', ("devices.tec.driver", "is not a Device")),
            (f"laboratory = {LABORATORY}", f"laboratory = {DRIVER}", ("emulation.laboratory", "HeaterTEC")),
            (f"laboratory = {LABORATORY}", "", ("emulation.laboratory",)),
            (LABORATORY, '"no_such:X"', ("emulation.laboratory = 'no_such:X'",)),
            ('"emulated://heater"', '"emulated://cooler"', ("port = 'emulated://cooler'", "emulated://heater")),
            ('"probe_temperature"', '"prob_temperature"', ("signal = 'prob_temperature'", "probe_temperature")),
        ],
    )
    def test_names_file_key_value_and_what_is_allowed(self, rig_file, old, new, expected):
        wrong(rig_file((old, new)), *expected)

    @cases("code", ["1 / 0", "raise RuntimeError('no')", "def broken(:", "import no_such_module", "undefined"])
    def test_a_driver_whose_module_fails(self, rig_file, tmp_path, monkeypatch, code):
        (tmp_path / "failing_driver.py").write_text(code)
        monkeypatch.syspath_prepend(str(tmp_path))
        wrong(
            rig_file(("heater_laboratory:HeaterTEC", "failing_driver:X")), "devices.tec.driver = 'failing_driver:X'"
        )

    def test_an_emulated_port_without_a_laboratory(self, rig_file):
        path = rig_file(('[emulation]\nlaboratory = "heater_laboratory:HeaterLaboratory"\nnoise = 0.002', ""))
        wrong(path, "devices.tec.port = 'emulated://heater'", "none: the rig has no [emulation]")

    @cases("table", ["rig", "devices", "telemetry", "emulation", "interlocks", "derived", "dashboard"])
    def test_a_table_that_is_none(self, tmp_path, table):
        path = tmp_path / "heater.toml"
        text = f"{table} = 5\n" + ("" if table == "rig" else "[rig]\ntitle = 'x'\n")
        path.write_text(text + ("" if table == "devices" else "[devices.a]\ndriver = 'a:b'\n"))
        wrong(str(path), f"{table} = 5")

    def test_all_wrong_devices_are_named_at_once(self, rig_file):
        message = wrong(
            rig_file(("heater_laboratory:HeaterTEC", "no_such:A"), ("heater_laboratory:Thermometer", "no_such:B"))
        )
        assert len(message.splitlines()) == 2

    @cases(
        ("key", "value"),
        [
            ("input_range", "[1.0, 1.0]"),
            ("output_range", "[nan, 1.0]"),
            ("plane", "[0.0, inf]"),
        ],
    )
    def test_dashboard_ranges(self, rig_file, key, value):
        lines = [line for line in DASHBOARD.splitlines() if not line.startswith(key)]
        wrong(rig_file(append="\n".join([*lines, f"{key} = {value}\n"])), f"dashboard.{key}")

    @cases(("key", "value"), [("input_range", "[1.0, 1.0]"), ("output_range", "[2.0, nan]")])
    def test_ranges_of_a_further_loop(self, rig_file, key, value):
        lines = [line for line in LOOP.splitlines() if not line.startswith(key)]
        wrong(rig_file(append="\n".join([DASHBOARD, *lines, f"{key} = {value}\n"])), f"dashboard.loops.0.{key}")

    @cases(("key", "name"), [("input", "probe_temperature"), ("output", "tec_current")])
    def test_signals_of_a_further_loop(self, rig_file, key, name):
        wrong(
            rig_file(append=DASHBOARD + LOOP + LOOP.replace(f'{key} = "{name}"', f'{key} = "tec"')),
            f"dashboard.loops.1.{key} = 'tec'",
            "tec_setpoint",
        )


class TestDerived:
    def test_is_computed(self, rig_file):
        with Rig(load_rig(rig_file(append=SPOT + DERIVED)), VirtualClock(), 1) as rig:
            assert rig.signals[-1].name == "curvature"
            rig.devices["tec"].set(82.0)
            rig.clock.sleep(100.0)
            values = rig.measure()
            assert values["spot_position"] == pytest.approx(60e-6, abs=0.05e-6)
            assert values["curvature"] == pytest.approx(1350.0, abs=5.0)

    @cases(
        ("text", "expected"),
        [
            (
                SPOT + DERIVED + DERIVED.replace(".curvature", ".again").replace("spot_position", "curvature"),
                ("derived.again.source = 'curvature'", "1/m"),
            ),
            (DERIVED, ("derived.curvature.source = 'spot_position'", "probe_temperature")),
            (DERIVED.replace("spot_position", "curvature"), ("derived.curvature.source = 'curvature'",)),
            (DERIVED.replace("cantilever-curvature", "magic"), ("derived.curvature.kind = 'magic'",)),
            (DERIVED + "residual_curvature = 9000\n", ("derived.curvature", "7770.4 1/m")),
        ],
    )
    def test_a_source_or_kind_that_does_not_fit_is_refused(self, rig_file, text, expected):
        wrong(rig_file(append=text), *expected)


class TestSample:
    def test_takes_the_best_reading_of_what_is_wanted_and_glances_at_the_rest(self, rig_file):
        with Rig(load_rig(rig_file()), VirtualClock(), 1) as rig:
            rig.devices["tec"].measure_error = DeviceError("tec", "was measured")
            rig.devices["probe"].glance_error = DeviceError("probe", "was glanced at")
            values = rig.sample(["probe_temperature"])
            assert set(values) == {signal.name for signal in rig.signals}
            for wanted in ([], ["tec_setpoint"]):
                with pytest.raises(DeviceError, match="probe: was glanced at"):
                    rig.sample(wanted)
            for wanted in (["tec_current"], ["tec_temperature", "probe_temperature"]):
                with pytest.raises(DeviceError, match="tec: was measured"):
                    rig.sample(wanted)

    def test_a_derived_signal_needs_the_best_reading_of_its_source(self):
        def read(ask):
            with Rig(load_rig("vo2"), VirtualClock(), 1) as rig:
                return ask(rig)["psd_position"]

        glanced = read(lambda rig: rig.glance())
        measured = read(lambda rig: rig.devices["tec"].glance() | rig.devices["psd"].measure())
        assert measured != glanced
        assert read(lambda rig: rig.sample(["curvature"])) == measured
        assert read(lambda rig: rig.sample(("psd_position",))) == measured
        assert read(lambda rig: rig.sample({"tec_temperature"})) == glanced


class TestNames:
    def test_two_signals_of_one_name(self, rig_file):
        more = '\n[devices.tec_sink]\ndriver = "heater_laboratory:Thermometer"\nport = "emulated://thermometer"\n'
        wrong(rig_file(append=more), "tec_sink_temperature")

    @cases("name", ["Probe", "probe"])
    def test_case_does_not_make_a_difference(self, rig_file, name):
        more = (
            f'\n[devices.{name.upper()}]\ndriver = "heater_laboratory:Thermometer"\nport = "emulated://thermometer"\n'
        )
        wrong(rig_file(append=more), "PROBE_temperature")


class TestOverrides:
    @cases(
        ("key", "expected"),
        [
            ("devices.laser.port", "there is no table 'devices.laser' in which 'port' could be set"),
            ("dashboard.levels", "there is no table 'dashboard'"),
            ("interlocks.0.high", "there is no table 'interlocks.0'"),
            ("devices.tec.prot", "devices.tec.prot: there is no such key"),
            ("telemetry.period", "telemetry.period = 'soon'"),
            ("telemetry", "telemetry = 'soon'"),
            ("", "there is no such key"),
        ],
    )
    def test_of_what_is_not_there(self, rig_file, key, expected):
        wrong(rig_file(), expected, overrides={key: "soon"})

    @settings(max_examples=40)
    @given(st.text(max_size=20), st.text(max_size=20))
    def test_any_text(self, tmp_path_factory, key, value):
        path = tmp_path_factory.getbasetemp() / "heater.toml"
        path.write_text(RIG, encoding="utf-8")
        try:
            load_rig(str(path), {key: value, "devices.tec.port": value})
        except ConfigurationError as error:
            assert str(error)  # noqa: PT017 - either way is right


class TestConnecting:
    def test_those_connected_before_are_closed_again(self, rig_file):
        path = rig_file(
            ('port = "emulated://thermometer"', 'port = "emulated://thermometer"\nconnect_error = "no answer"')
        )
        with pytest.raises(DeviceConnectionError, match="probe: no answer"):
            Rig(load_rig(path), VirtualClock(), 1)
        assert CLOSED == ["tec"]

    @cases(("slow", "tries"), [(1.0, 1), (2.0, 2)])
    def test_one_that_does_not_answer_is_asked_once_more_on_a_busy_computer(self, rig_file, monkeypatch, slow, tries):
        calls, connect = [], HeaterTEC.connect

        def fail_once(*given):
            calls.append(given)
            if len(calls) == 1:
                raise DeviceConnectionError("tec", "no answer")
            return connect(*given)

        monkeypatch.setattr(HeaterTEC, "connect", fail_once)
        monkeypatch.setattr("bench.rig.connected.slowness", lambda: slow)
        with ExitStack() as stack:
            if tries == 1:
                stack.enter_context(pytest.raises(DeviceConnectionError, match="no answer"))
            Rig(load_rig(rig_file()), WallClock(), 1).close()
        assert len(calls) == tries

    def test_one_that_fails_to_close_keeps_none_from_being_closed(self, rig_file):
        with Rig(load_rig(rig_file()), VirtualClock(), 1) as rig:
            for device in rig.devices.values():
                device.close_error = OSError(5, "Input/output error")
        assert CLOSED == ["probe", "tec"]


def _paths(node, prefix=()):
    for key, value in node.items() if isinstance(node, dict) else enumerate(node):
        yield (*prefix, key)
        if isinstance(value, dict | list):
            yield from _paths(value, (*prefix, key))


def _toml(value):
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_toml(str(key))} = {_toml(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, str):
        escaped = "".join(c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08x}" for c in value)
        return f'"{escaped}"'
    return repr(value)


texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=10)
values = st.one_of(
    texts,
    st.integers(-(2**63), 2**63 - 1),
    st.floats(),
    st.booleans(),
    st.lists(st.floats(), max_size=3),
    st.dictionaries(texts, st.integers(0, 3), max_size=2),
    st.sampled_from(
        ["emulated://heater", "heater_laboratory:HeaterTEC", "os:getcwd", "tec_temperature", "json:JSONDecoder"]
    ),
)


@settings(max_examples=400, deadline=None)
@given(data=st.data())
def test_any_mutation_loads_or_is_a_configuration_error(tmp_path_factory, data):
    content = tomllib.loads(RIG + SPOT + DASHBOARD + LOOP + DERIVED)
    for _ in range(data.draw(st.integers(1, 3))):
        known = list(_paths(content))
        if not known:
            break
        *parents, key = data.draw(st.sampled_from(known))
        node = content
        for part in parents:
            node = node[part]
        action = data.draw(st.sampled_from(["delete", "rename", "replace", "add"]))
        if action == "delete":
            del node[key]
        elif action == "replace" or not isinstance(node, dict):
            node[key] = data.draw(values)
        elif action == "rename":
            node[data.draw(texts)] = node.pop(key)
        else:
            node[data.draw(texts)] = data.draw(values)
    path = tmp_path_factory.getbasetemp() / "mutated.toml"
    path.write_text("\n".join(f"{_toml(key)} = {_toml(value)}" for key, value in content.items()), encoding="utf-8")
    try:
        with Rig(load_rig(str(path)), VirtualClock(), 1) as rig:
            assert rig.signals
    except ConfigurationError as error:
        assert "mutated.toml" in str(error)  # noqa: PT017 - either way is right
    except DeviceConnectionError:
        pass  # a port that is no emulated one any more


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_any_damage_to_the_text_is_a_configuration_error(tmp_path_factory, data):
    content = bytearray((RIG + SPOT + DERIVED).encode())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at : at + data.draw(st.integers(0, 6))] = data.draw(st.binary(max_size=4))
    path = tmp_path_factory.getbasetemp() / "damaged.toml"
    path.write_bytes(bytes(content))
    try:
        with Rig(load_rig(str(path)), VirtualClock(), 1):
            pass
    except ConfigurationError as error:
        assert "damaged.toml" in str(error)  # noqa: PT017 - either way is right
    except DeviceConnectionError:
        pass  # a port that is no emulated one any more


class TestQuickReader:
    def test_reads_the_devices_of_what_is_wanted_and_no_other(self, rig_file):
        with Rig(load_rig(rig_file(append=SPOT + DERIVED)), VirtualClock(), 1) as rig:
            for device in rig.devices.values():
                device.glance_error = DeviceError(device.name, "was glanced at")
                device.measure_error = DeviceError(device.name, "was measured")
            assert rig.quick_reader(())() == {}
            for signal, device in (("probe_temperature", "probe"), ("tec_current", "tec")):
                read = rig.quick_reader((signal,))
                with pytest.raises(DeviceError, match=f"{device}: was glanced at"):
                    read()
                rig.devices[device].glance_error = None
                assert signal in read()

    def test_gives_all_that_these_devices_deliver(self, rig_file):
        with Rig(load_rig(rig_file()), VirtualClock(), 1) as rig:
            values = rig.quick_reader(("tec_current",))()
            assert set(values) == {"tec_temperature", "tec_sink_temperature", "tec_current", "tec_voltage"}
            assert set(rig.quick_reader({"probe_temperature"})()) == {"probe_temperature"}

    def test_reads_anew_each_time(self, rig_file):
        with Rig(load_rig(rig_file()), VirtualClock(), 1) as rig:
            read = rig.quick_reader(["probe_temperature"])
            rig.devices["tec"].set(60.0)
            seen = []
            for _ in range(3):
                rig.clock.sleep(0.5)
                seen.append(read()["probe_temperature"])
            assert 25.0 < seen[0] < seen[1] < seen[2] < 60.0

    def test_setpoints_are_not_among_them(self, rig_file):
        with Rig(load_rig(rig_file()), VirtualClock(), 1) as rig:
            assert rig.quick_reader(("tec_setpoint",))() == {}

    def test_a_derived_one_is_computed_and_so_is_what_it_comes_from(self, rig_file):
        with Rig(load_rig(rig_file(append=SPOT + DERIVED)), VirtualClock(), 1) as rig:
            values = rig.quick_reader(("curvature",))()
            assert set(values) == {"spot_position", "curvature"}
            derived = rig.derived["curvature"]
            assert values["curvature"] == derived.compute({"spot_position": values["spot_position"]})
            # Not unless it is wanted.
            assert set(rig.quick_reader(("spot_position",))()) == {"spot_position"}

    def test_agrees_with_a_quick_reading_of_everything(self):
        def read(ask):
            with Rig(load_rig("hybrid"), VirtualClock(), 1) as rig:
                return ask(rig)

        everything = read(lambda rig: rig.glance())
        wanted = ("displacement_position", "base_temperature", "tip_temperature")
        some = read(lambda rig: rig.quick_reader(wanted)())
        assert some == {name: everything[name] for name in wanted}
