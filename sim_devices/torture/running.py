"""Runs with one fault each, and the verdict of the emulated instruments and the plant on them."""

from __future__ import annotations

import faulthandler
import io
import sys
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich.console import Console

from bench.base import BenchError, ConfigurationError, PlainConsole, VirtualClock, Workers, json_text
from bench.devices import Actuator
from bench.execution import Run, carry_out
from bench.protocol import ProtocolDefinition
from bench.record import Record
from bench.rig import EMULATED, JOIN, Rig, RigDescription, RigFile, TelemetryTable, load_rig
from sim_devices.faults.fault import Fault
from sim_devices.laboratory import EmulatedLaboratory
from sim_devices.torture.excursion import COUNT, DWELL, excursion, setpoints
from sim_devices.torture.truth import Observed, Reference
from sim_devices.transducers.specimens import SensorSettings

CHECKS = ("ends", "safe", "limits", "names", "rows", "true")
PASSED = ("ok", ".", "w")

_FIRST, _LAST = 4.0, 28.0
"""Between which a fault begins, s from the start of the run: while the rig is moved."""
_DURATION = 5.0
"""Of a fault that has an end, s."""
_DELAYS = (0.05, 0.12, 0.25, 0.6, 1.2)
"""By which answers are late, by seed, s: shorter and longer than the time-outs of drivers."""
_PERIOD = 0.5
"""Of the telemetry, s, where the rig has a longer one: several readings in each step."""
_MARGIN = 50.0
"""Laboratory time that a run may take beyond its plan and the time for which a line may be lost, s."""
_WATCHDOG_MARGIN = 5.0
"""Time after which the watchdogs have made every output safe, beyond the longest of them, s."""
_LONGEST = 300.0
"""Wall-clock time after which a run hangs, s."""
_REFERENCES = 3
"""Runs without a fault at least, from which the noise of each signal is known."""
_LEAST_SHARE = 0.01
"""Of the range, below which an excursion is of no use."""
_NEAR = 0.01
"""Excess over a limit that is allowed, as a part of it, beside what the signal may be off."""


@dataclass(frozen=True)
class Task:
    """What is tortured, and how far it is moved."""

    rig: str
    overrides: Mapping[str, str]
    share: float = 1.0


@dataclass(frozen=True)
class Cell:
    """One run with a fault, judged.

    Attributes
    ----------
    device : str
        Devices at the instrument at fault; empty of a fault of the plant.
    fault : str
        Its name.
    seed : int
        Of the run.
    status, reason : str
        How the run ended.
    results : mapping of str to str
        By check `ok`, `.` (does not apply), `w` (safe by the watchdogs), or what is wrong.
    """

    device: str
    fault: str
    seed: int
    status: str
    reason: str
    results: Mapping[str, str] = field(default_factory=dict)

    @property
    def failures(self) -> list[str]:
        """The checks that failed."""
        return [check for check, result in self.results.items() if result not in PASSED]


