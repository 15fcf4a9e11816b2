"""Characterization of a muscle at constant length: its force over the voltage."""

from __future__ import annotations

from bench.identification import voltage_steps
from bench.protocol import Messages, Phase, Slots, Views, parameter, protocol
from protocols.muscles.parts import ON_STAGE, StageParameters, prepare_on_stage, sample_voltages


class Parameters(StageParameters):
    """Parameters."""

    points: int = parameter(37, unit="1", low=11, high=10000, help="number of voltages")
    conditioning: int = parameter(2, unit="1", low=0, high=100, help="voltage cycles at constant length before")


@protocol(needs=ON_STAGE, views=Views((("drive", "force"),)))
def force_voltage(parameters: Parameters, slots: Slots) -> Messages:
    """Characterize the force of a muscle over the voltage, with its ends held near its resting length.

    The muscle is fastened to the stage, reset, and conditioned by cycles of the voltage at constant length. Then
    the stage stretches it to the pretension, and the voltage goes through a damped oscillation, with one reading
    after each dwell (Zhang and Yip 2017, sections II-A and V-A: 0 to 3 V, 37 voltages, 30 s, 0.3 N).
    """
    yield from prepare_on_stage(parameters, slots, parameters.conditioning)
    yield Phase("force over voltage")
    yield from sample_voltages(parameters, slots, scaled_steps(parameters.highest, parameters.points))


def scaled_steps(highest: float, points: int) -> list[float]:
    """Return the paper's damped oscillation, stretched to another highest voltage (V)."""
    return [float(voltage) for voltage in voltage_steps(count=points) * (highest / 3.0)]
