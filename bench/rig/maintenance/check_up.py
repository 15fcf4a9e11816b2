"""A check-up of a rig: what the instruments say of themselves beside what the rig file says of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import date
from functools import partial
from itertools import pairwise

from bench.base import (
    BenchError,
    Clock,
    DeviceConnectionError,
    DeviceError,
    counted,
    difference_unit,
    prefixed,
    wall_time,
)
from bench.devices import Actuator, CheckFinding, Device, DeviceDescription, Limits, Signal, Status
from bench.rig.calibration import Calibrated
from bench.rig.file import RigFile
from bench.rig.interlocks.config import Interlock
from bench.rig.maintenance.opening import Workplace
from bench.rig.maintenance.safe_state import SAFE, make_safe
from bench.rig.slots import RoleTable, reading_of
from bench.rig.start_checks import SHARE_AWAY, SHARE_OF_WATCHDOG, has_watchdog_key
from bench.rig.uncertainty import UncertainSignals

GLANCES, MEASUREMENTS = 20, 5
"""How many of each are taken for noise and time."""

_MUCH_NOISE = 3.0
"""Noise beyond what is typical, as a factor."""
_STEP = 0.01
"""Set-point of an exercise from the rest, as a part of the range, where the role has no increment."""
_PATIENCE = 20.0
"""Laboratory time (s) that an exercise gives a set-point to arrive."""
_NEAR = 0.1
"""Distance from the set-point that counts as having arrived, as a part of the way."""
_LOOK = 0.1
_SIGNIFICANT = 3.0
"""Change of a reading that is beyond its noise, as a factor."""


@dataclass(frozen=True)
class DeviceCheck:
    """What was found of one device, or of the rig as a whole.

    Attributes
    ----------
    device : str
        Name of the device; empty for the rig.
    identity : str
        Which instrument it is; empty if it did not say.
    findings : tuple of CheckFinding
        All of them, those without an advice as well.
    failed : bool
        Whether it could not be connected, or a reading failed.
    unsafe : bool
        Whether its safe state could not be confirmed at the end.
    """

    device: str
    identity: str
    findings: tuple[CheckFinding, ...]
    failed: bool = False
    unsafe: bool = False


def check_up(place: Workplace, exercise: bool, keep_on: Callable[[], None]) -> list[DeviceCheck]:
    """Connect every device, look at all that it says, and leave it in its safe state.

    Parameters
    ----------
    place : Workplace
        The lines of the rig.
    exercise : bool
        Whether to move each actuator that a role gives a rest.
    keep_on : callable
        Is called between two steps; what it raises ends the check-up, in the safe state.

    Returns
    -------
    list of DeviceCheck
        One a device in the order of the rig file, and one of the rig as a whole.
    """
    today = wall_time().astimezone().date()
    found = {
        entry.name: _calibration(
            entry.settings.calibrated, entry.settings.calibration_due, today, "set calibrated and calibration_due"
        )
        for entry in place.entries
    }
    identities: dict[str, str] = {}
    failed: set[str] = set()
    devices: dict[str, Device] = {}
    unsafe: set[str] = set()
    whole = [
        replace(each, subject=f"calibration of {name}")
        for name, derived in place.file.derived.items()
        if isinstance(derived, Calibrated)
        for each in _calibration(derived.calibration.date, derived.calibration.due, today, "name the new file")
    ]

    def of(name: str, check: Callable[[], Iterable[CheckFinding]]) -> None:
        keep_on()
        try:
            found[name].extend(check())
        except DeviceError as error:
            failed.add(name)
            found[name].append(_failure(error))

    try:
        for entry in place.entries:
            keep_on()
            try:
                device = entry.driver.connect(entry.name, entry.settings, place.clock)
            except BenchError as error:
                failed.add(entry.name)
                found[entry.name].append(_failure(error))
                continue
            devices[entry.name] = device
            identities[entry.name] = str(device.identity)
            place.take_instrument(device)
        ticks: dict[str, float] = {}
        for name, device in devices.items():
            of(name, device.self_check)
            of(name, partial(_readings, device, place, ticks))
            if isinstance(device, Actuator):
                of(name, partial(_limits, device, place.file.roles))
                of(name, partial(_watchdog, device, place.file))
        whole += _times(place.file, devices, ticks)
        if exercise:
            moving = _exercised(place.file.roles, devices)
            for name, device in devices.items():
                if isinstance(device, Actuator) and name not in moving:
                    found[name].append(CheckFinding("exercise", "not moved, as no role gives it a rest"))
            for name, role in moving.items():
                if name not in failed:
                    of(name, partial(_exercise, devices, name, role, place, keep_on))
    finally:
        for name, state in make_safe(devices.values()).items():
            if state != SAFE:
                unsafe.add(name)
                found[name].append(
                    CheckFinding("safe state", state, f"unplug what {name} drives, or its power supply")
                )
        for device in devices.values():
            # A line that is gone cannot be closed either.
            with suppress(Exception):
                device.close()
    checks = [
        DeviceCheck(name, identities.get(name, ""), tuple(findings), name in failed, name in unsafe)
        for name, findings in found.items()
    ]
    return [*checks, DeviceCheck("", "", tuple(whole))]


def _calibration(day: date | None, due: date | None, today: date, afterwards: str) -> list[CheckFinding]:
    """Say when something was calibrated, whether that is due again, and what to do afterwards."""
    parts = [*([f"of {day}"] if day else []), *([f"due on {due}"] if due else [])]
    if not parts:
        return []
    if day is not None and day > today:
        text = f"of {day}, after today, {today}"
        return [CheckFinding("calibration", text, "correct the date, or that of this computer")]
    if due is not None and due <= today:
        parts.append(f"{(today - due).days} days ago")
        return [CheckFinding("calibration", ", ".join(parts), f"calibrate it, then {afterwards}")]
    return [CheckFinding("calibration", ", ".join(parts))]


def _failure(error: BenchError) -> CheckFinding:
    if isinstance(error, DeviceConnectionError):
        return CheckFinding("connection", error.text, "see that it is on and connected as the rig file says")
    if isinstance(error, DeviceError):
        return CheckFinding("error", error.text, "do as it says; `bench rig clear` clears an error that it keeps")
    return CheckFinding("rig file", str(error), "correct the rig file")


def _readings(device: Device, place: Workplace, ticks: dict[str, float]) -> list[CheckFinding]:
    """Say what a device reads, how much that varies, and how long it takes; its `glance` joins `ticks`, s."""
    glances, glance_time = _repeat(device.glance, GLANCES, place.clock)
    measurements, measure_time = _repeat(device.measure, MEASUREMENTS, place.clock)
    ticks[device.name] = glance_time
    units = {signal.name: signal.unit for signal in device.signals}
    known = {name: each for name, each in place.file.uncertainty.items() if name in units}
    uncertain = UncertainSignals(known, {}, units, place.file.path)
    findings = []
    for signal in device.signals:
        quick = [values[signal.name] for values in glances]
        slow = [values[signal.name] for values in measurements]
        value, shown = math.fsum(slow) / len(slow), signal.display
        parts, advice = [], ""
        for readings, what, stated, key in (
            (
                quick,
                f"{GLANCES} quick readings",
                *_typical_noise(signal.name, place.file.roles, {device.name: device}),
            ),
            (slow, f"{MEASUREMENTS} measurements", uncertain.scatter(signal.name), f"uncertainty.{signal.name}"),
        ):
            noise = deviation(readings)
            parts.append(f"{_size(noise, signal)} of {what}")
            if stated is not None:
                parts[-1] += f" (stated: {_size(stated, signal)}, {key})"
                if noise > _MUCH_NOISE * stated:
                    advice = "look for a loose cable, a ground loop, or a load that is not at rest"
        text = f"{shown.text(value)}, noise {', '.join(parts)}"
        for lock in place.file.interlocks:
            if lock.signal == signal.name and not lock.minus and not lock.low <= value <= lock.high:
                text += f"; outside of its interlock, {shown.between(lock.low, lock.high)}"
                advice = "bring it into the range of its interlock before a run"
        findings.append(CheckFinding(signal.name, text, advice))
    text = f"{1e3 * glance_time:.3g} ms a quick reading, {1e3 * measure_time:.3g} ms a measurement"
    advice = ""
    if device.watchdog and measure_time > SHARE_OF_WATCHDOG * device.watchdog:
        text += f", {measure_time / device.watchdog:.0%} of its watchdog of {device.watchdog:g} s"
        advice = "take fewer samples in a measurement, or lengthen the watchdog"
    return [*findings, CheckFinding("time", text, advice)]


def _repeat(read: Callable[[], dict[str, float]], times: int, clock: Clock) -> tuple[list[dict[str, float]], float]:
    """Return readings, and the longest time that one took, s."""
    readings, longest = [], 0.0
    for _ in range(times):
        begin = clock.now()
        readings.append(read())
        longest = max(longest, clock.now() - begin)
    return readings, longest


def deviation(values: list[float]) -> float:
    """Return the standard deviation of values; 0 of one."""
    mean = math.fsum(values) / len(values)
    return math.sqrt(math.fsum((value - mean) ** 2 for value in values) / max(1, len(values) - 1))


def _size(noise: float, signal: Signal) -> str:
    """Return the standard deviation of readings with its unit."""
    return prefixed(noise, difference_unit(signal.unit), 3)


def _typical_noise(
    signal: str, roles: Mapping[str, RoleTable], devices: Mapping[str, Device]
) -> tuple[float | None, str]:
    """Return what the rig file says that quick readings of a signal vary by, None if nothing; and the key."""
    for name, role in roles.items():
        if role.reset is None or role.reset.noise is None:
            continue
        watched = role.reset.signal or role.signal or role.reading
        if not watched and role.device in devices:
            watched = _reading(role, devices)
        if watched == signal:
            return role.reset.noise, f"roles.{name}.reset.noise"
    return None, ""


def _reading(role: RoleTable, devices: Mapping[str, Device]) -> str:
    """Return the signal of a role whose device, if it has one, is connected."""
    known = {role.device: DeviceDescription.of(devices[role.device])} if role.device else {}
    return reading_of(role, known)


def _limits(device: Actuator, roles: Mapping[str, RoleTable]) -> list[CheckFinding]:
    """Compare the ranges of the roles with the limits of the device."""
    findings = [CheckFinding("limits", str(device.limits))]
    for name, role in roles.items():
        if role.device != device.name:
            continue
        values = {"range": role.range or (), "rest": () if role.rest is None else (role.rest,)}
        for key, each in values.items():
            beyond = [f"{value:g}" for value in each if value not in device.limits]
            if beyond:
                findings.append(
                    CheckFinding(
                        "limits",
                        f"roles.{name}.{key}: {' and '.join(beyond)} beyond {device.limits}",
                        f"correct roles.{name}.{key}, or the limits in devices.{device.name}",
                    )
                )
    return findings


def _watchdog(device: Actuator, file: RigFile) -> list[CheckFinding]:
    """Judge the watchdog that the driver declares."""
    watchdog, period = device.watchdog, file.telemetry.period
    if watchdog is None:
        if not device.heats:
            return [CheckFinding("watchdog", "none")]
        (settings,) = (entry.settings for entry in file.devices if entry.name == device.name)
        advice = (
            f"set the key watchdog of devices.{device.name}"
            if has_watchdog_key(settings)
            else "its driver has none: let the protection of the instrument limit it, and stay with the rig"
        )
        return [CheckFinding("watchdog", "none, and its output heats", advice)]
    text = f"{watchdog:g} s"
    if period > SHARE_OF_WATCHDOG * watchdog:
        return [
            CheckFinding(
                "watchdog",
                f"{text}, with {period:g} s between two readings (telemetry.period)",
                f"let telemetry.period be {SHARE_OF_WATCHDOG * watchdog:g} s at most, or lengthen the watchdog",
            )
        ]
    longest = min(file.safety.reconnect, SHARE_AWAY * watchdog)
    cut = f", as safety.reconnect = {file.safety.reconnect:g} is cut to {SHARE_AWAY:g} of it"
    return [
        CheckFinding(
            "watchdog",
            f"{text}; its line may be lost for {longest:g} s{cut if longest < file.safety.reconnect else ''}",
        )
    ]


def _times(file: RigFile, devices: Mapping[str, Device], ticks: Mapping[str, float]) -> list[CheckFinding]:
    """Compare the time of one reading of all devices with the telemetry and the shortest watchdog."""
    total, period = math.fsum(ticks.values()), file.telemetry.period
    watchdogs = [device.watchdog for device in devices.values() if device.watchdog]
    shortest = min(watchdogs, default=math.inf)
    text = f"{1e3 * total:.3g} ms a quick reading of all devices, every {period:g} s"
    if total > period:
        return [CheckFinding("time", text, "lengthen telemetry.period, or read faster (speed of the lines, samples)")]
    if total > SHARE_OF_WATCHDOG * shortest:
        return [CheckFinding("time", f"{text}; the shortest watchdog is {shortest:g} s", "lengthen the watchdog")]
    return [CheckFinding("time", text)]


def _exercised(roles: Mapping[str, RoleTable], devices: Mapping[str, Device]) -> dict[str, RoleTable]:
    """Return the actuators that have a rest, each with its role."""
    return {
        role.device: role
        for role in roles.values()
        if role.rest is not None and isinstance(devices.get(role.device), Actuator)
    }


def exercise_setpoint(role: RoleTable, limits: Limits) -> float:
    """Return a set-point near the rest of a role, within its range and the limits of its device.

    Parameters
    ----------
    role : RoleTable
        A role with a rest.
    limits : Limits
        Of its device.
    """
    assert role.rest is not None
    low, high = role.range or (limits.low, limits.high)
    low, high = max(low, limits.low), min(high, limits.high)
    step = role.increment or _STEP * (high - low)
    above = role.rest + step
    return min(max(above if above <= high else role.rest - step, low), high)


def _exercise(
    devices: Mapping[str, Device], name: str, role: RoleTable, place: Workplace, keep_on: Callable[[], None]
) -> list[CheckFinding]:
    """Set an actuator near its rest, see how its reading follows, and make it safe again."""
    device, clock = devices[name], place.clock
    assert isinstance(device, Actuator)
    signal = _reading(role, devices)
    source = next((each for each in devices.values() if signal in (s.name for s in each.signals)), None)
    if source is None:
        return [CheckFinding("exercise", f"{signal} cannot be read, so {name} was not moved", "connect its device")]
    read = next(each for each in source.signals if each.name == signal)
    quick, _ = _repeat(source.glance, GLANCES, clock)
    noise = deviation([values[signal] for values in quick])
    begin, target = _mean(quick, signal), exercise_setpoint(role, device.limits)
    # Of a reading in another unit only that it moves is known, which is looked at in the end.
    way = target - begin if read.unit == device.limits.unit else None
    near = -1.0 if way is None else max(_SIGNIFICANT * noise, _NEAR * abs(way))
    start, value = clock.now(), begin
    seen: list[dict[str, float]] = []

    def is_there() -> bool:
        return abs(value - target) <= near

    try:
        status = device.set(target)
        while not is_there() and clock.now() - start < _PATIENCE and not _has_failed(status):
            keep_on()
            clock.sleep(_LOOK)
            # Also what feeds a watchdog.
            seen.append(device.glance() | source.glance())
            value = seen[-1][signal]
        problem, seconds = status.exception(), clock.now() - start
        live, _ = _repeat(source.glance, GLANCES, clock)
    finally:
        device.safe()
    if way is None:
        value = _mean(live, signal)
    moved, on = value - begin, _spread(live, signal)
    setpoint = device.setpoint_signal.display
    part = f", {moved / way:.0%} of the way" if way else ""
    locks = [
        each for each in place.file.interlocks if not each.minus and any(each.signal in values for values in seen)
    ]
    text = (
        f"set to {setpoint.bare(target)} {setpoint.unit}: {signal} went from {read.display.text(begin)} to "
        f"{read.display.text(value)} within {seconds:.2g} s{part}; noise {_size(on, read)} then, "
        f"{_size(noise, read)} before; {counted(len(locks), 'interlock')} looked at"
    )
    if problem is not None:
        return [CheckFinding("exercise", f"{text}: {problem}", "see that the output is connected and not blocked")]
    follows = abs(moved) > _SIGNIFICANT * noise
    if way is not None:
        follows = abs(way) <= near or (follows and moved * way > 0.0)
    advice = "see that the output is connected, and the sensor on it"
    findings = [
        CheckFinding("exercise", text)
        if follows
        else CheckFinding("exercise", f"{text}, so it does not follow", advice)
    ]
    if follows and way and not is_there():
        advice = "compare its scale, calibration and limits with the rig file, or wait longer: it may be slow"
        findings.append(
            CheckFinding("scale", f"{signal} came {moved / way:.0%} of the way in {seconds:.0f} s", advice)
        )
    if is_there() and seconds > (role.dwell or math.inf):
        text = f"{signal} took {seconds:.2g} s for one increment; the dwell of its role is {role.dwell:g} s"
        findings.append(CheckFinding("settling", text, "lengthen the dwell, or compare the load of the output"))
    # Not while it is on its way.
    if is_there() and on > _MUCH_NOISE * max(noise, near / _SIGNIFICANT):
        advice = f"look for a ground loop between {name} and {source.name}, and for a shield that is open"
        findings.append(
            CheckFinding(
                "noise",
                f"{signal} varies by {_size(on, read)} while {name} is on, {_size(noise, read)} before",
                advice,
            )
        )
    return findings + _beyond(locks, seen, (*device.signals, *source.signals))


def _mean(readings: list[dict[str, float]], signal: str) -> float:
    return math.fsum(each[signal] for each in readings) / len(readings)


def _spread(readings: list[dict[str, float]], signal: str) -> float:
    """Return by how much quick readings of a signal differ from one to the next, as a standard deviation."""
    values = [each[signal] for each in readings]
    return deviation([b - a for a, b in pairwise(values)]) / math.sqrt(2)


def _beyond(
    locks: Iterable[Interlock], seen: Sequence[Mapping[str, float]], signals: Iterable[Signal]
) -> list[CheckFinding]:
    """Return the interlocks that a run would have tripped during an exercise."""
    displays = {signal.name: signal.display for signal in signals}
    found = []
    for lock in locks:
        values = [values[lock.signal] for values in seen if lock.signal in values]
        if beyond := [value for value in values if not lock.low <= value <= lock.high]:
            shown = displays[lock.signal]
            allowed = shown.between(lock.low, lock.high)
            text = f"{lock.signal} was {shown.text(beyond[0])} meanwhile, allowed is {allowed}"
            found.append(
                CheckFinding("interlock", text, "find out why, or correct the interlock, before a run trips it")
            )
    return found


def _has_failed(status: Status) -> bool:
    return status.update() and not status.success
