"""What was identified of a specimen, for people and for programs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.analysis import IdentifiedActuator, TransientRecording
from bench.models import Operator
from bench.specimen.disturbances import Noise
from bench.specimen.reading_time import ReadingTime
from bench.specimen.response import IdentifiedResponse
from bench.specimen.specimen import Dynamics


@dataclass(frozen=True, eq=False)
class IdentifiedTwin:
    """All that a twin has, with the evidence for it.

    Attributes
    ----------
    recordings : tuple of TransientRecording
        What it was identified from.
    model_name : str
        Name of the model, or of its file.
    model : Operator
        The hysteresis.
    actuator : IdentifiedActuator
        From the set-point to the drive.
    response : IdentifiedResponse
        From the drive to the response.
    noise : tuple of Noise
        Of the readings of drive and response, in input and output units.
    steps : float
        In which the drive carries out its set-points, input units; 0 for none.
    dynamics : Dynamics
        Actuator and response, with wander, unevenness and drift.
    offset : float
        Standard deviation of the response from session to session, output units.
    reading_time : ReadingTime or None
        What the lines take; None if it is not known.
    signals : mapping of str to dict
        How each signal of a device is read; see `NoiseTable`.
    conversion : tuple of pairs
        The model's output and the signal of the device, where the response is derived from that.
    source : str
        That signal; the response itself if it is not derived.
    warnings : tuple of str
        What the runs could not say, each with what to record instead, in a sentence.
    """

    recordings: tuple[TransientRecording, ...]
    model_name: str
    model: Operator[Any]
    actuator: IdentifiedActuator
    response: IdentifiedResponse
    noise: tuple[Noise, Noise]
    steps: float
    dynamics: Dynamics
    offset: float
    reading_time: ReadingTime | None
    signals: Mapping[str, dict[str, Any]]
    conversion: tuple[tuple[float, float], ...]
    source: str
    warnings: tuple[str, ...] = ()

    @property
    def units(self) -> dict[str, str]:
        """The unit of each signal."""
        return {signal.name: signal.unit for signal in self.recordings[0].signals}

    @property
    def setpoint_limits(self) -> dict[str, tuple[float, float]]:
        """The set-points that each device has allowed in the runs, or took if that is not on record."""
        found: dict[str, tuple[float, float]] = {}
        for recording in self.recordings:
            for device, (low, high) in recording.meta.get("limits", {}).items():
                found[device] = (float(low), float(high))
        for signal in self.recordings[0].signals:
            device = signal.name.removesuffix("_setpoint")
            if device != signal.name and device not in found:
                values = np.concatenate([r.columns[signal.name] for r in self.recordings])
                values = values[np.isfinite(values)]
                found[device] = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
        return found

    def rows(self) -> list[tuple[str, str]]:
        """Return what was identified, and the warnings, as (name, text) pairs."""
        return [*self.identified(), *(("warning", text) for text in self.warnings)]

    def identified(self) -> list[tuple[str, str]]:
        """Return what was identified, with units and uncertainty, as (name, text) pairs."""
        first, units = self.recordings[0], self.units
        drive, response = difference(units[first.drive]), difference(units[first.response])
        rows = [
            ("runs", ", ".join(str(r.path.name) for r in self.recordings)),
            ("model", f"{self.model_name}; error {_number(self.response.rms, response)} RMS over the readings"),
            *self._actuator(drive, units[first.drive]),
        ]
        if self.steps:
            rows.append(("steps of the set-points", _number(self.steps, drive)))
        slow, known = self.response.dynamics, self.response.lag_uncertainty
        if slow.lag:
            text = f"{_number(slow.lag, 's', known)}, of the drive to the power {slow.power:g}"
            rows.append(("lag of the specimen", text))
        for share, time in zip(slow.shares, slow.times, strict=True):
            rows.append(("late part", f"{100.0 * share:.2g} % of the response, {time:g} s"))
        found = self.dynamics
        for name, noise, unit in (
            ("noise of the drive", self.noise[0], drive),
            ("noise of the response", self.noise[1], response),
        ):
            text = f"{_number(noise.reading, unit)} of a reading, {_number(noise.quick, unit)} of a quick one"
            rows.append((name, text))
        wander = f"{_number(found.wander.deviation, drive)} in {_number(found.wander.time, 's')}"
        rows.append(("wander of the drive", wander if found.wander.deviation else "none"))
        uneven = found.unevenness
        text = f"{_number(uneven.deviation, drive)} of the drive, within {_number(uneven.length, drive)}"
        rows.append(("unknown to the model", text if uneven.deviation else "nothing"))
        rows.append(("drift of the response", f"{_number(found.drift, f'{response}/√s')}" if found.drift else "none"))
        if len(self.recordings) > 1:
            rows.append(("from run to run", f"{_number(self.offset, response)} of the response"))
        taken = self.reading_time
        text = "not known, as the protocols of the runs cannot be followed; 0 s taken"
        if taken is not None:
            times = ((taken.reading, ""), (taken.quick, "quick"), (taken.setpoint, "of a set-point"))
            text = ", ".join(f"{_number(each, 's')} {what}".strip() for each, what in times)
        return [*rows, ("time of a reading", text)]

    def _actuator(self, drive: str, unit: str) -> list[tuple[str, str]]:
        """Return the rows of the actuator, with the units of a difference of the drive and of the drive."""
        dynamics, known = self.actuator.dynamics, self.actuator.uncertainties
        order = ("follows at once", "first order", "second order")[dynamics.order]
        rows = [
            ("actuator", f"{order}; leaves {_number(self.actuator.rms, drive)} RMS"),
            ("  delay", _number(dynamics.delay, "s", known.get("delay"))),
        ]
        if dynamics.order == 1:
            constant, share = 1.0 / dynamics.frequency, known.get("frequency", math.nan) / dynamics.frequency
            rows.append(("  time constant", _number(constant, "s", constant * share)))
        if dynamics.order == 2:
            rows += [
                ("  natural frequency", _number(dynamics.frequency, "rad/s", known.get("frequency"))),
                ("  damping", _number(dynamics.damping, "", known.get("damping"))),
                ("  overshoot", f"{100.0 * dynamics.overshoot:.2g} %"),
            ]
        if math.isfinite(dynamics.rate):
            rows.append(("  fastest change", _number(dynamics.rate, f"{drive}/s", known.get("rate"))))
        return [*rows, ("  at rest", f"{dynamics.gain:.5g} × set-point {dynamics.offset:+.3g} {unit}")]

    def summary(self) -> dict[str, Any]:
        """Return what was identified, for programs."""
        dynamics, found = self.actuator.dynamics, self.dynamics
        return {
            "model": self.model_name,
            "model_rms": self.response.rms,
            "actuator": {
                **vars(dynamics),
                "order": dynamics.order,
                "rate": dynamics.rate if math.isfinite(dynamics.rate) else None,
                "overshoot": dynamics.overshoot,
                "uncertainties": dict(self.actuator.uncertainties),
            },
            "response": vars(self.response.dynamics),
            "noise": {"drive": vars(self.noise[0]), "response": vars(self.noise[1])},
            "setpoints": {"resolution": self.steps},
            "wander": found.wander.model_dump(),
            "unevenness": found.unevenness.model_dump(),
            "drift": found.drift,
            "session_offset": self.offset,
            "reading_time": None if self.reading_time is None else vars(self.reading_time),
            "warnings": list(self.warnings),
        }


def difference(unit: str) -> str:
    """Return the unit of differences of a quantity."""
    return unit.replace("°C", "K")


def _number(value: float, unit: str, spread: float | None = None) -> str:
    return f"{value:.4g}{'' if spread is None else f' ± {spread:.2g}'} {unit}".rstrip()
