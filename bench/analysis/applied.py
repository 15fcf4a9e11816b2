"""Models beside measurements, row by row: those of `bench predict` and `bench model test`, of a fit and of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from bench.analysis.band_columns import BandedPrediction, band_of
from bench.analysis.session_recalibration import Session
from bench.analysis.tables.data import Quantity
from bench.analysis.tables.dataset import Dataset
from bench.analysis.tables.starting_state import bind_times, foreign_drift, starting_state
from bench.analysis.uncertain_models import predicted_uncertainty
from bench.base import ConfigurationError, DataError, Floats, header_with_unit
from bench.identification import (
    Beyond,
    Comparison,
    Errors,
    ModelFile,
    Recalibration,
    load_model,
    measure_errors,
    parse_model,
    recalibrate,
)
from bench.models import Operator, TimedModel
from bench.record import Record, Table

# Derivation: of a hundred rows a tenth is ten, beside which one stray reading does not count; random errors of ninety
# rows reach 2.6 standard deviations, those of the others three times that by no chance.
_FEWEST, _FIRST_PART, _MUCH = 100, 10, 3.0


def check_finite(
    model: str, what: str, values: Floats, unit: str, given: Floats, of_given: str, unit_given: str
) -> None:
    """Check that what a model gave for N rows, shape (N,), is finite.

    Raises DataError otherwise: names the model, the first wrong row (from 1), and what it was given there.
    """
    wrong = np.flatnonzero(~np.isfinite(values))
    if wrong.size:
        row = int(wrong[0])
        value, at = f"{values[row]:g} {unit}".rstrip(), f"{given[row]:g} {unit_given}".rstrip()
        raise DataError(
            f"model {model}: its {what} is {value} in row {row + 1}, where the {of_given} is {at}, and not finite in "
            f"{wrong.size} of {values.size} rows: its numbers overflow; check its coefficients, and that the input "
            "is in the range that it was identified for"
        )


@dataclass(frozen=True)
class Applied:
    """What a model gives for a sequence of inputs, beside what was measured.

    Raises DataError if an output is not finite.

    Attributes
    ----------
    file : ModelFile
        The model.
    input : Quantity
        The inputs.
    predicted : ndarray, shape (N,)
        Outputs of the model, after recalibration if one was asked for.
    measured : Quantity or None
        The measured outputs, where there are some.
    time : Quantity or None
        When each row was taken, where it is known.
    first : int
        First row that counts in errors: those before drive the memory or tell the recalibration.
    state : object
        State of the model before the first row.
    recalibration : Recalibration or None
        What moved in the session, if that was asked for.
    """

    file: ModelFile
    input: Quantity
    predicted: Floats
    measured: Quantity | None = None
    time: Quantity | None = None
    first: int = 0
    state: Any = None
    recalibration: Recalibration | None = None

    def __post_init__(self) -> None:
        """Raise DataError if an output is not finite."""
        values, unit = self.input.values, self.input.unit
        check_finite(self.file.name, "output", self.predicted, self.unit, values, "input", unit)

    @classmethod
    def to(
        cls,
        data: Dataset,
        file: ModelFile,
        predicted: Floats,
        first: int,
        state: Any = None,  # noqa: ANN401 - each operator has its own
        recalibration: Recalibration | None = None,
    ) -> Applied:
        """Return what a model gives for a dataset; units that this does not say are those of the model."""
        response = file.response
        driven = replace(data.input, unit=data.input.unit or response.input_unit)
        measured = data.output and replace(data.output, unit=data.output.unit or response.output_unit)
        time = None if data.times is None else Quantity("time", "s", data.times)
        return cls(file, driven, predicted, measured, time, first, state, recalibration)

    @property
    def unit(self) -> str:
        """Unit of the output; empty if unknown."""
        return self.file.response.output_unit or ("" if self.measured is None else self.measured.unit)

    @property
    def band(self) -> BandedPrediction | None:
        """The band about the predictions, if the model's file has one."""
        return band_of(self.file)

    @cached_property
    def beyond(self) -> Beyond:
        """How far the inputs lie beyond those that were fitted."""
        moved = 0.0 if self.recalibration is None else self.recalibration.values.get("input-offset", 0.0)
        times = self.time.values if self.time is not None and isinstance(self.file.model, TimedModel) else None
        return self.file.beyond(self.input.values + moved, times)

    @property
    def residuals(self) -> Floats:
        """Measured minus predicted outputs, shape (N,). There must be measurements."""
        assert self.measured is not None
        return self.measured.values - self.predicted

    @property
    def counted(self) -> Floats | None:
        """The residuals of the rows that count; None without measurements."""
        return None if self.measured is None else self.residuals[self.first :]

    def errors(self) -> Errors:
        """Return the errors over the rows that count. There must be measurements."""
        assert self.measured is not None
        return measure_errors(self.measured.values[self.first :], self.predicted[self.first :])

    def warnings(self) -> list[str]:
        """Return a sentence each on inputs beyond those fitted, and on errors of what came before the first row."""
        return [text for text in (self.beyond.text(), self._of_first_rows()) if text]

    def _of_first_rows(self) -> str:
        errors = np.abs(np.empty(0) if self.counted is None else self.counted)
        first = errors.size // _FIRST_PART
        if errors.size < _FEWEST or not errors[:first].max() > _MUCH * (largest := float(errors[first:].max())):
            return ""
        last = self.first + int(np.flatnonzero(errors[:first] > largest)[-1]) + 1
        return (
            f"the largest errors stand in the first {last} rows ({errors.max():.4g} {self.unit}".rstrip()
            + f"; {largest:.4g} {self.unit}".rstrip()
            + f" in the others), where what came before the file still matters: --skip {last} leaves them out"
        )

    def to_json(self) -> dict[str, Any]:
        """Return `beyond` for programs, and `recalibration` and `band`, if there are."""
        found: dict[str, Any] = {"beyond": self.beyond.to_json()}
        if self.recalibration is not None:
            found["recalibration"] = {**self.recalibration.to_json(), "errors_from_row": self.first + 1}
        if self.band is not None:
            found["band"] = self.band.to_json(self.counted)
        return found


