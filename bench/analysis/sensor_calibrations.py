"""Calibrations from runs: the readings of a sensor beside those of a reference, or beside values that were set up."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path
from typing import Any

import numpy as np

from bench.base import DataError
from bench.devices import Identity
from bench.protocol import LATENESS
from bench.record import Record
from bench.rig import Calibration, calibrate


@dataclass(frozen=True)
class Reference:
    """What a sensor is compared with, and for how long that holds.

    Attributes
    ----------
    name : str
        What it is, with its certificate.
    uncertainty : float
        Standard uncertainty that is common to all its values, in its unit; more than 0.
    interval_days : int
        Days for which a calibration by it holds.
    signal : str or None
        Its signal. None where the values were set up by hand: each reading counts whose step has a number as its
        label, the value that was set up.
    unit : str
        Its unit; that of the sensor if empty.
    degrees_of_freedom : float or None
        Of the uncertainty; None for infinitely many.
    gain_uncertainty : float
        Standard uncertainty of its scale, as a share.
    """

    name: str
    uncertainty: float
    interval_days: int
    signal: str | None = None
    unit: str = ""
    degrees_of_freedom: float | None = None
    gain_uncertainty: float = 0.0


def calibrate_run(run: Path, sensor: str, reference: Reference) -> Calibration:
    """Find the calibration of a sensor, a signal, from a completed run.

    Raises
    ------
    DataError
        If the run was not completed, lacks a signal, or its readings do not tell a calibration; if the reference has
        no uncertainty or another unit, or its own calibration was due.
    """
    with Record(run) as record:
        if record.status != "completed":
            raise DataError(f"{run}: the run is {record.status}; a calibration needs a completed one")
        units = {signal.name: signal.unit for signal in record.signals}
        for name in filter(None, (sensor, reference.signal)):
            if name not in units:
                raise DataError(f"{run}: has no signal {name!r}; it has: {', '.join(units)}")
        unit = reference.unit or units[sensor]
        if reference.signal is not None and units[reference.signal] != unit:
            raise DataError(
                f"{run}: {reference.signal} is in {units[reference.signal]}, not in {unit}; if it does not measure "
                f"what {sensor} measures, name its unit"
            )
        # The virtual clock begins in the year 2000, and a calibration ages by the calendar.
        started = record.meta["host"]["started"] if record.meta["clock"] == "virtual" else record.meta["epoch"]
        day = datetime.fromisoformat(started).astimezone().date()
        if reference.signal is not None:
            _check_certificate(record.meta, reference.signal, day)
        about: dict[str, Any] = {
            "signal": sensor,
            "unit": units[sensor],
            "serial_number": _serial_number(record.meta, sensor),
            "date": day,
            "interval_days": reference.interval_days,
            "reference": reference.name,
            "reference_unit": unit,
            "reference_uncertainty": reference.uncertainty,
            "reference_degrees_of_freedom": reference.degrees_of_freedom,
            "reference_gain_uncertainty": reference.gain_uncertainty,
            "run": run.name,
        }
        if reference.signal is None:
            column = list(units).index(sensor)
            pairs = []
            for step in record.step_records():
                with suppress(ValueError):
                    pairs.append((float(step.label), step.values[column]))
            if not pairs:
                raise DataError(f"{run}: no step has a number as its label; name the signal of a reference")
            values, readings = np.array(pairs).T
            return calibrate(readings, values, **about)
        if LATENESS.name in units and np.isfinite((ticks := record.telemetry())[LATENESS.name]).any():
            # The samples of a loop, at which both were read.
            rows = np.isfinite(ticks[LATENESS.name])
            return calibrate(ticks[sensor][rows], ticks[reference.signal][rows], times=ticks["t"][rows], **about)
        steps = record.steps()
        return calibrate(steps[sensor], steps[reference.signal], **about)


def _device_of(meta: dict[str, Any], signal: str) -> str:
    """Return the device of a signal, which is named after it; empty of a derived one."""
    return max((name for name in meta["devices"] if signal.startswith(f"{name}_")), key=len, default="")


def _serial_number(meta: dict[str, Any], signal: str) -> str:
    """Return the serial number of the instrument of a signal; empty if it does not tell one."""
    found = re.search(r"serial number (.*), firmware", meta["devices"].get(_device_of(meta, signal), ""))
    number = "" if found is None else found[1]
    return number if Identity("", "", number, "").tells_serial_number else ""


def _check_certificate(meta: dict[str, Any], signal: str, day: date) -> None:
    """Raise DataError if the calibration of the instrument of a reference was due on a day."""
    name = _device_of(meta, signal)
    due = meta.get("calibration", {}).get(name, {}).get("calibration_due")
    if due and date.fromisoformat(due) <= day:
        raise DataError(
            f"the certificate of the reference {name} ended on {due}, before the run of {day}; have {name} "
            "calibrated, and repeat the run"
        )
