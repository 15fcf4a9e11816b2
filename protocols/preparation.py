"""Preparation of general protocols: the load, and the reset of the memory."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from typing import TypeAlias, TypeVar

from bench.control import Fallback, Rules, Tuning, load_model_for, saturated_below
from bench.devices import Actuator, Signal
from bench.identification import ModelFile
from bench.protocol import (
    LONGEST,
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
    Views,
    difference_of,
    from_slot,
    parameter,
    unit_of,
)

DRIVE_AND_RESPONSE: Mapping[str, type[Actuator] | type[Signal]] = {"drive": Actuator, "response": Signal}
"""What a characterization needs of a rig."""
LOAD: Mapping[str, type[Signal]] = {"load": Signal}
"""What it uses if the rig has it: a load that an operator hangs on the specimen."""

LOOP = Views(loops=(("drive", "response"),))
"""What is worth seeing of it."""

R = TypeVar("R")
Part: TypeAlias = Generator[Message, Reading, R]
"""A part of a protocol that returns something, such as its last reading."""

SETTLE_LOAD = Dwell(5.0)
"""What follows when an operator has changed the load."""

DRIVE = unit_of("drive")


class LoadedParameters(ProtocolParameters):
    """What can be set where a specimen may carry a load."""

    load: float = parameter(
        from_slot("load", "rest", fallback=0.0),
        unit=unit_of("load"),
        low=0.0,
        help="load that is hung on; 0 for none",
    )


class SweepParameters(LoadedParameters):
    """What can be set where the drive sweeps its range, set-point by set-point."""

    low: float = parameter(from_slot("drive", "low"), unit=DRIVE, help="lowest set-point, where the memory is reset")
    high: float = parameter(from_slot("drive", "high"), unit=DRIVE, help="highest set-point")
    dwell: float = parameter(
        from_slot("drive", "dwell"),
        unit="s",
        low=0.01,
        high=3600,
        help="hold at each set-point before the reading",
        changeable=True,
    )


class RampParameters(SweepParameters):
    """What can be set where ramps join the set-points."""

    increment: float = parameter(
        from_slot("drive", "increment"),
        unit=difference_of("drive"),
        above=0.0,
        help="largest difference of neighbouring set-points",
    )


class SupervisedParameters(ProtocolParameters):
    """What can be set where a controller is given up by its errors."""

    allowed_error: float = parameter(
        0.02,
        unit="1",
        above=0.0,
        high=1.0,
        help="allowed RMS error, as a part of the range of the model's output; without feedback at least that of the "
        "model on its own data",
    )
    judged_targets: int = parameter(
        5,
        unit="1",
        low=3,
        high=1000,
        help="number of last targets whose errors are judged; of a moving reference, stretches of the dwell time",
    )
    judged_quantile: float = parameter(
        0.95,
        unit="1",
        low=0.6,
        high=0.9999,
        help="quantile from which on an error is not by chance beyond the allowed one, or that of the model alone",
    )
    fallback: Fallback = parameter(
        "none", unit="", help="what goes on in place of a controller that is given up; none ends the run"
    )

    def rules(self, span: float) -> Rules:
        """Return by which errors a controller is given up whose model has an output of a range (output units)."""
        return Rules(allowed=self.allowed_error * span, targets=self.judged_targets, quantile=self.judged_quantile)


class ControlledParameters(LoadedParameters):
    """What can be set where a controller by a model drives the specimen."""

    model: str = parameter(..., unit="", help="model file, as `bench identify` writes it", file=True)
    reset: float = parameter(from_slot("drive", "saturating"), unit=DRIVE, help="where the memory is reset")
    hottest: float = parameter(from_slot("drive", "high"), unit=DRIVE, help="highest set-point allowed")
    tuning: Tuning = parameter(
        {},
        unit="",
        help="numbers of controllers in place of their defaults: a tuning file, or tables of the rig file",
    )


def check_order(parameters: ProtocolParameters, order: str, unit: str) -> None:
    """Raise ValueError unless parameters are in an order, such as `low < center ≤ high`; names the first that is not.

    `unit` is that of all of them.
    """
    words = order.split()
    for first, sign, second in zip(words[::2], words[1::2], words[2::2], strict=False):
        lower, upper = getattr(parameters, first), getattr(parameters, second)
        if lower > upper or (lower == upper and sign == "<"):
            raise ValueError(
                f"parameter {first} = {lower:g} {unit} is not allowed with {second} = {upper:g} {unit}; "
                f"allowed: {order}"
            )


def check_increment(parameters: RampParameters, way: float, ends: tuple[str, str], unit: str) -> None:
    """Raise ValueError if ramps would have more than a million set-points.

    `way` is their length in all, `ends` names the parameters between which they are, `unit` is that of the drive.
    """
    low, high = (f"{name} = {getattr(parameters, name):g}" for name in ends)
    least = way / LONGEST
    if parameters.increment < least:
        raise ValueError(
            f"parameter increment = {parameters.increment:g} {unit} is not allowed from {low} to {high} {unit}, "
            f"which would take more than {LONGEST} set-points; allowed: ≥ {least:.3g} {unit}"
        )


def load_checked_model(parameters: ControlledParameters, slots: Slots) -> ModelFile:
    """Return the model in the units of the slots.

    Raises DataError as `load_model_for`, and ValueError if the reset is not below the highest set-point, or does not
    saturate the specimen of the model.
    """
    drive, setpoint = slots["drive"], parameters.reset
    check_order(parameters, "reset < hottest", drive.unit)
    model = load_model_for(parameters.model, input_unit=drive.unit, output_unit=slots["response"].unit)
    if not saturated_below(model.operator, setpoint):
        raise ValueError(
            f"reset = {setpoint:g} {drive.unit} does not saturate the model's Preisach plane; "
            "choose it lower, or identify the model with a plane that begins higher"
        )
    return model


def hang_load(slots: Slots, load: float) -> Part[None]:
    """Have a load hung on the specimen, if the rig has such a slot, and check by its signal that this was done."""
    if "load" in slots and load:
        yield from prompt_for(slots["load"], load, slots["load"].table.tolerance_of(load))


def prompt_for(slot: Slot, value: float, tolerance: float, *, unit: str = "", expected: float = 1.0) -> Part[Reading]:
    """Prompt for a value set up by hand, and verify by the slot's signal, within a tolerance, that this was done.

    The value is in the unit of the slot unless one is given, and the reading `expected` times that.
    """
    reading = yield Prompt(
        text=slot.table.prompt.format(value=value, unit=unit or slot.unit),
        task=slot.table.task or slot.name,
        value=value,
        settle=SETTLE_LOAD,
        signal=slot.signal,
        low=expected * value - tolerance,
        high=expected * value + tolerance,
    )
    return reading


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


def reset_unknown_memory(parameters: ControlledParameters, slots: Slots, minimum: float) -> Part[Reading]:
    """Reset the memory of a specimen of which nothing is known, for a least time (s), and say so in the log."""
    setpoint = parameters.reset
    why = f"the memory of the specimen is unknown: it is reset to negative saturation at {setpoint:g} "
    return (yield from reset(slots, setpoint, minimum, load=parameters.load, why=why + slots["drive"].unit))
