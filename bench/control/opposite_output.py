"""A target controller of an actuator whose output falls, by one of the actuator with the opposite output."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from bench.control.tracking import Command, TargetController, Trace
from bench.models import Reach


class OppositeOutput:
    """A `TargetController` whose output is the opposite of that of the controller inside.

    For a controller whose steps are worked out for an output that rises with the input.

    Parameters
    ----------
    controller : TargetController
        Made from the operator with the opposite coefficients and bias.
    """

    def __init__(self, controller: TargetController) -> None:
        self._controller = controller

    def aim(self, target: float, t: float, measured_input: float, output: float) -> Command:
        """Start towards a new target and return the first command; see `TargetController.aim`."""
        return self._controller.aim(-target, t, measured_input, -output)

    def update(self, t: float, measured_input: float, output: float) -> Command:
        """Take in a reading and return the next command; see `TargetController.update`."""
        return self._controller.update(t, measured_input, -output)

    @property
    def trace(self) -> Trace:
        """Internal values at present."""
        trace = self._controller.trace
        return replace(trace, reference=-trace.reference, predicted=-trace.predicted, disturbance=-trace.disturbance)

    @property
    def state(self) -> Any:  # noqa: ANN401 - each operator has its own
        """Memory of the actuator as the controller knows it."""
        return self._controller.state

    @property
    def doubt(self) -> str:
        """Why the controller inside does not do what it should on this specimen; empty if it does."""
        return str(getattr(self._controller, "doubt", ""))

    @property
    def reach(self) -> Reach:
        """Whether the present target can be met."""
        return self._controller.reach.opposite
