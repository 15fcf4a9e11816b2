"""Watches over a target controller, whose feedback may do harm on another specimen than it was made for."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from bench.control.convergence import MOST_SWINGS, LimitCycleWatch
from bench.control.loops import Reaching
from bench.control.model_filters import ModelFilter
from bench.control.tracking import Command, Trace
from bench.errors import ConvergenceError
from bench.hysteresis import Reach

TARGETS = 5
"""Number of targets in a row over which errors are judged."""
_TOLERANCE = 0.02
"""Part of the range of the targets within which no error is judged."""
_BEYOND = 2.25
"""Ratio of two RMS errors over five targets that chance exceeds in 5 % of cases: the root of F(5, 5) = 5.05."""
_SWINGS = MOST_SWINGS - 2
"""Swings at one target after which its controller is given up: fewer than those that end the run."""


class Supervised:
    """A target controller that is given up when it does not converge: a `Reaching`.

    It does not if it sends the actuator to and fro between the ends of its range at one target; or if over several
    targets it errs by more than its model does at the same places, and more than by chance: then the model alone,
    without feedback, would have been better; or if it says so itself (`doubt`). Targets that cannot be met do not
    count, and a controller that does not say what its model errs by is judged by the swings alone.

    Parameters
    ----------
    controller : Reaching
        The controller.
    limits : (float, float)
        Set-points that it may ask for, input units.
    span : float
        Range of the targets, output units, > 0.
    fallback : callable or None
        Makes the controller that goes on, from the memory of the one that is given up. Without it a
        `ConvergenceError` ends the run in the safe state.
    compares : bool
        Whether errors are compared with those of the model. Not of a controller that corrects its model: what that
        errs by at present is the same.
    """

    def __init__(
        self,
        controller: Reaching,
        limits: tuple[float, float],
        span: float,
        fallback: Callable[[Any], Reaching] | None = None,
        *,
        compares: bool = True,
    ) -> None:
        self._controller: Any = controller
        self._watch = LimitCycleWatch(*limits)
        self._limits = limits
        self._tolerance = _TOLERANCE * span
        self._fallback = fallback
        self._compares = compares
        self._judged: deque[tuple[float, float]] = deque(maxlen=TARGETS)
        self._target = self._output = math.nan
        self._finished = False
        self._notice = ""
        self.gave_up = False
        """Whether the fallback is at work."""

    def aim(self, target: float, t: float, measured_input: float, output: float, *others: float) -> Command:
        """Aim at the next target; see `Reaching`. Raises ConvergenceError if the controller does not converge."""
        if why := self._judge():
            self._give_up(why)
        self._target, self._output, self._finished = target, output, False
        command: Command = self._controller.aim(target, t, measured_input, output, *others)
        return self._watched(command, t, measured_input, output, others)

    def update(self, t: float, measured_input: float, output: float, *others: float) -> Command:
        """Go on towards the target; see `Reaching`. Raises ConvergenceError if the controller does not converge."""
        if math.isfinite(output):
            self._output = output
        command: Command = self._controller.update(t, measured_input, output, *others)
        return self._watched(command, t, measured_input, output, others)

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
        """Whether the present target can be met."""
        reach: Reach = self._controller.reach
        return reach

    def take_notice(self) -> str:
        """Return why the controller was given up, once; empty if it was not."""
        notice, self._notice = self._notice, ""
        return notice

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

    def _judge(self) -> str:
        """Judge how the last target was met; return why the controller does not converge, or nothing."""
        if not self._compares or self.gave_up or not self._finished or self.reach is not Reach.MET:
            return ""
        if doubt := getattr(self._controller, "doubt", ""):
            return str(doubt)
        error, without = self._output - self._target, self.trace.disturbance
        if not math.isfinite(without):
            return ""
        self._judged.append((error, without))
        if len(self._judged) < TARGETS:
            return ""
        errors, opened = np.sqrt(np.mean(np.square(self._judged), axis=0)).tolist()
        if errors <= max(_BEYOND * opened, self._tolerance):
            return ""
        return (
            f"over {TARGETS} targets its error is {errors:.3g} RMS, and that of its model alone, without feedback, "
            f"{opened:.3g}"
        )

    def _give_up(self, why: str) -> None:
        text = f"the controller does not converge: {why}"
        if self._fallback is None:
            raise ConvergenceError(
                f"{text}; tune it for this specimen, identify the specimen again, or set fallback=open-loop to go on "
                "without feedback"
            )
        if self._controller.state is None:
            raise ConvergenceError(f"{text}; it keeps no memory of the specimen from which the open loop could go on")
        self._notice = f"{text}; it goes on in open loop"
        self._controller = self._fallback(self._controller.state)
        self.gave_up = True
