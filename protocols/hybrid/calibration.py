"""Calibration of the displacement sensor against an interferometer."""

from __future__ import annotations

import math

from bench.control import Playback
from bench.protocol import FixedRate, Messages, Phase, ProtocolParameters, Slots, parameter, protocol
from protocols.hybrid import THERMAL, WITNESS


class Parameters(ProtocolParameters):
    """What can be set."""

    cooling: float = parameter(..., unit="A", low=-1, high=0, help="lowest current, which cools most")
    heating: float = parameter(..., unit="A", low=0, high=1, help="highest current")
    period: float = parameter(..., unit="s", low=10, high=36000, help="time of one sweep there and back")
    sweeps: int = parameter(2, unit="1", low=1, high=100, help="sweeps")
    rate: float = parameter(10.0, unit="Hz", low=0.1, high=1000, help="samples in a second")


@protocol(needs={**THERMAL, **WITNESS}, controls="response")
def calibration_displacement(parameters: Parameters, slots: Slots) -> Messages:
    """Sweep the tip over its range by heat, and read the displacement sensor beside an interferometer.

    The sensor `witness` is the reference. `bench rig calibrate` makes a calibration of the run: gain, offset and
    nonlinearity over the range, and how late the sensor is.
    """
    p = parameters
    middle, amplitude = 0.5 * (p.cooling + p.heating), 0.5 * (p.heating - p.cooling)
    start = math.asin(-middle / amplitude) if amplitude > 0.0 else 0.0

    def current(t: float) -> float:
        # From no current on.
        value = middle + amplitude * math.sin(2.0 * math.pi * t / p.period + start)
        return min(max(value, p.cooling), p.heating)

    yield Phase("sweeps beside the reference")
    yield FixedRate(
        controller=Playback(current),
        rate=p.rate,
        duration=p.sweeps * p.period,
        inputs=tuple(slots[name].signal for name in ("response", "base", "tip", "witness")),
        actuators=(slots["coarse"].device,),
        limits=((p.cooling, p.heating),),
        label="sweeps",
    )
