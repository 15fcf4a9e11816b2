"""The look of figures, and their files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.base import DataError, Floats, needed_for

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.limits": (-4, 5),
    "axes.formatter.useoffset": False,
    "legend.frameon": False,
    "figure.dpi": 150.0,
    "path.simplify_threshold": 0.25,
    # A line of a million points in one piece is more than the renderer takes.
    "agg.path.chunksize": 20000,
    # Texts stay texts: they can be searched, and edited for a journal.
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
}

_COLUMNS = 700
"""Columns of a panel in which a long record is told apart."""
_FEW = 1000
"""So many points are drawn each."""
_GRID = (700, 400)
"""Grid on which points of a panel are told apart."""


def check_matplotlib() -> None:
    """Import matplotlib, which takes half a second the first time.

    Raises MissingExtraError if it is not installed.
    """
    with needed_for("a figure", "report"):
        import matplotlib.figure  # noqa: F401


@contextmanager
def drawn(path: Path, size: tuple[float, float], *, grid: bool = True) -> Iterator[Figure]:
    """Give an empty figure of a size in inches, and save it; raise DataError if it cannot be written."""
    check_matplotlib()
    import matplotlib as mpl
    from matplotlib.figure import Figure

    # By its name, so that a figure comes out the same each time, and two on one page share no identifier.
    with mpl.rc_context({**_STYLE, "axes.grid": grid, "svg.hashsalt": path.stem}):
        figure = Figure(figsize=size, layout="constrained")
        yield figure
        _label_ticks_plainly(figure)
        undated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(path.suffix.lstrip("."))
        try:
            figure.savefig(path, metadata=undated)
        except OSError as error:
            raise DataError(f"figure {path} cannot be written: {error.strerror or error}") from None


def legend_above(axes: Axes, markers: float = 3.0) -> None:
    """Put the legend above the axes, where it covers no data, in as many columns as its texts leave room for."""
    handles, labels = axes.get_legend_handles_labels()
    if not handles:
        return
    size = 7.5
    # Of a character, and of what stands beside a text, in inches.
    width, beside = 0.58 * size / 72.0, 0.45
    room = float(axes.figure.bbox.width / axes.figure.dpi) - 0.9
    wrapped = ["\n".join(wrap(label, int((room - beside) / width))) for label in labels]
    longest = max(len(line) for label in wrapped for line in label.splitlines())
    columns = max(1, min(len(labels), int(room / (longest * width + beside))))
    axes.legend(
        handles, wrapped, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, fontsize=size,
        markerscale=markers, borderaxespad=0.2, columnspacing=1.2,
    )  # fmt: skip


def _label_ticks_plainly(figure: Figure) -> None:
    """Let only the factor of an axis be an equation: plain text looks the same, and an equation takes some 15 ms."""
    from matplotlib.ticker import ScalarFormatter

    class PlainTicks(ScalarFormatter):
        def get_offset(self) -> str:
            self.set_useMathText(True)
            factor = super().get_offset()
            self.set_useMathText(False)
            return str(factor)

    for axis in (axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)):
        if type(axis.get_major_formatter()) is ScalarFormatter:
            axis.set_major_formatter(PlainTicks())


def outline(horizontal: Floats, vertical: Floats) -> tuple[Floats, Floats]:
    """Return a long record over increasing positions with the least and the greatest value of each column only."""
    if horizontal.size <= 4 * _COLUMNS or not (np.diff(horizontal) >= 0.0).all():
        return horizontal, vertical
    span = float(horizontal[-1] - horizontal[0]) or 1.0
    columns = np.minimum(((horizontal - horizontal[0]) / span * _COLUMNS).astype(np.int64), _COLUMNS - 1)
    starts = np.flatnonzero(np.diff(columns, prepend=-1))
    # What is missing stays a gap: a column without a number has its ends only.
    kept = [starts, np.append(starts[1:], horizontal.size) - 1]
    known = np.flatnonzero(np.isfinite(vertical))
    by_value = known[np.lexsort((vertical[known], columns[known]))]
    # The first and the last of each column in that order.
    turns = np.flatnonzero(np.diff(columns[by_value], prepend=-1, append=-1))
    kept += [by_value[turns[:-1]], by_value[turns[1:] - 1]]
    chosen = np.unique(np.concatenate(kept))
    return horizontal[chosen], vertical[chosen]


def apart(horizontal: Floats, vertical: Floats) -> tuple[Floats, Floats]:
    """Return the points that a panel can tell apart, in their order."""
    known = np.isfinite(horizontal) & np.isfinite(vertical)
    horizontal, vertical = horizontal[known], vertical[known]
    if horizontal.size <= _FEW:
        return horizontal, vertical
    cells = []
    for values, count in zip((horizontal, vertical), _GRID, strict=True):
        cells.append(np.round((values - values.min()) / (float(np.ptp(values)) or 1.0) * count).astype(np.int64))
    _, first = np.unique(cells[0] * (_GRID[1] + 1) + cells[1], return_index=True)
    first.sort()
    return horizontal[first], vertical[first]
