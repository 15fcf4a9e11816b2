import math
import sqlite3
import threading
from dataclasses import replace

import numpy as np
import pytest
from cases import cases
from heater_protocols import Settle, Stairs, Watcher, settle, stairs

from bench.base import (
    AbortError,
    ConfigurationError,
    ConvergenceError,
    DeviceError,
    InterlockError,
    Interrupts,
    LimitError,
    PacedClock,
    RecordError,
    SettleTimeoutError,
    VirtualClock,
    WallClock,
)
from bench.control import Command, Trace
from bench.execution import check_before_moving
from bench.execution.engine import Engine
from bench.execution.resumption.feeding import Past, feed
from bench.execution.station.local import LocalStation
from bench.operator import ABORT, RESUME
from bench.protocol import (
    PARAMETER,
    TRACES,
    Control,
    Dwell,
    Note,
    ParameterChange,
    Prompt,
    ProtocolParameters,
    Step,
    UntilSteady,
    plan,
    protocol,
)
from bench.record import FILE_NAME, Journal, Record
from bench.record.store import Store
from bench.rig import Rig, load_rig


class Nothing(ProtocolParameters):
    pass


def define(function):
    function.__annotations__ = {"parameters": Nothing}
    function.__doc__ = "A protocol."
    return protocol(needs=("tec",))(function)


class Bench:
    """A rig with its journal and engine; `record` reads back what was written."""

    def __init__(self, folder, path, clock=None, seed=1, observers=(), ask=None, traces=False, **keys):
        self.folder = folder
        self.clock = clock or VirtualClock()
        self.rig = Rig(load_rig(path), self.clock, seed)
        self.tec, self.probe = self.rig.devices["tec"], self.rig.devices["probe"]
        self.journal = Journal(folder / FILE_NAME, self.rig.signals + TRACES * traces, {}, flushed=False)
        self.interrupts = Interrupts()
        self.watcher = Watcher()
        station = LocalStation(self.rig)
        self.engine = Engine(station, self.journal, (*observers, self.watcher), self.interrupts, ask, **keys)

    def run(self, definition, parameters=None):
        try:
            outcome = self.engine.run(definition, definition.parameters() if parameters is None else parameters)
        finally:
            self.journal.close()
            self.rig.close()
        return outcome

    def record(self):
        return Record(self.folder)

    def assert_safe(self):
        assert self.tec.safe_times == self.probe.safe_times == 1
        assert self.tec.calls[-1] == "safe"
        assert not self.tec.output_enabled


@pytest.fixture
def bench(tmp_path, rig_file):
    made = []

    def make(*replacements, append="", **keys):
        folder = tmp_path / f"run{len(made)}"
        folder.mkdir()
        made.append(Bench(folder, rig_file(*replacements, append=append), **keys))
        return made[-1]

    return make


