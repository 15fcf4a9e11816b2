"""Checks of a connected rig before anything moves: watchdogs, interlocks, and how often instruments are asked.

Nothing here touches a device: what is checked is described by `DeviceDescription`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from bench.devices import Actuator, Device, Limits
from bench.errors import ConfigurationError
from bench.interlocks import SETPOINT, Interlock, Level
from bench.rig_file import RigFile

SHARE_OF_WATCHDOG = 0.4
"""Longest silence of the host on purpose, as a share of the shortest watchdog: one late answer may double it."""


@dataclass(frozen=True)
class DeviceDescription:
    """What the checks have to know of a connected device.

    Attributes
    ----------
    name : str
        Its name in the rig.
    signals : tuple of str
        Names of the signals that it measures.
    limits : Limits or None
        Set-points that it takes; None if it takes none.
    watchdog : float or None
        Silence after which its instrument goes to its safe state by itself, s; None or 0 if it never does.
    heats : bool
        Whether its output heats.
    longest_measurement : float
        Longest time between two requests during one of its measurements, s; 0 if it is not known.
    """

    name: str
    signals: tuple[str, ...]
    limits: Limits | None = None
    watchdog: float | None = None
    heats: bool = False
    longest_measurement: float = 0.0

    @classmethod
    def of(cls, device: Device, longest_measurement: float = 0.0) -> DeviceDescription:
        """Describe a connected device."""
        actuator = device if isinstance(device, Actuator) else None
        return cls(
            name=device.name,
            signals=tuple(signal.name for signal in device.signals),
            limits=None if actuator is None else actuator.limits,
            watchdog=device.watchdog,
            heats=actuator is not None and actuator.heats,
            longest_measurement=longest_measurement,
        )


@dataclass(frozen=True)
class RigDescription:
    """What the checks have to know of a connected rig.

    Attributes
    ----------
    devices : tuple of DeviceDescription
        Its devices.
    units : mapping of str to str
        Unit by name of signal: of devices, their set-points and derived ones.
    sources : mapping of str to tuple of str
        Signals that a derived signal is computed from, by its name.
    """

    devices: tuple[DeviceDescription, ...]
    units: Mapping[str, str]
    sources: Mapping[str, Sequence[str]]

    def origins(self, names: Iterable[str]) -> set[str]:
        """Return signals, and all those that the derived ones among them come from."""
        found: set[str] = set()
        waiting = [name for name in names if name]
        while waiting:
            name = waiting.pop()
            if name not in found:
                found.add(name)
                waiting.extend(self.sources.get(name, ()))
        return found


def check_start(file: RigFile, rig: RigDescription, *, interval: float, interval_key: str) -> tuple[str, ...]:
    """Check that a rig can be left to itself.

    Parameters
    ----------
    file : RigFile
        Its file.
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
    wrong = [*_wrong_intervals(rig.devices, interval, interval_key)]
    for i, interlock in enumerate(file.interlocks):
        wrong.extend(f"interlocks.{i}.{problem}" for problem in _wrong_interlock(interlock, rig))
    unguarded = [*_unguarded(file.interlocks, rig)]
    if file.safety.unattended:
        wrong.extend(f"{problem}, or safety.unattended = false if an operator is present" for problem in unguarded)
    if wrong:
        raise ConfigurationError("\n".join(f"{file.path}: {problem}" for problem in wrong))
    return tuple(f"{file.path}: {problem}; accepted, as safety.unattended = false" for problem in unguarded)


def _wrong_intervals(devices: Sequence[DeviceDescription], interval: float, interval_key: str) -> Iterable[str]:
    guarded = [(device.watchdog, device.name) for device in devices if device.watchdog]
    if not guarded:
        return
    watchdog, name = min(guarded)
    allowed = SHARE_OF_WATCHDOG * watchdog
    why = (
        f"{name} goes to its safe state after {watchdog:g} s of silence; {allowed:g} s, {SHARE_OF_WATCHDOG:g} of its "
        "watchdog, is allowed at most"
    )
    # Products of rounded numbers: 0.4 * 5 s are 2 s.
    if interval > allowed * (1.0 + 1e-9):
        yield f"{interval_key}: instruments are asked each {interval:g} s only, but {why}"
    for device in devices:
        if device.longest_measurement > allowed * (1.0 + 1e-9):
            yield f"devices.{device.name}: a measurement takes {device.longest_measurement:.3g} s, but {why}"


def _wrong_interlock(interlock: Interlock, rig: RigDescription) -> Iterable[str]:
    units = rig.units
    for key, signal in (("signal", interlock.signal), ("minus", interlock.minus)):
        if signal and signal not in units:
            yield f"{key} = {signal!r}: there is no such signal; there are: {', '.join(units)}"
    unit, other = units.get(interlock.signal), units.get(interlock.minus)
    if interlock.minus and unit is not None and other is not None and unit != other:
        yield f"minus = {interlock.minus!r}: it is in {other} and {interlock.signal} in {unit}; expected one unit"
    meant = {unit, "K"} if interlock.minus and unit == "°C" else {unit}
    if interlock.unit and unit is not None and interlock.unit not in meant:
        yield f"unit = {interlock.unit!r}: {interlock.label} is in {' or '.join(sorted(map(str, meant)))}"
    limits = {device.name: device.limits for device in rig.devices if device.limits is not None}
    if interlock.setpoint and interlock.setpoint not in limits:
        yield (
            f"setpoint = {interlock.setpoint!r}: there is no such device that takes a set-point; "
            f"there are: {', '.join(limits) or 'none'}"
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


def _unguarded(interlocks: Sequence[Interlock], rig: RigDescription) -> Iterable[str]:
    ending = [each for each in interlocks if each.level in (Level.SAFE, Level.HOLD) and each.limits_values]
    for device in rig.devices:
        if not device.heats:
            continue
        if not device.watchdog:
            yield (
                f"devices.{device.name}: it heats and has no watchdog, so that it goes on when its host is gone; "
                "expected a watchdog"
            )
        measured = set(device.signals)
        if not any(
            interlock.setpoint == device.name or measured & rig.origins((interlock.signal, interlock.minus))
            for interlock in ending
        ):
            yield (
                f"devices.{device.name}: it heats, and no interlock of level safe or hold limits it; expected one on "
                f"{', '.join(device.signals)} or a signal derived from them, or with setpoint = {device.name!r}"
            )
