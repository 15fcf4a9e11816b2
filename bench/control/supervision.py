"""Watches over a controller: its feedback, made for another specimen, may do harm, or its model no longer hold."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.base import ConvergenceError, Floats
from bench.control.convergence import SWINGS_OF_A_TARGET, LimitCycleWatch
from bench.control.loops import Foreseeing
from bench.control.model_filters import ModelFilter
from bench.control.tracking import Command, Follower, TargetController, Trace
from bench.models import Reach


@dataclass(frozen=True, kw_only=True)
class Rules:
    """By which errors a controller is given up; keys of the rig file.

    Parameters
    ----------
    allowed : float
        Allowed RMS error, output units, > 0. Of a controller without feedback at least that of its model.
    targets : int
        Number of last targets that are judged, >= 3.
    quantile : float
        Quantile at which chance is excluded, above 0.5 and below 1.
    judges : bool
        Whether errors are judged. Not of a controller that corrects its model, which takes its time, nor of one that
        may miss targets by design.
    feedback : bool
        Whether the controller has feedback. One without is as good as its model, which is not compared with itself.

    Notes
    -----
    Both are textbook tests of variances (NIST/SEMATECH, *e-Handbook of Statistical Methods*, sections 1.3.5.8 and
    1.3.5.9): that of F compares the controller's error with that of its model alone, that of χ² with the allowed one.
    One missed target is no reason to end a run: both leave the greatest error out, with its degree of freedom, and so
    err on the side of the controller.
    """

    allowed: float
    targets: int = 5
    quantile: float = 0.95
    judges: bool = True
    feedback: bool = True

    def bounds(self) -> tuple[float, float, float]:
        """Return the greatest ratios of mean squares that chance explains: to the model's, and to the allowed one.

        The third is the ratio of all errors to the allowed one up to which they are within it, and not by chance.
        """
        from scipy.special import chdtri, fdtri

        others, beside = self.targets - 1, 1.0 - self.quantile
        return (
            float(fdtri(others, others, self.quantile)),
            float(chdtri(others, beside)) / others,
            float(chdtri(self.targets, self.quantile)) / self.targets,
        )


class _Supervision:
    """What the supervision of targets and of a moving reference share: the rules, and what follows from them."""

    def __init__(
        self,
        controller: Any,  # noqa: ANN401 - `TargetController` or `Follower`
        rules: Rules,
        fallback: Callable[[Any], Any] | None = None,
    ) -> None:
        self._controller: Any = controller
        self._rules = rules
        self._to_model, self._to_allowed, self._within = rules.bounds()
        self._fallback = fallback
        self._judged: deque[tuple[float, float]] = deque(maxlen=rules.targets)
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

    @property
    def _is_judging(self) -> bool:
        return self._rules.judges and not self.gave_up

    def _judge(self, error: float, alone: float) -> None:
        """Take mean squares at a target: of the error, and of that of the model alone, nan if nobody knows it.

        Raises ConvergenceError if the controller is given up and nothing goes on in its place.
        """
        if not math.isfinite(error):
            return
        self._judged.append((error, alone))
        if len(self._judged) < self._rules.targets:
            return
        table = np.sort(self._judged, axis=0)
        everything = float(table[:, 0].mean())
        # Of a controller that does not say what its model errs by, that is not known.
        errors, alone = table[:-1].mean(axis=0).tolist()
        allowed, feedback = self._rules.allowed**2, self._rules.feedback
        if everything <= (self._within if feedback else 1.0) * allowed:
            return
        text = f"over {len(table)} targets its error is {math.sqrt(everything):.3g} RMS, {math.sqrt(errors):.3g} but "
        text += f"for the greatest; allowed is {self._rules.allowed:.3g}"
        worse = feedback and errors > self._to_model * alone
        if worse:
            self._give_up(f"{text}, and the model alone, without feedback, would err by {math.sqrt(alone):.3g}")
        elif errors > self._to_allowed * allowed and not (feedback and self._fallback):
            self._give_up(text)
        else:
            known = ", by which it is not shown to be met" if everything <= allowed else ""
            self._warn(f"the {'controller' if feedback else 'model'} leaves an error: {text}{known}")

    def _warn(self, text: str) -> None:
        """Have something said, once in a run."""
        if not self._warned:
            self._notice, self._warned = text, True

    def _give_up(self, why: str) -> None:
        if self._rules.feedback:
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
    """A target controller that is given up when it does not converge: a `TargetController`.

    It is by the rules; if it sends the actuator to and fro between the ends of its range at one target; or if it says
    so itself (`doubt`). Targets that cannot be met do not count; one that is missed by more than what would be within
    the allowed error is warned of. Parameters as `_Supervision`; `limits` are the set-points that it may ask for,
    input units.
    """

    def __init__(
        self,
        controller: TargetController,
        limits: tuple[float, float],
        rules: Rules,
        fallback: Callable[[Any], TargetController] | None = None,
    ) -> None:
        super().__init__(controller, rules, fallback)
        self._limits = limits
        self._watch = LimitCycleWatch(*limits)
        self._target = self._output = math.nan
        self._finished = False

    def aim(self, target: float, t: float, measured_input: float, output: float, *others: float) -> Command:
        """Aim at the next target; see `TargetController`. Raises ConvergenceError if it does not converge."""
        self._judge_target()
        self._target, self._output, self._finished = target, output, False
        command: Command = self._controller.aim(target, t, measured_input, output, *others)
        return self._watched(command, t, measured_input, output, others)

    def update(self, t: float, measured_input: float, output: float, *others: float) -> Command:
        """Go on towards the target; see `TargetController`. Raises ConvergenceError if it does not converge."""
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
        if self._watch.swings <= SWINGS_OF_A_TARGET:
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
        if not self._is_judging or not self._finished:
            return
        error = self._output - self._target
        if self.reach is not Reach.MET:
            if self._rules.feedback and error**2 > self._within * self._rules.allowed**2:
                self._warn(f"the target {self._target:.4g} cannot be met within the limits: missed by {error:.3g}")
        elif doubt := getattr(self._controller, "doubt", ""):
            self._give_up(str(doubt))
        else:
            self._judge(error**2, self.trace.disturbance**2)


class SupervisedFollower(_Supervision):
    """A follower that is given up by the rules: a `Follower`.

    On a moving reference, a stretch in which the specimen forgets an error counts as one target. Samples at which
    the reference stands, as on the way to its beginning, or cannot be met, do not count. `stretch` is the number of
    samples in one stretch; other parameters as `_Supervision`.
    """

    def __init__(
        self,
        controller: Follower,
        stretch: int,
        rules: Rules,
        fallback: Callable[[Any], Follower] | None = None,
    ) -> None:
        super().__init__(controller, rules, fallback)
        self._stretch = stretch
        self._samples: list[tuple[float, float]] = []
        self._reference = math.nan

    @property
    def horizon(self) -> int:
        """Number of coming periods whose reference the controller at work wants; 0 for none."""
        return self._controller.horizon if isinstance(self._controller, Foreseeing) else 0

    def foresee(self, references: Floats) -> None:
        """Take the reference at the end of each coming period; see `Foreseeing`."""
        if isinstance(self._controller, Foreseeing):
            self._controller.foresee(references)

    def update(self, t: float, measured_input: float, output: float, reference: float) -> float:
        """Take in a reading; see `Follower`. Raises ConvergenceError if the follower does no good."""
        # The last reference is that of now.
        error, moves = output - self._reference, reference != self._reference
        if moves and self._is_judging and self.reach is Reach.MET and math.isfinite(error):
            self._samples.append((error, self.trace.disturbance))
        if len(self._samples) == self._stretch:
            self._judge(*np.mean(np.square(self._samples), axis=0).tolist())
            self._samples = []
        self._reference = reference
        setpoint: float = self._controller.update(t, measured_input, output, reference)
        return setpoint
