"""Errors of the hybrid's loops: of what their sensor shows, and of the tip itself.

*Repeatability* is what a loop makes of its sensor: the error of what the sensor shows, without its noise. *Accuracy*
is the error of the tip (JCGM 200:2012, 2.13 and 2.21). They are one where the sensor is ideal.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from bench.base import ConfigurationError
from bench.rig import Calibration, load_rig
from rigs.hybrid.identification import WITNESS, read_loop

if TYPE_CHECKING:
    from sim_devices.transducers.imperfect import Characteristic

Floats = npt.NDArray[np.float64]

HOLD = 30.0
"""Length of each hold between the moves, s, for all controllers alike."""
HELD = 15.0
"""Time at the end of each hold that counts as held, s."""
BAND = 0.02
"""Band within which a step counts as settled, as a share of the step."""


def displacement_characteristic(rig: str) -> Characteristic:
    """Return what the displacement sensor of an emulated hybrid makes of the deflection.

    Raises ConfigurationError if the rig is none.
    """
    # Here, as `bench list` reads the names of the studies.
    from rigs.hybrid.laboratory import HybridLaboratorySettings
    from sim_devices.transducers.data_sheets import DISPLACEMENT

    settings = load_rig(rig).laboratory_settings
    if not isinstance(settings, HybridLaboratorySettings):
        raise ConfigurationError(f"{rig}: is not an emulated hybrid, so that the true deflection is not known")
    return settings.characteristic_of("displacement_sensor", DISPLACEMENT)


@dataclass(frozen=True)
class Tracking:
    """Result of a reference: times (s), reference and deflection (m), each of shape (N,)."""

    times: Floats
    reference: Floats
    deflection: Floats

    @property
    def errors(self) -> Floats:
        """Deflection less reference, m."""
        return self.deflection - self.reference

    @property
    def moving(self) -> npt.NDArray[np.bool_]:
        """Where the reference moves."""
        return np.abs(np.gradient(self.reference, self.times)) > 1e-12

    @property
    def held(self) -> npt.NDArray[np.bool_]:
        """The last `HELD` seconds of each hold of `HOLD`, but for the rest at the beginning."""
        moving = self.moving
        last = np.maximum.accumulate(np.where(moving, self.times, -np.inf))
        return ~moving & np.isfinite(last) & (self.times - last >= HOLD - HELD)

    def measures(self, chosen: npt.NDArray[np.bool_]) -> dict[str, float]:
        """Return RMS and greatest error (nm) of the chosen samples; nan if there is none."""
        errors = self.errors[chosen] * 1e9
        if not errors.size:
            return {"rms_nm": float("nan"), "max_nm": float("nan")}
        return {"rms_nm": float(np.sqrt(np.mean(errors**2))), "max_nm": float(np.abs(errors).max())}

    def summary(self) -> dict[str, float]:
        """Return RMS and greatest error in holds and moves, nm; nan where there is none."""
        parts = {"hold": self.held, "move": self.moving}
        return {
            f"{part}_{key}": value for part, chosen in parts.items() for key, value in self.measures(chosen).items()
        }


@dataclass(frozen=True)
class Tracked:
    """Result of a reference, as the sensor shows it and as it is."""

    shown: Tracking
    true: Tracking

    def measures(self, after: float) -> dict[str, float]:
        """Return RMS and greatest error (nm) after a time from the start, s; the true ones by keys with `true_`."""
        shown, true = (each.measures(each.times > after) for each in (self.shown, self.true))
        return {**shown, **_named_true(true)}

    def summary(self) -> dict[str, float]:
        """Return RMS and greatest error in holds and moves, nm; the true ones by keys with `true_`."""
        return {**self.shown.summary(), **_named_true(self.true.summary())}


def tracked(run: Path, sensor: Characteristic, calibration: Calibration | None = None) -> Tracked:
    """Return the result of a run with a witness, whose sensor may be calibrated."""
    samples = read_loop(run)
    times, reference, deflection = samples.times, samples["reference"], samples[WITNESS]
    shown = sensor.course(deflection)
    if calibration is not None:
        shown = calibration.value(shown)
    return Tracked(Tracking(times, reference, shown), Tracking(times, reference, deflection))


def fine_step(run: Path, sensor: Characteristic) -> dict[str, float]:
    """Return how a fine step settles, by what the sensor shows, and how far off the tip is then.

    They are settling time (ms), overshoot (%), and the RMS errors afterwards (nm), shown and true.
    """
    samples = read_loop(run)
    reference, deflection = samples["reference"], samples[WITNESS]
    height = float(reference[-1] - reference[0])
    start = int(np.flatnonzero(reference != reference[0])[0])
    shown, true = (seen[start:] - reference[-1] for seen in (sensor.course(deflection), deflection))
    outside = np.flatnonzero(np.abs(shown / height) > BAND)
    settled = int(outside[-1]) + 1 if outside.size else 0
    rms, true_rms = (float(np.sqrt(np.mean(each[len(each) // 2 :] ** 2)) * 1e9) for each in (shown, true))
    return {
        "settling_ms": settled * samples.period * 1e3,
        "overshoot_percent": max(0.0, float((shown / height).max()) * 100.0),
        "rms_nm": rms,
        "true_rms_nm": true_rms,
    }


def _named_true(values: dict[str, float]) -> dict[str, float]:
    return {f"true_{key}": value for key, value in values.items()}
