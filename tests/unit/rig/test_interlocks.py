import math
from itertools import pairwise

import pytest
from cases import cases
from hypothesis import given, strategies as st
from pydantic import ValidationError

from bench.base import ConfigurationError, Display, InterlockError
from bench.rig import Interlock, InterlockWatch, Level

DISPLAYS = {
    "sink": Display.of("°C", 3),
    "force": Display.of("N", 3, 5.0),
    "plate_setpoint": Display.of("°C", 3),
    "supply_setpoint": Display.of("V", 3, 10.0),
    "tip": Display.of("m", 9, 5e-5),
}


def watch(*interlocks):
    """Watch interlocks, with a warning band only where a test gives one."""
    silent = {"warn": 0.0}
    return InterlockWatch(
        (each if "warn" in each.model_fields_set else each.model_copy(update=silent) for each in interlocks), DISPLAYS
    )


class TestInterlock:
    @cases(
        "keys",
        [
            {},
            {"low": 2.0, "high": 1.0},
            {"low": math.nan},
            {"low": 1.0, "high": math.inf},
            {"high": 1.0, "seconds": -1.0},
            {"high": 1.0, "seconds": 1e6},
            {"high": 1.0, "warn": 0.51},
            {"hgih": 3.0},
            {"high": 5.0, "resume_high": 6.0},
            {"high": 5.0, "resume_low": 4.0},
            {"low": 1.0, "high": 5.0, "resume_low": 4.0, "resume_high": 2.0},
            {"low": 1.0, "high": 5.0, "resume_low": 6.0},
            {"fastest": 0.0},
            {"high": 5.0, "over": 2.0},
            {"fastest": 1.0, "over": 0.0},
            {"stale": 0.0},
            {"stale": 10.0, "minus": "force"},
            {"high": 5.0, "minus": "sink"},
            {"stuck": {"moved": 1.0, "follows": 1.0, "within": 1.0}},
            {"setpoint": "plate", "stuck": {"moved": 1.0, "follows": 1.0}},
            {"setpoint": "plate", "stuck": {"moved": 0.0, "follows": 1.0, "within": 1.0}},
            {"setpoint": "plate"},
            {"high": 5.0, "level": "stop"},
            {"high": 5.0, "hold_at_most": 20.0},
            {"high": 5.0, "level": "warn", "hold_at_most": 20.0},
        ],
    )
    def test_refuses(self, keys):
        with pytest.raises(ValidationError):
            Interlock(signal="sink", **keys)


class TestWatch:
    def test_within_its_range_ends_included(self):
        guard = watch(Interlock(signal="sink", low=0.0, high=60.0))
        for t, value in enumerate((0.0, 30.0, 60.0)):
            guard.check(float(t), {"sink": value})

    @cases("value", [-0.001, 60.001, math.inf, -math.inf, math.nan])
    def test_trips_at_once_without_seconds(self, value):
        guard = watch(Interlock(signal="sink", low=0.0, high=60.0))
        with pytest.raises(InterlockError) as caught:
            guard.check(7.0, {"sink": value})
        assert "sink" in str(caught.value)
        assert "0 to 60 °C" in str(caught.value)
        assert caught.value.exit_code == 5

    def test_each_interlock_has_its_own_time(self):
        guard = watch(
            Interlock(signal="sink", high=60.0, seconds=5.0), Interlock(signal="force", high=5.0, seconds=2.0)
        )
        guard.check(0.0, {"sink": 61.0, "force": 1.0})
        guard.check(4.0, {"sink": 61.0, "force": 6.0})
        with pytest.raises(InterlockError, match="sink"):
            guard.check(5.5, {"sink": 61.0, "force": 6.0})

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


def looks(watch, course, signal="sink"):
    """Look at a course of (t, value) or (t, value, set-point of the plate); return what is found."""
    found = []
    for t, value, *setpoint in course:
        setpoints = {"plate": setpoint[0]} if setpoint else {}
        found += [(t, each.level, each.over) for each in watch.look(t, {signal: value}, setpoints)]
    return found


