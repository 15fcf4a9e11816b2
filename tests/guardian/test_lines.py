"""Threads of lines: who goes first, who waits for nobody, and what is dropped at the end."""

import queue
import threading
from itertools import count

import pytest
from cases import cases

from bench.base import DeviceConnectionError, DeviceRestartedError, VirtualClock, WallClock
from bench.devices import Device
from bench.execution.guardian.lines import BENCH, LOOK, SAFE, LineThreads

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
            self.devices, lines, clock or VirtualClock(), lambda _: longest, lambda *news: self.news.append(news)
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


def test_the_devices_of_a_lost_line_are_not_waited_for_one_after_another():
    devices = {"a": Instrument("a", attempts=1000), "b": Instrument("b", attempts=1000), "c": Instrument("c")}
    bench = Bench({"a": "line", "b": "line", "c": "other"}, longest=1.0, devices=devices)
    for name in ("a", "b", "c"):
        bench.submit(BENCH, name, devices[name].measure)
    said = {result.device: result for result in (bench.result() for _ in devices)}
    assert str(said["b"].error).startswith("b: was not asked, as its line is lost (a: does not answer; ")
    assert (devices["a"].tried, devices["b"].tried) == (6, 0)
    assert said["c"].value == {"c": 1.0}
    # The safe state opens a line of its own.
    devices["b"].attempts = 0
    bench.submit(SAFE, "b", devices["b"].measure)
    assert bench.result().value == {"b": 1.0}


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
