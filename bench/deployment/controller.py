"""The controllers by the inverse as C: for a moving reference or targets, in open and in closed loop."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.base import ConfigurationError, DataError
from bench.control import (
    ControllerBase,
    ControllerSetup,
    FollowingParameters,
    Spans,
    controller_spec,
    load_tuning,
    make_controller,
    widened,
)
from bench.deployment.c_source import Real, Source, Value, constants, parts_of, rendered
from bench.identification import ModelFile
from bench.models import Operator
from bench.rig import load_rig

_PROTOCOLS = {"follow": "following", "target": "tracking"}
"""Which protocol carries a task out, and has the numbers of its controllers in the rig file."""
CONTROLLERS = tuple(f"{task}.{name}" for task in _PROTOCOLS for name in ("closed-loop-inverse", "open-loop-inverse"))
"""Those that can be exported: the task and the name."""
_REASONS = {
    "integral": "it uses no model, and is one line: set-point += gain * period * (reference - output), within limits",
    "latched": "there is no C for its search from both sides of a target",
    "polynomial": "its model has no memory, and its inverse is a table of 4001 points",
    "predictive": "it needs the reference ahead, and solves a problem of bounded least squares in each period",
}
"""Why others cannot be, by name."""
_FIRST = 1e9
"""Variance before the first reading, in variances of a period. Source: `DisturbanceEstimator`."""
_CLOSE = {"double": 1e-9, "float": 1e-5}
"""Part of the output's range within which a clipped answer still counts as met. Source: of the bench's controllers;
of float what its rounding leaves."""
_ON_TIME = {"double": 1e-9, "float": 1e-3}
"""Difference of times that are equal, in periods. Source: as `_CLOSE`."""
_INFINITE = 1e30
"""More than any time. Derivation: within the range of `float`, whose greatest number is 3.4e38."""

_MACHINE_CODE = {"follow": 1500, "target": 3500}
"""Bytes of machine code by task. Source: gcc -Os on x86-64, 1200 and 2800, and a quarter more."""


@dataclass(frozen=True)
class Controller:
    """A controller to export.

    Attributes
    ----------
    name : str
        One of `CONTROLLERS`, such as "target.closed-loop-inverse".
    period : float
        Time between two set-points, s.
    limits : tuple of float
        Least and greatest set-point, input units.
    safe : float
        Set-point where an input is not finite or late, input units.
    numbers : mapping
        Numbers of the controller in place of those scaled to the model.
    dwell : float, optional
        Time in which actuator and specimen come to rest at a set-point, s.

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
    dwell: float | None = None

    def __post_init__(self) -> None:
        if self.name not in CONTROLLERS:
            reason = _REASONS.get(self.name.rpartition(".")[2], "there is no C for it")
            raise ConfigurationError(
                f"--controller {self.name} cannot be exported: {reason}; what can be: {', '.join(CONTROLLERS)}"
            )
        if not 0.0 < self.period < math.inf:
            raise ConfigurationError(f"--period {self.period:g}: expected a positive time, s")
        low, high = self.limits
        if not low < high or not all(map(math.isfinite, (low, high, self.safe))):
            raise ConfigurationError(f"limits {low:g} to {high:g}, safe set-point {self.safe:g}: expected low < high")


def controller_of_rig(name: str, rig: str, period: float | None, tuning: Path | None) -> Controller:
    """Return a controller with the limits, the dwell and the safe set-point of a rig's drive.

    Its numbers are those of the rig file for its protocol, and those of a tuning file in their place. Raises
    ConfigurationError if the rig or the tuning cannot be read, or no period is given.
    """
    if period is None:
        raise ConfigurationError("--period: a controller needs one, in s")
    file = load_rig(rig)
    drive = file.roles.get("drive")
    if drive is None or drive.range is None or drive.rest is None:
        raise ConfigurationError(f"--rig {rig}: expected [roles.drive] with range and rest, the safe set-point")
    task, _, short = name.partition(".")
    tables = file.protocols.get(_PROTOCOLS.get(task, "")) or {}
    of_rig = tables.get("tuning", {}).get(short, {})
    of_file = {} if tuning is None else load_tuning(tuning).get(short, {})
    return Controller(name, period, drive.range, drive.rest, {**of_rig, **of_file}, drive.dwell)


