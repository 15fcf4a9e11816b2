"""Interlocks and the safe state."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from pydantic import BaseModel, ConfigDict, Field, model_validator

from bench.devices import Device
from bench.errors import InterlockError

SAFE = "safe"
"""What `make_safe` says of a device that reached its safe state."""


class Interlock(BaseModel):
    """A range that a signal must not leave while a run goes on."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    signal: str = Field(description="signal that is watched")
    low: float = Field(default=float("-inf"), description="smallest value allowed, in the signal's unit")
    high: float = Field(default=float("inf"), description="largest value allowed, in the signal's unit")
    seconds: float = Field(
        default=0.0, ge=0, le=3600, description="how long the signal may be outside before the run ends, s"
    )

    @model_validator(mode="after")
    def _range_is_not_empty(self) -> Interlock:
        if not self.low < self.high:
            raise ValueError(f"low must be below high, got low = {self.low} and high = {self.high}")
        if math.isinf(self.low) and math.isinf(self.high):
            raise ValueError("low or high, or both, must be given")
        return self


class InterlockWatch:
    """Watches the interlocks of a rig during a run.

    Parameters
    ----------
    interlocks : iterable of Interlock
        What to watch.
    units : mapping of str to str
        Unit by signal name, for messages.
    """

    def __init__(self, interlocks: Iterable[Interlock], units: Mapping[str, str]) -> None:
        self._interlocks = tuple(interlocks)
        self._units = dict(units)
        self._outside_since: list[float | None] = [None] * len(self._interlocks)

    def check(self, t: float, values: Mapping[str, float]) -> None:
        """Look at one set of readings.

        Parameters
        ----------
        t : float
            Laboratory time, s.
        values : mapping of str to float
            Readings by signal name. A value that is nan counts as outside.

        Raises
        ------
        InterlockError
            If a signal has been outside of its range for longer than its interlock allows.
        """
        for i, interlock in enumerate(self._interlocks):
            value = values[interlock.signal]
            if interlock.low <= value <= interlock.high:
                self._outside_since[i] = None
                continue
            since = self._outside_since[i]
            if since is None:
                self._outside_since[i] = since = t
            if t - since >= interlock.seconds:
                unit = self._units[interlock.signal]
                raise InterlockError(
                    f"interlock: {interlock.signal} = {value:.6g} {unit} is outside of "
                    f"{interlock.low:g} to {interlock.high:g} {unit} (for {t - since:.1f} s)"
                )


def make_safe(devices: Iterable[Device]) -> dict[str, str]:
    """Bring every device into its safe state, each by itself.

    Returns
    -------
    dict of str to str
        By device name: `safe`, or what went wrong. A failure of one never keeps the next from being tried.
    """
    outcome: dict[str, str] = {}
    for device in devices:
        try:
            device.safe()
            outcome[device.name] = SAFE
        # Nothing may keep the next device from being tried, an impatient Ctrl-C included.
        except BaseException as error:
            outcome[device.name] = f"{type(error).__name__}: {error}"
    return outcome
