"""The safe state of a rig."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from bench.base import DeviceError
from bench.devices import Device

SAFE = "safe"
"""What `make_safe` says of a device that reached its safe state."""


def raise_if_unsafe(states: Mapping[str, str]) -> None:
    """Raise DeviceError if `make_safe` says of a device that it is not in its safe state."""
    unsafe = {name: state for name, state in states.items() if state != SAFE}
    if unsafe:
        raise DeviceError(", ".join(unsafe), "; ".join(f"NOT in its safe state: {each}" for each in unsafe.values()))


def make_safe(devices: Iterable[Device]) -> dict[str, str]:
    """Bring every device into its safe state, each by itself.

    Returns
    -------
    dict of str to str
        By device name: `safe`, or what went wrong. A failure of one never keeps the next from being tried.
    """
    outcome: dict[str, str] = {}
    for device in devices:
        try:
            device.safe()
            outcome[device.name] = SAFE
        # Nothing may keep the next device from being tried, an impatient Ctrl-C included.
        except BaseException as error:
            outcome[device.name] = f"{type(error).__name__}: {error}"
    return outcome
