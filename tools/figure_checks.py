"""What is wrong with a figure: axes that show nothing, legends over the data, texts that are cut off."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

_TOUCH = 2.0
"""Pixels by which boxes may overlap."""


def problems_of(figure: Figure) -> list[str]:
    """Return what is wrong with a figure, as sentences."""
    figure.draw_without_rendering()
    return [*_empty(figure), *_covered(figure), *_cut_off(figure)]


def _empty(figure: Figure) -> Iterator[str]:
    for i, axes in enumerate(figure.axes):
        if axes.get_visible() and not _shows_something(axes):
            yield f"axes {i} ({axes.get_ylabel()!r}) show nothing finite"


def _shows_something(axes: Axes) -> bool:
    # Lines over the whole width or height, and what marks phases, are no data.
    curves = [line for line in axes.lines if _points(axes, line).size]
    return bool(curves or axes.collections or axes.images or len(axes.containers))


def _points(axes: Axes, line: Line2D) -> np.ndarray:
    """Return the points of a curve in pixels; none of a line across the axes."""
    if line.get_transform() != axes.transData:
        return np.empty((0, 2))
    points = np.column_stack([np.asarray(each, dtype=np.float64) for each in line.get_data()])
    return np.asarray(axes.transData.transform(points[np.isfinite(points).all(axis=1)]))


def _covered(figure: Figure) -> Iterator[str]:
    for axes in figure.axes:
        legend = axes.get_legend()
        if legend is None:
            continue
        box = legend.get_window_extent()
        for other in figure.axes:
            points = [point for line in other.lines for point in _points(other, line)]
            covered = sum(bool(box.contains(x, y)) for x, y in points)
            if covered:
                yield f"a legend covers {covered} points of {other.get_ylabel()!r}"


def _cut_off(figure: Figure) -> Iterator[str]:
    page = figure.bbox
    for axes in figure.axes:
        texts = [axes.xaxis.label, axes.yaxis.label, axes.title, *axes.texts]
        boxes = [(each.get_text(), each.get_window_extent()) for each in texts if each.get_text()]
        legend = axes.get_legend()
        boxes += [("legend", legend.get_window_extent())] if legend is not None else []
        for name, box in boxes:
            if (
                box.x0 < page.x0 - _TOUCH
                or box.x1 > page.x1 + _TOUCH
                or box.y0 < page.y0 - _TOUCH
                or box.y1 > page.y1 + _TOUCH
            ):
                yield f"{name!r} is cut off"
