import io
import json
import math
import os
import re
import signal
import sys
from datetime import datetime

import numpy as np
import pexpect
import pytest
from adaptive_protocols import bisect, climb, wait_for_ever
from cases import cases
from film import film_model
from heater_laboratory import CLOSED, HeaterLaboratory
from heater_protocols import stairs
from places import SUPPORT
from rich.console import Console

from bench.base import AbortError, ConfigurationError, VirtualClock
from bench.execution import Rehearsal, Run, carry_out, foresee
from bench.execution.rehearsal import rehearse
from bench.identification import ModelFile
from bench.protocol import Dwell, Step, Summary, find_protocol, plan, protocol
from bench.record import FILE_NAME, Record, run_card
from bench.rig import Rig, load_rig, twin_of

GOALS = {"vo2": {"goal": 900.0, "low": 30.0, "high": 80.0}, "sma": {"goal": -1.2e-3, "low": 0.0, "high": 3.0}}


@pytest.fixture
def console():
    return Console(file=io.StringIO(), width=200)


@pytest.fixture
def make(tmp_path, rig_file):
    def run(*replacements, definition=stairs, settings=None, append="", **keys):
        chosen = {
            "protocol": definition,
            "settings": settings or {},
            "folder": tmp_path / "runs",
            "recording": False,
            "clock": "x1000",
            **keys,
        }
        return Run(**{"rig": keys.get("rig") or rig_file(*replacements, append=append), **chosen})

    CLOSED.clear()
    yield run
    assert HeaterLaboratory.opened == 0


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A model near the emulated specimen."""
    path, operator = tmp_path_factory.mktemp("models") / "preisach.json", film_model()
    ModelFile("preisach-nonmonotonic", operator, operator.initial_state().advance(np.array([21.0, 84.0]))).save(path)
    return str(path)


def as_protocol(generator):
    """Make a protocol of the heater's TEC, with the parameters of `stairs`."""
    generator.__annotations__ = {"parameters": stairs.parameters}
    generator.__doc__ = "Do it."
    return protocol(needs=("tec",))(generator)


