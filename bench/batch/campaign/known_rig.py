"""A rig as a campaign knows it before its first run: connected once in this process, looked at, and closed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bench.base import ConfigurationError, Stopwatch, VirtualClock
from bench.batch.campaign.sources import PROGRAMS, digest, file_digest
from bench.rig import Rig, RigDescription, clock_for, load_rig, read_schedule, schedule_faults

_TICKS = 20
"""Seconds of laboratory time by which the speed of a rig is measured."""


@dataclass(frozen=True, eq=False)
class KnownRig:
    """An emulated rig with its overrides."""

    description: RigDescription  # its file, devices and signals
    pace: float  # wall-clock seconds that a second of laboratory time takes here
    digest: str  # hash of the rig file with all overrides, and of the programs beside it

    @classmethod
    def look_at(cls, name: str, overrides: tuple[tuple[str, str], ...]) -> KnownRig:
        """Connect a rig with values by dotted key.

        Raises ConfigurationError if the rig file is wrong, or not all instruments are emulated; DeviceError if one
        cannot be connected.
        """
        file = load_rig(name, dict(overrides))
        if not file.in_process:
            raise ConfigurationError("not all instruments are emulated; a campaign takes emulated rigs only")
        clock = clock_for(file, "virtual")
        with Rig(file, clock, 0) as rig:
            rig.measure()
            stopwatch = Stopwatch()
            for _ in range(_TICKS):
                clock.sleep(1.0)
                rig.measure()
            pace = stopwatch.seconds() / _TICKS
            programs = file_digest(Path(name), PROGRAMS) if name.endswith(".toml") else ""
            return cls(rig.description, pace, digest([file.content, programs]))

    def check_faults(self, path: Path) -> None:
        """Check that a schedule can be read and the laboratory has its faults; raises ConfigurationError."""
        file = self.description.file
        laboratory = file.laboratory(file.laboratory_settings, VirtualClock(), 0) if file.laboratory else None
        schedule_faults(laboratory, read_schedule(path), path)
