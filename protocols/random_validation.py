"""Validation: a random sequence of set-points that was not used for identification."""

from __future__ import annotations

import numpy as np

from bench.identification import random_validation as validation_setpoints
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

    inner_low: float = parameter(
        from_slot("drive", lambda drive: drive.at(0.3), "30 % of the range of drive"),
        unit=DRIVE,
        help="lower end of the range of most targets",
    )
    inner_high: float = parameter(
        from_slot("drive", lambda drive: drive.at(0.8), "80 % of the range of drive"),
        unit=DRIVE,
        help="upper end of the range of most targets",
    )
    count: int = parameter(600, unit="1", low=10, high=100000, help="number of set-points")
    sequence_seed: int = parameter(5, unit="1", low=0, help="seed of the sequence, independent of the rig's seed")


@protocol(needs=DRIVE_AND_RESPONSE, may_use=LOAD, views=LOOP)
def random_validation(parameters: Parameters, slots: Slots) -> Messages:
    """Measure along a random sequence of set-points.

    Four of five targets lie within the inner range, the others anywhere, and ramps of `increment` join them
    (Zhang et al. 2013, Fig. 10: 600 set-points). The run begins by resetting the memory to negative
    saturation at `low`.
    """
    unit = slots["drive"].setpoint_unit
    check_order(parameters, "low < high", unit)
    check_order(parameters, "inner_low < inner_high", unit)
    ends = {name: getattr(parameters, name) for name in ("low", "inner_low", "inner_high", "high")}
    # One ramp may go from end to end.
    lowest, highest = min(ends, key=ends.__getitem__), max(ends, key=ends.__getitem__)
    check_increment(parameters, ends[highest] - ends[lowest], (lowest, highest), unit)
    setpoints = validation_setpoints(
        np.random.default_rng(parameters.sequence_seed),
        count=parameters.count,
        operating=(parameters.low, parameters.high),
        transition=(parameters.inner_low, parameters.inner_high),
        step=parameters.increment,
    )
    yield from reset(slots, float(setpoints[0]), parameters.dwell, load=parameters.load)
    yield Phase("random sequence")
    for target in setpoints[1:].tolist():
        yield Step({slots["drive"].device: target}, Dwell(parameters.dwell))
