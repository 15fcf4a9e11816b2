"""One emulated laboratory's time: a plant and the instruments around it, brought up to the clock together.

There are no threads. Every request to an emulated instrument first calls `World.advance`, which integrates
the plant from where it was to the clock's time. What the instruments do by themselves, such as a watchdog
that expires, happens at its own instant in between.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
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
        self.time = clock.now()
        self._plant = plant
        self._timed: list[Timed] = []
        self._advancing = False

    def add(self, timed: Timed) -> None:
        """Keep the deadlines of an instrument."""
        self._timed.append(timed)

    @contextmanager
    def at_present(self) -> Iterator[None]:
        """Hold the lock, with plant and instruments at the clock's present time."""
        with self.lock:
            self.advance()
            yield

    def advance(self) -> None:
        """Bring the plant and everything due to the clock's present time."""
        with self.lock:
            # A request from within `expire` sees that instant, not the end.
            if self._advancing:
                return
            self._advancing = True
            try:
                self._advance_to(self.clock.now())
            finally:
                self._advancing = False

    def _advance_to(self, target: float) -> None:
        while self._timed:
            deadlines = [timed.deadline() for timed in self._timed]
            due = min(deadlines)
            if due > target:
                break
            self._move_to(due)
            self._timed[deadlines.index(due)].expire()
        self._move_to(target)

    def _move_to(self, instant: float) -> None:
        if instant > self.time:
            self._plant.advance(instant - self.time)
            self.time = instant
