"""What was recorded of a specimen: its drive and its response over time, from a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.binding import RoleTable
from bench.devices import Signal
from bench.errors import DataError
from bench.hysteresis._checks import Floats
from bench.journal import Record, StepRecord
from bench.rig_file import RigFile

FEWEST_STEPS = 20
"""Fewer steps than this say nothing of a specimen."""


@dataclass(frozen=True, eq=False)
class Recording:
    """A run, as a twin is made from it; rows are quick readings (telemetry) and readings (steps), in order of time.

    Attributes
    ----------
    path : Path
        Of the run.
    meta : mapping
        Of its journal.
    signals : tuple of Signal
        What was measured.
    steps : tuple of StepRecord
        The finished steps.
    times : ndarray, shape (N,)
        When each row was complete, s from the first.
    is_reading : ndarray of bool, shape (N,)
        Whether the row is the reading of a step, not a quick one.
    columns : mapping of str to ndarray, shape (N,)
        By signal.
    changes : ndarray, shape (K,)
        When the set-point of the drive was changed, s.
    setpoints : ndarray, shape (K,)
        To what, input units.
    drive, response : str
        The signals of these slots.
    ticks : tuple of ndarray
        When each quick reading was complete, on the clock of the run, s; in which step.
    """

    path: Path
    meta: Mapping[str, Any]
    signals: tuple[Signal, ...]
    steps: tuple[StepRecord, ...]
    times: Floats
    is_reading: NDArray[np.bool_]
    columns: Mapping[str, Floats]
    changes: Floats
    setpoints: Floats
    drive: str
    response: str
    ticks: tuple[Floats, Floats]

    @property
    def driven(self) -> Floats:
        """What the drive did, by row, input units."""
        return self.columns[self.drive]

    @property
    def responded(self) -> Floats:
        """What the response did, by row, output units."""
        return self.columns[self.response]

    @property
    def last_change(self) -> NDArray[np.int64]:
        """The change of the set-point before each row; -1 before the first."""
        return np.searchsorted(self.changes, self.times - 1e-9, side="right") - 1

    @property
    def since_change(self) -> Floats:
        """Time since the last change of the set-point, by row, s; infinite before the first."""
        before = self.last_change
        return np.asarray(np.where(before < 0, np.inf, self.times - self.changes[np.maximum(before, 0)]))

    def on_grid(self, step: float, initial: float, end: float) -> Floats:
        """Return the set-point of each step of a grid of time up to `end` s: its mean over the step.

        Before the first change it is `initial`.
        """
        edges = step * np.arange(int(np.ceil(end / step)) + 2)
        levels = np.concatenate([[initial], self.setpoints])
        instants = np.concatenate([[0.0], self.changes])
        areas = np.concatenate([[0.0], np.cumsum(levels[:-1] * np.diff(instants))])
        at = np.searchsorted(self.changes, edges, side="right")
        integral = areas[at] + levels[at] * (edges - instants[at])
        return np.asarray(np.diff(integral) / step)


def slots_of_twin(file: RigFile) -> tuple[RoleTable, RoleTable]:
    """Return the slots drive and response of a rig file.

    Raises DataError if it does not bind both, a drive by a device.
    """
    roles = file.roles
    if "drive" not in roles or "response" not in roles or not roles["drive"].device:
        raise DataError(
            f"{file.path}: a twin needs the slots drive, with a device, and response ([roles.drive], "
            f"[roles.response]); the file binds: {', '.join(roles) or 'none'}"
        )
    return roles["drive"], roles["response"]


def read_recording(path: Path, file: RigFile) -> Recording:
    """Read a run of a rig.

    Raises
    ------
    DataError
        If it is no run or not of this rig, or says too little: names run and reason.
    """
    drive, response = slots_of_twin(file)
    with Record(path) as record:
        meta, signals = record.meta, record.signals
        steps = tuple(record.step_records())
        ticks, table = record.telemetry(), record.steps()
    _check_rig(path, meta, file)
    slots = meta.get("slots", {})
    names = {signal.name for signal in signals}
    device = drive.device
    reading = slots.get("drive", {}).get("signal") or drive.reading or next(
        (signal.name for signal in signals if signal.name.startswith(f"{device}_") and
         signal.name != f"{device}_setpoint"), f"{device}_setpoint"
    )  # fmt: skip
    answer = slots.get("response", {}).get("signal") or response.signal or response.reading
    for name in (reading, answer, f"{device}_setpoint"):
        if name not in names:
            raise DataError(f"{path}: has no signal {name!r}, which a twin of rig {file.name} needs")
    if len(steps) < FEWEST_STEPS:
        raise DataError(
            f"{path}: has {len(steps)} steps; a twin needs a characterization, such as damped-oscillation, of "
            f"{FEWEST_STEPS} steps at least"
        )
    # The last tick under control is the reading of its step.
    fresh = ~np.isin(ticks["t"], table["finished"])
    times = np.concatenate([ticks["t"][fresh], table["finished"]])
    order = np.argsort(times, kind="stable")
    columns = {
        signal.name: np.concatenate([ticks[signal.name][fresh], table[signal.name]])[order] for signal in signals
    }
    is_reading = np.concatenate([np.zeros(int(fresh.sum()), dtype=bool), np.ones(len(steps), dtype=bool)])[order]
    number = np.concatenate([ticks["step"][fresh], table["step"]])[order].astype(np.int64)
    times = times[order]
    known = np.isfinite(columns[reading]) & np.isfinite(columns[answer])
    columns = {name: values[known] for name, values in columns.items()}
    times, is_reading, number = times[known], is_reading[known], number[known]
    setpoint = columns[f"{device}_setpoint"]
    changed = np.flatnonzero(np.diff(setpoint, prepend=np.nan) != 0)
    changed = changed[np.isfinite(setpoint[changed])]
    started = np.append(table["started"], np.inf)[np.minimum(number[changed], len(steps))]
    before = np.where(changed > 0, times[np.maximum(changed - 1, 0)], times[0])
    instants = np.where((started >= before - 1e-9) & (started <= times[changed]), started, before)
    if changed.size < 2:
        raise DataError(
            f"{path}: the set-point of {device} does not change, so that there is no transient from which dynamics "
            "could be identified; run creep or damped-oscillation"
        )
    return Recording(
        path=path,
        meta=meta,
        signals=signals,
        steps=steps,
        times=times - times[0],
        is_reading=is_reading,
        columns=columns,
        changes=instants - times[0],
        setpoints=setpoint[changed],
        drive=reading,
        response=answer,
        ticks=(ticks["t"], ticks["step"]),
    )


def _check_rig(path: Path, meta: Mapping[str, Any], file: RigFile) -> None:
    """Raise DataError unless a run is of a rig: of its name, or with the same slots on the same devices."""
    devices = [*meta.get("devices", {})]
    if [entry.name for entry in file.devices] != devices:
        raise DataError(
            f"{path}: is a run of rig {meta.get('rig')}, with the devices {', '.join(devices) or 'none'}; rig "
            f"{file.name} has {', '.join(entry.name for entry in file.devices)}"
        )