@dataclass(frozen=True)
class Bed:
    """A rig with its observed laboratory, what it is taken through, and its outputs in the safe state."""

    file: RigFile
    description: RigDescription
    observed: Observed
    protocol: ProtocolDefinition
    rest: Mapping[str, float]

    @classmethod
    def of(cls, task: Task) -> Bed:
        """Read the rig of a task, and connect it once to know its limits.

        Raises ConfigurationError if it has no laboratory with faults.
        """
        file = load_rig(task.rig, task.overrides)
        if not (isinstance(file.laboratory, type) and issubclass(file.laboratory, EmulatedLaboratory)):
            raise ConfigurationError(
                f"rig {file.name} has no emulated laboratory with faults: [emulation] laboratory names none that "
                "extends sim_devices.laboratory.EmulatedLaboratory"
            )
        if not file.in_process:
            raise ConfigurationError(f"rig {file.name} has devices that are not emulated; expected ports {EMULATED}…")
        if issubclass(file.laboratory.Settings, SensorSettings):
            # What is compared with the truth is what faults do, not what a sensor is off by.
            file = load_rig(task.rig, {"emulation.sensors": "ideal", **task.overrides})
        observed = Observed(file.laboratory)
        period = min(file.telemetry.period, _PERIOD)
        file = replace(file, laboratory=observed, telemetry=TelemetryTable(period=period))
        with Rig(file, VirtualClock(), 0) as rig:
            description = rig.description
        return cls(file, description, observed, excursion(setpoints(description, task.share)), observed.outputs())

    @property
    def faults(self) -> Mapping[str, Fault]:
        """What can go wrong in its laboratory, by name."""
        return self.observed.laboratory.faults

    def run(self, seed: int, folder: Path, faults: Path | None = None) -> Any:  # noqa: ANN401 - a private class
        """Carry the excursion out; return its outcome."""
        run = Run(
            self.protocol, {}, self.file.name, folder, seed=seed, clock="virtual", recording=False, faults=faults,
            rig_file=self.file,
        )  # fmt: skip
        return carry_out(run, PlainConsole(file=io.StringIO(), width=200)).outcome

    def devices_at(self, fault: str) -> list[str]:
        """Return the devices at the instruments at fault; none of a fault of the plant."""
        found: list[str] = []
        for instrument in fault.rpartition(".")[0].split(JOIN):
            on_line = [
                each.name
                for each in self.file.devices
                if instrument in str(getattr(each.settings, "port", "")).removeprefix(EMULATED).split(JOIN)
            ]
            # An instrument on a line that several share has the name of its device.
            found += [name for name in on_line if name == instrument] or on_line
        return found

    def named(self, fault: str, status: str, reason: str) -> str:
        """Judge whether a message names what is at fault."""
        if status == "completed":
            return "."
        wanted = self.devices_at(fault) or [each.name for each in self.file.devices]
        return "ok" if any(device in reason for device in wanted) else f"names none of {', '.join(wanted)}"

    def safe(self) -> str:
        """Look at the outputs themselves, and again when the watchdogs have expired."""

        def on() -> list[str]:
            outputs = self.observed.outputs()
            return [name for name, value in outputs.items() if abs(value) > abs(self.rest[name])]

        if not on():
            return "ok"
        longest = max((device.watchdog or 0.0 for device in self.description.devices.values()), default=0.0)
        self.observed.clock.sleep(longest + _WATCHDOG_MARGIN)
        return f"on for ever: {', '.join(still)}" if (still := on()) else "w"

    def within_limits(self, reference: Reference) -> str:
        """Judge what the actuators truly did by the limits of the rig file."""
        for signal, (low, high) in self._limits().items():
            if (source := reference.sources.get(signal)) is None:
                continue
            margin = reference.tolerances[signal] + _NEAR * max(abs(low), abs(high))
            for instant, values in self.observed.seen:
                value = source.scale * values[source.name] + source.offset
                if not low - margin <= value <= high + margin:
                    return f"{signal} truly was {value:.4g} at {instant:.2f} s, beyond {low:g} to {high:g}"
        return "ok"

    def _limits(self) -> dict[str, tuple[float, float]]:
        """Return the limits of actuators by signal: of what they are set to, and settings such as `current_limit`."""
        found: dict[str, tuple[float, float]] = {}
        for entry in self.file.devices:
            device = self.description.devices[entry.name]
            if not issubclass(device.kind, Actuator):
                continue
            for signal in device.signals:
                if device.limits is not None and signal.unit == device.limits.unit:
                    found[signal.name] = device.limits.low, device.limits.high
                quantity = signal.name.removeprefix(f"{entry.name}_")
                limit = getattr(entry.settings, f"{quantity}_limit", None)
                if limit is not None:
                    found[signal.name] = -limit, limit
                elif (limits := getattr(entry.settings, f"{quantity}_limits", None)) is not None:
                    found[signal.name] = limits[0], limits[1]
        return found


def faults_of(task: Task, device: str | None, word: str) -> list[str]:
    """Return the faults of a rig, of the instrument of a device if one is given, that have a word in their name.

    Raises ConfigurationError if there is no such device, or no such fault.
    """
    bed = Bed.of(task)
    known = [each.name for each in bed.file.devices]
    if device is not None and device not in known:
        raise ConfigurationError(f"--device {device}: there is no such device; there are: {', '.join(known)}")
    names = [*bed.faults]
    found = [name for name in names if word in name and (device is None or device in bed.devices_at(name))]
    if not found:
        raise ConfigurationError(f"--fault {word}: no fault has this in its name; there are: {', '.join(names)}")
    return found


def largest_excursion(task: Task) -> Task:
    """Return the task with the largest part of the ranges over which the rig completes the excursion without a fault.

    Raises ConfigurationError if it completes none.
    """
    reason = ""
    while task.share >= _LEAST_SHARE:
        bed = Bed.of(task)
        with TemporaryDirectory(prefix="bench-torture-") as folder:
            outcome = bed.run(0, Path(folder))
        if outcome.status == "completed":
            return task
        reason = outcome.reason
        task = replace(task, share=task.share / 2)
    raise ConfigurationError(f"rig {task.rig} completes no excursion without a fault: {reason}")