class TestCompleted:
    def test_everything_is_recorded(self, bench):
        b = bench()
        outcome = b.run(stairs)
        assert (outcome.status, outcome.reason, outcome.error) == ("completed", "", None)
        assert outcome.steps == 4
        assert outcome.laboratory_seconds == 8.0
        assert outcome.is_safe
        assert outcome.safe_state == {"tec": "safe", "probe": "safe"}
        b.assert_safe()
        with b.record() as run:
            assert run.status == "completed"
            assert run.meta["safe_state"] == {"tec": "safe", "probe": "safe"}
            assert run.meta["finished"] == 8.0
            records = list(run.step_records())
            assert [entry.setpoints for entry in records] == [{"tec": value} for value in (30.0, 35.0, 40.0, 45.0)]
            assert [(entry.started, entry.finished) for entry in records] == [
                (2.0 * i, 2.0 * i + 2) for i in range(4)
            ]
            assert all(entry.phase == "climb" and entry.label == "up" and entry.settled for entry in records)
            assert [event.text for event in run.events() if event.kind == "phase"] == ["climb"]
            assert len([event for event in run.events() if event.kind == "note"]) == 5
            assert [event.kind for event in run.events()][-3:] == ["safe-state", "safe-state", "end"]
            steps = run.steps()
            np.testing.assert_array_equal(steps["tec_setpoint"], [30.0, 35.0, 40.0, 45.0])
            expected = [30.0 + (22.0 - 30.0) * math.exp(-2.0)]
            for target in (35.0, 40.0, 45.0):
                expected.append(target + (expected[-1] - target) * math.exp(-2.0))
            np.testing.assert_allclose(steps["probe_temperature"], expected, atol=0.02)

    def test_observers_see_what_the_journal_has(self, bench):
        b = bench()
        b.run(stairs)
        with b.record() as run:
            assert list(run.step_records()) == b.watcher.steps
            assert run.events() == b.watcher.events
            ticks = run.telemetry()
            assert list(zip(ticks["t"], ticks["step"], strict=True)) == [tick[:2] for tick in b.watcher.ticks]
            names = [signal.name for signal in run.signals]
            for i, tick in enumerate(b.watcher.ticks):
                np.testing.assert_array_equal([ticks[name][i] for name in names], tick[2])

    def test_telemetry_ticks_at_the_exact_instants(self, bench):
        b = bench(("period = 0.5", "period = 0.1"))
        b.run(stairs, Stairs(count=3, dwell=1.0))
        instants = [tick[0] for tick in b.watcher.ticks]
        assert instants == [start + tick * 0.1 for start in (0.0, 1.0, 2.0) for tick in range(1, 10)]
        assert [tick[1] for tick in b.watcher.ticks] == [0] * 9 + [1] * 9 + [2] * 9

    @pytest.mark.parametrize(("period", "dwell"), [(0.7, 2.1), (0.3, 0.9), (0.05, 0.35), (0.5, 0.4), (0.5, 0.0)])
    def test_no_tick_a_rounding_error_before_the_reading(self, bench, period, dwell):
        b = bench(("period = 0.5", f"period = {period}"))
        b.run(stairs, Stairs(count=5, dwell=dwell))
        assert len(b.watcher.ticks) == 5 * max(round(dwell / period) - 1, 0)

    def test_readings_reach_the_protocol(self, bench):
        seen = []

        def look(parameters):
            seen.append((yield Step({"tec": 30.0}, Dwell(30.0))))
            seen.append((yield Step({}, Dwell(1.0))))

        b = bench()
        b.run(define(look))
        assert [reading.step for reading in seen] == [0, 1]
        assert [reading.time for reading in seen] == [30.0, 31.0]
        assert seen[0]["tec_setpoint"] == seen[1]["tec_setpoint"] == 30.0
        assert seen[1]["probe_temperature"] == pytest.approx(30.0, abs=0.02)
        assert b.tec.sent == [30.0]

    def test_the_same_seed_gives_the_same_tables(self, bench):
        tables = []
        for seed in (5, 5, 6):
            b = bench(seed=seed)
            b.run(stairs, Stairs(count=30, increment=1.0))
            db = sqlite3.connect(b.folder / FILE_NAME)
            tables.append(
                {
                    name: db.execute(f"SELECT * FROM {name}").fetchall()
                    for name in ("steps", "telemetry", "events", "meta")
                }
            )
            db.close()
        assert tables[0] == tables[1]
        assert tables[0]["steps"] != tables[2]["steps"]

    def test_whole_numbers_of_numpy_as_setpoints(self, bench):
        def scan(parameters):
            for target in np.arange(20, 40, 5):
                yield Step({"tec": target}, Dwell(1.0))

        b = bench()
        assert b.run(define(scan)).status == "completed"
        with b.record() as run:
            assert [entry.setpoints["tec"] for entry in run.step_records()] == [20.0, 25.0, 30.0, 35.0]


class TestWrongSetpoints:
    @pytest.mark.parametrize("value", [95.5, 9.0, math.nan, math.inf])
    def test_limits_are_checked_before_anything_is_sent(self, bench, value):
        def beyond(parameters):
            yield Step({"tec": 30.0}, Dwell(1.0))
            yield Step({"tec": value}, Dwell(1.0))

        b = bench()
        outcome = b.run(define(beyond))
        assert outcome.status == "failed"
        assert isinstance(outcome.error, LimitError)
        assert outcome.steps == 1
        assert b.tec.sent == [30.0]
        b.assert_safe()

    @cases(
        ("step", "name"),
        [
            (Step({"tec": 30.0, "absent": 3.0}, Dwell(1.0)), "absent"),
            (Step({"tec": 30.0, "probe": 30.0}, Dwell(1.0)), "probe"),
            (Step({"tec": 30.0}, UntilSteady("skin", drift=1.0, noise=1.0, timeout=9.0)), "skin"),
        ],
    )
    def test_none_is_sent_when_another_name_is_wrong(self, bench, step, name):
        def wrong(parameters):
            yield step

        b = bench()
        outcome = b.run(define(wrong))
        assert isinstance(outcome.error, ConfigurationError)
        assert name in outcome.reason
        assert b.tec.sent == []


