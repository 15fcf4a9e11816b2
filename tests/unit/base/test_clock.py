import math
import signal
import threading
from datetime import UTC, datetime, timedelta
from itertools import product

import pytest
from cases import cases
from hypothesis import given, strategies as st

from bench.base import (
    ConfigurationError,
    Pace,
    PacedClock,
    ScaledClock,
    Stopwatch,
    VirtualClock,
    WallClock,
    make_clock,
)


def every_clock():
    return [VirtualClock(), PacedClock(1000.0), ScaledClock(1000.0), WallClock()]


@pytest.mark.parametrize("clock", every_clock(), ids=lambda clock: type(clock).__name__)
class TestEveryClock:
    def test_time_does_not_go_back(self, clock):
        readings = []
        for seconds in (0.0, 1e-3, -1.0, 2e-3):
            readings.append(clock.now())
            clock.sleep(seconds)
        assert readings == sorted(readings)

    def test_sleep_lasts_at_least_as_long_as_asked(self, clock):
        start = clock.now()
        clock.sleep(5e-3)
        assert clock.now() - start >= 5e-3 * (1 - 1e-9)

    def test_sleep_until_reaches_the_instant(self, clock):
        instant = clock.now() + 5e-3
        clock.sleep_until(instant)
        assert clock.now() >= instant - 1e-9

    def test_sleep_until_the_past_returns_at_once(self, clock):
        before = clock.now()
        clock.sleep_until(before - 1e6)
        # A busy machine may take its time: a minute, at x1000.
        assert before <= clock.now() < before + 60e3

    @pytest.mark.parametrize("seconds", [math.nan, math.inf, -math.inf])
    def test_refuses_what_is_not_finite(self, clock, seconds):
        with pytest.raises(ValueError, match="finite"):
            clock.sleep(seconds)
        with pytest.raises(ValueError, match="finite"):
            clock.sleep_until(seconds)

    def test_timestamp_and_date_agree(self, clock):
        clock.sleep(1e-3)
        before, stamp, date, after = clock.now(), clock.timestamp(), clock.date(), clock.now()
        # A time of day is in whole microseconds.
        assert before <= stamp - clock.epoch.timestamp() + 2e-6
        assert stamp <= date.timestamp() + 2e-6
        assert date.timestamp() - clock.epoch.timestamp() <= after + 2e-6
        assert date.tzinfo is not None


class TestVirtualClock:
    def test_sleep_until_is_exact_after_many_ticks(self):
        clock = VirtualClock()
        for tick in range(1, 100_001):
            clock.sleep_until(tick * 0.1)
            assert clock.now() == tick * 0.1
        assert clock.now() == 100_000 * 0.1

    @given(st.lists(st.floats(0, 1e6), min_size=1, max_size=20))
    def test_sleep_until_any_instants_stands_at_the_latest(self, instants):
        clock = VirtualClock()
        for instant in instants:
            clock.sleep_until(instant)
        assert clock.now() == max(instants)

    def test_is_the_only_one_whose_sleep_does_not_wait(self):
        assert [clock.sleep_waits for clock in every_clock()] == [False, True, True, True]

    def test_any_thread_may_read_while_one_lets_time_pass(self):
        clock = VirtualClock()
        seen, done = [], threading.Event()

        def watch():
            while not done.is_set():
                seen.append(clock.now())

        thread = threading.Thread(target=watch)
        thread.start()
        for tick in range(1, 5001):
            clock.sleep_until(float(tick))
        done.set()
        thread.join()
        assert seen == sorted(seen)
        assert clock.now() == 5000.0


@pytest.mark.parametrize(
    "make", [WallClock, lambda: PacedClock(2.0), lambda: ScaledClock(2.0)], ids=["wall", "paced", "scaled"]
)
class TestInterruptedSleep:
    def test_does_not_begin_when_interrupted_before(self, make):
        clock = make()
        clock.interrupted = lambda: True
        clock.sleep(3600.0)
        clock.sleep_until(clock.now() + 3600.0)
        assert clock.now() < 60.0

    def test_ends_early_when_interrupted_meanwhile(self, make):
        clock = make()
        asked = []

        def interrupted():
            asked.append(clock.now())
            return len(asked) > 1

        clock.interrupted = interrupted
        clock.sleep(3600.0)
        assert len(asked) >= 2
        assert clock.now() < 60.0

    def test_a_signal_ends_it_soon(self, make):
        clock = make()
        came = []
        clock.interrupted = lambda: bool(came)
        former = signal.signal(signal.SIGALRM, lambda *_: came.append(True))
        try:
            signal.setitimer(signal.ITIMER_REAL, 0.05)
            clock.sleep(3600.0)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, former)
        assert came
        assert clock.now() < 60.0


