"""From a file of measurements to a model file, and back: what `bench identify` and `bench predict` do."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.control.baselines import LookUp
from bench.controllers import Policy
from bench.errors import ConfigurationError, DataError
from bench.hysteresis import (
    MemoryCurve,
    Operator,
    Polynomial,
    PrandtlIshlinskii,
    Preisach,
    ThermalExpansion,
    uniform_levels,
)
from bench.hysteresis.inverse import Inverse, Reach
from bench.identification import (
    MODELS,
    Assessment,
    Comparison,
    Coverage,
    CrossValidation,
    Errors,
    Identification,
    assess,
    compare,
    covering_sequence,
    cross_validate,
    damped_oscillation,
    first_order_reversals,
    identify,
    measure_coverage,
)
from bench.results.data import FEWEST_ROWS, check_excitation, read_columns
from bench.results.model_file import ModelFile, load_model

Floats = npt.NDArray[np.float64]


SMOOTHING = (0.0, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
"""Weights of the roughness penalty that cross-validation tries."""


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
    coverage : Coverage or None
        Which cells of the Preisach plane the input has swept; None for a model without one.
    trials : CrossValidation or None
        The table by which smoothing was chosen, if it was.
    """

    file: ModelFile
    identification: Identification
    warnings: tuple[str, ...]
    inputs: Floats
    outputs: Floats
    coverage: Coverage | None = None
    trials: CrossValidation | None = None

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
            "coverage": self.coverage.fraction if self.coverage else certificate.coverage,
            "largest_uncertainty": _largest(found.uncertainties),
            "smoothing": self.trials.best.smoothing if self.trials else None,
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
    initial: str | None = None,
    cross_validated: bool = False,
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
    initial : str, optional
        What is known of the memory at the first row: `negative` or `positive` saturation, or unknown, and then
        `skip` the rows that it could reach or `estimate` it; None leaves the model's own default.
    cross_validated : bool
        Whether smoothing is chosen by cross-validation among `SMOOTHING` (relative weights).

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
    if initial is not None:
        options["initial"] = initial
    trials: CrossValidation | None = None
    try:
        if cross_validated:
            others = {name: value for name, value in options.items() if name != "levels"}
            orders = None if levels is None else [levels]
            trials = cross_validate(model, inputs, outputs, smoothing=SMOOTHING, levels=orders, skip=skip, **others)
            smoothing = trials.best.smoothing
        found = identify(model, inputs, outputs, skip=skip, smoothing=smoothing, **options)
    except ValueError as error:
        raise ConfigurationError(f"model {model}: {error}") from None
    warnings += found.warnings
    coverage: Coverage | None = None
    memory: MemoryCurve | tuple[float, ...] | None = None
    if isinstance(found.model, Preisach):
        memory = found.initial_state.advance(inputs)
        coverage = measure_coverage(found.model, inputs, found.initial_state)
    elif isinstance(found.model, PrandtlIshlinskii):
        memory = found.model.advance(found.initial_state, inputs)
    provenance = {
        "source": path.name,
        "input": input_column,
        "output": output_column,
        "rows": int(inputs.size),
        "skipped": skip,
        **errors_json(found.errors),
        "kkt": found.certificate.kkt_residual,
    }
    file = ModelFile(model, found.model, memory, provenance)
    return IdentifiedFile(file, found, tuple(dict.fromkeys(warnings)), inputs, outputs, coverage, trials)


def _largest(uncertainties: Floats) -> float | None:
    known = uncertainties[np.isfinite(uncertainties)]
    return float(known.max()) if known.size else None


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
        Any model: Preisach and Prandtl-Ishlinskii models are inverted exactly with their memory, a polynomial by
        its look-up table.
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
        start = model.memory if continue_memory and isinstance(model.memory, MemoryCurve) else None
        found = Inverse(operator, policy).follow(targets, start)
        setpoints, passing, predicted = found.setpoints, found.saturating, found.outputs
        reached = [
            Reach.MET if met else Reach.TOO_HIGH if target > output else Reach.TOO_LOW
            for met, target, output in zip(found.met.tolist(), targets.tolist(), predicted.tolist(), strict=True)
        ]
    elif isinstance(operator, PrandtlIshlinskii):
        state = operator.initial_state()
        if continue_memory and isinstance(model.memory, tuple):
            state = model.memory
        low, high = operator.output_range()
        reachable = np.clip(targets, low, high)
        try:
            inverse = operator.inverse()
        except ValueError as error:
            raise DataError(f"model {model.name} has a plateau, so it has no inverse: {error}") from None
        setpoints = inverse.evaluate(reachable, operator.inverse_state(state))
        passing = np.full(targets.size, np.nan)
        predicted = operator.evaluate(setpoints, state)
        reached = [
            Reach.TOO_HIGH if target > high else Reach.TOO_LOW if target < low else Reach.MET
            for target in targets.tolist()
        ]
    elif isinstance(operator, Polynomial):
        table = LookUp(operator)
        answers = [table.look_up(target) for target in targets.tolist()]
        setpoints = np.array([setpoint for setpoint, _ in answers])
        passing = np.full(targets.size, np.nan)
        predicted = operator.evaluate(setpoints)
        reached = [reach for _, reach in answers]
    else:
        raise DataError(f"models of the kind {model.name} cannot be inverted")
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
        ("largest uncertainty", f"{_largest(found.uncertainties) or math.nan:.2g} (1σ, of a coefficient)"),
        ("excitation", identified.coverage.summary() if identified.coverage else "no plane to be swept"),
    )


