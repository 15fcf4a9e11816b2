"""Fast loops through the engine: when samples are taken, what is sent and recorded, and how a loop ends."""

import itertools
import math
import re

import numpy as np
import pytest
from cases import cases
from heater_protocols import Watcher

from bench.base import (
    AbortError,
    ConfigurationError,
    DeviceError,
    InterlockError,
    Interrupts,
    LimitError,
    VirtualClock,
    WallClock,
)
from bench.control import Playback, Trace
from bench.execution import check_before_moving
from bench.execution.context import trace_signals
from bench.execution.engine import Engine
from bench.execution.station.local import LocalStation
from bench.protocol import (
    LATENESS,
    TRACES,
    Dwell,
    FixedRate,
    ProtocolParameters,
    Settled,
    Step,
    find_protocol,
    plan,
    protocol,
)
from bench.record import FILE_NAME, Journal, Record
from bench.rig import Rig, load_rig

PERIOD = 0.5
"""Of the telemetry of the heater's rig, s."""
SECOND = """
[devices.other]
driver = "heater_laboratory:HeaterTEC"
port = "emulated://heater"
temperature_limits = [10.0, 50.0]
"""
CURVATURE = """
[devices.spot]
driver = "heater_laboratory:Spot"
port = "emulated://spot"

[derived.curvature]
kind = "cantilever-curvature"
source = "spot_position"
length = 300e-6
"""


class Nothing(ProtocolParameters):
    pass


class Controller:
    """Remembers what it was given and returns what it is told to."""

    def __init__(self, *setpoints):
        self.setpoints = setpoints or (30.0,)
        self.seen = []
        self.trace = Trace()

    def update(self, t, measured):
        self.seen.append((t, measured))
        self.trace = Trace(reference=t, predicted=-t, disturbance=2 * t, uncertainty=3 * t)
        return self.setpoints

    @property
    def times(self):
        return [t for t, _ in self.seen]


def loop(controller, rate=10.0, duration=1.0, inputs=("probe_temperature",), actuators=("tec",), **keys):
    return FixedRate(controller=controller, rate=rate, duration=duration, inputs=inputs, actuators=actuators, **keys)


def define(*messages):
    """A protocol of these messages."""

    def go(parameters: Nothing):
        """Run them."""
        for message in messages:
            reading = yield message
            assert not reading.settled.failed

    return protocol(needs=(), controls="probe_temperature")(go)


class Late(Controller):
    """Puts its end off by half a second, as its first reading tells."""

    @property
    def delay(self):
        return 0.5 if self.seen else 0.0


class Bench:
    """A rig with its journal and engine, as a run has them."""

    def __init__(self, folder, path, clock=None):
        self.folder = folder
        self.clock = clock or VirtualClock()
        self.rig = Rig(load_rig(path), self.clock, 1)
        self.devices = self.rig.devices
        self.interrupts = Interrupts()
        self.watcher = Watcher()

    def run(self, *messages, **settings):
        definition = messages[0] if hasattr(messages[0], "generator") else define(*messages)
        parameters = definition.parameters(**settings)
        signals = (*self.rig.signals, *TRACES, LATENESS)
        if definition.controls in [signal.name for signal in self.rig.signals]:
            signals = (*self.rig.signals, *trace_signals(definition, self.rig.description, {}))
        journal = Journal(self.folder / FILE_NAME, signals, {})
        try:
            return Engine(LocalStation(self.rig), journal, (self.watcher,), self.interrupts).run(
                definition, parameters
            )
        finally:
            journal.close()
            self.rig.close()

    @property
    def sent(self):
        return self.devices["tec"].sent

    def record(self):
        return Record(self.folder)

    def telemetry(self):
        with self.record() as run:
            return run.telemetry()

    def samples(self):
        """The recorded samples of the loop: where the lateness is a number."""
        ticks = self.telemetry()
        taken = np.isfinite(ticks["lateness"])
        return {name: values[taken] for name, values in ticks.columns.items()}

    def loop_event(self):
        """The text of the one event that tells of the loop."""
        (text,) = [event.text for event in self.watcher.events if event.kind == "loop"]
        return text

    def assert_safe(self):
        assert not self.devices["tec"].output_enabled
        for device in self.devices.values():
            assert device.safe_times == 1
            assert device.calls[-1] == "safe"
        with self.record() as run:
            assert run.meta["safe_state"] == dict.fromkeys(self.devices, "safe")