@cases(("make", "factor"), product([ScaledClock, PacedClock], [0.0, -1.0, math.nan, math.inf]))
def test_a_factor_that_is_not_positive_is_refused(make, factor):
    with pytest.raises(ValueError, match="factor: expected a positive number"):
        make(factor)


class TestScaledClock:
    def test_runs_faster_than_the_wall_clock(self):
        clock, watch = ScaledClock(1e5), Stopwatch()
        clock.sleep(3600.0)
        assert clock.now() >= 3600.0 * (1 - 1e-9)
        assert watch.seconds() < 30.0


def compute(seconds):
    """Keep the processor busy for some wall-clock seconds."""
    watch = Stopwatch()
    while watch.seconds() < seconds:
        pass


class TestPacedClock:
    def test_time_passes_only_by_sleep(self):
        clock = PacedClock(1e6)
        compute(0.05)
        assert clock.now() == 0.0
        clock.sleep(3.0)
        compute(0.05)
        assert clock.now() == 3.0

    def test_waits_for_the_wall_clock(self):
        clock, watch = PacedClock(100.0), Stopwatch()
        for tick in range(1, 31):
            clock.sleep_until(float(tick))
            assert watch.seconds() >= tick / 100.0 - 2e-3
        assert clock.now() == 30.0

    def test_collects_short_sleeps(self):
        """A nap for each of them would take at least 50 microseconds."""
        clock, naps = PacedClock(1000.0), []
        clock.interrupted = lambda: naps.append(clock.now())
        for _ in range(10_000):
            clock.sleep(1e-3)
        assert clock.now() == pytest.approx(10.0)
        assert len(naps) < 100

    def test_stands_at_the_instants_of_the_virtual_clock(self):
        paced, virtual = PacedClock(1e4), VirtualClock()
        for tick in range(1, 2001):
            for clock in (paced, virtual):
                clock.sleep(1e-3)
                clock.sleep_until(tick * 0.1)
            assert paced.now() == virtual.now()

    def test_makes_up_for_little_of_what_is_lost(self):
        clock = PacedClock(10.0)
        compute(1.2)
        # It catches up with 0.2 s, which are 2 s here, and then waits again.
        watch = Stopwatch()
        clock.sleep(1e-6)
        clock.sleep(6.0)
        assert watch.seconds() >= 0.35
        assert clock.pace().reached < 5.0

    def test_reports_the_pace_that_was_reached(self):
        clock = PacedClock(1e9)
        clock.sleep(1.0)
        compute(0.05)
        pace = clock.pace()
        assert pace.asked == 1e9
        assert 0.0 < pace.reached <= 20.0
        assert not pace.is_reached
        assert str(Pace(100.0, 37.04)) == "x100 asked for, x37 reached"
        clock.restart_pace()
        compute(0.01)
        assert clock.pace().reached == 0.0

    def test_a_loop_of_interrupted_sleeps_comes_to_its_end(self):
        clock = PacedClock(10.0)
        clock.interrupted = lambda: True
        while clock.now() < 1.0:
            clock.sleep(0.5)
        assert clock.now() < 60.0


