"""Figures of several panels: sets of curves on the same axes, signals over time, a histogram."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.analysis.figures.canvas import apart, drawn, legend_above, outline
from bench.analysis.figures.colors import MEASURED, color_of, series_color
from bench.analysis.figures.fits import MOST_PHASES
from bench.base import Floats

_MARKED = 200
"""Most points that are joined by a thin line."""


class Curve(NamedTuple):
    """One curve: its name in the legend (empty for none) and its points, each of shape (N,)."""

    label: str
    horizontal: Floats
    vertical: Floats


def plot_panels(
    path: Path,
    panels: Mapping[str, Sequence[Curve]],
    *,
    horizontal_label: str,
    vertical_label: str,
    columns: int = 2,
    measured: Sequence[str] = (),
    names: Mapping[str, str] | None = None,
) -> None:
    """Draw several sets of curves on the same axes, one panel a set, by their titles; `columns` beside each other.

    The panels in `measured` show measurements as points, others lines. A curve that is alone in its panel has the
    colour of the model that `names` has for the title, or that of measurements.
    """
    rows = -(-len(panels) // columns)
    with drawn(path, (3.3 * columns, 0.4 + 2.6 * rows)) as figure:
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for axes, (title, curves) in zip(grid.flat, panels.items(), strict=False):
            for k, curve in enumerate(curves):
                color = series_color(k)
                if len(curves) == 1 and not curve.label:
                    color = MEASURED if title in measured else color_of((names or {}).get(title, title))
                style: dict[str, Any] = {"color": color, "label": curve.label}
                if title in measured:
                    points = apart(curve.horizontal, curve.vertical)
                    axes.plot(*points, ".", markersize=3.0, markeredgewidth=0.0, **style)
                    if curve.horizontal.size <= _MARKED:
                        axes.plot(curve.horizontal, curve.vertical, color=color, linewidth=0.3, alpha=0.6)
                else:
                    axes.plot(curve.horizontal, curve.vertical, "-", linewidth=0.8, **style)
            axes.set_title(title, fontsize=9, loc="left")
        if any(label for label in grid[0, 0].get_legend_handles_labels()[1]):
            figure.legend(
                *grid[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=2 * columns, fontsize=6.5,
                markerscale=2.5,
            )  # fmt: skip
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)
        for axes in grid[-1]:
            axes.set_xlabel(horizontal_label)
        for axes in grid[:, 0]:
            axes.set_ylabel(vertical_label)


def time_axis(seconds: float) -> tuple[float, str]:
    """Return the factor from s to the unit of a time axis of this length, and its label."""
    factor, unit = next((1.0 / each, unit) for each, unit, most in _TIMES if seconds <= most)
    return factor, f"time / {unit}"


_TIMES = ((1.0, "s", 600.0), (60.0, "min", 4 * 3600.0), (3600.0, "h", math.inf))
"""Seconds in a unit, the unit, and the longest axis in it, s."""


def plot_signals(
    path: Path,
    curves: Sequence[Curve],
    horizontal_label: str,
    phases: Sequence[tuple[str, float, float]] = (),
) -> None:
    """Draw curves below each other over one axis; their labels are those of the axes, and include units.

    Of a few phases, given by name, start and end on the horizontal axis, each has a colour behind the curves.
    """
    length = max((end for _, _, end in phases), default=0.0)
    phases = [each for each in phases if each[2] - each[1] > _VISIBLE * length]
    names = list(dict.fromkeys(name for name, _, _ in phases))
    is_told = 1 < len(names) <= MOST_PHASES
    with drawn(path, (7.0, 0.8 + 0.3 * is_told + 1.2 * len(curves))) as figure:
        panels = figure.subplots(len(curves), 1, sharex=True, squeeze=False)[:, 0]
        for axes, curve in zip(panels, curves, strict=True):
            for name, start, end in phases if is_told else ():
                i = names.index(name)
                is_named = axes is panels[0] and name not in axes.get_legend_handles_labels()[1]
                axes.axvspan(
                    start, end, color=series_color(i), alpha=0.13, linewidth=0.0, label=name if is_named else "_"
                )
            known = np.isfinite(curve.horizontal) & np.isfinite(curve.vertical)
            few = np.count_nonzero(known) <= _FEW_POINTS
            axes.plot(
                *outline(curve.horizontal, curve.vertical), color=MEASURED, linewidth=0.7, marker="." if few else "",
                markersize=3.0,
            )  # fmt: skip
            axes.set_ylabel(curve.label.replace(" / ", "\n/ "), rotation=0, ha="right", va="center", fontsize=8)
        legend_above(panels[0])
        panels[-1].set_xlabel(horizontal_label)


_VISIBLE = 0.003
"""Least part of the axis that a phase has to take to be seen. Derivation: two pixels of 600."""
_FEW_POINTS = 60
"""Points that are drawn as such, as some may have no neighbour."""


def plot_histogram(path: Path, values: Floats, *, label: str) -> None:
    """Draw how often values of shape (N,) occur, on a logarithmic scale of counts."""
    with drawn(path, (6.0, 2.8)) as figure:
        axes = figure.subplots()
        axes.hist(values, bins=60, color=series_color(1), log=True)
        axes.set(xlabel=label, ylabel="samples")
