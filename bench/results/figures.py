"""Figures of runs and models, by matplotlib.

Each function draws one figure to the file `path`, PNG or PDF by its ending. Axis labels include units.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from bench.errors import DataError
from bench.extras import needed_for
from bench.hysteresis import Density, MemoryCurve
from bench.hysteresis.density import density_unit
from bench.units import with_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = npt.NDArray[np.float64]

_STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "figure.dpi": 150.0,
    "savefig.bbox": "tight",
    # A line of a million points in one piece is more than the renderer takes.
    "agg.path.chunksize": 20000,
}
_COLORS = ("#1b6ca8", "#d1495b", "#edae49", "#30638e", "#00798c")

_SKIPPED = "#a0a0a0"
"""Colour of what counts in no error."""

_MARKED = 200
"""Most samples of a curve that are marked one by one."""


def check_matplotlib() -> None:
    """Import matplotlib, which takes half a second the first time.

    Raises MissingExtraError if it is not installed.
    """
    with needed_for("a figure", "report"):
        import matplotlib.figure  # noqa: F401


@contextmanager
def _figure(path: Path, size: tuple[float, float], *, grid: bool = True) -> Iterator[Figure]:
    """Give an empty figure of a size in inches, and save it; raise DataError if it cannot be written."""
    check_matplotlib()
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({**_STYLE, "axes.grid": grid}):
        figure = Figure(figsize=size, layout="constrained")
        yield figure
        try:
            figure.savefig(path)
        except OSError as error:
            raise DataError(f"figure {path} cannot be written: {error.strerror or error}") from None


class Curve(NamedTuple):
    """One curve: its name in the legend (empty for none) and its points, each of shape (N,)."""

    label: str
    horizontal: Floats
    vertical: Floats


def plot_loops(
    path: Path, inputs: Floats, measured: Floats, modelled: Floats | None, *, input_label: str, output_label: str
) -> None:
    """Draw measured loops, one sample a step, and those of a model beside them; arrays of shape (N,)."""
    with _figure(path, (6.0, 4.2)) as figure:
        axes = figure.subplots()
        axes.plot(inputs, measured, "-", color=_COLORS[0], linewidth=0.8, label="measured")
        if modelled is not None:
            axes.plot(inputs, modelled, "--", color=_COLORS[1], linewidth=0.7, label="model")
            axes.legend(loc="upper left")
        axes.set(xlabel=input_label, ylabel=output_label)


def plot_errors(path: Path, errors: Mapping[str, Floats], *, error_label: str, skip: int = 0) -> None:
    """Draw each error (measured minus modelled, shape (N,)) over the index, one panel a model, by its title.

    The first `skip` samples are drawn in grey and do not count in the title.
    """
    with _figure(path, (6.0, 1.0 + 1.7 * len(errors))) as figure:
        panels = figure.subplots(len(errors), 1, sharex=True, squeeze=False)[:, 0]
        for i, (title, error) in enumerate(errors.items()):
            panels[i].plot(np.arange(skip, error.size), error[skip:], color=_COLORS[i % len(_COLORS)], linewidth=0.7)
            if skip:
                panels[i].plot(error[: skip + 1], color=_SKIPPED, linewidth=0.7)
            panels[i].set_ylabel(error_label)
            most, rms = np.max(np.abs(error[skip:])), float(np.sqrt(np.mean(error[skip:] ** 2)))
            panels[i].set_title(f"{title}: max {most:.3g}, RMS {rms:.3g}", fontsize=9, loc="left")
        panels[-1].set_xlabel("index of the set-point")


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
) -> None:
    """Draw measured and modelled outputs, and below them what is left, over the samples, time or input.

    Parameters
    ----------
    horizontal, measured : ndarray, shape (N,)
        Where each sample is drawn, and its output.
    modelled : mapping of str to ndarray
        Outputs by the name of the model, shape (N,) each.
    titles : mapping of str to str
        What the legend says of the error of each model.
    skip : int
        First samples, which count in no error: drawn in grey.
    """
    with _figure(path, (6.0, 5.5)) as figure:
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        top.plot(horizontal[skip:], measured[skip:], "-", color=_COLORS[0], linewidth=0.8, label="measured")
        for i, (name, values) in enumerate(modelled.items()):
            color = _COLORS[(i + 1) % len(_COLORS)]
            top.plot(horizontal[skip:], values[skip:], "--", color=color, linewidth=0.7, label=name)
            residuals = measured - values
            if skip:
                # One sample more, so that the curve does not break.
                early = slice(0, skip + 1)
                bottom.plot(horizontal[early], residuals[early], color=_SKIPPED, linewidth=0.7, label="_")
                top.plot(horizontal[early], values[early], "--", color=_SKIPPED, linewidth=0.7, label="_")
            bottom.plot(horizontal[skip:], residuals[skip:], color=color, linewidth=0.7, label=titles[name])
        if skip:
            rows = f"first {skip} samples, not in the errors"
            top.plot(horizontal[: skip + 1], measured[: skip + 1], color=_SKIPPED, linewidth=0.8, label=rows)
        bottom.axhline(0.0, color="black", linewidth=0.5)
        # Of what counts; the samples before may be far off.
        counted = np.concatenate([(measured - values)[skip:] for values in modelled.values()])
        margin = 0.05 * float(np.ptp(counted)) or 1e-12
        bottom.set_ylim(min(float(counted.min()), 0.0) - margin, max(float(counted.max()), 0.0) + margin)
        top.set_ylabel(output_label)
        bottom.set(xlabel=horizontal_label, ylabel=error_label)
        for axes, columns in ((top, 3), (bottom, 1)):
            axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, fontsize=7.5)


def plot_sequence_and_errors(
    path: Path, inputs: Floats, errors: Mapping[str, Floats], *, input_label: str, error_label: str
) -> None:
    """Draw an input sequence, one sample a step, and below it the errors of several models; as in `plot_errors`."""
    with _figure(path, (6.0, 5.5)) as figure:
        top, bottom = figure.subplots(2, 1, sharex=True)
        top.plot(inputs, color=_COLORS[0], linewidth=0.8)
        top.set_ylabel(input_label)
        for i, (title, error) in enumerate(errors.items()):
            bottom.plot(error, color=_COLORS[i], linewidth=0.8, label=title)
        bottom.set(xlabel="index of the set-point", ylabel=error_label)
        bottom.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=len(errors), fontsize=7.5)


def plot_tracking(
    path: Path,
    reference: Floats,
    outputs: Mapping[str, Floats],
    *,
    horizontal: Floats | None = None,
    horizontal_label: str = "index of the target",
    output_label: str,
    error_label: str,
) -> None:
    """Draw a reference and the outputs under several controllers, and below it their errors.

    Outputs are given by the controller's title; all arrays have the shape (N,). Horizontal positions, such as times,
    default to the index.
    """
    places = np.arange(reference.size, dtype=np.float64) if horizontal is None else horizontal
    marker = "." if horizontal is None else ""
    with _figure(path, (6.0, 5.5)) as figure:
        top, bottom = figure.subplots(2, 1, sharex=True)
        top.plot(places, reference, color="black", linewidth=1.2, label="reference")
        for i, (title, output) in enumerate(outputs.items()):
            style = {"color": _COLORS[i], "linewidth": 0.8, "marker": marker, "markersize": 3.0}
            top.plot(places, output, label=title, **style)
            bottom.plot(places, output - reference, label=title, **style)
        top.set_ylabel(output_label)
        bottom.set(xlabel=horizontal_label, ylabel=error_label)
        top.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=len(outputs) + 1, fontsize=7.5)


def plot_panels(
    path: Path,
    panels: Mapping[str, Sequence[Curve]],
    *,
    horizontal_label: str,
    vertical_label: str,
    columns: int = 2,
) -> None:
    """Draw several sets of curves on the same axes, one panel a set, by their titles; `columns` beside each other."""
    rows = -(-len(panels) // columns)
    with _figure(path, (3.3 * columns, 0.4 + 2.6 * rows)) as figure:
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for i, (axes, (title, curves)) in enumerate(zip(grid.flat, panels.items(), strict=False)):
            for k, curve in enumerate(curves):
                axes.plot(
                    curve.horizontal,
                    curve.vertical,
                    # Marks of dense samples would hide other curves.
                    ".-" if curve.horizontal.size <= _MARKED else "-",
                    color=f"C{k}",
                    linewidth=0.7,
                    markersize=2.5,
                    label=curve.label,
                )
            axes.set_title(title, fontsize=9, loc="left")
            if i == 0 and any(curve.label for curve in curves):
                axes.legend(fontsize=6.5)
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)
        for axes in grid[-1]:
            axes.set_xlabel(horizontal_label)
        for axes in grid[:, 0]:
            axes.set_ylabel(vertical_label)


def plot_densities(path: Path, densities: Sequence[Density], swept: npt.NDArray[np.bool_] | None = None) -> None:
    """Draw Preisach densities on their planes, side by side, under their titles; cells without density are white.

    Cells that `swept`, shape (K,) as in `Preisach`, leaves out are grey: the excitation says nothing of them.
    """
    with _figure(path, (5.2 * len(densities), 4.2), grid=False) as figure:
        panels = figure.subplots(1, len(densities), squeeze=False)[0]
        for axes, density in zip(panels, densities, strict=True):
            signed = bool(np.nanmin(density.values) < 0)
            largest = float(np.nanmax(np.abs(density.values))) or 1.0
            image = axes.pcolormesh(
                density.levels,
                density.levels,
                np.ma.masked_where(~(np.abs(density.values) > 0), density.values),
                cmap="RdBu_r" if signed else "viridis",
                vmin=-largest if signed else 0.0,
                vmax=largest,
            )
            title = density.title
            if swept is not None and not swept.all():
                cells = np.full(density.values.shape, np.nan)
                cells[np.tril_indices(len(cells))] = np.where(swept, np.nan, 1.0)
                unknown = np.ma.masked_invalid(cells)
                axes.pcolormesh(density.levels, density.levels, unknown, cmap="Greys", vmin=0.0, vmax=3.0, alpha=0.8)
                title = f"{title} grey: never swept ({np.mean(~swept):.0%} of the cells)".lstrip()
            _frame_plane(axes, density)
            figure.colorbar(image, ax=axes, label=f"density / {density_unit(density.output_unit, density.unit)}")
            axes.set_title(title, fontsize=9, loc="left")


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
    with _figure(path, (4.6, 4.2), grid=False) as figure:
        axes = figure.subplots()
        image = np.ma.masked_invalid(cells)
        mesh = axes.pcolormesh(density.levels, density.levels, image, cmap="RdYlGn", vmin=0.0, vmax=1.0, alpha=0.5)
        axes.plot(corners[:, 0], corners[:, 1], color=_COLORS[0], linewidth=1.5, label="memory curve")
        _frame_plane(axes, density)
        if resolution is None:
            axes.set_title(f"green: swept ({np.mean(swept):.0%} of the cells)")
        else:
            figure.colorbar(mesh, ax=axes, label="resolution (1: determined by the data)")
            axes.set_title(f"swept: {np.mean(swept):.0%} of the cells", fontsize=9, loc="left")
        axes.legend(loc="lower right")


def plot_signals(path: Path, hours: Floats, signals: Mapping[str, Floats], labels: Sequence[str]) -> None:
    """Draw signals, each of shape (N,), over laboratory time in h, one panel each; labels include units."""
    with _figure(path, (7.0, 0.8 + 1.2 * len(signals))) as figure:
        panels = figure.subplots(len(signals), 1, sharex=True, squeeze=False)[:, 0]
        for i, values in enumerate(signals.values()):
            panels[i].plot(hours, values, color=_COLORS[i % len(_COLORS)], linewidth=0.7)
            panels[i].set_ylabel(labels[i], rotation=0, ha="right", va="center", fontsize=8)
        panels[-1].set_xlabel("laboratory time / h")


def _frame_plane(axes: Axes, density: Density) -> None:
    """Draw the diagonal of a plane, and label its axes."""
    ends = float(density.levels[0]), float(density.levels[-1])
    axes.plot(ends, ends, color="black", linewidth=0.8)
    labels = {"xlabel": with_unit("β", density.unit), "ylabel": with_unit("α", density.unit)}
    axes.set(**labels, aspect="equal", xlim=ends, ylim=ends)
