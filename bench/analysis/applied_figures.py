"""Figures of models beside measurements: over the input, and over the rows or time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from bench.analysis.applied import Applied
from bench.analysis.figures.fits import plot_errors, plot_fit, plot_loops
from bench.analysis.figures.panels import time_axis
from bench.analysis.tables.data import Quantity
from bench.base import Floats, fitting_prefix, percent, prefixed, with_unit
from bench.identification import Errors


def draw_applied(
    models: Mapping[str, Applied], loops: Path, over_time: Path, times: Floats | None = None
) -> list[Path]:
    """Draw outputs of models for the same inputs and, beside measurements, their residuals; return the files.

    The first file shows them over the input, the second over times (s, those of the models if not given), or over the
    rows where these are unknown. Without measurements there is the first one only, for one model. The folders exist.
    """
    first = next(iter(models.values()))
    over_input = _scaled(first.input)
    if first.measured is None:
        label = with_unit("predicted", first.unit)
        plot_loops(loops, over_input[0], first.predicted, input_label=over_input[1], output_label=label)
        return [loops]
    if times is None and first.time is not None:
        times = first.time.values
    over = (np.arange(1.0, first.predicted.size + 1.0), "row")
    if times is not None:
        scale, label = time_axis(float(times.max(initial=0.0)))
        over = scale * times, label
    factor, unit = fitting_prefix(first.unit, float(np.abs(first.measured.values).max(initial=0.0)))
    for path, (horizontal, label) in ((loops, over_input), (over_time, over)):
        plot_fit(
            path,
            horizontal,
            factor * first.measured.values,
            {name: factor * each.predicted for name, each in models.items()},
            horizontal_label=label,
            output_label=with_unit(first.measured.title, unit),
            error_label=with_unit("residual", unit),
            titles={name: f"{name}: {errors_text(each.errors(), each.unit)}" for name, each in models.items()},
            skip=first.first,
            bands={n: (each.band.label, factor * each.band.half_width) for n, each in models.items() if each.band},
        )
    return [loops, over_time]


def draw_in(folder: Path, prefix: str, models: Mapping[str, Applied]) -> list[Path]:
    """Draw `PREFIX-loops.png` and `PREFIX-errors.png` in a folder, which exists; see `draw_applied`."""
    return draw_applied(models, folder / f"{prefix}-loops.png", folder / f"{prefix}-errors.png")


def draw_errors(path: Path, models: Mapping[str, Applied]) -> None:
    """Draw what each model leaves of the same measurements over the rows, with the bands of those that have one."""
    first = next(iter(models.values()))
    plot_errors(
        path,
        {name: each.residuals for name, each in models.items()},
        error_label=with_unit("error", first.unit),
        skip=first.first,
        bands={name: (each.band.label, each.band.half_width) for name, each in models.items() if each.band},
    )


def errors_text(errors: Errors, unit: str) -> str:
    """Return largest and RMS error, with the digits of the tables."""
    largest, rms = prefixed(errors.maximum, unit), prefixed(errors.rms, unit)
    return f"max {largest}, RMS {rms} ({percent(errors.rms_percent)} of the range)"


def _scaled(quantity: Quantity) -> tuple[Floats, str]:
    """Return a quantity in the prefix that fits it, and the label of its axis."""
    factor, unit = fitting_prefix(quantity.unit, float(np.abs(quantity.values).max(initial=0.0)))
    return factor * quantity.values, with_unit(quantity.title, unit)