@pytest.fixture
def bench(tmp_path, rig_file):
    count = itertools.count()

    def make(*replacements, append="", clock=None):
        folder = tmp_path / f"run{next(count)}"
        folder.mkdir()
        return Bench(folder, rig_file(*replacements, append=append), clock)

    return make


def slow_down(bench, device, seconds):
    """Let each quick reading of a device take its time, or that of its number the seconds that are said of it."""
    read, numbers = device.glance, itertools.count()

    def glance():
        bench.clock.sleep(seconds.get(next(numbers), 0.0) if isinstance(seconds, dict) else seconds)
        return read()

    device.glance = glance


def count_readings(device):
    """Return a list to which the instant of each quick reading of a device is added."""
    read, instants = device.glance, []

    def glance():
        instants.append(device.plate.clock.now())
        return read()

    device.glance = glance
    return instants


class TestTiming:
    @pytest.mark.parametrize(("rate", "duration"), [(10.0, 2.0), (200.0, 1.0), (7.0, 3.0), (0.75, 40.0), (2e4, 0.05)])
    def test_samples_come_at_the_exact_instants(self, bench, rate, duration):
        b, controller = bench(), Controller()
        outcome = b.run(loop(controller, rate, duration))
        assert (outcome.status, outcome.steps) == ("completed", 1), outcome.reason
        period, count = 1.0 / rate, round(duration * rate)
        assert controller.times == [k * period for k in range(count)]
        samples = b.samples()
        assert samples["t"].tolist() == controller.times
        assert samples["lateness"].tolist() == [0.0] * count
        assert outcome.laboratory_seconds == count * period

    def test_they_count_from_the_beginning_of_the_loop(self, bench):
        b, first, second = bench(), Controller(), Controller()
        b.run(Step({"tec": 30.0}, Dwell(1.75)), loop(first, 8.0, 0.5), loop(second, 4.0, 1.0))
        assert first.times == [0.0, 0.125, 0.25, 0.375]
        assert second.times == [0.0, 0.25, 0.5, 0.75]
        samples = b.samples()
        assert samples["t"].tolist() == [1.75, 1.875, 2.0, 2.125, 2.25, 2.5, 2.75, 3.0]
        assert samples["step"].tolist() == [1] * 4 + [2] * 4
        with b.record() as run:
            assert [(step.started, step.finished) for step in run.step_records()] == [
                (0.0, 1.75), (1.75, 2.25), (2.25, 3.25),
            ]  # fmt: skip

    def test_the_reading_at_the_end_is_the_best_one_of_everything(self, bench):
        b, seen = bench(), []

        def go(parameters: Nothing):
            """Look."""
            seen.append((yield loop(Controller(40.0), 10.0, 5.0, label="warm")))

        measured = b.devices["probe"].measure
        b.devices["probe"].measure = lambda: {**measured(), "probe_temperature": 12.5}
        b.run(protocol(needs=(), controls="probe_temperature")(go))
        (reading,) = seen
        assert (reading.step, reading.time, reading.settled) == (0, 5.0, Settled.CONTROLLED)
        assert reading["probe_temperature"] == 12.5
        assert reading["tec_setpoint"] == 40.0
        assert reading["tec_temperature"] == pytest.approx(40.0, abs=0.2)
        with b.record() as run:
            (step,) = run.step_records()
        assert (step.label, step.setpoints) == ("warm", {"tec": 40.0})


