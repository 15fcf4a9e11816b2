"""What a laboratory does at given instants, in the order of time."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable


class Calendar:
    """Actions at their instants (s of laboratory time); a `sim_devices.world.Timed`."""

    def __init__(self) -> None:
        self._entries: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = itertools.count()

    def add(self, instant: float, act: Callable[[], None]) -> Callable[[], None]:
        """Enter an action; return what takes it out again, which does nothing once it is done."""
        entry = (instant, next(self._numbers), act)
        heapq.heappush(self._entries, entry)

        def take_out() -> None:
            if entry in self._entries:
                self._entries.remove(entry)
                heapq.heapify(self._entries)

        return take_out

    def deadline(self) -> float:
        """Return the instant of the next action, s; infinity if there is none."""
        return self._entries[0][0] if self._entries else math.inf

    def expire(self) -> None:
        """Carry the next action out."""
        _, _, act = heapq.heappop(self._entries)
        act()