class TestLooks:
    def test_one_that_is_before_the_last_is_refused(self):
        guard = watch(Interlock(signal="sink", high=60.0))
        guard.look(5.0, {"sink": 20.0})
        guard.look(5.0, {"sink": 20.0})
        guard.look(5.0 - 1e-9, {"sink": 20.0})
        with pytest.raises(ValueError, match="order"):
            guard.look(4.9, {"sink": 20.0})
        with pytest.raises(ValueError, match="nan"):
            guard.look(math.nan, {"sink": 20.0})

    def test_a_signal_that_is_not_there_is_left_as_it_is(self):
        guard = watch(Interlock(signal="sink", high=60.0, seconds=2.0))
        assert guard.look(0.0, {"sink": 61.0}) == ()
        assert guard.look(5.0, {"force": 1.0}) == ()
        (finding,) = guard.look(6.0, {"sink": 61.0})
        assert (finding.since, finding.value, finding.level) == (0.0, 61.0, Level.SAFE)

    def test_the_signals_that_it_needs(self):
        guard = watch(
            Interlock(signal="sink", high=60.0, minus="plate_setpoint"), Interlock(signal="force", high=1.0)
        )
        assert guard.signals == {"sink", "force"}  # a set-point is known without a reading
        assert watch().signals == frozenset()
        assert watch().due == math.inf

    @cases("keys", [{"signal": "skin"}, {"signal": "sink", "minus": "skin"}, {"signal": "sink", "setpoint": "skin"}])
    def test_a_signal_that_does_not_exist_is_refused(self, keys):
        with pytest.raises(ConfigurationError, match="no signal skin"):
            watch(Interlock(high=1.0, **keys))

    def test_it_says_lengths_in_the_unit_that_the_signal_is_shown_in(self):
        (finding,) = watch(Interlock(signal="tip", high=2e-5)).look(0.0, {"tip": 2.01e-5})
        assert finding.text == "interlock: tip = 20.1 µm is outside of ≤ 20 µm (for 0.0 s)"

    def test_one_of_level_safe_is_never_over(self):
        guard = watch(Interlock(signal="sink", high=60.0))
        assert looks(guard, [(0.0, 61.0), (1.0, 20.0), (2.0, 61.0)]) == [(0.0, "safe", False)]
        with pytest.raises(InterlockError, match="= 61 °C"):
            guard.check(3.0, {"sink": 20.0})

    def test_below_safe_check_returns_what_is_to_be_done(self):
        guard = watch(Interlock(signal="sink", high=60.0, level="warn"), Interlock(signal="force", high=1.0))
        (finding,) = guard.check(0.0, {"sink": 61.0, "force": 0.0})
        assert finding.level is Level.WARN
        assert finding.text == "interlock: sink = 61 °C is outside of ≤ 60 °C (for 0.0 s)"
        with pytest.raises(InterlockError, match="force"):
            guard.check(1.0, {"sink": 61.0, "force": 2.0})


class TestDue:
    @given(
        st.floats(0.0, 1e5), st.floats(0.001, 0.2), st.floats(0.0, 100.0), st.floats(0.1, 50.0), st.integers(0, 40)
    )
    def test_it_acts_within_a_period_and_its_seconds_after_the_crossing(self, crossing, phase, seconds, rate, late):
        """Looks at a rate of their own, and one when it is due."""
        guard = watch(Interlock(signal="sink", high=60.0, seconds=seconds))
        period = 1.0 / rate
        t = crossing - late * phase * period
        while True:
            if guard.look(t, {"sink": 61.0 if t >= crossing else 20.0}):
                break
            t = min(t + period, guard.due)
        assert crossing + seconds <= t + 1e-9
        assert t <= crossing + period + seconds + 1e-9

    def test_the_first_look_at_or_after_acts(self):
        guard = watch(Interlock(signal="sink", high=60.0, seconds=0.3))
        t = 0.1 + 0.2  # 0.30000000000000004
        guard.look(t, {"sink": 61.0})
        due = guard.due
        assert due == pytest.approx(0.6, abs=1e-12)
        assert guard.look(math.nextafter(due, 0.0), {"sink": 61.0}) == ()
        assert len(guard.look(due, {"sink": 61.0})) == 1
        assert guard.due == math.inf

    def test_a_hold_is_due_at_its_limit(self):
        guard = watch(Interlock(signal="sink", high=60.0, level="hold", hold_at_most=30.0))
        guard.look(10.0, {"sink": 61.0})
        assert guard.due == 40.0


