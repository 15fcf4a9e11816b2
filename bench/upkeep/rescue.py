"""Making every instrument of a rig safe, each in whichever state it is."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from bench.clock import Clock, Stopwatch
from bench.devices import Actuator
from bench.locks import port_of
from bench.parsing import parse_json
from bench.rig_file import DeviceEntry
from bench.safety import SAFE
from bench.upkeep.opening import Workplace

LONGEST = 3.0
"""Wall-clock time (s) that all lines together are given."""

_LONGEST_RESCUE = 30.0
"""Wall-clock time (s) for a process of its own that does it, its start included."""

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


def rescue_by_another_process(
    rig: str, overrides: Mapping[str, str], endpoints: Path | None, devices: Iterable[str]
) -> dict[str, str]:
    """Make the devices of a rig safe by `bench safe --force`, for a process that opens no line itself.

    Parameters
    ----------
    rig, overrides, endpoints
        As for `bench.upkeep.opening.opened`.
    devices : iterable of str
        Names of the devices of the rig.

    Returns
    -------
    dict of str to str
        By device name: `safe`, or what went wrong; the same of all if the process itself failed.
    """
    with TemporaryDirectory(prefix="bench-safe-") as folder:
        result = Path(folder) / "result.json"
        command = [sys.executable, "-P", "-m", "bench", "safe", rig, "--force", "--json", str(result)]
        command += [f"--override={key}={value}" for key, value in overrides.items()]
        command += [] if endpoints is None else ["--attach", str(endpoints)]
        # The modules of the rig have to be found as here.
        path = os.pathsep.join(entry for entry in sys.path if entry)
        try:
            ended = subprocess.run(  # noqa: S603 - this interpreter
                command,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                env={**os.environ, "PYTHONPATH": path},
                start_new_session=True,
                timeout=_LONGEST_RESCUE,
                check=False,
            )
            if not result.exists():
                reason = f"`bench safe` ended with exit code {ended.returncode}: {ended.stderr.strip()}"
                return dict.fromkeys(devices, reason)
            content = parse_json(result.read_text(encoding="utf-8"))
        except (OSError, ValueError, subprocess.SubprocessError) as error:
            return dict.fromkeys(devices, f"`bench safe` failed: {error}")
    return {name: SAFE if each["is_safe"] else each["state"] for name, each in content.items()}


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
