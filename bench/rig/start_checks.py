"""Checks of a connected rig before anything moves: watchdogs, interlocks, and how often instruments are asked.

Nothing here touches a device.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from datetime import date

from bench.base import ConfigurationError, closest
from bench.devices import Actuator, Device, DeviceDescription, DriverSettings
from bench.rig.calibration import Calibrated
from bench.rig.description import RigDescription
from bench.rig.file import RigFile
from bench.rig.interlocks.config import SETPOINT, Interlock, Level
from bench.rig.maintenance.locks import line_names, port_of
from bench.rig.shared_lines import BLIND

SHARE_OF_WATCHDOG = 0.4
"""Longest silence of the host on purpose, as a share of the shortest watchdog: one late answer may double it."""


SHARE_AWAY = 0.6
"""Share of its watchdog's time for which an instrument may be out of reach."""


def lines_of(file: RigFile) -> dict[str, str]:
    """Return the line of each device of a rig, by the name that its lock has; one without a port has its own."""
    ports = {entry.name: port_of(entry.settings) for entry in file.devices}
    # The port itself where it is not locked: `emulated://NAME`, which may be served elsewhere.
    return {name: next(iter(line_names(port)), port or name) for name, port in ports.items()}


@dataclass(frozen=True)
class LongestAbsence:
    """For how long the line of a device may be lost.

    Attributes
    ----------
    seconds : float
        That time, s.
    reason : str
        Why it is not `[safety] reconnect`; empty if it is.
    """

    seconds: float
    reason: str = ""

    def __str__(self) -> str:
        return f"{self.seconds:g} s{self.reason and f' at most, {self.reason}'}"


def longest_away(
    file: RigFile, devices: Mapping[str, Device | DeviceDescription], looked_at: Collection[str] = ()
) -> dict[str, LongestAbsence]:
    """Return for how long the line of each device may be lost; taken while all lines are there.

    It is `[safety] reconnect` of the rig file, or 0.6 of the shortest watchdog on the line: an actuator that shares
    it is out of reach as well, and the rest of the rig is not left on after its watchdog has expired. Where a
    guardian looks at interlocks, it is `BLIND` at most for the devices `looked_at`, which the interlocks need.
    """
    lines = lines_of(file)
    longest = dict.fromkeys(lines.values(), LongestAbsence(file.safety.reconnect))
    for name, line in lines.items():
        watchdog = devices[name].watchdog
        if watchdog and SHARE_AWAY * watchdog < longest[line].seconds:
            reason = f"{SHARE_AWAY:g} of the watchdog of {name}, {watchdog:g} s"
            longest[line] = LongestAbsence(SHARE_AWAY * watchdog, reason)
    blind = LongestAbsence(BLIND, "as an interlock needs its readings")
    return {
        name: blind if name in looked_at and longest[line].seconds > BLIND else longest[line]
        for name, line in lines.items()
    }


def shortened_absences(rig: RigDescription, *, guarded: bool) -> tuple[str, ...]:
    """Say for which devices `[safety] reconnect` is cut short, and by what.

    Parameters
    ----------
    rig : RigDescription
        What was found when it was connected.
    guarded : bool
        Whether a guardian looks at the interlocks.
    """
    looked_at: set[str] = set()
    if guarded:
        needed = _origins(rig, [name for each in rig.file.interlocks for name in (each.signal, each.minus)])
        looked_at = {name for name, each in rig.devices.items() if needed & {signal.name for signal in each.signals}}
    names: dict[str, list[str]] = {}
    for name, longest in longest_away(rig.file, rig.devices, looked_at).items():
        if longest.reason:
            names.setdefault(str(longest), []).append(name)
    reconnect = rig.file.safety.reconnect
    return tuple(
        f"safety.reconnect = {reconnect:g}: the line of {', '.join(each)} may be lost for {longest}"
        for longest, each in names.items()
    )


def check_start(rig: RigDescription, *, interval: float, interval_key: str) -> tuple[str, ...]:
    """Check that a rig can be left to itself.

    Parameters
    ----------
    rig : RigDescription
        What was found when it was connected.
    interval : float
        Longest time between two requests to each instrument, s: the telemetry period, or that between two looks at
        the interlocks, where these feed the watchdogs.
    interval_key : str
        Key of the rig file from which the interval comes, for messages.

    Returns
    -------
    tuple of str
        Warnings: what is accepted only since an operator is present (`safety.unattended = false`).

    Raises
    ------
    ConfigurationError
        If the instruments are asked less often than their watchdogs need, a device that heats has no watchdog or no
        interlock, or an interlock does not fit its signals; one line each.
    """
    file = rig.file
    wrong = [*_wrong_intervals(rig, interval, interval_key)]
    for i, interlock in enumerate(file.interlocks):
        wrong.extend(f"interlocks.{i}.{problem}" for problem in _wrong_interlock(interlock, rig))
    unguarded = [*_unguarded(rig)]
    if file.safety.unattended:
        wrong.extend(f"{problem}, or safety.unattended = false if an operator is present" for problem in unguarded)
    if wrong:
        raise ConfigurationError("\n".join(f"{file.path}: {problem}" for problem in wrong))
    accepted = (f"{problem}; accepted, as safety.unattended = false" for problem in unguarded)
    return tuple(f"{file.path}: {warning}" for warning in accepted)


