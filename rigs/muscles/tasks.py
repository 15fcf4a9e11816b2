"""What is controlled of a muscle, its length or its force, and how good model and sensor are there."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

from bench.base import DataError, checks as _checks
from bench.control import check_positive, widened
from bench.models import TwoStageState, TwoStageStream
from rigs.muscles.two_stage_inverse import TwoStageInverse, TwoStageInversion

_READING = 1e-3
"""Noise of one reading where it is not known, as a part of the output's range."""
_BELIEVED = (0.7, 1.4)
"""Least and greatest slope that are believed, as parts of the mean one of the major loop."""


@dataclass(frozen=True, eq=False)
class Task(ABC):
    """What is controlled, how the model sees it, and how good model and sensor are.

    Parameters
    ----------
    inverse : TwoStageInverse
        The model and its inverse.
    walk_variance, reading_variance : float
        As in `DisturbanceEstimator`, output units squared: the change of the model's error in one period, and the
        noise of one reading.
    slopes : tuple of float
        Range of slopes of the output over the voltage that are believed, see `MuscleClosedLoop`; output units per V,
        of one sign.
    rise : float
        What the output moves by over the range of the voltage, output units; negative if it falls. nan if not known.

    Raises
    ------
    ValueError
        If a variance is not positive, or the slopes are not in order or of the wrong sign.
    """

    inverse: TwoStageInverse
    walk_variance: float
    reading_variance: float
    slopes: tuple[float, float]
    rise: float = math.nan
    _sign: ClassVar[float]
    quantity: ClassVar[str]
    """What is controlled, as the noise of a model file names it."""
    kind: ClassVar[str]
    """Data over the voltage from which the model was identified, as the errors of a model file name them."""

    def __post_init__(self) -> None:
        check_positive(self, "walk_variance", "reading_variance")
        if min(self._sign * slope for slope in _checks.increasing("slopes", self.slopes).tolist()) <= 0.0:
            raise ValueError(
                f"slopes: expected {'positive' if self._sign > 0 else 'negative'} numbers, got {self.slopes}"
            )

    @classmethod
    def of_model(
        cls,
        inverse: TwoStageInverse,
        state: TwoStageState,
        limits: tuple[float, float],
        noise: Mapping[str, float],
        model_error: float,
    ) -> Self:
        """Return the task with numbers from the model and from the sensor's noise.

        `model_error` is what the model's error changes by in one period, as a part of what the output moves by.

        The slopes are about the mean one of the major loop of the model, from the state (the muscle at rest under its
        load) on. By a steeper one the muscle would hardly move where it is flat, by a flatter one it would be driven
        beyond its target where it is steep.

        Raises DataError if the output does not move with the voltage as it has to.
        """
        # Only the model is used until the numbers are known.
        trial = cls(inverse, 1.0, 1.0, (1.0, 2.0) if cls._sign > 0 else (-2.0, -1.0))
        low, high = limits
        others, stream = trial.others(state), inverse.model.stream(state)
        trial.advance(stream, low, others)
        cold = trial.output(stream)
        trial.advance(stream, high, others)
        rise = trial.output(stream) - cold
        if not rise * cls._sign > 0.0:
            raise DataError(
                f"the model's {cls.quantity} does not {'rise' if cls._sign > 0 else 'fall'} with the voltage between "
                f"{low:g} and {high:g} V, so that no controller by this model can move it"
            )
        least, greatest = sorted(part * rise / (high - low) for part in _BELIEVED)
        reading = noise.get(cls.quantity, 0.0) or _READING * abs(rise)
        return cls(inverse, (model_error * rise) ** 2, reading**2, (least, greatest), rise)

    @abstractmethod
    def others(self, state: TwoStageState) -> tuple[float, ...]:
        """Return the further signals in a state."""

    @abstractmethod
    def advance(self, stream: TwoStageStream, voltage: float, others: tuple[float, ...]) -> None:
        """Bring the model to a voltage, with further signals."""

    @abstractmethod
    def output(self, stream: TwoStageStream) -> float:
        """Return the model's output."""

    @abstractmethod
    def output_range(self) -> tuple[float, float]:
        """Return the range of the model's output."""

    @abstractmethod
    def invert(self, state: TwoStageState, target: float) -> TwoStageInversion:
        """Return what leads the model's output to a target."""


@dataclass(frozen=True, eq=False)
class LengthTask(Task):
    """The length at a measured force, which may change; the one further signal is that force.

    Noise of a load cell of some 0.02 N needs no dead band: the effect of its small reversals on the memory is
    estimated as disturbance, and the errors are the same without it.
    """

    _sign = -1.0
    quantity = "length"
    kind = "length-voltage"

    def others(self, state: TwoStageState) -> tuple[float, ...]:
        """Return the force of a state."""
        return (state.force,)

    def advance(self, stream: TwoStageStream, voltage: float, others: tuple[float, ...]) -> None:
        """Bring force and voltage of the model to new values, the force first.

        A missing force is replaced by the last one. Raises ValueError if there is not one further signal.
        """
        if len(others) != 1:
            raise ValueError(f"length task: expected the force as one further signal, got {len(others)}")
        low, high = widened(*self.inverse.model.second.input_range)
        stream.step(voltage, others[0] if low <= others[0] <= high else stream.force)

    def output(self, stream: TwoStageStream) -> float:
        """Return the model's length."""
        return stream.length

    def output_range(self) -> tuple[float, float]:
        """Return the range of the model's length."""
        return self.inverse.model.second.output_range()

    def invert(self, state: TwoStageState, target: float) -> TwoStageInversion:
        """Return what leads the model's length to a target at the present force."""
        return self.inverse.voltage_for_length(state, target)


@dataclass(frozen=True, eq=False)
class ForceTask(Task):
    """The force between fixed ends, without further signals."""

    _sign = 1.0
    quantity = "force"
    kind = "force-voltage"

    def others(self, state: TwoStageState) -> tuple[float, ...]:  # noqa: ARG002
        """Return nothing."""
        return ()

    def advance(self, stream: TwoStageStream, voltage: float, others: tuple[float, ...]) -> None:
        """Bring the voltage of the model to a new value; the argument of H2 stays.

        Raises ValueError if there are further signals.
        """
        if others:
            raise ValueError(f"force task: expected no further signals, got {len(others)}")
        stream.move(voltage, stream.argument)

    def output(self, stream: TwoStageStream) -> float:
        """Return the model's force."""
        return stream.force

    def output_range(self) -> tuple[float, float]:
        """Return the range of the model's force at the resting length."""
        return self.inverse.model.first.output_range()

    def invert(self, state: TwoStageState, target: float) -> TwoStageInversion:
        """Return what leads the model's force to a target."""
        return self.inverse.voltage_for_force(state, target)
