"""Characterization along a sequence of set-points from a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.analysis import read_columns
from bench.base import DataError
from bench.protocol import Dwell, Messages, Phase, Slot, Slots, Step, parameter, protocol
from protocols.preparation import DRIVE_AND_RESPONSE, LOAD, LOOP, SweepParameters, check_order, reset

_LONGEST_DWELL = 86400.0


class Parameters(SweepParameters):
    """What can be set."""

    setpoints: str = parameter(..., unit="", help="file with the set-points, as of `bench model design`", file=True)
    column: str = parameter("input", unit="", help="column of the set-points")
    dwells: str = parameter(
        "dwell", unit="", help="column of the dwell at each set-point, s; empty for `dwell` at all of them"
    )


@protocol(needs=DRIVE_AND_RESPONSE, may_use=LOAD, views=LOOP)
def sequence(parameters: Parameters, slots: Slots) -> Messages:
    """Measure along a sequence of set-points from a file, such as one of `bench model design`.

    One reading at each set-point after its dwell. The run begins by resetting the memory to negative saturation at
    `low`. A file with a value outside of `low` to `high`, in another unit or without a dwell is refused before
    anything moves.
    """
    drive = slots["drive"]
    check_order(parameters, "low < high", drive.setpoint_unit)
    targets, dwells = _read(parameters, drive)
    yield from reset(slots, parameters.low, parameters.dwell, load=parameters.load)
    yield Phase("sequence")
    for i, target in enumerate(targets):
        yield Step({drive.device: target}, Dwell(dwells[i] if dwells else parameters.dwell))


def _read(parameters: Parameters, drive: Slot) -> tuple[list[float], list[float]]:
    path, names = Path(parameters.setpoints), [parameters.column]
    if parameters.dwells:
        names.append(parameters.dwells)
    columns = read_columns(path, names)
    targets = columns.values[parameters.column]
    dwells = columns.values[parameters.dwells] if parameters.dwells else np.empty(0)
    for name, expected in zip(names, (drive.unit, "s"), strict=False):
        if columns.units[name] not in ("", expected):
            raise DataError(f"{path}: column {name} is in {columns.units[name]}; expected {expected}")
    low, high = parameters.low, parameters.high
    _refuse(path, parameters.column, targets, (targets < low) | (targets > high), f"{low:g} to {high:g} {drive.unit}")
    wrong = (dwells <= 0.0) | (dwells > _LONGEST_DWELL)
    _refuse(path, parameters.dwells, dwells, wrong, f"more than 0 and at most {_LONGEST_DWELL:g} s")
    return targets.tolist(), dwells.tolist()


def _refuse(path: Path, column: str, values: np.ndarray, wrong: np.ndarray, allowed: str) -> None:
    """Raise DataError if a value of a column is wrong."""
    rows = np.flatnonzero(wrong)
    if rows.size:
        raise DataError(
            f"{path}: row {rows[0] + 1}, column {column}: {values[rows[0]]:g} is not allowed; allowed: {allowed}"
        )
