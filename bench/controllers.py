"""Controllers by name, made from a model file: what protocols and the command line choose from."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

from bench.control.baselines import IntegralControl, LookUp
from bench.control.following import ClosedLoopFollower, IntegralFollower, OpenLoopFollower
from bench.control.latched import Latched
from bench.control.muscle import (
    ForceTask,
    LengthTask,
    MuscleClosedLoop,
    MuscleController,
    MuscleOpenLoop,
    MuscleParameters,
    MuscleProportionalIntegral,
    ProportionalIntegralParameters,
)
from bench.control.tracking import (
    ClosedLoopInverse,
    Follower,
    OpenLoopInverse,
    TargetController,
)
from bench.control.two_stage_inverse import TwoStageInverse
from bench.errors import DataError
from bench.hysteresis import MemoryCurve, Polynomial, Preisach, TwoStage, TwoStageState
from bench.hysteresis.inverse import Inverse
from bench.results.model_file import ModelFile, load_coupled_model, load_model

Policy = Literal["nearest", "paper"]
TargetControllerName = Literal["open-loop-inverse", "polynomial", "integral", "closed-loop-inverse", "latched"]
FollowerName = Literal["open-loop-inverse", "integral", "closed-loop-inverse"]
MuscleControllerName = Literal["open-loop-inverse", "proportional-integral", "closed-loop-inverse"]

LENGTH_GAIN = -2500.0
FORCE_GAIN = 1.0
"""Gains of the proportional-integral control of the SMA wire, V²/m and V²/N: the best that were found."""


def load_model_for(path: str, *, input_unit: str, output_unit: str) -> ModelFile:
    """Read a model file for a rig.

    Parameters
    ----------
    path : str
        The model file.
    input_unit, output_unit : str
        Units of the rig's signals that the model shall stand for.

    Raises
    ------
    DataError
        If it cannot be read, or its units are others.
    """
    model = load_model(Path(path))
    for what, unit, expected in (
        ("input", model.operator.input_unit, input_unit),
        ("output", model.operator.output_unit, output_unit),
    ):
        if unit != expected:
            raise DataError(
                f"model file {path}: its {what} is in {unit or 'no unit'}, that of the rig in {expected}; "
                f"identify the model from columns with units, such as '{what} [{expected}]'"
            )
    return model


def make_target_controller(
    name: TargetControllerName,
    model: ModelFile,
    *,
    limits: tuple[float, float],
    policy: Policy = "nearest",
    state: MemoryCurve | None = None,
) -> TargetController:
    """Make a controller that reaches targets.

    Parameters
    ----------
    name : str
        Which.
    model : ModelFile
        A Preisach model for the inverses, a polynomial for `polynomial`; `integral` uses none.
    limits : (float, float)
        Set-points that it may ask for, input units.
    policy : {"nearest", "paper"}
        Which answer of the inverse is taken where there are several.
    state : MemoryCurve, optional
        The specimen's memory; negative saturation if not given.

    Raises
    ------
    DataError
        If the model is not of the kind that the controller needs.
    """
    if name == "integral":
        return IntegralControl(limits)
    if name == "polynomial":
        if not isinstance(model.operator, Polynomial):
            raise DataError(f"controller {name} needs a polynomial model; this one is {model.name}")
        return LookUp(model.operator, limits)
    inverse = _inverse(name, model, policy)
    if name == "open-loop-inverse":
        return OpenLoopInverse(inverse, state, limits)
    if name == "closed-loop-inverse":
        return ClosedLoopInverse(inverse, state, limits)
    return Latched(inverse, state, limits)


def make_follower(
    name: FollowerName,
    model: ModelFile,
    *,
    limits: tuple[float, float],
    state: MemoryCurve | None = None,
) -> Follower:
    """Make a controller that follows a moving reference; see `make_target_controller`."""
    if name == "integral":
        return IntegralFollower(limits)
    inverse = _inverse(name, model, "nearest")
    if name == "open-loop-inverse":
        return OpenLoopFollower(inverse, state, limits)
    return ClosedLoopFollower(inverse, state, limits)


def load_two_stage_model(path: str) -> TwoStage:
    """Read the two-stage model of a muscle, in V, N and m.

    Raises
    ------
    DataError
        If it cannot be read, is of another kind or in other units.
    """
    model = load_coupled_model(Path(path)).model
    if not isinstance(model, TwoStage):
        raise DataError(f"model file {path}: expected a two-stage model, whose inverse is known")
    units = (model.voltage_unit, model.force_unit, model.length_unit)
    if units != ("V", "N", "m"):
        raise DataError(f"model file {path}: expected a model in V, N and m, got {', '.join(map(repr, units))}")
    return model


def make_muscle_controller(
    name: MuscleControllerName,
    model: TwoStage,
    output: Literal["length", "force"],
    *,
    state: TwoStageState,
    limits: tuple[float, float],
    duration: float,
) -> MuscleController:
    """Make a controller of a muscle's length under a measured force, or of its force between fixed ends.

    Parameters
    ----------
    name : str
        Which.
    model : TwoStage
        In V, N and m; `proportional-integral` uses none.
    output : {"length", "force"}
        What is controlled.
    state : TwoStageState
        The muscle's memory at the start.
    limits : (float, float)
        Voltages that it may ask for.
    duration : float
        Time for each target, s.

    Raises
    ------
    DataError
        If the model cannot be inverted.
    """
    if name == "proportional-integral":
        gain = LENGTH_GAIN if output == "length" else FORCE_GAIN
        return MuscleProportionalIntegral(limits, ProportionalIntegralParameters(gain, duration=duration))
    try:
        inverse = TwoStageInverse(model)
    except ValueError as error:
        raise DataError(f"controller {name}: {error}") from error
    task = LengthTask(inverse) if output == "length" else ForceTask(inverse)
    make = MuscleOpenLoop if name == "open-loop-inverse" else MuscleClosedLoop
    return make(task, state, limits, MuscleParameters(duration=duration))


def saturated_below(model: ModelFile, value: float) -> bool:
    """Return whether an input value brings a specimen of this model to negative saturation from any state."""
    operator = model.operator
    return not isinstance(operator, Preisach) or (math.isfinite(value) and value <= float(operator.levels[0]))


def _inverse(name: str, model: ModelFile, policy: Policy) -> Inverse:
    if not isinstance(model.operator, Preisach):
        raise DataError(f"controller {name} needs a Preisach model, whose inverse is exact; this one is {model.name}")
    return Inverse(model.operator, policy)