class TestRehearsal:
    @pytest.mark.parametrize(("definition", "rig"), [(climb, "vo2"), (bisect, "sma")])
    def test_a_protocol_that_goes_by_its_readings_does_what_was_rehearsed(self, make, console, rig, definition):
        run = make(definition=definition, settings=GOALS[rig], rig=rig, clock="virtual", interlock_rate=None)
        rehearsal = foresee(run, console)
        assert (rehearsal.status, rehearsal.complete, rehearsal.findings) == ("completed", True, ())
        assert rehearsal.at_most == math.inf
        result = carry_out(run, console)
        assert result.outcome.status == "completed"
        assert (rehearsal.steps, rehearsal.seconds) == (result.outcome.steps, result.outcome.laboratory_seconds)
        with Record(result.folder) as record:
            assert not record.meta["plan"]["complete"]
            assert record.meta["plan"]["at_most"] is None
            steps, telemetry = record.steps(), record.telemetry()
            assert rehearsal.marks == tuple(enumerate(steps["finished"].tolist(), 1))
            for name, each in rehearsal.extremes.items():
                seen = np.concatenate([steps[name], telemetry[name]])
                assert (each.low, each.high) == (np.nanmin(seen), np.nanmax(seen))

    @pytest.mark.parametrize("protocol_name", ["tracking", "following"])
    def test_a_run_under_control_takes_as_long_as_rehearsed(self, make, console, model, protocol_name):
        """Those of another session differ by what it draws at random: on this film by 4 %, one standard deviation."""
        settings = {"readings": 1, "count": 8} if protocol_name == "tracking" else {"duration": 60}
        settings["model"] = model
        # The model is one of curvature itself, not of what a detector with errors makes of it.
        common = {"definition": find_protocol(protocol_name), "settings": settings, "rig": "vo2",
                  "overrides": {"emulation.sensors": "ideal"}}  # fmt: skip

        def rehearsed(seed):
            return foresee(make(clock="wall", seed=seed, **common), console).seconds

        outcome = carry_out(make(clock="virtual", seed=7, **common), console).outcome
        assert outcome.status == "completed"
        assert rehearsed(7) == pytest.approx(outcome.laboratory_seconds, rel=0.02)
        others = [rehearsed(seed) for seed in range(3)]
        assert np.median(others) == pytest.approx(outcome.laboratory_seconds, rel=0.12)

    @pytest.mark.parametrize(
        ("rig", "overrides", "shortened"),
        [
            ("vo2", {}, ["tec may be lost for 3 s at most, 0.6 of the watchdog of tec, 5 s"]),
            ("vo2", {"safety.reconnect": "3.0"}, []),
            # A guardian would look at the interlocks.
            ("vo2-hardware", {}, ["tec, psd may be lost for 2 s at most, as an interlock needs its readings"]),
        ],
    )
    def test_what_cuts_the_key_reconnect_short_is_said(self, make, console, rig, overrides, shortened):
        creep = find_protocol("creep")
        found = foresee(make(definition=creep, rig=rig, overrides=overrides), console)
        assert [*found.shortened] == [f"safety.reconnect = 10: the line of {each}" for each in shortened]
        assert tuple(found.to_json()["shortened"]) == found.shortened

    def test_the_key_reconnect_that_is_cut_short_is_warned_of_in_the_record(self, make, console):
        run = make(
            rig="vo2", definition=find_protocol("creep"), clock="virtual", overrides={"safety.reconnect": "10"}
        )
        with Record(carry_out(run, console).folder) as record:
            warnings = [event.text for event in record.events() if event.level == "WARN"]
        assert any("safety.reconnect = 10: the line of tec may be lost for 3 s at most" in each for each in warnings)

    def test_margins_are_those_to_devices_and_interlocks(self, make, console):
        rehearsal = foresee(make(settings={"start": 40.0}), console)
        setpoint, probe = rehearsal.extremes["tec_setpoint"], rehearsal.extremes["probe_temperature"]
        assert (setpoint.low, setpoint.high, setpoint.margin) == (40.0, 55.0, 30.0)
        assert [bound.by for bound in (*setpoint.bounds, *probe.bounds)] == ["device", "interlock"]
        assert probe.margin == 90.0 - probe.high
        assert rehearsal.extremes["tec_current"].margin == math.inf
        written = json.loads(json.dumps(rehearsal.to_json(), allow_nan=False))
        assert written["steps"] == rehearsal.steps
        assert written["extremes"]["tec_setpoint"]["margin"] == 30.0
        assert written["extremes"]["tec_current"]["margin"] is None

    def test_a_reading_beyond_which_its_device_raises_is_a_bound(self, make, console):
        limits = {"devices.psd.position_limits": "[-40e-6, 95e-6]"}
        interlock = {"interlocks": '[{ signal = "psd_position", high = 98e-6 }]'}
        definition = find_protocol("creep")
        common = {"definition": definition, "settings": {"duration": 20.0}, "rig": "vo2"}
        psd = foresee(make(overrides=limits | interlock, **common), console).extremes["psd_position"]
        bounds = [("device", -40e-6, 95e-6), ("interlock", -math.inf, 98e-6)]
        assert [(bound.by, bound.low, bound.high) for bound in psd.bounds] == bounds
        assert psd.margin == min(95e-6 - psd.high, psd.low + 40e-6)
        # And it is not only said: nearer to the limit the device ends the run.
        beyond = {"devices.psd.position_limits": f"[-40e-6, {psd.high - 5e-6}]"}
        refused = foresee(make(overrides=beyond, **common), console)
        assert "is outside of its calibrated range" in refused.reason

    def test_what_warns_is_found_and_refuses_nothing(self, make, console):
        warning = '\n[[interlocks]]\nsignal = "probe_temperature"\nminus = "tec_temperature"\nhigh = -9.0\n' \
            'level = "warn"\n'  # fmt: skip
        rehearsal = foresee(make(append=warning), console)
        assert rehearsal.is_right
        assert {finding.kind for finding in rehearsal.findings} == {"interlock"}
        difference = rehearsal.extremes["probe_temperature - tec_temperature"]
        assert (difference.unit, difference.margin) == ("K", -9.0 - difference.high)

    @pytest.mark.parametrize(("name", "limit"), [("LONGEST", 50), ("LONGEST_DAYS", 0.01)])
    def test_a_protocol_that_waits_for_ever_is_refused(self, make, console, monkeypatch, name, limit):
        monkeypatch.setattr(f"bench.execution.rehearsal.{name}", limit)
        run = make(definition=wait_for_ever, settings=GOALS["vo2"], rig="vo2")
        with pytest.raises(ConfigurationError, match=r"wait-for-ever does not end in its rehearsal on vo2, within"):
            foresee(run, console)

    @pytest.mark.parametrize("last", [False, True], ids=["in its middle", "behind its last step"])
    def test_ctrl_c_ends_it(self, make, console, last):
        def press(parameters):
            yield Step({"tec": 30.0}, Dwell(1.0))
            signal.raise_signal(signal.SIGINT)
            if not last:
                yield Step({"tec": 31.0}, Dwell(1.0))

        run = make(definition=as_protocol(press))
        former = signal.signal(signal.SIGINT, lambda *_: None)
        try:
            # Nobody has paused.
            with pytest.raises(AbortError, match=r"^the rehearsal was ended by Ctrl-C; nothing has moved$"):
                carry_out(run, console)
        finally:
            signal.signal(signal.SIGINT, former)
        assert not run.folder.exists()

    def test_what_a_protocol_raises_to_end_it_is_not_said_to_be_the_operator(self, make, console):
        def give_up(parameters):
            if (yield Step({"tec": 30.0}, Dwell(1.0))).time > 0.0:
                raise SystemExit

        with pytest.raises(AbortError, match=r"^in the rehearsal: ended by SystemExit, which the protocol raised; "):
            foresee(make(definition=as_protocol(give_up)), console)


