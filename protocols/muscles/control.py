"""Control of a muscle: its length under a weight, or its force between fixed ends, follows a sequence of targets."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from bench.analysis import REACH, READING
from bench.base import DataError
from bench.control import (
    ControllerSetup,
    ReachTarget,
    Supervised,
    Tuning,
    controller_names,
    make_supervised,
)
from bench.identification import ModelFile, load_model
from bench.models import TwoStage, TwoStageState
from bench.protocol import (
    Caution,
    Control,
    Dwell,
    Messages,
    Note,
    Phase,
    Slots,
    Step,
    Views,
    from_slot,
    parameter,
    protocol,
)
from protocols.muscles.parts import (
    LENGTH_LOOPS,
    ON_STAGE,
    ON_WEIGHTS,
    ResetParameters,
    StageParameters,
    hang,
    prepare_on_stage,
    reset_under_weights,
)
from protocols.preparation import Part, SupervisedParameters

Output = Literal["length", "force"]

_TARGETS_AT_A_LOAD = 5
_GRACE = 60.0


class Controlled(SupervisedParameters):
    """Parameters of either task."""

    model: str = parameter(
        ..., unit="", help="file of a two-stage model, as `bench identify --model two-stage` writes it", file=True
    )
    controller: str = parameter(
        "closed-loop-inverse", unit="", help="which controller", choices=lambda: controller_names("coupled-length")
    )
    count: int = parameter(40, unit="1", low=1, high=10000, help="number of targets, drawn from the model's range")
    margin: float = parameter(
        0.05, unit="1", low=0.0, high=0.45, help="part of the model's range at either end where no target is drawn"
    )
    sequence_seed: int = parameter(1, unit="1", low=0, help="seed of the targets")
    tuning: Tuning = parameter(
        {}, unit="", help="numbers of controllers in place of those from the model: a tuning file, or tables"
    )
    duration: float = parameter(20.0, unit="s", low=2, high=3600, help="time for each target")
    readings: int = parameter(5, unit="1", low=1, high=1000, help="readings at each target after that time")


class LengthParameters(Controlled, ResetParameters):
    """Parameters."""

    load: float = parameter(from_slot("load", "rest"), unit="N", low=0.05, high=100, help="weight on the muscle")
    change: float = parameter(
        0.0, unit="N", low=0, high=100, help="added weight for five targets in ten; 0 for a constant one"
    )


class ForceParameters(Controlled, StageParameters):
    """Parameters."""

    conditioning: int = parameter(2, unit="1", low=0, high=100, help="voltage cycles at constant length before")


@protocol(needs=ON_WEIGHTS, controls="response", views=LENGTH_LOOPS)
def length_control(parameters: LengthParameters, slots: Slots) -> Messages:
    """Bring the length of a muscle under a weight to one target after another.

    The memory is reset, the weight is hung on, and targets are drawn at random from the range that the model says
    it can reach. After its time at each target the length is read several times (`readings`): the mean less the
    target is the error that counts. With `change` the operator hangs more on after every five targets, and takes it
    off again after the next five; the controller learns of it by the load cell alone.
    """
    file = _load_model(parameters.model)
    model: TwoStage = file.model
    state = model.initial_state()
    ranges = [
        _range(model, _hung(model, state, load), parameters, "length")
        for load in (parameters.load, parameters.load + parameters.change)
    ]
    low, high = max(low for low, _ in ranges), min(high for _, high in ranges)
    if not low < high:
        raise ValueError("change: under the two weights the model has no length in common; choose a smaller one")
    # Before anything moves: it may refuse the model.
    controller = _make_controller(parameters, file, _hung(model, state, parameters.load), "length", high - low)
    yield from reset_under_weights(parameters, slots)
    yield from hang(parameters, slots, parameters.load)
    yield Phase(parameters.controller)
    errors: list[float] = []
    for i, target in enumerate(_targets(parameters, low, high)):
        if parameters.change and i and i % _TARGETS_AT_A_LOAD == 0:
            heavier = i // _TARGETS_AT_A_LOAD % 2 == 1
            yield from hang(parameters, slots, parameters.load + parameters.change * heavier)
        errors.append((yield from _reach(parameters, slots, controller, target, "response", ("force",))))
    yield _summary(parameters.controller, np.array(errors) * 1e3, "mm")


@protocol(needs=ON_STAGE, controls="force", views=Views((("drive", "force"),)))
def force_control(parameters: ForceParameters, slots: Slots) -> Messages:
    """Bring the force of a muscle between fixed ends to one target after another.

    The muscle is fastened to the stage, reset, conditioned by cycles of the voltage and stretched to the
    pretension; then the stage stands still. Targets and errors are as in `length-control`.
    """
    file = _load_model(parameters.model)
    model: TwoStage = file.model
    state = model.initial_state()
    low, high = _range(model, state, parameters, "force")
    controller = _make_controller(parameters, file, state, "force", high - low)
    yield from prepare_on_stage(parameters, slots, parameters.conditioning)
    yield Phase(parameters.controller)
    errors: list[float] = []
    for target in _targets(parameters, low, high):
        errors.append((yield from _reach(parameters, slots, controller, target, "force", ())))
    yield _summary(parameters.controller, np.array(errors), "N")


def _load_model(path: str) -> ModelFile:
    """Read the two-stage model of a muscle, in V, N and m."""
    file = load_model(Path(path), "two-stage")
    model: TwoStage = file.model
    units = (model.voltage_unit, model.force_unit, model.length_unit)
    if units != ("V", "N", "m"):
        raise DataError(f"model file {path}: expected a model in V, N and m, got {', '.join(map(repr, units))}")
    return file


def _make_controller(
    parameters: LengthParameters | ForceParameters,
    model: ModelFile,
    state: TwoStageState,
    output: Output,
    span: float,
) -> Supervised:
    common = {"duration": parameters.duration}
    setup = ControllerSetup(
        model=model,
        limits=(0.0, parameters.highest),
        state=state,
        options=common | parameters.tuning.get(parameters.controller, {}),
    )
    opened = common | parameters.tuning.get("open-loop-inverse", {})
    return make_supervised(
        Supervised,
        f"coupled-{output}",
        parameters.controller,
        setup,
        parameters.rules(span),
        fallback=parameters.fallback,
        **opened,
    )


def _hung(model: TwoStage, state: TwoStageState, load: float) -> TwoStageState:
    return model.step(state, state.voltage, load)[0]


def _range(
    model: TwoStage, state: TwoStageState, parameters: LengthParameters | ForceParameters, output: Output
) -> tuple[float, float]:
    """Return the outputs (m or N) between the ends of a full cycle of the voltage, less a margin at either end."""
    values, highest, margin = [], parameters.highest, parameters.margin
    under = f" under {state.force:g} N" if output == "length" else ""
    for voltage in (highest, 0.0):
        if output == "length":
            state, value = model.step(state, voltage, state.force)
        else:
            state = model.move(state, voltage, state.argument)[0]
            value = state.force
        values.append(value)
    low, high = min(values), max(values)
    if not low < high:
        raise ValueError(f"highest: up to {highest:g} V the model's {output} does not change{under}")
    return low + margin * (high - low), high - margin * (high - low)


def _targets(parameters: Controlled, low: float, high: float) -> list[float]:
    rng = np.random.default_rng(parameters.sequence_seed)
    return [float(target) for target in rng.uniform(low, high, parameters.count)]


def _reach(
    parameters: LengthParameters | ForceParameters,
    slots: Slots,
    controller: Supervised,
    target: float,
    controlled: str,
    others: tuple[str, ...],
) -> Part[float]:
    """Bring a slot to a target, with further slots for the controller, and read; return the error (m or N)."""
    drive, signal = slots["drive"], slots[controlled].signal
    yield Control(
        task=ReachTarget(controller, target),
        actuator=drive.device,
        drive=drive.signal,
        response=signal,
        limits=(0.0, parameters.highest),
        timeout=parameters.duration + _GRACE,
        label=REACH,
        others=tuple(slots[name].signal for name in others),
    )
    if notice := controller.take_notice():
        yield Caution(notice)
    outputs = []
    for _ in range(parameters.readings):
        reading = yield Step({}, Dwell(0.1), label=READING)
        outputs.append(reading[signal])
    return float(np.mean(outputs)) - target


def _summary(controller: str, errors: np.ndarray[tuple[int], np.dtype[np.float64]], unit: str) -> Note:
    rms = np.sqrt(np.mean(errors**2))
    return Note(f"{controller}: {len(errors)} targets, error max {np.abs(errors).max():.3f}, RMS {rms:.3f} {unit}")
