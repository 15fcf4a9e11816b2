"""How a muscle follows its voltage in time, and which of several time constants agrees with what is measured."""

from __future__ import annotations

import math
from dataclasses import dataclass

from bench.base import checks as _checks
from bench.control import check_positive


@dataclass(frozen=True, slots=True)
class Lag:
    """How what drives a muscle, its temperature or its pressure, follows the voltage.

    With the voltage v that would hold what the muscle has at present, w = v^power follows that power of the applied
    voltage V with one time constant, dw/dt = (V^power - w) / tau. For heat the power is 2 (Zhang and Yip 2017, eqs. 1
    and 2, where v² = d1 (T - T0) / d2), so that neither heating gain nor ambient temperature needs to be known; for a
    pressure that a valve regulates it is 1.

    Parameters
    ----------
    time_constant : float
        tau, s; 0 for a muscle that follows at once.
    level : float
        w, V^power, at least 0.
    power : {1, 2}
        See above.

    Raises
    ------
    ValueError
        If the time constant or the level is negative, or not finite.
    """

    time_constant: float
    level: float = 0.0
    power: float = 2.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.time_constant < math.inf:
            raise ValueError(f"time_constant: expected a finite number of s, at least 0, got {self.time_constant}")
        if not 0.0 <= self.level < math.inf:
            raise ValueError(f"level: expected a finite number of V^{self.power:g}, at least 0, got {self.level}")

    @property
    def voltage(self) -> float:
        """The constant voltage that would hold what the muscle has at present, V."""
        return float(self.level ** (1.0 / self.power))

    def advance(self, duration: float, voltage: float) -> Lag:
        """Return the lag after a time (s, at least 0) at a constant voltage, exactly.

        Raises ValueError if the duration is negative or a number is not finite.
        """
        if not 0.0 <= duration < math.inf:
            raise ValueError(f"duration: expected a finite number of s, at least 0, got {duration}")
        final = max(_checks.number("voltage", voltage), 0.0) ** self.power
        if duration == 0.0:
            return self
        return Lag(self.time_constant, final + (self.level - final) * self._remains(duration), self.power)

    def lead(self, target: float, horizon: float, limits: tuple[float, float]) -> float:
        """Return the constant voltage that leads to a target within a time, as far as the limits allow.

        Parameters
        ----------
        target : float
            Wanted `voltage` at the end, V, at least 0.
        horizon : float
            Time until then, s, > 0; the voltage exceeds its steady value the more, the shorter it is.
        limits : tuple of float
            Least and greatest voltage, V, at least 0.

        Raises
        ------
        ValueError
            If the target is negative or not finite.
        """
        if not 0.0 <= target < math.inf:
            raise ValueError(f"target: expected a finite number of V, at least 0, got {target}")
        low, high = limits
        wanted = self.level + (target**self.power - self.level) / (1.0 - self._remains(horizon))
        if wanted < low**self.power:
            return low
        return high if wanted > high**self.power else float(wanted ** (1.0 / self.power))

    def _remains(self, duration: float) -> float:
        return math.exp(-duration / self.time_constant) if self.time_constant else 0.0


@dataclass(frozen=True)
class LagSearch:
    """How a time constant is looked for while a muscle is controlled.

    A muscle in a draught, or another of its kind, has another time constant than the one that was identified. Of
    several, that one is taken with which the model's error changes least from reading to reading: what the wrong
    lag leaves changes whenever the muscle moves, and the error of the model at rest does not.
    """

    factor: float = 1.1
    """Ratio of neighbouring time constants."""
    steps: int = 8
    """Number of time constants above, and of those below the identified one; 0 for that alone."""
    margin: int = 2
    """How many steps above the likeliest the time constant is by which the muscle is led: the model is flat after a
    reversal where the muscle is not, which makes it seem faster than it is."""
    memory: float = 250.0
    """Number of readings after which a change of the error is forgotten."""
    advantage: float = 0.8
    """Part of the squares of its changes below which another time constant takes the place of the present one."""

    def __post_init__(self) -> None:
        check_positive(self, "memory", "advantage")
        if not 1.0 < self.factor < math.inf:
            raise ValueError(f"factor: expected a number above 1, got {self.factor}")
        if self.steps < 0 or self.margin < 0:
            raise ValueError(f"steps, margin: expected at least 0, got {self.steps} and {self.margin}")

    def factors(self) -> list[float]:
        """Return the multiples of the identified time constant that are tried, in order."""
        return [self.factor**k for k in range(-self.steps, self.steps + 1)]
