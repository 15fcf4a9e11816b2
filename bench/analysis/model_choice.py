"""The choice among all models on measurements: the work of `bench identify --model all`, and errors on test rows."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from bench.analysis.model_service import IdentifiedFile, errors_json
from bench.analysis.tables.data import FEWEST_ROWS, check_excitation
from bench.analysis.tables.joined_files import (
    check_rows,
    fitted_rows,
    is_rows,
    overwritten_from,
    parse_rows,
    read_files,
)
from bench.analysis.tables.reading.options import ReadingOptions
from bench.analysis.tables.starting_state import left_out
from bench.analysis.tables.times import bind_times, read_times
from bench.base import ConfigurationError, DataError, Workers
from bench.identification import (
    Comparison,
    Evaluation,
    Given,
    HeldOutInTime,
    Measurements,
    Selection,
    Task,
    check_words,
    compare,
    select,
)
from bench.models import Operator, find_model, identifiable_models, timed_models

MOST_ROWS = 4000
"""Rows by which models are compared: of more, evenly chosen ones; the chosen model is fitted to all."""

# With more, models with time take longer than all others, and are compared only if they were asked for.
_MOST_UNASKED = 50_000

# Fewer are compared in less time than worker processes take to start.
_FEW_ROWS = 1000

ALL = "all"
"""Name that stands for every model."""

COLUMNS = (
    "model", "options", "orientation", "initial", "smoothing", "free", "training_rms", "held_out_rms",
    "held_out_spread", "held_out_percent", "units_rms", "units_percent", "seconds", "note",
)  # fmt: skip
"""Columns of the table."""


@dataclass(frozen=True)
class SelectedModel:
    """The table of models and what was chosen.

    Attributes
    ----------
    selection : Selection
        What was tried.
    unit : str
        Unit of the output.
    known : int
        First row that does not depend on what came before the record, after those that were to be left out.
    warnings : tuple of str
        What the held-out errors say against the choice.
    """

    selection: Selection
    unit: str
    known: int
    warnings: tuple[str, ...]

    @property
    def model(self) -> str:
        """Name of the chosen model."""
        return self.selection.chosen.candidate.model

    @property
    def is_timed(self) -> bool:
        """Whether the chosen model is one with time."""
        return self.model in timed_models()

    def settings(self) -> dict[str, Any]:
        """Return the chosen settings as `identify_file` takes them."""
        chosen = self.selection.chosen.candidate
        orientation = {} if chosen.orientation == "auto" else {"orientation": chosen.orientation}
        skip = {"skip": self.known} if chosen.initial == "skip" else {}
        return {**chosen.options, **orientation, **skip, "initial": chosen.initial, "smoothing": chosen.smoothing}

    def rows(self) -> list[dict[str, Any]]:
        """Return the table: `COLUMNS` by name, errors in output units."""
        return [self._row(each) for each in self.selection.evaluations]

    def _row(self, each: Evaluation) -> dict[str, Any]:
        one, selection = each.candidate, self.selection
        note = each.failure
        if each is selection.chosen:
            note = "chosen"
        elif each is selection.best:
            note = "least error"
        elif not each.failure and len(each.blocks) < len(selection.best.blocks):
            note = "given up"
        values = (
            one.model,
            " ".join(f"{name}={value}" for name, value in one.options.items()),
            one.orientation,
            one.initial or "",
            one.smoothing,
            each.free,
            each.training,
            each.rms,
            each.spread,
            100.0 * each.rms / selection.span,
            each.units_rms,
            100.0 * each.units_rms / selection.span,
            each.seconds,
            note,
        )
        # JSON knows no nan.
        return {
            name: None if isinstance(value, float) and not np.isfinite(value) else value
            for name, value in zip(COLUMNS, values, strict=True)
        }

    def to_json(self) -> dict[str, Any]:
        """Return the choice for programs."""
        return {"gap": self.selection.gap, "rows": self.selection.rows, "unit": self.unit, "table": self.rows()}

    def record_in(self, found: IdentifiedFile) -> IdentifiedFile:
        """Return an identified model with the table in its provenance, and the warnings before its own."""
        file = replace(found.file, provenance={**found.file.provenance, "selection": self.to_json()})
        return replace(found, file=file, warnings=(*self.warnings, *found.warnings))

    def save(self, path: Path) -> None:
        """Write the table as CSV.

        Raises DataError if it cannot be written.
        """
        try:
            with path.open("w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, COLUMNS)
                writer.writeheader()
                writer.writerows(self.rows())
        except OSError as error:
            raise DataError(f"{path} cannot be written: {error}") from None


def named_models(text: str) -> tuple[str, ...]:
    """Return the models of `all`, or of names with commas between them.

    Raises ConfigurationError if there is none of a name.
    """
    known = identifiable_models()
    names = tuple(known) if text == ALL else tuple(text.split(","))
    for name in names:
        if name in timed_models():
            raise ConfigurationError(
                f"{name} is a model with time, which takes part in a comparison of operators with --time COLUMN: "
                f"leave it out of the names, or fit it alone with --model {name}"
            )
        if name not in known:
            raise ConfigurationError(f"there is no model {name!r}; there are: {', '.join(known)}, or {ALL}")
    return names


def select_model(
    paths: Sequence[Path],
    *,
    input_column: str,
    output_column: str,
    models: Sequence[str],
    given: Given,
    console: Console,
    skip: int = 0,
    train: slice | None = None,
    time_column: str | None = None,
    reading: ReadingOptions | None = None,
) -> SelectedModel:
    """Compare models on measurements by what is left out of their fits.

    Parameters
    ----------
    paths : sequence of Path
        Files that `read_columns` reads, or runs; each starts with a memory of its own.
    input_column, output_column : str
        Columns of the models' input and output.
    models : sequence of str
        Names of the models.
    given : Given
        Settings that are not to be chosen, and whether times were asked for.
    console : Console
        Where the progress is drawn.
    skip : int
        First rows that are neither fitted nor tested.
    train : slice or None
        Rows that are fitted and tested; all if None.
    time_column : str or None
        Column of times, with which models with time take part; of one file.
    reading : ReadingOptions, optional
        What is known of the layout of the files.

    Raises
    ------
    DataError
        If the measurements cannot be used.
    ConfigurationError
        If no model can be fitted.
    """
    try:
        check_words(given.initial, given.orientation)
    except ValueError as error:
        raise ConfigurationError(f"--{error}") from None
    if skip < 0:
        raise ConfigurationError(f"--skip {skip}: expected a number of rows ≥ 0")
    if time_column is not None and len(paths) > 1:
        raise ConfigurationError(f"--time: expected one file, as times are those of one record; got {len(paths)}")
    names = (input_column, output_column, *([time_column] if time_column else ()))
    files = read_files(paths, names, at_least=FEWEST_ROWS, options=reading)
    inputs, outputs = (files.columns.values[name] for name in (input_column, output_column))
    check_excitation(files.columns, input_column)
    fitted, _ = fitted_rows(files, inputs, train)
    fitted[:skip] = False
    if fitted.sum() < FEWEST_ROWS:
        raise DataError(
            f"{files.columns.source}: {int(fitted.sum())} rows are left; at least {FEWEST_ROWS} are needed"
        )
    _check_options(models, given)
    whole = Measurements.of(inputs, outputs, fitted)
    measured = whole.thinned(MOST_ROWS)
    few = measured.inputs.size <= _FEW_ROWS
    in_time = None
    if time_column is not None and (given.is_time_asked or inputs.size <= _MOST_UNASKED):
        # A linear part needs the rows between.
        in_time = HeldOutInTime(whole, read_times(files.columns, time_column), measured.inputs.size)
    try:
        kernels = ("bench.models", "bench.identification")
        with Workers(1 if few else None, console, "models", kernels=kernels) as workers:
            selection = select(measured, models, given, lambda tasks: _carry_out(workers, tasks), in_time)
    except ValueError as error:
        raise ConfigurationError(f"no model can be fitted: {error}") from None
    return SelectedModel(
        selection, files.columns.units[output_column], max(whole.known, skip), tuple(selection.warnings())
    )


def _carry_out(workers: Workers, tasks: Sequence[tuple[str, Task]]) -> Iterable[list[Evaluation]]:
    pending = [workers.submit_as(name, task) for name, task in tasks]
    return [each.result() for each in pending]


def _check_options(models: Sequence[str], given: Given) -> None:
    from bench.identification import model_options

    known = {option.name for model in models for option in model_options(find_model(model))}
    for name in given.options:
        if name not in known:
            raise ConfigurationError(
                f"{name}: none of the models has this option; there are: {', '.join(sorted(known))}"
            )


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
    """

    source: str
    comparison: Comparison
    skip: int

    def to_json(self) -> dict[str, Any]:
        """Return the errors for programs."""
        found = self.comparison
        return {
            "source": self.source,
            "skipped": self.skip,
            "raw": errors_json(found.raw),
            "rezeroed": errors_json(found.rezeroed),
            "offset": found.offset,
        }


