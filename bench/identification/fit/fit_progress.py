"""How far a constrained fit is."""

from __future__ import annotations

import math

from bench.base import say_share


def say_fit_progress(gradient: float) -> None:
    """Say about which share of a fit is done, by the greatest gradient that is left, relative to the outputs.

    It falls from 1e-4 to 1e-8 while nearly all the time passes, then at once to rounding.
    """
    say_share("fitting", min(-0.25 * math.log10(max(gradient, 1e-99)) - 1.0, 0.97))