class TestSetpoints:
    def test_are_sent_only_when_they_change(self, bench):
        b = bench()
        b.run(loop(Playback(lambda t: 30.0 if 0.35 < t < 0.75 else 25.0), 10.0, 1.0))
        assert b.sent == [25.0, 30.0, 25.0]
        assert b.samples()["tec_setpoint"].tolist() == [25.0] * 4 + [30.0] * 4 + [25.0] * 2

    def test_one_that_stands_already_is_not_sent(self, bench):
        b = bench()
        b.run(Step({"tec": 30.0}, Dwell(1.0)), loop(Controller(30.0)), loop(Controller(31.0)))
        assert b.sent == [30.0, 31.0]

    def test_several_actuators_get_theirs_in_order(self, bench):
        b = bench(append=SECOND)
        playback = Playback(lambda _: 40.0, lambda t: 20.0 + 10.0 * (t >= 0.45))
        b.run(loop(playback, actuators=("other", "tec")))
        assert b.devices["other"].sent == [40.0]
        assert b.sent == [20.0, 30.0]
        with b.record() as run:
            (step,) = run.step_records()
        assert step.setpoints == {"other": 40.0, "tec": 30.0}

    def test_it_may_only_watch(self, bench):
        b = bench()
        outcome = b.run(loop(Playback(), actuators=()))
        assert outcome.status == "completed", outcome.reason
        assert b.sent == []
        assert len(b.samples()["t"]) == 10

    @pytest.mark.parametrize("value", [95.5, 9.0, math.nan, math.inf])
    def test_beyond_the_limits_it_is_refused_and_the_run_ends_safe(self, bench, value):
        b = bench()
        outcome = b.run(loop(Playback(lambda t: 30.0 if t < 0.55 else value)))
        assert isinstance(outcome.error, LimitError)
        assert outcome.reason.startswith("tec: set-point")
        assert "10 to 95 °C" in outcome.reason
        assert b.sent == [30.0]
        b.assert_safe()
        # What was recorded before is kept.
        assert len(b.samples()["t"]) == 6
        assert [event.kind for event in b.watcher.events].count("error") == 1

    def test_beyond_its_own_limits_too(self, bench):
        b = bench()
        outcome = b.run(loop(Playback(lambda t: 30.0 if t < 0.55 else 41.0), limits=((20.0, 40.0),)))
        assert isinstance(outcome.error, LimitError)
        assert outcome.reason == "tec: the controller asked for 41, beyond 20 to 40"
        assert b.sent == [30.0]
        b.assert_safe()

    def test_none_is_sent_when_another_is_wrong(self, bench):
        b = bench(append=SECOND)
        outcome = b.run(loop(Controller(60.0, 60.0), actuators=("tec", "other")))
        assert outcome.reason.startswith("other: set-point 60 °C is outside of 10 to 50 °C")
        assert b.sent == b.devices["other"].sent == []
        b.assert_safe()

    @pytest.mark.parametrize("setpoints", [(30.0, 30.0), (30.0, 30.0, 30.0, 30.0)])
    def test_too_few_or_too_many_are_named_and_none_is_sent(self, bench, setpoints):
        b = bench(append=SECOND + SECOND.replace("other", "third"))
        outcome = b.run(loop(Controller(*setpoints), actuators=("tec", "other", "third")))
        assert isinstance(outcome.error, ConfigurationError)
        assert outcome.reason == (f"the controller of tec, other, third gave {len(setpoints)} set-points; expected 3")
        assert b.sent == b.devices["other"].sent == []
        b.assert_safe()