class TestResume:
    @given(
        st.sampled_from([0.0, 0.5, 1.0, 2.5]),
        st.sampled_from([0.0, 1.0, 2.0]),
        st.lists(
            st.tuples(
                st.sampled_from([0.0, 0.25, 0.5, 1.0]),
                st.sampled_from([20.0, 40.0, 41.0, 50.0, 59.0, 60.0, 61.0, -5.0, math.nan]),
                st.sampled_from([25.0, 25.0, 25.0, 30.0, math.nan]),
            ),
            max_size=40,
        ),
    )
    def test_as_seen_from_the_whole_history(self, seconds, settle, course):
        interlock = Interlock(
            signal="sink",
            low=0.0,
            high=60.0,
            resume_low=40.0,
            resume_high=50.0,
            seconds=seconds,
            settle=settle,
            level="warn",
        )
        guard = watch(interlock)
        instants = [sum(dt for dt, _, _ in course[: k + 1]) for k in range(len(course))]
        values, setpoints = [each[1] for each in course], [each[2] for each in course]
        found = looks(guard, zip(instants, values, setpoints, strict=True))

        def since(k):
            """When it left the range for good, as seen at look k; None if it is inside."""
            first = None
            for t, value in zip(instants[: k + 1], values[: k + 1], strict=True):
                if 40.0 <= value <= 50.0 or (first is None and 0.0 <= value <= 60.0):
                    first = None
                elif first is None:
                    first = t
            return first

        def settling(k):
            pairs = pairwise(setpoints[: k + 1])
            changes = [instants[i] for i, (a, b) in enumerate(pairs, 1) if repr(a) != repr(b)]
            if not changes:
                return False
            begin = changes[-1]
            for before, after in reversed(list(pairwise(changes))):
                if after - before >= settle:
                    break
                begin = before
            return instants[k] < changes[-1] + settle and instants[k] < begin + 2 * settle

        expected, acted = [], False
        for k, t in enumerate(instants):
            outside = since(k)
            if acted and outside is None:
                acted = False
                expected.append((t, "warn", True))
            elif not acted and outside is not None and t - outside >= seconds and not settling(k):
                acted = True
                expected.append((t, "warn", False))
        assert found == expected


class TestLevels:
    def test_hold_until_it_is_back(self):
        guard = watch(Interlock(signal="sink", high=60.0, resume_high=58.0, seconds=1.0, level="hold"))
        for t, value, holding in [
            (0.0, 61.0, False),
            (1.0, 61.0, True),
            (2.0, 59.0, True),
            (3.0, 58.0, False),
            (4.0, 60.5, False),
        ]:
            guard.check(t, {"sink": value})
            assert [each.level for each in guard.active] == (["hold"] if holding else [])

    def test_a_hold_that_takes_too_long_ends_in_the_safe_state(self):
        guard = watch(Interlock(signal="sink", high=60.0, level="hold", hold_at_most=30.0))
        assert looks(guard, [(0.0, 20.0), (1.0, 61.0), (30.9, 61.0)]) == [(1.0, "hold", False)]
        (finding,) = guard.look(31.0, {"sink": 62.0})
        assert (finding.level, finding.since, finding.over) == (Level.SAFE, 1.0, False)
        assert finding.text == (
            "interlock: sink = 62 °C is outside of ≤ 60 °C (for 30.0 s); it was not back 30 s after"
        )
        with pytest.raises(InterlockError, match="not back 30 s after"):
            guard.check(32.0, {"sink": 20.0})

    def test_a_pause_is_asked_for_once_until_it_was_back(self):
        guard = watch(Interlock(signal="sink", high=60.0, level="pause"))
        course = [(0.0, 61.0), (1.0, 61.0), (2.0, 20.0), (3.0, 61.0)]
        assert looks(guard, course) == [(0.0, "pause", False), (2.0, "pause", True), (3.0, "pause", False)]

    def test_what_is_found_says_what_was_seen_since_when_and_what_is_allowed(self):
        guard = watch(Interlock(signal="force", low=-0.5, high=5.0, seconds=2.0, level="warn"))
        guard.look(10.0, {"force": 6.0})
        (begun,) = guard.look(12.5, {"force": 6.5})
        (ended,) = guard.look(20.0, {"force": 4.0})
        assert (begun.since, begun.value, begun.over) == (10.0, 6.5, False)
        assert begun.text == "interlock: force = 6.5 N is outside of -0.5 to 5 N (for 2.5 s)"
        assert (ended.since, ended.value, ended.over) == (10.0, 4.0, True)
        assert ended.text == "interlock: force = 4 N is back within -0.5 to 5 N (after 10.0 s)"


