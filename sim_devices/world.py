"""One emulated laboratory's time: a plant and the instruments around it, brought up to the clock together.

There are no threads. Every request to an emulated instrument first calls `World.advance`, which integrates
the plant from where it was to the clock's time. What the instruments do by themselves, such as a watchdog
that expires, happens at its own instant in between.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Protocol

from bench.base import Clock


class Plant(Protocol):
    """Physics only: a state and its way through time."""

    def advance(self, dt: float) -> None:
        """Integrate over `dt` seconds, from microseconds to hours; the split must not matter."""


class Timed(Protocol):
    """An instrument that does something by itself at a time of its own."""

    def deadline(self) -> float:
        """Return the laboratory time (s) at which something is due; infinity when nothing is."""

    def expire(self) -> None:
        """Do what is due; the plant stands at that instant. `deadline` must move on."""


class World:
    """A plant, the clock, and the instruments with deadlines.

    Parameters
    ----------
    plant : Plant
        The physics that the instruments look at and act on.

    Attributes
    ----------
    lock : threading.RLock
        Held by a wire server for the whole of a request, as servers of TCP ports have threads.
    time : float
        Laboratory time (s) at which plant and instruments stand; read it only.
    """

    def __init__(self, plant: Plant, clock: Clock) -> None:
        self.clock = clock
        self.lock = threading.RLock()
        self._plant = plant
        self.time = clock.now()
        self._now = clock.now
        self._timed: list[Timed] = []
        self._dues: list[float] = []
        """Of each, an instant that its deadline is not before, as far as it announces it."""
        self._asked: list[tuple[int, Callable[[], float]]] = []
        """Numbers and deadlines of those that do not."""
        self._soonest = -math.inf
        """No announced deadline is before; it may be earlier than the next of them."""
        self._late: list[Callable[[], None]] = []
        self._advancing = False

    def add(
        self, timed: Timed, *, announces: bool = False, catch_up: Callable[[], None] | None = None
    ) -> Callable[[float], None]:
        """Keep the deadlines of an instrument; return what it calls with its deadline (s) to announce it.

        Parameters
        ----------
        announces : bool
            Whether it does so whenever its deadline comes closer, so that it need not be asked all the time.
        catch_up : callable, optional
            Does what it has put off, before anybody interferes.
        """
        number = len(self._timed)
        self._timed.append(timed)
        self._dues.append(-math.inf)
        if not announces:
            self._asked.append((number, timed.deadline))
        self._soonest = -math.inf
        if catch_up is not None:
            self._late.append(catch_up)
        return partial(self._note, number)

    def _note(self, number: int, instant: float) -> None:
        if instant < self._dues[number]:
            self._dues[number] = instant
        if instant < self._soonest:
            self._soonest = instant

    @contextmanager
    def at_present(self) -> Iterator[None]:
        """Hold the lock, with plant and instruments at the clock's present time."""
        with self.lock:
            self.catch_up()
            yield

    def catch_up(self) -> None:
        """Bring the plant and everything to the clock's present time, also what instruments have put off.

        A request needs `advance` only; this is for what changes plant, sensors or instruments from without.
        """
        with self.lock:
            self.advance_locked()
            for catch_up in self._late:
                catch_up()

    def advance(self) -> None:
        """Bring the plant and everything due to the clock's present time."""
        with self.lock:
            self.advance_locked()

    def advance_locked(self) -> None:
        """Bring the plant and everything due to the clock's present time; the caller holds the lock."""
        # A request from within `expire` sees that instant, not the end.
        if self._advancing:
            return
        target = self._now()
        # Mostly nothing is due, and a fast loop asks several times for each sample.
        if target < self._soonest:
            for _, deadline in self._asked:
                if deadline() <= target:
                    break
            else:
                before = self.time
                if target > before:
                    self._plant.advance(target - before)
                    self.time = target
                return
        self._advancing = True
        try:
            self._advance_to(target)
        finally:
            self._advancing = False

    def _advance_to(self, target: float) -> None:
        dues = self._dues
        while True:
            for number, deadline in self._asked:
                dues[number] = deadline()
            due = min(dues, default=math.inf)
            if due > target:
                self._soonest = due
                break
            first = dues.index(due)
            timed = self._timed[first]
            # It may have been put off since it was announced.
            if (instant := timed.deadline()) != due:
                dues[first] = instant
                continue
            if due > self.time:
                self._plant.advance(due - self.time)
                self.time = due
            timed.expire()
            dues[first] = timed.deadline()
        if target > self.time:
            self._plant.advance(target - self.time)
            self.time = target
