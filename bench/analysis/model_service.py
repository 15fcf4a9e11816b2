"""From measurements to a model file, and back: the work of `bench identify`, `bench predict` and their like."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.analysis.band_columns import BandedPrediction, calibrate, predict_band
from bench.analysis.examined import Examined, examine
from bench.analysis.predictions import Predictions, Quantity
from bench.analysis.session_recalibration import Session
from bench.analysis.tables.data import FEWEST_ROWS, check_excitation, check_variation, read_columns
from bench.analysis.tables.joined_files import fitted_rows, read_files
from bench.analysis.tables.reading.options import ReadingOptions
from bench.analysis.tables.starting_state import StartingState, digest, starting_state
from bench.analysis.tables.times import (
    bind_times,
    check_model_name,
    check_penalties,
    choose_times,
    foreign_drift,
    is_smoothed,
    read_times,
    time_quantity,
)
from bench.analysis.transients.transient_dynamics import (
    Transients,
    identify_dynamics,
    identify_transients,
    read_transients,
)
from bench.base import ConfigurationError, DataError
from bench.identification import (
    Band,
    Comparison,
    CrossValidation,
    Errors,
    Identification,
    MemoryTest,
    ModelFile,
    Regularization,
    Resolution,
    check_congruency,
    check_options,
    check_return_points,
    compare,
    cross_validate,
    identify,
    identify_in_time,
    load_model,
    measure_errors,
    model_options,
    resolve,
)
from bench.models import Coverage, IdentifiedDynamics, Operator, TimedModel, TimedSequence, find_model

Floats = npt.NDArray[np.float64]


_OF_ALL = ("initial", "orientation")
"""Options of `identify_file` that every model takes, though they are not its own."""

SMOOTHING = (0.0, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
"""Weights of the roughness penalty that cross-validation tries."""

# Coefficients up to which cross-validation that nobody asked for takes seconds.
_MOST_CROSS_VALIDATED = 6000


@dataclass(frozen=True, repr=False)
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
    return_points, congruency : MemoryTest
        Whether the measurements agree with what a Preisach-type model takes for granted.
    coverage : Coverage or None
        Which cells of the Preisach plane the input has swept; None for a model without one.
    resolution : Resolution or None
        What the data say of each coefficient; None for a model without a plane, or with one too fine for it.
    trials : CrossValidation or None
        The table by which smoothing was chosen, if it was.
    assumptions : str
        What was assumed about the layout of the file; empty for a run.
    times : ndarray, shape (N,), or None
        When each row was taken, s; None for a model without time.
    fitted : int or None
        Number of rows that were fitted, to which the errors of the identification belong; None if it is all that
        were not skipped.
    """

    file: ModelFile
    identification: Identification[Any]
    warnings: tuple[str, ...]
    inputs: Floats
    outputs: Floats
    return_points: MemoryTest
    congruency: MemoryTest
    coverage: Coverage | None = None
    resolution: Resolution | None = None
    trials: CrossValidation | None = None
    assumptions: str = ""
    times: Floats | None = None
    fitted: int | None = None

    def __repr__(self) -> str:
        """Return what a person should know of the fit."""
        return "\n".join([self.file.name, *(f"  {name:20} {text}" for name, text in certificate_lines(self))])

    @property
    def all_errors(self) -> Errors:
        """Error measures over all rows that were not skipped, fitted or not: those of `bench predict`."""
        found = self.identification
        measured = self.outputs[found.skip :]
        return measure_errors(measured, measured - found.residuals[found.skip :])

    @cached_property
    def band(self) -> BandedPrediction | None:
        """The prediction band at the measurements; None if none was calibrated."""
        return predict_band(self.file, self.inputs, self.identification.initial_state, self.times)

    def predictions(self) -> Predictions:
        """Return the outputs of the model beside the measurements, as the fit has them."""
        operator, names, band = self.file.response, self.file.provenance, self.band
        return Predictions(
            Quantity(names["input"], operator.input_unit, self.inputs),
            operator.output_unit,
            {self.file.name: self.outputs - self.identification.residuals},
            Quantity(names["output"], operator.output_unit, self.outputs),
            time_quantity(self.times),
            skip=self.identification.skip,
            bands={} if band is None else {self.file.name: band},
        )

    def summary(self) -> dict[str, Any]:
        """Return the result for programs."""
        found = self.identification
        certificate = found.certificate
        operator = self.file.response
        penalties = found.regularization
        return {
            "model": found.model_name,
            "samples": int(self.inputs.size - found.skip),
            **({} if self.fitted is None else {"fitted": self.fitted, "all_rows": errors_json(self.all_errors)}),
            "levels": densities[0].levels.size - 1 if (densities := operator.densities()) else None,
            **errors_json(found.errors),
            "kkt": certificate.kkt_residual,
            "converged": certificate.converged,
            "passive": certificate.passive,
            "active": certificate.active,
            "rank": self.resolution.rank if self.resolution else None,
            "exchangeable": certificate.exchangeable,
            "condition": certificate.condition,
            "coverage": self.coverage.fraction if self.coverage else certificate.coverage,
            "largest_uncertainty": _largest(found.uncertainties),
            "smoothing": self.trials.best.smoothing if self.trials else penalties and penalties.smoothing,
            "ridge": penalties and penalties.ridge,
            "cross_validated_rms": penalties and penalties.rms,
            "orientation": found.orientation,
            "input_unit": operator.input_unit,
            "output_unit": operator.output_unit,
            "return_points": self.return_points.to_json(),
            "congruency": self.congruency.to_json(),
            "warnings": list(self.warnings),
            **({"band": {**band.to_json(), "held_out": band.band.held_out}} if (band := self.band) else {}),
            **({"shape": shape} if (shape := _shape(operator)) else {}),
        }


