"""Settling rules: how a rig comes to rest between a set-point and its reading."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum


@dataclass(frozen=True)
class Dwell:
    """Settle by waiting a fixed time.

    Raises
    ------
    ValueError
        If `seconds` is negative or not finite.
    """

    seconds: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.seconds) and self.seconds >= 0):
            raise ValueError(f"seconds: expected a finite number ≥ 0, got {self.seconds}")


@dataclass(frozen=True)
class UntilSteady:
    """Settle until a signal's remaining drift, as a Kalman filter estimates it, is below a limit.

    Attributes
    ----------
    signal : str
        Which signal has to come to rest.
    drift : float
        Largest drift allowed, in units of the signal per second. The estimate's magnitude and one
        standard deviation of its uncertainty must both fit within.
    noise : float
        Standard deviation of one quick reading of the signal, in units of the signal.
    timeout : float
        Seconds after which the step has failed and the run ends in the safe state.
    minimum : float
        Seconds to wait in any case.
    """

    signal: str
    drift: float
    noise: float
    timeout: float
    minimum: float = 0.0

    def __post_init__(self) -> None:
        if not (self.drift > 0 and self.noise > 0 and self.timeout > self.minimum >= 0):
            raise ValueError(
                "UntilSteady: expected drift > 0, noise > 0 and timeout > minimum ≥ 0, got "
                f"drift={self.drift}, noise={self.noise}, timeout={self.timeout}, minimum={self.minimum}"
            )


@dataclass(frozen=True)
class Arrived:
    """Settle until every device that was sent a set-point says that it has arrived.

    The device itself decides: a temperature controller by its stability, a stage by its position. One that reports
    a failed arrival, or does not arrive in time, ends the run in the safe state.

    Attributes
    ----------
    timeout : float
        Seconds after which the step has failed; the device's own time-out may be shorter.
    minimum : float
        Seconds to wait in any case.
    """

    timeout: float = 600.0
    minimum: float = 0.0

    def __post_init__(self) -> None:
        if not math.inf > self.timeout > self.minimum >= 0:
            raise ValueError(
                f"Arrived: expected finite timeout > minimum ≥ 0, got timeout={self.timeout}, minimum={self.minimum}"
            )


Settle = Dwell | UntilSteady | Arrived


class Settled(StrEnum):
    """How a step settled, as its record says."""

    DWELL = "dwell"
    STEADY = "steady"
    ARRIVED = "arrived"
    CONTROLLED = "controlled"
    NOT_STEADY = "not steady"
    NOT_ARRIVED = "not arrived"
    UNRECORDED = "not recorded"

    @property
    def failed(self) -> bool:
        """Whether the settling rule was not met; such a step ends its run."""
        return self in (Settled.NOT_STEADY, Settled.NOT_ARRIVED)


def durations(settle: Settle) -> tuple[float, float]:
    """Return the shortest and the longest time that a rule takes, s."""
    if isinstance(settle, Dwell):
        return settle.seconds, settle.seconds
    return settle.minimum, settle.timeout
