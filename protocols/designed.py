"""Characterization by designed sequences: every cell of the Preisach plane in few set-points."""

from __future__ import annotations

import numpy as np

from bench.identification import covering_sequence, first_order_reversals as reversal_setpoints
from bench.models import uniform_levels
from bench.protocol import Dwell, Messages, Phase, Slots, Step, from_slot, parameter, protocol
from protocols.preparation import DRIVE, DRIVE_AND_RESPONSE, LOAD, LOOP, SweepParameters, check_order, reset


class Parameters(SweepParameters):
    """What can be set."""

    plane_low: float = parameter(from_slot("drive", "low"), unit=DRIVE, help="lower end of the Preisach plane")
    plane_high: float = parameter(from_slot("drive", "high"), unit=DRIVE, help="upper end of the Preisach plane")
    levels: int = parameter(40, unit="1", low=2, high=200, help="levels of the sequence, as the model's or finer")
    per_cell: int = parameter(2, unit="1", low=1, high=20, help="set-points from one level to the next")


@protocol(needs=DRIVE_AND_RESPONSE, may_use=LOAD, views=LOOP)
def covering(parameters: Parameters, slots: Slots) -> Messages:
    """Characterize a hysteresis in the fewest set-points that cover every cell.

    Loops that shrink level by level: each cell of the plane is told apart from all others by the difference of two
    readings. One set-point a level is enough to determine a model of as many levels; twice as many levels, two
    set-points each, average noise as the damped oscillation does for a model of 20 levels, in half its time.
    `bench model design` shows what each sequence costs.
    """
    sequence = covering_sequence(*_grid(parameters, slots), per_cell=parameters.per_cell)
    yield from _carry_out(parameters, slots, sequence)


@protocol(needs=DRIVE_AND_RESPONSE, may_use=LOAD, views=LOOP)
def first_order_reversals(parameters: Parameters, slots: Slots) -> Messages:
    """Characterize a hysteresis by first-order reversal curves.

    From positive saturation down to each level in turn, and up again level by level (Mayergoyz, *Mathematical
    Models of Hysteresis and Their Applications*, 2003, chapter 1).
    """
    sequence = reversal_setpoints(*_grid(parameters, slots), per_cell=parameters.per_cell)
    yield from _carry_out(parameters, slots, sequence)


def _grid(parameters: Parameters, slots: Slots) -> tuple[np.ndarray, tuple[float, float]]:
    """Return the levels and the range of the drive; raises ValueError if the plane is not within the range."""
    unit = slots["drive"].setpoint_unit
    check_order(parameters, "low < high", unit)
    check_order(parameters, "low ≤ plane_low < plane_high ≤ high", unit)
    grid = uniform_levels(parameters.plane_low, parameters.plane_high, parameters.levels)
    return grid, (parameters.low, parameters.high)


def _carry_out(parameters: Parameters, slots: Slots, setpoints: np.ndarray) -> Messages:
    yield from reset(slots, parameters.low, parameters.dwell, load=parameters.load)
    yield Phase("designed sequence")
    for target in setpoints.tolist():
        yield Step({slots["drive"].device: target}, Dwell(parameters.dwell))
