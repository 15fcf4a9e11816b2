"""`Arrived`: a step ends when its devices have arrived, and its record says so, or that they have not."""

import pytest
from cases import cases

from bench.base import DeviceError, Interrupts, SettleTimeoutError, VirtualClock
from bench.dashboard.timeline import _NOT_SETTLED, Timeline
from bench.execution.engine import Engine
from bench.execution.station.local import LocalStation
from bench.protocol import Arrived, Dwell, Prompt, ProtocolParameters, Settled, Step, UntilSteady, plan, protocol
from bench.record import FILE_NAME, Journal, Record
from bench.rig import Rig, load_rig


class Nothing(ProtocolParameters):
    pass


def run(folder, rig, *steps, overrides=None):
    """Carry steps out; return the outcome, and the record of each step with its readings."""

    def go(parameters):
        """Go."""
        remaining = list(steps)
        while remaining:
            yield remaining.pop(0)

    go.__annotations__ = {"parameters": Nothing}
    definition = protocol(needs=())(go)
    with Rig(load_rig(rig, overrides), VirtualClock(), 1) as connected:
        journal = Journal(folder / FILE_NAME, connected.signals, {})
        outcome = Engine(LocalStation(connected), journal, (), Interrupts()).run(definition, Nothing())
        journal.close()
    assert outcome.is_safe
    assert plan(definition, Nothing()).steps == len(steps)
    with Record(folder) as record:
        names = [signal.name for signal in record.signals]
        return outcome, [(each, dict(zip(names, each.values, strict=True))) for each in record.step_records()]


class TestOnTheHeater:
    def test_each_rule_records_how_it_was_met(self, rig_file, tmp_path):
        steady = UntilSteady("probe_temperature", drift=0.05, noise=0.01, timeout=200.0)
        steps = [Step({"tec": 40.0}, Dwell(1.0)), Step({"tec": 50.0}, Arrived()), Step({"tec": 45.0}, steady)]
        outcome, records = run(tmp_path, rig_file(), *steps)
        assert outcome.status == "completed"
        assert [record.settled for record, _ in records] == [Settled.DWELL, Settled.ARRIVED, Settled.STEADY]
        assert not any(record.settled.failed for record, _ in records)
        assert records[1][1]["tec_temperature"] == pytest.approx(50.0, abs=0.12)

    def test_at_least_the_minimum(self, rig_file, tmp_path):
        _, records = run(tmp_path, rig_file(), Step({"tec": 40.0}, Arrived(timeout=90.0, minimum=30.0)))
        assert records[0][0].finished == 30.0

    def test_nothing_sent_has_arrived(self, rig_file, tmp_path):
        _, records = run(tmp_path, rig_file(), Step({}, Arrived()))
        assert (records[0][0].settled, records[0][0].finished) == (Settled.ARRIVED, 0.0)

    def test_what_was_sent_before_a_prompt_need_not_have_arrived_after_it(self, rig_file, tmp_path):
        path = rig_file(("noise = 0.002", "noise = 0.002\ntime_constant = 100.0"))
        by_hand = Prompt(
            text="Turn it", task="turn", value=33.0, settle=Arrived(timeout=5.0), signal="probe_temperature",
            low=0.0, high=90.0,
        )  # fmt: skip
        outcome, records = run(tmp_path, path, Step({"tec": 90.0}, Dwell(1.0)), by_hand)
        assert outcome.status == "completed"
        assert (records[1][0].settled, records[1][0].finished) == (Settled.ARRIVED, 1.0)

    def test_a_step_that_takes_too_long_is_recorded_and_ends_the_run(self, rig_file, tmp_path):
        path = rig_file(("noise = 0.002", "noise = 0.002\ntime_constant = 100.0"))
        outcome, records = run(tmp_path, path, Step({"tec": 90.0}, Arrived(timeout=5.0)), Step({}, Dwell(1.0)))
        assert isinstance(outcome.error, SettleTimeoutError)
        assert outcome.reason == "tec did not arrive within 5 s"
        ((record, reading),) = records
        assert (record.settled, record.finished) == (Settled.NOT_ARRIVED, 5.0)
        assert 22.0 < reading["tec_temperature"] < 30.0

    def test_the_same_for_one_that_is_not_steady(self, rig_file, tmp_path):
        path = rig_file(("noise = 0.002", "noise = 0.002\ntime_constant = 100.0"))
        steady = UntilSteady("probe_temperature", drift=0.01, noise=0.002, timeout=5.0)
        outcome, records = run(tmp_path, path, Step({"tec": 90.0}, steady), Step({}, Dwell(1.0)))
        assert isinstance(outcome.error, SettleTimeoutError)
        assert [record.settled for record, _ in records] == [Settled.NOT_STEADY]

    @cases("bad", [{"timeout": 0.0}, {"timeout": 5.0, "minimum": 5.0}, {"timeout": float("inf")}])
    def test_times_that_do_not_fit(self, bad):
        with pytest.raises(ValueError, match=r"Arrived: expected finite timeout > minimum ≥ 0"):
            Arrived(**bad)


class Lanes:
    """Takes what the timeline sends."""

    def __init__(self):
        self.sent = []

    def send(self, path, _, columns):
        self.sent.append((path, str([column.as_arrow_array().to_pylist() for column in columns])))

    def log(self, *_):
        pass


def test_the_dashboard_shows_a_step_that_did_not_settle(rig_file, tmp_path):
    path = rig_file(("noise = 0.002", "noise = 0.002\ntime_constant = 100.0"))
    _, records = run(tmp_path, path, Step({"tec": 30.0}, Dwell(1.0)), Step({"tec": 90.0}, Arrived(timeout=5.0)))
    lanes = Lanes()
    Timeline().write(lanes, [record for record, _ in records])
    shown = next(text for name, text in lanes.sent if name == "state/run")
    assert _NOT_SETTLED in shown
    assert shown.index("running") < shown.index(_NOT_SETTLED)


class TestOnRealInstruments:
    """The wire-level emulators, with the drivers of the real instruments."""

    def test_a_stage_on_its_way_is_never_recorded_as_arrived(self, tmp_path):
        outcome, records = run(tmp_path, "sma", Step({"stage": 5e-3}, Arrived(timeout=30.0)))
        ((record, reading),) = records
        assert (outcome.status, record.settled) == ("completed", Settled.ARRIVED)
        assert reading["stage_position"] == pytest.approx(5e-3, abs=0.1e-3)

    def test_nor_is_one_that_has_too_little_time(self, tmp_path):
        outcome, records = run(tmp_path, "sma", Step({"stage": 5e-3}, Arrived(timeout=0.05)))
        ((record, reading),) = records
        assert (outcome.status, record.settled) == ("failed", Settled.NOT_ARRIVED)
        assert reading["stage_position"] < 4.5e-3

    def test_a_controller_whose_own_time_out_is_too_short(self, tmp_path):
        overrides = {"devices.tec.stable_timeout": "0.001"}
        outcome, records = run(tmp_path, "vo2", Step({"tec": 60.0}, Arrived()), overrides=overrides)
        assert outcome.status == "failed"
        assert isinstance(outcome.error, DeviceError | SettleTimeoutError)
        assert outcome.error.exit_code in (4, 6)
        assert [record.settled for record, _ in records] == [Settled.NOT_ARRIVED]
