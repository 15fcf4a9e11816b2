"""Characterization by nested loops: a damped oscillation of the temperature that fills the Preisach plane."""

from __future__ import annotations

from itertools import pairwise

from bench.identification import excitation
from bench.protocol import Dwell, Messages, Phase, ProtocolParameters, Step, UntilSteady, parameter, protocol


class Parameters(ProtocolParameters):
    """What can be set."""

    low: float = parameter(21.0, unit="°C", low=-20, high=150, help="lowest temperature, where the memory is reset")
    high: float = parameter(84.0, unit="°C", low=-20, high=150, help="highest temperature, the first reversal")
    center: float = parameter(
        54.0, unit="°C", low=-20, high=150, help="temperature about which the oscillation decays"
    )
    half_cycles: int = parameter(36, unit="1", low=1, high=1000, help="number of half-cycles after the first rise")
    increment: float = parameter(0.35, unit="K", low=0.01, high=20, help="difference of neighbouring set-points")
    dwell: float = parameter(8.0, unit="s", low=0.5, high=3600, help="hold at each set-point before the reading")


@protocol(needs=("tec", "tec_temperature", "curvature"))
def damped_oscillation(parameters: Parameters) -> Messages:
    """Characterize a hysteresis by nested minor loops.

    Rises from `low` to `high`, then swings about `center` with shrinking amplitude, in steps of `increment`
    with a fixed dwell and one reading each, so that every cell of the Preisach plane is swept (Zhang et al.
    2013, section IV-B: 21 to 84 °C, 8 s, about 3000 set-points). `low` has to be below the phase transition:
    the run begins by resetting the memory to negative saturation there.
    """
    setpoints = excitation.damped_oscillation(
        parameters.low, parameters.high, parameters.center, parameters.half_cycles, parameters.increment
    )
    yield Phase("reset to negative saturation")
    yield Step(
        {"tec": float(setpoints[0])},
        UntilSteady("tec_temperature", drift=0.02, noise=0.01, timeout=300.0, minimum=parameters.dwell),
        label="reset",
    )
    yield Phase("rise")
    direction = 1.0
    for previous, target in pairwise(setpoints.tolist()):
        reversal = (target - previous) * direction < 0
        if reversal and previous == setpoints.max():
            yield Phase("damped oscillation")
        if reversal:
            direction = -direction
        yield Step({"tec": target}, Dwell(parameters.dwell), label="reversal" if reversal else "")
