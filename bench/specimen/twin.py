"""What was identified of a specimen, for people and for programs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel

from bench.analysis import IdentifiedActuator, TransientRecording
from bench.base import difference_unit
from bench.models import Operator
from bench.specimen.device import TwinSettings
from bench.specimen.disturbances import Noise
from bench.specimen.reading_time import ReadingTime
from bench.specimen.response import IdentifiedResponse
from bench.specimen.specimen import Dynamics, Unevenness, Wander
from bench.specimen.tables import DriveTable, NoiseTable, ResponseTable, TwinTable


@dataclass(frozen=True, eq=False)
class IdentifiedTwin:
    """All that a twin has, with the evidence for it."""

    recordings: tuple[TransientRecording, ...]  # what it was identified from
    model_name: str  # name of the model, or of its file
    model: Operator[Any]
    actuator: IdentifiedActuator  # from the set-point to the drive
    response: IdentifiedResponse  # from the drive to the response
    noise: tuple[Noise, Noise]  # of the readings of drive and response, in input and output units
    steps: float  # in which the drive carries out its set-points, input units; 0 for none
    dynamics: Dynamics  # actuator and response, with wander, unevenness and drift
    offset: float  # standard deviation of the response from session to session, output units
    reading_time: ReadingTime | None  # what the lines take; None if it is not known
    signals: Mapping[str, dict[str, Any]]  # how each signal of a device is read; see `NoiseTable`
    # The model's output and the signal of the device, where the response is derived from that.
    conversion: tuple[tuple[float, float], ...]
    source: str  # that signal; the response itself if it is not derived
    warnings: tuple[str, ...] = ()  # what the runs could not say, each with what to record instead, in a sentence

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
        """Return what was identified, as the rig file describes it, and the warnings, as (name, text) pairs."""
        first, found = self.recordings[0], self.dynamics
        units = {
            "input units": difference_unit(self.units[first.drive]),
            "output units": difference_unit(self.units[first.response]),
        }
        order = ("follows at once", "first order", "second order")[found.actuator.order]
        rows = [
            ("runs", ", ".join(recording.path.name for recording in self.recordings)),
            (
                "model",
                f"{self.model_name}; error {self.response.rms:.4g} {units['output units']} RMS over the readings",
            ),
            ("actuator", f"{order}; leaves {self.actuator.rms:.4g} {units['input units']} RMS"),
        ]
        taken = self.reading_time
        parts: list[tuple[str, type[BaseModel], Mapping[str, Any], Mapping[str, float]]] = [
            ("drive", DriveTable, vars(found.actuator) | {"resolution": self.steps}, self.actuator.uncertainties),
            ("response", ResponseTable, vars(found.response), {"lag": self.response.lag_uncertainty}),
            ("drive", NoiseTable, vars(self.noise[0]), {}),
            ("response", NoiseTable, vars(self.noise[1]), {}),
            ("wander", Wander, found.wander.model_dump(), {}),
            ("unevenness", Unevenness, found.unevenness.model_dump(), {}),
            ("response", TwinTable, {"drift": found.drift, "session_offset": self.offset}, {}),
            (
                "lines",
                TwinSettings,
                {} if taken is None else {f"{n}_time": each for n, each in vars(taken).items()},
                {},
            ),
        ]
        for part, table, values, spreads in parts:
            for key, value in values.items():
                field = table.model_fields[key]
                if value in (field.default, math.inf):
                    continue
                name = f"{part}: {str(field.description).split(';', maxsplit=1)[0]}"
                if table is NoiseTable:
                    name += f", {'input' if part == 'drive' else 'output'} units"
                for said, unit in units.items():
                    name = name.replace(said, unit)
                text = ", ".join(f"{each:.4g}" for each in np.atleast_1d(value))
                rows.append((name, f"{text} ± {spreads[key]:.2g}" if key in spreads else text))
        if taken is None:
            rows.append(("lines", "not known, as the protocols of the runs cannot be followed; 0 s taken"))
        return [*rows, *(("warning", text) for text in self.warnings)]

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
