"""Figures of runs and models, by matplotlib.

Each function draws one figure to the file `path`: PNG, PDF or SVG by its ending. Axis labels include units. What was
measured is drawn as dark points, what a model or controller gave as a line in its own colour (`color_of`), which is
the same in all figures. Panels of errors share one scale.
"""
