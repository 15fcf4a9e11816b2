"""Creep: whether the curvature goes on changing while the temperature stands still."""

from __future__ import annotations

import math

from bench.protocol import Dwell, Messages, Note, Phase, ProtocolParameters, Step, UntilSteady, parameter, protocol


class Parameters(ProtocolParameters):
    """What can be set."""

    start: float = parameter(25.0, unit="°C", low=-20, high=150, help="temperature from which the first step is made")
    hot: float = parameter(80.0, unit="°C", low=-20, high=150, help="temperature held after the step up")
    cool: float = parameter(50.0, unit="°C", low=-20, high=150, help="temperature held after the step down")
    duration: float = parameter(
        60.0, unit="s", low=1, high=86400, help="how long each temperature is held and watched"
    )
    interval: float = parameter(0.5, unit="s", low=0.05, high=3600, help="time between two readings")
    settling: float = parameter(5.0, unit="s", low=0, high=3600, help="time after a step that counts as settling")


@protocol(needs=("tec", "tec_temperature", "curvature"))
def creep(parameters: Parameters) -> Messages:
    """Step the temperature up and down, and watch the curvature at each.

    The change of the curvature between the end of settling and the end of the hold is logged for each
    temperature. A specimen without creep shows no more than what the temperature control leaves over
    (Zhang et al. 2013, Fig. 4).
    """
    if parameters.settling + 2 * parameters.interval > parameters.duration:
        raise ValueError("settling must leave two intervals of the duration")
    yield Phase("start")
    yield Step({"tec": parameters.start}, UntilSteady("tec_temperature", drift=0.02, noise=0.01, timeout=300.0))
    for name, temperature in (("hot", parameters.hot), ("cool", parameters.cool)):
        yield Phase(name)
        yield Step({"tec": temperature}, Dwell(0.0), label="step")
        curvatures: list[float] = []
        for i in range(math.ceil(parameters.duration / parameters.interval)):
            reading = yield Step({}, Dwell(parameters.interval))
            if i * parameters.interval >= parameters.settling:
                curvatures.append(reading["curvature"])
        yield Note(
            f"{name}, {temperature:g} °C: curvature from {curvatures[0]:.2f} to {curvatures[-1]:.2f} 1/m, "
            f"spread {max(curvatures) - min(curvatures):.2f} 1/m after settling"
        )
