"""Lines that several devices share: `[lines.NAME]` of a rig file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from bench.base import closest

if TYPE_CHECKING:
    from bench.rig.file import DeviceEntry

BLIND = 2.0
"""Time for which what the interlocks need may not be seen, s; a request that is carried out counts as seen."""

LONGEST_TURN = 0.75 * BLIND
"""Longest time for which a device that is silent may keep its line from the others, s.

Derivation: its neighbours are seen in time after it, with a quarter of that time for the looks themselves.
"""


def with_line(
    device: str, table: Mapping[str, Any], lines: Mapping[str, Mapping[str, Any]], found: list[str]
) -> dict[str, Any]:
    """Return the table of a device with the keys of the line that it names; problems go to `found`."""
    name = table.get("line")
    # Of a driver of another kind it may be a number.
    if not isinstance(name, str):
        return dict(table)
    if name not in lines:
        known = closest(name, lines) if lines else "the rig has no [lines.NAME]"
        found.append(f"devices.{device}.line = {name!r}: there is no such line; {known}")
        return dict(table)
    found.extend(
        f"devices.{device}.{key} = {table[key]!r}: stands in lines.{name} as well, as {value!r}; give it once"
        for key, value in lines[name].items()
        if key in table
    )
    return {**lines[name], **table}


def wrong_lines(
    entries: Sequence[DeviceEntry], lines: Mapping[str, Mapping[str, Any]], interval: float = 0.0
) -> list[str]:
    """Return what is wrong with the lines that devices share: one message a problem.

    Each device needs an address that no other on its line has, what is of the line has one value for all, and a
    device that falls silent may not keep the others waiting for longer than `LONGEST_TURN`, nor for longer than
    `BLIND` together with the `interval` between two looks at the interlocks, s.
    """
    found = []
    for name, keys in lines.items():
        sharing = [entry for entry in entries if getattr(entry.settings, "line", "") == name]
        taken: dict[object, str] = {}
        for entry in sharing:
            settings, where = entry.settings, f"devices.{entry.name}"
            key = settings.address_key
            address = getattr(settings, key, None)
            if address in (None, ""):
                found.append(
                    f"{where}.line = {name!r}: {f'needs the key {key}' if key else 'its driver knows no address'}, "
                    "by which its instrument is told from others on the line"
                )
            elif address in taken:
                found.append(
                    f"{where}.{key} = {address!r}: devices.{taken[address]} has this address on line {name} already"
                )
            else:
                taken[address] = entry.name
            turn, allowed = settings.longest_turn, min(LONGEST_TURN, BLIND - interval)
            if turn > allowed:
                timeout = getattr(settings, "timeout", turn)
                rate = f" with safety.rate = {1.0 / interval:g}" if allowed < LONGEST_TURN else ""
                advice = (
                    f"a timeout of {timeout * allowed / turn:.3g} s at most"
                    if allowed > 0.0
                    else f"a safety.rate of {1.0 / (BLIND - LONGEST_TURN):g} Hz at least"
                )
                key = f"{f'lines.{name}' if 'timeout' in keys else where}.timeout"
                found.append(
                    f"{key} = {timeout:g}: when {entry.name} falls silent, the others on line {name} are not "
                    f"asked for {turn:.3g} s; allowed are {max(allowed, 0.0):.3g} s{rate}, so {advice}"
                )
        for key in sorted(set().union(*(entry.settings.keys_of_line for entry in sharing))):
            given = {e.name: getattr(e.settings, key) for e in sharing if key in type(e.settings).model_fields}
            if len(set(given.values())) > 1:
                each = ", ".join(f"{value!r} for {device}" for device, value in given.items())
                found.append(f"lines.{name}.{key}: one value is expected for all devices of the line, not {each}")
        port = str(keys.get("port", ""))
        for entry in entries:
            if port and getattr(entry.settings, "port", "") == port and entry not in sharing:
                found.append(
                    f"devices.{entry.name}.port = {port!r}: is that of lines.{name}; expected line = {name!r}"
                )
        if not sharing:
            found.append(f"lines.{name}: no device is on it; expected line = {name!r} in those that share it")
    return [*dict.fromkeys(found)]
