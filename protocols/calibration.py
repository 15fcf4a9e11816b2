"""Calibration of sensors by values that an operator sets up: weights, gauge blocks, angles of a mirror, a micrometer.

`bench rig calibrate` makes a calibration of such a run. Where an instrument reads the values, as an autocollimator
does, its signal is in the record as well, and takes the place of what the operator set up.
"""

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


class MirrorParameters(CommonParameters):
    """Parameters of the calibration by a mirror."""

    angles: NumberList = parameter(..., unit="°", help="angles of the mirror, one after another")
    sensitivity: float = parameter(
        ..., unit="m/°", above=0.0, high=1.0, help="reading of the detector for an angle, as it is expected"
    )
    tolerance: float = parameter(
        ..., unit="m", low=1e-9, high=1.0, help="farthest reading from the expected one that is believed"
    )


class DetectorParameters(CommonParameters):
    """Parameters of the calibration by a stage under the detector."""

    movements: NumberList = parameter(..., unit="m", help="places of the detector by the micrometer")
    magnification: float = parameter(
        ..., unit="1", above=0.0, high=1e6, help="way of the spot on the detector, as a multiple of the tip's"
    )
    tolerance: float = parameter(
        ..., unit="m", low=1e-9, high=1.0, help="farthest reading from the expected one that is believed"
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

    They are the reference of the calibration.
    """
    if min(parameters.weights) < 0.0:
        weights = ", ".join(f"{weight:g}" for weight in parameters.weights)
        raise ValueError(f"parameter weights = {weights} N is not allowed; allowed: numbers ≥ 0")
    yield from _compare(slots["load"], parameters.weights, parameters.tolerance, parameters)


@protocol(needs={"gauge": Signal})
def calibration_position(parameters: BlockParameters, slots: Slots) -> Messages:
    """Read a position sensor with gauge blocks that an operator puts under it.

    They are the reference of the calibration.
    """
    yield from _compare(slots["gauge"], parameters.positions, parameters.tolerance, parameters)


@protocol(needs={"mirror": Signal})
def calibration_mirror(parameters: MirrorParameters, slots: Slots) -> Messages:
    """Read a position-sensitive detector while an operator tilts a mirror in place of the cantilever.

    The whole chain from angle to reading is calibrated, the lever from mirror to detector included. The reference
    is the goniometer under the mirror: `bench rig calibrate` with `--unit °`. One that is read by the rig, such as an
    autocollimator, is named by `--reference`.
    """
    p = parameters
    yield from _compare(slots["mirror"], p.angles, p.tolerance, p, unit="°", expected=p.sensitivity)


@protocol(needs={"detector": Signal})
def calibration_detector(parameters: DetectorParameters, slots: Slots) -> Messages:
    """Read a position-sensitive detector while an operator moves it on a micrometer stage and the spot stands still.

    The reference is the micrometer, divided by the magnification. That finds the nonlinearity of the detector, but
    not the gain: the uncertainty of the lever stays, and is given to `bench rig calibrate` by `--gain-uncertainty`.
    """
    p = parameters
    scale = 1.0 / p.magnification
    yield from _compare(slots["detector"], p.movements, p.tolerance, p, expected=scale, scale=scale)


def _compare(
    slot: Slot,
    values: NumberList,
    tolerance: float,
    parameters: CommonParameters,
    *,
    unit: str = "",
    expected: float = 1.0,
    scale: float = 1.0,
) -> Messages:
    """Prompt for values, and read each, labelled by `scale` times the value; expect `expected` times the value."""
    unit = unit or slot.unit
    for value in values:
        yield Phase(f"{value:g} {unit}")
        yield from prompt_for(slot, value, tolerance, unit=unit, expected=expected)
        for _ in range(parameters.readings):
            yield Step({}, Dwell(parameters.dwell), label=repr(scale * value))