def option_names(model: str) -> tuple[str, ...]:
    """Return the names of the options that `identify_file` takes for a registered model."""
    own = [option.name for option in model_options(find_model(model))]
    return (*own, "smoothing", "ridge", "skip", "initial", "orientation", "cross_validated", "band")


def check_template(model: str, inputs: Floats, options: Mapping[str, Any]) -> None:
    """Check the values of a model's own options for inputs, shape (N,), without a fit.

    Raises ValueError if the model does not take them.
    """
    spec = find_model(model)
    assert spec.template is not None
    known = [option.name for option in model_options(spec)]
    own = {name: value for name, value in options.items() if name in known}
    check_options(model, own)
    spec.template(inputs, **own)


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
    path: Path | Sequence[Path],
    *,
    input_column: str,
    output_column: str,
    model: str,
    smoothing: float | None = None,
    ridge: float | None = None,
    skip: int = 0,
    cross_validated: bool = False,
    weights_column: str | None = None,
    levels_to_try: Sequence[int] = (),
    train: slice | None = None,
    time_column: str | None = None,
    band: bool = False,
    reading: ReadingOptions | None = None,
    transients: Transients | None = None,
    **options: Any,  # noqa: ANN401 - each model names and types its own
) -> IdentifiedFile:
    """Identify a model from a file of measurements or a run.

    Parameters
    ----------
    path : Path or sequence of Path
        A file that `read_columns` reads, or the folder of a run; of several, each starts with a memory of its own.
    input_column, output_column : str
        Columns of the model's input and output, by name or by number from 1.
    model : str
        Name of an entry of `bench.models`.
    smoothing, ridge : float, optional
        Weights of the penalties on the roughness and the size of the density; `identify` says what None is. If both
        are None and a density with signs has more coefficients than there are rows, cross-validation chooses.
    skip : int
        Number of first rows that drive the memory but do not count in the fit.
    cross_validated : bool
        Whether smoothing is chosen by cross-validation among `SMOOTHING` (relative weights).
    weights_column : str, optional
        Column of the weight of each row, >= 0 (inverse variance, say).
    levels_to_try : sequence of int
        Values of the option `levels` among which cross-validation chooses.
    train : slice, optional
        Rows that are fitted; all others still drive the memory. The errors are those of the rows fitted.
    time_column : str or None
        Column of times, for a model with time.
    band : bool
        Whether a prediction band is calibrated on blocks of the rows.
    reading : ReadingOptions, optional
        What is known of the layout of the file.
    transients : Transients, optional
        Of the runs, as `transients_of` gives them, for several models of the same runs; found if not given.
    **options
        `initial`, `orientation` and the options of the model, as in `identify`; None leaves the default.

    Raises
    ------
    DataError
        If the measurements cannot be used: names row and column.
    ConfigurationError
        If an option is wrong or does not belong to the model.
    """
    check_model_name(model, time_column)
    if skip < 0:
        raise ConfigurationError(f"--skip {skip}: expected a number of rows ≥ 0")
    options = {name: value for name, value in options.items() if value is not None}
    if levels_to_try:
        options["levels"] = levels_to_try[0]
    if time_column is None:
        try:
            check_options(model, {key: value for key, value in options.items() if key not in _OF_ALL})
        except ValueError as error:
            raise ConfigurationError(str(error)) from None
    names = tuple(name for name in (input_column, output_column, weights_column, time_column) if name)
    paths = [path] if isinstance(path, Path) else path
    if time_column is not None and len(paths) > 1:
        raise ConfigurationError(f"--time: expected one file, as times are those of one record; got {len(paths)}")
    files = read_files(paths, names, at_least=FEWEST_ROWS, options=reading)
    columns = files.columns
    inputs, outputs = columns.values[input_column], columns.values[output_column]
    if inputs.size - skip < FEWEST_ROWS:
        left = max(inputs.size - skip, 0)
        raise DataError(f"{columns.source}: --skip {skip} leaves {left} of {inputs.size} rows; too few")
    fitted, odd = fitted_rows(files, inputs, train)
    warnings = (*check_excitation(columns, input_column), *odd)
    check_variation(columns, output_column)
    weights = columns.values[weights_column] if weights_column else None
    if not fitted.all():
        weights = fitted.astype(np.float64) if weights is None else np.where(fitted, weights, 0.0)
    for key, column in (("input_unit", input_column), ("output_unit", output_column)):
        if columns.units[column]:
            options[key] = columns.units[column]
    trials: CrossValidation | None = None
    times = None if time_column is None else read_times(columns, time_column)
    if times is not None:
        smooth = SMOOTHING if cross_validated else smoothing or 0.0
        check_penalties(model, smooth, ridge=ridge, levels_to_try=levels_to_try)
        options |= {"smoothing": smooth} if smooth else {}
    try:
        if times is not None:
            found = identify_in_time(model, times, inputs, outputs, weights=weights, skip=skip, **options)
            memory, coverage = found.model.run(times, inputs, found.initial_state)[1], None
        else:
            open_smoothing = smoothing is None and ridge is None and not (cross_validated or levels_to_try)
            if open_smoothing and _is_undetermined(model, inputs, options, int(fitted[skip:].sum())):
                cross_validated = True
                warnings += (
                    "there are more cells of the density than samples: smoothness decides between them, by "
                    "cross-validation; --smoothing gives its weight",
                )
            if cross_validated or levels_to_try:
                others, orders = dict(options), levels_to_try or None
                if isinstance(options.get("levels"), int):
                    orders = orders or [others["levels"]]
                    del others["levels"]
                # A signed density is not fitted without a penalty.
                is_open = cross_validated or (smoothing is None and not find_model(model).constrained)
                tried = SMOOTHING if is_open else (smoothing or 0.0,)
                ridge = ridge or 0.0
                trials = cross_validate(
                    model,
                    inputs,
                    outputs,
                    smoothing=tried,
                    ridge=ridge,
                    levels=orders,
                    weights=weights,
                    skip=skip,
                    **others,
                )
                smoothing = trials.best.smoothing
                if trials.best.levels is not None and levels_to_try:
                    options["levels"] = trials.best.levels
            found = identify(
                model, inputs, outputs, weights=weights, skip=skip, smoothing=smoothing, ridge=ridge, **options
            )
            memory = found.model.advance(found.initial_state, inputs)
            coverage = found.model.coverage(inputs, found.initial_state)
        penalties = found.regularization or Regularization(smoothing or 0.0, ridge or 0.0)
        calibrated: Band | None = None
        if band:
            calibrated = calibrate(found, inputs, outputs, weights, skip, penalties, options, times)
    except ValueError as error:
        raise ConfigurationError(f"model {model}: {error}") from None
    counted = fitted & (np.arange(inputs.size) >= found.skip)
    if not fitted.all():
        found = replace(found, errors=measure_errors(outputs[counted], (outputs - found.residuals)[counted]))
    warnings += found.warnings
    tests = check_return_points(inputs, outputs), check_congruency(inputs, outputs)
    if time_column is None:
        # A model with time takes neither for granted.
        warnings += tuple(test.text for test in tests if test.holds is False)
    resolution: Resolution | None = None
    if coverage is not None:
        regressor = found.model.regressor(inputs, found.initial_state)
        counting = np.ones(inputs.size) if weights is None else weights
        resolution = resolve(regressor, counting, found.skip, penalties.smoothing, penalties.ridge)
    provenance = {
        "source": ", ".join(each.name for each in paths),
        "input": input_column,
        "output": output_column,
        **({} if time_column is None else {"time": time_column}),
        "rows": int(inputs.size),
        "skipped": found.skip,
        "initial": options.get("initial"),
        "input_sha256": digest(inputs),
        **errors_json(found.errors),
        "kkt": found.certificate.kkt_residual,
        "smoothing": penalties.smoothing,
        "ridge": penalties.ridge,
        "orientation": found.orientation,
    }
    dynamics: IdentifiedDynamics | None = None
    if times is None:
        transients = transients or transients_of(paths, input_column, output_column)
        if transients is not None:
            dynamics = identify_dynamics(transients, [found.model.evaluate] * len(transients.recordings))
    file = ModelFile(model, found.model, memory, provenance, found.initial_state, calibrated, dynamics)
    return IdentifiedFile(
        file,
        found,
        tuple(dict.fromkeys(warnings)),
        inputs,
        outputs,
        *tests,
        coverage,
        resolution,
        trials,
        columns.assumptions,
        times,
        None if fitted.all() else int(counted.sum()),
    )


