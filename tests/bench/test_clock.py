import math
import signal
import threading
from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.clock import VIRTUAL_EPOCH, ScaledClock, Stopwatch, VirtualClock, WallClock, make_clock, wall_time
from bench.errors import ConfigurationError


def every_clock():
    return [VirtualClock(), ScaledClock(1000.0), WallClock()]


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
        clock.sleep_until(before - 1000.0)
        assert before <= clock.now() < before + 500.0

    @pytest.mark.parametrize("seconds", [math.nan, math.inf, -math.inf])
    def test_refuses_what_is_not_finite(self, clock, seconds):
        with pytest.raises(ValueError, match="finite"):
            clock.sleep(seconds)
        with pytest.raises(ValueError, match="finite"):
            clock.sleep_until(seconds)

    def test_timestamp_and_date_agree(self, clock):
        clock.sleep(1e-3)
        stamp, date = clock.timestamp(), clock.date()
        assert stamp == pytest.approx(clock.epoch.timestamp() + clock.now(), abs=10.0)
        assert date.timestamp() == pytest.approx(stamp, abs=10.0)
        assert date.tzinfo is not None


class TestVirtualClock:
    def test_starts_at_the_same_epoch_each_time(self):
        assert VirtualClock().epoch == VIRTUAL_EPOCH == datetime(2000, 1, 1, tzinfo=UTC)
        assert VirtualClock().timestamp() == VIRTUAL_EPOCH.timestamp()

    def test_a_day_costs_nothing(self):
        clock, watch = VirtualClock(), Stopwatch()
        clock.sleep(86400.0)
        assert clock.now() == 86400.0
        assert clock.date() == VIRTUAL_EPOCH + timedelta(days=1)
        assert watch.seconds() < 60.0

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

    def test_does_not_run_by_itself(self):
        assert not VirtualClock.runs_by_itself
        assert WallClock.runs_by_itself
        assert ScaledClock.runs_by_itself

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


@pytest.mark.parametrize("make", [WallClock, lambda: ScaledClock(2.0)], ids=["wall", "scaled"])
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
        assert len(asked) == 2
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


class TestScaledClock:
    @pytest.mark.parametrize("factor", [0.0, -1.0, math.nan, math.inf])
    def test_refuses_a_factor_that_is_not_positive(self, factor):
        with pytest.raises(ValueError, match="factor: expected a positive number"):
            ScaledClock(factor)

    def test_runs_faster_than_the_wall_clock(self):
        clock, watch = ScaledClock(1e5), Stopwatch()
        clock.sleep(3600.0)
        assert clock.now() >= 3600.0 * (1 - 1e-9)
        assert watch.seconds() < 30.0


class TestMakeClock:
    def test_by_name(self):
        assert isinstance(make_clock("wall"), WallClock)
        assert isinstance(make_clock("virtual"), VirtualClock)
        fast = make_clock("x20")
        assert isinstance(fast, ScaledClock)
        assert fast.factor == 20.0
        assert make_clock("x0.5").factor == 0.5

    @pytest.mark.parametrize("name", ["", "x", "x0", "x-3", "xnan", "xinf", "20", "Virtual", "real", "xx2"])
    def test_names_what_is_allowed(self, name):
        with pytest.raises(ConfigurationError) as caught:
            make_clock(name)
        assert repr(name) in str(caught.value)
        assert "wall, virtual, and xN" in str(caught.value)
        assert caught.value.exit_code == 2


def test_wall_time_carries_its_zone():
    assert wall_time().utcoffset() == timedelta(0)