class TestFaults:
    def test_interlock_in_the_middle_of_a_hold(self, bench):
        b = bench(("high = 90.0", "high = 41.0"))
        outcome = b.run(stairs, Stairs(dwell=20.0))
        assert outcome.status == "failed"
        assert isinstance(outcome.error, InterlockError)
        assert outcome.steps == 3
        b.assert_safe()
        with b.record() as run:
            assert run.status == "failed"
            assert "probe_temperature" in run.meta["reason"]
            assert len(run.steps()) == 3
            ticks = run.telemetry()
            assert ticks["t"][-1] == outcome.laboratory_seconds
            assert 60.0 < ticks["t"][-1] < 63.0
            assert ticks["probe_temperature"][-1] > 41.0
            assert np.all(ticks["probe_temperature"][:-1] <= 41.0)
            (event,) = [event for event in run.events() if event.level == "ERROR"]
            assert event.kind == "interlock"
            assert "is outside of ≤ 41 °C" in event.text

    def test_interlock_before_the_first_step(self, bench):
        b = bench(("high = 90.0", "high = 20.0"))
        outcome = b.run(stairs)
        assert isinstance(outcome.error, InterlockError)
        assert b.tec.sent == []
        b.assert_safe()

    def test_a_fault_in_the_middle_of_a_hold(self, bench):
        b = bench()
        b.probe.fail_at = 5.2
        outcome = b.run(stairs)
        assert outcome.status == "failed"
        assert isinstance(outcome.error, DeviceError)
        assert outcome.reason == "probe: open circuit at the sensor"
        assert outcome.steps == 2
        assert outcome.laboratory_seconds == 5.5
        b.assert_safe()
        with b.record() as run:
            assert len(run.steps()) == 2
            assert len(run.telemetry()) == 8
            assert ("ERROR", "error") in [(event.level, event.kind) for event in run.events()]

    @pytest.mark.parametrize("where", ["measure_error", "glance_error", "set_error"])
    @pytest.mark.parametrize("error", [DeviceError("tec", "x"), StopIteration()])
    def test_whatever_a_device_raises_ends_in_the_safe_state(self, bench, where, error):
        def go(parameters):
            yield Step({"tec": 30.0}, Dwell(1.0))
            setattr(b.tec, where, error)
            yield Step({"tec": 31.0}, Dwell(1.0))
            yield Step({"tec": 32.0}, Dwell(1.0))

        b = bench()
        outcome = b.run(define(go))
        assert outcome.status == "failed"
        assert outcome.error is error
        assert outcome.steps == 1
        b.assert_safe()
        with b.record() as run:
            assert run.status == "failed"

    @pytest.mark.parametrize("error", [DeviceError("tec", "port gone"), OSError("gone"), KeyboardInterrupt()])
    def test_one_that_cannot_be_made_safe(self, bench, error):
        b = bench()
        b.tec.safe_error = error
        outcome = b.run(stairs)
        assert outcome.status == "completed"
        assert not outcome.is_safe
        assert outcome.safe_state["probe"] == "safe"
        assert type(error).__name__ in outcome.safe_state["tec"]
        assert b.probe.safe_times == 1
        with b.record() as run:
            assert run.meta["safe_state"] == outcome.safe_state
            (event,) = [event for event in run.events() if event.level == "ERROR"]
            assert event.kind == "safe-state"
            assert event.text.startswith("tec: ")

    @cases(
        ("kind", "status"),
        [(KeyError, "failed"), (KeyboardInterrupt, "aborted"), (SystemExit, "aborted"), (GeneratorExit, "aborted")],
    )
    def test_whatever_a_protocol_raises_ends_the_run_and_its_record(self, bench, kind, status):
        def go(parameters):
            yield Step({"tec": 30.0}, Dwell(1.0))
            raise kind

        b = bench()
        outcome = b.run(define(go))
        assert (outcome.status, outcome.steps) == (status, 1)
        assert kind.__name__ in outcome.reason
        b.assert_safe()
        with b.record() as run:
            assert (run.status, run.meta["safe_state"]) == (status, {"tec": "safe", "probe": "safe"})

    @pytest.mark.parametrize("how", ["removed", "replaced"])
    def test_a_journal_that_is_gone_ends_the_run(self, bench, how):
        b = bench()
        path = b.folder / FILE_NAME

        def go(parameters):
            reading = yield Step({"tec": 30.0}, Dwell(1.0))
            if reading.values:
                path.unlink()
                if how == "replaced":
                    path.write_text("another file")
            yield Step({"tec": 40.0}, Dwell(1.0))

        outcome = b.run(define(go))
        assert outcome.status == "failed"
        assert f"{path} was {how} while the run went on" in outcome.reason
        b.assert_safe()

    @pytest.mark.parametrize("nonsense", [None, 42, "tec", {"tec": 30.0}, Step])
    def test_a_protocol_that_yields_nonsense(self, bench, nonsense):
        def go(parameters):
            yield nonsense

        b = bench()
        outcome = b.run(define(go))
        assert isinstance(outcome.error, ConfigurationError)
        assert "expected a Step, a Control, a FixedRate, a Prompt, a Phase or a Note" in outcome.reason
        b.assert_safe()

    def test_a_protocol_that_goes_on_when_it_is_closed(self, bench):
        # As one that wants to go home at the end, whatever happens.
        def go(parameters):
            try:
                while True:
                    yield Step({"tec": 30.0}, Dwell(2.0))
            finally:
                yield Step({"tec": 20.0}, Dwell(2.0))

        b = bench()
        b.probe.fail_at = 5.0
        outcome = b.run(define(go))
        assert outcome.reason == "probe: open circuit at the sensor"
        assert b.tec.sent == [30.0, 30.0, 30.0]
        b.assert_safe()

    def test_a_protocol_cannot_swallow_a_fault(self, bench):
        def go(parameters):
            while True:
                try:
                    yield Step({"tec": 30.0}, Dwell(2.0))
                except Exception:
                    yield Note("never mind")

        b = bench()
        b.probe.fail_at = 5.0
        assert b.run(define(go)).status == "failed"
        b.assert_safe()

    def test_a_full_disk_does_not_hide_the_safe_state(self, bench, monkeypatch):
        b = bench()
        write = Store.write

        def full(store, entries):
            if b.clock.now() > 3.0:
                raise sqlite3.OperationalError("database or disk is full")
            write(store, entries)

        monkeypatch.setattr(Store, "write", full)
        outcome = b.run(stairs)
        assert outcome.status == "failed"
        assert "disk is full" in outcome.reason
        assert isinstance(outcome.error, RecordError)
        assert outcome.is_safe
        b.assert_safe()


