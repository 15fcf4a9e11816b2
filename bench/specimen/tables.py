"""The tables of a twin's rig file: its devices, and the specimen behind them."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from bench.base import CheckedTable, parse_json
from bench.devices import Signal
from bench.models import ActuatorDynamics, Operator, ResponseDynamics, operator_from_json
from bench.rig import LaboratorySettings
from bench.specimen.specimen import Dynamics, Unevenness, Wander


class SignalTable(CheckedTable):
    """A signal of a twin's device."""

    name: str = Field(min_length=1, description="name of the signal on the rig")
    unit: str = Field(description="its unit")
    description: str = Field(default="", description="a few words for axes and column headers")
    precision: int = Field(default=3, ge=0, le=12, description="digits after the point that are worth showing")

    @property
    def signal(self) -> Signal:
        """The signal."""
        return Signal(self.name, self.unit, self.description, self.precision)


class SetpointTable(SignalTable):
    """The set-point of a twin's device."""

    limits: tuple[float, float] = Field(description="set-points that are allowed, in its unit")
    tolerance: float = Field(
        default=0.0, ge=0, description="distance of the first signal at which it has arrived; 0 for at once"
    )

    @field_validator("limits")
    @classmethod
    def _increase(cls, limits: tuple[float, float]) -> tuple[float, float]:
        if not limits[0] <= limits[1]:
            raise ValueError("expected the lower limit first")
        return limits


class WanderTable(CheckedTable):
    """A quantity that wanders: `[emulation.wander]`, of the drive, and `[emulation.drift]`, of the response."""

    deviation: float = Field(default=0.0, ge=0, description="standard deviation, in the unit of the quantity")
    time: float = Field(default=1.0, gt=0, description="correlation time, s")

    @property
    def wander(self) -> Wander:
        """What the specimen takes."""
        return Wander(self.deviation, self.time)


class UnevennessTable(CheckedTable):
    """What the model does not know, as a shift of the drive: `[emulation.unevenness]`."""

    deviation: float = Field(default=0.0, ge=0, description="standard deviation, input units")
    length: float = Field(default=1.0, gt=0, description="travel after which it is forgotten, input units")


class InexactTable(CheckedTable):
    """How exactly something is read or carried out."""

    resolution: float = Field(default=0.0, ge=0, description="last digit; 0 for none")
    outlier_share: float = Field(default=0.0, ge=0, le=1, description="share of values that are further off")
    outliers: tuple[float, ...] = Field(default=(), description="by how much these are off, quantiles")
    relative_outliers: bool = Field(default=False, description="whether they are shares of the value")

    def inexact(self, value: float, rng: np.random.Generator) -> float:
        """Return what becomes of a value."""
        if self.outliers and rng.random() < self.outlier_share:
            size = float(rng.choice(self.outliers))
            return value * (1.0 + size) if self.relative_outliers else value + size
        return self.rounded(value)

    def rounded(self, value: float) -> float:
        """Return the nearest multiple of the last digit."""
        return round(value / self.resolution) * self.resolution if self.resolution else value


class NoiseTable(InexactTable):
    """How a signal is read: `[emulation.signals.NAME]`."""

    level: float = Field(default=0.0, description="what it reads, where nothing moves it")
    follows: str = Field(default="", description="device whose set-point it follows; none if empty")
    reading: float = Field(default=0.0, ge=0, description="noise of a reading, standard deviation")
    quick: float = Field(default=0.0, ge=0, description="noise of a quick reading, standard deviation")


