"""Tracking: bring the output to one target after another, by a controller of choice."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.control.loops import ReachTarget
from bench.control.references import tracking_targets
from bench.controllers import (
    ControllerSetup,
    controller_names,
    load_model_for,
    make_controller,
    saturated_below,
)
from bench.hysteresis import Policy
from bench.protocol import (
    Control,
    Dwell,
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
from bench.tracking_results import REACH, READING


class Parameters(ProtocolParameters):
    """What can be set."""

    model: str = parameter(..., unit="", help="model file, as `bench identify` writes it")
    controller: str = parameter(
        "closed-loop-inverse", unit="", help=f"which controller: {', '.join(controller_names('target'))}"
    )
    policy: Policy = parameter("nearest", unit="", help="which answer of the inverse, where there are several")
    targets: str = parameter("", unit="", help="CSV file with a column `target`; generated if not given")
    low: float = parameter(-63.0, unit="1/m", low=-1e5, high=1e5, help="lowest of the generated targets")
    high: float = parameter(1814.0, unit="1/m", low=-1e5, high=1e5, help="highest of the generated targets")
    count: int = parameter(60, unit="1", low=2, high=10000, help="number of generated targets")
    sequence_seed: int = parameter(1, unit="1", low=0, help="seed of the generated targets")
    reset: float = parameter(21.0, unit="°C", low=-20, high=150, help="where the memory is reset")
    hottest: float = parameter(84.0, unit="°C", low=-20, high=150, help="highest set-point that is allowed")
    readings: int = parameter(10, unit="1", low=1, high=1000, help="readings at each target once it is reached")
    timeout: float = parameter(300.0, unit="s", low=1, high=86400, help="longest time for one target")


@protocol(needs=("tec", "tec_temperature", "curvature"), controls="curvature")
def tracking(parameters: Parameters) -> Messages:
    """Bring the curvature to one target after another.

    The targets are a decaying oscillation and a random part between `low` and `high`, or those of a file. When
    the controller has done what it can, `readings` readings are taken, 0.1 s apart: their mean less the target
    is the error that counts. The memory of the specimen is unknown at the start, so it is reset first, by
    negative saturation at `reset`.
    """
    model = load_model_for(parameters.model, input_unit="°C", output_unit="1/m")
    if not saturated_below(model.operator, parameters.reset):
        raise ValueError(
            f"reset = {parameters.reset:g} °C does not saturate the model's Preisach plane; choose it lower"
        )
    if parameters.targets:
        targets = read_columns(Path(parameters.targets), ["target"], at_least=1).values["target"]
    else:
        rng = np.random.default_rng(parameters.sequence_seed)
        targets = tracking_targets(rng, parameters.low, parameters.high, parameters.count)
    limits = (parameters.reset, parameters.hottest)

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
    setup = ControllerSetup(model=model, limits=limits, policy=parameters.policy, state=state)
    controller = make_controller("target", parameters.controller, setup)
    yield Phase(parameters.controller)
    errors: list[float] = []
    seconds: list[float] = []
    for target in targets.tolist():
        start = reading.time
        reading = yield Control(
            ReachTarget(controller, target),
            "tec",
            "tec_temperature",
            "curvature",
            limits,
            parameters.timeout,
            label=REACH,
        )
        seconds.append(reading.time - start)
        outputs: list[float] = []
        for _ in range(parameters.readings):
            reading = yield Step({}, Dwell(0.1), label=READING)
            outputs.append(reading["curvature"])
        errors.append(float(np.mean(outputs)) - target)
    magnitudes = np.abs(errors)
    yield Note(
        f"{parameters.controller}: {len(errors)} targets, error max {magnitudes.max():.2f}, "
        f"RMS {np.sqrt(np.mean(magnitudes**2)):.2f}, median {np.median(magnitudes):.2f} 1/m; "
        f"{np.mean(seconds):.1f} s a target"
    )