class BrokenObserver(Watcher):
    """One whose terminal or viewer is gone."""

    def __init__(self, *methods):
        super().__init__()
        for method in methods:
            setattr(self, method, self.fail)

    def fail(self, *_):
        raise OSError(5, "Input/output error")


class TestObservers:
    @pytest.mark.parametrize("methods", [("telemetry",), ("step",), ("event",), ("telemetry", "step", "event")])
    def test_one_that_fails_ends_no_run_and_is_told_no_more(self, bench, methods):
        b = bench(observers=[BrokenObserver(*methods)])
        outcome = b.run(stairs)
        assert (outcome.status, outcome.steps) == ("completed", 4)
        b.assert_safe()
        assert len(b.watcher.steps) == 4
        with b.record() as run:
            assert run.status == "completed"
            (event,) = [event for event in run.events() if event.level == "WARN" and event.kind == "observer"]
            assert "BrokenObserver" in event.text


class TestSettling:
    def test_until_steady(self, bench):
        b = bench()
        outcome = b.run(settle)
        assert outcome.status == "completed"
        # 28 K with a time constant of 1 s drift by less than 0.02 K/s after 7.2 s.
        assert 7.0 < outcome.laboratory_seconds < 30.0
        with b.record() as run:
            assert run.steps()["probe_temperature"][0] == pytest.approx(50.0, abs=0.05)
            np.testing.assert_array_equal(
                run.telemetry()["t"], 0.5 * np.arange(1, 2 * outcome.laboratory_seconds + 1)
            )

    def test_waits_its_minimum(self, bench):
        outcome = bench().run(settle, Settle(minimum=60.0))
        assert outcome.laboratory_seconds == 60.0

    def test_times_out(self, bench):
        b = bench()
        outcome = b.run(settle, Settle(timeout=5.0))
        assert outcome.status == "failed"
        assert isinstance(outcome.error, SettleTimeoutError)
        assert "probe_temperature is not steady after 5 s: it drifts by" in outcome.reason
        assert "0.02 °C/s is allowed" in outcome.reason
        assert outcome.laboratory_seconds == 5.0
        b.assert_safe()

    @pytest.mark.parametrize("period", [0.1, 1.0, 5.0, 20.0])
    def test_comes_to_an_end_whatever_the_telemetry_period(self, bench, period):
        outcome = bench(("period = 0.5", f"period = {period}")).run(settle, Settle(timeout=3600.0))
        assert outcome.status == "completed", outcome.reason

    def test_a_gap_in_the_signal_is_named(self, bench):
        def go(parameters):
            yield Step({}, UntilSteady("tec_setpoint", drift=1.0, noise=1.0, timeout=10.0))

        b = bench()
        outcome = b.run(define(go))
        assert outcome.status == "failed"
        assert "tec_setpoint" in outcome.reason


class Integrator:
    """A loop that moves the plate until its thermometer says what it should."""

    def __init__(self, target, wait=4.0, tolerance=0.05):
        self.target, self.wait, self.tolerance = target, wait, tolerance
        self.setpoint = math.nan
        self.times = []
        self.trace = Trace(reference=target)

    def begin(self, t, measured_input, output):
        self.setpoint = measured_input
        return self.update(t, measured_input, output)

    def update(self, t, _, output):
        self.times.append(t)
        self.trace = Trace(self.target, output, self.target - output, 0.01)
        done = abs(self.target - output) < self.tolerance
        if not done:
            self.setpoint += 0.8 * (self.target - output)
        return Command(self.setpoint, self.wait, done)


def control(loop, **keys):
    def go(parameters):
        yield Control(
            **{
                "task": loop,
                "actuator": "tec",
                "drive": "tec_temperature",
                "response": "probe_temperature",
                "limits": (15.0, 80.0),
                "timeout": 600.0,
                "label": "reach",
                **keys,
            }
        )

    return define(go)


