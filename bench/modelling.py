"""From a file of measurements to a model file, and back: what `bench identify` and `bench predict` do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.control.baselines import LookUp
from bench.control.inverse import Inverse, Reach
from bench.controllers import Policy
from bench.errors import ConfigurationError, DataError
from bench.hysteresis import Polynomial, Preisach
from bench.identification import MODELS, Errors, Identification, identify
from bench.measurements import FEWEST_ROWS, check_excitation, read_columns
from bench.model_file import ModelFile

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class IdentifiedFile:
    """A model that was identified from a file of measurements.

    Attributes
    ----------
    file : ModelFile
        The model, ready to be saved.
    identification : Identification
        The fit behind it.
    warnings : tuple of str
        What is odd about the data, though usable.
    inputs, outputs : ndarray, shape (N,)
        The measurements.
    """

    file: ModelFile
    identification: Identification
    warnings: tuple[str, ...]
    inputs: Floats
    outputs: Floats

    def summary(self) -> dict[str, Any]:
        """Return the result for programs."""
        found = self.identification
        certificate = found.certificate
        operator = self.file.operator
        return {
            "model": found.model_name,
            "samples": int(self.inputs.size - found.skip),
            "levels": operator.order if isinstance(operator, Preisach) else None,
            **errors_json(found.errors),
            "kkt": certificate.kkt_residual,
            "converged": certificate.converged,
            "passive": certificate.passive,
            "active": certificate.active,
            "condition": certificate.condition,
            "coverage": certificate.coverage,
            "input_unit": operator.input_unit,
            "output_unit": operator.output_unit,
            "warnings": list(self.warnings),
        }


def errors_json(errors: Errors) -> dict[str, float]:
    """Return error measures for programs: `max`, `rms`, `average` in output units, and percentages."""
    return {
        "max": errors.maximum,
        "rms": errors.rms,
        "average": errors.average,
        "max_percent": errors.maximum_percent,
        "rms_percent": errors.rms_percent,
        "average_percent": errors.average_percent,
    }


def identify_file(
    path: Path,
    *,
    input_column: str,
    output_column: str,
    model: str,
    levels: int | None = None,
    degree: int | None = None,
    plane: tuple[float, float] | None = None,
    reversible: str | None = None,
    smoothing: float = 0.0,
    skip: int = 0,
) -> IdentifiedFile:
    """Identify a model from a CSV file or a run.

    Parameters
    ----------
    path : Path
        CSV file with a header, or the folder of a run.
    input_column, output_column : str
        What drives and what answers.
    model : str
        A key of `bench.identification.MODELS`.
    levels, degree, plane, reversible : optional
        Options of the model, where it has them; None leaves the model's own default.
    smoothing : float
        Weight of the roughness penalty.
    skip : int
        Number of first rows that drive the memory but do not count in the fit.

    Raises
    ------
    DataError
        If the measurements cannot be used: names row and column.
    ConfigurationError
        If an option is wrong or does not belong to the model.
    """
    if model not in MODELS:
        raise ConfigurationError(f"there is no model {model!r}; there are: {', '.join(MODELS)}")
    if skip < 0:
        raise ConfigurationError(f"--skip {skip}: expected a number of rows ≥ 0")
    columns = read_columns(path, (input_column, output_column), at_least=FEWEST_ROWS)
    inputs, outputs = columns.values[input_column], columns.values[output_column]
    if inputs.size - skip < FEWEST_ROWS:
        raise DataError(f"{path}: --skip {skip} leaves {max(inputs.size - skip, 0)} of {inputs.size} rows; too few")
    warnings = tuple(check_excitation(columns, input_column))
    given = {"levels": levels, "degree": degree, "plane": plane, "reversible": reversible}
    options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    for key, column in (("input_unit", input_column), ("output_unit", output_column)):
        if columns.units[column]:
            options[key] = columns.units[column]
    try:
        found = identify(model, inputs, outputs, skip=skip, smoothing=smoothing, **options)
    except ValueError as error:
        raise ConfigurationError(f"model {model}: {error}") from None
    state = found.model.initial_state()
    memory = state.advance(inputs) if isinstance(found.model, Preisach) else None
    provenance = {
        "source": path.name,
        "input": input_column,
        "output": output_column,
        "rows": int(inputs.size),
        "skipped": skip,
        **errors_json(found.errors),
        "kkt": found.certificate.kkt_residual,
    }
    return IdentifiedFile(ModelFile(model, found.model, memory, provenance), found, warnings, inputs, outputs)


def predict(model: ModelFile, inputs: Floats, *, continue_memory: bool = False) -> Floats:
    """Apply a model to a sequence of inputs.

    Parameters
    ----------
    model : ModelFile
        The model.
    inputs : ndarray, shape (N,)
        Inputs in the unit of the model, finite.
    continue_memory : bool
        Start from the memory that the model file keeps, the end of its identification data, rather than from
        the state from which identification started.

    Returns
    -------
    ndarray, shape (N,)
        Predicted outputs, in the unit of the model.
    """
    return np.asarray(model.operator.evaluate(inputs, model.memory if continue_memory else None))


@dataclass(frozen=True)
class InvertedTargets:
    """Set-points that bring a model's output to one target after another.

    Attributes
    ----------
    targets : ndarray, shape (N,)
        Output units.
    setpoints : ndarray, shape (N,)
        Input units.
    passing : ndarray, shape (N,)
        Set-point to pass before it, where the target is met only after saturation; nan where there is none.
    predicted : ndarray, shape (N,)
        Output of the model at `setpoints`, output units.
    flags : tuple of str
        By target: `met`, `too high` or `too low`. What is not met is clamped to the nearest reachable value.
    """

    targets: Floats
    setpoints: Floats
    passing: Floats
    predicted: Floats
    flags: tuple[str, ...]


def invert_targets(
    model: ModelFile, targets: Floats, *, policy: Policy = "nearest", continue_memory: bool = False
) -> InvertedTargets:
    """Invert a model for a sequence of targets.

    Parameters
    ----------
    model : ModelFile
        Any model: Preisach models are inverted exactly with their memory, a polynomial by its look-up table.
    targets : ndarray, shape (N,)
        Output units, finite.
    policy : {"nearest", "paper"}
        Which answer is taken where a Preisach model has several.
    continue_memory : bool
        Start from the memory that the model file keeps rather than from negative saturation.

    Raises
    ------
    DataError
        If this kind of model has no inverse.
    """
    operator = model.operator
    if isinstance(operator, Preisach):
        found = Inverse(operator, policy).follow(targets, model.memory if continue_memory else None)
        setpoints, passing, predicted = found.setpoints, found.saturating, found.outputs
        reached = [
            Reach.MET if met else Reach.TOO_HIGH if target > output else Reach.TOO_LOW
            for met, target, output in zip(found.met.tolist(), targets.tolist(), predicted.tolist(), strict=True)
        ]
    elif isinstance(operator, Polynomial):
        table = LookUp(operator)
        answers = [table.look_up(target) for target in targets.tolist()]
        setpoints = np.array([setpoint for setpoint, _ in answers])
        passing = np.full(targets.size, np.nan)
        predicted = operator.evaluate(setpoints)
        reached = [reach for _, reach in answers]
    else:
        raise DataError(f"models of the kind {model.name} cannot be inverted; a Preisach model or a polynomial can")
    flags = tuple(reach.value for reach in reached)
    return InvertedTargets(targets, setpoints, passing, predicted, flags)


def check_unit(expected: str, unit: str, column: str) -> None:
    """Check that a column's unit is that of the model; an unknown unit passes.

    Raises
    ------
    DataError
        If both are known and differ.
    """
    if unit and expected and unit != expected:
        raise DataError(f"column {column} is in {unit}; the model has it in {expected}")


def outside_of_range(model: ModelFile, inputs: Floats) -> str:
    """Return a warning if inputs leave the range for which the model was identified, else an empty text."""
    low, high = model.operator.input_range
    outside = np.flatnonzero((inputs < low) | (inputs > high))
    if outside.size == 0:
        return ""
    return (
        f"{outside.size} of {inputs.size} inputs (first: row {outside[0] + 1}, {inputs[outside[0]]:g}) are outside "
        f"of {low:g} to {high:g} {model.operator.input_unit}, for which the model was identified"
    )


def certificate_lines(identified: IdentifiedFile) -> Sequence[tuple[str, str]]:
    """Return what a person should know of a fit, as (name, text) pairs."""
    found, operator = identified.identification, identified.file.operator
    unit = f" {operator.output_unit}" if operator.output_unit else ""
    errors, certificate = found.errors, found.certificate
    return (
        ("samples", f"{identified.inputs.size - found.skip} (skipped: {found.skip})"),
        ("largest error", f"{errors.maximum:.4g}{unit} ({errors.maximum_percent:.2f} % of the range)"),
        ("RMS error", f"{errors.rms:.4g}{unit} ({errors.rms_percent:.2f} % of the range)"),
        ("coefficients", f"{certificate.passive} free, {certificate.active} held at zero"),
        ("KKT residual", f"{certificate.kkt_residual:.1e}" + ("" if certificate.converged else " (NOT converged)")),
        ("condition", f"{certificate.condition:.2g}"),
        ("cells swept", f"{100 * certificate.coverage:.1f} %"),
    )
