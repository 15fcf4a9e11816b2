"""The complete inverse of the two-stage model: voltages and forces for lengths, forces and elastic loads."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bench.base import checks as _checks
from bench.models import Inverse, Reach, Stage, TwoStage, TwoStageState

_TOLERANCE = 1e-10
"""Part of an output range within which a target counts as met.

Source: rounding of float64: sums of 10⁵ cells err by no more than 10⁵ times 2.2e-16, 2e-11, in each of two stages.
"""


@dataclass(frozen=True)
class TwoStageInversion:
    """What the model says will meet a target, and where that leads.

    Parameters
    ----------
    voltage : float
        Voltage to apply.
    force, length : float
        Force and length that the model then has.
    reach : Reach
        Whether the target is met, else that it was too high or too low; force and length then are the
        closest that the voltage range and the range of the second stage allow.
    imposed : Reach
        The same for a length imposed beside a target force; `MET` where none was.
    state : TwoStageState
        State afterwards.
    """

    voltage: float
    force: float
    length: float
    reach: Reach
    imposed: Reach
    state: TwoStageState


@dataclass(frozen=True, eq=False)
class TwoStageInverse:
    """The complete inverse of length = H2[force - H1[voltage]] (Zhang and Yip 2017, eq. 6).

    The argument u = force - H1[voltage] of H2 decides the length, so each task takes one inverse of H2 and one of
    H1, both from the present memory:

    - length at a given force: u = H2⁻¹[length], voltage = H1⁻¹[force - u];
    - force between fixed ends: u stays, voltage = H1⁻¹[force - u];
    - length against an elastic load: as the first, with force = load(length);
    - force at a given length and voltage: force = H1[voltage] + H2⁻¹[length].

    Preisach stages are inverted exactly, segment by segment; Prandtl-Ishlinskii ones by their analytic
    inverse; others, and plays with plateaus, by bisection to the last digit. On plateaus the answer
    is the point nearest to the present input. Targets out of reach are clamped and flagged. A target counts
    as met within 1e-10 of the output range.

    Parameters
    ----------
    model : TwoStage
        The model to invert; both stages must rise with their input.

    Raises
    ------
    ValueError
        If a stage falls somewhere.
    """

    model: TwoStage

    def __post_init__(self) -> None:
        _ = self._first, self._second

    @cached_property
    def _first(self) -> Inverse[Any]:
        return _rising_inverse("first", self.model.first)

    @cached_property
    def _second(self) -> Inverse[Any]:
        return _rising_inverse("second", self.model.second)

    @cached_property
    def _tolerances(self) -> tuple[float, float]:
        """Within which a force and a length count as met."""
        spans = [float(np.ptp(stage.output_range())) for stage in (self.model.first, self.model.second)]
        forces = spans[0] + float(np.ptp(self.model.second.input_range))
        return _TOLERANCE * forces, _TOLERANCE * spans[1]

    def voltage_for_length(
        self, state: TwoStageState, length: float, force: float | None = None
    ) -> TwoStageInversion:
        """Return the voltage that brings the length to a target under a force (default: the present one).

        As in `TwoStage.step` the force moves first, then the voltage; units are those of the model. Raises ValueError
        if a number is not finite.
        """
        target = _checks.number("length", length)
        tension = state.force if force is None else _checks.number("force", force)
        loaded, _ = self.model.step(state, state.voltage, tension)
        low, high = (self._blocked(state, v) for v in self._voltages(state))
        bounds = tension - high, tension - low
        argument = self._second.nearest_input(loaded.second, loaded.argument, target, bounds)
        voltage = self._voltage(loaded, argument, tension)
        after, reached = self.model.step(loaded, voltage, tension)
        return self._result(after, self._length_flag(reached, target))

    def voltage_for_force(self, state: TwoStageState, force: float, length: float | None = None) -> TwoStageInversion:
        """Return the voltage that brings the force to a target between fixed ends (isometric).

        The argument u goes straight to that of the length, if one is imposed from now on, and stays where it is if
        the length is held. Units are those of the model. Raises ValueError if a number is not finite.
        """
        target = _checks.number("force", force)
        argument, imposed = state.argument, Reach.MET
        if length is not None:
            wanted = _checks.number("length", length)
            argument = self._second.nearest_input(state.second, state.argument, wanted)
        voltage = self._first.nearest_input(state.first, state.voltage, target - argument)
        after, reached = self.model.move(state, voltage, argument)
        if length is not None:
            imposed = self._length_flag(reached, length)
        return self._result(after, _flag(target - after.force, self._tolerances[0]), imposed)

    def _voltages(self, state: TwoStageState) -> tuple[float, float]:
        low, high = self.model.first.input_range
        return min(low, state.voltage), max(high, state.voltage)

    def _blocked(self, state: TwoStageState, voltage: float) -> float:
        return self.model.first.step(state.first, voltage)[1]

    def _voltage(self, state: TwoStageState, argument: float, force: float) -> float:
        # Where u need not move, rounding must not move the voltage either.
        if argument == state.argument:
            return state.voltage
        return self._first.nearest_input(state.first, state.voltage, force - argument)

    def _length_flag(self, reached: float, target: float) -> Reach:
        return _flag(target - reached, self._tolerances[1])

    @staticmethod
    def _result(after: TwoStageState, reach: Reach, imposed: Reach = Reach.MET) -> TwoStageInversion:
        return TwoStageInversion(after.voltage, after.force, after.length, reach, imposed, after)


def _flag(short: float, tolerance: float) -> Reach:
    return Reach.of(abs(short) <= tolerance, short)


def _rising_inverse(name: str, stage: Stage) -> Inverse[Any]:
    """Return the inverse of a stage that rises: else the ends of a move would not decide what the next stage saw."""
    if not stage.rises():
        raise ValueError(f"{name}: expected an operator that rises with its input, got a falling part")
    return stage.inverse()
