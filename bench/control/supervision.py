"""Watches over a controller: its feedback, made for another specimen, may do harm, or its model no longer hold."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.base import ConvergenceError
from bench.control.convergence import MOST_SWINGS, LimitCycleWatch
from bench.control.loops import Foreseeing, Reaching
from bench.control.model_filters import ModelFilter
from bench.control.tracking import Command, Follower, Trace
from bench.models import Reach

TARGETS = 5
"""Number of targets in a row over which errors are judged."""
SAMPLES = 200
"""Number of samples of a moving reference over which they are judged."""
HOLDS = 0.03
"""Part of the output's range that a model may err by that fits its own data well: sessions differ. Feedback that errs
by more does not do what it is for."""
_CHANCE_OF_TARGETS = 2.7
"""Ratio of two RMS errors over five targets, each without the greatest, that chance exceeds in 5 % of cases."""
_CHANCE_OF_SAMPLES = 2.25
"""The same for a moving reference, whose errors are alike over many samples: as of five that are not."""
_TOLERANCE = 0.02
"""Part of the range within which the model alone is not taken for better."""
_WARNED = 0.008
"""The same part from which on there is a warning."""
_MISSED = 0.01
"""Part of the range by which a target that cannot be met is missed without a warning."""
_DOUBTED = 2.0
"""Factor below the error that ends an open loop from which on there is a warning, if its model errs by itself."""
_MOVING = 1.5
"""How much more a model may err where the reference moves: the actuator's lag is no part of its error at rest."""
_SWINGS = MOST_SWINGS - 2
"""Swings at one target after which its controller is given up: fewer than those that end the run."""


class _Supervision:
    """What the supervision of targets and of a moving reference have in common.

    Parameters
    ----------
    controller : object
        The controller.
    limits : (float, float)
        Set-points that it may ask for, input units.
    span : float
        Range of the output by the model, output units, > 0.
    fallback : callable or None
        Makes the controller that goes on, from the memory of the one that is given up. Without it a
        `ConvergenceError` ends the run in the safe state.
    judges : bool
        Whether errors are judged. Not of a controller that corrects its model, which takes its time, nor of one that
        may miss targets by design.
    holds : float
        Of a controller without feedback: greatest RMS error of a model that still holds, output units. nan for one
        with feedback, whose model may err by more.

    Notes
    -----
    A controller is given up by the RMS of the errors of a window without the greatest: one missed target is no reason
    to end a run. A warning is by the RMS of all.
    """

    _window = TARGETS
    _over = "targets"
    _chance = _CHANCE_OF_TARGETS
    _strict = True
    """Whether an error beyond the tolerance ends the run, also where the model alone would err by more."""

    def __init__(
        self,
        controller: Any,  # noqa: ANN401 - `Reaching` or `Follower`
        limits: tuple[float, float],
        span: float,
        fallback: Callable[[Any], Any] | None = None,
        *,
        judges: bool = True,
        holds: float = math.nan,
    ) -> None:
        self._controller: Any = controller
        self._limits = limits
        self._span = span
        self._fallback = fallback
        self._judges = judges
        self._holds = holds
        self._judged: deque[tuple[float, float]] = deque(maxlen=self._window)
        self._notice = ""
        self._warned = False
        self.gave_up = False
        """Whether the fallback is at work."""

    @property
    def trace(self) -> Trace:
        """Internal values of the controller at work."""
        trace: Trace = self._controller.trace
        return trace

    @property
    def state(self) -> Any:  # noqa: ANN401 - each operator has its own
        """Memory of the actuator as the controller at work knows it."""
        return self._controller.state

    @property
    def adaptation(self) -> ModelFilter | None:
        """What corrects the model of the controller at work; None if nothing does."""
        found: ModelFilter | None = getattr(self._controller, "adaptation", None)
        return found

    @property
    def reach(self) -> Reach:
        """Whether the present target or reference can be met."""
        reach: Reach = self._controller.reach
        return reach

    def take_notice(self) -> str:
        """Return why the controller was given up, or what error it leaves, once; empty if there is nothing to say."""
        notice, self._notice = self._notice, ""
        return notice

    def _judge(self, error: float) -> None:
        """Take the error of a target or sample, output units; give the controller up if it does no good.

        Raises ConvergenceError if nothing goes on in its place.
        """
        without = self.trace.disturbance
        if not math.isfinite(error):
            return
        self._judged.append((error, without))
        if len(self._judged) < self._window:
            return
        squares = np.sort(np.square(self._judged), axis=0)
        everything = math.sqrt(float(np.mean(squares[:, 0])))
        # Of a controller that does not say what its model errs by, that is not known.
        errors, without = np.sqrt(np.mean(squares[:-1], axis=0)).tolist()
        over = f"over {self._window} {self._over} its error"
        but = f"{over} but for the greatest is {errors:.3g} RMS"
        if not math.isnan(self._holds):
            known = f"and that of a model that holds at most {self._holds:.3g}"
            if errors > self._holds:
                self._give_up(f"{but}, {known}")
            elif everything > max(self._holds / _DOUBTED, min(self._holds, _DOUBTED * HOLDS * self._span)):
                self._warn(f"the open loop errs: {over} is {everything:.3g} RMS, {known}")
            return
        text = f"{but}, {100.0 * errors / self._span:.2g} % of the range"
        known = f"{text}, and that of its model alone, without feedback, {without:.3g}"
        if errors > _TOLERANCE * self._span and errors > self._chance * without:
            self._give_up(known)
        elif errors > HOLDS * self._span and self._strict and self._fallback is None:
            self._give_up(text if math.isnan(without) else known)
        elif everything > _WARNED * self._span:
            part = 100.0 * everything / self._span
            self._warn(f"the controller leaves an error: {over} is {everything:.3g} RMS, {part:.2g} % of the range")

    def _warn(self, text: str) -> None:
        """Have something said, once in a run."""
        if not self._warned:
            self._notice, self._warned = text, True

    def _give_up(self, why: str) -> None:
        if math.isnan(self._holds):
            text, remedy = f"the controller does not converge: {why}", "tune it for this specimen, "
        else:
            text, remedy = f"the model does not hold for this specimen: {why}", "correct it by adaptation=session, "
        if self._fallback is None:
            raise ConvergenceError(
                f"{text}; {remedy}identify the specimen again, or set fallback=open-loop to go on without feedback"
            )
        if self._controller.state is None:
            raise ConvergenceError(f"{text}; it keeps no memory of the specimen from which the open loop could go on")
        self._notice = f"{text}; it goes on in open loop"
        self._controller = self._fallback(self._controller.state)
        self.gave_up = True


