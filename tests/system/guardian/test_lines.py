"""Threads of lines: who goes first, who waits for nobody, and what is dropped at the end."""

import queue
import threading
from itertools import count

import pytest
from cases import cases

from bench.base import DeviceConnectionError, DeviceRestartedError, VirtualClock, WallClock
from bench.devices import Device
from bench.execution.guardian.lines import BENCH, LOOK, SAFE, LineThreads
from bench.rig import LongestAbsence

LONG = 60.0
"""Wall-clock time that a busy machine may take, s."""


class Instrument(Device):
    """One whose line can be away."""

    identity = signals = None
    watchdog = None

    def __init__(self, name, attempts=0, problem=None):
        super().__init__(name, VirtualClock())
        self.attempts = attempts
        self.problem = problem
        self.tried = 0
        self.on_attempt = lambda: None

    def measure(self):
        if self.attempts > 0:
            raise DeviceConnectionError(self.name, "does not answer")
        return {self.name: 1.0}

    def reconnect(self):
        self.tried += 1
        self.on_attempt()
        self.attempts -= 1
        if self.attempts > 0:
            raise DeviceConnectionError(self.name, "still away")
        if self.problem is not None:
            raise self.problem

    def safe(self):
        pass

    def close(self):
        pass


class Bench:
    def __init__(self, lines, longest=10.0, devices=None, clock=None):
        self.devices = devices or {name: Instrument(name) for name in lines}
        self.results = queue.SimpleQueue()
        self.news = []
        self.threads = LineThreads(
            self.devices,
            lines,
            clock or VirtualClock(),
            lambda _: LongestAbsence(longest),
            lambda *news: self.news.append(news),
        )

    def submit(self, priority, device, call):
        self.threads.submit(priority, device, call, self.results.put)

    def result(self):
        return self.results.get(timeout=LONG)


@pytest.fixture
def gate():
    """An event that lets calls go on; set at the end in any case."""
    event = threading.Event()
    yield event
    event.set()


def test_what_is_urgent_goes_first_and_the_rest_in_order(gate):
    bench = Bench({"a": "line"})
    started = threading.Event()
    bench.submit(BENCH, "a", lambda: (started.set(), gate.wait(LONG)))
    assert started.wait(LONG)
    for priority, name in [(LOOK, "look"), (BENCH, "first"), (BENCH, "second"), (SAFE, "safe")]:
        bench.submit(priority, "a", lambda name=name: name)
    gate.set()
    assert [bench.result().value for _ in range(5)][1:] == ["safe", "first", "second", "look"]


def test_a_line_that_hangs_delays_no_other(gate):
    bench = Bench({"a": "stuck", "b": "free"})
    bench.submit(BENCH, "a", lambda: gate.wait(LONG))
    for _ in range(100):
        bench.submit(BENCH, "b", lambda: "answer")
        assert bench.result().device == "b"


def test_devices_on_one_line_are_asked_one_after_another():
    bench = Bench({"a": "line", "b": "line"})
    inside, most, numbers = [], [], count()

    def call():
        inside.append(next(numbers))
        most.append(len(inside))
        inside.pop()

    for _ in range(200):
        bench.submit(BENCH, "a", call)
        bench.submit(BENCH, "b", call)
    for _ in range(400):
        assert bench.result().error is None
    assert max(most) == 1


@cases("error", [ValueError("x"), KeyboardInterrupt(), SystemExit(1), GeneratorExit()])
def test_an_error_of_any_kind_is_the_answer_and_the_thread_goes_on(error):
    bench = Bench({"a": "line"})

    def fail():
        raise error

    bench.submit(BENCH, "a", fail)
    assert bench.result().error is error
    bench.submit(BENCH, "a", lambda: 3)
    assert bench.result().value == 3


