"""Who is at which port: each device of a rig is asked for in its own dialect, and nothing but its identity."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import serial
from pydantic import ValidationError

from bench.base import BenchError, WallClock
from bench.devices import Identity
from bench.rig import DeviceEntry, RigFile, port_of
from drivers.device import LineDevice
from drivers.finding.ports import Port
from drivers.labjack_t7.device import T7Device

_HASTE, _HASTE_IN_NETWORK = 0.15, 0.5
"""Longest wait for an answer, s. Derivation: 100 bytes at 9600 Bd take 0.1 s, and a USB adapter 16 ms."""
_EMPTY_LINE, _HEED = b"\r\n", 0.05
"""What ends whatever an instrument has received of other questions, and the wait for what it says to it, s.

Derivation: two bytes at 9600 Bd take 2 ms, and a USB adapter 16 ms, each way.
"""
_SPEEDS = (9600, 19200, 38400, 57600, 115200, 1000000)
"""Tried where nothing answers, Bd: what instruments are delivered with."""
_PARITIES = ("N", "E", "O")


@dataclass(frozen=True)
class Answer:
    """A device that answered at a port, with other settings than those of the rig file if need be."""

    device: str
    port: Port
    identity: Identity
    changed: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Placement:
    """Where a device is.

    Attributes
    ----------
    device : str
        Its name.
    answer : Answer or None
        Who answers, and where; None if it was not found, or is not told from another one.
    remark : str
        What is to be known or done; empty if it is where the rig file says.
    is_settled : bool
        Whether it was found.
    """

    device: str
    answer: Answer | None
    remark: str

    @property
    def is_settled(self) -> bool:
        """Whether it is known where it is."""
        return self.answer is not None


def askable(file: RigFile) -> list[DeviceEntry]:
    """Return the devices of a rig that have a line of their own."""
    return [each for each in file.devices if issubclass(each.driver, LineDevice) and hasattr(each.settings, "port")]


def answers(file: RigFile, ports: Sequence[Port]) -> list[Answer]:
    """Ask at every port, all at the same time, for each device of a rig in turn.

    Ports at which nothing answers are asked with other speeds and parities for the devices that were not found.
    """
    entries = [entry for entry in askable(file) if _tells_identity(entry)]
    open_ports = [port for port in ports if not port.problem]
    if not open_ports:
        return []
    with ThreadPoolExecutor(len(open_ports)) as pool:
        echoes = [*pool.map(_echoes, open_ports)]
        firsts = pool.map(lambda port, echo: _asked(entries, port, {"echo": echo}), open_ports, echoes)
        found = [each for some in firsts for each in some]
        lost = [entry for entry in entries if entry.name not in {each.device for each in found}]
        heard = [each.port for each in found]
        silent = [(port, echo) for port, echo in zip(open_ports, echoes, strict=True) if port not in heard]
        more = pool.map(lambda line: _asked_otherwise(lost, *line), silent)
        return found + [each for some in more for each in some]


def _asked(entries: Iterable[DeviceEntry], port: Port, line: Mapping[str, Any]) -> list[Answer]:
    """Ask at a port for devices, with the settings of a line instead of those of the rig file."""
    found: list[Answer] = []
    heard: list[DeviceEntry] = []
    for entry in sorted(entries, key=lambda each: port_of(each.settings) not in (port.address, port.link)):
        if port.in_network != (issubclass(entry.driver, T7Device) or port_of(entry.settings).startswith("tcp://")):
            continue
        # A line has one dialect: its equals, and those that share the line.
        if heard and not any(_may_share(entry, other) for other in heard):
            continue
        known = entry.settings.model_dump()
        changed = {key: value for key, value in line.items() if key in known and value != known[key]}
        if "identity_query" in known:
            _heed(port, known | changed)
        identity = _identity(entry, port, changed)
        if identity is not None:
            heard.append(entry)
            found.append(Answer(entry.name, port, identity, changed))
    return found


def _asked_otherwise(entries: Iterable[DeviceEntry], port: Port, echo: bool) -> list[Answer]:
    """Ask at a port with each other speed and parity that its line may have until a device answers."""
    asked = [(entry, known) for entry in entries if "baudrate" in (known := entry.settings.model_dump())]
    for parity, speed in product(_PARITIES, _SPEEDS):
        able = [
            entry
            for entry, known in asked
            if (parity == "N" or "parity" in known)
            and (parity, speed) != (known.get("parity", "N"), known["baudrate"])
        ]
        if found := _asked(able, port, {"echo": echo, "parity": parity, "baudrate": speed}):
            return found
    return []


def _echoes(port: Port) -> bool:
    """Return whether the adapter at a port echoes, which it does at any speed and parity."""
    return _heed(port, {}) == _EMPTY_LINE


def _tells_identity(entry: DeviceEntry) -> bool:
    """Return whether an instrument can be asked who it is; a text instrument may have no question for it."""
    return getattr(entry.settings, "identity_query", None) != ""


def _may_share(one: DeviceEntry, other: DeviceEntry) -> bool:
    return (
        one.driver is other.driver
        or port_of(one.settings) == port_of(other.settings)
        or (issubclass(one.driver, T7Device) and issubclass(other.driver, T7Device))
    )


def _heed(port: Port, line: Mapping[str, Any]) -> bytes:
    """Send an empty line at the speed and parity of a line, and return what comes."""
    with (
        # pyserial passes on the errors of termios.
        suppress(Exception),
        serial.serial_for_url(
            port.address,
            line.get("baudrate", _SPEEDS[0]),
            parity=line.get("parity", "N"),
            timeout=_HEED,
            write_timeout=_HASTE,
            exclusive=True,
        ) as opened,
    ):
        opened.write(_EMPTY_LINE)
        return bytes(opened.read(256))
    return b""


def _identity(entry: DeviceEntry, port: Port, changed: Mapping[str, Any]) -> Identity | None:
    haste = _HASTE_IN_NETWORK if port.in_network else _HASTE
    update = {"port": port.address, **changed}
    if (timeout := getattr(entry.settings, "timeout", None)) is not None:
        update["timeout"] = min(timeout, haste)
    try:
        settings = entry.settings.model_copy(update=update)
        identity: Identity = entry.driver.identify_at(entry.name, settings, WallClock())
    except (BenchError, ValidationError, OSError, ValueError):
        return None
    return identity


def placements(file: RigFile, found: Sequence[Answer], ports: Sequence[Port]) -> list[Placement]:
    """Return where each device is, in the order of the rig file.

    Devices with one address in the rig file share a line and are placed together. Instruments that answer alike are
    told apart by `serial_number`; what the others leave over is taken for the last one.
    """
    links = {port.link: port.address for port in ports if port.link}
    lines: dict[str, list[DeviceEntry]] = {}
    for entry in askable(file):
        line = port_of(entry.settings)
        lines.setdefault(links.get(line, line), []).append(entry)
    heard = {(each.device, each.port.address): each for each in found}
    fitting = {
        line: {
            address
            for _, address in heard
            if all((answer := heard.get((each.name, address))) and _fits(each, answer) for each in group)
        }
        for line, group in lines.items()
    }
    left, placed = dict(fitting), dict[str, str]()
    while single := [
        line
        for line, where in left.items()
        if len(where) == 1 and not any(other == where for name, other in left.items() if name != line)
    ]:
        (placed[single[0]],) = left.pop(single[0])
        left = {line: where - {placed[single[0]]} for line, where in left.items()}
    result = {}
    for line, group in lines.items():
        for entry in group:
            if line not in placed:
                alike = [
                    each.name for other in left if other != line and left[other] & left[line] for each in lines[other]
                ]
                own = [each for each in found if each.device == entry.name]
                result[entry.name] = Placement(entry.name, None, _unplaced(entry, own, fitting[line], alike))
                continue
            answer = heard[entry.name, placed[line]]
            remarks = [f"answers with {key} = {value}" for key, value in answer.changed.items()]
            if placed[line] != line:
                others = ", ".join(each.name for each in lines.get(placed[line], ()))
                remarks.insert(0, f"answers at the port of {others}" if others else f"the rig file says {line}")
            result[entry.name] = Placement(entry.name, answer, "; ".join(remarks))
    return [result[each.name] for each in askable(file)]


def _fits(entry: DeviceEntry, answer: Answer) -> bool:
    return _wanted(entry) in ("", answer.identity.serial_number.strip())


def _wanted(entry: DeviceEntry) -> str:
    return entry.settings.serial_number.strip()


def _unplaced(entry: DeviceEntry, own: Sequence[Answer], fitting: Collection[str], alike: Sequence[str]) -> str:
    """Return why a device has no place; `own` are its answers, `alike` the devices that it may be taken for."""
    if not _tells_identity(entry):
        return "cannot be asked who it is: its identity_query is empty"
    if not own:
        return "nothing answers as it would: check power, cable, address and speed"
    heard = " and ".join(f"{each.identity.serial_number} at {each.port.name}" for each in own)
    if not all(_fits(entry, each) for each in own) and not fitting:
        return f"another instrument answers, serial number {heard}; the rig file says {_wanted(entry)}"
    if not fitting or not alike:
        return f"not told from others; serial numbers: {heard}"
    return f"interchangeable with {', '.join(alike)}: write serial_number into the rig file; there are {heard}"


def keys_of(entry: DeviceEntry, answer: Answer) -> dict[tuple[str, str], dict[str, Any]]:
    """Return what a rig file has to say of a device that was found, by its tables, such as `("devices", "stage")`.

    The port of a line that it shares, and its speed, stand in the table of the line.
    """
    of_line = {"port": answer.port.name, **answer.changed}
    of_device = {}
    if answer.identity.tells_serial_number:
        of_device["serial_number"] = answer.identity.serial_number.strip()
    line = getattr(entry.settings, "line", "")
    if isinstance(line, str) and line:
        return {("lines", line): of_line, ("devices", entry.name): of_device}
    return {("devices", entry.name): of_line | of_device}
