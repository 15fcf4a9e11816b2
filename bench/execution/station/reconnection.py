"""A line that is lost is opened again, for as long as the rig file allows."""

from __future__ import annotations

from bench.base import Clock, DeviceConnectionError
from bench.devices import Device
from bench.rig import LongestAbsence

TRIES = 3
"""How often all devices are read at most, when a line is lost and comes back while they are read."""

_INTERVAL = 0.2
"""Time between two attempts, s."""


class Absence:
    """A device that does not answer, whose line is opened again by one attempt after another.

    Parameters
    ----------
    device : Device
        The device, of which a request has just failed.
    lost : DeviceConnectionError
        What it failed with.
    clock : Clock
        The clock of the run.
    longest : LongestAbsence
        How long it may be away; see `longest_away`.
    since : float
        Instant at which that request began, s: its watchdog has been waiting from then on.

    Attributes
    ----------
    lost : DeviceConnectionError
        What the request failed with.
    due : float
        Instant of the next attempt, s.

    Raises
    ------
    DeviceConnectionError
        What it failed with, if its driver cannot open its line again.
    """

    def __init__(
        self, device: Device, lost: DeviceConnectionError, clock: Clock, longest: LongestAbsence, since: float
    ) -> None:
        if type(device).reconnect is Device.reconnect:
            raise lost
        self.lost = lost
        self._device = device
        self._clock = clock
        self._longest = longest
        self._since, self.due = since, clock.now()

    def try_again(self) -> float | None:
        """Try once to reach it; return how long it was away, s, or None if it still is.

        Raises
        ------
        DeviceConnectionError
            What the request failed with, if it has been away for too long, or the run was interrupted.
        DeviceError
            If the instrument is not as it was left.
        """
        try:
            self._device.reconnect()
        except DeviceConnectionError:
            now = self._clock.now()
            if now - self._since >= self._longest.seconds:
                raise DeviceConnectionError(
                    self.lost.device, f"{self.lost.text}; it was not back within {self._longest}"
                ) from None
            if self._clock.interrupted():
                raise self.lost from None
            self.due = now + _INTERVAL
            return None
        return self._clock.now() - self._since
