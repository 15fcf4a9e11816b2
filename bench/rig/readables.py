"""Single signals of a rig as bluesky reads devices: set-points, and signals that are computed from others."""

from __future__ import annotations

from collections.abc import Callable

from bench.base import Clock
from bench.devices import BlueskyReading, DataKey, Signal, Status


class ReadableSignal:
    """One signal that no device measures by itself; conforms to `bluesky.protocols.Readable` and `Triggerable`.

    Parameters
    ----------
    signal : Signal
        What it is; its name is that of the readable.
    clock : Clock
        The clock of the rig.
    take : callable
        Returns the value, in the unit of the signal; raises what the devices raise.
    source : str
        Where it comes from, for the description.
    """

    def __init__(self, signal: Signal, clock: Clock, take: Callable[[], float], source: str) -> None:
        self._signal = signal
        self._clock = clock
        self._take = take
        self._source = source

    @property
    def name(self) -> str:
        """Name of the signal."""
        return self._signal.name

    @property
    def parent(self) -> None:
        """Always None: devices of the bench are not nested (bluesky asks)."""
        return

    @property
    def hints(self) -> dict[str, list[str]]:
        """What a live table shows of it (bluesky asks)."""
        return {"fields": [self.name]}

    def read(self) -> dict[str, BlueskyReading]:
        """Take the value, with its time stamp."""
        value = self._take()
        return {self.name: {"value": value, "timestamp": self._clock.timestamp()}}

    def trigger(self) -> Status:
        """Return a completed status: `read` takes the value by itself (bluesky asks)."""
        return Status.completed(self.name, self._clock)

    def describe(self) -> dict[str, DataKey]:
        """Describe what `read` returns."""
        signal = self._signal
        return {
            signal.name: {
                "source": self._source,
                "dtype": "number",
                "shape": [],
                "units": signal.unit,
                "precision": signal.precision,
            }
        }
