"""Figures of control: targets or a moving reference, the outputs under several controllers, and their errors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from bench.analysis.figures.canvas import drawn, legend_above, outline
from bench.analysis.figures.colors import REFERENCE, color_of
from bench.analysis.figures.fits import draw_published
from bench.base import Floats

_START = 0.2
"""Share of a record that may belong to the start, in which the controller finds the reference."""
_FAR = 1.5
"""The start is cut off if it goes so many times beyond the rest."""


def plot_tracking(
    path: Path,
    reference: Floats,
    outputs: Mapping[str, Floats],
    *,
    horizontal: Floats | None = None,
    horizontal_label: str = "index of the target",
    output_label: str,
    error_label: str,
    names: Mapping[str, str] | None = None,
    published: Mapping[str, float] | None = None,
) -> None:
    """Draw a reference and the outputs under several controllers, and below it their errors.

    A moving reference is a wide grey line below the outputs, targets are horizontal marks. The scale of the errors
    over time is that of the record after its first fifth, if the start goes far beyond it; the greatest error of the
    start is then said.

    Parameters
    ----------
    reference : ndarray, shape (N,)
        Output units, as all that follows.
    outputs : mapping of str to ndarray
        By the controller's title, shape (N,) each.
    horizontal : ndarray, shape (N,), optional
        Positions, such as times; the index if not given.
    names : mapping of str to str, optional
        Names of the controllers by their titles, which decide the colours.
    published : mapping of str to float, optional
        Largest error that a paper states, by the same titles.
    """
    by_target = horizontal is None
    places = np.arange(reference.size, dtype=np.float64) if horizontal is None else horizontal
    errors = {title: output - reference for title, output in outputs.items()}
    with drawn(path, (6.0, 5.5)) as figure:
        top, bottom = figure.subplots(2, 1, sharex=True)
        if by_target:
            style = {"marker": "_", "markersize": 9.0, "markeredgewidth": 1.2, "linestyle": "none"}
            top.plot(places, reference, color=REFERENCE, label="target", zorder=1.9, **style)
        else:
            top.plot(*outline(places, reference), color="#b8b8b8", linewidth=3.2, label="reference", zorder=1.9)
        bottom.axhline(0.0, color="black", linewidth=0.5)
        for title, output in outputs.items():
            color = color_of((names or {}).get(title, title))
            if by_target:
                shown = {"marker": ".", "markersize": 4.5, "markeredgewidth": 0.0, "linestyle": "none"}
                top.plot(places, output, color=color, label=title, **shown)
                bottom.plot(places, errors[title], color=color, linewidth=0.4, alpha=0.5)
                bottom.plot(places, errors[title], color=color, label=title, **shown)
            else:
                top.plot(*outline(places, output), color=color, linewidth=0.9, label=title)
                bottom.plot(*outline(places, errors[title]), color=color, linewidth=0.8, label=title)
            draw_published(bottom, (published or {}).get(title), color)
        top.set_ylabel(output_label)
        bottom.set(xlabel=horizontal_label, ylabel=error_label)
        legend_above(top, markers=1.0)
        if not by_target and (said := _limits(places, errors)) is not None:
            bottom.set_ylim(*said[0])
            bottom.set_title(said[1], fontsize=7.5, loc="left")


def _limits(places: Floats, errors: Mapping[str, Floats]) -> tuple[tuple[float, float], str] | None:
    """Return limits of the errors after the start, and what is cut off; None if nothing has to be."""
    late = places >= places[0] + _START * (places[-1] - places[0])
    rest = np.concatenate([error[late] for error in errors.values()])
    most = float(np.abs(rest[np.isfinite(rest)]).max(initial=0.0))
    first = {title: float(np.nanmax(np.abs(error), initial=0.0)) for title, error in errors.items()}
    beyond = {title: value for title, value in first.items() if value > _FAR * most}
    if not beyond or most == 0.0:
        return None
    texts = ", ".join(f"{title} {value:.3g}" for title, value in beyond.items())
    return (-1.15 * most, 1.15 * most), f"beyond the scale at the start, greatest error: {texts}"
