"""Tracking: bring the output to a sequence of targets, with a selectable controller."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.analysis import REACH, READING, read_columns
from bench.base import Floats
from bench.control import (
    ControllerSetup,
    ReachTarget,
    Supervised,
    controller_names,
    make_supervised,
    tracking_targets,
)
from bench.models import Policy
from bench.protocol import (
    Caution,
    Control,
    Dwell,
    Messages,
    Note,
    Phase,
    Slots,
    Step,
    from_slot,
    parameter,
    protocol,
    unit_of,
)
from protocols.preparation import (
    DRIVE_AND_RESPONSE,
    LOAD,
    LOOP,
    SupervisedParameters,
    check_order,
    load_checked_model,
)
from protocols.session import SessionParameters, begin_session, keep_adapted, session_kinds

_TARGETS_A_NOTE = 10
"""Targets after which what an adaptation has learnt is noted."""


class Parameters(SessionParameters, SupervisedParameters):
    """What can be set."""

    controller: str = parameter(
        "closed-loop-inverse", unit="", help="which controller", choices=lambda: controller_names("target")
    )
    policy: Policy = parameter("nearest", unit="", help="which answer of the inverse, where there are several")
    targets: str = parameter("", unit="", help="CSV file with a column `target`; generated if not given", file=True)
    low: float = parameter(
        from_slot("response", "low"), unit=unit_of("response"), help="lowest of the generated targets"
    )
    high: float = parameter(
        from_slot("response", "high"), unit=unit_of("response"), help="highest of the generated targets"
    )
    count: int = parameter(60, unit="1", low=2, high=10000, help="number of generated targets")
    sequence_seed: int = parameter(1, unit="1", low=0, help="seed of the generated targets")
    readings: int = parameter(
        10, unit="1", low=1, high=1000, help="readings at each target once it is reached", changeable=True
    )
    timeout: float = parameter(
        300.0, unit="s", low=1, high=86400, help="longest time for one target", changeable=True
    )


def _targets(parameters: Parameters, slots: Slots) -> Floats:
    if parameters.targets:
        return read_columns(Path(parameters.targets), ["target"], at_least=1).values["target"]
    check_order(parameters, "low < high", slots["response"].unit)
    rng = np.random.default_rng(parameters.sequence_seed)
    return tracking_targets(rng, parameters.low, parameters.high, parameters.count)


@protocol(needs=DRIVE_AND_RESPONSE, may_use=LOAD, controls="response", views=LOOP, targets=_targets)
def tracking(parameters: Parameters, slots: Slots) -> Messages:
    """Bring the response to a sequence of targets.

    The targets are a decaying oscillation and a random part between `low` and `high`, or those of a file. When
    the controller has done what it can, `readings` readings are taken, 0.1 s apart: their mean less the target
    is the error that counts. The memory of the specimen is unknown at the start, so it is reset first, by
    negative saturation at `reset`. With `recalibrate` known set-points are visited before, by which the model is
    corrected for what moved since it was identified; with `adaptation` it is corrected at each target.
    """
    drive, response = slots["drive"], slots["response"]
    model = load_checked_model(parameters, slots)
    kinds = session_kinds(parameters)
    targets = _targets(parameters, slots)
    limits = (parameters.reset, parameters.hottest)

    reading, model = yield from begin_session(parameters, slots, model, kinds)
    state = model.operator.saturated_state(-1, reading[drive.signal])
    options = parameters.tuning.get(parameters.controller, {})
    setup = ControllerSetup(
        model=model,
        limits=limits,
        dwell=drive.table.dwell,
        policy=parameters.policy,
        state=state,
        options=options,
        adaptation=parameters.adaptation,
    )
    controller = make_supervised(
        Supervised,
        "target",
        parameters.controller,
        setup,
        parameters.rules(setup.spans.output),
        fallback=parameters.fallback,
        **parameters.tuning.get("open-loop-inverse", {}),
    )
    yield Phase(parameters.controller)
    errors: list[float] = []
    seconds: list[float] = []
    for number, target in enumerate(targets.tolist(), start=1):
        start = reading.time
        reading = yield Control(
            task=ReachTarget(controller, target),
            actuator=drive.device,
            drive=drive.signal,
            response=response.signal,
            limits=limits,
            timeout=parameters.timeout,
            label=REACH,
        )
        seconds.append(reading.time - start)
        if notice := controller.take_notice():
            yield Caution(notice)
        outputs: list[float] = []
        for _ in range(parameters.readings):
            reading = yield Step({}, Dwell(0.1), label=READING)
            outputs.append(reading[response.signal])
        errors.append(float(np.mean(outputs)) - target)
        if number % _TARGETS_A_NOTE == 0 or number == targets.size:
            yield from keep_adapted(controller, model)
    magnitudes = np.abs(errors)
    rms = float(np.sqrt(np.mean(magnitudes**2)))
    yield Note(
        f"{parameters.controller}: {len(errors)} targets, error max {response.show(magnitudes.max())}, "
        f"RMS {response.show(rms)}, median {response.show(float(np.median(magnitudes)))}; "
        f"{np.mean(seconds):.1f} s a target"
    )
