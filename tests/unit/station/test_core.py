"""What a station decides, by random sequences of messages, delays and errors."""

import math

import pytest
from cases import cases
from hypothesis import settings, strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from bench.base import DeviceError, Display, GuardianError, InterlockError
from bench.execution.station.core import StationCore
from bench.rig import Interlock, InterlockWatch, Level

INTERVAL = 0.2
SECONDS = 2.0
HOLD = 3.0
SLACK = 1e-6
INTERLOCKS = (
    Interlock(signal="at_once", high=1.0),
    Interlock(signal="after", high=1.0, seconds=SECONDS),
    Interlock(signal="held", high=1.0, level=Level.HOLD, hold_at_most=HOLD),
    Interlock(signal="warned", high=1.0, level=Level.WARN),
)
ALLOWED = {"at_once": 0.0, "after": SECONDS, "held": HOLD}
"""How long each may be outside once it was seen, s."""


def core(interval=INTERVAL, interlocks=INTERLOCKS):
    displays = dict.fromkeys((each.signal for each in interlocks), Display.of("1", 3))
    return StationCore(InterlockWatch(interlocks, displays), interval)


class Bench(RuleBasedStateMachine):
    """A bench that does anything, and a loop that carries out what the core decides.

    The output is on from a request that was not refused, until the loop sees that the run is over.
    """

    def __init__(self):
        super().__init__()
        self.now = 0.0
        self.core = core()
        self.core.begin(0.0)
        self.values = dict.fromkeys((each.signal for each in INTERLOCKS), 0.0)
        self.seen_outside = {}
        self.is_on = self.is_bound = False
        self.is_asking = False
        self.promised = 10.0
        self.lease_end = math.inf
        self.cause = None

    # The loop

    def turn(self):
        self.core.advance(self.now)
        if self.core.look_due(self.now):
            self.judge()
        self.note()

    def judge(self):
        for name, value in self.values.items():
            if value <= 1.0:
                self.seen_outside.pop(name, None)
            else:
                self.seen_outside.setdefault(name, self.now)
        self.core.judge(self.now, self.values)

    def note(self):
        """Carry out what the core decided; the first cause counts."""
        if self.core.over:
            self.is_on = False
        if self.cause is None:
            self.cause = self.core.cause
        assert self.core.cause is self.cause

    def let_pass(self, seconds):
        end = self.now + seconds
        turns = 0
        while (due := self.core.due()) <= end:
            assert due >= self.now - SLACK
            self.now = max(due, self.now)
            self.turn()
            turns += 1
            assert turns < 20 + 10 * seconds / INTERVAL, "the loop spins"
        self.now = end

    def ask(self):
        """Begin a request; return whether it was not refused."""
        late = self.is_bound and not self.core.over and self.now >= self.lease_end
        refusal = None
        try:
            self.core.request(self.now)
        except (GuardianError, InterlockError, DeviceError) as error:
            refusal = error
        if refusal is not None:
            self.note()
            assert self.core.over
            assert self.core.cause is None or refusal is self.core.cause
            self.core.reply(self.now)
            return False
        assert not late
        assert not self.core.over
        return True

    def reply(self):
        self.core.reply(self.now)
        self.lease_end = self.now + self.promised

    # What happens

    @precondition(lambda self: not self.is_asking)
    @rule(seconds=st.sampled_from([0.0, 0.1, 0.5, 3.0, 20.0]))
    def promise(self, seconds):
        if self.ask():
            self.core.promise(seconds, "it computes")
            self.promised, self.is_bound = seconds, True
            self.reply()

    @precondition(lambda self: not self.is_asking)
    @rule()
    def apply(self):
        if self.ask():
            self.core.arm()
            self.is_on = self.is_bound = True
            self.reply()

    @precondition(lambda self: not self.is_asking)
    @rule()
    def look(self):
        if self.ask():
            self.judge()
            self.note()
            self.reply()

    @precondition(lambda self: not self.is_asking)
    @rule()
    def begin_slow_request(self):
        if self.ask():
            self.core.arm()
            self.is_on = self.is_bound = self.is_asking = True

    @precondition(lambda self: self.is_asking)
    @rule()
    def end_slow_request(self):
        self.is_asking = False
        self.reply()

    @rule(seconds=st.floats(0.0, 6.0))
    def wait(self, seconds):
        self.let_pass(seconds)

    @rule(seconds=st.floats(0.0, 6.0))
    def stall(self, seconds):
        """The machine is busy: the loop turns late."""
        self.now += seconds
        self.turn()

    @rule(name=st.sampled_from(sorted(ALLOWED)), value=st.sampled_from([0.0, 0.0, 2.0, math.nan]))
    def plant_changes(self, name, value):
        self.values[name] = value

    @rule()
    def line_fails(self):
        self.core.trip(DeviceError("sensor", "does not answer"))
        self.note()

    @rule()
    def end(self):
        # Also while another request is carried out.
        self.core.end()
        self.is_asking = False
        self.note()
        self.core.reply(self.now)

    # What has to hold

    @invariant()
    def no_output_is_on_beyond_the_promise(self):
        if self.is_on and not self.is_asking:
            assert self.now <= self.lease_end + SLACK

    @invariant()
    def no_output_is_on_beyond_the_time_of_an_interlock(self):
        for name, seconds in ALLOWED.items():
            if self.is_on and (since := self.seen_outside.get(name)) is not None:
                # What is no longer outside may not have been seen yet.
                assert self.values[name] <= 1.0 or self.now <= since + seconds + INTERVAL + SLACK

    @invariant()
    def interlocks_are_looked_at_in_time(self):
        assert self.core.over or self.core.due() <= self.now + INTERVAL + SLACK

    @invariant()
    def what_is_over_stays_over(self):
        if self.cause is not None:
            assert self.core.cause is not None
        assert not (self.core.over and self.is_on)


