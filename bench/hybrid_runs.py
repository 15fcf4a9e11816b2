"""From the runs that characterize the thermo-piezoelectric hybrid to its models.

The runs are fast loops on the rig's signals: what their samples measured stands in the telemetry, at their rate.
Everything is in SI units; temperatures are in °C and a positive current heats.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bench.errors import DataError
from bench.hysteresis import PrandtlIshlinskii
from bench.identification import Errors, measure_errors
from bench.identification.hybrid_model import identify_pi
from bench.journal import Record, Table
from bench.protocol import LATENESS

Floats = npt.NDArray[np.float64]

CURRENT, VOLTAGE = "tec_setpoint", "piezo_setpoint"
DEFLECTION = "displacement_position"
BASE, TIP = "base_temperature", "tip_temperature"

_DRIFT_PASSES = 4


@dataclass(frozen=True)
class Samples:
    """The samples of one fast loop.

    Attributes
    ----------
    table : Table
        Signals by name; set-points are those that were sent upon the sample.
    period : float
        From sample to sample, s.
    """

    table: Table
    period: float

    def __getitem__(self, signal: str) -> Floats:
        return self.table[signal]

    @property
    def times(self) -> Floats:
        """Time from the first sample, s."""
        return np.arange(len(self.table), dtype=np.float64) * self.period


def read_loops(run: Path) -> dict[str, Samples]:
    """Return the samples of each fast loop of a run by its label.

    Raises
    ------
    DataError
        If the run was not completed, has no fast loop, or left samples out.
    """
    with Record(run) as record:
        if record.status != "completed":
            raise DataError(f"{run}: the run is {record.status}; a model needs a completed one")
        if LATENESS.name not in [signal.name for signal in record.signals]:
            raise DataError(f"{run}: has no fast loop")
        labels = {step.step: step.label for step in record.step_records()}
        ticks = record.telemetry()
    taken = np.isfinite(ticks[LATENESS.name])
    loops = {}
    for step in np.unique(ticks["step"][taken]).astype(int).tolist():
        rows = taken & (ticks["step"] == step)
        table = Table({name: values[rows] for name, values in ticks.columns.items()})
        times = table["t"] - table[LATENESS.name]
        if len(table) < 2 or np.ptp(steps := np.diff(times)) > 1e-3 * steps.mean():
            raise DataError(f"{run}: the loop {labels[step]!r} left samples out; a model needs all of them")
        loops[labels[step]] = Samples(table, float(steps.mean()))
    if not loops:
        raise DataError(f"{run}: has no fast loop")
    return loops


def sine_at(samples: Samples, signal: str, frequency: float) -> complex:
    """Return the complex amplitude of a signal at a frequency (Hz), over the last whole periods but the first.

    The first period is left out, as the transient is in it.
    """
    count = round(1.0 / (frequency * samples.period))
    periods = len(samples.table) // count - 1
    if periods < 1:
        raise DataError(f"a sine of {frequency:g} Hz takes two periods at least, the first of which does not count")
    last = slice(len(samples.table) - periods * count, None)
    times, values = samples.times[last], samples[signal][last]
    # With what drifts from period to period as further columns.
    angle = 2.0 * np.pi * frequency * times
    columns = np.column_stack([np.cos(angle), np.sin(angle), np.ones_like(times), times - times.mean()])
    cosine, sine, *_ = np.linalg.lstsq(columns, values, rcond=None)[0]
    return complex(sine, cosine)


def bandwidth_of(frequencies: Floats, gains: Floats) -> float:
    """Return the frequency (Hz) at which a gain has fallen by 3 dB from the one at the lowest, between two of them.

    Raises
    ------
    DataError
        If it has not fallen so far at the highest.
    """
    wanted = gains[0] / np.sqrt(2.0)
    below = np.flatnonzero(gains <= wanted)
    if below.size == 0:
        raise DataError(f"the gain has not fallen by 3 dB up to {frequencies[-1]:g} Hz")
    k = int(below[0])
    # Straight between two points of the Bode plot.
    return float(
        np.exp(np.interp(-np.log(wanted), -np.log(gains[k - 1 : k + 1]), np.log(frequencies[k - 1 : k + 1])))
    )


def identify_piezo(samples: Samples, plays: int = 15) -> tuple[PrandtlIshlinskii, Errors, Floats]:
    """Return the Prandtl-Ishlinskii operator of a slow loop, its errors, and the deflection without drift (m).

    What the room's temperature bends the beam meanwhile is taken for a parabola in time and taken off.
    """
    voltages, deflections = samples[VOLTAGE], samples[DEFLECTION]
    # A sample is read before its set-point is sent.
    applied = np.append(0.0, voltages[:-1])
    middle = samples.times - samples.times.mean()
    columns = np.column_stack([middle, middle**2])
    drift = np.zeros_like(deflections)
    for _ in range(_DRIFT_PASSES):
        found = identify_pi(applied, deflections - drift, plays=plays, maximum=float(np.abs(applied).max()))
        rest = deflections - drift - (deflections - drift - found.residuals)
        drift = drift + columns @ np.linalg.lstsq(columns, rest - rest.mean(), rcond=None)[0]
    operator = found.model
    if not isinstance(operator, PrandtlIshlinskii):
        raise TypeError("expected a Prandtl-Ishlinskii operator")
    clean = deflections - drift
    return operator, measure_errors(clean, clean - found.residuals), clean
