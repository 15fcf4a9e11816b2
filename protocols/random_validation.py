"""Validation: a random temperature sequence that no model was fitted to."""

from __future__ import annotations

import numpy as np

from bench.identification import excitation
from bench.protocol import Dwell, Messages, Phase, ProtocolParameters, Step, UntilSteady, parameter, protocol


class Parameters(ProtocolParameters):
    """What can be set."""

    low: float = parameter(21.0, unit="°C", low=-20, high=150, help="lowest temperature, where the memory is reset")
    high: float = parameter(84.0, unit="°C", low=-20, high=150, help="highest temperature")
    inner_low: float = parameter(40.0, unit="°C", low=-20, high=150, help="lower end of the range of most targets")
    inner_high: float = parameter(72.0, unit="°C", low=-20, high=150, help="upper end of the range of most targets")
    count: int = parameter(600, unit="1", low=10, high=100000, help="number of set-points")
    increment: float = parameter(
        1.2, unit="K", low=0.01, high=20, help="largest difference of neighbouring set-points"
    )
    dwell: float = parameter(8.0, unit="s", low=0.5, high=3600, help="hold at each set-point before the reading")
    sequence_seed: int = parameter(5, unit="1", low=0, help="seed of the sequence, the same whatever the rig's seed")


@protocol(needs=("tec", "tec_temperature", "curvature"))
def random_validation(parameters: Parameters) -> Messages:
    """Measure along a random sequence of set-points.

    Four of five targets lie within the inner range, the others anywhere, and ramps of `increment` join them
    (Zhang et al. 2013, Fig. 10: 600 set-points). The run begins by resetting the memory to negative
    saturation at `low`.
    """
    setpoints = excitation.random_validation(
        np.random.default_rng(parameters.sequence_seed),
        count=parameters.count,
        operating=(parameters.low, parameters.high),
        transition=(parameters.inner_low, parameters.inner_high),
        step=parameters.increment,
    )
    yield Phase("reset to negative saturation")
    yield Step(
        {"tec": float(setpoints[0])},
        UntilSteady("tec_temperature", drift=0.02, noise=0.01, timeout=300.0, minimum=parameters.dwell),
        label="reset",
    )
    yield Phase("random sequence")
    for target in setpoints[1:].tolist():
        yield Step({"tec": target}, Dwell(parameters.dwell))
