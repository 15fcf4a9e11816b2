"""Following: make the output follow a reference that moves."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.control.loops import FollowReference
from bench.control.references import fastest_slope, modulated_sine
from bench.controllers import ControllerSetup, controller_names, load_model_for, make_controller, saturated_below
from bench.protocol import (
    Control,
    Messages,
    Note,
    Phase,
    ProtocolParameters,
    Step,
    UntilSteady,
    parameter,
    protocol,
)
from bench.results.data import read_columns
from bench.tracking_results import FOLLOW


class Parameters(ProtocolParameters):
    """What can be set."""

    model: str = parameter(..., unit="", help="model file, as `bench identify` writes it")
    controller: str = parameter(
        "closed-loop-inverse", unit="", help=f"which controller: {', '.join(controller_names('follow'))}"
    )
    reference: str = parameter("", unit="", help="CSV file with columns `time` and `reference`; a sine if not given")
    low: float = parameter(200.0, unit="1/m", low=-1e5, high=1e5, help="lowest value of the sine")
    high: float = parameter(1500.0, unit="1/m", low=-1e5, high=1e5, help="highest value of the sine")
    period: float = parameter(200.0, unit="s", low=1, high=1e6, help="period of the sine, whose amplitude varies")
    duration: float = parameter(800.0, unit="s", low=1, high=1e7, help="how long the sine is followed")
    rate: float = parameter(2.0, unit="1/s", low=0.01, high=50, help="set-points and readings per second")
    fastest: float = parameter(3.0, unit="K/s", low=0.001, high=100, help="what the plate can follow")
    reset: float = parameter(21.0, unit="°C", low=-20, high=150, help="where the memory is reset")
    hottest: float = parameter(84.0, unit="°C", low=-20, high=150, help="highest set-point that is allowed")


@protocol(needs=("tec", "tec_temperature", "curvature"), controls="curvature")
def following(parameters: Parameters) -> Messages:
    """Make the curvature follow a reference, set-point by set-point at a fixed rate.

    The reference is a sine of varying amplitude between `low` and `high`, or that of a file, between whose rows
    it is straight. One that asks the plate for more than `fastest` is refused before anything moves. The memory
    of the specimen is unknown at the start, so it is reset first, by negative saturation at `reset`.
    """
    model = load_model_for(parameters.model, input_unit="°C", output_unit="1/m")
    if not saturated_below(model.operator, parameters.reset):
        raise ValueError(
            f"reset = {parameters.reset:g} °C does not saturate the model's Preisach plane; choose it lower"
        )
    times, values = _reference(parameters)
    if not model.operator.memoryless:
        slope = fastest_slope(model.operator.inverse(), times, values)
        if not slope.within(parameters.fastest):
            raise ValueError(
                f"the reference asks for {slope.rate:.2f} K/s at {slope.time:g} s, and the plate follows "
                f"{parameters.fastest:g} K/s at most"
            )
    limits = (parameters.reset, parameters.hottest)
    duration = float(times[-1])

    yield Phase("reset")
    yield Note(
        f"the memory of the specimen is unknown: it is reset to negative saturation at {parameters.reset:g} °C"
    )
    reading = yield Step(
        {"tec": parameters.reset},
        UntilSteady("tec_temperature", drift=0.02, noise=0.01, timeout=300.0, minimum=8.0),
        label="reset",
    )
    state = model.operator.saturated_state(-1, reading["tec_temperature"])
    follower = make_controller(
        "follow", parameters.controller, ControllerSetup(model=model, limits=limits, state=state)
    )
    yield Phase(f"approach, {parameters.controller}")
    # The way to the first value is no part of the reference.
    yield Control(
        FollowReference(follower, lambda _: float(values[0]), 1.0 / parameters.rate, 20.0),
        "tec", "tec_temperature", "curvature", limits, 60.0, label="approach",
    )  # fmt: skip
    yield Phase(f"follow, {parameters.controller}")
    yield Control(
        FollowReference(follower, lambda t: float(np.interp(t, times, values)), 1.0 / parameters.rate, duration),
        "tec", "tec_temperature", "curvature", limits, duration + 60.0, label=FOLLOW,
    )  # fmt: skip


def _reference(parameters: Parameters) -> tuple[np.ndarray, np.ndarray]:
    if not parameters.reference:
        times = np.arange(0.0, parameters.duration + 0.5 / parameters.rate, 1.0 / parameters.rate)
        # From its trough, where it stands still: a plate at rest cannot start at full speed.
        return times, modulated_sine(
            times + 0.75 * parameters.period, parameters.low, parameters.high, parameters.period
        )
    columns = read_columns(Path(parameters.reference), ["time", "reference"], at_least=3)
    times, values = columns.values["time"], columns.values["reference"]
    steps = np.diff(times)
    if np.any(steps <= 0):
        row = int(np.argmax(steps <= 0)) + 2
        raise ValueError(f"{parameters.reference}: row {row}, column time: times must increase")
    return times - times[0], values
