"""The panel of big numbers: phase, output, error, margin to the nearest interlock, and when the run ends."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timedelta
from typing import Any

import rerun as rr

from bench.base import Expectation, fitting_prefix, format_duration
from bench.dashboard.bounds import Bound, nearest
from bench.dashboard.controlled_run import ErrorPlot
from bench.dashboard.entries import End, Part, Ticks
from bench.dashboard.model_band import ModelBand
from bench.dashboard.rerun_recording import RerunRecording, times
from bench.devices import Signal
from bench.record import Event, StepRecord, expected_steps

_SHORT = 10.0
"""Durations below are shown in s. Derivation: three digits then show hundredths."""

LIVE_SECONDS = 1.0
FILE_SECONDS = 10.0
"""Laboratory time between two panels for viewers, and in the file, s.

Source: Nielsen, *Usability Engineering*, 1993, section 5.5: 1 s keeps a thought going, 10 s an eye on the screen.
"""


class Numbers:
    """Writes the panel of numbers at the entity `numbers`.

    Parameters
    ----------
    meta : mapping
        The run's metadata.
    signals : sequence of Signal
        What is measured.
    shown : sequence of int
        Columns of the signals whose values are shown, the most important first.
    bounds : sequence of Bound
        Of the signals.
    errors : ErrorPlot or None
        Of a run under control.
    band : ModelBand or None
        Of the model in the run; it has seen the entries first.
    """

    def __init__(
        self,
        meta: Mapping[str, Any],
        signals: Sequence[Signal],
        shown: Sequence[int],
        bounds: Sequence[Bound],
        errors: ErrorPlot | None,
        band: ModelBand | None = None,
    ) -> None:
        self._band = band
        self._signals, self._shown, self._bounds, self._errors = signals, shown, bounds, errors
        self._epoch = datetime.fromisoformat(meta["epoch"]) if meta.get("epoch") else None
        self._is_dated = meta.get("clock") == "wall"
        self._steps_expected = expected_steps(meta)
        self._expected = _expectation(meta)
        self._state, self._phase, self._steps, self._reason = "running", "", 0, ""
        self._values: Sequence[float] = ()
        self._t, self._step = 0.0, 0
        self.interval = FILE_SECONDS
        """Laboratory time between two panels, s."""
        self._last = -math.inf
        self._pending: list[tuple[float, int, str]] = []

    @property
    def state(self) -> str:
        """What the run is doing, or how it ended."""
        return self._state

    def cut(self, part: Part) -> Iterator[Part]:
        """Yield a part; ticks in pieces that end where a panel is due, if `see` takes each before the next."""
        if not isinstance(part, Ticks):
            yield part
            return
        first = 0
        while first < len(part):
            due = part.t[first:] - self._last >= self.interval
            end = first + int(due.argmax()) + 1 if due.any() else len(part)
            yield part.part(first, end)
            first = end

    def see(self, part: Part) -> None:
        """Take a part into account, and keep the panel of its time where it is due."""
        if isinstance(part, Ticks):
            self._t, self._step = float(part.t[-1]), int(part.step[-1])
            self._values = part.values[-1].tolist()
        elif isinstance(part, StepRecord):
            self._t, self._step, self._values = part.finished, part.step, part.values
            self._steps = part.step + 1
        elif isinstance(part, Event):
            self._t = max(self._t, part.t)
            if part.kind == "phase":
                self._phase = part.text
            elif part.kind in ("pause", "resume"):
                self._state = "paused" if part.kind == "pause" else "running"
        elif isinstance(part, End):
            self._state, self._reason = part.status, part.reason
            self._last = -math.inf
        else:
            return
        if self._t - self._last >= self.interval:
            self._last = self._t
            self._pending.append((self._t, self._step, self._text()))

    def write(self, recording: RerunRecording) -> None:
        """Write the panels that were kept."""
        if self._pending:
            t, step, text = zip(*self._pending, strict=True)
            columns = rr.TextDocument.columns(text=text, media_type=[rr.MediaType.MARKDOWN] * len(text))
            recording.send("numbers", times(t, step), columns)
            self._pending.clear()

    def _text(self) -> str:
        done = f"step {self._steps}" + (f" of {self._steps_expected}" if self._steps_expected else "")
        is_over = self._state not in ("running", "paused")
        lines = [f"# {self._state if is_over or self._state == 'paused' else self._phase or self._state}"]
        phase = [self._phase] if is_over and self._phase else []
        lines.append(" · ".join([*phase, done, _duration(self._t)]))
        if self._reason:
            lines.append(self._reason)
        for name, number in self._numbers():
            lines += [f"# {number}", name]
        lines.append("---")
        lines += [f"**{value}** {name}" for name, value in self._rest(is_over=is_over)]
        return "\n\n".join(lines)

    def _numbers(self) -> Iterator[tuple[str, str]]:
        if not self._values:
            return
        for column in self._shown:
            yield self._signals[column].name, self._show(self._values[column], column)
        if self._errors is not None and math.isfinite(self._errors.now):
            column = self._errors.output
            unit = self._signals[column].unit
            yield f"error now, target {self._show(self._errors.target, column)}", _small(self._errors.now, unit)
            name, rms = self._errors.rms()
            yield name, _small(rms, unit)
            if math.isfinite(witnessed := self._errors.rms_of_witness()):
                yield "RMS of the error of late, by the witness", _small(witnessed, unit)

    def _rest(self, *, is_over: bool) -> Iterator[tuple[str, str]]:
        if self._values and (bound := nearest(self._bounds, self._values)) is not None:
            margin = bound.margin(self._values[bound.column])
            yield f"to the interlock {bound.name}", self._show(margin, bound.column)
        if self._band is not None:
            yield from self._band.texts(self._t)
        if is_over:
            yield "in all", _duration(self._t)
        elif self._expected is not None:
            left = max(self._expected.seconds - self._expected.end_of(self._steps), 0.0)
            at = max(self._expected.seconds - self._t, 0.0) if self._steps == 0 else left
            yield "left", format_duration(at)
            if self._epoch is not None and self._is_dated:
                end = self._epoch + timedelta(seconds=self._t + at)
                yield "end", end.astimezone().strftime("%a %H:%M")

    def _show(self, value: float, column: int) -> str:
        signal = self._signals[column]
        if not math.isfinite(value):
            return "–"
        return signal.display.text(value).replace("-", "−")


def _small(value: float, unit: str) -> str:
    """Return an error with its unit, to three digits."""
    factor, shown = fitting_prefix(unit, value)
    return f"{f'{factor * value:#.3g}'.removesuffix('.')} {shown}".replace("-", "−")


def _duration(seconds: float) -> str:
    return format_duration(seconds) if seconds >= _SHORT else f"{seconds:.3g} s"


def _expectation(meta: Mapping[str, Any]) -> Expectation | None:
    """Return when the steps of a run end, as it was rehearsed or planned; None if that is not known."""
    rehearsal, plan = meta.get("rehearsal"), meta.get("plan") or {}
    if rehearsal:
        marks = tuple((int(steps), float(seconds)) for steps, seconds in rehearsal["marks"])
        return Expectation(marks, float(rehearsal["seconds"]))
    if plan.get("complete") and plan.get("steps"):
        return Expectation(((int(plan["steps"]), float(plan["seconds"])),), float(plan["seconds"]))
    return None
