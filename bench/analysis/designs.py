"""Experiments that are designed: the work of `bench model design`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.analysis.tables.data import write_csv
from bench.analysis.tables.dataset import ColumnNames, check_unit, read_for
from bench.analysis.tables.reading.options import ReadingOptions
from bench.base import ConfigurationError, DataError, Floats, header_with_unit
from bench.identification import (
    NOISE,
    Assessment,
    Continuation,
    ModelFile,
    assess,
    continue_design,
    covering_sequence,
    damped_oscillation,
    first_order_reversals,
)
from bench.models import Preisach, ThermalExpansion, uniform_levels


@dataclass(frozen=True)
class Design:
    """A sequence of set-points, and what it tells."""

    setpoints: Floats  # shape (N,); input units
    assessment: Assessment  # what it tells about a plane, and what it costs


def assess_designs(
    plane: tuple[float, float], operating: tuple[float, float], levels: int, dwell: float
) -> dict[str, Design]:
    """Return excitation sequences and what each tells about a plane of `levels` intervals, by name.

    Plane and operating range are in input units, the settling time `dwell` at each set-point in s. Raises
    ConfigurationError if the ranges do not fit.
    """
    low, high = operating
    try:
        grid = uniform_levels(*plane, levels)
        # The term stands for any reversible part of two coefficients.
        operator = Preisach(
            grid,
            np.zeros(levels * (levels + 1) // 2),
            reversible=ThermalExpansion(0.0, 0.0, *plane, low),
            input_range=operating,
        )
        span = high - low
        sequences = {
            "damped-oscillation": damped_oscillation(low, high, low + 0.524 * span, 36, span / 180.0),
            "first-order-reversals": first_order_reversals(grid, operating),
            "covering, fewest": covering_sequence(grid, operating),
            "covering, fine": covering_sequence(uniform_levels(*plane, 2 * levels), operating, per_cell=2),
        }
        return {
            name: Design(sequence, assess(operator, sequence, dwell=dwell)) for name, sequence in sequences.items()
        }
    except ValueError as error:
        raise ConfigurationError(f"design: {error}") from None


def continue_file(
    model: ModelFile,
    data: Path,
    *,
    input_column: str | None = None,
    seconds: float,
    dwell: float,
    reading: ReadingOptions | None = None,
) -> Continuation:
    """Return how to go on measuring for a model, beside the data from which it was identified.

    The noise is the RMS error of the model's fit where its file says it, else 1 % of the range of the output.

    Parameters
    ----------
    model : ModelFile
        A model of one input.
    data : Path
        A file that `read_columns` reads, or a run.
    input_column : str or None
        Column of the inputs; that of the model's data if None.
    seconds, dwell : float
        Laboratory time to be filled, and that at each set-point, s.
    reading : ReadingOptions, optional
        What is known of the layout of the file.

    Raises
    ------
    DataError
        If a file cannot be used, or the unit of the inputs is not that of the model.
    ConfigurationError
        If a number is not positive, the time too short, or the model too large.
    """
    name = input_column or str(model.provenance.get("input", ""))
    if not name:
        raise DataError(f"model {model.name} does not say which column its inputs were; give --input")
    measured = read_for([model], data, ColumnNames(name), reading)
    check_unit(model.operator.input_unit, measured.input)
    low, high = model.operator.output_range()
    rms = float(model.provenance.get("rms", 0.0))
    noise = rms / (high - low) if rms > 0.0 and high > low else NOISE
    try:
        return continue_design(
            model.operator, measured.inputs, seconds=seconds, dwell=dwell, state=model.initial, noise=noise
        )
    except ValueError as error:
        raise ConfigurationError(f"design: {error}") from None


def write_sequence(path: Path, setpoints: Floats, *, unit: str, dwell: float) -> None:
    """Write set-points as CSV for the protocol `sequence`: the time of each reading, the input, and its dwell.

    Parameters
    ----------
    path : Path
        The file.
    setpoints : ndarray, shape (N,)
        In `unit`, which is empty if unknown.
    unit : str
        Unit of the input.
    dwell : float
        Hold at each set-point, s.

    Raises
    ------
    DataError
        If the file cannot be written.
    """
    dwells = np.full(setpoints.size, dwell)
    head = header_with_unit("input", unit)
    write_csv(path, [("time [s]", np.cumsum(dwells)), (head, setpoints), ("dwell [s]", dwells)])