class TestInputs:
    def test_the_controller_sees_them_in_its_order(self, bench):
        b, controller = bench(), Controller(35.0)
        b.run(loop(controller, inputs=("tec_setpoint", "probe_temperature", "tec_current")))
        samples = b.samples()
        for k, (_, (setpoint, temperature, current)) in enumerate(controller.seen):
            assert temperature == samples["probe_temperature"][k]
            assert current == samples["tec_current"][k] == pytest.approx(0.0 if k == 0 else 0.05 * 13.0)
            # A sample is read before its set-point is sent.
            assert math.isnan(setpoint) if k == 0 else setpoint == 35.0
            assert samples["tec_setpoint"][k] == 35.0

    def test_only_what_is_wanted_is_read_with_each_sample(self, bench):
        b = bench()
        probe, tec = count_readings(b.devices["probe"]), count_readings(b.devices["tec"])
        b.run(loop(Controller(), 10.0, 2.0))
        # The check at the beginning, the tick before the first sample, and the others a telemetry period apart.
        assert tec == [0.0, 0.0, 0.5, 1.0, 1.5]
        assert sorted(set(probe)) == pytest.approx([0.1 * k for k in range(20)])
        assert len(probe) == 20 + len(tec)

    def test_what_is_watched_is_recorded_and_not_given(self, bench):
        b, controller = bench(), Controller()
        tec = count_readings(b.devices["tec"])
        b.run(loop(controller, 10.0, 2.0, watched=("tec_temperature",)))
        assert all(len(measured) == 1 for _, measured in controller.seen)
        assert len(tec) == 20 + 5
        # The noise of each reading is another.
        assert len(set(b.samples()["tec_temperature"])) == 20

    def test_what_is_watched_is_read_with_the_recorded_samples_alone(self, bench):
        b = bench()
        probe, tec = count_readings(b.devices["probe"]), count_readings(b.devices["tec"])
        b.run(loop(Controller(), 10.0, 2.0, watched=("tec_temperature",), record_every=4))
        assert len(probe) == 20 + 5
        assert len(tec) == 5 + 5
        assert {0.4, 0.8, 1.2, 1.6} <= {round(instant, 6) for instant in tec}
        assert len(set(b.samples()["tec_temperature"])) == 5

    def test_what_is_not_watched_stands_as_at_the_last_tick(self, bench):
        b = bench()
        b.run(loop(Controller(), 10.0, 2.0))
        temperatures = b.samples()["tec_temperature"]
        # Each tick comes after the sample of its instant.
        assert len(set(temperatures)) == 4
        for first, last in ((0, 5), (6, 10), (11, 15), (16, 19)):
            assert len(set(temperatures[first : last + 1])) == 1

    def test_a_derived_one_is_computed_from_each_reading(self, bench):
        b, controller = bench(append=CURVATURE), Controller(60.0)
        b.run(loop(controller, inputs=("curvature",)))
        samples = b.samples()
        assert [measured[0] for _, measured in controller.seen] == samples["curvature"].tolist()
        position = samples["spot_position"]
        assert np.all(np.diff(position) > 0)
        derived = b.rig.derived["curvature"]
        expected = [derived.compute({"spot_position": value}) for value in position]
        assert samples["curvature"].tolist() == expected


class TestRecord:
    def test_each_sample_has_what_the_controller_thought_of_it(self, bench):
        b = bench()
        b.run(loop(Controller()))
        samples = b.samples()
        t = samples["t"]
        for signal, factor in zip(TRACES, (1.0, -1.0, 2.0, 3.0), strict=True):
            np.testing.assert_array_equal(samples[signal.name], factor * t)

    @pytest.mark.parametrize("every", [1, 2, 7, 100])
    def test_one_of_so_many_is_recorded(self, bench, every):
        b, controller = bench(), Controller()
        b.run(loop(controller, 20.0, 2.0, record_every=every))
        assert len(controller.seen) == 40
        assert b.samples()["t"].tolist() == controller.times[::every]
        assert b.loop_event().startswith("40 samples at 20 Hz, 0 left out;")

    def test_outside_of_the_loop_nobody_is_at_work(self, bench):
        b = bench()
        b.run(loop(Controller(), 10.0, 1.0), Step({"tec": 31.0}, Dwell(2.0)))
        with b.record() as run:
            steps = run.steps()
        ticks = b.telemetry()
        for name in (*(signal.name for signal in TRACES), "lateness"):
            assert np.all(np.isnan(steps[name]))
            assert np.all(np.isnan(ticks[name][ticks["t"] > 1.0]))
        assert np.isnan(ticks["lateness"]).sum() == len(ticks) - 10