def rows_table(models: Mapping[str, Applied]) -> list[tuple[str, Floats]]:
    """Return the columns of a file with their heads: time, input, measured; what belongs to each model.

    All are applied to the same rows. The model is named in the heads if there are several.
    """
    first = next(iter(models.values()))
    columns = [(each.header, each.values) for each in (first.time, first.input) if each is not None]
    if first.measured is not None:
        columns.append((header_with_unit("measured", first.unit), first.measured.values))
    bands = []
    for name, each in models.items():
        prefix = f"{name} " if len(models) > 1 else ""
        columns.append((header_with_unit(f"{prefix}predicted", each.unit), each.predicted))
        if (uncertainty := predicted_uncertainty(each.file, each.predicted)) is not None:
            columns.append((header_with_unit(f"{prefix}u_predicted", each.unit), uncertainty))
        if each.measured is not None:
            columns.append((header_with_unit(f"{prefix}residual", each.unit), each.residuals))
        if each.band is not None:
            bands += [(f"{prefix}{head}", values) for head, values in each.band.columns(each.predicted)]
    return columns + bands


def apply_model(
    model: ModelFile,
    data: Dataset,
    *,
    state: Any = None,  # noqa: ANN401 - each operator has its own
    session: Session | None = None,
    skip: int = 0,
) -> Applied:
    """Return what a model gives for a dataset.

    Parameters
    ----------
    model : ModelFile
        The model.
    data : Dataset
        Inputs in the unit of the model, and what else there is.
    state : object
        State before the first row; None is the initial one.
    session : Session, optional
        What is estimated of the session from measured outputs.
    skip : int
        First rows that drive the memory but do not count.

    Raises
    ------
    ConfigurationError
        If the session cannot be estimated, or a model with time has no times.
    DataError
        If an output is not finite.
    """
    bound = bind_times(model, data.times)
    inputs, found, first = data.inputs, None, skip
    if session is not None:
        if data.output is None:
            raise ConfigurationError("--recalibrate needs measured outputs: name their column with --output")
        kinds, rows = session.kinds, session.rows
        try:
            found = recalibrate(bound, inputs, data.outputs, kinds, rows=rows, skip=skip, state=state)
        except ValueError as error:
            raise ConfigurationError(f"--recalibrate {','.join(kinds)}: {error}") from None
        if rows is not None and rows < inputs.size:
            # The rows that tell the recalibration do not count.
            first = max(rows, skip)
    with np.errstate(over="ignore", invalid="ignore"):
        predicted = bound.evaluate(inputs, state) if found is None else found.predict(bound, inputs, state)
    return Applied.to(data, model, np.asarray(predicted), first, state, found)


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


