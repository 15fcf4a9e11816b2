"""A line that is lost is opened again, for as long as the rig file allows."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from bench.base import Clock, DeviceConnectionError
from bench.devices import Device
from bench.rig import RigFile, line_names, port_of

TRIES = 3
"""How often all devices are read at most, when a line is lost and comes back while they are read."""

_INTERVAL = 0.2
"""Time between two attempts, s."""

_SHARE_OF_WATCHDOG = 0.6
"""Share of its watchdog's time for which an instrument may be out of reach."""


def lines_of(file: RigFile) -> dict[str, str]:
    """Return the line of each device of a rig, by the name that its lock has; one without a port has its own."""
    ports = {entry.name: port_of(entry.settings) for entry in file.devices}
    # The port itself where it is not locked: `emulated://NAME`, which may be served elsewhere.
    return {name: next(iter(line_names(port)), port or name) for name, port in ports.items()}


def longest_away(file: RigFile, devices: Mapping[str, Device]) -> dict[str, float]:
    """Return for how long the line of each device may be away, s; taken while all lines are there.

    It is `[safety] reconnect` of the rig file, or 0.6 of the shortest watchdog on the line: an actuator that shares
    it is out of reach as well, and the rest of the rig is not left on after its watchdog has expired.
    """
    lines = lines_of(file)
    longest = dict.fromkeys(lines.values(), file.safety.reconnect)
    for name, line in lines.items():
        if watchdog := devices[name].watchdog:
            longest[line] = min(longest[line], _SHARE_OF_WATCHDOG * watchdog)
    return {name: longest[line] for name, line in lines.items()}


def reconnect(
    device: Device, lost: DeviceConnectionError, clock: Clock, longest: float, given_up: Callable[[], bool]
) -> float:
    """Open the line of a device again, by one attempt after another.

    Parameters
    ----------
    device : Device
        The device, of which a request has just failed.
    lost : DeviceConnectionError
        What it failed with.
    clock : Clock
        The clock of the run.
    longest : float
        How long the line may be away, s; see `longest_away`.
    given_up : callable
        Called between two attempts; returns whether the run has ended meanwhile.

    Returns
    -------
    float
        How long the line was away, s.

    Raises
    ------
    DeviceConnectionError
        What it failed with, if the line is not back in time.
    DeviceError
        If the instrument is not as it was left, or its driver cannot open the line again.
    """
    if type(device).reconnect is Device.reconnect:
        raise lost
    start = clock.now()
    while True:
        try:
            device.reconnect()
        except DeviceConnectionError:
            if clock.now() - start >= longest or given_up() or clock.interrupted():
                raise lost from None
            clock.sleep(_INTERVAL)
        else:
            return clock.now() - start
