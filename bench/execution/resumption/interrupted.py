"""A run that died, as it is taken up: what it is compared with, and where it goes on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.base import Clock, ConfigurationError, wall_time
from bench.execution.resumption.feeding import Past, feed
from bench.execution.resumption.repriming import RESUMED, Resumption
from bench.protocol import LATENESS, TRACES, ProtocolDefinition, ProtocolParameters
from bench.record import Event, Journal
from bench.rig import SETPOINT, RigDescription, Slots

if TYPE_CHECKING:
    from bench.execution.resumption.resuming import Resume

_DESCRIBED = ("operator", "command", "packages", "git", "host", "devices", "rig_content", "protocol_source")
"""What is kept of each process that takes a run up."""

_MOST_NAMED = 8
"""Changes that a message names."""


@dataclass(frozen=True)
class Interrupted:
    """A run that died.

    Attributes
    ----------
    folder : Path
        Its folder.
    meta : mapping
        What its journal says of it as a whole.
    past : Past
        What it has recorded.
    written : datetime
        Time of day of its last row.
    asked : Resume
        How it is to be taken up.
    """

    folder: Path
    meta: Mapping[str, Any]
    past: Past
    written: datetime
    asked: Resume

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

    def fed(
        self,
        definition: ProtocolDefinition,
        parameters: ProtocolParameters,
        slots: Slots,
        description: RigDescription,
        clock: Clock,
        by_hand: bool,
    ) -> Resumption:
        """Feed the protocol what was recorded.

        Raises ConfigurationError if it does other than that, or there is no finished step.
        """
        traced = {signal.name for signal in (*TRACES, LATENESS)}
        if missing := [name for name in self.past.names if name not in description.by_name and name not in traced]:
            raise ConfigurationError(
                f"{self.folder} has the signals {', '.join(missing)}, which rig {description.file.name} does not "
                "give any more; restore them"
            )
        fed = feed(definition, parameters, slots, self.past)
        if fed.step is None:
            raise ConfigurationError(f"{self.folder} has no finished step to go on from; start the run again")
        if fed.message is not None:
            fed.check_fresh(fed.message)
        measured = [slot.signal for slot in slots.values()]
        if not measured:
            setpoints = {f"{name}{SETPOINT}" for name in description.devices}
            measured = [signal.name for signal in description.signals if signal.name not in setpoints]
        compared = tuple(name for name in dict.fromkeys(measured) if name in self.past.names and name not in traced)
        zero = 0.0 if self.meta["laboratory_epoch"] is None else (self._epoch - clock.epoch).total_seconds()
        drive = slots["drive"].signal if "drive" in slots else ""
        return Resumption(fed, compared, drive, self.asked.sigmas, not self.asked.accept_disagreement, by_hand, zero)

    @property
    def latest(self) -> dict[str, Any]:
        """The metadata of the run, as the last process had it that carried it out."""
        return {**self.meta, **(self._resumes[-1] if self._resumes else {})}

    def reopen(
        self,
        path: Path,
        resumption: Resumption,
        now: Mapping[str, Any],
        changes: Sequence[str],
        t: float,
        patience: float | None,
    ) -> Journal:
        """Open the journal to write on, and note in it that the run is taken up, by whom, and after which step.

        Parameters
        ----------
        path : Path
            The journal.
        resumption : Resumption
            The run, as it goes on.
        now : mapping
            Metadata of the run as it would be started now.
        changes : sequence of str
            What is not as it was when the run was carried out last.
        t : float
            Time of the clock, s.
        patience : float or None
            As of a journal.

        Raises
        ------
        ConfigurationError
            If something has changed and that is not accepted.
        """
        if changes and not self.asked.accept_changes:
            more = f", and {len(changes) - _MOST_NAMED} more" if len(changes) > _MOST_NAMED else ""
            raise ConfigurationError(
                f"the run was started otherwise: {'; '.join(changes[:_MOST_NAMED])}{more}. Restore that, or go on "
                "all the same with --accept-changes"
            )
        step = resumption.fed.step
        assert step is not None
        t -= resumption.zero
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