class TestLate:
    """All times here are sums of powers of two, and so exact."""

    def test_a_reading_within_the_period_makes_nothing_late(self, bench):
        b, controller = bench(("period = 0.5", "period = 50.0")), Controller()
        slow_down(b, b.devices["probe"], 0.125)
        b.run(loop(controller, 4.0, 4.0))
        start = b.samples()["t"][0]
        assert b.samples()["t"].tolist() == [start + 0.25 * k for k in range(16)]
        assert b.loop_event() == "16 samples at 4 Hz, 0 left out; late by 0 ms on average, 0 ms at most"

    def test_a_slow_one_leaves_samples_out(self, bench):
        b, controller = bench(("period = 0.5", "period = 50.0")), Controller()
        slow_down(b, b.devices["probe"], 0.3125)
        outcome = b.run(loop(controller, 4.0, 4.0))
        assert outcome.status == "completed"
        # Five readings take as long as 6.25 periods should; which is late by less than one is taken at once.
        due = [0.25 * k for k in (0, 1, 2, 3, 5, 6, 7, 8, 10, 11, 12, 13, 15)]
        late = [0.0, 0.0625, 0.125, 0.1875] * 3 + [0.0]
        assert controller.times == [a + b for a, b in zip(due, late, strict=True)]
        samples = b.samples()
        assert samples["lateness"].tolist() == late
        assert (samples["t"] - samples["lateness"]).tolist() == [samples["t"][0] + instant for instant in due]
        mean, most = 1e3 * sum(late) / 13, 1e3 * max(late)
        assert b.loop_event() == (
            f"13 samples at 4 Hz, 3 left out; late by {mean:.3g} ms on average, {most:.3g} ms at most"
        )

    def test_a_late_one_is_told_its_true_time(self, bench):
        b, controller = bench(("period = 0.5", "period = 50.0")), Controller()
        slow_down(b, b.devices["probe"], {4: 0.375})
        b.run(loop(controller, 4.0, 2.0))
        assert controller.times == [0.0, 0.25, 0.5, 0.875, 1.0, 1.25, 1.5, 1.75]
        assert b.samples()["lateness"].tolist() == [0.0, 0.0, 0.0, 0.125, 0.0, 0.0, 0.0, 0.0]

    def test_at_the_end_none_is_taken_too_late(self, bench):
        b, controller = bench(("period = 0.5", "period = 50.0")), Controller()
        slow_down(b, b.devices["probe"], {2: 7.0})
        outcome = b.run(loop(controller, 4.0, 4.0))
        assert (outcome.status, controller.times) == ("completed", [0.0])
        assert b.loop_event().startswith("1 samples at 4 Hz, 15 left out;")

    def test_of_those_that_are_taken_one_of_so_many_is_recorded(self, bench):
        b, controller = bench(("period = 0.5", "period = 50.0")), Controller()
        slow_down(b, b.devices["probe"], 0.3125)
        b.run(loop(controller, 4.0, 4.0, record_every=4))
        assert b.samples()["lateness"].tolist() == [0.0] * 4

    def test_ticks_that_were_missed_are_not_made_up_for(self, bench):
        b = bench()
        tec = count_readings(b.devices["tec"])
        slow_down(b, b.devices["probe"], {5: 20.0})
        b.run(loop(Controller(), 16.0, 30.0))
        gap = int(np.argmax(np.diff(tec)))
        assert tec[gap + 1] - tec[gap] >= 20.0
        # One that is overdue, and then as before.
        assert np.diff(tec[gap + 2 :]) == pytest.approx(PERIOD)
        assert len(tec) - gap < 10.0 / PERIOD + 2

    @pytest.mark.parametrize("wait", [0.01, 0.7, 3.0])
    def test_slow_ticks_leave_room_for_samples(self, bench, wait):
        b = bench()
        slow_down(b, b.devices["tec"], wait)
        outcome = b.run(loop(Controller(), 10.0, 20.0))
        assert outcome.status == "completed"
        taken, left_out = map(int, re.match(r"(\d+) samples at 10 Hz, (\d+) left out", b.loop_event()).groups())
        assert taken + left_out == 200
        assert taken == len(b.samples()["t"]) >= 20.0 / (PERIOD + wait) - 1