class TestBeforeARun:
    def test_an_interlock_that_would_trip_refuses_the_run(self, make, console):
        run = make(("high = 90.0", "high = 41.0"), settings={"dwell": 10.0})
        with pytest.raises(ConfigurationError, match=r"on heater.* after 3 steps.*interlock: .*Nothing has moved"):
            carry_out(run, console)
        assert not run.folder.exists()

    def test_a_setpoint_that_a_reading_decides_is_checked_too(self, make, console):
        run = make(definition=climb, settings={**GOALS["vo2"], "goal": 1e6}, rig="vo2")
        with pytest.raises(ConfigurationError, match=r"tec: set-point .* is outside of 15 to 95 °C"):
            carry_out(run, console)

    def test_the_record_keeps_what_was_found(self, make, console):
        result = carry_out(make(settings={"dwell": 4.0}), console)
        with Record(result.folder) as record:
            kept = record.meta["rehearsal"]
            assert (kept["steps"], kept["seconds"]) == (4, record.meta["finished"])
            card = run_card(record.meta)
        assert "| rehearsed on heater | 4 steps, 0:00:16, at most 0:00:16 |" in card
        assert "tec_setpoint 20 °C" in card

    def test_a_run_without_rehearsal(self, make, console):
        for keys in ({"rehearse": False}, {"clock": "virtual"}):
            with Record(carry_out(make(**keys), console).folder) as record:
                assert record.meta["rehearsal"] is None
                assert "| planned | 4 steps, 0:00:08 |" in run_card(record.meta)


