"""How far each signal is from what stops it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from bench.base import Display
from bench.operator import Shown
from bench.rig import SETPOINT, Level

_BLOCKS = "▁▂▃▄▅▆▇█"


@dataclass(frozen=True)
class Margin:
    """The nearest limit of a signal.

    Attributes
    ----------
    distance : float
        To it, in the unit of the signal; negative beyond it, infinite without one.
    limit : float
        The limit.
    by : str
        Whose it is: `device` or `interlock`.
    is_warned : bool
        Whether the signal is within the warning band.
    """

    distance: float
    limit: float
    by: str
    is_warned: bool

    def text(self, display: Display) -> str:
        """Return it for a table, in the unit that the signal is shown in."""
        if math.isinf(self.distance):
            return ""
        return f"{display.number(self.distance)} to {display.bare(self.limit)} ({self.by})"


def margin_of(signal: str, values: Mapping[str, float], shown: Shown) -> Margin:
    """Return the nearest limit of a signal: of its device if it is a set-point, and of interlocks on its value."""
    value = values.get(signal, math.nan)
    limits = shown.limits.get(signal.removesuffix(SETPOINT)) if signal.endswith(SETPOINT) else None
    edges = [] if limits is None else [(limits.low, limits.high, -math.inf, math.inf, "device")]
    edges += [
        (each.low, each.high, *each.unwarned, "interlock")
        for each in shown.interlocks
        if each.signal == signal and not each.minus and each.level is not Level.WARN
    ]
    nearest = Margin(math.inf, math.inf, "", False)
    for low, high, warn_low, warn_high, by in edges:
        for distance, limit in ((value - low, low), (high - value, high)):
            if distance < nearest.distance:
                nearest = Margin(distance, limit, by, not warn_low <= value <= warn_high)
    return nearest


def sparkline(values: list[float], width: int) -> str:
    """Return the course of a signal in one line of text, its own extremes as the ends of the scale."""
    finite = [value for value in values[-width:] if math.isfinite(value)]
    if not finite:
        return ""
    low, high = min(finite), max(finite)
    span = high - low
    return "".join(
        " " if not math.isfinite(value) else _BLOCKS[round((value - low) / span * 7)] if span else _BLOCKS[3]
        for value in values[-width:]
    )
