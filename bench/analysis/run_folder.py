"""The folder of a run, for programs and notebooks: measurements as tables, events, and outcome."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from bench.analysis.picture import Picture
from bench.base import DataError, counted, html_table
from bench.record import Event, Record, Table


@dataclass(frozen=True)
class RunFolder:
    """A run that was recorded.

    Every property reads the journal again, so that a run that goes on can be watched.

    Parameters
    ----------
    folder : Path
        Folder of the run, or its journal.

    Raises
    ------
    DataError
        By each property, if the journal cannot be read.
    """

    folder: Path

    @property
    def meta(self) -> dict[str, Any]:
        """What the journal says of the run as a whole; its keys stand in `bench.record`."""
        with Record(self.folder) as record:
            return record.meta

    @property
    def status(self) -> str:
        """`completed`, `aborted`, `failed`, or `unfinished`."""
        with Record(self.folder) as record:
            return record.status

    @property
    def readings(self) -> Table:
        """One row a step: `step`, `started`, `finished` (s), `settled`, and each signal in its unit."""
        with Record(self.folder) as record:
            return record.steps()

    @property
    def telemetry(self) -> Table:
        """One row a tick of a hold: `t` (s), `step`, and each signal in its unit."""
        with Record(self.folder) as record:
            return record.telemetry()

    @property
    def events(self) -> list[Event]:
        """Phases, notes, interlocks, the safe state, in their order."""
        with Record(self.folder) as record:
            return record.events()

    @property
    def notes(self) -> list[str]:
        """What the protocol noted."""
        return [event.text for event in self.events if event.kind == "note"]

    def signal_of(self, slot: str) -> str:
        """Return the signal to which the protocol's slot was bound.

        Raises DataError if the protocol had no such slot.
        """
        slots = self.meta.get("slots", {})
        if slot not in slots:
            raise DataError(
                f"{self.folder}: the protocol had no slot {slot!r}, so input and output must be named; "
                f"it had: {', '.join(slots) or 'none'}"
            )
        return str(slots[slot]["signal"])

    def plot(self, kind: Literal["signals", "loops"] = "signals") -> Picture:
        """Draw the signals over time, or the loop that its dashboard shows first.

        Raises
        ------
        DataError
            If there is nothing to draw, or the journal cannot be read.
        """
        from bench.analysis.report.recorded_run import RecordedRun
        from bench.analysis.report.run_figures import draw_loops, draw_signals

        def draw(folder: Path) -> Path:
            with Record(self.folder) as record:
                run, path = RecordedRun.of(record), folder / "signals.png"
                if kind == "loops":
                    drawn = next((path for path, _ in draw_loops(folder, "png", run)), None)
                else:
                    drawn = path if draw_signals(path, run) else None
            if drawn is None:
                raise DataError(f"{self.folder}: there are no {kind} to draw")
            return drawn

        return Picture.drawn_by(draw)

    def _repr_html_(self) -> str:
        meta = self.meta
        rows = {
            "run": self.folder.name,
            "status": self.status,
            "protocol": f"{meta['protocol']}: {meta['protocol_summary']}",
            "rig": f"{meta['rig']}: {meta['rig_title']}",
            "readings": str(len(self.readings)),
            **{f"note {i}": text for i, text in enumerate(self.notes, 1)},
        }
        return html_table((), rows.items())

    def __repr__(self) -> str:
        """Return what was run, how it ended and where it is."""
        meta = self.meta
        size = counted(len(self.readings), "reading")
        return f"<{meta['protocol']} on {meta['rig']}: {self.status}, {size}, {self.folder}>"