class TestSettle:
    def guard(self, **keys):
        return watch(Interlock(signal="sink", high=60.0, settle=10.0, **keys))

    def test_it_does_not_act_after_an_output_is_switched_on_or_a_setpoint_has_changed(self):
        course = [(0.0, 20.0, math.nan), (1.0, 61.0, 25.0), (10.9, 61.0, 25.0), (11.0, 61.0, 25.0)]
        assert looks(self.guard(), course) == [(11.0, "safe", False)]
        course = [(0.0, 20.0, 25.0), (1.0, 61.0, 30.0), (10.9, 61.0, 30.0), (11.0, 61.0, 30.0)]
        assert looks(self.guard(), course) == [(11.0, "safe", False)]

    @cases("setpoint", [25.0, math.nan])
    def test_without_a_change_it_acts_at_once(self, setpoint):
        assert looks(self.guard(), [(0.0, 20.0, setpoint), (20.0, 61.0, setpoint)]) == [(20.0, "safe", False)]

    def test_a_loop_that_changes_it_all_the_time_puts_it_off_for_twice_the_time_at_most(self):
        course = [(0.5 * k, 61.0 if k > 2 else 20.0, 25.0 + k) for k in range(100)]
        assert looks(self.guard(), course) == [(20.5, "safe", False)]

    def test_another_device_does_not_count(self):
        guard = self.guard(setpoint="supply")
        assert looks(guard, [(0.0, 20.0, 25.0), (1.0, 61.0, 30.0)]) == [(1.0, "safe", False)]

    def test_setpoints_are_among_the_values_of_a_tick(self):
        guard = self.guard()
        guard.check(0.0, {"sink": 20.0, "plate_setpoint": math.nan})
        guard.check(1.0, {"sink": 61.0, "plate_setpoint": 25.0})
        guard.check(10.9, {"sink": 61.0, "plate_setpoint": 25.0})
        with pytest.raises(InterlockError):
            guard.check(11.0, {"sink": 61.0, "plate_setpoint": 25.0})


class TestWarning:
    """The band before a limit, in which an interlock warns and does nothing else."""

    @staticmethod
    def course(guard, *values):
        return [
            [(each.early, each.level.value, each.over) for each in guard.look(float(t), {"sink": value})]
            for t, value in enumerate(values)
        ]

    def test_once_a_crossing_and_over_half_a_band_further_inside(self):
        guard = watch(Interlock(signal="sink", high=60.0, warn=0.05))
        begun, over, acts = (True, "warn", False), (True, "warn", True), (False, "safe", False)
        assert self.course(guard, 56.9, 57.1, 57.5, 56.9, 55.6, 55.4, 57.1, 61.0) == [
            [], [begun], [], [], [], [over], [begun], [acts],
        ]  # fmt: skip

    def test_the_text_names_the_limit_and_what_happens_there(self):
        guard = watch(Interlock(signal="sink", low=-20.0, level="pause", warn=0.1))
        (finding,) = guard.look(0.0, {"sink": -19.0})
        assert finding.text == "warning: sink = -19 °C is below -18 °C; the interlock acts at -20 °C (level pause)"
        (finding,) = guard.look(2.0, {"sink": 0.0})
        assert finding.text == "warning: sink = 0 °C is far from its interlock again (after 2.0 s)"

    def test_what_is_beyond_the_limit_for_a_while_was_warned_of_at_once(self):
        guard = watch(Interlock(signal="sink", high=60.0, seconds=3.0, warn=0.05))
        assert [[each.early for each in found] for found in (guard.look(t, {"sink": 70.0}) for t in range(4))] == [
            [True], [], [], [False],
        ]  # fmt: skip

    @cases("keys", [{"warn": 0.0}, {"level": "warn"}, {"high": 0.0}, {"low": 59.0, "warn": 0.2}])
    def test_none_where_there_is_no_room_or_no_wish(self, keys):
        guard = watch(Interlock(signal="sink", **{"high": 60.0, **keys}))
        top = keys.get("high", 60.0)
        assert self.course(guard, math.nextafter(top, -math.inf), top) == [[], []]

    @given(
        st.floats(-1e6, 1e6), st.floats(1e-3, 1e6), st.floats(0.0, 0.5), st.lists(st.floats(-2e6, 2e6), max_size=20)
    )
    def test_it_changes_nothing_of_what_acts(self, low, width, warn, values):
        interlock = Interlock(signal="sink", low=low, high=low + width, seconds=1.0, level="hold")
        plain, warned = (watch(interlock.model_copy(update={"warn": share})) for share in (0.0, warn))
        for t, value in enumerate(values):
            found = warned.look(float(t), {"sink": value})
            assert [each.text for each in found if not each.early] == [
                each.text for each in plain.look(float(t), {"sink": value})
            ]