class TestTwin:
    HARDWARE = 'extends = "vo2"\nwithout = ["emulation"]\n[rig]\ntitle = "x"\n[devices.tec]\nport = "/dev/ttyUSB0"\n'

    def write(self, tmp_path, text, name="desk.toml"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return str(path)

    def twin(self, path):
        return twin_of(load_rig(path), path)

    def test_an_emulated_rig_is_its_own(self):
        file = load_rig("vo2")
        assert twin_of(file, "vo2") is file
        wired = load_rig("vo2", {"devices.tec.port": "/dev/ttyUSB9", "telemetry.period": "0.7"})
        twin = twin_of(wired, "vo2")
        assert twin.in_process
        assert twin.telemetry.period == 0.7

    def test_limits_interlocks_and_slots_are_those_of_the_rig(self, tmp_path):
        text = self.HARDWARE + 'temperature_limits = [18.0, 60.0]\naddress = 7\n[telemetry]\nperiod = 0.5\n' \
            '[devices.psd]\nport = "tcp://192.0.2.7:502"\nvolts_per_metre = 2e5\n' \
            '[[interlocks]]\nsignal = "psd_position"\nhigh = 1e-3\n[roles.drive]\nrange = [20.0, 50.0]\n'  # fmt: skip
        twin = self.twin(self.write(tmp_path, text))
        tec, psd = (entry.settings for entry in twin.devices)
        assert tec.temperature_limits == (18.0, 60.0)
        # Of the instrument that is emulated.
        assert (tec.address, psd.volts_per_metre) == (1, 1e5)
        assert (twin.telemetry.period, twin.roles["drive"].range) == (0.5, (20.0, 50.0))
        assert [each.signal for each in twin.interlocks] == ["psd_position"]

    def test_a_rig_names_its_twin(self, tmp_path):
        self.write(tmp_path, 'extends = "vo2"\n[rig]\ntitle = "mine"\n[emulation]\npsd_noise = 1e-3\n', "mine.toml")
        named = self.HARDWARE.replace("[rig]\n", '[rig]\ntwin = "mine.toml"\n')
        twin = self.twin(self.write(tmp_path, named))
        assert (twin.name, twin.laboratory_settings.psd_noise) == ("mine", 1e-3)

    def test_a_rig_without_a_twin_is_planned(self, rig_file):
        path = rig_file(
            ("emulated://heater", "COM1"), ("emulated://thermometer", "COM2"),
            ('[emulation]\nlaboratory = "heater_laboratory:HeaterLaboratory"\nnoise = 0.002\n', ""),
        )  # fmt: skip
        assert self.twin(path) is None
        with Rig(load_rig("vo2"), VirtualClock(), 0) as rig:
            settings = climb.parse(GOALS["vo2"])
            expected = plan(climb, settings, rig.description.slots(climb))
            found = Rehearsal.of_plan(rig.description, climb, expected)
        assert (found.twin, found.status, found.complete, found.steps) == ("", "planned", False, 1)
        assert found.extremes["tec_setpoint"].margin == 15.0

    @pytest.mark.parametrize(("rig", "steps"), [("vo2", 243), ("sma", 244)])
    def test_creep_is_planned_to_its_end(self, make, console, rig, steps):
        """Its notes compare readings, and its steps do not depend on them."""
        creep = find_protocol("creep")
        with Rig(load_rig(rig), VirtualClock(), 0) as laboratory:
            description = laboratory.description
            settings = creep.parse({}, description.file.roles)
            found = Rehearsal.of_plan(description, creep, plan(creep, settings, description.slots(creep)))
        assert (found.complete, found.steps) == (True, steps)
        assert found.seconds <= found.at_most < math.inf
        drive = found.extremes[f"{description.file.roles['drive'].device}_setpoint"]
        assert drive.low <= settings.cool < settings.hot <= drive.high
        rehearsal = foresee(make(definition=creep, rig=rig, settings={"duration": 20.0}), console)
        assert rehearsal.seconds <= rehearsal.at_most < math.inf

    def test_a_summary_is_not_asked_for_in_a_plan_and_stands_in_the_log(self, make, console):
        def sum_up(parameters):
            first = yield Step({"tec": 20.0}, Dwell(1.0))
            second = yield Step({"tec": 30.0}, Dwell(1.0))
            readings = [first["probe_temperature"], second["probe_temperature"]]
            yield Summary(
                lambda: f"of {len(readings)} readings the greatest is the last: {max(readings) == readings[-1]}"
            )
            yield Step({"tec": 40.0}, Dwell(1.0))

        definition = as_protocol(sum_up)
        found = plan(definition, definition.parse({}, {}))
        assert (found.complete, found.steps, found.extremes["tec"]) == (True, 3, (20.0, 40.0))
        with Record(carry_out(make(definition=definition, clock="virtual"), console).folder) as record:
            notes = [event.text for event in record.events() if event.kind == "note"]
        assert notes == ["of 2 readings the greatest is the last: True"]

    @cases(
        ("change", "message"),
        [
            ('twin = "vo3"', "there is no rig 'vo3'"),
            ('twin = "vo2-hardware"', r"rig.twin = 'vo2-hardware': expected an emulated rig, and that one has no"),
            ('twin = "sma"', r"desk.toml: roles.drive.device = 'tec', and the twin sma.toml has 'supply'"),
        ],
    )
    def test_a_twin_that_does_not_fit(self, tmp_path, change, message):
        path = self.write(tmp_path, self.HARDWARE.replace("[rig]\n", f"[rig]\n{change}\n"))
        with pytest.raises(ConfigurationError, match=message):
            self.twin(path)

    def test_a_twin_without_a_device_that_the_protocol_needs(self, tmp_path):
        bare = 'extends = "vo2"\nwithout = ["devices.psd", "derived", "roles.response", "dashboard", ' \
            '"interlocks", "uncertainty"]\n[rig]\ntitle = "bare"\n'  # fmt: skip
        self.write(tmp_path, bare, "bare.toml")
        path = self.write(tmp_path, self.HARDWARE.replace("[rig]\n", '[rig]\ntwin = "bare.toml"\n'))
        twin = self.twin(path)
        # The slot went with the device, and so did the interlock on it; that on the plate stays.
        assert set(twin.roles) == {"drive"}
        assert "tec_current" in [each.signal for each in twin.interlocks]
        creep = find_protocol("creep")
        with pytest.raises(ConfigurationError, match=r"bare.toml, the twin of .*desk.toml.*roles.response"):
            rehearse(creep, creep.parse({}, load_rig(path).roles), twin, rig="desk")


class TestEnd:
    """The end that the display shows, from 5 % of a run on."""

    @pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")
    def test_it_fits_within_a_tenth(self, tmp_path):
        command = ["-m", "bench", "run", "creep", "--rig", "vo2", "--clock", "x50", "--seed", "3"]
        command += ["--set=duration=30", "--out", str(tmp_path)]
        environment = {**os.environ, "TERM": "xterm", "NO_COLOR": "1", "COLUMNS": "400"}
        with pexpect.spawn(
            sys.executable, command, dimensions=(40, 400), env=environment, encoding="utf-8", timeout=180
        ) as terminal:
            terminal.expect(pexpect.EOF)
            text = terminal.before
        ended = datetime.now()  # noqa: DTZ005 - as the display
        assert terminal.exitstatus == 0, text
        with Record(next(tmp_path.glob(f"*/{FILE_NAME}"))) as record:
            whole = record.meta["finished"]
        shown = re.findall(r"t ([\d:]+), left ([\d:]+) laboratory ≈ [\d.]+ \w+, ends ([\d:]+)", text)
        frames = [(seconds(t), seconds(left), end) for t, left, end in shown if seconds(t) > 0.05 * whole]
        assert len(frames) > 3
        for t, left, end in frames:
            assert t + left == pytest.approx(whole, rel=0.1, abs=1.0)
            of_day = datetime.strptime(end, "%H:%M").replace(ended.year, ended.month, ended.day)  # noqa: DTZ007
            assert abs((of_day - ended).total_seconds()) % 86400.0 < 120.0


def seconds(text):
    hours, minutes, rest = map(int, text.split(":"))
    return 3600 * hours + 60 * minutes + rest


class TestCommand:
    PROTOCOL = f"{SUPPORT / 'adaptive_protocols.py'}:bisect"
    SET = ("--set", "goal=900", "--set", "low=30", "--set", "high=80")

    def test_it_prints_what_the_run_would_do(self, bench, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        results = []
        for command in (["rehearse"], ["run", "--dry-run"]):
            result = tmp_path / f"{len(results)}.json"
            code, out, err = bench(*command, self.PROTOCOL, "--rig", "vo2-hardware", *self.SET, "--json", result)
            assert (code, err) == (0, "")
            assert "bisect on vo2-hardware, rehearsed on vo2" in out
            assert re.search(r"tec_setpoint +30.000 +\S+ +°C +15 to 95", out)
            results.append(json.loads(result.read_text()))
        assert results[0] == results[1]
        assert results[0]["steps"] == 8
        assert sorted(path.name for path in tmp_path.iterdir()) == ["0.json", "1.json"]

    def test_what_would_not_complete_exits_like_a_wrong_parameter(self, bench, tmp_path):
        result = tmp_path / "result.json"
        settings = ("--set", "goal=1e6", "--set", "low=30", "--set", "high=80")
        protocol_name = self.PROTOCOL.replace(":bisect", ":climb")
        code, out, err = bench("rehearse", protocol_name, "--rig", "vo2", *settings, "--json", result)
        assert code == 2
        assert re.search(r"error: tec: set-point [\d.]+ °C is outside of 15 to 95 °C", re.sub(r"\s+", " ", out))
        assert re.search(r"in the rehearsal on vo2, protocol climb ends after \d+ steps", re.sub(r"\s+", " ", err))
        assert json.loads(result.read_text())["status"] == "failed"

    @cases(
        ("arguments", "message"),
        [
            (["rehearse", "creep", "--rig", "vo2", "--set", "cool=10"], "would set tec to between 10 and 80 °C"),
            (["run", "creep", "--rig", "vo2", "--dry-run", "--no-rehearse"], "leave --no-rehearse out"),
        ],
    )
    def test_bad_input_is_one_message(self, bench, arguments, message):
        code, _, err = bench(*arguments)
        assert code == 2
        assert message in err
        assert err.count("error:") == 1
