"""Following: make the output follow a reference that moves."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from bench.analysis import FOLLOW, ColumnNames, read_columns, read_dataset
from bench.base import Floats
from bench.control import (
    ControllerSetup,
    FollowReference,
    SupervisedFollower,
    controller_names,
    fastest_slope,
    make_supervised,
    modulated_sine,
)
from bench.protocol import Caution, Control, Messages, Phase, Slots, from_slot, parameter, protocol, unit_of
from protocols.preparation import (
    DRIVE_AND_RESPONSE,
    LOAD,
    LOOP,
    SupervisedParameters,
    check_order,
    load_checked_model,
)
from protocols.session import SessionParameters, begin_session, keep_adapted, session_kinds

_DRIVE = unit_of("drive")

_MOST = 10_000_000
"""Most set-points of the sine."""


class Parameters(SessionParameters, SupervisedParameters):
    """What can be set."""

    controller: str = parameter(
        "closed-loop-inverse", unit="", help="which controller", choices=lambda: controller_names("follow")
    )
    reference: str = parameter(
        "", unit="", help="CSV file with columns `time` and `reference`; a sine if not given", file=True
    )
    low: float = parameter(from_slot("response", "low"), unit=unit_of("response"), help="lowest value of the sine")
    high: float = parameter(from_slot("response", "high"), unit=unit_of("response"), help="highest value of the sine")
    period: float = parameter(200.0, unit="s", low=1, high=1e6, help="period of the sine, whose amplitude varies")
    duration: float = parameter(800.0, unit="s", low=1, high=1e7, help="how long the sine is followed")
    rate: float = parameter(2.0, unit="1/s", low=0.01, high=50, help="set-points and readings per second")
    allowed_error: float = parameter(
        0.03,
        unit="1",
        above=0.0,
        high=1.0,
        help="allowed RMS error, as a part of the range of the model's output: that of a drive that lags included",
    )
    fastest: float = parameter(
        from_slot("drive", "rate"), unit=f"{_DRIVE}/s", above=0.0, help="what the drive can follow"
    )


def _targets(parameters: Parameters, slots: Slots) -> Floats:
    return _reference(parameters, slots["response"].unit)[1]


@protocol(needs=DRIVE_AND_RESPONSE, may_use=LOAD, controls="response", views=LOOP, targets=_targets)
def following(parameters: Parameters, slots: Slots) -> Messages:
    """Make the response follow a reference, set-point by set-point at a fixed rate.

    The reference is a sine of varying amplitude between `low` and `high`, or that of a file, between whose rows
    it is straight. One that asks the drive for more than `fastest` is refused before anything moves. The memory
    of the specimen is unknown at the start, so it is reset first, by negative saturation at `reset`. With
    `recalibrate` known set-points are visited before, by which the model is corrected for what moved since it was
    identified; with `adaptation` it is corrected while it is used.
    """
    drive, response = slots["drive"], slots["response"]
    model = load_checked_model(parameters, slots)
    kinds = session_kinds(parameters)
    times, values = _reference(parameters, response.unit)
    if not model.operator.memoryless:
        slope = fastest_slope(model.operator.inverse(), times, values)
        if not slope.within(parameters.fastest):
            raise ValueError(
                f"the reference asks for {slope.rate:.2f} {drive.rate_unit} at {slope.time:g} s; the drive follows "
                f"{parameters.fastest:g} {drive.rate_unit} at most"
            )
    limits = (parameters.reset, parameters.hottest)
    duration = float(times[-1])

    reading, model = yield from begin_session(parameters, slots, model, kinds)
    state = model.operator.saturated_state(-1, reading[drive.signal])
    options = parameters.tuning.get(parameters.controller, {})
    setup = ControllerSetup(
        model=model,
        limits=limits,
        dwell=drive.table.dwell,
        state=state,
        options=options,
        adaptation=parameters.adaptation,
        period=1.0 / parameters.rate,
    )
    follower = make_supervised(
        SupervisedFollower,
        "follow",
        parameters.controller,
        setup,
        parameters.rules(setup.spans.output),
        fallback=parameters.fallback,
        **parameters.tuning.get("open-loop-inverse", {}),
    )

    def follow(reference: Callable[[float], float], seconds: float, timeout: float, label: str) -> Control:
        return Control(
            task=FollowReference(follower, reference, 1.0 / parameters.rate, seconds),
            actuator=drive.device,
            drive=drive.signal,
            response=response.signal,
            limits=limits,
            timeout=timeout,
            label=label,
        )

    yield Phase(f"approach, {parameters.controller}")
    # The way to the first value is no part of the reference.
    yield follow(lambda _: float(values[0]), 20.0, 60.0, "approach")
    yield Phase(f"follow, {parameters.controller}")
    yield follow(lambda t: float(np.interp(t, times, values)), duration, duration + 60.0, FOLLOW)
    if notice := follower.take_notice():
        yield Caution(notice)
    yield from keep_adapted(follower, model)


def _reference(parameters: Parameters, unit: str) -> tuple[Floats, Floats]:
    if not parameters.reference:
        check_order(parameters, "low < high", unit)
        if parameters.duration * parameters.rate > _MOST:
            raise ValueError(
                f"parameter duration = {parameters.duration:g} s is not allowed at rate = {parameters.rate:g} 1/s; "
                f"allowed: ≤ {_MOST / parameters.rate:g} s, which is {_MOST} set-points"
            )
        times = np.arange(0.0, parameters.duration + 0.5 / parameters.rate, 1.0 / parameters.rate)
        # From its trough, where it stands still: a plate at rest cannot start at full speed.
        return times, modulated_sine(
            times + 0.75 * parameters.period, parameters.low, parameters.high, parameters.period
        )
    columns = read_columns(Path(parameters.reference), ["time", "reference"], at_least=3)
    steps = np.diff(columns.values["time"])
    if np.any(steps <= 0):
        row = int(np.argmax(steps <= 0)) + 2
        raise ValueError(f"{parameters.reference}: row {row}, column time: times must increase")
    # In s, whatever the unit of the file.
    rows = read_dataset([Path(parameters.reference)], ColumnNames("reference", time="time"), at_least=3)
    assert rows.times is not None
    return rows.times - rows.times[0], rows.inputs
