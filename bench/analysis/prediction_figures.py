"""Figures of models beside measurements: over the rows or time, and over the input."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.analysis.figures.fits import plot_fit, plot_loops
from bench.analysis.predictions import Predictions
from bench.base import percent, prefixed, with_unit
from bench.identification import Errors


def draw_predictions(found: Predictions, folder: Path, prefix: str) -> list[Path]:
    """Draw outputs of models and, beside measurements, their residuals; return the files.

    `PREFIX-errors.png` shows them over the rows, or over time where it is known, `PREFIX-loops.png` over the input.
    Without measurements there are the loops only. The folder exists.
    """
    loops, errors = folder / f"{prefix}-loops.png", folder / f"{prefix}-errors.png"
    over_input = with_unit(found.input.title, found.input.unit)
    if found.measured is None:
        for values in found.predicted.values():
            label = with_unit("predicted", found.unit)
            plot_loops(loops, found.input.values, values, input_label=over_input, output_label=label)
        return [loops]
    rows = np.arange(1.0, found.input.values.size + 1.0)
    over_rows = (rows, "row") if found.time is None else (found.time.values, with_unit("time", found.time.unit))
    titles = {name: f"{name}: {errors_text(entry, found.unit)}" for name, entry in found.errors().items()}
    for path, (horizontal, label) in ((loops, (found.input.values, over_input)), (errors, over_rows)):
        plot_fit(
            path,
            horizontal,
            found.measured.values,
            found.predicted,
            horizontal_label=label,
            output_label=with_unit(found.measured.title, found.unit),
            error_label=with_unit("residual", found.unit),
            titles=titles,
            skip=found.skip,
            bands={name: (band.label, band.half_width) for name, band in found.bands.items()},
        )
    return [loops, errors]


def errors_text(errors: Errors, unit: str) -> str:
    """Return largest and RMS error, with the digits of the tables."""
    largest, rms = prefixed(errors.maximum, unit), prefixed(errors.rms, unit)
    return f"max {largest}, RMS {rms} ({percent(errors.rms_percent)} of the range)"
