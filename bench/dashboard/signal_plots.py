"""Signals over time, one plot a unit."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import rerun as rr
import rerun.blueprint as rrb

from bench.dashboard.drawing import Colour, time_view
from bench.dashboard.recording import Floats
from bench.devices import Signal
from bench.errors import ConfigurationError
from bench.units import fitting_prefix

_SETPOINT: Colour = (150, 158, 168)
_PALETTE: tuple[Colour, ...] = (
    (255, 122, 72),
    (78, 160, 255),
    (98, 208, 126),
    (214, 128, 255),
    (255, 206, 84),
    (64, 208, 206),
    (255, 128, 170),
    (178, 196, 98),
)
_QUANTITIES = {
    "°C": "temperature",
    "K": "temperature difference",
    "A": "current",
    "V": "voltage",
    "W": "power",
    "m": "position",
    "N": "force",
    "1/m": "curvature",
    "rad": "angle",
    "rad/s": "angular velocity",
    "Ω": "resistance",
    "1": "number",
}


@dataclass(frozen=True)
class SignalPlot:
    """The signals of one unit: their columns, the factor to the unit shown, and how the lines look."""

    path: str
    title: str
    columns: list[int]
    factor: float
    height: int
    style: rr.SeriesLines

    def series(self, values: Floats) -> Floats:
        """Return what is plotted of values, one row a time, one column a signal."""
        return values[:, self.columns] * self.factor

    def view(self) -> rrb.TimeSeriesView:
        """Return the view of the ticks."""
        legend = rrb.Corner2D.RightBottom if len(self.columns) > 1 else None
        return time_view(f"/signals/{self.path}", self.title, legend)


def plots_by_unit(
    signals: Sequence[Signal], ranges: Mapping[str, tuple[float, float]], omitted: Collection[str]
) -> list[SignalPlot]:
    """Return one plot a unit, of the signals that are not `omitted`; `ranges` are those on axes, by signal."""
    shown_signals = [(i, signal) for i, signal in enumerate(signals) if signal.name not in omitted]
    plots = []
    for unit in dict.fromkeys(signal.unit for _, signal in shown_signals):
        columns = [i for i, signal in shown_signals if signal.unit == unit]
        members = [signals[i] for i in columns]
        extents = [ranges[signal.name] for signal in members if signal.name in ranges]
        factor, shown = fitting_prefix(unit, *(extents[0] if extents else [likely_magnitude(members[0])]))
        quantity = _QUANTITIES.get(unit, unit)
        title = quantity if len(members) > 1 else members[0].description
        style = rr.SeriesLines(
            names=[f"{signal.name} [{shown}]" for signal in members],
            colors=[_colour(signals[i].name, i) for i in columns],
            widths=[1.5] * len(members),
        )
        path = rr.escape_entity_path_part(quantity)
        headline = f"{title[:1].upper()}{title[1:]} [{shown}]"
        plots.append(SignalPlot(path, headline, columns, factor, 2 if extents else 1, style))
    return plots


def find_column(signals: Sequence[Signal], key: str, name: str) -> int:
    """Return the column of the signal that `key` of the layout names."""
    names = [signal.name for signal in signals]
    if name not in names:
        raise ConfigurationError(f"dashboard: {key}: there is no signal {name!r}; there are: {', '.join(names)}")
    return names.index(name)


def likely_magnitude(signal: Signal) -> float:
    """Return the likely magnitude of a signal's values, judged by the digits that are worth showing."""
    return float(10.0 ** (3 - signal.precision))


def _colour(name: str, position: int) -> Colour:
    return _SETPOINT if name.endswith("_setpoint") else _PALETTE[position % len(_PALETTE)]
