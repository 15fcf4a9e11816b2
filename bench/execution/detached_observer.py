"""An observer that is notified in a thread of its own, as a terminal that is stuck must not hold up a run."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Protocol, Self

from bench.execution.run_at_hand import Observer
from bench.record import Event, StepRecord

_INTERVAL = 0.1
"""Wall-clock time between two notifications, s."""

_MOST = 10_000
"""Steps and events that wait for an observer that hangs; the journal has them all."""

_END = 2.0
"""Longest wait for an observer at the end, s of wall-clock time."""


class _ObserverInContext(Observer, AbstractContextManager["_ObserverInContext"], Protocol):
    pass


class DetachedObserver:
    """Passes on to another observer, ten times a second, all steps and events and the newest tick.

    Use it as a context manager; the thread enters and leaves the context of the observer. At the end what waits is
    passed on for 2 s at most. What the observer raises is raised at the next notification.

    Parameters
    ----------
    observer : Observer
        It is called from one thread only.
    """

    def __init__(self, observer: _ObserverInContext) -> None:
        self._observer = observer
        self._tick: tuple[float, int, Sequence[float]] | None = None
        self._happened: deque[StepRecord | Event] = deque(maxlen=_MOST)
        self._failure: Exception | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._work, name=type(observer).__name__, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join(_END)

    def telemetry(self, t: float, step: int, values: Sequence[float]) -> None:
        """Note a tick."""
        self._tick = t, step, values
        self._raise_failure()

    def step(self, record: StepRecord) -> None:
        """Note a finished step."""
        self._happened.append(record)
        self._raise_failure()

    def event(self, event: Event) -> None:
        """Note that something happened."""
        self._happened.append(event)
        self._raise_failure()

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _work(self) -> None:
        try:
            with self._observer:
                over = False
                while not over:
                    over = self._over.wait(_INTERVAL)
                    self._pass_on()
        # Raised in the run's own thread.
        except Exception as error:
            self._failure = error

    def _pass_on(self) -> None:
        # First of all, so that the steps before the tick are passed on before it.
        tick, self._tick = self._tick, None
        while self._happened:
            each = self._happened.popleft()
            if isinstance(each, StepRecord):
                self._observer.step(each)
            else:
                self._observer.event(each)
        if tick is not None:
            self._observer.telemetry(*tick)
