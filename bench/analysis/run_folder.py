"""Runs that were recorded: the folder of one for programs and notebooks, and those below a folder."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from bench.analysis.picture import Picture
from bench.base import ConfigurationError, DataError, counted, html_table
from bench.record import Event, Record, Table, file_name, find_journals
from bench.rig import SAFE, is_in_use

DAMAGED, RUNNING = "damaged", "running"

_RESULT = re.compile(r"\b(RMS|error|spread)\b")
"""What the note of a protocol has that says how well it went."""


@dataclass(frozen=True)
class ListedRun:
    """One run of a list.

    Attributes
    ----------
    folder : Path
        Its folder.
    status : str
        `completed`, `aborted`, `failed`, `running` (in a process of this computer), `unfinished` (its process
        died, with no guardian to say how, or is of another computer) or `damaged` (rows are damaged, or the journal
        is gone).
    protocol, rig : str
        What ran, and on what.
    started : str
        Time of day, ISO 8601.
    seconds : float or None
        Laboratory time, s; None of a run that has not ended.
    steps : int
        Finished steps.
    result : str
        The devices that did not confirm their safe state at its end, else the last note of the protocol that states
        an error, or why the run did not complete.
    changed : mapping
        Parameters that differ from their defaults, and values of the rig file that were replaced.
    values : mapping
        What a run is found by: all parameters, values of the rig file that were replaced, and `seed`, `clock`, `run`
        and `operator`.
    """

    folder: Path
    status: str
    protocol: str = ""
    rig: str = ""
    started: str = ""
    seconds: float | None = None
    steps: int = 0
    result: str = ""
    changed: Mapping[str, Any] = field(default_factory=dict)
    values: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return it for programs."""
        return asdict(self) | {"folder": str(self.folder)}


def list_runs(folder: Path) -> list[ListedRun]:
    """Return the runs below a folder, in the order of their start; those that cannot be read come first.

    Damaged are those in which `Record.damage` finds a wrong row, and those whose journal is gone but for a second
    file or a recovered copy.

    Raises ConfigurationError if there is no such folder.
    """
    if not folder.is_dir():
        raise ConfigurationError(f"{folder} is not a folder")
    return sorted((_listed(path) for path in find_journals(folder)), key=lambda run: (run.started, run.folder))


def select_runs(
    runs: list[ListedRun],
    where: Mapping[str, str],
    *,
    status: str | None = None,
    protocol: str | None = None,
    rig: str | None = None,
) -> list[ListedRun]:
    """Return the runs that fit all that is given.

    Parameters
    ----------
    runs : list of ListedRun
        From which to choose.
    where : mapping of str to str
        Values by the keys of `ListedRun.values`. Numbers are compared as numbers, files by the end of their path.
    status, protocol, rig : str, optional
        What these are.

    Raises
    ------
    ConfigurationError
        If no run has one of the keys.
    """
    for key in where:
        if runs and not any(key in run.values for run in runs):
            known = ", ".join(sorted({name for run in runs for name in run.values})) or "none"
            raise ConfigurationError(f"--where {key}: no run has such a parameter; they have: {known}")
    wanted = {"status": status, "protocol": protocol, "rig": rig}
    return [
        run
        for run in runs
        if all(value in (None, getattr(run, name)) for name, value in wanted.items())
        and all(key in run.values and _fits(run.values[key], text) for key, text in where.items())
    ]


def main_result(record: Record) -> str:
    """Return the last note of a run's protocol that states an error; empty if there is none."""
    notes = (event.text for event in reversed(record.events()) if event.kind == "note")
    return next((text for text in notes if _RESULT.search(text)), "")


def _listed(path: Path) -> ListedRun:
    folder = path.parent
    try:
        with Record(path) as record:
            meta = record.meta
            status = RUNNING if record.status == "unfinished" and is_in_use(folder) else record.status
            damage = "" if status == RUNNING else record.damage()
            counted = "counts" in meta or damage
            unsafe = ", ".join(name for name, state in record.safe_state.items() if state != SAFE)
            result = main_result(record) if status == "completed" else record.reason
            return ListedRun(
                folder,
                DAMAGED if damage else status,
                str(meta["protocol"]),
                str(meta["rig"]),
                str(meta["host"]["started"]),
                meta.get("finished"),
                int(meta.get("counts", {}).get("steps", 0)) if counted else len(record.steps()),
                damage or "; ".join(filter(None, (unsafe and f"NOT in its safe state: {unsafe}", result))),
                meta.get("changed", {}) | meta["overrides"],
                {
                    **meta["parameters"],
                    **meta["overrides"],
                    **{key: meta[key] for key in ("seed", "clock", "run", "operator")},
                },
            )
    except DataError as error:
        return ListedRun(folder, DAMAGED, result=str(error))
    except (KeyError, TypeError) as error:
        return ListedRun(folder, DAMAGED, result=f"{path}: the metadata are damaged: {error}")


def _fits(value: Any, text: str) -> bool:  # noqa: ANN401 - anything that JSON can hold
    if isinstance(value, bool) or value is None:
        return str(value).lower() == text.lower()
    if isinstance(value, int | float):
        try:
            return float(text) == value
        except ValueError:
            return False
    return text in (str(value), file_name(str(value)))


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
