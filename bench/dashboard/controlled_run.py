"""A run under control over time: reference and output, error on its own scale, and estimated disturbance."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from bench.base import Floats, fitting_prefix
from bench.dashboard.arrangement import seldom
from bench.dashboard.drawing import FAINT, Colour, time_view
from bench.dashboard.entries import End, Part, Ticks
from bench.dashboard.rerun_recording import RerunRecording, times
from bench.dashboard.signal_plots import find_column
from bench.devices import Settled, Signal
from bench.protocol import TRACES
from bench.record import StepRecord

WITNESS = "witness"
"""Slot of a sensor of the controlled quantity that the controller does not use: it tells error from noise."""

TRACE_NAMES = tuple(signal.name for signal in TRACES)

LAST_TARGETS = 10
"""Targets that the scale of the error and its RMS are taken from.

Derivation: the RMS of n errors is uncertain by 1 / √(2 n), 22 %.
"""
_RECENT_TICKS = 2000
"""Ticks that the RMS is taken from where there are no targets. Derivation: as `LAST_TARGETS`, 1.6 %."""

# Source: WCAG 2.2, 1.4.11: each has a contrast of 3 to 1 or more to the nearly black background of the viewer.
_OUTPUT: Colour = (236, 100, 46)
_PREDICTED: Colour = (150, 110, 190)
_REFERENCE: Colour = (112, 168, 226)
# Between the targets an error is that of a transient.
_ERROR: Colour = FAINT
_AT_TARGET: Colour = (236, 100, 46)
_WITNESSED: Colour = (30, 170, 170)
_DISTURBANCE: Colour = (30, 170, 170)
_BAND: Colour = (132, 142, 158)


@dataclass(frozen=True)
class ControlPlots:
    """Columns of the controlled signal and of `TRACES`, the range of the former, and the units shown."""

    output: int  # column of the controlled signal
    traces: tuple[int, ...]  # columns of reference, predicted output, disturbance and its uncertainty
    extent: tuple[float, float] | None  # range of the output
    # Of outputs.
    factor: float
    unit: str
    # Of errors, which are smaller.
    error_factor: float
    error_unit: str
    witness: int | None = None  # column of a further sensor of the controlled quantity

    @classmethod
    def of(
        cls, signals: Sequence[Signal], controls: str, extent: tuple[float, float] | None, witness: str = ""
    ) -> ControlPlots:
        """Return the plots of a run whose controllers control the signal `controls`, which `witness` sees as well."""
        output, *traces = (find_column(signals, "controls", name) for name in (controls, *TRACE_NAMES))
        signal = signals[output]
        unit = signal.display.factor, signal.display.unit
        # What an error comes down to: a thousandth of the range, or the last digits that are worth showing.
        error_unit = fitting_prefix(
            signal.unit, 1e-3 * (extent[1] - extent[0]) if extent else 10.0 ** (1 - signal.precision)
        )
        beside = find_column(signals, WITNESS, witness) if witness else None
        return cls(output, tuple(traces), extent, *unit, *error_unit, witness=beside)

    def is_at_work(self, values: Floats) -> npt.NDArray[np.bool_]:
        """Return for values, a row each tick, whether a controller was at work when it was taken."""
        return np.isfinite(values[:, self.traces[0]])

    def series(self, values: Floats) -> dict[str, Floats]:
        """Return what is plotted of ticks: by plot, one row a tick, one column a line, in its unit."""
        reference, predicted, disturbance, uncertainty = values[:, self.traces].T
        output = values[:, self.output]
        band = 2.0 * uncertainty
        if self.extent is not None:
            # Before the first estimate, the uncertainty only bounds the size of any disturbance.
            band[band > self.extent[1] - self.extent[0]] = np.nan
        around = np.where(np.isfinite(reference), 0.0, np.nan)
        errors = [around - band, around + band, output - reference]
        if self.witness is not None:
            errors.append(values[:, self.witness] - reference)
        return {
            "tracking": self.factor * np.column_stack([reference, predicted, output]),
            "error": self.error_factor * np.column_stack(errors),
            "disturbance": self.factor * np.column_stack([disturbance - band, disturbance + band, disturbance]),
        }

    def styles(self) -> dict[str, rr.SeriesLines | rr.SeriesPoints]:
        """Return how the lines of `series` look; the last is on top, and each has a name of its own."""
        looks: dict[str, list[tuple[str, Colour, float]]] = {
            "tracking": [
                # Broad, so that it is seen below an output that reaches it.
                ("reference", _REFERENCE, 5.0),
                ("predicted", _PREDICTED, 1.0),
                ("output", _OUTPUT, 1.5),
            ],
            "error": [("− 2σ", _BAND, 1.5), ("+ 2σ", _BAND, 1.5), ("output − reference", _ERROR, 1.0)],
            "disturbance": [
                ("disturbance − 2σ", _BAND, 0.75),
                ("disturbance + 2σ", _BAND, 0.75),
                ("disturbance", _DISTURBANCE, 1.75),
            ],
        }
        if self.witness is not None:
            looks["error"].append((WITNESS, _WITNESSED, 1.25))
        styles: dict[str, rr.SeriesLines | rr.SeriesPoints] = {}
        for name, look in looks.items():
            names, colours, widths = zip(*look, strict=True)
            styles[name] = rr.SeriesLines(names=names, colors=colours, widths=widths)
        styles["error/targets"] = rr.SeriesPoints(
            names="mean at the target", colors=_AT_TARGET, marker_sizes=3.5, markers="circle"
        )
        return styles

    def views(
        self, shown: frozenset[str], error_range: float | None, *, banded: bool = False
    ) -> list[tuple[rrb.TimeSeriesView, int]]:
        """Return the plots of `series` that are `shown`, from top to bottom, with their heights.

        `error_range` is what the plot of the error shows to either side of zero, in its unit; `banded` says whether
        a prediction band is there, too.
        """
        views = []
        if "tracking" in shown:
            title = f"Tracking [{self.unit}]: output (orange), reference (pale blue), predicted (violet)"
            views.append((time_view("/control/tracking", title), 4))
        if "error" in shown:
            y = None if error_range is None else (-error_range, error_range)
            title = f"Error [{self.error_unit}]: each tick within ± 2σ, mean at each target (points)"
            if self.witness is not None:
                title = f"Error [{self.error_unit}]: each tick within ± 2σ, and of the witness (green)"
            if banded:
                title += ", band"
            views.append((time_view("/control/error", title, y=y), 6))
        if "disturbance" in shown:
            views.append((time_view("/control/disturbance", f"Disturbance ± 2σ [{self.unit}]"), 3))
        return views


class ErrorPlot:
    """The errors of a run under control: those at its last targets, and that of now.

    A target ends with the readings that follow while no controller is at work; their mean less the last reference is
    the error at the target. A reference that moves has no targets: the error of every tick counts.

    `now` is the present error, in the unit of the output; nan before a controller was at work.
    """

    def __init__(self, plots: ControlPlots) -> None:
        self.now = self.target = math.nan
        self.output = plots.output
        self._plots = plots
        self._at_targets: deque[tuple[float, int, float]] = deque(maxlen=LAST_TARGETS)
        self._not_written: list[tuple[float, int, float]] = []
        self._recent: deque[float] = deque(maxlen=_RECENT_TICKS)
        self._witnessed: deque[float] = deque(maxlen=_RECENT_TICKS)
        self._readings: list[float] = []
        self._read_at = (0.0, 0)

    def see(self, part: Part) -> None:
        """Take ticks, a finished step, or the end into account."""
        if isinstance(part, Ticks):
            self._see_control(part.values)
        elif isinstance(part, StepRecord):
            output = part.values[self._plots.output]
            if math.isfinite(part.values[self._plots.traces[0]]):
                self._see_control(np.array([part.values]))
            elif part.settled is not Settled.CONTROLLED and math.isfinite(self.target) and math.isfinite(output):
                self._readings.append(output)
                self._read_at = part.finished, part.step
                self.now = self._mean_error()
        elif isinstance(part, End):
            self._end_target()

    def _see_control(self, values: Floats) -> None:
        """Take the rows into account at which a controller was at work."""
        at_work = values[self._plots.is_at_work(values)]
        if not len(at_work):
            return
        self._end_target()
        references = at_work[:, self._plots.traces[0]]
        self.target = float(references[-1])
        errors = at_work[:, self._plots.output] - references
        if (known := errors[np.isfinite(errors)]).size:
            self._recent.extend(known[-_RECENT_TICKS:].tolist())
            self.now = self._recent[-1]
        if self._plots.witness is not None:
            errors = at_work[:, self._plots.witness] - references
            self._witnessed.extend(errors[np.isfinite(errors)][-_RECENT_TICKS:].tolist())

    def _mean_error(self) -> float:
        return sum(self._readings) / len(self._readings) - self.target

    def _end_target(self) -> None:
        if self._readings:
            ended = (*self._read_at, self._mean_error())
            self._at_targets.append(ended)
            self._not_written.append(ended)
            self._readings = []

    def write(self, recording: RerunRecording) -> None:
        """Write the errors at the targets that have ended since the last call."""
        if self._not_written:
            t, step, error = zip(*self._not_written, strict=True)
            values = self._plots.error_factor * np.array(error)[:, None]
            recording.send_vectors("control/error/targets", times(t, step), values)
            self._not_written = []

    def rms(self) -> tuple[str, float]:
        """Return the RMS of the errors at the last targets, or of late where there are none, behind its name."""
        if self._at_targets:
            errors = [error for _, _, error in self._at_targets]
            name = f"RMS of the last {len(errors)} targets"
        else:
            errors, name = list(self._recent), "RMS of the error of late"
        return name, _rms(errors)

    def rms_of_witness(self) -> float:
        """Return the RMS of the errors of late that the witness sees; nan if there is none."""
        return _rms(list(self._witnessed))

    def range(self) -> float | None:
        """Return what the plot of the error shows to either side of zero, in its unit.

        It is the greatest error at the last targets, and changes by factors of two. None leaves it to the data where
        there are no targets.
        """
        greatest = max((abs(error) for _, _, error in self._at_targets), default=0.0)
        return seldom(self._plots.error_factor * greatest) if greatest else None

    def seconds_bright(self, now: float) -> float:
        """Return for how long back from a time (s) the last targets reach, s; inf if there were no more."""
        full = len(self._at_targets) == LAST_TARGETS
        return now - self._at_targets[0][0] if full else math.inf


def _rms(errors: Sequence[float]) -> float:
    return math.sqrt(sum(error * error for error in errors) / len(errors)) if errors else math.nan
