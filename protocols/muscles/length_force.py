"""Characterization of a muscle at constant voltages: its length over the force."""

from __future__ import annotations

import numpy as np

from bench.protocol import Dwell, Messages, NumberList, Phase, Slots, Step, Views, from_slot, parameter, protocol
from protocols.muscles.parts import (
    ON_STAGE,
    SAMPLE,
    StageParameters,
    drive_to,
    fasten,
    over_range,
    reset_on_stage,
    stretch,
)
from protocols.preparation import check_order

_STRETCHED = 1.0 / 6.0
"""Error of a force that the stage sets, as a part of the pretension."""


class Parameters(StageParameters):
    """Parameters."""

    voltages: NumberList = parameter(over_range("drive", 6), unit="V", help="voltages, one after another")
    smallest_force: float = parameter(
        from_slot("force", "low"), unit="N", low=0.1, high=100, help="where the muscle is just taut"
    )
    largest_force: float = parameter(
        from_slot("force", "high"), unit="N", low=0.2, high=100, help="where the stage turns"
    )
    points: int = parameter(12, unit="1", low=2, high=1000, help="forces on the way up; one less on the way down")


@protocol(needs=ON_STAGE, views=Views((("force", "response"),)))
def length_force(parameters: Parameters, slots: Slots) -> Messages:
    """Characterize the length of a muscle over the force, at one constant voltage after another.

    For each voltage the memory is reset, the slack muscle is brought to the voltage, and the stage stretches it
    up to the largest force and back, with one reading after each dwell (Zhang and Yip 2017, sections II-A and
    V-A: 138 readings).
    """
    check_order(parameters, "smallest_force < largest_force", "N")
    up = np.linspace(parameters.smallest_force, parameters.largest_force, parameters.points)
    forces = [*up, *up[-2::-1]]
    yield from fasten(parameters, slots)
    for voltage in parameters.voltages:
        yield from reset_on_stage(parameters, slots)
        yield Phase(f"length over force at {voltage:g} V")
        yield Step({slots["stage"].device: parameters.slack}, Dwell(5.0))
        yield drive_to(slots, voltage, parameters.dwell, "")
        for force in forces:
            yield from stretch(parameters, slots, float(force), tolerance=_STRETCHED)
            yield Step({}, Dwell(parameters.dwell), label=SAMPLE)
