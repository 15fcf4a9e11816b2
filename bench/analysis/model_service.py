"""From measurements to a model file, and back: the work of `bench identify`, `bench predict` and their like."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from typing import Any

import numpy as np

from bench.analysis.applied import Applied
from bench.analysis.band_columns import BandedPrediction, band_of, calibrate
from bench.analysis.picture import Picture
from bench.analysis.tables.data import check_variation, is_run
from bench.analysis.tables.dataset import Dataset, digest
from bench.analysis.transients.transient_dynamics import (
    Transients,
    identify_dynamics,
    identify_transients,
    read_transients,
)
from bench.analysis.uncertain_models import PROVENANCE, ModelUncertainty, identified_uncertainty
from bench.base import ConfigurationError, Floats, closest, html_table, percent, prefixed
from bench.identification import (
    ONE_RUN,
    Advice,
    CrossValidation,
    Errors,
    Identification,
    MemoryTest,
    ModelFile,
    Regularization,
    Resolution,
    Validity,
    advise_on_record,
    check_congruency,
    check_options,
    check_return_points,
    cross_validate,
    identify,
    identify_in_time,
    measure_errors,
    model_options,
    once,
    record_of,
    resolve,
    template_of,
)
from bench.models import (
    Coverage,
    IdentifiedDynamics,
    Operator,
    TimedModel,
    find_model,
    identifiable_models,
    timed_models,
)
from bench.record import Record

_OF_ALL = ("initial", "orientation")
"""Options that every model takes, though they are not its own."""

SMOOTHING = (0.0, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
"""Weights of the roughness penalty that cross-validation tries. Derivation: decades from no effect to flatness."""

# Coefficients up to which cross-validation that nobody asked for takes seconds. Derivation: their normal equations
# have 0.3 GB, a tenth of what a small computer has.
_MOST_CROSS_VALIDATED = 6000


# Part of the time between rows below which a time of a model is implausible. Derivation: the next row finds nothing
# left of it, and a step of the input cannot be that sharp.
_SHORTEST = 1e-3

_UNIT_OF_TIMES = "; the rows do not show it, unless the unit of their times is wrong (--format time-unit=UNIT)"


@dataclass(frozen=True)
class FitOptions:
    """How a model is fitted to a dataset.

    Attributes
    ----------
    smoothing, ridge : float or None
        Weights of the penalties on the roughness and the size of the density; `identify` says what None is. If both
        are None and a density with signs has more coefficients than there are rows, cross-validation chooses.
    skip : int
        Number of first rows that drive the memory but do not count in the fit.
    cross_validated : bool
        Whether smoothing is chosen by cross-validation among `SMOOTHING` (relative weights).
    levels_to_try : sequence of int
        Values of the option `levels` among which cross-validation chooses.
    train : slice or None
        Rows that are fitted; all others still drive the memory. The errors are those of the rows fitted.
    band : bool
        Whether a prediction band is calibrated on blocks of the rows.
    own : mapping of str to object
        `initial`, `orientation` and the options of the model, as in `identify`; None leaves the default.
    """

    smoothing: float | None = None
    ridge: float | None = None
    skip: int = 0
    cross_validated: bool = False
    levels_to_try: Sequence[int] = ()
    train: slice | None = None
    band: bool = False
    own: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> FitOptions:
        """Return options by name; those that are not its attributes are the model's own."""
        shared = {each.name for each in fields(cls)} - {"own"}
        given = {name: value for name, value in options.items() if name in shared}
        return cls(**given, own={name: value for name, value in options.items() if name not in shared})


