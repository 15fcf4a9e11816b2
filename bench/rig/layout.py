"""The layout of a rig's dashboard: the table `[dashboard]` of its rig file."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field

from bench.base import CheckedTable


def _check_range(ends: tuple[float, float]) -> tuple[float, float]:
    if not ends[0] < ends[1]:
        raise ValueError("expected two numbers, the lower one first")
    return ends


Range = Annotated[tuple[float, float], AfterValidator(_check_range)]


class XYPlot(CheckedTable):
    """A table `[[dashboard.loops]]`: a further plot of one signal over another, in the units of the signals."""

    input: str = Field(description="signal on the horizontal axis of the loop")
    output: str = Field(description="signal on the vertical axis of the loop")
    input_range: Range = Field(description="ends of the horizontal axis")
    output_range: Range = Field(description="ends of the vertical axis")


class DashboardLayout(XYPlot):
    """The table `[dashboard]`: the hysteresis loop, the Preisach plane over its input, and further plots."""

    input: str = Field(description="signal on the horizontal axis of the loop, and input of the plane")
    plane: Range | None = Field(
        default=None, description="ends of both axes of the Preisach plane; without it, there is none"
    )
    levels: int = Field(default=20, ge=2, le=200, description="discretization levels drawn on the plane")
    loops: tuple[XYPlot, ...] = Field(default=(), description="further loops")

    @property
    def plots(self) -> dict[str, XYPlot]:
        """The first plot and the further ones, by the prefix of their keys in the table."""
        return {"": self} | {f"loops.{i}.": plot for i, plot in enumerate(self.loops)}

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """The range of each signal on an axis; of several, the first."""
        ranges: dict[str, tuple[float, float]] = {}
        for plot in self.plots.values():
            ranges = {plot.output: plot.output_range, plot.input: plot.input_range} | ranges
        return ranges
