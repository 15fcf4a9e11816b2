"""Control tasks: a controller and its targets or reference, carried out sample by sample."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from bench.control.tracking import Command, Follower, TargetController, Trace

Floats = NDArray[np.float64]

SHORTEST_WAIT = 1e-3
"""Least time between two commands of a loop that is late, s.

Derivation: eight bytes, as of a Modbus request, take 0.7 ms at 115 200 Bd; no instrument is asked sooner again.
"""


class ControlTask(Protocol):
    """A controller at work: asked for a command at its beginning and after each reading, until it is done.

    Beside input and output it receives the further signals that its `Control` names, in that order.
    """

    def begin(self, t: float, measured_input: float, output: float, *others: float) -> Command:
        """Take the first reading (s, input units, output units, others in theirs); say what to do."""

    def update(self, t: float, measured_input: float, output: float, *others: float) -> Command:
        """Take the next reading, `wait` seconds after the last command; say what to do."""

    @property
    def trace(self) -> Trace:
        """Internal values at present."""


@runtime_checkable
class SampledController(Protocol):
    """A controller of one or several actuators that is called at a fixed rate."""

    def update(self, t: float, measured: tuple[float, ...]) -> tuple[float, ...]:
        """Take a reading, one value a signal, at t s from the beginning; return a set-point for each actuator.

        A set-point that is the same as before is not sent again.
        """

    @property
    def trace(self) -> Trace:
        """Internal values at present."""


@runtime_checkable
class DelayedController(Protocol):
    """A `SampledController` that may need more time than was planned, as only its first readings tell."""

    @property
    def delay(self) -> float:
        """Time by which the end of its reference is put off, s, known from the first complete reading on."""


@runtime_checkable
class BlockController(Protocol):
    """A controller of one or several actuators that steps a block of samples in one call, such as a compiled one."""

    def step_block(self, times: Floats, readings: Floats, out: Floats) -> None:
        """Write the set-points of the next block, from the readings of the last one.

        A reading acts on the set-points one to two blocks later: the delay of a loop that is closed this way.

        Parameters
        ----------
        times : numpy.ndarray
            Instants of the samples of the next block, s from the beginning of the loop.
        readings : numpy.ndarray
            Readings of the last block, a row for each sample and a column for each signal; no row before the first.
        out : numpy.ndarray
            Takes the set-points, a row for each sample and a column for each actuator.
        """

    @property
    def trace(self) -> Trace:
        """Internal values at present."""


class Playback:
    """Set-points as functions of time, without feedback: a `SampledController` and a `BlockController`.

    Parameters
    ----------
    setpoints : callable
        One for each actuator: its set-point at a time in s from the beginning.
    """

    def __init__(self, *setpoints: Callable[[float], float]) -> None:
        self._setpoints = setpoints
        self.trace = Trace()

    def update(self, t: float, measured: tuple[float, ...]) -> tuple[float, ...]:  # noqa: ARG002
        """Return the set-points of the moment."""
        return tuple(setpoint(t) for setpoint in self._setpoints)

    def step_block(self, times: Floats, readings: Floats, out: Floats) -> None:  # noqa: ARG002
        """Write the set-points of a block; without feedback nothing is delayed."""
        for k, t in enumerate(times.tolist()):
            out[k] = self.update(t, ())


class ReachTarget:
    """Bring the output to one target.

    Parameters
    ----------
    controller : TargetController
        Keeps its state from one target to the next.
    target : float
        Output units.
    """

    def __init__(self, controller: TargetController, target: float) -> None:
        self._controller = controller
        self._target = target

    def begin(self, t: float, measured_input: float, output: float, *others: float) -> Command:
        """Aim at the target."""
        return self._controller.aim(self._target, t, measured_input, output, *others)

    def update(self, t: float, measured_input: float, output: float, *others: float) -> Command:
        """Go on towards it."""
        return self._controller.update(t, measured_input, output, *others)

    @property
    def trace(self) -> Trace:
        """The controller's estimates."""
        return self._controller.trace


@runtime_checkable
class Foreseeing(Protocol):
    """A `Follower` that is given the reference of some coming periods before each update."""

    horizon: int

    def foresee(self, references: Floats) -> None:
        """Take the reference at the end of each coming period, shape (`horizon`,), output units."""


class FollowReference:
    """Make the output follow a reference at a fixed rate.

    Parameters
    ----------
    follower : Follower
        The controller.
    reference : callable
        Reference in output units at a time in s from the beginning of the loop.
    period : float
        Seconds between two set-points.
    duration : float
        Seconds to follow.

    Raises
    ------
    ValueError
        If period or duration is not positive.
    """

    def __init__(
        self, follower: Follower, reference: Callable[[float], float], period: float, duration: float
    ) -> None:
        if not (period > 0 and duration > 0):
            raise ValueError(f"period, duration: expected positive numbers of s, got {period} and {duration}")
        self._follower = follower
        self._reference = reference
        self._period = period
        self._samples = max(1, round(duration / period))
        self._sample: int
        self._start = self._setpoint = self._now = math.nan

    def begin(self, t: float, measured_input: float, output: float, *others: float) -> Command:  # noqa: ARG002
        """Set the first set-point."""
        self._start = t
        self._sample = 0
        return self.update(t, measured_input, output)

    def update(self, t: float, measured_input: float, output: float, *others: float) -> Command:  # noqa: ARG002
        """Set the next one, for the reference at the end of the period."""
        self._now = t - self._start
        if self._sample == self._samples:
            return Command(self._setpoint, 0.0, done=True)
        self._sample += 1
        end = self._sample * self._period
        if isinstance(self._follower, Foreseeing):
            ahead = end + self._period * np.arange(self._follower.horizon)
            self._follower.foresee(np.array([self._reference(each) for each in ahead.tolist()]))
        self._setpoint = self._follower.update(t, measured_input, output, self._reference(end))
        # Counted from the beginning, so that one delay does not shift all later samples.
        return Command(self._setpoint, max(SHORTEST_WAIT, self._start + end - t))

    @property
    def trace(self) -> Trace:
        """Internal values, with the reference at the time of the last reading."""
        return replace(self._follower.trace, reference=self._reference(self._now))