def transients_of(paths: Sequence[Path], drive: str, response: str) -> Transients | None:
    """Return what the transients of runs show of a drive and a response; None of tables, which have none.

    Raises DataError if the record of a run is damaged.
    """
    runs = [path for path in paths if path.is_dir() or path.suffix == ".sqlite"]
    found = [recording for path in runs if (recording := read_transients(path, drive, response)) is not None]
    return identify_transients(found) if found else None


def _is_undetermined(model: str, inputs: Floats, options: Mapping[str, Any], samples: int) -> bool:
    """Return whether samples are fewer than the coefficients of a density with signs, which nothing else bounds."""
    spec = find_model(model)
    assert spec.template is not None
    own = {name: value for name, value in options.items() if name not in _OF_ALL}
    template: Operator[Any] = spec.template(inputs, **own)
    count = template.coefficients.size
    return spec.constrained and bool(template.densities()) and samples < count <= _MOST_CROSS_VALIDATED


def _shape(operator: Operator[Any] | TimedModel[Any]) -> dict[str, float]:
    """Return the shape parameters by name; none of an operator that is linear in all it has."""
    if isinstance(operator, TimedModel):
        return {name: value for name, (value, _) in operator.parameters().items()}
    shape = operator.shape_parameters()
    return dict(zip(shape.names, shape.values, strict=True))


