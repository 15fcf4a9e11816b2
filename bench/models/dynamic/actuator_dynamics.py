"""The dynamics of an actuator and its specimen, as transients show them: what controllers know beside a model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Self


@dataclass(frozen=True)
class ActuatorDynamics:
    """How the drive follows its set-point.

    The position x follows the set-point by x'' = frequency² (set-point - x) - 2 damping frequency x', or by
    x' = frequency (set-point - x) if the damping is 0, or at once if the frequency is 0; |x'| is at most `rate`. What
    the drive does is offset + gain x.

    Attributes
    ----------
    delay : float
        From the set-point to its first effect, s.
    frequency : float
        Natural frequency, or the inverse of the time constant, rad/s.
    damping : float
        Damping ratio.
    rate : float
        Fastest change, input units per s; infinite if none was found.
    gain, offset : float
        Drive against set-point at rest; 1 and 0 for an ideal one.
    """

    delay: float = 0.0
    frequency: float = 0.0
    damping: float = 0.0
    rate: float = math.inf
    gain: float = 1.0
    offset: float = 0.0

    @property
    def order(self) -> int:
        """Order of the differential equation: 0, 1 or 2."""
        return 0 if self.frequency == 0.0 else 1 if self.damping == 0.0 else 2

    @property
    def time_constant(self) -> float:
        """Time after which a small step has come to some 63 % of its way, beside the delay, s."""
        if self.order == 0:
            return 0.0
        return max(1.0, 2.0 * self.damping) / self.frequency

    @property
    def overshoot(self) -> float:
        """Overshoot of a small step, as a share of it."""
        if self.order < 2 or self.damping >= 1.0:
            return 0.0
        return math.exp(-math.pi * self.damping / math.sqrt(1.0 - self.damping**2))


@dataclass(frozen=True)
class ResponseDynamics:
    """How the response follows the drive, beside the hysteresis.

    Attributes
    ----------
    lag : float
        Time constant between drive and hysteresis, s; 0 for none. It acts on |x|^power: 2 is that of heat by a
        current or voltage.
    power : {1, 2}
        See `lag`.
    gain : float
        Part of what the hysteresis gives that comes at once.
    shares, times : tuple of float
        Parts of it that come late, and their time constants, s.
    """

    lag: float = 0.0
    power: float = 1.0
    gain: float = 1.0
    shares: tuple[float, ...] = ()
    times: tuple[float, ...] = ()

    def level(self, value: float) -> float:
        """Return what of an input the lag acts on, with its sign: its `power`."""
        return value if self.power == 1.0 else value * abs(value)

    def of_level(self, level: float) -> float:
        """Return the input of a level."""
        return level if self.power == 1.0 else math.copysign(math.sqrt(abs(level)), level)


class SeenInput:
    """The input as the hysteresis sees it, behind the lag of the response.

    Parameters
    ----------
    response : ResponseDynamics
        With the lag; without one the input is seen at once.
    start : float
        Input that is seen until the first reading, input units; nan if the actuator rests at the first reading.
    """

    def __init__(self, response: ResponseDynamics, start: float = math.nan) -> None:
        self.response = response
        self._level, self._time = response.level(start), math.nan

    @property
    def value(self) -> float:
        """The input that is seen at present, input units."""
        return self.response.of_level(self._level)

    def take(self, t: float, measured: float) -> float:
        """Take a reading of the input at a time (s), which it has had since the last one; return what is seen."""
        level, passed = self.response.level(measured), t - self._time
        if not math.isnan(self._level):
            level += (self._level - level) * self._remains(0.0 if math.isnan(passed) else max(passed, 0.0))
        self._level, self._time = level, t
        return self.value

    def lead(self, target: float, horizon: float, limits: tuple[float, float]) -> float:
        """Return the constant input after which a target is seen within a time, as far as the limits allow.

        Parameters
        ----------
        target : float
            Input to be seen at the end of the horizon, input units.
        horizon : float
            Time until then, s, > 0; the input exceeds its steady value the more, the shorter it is.
        limits : tuple of float
            Least and greatest input, input units.
        """
        wanted = self._level + (self.response.level(target) - self._level) / (1.0 - self._remains(horizon))
        return min(max(self.response.of_level(wanted), limits[0]), limits[1])

    def _remains(self, duration: float) -> float:
        return math.exp(-duration / self.response.lag) if self.response.lag else 0.0


@dataclass(frozen=True)
class IdentifiedDynamics:
    """The dynamics behind a model, with noise and evidence; the key `dynamics` of a model file.

    Attributes
    ----------
    actuator : ActuatorDynamics
        From the set-point to the drive.
    response : ResponseDynamics
        From the drive to the response.
    noise : mapping of str to float
        Standard deviation of one reading, by what is read, in its unit: `input` and `output`; of a two-stage model
        `voltage`, `force` and `length`. What is not known is missing.
    uncertainties : mapping of str to float
        Standard uncertainty of `lag` (s), and of numbers of the actuator in their units.
    fastest : float
        A shorter time constant of the response would not have been seen, s.
    source : str
        The runs that show it, or who said it.

    Raises
    ------
    ValueError
        If a number is out of range.
    """

    actuator: ActuatorDynamics = field(default_factory=ActuatorDynamics)
    response: ResponseDynamics = field(default_factory=ResponseDynamics)
    noise: Mapping[str, float] = field(default_factory=dict)
    uncertainties: Mapping[str, float] = field(default_factory=dict)
    fastest: float = 0.0
    source: str = ""

    def __post_init__(self) -> None:
        for name, value, above in (
            ("actuator.delay", self.actuator.delay, 0.0),
            ("actuator.frequency", self.actuator.frequency, 0.0),
            ("actuator.damping", self.actuator.damping, 0.0),
            ("response.lag", self.response.lag, 0.0),
            ("fastest", self.fastest, 0.0),
            *((f"noise.{name}", value, 0.0) for name, value in self.noise.items()),
        ):
            if not above <= value < math.inf:
                raise ValueError(f"{name}: expected a finite number, at least {above:g}, got {value}")
        if self.response.power not in (1.0, 2.0):
            raise ValueError(f"response.power: expected 1 or 2, got {self.response.power}")
        if not self.actuator.rate > 0.0:
            raise ValueError(f"actuator.rate: expected a positive number, got {self.actuator.rate}")

    @property
    def time_constant(self) -> float:
        """Sum of the delay and the time constants from the set-point to the response, s."""
        return self.actuator.delay + self.actuator.time_constant + self.response.lag

    def to_json(self) -> dict[str, Any]:
        """Return the content of the key of a model file; a number that is infinite is null."""
        actuator = asdict(self.actuator)
        actuator["rate"] = None if math.isinf(self.actuator.rate) else self.actuator.rate
        response = asdict(self.response)
        return {
            "actuator": actuator,
            "response": response | {"shares": list(self.response.shares), "times": list(self.response.times)},
            "noise": dict(self.noise),
            "uncertainties": dict(self.uncertainties),
            "fastest": self.fastest,
            "source": self.source,
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Self:
        """Return dynamics from what `to_json` wrote; a key may be missing.

        Raises ValueError or TypeError if it is damaged.
        """
        actuator, response = dict(content.get("actuator", {})), dict(content.get("response", {}))
        if actuator.get("rate", 0.0) is None:
            actuator["rate"] = math.inf
        late = {name: tuple(float(value) for value in response.pop(name, ())) for name in ("shares", "times")}
        return cls(
            ActuatorDynamics(**{name: float(value) for name, value in actuator.items()}),
            ResponseDynamics(**{name: float(value) for name, value in response.items()}, **late),  # type: ignore[arg-type]
            {str(name): float(value) for name, value in content.get("noise", {}).items()},
            {str(name): float(value) for name, value in content.get("uncertainties", {}).items()},
            float(content.get("fastest", 0.0)),
            str(content.get("source", "")),
        )