class TestControl:
    def test_reaches_its_target(self, bench):
        b, loop = bench(("[devices.probe]", "[devices.probe]\noffset = -2.0")), Integrator(50.0)
        outcome = b.run(control(loop))
        assert (outcome.status, outcome.steps) == ("completed", 1), outcome.reason
        b.assert_safe()
        np.testing.assert_allclose(np.diff(loop.times), 4.0)
        assert outcome.lateness["reach"]["samples"] == len(loop.times) - 1
        with b.record() as run:
            (entry,) = run.step_records()
            assert entry.label == "reach"
            assert entry.setpoints == {"tec": loop.setpoint}
            assert entry.setpoints["tec"] == pytest.approx(52.0, abs=0.1)
            assert run.steps()["probe_temperature"][0] == pytest.approx(50.0, abs=0.05)
            # A tick at each reading of the loop and the telemetry in between.
            assert len(run.telemetry()) == len(loop.times) + 7 * (len(loop.times) - 1)

    def test_one_reading_is_not_late(self, bench):
        assert bench().run(control(Integrator(50.0, tolerance=100.0))).lateness == {}

    def test_what_the_controller_thinks_is_recorded(self, bench):
        b = bench(traces=True)
        outcome = b.run(control(Integrator(50.0)))
        assert outcome.status == "completed", outcome.reason
        with b.record() as run:
            ticks = run.telemetry()
            assert ticks[TRACES[0].name][0] == 50.0
            assert set(ticks[TRACES[0].name][1:]) == {50.0}
            assert run.steps()[TRACES[0].name].tolist() == [50.0]

    @cases("target", [300.0, math.nan])
    def test_beyond_its_limits_nothing_is_sent(self, bench, target):
        b = bench()
        outcome = b.run(control(Integrator(target)))
        assert isinstance(outcome.error, LimitError)
        assert b.tec.sent == []
        b.assert_safe()

    def test_times_out(self, bench):
        b = bench()
        outcome = b.run(control(Integrator(50.0, tolerance=0.0), timeout=100.0))
        assert isinstance(outcome.error, SettleTimeoutError)
        assert "within 100 s" in outcome.reason
        assert outcome.laboratory_seconds <= 100.0
        b.assert_safe()

    @pytest.mark.parametrize("wait", [0.0, -1.0, math.nan])
    def test_one_that_would_not_let_time_pass_is_refused(self, bench, wait):
        b = bench()
        outcome = b.run(control(Integrator(50.0, wait=wait)))
        assert isinstance(outcome.error, ConfigurationError)
        assert f"the controller of probe_temperature asked to wait {wait} s" in outcome.reason
        b.assert_safe()

    def test_one_that_does_not_converge_is_stopped(self, bench):
        class Cycling(Integrator):
            def update(self, t, measured_input, output):
                command = super().update(t, measured_input, output)
                return replace(command, setpoint=80.0 if measured_input < 47.5 else 15.0, done=False)

        b = bench()
        outcome = b.run(control(Cycling(50.0, wait=20.0), timeout=10000.0))
        assert isinstance(outcome.error, ConvergenceError)
        assert outcome.error.exit_code == 10
        assert "from one end of its range (15 to 80 °C) to the other" in outcome.reason
        assert "stands at 50 °C" in outcome.reason
        b.assert_safe()

    @pytest.mark.parametrize("key", ["actuator", "drive", "response"])
    def test_what_is_not_there_is_named(self, bench, key):
        b = bench()
        outcome = b.run(control(Integrator(50.0), **{key: "absent"}))
        assert isinstance(outcome.error, ConfigurationError)
        assert "absent" in outcome.reason
        assert b.tec.sent == []

    def test_an_interlock_ends_it(self, bench):
        b = bench(("high = 90.0", "high = 41.0"))
        assert isinstance(b.run(control(Integrator(50.0))).error, InterlockError)
        b.assert_safe()

    @cases("keys", [{"limits": (2.0, 1.0)}, {"limits": (math.nan, 1.0)}, {"timeout": 0.0}, {"timeout": math.nan}])
    def test_nonsense_is_refused(self, keys):
        with pytest.raises(ConfigurationError, match="Control: expected finite limits"):
            plan(control(Integrator(50.0), **keys), Nothing())


PROMPT = {
    "text": "Turn the plate to 33 °C", "task": "turn", "value": 33.0, "settle": Dwell(20.0),
    "signal": "probe_temperature", "low": 32.5, "high": 33.5,
}  # fmt: skip


def prompt(**keys):
    def go(parameters):
        yield Step({"tec": 30.0}, Dwell(2.0))
        reading = yield Prompt(**{**PROMPT, **keys})
        assert reading["probe_temperature"] == pytest.approx(33.0, abs=0.1)

    return define(go)


class TestPrompt:
    def test_an_emulated_laboratory_does_it_by_itself(self, bench):
        b = bench()
        outcome = b.run(prompt())
        assert (outcome.status, outcome.steps, outcome.laboratory_seconds) == ("completed", 2, 22.0)
        assert [event.text for event in b.watcher.events if event.kind == "prompt"] == ["Turn the plate to 33 °C"]
        assert b.watcher.steps[-1].label == "prompt"

    def test_what_was_not_done_ends_the_run_and_is_recorded(self, bench):
        b = bench()
        outcome = b.run(prompt(value=30.0))
        assert (outcome.status, outcome.steps) == ("failed", 2)
        assert isinstance(outcome.error, DeviceError)
        assert outcome.reason == (
            "probe_temperature: reads 30 °C after the prompt to turn the plate to 33 °C; "
            "expected 32.5 to 33.5 °C. Was it done?"
        )
        b.assert_safe()
        with b.record() as run:
            assert run.steps()["probe_temperature"][-1] == pytest.approx(30.0, abs=0.1)

    def test_a_task_that_the_laboratory_cannot_do(self, bench):
        b = bench()
        outcome = b.run(prompt(task="dance"))
        assert isinstance(outcome.error, ConfigurationError)
        assert "'dance'" in outcome.reason
        b.assert_safe()

    def by_hand(self, b):
        """The rig without a laboratory that answers, as a real one is."""
        laboratory, b.rig.laboratory = b.rig.laboratory, None
        return laboratory

    def test_an_operator_is_asked_with_telemetry_going_on(self, bench):
        questions = []

        def ask(question):
            questions.append(question)
            laboratory.operate("turn", 33.0)
            return RESUME

        b = bench(ask=ask)
        laboratory = self.by_hand(b)
        assert b.run(prompt()).status == "completed"
        assert [(each.title, each.text) for each in questions] == [("BY HAND", "Turn the plate to 33 °C")]

    def test_an_operator_may_end_the_run(self, bench):
        b = bench(ask=lambda _: ABORT)
        self.by_hand(b)
        outcome = b.run(prompt())
        assert (outcome.status, outcome.reason) == ("aborted", "ended by the operator at a prompt")
        b.assert_safe()

    def test_nobody_there(self, bench):
        b = bench()
        self.by_hand(b)
        outcome = b.run(prompt())
        assert (outcome.status, outcome.reason) == (
            "aborted",
            "no operator is present to do it: Turn the plate to 33 °C",
        )
        b.assert_safe()

    def test_the_dry_run_counts_them(self):
        steady = UntilSteady("tec_temperature", drift=0.02, noise=0.01, timeout=60.0, minimum=5.0)
        expected = plan(of(Prompt(**{**PROMPT, "settle": steady})), Nothing())
        assert (expected.prompts, expected.steps, expected.seconds, expected.at_most) == (1, 1, 5.0, 60.0)
        assert expected.watched == {"probe_temperature", "tec_temperature"}

    def test_an_empty_range(self):
        with pytest.raises(ValueError, match="low < high"):
            Prompt(**{**PROMPT, "low": 33.5})


