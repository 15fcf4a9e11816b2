import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from bench.errors import InterlockError
from bench.interlocks import Interlock, InterlockWatch

UNITS = {"sink": "°C", "force": "N"}


def watch(*interlocks):
    return InterlockWatch(interlocks, UNITS)


class TestInterlock:
    @pytest.mark.parametrize(
        "keys",
        [
            {"low": 2.0, "high": 1.0},
            {"low": 1.0, "high": 1.0},
            {"low": math.nan},
            {"high": math.nan},
            {"seconds": -1.0},
            {"seconds": 1e6},
            {"hgih": 3.0},
        ],
    )
    def test_refuses(self, keys):
        with pytest.raises(ValidationError):
            Interlock(signal="sink", **keys)

    def test_one_that_watches_nothing_is_refused(self):
        with pytest.raises(ValidationError, match="low or high"):
            Interlock(signal="sink")


class TestWatch:
    def test_within_its_range_ends_included(self):
        guard = watch(Interlock(signal="sink", low=0.0, high=60.0))
        for t, value in enumerate((0.0, 30.0, 60.0)):
            guard.check(float(t), {"sink": value})

    @pytest.mark.parametrize("value", [-0.001, 60.001, math.inf, -math.inf, math.nan])
    def test_trips_at_once_without_seconds(self, value):
        guard = watch(Interlock(signal="sink", low=0.0, high=60.0))
        with pytest.raises(InterlockError) as caught:
            guard.check(7.0, {"sink": value})
        assert "sink" in str(caught.value)
        assert "0 to 60 °C" in str(caught.value)
        assert caught.value.exit_code == 5

    def test_one_sided(self):
        guard = watch(Interlock(signal="force", high=5.0))
        guard.check(0.0, {"force": -1e9})
        with pytest.raises(InterlockError, match=r"force = 5\.1 N"):
            guard.check(1.0, {"force": 5.1})

    def test_nan_counts_as_outside_even_of_one_sided(self):
        with pytest.raises(InterlockError):
            watch(Interlock(signal="force", high=5.0)).check(0.0, {"force": math.nan})

    def test_waits_its_seconds(self):
        guard = watch(Interlock(signal="sink", high=60.0, seconds=5.0))
        guard.check(100.0, {"sink": 61.0})
        guard.check(104.9, {"sink": math.nan})
        with pytest.raises(InterlockError, match=r"for 5\.0 s"):
            guard.check(105.0, {"sink": 61.0})

    def test_recovery_in_between_starts_anew(self):
        guard = watch(Interlock(signal="sink", high=60.0, seconds=5.0))
        guard.check(0.0, {"sink": 61.0})
        guard.check(4.0, {"sink": 60.0})
        guard.check(4.5, {"sink": 61.0})
        guard.check(9.4, {"sink": 61.0})
        with pytest.raises(InterlockError):
            guard.check(9.5, {"sink": 61.0})

    def test_each_interlock_has_its_own_time(self):
        guard = watch(
            Interlock(signal="sink", high=60.0, seconds=5.0), Interlock(signal="force", high=5.0, seconds=2.0)
        )
        guard.check(0.0, {"sink": 61.0, "force": 1.0})
        guard.check(4.0, {"sink": 61.0, "force": 6.0})
        with pytest.raises(InterlockError, match="sink"):
            guard.check(5.5, {"sink": 61.0, "force": 6.0})

    def test_two_interlocks_on_one_signal(self):
        guard = watch(Interlock(signal="sink", high=60.0, seconds=100.0), Interlock(signal="sink", high=80.0))
        guard.check(0.0, {"sink": 70.0})
        with pytest.raises(InterlockError, match="to 80"):
            guard.check(1.0, {"sink": 81.0})

    @given(
        st.floats(0.0, 10.0),
        st.lists(st.tuples(st.floats(0.01, 3.0), st.booleans()), min_size=1, max_size=30),
    )
    def test_trips_exactly_when_outside_without_a_break_for_its_seconds(self, seconds, course):
        guard = watch(Interlock(signal="sink", high=60.0, seconds=seconds))
        t, since = 0.0, None
        for dt, outside in course:
            t += dt
            since = (t if since is None else since) if outside else None
            if since is not None and t - since >= seconds:
                with pytest.raises(InterlockError):
                    guard.check(t, {"sink": 99.0})
                return
            guard.check(t, {"sink": 99.0 if outside else 20.0})
