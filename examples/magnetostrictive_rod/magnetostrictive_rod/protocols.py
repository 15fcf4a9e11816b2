"""The protocol that is customary for magnetostrictive rods."""

from __future__ import annotations

import numpy as np

from bench.devices import Actuator, Signal
from bench.protocol import (
    Dwell,
    Messages,
    Note,
    Phase,
    ProtocolParameters,
    Slots,
    Step,
    difference_of,
    from_slot,
    parameter,
    protocol,
    unit_of,
)


class Parameters(ProtocolParameters):
    """What can be set."""

    amplitude: float = parameter(from_slot("drive", "high"), unit=unit_of("drive"), help="set-point of the tips")
    increment: float = parameter(
        from_slot("drive", "increment"), unit=difference_of("drive"), help="between set-points"
    )
    cycles: int = parameter(2, unit="1", low=1, high=100, help="how often the loop is driven; the last one counts")
    dwell: float = parameter(from_slot("drive", "dwell"), unit="s", low=0.01, high=60, help="hold before a reading")


@protocol(needs={"drive": Actuator, "response": Signal})
def butterfly_loop(parameters: Parameters, slots: Slots) -> Messages:
    """Drive a symmetric major loop, and find the drive at which the response is least on either branch.

    Half the distance of both minima is the coercivity.
    """
    drive, response = slots["drive"], slots["response"]
    count = max(round(2.0 * parameters.amplitude / parameters.increment), 2) + 1
    branch = np.linspace(-parameters.amplitude, parameters.amplitude, count)
    yield Step({drive.device: float(branch[0])}, drive.settle(parameters.dwell), label="reset")
    minima = {}
    for cycle in range(parameters.cycles):
        for name, setpoints in (("rising", branch[1:]), ("falling", branch[-2::-1])):
            yield Phase(f"{name}, cycle {cycle + 1}")
            readings = []
            for setpoint in setpoints.tolist():
                readings.append((yield Step({drive.device: setpoint}, Dwell(parameters.dwell))))
            minima[name] = min(readings, key=lambda reading: reading[response.signal])[drive.signal]
    coercivity = 0.5 * abs(minima["rising"] - minima["falling"])
    yield Note(f"coercivity {drive.show(coercivity)}")
