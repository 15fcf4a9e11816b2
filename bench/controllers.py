"""Controllers by name, made from a model file: what protocols and the command line choose from."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

from bench.control.baselines import IntegralControl, LookUp
from bench.control.following import ClosedLoopFollower, IntegralFollower, OpenLoopFollower
from bench.control.inverse import Inverse
from bench.control.latched import Latched
from bench.control.tracking import (
    ClosedLoopInverse,
    Follower,
    OpenLoopInverse,
    TargetController,
)
from bench.errors import DataError
from bench.hysteresis import MemoryCurve, Polynomial, Preisach
from bench.model_file import ModelFile, load_model

Policy = Literal["nearest", "paper"]
TargetControllerName = Literal["open-loop-inverse", "polynomial", "integral", "closed-loop-inverse", "latched"]
FollowerName = Literal["open-loop-inverse", "integral", "closed-loop-inverse"]


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


def saturated_below(model: ModelFile, value: float) -> bool:
    """Return whether an input value brings a specimen of this model to negative saturation from any state."""
    operator = model.operator
    return not isinstance(operator, Preisach) or (math.isfinite(value) and value <= float(operator.levels[0]))


def _inverse(name: str, model: ModelFile, policy: Policy) -> Inverse:
    if not isinstance(model.operator, Preisach):
        raise DataError(f"controller {name} needs a Preisach model, whose inverse is exact; this one is {model.name}")
    return Inverse(model.operator, policy)