@dataclass(frozen=True, repr=False)
class IdentifiedFile:
    """A model that was identified from a file of measurements.

    Attributes
    ----------
    file : ModelFile
        The model, ready to be saved.
    identification : Identification
        The fit behind it.
    advice : tuple of Advice
        What the data cannot decide, and what is odd about them and the fit, each once.
    data : Dataset
        The measurements.
    return_points, congruency : MemoryTest
        Whether the measurements agree with what a Preisach-type model takes for granted.
    coverage : Coverage or None
        Which cells of the Preisach plane the input has swept; None for a model without one.
    resolution : Resolution or None
        What the data say of each coefficient; None for a model without a plane, or with one too fine for it.
    trials : CrossValidation or None
        The table by which smoothing was chosen, if it was.
    fitted : int or None
        Number of rows that were fitted, to which the errors of the identification belong; None if it is all that
        were not skipped.
    refit : callable or None
        Fits other inputs and outputs of the same rows in the same way; None of a model with time.
    uncertainty : ModelUncertainty or None
        What is known of the model, after `with_uncertainty`.
    """

    file: ModelFile
    identification: Identification[Any]
    advice: tuple[Advice, ...]
    data: Dataset
    return_points: MemoryTest
    congruency: MemoryTest
    coverage: Coverage | None = None
    resolution: Resolution | None = None
    trials: CrossValidation | None = None
    fitted: int | None = None
    refit: Callable[[Floats, Floats], Operator[Any]] | None = None
    uncertainty: ModelUncertainty | None = None

    def plot(self) -> Picture:
        """Draw the measured loops and those of the model, and below them what it leaves.

        Raises DataError if the measurements cannot be read again.
        """
        from bench.analysis.applied_figures import draw_in

        return Picture.drawn_by(lambda folder: draw_in(folder, "fit", {self.file.name: self.applied()})[0])

    def _repr_html_(self) -> str:
        lines = certificate_lines(self, verbose=False)
        return html_table((), lines, f"{self.file.name}: {fit_sentence(self)}")

    def __repr__(self) -> str:
        """Return what a person should know of the fit."""
        lines = certificate_lines(self, verbose=False)
        return "\n".join(
            [f"{self.file.name}: {fit_sentence(self)}", *(f"  {name:26} {text}" for name, text in lines)]
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """The advice as sentences, but for what holds for every record of one run."""
        return tuple(str(each) for each in self.advice if each.code != ONE_RUN)

    @property
    def inputs(self) -> Floats:
        """The measured inputs, shape (N,)."""
        return self.data.inputs

    @property
    def outputs(self) -> Floats:
        """The measured outputs, shape (N,)."""
        return self.data.outputs

    @property
    def all_errors(self) -> Errors:
        """Error measures over all rows that were not skipped, fitted or not: those of `bench predict`."""
        found = self.identification
        measured = self.outputs[found.skip :]
        return measure_errors(measured, measured - found.residuals[found.skip :])

    def with_uncertainty(self) -> IdentifiedFile:
        """Return the model with the uncertainty of its quantities, which its file keeps as well.

        It is unchanged if it has time, or was not identified from one run whose rig file states the uncertainty of
        the output.
        """
        data = self.data
        if self.refit is None or len(data.paths) != 1 or not is_run(data.paths[0]) or data.output is None:
            return self
        with Record(data.paths[0]) as record:
            found = identified_uncertainty(
                record,
                (data.input.name, data.output.name),
                self.inputs,
                self.outputs,
                self.identification.residuals,
                self.file.operator,
                self.refit,
            )
        if found is None:
            return self
        provenance = {**self.file.provenance, PROVENANCE: found.to_json()}
        return replace(self, file=replace(self.file, provenance=provenance), uncertainty=found)

    @property
    def band(self) -> BandedPrediction | None:
        """The prediction band; None if none was calibrated."""
        return band_of(self.file)

    def applied(self) -> Applied:
        """Return the outputs of the model beside the measurements, as the fit has them."""
        found = self.identification
        return Applied.to(self.data, self.file, self.outputs - found.residuals, found.skip, found.initial_state)

    def summary(self) -> dict[str, Any]:
        """Return the result for programs."""
        found = self.identification
        certificate = found.certificate
        operator = self.file.response
        penalties = found.regularization
        return {
            "model": found.model_name,
            "samples": int(self.inputs.size - found.skip),
            **({} if self.fitted is None else {"fitted": self.fitted, "all_rows": self.all_errors.to_json()}),
            "levels": densities[0].levels.size - 1 if (densities := operator.densities()) else None,
            **found.errors.to_json(),
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
            "advice": [asdict(each) for each in self.advice],
            "validity": self.file.valid.to_json(),
            **({"band": {**band.to_json(), "held_out": band.band.held_out}} if (band := self.band) else {}),
            **({"shape": shape} if (shape := _shape(operator)) else {}),
            **({} if self.uncertainty is None else {"uncertainty": self.uncertainty.to_json()}),
        }


def option_names(model: str) -> tuple[str, ...]:
    """Return the names of the options by which a registered model is fitted."""
    own = [option.name for option in model_options(find_model(model))]
    return (*own, "smoothing", "ridge", "skip", "initial", "orientation", "cross_validated", "band")


def check_template(model: str, inputs: Floats, options: Mapping[str, Any]) -> None:
    """Check the values of a model's own options for inputs, shape (N,), without a fit.

    Raises ValueError if the model does not take them.
    """
    spec = find_model(model)
    known = [option.name for option in model_options(spec)]
    own = {name: value for name, value in options.items() if name in known}
    check_options(model, own)
    template_of(spec, inputs, own)


def _implausible_times(model: TimedModel[Any], times: Floats) -> Iterator[Advice]:
    """Yield warnings of the times of a model that rows at these times cannot show."""
    interval, duration = float(np.median(np.diff(times))), float(np.ptp(times))
    for name, (value, unit) in model.parameters().items():
        if unit != "s":
            continue
        if value < _SHORTEST * interval:
            text = f"{name}: {value:.3g} s is under a thousandth of the {interval:.3g} s between rows{_UNIT_OF_TIMES}"
            yield Advice(f"{name}-short", text)
        elif value > duration:
            text = f"{name}: {value:.3g} s is longer than the record, which lasts {duration:.3g} s{_UNIT_OF_TIMES}"
            yield Advice(f"{name}-long", text)


def identify_model(
    data: Dataset, model: str, options: FitOptions | None = None, transients: Transients | None = None
) -> IdentifiedFile:
    """Identify a model from measurements.

    Parameters
    ----------
    data : Dataset
        Input and output, and for a model with time, only, the times; of several files each starts with a memory of
        its own.
    model : str
        Name of an entry of `bench.models`.
    options : FitOptions, optional
        How it is fitted.
    transients : Transients, optional
        Of the runs, as `transients_of` gives them, for several models of the same runs; found if not given.

    Raises
    ------
    DataError
        If the measurements cannot be used: names row and column.
    ConfigurationError
        If an option is wrong or does not belong to the model.
    """
    options = options or FitOptions()
    own = {name: value for name, value in options.own.items() if value is not None}
    if options.levels_to_try:
        own["levels"] = options.levels_to_try[0]
    _check_model(model, data, options, own)
    fitted, advice = data.fitted_rows(options.train, options.skip)
    inputs, outputs, times, measured, record = data.inputs, data.outputs, data.times, data.output, record_of(fitted)
    assert measured is not None
    check_variation(data.source, measured)
    if not fitted.all():
        weights = fitted.astype(np.float64) if data.weights is None else np.where(fitted, data.weights, 0.0)
        data = replace(data, weights=weights)
    units = {"input_unit": data.input.unit, "output_unit": measured.unit}
    own |= {key: unit for key, unit in units.items() if unit}
    trials: CrossValidation | None = None
    coverage: Coverage | None = None
    found: Identification[Any]
    try:
        if times is not None:
            if smooth := SMOOTHING if options.cross_validated else options.smoothing:
                own["smoothing"] = smooth
            found = identify_in_time(model, times, inputs, outputs, weights=data.weights, skip=options.skip, **own)
            memory = found.model.run(times, inputs, found.initial_state)[1]
        else:
            if _is_undetermined(model, data, options, own, int(fitted[options.skip :].sum())):
                options = replace(options, cross_validated=True)
                text = "there are more cells of the density than samples: smoothness decides between them, by "
                advice += (Advice("more-cells", f"{text}cross-validation", "--smoothing gives its weight"),)
            if options.cross_validated or options.levels_to_try:
                trials = _cross_validate(model, data, options, own)
                options = replace(options, smoothing=trials.best.smoothing, ridge=options.ridge or 0.0)
                if trials.best.levels is not None and options.levels_to_try:
                    own["levels"] = trials.best.levels
            found = identify(
                model,
                inputs,
                outputs,
                weights=data.weights,
                skip=options.skip,
                smoothing=options.smoothing,
                ridge=options.ridge,
                **own,
            )
            memory = found.model.advance(found.initial_state, inputs)
            coverage = found.model.coverage(inputs[record], found.initial_state)
        penalties = found.regularization or Regularization(options.smoothing or 0.0, options.ridge or 0.0)
        band = calibrate(found, data, options.skip, penalties, own) if options.band else None
    except ValueError as error:
        raise ConfigurationError(f"model {model}: {error}") from None
    counted = fitted & (np.arange(inputs.size) >= found.skip)
    used = counted if data.weights is None else counted & (data.weights > 0.0)
    validity = Validity.of_rows(inputs, used, times, found.skip)
    if isinstance(found.model, Operator) and found.model.memoryless:
        validity = replace(validity, moves=None)
    if not fitted.all():
        found = replace(found, errors=measure_errors(outputs[counted], (outputs - found.residuals)[counted]))
    timed = None if times is None else times[record]
    runs = max(len(data.starts), 1)
    advice = (*advise_on_record(inputs[record], timed, runs, counted[record]), *advice, *found.advice)
    if times is not None:
        advice = (*advice, *_implausible_times(found.model, times))
    known = inputs[record], outputs[record]
    tests = check_return_points(*known), check_congruency(*known)
    if times is None:
        # A model with time takes neither for granted.
        advice += tuple(
            Advice(test.name.replace(" ", "-"), test.text, test.remedy) for test in tests if not test.agrees
        )
    resolution: Resolution | None = None
    if coverage is not None:
        regressor = found.model.regressor(inputs, found.initial_state)
        counting = np.ones(inputs.size) if data.weights is None else data.weights
        resolution = resolve(regressor, counting, found.skip, penalties.smoothing, penalties.ridge)
    provenance = {
        "source": data.name,
        "input": data.input.name,
        "output": measured.name,
        **({} if data.time is None else {"time": data.time.name}),
        "rows": int(inputs.size),
        "skipped": found.skip,
        "initial": own.get("initial"),
        "input_sha256": digest(inputs),
        **found.errors.to_json(),
        "kkt": found.certificate.kkt_residual,
        "smoothing": penalties.smoothing,
        "ridge": penalties.ridge,
        "orientation": found.orientation,
    }
    dynamics: IdentifiedDynamics | None = None
    if times is None and (transients := transients or transients_of(data)) is not None:
        dynamics = identify_dynamics(transients, [found.model.evaluate] * len(transients.recordings))
    return IdentifiedFile(
        ModelFile(model, found.model, memory, provenance, found.initial_state, band, dynamics, validity),
        found,
        once(advice),
        data,
        *tests,
        coverage,
        resolution,
        trials,
        None if fitted.all() else int(counted.sum()),
        None if times is not None else partial(_refit, model, data.weights, options.skip, penalties, own),
    )


def _refit(
    model: str,
    weights: Floats | None,
    skip: int,
    penalties: Regularization,
    own: Mapping[str, Any],
    inputs: Floats,
    outputs: Floats,
) -> Operator[Any]:
    """Return the model of other inputs and outputs, shape (N,), fitted with the same options and penalties."""
    smoothing, ridge = penalties.smoothing, penalties.ridge
    found: Identification[Any] = identify(
        model, inputs, outputs, weights=weights, skip=skip, smoothing=smoothing, ridge=ridge, **own
    )
    return found.model  # type: ignore[no-any-return]


def _check_model(model: str, data: Dataset, options: FitOptions, own: Mapping[str, Any]) -> None:
    """Raise ConfigurationError if there is no such model, or it does not take times or an option."""
    timed = timed_models()
    if model not in timed:
        try:
            find_model(model)
        except ValueError:
            known = closest(model, sorted([*identifiable_models(), *timed]), "`bench show models`")
            raise ConfigurationError(f"there is no model {model!r}; {known}") from None
        if data.time is not None:
            raise ConfigurationError(
                f"--time: {model} is a model without time; with time there are: {', '.join(timed)}"
            )
        try:
            check_options(model, {key: value for key, value in own.items() if key not in _OF_ALL})
        except ValueError as error:
            raise ConfigurationError(str(error)) from None
        return
    if data.time is None:
        raise ConfigurationError(
            f"model {model} needs the time of each row: give --time COLUMN, or --format interval=TIME"
        )
    if options.ridge or ((options.smoothing or options.cross_validated) and not _is_smoothed(model)):
        others = "-o ridge=WEIGHT" if _is_smoothed(model) else "--smoothing, -o ridge=WEIGHT or --cross-validate"
        raise ConfigurationError(f"model {model} takes no {others}")
    if options.levels_to_try:
        raise ConfigurationError(f"--levels: model {model} takes one number; it is not chosen by cross-validation")


def _is_smoothed(model: str) -> bool:
    """Return whether a model with time takes a weight of smoothing."""
    fit = timed_models()[model].fit_in_time
    assert fit is not None
    return "smoothing" in inspect.signature(fit).parameters


def _cross_validate(model: str, data: Dataset, options: FitOptions, own: Mapping[str, Any]) -> CrossValidation:
    others, orders = dict(own), options.levels_to_try or None
    if isinstance(others.get("levels"), int):
        levels = others.pop("levels")
        orders = orders or [levels]
    # A signed density is not fitted without a penalty.
    is_open = options.cross_validated or (options.smoothing is None and not find_model(model).constrained)
    return cross_validate(
        model,
        data.inputs,
        data.outputs,
        smoothing=SMOOTHING if is_open else (options.smoothing or 0.0,),
        ridge=options.ridge or 0.0,
        levels=orders,
        weights=data.weights,
        skip=options.skip,
        **others,
    )


def transients_of(data: Dataset) -> Transients | None:
    """Return what the transients of runs show of their drive and response; None of tables, which have none.

    Raises DataError if the record of a run is damaged.
    """
    runs = [path for path in data.paths if is_run(path)]
    assert data.output is not None
    names = data.input.name, data.output.name
    found = [recording for path in runs if (recording := read_transients(path, *names)) is not None]
    return identify_transients(found) if found else None


def _is_undetermined(model: str, data: Dataset, options: FitOptions, own: Mapping[str, Any], samples: int) -> bool:
    """Return whether samples are fewer than the coefficients of a density with signs, which nothing else bounds."""
    if options.smoothing is not None or options.ridge is not None or options.cross_validated or options.levels_to_try:
        return False
    spec = find_model(model)
    template = template_of(spec, data.inputs, {name: value for name, value in own.items() if name not in _OF_ALL})
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


_QUALITY = ((2.0, "Good fit"), (8.0, "Fair fit"), (math.inf, "Poor fit"))
"""Greatest error in percent of the range, and what a fit with it is called.

Source: "Three-Dimensional Hysteresis Modeling of Robotic Artificial Muscles", Figs. 7 and 10: the proposed model has
an RMS error of 7.2 % of the range, those it is compared with 11.8 % and more; a quarter of the former is good.
"""


def fit_sentence(identified: IdentifiedFile, left_out: float | None = None) -> str:
    """Return in one sentence how good a fit is.

    Parameters
    ----------
    identified : IdentifiedFile
        The fit.
    left_out : float, optional
        Error on data that were left out of the fit, as a part of the range; that of the prediction band if there is
        one and this is not given.
    """
    found = identified.identification
    if left_out is None and identified.band is not None and found.errors.span > 0.0:
        left_out = identified.band.band.held_out / found.errors.span
    errors = [found.errors.rms_percent, *([] if left_out is None else [100.0 * left_out])]
    quality = next(name for most, name in _QUALITY if max(errors) <= most or math.isinf(most))
    parts = [f"{percent(errors[0])} of range", *(f"{percent(each)} on data left out" for each in errors[1:])]
    count = found.certificate.passive
    text = f"{quality}: {', '.join(parts)}; {count} coefficient{'' if count == 1 else 's'}"
    return f"{text}." if found.certificate.converged else f"{text}. The fit has NOT converged."


def certificate_lines(identified: IdentifiedFile, *, verbose: bool = True) -> Sequence[tuple[str, str]]:
    """Return what a person should know of a fit, as (name, text) pairs; the numerics only if `verbose`."""
    found, operator = identified.identification, identified.file.response
    unit = operator.output_unit
    errors, certificate, largest = found.errors, found.certificate, _largest(found.uncertainties)
    whose = "operator " if isinstance(operator, TimedModel) else ""
    rows = identified.inputs.size - found.skip
    partly = f"{identified.fitted} fitted of {rows}"
    if isinstance(operator, TimedModel):
        own = [(name, f"{value:.4g} {its}".rstrip()) for name, (value, its) in operator.parameters().items()]
    else:
        shape = ", ".join(f"{name} {value:.4g}" for name, value in _shape(operator).items())
        own = [("shape", shape)] if shape else []
    numerics = [
        (
            "fit residual (KKT)",
            f"{certificate.kkt_residual:.1e}" + ("" if certificate.converged else " (NOT converged)"),
        ),
        ("condition", f"{certificate.condition:.2g}"),
        ("largest uncertainty", "unknown" if largest is None else f"{largest:.2g} (1σ, of a coefficient)"),
    ]
    tests = identified.return_points, identified.congruency
    return (
        *own,
        ("samples", f"{rows if identified.fitted is None else partly} (skipped: {found.skip})"),
        *error_lines(errors, unit),
        *([] if identified.fitted is None else error_lines(identified.all_errors, unit, " of all rows")),
        *_uniqueness(found, identified.resolution, verbose=verbose),
        *([("penalties", found.regularization.summary(unit))] if found.regularization else []),
        *([("orientation", f"{whose}{found.orientation} with the input")] if found.orientation else []),
        *(numerics if verbose else numerics[: not certificate.converged]),
        ("valid for inputs", identified.file.valid.text(operator.input_unit)),
        ("excitation", identified.coverage.summary() if identified.coverage else "no plane to be swept"),
        *[("assumption check", test.text) for test in tests if test.agrees and (verbose or test.holds)],
        *_uncertainty_lines(identified),
    )


def _uncertainty_lines(identified: IdentifiedFile) -> list[tuple[str, str]]:
    """Return the quantities of a model of runs with their uncertainty, or why it is not stated."""
    data = identified.data
    if identified.uncertainty is not None:
        return identified.uncertainty.lines()
    if not any(map(is_run, data.paths)) or data.output is None:
        return []
    why = f"the rig file states none of {data.output.name}"
    if identified.refit is None:
        why = f"{identified.file.name} is a model with time"
    elif len(data.paths) > 1:
        why = "the model is of several runs"
    return [("uncertainty", f"not stated, as {why}")]


def error_lines(errors: Errors, unit: str, which: str = "") -> list[tuple[str, str]]:
    """Return largest and RMS error as (name, text) pairs; `which` says of which rows."""
    return [
        (
            f"largest error{which}",
            f"{prefixed(errors.maximum, unit)} ({percent(errors.maximum_percent)} of the range)",
        ),
        (f"RMS error{which}", f"{prefixed(errors.rms, unit)} ({percent(errors.rms_percent)} of the range)"),
    ]


def _uniqueness(found: Identification[Any], resolution: Resolution | None, *, verbose: bool) -> list[tuple[str, str]]:
    """Return how many coefficients are free, what the data determine of them, and whether others would do as well."""
    certificate = found.certificate
    signed = not isinstance(found.model, TimedModel) and not find_model(found.model_name).constrained
    is_least_norm = signed and found.regularization is None
    if is_least_norm:
        text = f"rank {certificate.passive}, null space of {certificate.active} (least norm)"
    else:
        text = f"{certificate.passive} free, {certificate.active} held at zero"
    lines = [("coefficients", text)] if verbose or resolution is None or is_least_norm else []
    if resolution is not None and not is_least_norm:
        lines.append(("identifiable coefficients", f"{resolution.rank} of {resolution.diagonal.size}"))
    if certificate.exchangeable:
        text = (
            f"the minimiser is not unique: {certificate.exchangeable} cells could replace others without "
            "changing the fit"
        )
        unsmoothed = isinstance(found.model, TimedModel) and not _is_smoothed(found.model_name)
        remedy = "give fewer --levels" if unsmoothed else "they are resolved by --smoothing"
        lines.append(("not unique", f"{text}; {remedy}"))
    return lines
