"""How long readings and set-points take, from the times of the steps of a run.

What a step waited is not on record; its protocol says it, when it is given the recorded readings again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bench.analysis import TransientRecording
from bench.base import BenchError
from bench.devices import Dwell
from bench.protocol import Note, Phase, Reading, Step, find_protocol
from bench.record import StepRecord
from bench.rig import RigFile, RoleTable, Slot, Slots

# Derivation: the median of three is right with one that is wrong.
_FEWEST = 3


@dataclass(frozen=True)
class ReadingTime:
    """What takes time on the lines of a rig, s."""

    reading: float = 0.0  # a reading of all signals
    quick: float = 0.0  # a quick reading of all signals
    setpoint: float = 0.0  # a set-point of the drive


def time_readings(recordings: Sequence[TransientRecording], file: RigFile) -> ReadingTime | None:
    """Return the times of runs of a rig; None if their protocols cannot be followed."""
    whole, quick, moved = [], [], []
    for recording in recordings:
        period = recording.meta["rig_content"].get("telemetry", {}).get("period", 1.0)
        begun = {}
        for step, record in _followed(recording, file):
            if not isinstance(step.settle, Dwell):
                continue
            spent = record.finished - record.started - step.settle.seconds
            begun[record.step] = record.started
            if not step.setpoints or step.settle.seconds > 0.0:
                whole.append(spent)
            else:
                moved.append(spent)
        ticks, numbers = recording.ticks
        for t, number in zip(ticks.tolist(), numbers.tolist(), strict=True):
            if number in begun:
                quick.append(float((t - begun[number]) % period))
    if len(whole) < _FEWEST:
        return None
    reading = float(np.median(whole))
    setpoint = max(float(np.median(moved)) - reading, 0.0) if moved else 0.0
    return ReadingTime(max(reading, 0.0), float(np.median(quick)) if quick else 0.0, setpoint)


def _followed(recording: TransientRecording, file: RigFile) -> Iterator[tuple[Step, StepRecord]]:
    """Yield the steps that the protocol of a run asked for, with their records, as far as it can be followed."""
    try:
        definition = find_protocol(str(recording.meta["protocol"]))
        parameters = definition.parameters.model_validate(recording.meta["parameters"])
        messages = definition.start(parameters, _slots(recording, file))
        names = [signal.name for signal in recording.signals]
        records = iter(recording.steps)
        reading: Reading | None = None
        while True:
            message = messages.send(reading)  # type: ignore[arg-type]  # the first of a generator is None
            if isinstance(message, Phase | Note):
                reading = None
                continue
            record = next(records)
            reading = Reading(
                record.step, record.finished, record.settled, dict(zip(names, record.values, strict=True))
            )
            if isinstance(message, Step):
                yield message, record
    # The protocol may be of a file that is gone, or another by now; then nothing more is known.
    except (BenchError, StopIteration, ValueError, LookupError, ArithmeticError, TypeError):
        return


def _slots(recording: TransientRecording, file: RigFile) -> Slots:
    signals = {signal.name: signal for signal in recording.signals}
    found = {}
    for name, bound in recording.meta.get("slots", {}).items():
        signal, setpoint = signals[bound["signal"]], signals.get(f"{bound['device']}_setpoint")
        found[name] = Slot(
            name, bound["device"], signal.name, signal.unit, signal.description, setpoint.unit if setpoint else "",
            signal.display, file.roles.get(name) or RoleTable(signal=signal.name),
        )  # fmt: skip
    return found
