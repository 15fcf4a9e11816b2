"""Figures of models beside measurements: loops, outputs, and what is left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.analysis.figures.canvas import apart, drawn, legend_above, outline
from bench.analysis.figures.colors import MEASURED, SKIPPED, color_of, series_color
from bench.base import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_MODEL: dict[str, Any] = {"linewidth": 1.3, "alpha": 0.75}
"""Wide lines: the points of what was measured are drawn onto them."""
MOST_PHASES = 8
"""Most phases that are told apart by colours."""
_MOST_PANELS = 4
"""Most models whose residuals have a panel each."""


def draw_measured(
    axes: Axes, horizontal: Floats, vertical: Floats, *, label: str = "measured", color: str = MEASURED
) -> None:
    """Draw what was measured: points, dark ones if nothing else is said."""
    size = 2.6 if horizontal.size <= 1500 else 1.7
    axes.plot(
        *apart(horizontal, vertical),
        ".",
        color=color,
        markersize=size,
        markeredgewidth=0.0,
        label=label,
        zorder=2.0,
    )


def plot_loops(
    path: Path, inputs: Floats, outputs: Floats, *, input_label: str, output_label: str, phases: Sequence[str] = ()
) -> None:
    """Draw loops, one sample a step, shape (N,); a few phases have colours of their own."""
    names = list(dict.fromkeys(phases))
    with drawn(path, (6.0, 4.2)) as figure:
        axes = figure.subplots()
        if 1 < len(names) <= MOST_PHASES:
            of = np.array([names.index(name) for name in phases])
            for i, name in enumerate(names):
                # What follows another phase is not joined to what comes before it.
                part = np.where(of == i, outputs, np.nan)
                axes.plot(inputs, part, "-", color=series_color(i), linewidth=0.5, alpha=0.6, label="_")
                draw_measured(axes, inputs, part, label=name, color=series_color(i))
            legend_above(axes)
        else:
            axes.plot(inputs, outputs, "-", color=SKIPPED, linewidth=0.5)
            draw_measured(axes, inputs, outputs)
        axes.set(xlabel=input_label, ylabel=output_label)


def plot_errors(
    path: Path,
    errors: Mapping[str, Floats],
    *,
    error_label: str,
    inputs: tuple[Floats, str] | None = None,
    skip: int = 0,
    names: Mapping[str, str] | None = None,
    published: Mapping[str, float] | None = None,
    bands: Mapping[str, tuple[str, float]] | None = None,
) -> None:
    """Draw each error (measured minus modelled, shape (N,)) over the index, one panel a model, on one scale.

    Parameters
    ----------
    errors : mapping of str to ndarray
        By the title of the model.
    inputs : (ndarray of shape (N,), str), optional
        Input sequence that is drawn above the errors, and its label.
    skip : int
        First samples: drawn in grey, and not counted in the title.
    names : mapping of str to str, optional
        Names of the models by their titles, which decide the colours; the title itself if not given.
    published : mapping of str to float, optional
        Largest error that a paper states of a model, by its title: drawn as two lines.
    bands : mapping of str to (str, float), optional
        As in `plot_fit`, by the titles.
    """
    above, count = int(inputs is not None), len(errors)
    with drawn(path, (6.0, 1.0 + 1.6 * above + 1.7 * count)) as figure:
        ratios = (*[1.6] * above, *[1.0] * count)
        panels = figure.subplots(above + count, 1, sharex=True, squeeze=False, height_ratios=ratios)[:, 0]
        if inputs is not None:
            draw_measured(panels[0], np.arange(inputs[0].size, dtype=np.float64), inputs[0])
            panels[0].set_ylabel(inputs[1])
        for axes in panels[above + 1 :]:
            axes.sharey(panels[above])
        for axes, (title, error) in zip(panels[above:], errors.items(), strict=True):
            indices = np.arange(error.size, dtype=np.float64)
            axes.axhline(0.0, color="black", linewidth=0.5)
            color = color_of((names or {}).get(title, title))
            axes.plot(*outline(indices[skip:], error[skip:]), color=color, linewidth=0.7)
            if skip:
                axes.plot(*outline(indices[: skip + 1], error[: skip + 1]), color=SKIPPED, linewidth=0.7)
            axes.set_ylabel(error_label)
            most, rms = np.max(np.abs(error[skip:])), float(np.sqrt(np.mean(error[skip:] ** 2)))
            axes.set_title(f"{title}: max {most:.3g}, RMS {rms:.3g}", fontsize=9, loc="left")
            draw_published(axes, (published or {}).get(title), color)
            if bands and title in bands:
                _draw_band(axes, *bands[title], color)
                axes.set_title(f"{axes.get_title(loc='left')}; shaded: {bands[title][0]}", fontsize=9, loc="left")
        panels[-1].set_xlabel("index of the set-point")


def draw_published(axes: Axes, largest: float | None, color: str) -> None:
    """Draw the largest error that a paper states, on both sides of zero."""
    if largest is None:
        return
    for sign in (-1.0, 1.0):
        axes.axhline(sign * largest, color=color, linewidth=0.8, linestyle=(0, (5, 3)), label="_")
    axes.annotate(
        f"paper: max {largest:g}", (1.0, largest), xycoords=("axes fraction", "data"), ha="right", va="bottom",
        fontsize=7.0, color=color,
    )  # fmt: skip


def plot_fit(
    path: Path,
    horizontal: Floats,
    measured: Floats,
    modelled: Mapping[str, Floats],
    *,
    horizontal_label: str,
    output_label: str,
    error_label: str,
    titles: Mapping[str, str],
    skip: int = 0,
    names: Mapping[str, str] | None = None,
    bands: Mapping[str, tuple[str, float]] | None = None,
) -> None:
    """Draw measured and modelled outputs, and below them what each model leaves, on one scale.

    Parameters
    ----------
    horizontal, measured : ndarray, shape (N,)
        Where each sample is drawn, and its output.
    modelled : mapping of str to ndarray
        Outputs by the name of the model, shape (N,) each.
    titles : mapping of str to str
        What is said of the error of each model.
    skip : int
        First samples, which count in no error: drawn in grey.
    names : mapping of str to str, optional
        Registered names by those of `modelled`, where they differ; they decide the colours.
    bands : mapping of str to (str, float), optional
        Labels and half-widths of prediction bands by the same names; drawn about the residuals.
    """
    apiece = len(modelled) <= _MOST_PANELS
    rows = len(modelled) if apiece else 1
    with drawn(path, (6.0, 3.4 + (1.35 if rows > 1 else 2.1) * rows)) as figure:
        panels = figure.subplots(rows + 1, 1, sharex=True, height_ratios=(3, *[1.2 if rows > 1 else 2.0] * rows))
        top = panels[0]
        for axes in panels[2:]:
            axes.sharey(panels[1])
        draw_measured(top, horizontal[skip:], measured[skip:])
        for i, (name, values) in enumerate(modelled.items()):
            color = color_of((names or {}).get(name, name))
            bottom = panels[1 + i] if apiece else panels[1]
            top.plot(*outline(horizontal[skip:], values[skip:]), color=color, label=name, **_MODEL)
            residuals = measured - values
            if skip:
                # One sample more, so that the curve does not break.
                early = slice(0, skip + 1)
                bottom.plot(*outline(horizontal[early], residuals[early]), color=SKIPPED, linewidth=0.7, label="_")
                top.plot(*outline(horizontal[early], values[early]), color=SKIPPED, label="_", **_MODEL)
            if bands and name in bands:
                _draw_band(bottom, *bands[name], color)
            if horizontal.size <= _DENSE or not (np.diff(horizontal) >= 0.0).all():
                draw_residuals(bottom, horizontal[skip:], residuals[skip:], color, titles[name])
            else:
                bottom.plot(
                    *outline(horizontal[skip:], residuals[skip:]), color=color, linewidth=0.7, label=titles[name]
                )
        if skip:
            early = slice(0, skip + 1)
            rows_left_out = f"first {skip} samples, not in the errors"
            top.plot(*outline(horizontal[early], measured[early]), color=SKIPPED, linewidth=0.8, label=rows_left_out)
        for axes in panels[1:]:
            axes.axhline(0.0, color="black", linewidth=0.5)
            axes.set_ylabel(error_label)
            legend_above(axes)
        # Of what counts; the samples before may be far off.
        counted = np.concatenate([(measured - values)[skip:] for values in modelled.values()])
        widths = [width for _, width in (bands or {}).values()]
        least, most = (
            min([0.0, float(counted.min()), *(-w for w in widths)]),
            max([0.0, float(counted.max()), *widths]),
        )
        margin = 0.05 * (most - least) or 1e-12
        panels[1].set_ylim(least - margin, most + margin)
        top.set_ylabel(output_label)
        panels[-1].set_xlabel(horizontal_label)
        legend_above(top)


_DENSE = 3000
"""Most samples whose residuals are drawn as points over rows or time."""


def draw_residuals(axes: Axes, horizontal: Floats, residuals: Floats, color: str, label: str) -> None:
    """Draw residuals as points in the colour of their model."""
    axes.plot(
        *apart(horizontal, residuals), ".", color=color, markersize=2.0, markeredgewidth=0.0, label=label, zorder=2.5
    )


def _draw_band(axes: Axes, label: str, width: float, color: str) -> None:
    axes.axhspan(-width, width, color=color, alpha=0.15, linewidth=0.0, label=label, zorder=1.0)
