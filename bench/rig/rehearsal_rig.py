"""The emulated twin of a rig, on which its runs are rehearsed.

An emulated rig is its own twin. A rig of real instruments names one in its file (`[rig] twin`), or has that which it
extends. The twin gives the instruments and the plant behind them. Everything that a run is judged by comes from the
rig itself: slots, defaults of protocols, derived signals, interlocks, telemetry, and the limits of each device.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from bench.base import ConfigurationError
from bench.rig.file import RigFile, load_rig, rig_of

_JUDGED = ("roles", "protocols", "derived", "interlocks", "telemetry", "safety")
"""Tables that are the rig's own."""

_LIMITS = ("limit", "limits")
"""Last words of the keys of a device that are limits."""


def twin_of(file: RigFile, name: str) -> RigFile | None:
    """Return the emulated twin of a rig, None if it has none.

    Parameters
    ----------
    file : RigFile
        The rig of a run.
    name : str
        Its name, or the path of its file.

    Raises
    ------
    ConfigurationError
        If the file names a twin that is not there or not emulated, or one whose slots differ.
    """
    if file.in_process:
        return file
    base = _base(file, name)
    if base is None:
        return None
    _check_slots(file, base)
    content = {**base.content, **{key: file.content[key] for key in _JUDGED if key in file.content}}
    if file.emulated:
        content["emulation"] = file.content["emulation"]
    content["devices"] = {
        device: _with_limits(table, file.content["devices"].get(device, {}))
        for device, table in base.content["devices"].items()
    }
    _leave_out(content, set(file.content["devices"]) - set(content["devices"]))
    # What is drawn plays no part, and may name signals that are not there.
    content.pop("dashboard", None)
    return replace(rig_of(f"{base.path}, the twin of {file.path}", content), name=base.name)


def _base(file: RigFile, name: str) -> RigFile | None:
    """Return the rig that emulates another."""
    if file.rig.twin:
        base = load_rig(file.rig.twin)
        if not base.in_process:
            raise ConfigurationError(
                f"{file.path}: rig.twin = {file.rig.twin!r}: expected an emulated rig, and that one has "
                + ("real ports" if base.emulated else "no [emulation]")
            )
        return base
    # An emulated rig with the port of a real instrument is that without it.
    for candidate in (name, *file.bases):
        if (base := load_rig(candidate)).in_process:
            return base
    return None


def _check_slots(file: RigFile, base: RigFile) -> None:
    for name, role in file.roles.items():
        other = base.roles.get(name)
        for key in ("device", "signal", "reading", "unit"):
            ours, theirs = getattr(role, key), getattr(other, key, None)
            if ours and theirs and ours != theirs:
                raise ConfigurationError(
                    f"{file.path}: roles.{name}.{key} = {ours!r}, and the twin {base.path} has {theirs!r}; "
                    "expected the same, so that a rehearsal means what the run does"
                )


def _with_limits(twin: Mapping[str, Any], rig: Mapping[str, Any]) -> dict[str, Any]:
    """Return the table of a device of the twin with the limits of the rig's, at any depth."""
    merged = dict(twin)
    for key, value in rig.items():
        if key.rpartition("_")[2] in _LIMITS:
            # A driver of another kind may have other keys.
            if key in twin or twin.get("driver") == rig.get("driver"):
                merged[key] = value
        elif isinstance(value, Mapping) and isinstance(twin.get(key), Mapping):
            merged[key] = _with_limits(twin[key], value)
    return merged


def _leave_out(content: dict[str, Any], absent: set[str]) -> None:
    """Leave out what belongs to devices that the twin lacks: slots, derived signals, interlocks, uncertainties."""
    if not absent:
        return
    # A derived signal may come from one above it.
    gone = set(absent)
    derived = content.get("derived", {})
    for name, table in derived.items():
        if _names(table, gone):
            gone.add(name)
    content["derived"] = {name: table for name, table in derived.items() if name not in gone}
    roles = content.get("roles", {})
    content["roles"] = {name: table for name, table in roles.items() if not _names(table, gone)}
    content["interlocks"] = [table for table in content.get("interlocks", []) if not _names(table, gone)]
    stated = content.get("uncertainty", {})
    content["uncertainty"] = {name: table for name, table in stated.items() if not _names({"signal": name}, gone)}
    order = content.get("safety", {}).get("order", [])
    content["safety"] = {**content.get("safety", {}), "order": [each for each in order if each not in absent]}


def _names(table: Mapping[str, Any], gone: set[str]) -> bool:
    """Return whether a table names a device or a signal that is gone, or a signal of such a device."""
    words = {word for each in table.values() if isinstance(each, str) for word in re.findall(r"\w+", each)}
    return any(word == name or word.startswith(f"{name}_") for word in words for name in gone)