def evaluate_on_test(
    found: IdentifiedFile, test: str, columns: tuple[str, str], reading: ReadingOptions | None
) -> TestedModel:
    """Return the errors of a model on rows `START:STOP` of its own measurements, or on another file.

    Of its own measurements the memory goes on through all rows. Another file starts with an unknown memory: its first
    rows, until the inputs have overwritten it, are left out.

    Parameters
    ----------
    found : IdentifiedFile
        The model with the measurements it was identified from.
    test : str
        The rows, or a path.
    columns : tuple of str
        Input and output column of another file.
    reading : ReadingOptions or None
        What is known of the layout of another file.

    Raises
    ------
    DataError
        If another file cannot be used.
    ConfigurationError
        If there is no such row.
    """
    if is_rows(test):
        rows = parse_rows("--test", test)
        check_rows("--test", rows, found.inputs.size)
        predicted = (found.outputs - found.identification.residuals)[rows]
        if not predicted.size:
            raise ConfigurationError(f"--test {test}: there are {found.inputs.size} rows")
        return TestedModel(f"rows {test}", _compared(found.outputs[rows], predicted), 0)
    path = Path(test)
    time_column = found.file.provenance.get("time")
    names = (*columns, *([time_column] if time_column else ()))
    read = read_files([path], names, at_least=FEWEST_ROWS, options=reading).columns
    inputs, outputs = (read.values[name] for name in columns)
    model = bind_times(found.file, read_times(read, time_column) if time_column else None)
    skip = 0 if isinstance(model, Operator) and model.memoryless else left_out(overwritten_from(inputs), inputs.size)
    state = {"model": found.identification.initial_state}
    return TestedModel(path.name, compare({"model": model}, inputs, outputs, states=state, skip=skip)["model"], skip)


def _compared(measured: Any, predicted: Any) -> Comparison:  # noqa: ANN401 - arrays
    from bench.identification import measure_errors

    residuals = measured - predicted
    offset = float(residuals.mean())
    return Comparison(
        measure_errors(measured, predicted), measure_errors(measured, predicted + offset), offset, residuals
    )
