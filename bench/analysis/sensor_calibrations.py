"""Calibrations from runs: the readings of a sensor beside those of a reference, or beside values that were set up."""

from __future__ import annotations

from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from bench.base import DataError
from bench.protocol import LATENESS
from bench.record import Record
from bench.rig import Calibration, calibrate


def calibrate_run(
    run: Path, sensor: str, reference: str | None, *, reference_name: str = "", reference_uncertainty: float = 0.0
) -> Calibration:
    """Find the calibration of a sensor from a run.

    Parameters
    ----------
    run : Path
        Folder of a completed run.
    sensor : str
        Signal of the sensor.
    reference : str or None
        Signal of the reference. None where the values were set up by hand: each reading counts whose step has a
        number as its label, the value that was set up, in the unit of the sensor.
    reference_name : str
        What the reference is, for the file; its signal if empty.
    reference_uncertainty : float
        Standard uncertainty of the reference, unit of the sensor.

    Raises
    ------
    DataError
        If the run was not completed, lacks a signal, or its readings do not tell a calibration.
    """
    with Record(run) as record:
        if record.status != "completed":
            raise DataError(f"{run}: the run is {record.status}; a calibration needs a completed one")
        units = {signal.name: signal.unit for signal in record.signals}
        for name in filter(None, (sensor, reference)):
            if name not in units:
                raise DataError(f"{run}: has no signal {name!r}; it has: {', '.join(units)}")
        if reference is not None and units[reference] != units[sensor]:
            raise DataError(f"{run}: {sensor} is in {units[sensor]}, {reference} in {units[reference]}")
        common: dict[str, Any] = {
            "signal": sensor,
            "unit": units[sensor],
            "day": datetime.fromisoformat(record.meta["epoch"]).date(),
            "reference_uncertainty": reference_uncertainty,
            "run": run.name,
        }
        if reference is None:
            names = list(units)
            column = names.index(sensor)
            pairs = []
            for step in record.step_records():
                with suppress(ValueError):
                    pairs.append((float(step.label), step.values[column]))
            if not pairs:
                raise DataError(f"{run}: no step has a number as its label; name the signal of a reference")
            values, readings = np.array(pairs).T
            return calibrate(readings, values, named=reference_name or "values that were set up", **common)
        named = reference_name or reference
        if LATENESS.name in units and np.isfinite((ticks := record.telemetry())[LATENESS.name]).any():
            # The samples of a loop, at which both were read.
            rows = np.isfinite(ticks[LATENESS.name])
            times = ticks["t"][rows]
            return calibrate(ticks[sensor][rows], ticks[reference][rows], named=named, times=times, **common)
        steps = record.steps()
        return calibrate(steps[sensor], steps[reference], named=named, **common)
