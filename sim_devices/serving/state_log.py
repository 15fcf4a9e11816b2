"""The log of true values: a line of JSON each period of laboratory time, at each change of an output, and a fault."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from typing import Any

from bench.base import ConfigurationError, json_text
from sim_devices.serving.control import values_to_json
from sim_devices.serving.served import ServedLaboratory


class StateLog:
    """Appends `{"rig": …, "time": …, "timestamp": …, "values": {NAME: {"value": …, "unit": …}}}` to a file.

    A fault is a line `{"rig": …, "time": …, "timestamp": …, "fault": NAME, "what": "begins" or "ends", "values": …}`.

    Parameters
    ----------
    path : Path
        The file; it is made, or continued.
    period : float
        Laboratory time between two lines of a rig, s; positive.

    Raises
    ------
    ConfigurationError
        If the file cannot be opened.
    """

    def __init__(self, path: Path, period: float) -> None:
        self._period = period
        self._due: dict[str, float] = {}
        self._events: dict[str, int] = {}
        self._outputs: dict[str, dict[str, float]] = {}
        try:
            # Line by line, so that who reads along sees each at once.
            self._file = path.open("a", encoding="utf-8", buffering=1)
        except OSError as error:
            raise ConfigurationError(f"--state {path} cannot be opened: {error.strerror}") from None

    def look_at(self, served: ServedLaboratory) -> None:
        """Write the faults since the last look; then a line if the period is over, or an output has changed."""
        events = served.laboratory.events
        for event in events[self._events.get(served.name, 0) :]:
            instant = (served.clock.epoch + timedelta(seconds=event.time)).timestamp()
            self._write({"rig": served.name, "timestamp": instant, **event.to_json()})
        self._events[served.name] = len(events)
        now, truth = served.clock.now(), served.truth()
        outputs = {name: each.value for name, each in truth.items() if each.is_output}
        due = self._due.get(served.name, now)
        if now < due and outputs == self._outputs.get(served.name):
            return
        self._outputs[served.name] = outputs
        if now >= due:
            self._due[served.name] = max(due + self._period, now)
        line = {
            "rig": served.name,
            "time": now,
            "timestamp": served.clock.timestamp(),
            "values": values_to_json(truth),
        }
        self._write(line)

    def _write(self, line: dict[str, Any]) -> None:
        self._file.write(json_text(line) + "\n")

    def close(self) -> None:
        """Close the file."""
        self._file.close()
