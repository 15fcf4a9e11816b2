"""Calibration of sensors by values that an operator sets up: dead weights, and gauge blocks."""

from __future__ import annotations

from bench.devices import Signal
from bench.protocol import (
    Dwell,
    Messages,
    NumberList,
    Phase,
    ProtocolParameters,
    Slot,
    Slots,
    Step,
    parameter,
    protocol,
)
from protocols.preparation import prompt_for


class CommonParameters(ProtocolParameters):
    """What can be set where values are set up by hand."""

    readings: int = parameter(10, unit="1", low=1, high=10000, help="readings of each value")
    dwell: float = parameter(1.0, unit="s", low=0.0, high=3600, help="time before each reading")


class WeightParameters(CommonParameters):
    """Parameters of the calibration by weights."""

    weights: NumberList = parameter(..., unit="N", help="dead weights ≥ 0, one after another")
    tolerance: float = parameter(
        ..., unit="N", low=1e-3, high=1e3, help="farthest reading from the weight that is believed"
    )


class BlockParameters(CommonParameters):
    """Parameters of the calibration by gauge blocks."""

    positions: NumberList = parameter(..., unit="m", help="positions that the blocks give, one after another")
    tolerance: float = parameter(
        ..., unit="m", low=1e-6, high=1.0, help="farthest reading from the position that is believed"
    )


@protocol(needs={"load": Signal})
def calibration_load(parameters: WeightParameters, slots: Slots) -> Messages:
    """Read a load cell under dead weights that an operator hangs on it.

    `bench rig calibrate` makes a calibration of the run: its reference are the weights.
    """
    if min(parameters.weights) < 0.0:
        weights = ", ".join(f"{weight:g}" for weight in parameters.weights)
        raise ValueError(f"parameter weights = {weights} N is not allowed; allowed: numbers ≥ 0")
    yield from _compare(slots["load"], parameters.weights, parameters.tolerance, parameters)


@protocol(needs={"gauge": Signal})
def calibration_position(parameters: BlockParameters, slots: Slots) -> Messages:
    """Read a position sensor with gauge blocks that an operator puts under it.

    `bench rig calibrate` makes a calibration of the run: its reference are the blocks.
    """
    yield from _compare(slots["gauge"], parameters.positions, parameters.tolerance, parameters)


def _compare(slot: Slot, values: NumberList, tolerance: float, parameters: CommonParameters) -> Messages:
    """Prompt for one value after another, and read each; the label of a reading is its value."""
    for value in values:
        yield Phase(f"{value:g} {slot.unit}")
        yield from prompt_for(slot, value, tolerance)
        for _ in range(parameters.readings):
            yield Step({}, Dwell(parameters.dwell), label=repr(float(value)))