@dataclass(frozen=True)
class ComparedModels:
    """How several models do on one set of measurements.

    Attributes
    ----------
    comparisons : mapping of str to Comparison
        By the model file's name.
    unit : str
        Unit of the output.
    """

    comparisons: Mapping[str, Comparison]
    unit: str

    def to_json(self) -> dict[str, Any]:
        """Return the comparison for programs: `raw` and `rezeroed` errors and the `offset` of each model."""
        return {
            name: {"raw": errors_json(entry.raw), "rezeroed": errors_json(entry.rezeroed), "offset": entry.offset}
            for name, entry in self.comparisons.items()
        }


def compare_models(
    paths: Sequence[Path], data: Path, input_column: str | None, output_column: str | None, *, skip: int = 0
) -> ComparedModels:
    """Compare model files on measurements.

    Parameters
    ----------
    paths : sequence of Path
        Model files.
    data : Path
        CSV file or run.
    input_column, output_column : str or None
        Columns; those that the first model was identified from if None.
    skip : int
        First rows that drive the memory but do not count.

    Raises
    ------
    DataError
        If a file cannot be used, or units do not fit.
    ConfigurationError
        If `skip` leaves nothing.
    """
    files = [load_model(path) for path in paths]
    names = [
        given or str(files[0].provenance.get(key, ""))
        for key, given in (("input", input_column), ("output", output_column))
    ]
    columns = read_columns(data, names)
    inputs, outputs = (columns.values[name] for name in names)
    if not 0 <= skip < inputs.size:
        raise ConfigurationError(f"--skip {skip}: {data} has {inputs.size} rows")
    operators: dict[str, Operator[Any]] = {}
    for path, file in zip(paths, files, strict=True):
        check_unit(file.operator.input_unit, columns.units[names[0]], names[0])
        check_unit(file.operator.output_unit, columns.units[names[1]], names[1])
        name = path.stem if path.stem not in operators else str(path)
        operators[name] = file.operator
    return ComparedModels(compare(operators, inputs, outputs, skip=skip), files[0].operator.output_unit)


def assess_designs(
    plane: tuple[float, float], operating: tuple[float, float], levels: int, dwell: float
) -> dict[str, Assessment]:
    """Return what each excitation sequence tells about a plane, by the name of its protocol.

    Parameters
    ----------
    plane, operating : (float, float)
        Ends of the Preisach plane and of the operating range, input units.
    levels : int
        Number of intervals M of the plane.
    dwell : float
        Settling time at each set-point, s.

    Raises
    ------
    ConfigurationError
        If the ranges do not fit.
    """
    low, high = operating
    try:
        grid = uniform_levels(*plane, levels)
        # The thermal term stands for any reversible part whose two slopes are to be found as well.
        operator = Preisach(
            grid,
            np.zeros(levels * (levels + 1) // 2),
            reversible=ThermalExpansion(low=plane[0], high=plane[1]),
            input_range=operating,
        )
        span = high - low
        sequences = {
            "damped-oscillation": damped_oscillation(low, high, low + 0.524 * span, 36, span / 180.0),
            "first-order-reversals": first_order_reversals(grid, operating),
            "covering, fewest": covering_sequence(grid, operating),
            "covering, fine": covering_sequence(uniform_levels(*plane, 2 * levels), operating, per_cell=2),
        }
        return {name: assess(operator, sequence, dwell=dwell) for name, sequence in sequences.items()}
    except ValueError as error:
        raise ConfigurationError(f"design: {error}") from None
