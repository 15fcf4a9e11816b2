"""The inverse of a Prandtl-Ishlinskii operator one sample at a time.

Source: Kuhnen, "Modeling, identification and compensation of complex hysteretic nonlinearities", European Journal of
Control 9, 2003.
"""

from __future__ import annotations

import math

from bench.models import PrandtlIshlinskii


class SampledPlayInverse:
    """The inverse of a Prandtl-Ishlinskii operator one sample at a time, with its memory.

    Equal to the operator's `inverse`, but cheap enough for every sample of a fast loop. A move drags the first plays
    only: neighbouring states never differ by more than their thresholds do, so that no play behind one that stays is
    dragged.

    Parameters
    ----------
    operator : PrandtlIshlinskii
        Without dead zones; relaxed.
    stroke : float
        Largest output of either sign, output units from rest; further limited by the operating range.

    Raises
    ------
    ValueError
        If the operator has dead zones or no inverse, or the stroke is not positive.
    """

    def __init__(self, operator: PrandtlIshlinskii, stroke: float = math.inf) -> None:
        if operator.before is not None or operator.after is not None:
            raise ValueError("hysteresis: expected an operator of plays alone, got one with dead zones")
        if not stroke > 0.0:
            raise ValueError(f"stroke: expected a positive number, got {stroke}")
        inverse = operator.inverse_operator()
        self._offset = inverse.bias
        self._thresholds: list[float] = inverse.thresholds.tolist()
        self._weights: list[float] = inverse.weights.tolist()
        self._states: list[float] = list(operator.inverse_state(operator.initial_state()))
        self._total = 0.0
        low, high = operator.output_range()
        self.low = max(low - operator.bias, -stroke)
        """Lowest output, output units from rest."""
        self.high = min(high - operator.bias, stroke)
        """Highest output, output units from rest."""
        self.output = 0.0
        """Output of the model at the last input, output units from rest."""

    def input(self, output: float) -> float:
        """Move to the input for an output (output units from rest) clipped to the stroke, and return it."""
        x = self.low if output < self.low else self.high if output > self.high else output
        self.output = x
        states, weights = self._states, self._weights
        total = self._total
        for k, r in enumerate(self._thresholds):
            z = states[k]
            if x - r > z:
                total += weights[k] * (x - r - z)
                states[k] = x - r
            elif x + r < z:
                total += weights[k] * (x + r - z)
                states[k] = x + r
            elif k:
                break
        self._total = total
        return self._offset + total