class TestDifference:
    def test_of_two_signals(self):
        guard = watch(Interlock(signal="sink", minus="plate_setpoint", low=-3.0, high=3.0))
        assert guard.look(0.0, {"sink": 22.0}, {"plate": 20.0}) == ()
        (finding,) = guard.look(1.0, {"sink": 24.0, "plate_setpoint": 20.0})
        assert finding.text == "interlock: sink - plate_setpoint = 4 K is outside of -3 to 3 K (for 0.0 s)"

    def test_of_an_output_that_is_off_it_is_left_alone_and_begins_anew(self):
        guard = watch(Interlock(signal="sink", minus="plate_setpoint", high=3.0, seconds=2.0, level="warn"))
        course = [(0.0, 30.0, 20.0), (1.0, 30.0, math.nan), (2.0, 30.0, 20.0), (3.9, 30.0, 20.0), (4.0, 30.0, 20.0)]
        assert looks(guard, course) == [(4.0, "warn", False)]

    def test_one_alone_is_no_difference(self):
        guard = watch(Interlock(signal="sink", minus="force", high=3.0))
        assert guard.look(0.0, {"sink": 30.0}) == ()
        assert guard.look(1.0, {"force": 30.0}) == ()
        assert len(guard.look(2.0, {"sink": 30.0, "force": math.nan})) == 1


class TestRate:
    def test_faster_than_allowed_in_either_direction(self):
        for sign in (1.0, -1.0):
            guard = watch(Interlock(signal="sink", fastest=2.0, over=1.0))
            course = [(0.25 * k, 20.0 + sign * 2.0 * 0.25 * k) for k in range(20)]
            assert looks(guard, course) == []
            (finding,) = guard.look(5.0, {"sink": 20.0 + sign * 11.0})
            assert finding.text == (
                f"interlock: sink changes by {sign * 3:g} K/s over 1 s; 2 K/s is allowed (for 0.0 s)"
            )

    def test_nan_is_outside(self):
        assert looks(watch(Interlock(signal="sink", fastest=2.0)), [(0.0, math.nan)]) == [(0.0, "safe", False)]

    def test_a_single_wrong_reading_is_shorter_than_its_seconds(self):
        course = [(0.2 * k, 90.0 if k == 20 else 20.0) for k in range(100)]
        assert looks(watch(Interlock(signal="sink", fastest=2.0, over=2.0, seconds=0.5)), course) == []
        assert looks(watch(Interlock(signal="sink", fastest=2.0, over=2.0)), course) == [(4.0, "safe", False)]

    @given(
        st.sampled_from([0.25, 1.0, 2.0]),
        st.lists(st.tuples(st.sampled_from([0.25, 0.5, 3.0]), st.integers(-4, 4)), max_size=40),
    )
    def test_as_seen_from_the_whole_history(self, over, course):
        guard = watch(Interlock(signal="sink", fastest=1.0, over=over, level="warn"))
        instants = [sum(dt for dt, _ in course[: k + 1]) for k in range(len(course))]
        values = [float(value) for _, value in course]
        expected, outside = [], False
        for k, t in enumerate(instants):
            old = [j for j in range(k) if t - instants[j] >= over]
            if not old:
                continue
            fast = abs(values[k] - values[old[-1]]) > 1.0 * (t - instants[old[-1]])
            if fast != outside:
                outside = fast
                expected.append((t, "warn", not fast))
        assert looks(guard, zip(instants, values, strict=True)) == expected