Bench.TestCase.settings = settings(max_examples=150, stateful_step_count=40, deadline=None)
TestBench = Bench.TestCase


def armed(promised=1.0, **more):
    it = core(**more)
    it.begin(0.0)
    it.request(0.0)
    it.promise(promised, "a loop at 100 Hz")
    it.arm()
    it.reply(0.0)
    return it


def test_a_broken_promise_ends_the_run_and_says_which_it_was():
    it = armed()
    it.advance(0.999)
    assert not it.over
    it.advance(1.0)
    assert it.cause is not None
    assert it.late
    with pytest.raises(GuardianError, match=r"not come back within the 1 s that it promised \(a loop at 100 Hz\)"):
        it.request(1.1)


def test_a_promise_binds_before_anything_has_moved():
    it = core()
    it.begin(0.0)
    it.request(0.0)
    it.reply(0.0)
    # Nothing was promised yet.
    it.advance(1e6)
    assert not it.over
    it.request(1e6)
    it.promise(30.0, "it computes")
    it.reply(1e6)
    it.advance(1e6 + 29.0)
    assert not it.over
    it.advance(1e6 + 31.0)
    assert it.cause is not None
    assert it.late


def test_an_output_is_not_left_on_by_a_bench_that_promised_nothing():
    it = core()
    it.begin(0.0)
    it.request(0.0)
    it.arm()
    it.reply(0.0)
    it.advance(60.0)
    assert it.cause is not None


@cases("seconds", [math.nan, math.inf, -1.0])
def test_a_promise_without_end_is_none(seconds):
    it = armed(1.0)
    it.request(0.5)
    with pytest.raises(ValueError, match="expected a time"):
        it.promise(seconds, "for ever")
    it.reply(0.5)
    it.advance(1.5)
    assert it.cause is not None


