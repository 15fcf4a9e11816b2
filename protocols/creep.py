"""Creep: how the response changes while the drive is constant."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

from bench.devices import Actuator, Signal
from bench.protocol import (
    Dwell,
    Messages,
    Phase,
    Slot,
    Slots,
    Step,
    Summary,
    Views,
    from_slot,
    parameter,
    protocol,
    unit_of,
)
from protocols.preparation import LOAD, LoadedParameters, hang_load

_DRIVE = unit_of("drive")


class Parameters(LoadedParameters):
    """What can be set."""

    start: float = parameter(from_slot("drive", "rest"), unit=_DRIVE, help="set-point from which the first step goes")
    hot: float = parameter(
        from_slot("drive", lambda drive: drive.at(0.95), "95 % of the range of drive"),
        unit=_DRIVE,
        help="set-point held after the step up",
    )
    cool: float = parameter(
        from_slot("drive", lambda drive: drive.at(0.45), "45 % of the range of drive"),
        unit=_DRIVE,
        help="set-point held after the step down",
    )
    duration: float = parameter(60.0, unit="s", low=1, high=86400, help="how long each set-point is held and watched")
    interval: float = parameter(0.5, unit="s", low=0.05, high=3600, help="time between two readings")
    settling: float = parameter(5.0, unit="s", low=0, high=3600, help="time after a step that counts as settling")


@protocol(
    needs={"drive": Actuator, "response": Signal},
    may_use=LOAD,
    views=Views((("drive", "response"),), plane=False, over_time=("response", "drive")),
)
def creep(parameters: Parameters, slots: Slots) -> Messages:
    """Step the drive up and down, and watch the response at each set-point.

    The change of the response between the end of settling and the end of the hold is logged for each set-point. A
    specimen without creep shows no more than what the control of the drive leaves over (Zhang et al. 2013, Fig. 4).
    """
    drive, response = slots["drive"], slots["response"]
    if parameters.settling + 2 * parameters.interval > parameters.duration:
        raise ValueError(
            f"parameter settling = {parameters.settling:g} s is not allowed with interval = {parameters.interval:g} s"
            f" and duration = {parameters.duration:g} s; allowed: settling + 2 × interval ≤ duration"
        )
    yield from hang_load(slots, parameters.load)
    yield Phase("start")
    yield Step({drive.device: parameters.start}, drive.settle(0.0))
    for name, setpoint in (("hot", parameters.hot), ("cool", parameters.cool)):
        yield Phase(name)
        yield Step({drive.device: setpoint}, Dwell(0.0), label="step")
        responses: list[float] = []
        for i in range(math.ceil(parameters.duration / parameters.interval)):
            reading = yield Step({}, Dwell(parameters.interval))
            if i * parameters.interval >= parameters.settling:
                responses.append(reading[response.signal])
        yield Summary(partial(_summary, f"{name}, {setpoint:g} {drive.setpoint_unit}", response, responses))


def _summary(hold: str, response: Slot, responses: Sequence[float]) -> str:
    spread = max(responses) - min(responses)
    return (
        f"{hold}: {response.signal} from {response.show(responses[0])} to {response.show(responses[-1])}, "
        f"spread {response.show(spread)} after settling"
    )