def _largest(uncertainties: Floats) -> float | None:
    known = uncertainties[np.isfinite(uncertainties)]
    return float(known.max()) if known.size else None


def predict(
    model: ModelFile,
    inputs: Floats,
    *,
    initial: str | None = None,
    continue_memory: bool = False,
    times: Floats | None = None,
) -> Floats:
    """Return the outputs of a model for a sequence of inputs, shape (N,), in its unit.

    Parameters
    ----------
    model : ModelFile
        The model.
    inputs : ndarray, shape (N,)
        Inputs in the unit of the model, finite.
    initial, continue_memory
        The state before the first input, as for `starting_state`.
    times : ndarray, shape (N,), or None
        s, for a model with time.

    Raises
    ------
    ConfigurationError
        If a model with time has none.
    """
    start = starting_state(model, initial=initial, continue_memory=continue_memory)
    return bind_times(model, times).evaluate(inputs, start.state)


def check_unit(expected: str, unit: str, column: str) -> None:
    """Check that a column's unit is that of the model; an unknown unit passes.

    Raises DataError if both are known and differ.
    """
    if unit and expected and unit != expected:
        raise DataError(f"column {column} is in {unit}; the model has it in {expected}")


def outside_of_range(model: ModelFile, inputs: Floats) -> str:
    """Return a warning if inputs leave the range for which the model was identified, else an empty text."""
    low, high = model.response.input_range
    outside = np.flatnonzero((inputs < low) | (inputs > high))
    if outside.size == 0:
        return ""
    return (
        f"{outside.size} of {inputs.size} inputs (first: row {outside[0] + 1}, {inputs[outside[0]]:g}) are outside "
        f"of {low:g} to {high:g} {model.response.input_unit}, for which the model was identified"
    )