def calibration_warnings(file: RigFile, today: date) -> tuple[str, ...]:
    """Return a warning for each calibration of a device or signal that is due by a day, or dated after it."""
    stated = [
        (f"devices.{each.name}: its calibration", each.settings.calibrated, each.settings.calibration_due)
        for each in file.devices
    ]
    for name, of in file.derived.items():
        if isinstance(of, Calibrated):
            known = of.calibration
            what = f"derived.{name}: the calibration of {of.source} by {known.reference}"
            stated.append((what, known.date, known.due))
    warnings = []
    for what, day, due in stated:
        if day is not None and day > today:
            warnings.append(
                f"{what} is dated {day}, after today, {today}; correct that, or the clock of the computer"
            )
        elif due is not None and due <= today:
            warnings.append(f"{what} was due on {due}; calibrate it, and state the new dates")
    return tuple(f"{file.path}: {warning}" for warning in warnings)


def _wrong_intervals(rig: RigDescription, interval: float, interval_key: str) -> Iterable[str]:
    guarded = [(device.watchdog, device.name) for device in rig.devices.values() if device.watchdog]
    if not guarded:
        return
    watchdog, name = min(guarded)
    allowed = SHARE_OF_WATCHDOG * watchdog
    # Products of rounded numbers: 0.4 * 5 s are 2 s.
    if interval > allowed * (1.0 + 1e-9):
        yield (
            f"{interval_key}: instruments are asked each {interval:g} s only, but {name} goes to its safe state "
            f"after {watchdog:g} s of silence; {allowed:g} s, {SHARE_OF_WATCHDOG:g} of its watchdog, is allowed at "
            "most"
        )


def _wrong_interlock(interlock: Interlock, rig: RigDescription) -> Iterable[str]:
    units = {name: signal.unit for name, signal in rig.by_name.items()}
    for key, signal in (("signal", interlock.signal), ("minus", interlock.minus)):
        if signal and signal not in units:
            yield f"{key} = {signal!r}: there is no such signal; {closest(signal, units)}"
    unit, other = units.get(interlock.signal), units.get(interlock.minus)
    if interlock.minus and unit is not None and other is not None and unit != other:
        yield f"minus = {interlock.minus!r}: it is in {other} and {interlock.signal} in {unit}; expected one unit"
    meant = {unit, "K"} if interlock.minus and unit == "°C" else {unit}
    if interlock.unit and unit is not None and interlock.unit not in meant:
        yield f"unit = {interlock.unit!r}: {interlock.label} is in {' or '.join(sorted(map(str, meant)))}"
    limits = rig.limits
    if interlock.setpoint and interlock.setpoint not in limits:
        yield (
            f"setpoint = {interlock.setpoint!r}: there is no such device that takes a set-point; "
            f"{closest(interlock.setpoint, limits)}"
        )
    moving = limits.get(interlock.setpoint)
    if interlock.stuck is not None and moving is not None and interlock.stuck.moved > moving.high - moving.low:
        yield f"stuck.moved = {interlock.stuck.moved:g}: {interlock.setpoint} takes {moving}, so that it never acts"
    device = interlock.signal.removesuffix(SETPOINT)
    if device == interlock.signal or device not in limits or interlock.minus:
        return
    for key, limit in (("low", interlock.low), ("high", interlock.high)):
        if math.isfinite(limit) and limit not in limits[device]:
            yield f"{key} = {limit:g}: {device} takes {limits[device]}, so that it never acts"


def _unguarded(rig: RigDescription) -> Iterable[str]:
    with_key = {entry.name for entry in rig.file.devices if has_watchdog_key(entry.settings)}
    ending = [each for each in rig.file.interlocks if each.level in (Level.SAFE, Level.HOLD) and each.limits_values]
    for device in rig.devices.values():
        if not _heats(device):
            continue
        if not device.watchdog:
            yield (
                f"devices.{device.name}: it heats and has no watchdog, so that it goes on when its host is gone; "
                f"expected {'its key watchdog' if device.name in with_key else 'a driver that has one'}"
            )
        measured = {signal.name for signal in device.signals}
        if not any(
            each.setpoint == device.name or measured & _origins(rig, (each.signal, each.minus)) for each in ending
        ):
            yield (
                f"devices.{device.name}: it heats, and no interlock of level safe or hold limits it; expected one on "
                f"{', '.join(sorted(measured))} or a signal derived from them, or with setpoint = {device.name!r}"
            )


def has_watchdog_key(settings: DriverSettings) -> bool:
    """Return whether the driver of a device has a watchdog that the rig file can set."""
    return "watchdog" in type(settings).model_fields


def _heats(device: DeviceDescription) -> bool:
    return issubclass(device.kind, Actuator) and device.kind.heats


def _origins(rig: RigDescription, names: Iterable[str]) -> set[str]:
    """Return signals, and all those that the derived ones among them come from."""
    found: set[str] = set()
    waiting = [*names]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting.extend(rig.file.derived[name].sources if name in rig.file.derived else ())
    return found
