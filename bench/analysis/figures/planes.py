"""Figures of Preisach planes: densities, their uncertainties, and what was swept."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from bench.analysis.figures.canvas import drawn
from bench.base import Floats, per_square, with_unit
from bench.models import Density, MemoryCurve

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_MOST_CELLS = 2500
"""Beyond so many cells a plane is a picture in a figure of lines."""
_ZERO = "#ececec"
"""Colour of a cell whose density is zero."""


def plot_densities(
    path: Path,
    densities: Sequence[Density],
    swept: npt.NDArray[np.bool_] | Sequence[npt.NDArray[np.bool_] | None] | None = None,
    *,
    uncertainties: Floats | None = None,
) -> None:
    """Draw Preisach densities on their planes, side by side, under their titles.

    A cell whose density is zero is light grey; one that the excitation never swept is hatched: a density there
    does not come from the data.

    Parameters
    ----------
    densities : sequence of Density
        What to draw.
    swept : ndarray of bool, shape (K,), or a sequence of them, optional
        Which cells were swept, as in `Preisach`; of each density where there are several, None where it is not known.
    uncertainties : ndarray, shape (K,), optional
        Standard uncertainties of the only density, in its unit; drawn beside it.
    """
    known = list(swept) if isinstance(swept, Sequence) else [swept] * len(densities)
    count = len(densities) + (uncertainties is not None)
    with drawn(path, (5.2 * count, 4.2), grid=False) as figure:
        panels = figure.subplots(1, count, squeeze=False)[0]
        for axes, density, cells in zip(panels, densities, known, strict=False):
            _draw_density(axes, density, density.values, cells, "density")
        if uncertainties is not None:
            values = np.full(densities[0].values.shape, np.nan)
            values[np.tril_indices(len(values))] = uncertainties
            _draw_density(panels[-1], densities[0], values, known[0], "σ of the density")


def _draw_density(
    axes: Axes, density: Density, values: Floats, swept: npt.NDArray[np.bool_] | None, label: str
) -> None:
    from matplotlib.colors import ListedColormap

    found = values[np.isfinite(values)]
    signed = bool(found.size) and bool(found.min() < 0)
    largest = float(np.abs(found).max(initial=0.0)) or 1.0
    factor, unit = per_square(density.output_unit, density.unit, largest)
    flat = values.size > _MOST_CELLS
    style: dict[str, Any] = {"rasterized": flat, "edgecolors": "none"}
    levels = density.levels
    is_zero = values == 0.0
    if swept is not None:
        is_zero[np.tril_indices(len(values))] &= swept
    zero = np.ma.masked_where(~is_zero, values)
    if not zero.mask.all():
        axes.pcolormesh(levels, levels, zero, cmap=ListedColormap([_ZERO]), **style)
    image = axes.pcolormesh(
        levels,
        levels,
        np.ma.masked_where(~(np.abs(values) > 0), factor * values),
        cmap="RdBu_r" if signed else "viridis",
        vmin=-factor * largest if signed else 0.0,
        vmax=factor * largest,
        **style,
    )
    notes = [] if zero.mask.all() else ["light grey: zero"]
    if swept is not None and not swept.all():
        _hatch(axes, levels, ~swept, len(values))
        notes.append(f"hatched: never swept ({np.mean(~swept):.0%})")
    _frame_plane(axes, density)
    axes.figure.colorbar(image, ax=axes, label=with_unit(label, unit))
    axes.set_title("  ".join([density.title, "; ".join(notes)]).strip(), fontsize=8.5, loc="left")


def _hatch(axes: Axes, levels: Floats, unknown: npt.NDArray[np.bool_], size: int) -> None:
    """Hatch the cells of which nothing is known."""
    from matplotlib.collections import PolyCollection

    rows, columns = (index[unknown] for index in np.tril_indices(size))
    left, right, low, high = levels[columns], levels[columns + 1], levels[rows], levels[rows + 1]
    corners = np.stack([np.stack(pair, 1) for pair in ((left, low), (right, low), (right, high), (left, high))], 1)
    axes.add_collection(
        PolyCollection(list(corners), facecolors="none", edgecolors="#9a9a9a", linewidths=0.0, hatch="////")
    )


def plot_coverage(
    path: Path,
    density: Density,
    swept: npt.NDArray[np.bool_],
    memory: MemoryCurve,
    resolution: Floats | None = None,
) -> None:
    """Draw which cells of a plane were swept, shape (K,) as in `Preisach`, and the memory curve at the end over them.

    With the resolution, shape (K,), from 0 to 1, it is drawn instead. Of the density only the levels and units count.
    """
    cells = np.full(density.values.shape, np.nan)
    cells[np.tril_indices(len(cells))] = swept if resolution is None else resolution
    corners = memory.corners(float(density.levels[0]), float(density.levels[-1]))
    with drawn(path, (4.6, 4.2), grid=False) as figure:
        axes = figure.subplots()
        image = np.ma.masked_invalid(cells)
        mesh = axes.pcolormesh(
            density.levels, density.levels, image, cmap="RdYlBu", vmin=0.0, vmax=1.0, alpha=0.6,
            rasterized=cells.size > _MOST_CELLS,
        )  # fmt: skip
        axes.plot(corners[:, 0], corners[:, 1], color="black", linewidth=1.5, label="memory curve at the end")
        _frame_plane(axes, density)
        if resolution is None:
            axes.set_title(f"blue: swept ({np.mean(swept):.0%} of the cells)", fontsize=9, loc="left")
        else:
            figure.colorbar(mesh, ax=axes, label="resolution (1: determined by the data)")
            axes.set_title(f"swept: {np.mean(swept):.0%} of the cells", fontsize=9, loc="left")
        axes.legend(loc="lower right", fontsize=7.5)


def _frame_plane(axes: Axes, density: Density) -> None:
    """Draw the diagonal of a plane, and label its axes."""
    ends = float(density.levels[0]), float(density.levels[-1])
    axes.plot(ends, ends, color="black", linewidth=0.8)
    labels = {"xlabel": with_unit("β", density.unit), "ylabel": with_unit("α", density.unit)}
    axes.set(**labels, aspect="equal", xlim=ends, ylim=ends)