def certificate_lines(identified: IdentifiedFile) -> Sequence[tuple[str, str]]:
    """Return what a person should know of a fit, as (name, text) pairs."""
    found, operator = identified.identification, identified.file.response
    unit = f" {operator.output_unit}" if operator.output_unit else ""
    errors, certificate, largest = found.errors, found.certificate, _largest(found.uncertainties)
    rows = identified.inputs.size - found.skip
    partly = f"{identified.fitted} fitted of {rows}"
    if isinstance(operator, TimedModel):
        own = [(name, f"{value:.4g} {its}".rstrip()) for name, (value, its) in operator.parameters().items()]
    else:
        shape = ", ".join(f"{name} {value:.4g}" for name, value in _shape(operator).items())
        own = [("shape", shape)] if shape else []
    return (
        *own,
        ("samples", f"{rows if identified.fitted is None else partly} (skipped: {found.skip})"),
        *_error_lines(errors, unit),
        *([] if identified.fitted is None else _error_lines(identified.all_errors, unit, " of all rows")),
        *_uniqueness(found, identified.resolution),
        *([("penalties", found.regularization.summary(unit))] if found.regularization else []),
        *([("orientation", f"{found.orientation} with the input")] if found.orientation else []),
        ("KKT residual", f"{certificate.kkt_residual:.1e}" + ("" if certificate.converged else " (NOT converged)")),
        ("condition", f"{certificate.condition:.2g}"),
        ("largest uncertainty", "unknown" if largest is None else f"{largest:.2g} (1σ, of a coefficient)"),
        ("excitation", identified.coverage.summary() if identified.coverage else "no plane to be swept"),
        ("return points", identified.return_points.text),
        ("loops", identified.congruency.text),
    )


def _error_lines(errors: Errors, unit: str, which: str = "") -> list[tuple[str, str]]:
    return [
        (f"largest error{which}", f"{errors.maximum:.4g}{unit} ({errors.maximum_percent:.2f} % of the range)"),
        (f"RMS error{which}", f"{errors.rms:.4g}{unit} ({errors.rms_percent:.2f} % of the range)"),
    ]


def _uniqueness(found: Identification[Any], resolution: Resolution | None) -> list[tuple[str, str]]:
    """Return how many coefficients are free, what the data determine of them, and whether others would do as well."""
    certificate = found.certificate
    signed = not isinstance(found.model, TimedModel) and not find_model(found.model_name).constrained
    is_least_norm = signed and found.regularization is None
    if is_least_norm:
        text = f"rank {certificate.passive}, null space of {certificate.active} (least norm)"
    else:
        text = f"{certificate.passive} free, {certificate.active} held at zero"
    lines = [("coefficients", text)]
    if resolution is not None and not is_least_norm:
        lines.append(("determined by data", resolution.summary()))
    if certificate.exchangeable:
        text = (
            f"the minimiser is not unique: {certificate.exchangeable} cells could replace others without "
            "changing the fit"
        )
        unsmoothed = isinstance(found.model, TimedModel) and not is_smoothed(found.model_name)
        remedy = "give fewer --levels" if unsmoothed else "they are resolved by --smoothing"
        lines.append(("not unique", f"{text}; {remedy}"))
    return lines


