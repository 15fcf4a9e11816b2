"""The tables of a twin's rig file: its devices, and the specimen behind them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

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
    extent: float | None = Field(
        default=None, gt=0, description="greatest magnitude that the rig allows, in its unit, for the unit on display"
    )

    @property
    def signal(self) -> Signal:
        """The signal."""
        return Signal(self.name, self.unit, self.description, self.precision, extent=self.extent)


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


class NoiseTable(CheckedTable):
    """How a signal is read: `[emulation.signals.NAME]`."""

    level: float = Field(default=0.0, description="what it reads, where nothing moves it")
    follows: str = Field(default="", description="device whose set-point it follows; none if empty")
    reading: float = Field(default=0.0, ge=0, description="noise of a reading, standard deviation")
    quick: float = Field(default=0.0, ge=0, description="noise of a quick reading, standard deviation")
    resolution: float = Field(default=0.0, ge=0, description="last digit; 0 for none")


class DriveTable(CheckedTable):
    """The actuator: `[emulation.drive]`; see `ActuatorDynamics`."""

    device: str = Field(description="device that takes its set-points")
    signal: str = Field(description="signal that says what it did")
    rest: float = Field(description="what it does while it is off, input units")
    resolution: float = Field(default=0.0, ge=0, description="steps of its set-points, input units; 0 for none")
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


class BoardTable(CheckedTable):
    """A controller board between the bench and the specimen: `[emulation.board]`."""

    device: str = Field(description="device whose set-point is the target of the board")
    firmware: Path = Field(description="folder that bench model deploy --controller has written")


class SetUpTable(LaboratorySettings):
    """What `[emulation]` says of the devices around a specimen."""

    drive: DriveTable
    response: ResponseTable
    board: BoardTable | None = Field(default=None, description="board that moves the drive in place of its device")
    session_offset: float = Field(
        default=0.0, ge=0, description="standard deviation of the response from session to session, output units"
    )
    signals: dict[str, NoiseTable] = Field(default_factory=dict, description="how each signal is read")
    tasks: dict[str, str] = Field(
        default_factory=dict, description="what may be asked of an operator, and the signal that shows it"
    )


class TwinTable(SetUpTable):
    """The table `[emulation]` of a twin."""

    step: float = Field(gt=0, le=1, description="step of the grid of time, s")
    model: str = Field(description="the model, as the content of its file, in JSON")
    wander: Wander = Wander()
    unevenness: Unevenness = Unevenness()
    drift: float = Field(
        default=0.0, ge=0, description="random walk of the response, output units per root of a second"
    )

    @field_validator("model")
    @classmethod
    def _is_an_operator(cls, text: str) -> str:
        _operator(text)
        return text

    @property
    def operator(self) -> Operator[Any]:
        """The model."""
        return _operator(self.model)

    @property
    def dynamics(self) -> Dynamics:
        """What the specimen takes beside the model."""
        return Dynamics(
            self.step, self.drive.dynamics, self.response.dynamics, self.wander, self.unevenness, self.drift
        )


def rounded(value: float, resolution: float) -> float:
    """Return the nearest multiple of a last digit, of one that is not 0."""
    return round(value / resolution) * resolution if resolution else value


def _operator(text: str) -> Operator[Any]:
    try:
        return operator_from_json(parse_json(text))
    except (TypeError, KeyError, AttributeError, RecursionError) as error:
        raise ValueError(f"is no operator: {type(error).__name__}: {error}") from None