class TestStale:
    def test_readings_equal_to_the_last_bit(self):
        value = 21.3
        guard = watch(Interlock(signal="sink", stale=60.0))
        course = [(0.0, 20.0), *((1.0 + 0.5 * k, value) for k in range(119))]
        assert looks(guard, course) == []
        (finding,) = guard.look(61.0, {"sink": value})
        assert finding.since == 1.0
        assert finding.text == (
            "interlock: sink = 21.3 °C stands still: all readings of the last 60.0 s are equal to the last bit; "
            "60 s is allowed"
        )

    def test_the_last_bit_counts(self):
        course = [(float(k), math.nextafter(21.3, 22.0) if k % 50 == 49 else 21.3) for k in range(500)]
        assert looks(watch(Interlock(signal="sink", stale=60.0)), course) == []
        zeros = [(float(k), -0.0 if k % 50 == 49 else 0.0) for k in range(500)]
        assert looks(watch(Interlock(signal="sink", stale=60.0)), zeros) == []

    @given(st.lists(st.tuples(st.sampled_from([0.5, 1.0, 2.5]), st.sampled_from([1.0, 1.0, 1.0, 2.0])), max_size=40))
    def test_as_seen_from_the_whole_history(self, course):
        instants = [sum(dt for dt, _ in course[: k + 1]) for k in range(len(course))]
        values = [value for _, value in course]
        expected, acted = [], False
        for k, t in enumerate(instants):
            first = next(j for j in range(k + 1) if len(set(values[j : k + 1])) == 1)
            stale = first < k and t - instants[first] >= 3.0
            if stale != acted:
                acted = stale
                expected.append((t, "warn", not stale))
        guard = watch(Interlock(signal="sink", stale=3.0, level="warn"))
        assert looks(guard, zip(instants, values, strict=True)) == expected


class TestStuck:
    def guard(self, **keys):
        stuck = {"moved": 5.0, "follows": 1.0, "within": 10.0}
        return watch(Interlock(signal="sink", setpoint="plate", stuck=stuck, **keys))

    def test_a_signal_that_does_not_follow(self):
        guard = self.guard()
        course = [(0.0, 20.0, math.nan), (1.0, 20.0, 20.0), (2.0, 20.1, 30.0), (11.9, 20.9, 30.0)]
        assert looks(guard, course) == []
        (finding,) = guard.look(12.0, {"sink": 20.9}, {"plate": 30.0})
        assert finding.since == 2.0
        assert finding.text == (
            "interlock: sink = 20.9 °C is stuck: 10.0 s after plate was set to 30 °C it has moved by 0.9 K; "
            "at least 1 K is expected within 10 s"
        )

    def test_one_that_follows_late_enough(self):
        course = [(0.0, 20.0, 20.0), (2.0, 20.0, 30.0), (11.0, 21.0, 30.0), (40.0, 21.0, 30.0)]
        assert looks(self.guard(), course) == []

    @given(st.lists(st.tuples(st.sampled_from([0.5, 2.0, 30.0]), st.floats(-50.0, 50.0)), max_size=40))
    def test_a_signal_that_follows_never_acts(self, course):
        t, guard = 0.0, self.guard()
        for dt, setpoint in course:
            t += dt
            assert guard.look(t, {"sink": setpoint}, {"plate": setpoint}) == ()

    @given(
        st.lists(
            st.tuples(st.sampled_from([0.5, 1.0, 4.0]), st.sampled_from([20.0, 20.0, 24.0, 25.0, 30.0, 30.0, 14.0])),
            max_size=40,
        )
    )
    def test_a_dead_signal_acts_once_the_setpoint_was_away_to_one_side_for_the_time(self, course):
        instants = [sum(dt for dt, _ in course[: k + 1]) for k in range(len(course))]
        setpoints = [setpoint for _, setpoint in course]
        sides = [0 if abs(each - setpoints[0]) < 5.0 else math.copysign(1, each - setpoints[0]) for each in setpoints]
        expected, acted = [], False
        for k, t in enumerate(instants):
            first = next(j for j in range(k + 1) if len(set(sides[j : k + 1])) == 1)
            if acted and not sides[k]:
                acted = False
                expected.append((t, "warn", True))
            elif not acted and sides[k] and t - instants[first] >= 10.0:
                acted = True
                expected.append((t, "warn", False))
        course = zip(instants, [20.0] * len(instants), setpoints, strict=True)
        assert looks(self.guard(level="warn"), course) == expected
