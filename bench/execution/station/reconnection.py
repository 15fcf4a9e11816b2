"""A line that is lost is opened again, for as long as the rig file allows."""

from __future__ import annotations

from collections.abc import Callable

from bench.base import Clock, DeviceConnectionError
from bench.devices import Device

TRIES = 3
"""How often all devices are read at most, when a line is lost and comes back while they are read."""

_INTERVAL = 0.2
"""Time between two attempts, s."""


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
        What it failed with, if the line is not back in time; it says how long that was.
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
            if clock.now() - start >= longest:
                text = str(lost).removeprefix(f"{lost.device}: ")
                raise DeviceConnectionError(lost.device, f"{text}; it was not back within {longest:g} s") from None
            if given_up() or clock.interrupted():
                raise lost from None
            clock.sleep(_INTERVAL)
        else:
            return clock.now() - start