def test_the_bench_is_not_late_while_its_request_is_carried_out():
    it = armed()
    it.request(0.9)
    it.advance(50.0)
    assert not it.over
    it.reply(50.0)
    assert it.due() <= 51.0
    it.advance(51.0)
    assert it.cause is not None


def test_looks_that_were_missed_are_not_made_up_for():
    it = core()
    it.begin(0.0)
    assert not it.look_due(0.1)
    assert it.look_due(1.05)
    assert not it.look_due(1.1)
    assert it.due() == pytest.approx(1.2)


def test_the_instant_at_which_an_interlock_acts_is_due_between_two_looks():
    it = core(interval=10.0)
    it.begin(0.0)
    it.arm()
    it.judge(1.0, {"after": 2.0})
    assert it.due() == pytest.approx(1.0 + SECONDS)
    assert it.look_due(it.due())
    it.judge(1.0 + SECONDS, {"after": 2.0})
    assert it.cause is not None


def test_a_look_at_another_line_does_not_put_off_the_instant_at_which_an_interlock_acts():
    it = core(interval=10.0)
    it.begin(0.0)
    it.judge(1.0, {"after": 2.0})
    it.judge(1.0 + SECONDS, {"at_once": 0.5})
    assert it.look_due(1.0 + SECONDS)
    # Now it is on its way.
    it.judge(1.0 + SECONDS, {"at_once": 0.5})
    assert it.due() == pytest.approx(10.0)


def test_an_interlock_whose_signal_is_out_of_reach_does_not_put_off_another():
    it = core(interval=10.0, interlocks=(*INTERLOCKS, Interlock(signal="beside", high=1.0, seconds=2.0 * SECONDS)))
    it.begin(0.0)
    it.judge(1.0, {"after": 2.0, "beside": 2.0})
    assert it.look_due(1.0 + SECONDS)
    it.judge(1.5 + SECONDS, {"beside": 2.0})
    assert it.due() == pytest.approx(1.0 + 2.0 * SECONDS)


def test_an_instant_is_due_by_the_clock_of_the_caller():
    it = core(interval=100.0)
    it.begin(50.0)
    it.judge(1.0, {"after": 2.0}, now=50.0, factor=4.0)
    assert it.due() == pytest.approx(50.0 + SECONDS / 4.0)


def test_a_pause_is_asked_for_once_and_a_hold_until_it_is_over():
    it = core(
        interlocks=(
            Interlock(signal="paused", high=1.0, level=Level.PAUSE),
            Interlock(signal="held", high=1.0, level=Level.HOLD),
        )
    )
    it.judge(0.0, {"paused": 2.0, "held": 0.0})
    assert "paused = 2" in it.pause
    it.pause = ""
    it.judge(1.0, {"paused": 2.0, "held": 2.0})
    assert not it.pause
    assert it.holding
    it.judge(2.0, {"paused": 2.0, "held": 0.5})
    assert not it.holding
    assert not it.over


def test_samples_that_are_older_than_the_last_look_are_judged_at_it():
    it = core()
    it.judge(5.0, {"after": 2.0})
    it.judge(4.0, {"after": 2.0})
    assert not it.over
    it.judge(7.0, {"after": 2.0})
    assert it.cause is not None


def test_the_first_cause_counts():
    it = armed()
    it.trip(DeviceError("sensor", "does not answer"))
    it.judge(0.1, {"at_once": 2.0})
    it.advance(60.0)
    assert it.is_late(60.0)
    it.end()
    assert it.cause is not None
    assert not it.late
    assert not it.is_late(60.0)
    with pytest.raises(DeviceError, match="sensor: does not answer"):
        it.request(60.0)


def test_nothing_is_done_after_the_end():
    it = armed()
    it.end()
    assert it.due() == math.inf
    it.trip(DeviceError("sensor", "does not answer"))
    assert (it.over, it.cause) == (True, None)
    assert it.judge(0.1, {"at_once": 2.0}) == ()
    with pytest.raises(GuardianError, match="ended already"):
        it.request(0.1)
