"""The runs from which a twin is made."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.analysis import TransientRecording, recording_of
from bench.base import DataError
from bench.record import Record
from bench.rig import RigFile, RoleTable

FEWEST_STEPS = 20
"""Fewer steps than this say nothing of a specimen. Derivation: a plane of five intervals has 16 numbers, with as many
steps at least."""


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


def read_recording(path: Path, file: RigFile) -> TransientRecording:
    """Read a run of a rig.

    Raises DataError if it is no run or not of this rig, or says too little: names run and reason.
    """
    drive, response = slots_of_twin(file)
    with Record(path) as record:
        meta = record.meta
        _check_rig(path, meta, file)
        slots = meta.get("slots", {})
        names = [signal.name for signal in record.signals]
        device = drive.device
        reading = slots.get("drive", {}).get("signal") or drive.reading or next(
            (signal.name for signal in record.signals if signal.name.startswith(f"{device}_") and
             signal.name != f"{device}_setpoint"), f"{device}_setpoint"
        )  # fmt: skip
        answer = slots.get("response", {}).get("signal") or response.signal or response.reading
        for name in (reading, answer, f"{device}_setpoint"):
            if name not in names:
                raise DataError(f"{path}: has no signal {name!r}, which a twin of rig {file.name} needs")
        found = recording_of(path, record, device, reading, answer)
    if len(found.steps) < FEWEST_STEPS:
        raise DataError(
            f"{path}: has {len(found.steps)} steps; a twin needs a characterization, such as damped-oscillation, of "
            f"{FEWEST_STEPS} steps at least"
        )
    return found


def _check_rig(path: Path, meta: Mapping[str, Any], file: RigFile) -> None:
    """Raise DataError unless a run is of a rig: of its name, or with the same slots on the same devices."""
    devices = [*meta.get("devices", {})]
    if [entry.name for entry in file.devices] != devices:
        raise DataError(
            f"{path}: is a run of rig {meta.get('rig')}, with the devices {', '.join(devices) or 'none'}; rig "
            f"{file.name} has {', '.join(entry.name for entry in file.devices)}"
        )
