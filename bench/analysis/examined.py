"""What models give for measurements, with the session recalibrated and bands: `bench predict`, `bench model test`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bench.analysis.band_columns import BandedPrediction, band_of
from bench.analysis.predictions import Predictions, check_finite
from bench.analysis.session_recalibration import Session
from bench.analysis.tables.dataset import Dataset
from bench.analysis.tables.starting_state import StartingState, bind_times, foreign_drift, starting_state
from bench.base import ConfigurationError, Floats
from bench.identification import (
    Beyond,
    Comparison,
    Errors,
    ModelFile,
    Recalibration,
    compare,
    load_model,
    measure_errors,
)
from bench.models import Operator, TimedSequence

# Derivation: of a hundred rows a tenth is ten, beside which one stray reading does not count; random errors of ninety
# rows reach 2.6 standard deviations, those of the others three times that by no chance.
_FEWEST, _FIRST_PART, _MUCH = 100, 10, 3.0


@dataclass(frozen=True)
class Examined:
    """What a model gives for a sequence of inputs.

    Attributes
    ----------
    predicted : ndarray, shape (N,)
        Outputs of the model, after recalibration if one was asked for.
    measured : ndarray, shape (N,), or None
        The measured outputs, where there are some.
    recalibration : Recalibration or None
        What moved in the session, if that was asked for.
    band : BandedPrediction or None
        The band about the predictions, if the model's file has one.
    units : (str, str)
        Units of input and output.
    first : int
        First row that counts in errors: those before drive the memory or tell the recalibration.
    beyond : Beyond
        How far the inputs lie beyond those that were fitted.
    """

    predicted: Floats
    measured: Floats | None
    recalibration: Recalibration | None
    band: BandedPrediction | None
    units: tuple[str, str]
    first: int
    beyond: Beyond

    @property
    def residuals(self) -> Floats | None:
        """Measured minus predicted outputs of the rows that count; None without measurements."""
        return None if self.measured is None else (self.measured - self.predicted)[self.first :]

    def errors(self) -> Errors:
        """Return the errors over the rows that count. There must be measurements."""
        assert self.measured is not None
        return measure_errors(self.measured[self.first :], self.predicted[self.first :])

    def warnings(self) -> list[str]:
        """Return a sentence each on inputs beyond those fitted, and on errors of what came before the first row."""
        return [text for text in (self.beyond.text(), self._of_first_rows()) if text]

    def _of_first_rows(self) -> str:
        errors = np.abs(np.empty(0) if self.residuals is None else self.residuals)
        first = errors.size // _FIRST_PART
        if errors.size < _FEWEST or not errors[:first].max() > _MUCH * (largest := float(errors[first:].max())):
            return ""
        last = self.first + int(np.flatnonzero(errors[:first] > largest)[-1]) + 1
        unit = self.units[1]
        return (
            f"the largest errors stand in the first {last} rows ({errors.max():.4g} {unit}".rstrip()
            + f"; {largest:.4g} {unit}".rstrip()
            + f" in the others), where what came before the file still matters: --skip {last} leaves them out"
        )

    def to_json(self) -> dict[str, Any]:
        """Return `beyond` for programs, and `recalibration` and `band`, if there are."""
        found: dict[str, Any] = {"beyond": self.beyond.to_json()}
        if self.recalibration is not None:
            found["recalibration"] = {**self.recalibration.to_json(), "errors_from_row": self.first + 1}
        if self.band is not None:
            found["band"] = self.band.to_json(self.residuals)
        return found


def examine(
    model: ModelFile,
    data: Dataset,
    *,
    state: Any = None,  # noqa: ANN401 - each operator has its own
    session: Session | None = None,
    skip: int = 0,
) -> Examined:
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
    times = data.times if isinstance(bound, TimedSequence) else None
    inputs, measured = data.inputs, None if data.output is None else data.outputs
    units = model.response.input_unit, model.response.output_unit
    found, first = None, skip
    if session is not None:
        if measured is None:
            raise ConfigurationError("--recalibrate needs measured outputs: name their column with --output")
        found = session.estimate(bound, inputs, measured, skip=skip, state=state)
        first = session.first_unused(inputs.size, skip)
    with np.errstate(over="ignore", invalid="ignore"):
        predicted = (
            np.asarray(bound.evaluate(inputs, state)) if found is None else found.predict(bound, inputs, state)
        )
    check_finite(model.name, "output", predicted, units[1], inputs, "input", units[0])
    moved = 0.0 if found is None else found.values.get("input-offset", 0.0)
    return Examined(predicted, measured, found, band_of(model), units, first, model.beyond(inputs + moved, times))


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
    """How several models do on one set of measurements."""

    comparisons: Mapping[str, Comparison]  # by the model file's name
    predictions: Predictions  # what each model gives, row by row
    # The session recalibrated and the band of each model, by the same names.
    examined: Mapping[str, Examined] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()  # what of a model belongs to its own record only

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
                **entry.to_json(),
                "skipped": self.skip,
                **(self.examined[name].to_json() if name in self.examined else {}),
                **({"recalibrated": mended.to_json()} if (mended := self.recalibrated(name)) else {}),
            }
            for name, entry in self.comparisons.items()
        }

    def recalibrated(self, name: str) -> Errors | None:
        """Return a model's errors after recalibration, over the same rows as the others; None without one."""
        found = self.examined.get(name)
        return None if found is None or found.recalibration is None else found.errors()


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
    inputs, outputs, times = data.inputs, data.outputs, data.times
    operators: dict[str, Operator[Any] | TimedSequence] = {}
    starts: dict[str, StartingState] = {}
    for name, file in models.items():
        data.check_units(file)
        operators[name] = bind_times(file, times)
        starts[name] = starting_state(file, inputs, initial=initial, skip=skip)
    states = {name: start.state for name, start in starts.items()}
    most = max(start.skip for start in starts.values())
    examined = {
        name: examine(file, data, state=states[name], session=session, skip=most) for name, file in models.items()
    }
    first = most if session is None else session.first_unused(inputs.size, most)
    comparisons = compare(operators, inputs, outputs, states=states, skip=first)
    predicted = {name: entry.predicted for name, entry in examined.items()}
    bands = {name: entry.band for name, entry in examined.items()}
    predictions = Predictions.of(next(iter(models.values())), data, predicted, first, bands)
    drifts = (
        () if session is not None else tuple(filter(None, (foreign_drift(each, inputs) for each in models.values())))
    )
    return ComparedModels(comparisons, predictions, examined, drifts)