@dataclass(frozen=True)
class ComparedModels:
    """How several models do on one set of measurements, by the names of their files."""

    comparisons: Mapping[str, Comparison]
    applied: Mapping[str, Applied]
    unit: str  # of the output
    skip: int  # first rows that are left out of the errors
    warnings: tuple[str, ...] = ()  # what of a model belongs to its own record only

    def to_json(self) -> dict[str, Any]:
        """Return the comparison for programs: `raw` and `rezeroed` errors, `offset` and `skipped` of each model."""
        return {
            name: {
                **entry.to_json(),
                "skipped": self.skip,
                **self.applied[name].to_json(),
                **({"recalibrated": mended.to_json()} if (mended := self.recalibrated(name)) else {}),
            }
            for name, entry in self.comparisons.items()
        }

    def recalibrated(self, name: str) -> Errors | None:
        """Return a model's errors after recalibration, over the same rows as the others; None without one."""
        found = self.applied[name]
        return None if found.recalibration is None else found.errors()


def load_models(paths: Sequence[Path]) -> dict[str, ModelFile]:
    """Return model files by the names under which they are compared; raises DataError if one cannot be read."""
    found: dict[str, ModelFile] = {}
    for path in paths:
        found[path.stem if path.stem not in found else str(path)] = load_model(path)
    return found


def compare_models(
    models: Mapping[str, ModelFile],
    data: Dataset,
    *,
    skip: int | None = None,
    initial: str | None = None,
    session: Session | None = None,
) -> ComparedModels:
    """Compare models on measurements.

    Parameters
    ----------
    models : mapping of str to ModelFile
        The models by the name of their file.
    data : Dataset
        Input and output, and for models with time the times.
    skip, initial
        First rows that drive the memory but do not count, and the state before them, as for `starting_state`. Of
        the numbers of rows of the models the greatest is taken for all, so that their errors are of the same rows.
    session : Session, optional
        What is estimated of the session for each model; the rows that it uses do not count either.

    Raises
    ------
    DataError
        If units do not fit, or an output is not finite.
    ConfigurationError
        If `skip` leaves nothing, there is no such initial state, or times are missing.
    """
    inputs = data.inputs
    for file in models.values():
        data.check_units(file)
    starts = {name: starting_state(file, inputs, initial=initial, skip=skip) for name, file in models.items()}
    most = max(start.skip for start in starts.values())

    def all_applied(session: Session | None, skip: int) -> dict[str, Applied]:
        return {
            name: apply_model(file, data, state=starts[name].state, session=session, skip=skip)
            for name, file in models.items()
        }

    applied = all_applied(session, most)
    first = next(iter(applied.values()))
    plain = applied if session is None else all_applied(None, first.first)
    comparisons = {name: Comparison.of(data.outputs, each.predicted, first.first) for name, each in plain.items()}
    drifts = () if session is not None else (foreign_drift(each, inputs) for each in models.values())
    return ComparedModels(comparisons, applied, first.unit, first.first, tuple(filter(None, drifts)))


def models_of(record: Record) -> list[ModelFile]:
    """Return the models of one input that were identified from a run, the newest last.

    Those of several inputs are left out, as their errors are those of several runs together.
    """
    files = [parse_model(content, f"{record.path}: model {name}") for name, content in record.models().items()]
    return [file for file in files if isinstance(file.model, Operator | TimedModel)]


def apply_to_run(record: Record, steps: Table, models: Sequence[ModelFile]) -> list[Applied]:
    """Return what each model predicts of the readings of a run; the same of them count for all.

    The time of a reading is the end of its step, unless a model with time was identified with another column.

    Raises DataError if the run lacks a signal from which a model was identified, or a model has several inputs.
    """
    prepared = []
    for model in models:
        columns = [str(model.provenance.get(end, "")) for end in ("input", "output")]
        missing = [name for name in columns if name not in steps.columns]
        if missing:
            raise DataError(
                f"model {model.name} was identified with {' and '.join(missing)}, which {record.path} lacks"
            )
        driven, response = (Quantity(name, record.unit(name), steps[name]) for name in columns)
        clock = str(model.provenance.get("time"))
        time = Quantity("time", "s", steps[clock if clock in steps.columns else "finished"])
        is_timed = isinstance(model.model, TimedModel)
        data = Dataset((record.path,), str(record.path), driven, response, time if is_timed else None)
        prepared.append((model, data, starting_state(model, data.inputs)))
    skip = max((start.skip for _, _, start in prepared), default=0)
    return [apply_model(model, data, state=start.state, skip=skip) for model, data, start in prepared]
