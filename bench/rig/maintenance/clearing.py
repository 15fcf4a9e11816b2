"""Clearing what a protection or a watchdog left in the instruments of a rig."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from bench.base import ConfigurationError, DeviceConnectionError, DeviceError, WatchdogError
from bench.devices import Device
from bench.rig.file import DeviceEntry
from bench.rig.maintenance.opening import Workplace

State = Literal["ready", "in error", "not reached", "refused"]


@dataclass(frozen=True)
class Condition:
    """How a device was found.

    Attributes
    ----------
    device : str
        Its name.
    state : {"ready", "in error", "not reached", "refused"}
        Whether it can be used; refused, if the rig file does not fit the instrument.
    meaning : str
        The instrument if it is ready; else what it reports and what to do, or why it was not reached.
    can_recover : bool
        Whether its driver can clear an error.
    """

    device: str
    state: State
    meaning: str
    can_recover: bool


def look(place: Workplace, entry: DeviceEntry) -> Condition:
    """Connect a device, switch its output off, and say how it was found; an error stays as it is."""
    return _condition(place, entry, entry.driver.connect)


def recover(place: Workplace, entry: DeviceEntry) -> Condition:
    """Clear the error of a device, configure it and leave its output off; say how it is then."""
    return _condition(place, entry, entry.driver.recover)


def _condition(place: Workplace, entry: DeviceEntry, connect: Any) -> Condition:  # noqa: ANN401 - of a driver
    can_recover = callable(getattr(entry.driver, "recover", None))

    def found(state: State, meaning: object) -> Condition:
        return Condition(entry.name, state, str(meaning), can_recover)

    try:
        device: Device = connect(entry.name, entry.settings, place.clock)
    except DeviceConnectionError as error:
        return found("not reached", error.text)
    except DeviceError as error:
        return found("in error", error.text)
    except ConfigurationError as error:
        return found("refused", error)
    try:
        place.take_instrument(device)
        device.safe()
    except DeviceError as error:
        return found("in error", error.text)
    finally:
        device.close()
    return found("ready", device.identity)


def clear_expired_watchdogs(place: Workplace) -> dict[str, str]:
    """Clear the errors that watchdogs left when their host was gone, and no others.

    Returns
    -------
    dict of str to str
        What each device reported whose error was cleared, by its name.

    Raises
    ------
    DeviceError
        If a device is in another error, or cannot be reached.
    """
    cleared: dict[str, str] = {}
    for entry in place.entries:
        try:
            entry.driver.connect(entry.name, entry.settings, place.clock).close()
        except WatchdogError as error:
            found = recover(place, entry)
            if found.state != "ready":
                raise DeviceError(entry.name, f"is {found.state}: {found.meaning}") from None
            cleared[entry.name] = error.text.partition(";")[0]
    return cleared
