"""Making every instrument of a rig safe, each in whichever state it is."""

from __future__ import annotations

import threading
from dataclasses import dataclass

from bench.clock import Clock, Stopwatch
from bench.devices import Actuator
from bench.locks import port_of
from bench.rig_file import DeviceEntry
from bench.safety import SAFE
from bench.upkeep.opening import Workplace

LONGEST = 3.0
"""Wall-clock time (s) that all lines together are given."""

MEASURES_ONLY = "measures only"
"""State of a device without an output that could not be reached."""


@dataclass(frozen=True)
class Rescued:
    """What became of a device.

    Attributes
    ----------
    device : str
        Its name.
    state : str
        `safe`, `measures only`, or what went wrong.
    advice : str
        What to do; empty if nothing has to be done.
    """

    device: str
    state: str
    advice: str

    @property
    def is_safe(self) -> bool:
        """Whether the device is known to be safe."""
        return self.state in (SAFE, MEASURES_ONLY)


def rescue(place: Workplace) -> list[Rescued]:
    """Bring every device into its safe state: the lines in parallel, actuators first on each, 3 s in all.

    Returns
    -------
    list of Rescued
        One a device, in the order of the rig file. A failure of one keeps no other from being tried.
    """
    states: dict[str, str] = {}
    stopwatch = Stopwatch()
    threads = []
    for entries in place.lines.values():
        ordered = sorted(entries, key=lambda entry: not issubclass(entry.driver, Actuator))
        # A line that hangs must not keep the process from its end.
        threads.append(threading.Thread(target=_rescue_line, args=(ordered, place.make_clock(), states), daemon=True))
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(max(0.0, LONGEST - stopwatch.seconds()))
    # What is still under way may add to it.
    found = dict(states)
    return [_judged(entry, found.get(entry.name, f"not confirmed within {LONGEST:g} s")) for entry in place.entries]


def _rescue_line(entries: list[DeviceEntry], clock: Clock, states: dict[str, str]) -> None:
    for entry in entries:
        try:
            entry.driver.rescue(entry.name, entry.settings, clock)
            states[entry.name] = SAFE
        # Nothing may keep the next device from being tried, a defect of a driver included.
        except Exception as error:
            states[entry.name] = str(error).removeprefix(f"{entry.name}: ") or type(error).__name__


def _judged(entry: DeviceEntry, state: str) -> Rescued:
    if state == SAFE:
        return Rescued(entry.name, SAFE, "")
    if not issubclass(entry.driver, Actuator):
        return Rescued(entry.name, MEASURES_ONLY, "")
    port = port_of(entry.settings)
    advice = f"unplug what {entry.name} drives, or the power supply of the instrument at {port}: it may be on"
    return Rescued(entry.name, state, advice)
