"""The rig file of a twin, as text."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from bench.base import CheckedTable, toml_value
from bench.rig import RigFile
from bench.specimen.identify import measured_signals
from bench.specimen.specimen import Unevenness, Wander
from bench.specimen.tables import DriveTable, NoiseTable, ResponseTable, TwinTable
from bench.specimen.twin import IdentifiedTwin

_FASTEST_LINE = 100_000_000
"""Speed of the emulated lines, Bd: their time is part of that of a reading. Derivation: a line of 100 characters
takes 10 µs."""


def rig_text(twin: IdentifiedTwin, file: RigFile, rig: str, out: Path) -> str:
    """Return the rig file of a twin.

    `rig` is the name of a packaged rig, or a path.
    """
    lines = [
        f"# A twin of the present specimen on the rig {file.name}, made by `bench model twin` from the runs",
        *(f"#   {recording.path.name}" for recording in twin.recordings),
        "# Its slots, derived signals, interlocks, parameters of protocols and telemetry are those of that rig. Its",
        "# devices have the same names, signals, units and limits, but are emulated: the drive follows its",
        "# set-points, and the response follows the drive as was identified. Other signals stand at the level that",
        "# was measured, with the noise that was measured, or follow the set-point of their device at once.",
        "",
        f"extends = {toml_value(_base(rig, out))}",
        f"without = {toml_value(_left_out(file))}",
        "",
        "[rig]",
        f"title = {toml_value(f'{file.rig.title}: twin')}",
        "",
        *_devices(twin, file),
        *_emulation(twin, file),
    ]
    return "\n".join(lines) + "\n"


def _left_out(file: RigFile) -> list[str]:
    """Return the keys of the rig that its twin does not have."""
    named = ["rig.twin"] if "twin" in file.content["rig"] else []
    return [key for key in ("devices", "lines", "emulation") if key in file.content] + named


def _base(rig: str, out: Path) -> str:
    """Return the rig as `extends` names it in the file of the twin."""
    if not rig.endswith(".toml"):
        return rig
    path = Path(rig).resolve()
    try:
        return Path(os.path.relpath(path, out.resolve().parent)).as_posix()
    # On Windows there is no way from one drive to another.
    except ValueError:
        return path.as_posix()


def _devices(twin: IdentifiedTwin, file: RigFile) -> Iterator[str]:
    first, time = twin.recordings[0], twin.reading_time
    signals = {signal.name: signal for signal in first.signals}
    limits = twin.setpoint_limits
    drive = file.roles["drive"].device
    for device, measured in measured_signals(first, file).items():
        setpoint = signals.get(f"{device}_setpoint")
        keys: dict[str, Any] = {
            "driver": "twin-sensor" if setpoint is None else "twin-actuator",
            "port": f"emulated://{device}",
            "baudrate": _FASTEST_LINE,
        }
        if time is not None:
            # What each device takes of the time is not on record: equal parts.
            count = len(file.devices)
            keys |= {"reading_time": round(time.reading / count, 6), "quick_time": round(time.quick / count, 6)}
        if time is not None and device == drive:
            keys["setpoint_time"] = round(time.setpoint, 5)
        yield from _table(f"devices.{device}", keys)
        for signal in measured:
            described = {"name": signal.name, "unit": signal.unit, "description": signal.description}
            shown = {"precision": signal.precision} | ({"extent": signal.extent} if signal.extent else {})
            yield from _table(f"[devices.{device}.signals]", described | shown)
        if setpoint is not None:
            low, high = limits[device]
            described = {"name": setpoint.name, "unit": setpoint.unit, "description": setpoint.description}
            tolerance = {}
            if device == drive:
                noise = twin.noise[0]
                tolerance["tolerance"] = max(6.0 * noise.quick, 2.0 * noise.resolution, 1e-3 * (high - low))
            yield from _table(
                f"devices.{device}.setpoint",
                described | {"precision": setpoint.precision, "limits": [low, high]} | tolerance,
            )


def _emulation(twin: IdentifiedTwin, file: RigFile) -> Iterator[str]:
    first, found = twin.recordings[0], twin.dynamics
    actuator, response = found.actuator, found.response
    whole = {
        "step": found.step,
        "session_offset": twin.offset,
        "drift": found.drift,
        "tasks": _tasks(file, twin),
    }
    model = json.dumps(twin.model.to_json(), ensure_ascii=False, separators=(",", ":"))
    # Without the quote that ends a literal of TOML.
    text = model.replace("'", "\\u0027")
    yield from _table("emulation", {"laboratory": "twin", **whole}, TwinTable, f"model = '{text}'")
    drive = {"device": file.roles["drive"].device, "signal": first.drive, "rest": float(first.driven[0])}
    drive |= {"resolution": twin.steps, **vars(actuator), "delay": _delay(twin, file)}
    yield from _table("emulation.drive", {key: each for key, each in drive.items() if each != math.inf}, DriveTable)
    answer = {"signal": twin.source, **vars(response), "conversion": twin.conversion}
    yield from _table("emulation.response", answer, ResponseTable)
    yield from _table("emulation.wander", found.wander.model_dump(), Wander)
    yield from _table("emulation.unevenness", found.unevenness.model_dump(), Unevenness)
    for name, table in twin.signals.items():
        yield from _table(f"emulation.signals.{name}", table, NoiseTable)


def _delay(twin: IdentifiedTwin, file: RigFile) -> float:
    """Return the delay of the drive, s, from sending a set-point: without what the lines of the twin take."""
    delay, time = twin.dynamics.actuator.delay, twin.reading_time
    if time is not None:
        names = [each.name for each in file.devices]
        read_later = len(names) - 1 - names.index(file.roles["drive"].device)
        delay -= time.setpoint + time.quick * read_later / len(names)
    return max(delay, 0.0)


def _tasks(file: RigFile, twin: IdentifiedTwin) -> dict[str, str]:
    """Return what a prompt may ask for: the slots of what is set by hand, as the runs have it."""
    return {
        table.task or name: table.signal
        for name, table in file.roles.items()
        if table.signal in twin.signals and table.signal != twin.source
    }


def _table(
    name: str, keys: Mapping[str, Any], described: type[CheckedTable] | None = None, *tail: str
) -> Iterator[str]:
    """Yield the lines of a table, with what its class says of each key."""
    yield f"[{name}]"
    fields = {} if described is None else described.model_fields
    for key, value in keys.items():
        text = f"{key} = {toml_value(value)}"
        yield f"{text:<36}# {fields[key].description}" if key in fields else text
    yield from tail
    yield ""