class Supervised(_Supervision):
    """A target controller that is given up when it does not converge: a `Reaching`.

    It does not if it sends the actuator to and fro between the ends of its range at one target; or if over several
    targets it errs by more than its model does at the same places, and more than by chance: then the model alone,
    without feedback, would have been better; or if it says so itself (`doubt`); or, without a fallback, if it errs by
    more than 3 % of the range. One without feedback is given up where its model does not hold. One missed target of
    several is no reason, but from 0.8 % of the range on there is a warning. Targets that cannot be met do not count;
    one that is missed by more than 1 % is warned of. Parameters as `_Supervision`.
    """

    def __init__(
        self,
        controller: Reaching,
        limits: tuple[float, float],
        span: float,
        fallback: Callable[[Any], Reaching] | None = None,
        *,
        judges: bool = True,
        holds: float = math.nan,
    ) -> None:
        super().__init__(controller, limits, span, fallback, judges=judges, holds=holds)
        self._watch = LimitCycleWatch(*limits)
        self._target = self._output = math.nan
        self._finished = False

    def aim(self, target: float, t: float, measured_input: float, output: float, *others: float) -> Command:
        """Aim at the next target; see `Reaching`. Raises ConvergenceError if the controller does not converge."""
        self._judge_target()
        self._target, self._output, self._finished = target, output, False
        command: Command = self._controller.aim(target, t, measured_input, output, *others)
        return self._watched(command, t, measured_input, output, others)

    def update(self, t: float, measured_input: float, output: float, *others: float) -> Command:
        """Go on towards the target; see `Reaching`. Raises ConvergenceError if the controller does not converge."""
        if math.isfinite(output):
            self._output = output
        command: Command = self._controller.update(t, measured_input, output, *others)
        return self._watched(command, t, measured_input, output, others)

    def _watched(
        self, command: Command, t: float, measured_input: float, output: float, others: tuple[float, ...]
    ) -> Command:
        self._finished = self._finished or command.done
        if self.gave_up:
            return command
        self._watch.note(command.setpoint, self._target)
        if self._watch.swings < _SWINGS:
            return command
        low, high = self._limits
        self._give_up(
            f"it sent the actuator {self._watch.swings} times from one end of its range ({low:g} to {high:g}) to the "
            f"other at the target {self._target:g}"
        )
        again: Command = self._controller.aim(self._target, t, measured_input, output, *others)
        return again

    def _judge_target(self) -> None:
        """Judge how the last target was met."""
        if not self._judges or self.gave_up or not self._finished:
            return
        error = self._output - self._target
        if self.reach is not Reach.MET:
            if math.isnan(self._holds) and abs(error) > _MISSED * self._span:
                missed = f"missed by {100.0 * abs(error) / self._span:.2g} % of the range"
                self._warn(f"the target {self._target:.4g} cannot be met within the limits: {missed}")
        elif doubt := getattr(self._controller, "doubt", ""):
            self._give_up(str(doubt))
        else:
            self._judge(error)


class SupervisedFollower(_Supervision):
    """A follower that is given up where it errs by more than its model, and more than by chance: a `Follower`.

    That is judged from 2 % of the range on; from 0.8 % on there is a warning. One without feedback is given up where
    its model does not hold. Samples at which the reference stands, as on the way to its beginning, or cannot be met,
    do not count. Parameters as `_Supervision`.
    """

    _window = SAMPLES
    _over = "samples"
    _chance = _CHANCE_OF_SAMPLES
    _strict = False

    def __init__(
        self,
        controller: Follower,
        limits: tuple[float, float],
        span: float,
        fallback: Callable[[Any], Follower] | None = None,
        *,
        judges: bool = True,
        holds: float = math.nan,
    ) -> None:
        super().__init__(controller, limits, span, fallback, judges=judges, holds=_MOVING * holds)
        self._reference = math.nan

    @property
    def horizon(self) -> int:
        """Number of coming periods whose reference the controller at work wants; 0 for none."""
        return self._controller.horizon if isinstance(self._controller, Foreseeing) else 0

    def foresee(self, references: NDArray[np.float64]) -> None:
        """Take the reference at the end of each coming period; see `Foreseeing`."""
        if isinstance(self._controller, Foreseeing):
            self._controller.foresee(references)

    def update(self, t: float, measured_input: float, output: float, reference: float) -> float:
        """Take in a reading; see `Follower`. Raises ConvergenceError if the follower does no good."""
        # The last reference is that of now.
        moves = reference != self._reference
        if moves and self._judges and not self.gave_up and self.reach is Reach.MET:
            self._judge(output - self._reference)
        self._reference = reference
        setpoint: float = self._controller.update(t, measured_input, output, reference)
        return setpoint
