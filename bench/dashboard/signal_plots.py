"""Signals over time, one plot a unit."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from bench.base import ConfigurationError, Floats, closest
from bench.dashboard.drawing import Colour, pale, time_view
from bench.devices import Signal
from bench.rig import SETPOINT

_SETPOINT_PART = 0.45
"""Part of a device's colour in that of its set-point, whose broad line lies below the measured one.

Derivation: less than half, so that the measured one stands out.
"""
# Source: WCAG 2.2, 1.4.11: each has a contrast of 3 to 1 or more to a nearly black and a nearly white background.
_PALETTE: tuple[Colour, ...] = (
    (236, 100, 46),
    (58, 132, 232),
    (48, 162, 86),
    (176, 92, 226),
    (150, 112, 72),
    (22, 160, 160),
    (226, 88, 136),
    (128, 146, 44),
)
_COLOUR_NAMES = ("orange", "blue", "green", "violet", "brown", "teal", "pink", "olive")
_READING = 1.25
"""Size of the point of a reading; in a hold that is shorter than a tick there is nothing else.

Derivation: less than the width of a line, 1.5, which hides it elsewhere.
"""
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
    """The signals of one unit: their columns, the factor to the unit shown, and how ticks and readings look."""

    path: str
    title: str
    columns: list[int]
    factor: float
    styles: Mapping[str, rr.SeriesLines | rr.SeriesPoints]

    def series(self, values: Floats) -> Floats:
        """Return what is plotted of values, one row a time, one column a signal."""
        return values[:, self.columns] * self.factor

    def view(self) -> rrb.TimeSeriesView:
        """Return the view of the ticks, as lines, and of the readings, as points."""
        # A legend would hide what is below it: the title says which colour is what.
        view = time_view(f"/signals/{self.path}", self.title)
        view.contents = ["$origin/**", f"/readings/{self.path}"]
        return view


def plots_by_unit(signals: Sequence[Signal], omitted: Collection[str]) -> list[SignalPlot]:
    """Return one plot a unit, of the signals that are not `omitted`."""
    shown_signals = [(i, signal) for i, signal in enumerate(signals) if signal.name not in omitted]
    plots = []
    for unit in dict.fromkeys(signal.unit for _, signal in shown_signals):
        columns = [i for i, signal in shown_signals if signal.unit == unit]
        # The set-points first, as what comes last is on top.
        columns.sort(key=lambda i: not signals[i].name.endswith(SETPOINT))
        members = [signals[i] for i in columns]
        display = members[0].display
        factor, shown = display.factor, display.unit
        quantity = _QUANTITIES.get(unit, unit)
        title = quantity if len(members) > 1 else members[0].description
        look: dict[str, Any] = {
            "names": [f"{signal.name} [{shown}]" if shown else signal.name for signal in members],
            "colors": [_colour(signals, i) for i in columns],
        }
        styles: dict[str, rr.SeriesLines | rr.SeriesPoints] = {
            "readings": rr.SeriesPoints(**look, marker_sizes=[_READING] * len(members), markers="circle"),
            "signals": rr.SeriesLines(
                **look, widths=[4.0 if signal.name.endswith(SETPOINT) else 1.5 for signal in members]
            ),
        }
        path = rr.escape_entity_path_part(quantity)
        headline = f"{title[:1].upper()}{title[1:]}" + (f" [{shown}]" if shown else "")
        if legend := _legend(signals, columns, quantity):
            headline += f": {legend}"
        plots.append(SignalPlot(path, headline, columns, factor, styles))
    return plots


def find_column(signals: Sequence[Signal], key: str, name: str) -> int:
    """Return the column of the signal that `key` of the layout names."""
    names = [signal.name for signal in signals]
    if name not in names:
        raise ConfigurationError(f"dashboard: {key}: there is no signal {name!r}; {closest(name, names)}")
    return names.index(name)


def _legend(signals: Sequence[Signal], columns: Sequence[int], quantity: str) -> str:
    """Return which signal has which colour, as short as the tab of a view is; empty if there is one only.

    A set-point is the pale line below what follows it. The device that all are of, and the quantity, are left out.
    """
    columns = [i for i in columns if _follower(signals, i) == i]
    names = [signals[i].name for i in columns]
    if len(names) < 2:
        return ""
    device = names[0].partition("_")[0] + "_"
    if all(name.startswith(device) for name in names):
        names = [name.removeprefix(device) for name in names]
    names = [name.removesuffix(f"_{quantity}").replace("_", " ") for name in names]
    named = zip(names, columns, strict=True)
    return ", ".join(f"{name} {_COLOUR_NAMES[column % len(_COLOUR_NAMES)]}" for name, column in named)


def _colour(signals: Sequence[Signal], column: int) -> Colour:
    """Return the colour of a signal; a set-point has a paler one of what follows it, the next of its device."""
    colour = _PALETTE[_follower(signals, column) % len(_PALETTE)]
    if not signals[column].name.endswith(SETPOINT):
        return colour
    return pale(colour, _SETPOINT_PART, 150)


def _follower(signals: Sequence[Signal], column: int) -> int:
    """Return the column of what follows a set-point; that of another signal itself."""
    return next((i for i, signal in enumerate(signals) if follows(signal, signals[column])), column)


def follows(signal: Signal, setpoint: Signal) -> bool:
    """Return whether a signal is what the device of a set-point makes of it; nothing follows another signal."""
    device = setpoint.name.removesuffix(SETPOINT)
    is_of_it = device != setpoint.name != signal.name and signal.name.startswith(f"{device}_")
    return is_of_it and signal.unit == setpoint.unit
