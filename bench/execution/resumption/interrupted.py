"""A run that died, as it is taken up: what it is compared with, and where it goes on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from bench.base import Clock, ConfigurationError, wall_time
from bench.execution.resumption.feeding import Fed, Past, feed
from bench.protocol import LATENESS, TRACES, ProtocolDefinition, ProtocolParameters
from bench.record import Event, Journal
from bench.rig import SETPOINT, RigDescription, Slots

RESUMED = "resumed"
"""Kind of the events of a process that takes a run up."""

_DESCRIBED = ("operator", "command", "packages", "git", "host", "devices", "rig_content", "protocol_source")
"""What is kept of each process that takes a run up."""

_MOST_NAMED = 8
"""Changes that a message names."""


@dataclass(frozen=True, kw_only=True)
class Resume:
    """What to resume, and how.

    Attributes
    ----------
    folder : Path
        The folder of the run, or its journal.
    rig : str, optional
        Where its rig file is now; the one that it was started with if not given.
    attach : Path, optional
        Endpoints file of `bench rig emulate`, for a run on a laboratory that is served elsewhere.
    sigmas : float
        Standard deviations by which the specimen may differ from the last readings of the record.
    accept_changes : bool
        Whether to go on although the protocol, the content of the rig or a version has changed.
    accept_disagreement : bool
        Whether to go on although the specimen is not as the record left it.
    live : bool
        Whether to serve the live view on the loopback interface.
    notify : tuple of str
        Who is sent messages; see `bench.execution.notify`.
    """

    folder: Path
    rig: str | None = None
    attach: Path | None = None
    sigmas: float = 5.0
    accept_changes: bool = False
    accept_disagreement: bool = False
    live: bool = False
    notify: tuple[str, ...] = ()


@dataclass
class Interrupted:
    """A run that died."""

    folder: Path  # its folder
    meta: Mapping[str, Any]  # what its journal says of it as a whole
    past: Past  # what it has recorded
    written: datetime  # time of day of its last row
    asked: Resume  # how it is to be taken up
    # The protocol, with its past. This and what follows is known after `feed` only.
    fed: Fed = field(init=False)
    compared: tuple[str, ...] = field(init=False)  # signals that have to agree with the last readings of the record
    drive: str = field(init=False)  # signal of the slot `drive`; empty if there is none
    # Whether what was done by hand has to be done again, as in a new emulated laboratory.
    by_hand: bool = field(init=False)
    zero: float = field(init=False)  # time of the clock at which the run began, s

    @property
    def _resumes(self) -> list[dict[str, Any]]:
        resumes: list[dict[str, Any]] = self.meta.get("resumes", [])
        return resumes

    def continue_time(self, clock: Clock) -> None:
        """Let a clock go on with the laboratory time of the run, which began at its epoch.

        Raises ConfigurationError if it cannot: a served laboratory goes on by itself, and has to be the same.
        """
        began = self.meta["laboratory_epoch"]
        if began is None:
            clock.go_on(self._epoch, self.past.last)
        elif clock.epoch.isoformat() != began:
            raise ConfigurationError(
                f"the laboratory that is served now began at {clock.epoch.isoformat()}, that of the run at {began}: "
                "its specimen is another one, so the run cannot be resumed on it"
            )

    @property
    def _epoch(self) -> datetime:
        return datetime.fromisoformat(self.meta["epoch"])

    def feed(
        self,
        definition: ProtocolDefinition,
        parameters: ProtocolParameters,
        slots: Slots,
        description: RigDescription,
        clock: Clock,
        *,
        by_hand: bool,
    ) -> None:
        """Feed the protocol what was recorded.

        Raises ConfigurationError if it does other than that, or there is no finished step.
        """
        traced = {signal.name for signal in (*TRACES, LATENESS)}
        if missing := [name for name in self.past.names if name not in description.by_name and name not in traced]:
            raise ConfigurationError(
                f"{self.folder} has the signals {', '.join(missing)}, which rig {description.file.name} does not "
                "give any more; restore them"
            )
        self.fed = feed(definition, parameters, slots, self.past)
        if self.fed.step is None:
            raise ConfigurationError(f"{self.folder} has no finished step to go on from; start the run again")
        if self.fed.message is not None:
            self.fed.check_fresh(self.fed.message)
        measured = [slot.signal for slot in slots.values()]
        if not measured:
            setpoints = {f"{name}{SETPOINT}" for name in description.devices}
            measured = [signal.name for signal in description.signals if signal.name not in setpoints]
        known = self.past.names
        self.compared = tuple(name for name in dict.fromkeys(measured) if name in known and name not in traced)
        self.zero = 0.0 if self.meta["laboratory_epoch"] is None else (self._epoch - clock.epoch).total_seconds()
        self.drive = slots["drive"].signal if "drive" in slots else ""
        self.by_hand = by_hand

    @property
    def latest(self) -> dict[str, Any]:
        """The metadata of the run, as the last process had it that carried it out."""
        return {**self.meta, **(self._resumes[-1] if self._resumes else {})}

    def reopen(
        self,
        path: Path,
        now: Mapping[str, Any],
        changes: Sequence[str],
        t: float,
        patience: float | None,
    ) -> Journal:
        """Open the journal to write on, and note in it that the run is taken up, by whom, and after which step.

        `now` is the metadata of the run as it would be started now, `changes` what is not as it was when the run was
        carried out last, `t` the time of the clock, s, and `patience` as of a journal. Raises ConfigurationError if
        something has changed and that is not accepted.
        """
        if changes and not self.asked.accept_changes:
            more = f", and {len(changes) - _MOST_NAMED} more" if len(changes) > _MOST_NAMED else ""
            raise ConfigurationError(
                f"the run was started otherwise: {'; '.join(changes[:_MOST_NAMED])}{more}. Restore that, or go on "
                "all the same with --accept-changes"
            )
        step = self.fed.step
        assert step is not None
        t -= self.zero
        gap = (wall_time() - self.written).total_seconds()
        entry = {
            "t": t,
            "after_step": step.step,
            "gap_seconds": gap,
            "changes": list(changes),
            "ended": {key: self.meta[key] for key in ("status", "reason") if key in self.meta},
            **{key: now[key] for key in _DESCRIBED if key in now},
        }
        journal = Journal.reopen(path, {"resumes": [*self._resumes, entry]}, patience)
        label = f" ({step.label})" if step.label else ""
        text = f"resumed by {now['operator']} after step {step.step}{label}; it had stood for {gap:.0f} s"
        journal.event(
            Event(t, "INFO", RESUMED, text + (f"; accepted changes: {'; '.join(changes)}" if changes else ""))
        )
        return journal
