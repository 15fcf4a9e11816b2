"""The inverse of a Prandtl-Ishlinskii operator one sample at a time.

Source: Kuhnen, "Modeling, identification and compensation of complex hysteretic nonlinearities", European Journal of
Control 9, 2003.
"""

from __future__ import annotations

import math

from bench.models import PrandtlIshlinskii


class SampledPlayInverse:
    """The inverse of a relaxed Prandtl-Ishlinskii operator one sample at a time, within a stroke.

    Parameters
    ----------
    operator : PrandtlIshlinskii
        Relaxed.
    stroke : float
        Largest output of either sign, output units from rest; further limited by the operating range.

    Raises
    ------
    ValueError
        If the operator has no inverse, or the stroke is not positive.
    """

    def __init__(self, operator: PrandtlIshlinskii, stroke: float = math.inf) -> None:
        if not stroke > 0.0:
            raise ValueError(f"stroke: expected a positive number, got {stroke}")
        self._rest = operator.bias
        inverse = operator.inverse_operator()
        self._step = inverse.stream(operator.inverse_state(operator.initial_state())).step
        low, high = operator.output_range()
        self.low = max(low - operator.bias, -stroke)
        """Lowest output, output units from rest."""
        self.high = min(high - operator.bias, stroke)
        """Highest output, output units from rest."""
        self.output = 0.0
        """Output of the model at the last input, output units from rest."""

    def input(self, output: float) -> float:
        """Move to the input for an output (output units from rest) clipped to the stroke, and return it."""
        self.output = x = self.low if output < self.low else self.high if output > self.high else output
        return self._step(self._rest + x)
