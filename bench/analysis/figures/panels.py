"""Figures of several panels: sets of curves on the same axes, signals over time, a histogram."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from bench.analysis.figures.canvas import apart, drawn, outline
from bench.analysis.figures.colors import MEASURED, color_of, series_color

Floats = npt.NDArray[np.float64]


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
        for i, (axes, (title, curves)) in enumerate(zip(grid.flat, panels.items(), strict=False)):
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
            if i == 0 and any(curve.label for curve in curves):
                axes.legend(fontsize=6.5, markerscale=2.5)
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)
        for axes in grid[-1]:
            axes.set_xlabel(horizontal_label)
        for axes in grid[:, 0]:
            axes.set_ylabel(vertical_label)


def plot_signals(
    path: Path,
    hours: Floats,
    signals: Mapping[str, Floats],
    labels: Sequence[str],
    *,
    horizontal_label: str = "laboratory time / h",
) -> None:
    """Draw signals, each of shape (N,), over laboratory time in h or other positions; labels include units."""
    with drawn(path, (7.0, 0.8 + 1.2 * len(signals))) as figure:
        panels = figure.subplots(len(signals), 1, sharex=True, squeeze=False)[:, 0]
        for i, values in enumerate(signals.values()):
            panels[i].plot(*outline(hours, values), color=series_color(i), linewidth=0.7)
            panels[i].set_ylabel(labels[i], rotation=0, ha="right", va="center", fontsize=8)
        panels[-1].set_xlabel(horizontal_label)


def plot_histogram(path: Path, values: Floats, *, label: str, limit: float | None = None) -> None:
    """Draw how often values of shape (N,) occur, on a logarithmic scale of counts; `limit` is drawn as a line."""
    with drawn(path, (6.0, 2.8)) as figure:
        axes = figure.subplots()
        axes.hist(values, bins=60, color=series_color(1), log=True)
        if limit is not None:
            axes.axvline(limit, color="black", linestyle="--", linewidth=0.8, label="period")
            axes.legend(fontsize=7.5)
        axes.set(xlabel=label, ylabel="samples")
