"""What the protocols for artificial muscles share: the reset, the weights, and the stage that stretches.

The rig has a `supply` that drives the muscle, a `load_cell` from which it hangs, a sensor at its lower end
(`wire_end_position`, m, positive when the muscle is longer than at rest), and a `stage` to which that end may be
fastened. Sequences follow Zhang and Yip, "Three-Dimensional Hysteresis Modeling of Robotic Artificial Muscles with
Application to Shape Memory Alloy Actuators", Robotics: Science and Systems, 2017, sections II-A and V-A.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from typing import TypeAlias, TypeVar

from bench.control.stretching import Stretch
from bench.muscle_runs import FORCE, LENGTH, SAMPLE
from bench.protocol import (
    Control,
    Dwell,
    Message,
    Phase,
    Prompt,
    ProtocolParameters,
    Reading,
    Step,
    parameter,
)

ON_WEIGHTS = ("supply", FORCE, LENGTH, "fan")
ON_STAGE = ("supply", FORCE, LENGTH, "stage", "stage_position")
"""What a protocol needs of the rig where the muscle carries weights, and where the stage holds it."""

LOADS = (0.98, 2.94, 4.90, 6.86, 8.82)
"""Dead loads, N (Zhang and Yip 2017, section II-A)."""

_COOL_SECONDS = 20.0
_SETTLE_LOAD = Dwell(5.0)
_STRETCH_TIMEOUT = 900.0

R = TypeVar("R")
Part: TypeAlias = Generator[Message, Reading, R]
"""A part of a protocol that returns something, such as its last reading."""


class MuscleParameters(ProtocolParameters):
    """What can be set in each of these protocols."""

    highest: float = parameter(3.0, unit="V", low=0.1, high=60, help="highest voltage, where the memory is reset")
    dwell: float = parameter(30.0, unit="s", low=0.5, high=3600, help="hold at each set-point before the reading")
    pretension: float = parameter(0.3, unit="N", low=0.05, high=10, help="force under which the memory is reset")


class StageParameters(MuscleParameters):
    """What can be set where the stage stretches the muscle."""

    slack: float = parameter(
        -6e-3, unit="m", low=-0.1, high=0, help="position of the stage at which the muscle is slack at any voltage"
    )


def parse_numbers(name: str, text: str) -> tuple[float, ...]:
    """Return the numbers of a parameter such as `0.98, 2.94`.

    Raises
    ------
    ValueError
        If one of them is no finite number, or there is none at all.
    """
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if not values or not all(map(math.isfinite, values)):
        raise ValueError(f"{name} = {text!r}: expected numbers with commas between them, such as 0.98, 2.94")
    return values


def hang(load: float) -> Part[Reading]:
    """Have a load (N) hung on the muscle, and see by the load cell that it was."""
    tolerance = 0.15 + 0.02 * load
    reading = yield Prompt(
        text=f"Hang {load:g} N on the muscle, hook and magnet included, and let it come to rest",
        task="load",
        value=load,
        settle=_SETTLE_LOAD,
        signal=FORCE,
        low=load - tolerance,
        high=load + tolerance,
    )
    return reading


def reset_under_weights(parameters: MuscleParameters) -> Part[Reading]:
    """Reset the memory: drive the muscle to its highest voltage and back to 0 V under the pretension.

    Nobody shall touch a hot muscle: it cools before the weight is changed.
    """
    yield Phase("reset")
    yield Step({"supply": 0.0, "fan": 1.0}, Dwell(_COOL_SECONDS), label="reset")
    yield Step({"fan": 0.0}, Dwell(0.5), label="reset")
    yield from hang(parameters.pretension)
    yield Step({"supply": parameters.highest}, Dwell(parameters.dwell), label="reset")
    return (yield from cool(parameters))


def cool(parameters: MuscleParameters) -> Part[Reading]:
    """Go to 0 V with the fan on, then let the muscle stand without it."""
    yield Step({"supply": 0.0, "fan": 1.0}, Dwell(_COOL_SECONDS), label="reset")
    reading = yield Step({"fan": 0.0}, Dwell(parameters.dwell), label="reset")
    return reading


def fasten() -> Part[Reading]:
    """Have the end of the cold muscle fastened to the stage."""
    yield Step({"supply": 0.0, "stage": 0.0}, Dwell(5.0), label="fasten")
    reading = yield Prompt(
        text="Take the weight off and fasten the end of the muscle to the stage, where both stand at 0 m",
        task="stage",
        value=0.0,
        settle=_SETTLE_LOAD,
        signal=FORCE,
        low=-0.3,
        high=1.0,
    )
    return reading


def stretch(force: float, *, tolerance: float = 0.03, duration: float = 0.0) -> Part[Reading]:
    """Stretch the muscle until it pulls with a force (N); or hold that force for a time (s)."""
    reading = yield Control(
        task=Stretch(force, tolerance=tolerance, duration=duration),
        actuator="stage",
        drive="stage_position",
        response=FORCE,
        timeout=duration + _STRETCH_TIMEOUT,
        label="stretch",
    )
    return reading


def reset_on_stage(parameters: StageParameters) -> Part[Reading]:
    """Reset the memory as under weights: heat the slack muscle, and cool it while the stage holds the pretension."""
    yield Phase("reset")
    yield Step({"stage": parameters.slack}, Dwell(5.0), label="reset")
    yield Step({"supply": parameters.highest}, Dwell(parameters.dwell), label="reset")
    yield from stretch(parameters.pretension)
    # Without the fan: the stage has to keep up with the muscle.
    yield Step({"supply": 0.0}, Dwell(0.1), label="reset")
    yield from stretch(parameters.pretension, duration=parameters.dwell + _COOL_SECONDS)
    return (yield from stretch(parameters.pretension))


def sample_voltages(parameters: MuscleParameters, voltages: Sequence[float]) -> Part[Reading]:
    """Step through voltages (V), with one reading each after the dwell."""
    for voltage in voltages:
        reading = yield Step({"supply": voltage}, Dwell(parameters.dwell), label=SAMPLE)
    return reading
