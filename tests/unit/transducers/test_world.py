import math
import threading

import pytest
from hypothesis import given, strategies as st

from bench.base import VirtualClock
from sim_devices.world import World


class Plant:
    """Remembers how it was advanced."""

    def __init__(self):
        self.steps = []

    @property
    def time(self):
        return math.fsum(self.steps)

    def advance(self, dt):
        assert dt > 0
        self.steps.append(dt)


class Alarm:
    """Goes off at its times, and notes when the plant really stood there."""

    def __init__(self, world, log, name, times, then=None):
        self.world, self.log, self.name = world, log, name
        self.times = list(times)
        self.then = then
        world.add(self)

    def deadline(self):
        return self.times[0] if self.times else math.inf

    def expire(self):
        due = self.times.pop(0)
        self.log.append((self.name, due, self.world.time, self.world._plant.time))
        if self.then is not None:
            self.then(self)


@pytest.fixture
def world():
    return World(Plant(), VirtualClock())


def at(world, instant):
    world.clock.sleep_until(instant)
    world.advance()


class TestPlant:
    def test_stands_at_the_clock(self, world):
        for instant in (0.5, 0.5, 3.0):
            at(world, instant)
            assert world.time == instant
        assert world._plant.steps == [0.5, 2.5]

    def test_begins_where_the_clock_stands(self):
        clock = VirtualClock()
        clock.sleep(100.0)
        world = World(Plant(), clock)
        assert world.time == 100.0
        at(world, 101.0)
        assert world._plant.steps == [1.0]

    def test_the_clock_of_the_world_is_exact_after_many_steps(self, world):
        for tick in range(1, 100_001):
            world.clock.sleep_until(tick * 0.1)
            world.advance()
        assert world.time == 10_000.0
        assert world._plant.time == pytest.approx(10_000.0, abs=1e-6)


class TestDeadlines:
    def test_happen_at_their_own_instants_and_in_order(self, world):
        log = []
        Alarm(world, log, "a", [1.0, 4.0])
        Alarm(world, log, "b", [2.5, 3.0, 9.0])
        at(world, 5.0)
        assert [(name, due) for name, due, *_ in log] == [("a", 1.0), ("b", 2.5), ("b", 3.0), ("a", 4.0)]
        assert all(due == time == plant for _, due, time, plant in log)
        assert world.time == 5.0

    def test_at_one_instant_the_one_added_first_comes_first(self, world):
        log = []
        for name in "abc":
            Alarm(world, log, name, [1.0])
        at(world, 2.0)
        assert [entry[0] for entry in log] == ["a", "b", "c"]

    def test_one_that_comes_closer_is_kept_where_it_is_announced(self, world):
        log = []

        class Announcing(Alarm):
            asked = 0

            def deadline(self):
                self.asked += 1
                return super().deadline()

        announced = []
        add, world.add = world.add, lambda timed: announced.append(add(timed, announces=True))
        alarm = Announcing(world, log, "a", [8.0])
        at(world, 1.0)
        asked = alarm.asked
        for tick in range(100):
            at(world, 1.0 + 0.01 * tick)
        assert alarm.asked == asked
        alarm.times.insert(0, 3.0)
        (announce,) = announced
        announce(3.0)
        at(world, 5.0)
        assert [(name, due, time) for name, due, time, _ in log] == [("a", 3.0, 3.0)]
        at(world, 9.0)
        assert [due for _, due, *_ in log] == [3.0, 8.0]

    def test_a_deadline_of_the_past_happens_now(self, world):
        at(world, 10.0)
        log = []
        Alarm(world, log, "late", [3.0])
        world.advance()
        assert log == [("late", 3.0, 10.0, 10.0)]

    def test_one_that_sets_another(self, world):
        log = []
        second = Alarm(world, log, "second", [])
        Alarm(world, log, "first", [1.0], then=lambda _: second.times.append(1.5))
        at(world, 4.0)
        assert [(name, time) for name, _, time, _ in log] == [("first", 1.0), ("second", 1.5)]

    def test_nested_requests_see_the_instant_and_not_the_end(self, world):
        # As an instrument that reads another of its own parameters while it trips.
        log = []

        def ask(alarm):
            alarm.world.advance()
            log.append(("asked", alarm.world.time))

        Alarm(world, log, "a", [1.0, 2.0], then=ask)
        at(world, 5.0)
        assert [entry[0] for entry in log] == ["a", "asked", "a", "asked"]
        assert [entry[1] for entry in log] == [1.0, 1.0, 2.0, 2.0]
        assert world.time == 5.0

    @given(
        st.lists(st.lists(st.floats(0.01, 100.0), max_size=6).map(sorted), min_size=1, max_size=4),
        st.lists(st.floats(0.01, 120.0), min_size=1, max_size=5).map(sorted),
    )
    def test_however_the_time_is_split(self, alarms, instants):
        world, log = World(Plant(), VirtualClock()), []
        for i, times in enumerate(alarms):
            Alarm(world, log, i, times)
        for instant in instants:
            at(world, instant)
        expected = sorted(due for times in alarms for due in times if due <= instants[-1])
        assert [due for _, due, *_ in log] == expected
        assert all(due == time for _, due, time, _ in log)
        assert world.time == instants[-1]


def test_threads_take_turns():
    world, log = World(Plant(), VirtualClock()), []
    Alarm(world, log, "a", [0.001 * k for k in range(1, 2001)])
    ready = threading.Barrier(4)

    def ask():
        ready.wait()
        for _ in range(500):
            world.advance()

    threads = [threading.Thread(target=ask) for _ in range(3)]
    for thread in threads:
        thread.start()
    ready.wait()
    for k in range(1, 201):
        world.clock.sleep_until(0.01 * k)
    for thread in threads:
        thread.join()
    world.advance()
    assert [due for _, due, *_ in log] == [0.001 * k for k in range(1, 2001)]
    assert all(due == time for _, due, time, _ in log)