class DriveTable(CheckedTable):
    """The actuator: `[emulation.drive]`; see `ActuatorDynamics`."""

    device: str = Field(description="device that takes its set-points")
    signal: str = Field(description="signal that says what it did")
    rest: float = Field(description="what it does while it is off, input units")
    delay: float = Field(default=0.0, ge=0, description="from a set-point to its first effect, s")
    frequency: float = Field(default=0.0, ge=0, description="natural frequency, rad/s; 0 if it follows at once")
    damping: float = Field(default=0.0, ge=0, description="damping ratio; 0 for a lag of first order")
    rate: float | None = Field(default=None, gt=0, description="fastest change, input units per s; none if not given")
    gain: float = Field(default=1.0, description="drive against set-point at rest")
    offset: float = Field(default=0.0, description="drive at a set-point of 0, input units")

    @field_validator("gain")
    @classmethod
    def _not_zero(cls, value: float) -> float:
        if value == 0.0:
            raise ValueError("must be a number other than 0")
        return value

    @property
    def dynamics(self) -> ActuatorDynamics:
        """What the specimen takes."""
        rate = float("inf") if self.rate is None else self.rate
        return ActuatorDynamics(self.delay, self.frequency, self.damping, rate, self.gain, self.offset)


class ResponseTable(CheckedTable):
    """The response: `[emulation.response]`; see `ResponseDynamics`."""

    signal: str = Field(description="signal that a device measures")
    lag: float = Field(default=0.0, ge=0, description="time constant between drive and hysteresis, s; 0 for none")
    power: float = Field(default=1.0, gt=0, description="the lag acts on the drive to this power")
    gain: float = Field(default=1.0, description="part of the hysteresis that comes at once")
    shares: tuple[float, ...] = Field(default=(), description="parts of it that come late")
    times: tuple[float, ...] = Field(default=(), description="their time constants, s")
    conversion: tuple[tuple[float, float], ...] = Field(
        default=(),
        description="pairs of the model's output and the signal, by which one follows from the other; none if they "
        "are the same",
    )

    @model_validator(mode="after")
    def _belong_together(self) -> Self:
        if len(self.shares) != len(self.times) or any(time <= 0 for time in self.times):
            raise ValueError("shares and times: expected as many of each, times > 0")
        if any(after[0] <= before[0] for before, after in zip(self.conversion, self.conversion[1:], strict=False)):
            raise ValueError("conversion: expected outputs that increase")
        return self

    @property
    def dynamics(self) -> ResponseDynamics:
        """What the specimen takes."""
        return ResponseDynamics(self.lag, self.power, self.gain, self.shares, self.times)


class TwinTable(LaboratorySettings):
    """The table `[emulation]` of a twin."""

    step: float = Field(gt=0, le=1, description="step of the grid of time, s")
    model: str = Field(description="the model, as the content of its file, in JSON")
    correction: str = Field(default="", description="what of its error repeats, an operator in JSON; none if empty")
    session_offset: float = Field(
        default=0.0, ge=0, description="standard deviation of the response from session to session, output units"
    )
    drive: DriveTable
    setpoints: InexactTable = InexactTable()
    response: ResponseTable
    wander: WanderTable = WanderTable()
    drift: WanderTable = WanderTable()
    unevenness: UnevennessTable = UnevennessTable()
    signals: dict[str, NoiseTable] = Field(default_factory=dict, description="how each signal is read")
    tasks: dict[str, str] = Field(
        default_factory=dict, description="what may be asked of an operator, and the signal that shows it"
    )

    @field_validator("model", "correction")
    @classmethod
    def _is_an_operator(cls, text: str) -> str:
        if text:
            _operator(text)
        return text

    @property
    def operators(self) -> tuple[Operator[Any], ...]:
        """The model, and the correction if there is one."""
        return tuple(_operator(text) for text in (self.model, self.correction) if text)

    @property
    def dynamics(self) -> Dynamics:
        """What the specimen takes beside the operators."""
        return Dynamics(
            self.step,
            self.drive.dynamics,
            self.response.dynamics,
            self.wander.wander,
            self.drift.wander,
            Unevenness(self.unevenness.deviation, self.unevenness.length),
        )


def _operator(text: str) -> Operator[Any]:
    try:
        return operator_from_json(parse_json(text))
    except (TypeError, KeyError, AttributeError, RecursionError) as error:
        raise ValueError(f"is no operator: {type(error).__name__}: {error}") from None
