"""The prediction band of a model while a run goes on: about its own prediction, and about the set-points.

The model follows the measured input from its initial state, as a controller's does. It is the model of the file: what
a controller has learnt, or what has moved in a session, shows as readings beside the band.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import rerun as rr

from bench.base import Floats, prefixed
from bench.control import widened
from bench.dashboard.drawing import CAUTION, Colour
from bench.dashboard.entries import Part, Tick, Ticks, single
from bench.dashboard.rerun_recording import RerunRecording, times
from bench.devices import Settled
from bench.identification import ModelFile, input_half_widths
from bench.models import Operator
from bench.record import StepRecord

# Source: WCAG 2.2, 1.4.11: each has a contrast of 3 to 1 or more to the nearly black background of the viewer.
_MODEL: Colour = (150, 110, 190)
_WITHIN: Colour = (186, 156, 216)


class Plotted(NamedTuple):
    """Where a quantity is plotted: its column, path of the plot, and factor to the unit shown."""

    column: int
    path: str
    factor: float


class _Row(NamedTuple):
    t: float
    step: int
    input: float
    output: float
    setpoint: float
    reference: float
    is_reading: bool


class _Standing(NamedTuple):
    """Counts at a time: readings so far, those within the band, and rows beyond the inputs fitted."""

    t: float
    readings: int
    covered: int
    beyond: int


class ModelBand:
    """The band of one model in a run; used by one thread at a time.

    In a run under control it is there from the first tick of a controller on; in another one at every reading. Rows
    without a plausible input are left out.

    `reference` is the column of the reference, which is finite while a controller is at work: outputs are then drawn
    less the last reference. It is None in a run without one.
    """

    def __init__(
        self,
        file: ModelFile,
        *,
        drive: int,
        response: Plotted,
        setpoint: Plotted | None = None,
        reference: int | None = None,
    ) -> None:
        assert file.band is not None
        self._name, self._operator, self._band, self._validity = file.name, file.operator, file.band, file.valid
        self._drive, self._response, self._setpoint, self._reference = drive, response, setpoint, reference
        self._plausible = widened(*self._operator.input_range)
        self._state: Any = self._operator.initial_state() if file.initial is None else file.initial
        self._set_state = self._state
        self._set, self._set_width = math.nan, math.nan
        self._begun, self._last_reference = reference is None, 0.0
        self._standings: list[_Standing] = []
        self._drawn: list[tuple[str, list[rr.TimeColumn], Floats]] = []

    def draw(self, recording: RerunRecording) -> None:
        """Write how the lines look."""
        level = f"{100.0 * self._band.level:g} %"
        names = [f"{sign} {level}{where}" for where in ("", ", beyond the inputs fitted") for sign in "−+"]
        looks: dict[str, Any] = {"colors": [_WITHIN, _WITHIN, CAUTION, CAUTION], "widths": [1.0] * 4}
        if self._setpoint is not None:
            recording.log(f"{self._setpoint.path}/setpoint_band", rr.SeriesLines(names=names, **looks))
        looks = {"colors": [*looks["colors"], _MODEL], "widths": [1.0] * 5}
        recording.log(f"{self._response.path}/band", rr.SeriesLines(names=[*names, "model alone"], **looks))

    def see(self, parts: Sequence[Part]) -> None:
        """Take parts into account, in their order."""
        before: list[_Row] = []
        rows: list[_Row] = []
        for row, at_work in self._rows(parts):
            self._begun |= at_work
            (rows if self._begun else before).append(row)
        if before:
            self._state = self._operator.advance(self._state, [row.input for row in before])
            self._setpoint_widths(before, seen=False)
        if not rows:
            return
        inputs = np.array([row.input for row in rows])
        predicted = self._operator.evaluate(inputs, self._state)
        self._state = self._operator.advance(self._state, inputs)
        beyond = (inputs < self._validity.low) | (inputs > self._validity.high)
        self._stand(rows, predicted, beyond)
        when = times([row.t for row in rows], [row.step for row in rows])
        about = predicted - np.array([row.reference for row in rows])
        table = np.column_stack([*_parted(about, self._band.half_width, beyond), about])
        self._drawn.append((f"{self._response.path}/band", when, self._response.factor * table))
        if self._setpoint is not None:
            setpoints = np.array([row.setpoint for row in rows])
            table = np.column_stack(_parted(setpoints, self._setpoint_widths(rows), beyond))
            self._drawn.append((f"{self._setpoint.path}/setpoint_band", when, self._setpoint.factor * table))

    def write(self, recording: RerunRecording) -> None:
        """Write the lines of what was seen since the last call."""
        for path, when, table in self._drawn:
            recording.send_vectors(path, when, table)
        self._drawn.clear()

    def texts(self, t: float) -> Iterator[tuple[str, str]]:
        """Yield name and value of what is known of the band at a time of the last entries seen, s."""
        place = bisect_right(self._standings, t, key=lambda standing: standing.t) - 1
        if place < 0:
            return
        standing = self._standings[place]
        level = f"{100.0 * self._band.level:g} % band"
        yield f"{level} of {self._name}", f"± {prefixed(self._band.half_width, self._operator.output_unit, 3)}"
        if standing.readings:
            share = 100.0 * standing.covered / standing.readings
            yield f"of {standing.readings} readings within it", f"{share:.0f} %"
        if standing.beyond:
            fitted = self._validity.range_text(self._operator.input_unit)
            yield f"inputs beyond those fitted, {fitted}: the errors there are unknown", f"{standing.beyond}"

    def _rows(self, parts: Sequence[Part]) -> Iterator[tuple[_Row, bool]]:
        """Yield the rows of parts, and whether a controller is at work."""
        low, high = self._plausible
        if self._reference is None:
            parts = [part for part in parts if not isinstance(part, Ticks)]
        for entry in single(parts):
            if isinstance(entry, Tick):
                t, is_reading = entry.t, False
            elif isinstance(entry, StepRecord):
                t, is_reading = entry.finished, entry.settled is not Settled.CONTROLLED
            else:
                continue
            if self._reference is None and not is_reading:
                continue
            values = entry.values
            if low <= values[self._drive] <= high:
                setpoint = math.nan if self._setpoint is None else values[self._setpoint.column]
                at_work = self._reference is not None and math.isfinite(values[self._reference])
                if at_work:
                    self._last_reference = values[self._reference or 0]
                output = values[self._response.column]
                row = _Row(t, entry.step, values[self._drive], output, setpoint, self._last_reference, is_reading)
                yield row, at_work

    def _stand(self, rows: Sequence[_Row], predicted: Floats, beyond: npt.NDArray[np.bool_]) -> None:
        """Note how it stands at each row; what stood before the last row of the last call is forgotten."""
        del self._standings[:-1]
        readings, covered, count = self._standings[-1][1:4] if self._standings else (0, 0, 0)
        for row, output, is_beyond in zip(rows, predicted.tolist(), beyond.tolist(), strict=True):
            count += is_beyond
            if row.is_reading and math.isfinite(row.output):
                readings += 1
                covered += abs(row.output - output) <= self._band.half_width
            self._standings.append(_Standing(row.t, readings, covered, count))

    def _setpoint_widths(self, rows: Sequence[_Row], *, seen: bool = True) -> Floats:
        """Return the half-width about the set-point of each row, that of the last move; moves the memory."""
        setpoints = np.array([row.setpoint for row in rows])
        known = np.isfinite(setpoints)
        places = np.flatnonzero(known)
        moved = places[np.diff(setpoints[places], prepend=self._set) != 0.0]
        widths = np.full(len(rows), np.nan)
        if moved.size:
            path = setpoints[moved]
            if seen:
                found = input_half_widths(self._operator, path, self._band.half_width, self._set_state)
                widths = np.append(self._set_width, found)[np.searchsorted(moved, np.arange(len(rows)), side="right")]
            self._set_state = self._operator.advance(self._set_state, path)
            self._set = float(path[-1])
        else:
            widths[:] = self._set_width
        self._set_width = float(widths[-1])
        return widths


def _parted(middle: Floats, widths: Floats | float, beyond: npt.NDArray[np.bool_]) -> list[Floats]:
    """Return lower and upper ends, each shape (N,), within the inputs that were fitted, then beyond them."""
    return [np.where(where, middle + sign * widths, np.nan) for where in (~beyond, beyond) for sign in (-1.0, 1.0)]


def banded_model(models: Sequence[ModelFile], units: tuple[str, str], *, is_controlled: bool) -> ModelFile | None:
    """Return the model whose band is shown, of those with a band and with these units of input and output, if any.

    Under control it is the first, which the run was given; otherwise the last, which was identified from the run.
    """
    fitting = [
        file
        for file in models
        if file.band is not None
        and isinstance(file.model, Operator)
        and (file.model.input_unit, file.model.output_unit) == units
    ]
    return fitting[0 if is_controlled else -1] if fitting else None
