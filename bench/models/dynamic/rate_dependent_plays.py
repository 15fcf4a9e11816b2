"""Rate-dependent plays: a weighted sum of plays whose thresholds grow with the rate at which they move.

A play z with threshold r and time constant τ follows its input x by

    τ z' = x - r - z above, x + r - z below the band of the play without a rate, 0 within it,

so that it moves along x ± (r + τ |z'|): steadily dragged, by the threshold r + τ |x'| of the rate-dependent plays of
Al Janaideh, Rakheja and Su (Mechatronics 19(5), 656-670, 2009) and Al Janaideh and Krejčí (IEEE/ASME Transactions on
Mechatronics 18(5), 1498-1507, 2013). With their rate of the input in place of that of the play, y = W x - B x' on a
branch, whose inverse grows without end. This one's is stable: it is the play of Krejčí and Kuhnen's creep operator
(IEE Proceedings - Control Theory and Applications 148(3), 185-192, 2001), the viscous regularisation of a play.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.models.dynamic.model_with_time import TimedModel, check_sequence
from bench.models.inverses.inverse import Policy
from bench.models.memory import overwritten_from


class PlaysState(NamedTuple):
    """Memory of rate-dependent plays.

    Attributes
    ----------
    plays : tuple of float
        Where each play stands, input units.
    last : tuple of float or None
        Time (s) and input (input units) of the last sample; None before the first, at which each play stands as
        without a time constant.
    """

    plays: tuple[float, ...]
    last: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class RateDependentPlays(TimedModel[PlaysState]):
    """Output = bias + Σ weight_k z_k, with plays as at the head of this module.

    Between samples the input is a straight line. For such inputs the plays are exact on uneven times.

    Parameters
    ----------
    thresholds : array_like, shape (K,)
        Input units, >= 0.
    time_constants : array_like, shape (K,)
        s, >= 0; 0 for a play that does not depend on the rate.
    weights : array_like, shape (K,)
        Output units per input unit, all >= 0 or all <= 0.
    input_range : tuple of float
        Range of the inputs from which it was identified, and of those that `follow` gives, input units.
    bias : float
        Output units.
    origin : float
        Where the plays stand at first, input units.
    input_unit, output_unit : str
        Units, for labels.

    Raises
    ------
    ValueError
        If a number is not finite or out of its range, the weights differ in sign, or the lengths differ.
    """

    kind: ClassVar[str] = "rate-dependent-plays"
    starts: ClassVar[tuple[str, ...]] = ("negative", "positive", "skip")
    inverse_method: ClassVar[str] = "exact"

    thresholds: Floats
    time_constants: Floats
    weights: Floats
    input_range: tuple[float, float]
    bias: float = 0.0
    origin: float = 0.0
    input_unit: str = ""
    output_unit: str = ""

    def __post_init__(self) -> None:
        for name in ("thresholds", "time_constants", "weights"):
            count = np.size(self.weights)
            values = _checks.counted(name, getattr(self, name), count, "values, one for each weight")
            if name != "weights" and (values < 0.0).any():
                raise ValueError(f"{name}: expected values >= 0, got {values.min()}")
            object.__setattr__(self, name, _checks.frozen(values))
        if (self.weights < 0.0).any() and (self.weights > 0.0).any():
            raise ValueError("weights: expected values >= 0, or all <= 0, got both")
        low, high = _checks.increasing("input_range", self.input_range).tolist()
        object.__setattr__(self, "input_range", (low, high))
        for name in ("bias", "origin"):
            object.__setattr__(self, name, _checks.number(name, getattr(self, name)))

    def run(self, times: ArrayLike, inputs: ArrayLike, state: PlaysState | None = None) -> tuple[Floats, PlaysState]:
        """Return the outputs of a sequence, shape (N,), and the state after it; see `TimedModel.run`."""
        from bench.models.kernels import viscous_play_kernels as _play_kernels

        clock, sequence, plays = self._begin(times, state, inputs=inputs)
        total = _play_kernels.weighted_plays(*sequence, *self._elements(), self.weights.copy(), plays)
        return self.bias + total, PlaysState(tuple(plays.tolist()), (float(clock[-1]), float(sequence[0][-1])))

    def columns(self, times: ArrayLike, inputs: ArrayLike, state: PlaysState | None = None) -> Floats:
        """Return the plays sample by sample, shape (N, K), which the weights multiply; arguments as `run`."""
        from bench.models.kernels import viscous_play_kernels as _play_kernels

        _, sequence, plays = self._begin(times, state, inputs=inputs)
        return np.asarray(_play_kernels.plays(*sequence, *self._elements(), plays))

    def follow(
        self,
        times: ArrayLike,
        targets: ArrayLike,
        state: PlaysState | None = None,
        policy: Policy = "nearest",  # noqa: ARG002 - there is one answer
    ) -> Floats:
        """Return the inputs of the operating range that bring the output to targets; see `TimedModel.follow`."""
        from bench.models.kernels import viscous_play_kernels as _play_kernels

        _, (wanted, steps, before), plays = self._begin(times, state, targets=targets)
        sign = -1.0 if (self.weights < 0.0).any() else 1.0
        elements = *self._elements(), sign * self.weights
        return np.asarray(
            _play_kernels.inputs_for(sign * (wanted - self.bias), steps, before, *self.input_range, *elements, plays)
        )

    def _begin(
        self, times: ArrayLike, state: PlaysState | None, **given: ArrayLike
    ) -> tuple[Floats, tuple[Floats, Floats, float], Floats]:
        """Return the times; the values given, their steps of time and the input before them; and the plays before."""
        clock, values = check_sequence(times, **given)
        state = self.initial_state() if state is None else state
        return clock, (values, *_steps(clock, state)), np.array(state.plays)

    def _elements(self) -> tuple[Floats, Floats]:
        """Return thresholds and time constants as the kernels take them: arrays that may be written to."""
        return self.thresholds.copy(), self.time_constants.copy()

    def initial_state(self) -> PlaysState:
        """Return the relaxed state: every play at the origin."""
        return PlaysState((self.origin,) * self.thresholds.size)

    def start(self, word: str) -> PlaysState:
        """Return the state at the low end of the range, every play dragged there ("negative"), or the high one."""
        low, high = self.input_range
        plays = low + self.thresholds if word == "negative" else high - self.thresholds
        return PlaysState(tuple(plays.tolist()))

    def unknown_until(self, inputs: ArrayLike) -> int:
        """Return what plays without a rate do."""
        return overwritten_from(inputs)

    def parameters(self) -> Mapping[str, tuple[float, str]]:
        """Return the time constants, and the part of the weights that each has."""
        total, found = float(self.weights.sum()) or 1.0, {}
        for number, lag in enumerate(np.unique(self.time_constants[self.time_constants > 0.0]).tolist(), 1):
            part = float(self.weights[self.time_constants == lag].sum()) / total
            found[f"time constant {number}"] = lag, "s"
            found[f"part with time constant {number}"] = 100.0 * part, "%"
        return found

    def structure(self) -> Mapping[str, Any]:
        """Return the number of time constants."""
        return {"time_constants": np.unique(self.time_constants[self.time_constants > 0.0]).size}

    def state_to_json(self, state: PlaysState) -> Any:  # noqa: ANN401
        """Return a state as JSON."""
        return {"plays": list(state.plays), "last": None if state.last is None else list(state.last)}

    def state_from_json(self, document: Any) -> PlaysState:  # noqa: ANN401
        """Return the state that `state_to_json` wrote.

        Raises ValueError if it is no state of this model.
        """
        plays, last = (_checks.json_field(document, key, "memory") for key in ("plays", "last"))
        numbers = _checks.counted("memory", plays, self.thresholds.size, "plays")
        if last is None:
            return PlaysState(tuple(numbers.tolist()))
        sample = _checks.samples("memory", last).tolist()
        if len(sample) != 2:
            raise ValueError(f"memory: expected time and input of the last sample, got {len(sample)} numbers")
        return PlaysState(tuple(numbers.tolist()), (sample[0], sample[1]))


def _steps(clock: Floats, state: PlaysState) -> tuple[Floats, float]:
    """Return the time since the sample before of each sample, 0 at a beginning, and the input before the first."""
    steps = np.diff(clock, prepend=clock[0])
    if state.last is None:
        return steps, 0.0
    moment, before = state.last
    steps[0] = clock[0] - moment if clock[0] > moment else steps[1]
    return steps, before
