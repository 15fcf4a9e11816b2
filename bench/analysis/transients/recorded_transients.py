"""What was recorded of a specimen in a run: its drive and its response over time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bench.base import DataError, DeferredModule, Floats
from bench.devices import Signal
from bench.record import Record, StepRecord
from bench.rig import SETPOINT

if TYPE_CHECKING:
    from bench.models import actuator_kernels as _kernels
else:
    _kernels = DeferredModule("bench.models.kernels.actuator_kernels")


@dataclass(frozen=True, eq=False)
class TransientRecording:
    """A run; rows are quick readings (telemetry) and readings (steps), in order of time.

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
    zero : float
        Time of the first row on the clock of the run, s.
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
    zero: float = 0.0

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

    def within(self, start: float, end: float) -> TransientRecording:
        """Return the part between two instants on the clock of the run, s, both included; times begin again."""
        rows = (self.times >= start - self.zero - 1e-9) & (self.times <= end - self.zero + 1e-9)
        first = float(self.times[rows][0])
        # A set-point at the very beginning of the part belongs to it, and not what came before.
        moved = (self.changes >= start - self.zero - 1e-9) & (self.changes <= end - self.zero)
        before = np.searchsorted(self.changes, start - self.zero - 1e-9) - 1
        standing = [self.setpoints[before]] if before >= 0 else []
        return replace(
            self,
            times=self.times[rows] - first,
            is_reading=self.is_reading[rows],
            columns={name: values[rows] for name, values in self.columns.items()},
            changes=np.append([0.0] * len(standing), np.maximum(self.changes[moved] - first, 0.0)),
            setpoints=np.append(standing, self.setpoints[moved]),
            zero=self.zero + first,
        )

    def on_grid(self, step: float, initial: float, end: float) -> Floats:
        """Return the set-point of each step of a grid of time up to `end` s: its mean over the step.

        Before the first change it is `initial`.
        """
        means = np.empty(_steps_until(end, step))
        _kernels.step_means(self.changes, np.append(initial, self.setpoints), step, means)
        return means

    def holds(self, step: float, initial: float, end: float) -> tuple[NDArray[np.int64], Floats]:
        """Return the same by its changes: step n to n + 1 of `starts`, shape (N + 1,), has one of shape (N,)."""
        most = 2 * self.changes.size + 1
        count = _steps_until(end, step)
        starts, means = np.full(most + 1, count), np.empty(most)
        found = _kernels.find_holds(self.changes, np.append(initial, self.setpoints), step, count, starts, means)
        return starts[: found + 1], means[:found]


def _steps_until(end: float, step: float) -> int:
    return int(np.ceil(end / step)) + 1


def recording_of(path: Path, record: Record, device: str, drive: str, response: str) -> TransientRecording:
    """Return what a run recorded of a drive and a response.

    Parameters
    ----------
    path : Path
        Of the run.
    record : Record
        Of the run.
    device : str
        The drive's device.
    drive, response : str
        The signals.

    Raises
    ------
    DataError
        If a signal is missing, or the set-point of the drive does not change.
    """
    signals = record.signals
    names = {signal.name for signal in signals}
    for name in (drive, response, f"{device}{SETPOINT}"):
        if name not in names:
            raise DataError(f"{path}: has no signal {name!r}; it has: {', '.join(sorted(names))}")
    steps = tuple(record.step_records())
    ticks, table = record.telemetry(), record.steps()
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
    known = np.isfinite(columns[drive]) & np.isfinite(columns[response])
    columns = {name: values[known] for name, values in columns.items()}
    times, is_reading, number = times[known], is_reading[known], number[known]
    setpoint = columns[f"{device}{SETPOINT}"]
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
    return TransientRecording(
        path=path,
        meta=record.meta,
        signals=signals,
        steps=steps,
        times=times - times[0],
        is_reading=is_reading,
        columns=columns,
        changes=instants - times[0],
        setpoints=setpoint[changed],
        drive=drive,
        response=response,
        ticks=(ticks["t"], ticks["step"]),
        zero=float(times[0]),
    )
