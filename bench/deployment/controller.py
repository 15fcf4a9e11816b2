"""The controllers that follow a reference as C: the inverse in open loop, and with the measured disturbance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.base import ConfigurationError, DataError
from bench.control import FollowingParameters, Spans, load_tuning, tuned, widened
from bench.deployment.c_source import Real, constants, parts_of, rendered
from bench.identification import ModelFile
from bench.models import Operator
from bench.rig import load_rig

CONTROLLERS = ("closed-loop-inverse", "open-loop-inverse")
"""Those that can be exported, as `following` names them."""
_FIRST = 1e9
"""Variance before the first reading, in variances of a period. Source: `DisturbanceEstimator`."""
_CLOSE = {"double": 1e-9, "float": 1e-5}
"""Part of the output's range within which a clipped answer still counts as met. Source: of the bench's controllers;
of float what its rounding leaves."""


@dataclass(frozen=True)
class Controller:
    """A controller to export.

    Attributes
    ----------
    name : {"closed-loop-inverse", "open-loop-inverse"}
        Which of those that `following` tries.
    period : float
        Time between two set-points, s.
    limits : tuple of float
        Least and greatest set-point, input units.
    safe : float
        Set-point where an input is not finite or late, input units.
    numbers : mapping
        Numbers of the controller in place of those scaled to the model: see `FollowingParameters`.

    Raises
    ------
    ConfigurationError
        If there is no such controller, a number is not finite, or the limits do not increase.
    """

    name: str
    period: float
    limits: tuple[float, float]
    safe: float
    numbers: Mapping[str, Any]

    def __post_init__(self) -> None:
        if self.name not in CONTROLLERS:
            raise ConfigurationError(f"--controller {self.name}: expected one of {', '.join(CONTROLLERS)}")
        if not 0.0 < self.period < math.inf:
            raise ConfigurationError(f"--period {self.period:g}: expected a positive time, s")
        low, high = self.limits
        if not low < high or not all(map(math.isfinite, (low, high, self.safe))):
            raise ConfigurationError(f"limits {low:g} to {high:g}, safe set-point {self.safe:g}: expected low < high")


def controller_of_rig(name: str, rig: str, period: float | None, tuning: Path | None) -> Controller:
    """Return a controller with the limits and the safe set-point of a rig's drive.

    Its numbers are those of the rig file for `following`, and those of a tuning file in their place. Raises
    ConfigurationError if the rig or the tuning cannot be read, or no period is given.
    """
    if period is None:
        raise ConfigurationError("--period: a controller needs one, in s")
    file = load_rig(rig)
    drive = file.roles.get("drive")
    if drive is None or drive.range is None or drive.rest is None:
        raise ConfigurationError(f"--rig {rig}: expected [roles.drive] with range and rest, the safe set-point")
    of_rig = file.content.get("protocols", {}).get("following", {}).get("tuning", {}).get(name, {})
    of_file = {} if tuning is None else load_tuning(tuning).get(name, {})
    return Controller(name, period, drive.range, drive.rest, {**of_rig, **of_file})


def controller_source(file: ModelFile, controller: Controller, real: Real, name: str) -> tuple[str, str]:
    """Return header and code of a controller beside its model.

    Raises
    ------
    ConfigurationError
        If it has no such number, or its value is not allowed, or the limits are none of the model.
    DataError
        If the model is not one of one input and one output without time.
    """
    operator = file.model
    if not isinstance(operator, Operator):
        raise DataError(f"controller {controller.name} needs a model of one input, without time, got {operator.kind}")
    spans = Spans.of(operator)
    try:
        numbers = tuned(FollowingParameters.scaled(spans), controller.numbers)
    except ValueError as error:
        raise ConfigurationError(f"controller {controller.name}: {error}") from None
    (low, high), (least, greatest) = operator.input_range, controller.limits
    lowest, highest = max(low, least), min(high, greatest)
    if lowest >= highest:
        raise ConfigurationError(
            f"the limits {least:g} to {greatest:g} have nothing of the model's {low:g} to {high:g}"
        )
    first = _FIRST * (numbers.walk_variance + numbers.reading_variance)
    (least_input, greatest_input), (least_output, greatest_output) = (
        widened(*span) for span in (operator.input_range, operator.output_range())
    )
    declared, _ = constants(
        {
            "lowest": lowest, "highest": highest, "safe": controller.safe, "period": controller.period,
            "lead": numbers.lead, "walk": numbers.walk_variance, "noise": numbers.reading_variance,
            "first_variance": first, "near": _CLOSE[real] * spans.output, "least_input": least_input,
            "greatest_input": greatest_input, "least_output": least_output, "greatest_output": greatest_output,
            "corrects": int(controller.name == "closed-loop-inverse"),
        },
        real,
    )  # fmt: skip
    names = real, f"{name}_control", name
    words = {
        "controller": controller.name,
        "period": f"{controller.period:g}",
        "bounds": f"{lowest:g} to {highest:g} {operator.input_unit}".rstrip(),
        "safe": f"{controller.safe:g}",
    }
    header = rendered(parts_of("controller.h.in")["head"], *names, words)
    code = parts_of("controller.c.in")["head"].replace("/*@constants*/\n", declared)
    return header, rendered(code, *names)