def test_the_end_drops_what_waits_but_for_the_safe_state(gate):
    bench = Bench({"a": "line"})
    started = threading.Event()
    sent = []
    bench.submit(BENCH, "a", lambda: (started.set(), gate.wait(LONG)))
    assert started.wait(LONG)
    bench.submit(BENCH, "a", lambda: sent.append("set-point"))
    bench.submit(SAFE, "a", lambda: sent.append("off"))
    bench.threads.end()
    gate.set()
    results = [bench.result() for _ in range(3)]
    assert sent == ["off"]
    assert isinstance(results[2].error, DeviceConnectionError)
    assert "the run has ended" in str(results[2].error)


def test_a_line_that_comes_back_answers_and_is_news():
    bench = Bench({"a": "line"}, devices={"a": Instrument("a", attempts=5)})
    bench.submit(BENCH, "a", bench.devices["a"].measure)
    assert bench.result().value == {"a": 1.0}
    ((name, seconds, why),) = bench.news
    assert (name, why) == ("a", "a: does not answer")
    assert seconds == pytest.approx(0.8)


def test_a_line_that_stays_away_is_given_up():
    bench = Bench({"a": "line"}, longest=1.0, devices={"a": Instrument("a", attempts=1000)})
    bench.submit(BENCH, "a", bench.devices["a"].measure)
    assert str(bench.result().error) == "a: does not answer; it was not back within 1 s"
    assert bench.devices["a"].tried == 6
    assert bench.news == []


def test_a_line_is_away_from_when_the_request_began_that_waited_for_it_in_vain():
    clock = VirtualClock()
    device = Instrument("a", attempts=1000)
    bench = Bench({"a": "line"}, longest=3.0, devices={"a": device}, clock=clock)

    def wait_in_vain():
        clock.sleep(2.0)
        return device.measure()

    bench.submit(BENCH, "a", wait_in_vain)
    assert "was not back within 3 s" in str(bench.result().error)
    assert clock.now() == pytest.approx(3.0, abs=0.3)


def test_the_devices_of_a_lost_line_are_waited_for_at_the_same_time():
    clock = VirtualClock()
    devices = {name: Instrument(name, attempts=1000) for name in ("a", "b")} | {"c": Instrument("c")}
    for device in devices.values():
        device.on_attempt = lambda: clock.sleep(0.3)
    bench = Bench({"a": "line", "b": "line", "c": "other"}, longest=3.0, devices=devices, clock=clock)
    for name in devices:
        bench.submit(BENCH, name, devices[name].measure)
    said = {result.device: result for result in (bench.result() for _ in devices)}
    for name in ("a", "b"):
        assert str(said[name].error) == f"{name}: does not answer; it was not back within 3 s"
    assert abs(devices["a"].tried - devices["b"].tried) <= 1
    assert clock.now() < 2 * 3.0
    assert said["c"].value == {"c": 1.0}
    # Those that were given up are not waited for again, but for the safe state, which opens a line of its own.
    devices["b"].attempts = 0
    bench.submit(BENCH, "b", devices["b"].measure)
    assert "not asked" in str(bench.result().error)
    bench.submit(SAFE, "b", devices["b"].measure)
    assert bench.result().value == {"b": 1.0}


def test_a_device_that_is_away_delays_its_neighbours_by_one_attempt():
    clock = VirtualClock()
    devices = {"a": Instrument("a", attempts=20), "b": Instrument("b")}
    bench = Bench({"a": "line", "b": "line"}, longest=60.0, devices=devices, clock=clock)

    def attempt():
        bench.submit(LOOK, "b", lambda: devices["a"].tried)
        clock.sleep(0.7)

    devices["a"].on_attempt = attempt
    bench.submit(BENCH, "a", devices["a"].measure)
    bench.submit(BENCH, "a", lambda: "waited")
    found = [bench.result() for _ in range(20 + 2)]
    # After each attempt the neighbour was looked at, before the next one.
    assert [each.value for each in found if each.device == "b"] == [*range(1, 21)]
    assert [(each.value, each.was_away) for each in found if each.device == "a"] == [
        ({"a": 1.0}, True),
        ("waited", True),
    ]
    assert bench.threads.late["b"] == pytest.approx(0.7)
    ((name, seconds, _),) = bench.news
    assert name == "a"
    assert seconds == pytest.approx(20 * 0.7 + 19 * 0.2, abs=0.5)


