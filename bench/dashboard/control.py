"""A run under control over time: reference and output, error, and estimated disturbance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from bench.dashboard.drawing import INK, Colour, time_view
from bench.dashboard.recording import Floats
from bench.dashboard.signal_plots import find_column, likely_magnitude
from bench.devices import Signal
from bench.protocol import TRACES
from bench.units import fitting_prefix

TRACE_NAMES = tuple(signal.name for signal in TRACES)

_CLOSE = 0.01
"""Part of the output's range that the close view of the error shows to either side of zero."""

_OUTPUT: Colour = (255, 122, 72)
_PREDICTED: Colour = (150, 110, 190)
_ERROR: Colour = (255, 206, 84)
_DISTURBANCE: Colour = (64, 208, 206)
_BAND: Colour = (122, 132, 148)


@dataclass(frozen=True)
class ControlPlots:
    """Columns of the controlled signal and of `TRACES`, the range of the former, and the unit shown."""

    output: int
    traces: tuple[int, ...]
    extent: tuple[float, float] | None
    factor: float
    unit: str

    @classmethod
    def of(cls, signals: Sequence[Signal], controls: str, extent: tuple[float, float] | None) -> ControlPlots:
        """Return the plots of a run whose controllers control the signal `controls`."""
        output, *traces = (find_column(signals, "controls", name) for name in (controls, *TRACE_NAMES))
        factor, unit = fitting_prefix(signals[output].unit, *(extent or [likely_magnitude(signals[output])]))
        return cls(output, tuple(traces), extent, factor, unit)

    def is_at_work(self, values: Sequence[float]) -> bool:
        """Return whether a controller was at work when a tick was taken."""
        return math.isfinite(values[self.traces[0]])

    def series(self, values: Floats) -> dict[str, Floats]:
        """Return what is plotted of ticks: by plot, one row a tick, one column a line, in its unit."""
        reference, predicted, disturbance, uncertainty = self.factor * values[:, self.traces].T
        output = self.factor * values[:, self.output]
        band = 2.0 * uncertainty
        if self.extent is not None:
            # Before the first estimate, the uncertainty only bounds the size of any disturbance.
            band[band > self.factor * (self.extent[1] - self.extent[0])] = np.nan
        around = np.where(np.isfinite(reference), 0.0, np.nan)
        return {
            "tracking": np.column_stack([reference - band, reference + band, predicted, output, reference]),
            "error": np.column_stack([output - reference, around - band, around + band]),
            "disturbance": np.column_stack([disturbance - band, disturbance + band, disturbance]),
        }

    def styles(self) -> dict[str, rr.SeriesLines]:
        """Return how the lines of `series` look."""
        looks = {
            # The last line is on top. Lines of one name are one entry of the legend.
            "tracking": [
                *[("reference ± 2σ", _BAND, 0.75)] * 2,
                ("predicted", _PREDICTED, 1.0),
                ("output", _OUTPUT, 2.0),
                ("reference ± 2σ", INK, 1.0),
            ],
            "error": [("output − reference", _ERROR, 1.0), *[("± 2σ", _BAND, 1.0)] * 2],
            "disturbance": [*[("± 2σ", _BAND, 0.75)] * 2, ("disturbance", _DISTURBANCE, 1.75)],
        }
        return {
            name: rr.SeriesLines(names=names, colors=colours, widths=widths)
            for name, (names, colours, widths) in ((name, zip(*look, strict=True)) for name, look in looks.items())
        }

    def views(self) -> list[rrb.TimeSeriesView | rrb.Tabs]:
        """Return the plots of `series`, from top to bottom."""
        error: rrb.TimeSeriesView | rrb.Tabs = time_view("/control/error", f"Error ± 2σ [{self.unit}]")
        if self.extent is not None:
            # A new target lies far away; at the scale of the way there, the error at the target is invisible.
            most = _CLOSE * self.factor * (self.extent[1] - self.extent[0])
            close = time_view("/control/error", f"Error ± 2σ, close [{self.unit}]", y=(-most, most))
            error = rrb.Tabs(close, error, active_tab=0)
        return [
            time_view("/control/tracking", f"Tracking [{self.unit}]", rrb.Corner2D.LeftTop),
            error,
            time_view("/control/disturbance", f"Disturbance ± 2σ [{self.unit}]"),
        ]
