"""Adaptation of a Preisach density while the model is in use, sample by sample."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from bench.base import checks as _checks
from bench.models import MemoryCurve, Preisach, PreisachInverse


@dataclass(frozen=True, eq=False)
class DensityAdapter:
    """A model, the memory of its plant, and how the next measurement changes the model.

    `update` returns a new adapter; nothing is changed in place, so that an earlier model can be taken up again.
    The density follows a projected normalised gradient on output differences (Tan and Baras, Recursive
    identification of hysteresis in smart materials, American Control Conference 2004). With x = density * area
    of each cell and φ the change of its (on - off) part between two measurements,

        x := max(0, x + step φ (Δoutput - Δpredicted) / (|φ|² + 2 noise² / (uncertainty m)²)),

    where m is the root mean square of x at the start. Differences are free of the bias, and only the cells that
    the input swept change. The bias then takes `bias_step` of what is left of the error in the output itself.
    The reversible part is not adapted. For bounded noise the density stays bounded: a step below 2 never
    overshoots, and moves small against the noise hardly count.

    Parameters
    ----------
    model : Preisach
        The model to begin with, density >= 0.
    state : MemoryCurve or None
        Memory of the plant; default the model's initial state.
    step : float
        Step of the density, 0 (off) to below 2.
    bias_step : float
        Part of the output error that the bias takes at each measurement, 0 (off) to 1. In a loop that is closed
        by the inverse keep it small: a bias that follows the noise moves the input with it, and the density
        takes that for gain.
    noise : float or None
        Standard deviation of one output reading and of what no density explains, output units, > 0; default a
        thousandth of the span between the saturations. It keeps very small moves from being divided by.
    uncertainty : float
        Relative uncertainty of a cell's part of the output, > 0: the smaller, the more the noise counts.
    policy : {"nearest", "paper"}
        Policy of `inverse`.
    output : float
        Output measured in this state, output units; NaN if there was none.
    error : float
        Error of the change of output that the last `update` predicted, output units; NaN if there was none.

    Raises
    ------
    ValueError
        If the density is negative somewhere, or a number is out of its range.
    """

    model: Preisach
    state: MemoryCurve = None  # type: ignore[assignment]
    step: float = 0.5
    bias_step: float = 0.03
    noise: float = None  # type: ignore[assignment]
    uncertainty: float = 0.2
    policy: Literal["nearest", "paper"] = "nearest"
    output: float = math.nan
    error: float = math.nan
    _scale: float = math.nan

    def __post_init__(self) -> None:
        if not (self.model.density >= 0.0).all():
            raise ValueError(f"model: expected a density >= 0, got {self.model.density.min()}")
        if not 0.0 <= _checks.number("step", self.step) < 2.0:
            raise ValueError(f"step: expected 0 <= step < 2, got {self.step}")
        if not 0.0 <= _checks.number("bias_step", self.bias_step) <= 1.0:
            raise ValueError(f"bias_step: expected a number from 0 to 1, got {self.bias_step}")
        masses = self.model.density * self.model.cell_areas()
        noise = 2e-3 * float(masses.sum()) or 1.0 if self.noise is None else _checks.number("noise", self.noise)
        if not noise > 0.0:
            raise ValueError(f"noise: expected a positive number, got {noise}")
        if not _checks.number("uncertainty", self.uncertainty) > 0.0:
            raise ValueError(f"uncertainty: expected a positive number, got {self.uncertainty}")
        state = self.model.initial_state() if self.state is None else self.state
        object.__setattr__(self, "state", state)
        if math.isnan(self._scale):
            # Without any density to go by, that of an output of the size of the noise.
            object.__setattr__(self, "_scale", float(np.sqrt(np.mean(masses**2))) or noise)
        object.__setattr__(self, "noise", noise)

    @cached_property
    def inverse(self) -> PreisachInverse:
        """The exact inverse of the present model."""
        return PreisachInverse(self.model, self.policy)

    def update(self, value: float, output: float | None) -> DensityAdapter:
        """Return the adapter after the input moved monotonically to `value` and `output` was measured there.

        Parameters
        ----------
        value : float
            What the plant's input did, not what was wished, input units.
        output : float or None
            The measured output, output units; None if none was taken. The memory then moves on, and adaptation
            takes up again with the second measurement after it.

        Raises
        ------
        ValueError
            If a number is not finite.
        """
        from bench.control import adaptation_kernels as _kernels

        state = self.state
        after = state.step(value)
        if output is None:
            return self._moved(after, math.nan, math.nan)
        if not math.isfinite(output):
            raise ValueError(f"output: expected a finite number, got {output}")
        model, t = self.model, self.model.lattice
        density, table, below, bias, offset, minus, plus, error = _kernels.adapt(
            (t.levels, t.inverse_step),
            model.density,
            model.bias,
            t.terms,
            model._pieces(state),
            state.input,
            float(value),
            self.output,
            float(output),
            self.step,
            self.bias_step,
            2.0 * (self.noise / (self.uncertainty * self._scale)) ** 2,
        )
        inverse = self.inverse
        adapted = model._retuned(density, bias, table, below, offset)
        other = self._moved(after, float(output), error)
        other.__dict__["model"] = adapted
        other.__dict__["inverse"] = inverse._retuned(adapted, (minus, plus, inverse._ends[2]))
        return other

    def _moved(self, state: MemoryCurve, output: float, error: float) -> DensityAdapter:
        other = object.__new__(DensityAdapter)
        other.__dict__.update(self.__dict__)
        other.__dict__.update(state=state, output=output, error=error)
        return other
