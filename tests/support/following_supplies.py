"""A rig of any number of bench supplies, and a loop that makes their outputs follow a sine."""

import math
from collections.abc import Mapping

from bench.control import Trace
from bench.protocol import FixedRate, Messages, ProtocolParameters, parameter, protocol

_HEAD = """
[rig]
title = "supplies in a row"

[telemetry]
period = 1.0

[safety]
unattended = false
"""
_EMULATION = """
[emulation]
laboratory = "scpi"
"""
_SUPPLY = """
[devices.supply{i}]
driver = "scpi-voltage-supply"
port = "{port}"
baudrate = 115200
identity = "EXAMPLE,PS-3005,{{any}}"

[devices.supply{i}.setpoint]
command = "VOLT {{value:.3f}}"
unit = "V"
limits = [0.0, 12.0]

[devices.supply{i}.output]
on = ["OUTP ON"]
off = ["OUTP OFF"]
query = "OUTP?"

[devices.supply{i}.signals.voltage]
query = "MEAS:VOLT?"
unit = "V"

[devices.supply{i}.signals.current]
query = "MEAS:CURR?"
unit = "A"
"""
_EMULATED = """
[emulation.signals.supply{i}_voltage]
time_constant = 0.01

[emulation.signals.supply{i}_current]
expression = "supply{i}_voltage / resistance"
constants = {{ resistance = "10 ohm" }}
"""


def rig_of(count: int) -> str:
    """Return the rig file of so many emulated supplies."""
    supplies = "".join(_SUPPLY.format(i=i, port=f"emulated://supply{i}") for i in range(count))
    return _HEAD + supplies + _EMULATION + "".join(_EMULATED.format(i=i) for i in range(count))


def hardware_of(count: int, ports: Mapping[str, str]) -> str:
    """Return the rig file of so many supplies at serial ports, by their names."""
    return _HEAD + "".join(_SUPPLY.format(i=i, port=ports[f"supply{i}"]) for i in range(count))


class Follower:
    """An integral controller for each supply; all follow one sine."""

    def __init__(self, count: int, rate: float) -> None:
        self.setpoints = [5.0] * count
        self.rate = rate
        self.trace = Trace()

    def update(self, t, measured):
        reference = 5.0 + 2.0 * math.sin(2.0 * math.pi * t)
        self.setpoints = [
            min(max(setpoint + 0.2 * (reference - value), 0.0), 12.0)
            for setpoint, value in zip(self.setpoints, measured, strict=True)
        ]
        self.trace = Trace(reference=reference)
        return self.setpoints


class Parameters(ProtocolParameters):
    """What can be set."""

    count: int = parameter(1, unit="1", low=1, high=64, help="number of supplies")
    rate: float = parameter(100.0, unit="Hz", low=1, high=100000, help="samples in a second")
    duration: float = parameter(2.0, unit="s", low=0.01, high=3600, help="how long")


@protocol(needs=("supply0",), controls="supply0_voltage")
def supplies(parameters: Parameters) -> Messages:
    """Make the outputs of supplies follow a sine."""
    names = [f"supply{i}" for i in range(parameters.count)]
    yield FixedRate(
        controller=Follower(parameters.count, parameters.rate),
        rate=parameters.rate,
        duration=parameters.duration,
        inputs=tuple(f"{name}_voltage" for name in names),
        actuators=tuple(names),
        limits=((0.0, 12.0),) * parameters.count,
        label="sine",
    )