def test_a_neighbour_that_has_waited_for_a_request_in_vain_is_asked_before_the_first_attempt():
    devices = {"a": Instrument("a", attempts=3), "b": Instrument("b")}
    bench = Bench({"a": "line", "b": "line"}, longest=60.0, devices=devices)

    def miss():
        if not devices["a"].tried:
            bench.submit(LOOK, "b", lambda: devices["a"].tried)
        return devices["a"].measure()

    bench.submit(BENCH, "a", miss)
    assert [bench.result().value for _ in range(2)] == [0, {"a": 1.0}]


def test_the_safe_state_of_a_neighbour_and_of_a_device_that_is_away_come_at_once():
    devices = {"a": Instrument("a", attempts=10**9), "b": Instrument("b")}
    bench = Bench({"a": "line", "b": "line"}, longest=1e9, devices=devices)
    bench.submit(BENCH, "a", devices["a"].measure)
    for name in devices:
        bench.submit(SAFE, name, devices[name].safe)
        assert (bench.result().device, bench.news) == (name, [])
    bench.threads.end()
    assert isinstance(bench.result().error, DeviceConnectionError)


def test_those_that_answer_are_made_safe_before_one_that_is_away(gate):
    devices = {"a": Instrument("a", attempts=10**9), "b": Instrument("b")}
    bench = Bench({"a": "line", "b": "line"}, longest=1e9, devices=devices)
    bench.submit(BENCH, "a", devices["a"].measure)
    # The line of both is busy once "a" is known to be away.
    started = threading.Event()
    devices["a"].on_attempt = lambda: (started.set(), gate.wait(LONG))
    assert started.wait(LONG)
    for name in devices:
        bench.submit(SAFE, name, devices[name].safe)
    bench.threads.end()
    gate.set()
    assert [result.device for result in (bench.result() for _ in range(3)) if result.error is None] == ["b", "a"]


def test_another_instrument_or_a_restart_is_not_tried_again():
    restarted = DeviceRestartedError("a", "has restarted")
    bench = Bench({"a": "line"}, devices={"a": Instrument("a", attempts=1, problem=restarted)})
    bench.submit(BENCH, "a", bench.devices["a"].measure)
    assert bench.result().error is restarted
    assert bench.devices["a"].tried == 1


def test_the_safe_state_waits_for_no_line():
    bench = Bench({"a": "line"}, devices={"a": Instrument("a", attempts=1000)})
    bench.submit(SAFE, "a", bench.devices["a"].measure)
    assert isinstance(bench.result().error, DeviceConnectionError)
    assert bench.devices["a"].tried == 0


def test_a_line_that_is_waited_for_is_given_up_at_the_end():
    bench = Bench({"a": "line"}, longest=1e6, devices={"a": Instrument("a", attempts=10**9)}, clock=WallClock())
    bench.devices["a"].on_attempt = bench.threads.end
    bench.submit(BENCH, "a", bench.devices["a"].measure)
    assert isinstance(bench.result().error, DeviceConnectionError)


def test_a_setpoint_that_waited_for_its_line_is_not_sent_after_the_end():
    device = Instrument("a", attempts=2)
    bench = Bench({"a": "line"}, devices={"a": device})
    sent = []

    def set_point():
        device.measure()
        sent.append("on")

    # The end comes in the very attempt that succeeds.
    device.on_attempt = lambda: bench.threads.end() if device.tried == 2 else None
    bench.submit(BENCH, "a", set_point)
    assert isinstance(bench.result().error, DeviceConnectionError)
    assert sent == []
