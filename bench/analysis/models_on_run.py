"""Models beside the readings of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from bench.analysis.band_columns import BandedPrediction, band_of
from bench.analysis.tables.data import Quantity
from bench.analysis.tables.starting_state import bind_times, starting_state
from bench.base import DataError, Floats
from bench.identification import Beyond, Errors, ModelFile, measure_errors, parse_model
from bench.models import Operator, TimedModel
from bench.record import Record, Table


@dataclass(frozen=True)
class ModelOnRun:
    """A model of one input, and what it predicts of the readings of a run."""

    file: ModelFile
    # The readings of the signals from which it was identified, shape (N,).
    inputs: Quantity
    measured: Quantity
    predicted: Floats  # shape (N,); outputs of the model, output units
    state: Any  # its state before the first reading
    skip: int  # first readings that count in no error: the same of all models that are compared
    band: BandedPrediction | None  # its prediction band, if its file has one
    beyond: Beyond  # how far the readings of the input lie beyond those that were fitted

    @property
    def unit(self) -> str:
        """Unit of the output."""
        return self.file.response.output_unit or self.measured.unit

    @property
    def residuals(self) -> Floats:
        """Measured less predicted output, shape (N,)."""
        return self.measured.values - self.predicted

    @property
    def errors(self) -> Errors:
        """Errors of the readings that count."""
        return measure_errors(self.measured.values[self.skip :], self.predicted[self.skip :])


def models_of(record: Record) -> list[ModelFile]:
    """Return the models of one input that were identified from a run, the newest last.

    Those of several inputs are left out, as their errors are those of several runs together.
    """
    files = [parse_model(content, f"{record.path}: model {name}") for name, content in record.models().items()]
    return [file for file in files if isinstance(file.model, Operator | TimedModel)]


def apply_models(record: Record, steps: Table, models: Sequence[ModelFile]) -> list[ModelOnRun]:
    """Return what each model predicts of a run.

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
        prepared.append((model, starting_state(model, steps[columns[0]]), columns))
    # Errors of the same rows for all.
    skip = max((start.skip for _, start, _ in prepared), default=0)
    found = []
    for model, start, columns in prepared:
        driven, response = (Quantity(name, record.unit(name), steps[name]) for name in columns)
        clock = str(model.provenance.get("time"))
        times = steps[clock if clock in steps.columns else "finished"]
        predicted = bind_times(model, times).evaluate(driven.values, start.state)
        beyond = model.beyond(driven.values, times)
        found.append(ModelOnRun(model, driven, response, predicted, start.state, skip, band_of(model), beyond))
    return found
