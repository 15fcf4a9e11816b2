"""Characterization by nested loops: a damped oscillation of the drive that fills the Preisach plane."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from bench.identification import damped_oscillation as oscillation_setpoints
from bench.protocol import Dwell, Messages, Phase, Slots, Step, from_slot, parameter, protocol
from protocols.preparation import (
    DRIVE,
    DRIVE_AND_RESPONSE,
    LOAD,
    LOOP,
    RampParameters,
    check_increment,
    check_order,
    reset,
)


class Parameters(RampParameters):
    """What can be set."""

    high: float = parameter(from_slot("drive", "high"), unit=DRIVE, help="highest set-point, the first reversal")
    center: float = parameter(
        from_slot("drive", lambda drive: drive.at(0.5), "middle of the range of drive"),
        unit=DRIVE,
        help="set-point about which the oscillation decays",
    )
    half_cycles: int = parameter(36, unit="1", low=1, high=1000, help="number of half-cycles after the first rise")


@protocol(needs=DRIVE_AND_RESPONSE, may_use=LOAD, views=LOOP)
def damped_oscillation(parameters: Parameters, slots: Slots) -> Messages:
    """Characterize a hysteresis by nested minor loops.

    Rises from `low` to `high`, then swings about `center` with shrinking amplitude, in steps of `increment` with a
    fixed dwell and one reading each, so that every cell of the Preisach plane is swept (Zhang et al. 2013, section
    IV-B: 21 to 84 °C, 8 s, about 3000 set-points). `low` has to saturate the specimen: the run begins by resetting
    the memory to negative saturation there.
    """
    drive, unit = slots["drive"].device, slots["drive"].setpoint_unit
    check_order(parameters, "low < center < high", unit)
    ends = parameters.low, parameters.high, parameters.center, parameters.half_cycles
    corners = oscillation_setpoints(*ends, step=parameters.high - parameters.low)
    check_increment(parameters, float(np.abs(np.diff(corners)).sum()), ("low", "high"), unit)
    setpoints = oscillation_setpoints(*ends, step=parameters.increment)
    yield from reset(slots, float(setpoints[0]), parameters.dwell, load=parameters.load)
    yield Phase("rise")
    direction = 1.0
    for previous, target in pairwise(setpoints.tolist()):
        reversal = (target - previous) * direction < 0
        if reversal and previous == setpoints.max():
            yield Phase("damped oscillation")
        if reversal:
            direction = -direction
        yield Step({drive: target}, Dwell(parameters.dwell), label="reversal" if reversal else "")
