"""From runs to a twin: its tables, and what was identified, for people."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.analysis import IdentifiedActuator, TransientRecording, grid_step, identify_actuator
from bench.base import DataError
from bench.devices import Signal
from bench.identification import cross_validate, identify, load_model
from bench.models import Operator
from bench.rig import RigFile
from bench.specimen.characterizations import read_recording, slots_of_twin
from bench.specimen.disturbances import Noise, identify_disturbances, mean_effects, noise_of
from bench.specimen.reading_time import ReadingTime, time_readings
from bench.specimen.response import IdentifiedResponse, correct_response, identify_response
from bench.specimen.setpoints import identify_setpoints
from bench.specimen.specimen import Dynamics, Unevenness, Wander
from bench.specimen.suitability import (
    doubts_of_disturbances,
    doubts_of_model,
    doubts_of_sweep,
    raise_if_wrong,
    run_of_model,
)
from bench.specimen.tables import InexactTable
from bench.specimen.unevenness import identify_unevenness

_MODELS: Mapping[str, Mapping[str, Any]] = {
    "preisach": {"reversible": "linear"},
    "preisach-nonmonotonic": {},
    "preisach-signed": {},
    "prandtl-ishlinskii": {},
}
"""Models of which cross-validation chooses one where none is given, with their options."""
_NODES = 65
"""Pairs by which a derived signal and what it comes from follow from each other."""


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
    actuator, response, noise, wander, drift, unevenness, reading_time
        What was identified beside it; the noise is of drive and response.
    setpoints : Noise
        How exactly set-points are carried out.
    offset : float
        Standard deviation of the response from session to session, output units.
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
    setpoints: Noise
    wander: Wander
    drift: Wander
    unevenness: Unevenness
    reading_time: ReadingTime | None
    offset: float
    signals: Mapping[str, dict[str, Any]]
    conversion: tuple[tuple[float, float], ...]
    source: str
    warnings: tuple[str, ...] = ()

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
        first = self.recordings[0]
        units = {signal.name: signal.unit for signal in first.signals}
        drive, response = _difference(units[first.drive]), _difference(units[first.response])
        dynamics, found = self.actuator.dynamics, self.response
        known = self.actuator.uncertainties

        def number(value: float, unit: str, spread: float | None = None) -> str:
            return f"{value:.4g}{'' if spread is None else f' ± {spread:.2g}'} {unit}".rstrip()

        def outliers(noise: Noise, unit: str, what: str) -> list[tuple[str, str]]:
            if not noise.outliers:
                return []
            most = max(map(abs, noise.outliers))
            size = f"{100.0 * most:.2g} % of it" if noise.relative_outliers else number(most, unit)
            return [("  outliers", f"{100.0 * noise.outlier_share:.2g} % of the {what}, by up to {size}")]

        order = ("follows at once", "first order", "second order")[dynamics.order]
        rows = [
            ("runs", ", ".join(str(r.path.name) for r in self.recordings)),
            ("model", f"{self.model_name}; error {number(found.rms_model, response)} RMS over the readings"),
            ("correction", f"leaves {number(found.rms, response)} RMS" if found.correction else "none that repeats"),
            ("actuator", f"{order}; leaves {number(self.actuator.rms, drive)} RMS"),
            ("  delay", number(dynamics.delay, "s", known.get("delay"))),
        ]
        if dynamics.order == 1:
            constant, share = 1.0 / dynamics.frequency, known.get("frequency", math.nan) / dynamics.frequency
            rows.append(("  time constant", number(constant, "s", constant * share)))
        if dynamics.order == 2:
            rows += [
                ("  natural frequency", number(dynamics.frequency, "rad/s", known.get("frequency"))),
                ("  damping", number(dynamics.damping, "", known.get("damping"))),
                ("  overshoot", f"{100.0 * dynamics.overshoot:.2g} %"),
            ]
        if math.isfinite(dynamics.rate):
            rows.append(("  fastest change", number(dynamics.rate, f"{drive}/s", known.get("rate"))))
        rows.append(("  at rest", f"{dynamics.gain:.5g} × set-point {dynamics.offset:+.3g} {units[first.drive]}"))
        slow = found.dynamics
        if slow.lag:
            rows.append(
                (
                    "lag of the specimen",
                    f"{number(slow.lag, 's', found.lag_uncertainty)}, of the drive to the power {slow.power:g}",
                )
            )
        for share, time in zip(slow.shares, slow.times, strict=True):
            rows.append(("late part", f"{100.0 * share:.2g} % of the response, {time:g} s"))
        for name, noise, unit in (
            ("noise of the drive", self.noise[0], drive),
            ("noise of the response", self.noise[1], response),
        ):
            rows.append(
                (name, f"{number(noise.reading, unit)} of a reading, {number(noise.quick, unit)} of a quick one")
            )
            rows += outliers(noise, unit, "readings")
        if self.setpoints.resolution:
            rows.append(("steps of the set-points", number(self.setpoints.resolution, drive)))
            rows += outliers(self.setpoints, drive, "set-points")
        for name, wander, unit in (
            ("wander of the drive", self.wander, drive),
            ("drift of the response", self.drift, response),
        ):
            rows.append((name, f"{number(wander.deviation, unit)} in {number(wander.time, 's')}"))
        uneven = self.unevenness
        text = f"{number(uneven.deviation, drive)} of the drive, within {number(uneven.length, drive)}"
        rows.append(("unknown to the model", text))
        if len(self.recordings) > 1:
            rows.append(("from run to run", f"{number(self.offset, response)} of the response"))
        taken = self.reading_time
        text = "not known, as the protocols of the runs cannot be followed; 0 s taken"
        if taken is not None:
            text = ", ".join(
                f"{number(each, 's')} {what}".strip()
                for each, what in ((taken.reading, ""), (taken.quick, "quick"), (taken.setpoint, "of a set-point"))
            )
        return [*rows, ("time of a reading", text)]

    def summary(self) -> dict[str, Any]:
        """Return what was identified, for programs."""
        dynamics, slow = self.actuator.dynamics, self.response.dynamics
        return {
            "model": self.model_name,
            "model_rms": self.response.rms_model,
            "left_rms": self.response.rms,
            "actuator": {
                "order": dynamics.order, "delay": dynamics.delay, "frequency": dynamics.frequency,
                "damping": dynamics.damping, "rate": dynamics.rate if math.isfinite(dynamics.rate) else None,
                "overshoot": dynamics.overshoot, "gain": dynamics.gain, "offset": dynamics.offset,
                "uncertainties": dict(self.actuator.uncertainties),
            },
            "response": {
                "lag": slow.lag, "power": slow.power, "gain": slow.gain, "shares": list(slow.shares),
                "times": list(slow.times),
            },
            "noise": {"drive": vars(self.noise[0]), "response": vars(self.noise[1])},
            "setpoints": inexact(self.setpoints),
            "wander": vars(self.wander),
            "drift": vars(self.drift),
            "unevenness": vars(self.unevenness),
            "session_offset": self.offset,
            "reading_time": None if self.reading_time is None else vars(self.reading_time),
            "warnings": list(self.warnings),
        }  # fmt: skip


def identify_twin(paths: Sequence[Path], file: RigFile, model: Path | None) -> IdentifiedTwin:
    """Identify a twin of the specimen of some runs.

    Parameters
    ----------
    paths : sequence of Path
        Folders of runs on the rig: characterizations, and others.
    file : RigFile
        The rig.
    model : Path or None
        File of the model; if None, it is identified from the run that determines most of one.

    Raises
    ------
    DataError
        If a run or the model cannot be used, or the model does not describe the runs.
    """
    slots_of_twin(file)
    recordings = tuple(read_recording(path, file) for path in paths)
    first = recordings[0]
    units = {signal.name: signal.unit for signal in first.signals}
    source, conversion = _source(recordings, file)
    warnings: list[str] = []
    if model is None:
        swept, determined = run_of_model(recordings)
        name, operator = _identify_model(swept, file, units)
        warnings += doubts_of_sweep(swept, determined)
    else:
        name, operator = model.name, load_model(model).operator
        for what, unit, expected in (
            ("input", operator.input_unit, units[first.drive]),
            ("output", operator.output_unit, units[first.response]),
        ):
            if unit != expected:
                raise DataError(
                    f"model file {model}: its {what} is in {unit or 'no unit'}, that of the runs in {expected}"
                )
    actuator = identify_actuator(recordings)
    # The drive stands still long before what lags behind it.
    drive_noise = noise_of(
        recordings, first.drive, Dynamics(grid_step(actuator.dynamics), actuator.dynamics), outliers=True
    )
    setpoints, carried_out = identify_setpoints(recordings, actuator.dynamics, drive_noise, operator)
    response = identify_response(carried_out, actuator.dynamics, operator)
    output = _difference(units[first.response])
    raise_if_wrong(carried_out, response, name, output)
    warnings += doubts_of_model(carried_out, response, output)
    operators = [operator] if response.correction is None else [operator, response.correction]
    dynamics = Dynamics(grid_step(actuator.dynamics), actuator.dynamics, response.dynamics)
    noise, wander, drift = identify_disturbances(
        carried_out, operators, dynamics, first.response, response.of_model, response.left
    )
    disturbed = replace(dynamics, wander=wander, drift=drift)
    # The readings had the effect of wander, too: the twin adds its own.
    effects = mean_effects(carried_out, operators, disturbed)
    if any(effect.any() for effect in effects):
        response = correct_response(response, carried_out, operator, effects)
    operators = [operator] if response.correction is None else [operator, response.correction]
    unevenness = identify_unevenness(
        carried_out, response.of_model, response.left, operators, disturbed, effects, noise
    )
    warnings += doubts_of_disturbances(carried_out, dynamics, drive_noise, noise, wander, drift)
    return IdentifiedTwin(
        recordings=recordings,
        model_name=name,
        model=operator,
        actuator=actuator,
        response=response,
        noise=(drive_noise, noise),
        setpoints=setpoints,
        wander=wander,
        drift=drift,
        unevenness=unevenness,
        reading_time=time_readings(recordings, file),
        offset=float(np.std(response.offsets, ddof=1)) if len(recordings) > 1 else 0.0,
        signals=_signals(recordings, file, dynamics, drive_noise, noise, source, conversion),
        conversion=conversion,
        source=source,
        warnings=tuple(warnings),
    )


def device_of(signal: str, file: RigFile) -> str:
    """Return the device that measures a signal, by its name; empty if none does."""
    fitting = [entry.name for entry in file.devices if signal.startswith(f"{entry.name}_")]
    return max(fitting, key=len, default="") if signal not in file.derived else ""


def measured_signals(recording: TransientRecording, file: RigFile) -> dict[str, list[Signal]]:
    """Return the signals that each device measures, by device; without set-points."""
    found: dict[str, list[Signal]] = {entry.name: [] for entry in file.devices}
    for signal in recording.signals:
        device = device_of(signal.name, file)
        if device and signal.name != f"{device}_setpoint":
            found[device].append(signal)
    return found


def _source(recordings: Sequence[TransientRecording], file: RigFile) -> tuple[str, tuple[tuple[float, float], ...]]:
    """Return the signal of a device that the response comes from, and the pairs that lead to it."""
    first = recordings[0]
    response, drive = first.response, first.drive
    if not device_of(drive, file):
        raise DataError(
            f"{first.path}: the drive {drive} is a derived signal; a twin needs one that a device measures"
        )
    if device_of(response, file):
        return response, ()
    outputs = np.concatenate([r.responded for r in recordings])
    waiting, sources = [response], set()
    while waiting:
        name = waiting.pop()
        if name in file.derived:
            waiting.extend(file.derived[name].sources)
        else:
            sources.add(name)
    for source in sorted(sources):
        values = np.concatenate([r.columns[source] for r in recordings])
        order = np.argsort(outputs, kind="stable")
        nodes = np.linspace(outputs.min(), outputs.max(), _NODES)
        found = np.interp(nodes, outputs[order], values[order])
        left = values - np.interp(outputs, nodes, found)
        if float(np.ptp(values)) > 0.0 and float(np.abs(left).max()) < 2e-3 * float(np.ptp(values)):
            return source, tuple(zip(nodes.tolist(), found.tolist(), strict=True))
    raise DataError(
        f"{first.path}: the response {response} is derived from {', '.join(sorted(sources))}, and follows from none "
        "of them alone; a twin needs a response that a device measures, or one that is derived from one signal"
    )


def _identify_model(
    recording: TransientRecording, file: RigFile, units: Mapping[str, str]
) -> tuple[str, Operator[Any]]:
    """Return the model of the least error of cross-validation, of those that identification offers."""
    chosen = recording.is_reading
    inputs, outputs = recording.driven[chosen], recording.responded[chosen]
    layout = file.dashboard
    plane = layout.plane if layout is not None and layout.input == recording.drive else None
    common = {"input_unit": units[recording.drive], "output_unit": units[recording.response]}
    trials: list[tuple[float, str, dict[str, Any]]] = []
    for name, options in _MODELS.items():
        whole = {**common, **options, **({"plane": plane} if plane and name.startswith("preisach") else {})}
        try:
            trials.append((cross_validate(name, inputs, outputs, **whole).best.rms, name, whole))
        except ValueError:
            # Not every model takes every sequence.
            continue
    if not trials:
        raise DataError(f"{recording.path}: no model can be identified from its readings; give one by --model FILE")
    _, name, options = min(trials, key=lambda each: each[0])
    # As it was tried.
    return name, identify(name, inputs, outputs, smoothing=0.0, ridge=0.0, **options).model


def _signals(
    recordings: Sequence[TransientRecording],
    file: RigFile,
    dynamics: Dynamics,
    drive: Noise,
    response: Noise,
    source: str,
    conversion: Sequence[tuple[float, float]],
) -> dict[str, dict[str, Any]]:
    """Return how each signal of a device is read."""
    first = recordings[0]
    units = {signal.name: signal.unit for signal in first.signals}
    driving = slots_of_twin(file)[0].device
    found: dict[str, dict[str, Any]] = {}
    for device, signals in measured_signals(first, file).items():
        followed = False
        for signal in signals:
            name = signal.name
            values = np.concatenate([r.columns[name] for r in recordings])
            values = values[np.isfinite(values)]
            noise = drive if name == first.drive else noise_of(recordings, name, dynamics)
            if name == source:
                noise = response if not conversion else _converted(response, conversion, noise)
            table: dict[str, Any] = {"level": float(np.median(values)) if values.size else 0.0}
            setpoint = f"{device}_setpoint"
            if device != driving and not followed and units.get(setpoint) == signal.unit:
                table["follows"], followed = device, True
            found[name] = table | {"reading": noise.reading, "quick": noise.quick} | inexact(noise)
    return found


def _converted(noise: Noise, conversion: Sequence[tuple[float, float]], own: Noise) -> Noise:
    """Return the noise of the signal from which a response is derived."""
    pairs = np.array(conversion)
    slope = abs(float((pairs[-1, 1] - pairs[0, 1]) / (pairs[-1, 0] - pairs[0, 0])))
    return Noise(noise.reading * slope, noise.quick * slope, own.resolution)


def inexact(noise: Noise) -> dict[str, Any]:
    """Return the keys of an `InexactTable`."""
    found = {key: value for key, value in vars(noise).items() if key in InexactTable.model_fields}
    return found | {"outliers": list(noise.outliers)}


def _difference(unit: str) -> str:
    return unit.replace("°C", "K")


def model_json(operator: Operator[Any]) -> str:
    """Return an operator as JSON on one line, without the quote that ends a TOML literal."""
    return json.dumps(operator.to_json(), ensure_ascii=False, separators=(",", ":")).replace("'", "\\u0027")
