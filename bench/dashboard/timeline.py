"""The log of a run, and the lanes that show its phase and its state over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import rerun as rr

from bench.base import format_duration
from bench.dashboard.drawing import Colour
from bench.dashboard.entries import Part, Ticks
from bench.dashboard.rerun_recording import RerunRecording, times
from bench.record import Event, StepRecord

_RUNNING = "running"
_NOT_SETTLED, _NOT_SAFE = "not settled", "not safe"
# Source: traffic lights: green goes on, amber waits, red is the end; blue is safe.
_STATES: Mapping[str, Colour] = {
    _RUNNING: (66, 140, 92),
    "paused": (190, 146, 44),
    "interlock": (206, 62, 58),
    "safe": (64, 112, 176),
    _NOT_SAFE: (206, 62, 58),
    "completed": (66, 140, 92),
    "aborted": (190, 146, 44),
    "failed": (206, 62, 58),
    _NOT_SETTLED: (206, 118, 52),
}

_PLAIN = (_RUNNING, "safe", "completed", "aborted", "failed")
"""States that every run has, the last ones for a moment at its end."""
_STATE_OF_EVENT = {"pause": "paused", "resume": _RUNNING, "interlock": "interlock", "safe-state": "safe"}
# Source: WCAG 2.2, 1.4.3: white text on each has a contrast of 4.5 to 1 or more.
_PHASE_COLOURS: tuple[Colour, ...] = (
    (58, 92, 138),
    (52, 116, 122),
    (104, 84, 140),
    (74, 112, 78),
    (128, 96, 62),
    (122, 74, 104),
)


class Timeline:
    """Writes events and the changes of phase and state to a recording."""

    def __init__(self) -> None:
        self._states: dict[str, str] = {}
        self._phases: list[str] = []
        self._step = 0
        self.t = 0.0
        """Laboratory time of the last entry, s."""
        self.is_eventful = False
        """Whether the run has been in a state that its end does not say, such as paused."""

    def draw(self, recording: RerunRecording) -> None:
        """Give the states their colours."""
        recording.log("state/run", rr.StateConfiguration(values=list(_STATES), colors=list(_STATES.values())))

    def write(self, recording: RerunRecording, parts: Sequence[Part]) -> None:
        """Write events, and the changes that events and steps bring."""
        events: list[tuple[int, Event]] = []
        changes: dict[str, list[tuple[float, int, str]]] = {"run": [], "phase": []}

        def enter(lane: str, t: float, step: int, state: str | None) -> None:
            if state is not None and self._states.get(lane) != state:
                self._states[lane] = state
                changes[lane].append((t, step, state))
                self.is_eventful |= lane == "run" and state not in _PLAIN

        for entry in parts:
            if isinstance(entry, StepRecord):
                enter("run", entry.started, entry.step, _NOT_SETTLED if entry.settled.failed else _RUNNING)
                self._step, self.t = entry.step + 1, entry.finished
            elif isinstance(entry, Event):
                events.append((self._step, entry))
                if entry.kind == "phase":
                    self._colour_phase(recording, entry.text)
                    enter("phase", entry.t, self._step, entry.text)
                enter("run", entry.t, self._step, _state_after(entry))
                self.t = entry.t
            elif isinstance(entry, Ticks):
                self.t = max(self.t, float(entry.t.max()))
        _write_events(recording, events)
        for lane, changed in changes.items():
            if changed:
                t, step, state = zip(*changed, strict=True)
                recording.send(f"state/{lane}", times(t, step), rr.StateChange.columns(state=state))

    def warn(self, recording: RerunRecording, text: str) -> None:
        """Report a problem of the dashboard itself in the log."""
        _write_events(recording, [(self._step, Event(self.t, "WARN", "dashboard", text))])

    def _colour_phase(self, recording: RerunRecording, phase: str) -> None:
        if phase not in self._phases:
            self._phases.append(phase)
            colours = [_PHASE_COLOURS[i % len(_PHASE_COLOURS)] for i in range(len(self._phases))]
            recording.log("state/phase", rr.StateConfiguration(values=self._phases, colors=colours))


def _write_events(recording: RerunRecording, events: Sequence[tuple[int, Event]]) -> None:
    if not events:
        return
    columns = rr.TextLog.columns(
        # The viewer leaves its own time column too narrow to read.
        text=[f"{format_duration(max(event.t, 0.0))}  {event.text}" for _, event in events],
        level=[event.level for _, event in events],
    )
    recording.send("events", times([event.t for _, event in events], [step for step, _ in events]), columns)


def _state_after(event: Event) -> str | None:
    """Return the state of the run after an event; None if it changes nothing."""
    if event.kind == "safe-state" and event.level == "ERROR":
        return _NOT_SAFE
    return event.text if event.kind == "end" else _STATE_OF_EVENT.get(event.kind)
