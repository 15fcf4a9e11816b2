"""The choice among all models on measurements: the work of `bench identify --model all`, and errors on test rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.analysis.model_service import FitOptions, IdentifiedFile, identify_model
from bench.analysis.tables.data import check_variation, write_csv
from bench.analysis.tables.dataset import Dataset, check_rows, parse_rows
from bench.analysis.tables.reading.table import FEWEST_ROWS
from bench.analysis.tables.starting_state import bind_times, left_out
from bench.base import ConfigurationError, DataError, closest
from bench.identification import (
    Beyond,
    Comparison,
    Given,
    Measurements,
    Score,
    Selection,
    check_words,
    compared_models,
    model_options,
    once,
    select,
)
from bench.models import Operator, TimedModel, find_model, identifiable_models, overwritten_from, timed_models

ALL = "all"
"""Name that stands for the models that are compared if none is named."""

# Codes of advice whose remedies a comparison tries: settings and models of other structure, and of those with time.
_TRIED = ("few-free", "unexplained", "few-samples", "condition", "initial-memory", "more-cells", "congruency")
_TRIED_IN_TIME = ("return-point-memory",)


@dataclass(frozen=True)
class SelectedModel:
    """The table of models and what was chosen.

    Attributes
    ----------
    selection : Selection
        What was tried.
    unit : str
        Unit of the output.
    """

    selection: Selection
    unit: str

    @property
    def model(self) -> str:
        """Name of the chosen model."""
        return self.selection.chosen.candidate.fitted[0]

    @property
    def error_left_out(self) -> float:
        """RMS error of the chosen model on whole runs or blocks left out of the fit, as a part of the range."""
        selection = self.selection
        error = selection.on_runs if np.isfinite(selection.on_runs) else selection.on_blocks
        return error / selection.span

    @property
    def is_timed(self) -> bool:
        """Whether the chosen model is one with time."""
        return self.model in timed_models()

    def settings(self, given: FitOptions) -> FitOptions:
        """Return the given options with the chosen settings."""
        chosen = self.selection.chosen.candidate
        own = {**given.own, **chosen.fitted[1], "initial": chosen.initial}
        if chosen.orientation != "auto":
            own["orientation"] = chosen.orientation
        if chosen.dynamics:
            own |= {"ridge": chosen.ridge} if chosen.ridge else {}
            return replace(given, smoothing=chosen.smoothing or None, ridge=None, own=own)
        return replace(given, smoothing=chosen.smoothing, ridge=chosen.ridge, own=own)

    def rows(self) -> list[dict[str, Any]]:
        """Return the table: a row a score by the names of its columns, errors in output units."""
        return [self._row(each) for each in self.selection.scores]

    def _row(self, score: Score) -> dict[str, Any]:
        one, span = score.candidate, self.selection.span
        note = score.failure
        if score is self.selection.chosen:
            note = "chosen"
        elif score is self.selection.best:
            note = "least error"
        model, options = one.fitted
        found: dict[str, Any] = {
            "model": model,
            "options": " ".join(f"{name}={value}" for name, value in options.items()),
            "orientation": one.orientation,
            "initial": one.initial or "",
            "smoothing": one.smoothing,
            "ridge": one.ridge,
            "free": score.freedom,
            "training_rms": score.training,
            "score": score.error,
            "score_percent": 100.0 * score.error / span,
            "held_out_rms": score.blocks_rms,
            "held_out_spread": score.spread,
            "held_out_percent": 100.0 * score.blocks_rms / span,
            "units_rms": score.cycles_rms,
            "units_percent": 100.0 * score.cycles_rms / span,
            "rows": score.rows,
            "seconds": score.seconds,
            "note": note,
        }
        # JSON knows no nan.
        finite = (not isinstance(value, float) or np.isfinite(value) for value in found.values())
        return {name: found[name] if known else None for name, known in zip(found, finite, strict=True)}

    def to_json(self) -> dict[str, Any]:
        """Return the choice for programs."""
        selection = self.selection
        return {
            "gap": selection.gap,
            "rows": selection.rows,
            "of": selection.of,
            "unit": self.unit,
            "blocks_rms": selection.on_blocks,
            "another_run_rms": selection.on_runs if np.isfinite(selection.on_runs) else None,
            "advice": [vars(advice) for advice in selection.advice],
            "table": self.rows(),
        }

    def record_in(self, found: IdentifiedFile) -> IdentifiedFile:
        """Return an identified model with the table in its provenance, and without remedies that were tried."""
        file = replace(found.file, provenance={**found.file.provenance, "selection": self.to_json()})
        tried = {*_TRIED, *(_TRIED_IN_TIME if self.selection.has_times else ())}
        own = [replace(one, remedy="") if one.code in tried else one for one in found.advice]
        return replace(found, file=file, advice=once((*self.selection.advice, *own)))

    def save(self, path: Path) -> None:
        """Write the table as CSV.

        Raises DataError if it cannot be written.
        """
        rows = self.rows()
        write_csv(path, [(name, [row[name] for row in rows]) for name in rows[0]])


def is_comparison(model: str) -> bool:
    """Return whether a name is `all`, or several names with commas between them."""
    return model == ALL or "," in model


def named_models(text: str) -> tuple[str, ...]:
    """Return the models of `all`, or of names with commas between them.

    Raises ConfigurationError if there is none of a name.
    """
    known = identifiable_models()
    names = compared_models() if text == ALL else tuple(text.split(","))
    for name in names:
        if name in timed_models():
            raise ConfigurationError(
                f"{name} is a model with time, which takes part in a comparison of operators with --time COLUMN: "
                f"leave it out of the names, or fit it alone with --model {name}"
            )
        if name not in known:
            raise ConfigurationError(
                f"there is no model {name!r}; {closest(name, [*known, ALL], '`bench show models`')}"
            )
    return names


def identify_best(data: Dataset, models: Sequence[str], options: FitOptions) -> tuple[IdentifiedFile, SelectedModel]:
    """Compare models on measurements by what is left out of their fits, and identify the chosen one.

    The progress goes to `say_share`.

    Parameters
    ----------
    data : Dataset
        Input and output; each file starts with a memory of its own, and of several files whole ones are left out.
        With the times of one file models with time take part.
    models : sequence of str
        Names of the models.
    options : FitOptions
        Rows that are fitted, first rows that are neither fitted nor tested, and settings that are not to be chosen.

    Raises
    ------
    DataError
        If the measurements cannot be used.
    ConfigurationError
        If no model can be fitted, or an option goes with one model only.
    """
    if options.cross_validated or options.levels_to_try or data.weights is not None:
        raise ConfigurationError("cross-validation and weights of the rows go with one model: name it")
    own = dict(options.own)
    initial, orientation = own.pop("initial", None), own.pop("orientation", "auto")
    free = None if orientation == "auto" else orientation
    given = Given(own, initial=initial, orientation=free, smoothing=options.smoothing, ridge=options.ridge)
    selected = _selected(data, models, given, options)
    # The chosen model may not have all options that were given.
    settings = selected.settings(replace(options, own={"initial": initial, "orientation": orientation}))
    found = identify_model(data if selected.is_timed else data.without_time(), selected.model, settings)
    return selected.record_in(found.with_uncertainty()), selected


def _selected(data: Dataset, models: Sequence[str], given: Given, options: FitOptions) -> SelectedModel:
    try:
        check_words(given.initial, given.orientation)
    except ValueError as error:
        raise ConfigurationError(f"{'--' if str(error).startswith('initial') else '-o '}{error}") from None
    inputs, output = data.inputs, data.output
    assert output is not None
    check_variation(data.source, output)
    fitted, _ = data.fitted_rows(options.train, options.skip)
    fitted[: options.skip] = False
    if fitted.sum() < FEWEST_ROWS:
        raise DataError(f"{data.source}: {int(fitted.sum())} rows are left; at least {FEWEST_ROWS} are needed")
    _check_options(models, given)
    runs = np.searchsorted(data.starts, np.arange(inputs.size), side="right") if len(data.starts) > 1 else None
    try:
        measured = Measurements.of(inputs, data.outputs, fitted, data.times, runs)
        selection = select(measured, models, given)
    except ValueError as error:
        raise ConfigurationError(f"no model can be fitted: {error}") from None
    return SelectedModel(selection, output.unit)


def _check_options(models: Sequence[str], given: Given) -> None:
    known = {option.name for model in models for option in model_options(find_model(model))}
    for name in given.options:
        if name not in known:
            raise ConfigurationError(f"-o {name}: none of the models has this option; {closest(name, sorted(known))}")


@dataclass(frozen=True)
class TestedModel:
    """How an identified model does on rows that it was not fitted to.

    Attributes
    ----------
    source : str
        Rows of the same file, or another file.
    comparison : Comparison
        Errors as they are, and after re-zeroing the sensor.
    skip : int
        First rows of another file that are left out, as they depend on its unknown memory.
    beyond : Beyond
        How far the inputs of these rows lie beyond those that were fitted.
    """

    source: str
    comparison: Comparison
    skip: int
    beyond: Beyond

    def to_json(self) -> dict[str, Any]:
        """Return the errors for programs."""
        own = {"source": self.source, "skipped": self.skip, "beyond": self.beyond.to_json()}
        return own | self.comparison.to_json()


def evaluate_on_rows(found: IdentifiedFile, test: str) -> TestedModel:
    """Return the errors of a model on rows `START:STOP` of its own measurements; its memory goes through all of them.

    Raises ConfigurationError if there is no such row.
    """
    rows = parse_rows("--test", test)
    outputs = found.outputs
    check_rows("--test", rows, outputs.size)
    measured, predicted = outputs[rows], (outputs - found.identification.residuals)[rows]
    if not measured.size:
        raise ConfigurationError(f"--test {test}: there are {outputs.size} rows")
    times = None if found.data.times is None else found.data.times[rows]
    beyond = found.file.beyond(found.inputs[rows], times, first=rows.indices(outputs.size)[0])
    return TestedModel(f"rows {test}", Comparison.of(measured, predicted), 0, beyond)


def evaluate_on(found: IdentifiedFile, data: Dataset) -> TestedModel:
    """Return the errors of a model on another file; raises DataError if its times do not increase.

    It starts with an unknown memory: its first rows, until the inputs have overwritten it, are left out.
    """
    inputs, times = data.inputs, data.times if isinstance(found.file.response, TimedModel) else None
    model = bind_times(found.file, times)
    skip = 0 if isinstance(model, Operator) and model.memoryless else left_out(overwritten_from(inputs), inputs.size)
    predicted = model.evaluate(inputs, found.identification.initial_state)
    compared = Comparison.of(data.outputs, predicted, skip)
    return TestedModel(data.name, compared, skip, found.file.beyond(inputs, times))
