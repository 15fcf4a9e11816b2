"""The column of times, and which models take one."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.analysis.predictions import Quantity
from bench.analysis.tables.data import Columns, Floats, read_columns
from bench.analysis.tables.reading.options import ReadingOptions
from bench.analysis.tables.starting_state import digest
from bench.base import ConfigurationError, DataError
from bench.identification import ModelFile
from bench.models import (
    Hammerstein,
    Operator,
    TimedModel,
    TimedSequence,
    find_model,
    identifiable_models,
    timed_models,
)

_SECONDS = {"": 1.0, "s": 1.0, "ms": 1e-3, "µs": 1e-6, "μs": 1e-6, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
NO_TIMES = "none"
"""Stands for a column of times where a file's own is to be left out."""

# Heads that name a column of times.
_NAMES = ("time", "t", "Time", "time_s", "t_s", "Time_s", "timestamp", "Timestamp", "datetime")


def check_model_name(model: str, time_column: str | None) -> None:
    """Check that there is a model of this name that can be fitted to a file with or without a column of times.

    Raises ConfigurationError if not: names the models, or the option `--time`.
    """
    timed = timed_models()
    if model in timed:
        if time_column is None:
            raise ConfigurationError(f"model {model} needs the time of each row: give --time COLUMN")
        return
    try:
        find_model(model)
    except ValueError:
        known = ", ".join(sorted([*identifiable_models(), *timed]))
        raise ConfigurationError(f"there is no model {model!r}; there are: {known}") from None
    if time_column is not None:
        raise ConfigurationError(f"--time: {model} is a model without time; with time there are: {', '.join(timed)}")


def is_smoothed(model: str) -> bool:
    """Return whether a model with time takes a weight of smoothing."""
    fit = timed_models()[model].fit_in_time
    assert fit is not None
    return "smoothing" in inspect.signature(fit).parameters


def check_penalties(
    model: str,
    smoothing: float | Sequence[float],
    *,
    ridge: float | None,
    levels_to_try: Sequence[int],
) -> None:
    """Raise ConfigurationError if a model with time does not take one of these; see `identify_file`."""
    if ridge or (smoothing and not is_smoothed(model)):
        others = "--ridge" if is_smoothed(model) else "--smoothing, --ridge or --cross-validate"
        raise ConfigurationError(f"model {model} takes no {others}")
    if levels_to_try:
        raise ConfigurationError(f"--levels: model {model} takes one number; it is not chosen by cross-validation")


def read_times(columns: Columns, name: str) -> Floats:
    """Return a column of times, shape (N,), in s.

    Raises DataError if its unit is none of time, or the times do not increase: names the row.
    """
    unit = columns.units[name]
    if unit not in _SECONDS:
        raise DataError(
            f"{columns.source}: column {name} is in {unit}; expected a time in {', '.join(filter(None, _SECONDS))}"
        )
    times = columns.values[name] * _SECONDS[unit]
    wrong = np.flatnonzero(np.diff(times) <= 0.0)
    if wrong.size:
        row = int(wrong[0]) + 2
        before, after = columns.values[name][row - 2 : row]
        raise DataError(
            f"{columns.source}: column {name} does not increase in row {row} ({after:g} after {before:g}); "
            "times must be those of one record, in order"
        )
    return times


def time_quantity(times: Floats | None) -> Quantity | None:
    """Return times, shape (N,) in s, as a column of results; None without them."""
    return None if times is None else Quantity("time", "s", times)


def named_times(path: Path, reading: ReadingOptions | None, own: str | None = None) -> str | None:
    """Return the column of a file that by its name and unit holds times; None if there is none.

    Tried first is the column of a model's own data, if given. Of a run no other is: its steps are quasi-static.
    """
    found = _read_named(path, reading, own)
    return None if found is None else found[0]


def _read_named(path: Path, reading: ReadingOptions | None, own: str | None = None) -> tuple[str, Columns] | None:
    """Return the column of `named_times` and its values."""
    names = [] if own is None else [own]
    if not (path.is_dir() or path.suffix == ".sqlite"):
        names += _NAMES
    for name in names:
        try:
            columns = read_columns(path, [name], options=reading)
        except (DataError, ConfigurationError):
            continue
        if columns.units[name] in _SECONDS:
            return name, columns
    return None


def find_times(path: Path, reading: ReadingOptions | None) -> str | None:
    """Return the column of a file that by its name and unit holds times; None if there is none.

    Raises DataError if they do not increase.
    """
    found = _read_named(path, reading)
    if found is None:
        return None
    name, columns = found
    read_times(columns, name)
    return name


def choose_times(file: ModelFile, path: Path, given: str | None, reading: ReadingOptions | None) -> str | None:
    """Return the column of times by which a model predicts a file: the given one, or for a model with time one found.

    None for a model without time; also if no column is found.
    """
    if given is not None or not isinstance(file.model, TimedModel):
        return given
    own = file.provenance.get("time")
    return named_times(path, reading, str(own) if own else None)


def foreign_drift(file: ModelFile, inputs: Floats) -> str:
    """Return a warning if a model's drift is applied to inputs, shape (N,), of another record; else an empty text."""
    model = file.model
    own = file.provenance.get("input_sha256")
    if not isinstance(model, Hammerstein) or not model.drift or own in (None, digest(inputs)):
        return ""
    value, unit = model.parameters()["drift"]
    return (
        f"{file.name} has a drift of {value:.3g} {unit}, which is that of its own record, from its first row on; "
        "--recalibrate offset,drift estimates what it is in this one"
    )


def bind_times(file: ModelFile, times: Floats | None) -> Operator[Any] | TimedSequence:
    """Return what evaluates inputs: the operator, or the model with time at these times, s.

    Raises ConfigurationError if a model with time has none.
    """
    model = file.response
    if not isinstance(model, TimedModel):
        return model
    if times is None:
        raise ConfigurationError(f"model {file.name} needs the time of each row: give --time COLUMN")
    return model.at(times)