def reference_of(task: Task, seed: int) -> Reference:
    """Carry the excursion out without a fault; return what is recorded.

    Raises BenchError if it is not completed.
    """
    bed = Bed.of(task)
    with TemporaryDirectory(prefix="bench-torture-") as folder:
        outcome = bed.run(seed, Path(folder))
        if outcome.status != "completed":
            raise BenchError(f"seed {seed}: the run without a fault ended: {outcome.reason}")
        (journal,) = Path(folder).glob("*/")
        with Record(journal) as record:
            return Reference.of(record, bed.observed, outcome.laboratory_seconds, bed.file.derived)


def torture(task: Task, fault: str, seed: int, reference: Reference) -> Cell:
    """Carry one run out with a fault, and judge it; one that hangs says where, and ends its process."""
    faulthandler.dump_traceback_later(_LONGEST, exit=True, file=sys.__stderr__ or sys.stderr)
    try:
        return _torture(Bed.of(task), fault, seed, reference)
    finally:
        faulthandler.cancel_dump_traceback_later()


def entry(name: str, fault: Fault, seed: int) -> dict[str, Any]:
    """Return the entry of the schedule: at an instant by the seed, with an end if the fault may have one."""
    part = zlib.crc32(f"{name} {seed}".encode()) / 2**32
    found: dict[str, Any] = {"at": round(_FIRST + (_LAST - _FIRST) * part, 3), "fault": name}
    values = {}
    if fault.undo is not None:
        found["duration"] = _DURATION
    if "probability" in fault.values:
        # On even seeds every answer of the duration, on odd ones some of them.
        values["probability"] = 0.3 if seed % 2 else 1.0
    if name.endswith((".delay", ".halve")):
        values["seconds"] = _DELAYS[seed % len(_DELAYS)]
    return found | {"values": values}


def _torture(bed: Bed, name: str, seed: int, reference: Reference) -> Cell:
    fault = bed.faults[name]
    results = dict.fromkeys(CHECKS, "ok")
    with TemporaryDirectory(prefix="bench-torture-") as folder:
        schedule = Path(folder) / "faults.jsonl"
        schedule.write_text(json_text(entry(name, fault, seed)) + "\n")
        outcome = None
        try:
            outcome = bed.run(seed, Path(folder), schedule)
            status, reason = outcome.status, outcome.reason
        except BenchError as error:
            status, reason = "refused", str(error)
        except Exception as error:  # a driver of the user's own may fail in any way
            status, reason = "crashed", f"{type(error).__name__}: {error}"
            results["ends"] = reason
        results["limits"] = bed.within_limits(reference)
        results["safe"] = bed.safe()
        if outcome is not None:
            longest = COUNT * DWELL + bed.file.safety.reconnect + _MARGIN
            if outcome.laboratory_seconds > longest:
                results["ends"] = f"after {outcome.laboratory_seconds:.0f} s, planned were {reference.seconds:.0f} s"
            (journal,) = Path(folder).glob("*/")
            with Record(journal) as record:
                if (steps := len(record.steps())) != outcome.steps:
                    results["rows"] = f"{steps} steps of {outcome.steps}"
                elif record.status != status:
                    results["rows"] = f"journal says {record.status}"
                results["true"] = "." if fault.lies else reference.lie(record, bed.observed, reason) or "ok"
    results["names"] = bed.named(name, status, reason)
    return Cell(", ".join(bed.devices_at(name)), name, seed, status, reason, results)


def cells(task: Task, faults: list[str], seeds: int, processes: int | None, console: Console) -> Iterator[Cell]:
    """Yield each run as it is judged, in the order of faults and seeds; one that hangs is one of its failures."""
    with Workers(processes, console, f"torture {task.rig}") as workers:
        waiting = [
            workers.submit(f"no fault {seed}", reference_of, task, seed) for seed in range(max(seeds, _REFERENCES))
        ]
        found = [each.result() for each in waiting]
        references = [each.widened(found) for each in found]
        pending = [
            (name, seed, workers.submit(f"{name} {seed}", torture, task, name, seed, references[seed]))
            for name in faults
            for seed in range(seeds)
        ]
        for name, seed, each in pending:
            try:
                yield each.result()
            except BenchError as error:
                yield Cell("", name, seed, "refused", "", dict.fromkeys(CHECKS, ".") | {"ends": str(error)})
