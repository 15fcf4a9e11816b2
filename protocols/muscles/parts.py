"""Parts of the protocols for artificial muscles: the reset, the weights, and the stage that stretches.

The slots are a `drive` (V), the `force` in the muscle (N), a `response` (the position of its lower end, m, positive
when the muscle is longer than at rest), and either a `load` that an operator hangs on it (N) and a `cooling` (a fan),
or a `stage` to which the lower end is fastened (m). Sequences follow Zhang and Yip, "Three-Dimensional Hysteresis
Modeling of Robotic Artificial Muscles with Application to Shape Memory Alloy Actuators", Robotics: Science and
Systems, 2017, sections II-A and V-A.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bench.control import Approach
from bench.devices import Actuator, Signal
from bench.protocol import (
    Control,
    Dwell,
    NumberList,
    Phase,
    Prompt,
    ProtocolParameters,
    Reading,
    Slots,
    Step,
    Views,
    from_slot,
    parameter,
    unit_of,
)
from bench.rig import RoleTable
from protocols.preparation import DRIVE_AND_RESPONSE, SETTLE_LOAD, Part, prompt_for

SAMPLE = "sample"
"""Label of the readings that count."""
CONDITIONING = "conditioning"
"""Label of the cycles of the voltage over its whole range before them."""

ON_WEIGHTS = {**DRIVE_AND_RESPONSE, "force": Signal, "load": Signal, "cooling": Actuator}
ON_STAGE = {**DRIVE_AND_RESPONSE, "force": Signal, "stage": Actuator}
"""Needs of a protocol where the muscle carries weights, and where the stage holds it."""

LENGTH_LOOPS = Views((("drive", "response"),), over_time=("response", "drive", "force"))
"""What is worth seeing where the muscle carries weights."""

_STRETCH_TIMEOUT = 900.0
_STRETCHED = 0.1
"""Error of a force that the stage sets, as a part of the pretension."""
_HUNG = 0.5, 0.02
"""Difference of the force from a weight that hangs, as parts of the pretension and of the weight, together."""
_FASTENED = -1.0, 3.0
"""Least and greatest force in a muscle that was fastened at its resting length, as parts of the pretension."""


def over_range(slot: str, count: int) -> Any:  # noqa: ANN401 - stands for a default of any type
    """Return a default for `parameter`: a number of values, evenly over the range of a slot, to three digits."""

    def take(table: RoleTable) -> tuple[float | None, ...] | None:
        return None if table.range is None else tuple(table.at(part) for part in np.linspace(0.0, 1.0, count))

    return from_slot(slot, take, f"{count} over the range of {slot}")


class ResetParameters(ProtocolParameters):
    """Parameters of each of these protocols."""

    highest: float = parameter(
        from_slot("drive", "high"),
        unit=unit_of("drive"),
        above=0.0,
        help="highest set-point, where the memory is reset",
    )
    dwell: float = parameter(
        from_slot("drive", "dwell"),
        unit="s",
        low=0.5,
        high=3600,
        help="hold at each set-point before the reading",
        changeable=True,
    )
    pretension: float = parameter(
        from_slot("force", "rest"), unit="N", low=0.05, high=10, help="force under which the memory is reset"
    )
    cooling: float = parameter(
        from_slot("cooling", "dwell"), unit="s", low=0, high=3600, help="time in which the muscle cools down by a fan"
    )


class StageParameters(ResetParameters):
    """Parameters where the stage stretches the muscle."""

    slack: float = parameter(
        from_slot("stage", "low"),
        unit="m",
        low=-0.1,
        high=0,
        help="position of the stage at which the muscle is slack at any voltage",
    )
    stiffnesses: NumberList = parameter(
        ..., unit="N/m", help="least and greatest stiffness of muscle and frame together that are believed"
    )
    largest_step: float = parameter(
        from_slot("stage", "increment"),
        unit="m",
        low=1e-6,
        high=1e-2,
        help="longest step of the stage; where a slack muscle becomes taut, its stiffness doubles within one",
    )


def drive_to(slots: Slots, value: float, seconds: float, label: str) -> Step:
    """Return the step that holds a set-point of the drive for a time (s)."""
    return Step({slots["drive"].device: value}, Dwell(seconds), label=label)


def hang(parameters: ResetParameters, slots: Slots, load: float) -> Part[Reading]:
    """Prompt for a load (N) on the muscle, and verify it with the load cell."""
    some, part = _HUNG
    return (yield from prompt_for(slots["load"], load, some * parameters.pretension + part * load))


def reset_under_weights(parameters: ResetParameters, slots: Slots) -> Part[Reading]:
    """Reset the memory: drive the muscle to its highest set-point and back to 0 under the pretension.

    The muscle cools before the weight is changed, as a hot one must not be touched.
    """
    yield Phase("reset")
    yield from cool(parameters, slots, 0.5)
    yield from hang(parameters, slots, parameters.pretension)
    yield drive_to(slots, parameters.highest, parameters.dwell, "reset")
    return (yield from cool(parameters, slots, parameters.dwell))


def cool(parameters: ResetParameters, slots: Slots, seconds: float) -> Part[Reading]:
    """Go to 0 with the fan on, then let the muscle stand without it for a time (s)."""
    drive, fan = slots["drive"].device, slots["cooling"].device
    yield Step({drive: 0.0, fan: 1.0}, Dwell(parameters.cooling), label="reset")
    reading = yield Step({fan: 0.0}, Dwell(seconds), label="reset")
    return reading


def fasten(parameters: StageParameters, slots: Slots) -> Part[Reading]:
    """Prompt for the end of the cold muscle to be fastened to the stage."""
    yield Step({slots["drive"].device: 0.0, slots["stage"].device: 0.0}, Dwell(5.0), label="fasten")
    least, greatest = (part * parameters.pretension for part in _FASTENED)
    reading = yield Prompt(
        text="Take the weight off and fasten the end of the muscle to the stage, where both stand at 0 m",
        task="stage",
        value=0.0,
        settle=SETTLE_LOAD,
        signal=slots["force"].signal,
        low=least,
        high=greatest,
    )
    return reading


def stretch(
    parameters: StageParameters, slots: Slots, force: float, *, tolerance: float = _STRETCHED, duration: float = 0.0
) -> Part[Reading]:
    """Stretch the muscle until it pulls with a force (N); or hold that force for a time (s).

    The tolerance is a part of the pretension. Raises ValueError if the stiffnesses are not two positive numbers.
    """
    stiffnesses = parameters.stiffnesses
    if len(stiffnesses) != 2 or not 0.0 < stiffnesses[0] <= stiffnesses[1]:
        given = ", ".join(f"{stiffness:g}" for stiffness in stiffnesses)
        raise ValueError(
            f"parameter stiffnesses = {given} N/m is not allowed; allowed: two positive numbers, the lower one first"
        )
    least, greatest = stiffnesses
    stage = slots["stage"]
    reading = yield Control(
        task=Approach(
            force,
            slopes=(least, greatest),
            largest_step=parameters.largest_step,
            tolerance=tolerance * parameters.pretension,
            duration=duration,
        ),
        actuator=stage.device,
        drive=stage.signal,
        response=slots["force"].signal,
        timeout=duration + _STRETCH_TIMEOUT,
        label="stretch",
    )
    return reading


def prepare_on_stage(parameters: StageParameters, slots: Slots, cycles: int) -> Part[Reading]:
    """Fasten the muscle, reset it, condition it by cycles of the voltage, and stretch it to the pretension."""
    yield from fasten(parameters, slots)
    yield from reset_on_stage(parameters, slots)
    yield Phase("conditioning")
    for _ in range(cycles):
        yield drive_to(slots, parameters.highest, parameters.dwell, CONDITIONING)
        yield drive_to(slots, 0.0, parameters.dwell, CONDITIONING)
    return (yield from stretch(parameters, slots, parameters.pretension))


def reset_on_stage(parameters: StageParameters, slots: Slots) -> Part[Reading]:
    """Reset the memory as under weights: heat the slack muscle, and cool it while the stage holds the pretension."""
    yield Phase("reset")
    yield Step({slots["stage"].device: parameters.slack}, Dwell(5.0), label="reset")
    yield drive_to(slots, parameters.highest, parameters.dwell, "reset")
    yield from stretch(parameters, slots, parameters.pretension)
    # Without the fan: the stage has to keep up with the muscle.
    yield drive_to(slots, 0.0, 0.1, "reset")
    yield from stretch(parameters, slots, parameters.pretension, duration=parameters.dwell + parameters.cooling)
    return (yield from stretch(parameters, slots, parameters.pretension))


def sample_voltages(parameters: ResetParameters, slots: Slots, voltages: Sequence[float]) -> Part[Reading]:
    """Step through voltages (V), with one reading each after the dwell."""
    for voltage in voltages:
        reading = yield drive_to(slots, voltage, parameters.dwell, SAMPLE)
    return reading