def of(message, needs=("tec",)):
    def go(parameters):
        yield message

    go.__annotations__ = {"parameters": Nothing}
    go.__doc__ = "A protocol."
    return protocol(needs=needs)(go)


@cases(
    ("definition", "parameters", "wrong"),
    [
        (stairs, Stairs(), None),
        (stairs, Stairs(count=30), "30 and 175 °C; rig heater allows 10 to 95 °C"),
        (settle, Settle(signal="prob_temperature"), "prob_temperature"),
        (of(Step({"probe": 30.0}, Dwell(1.0))), Nothing(), "probe"),
        (of(Note("x"), ("tec", "curvature", "servo")), Nothing(), "curvature, servo"),
        (of(Prompt(**{**PROMPT, "signal": "no_such"})), Nothing(), "no_such"),
        (control(Integrator(50.0)), Nothing(), None),
        (control(Integrator(50.0), limits=(15.0, 100.0)), Nothing(), "rig heater allows 10 to 95 °C"),
        (control(Integrator(50.0), response="absent"), Nothing(), "absent"),
    ],
)
def test_what_a_rig_lacks_or_forbids_is_found_before_anything_moves(rig_file, definition, parameters, wrong):
    with Rig(load_rig(rig_file()), VirtualClock(), 1) as rig:
        planned = plan(definition, parameters)
        if wrong is None:
            check_before_moving(rig.description, definition, planned)
        else:
            with pytest.raises(ConfigurationError, match=wrong):
                check_before_moving(rig.description, definition, planned)
        assert rig.devices["tec"].calls == []