def with_controller(source: Source, file: ModelFile, controller: Controller, real: Real, name: str) -> Source:
    """Return a model as C with a controller behind it.

    Raises
    ------
    ConfigurationError
        If it has no such number, or its value is not allowed, or the limits are none of the model.
    DataError
        If the model is not one of one input and one output with memory and without time.
    """
    operator = file.model
    if not isinstance(operator, Operator):
        raise DataError(f"controller {controller.name} needs a model of one input, without time, got {operator.kind}")
    task, _, short = controller.name.partition(".")
    setup = ControllerSetup(
        model=file,
        limits=controller.limits,
        options=controller.numbers,
        period=controller.period,
        dwell=controller.numbers.get("wait", controller.dwell),
    )
    try:
        made: ControllerBase = make_controller(task, short, setup)
    except ValueError as error:
        raise ConfigurationError(f"controller {controller.name}: {error}") from None
    (low, high), span = made.limits, Spans.of(operator).output
    (least_input, greatest_input), (least_output, greatest_output) = (
        widened(*each) for each in (operator.input_range, operator.output_range())
    )
    corrects = short == "closed-loop-inverse"
    if task == "follow":
        numbers: Any = setup.tuned(FollowingParameters.scaled)
        own: dict[str, Value] = {"lead": numbers.lead}
        parts, words = {"see": "", "fields": ""}, {"reference": "wanted output at the end of the coming period"}
    else:
        spec = controller_spec(task, short)
        numbers = setup.tuned(lambda _: spec.numbers(setup) if spec.numbers else None)
        own, parts, words = _of_targets(numbers, setup, (low, high), real)
    first, second = getattr(numbers, "walk_variance", 1.0), getattr(numbers, "reading_variance", 1.0)
    declared, size = constants(
        {
            "lowest": low, "highest": high, "safe": controller.safe, "period": controller.period,
            "walk": first, "noise": second, "first_variance": _FIRST * (first + second), "close": _CLOSE[real] * span,
            "least_input": least_input, "greatest_input": greatest_input, "least_output": least_output,
            "greatest_output": greatest_output, "corrects": int(corrects), **own,
        },
        real,
    )  # fmt: skip
    names = real, f"{name}_control", name
    words |= {
        "controller": controller.name,
        "period": f"{controller.period:g}",
        "bounds": f"{low:g} to {high:g} {operator.input_unit}".rstrip(),
        "safe": f"{controller.safe:g}",
    }
    template = parts_of("controller.c.in")
    header = parts_of("controller.h.in")["head"].replace("@fields", template.get(parts["fields"], ""))
    code = (template["head"] + template[task]).replace("/*@constants*/\n", declared)
    code = code.replace("@see", template.get(parts["see"], ""))
    return replace(
        source,
        functions=source.functions + "\n" + rendered(header, *names, words),
        code=source.code + "\n" + rendered(code, *names, words),
        constants=source.constants + size,
        machine=source.machine + _MACHINE_CODE[task],
    )


def _of_targets(
    numbers: Any,  # noqa: ANN401 - of either controller
    setup: ControllerSetup,
    limits: tuple[float, float],
    real: Real,
) -> tuple[dict[str, Value], dict[str, str], dict[str, str]]:
    """Return constants, parts of the template and words of a controller of a sequence of targets."""
    low, high = limits
    # Source, of this and of the shares and readings of an overshoot: bench.control.
    significant = 0.01 * (high - low)
    first, last = setup.model.operator.input_range
    # Of the least move that counts, and of the longest from an input that is believed.
    octaves = np.arange(round(math.log2(significant)), round(math.log2(2.0 * (last - first))))
    response = setup.response
    lags = response is not None and response.lag > 0.0
    level, seen = "measured", "c->level"
    if lags and response is not None and response.power == 2.0:
        level = "(measured < 0.0 ? -measured * measured : measured * measured)"
        seen = "c->level < 0.0 ? -SQRT(-c->level) : SQRT(c->level)"
    values: dict[str, Value] = {
        "unknown": _INFINITE, "significant": significant, "least_share": 0.01, "most_share": 0.6, "still": 0.003,
        "most_readings": 100, "octaves": np.exp2(octaves + 0.5), "on_time": _ON_TIME[real] * setup.period,
        "wait": getattr(numbers, "wait", 0.0), "corrections": getattr(numbers, "corrections", 0),
        "close_enough": getattr(numbers, "close_enough", 0.0), "lags": int(lags),
        "at_rest": 0.5 * getattr(numbers, "close_enough", 0.0),
    }  # fmt: skip
    if lags and response is not None:
        values["lag"] = response.lag
    arrival = getattr(numbers, "arrival", None)
    values |= {each: getattr(arrival, each, 0.0) for each in ("tolerance", "hold", "patience")}
    words = {"sizes": str(octaves.size + 1), "level": level, "seen": seen, "reference": "wanted output, the target"}
    return values, {"see": "see_late" if lags else "see", "fields": "fields"}, words
