"""Figures of runs and models, by matplotlib.

Each function draws one figure to the file `path`: PNG, PDF or SVG by its ending. Axis labels include units. What was
measured is drawn as dark points, what a model or controller gave as a line in its own colour (`color_of`), which is
the same in all figures. Panels of errors share one scale.
"""

from bench.results.figures.canvas import FORMATS, check_matplotlib
from bench.results.figures.colors import color_of
from bench.results.figures.fits import plot_errors, plot_fit, plot_loops, plot_sequence_and_errors
from bench.results.figures.panels import Curve, plot_histogram, plot_panels, plot_signals
from bench.results.figures.planes import plot_coverage, plot_densities
from bench.results.figures.targets import plot_tracking

__all__ = [
    "FORMATS",
    "Curve",
    "check_matplotlib",
    "color_of",
    "plot_coverage",
    "plot_densities",
    "plot_errors",
    "plot_fit",
    "plot_histogram",
    "plot_loops",
    "plot_panels",
    "plot_sequence_and_errors",
    "plot_signals",
    "plot_tracking",
]