class TestSuspension:
    def times(self):
        class Times:
            running = 100.0
            passing = 5000.0

            def go(self, seconds, suspended=0.0):
                self.running += seconds
                self.passing += seconds + suspended

        times = Times()
        return times, WallClock(lambda: times.running, lambda: times.passing)

    def test_is_noticed_once(self):
        times, clock = self.times()
        times.go(10.0)
        assert clock.suspension() == 0.0
        times.go(10.0, suspended=3600.0)
        assert clock.suspension() == pytest.approx(3600.0)
        times.go(10.0)
        assert clock.suspension() == 0.0
        assert clock.now() == pytest.approx(30.0)

    def test_below_a_second_is_none(self):
        times, clock = self.times()
        times.go(1.0, suspended=0.9)
        assert clock.suspension() == 0.0
        times.go(1.0, suspended=0.2)
        assert clock.suspension() == pytest.approx(1.1)

    def test_of_a_clock_in_process_cannot_matter(self):
        assert PacedClock(1.0).suspension() == VirtualClock().suspension() == 0.0


class TestParting:
    def times(self):
        class Times:
            running = passing = 100.0
            of_day = 1e9
            step = 0.0

            def read_passing(self):
                """Return the time that passes, and let the machine wait."""
                passing = self.passing
                self.passing += self.step
                self.of_day += self.step
                return passing

        times = Times()
        return times, WallClock(lambda: times.running, times.read_passing, lambda: times.of_day)

    @pytest.mark.parametrize("seconds", [1.5, -1.5])
    def test_is_noticed_once(self, seconds):
        times, clock = self.times()
        times.of_day += seconds
        assert clock.parting() == pytest.approx(seconds)
        assert clock.parting() == 0.0

    def test_below_a_second_is_none_until_it_adds_up(self):
        times, clock = self.times()
        times.of_day += 0.9
        assert clock.parting() == 0.0
        times.of_day += 0.2
        assert clock.parting() == pytest.approx(1.1)

    def test_a_suspension_is_none(self):
        times, clock = self.times()
        times.passing += 3600.0
        times.of_day += 3600.0
        assert clock.parting() == 0.0

    def test_a_machine_that_waits_between_two_readings_has_none(self):
        times, clock = self.times()
        times.step = 5.0
        assert clock.parting() == 0.0

    def test_of_a_clock_in_process_cannot_matter(self):
        assert PacedClock(1.0).parting() == VirtualClock().parting() == 0.0


class TestMakeClock:
    def test_by_name(self):
        assert isinstance(make_clock("wall", in_process=False), WallClock)
        fast = make_clock("x20", in_process=False)
        assert isinstance(fast, ScaledClock)
        assert fast.factor == 20.0

    def test_in_process_by_name(self):
        assert type(make_clock("virtual", in_process=True)) is VirtualClock
        for name, factor in {"wall": 1.0, "x20": 20.0, "x0.5": 0.5}.items():
            clock = make_clock(name, in_process=True)
            assert isinstance(clock, PacedClock)
            assert clock.factor == factor

    @cases("name", ["", "x", "x0", "x-3", "xnan", "xinf", "20", "Virtual", "real", "xx2"])
    def test_names_what_is_allowed(self, name):
        with pytest.raises(ConfigurationError) as caught:
            make_clock(name, in_process=True)
        assert repr(name) in str(caught.value)
        assert "wall, virtual, and xN" in str(caught.value)
        assert caught.value.exit_code == 2


class TestGoingOn:
    EPOCH = datetime(2026, 3, 1, 10, tzinfo=UTC)

    def test_a_laboratory_of_this_process_goes_on_where_it_ended(self):
        for clock in (VirtualClock(), PacedClock(1e6)):
            clock.go_on(self.EPOCH, 500.0)
            assert clock.now() == 500.0
            clock.sleep(2.0)
            assert clock.now() == 502.0
            assert clock.date() == self.EPOCH + timedelta(seconds=502.0)

    def test_on_the_wall_clock_the_time_has_passed(self):
        clock = WallClock()
        clock.go_on(datetime.now(UTC) - timedelta(hours=2), 10.0)
        assert 7200.0 <= clock.now() < 7260.0

    def test_a_wall_clock_that_was_set_back_does_not_go_back(self):
        clock = WallClock()
        clock.go_on(datetime.now(UTC) + timedelta(hours=2), 10.0)
        assert 10.0 <= clock.now() < 70.0

    def test_the_clock_of_a_served_laboratory_goes_on_by_itself(self):
        with pytest.raises(ConfigurationError, match="cannot go on with the time of another run"):
            ScaledClock(2.0).go_on(self.EPOCH, 0.0)