class TestGoesOnMeanwhile:
    def test_a_device_that_the_loop_does_not_read_is_looked_at(self, bench):
        b = bench()
        b.devices["tec"].fail_at = 3.2
        outcome = b.run(loop(Controller(), 10.0, 60.0))
        assert isinstance(outcome.error, DeviceError)
        assert outcome.reason == "tec: open circuit at the sensor"
        assert 3.2 <= outcome.laboratory_seconds <= 3.2 + PERIOD
        b.assert_safe()
        samples = b.samples()
        assert samples["t"][-1] == pytest.approx(outcome.laboratory_seconds)
        assert len(samples["t"]) == round(10 * outcome.laboratory_seconds) + 1

    @cases(("rate", "inputs"), [(10.0, ("tec_current",)), (0.01, ("probe_temperature",))])
    def test_an_interlock_on_what_the_loop_does_not_read_or_between_its_samples(self, bench, rate, inputs):
        b = bench(("high = 90.0", "high = 50.0"))
        outcome = b.run(loop(Controller(80.0), rate, 300.0, inputs=inputs))
        assert isinstance(outcome.error, InterlockError)
        # At 80 °C it goes, 50 °C it passes after 0.66 s.
        assert outcome.laboratory_seconds == 1.0
        b.assert_safe()

    def test_an_interlock_on_an_input_holds_at_each_sample(self, bench):
        b = bench(("high = 90.0", "high = 50.0"))
        outcome = b.run(loop(Controller(80.0), 100.0, 60.0))
        assert isinstance(outcome.error, InterlockError)
        assert outcome.laboratory_seconds == pytest.approx(math.log(58.0 / 30.0), abs=0.011)
        b.assert_safe()
        temperatures = b.samples()["probe_temperature"]
        # The reading that ended it is recorded, and no other beyond.
        assert temperatures[-1] > 50.0 > temperatures[:-1].max()

    def test_a_slow_loop_does_not_keep_telemetry_waiting(self, bench):
        b, controller = bench(), Controller()
        tec = count_readings(b.devices["tec"])
        b.run(loop(controller, 0.2, 15.0))
        assert controller.times == [0.0, 5.0, 10.0]
        assert max(np.diff(tec)) == PERIOD
        ticks = b.telemetry()
        assert sorted(set(ticks["t"])) == [PERIOD * k for k in range(30)]
        # A tick is no sample.
        assert b.samples()["t"].tolist() == [0.0, 5.0, 10.0]
        assert b.loop_event().startswith("3 samples at 0.2 Hz, 0 left out; late by 0 ms")


class TestTrouble:
    @cases(("error", "status"), [(ValueError("lost its way"), "failed"), (KeyboardInterrupt(), "aborted")])
    def test_a_controller_that_raises(self, bench, error, status):
        class Lost(Controller):
            def update(self, t, measured):
                if len(self.seen) == 7:
                    raise error
                return super().update(t, measured)

        b = bench()
        outcome = b.run(loop(Lost()))
        assert outcome.status == status
        assert type(error).__name__ in outcome.reason
        b.assert_safe()
        assert len(b.samples()["t"]) == 7
        with b.record() as run:
            assert run.status == status
            assert len(run.steps()) == 0

    @pytest.mark.parametrize("where", ["glance_error", "set_error", "measure_error"])
    def test_a_device_that_raises(self, bench, where):
        class Breaking(Controller):
            def update(_, t, measured):
                if len(_.seen) == 5:
                    device = b.devices["tec" if where == "set_error" else "probe"]
                    setattr(device, where, DeviceError(device.name, "does not answer"))
                super().update(t, measured)
                return (30.0 + t,)

        b = bench()
        outcome = b.run(loop(Breaking()))
        assert isinstance(outcome.error, DeviceError)
        assert outcome.reason.endswith(": does not answer")
        b.assert_safe()
        assert len(b.samples()["t"]) == {"glance_error": 6, "set_error": 5, "measure_error": 10}[where]

    def test_abort_in_the_middle(self, bench):
        class Impatient(Controller):
            def update(_, t, measured):
                if len(_.seen) == 5:
                    b.interrupts.abort_reason = "SIGTERM"
                return super().update(t, measured)

        b, controller = bench(), Impatient()
        outcome = b.run(loop(controller, 10.0, 3600.0))
        assert isinstance(outcome.error, AbortError)
        assert (outcome.status, outcome.reason) == ("aborted", "ended by SIGTERM")
        assert len(controller.seen) == 6
        assert outcome.laboratory_seconds == 0.5
        b.assert_safe()

    @pytest.mark.parametrize("wait", [0.05, 20.0])
    def test_abort_of_a_loop_that_is_always_late(self, bench, wait):
        class Impatient(Controller):
            def update(_, t, measured):
                b.clock.sleep(wait)
                if len(_.seen) == 5:
                    b.interrupts.abort_reason = "SIGTERM"
                return super().update(t, measured)

        b, controller = bench(), Impatient()
        assert b.run(loop(controller, 100.0, 3600.0)).status == "aborted"
        assert len(controller.seen) == 6
        b.assert_safe()

    @cases(
        ("keys", "name"),
        [
            ({"inputs": ("prob_temperature",)}, "prob_temperature"),
            ({"watched": ("spot_position",)}, "spot_position"),
            ({"actuators": ("heater",)}, "heater"),
            ({"actuators": ("probe",)}, "probe"),
        ],
    )
    def test_wrong_names_are_found_before_the_run_and_before_anything_is_sent(self, bench, rig_file, keys, name):
        b, controller = bench(), Controller()
        outcome = b.run(loop(controller, **keys))
        assert isinstance(outcome.error, ConfigurationError)
        assert outcome.reason.startswith(name)
        assert b.sent == controller.seen == []
        b.assert_safe()
        wrong, right = define(loop(Controller(), **keys)), define(loop(Controller()))
        with Rig(load_rig(rig_file()), VirtualClock(), 1) as rig:
            check_before_moving(rig.description, right, plan(right, Nothing()))
            with pytest.raises(ConfigurationError, match=name):
                check_before_moving(rig.description, wrong, plan(wrong, Nothing()))


