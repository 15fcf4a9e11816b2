"""From runs to a twin of their specimen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.analysis import TransientRecording, grid_step, identify_actuator
from bench.base import DataError, difference_unit
from bench.devices import Signal
from bench.identification import load_model
from bench.models import ActuatorDynamics, Operator
from bench.rig import RigFile
from bench.specimen.characterizations import read_recording, slots_of_twin
from bench.specimen.disturbances import Noise, identify_disturbances, noise_of
from bench.specimen.hysteresis import identify_hysteresis, run_of_model
from bench.specimen.reading_time import time_readings
from bench.specimen.response import identify_response
from bench.specimen.specimen import Dynamics
from bench.specimen.suitability import doubts, raise_if_wrong
from bench.specimen.twin import IdentifiedTwin

_NODES = 65
"""Pairs by which a derived signal and what it comes from follow from each other; between them it is linear.
Derivation: a straight piece of 1/64 of the range leaves a curve of a constant bend by 1/64² of what the whole
bends."""
_ALIKE = 2e-3
"""Share of the range of a signal by which it may differ from what those pairs say and still be what the response is
derived from. Derivation: a smooth curve through 65 points is that close."""


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
    swept = run_of_model(recordings) if model is None else None
    if swept is not None:
        name, operator = identify_hysteresis(swept[0], file)
        new = [i for i, r in enumerate(recordings) if r is not swept[0]]
    else:
        assert model is not None
        name, operator = model.name, _load(model, units[first.drive], units[first.response])
        new = [*range(len(recordings))]
    actuator = identify_actuator(recordings)
    # The drive stands still long before what lags behind it.
    of_drive = Dynamics(grid_step(actuator.dynamics), actuator.dynamics)
    drive_noise = noise_of(recordings, first.drive, of_drive)
    steps = _steps_of_setpoints(recordings, actuator.dynamics, drive_noise)
    if steps:
        recordings = tuple(replace(r, setpoints=np.round(r.setpoints / steps) * steps) for r in recordings)
    response = identify_response(recordings, actuator.dynamics, operator)
    output = difference_unit(units[first.response])
    raise_if_wrong(recordings, response, name, output)
    dynamics = Dynamics(of_drive.step, actuator.dynamics, response.dynamics)
    # A model errs less on the run that it is from than on another history.
    of = new or [*range(len(recordings))]
    found = identify_disturbances([recordings[i] for i in of], [response.errors[i] for i in of], operator, dynamics)
    unknown = [] if drive_noise else ["noise of the drive"]
    unknown += [] if found else ["noise of the response", "wander", "drift"]
    warnings = tuple(doubts(recordings, response, output, swept, other=bool(new), unknown=unknown))
    noise, dynamics = found or (Noise(), dynamics)
    drive_noise = drive_noise or Noise()
    return IdentifiedTwin(
        recordings=recordings,
        model_name=name,
        model=operator,
        actuator=actuator,
        response=response,
        noise=(drive_noise, noise),
        steps=steps,
        dynamics=dynamics,
        offset=float(np.std(response.offsets, ddof=1)) if len(recordings) > 1 else 0.0,
        reading_time=time_readings(recordings, file),
        signals=_signals(recordings, file, dynamics, drive_noise, noise, source, conversion),
        conversion=conversion,
        source=source,
        warnings=warnings,
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


def _load(path: Path, drive: str, response: str) -> Operator[Any]:
    """Return the model of a file; raise DataError if its units are not those of the runs."""
    operator = load_model(path).operator
    for what, unit, expected in (("input", operator.input_unit, drive), ("output", operator.output_unit, response)):
        if unit != expected:
            raise DataError(
                f"model file {path}: its {what} is in {unit or 'no unit'}, that of the runs in {expected}"
            )
    return operator


def _steps_of_setpoints(
    recordings: Sequence[TransientRecording], actuator: ActuatorDynamics, noise: Noise | None
) -> float:
    """Return the steps in which a drive that follows at once carries out its set-points; 0 if none are seen.

    They are the last digit of its readings where it stands without noise and half of them or more are nearer to the
    multiple of it next to the set-point than a tenth.
    """
    if actuator.order or noise is None or noise.reading or not noise.resolution:
        return 0.0
    digit = noise.resolution
    off = np.concatenate([r.driven - np.round(r.setpoints[r.last_change] / digit) * digit for r in recordings])
    return digit if float(np.median(np.abs(off))) < 0.1 * digit else 0.0


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
        if float(np.ptp(values)) > 0.0 and float(np.abs(left).max()) < _ALIKE * float(np.ptp(values)):
            return source, tuple(zip(nodes.tolist(), found.tolist(), strict=True))
    raise DataError(
        f"{first.path}: the response {response} is derived from {', '.join(sorted(sources))}, and follows from none "
        "of them alone; a twin needs a response that a device measures, or one that is derived from one signal"
    )


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
            noise = drive if name == first.drive else noise_of(recordings, name, dynamics) or Noise()
            if name == source:
                noise = response if not conversion else _converted(response, conversion, noise)
            table: dict[str, Any] = {"level": float(np.median(values)) if values.size else 0.0}
            setpoint = f"{device}_setpoint"
            if device != driving and not followed and units.get(setpoint) == signal.unit:
                table["follows"], followed = device, True
            found[name] = table | vars(noise)
    return found


def _converted(noise: Noise, conversion: Sequence[tuple[float, float]], own: Noise) -> Noise:
    """Return the noise of the signal from which a response is derived, with the last digit of its own."""
    (low, below), (high, above) = conversion[0], conversion[-1]
    slope = abs((above - below) / (high - low))
    return Noise(noise.reading * slope, noise.quick * slope, own.resolution)
