"""Interlocks: what signals may not do while a run goes on, and what is done about it.

Nothing here touches a device, a clock or a thread. Each reading that is taken, for whatever reason, is shown to an
`InterlockWatch`, which says what begins and what ends at it.

A rig file has one table an interlock; one table may ask for several things of one signal::

    [[interlocks]]
    signal = "plate_temperature"
    high = 90.0                  # °C
    resume_high = 85.0           # it counts as outside until it is below this
    seconds = 2.0                # outside for so long before it acts
    fastest = 5.0                # K/s, on average over ...
    over = 2.0                   # ... so many seconds
    level = "hold"               # warn, hold, pause, or safe
    warn = 0.05                  # it warns from 85.5 °C on, 5 % of the limit before it

    [[interlocks]]
    signal = "plate_temperature"
    minus = "plate_setpoint"     # the difference of two signals
    low = -3.0                   # K
    high = 3.0
    settle = 60.0                # s after a change of a set-point during which it does not act

    [[interlocks]]
    signal = "spot_position"
    stale = 60.0                 # s for which readings may be equal to the last bit

    [[interlocks]]
    signal = "plate_temperature"
    setpoint = "plate"           # it has to follow the set-point of this device
    stuck = { moved = 5.0, follows = 1.0, within = 60.0 }
"""

from __future__ import annotations

import math
from enum import StrEnum

from pydantic import Field, model_validator

from bench.base import CheckedTable

SETPOINT = "_setpoint"
"""Ending of the signal that is the set-point of a device, after the name of the device."""


class Level(StrEnum):
    """What an interlock does when it acts."""

    WARN = "warn"
    """It is recorded as an event."""
    HOLD = "hold"
    """The set-points stay until the signal is back, then the run goes on; it ends if that takes too long."""
    PAUSE = "pause"
    """The run pauses, as the operator may ask for at any time."""
    SAFE = "safe"
    """The run ends in the safe state."""


class Stuck(CheckedTable):
    """How a signal has to follow a set-point."""

    moved: float = Field(gt=0, description="change of the set-point that the signal has to follow, in its unit")
    follows: float = Field(gt=0, description="smallest change of the signal that follows it, in the signal's unit")
    within: float = Field(gt=0, le=3600, description="time that the signal has for it, s")


class Interlock(CheckedTable):
    """What a signal may not do while a run goes on. A value that is nan counts as outside of any range."""

    signal: str = Field(description="signal that is watched")
    low: float = Field(default=-math.inf, description="smallest value allowed, in the signal's unit")
    high: float = Field(default=math.inf, description="largest value allowed, in the signal's unit")
    seconds: float = Field(
        default=0.0, ge=0, le=3600, description="how long it may be outside, or change too fast, before it acts, s"
    )
    resume_low: float | None = Field(
        default=None, description="once below low, it is outside until it has reached this"
    )
    resume_high: float | None = Field(
        default=None, description="once above high, it is outside until it has come down to this"
    )
    minus: str = Field(default="", description="signal that is subtracted from it before it is compared")
    unit: str = Field(default="", description="unit in which the numbers are meant, checked against the signal's")
    setpoint: str = Field(default="", description="device whose set-point moves the signal; without it any does")
    settle: float = Field(
        default=0.0,
        ge=0,
        le=3600,
        description="time after a set-point has changed during which range and rate do not act, s",
    )
    fastest: float | None = Field(
        default=None, gt=0, description="largest rate of change allowed, the signal's unit per s"
    )
    over: float = Field(default=1.0, ge=0.01, le=3600, description="time over which the rate is taken, s")
    stale: float | None = Field(
        default=None, gt=0, le=86400, description="how long its readings may be equal to the last bit, s"
    )
    stuck: Stuck | None = Field(
        default=None, description="how it has to follow the set-point: moved, follows, within"
    )
    level: Level = Field(default=Level.SAFE, description="what it does: warn, hold, pause, or safe")
    hold_at_most: float = Field(
        default=600.0, gt=0, le=86400, description="longest time that it holds before the run ends, s"
    )
    warn: float = Field(
        default=0.05,
        ge=0,
        le=0.5,
        description="width of the warning band before low and before high, as a share of the limit; 0 for none",
    )

    @property
    def label(self) -> str:
        """What is watched, for messages: the signal, or the difference of two."""
        return f"{self.signal} - {self.minus}" if self.minus else self.signal

    @property
    def resume(self) -> tuple[float, float]:
        """Range in which the signal counts as back, in its unit."""
        return (
            self.low if self.resume_low is None else self.resume_low,
            self.high if self.resume_high is None else self.resume_high,
        )

    @property
    def unwarned(self) -> tuple[float, float]:
        """Range outside of which it warns before it acts, in the signal's unit; infinite where it does not."""
        if self.level is Level.WARN:
            return -math.inf, math.inf
        low = self.low + self.warn * abs(self.low) if math.isfinite(self.low * self.warn) else -math.inf
        high = self.high - self.warn * abs(self.high) if math.isfinite(self.high * self.warn) else math.inf
        # A limit of zero has no share, and a narrow range no room.
        low, high = (low if low > self.low else -math.inf), (high if high < self.high else math.inf)
        return (low, high) if low < high else (-math.inf, math.inf)

    @property
    def limits_values(self) -> bool:
        """Whether it limits the values of the signal or their rate, not only how it follows."""
        return math.isfinite(self.low) or math.isfinite(self.high) or self.fastest is not None

    @model_validator(mode="after")
    def _is_consistent(self) -> Interlock:
        if not self.low < self.high:
            raise ValueError(f"low must be below high, got low = {self.low} and high = {self.high}")
        if not (self.limits_values or self.stale or self.stuck):
            raise ValueError("low or high, or both, must be given, or fastest, stale or stuck")
        low, high = self.resume
        if not (self.low <= low <= high <= self.high):
            raise ValueError(
                "expected low ≤ resume_low ≤ resume_high ≤ high, "
                f"got {self.low:g}, {low:g}, {high:g} and {self.high:g}"
            )
        for key, wanted, is_there in (
            ("resume_low", "low", math.isfinite(self.low)),
            ("resume_high", "high", math.isfinite(self.high)),
            ("over", "fastest", self.fastest is not None),
            ("hold_at_most", 'level = "hold"', self.level is Level.HOLD),
            ("stuck", "setpoint", bool(self.setpoint)),
        ):
            if key in self.model_fields_set and getattr(self, key) is not None and not is_there:
                raise ValueError(f"{key} has no meaning without {wanted}")
        if self.minus and (self.stale is not None or self.minus == self.signal):
            raise ValueError(
                f"minus = {self.minus!r}: expected another signal than {self.signal}, in a table of its own without "
                "stale, which concerns one sensor"
            )
        return self