@dataclass(frozen=True)
class ComparedModels:
    """How several models do on one set of measurements.

    Attributes
    ----------
    comparisons : mapping of str to Comparison
        By the model file's name.
    predictions : Predictions
        What each model gives, row by row.
    assumptions : str
        What was assumed about the layout of the file; empty for a run.
    examined : mapping of str to Examined
        The session recalibrated and the band of each model, by the same names.
    warnings : tuple of str
        What of a model belongs to its own record only.
    """

    comparisons: Mapping[str, Comparison]
    predictions: Predictions
    assumptions: str = ""
    examined: Mapping[str, Examined] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def unit(self) -> str:
        """The unit of the output."""
        return self.predictions.unit

    @property
    def skip(self) -> int:
        """The number of first rows left out of the errors."""
        return self.predictions.skip

    def to_json(self) -> dict[str, Any]:
        """Return the comparison for programs: `raw` and `rezeroed` errors, `offset` and `skipped` of each model."""
        return {
            name: {
                "raw": errors_json(entry.raw),
                "rezeroed": errors_json(entry.rezeroed),
                "offset": entry.offset,
                "skipped": self.skip,
                **(self.examined[name].to_json() if name in self.examined else {}),
                **({"recalibrated": errors_json(mended)} if (mended := self.recalibrated(name)) else {}),
            }
            for name, entry in self.comparisons.items()
        }

    def recalibrated(self, name: str) -> Errors | None:
        """Return a model's errors after recalibration, over the same rows as the others; None without one."""
        found = self.examined.get(name)
        return None if found is None or found.recalibration is None else found.errors()


def compare_models(
    paths: Sequence[Path],
    data: Path,
    input_column: str | None,
    output_column: str | None,
    *,
    skip: int | None = None,
    initial: str | None = None,
    time_column: str | None = None,
    session: Session | None = None,
    reading: ReadingOptions | None = None,
) -> ComparedModels:
    """Compare model files on measurements.

    Parameters
    ----------
    paths : sequence of Path
        Model files.
    data : Path
        A file that `read_columns` reads, or a run.
    input_column, output_column : str or None
        Columns; those that the first model was identified from if None.
    skip, initial
        First rows that drive the memory but do not count, and the state before them, as for `starting_state`. Of
        the numbers of rows of the models the greatest is taken for all, so that their errors are of the same rows.
    time_column : str or None
        Column of times, for models with time; that of the first such model if None.
    session : Session, optional
        What is estimated of the session for each model; the rows that it uses do not count either.
    reading : ReadingOptions, optional
        What is known of the layout of the file.

    Raises
    ------
    DataError
        If a file cannot be used, or units do not fit.
    ConfigurationError
        If `skip` leaves nothing, or there is no such initial state.
    """
    files = [load_model(path) for path in paths]
    names = [
        given or str(files[0].provenance.get(key, ""))
        for key, given in (("input", input_column), ("output", output_column))
    ]
    timed = [file for file in files if isinstance(file.model, TimedModel)]
    if time_column is None and timed:
        time_column = choose_times(timed[0], data, None, reading)
    columns = read_columns(data, [*names, *([time_column] if time_column else [])], options=reading)
    inputs, outputs = (columns.values[name] for name in names)
    times = read_times(columns, time_column) if time_column else None
    operators: dict[str, Operator[Any] | TimedSequence] = {}
    starts: dict[str, StartingState] = {}
    for path, file in zip(paths, files, strict=True):
        check_unit(file.response.input_unit, columns.units[names[0]], names[0])
        check_unit(file.response.output_unit, columns.units[names[1]], names[1])
        name = path.stem if path.stem not in operators else str(path)
        operators[name] = bind_times(file, times)
        starts[name] = starting_state(file, inputs, initial=initial, skip=skip)
    states = {name: start.state for name, start in starts.items()}
    most = max(start.skip for start in starts.values())
    examined = {
        name: examine(file, inputs, outputs, state=states[name], session=session, skip=most, times=times)
        for name, file in zip(operators, files, strict=True)
    }
    first = most if session is None else session.first_unused(inputs.size, most)
    comparisons = compare(operators, inputs, outputs, states=states, skip=first)
    predictions = Predictions(
        Quantity(names[0], columns.units[names[0]] or files[0].response.input_unit, inputs),
        files[0].response.output_unit,
        {name: entry.predicted for name, entry in examined.items()},
        Quantity(names[1], columns.units[names[1]], outputs),
        time_quantity(times),
        skip=first,
        bands={name: entry.band for name, entry in examined.items() if entry.band is not None},
    )
    drifts = () if session is not None else tuple(filter(None, (foreign_drift(file, inputs) for file in files)))
    return ComparedModels(comparisons, predictions, columns.assumptions, examined, drifts)
