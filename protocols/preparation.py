"""Preparation of general protocols: the load, and the reset of the memory."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from typing import TypeAlias, TypeVar

from bench.controllers import saturated_below
from bench.devices import Actuator, Signal
from bench.model_file import ModelFile
from bench.protocol import (
    Dwell,
    Message,
    Note,
    Phase,
    Prompt,
    ProtocolParameters,
    Reading,
    Slot,
    Slots,
    Step,
    from_slot,
    parameter,
    unit_of,
)

DRIVE_AND_RESPONSE: Mapping[str, type[Actuator] | type[Signal]] = {"drive": Actuator, "response": Signal}
"""What a characterization needs of a rig."""
LOAD: Mapping[str, type[Signal]] = {"load": Signal}
"""What it uses if the rig has it: a load that an operator hangs on the specimen."""

R = TypeVar("R")
Part: TypeAlias = Generator[Message, Reading, R]
"""A part of a protocol that returns something, such as its last reading."""

_SETTLE_LOAD = Dwell(5.0)


class LoadedParameters(ProtocolParameters):
    """What can be set where a specimen may carry a load."""

    load: float = parameter(
        from_slot("load", "rest", fallback=0.0), unit=unit_of("load"), help="load that is hung on; 0 for none"
    )


def hang_load(slots: Slots, load: float) -> Part[None]:
    """Have a load hung on the specimen, if the rig has such a slot, and check by its signal that this was done."""
    if "load" in slots and load:
        slot = slots["load"]
        tolerance = slot.table.tolerance_of(load)
        yield Prompt(
            text=slot.table.prompt.format(value=load, unit=slot.unit),
            task=slot.table.task or slot.name,
            value=load,
            settle=_SETTLE_LOAD,
            signal=slot.signal,
            low=load - tolerance,
            high=load + tolerance,
        )


def check_reset(model: ModelFile, drive: Slot, setpoint: float) -> None:
    """Check that a set-point saturates the specimen of a model.

    Raises
    ------
    ValueError
        If it does not.
    """
    if not saturated_below(model.operator, setpoint):
        raise ValueError(
            f"reset = {setpoint:g} {drive.unit} does not saturate the model's Preisach plane; "
            "choose it lower, or identify the model with a plane that begins higher"
        )


def unknown_memory(drive: Slot, setpoint: float) -> str:
    """Return the note that a run begins with where the memory is unknown."""
    return f"the memory of the specimen is unknown: it is reset to negative saturation at {setpoint:g} {drive.unit}"


def reset(slots: Slots, setpoint: float, minimum: float, *, load: float = 0.0, why: str = "") -> Part[Reading]:
    """Reset the memory of the specimen at a set-point that saturates it.

    Parameters
    ----------
    slots : Slots
        With the slot `drive`; its table says how the reset settles.
    setpoint : float
        Set-point of the drive.
    minimum : float
        Least time there, s.
    load : float
        Load that is hung on before; 0 for none.
    why : str
        A sentence for the log, if it is not the first part of a characterization.
    """
    drive = slots["drive"]
    yield from hang_load(slots, load)
    yield Phase("reset" if why else "reset to negative saturation")
    if why:
        yield Note(why)
    reading = yield Step({drive.device: setpoint}, drive.settle(minimum), label="reset")
    return reading