class TestInterrupted:
    def request(self, **flags):
        """A protocol that sets flags of the interrupts in its second step."""

        def go(parameters):
            yield Step({"tec": 30.0}, Dwell(2.0))
            for name, value in flags.items():
                setattr(self.b.interrupts, name, value)
            yield Step({"tec": 31.0}, Dwell(2.0))
            yield Step({"tec": 32.0}, Dwell(2.0))

        return define(go)

    def test_pause_and_resume(self, bench):
        asked = []

        def ask(question):
            asked.append(threading.current_thread() is not threading.main_thread())
            return RESUME

        self.b = b = bench(ask=ask)
        outcome = b.run(self.request(pause_requested=True))
        assert (outcome.status, outcome.steps) == ("completed", 3)
        assert asked == [True]
        assert not b.interrupts.pause_requested
        kinds = [event.kind for event in b.watcher.events]
        assert kinds.index("pause") < kinds.index("resume")
        assert b.tec.sent == [30.0, 31.0, 32.0]

    def answering(self, *answers):
        """Return what asks, and answers one after another; and the questions that were asked."""
        asked, left = [], list(answers)

        def ask(question):
            asked.append(question)
            return left.pop(0)

        return ask, asked

    def test_one_step_then_it_pauses_again(self, bench):
        ask, _ = self.answering("step", RESUME)
        self.b = b = bench(ask=ask)
        assert b.run(self.request(pause_requested=True)).status == "completed"
        pauses = [event.text for event in b.watcher.events if event.kind == "pause"]
        assert pauses == ["paused by the operator; the set-points stand", "paused by one step; the set-points stand"]
        steps = [len(each.setpoints) for each in b.record().step_records()]
        assert len(steps) == 3

    def test_a_note_is_recorded(self, bench):
        ask, _ = self.answering("note the lamp was on", RESUME)
        self.b = b = bench(ask=ask)
        assert b.run(self.request(pause_requested=True)).status == "completed"
        with b.record() as run:
            assert [each.text for each in run.events() if each.kind == "remark"] == ["the lamp was on"]

    def test_outputs_off_and_on_again(self, bench):
        ask, asked = self.answering("off", "off", RESUME)
        self.b = b = bench(ask=ask)
        assert b.run(self.request(pause_requested=True)).status == "completed"
        assert b.tec.safe_times == b.probe.safe_times == 2
        off = b.tec.calls.index("safe")
        assert b.tec.calls[off - 1 : off + 2] == ["set", "safe", "set"]
        assert asked[1].text.startswith("the outputs are off until the run is resumed")
        assert "bench resume" in asked[1].text
        with b.record() as run:
            assert [each.text[:11] for each in run.events() if each.kind == "off"] == ["outputs off", "outputs on "]

    def paused_in_stairs(self, bench, *answers):
        """Carry the stairs out, with a pause in the middle of the second hold."""

        class Pausing(Watcher):
            def telemetry(_, __, step, ___):
                if step == 1 and not self.b.interrupts.pause_requested and not asked:
                    self.b.interrupts.pause_requested = True

        ask, asked = self.answering(*answers)
        self.b = b = bench(ask=ask, observers=[Pausing()])
        outcome = b.run(stairs, stairs.parse({"dwell": 4.0}))
        assert outcome.status == "completed"
        return b, asked

    def test_a_changed_parameter_counts_from_the_next_reading_on(self, bench):
        b, asked = self.paused_in_stairs(bench, "set dwell=2", RESUME)
        assert asked[0].parameters == {"dwell": "4 s, hold (0 to 3600)"}
        assert asked[1].parameters == {"dwell": "2 s, hold (0 to 3600)"}
        with b.record() as run:
            assert [step.finished - step.started for step in run.step_records()] == [4.0, 4.0, 2.0, 2.0]
            (change,) = ParameterChange.among((each.kind, each.text) for each in run.events())
        assert change == ParameterChange(1, "dwell", 2.0, 4.0)

    @pytest.mark.parametrize(
        ("answer", "message"),
        [
            ("set count=5", "'count' cannot be changed at a pause; parameters that can: dwell"),
            ("set dwell=-1", "parameter dwell = '-1' is not allowed; allowed: 0 to 3600 s"),
            ("set dwell", "parameter dwell = '' is not allowed"),
        ],
    )
    def test_a_change_that_is_not_allowed_is_said(self, bench, answer, message):
        b, asked = self.paused_in_stairs(bench, answer, RESUME)
        assert message in asked[1].problem
        with b.record() as run:
            assert not [each for each in run.events() if each.kind == PARAMETER]
            assert [step.finished - step.started for step in run.step_records()] == [4.0] * 4

    def test_a_change_is_made_again_where_it_was(self, bench):
        b, _ = self.paused_in_stairs(bench, "set dwell=2", RESUME)
        with b.record() as run:
            expected = list(run.step_records())
            changes = ParameterChange.among((each.kind, each.text) for each in run.events())
        again = bench(changes=changes)
        assert again.run(stairs, stairs.parse({"dwell": 4.0})).status == "completed"
        with again.record() as run:
            assert list(run.step_records()) == expected

    def test_a_change_is_fed_back(self, bench):
        b, _ = self.paused_in_stairs(bench, "set dwell=2", RESUME)
        with b.record() as run:
            past = Past.of(run)
        for count in (1, 2, 3):
            parameters = stairs.parse({"dwell": 4.0})
            cut = replace(past, steps=past.steps[:count], remarks=past.remarks[: count + 2])
            fed = feed(stairs, parameters, {}, cut)
            # In the message that waits the old one, if the change came with its reading.
            assert fed.message.settle == Dwell(2.0 if count > 1 else 4.0)
            assert parameters.dwell == 2.0

    @pytest.mark.parametrize("answer", [ABORT, "", "whatever"])
    def test_pause_and_abort(self, bench, answer):
        self.b = b = bench(ask=lambda _: answer)
        outcome = b.run(self.request(pause_requested=True))
        assert (outcome.status, outcome.steps) == ("aborted", 1)
        assert isinstance(outcome.error, AbortError)
        assert outcome.reason == "ended by the operator at a pause"
        assert b.tec.sent == [30.0]
        b.assert_safe()
        with b.record() as run:
            assert run.status == "aborted"

    @pytest.mark.parametrize(("second", "status"), [(RESUME, "completed"), (ABORT, "aborted")])
    def test_the_end_of_a_long_run_is_to_be_confirmed(self, bench, second, status):
        ask, asked = self.answering(ABORT, second)
        b = bench(ask=ask)

        def go(parameters):
            yield Step({"tec": 30.0}, Dwell(700.0))
            b.interrupts.pause_requested = True
            yield Step({"tec": 31.0}, Dwell(2.0))

        assert b.run(define(go)).status == status
        assert "answer abort once more" in asked[1].problem

    def test_a_pause_that_nobody_can_end_is_an_abort(self, bench):
        self.b = b = bench()
        outcome = b.run(self.request(pause_requested=True))
        assert (outcome.status, outcome.steps) == ("aborted", 1)
        assert "no operator is present" in outcome.reason
        b.assert_safe()

    def test_abort_at_once(self, bench):
        self.b = b = bench()
        outcome = b.run(self.request(abort_reason="SIGTERM"))
        assert (outcome.status, outcome.reason, outcome.steps) == ("aborted", "ended by SIGTERM", 1)
        b.assert_safe()

    def ended_at_three_seconds(self, bench):
        class Late(Watcher):
            def telemetry(_, t, *__):
                if t >= 3.0:
                    self.b.interrupts.abort_reason = "SIGTERM"

        self.b = bench(observers=[Late()])
        return self.b

    def test_abort_in_the_middle_of_a_hold(self, bench):
        b = self.ended_at_three_seconds(bench)
        outcome = b.run(stairs)
        assert (outcome.status, outcome.steps, outcome.laboratory_seconds) == ("aborted", 1, 3.0)
        b.assert_safe()

    def test_abort_while_settling(self, bench):
        b = self.ended_at_three_seconds(bench)
        assert b.run(settle).status == "aborted"
        b.assert_safe()

    def test_abort_at_a_pause(self, bench):
        answered = threading.Event()

        def ask(question):
            self.b.interrupts.abort_reason = "Ctrl-C, twice"
            answered.wait(60.0)
            return RESUME

        self.b = b = bench(ask=ask)
        outcome = b.run(self.request(pause_requested=True))
        answered.set()
        assert (outcome.status, outcome.reason) == ("aborted", "ended by Ctrl-C, twice")
        b.assert_safe()

    def test_a_protocol_that_only_talks_can_be_aborted(self, bench):
        def chatter(parameters):
            for i in range(100_000):
                if i == 3:
                    self.b.interrupts.abort_reason = "SIGTERM"
                yield Note("still here")

        self.b = b = bench()
        assert b.run(define(chatter)).status == "aborted"
        assert len([event for event in b.watcher.events if event.kind == "note"]) < 10

    def test_interlocks_do_not_pause(self, bench):
        done = threading.Event()

        def ask(question):
            self.b.probe.plate.temperature = 500.0
            done.wait(60.0)
            return RESUME

        self.b = b = bench(ask=ask, clock=PacedClock(50.0))
        outcome = b.run(self.request(pause_requested=True))
        done.set()
        assert isinstance(outcome.error, InterlockError)
        b.assert_safe()

    def test_telemetry_goes_on_at_a_pause(self, bench):
        enough = threading.Event()

        class Counting(Watcher):
            def telemetry(_, t, step, values):
                super().telemetry(t, step, values)
                if len(_.ticks) >= 12:
                    enough.set()

        def ask(question):
            enough.wait(60.0)
            return RESUME

        self.b = b = bench(ask=ask, clock=PacedClock(50.0), observers=[Counting()])
        assert b.run(self.request(pause_requested=True)).status == "completed"
        assert len([tick for tick in b.watcher.ticks if tick[1] == 1]) > 3

    def test_the_pace_of_a_paced_clock_is_recorded(self, bench):
        self.b = b = bench(clock=PacedClock(1e9))
        outcome = b.run(stairs)
        assert outcome.pace.asked == 1e9
        assert not outcome.pace.is_reached
        with b.record() as run:
            (event,) = (event for event in run.events() if event.kind == "clock")
            assert event.level == "INFO"
            assert event.text == str(outcome.pace)

    def test_a_run_at_the_pace_of_the_virtual_clock_reads_the_same(self, bench):
        values = []
        for clock in (VirtualClock(), PacedClock(200.0)):
            b = bench(clock=clock)
            assert b.run(stairs).status == "completed"
            with b.record() as run:
                values.append([run.steps().columns, run.telemetry().columns])
        for table, other in zip(*values, strict=True):
            for name, column in table.items():
                assert np.array_equal(column, other[name], equal_nan=True), name

    @cases(
        ("seconds", "is_suspended", "said"),
        [(3600.0, True, "for 3600 s"), (3600.0, False, "forward by 3600.0 s"), (-7.5, False, "back by 7.5 s")],
    )
    def test_a_suspension_of_the_machine_and_a_time_of_day_that_was_set_are_recorded(
        self, bench, seconds, is_suspended, said
    ):
        off, wall = [0.0], WallClock()
        booted = (lambda: wall.now() + off[0]) if is_suspended else wall.now

        def late(parameters):
            yield Step({"tec": 30.0}, Dwell(0.05))
            off[0] = seconds
            yield Step({"tec": 31.0}, Dwell(0.05))
            yield Step({"tec": 32.0}, Dwell(0.05))

        self.b = b = bench(clock=WallClock(wall.now, booted, lambda: wall.timestamp() + off[0]))
        assert b.run(define(late)).status == "completed"
        with b.record() as run:
            (event,) = (event for event in run.events() if event.kind in {"suspended", "clock"})
            assert (event.kind, event.level) == ("suspended" if is_suspended else "clock", "WARN")
            assert said in event.text
            # Laboratory time goes on as before.
            assert np.all(np.diff(run.steps()["finished"]) < 60.0)
            assert np.all(np.diff(run.steps()["finished"]) > 0.0)

    def test_the_clock_is_left_as_it_was(self, bench):
        self.b = b = bench()
        b.run(self.request(abort_reason="SIGTERM"))
        assert not b.clock.interrupted()