class TestWallClockTime:
    @pytest.mark.parametrize(("rate", "duration"), [(200.0, 1.0), (2000.0, 0.25)])
    def test_the_record_is_consistent_however_busy_the_machine_is(self, bench, rate, duration):
        b, controller = bench(clock=WallClock()), Controller()
        outcome = b.run(loop(controller, rate, duration))
        assert outcome.status == "completed", outcome.reason
        planned = round(rate * duration)
        taken, left_out = map(int, re.match(r"(\d+) samples at \d+ Hz, (\d+) left out", b.loop_event()).groups())
        assert taken + left_out == planned
        samples = b.samples()
        assert len(samples["t"]) == len(controller.seen) == taken > 0
        assert np.all(np.diff(samples["t"]) > 0)
        assert np.all(samples["lateness"] >= 0)
        # Each was due at one of the instants, none twice.
        due = (samples["t"] - samples["lateness"]) * rate
        numbers = np.rint(due - due[0])
        np.testing.assert_allclose(due - due[0], numbers, atol=1e-3)
        assert np.all(np.diff(numbers) >= 1)
        assert numbers[-1] < planned
        assert outcome.laboratory_seconds >= duration
        b.assert_safe()


class TestTwentyKilohertz:
    """A loop through the drivers, on the virtual clock."""

    def test_every_sample_is_there(self, tmp_path):
        b = Bench(tmp_path, "hybrid")
        outcome = b.run(find_protocol("piezo-step"), voltage=40.0)
        assert outcome.status == "completed", outcome.reason
        assert outcome.safe_state == dict.fromkeys(b.devices, "safe")
        samples = b.samples()
        # From where the first reading of everything, over the wires, has ended.
        start = samples["t"][0]
        # The record counts from the start of the run, which rounds.
        assert samples["t"] == pytest.approx([start + k * (1.0 / 20e3) for k in range(6400)], abs=1e-12)
        assert not samples["lateness"].any()
        assert b.loop_event() == "6400 samples at 20000 Hz, 0 left out; late by 0 ms on average, 0 ms at most"
        assert samples["piezo_setpoint"].tolist() == [0.0] * 400 + [40.0] * 6000
        # Where the resonance is: the highest line of what is left of the step.
        ringing = samples["displacement_position"][800:4800]
        spectrum = np.abs(np.fft.rfft((ringing - ringing.mean()) * np.hanning(4000)))
        assert np.fft.rfftfreq(4000, 1 / 20e3)[20 + np.argmax(spectrum[20:])] == pytest.approx(693.7, abs=5.0)


def test_a_controller_may_put_the_end_off(bench):
    controllers = [Late(), Late(), Late()]
    bench().run(
        loop(controllers[0], put_off=2.0),
        loop(controllers[1], put_off=0.2),
        loop(controllers[2]),
    )
    assert [len(each.seen) for each in controllers] == [15, 12, 10]
    assert np.diff(controllers[0].times) == pytest.approx(0.1)


def test_only_a_controller_with_a_delay_puts_the_end_off():
    assert loop(Late(), put_off=2.0).plan().at_most == 3.0
    with pytest.raises(ValueError, match="put_off"):
        loop(Controller(), put_off=2.0)
    with pytest.raises(ValueError, match="put_off"):
        loop(Late(), put_off=-1.0)
