"""The Prandtl-Ishlinskii operator: weighted plays between two single-valued maps, and its exact inverse."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.models.documents import Parts
from bench.models.operator import Operator
from bench.models.regressor import Regressor
from bench.models.streams.stream import PlayStream

if TYPE_CHECKING:
    from bench.models.inverses.inverse import Inverse, Policy

PlayState: TypeAlias = tuple[float, ...]


@dataclass(frozen=True, eq=False)
class DeadZones:
    """A monotone piecewise linear map with S(0) = 0, the superposition of one-sided dead zones.

    Kuhnen 2003 (European Journal of Control 9, 407-418) writes it as a sum of weights times max(x - r, 0) for
    thresholds r > 0, min(x - r, 0) for r < 0, and x. The slope between two thresholds is the
    sum of the weights that are active there, and the slopes are what is kept here: the map rises if and only
    if none is negative, falls if none is positive, and its inverse is again such a map.

    Parameters
    ----------
    thresholds : array_like, shape (m,)
        Increasing points at which the slope changes, units of the argument, m >= 1.
    slopes : array_like, shape (m + 1,)
        Slope below the first threshold, between thresholds, and above the last one, all >= 0 or all <= 0.

    Raises
    ------
    ValueError
        If the thresholds do not increase, slopes have both signs, a number is not finite or a length is wrong.
    """

    thresholds: Floats
    slopes: Floats

    def __post_init__(self) -> None:
        thresholds = _checks.increasing("thresholds", self.thresholds, least=1)
        count = thresholds.size
        slopes = _checks.counted("slopes", self.slopes, count + 1, f"values for {count} thresholds")
        if (slopes < 0.0).any() and (slopes > 0.0).any():
            raise ValueError(f"slopes: expected values >= 0, or all <= 0, got {slopes.min()} and {slopes.max()}")
        object.__setattr__(self, "thresholds", _checks.frozen(thresholds))
        object.__setattr__(self, "slopes", _checks.frozen(slopes))

    def columns(self, values: ArrayLike) -> Floats:
        """Return, for each value and each interval, the signed length between 0 and the value in it.

        The map is these columns times the slopes; shape (N, m + 1).
        """
        x = np.asarray(values, dtype=np.float64)[:, None]
        low = np.append(-np.inf, self.thresholds)
        high = np.append(self.thresholds, np.inf)
        result: Floats = np.clip(x, low, high) - np.clip(0.0, low, high)
        return result

    def __call__(self, values: ArrayLike) -> Floats:
        """Return the map of each value, shape (N,)."""
        x = np.asarray(values, dtype=np.float64)
        thresholds, intercepts, slopes = self.lines
        interval = np.searchsorted(thresholds, x)
        return np.asarray(intercepts[interval] + slopes[interval] * x)

    def value(self, x: float) -> float:
        """Return the map of one value."""
        return float(self([x])[0])

    @cached_property
    def lines(self) -> tuple[Floats, Floats, Floats]:
        """Thresholds, and intercept and slope of the line on each interval, shapes (m,), (m + 1,), (m + 1,)."""
        # A point inside or at the border of each interval, the nearest to zero: there rounding is least.
        low = np.append(-np.inf, self.thresholds)
        points = np.clip(0.0, low, np.append(self.thresholds, np.inf))
        return self.thresholds, self.columns(points) @ self.slopes - self.slopes * points, self.slopes

    def inverse(self) -> DeadZones:
        """Return the inverse map.

        Raises ValueError if a slope is zero.
        """
        if (self.slopes == 0.0).any():
            raise ValueError("slopes: expected values > 0 for an inverse, or all < 0, got 0")
        thresholds, slopes = self(self.thresholds), 1.0 / self.slopes
        return DeadZones(thresholds, slopes) if self.sign > 0 else DeadZones(thresholds[::-1], slopes[::-1])

    @property
    def sign(self) -> Literal[-1, 1]:
        """-1 if the map falls, else 1."""
        return -1 if (self.slopes < 0.0).any() else 1

    def to_json(self) -> dict[str, Any]:
        """Return the map as a JSON object."""
        return {"thresholds": self.thresholds.tolist(), "slopes": self.slopes.tolist()}

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> DeadZones:
        """Return the map that `to_json` wrote.

        Raises ValueError if a key is missing or wrong.
        """
        return cls(
            _checks.json_field(document, "thresholds", "dead zones"),
            _checks.json_field(document, "slopes", "dead zones"),
        )


@dataclass(frozen=True, eq=False)
class PrandtlIshlinskii(Operator[PlayState]):
    """A weighted sum of play operators, with dead zones before or after it where wanted.

    With x = before(input - origin), each play keeps a state z = max(x - r, min(x + r, z before)), and
    output = bias + after(sum of weight * z). `after` adds saturation and asymmetry (Kuhnen 2003). The output
    never falls while the input rises, or never rises. The state is the tuple of play states, in the units of x,
    outermost last; the first one, of threshold 0, is x itself.

    Parameters
    ----------
    thresholds : array_like, shape (n,)
        Increasing, from 0 on, in the units of x.
    weights : array_like, shape (n,)
        Output per unit of x, of either sign, every running sum >= 0 (for instance all >= 0), or every one <= 0.
    origin : float
        Input of x = 0, input units.
    before, after : DeadZones or None
        The single-valued maps; None is the identity.
    input_range : tuple of float or None
        Operating range of the input. Default: origin ± the last threshold (± 1 if that is zero).
    bias, input_unit, output_unit
        As `Operator`.

    Raises
    ------
    ValueError
        If the thresholds do not increase from 0, there are not as many weights, the running sums of the weights
        have both signs, a number is not finite, or the range does not increase.
    """

    kind: ClassVar[str] = "prandtl-ishlinskii"
    inverse_method: ClassVar[str] = "exact"
    parts: ClassVar[Parts] = {
        "before": DeadZones.from_json,
        "after": DeadZones.from_json,
    }
    thresholds: Floats
    weights: Floats
    bias: float = 0.0
    origin: float = 0.0
    before: DeadZones | None = None
    after: DeadZones | None = None
    input_range: tuple[float, float] = None  # type: ignore[assignment]
    input_unit: str = ""
    output_unit: str = ""

    def __post_init__(self) -> None:
        thresholds, weights = _checks.plays(self.thresholds, self.weights)
        sums = np.cumsum(weights)
        rounding = 1e-12 * np.abs(weights).max()
        if sums.min() < -rounding and sums.max() > rounding:
            raise ValueError(f"weights: expected running sums >= 0, or all <= 0, got {sums.min()} and {sums.max()}")
        origin = _checks.number("origin", self.origin)
        reach = float(thresholds[-1]) or 1.0
        span = origin - reach, origin + reach
        self._settle("origin", span=span, thresholds=thresholds, weights=weights)

    @property
    def coefficients(self) -> Floats:
        """The weights, shape (n,); with dead zones after the plays their slopes, shape (m + 1,)."""
        return self.weights if self.after is None else self.after.slopes

    def with_coefficients(self, coefficients: ArrayLike, bias: float) -> PrandtlIshlinskii:
        """Return the same operator with other coefficients and bias.

        Raises ValueError if their number is wrong, one is not finite, or the output would not be monotone.
        """
        values = self._coefficients(coefficients)
        if self.after is None:
            return replace(self, weights=values, bias=bias)
        return replace(self, after=DeadZones(self.after.thresholds, values), bias=bias)

    def count_beside_coefficients(self) -> int:
        """Return the number of weights found before the slopes of dead zones, which have the scale."""
        return 0 if self.after is None else max(int(np.count_nonzero(self.weights)) - 1, 0)

    def initial_state(self) -> PlayState:
        """Return the relaxed state: every play at zero, the input at the origin."""
        return (0.0,) * self.thresholds.size

    def saturated_state(self, direction: int, value: float | None = None) -> PlayState:
        """Return the state at the low (-1) or high (1) end, or at a value, entered from far beyond the other end.

        Every play then is dragged: at the low end z = x + r, at the high end z = x - r (the other way round behind a
        falling map). Raises ValueError if
        `direction` is neither -1 nor 1.
        """
        _, end = self._ends(direction)
        x = self._inner(end if value is None else value)
        turn = direction if self.before is None else direction * self.before.sign
        return tuple([x - turn * r for r in self._lists[0]])

    def present_input(self, state: PlayState) -> float:
        """Return the input of a state: where the first play, of threshold 0, stands."""
        return self.origin + (state[0] if self.before is None else self.before.inverse().value(state[0]))

    def _inner(self, value: float) -> float:
        x = value - self.origin
        return x if self.before is None else self.before.value(x)

    def _checked(self, state: PlayState | None) -> Floats:
        if state is None:
            return np.zeros(self.thresholds.size)
        return _checks.counted("state", state, self.thresholds.size, "play states")

    def _drive(self, inputs: ArrayLike) -> Floats:
        x = _checks.samples("inputs", inputs) - self.origin
        return x if self.before is None else self.before(x)

    def _plays(self, inputs: ArrayLike, state: PlayState | None) -> Floats:
        from bench.models.kernels import memory_kernels as _kernels

        x = self._drive(inputs)
        return np.asarray(_kernels.plays(x, x, self.thresholds, self._checked(state).copy()))

    def evaluate(self, inputs: ArrayLike, state: PlayState | None = None) -> Floats:
        """Return the outputs of a sequence, shape (N,), from `state` (default: relaxed).

        Raises ValueError if `inputs` is empty, not one-dimensional or not finite, or `state` has the wrong length.
        """
        from bench.models.kernels import memory_kernels as _kernels

        total = _kernels.weighted_plays(
            self._drive(inputs), self.thresholds, self.weights, self._checked(state).copy()
        )
        return self.bias + (total if self.after is None else self.after(total))

    def advance(self, state: PlayState, inputs: ArrayLike) -> PlayState:
        """Return the state after a sequence of inputs, shape (N,).

        Raises ValueError as `evaluate`.
        """
        from bench.models.kernels import memory_kernels as _kernels

        plays = self._checked(state).copy()
        _kernels.weighted_plays(self._drive(inputs), self.thresholds, self.weights, plays)
        return tuple(plays.tolist())

    @cached_property
    def _lists(self) -> tuple[list[float], list[float]]:
        return self.thresholds.tolist(), self.weights.tolist()

    def step(self, state: PlayState, value: float) -> tuple[PlayState, float]:
        """Return state and output after the input moved monotonically to `value`.

        Raises ValueError if `value` is not finite or the state has the wrong length.
        """
        if not math.isfinite(value):
            raise ValueError(f"value: expected a finite number, got {value}")
        thresholds, _ = self._lists
        if len(state) != len(thresholds):
            raise ValueError(f"state: expected {len(thresholds)} play states, got {len(state)}")
        x = self._inner(value)
        after = tuple([max(x - r, min(x + r, z)) for r, z in zip(thresholds, state, strict=True)])
        return after, self._output(after)

    def value(self, state: PlayState) -> float:
        """Return the output of a state.

        Raises ValueError if the state has the wrong length or is not finite.
        """
        return self._output(tuple(self._checked(state).tolist()))

    def stream(self, state: PlayState | None = None) -> PlayStream:
        """Return the operator with a memory of its own, compiled; see `Operator.stream`.

        Raises ValueError if the state has the wrong length or is not finite.
        """
        return PlayStream(self, tuple(self._checked(state).tolist()))

    def _output(self, state: PlayState) -> float:
        total = 0.0
        for weight, z in zip(self._lists[1], state, strict=True):
            total += weight * z
        return self.bias + (total if self.after is None else self.after.value(total))

    def regressor(self, inputs: ArrayLike, state: PlayState | None = None) -> Regressor:
        """Return the dense columns that the coefficients multiply.

        evaluate(inputs) = bias + regressor @ coefficients: the play states, or, with dead zones after the plays, what
        `DeadZones.columns` makes of the weighted sum. Raises ValueError as `evaluate`.
        """
        columns = self._plays(inputs, state)
        if self.after is not None:
            columns = self.after.columns(columns @ self.weights)
        return Regressor.of_columns(columns)

    def shifted(self, offset: float) -> PrandtlIshlinskii:
        """Return the operator whose output at an input u is that of this one at u + offset, input units.

        Raises ValueError if the offset is not finite.
        """
        low, high = self.input_range
        return replace(self, origin=self.origin - offset, input_range=(low - offset, high - offset))

    def output_range(self) -> tuple[float, float]:
        """Return the least and greatest output that the operating range can produce from the relaxed state.

        The output is monotone in the input, so both are at the ends of the range. There a play too wide to
        follow still depends on how far the input had been the other way; the output is piecewise linear in that
        distance and is tested at every break.
        """
        low, high = sorted(self._inner(end) for end in self.input_range)
        ends = [-self._farthest(-high, -low), self._farthest(low, high)]
        if self.after is not None:
            ends = [self.after.value(end) for end in ends]
        least, greatest = sorted(ends)
        return self.bias + least, self.bias + greatest

    def _farthest(self, low: float, high: float) -> float:
        """Return the sum of weighted plays for x from low to high that is farthest from 0, reached at high."""
        r = self.thresholds
        turns = np.clip(np.concatenate([[low, high, 0.0], -r, high - 2.0 * r]), low, high)
        states = np.maximum(high - r, np.minimum(0.0, turns[:, None] + r))
        sums = states @ self.weights
        return float(sums.max() if self._sign > 0 else sums.min())

    @cached_property
    def _sums(self) -> Floats:
        return np.asarray(np.cumsum(self.weights))

    @cached_property
    def _sign(self) -> Literal[-1, 1]:
        """-1 if the sum of the plays falls with x, else 1."""
        return -1 if -self._sums.min() > self._sums.max() else 1

    @property
    def _direction(self) -> int:
        """-1 if the output falls with the input, else 1."""
        maps = [zones.sign for zones in (self.before, self.after) if zones is not None]
        return math.prod([self._sign, *maps])

    def inverse_operator(self) -> PrandtlIshlinskii:
        """Return the operator that gives the input back: itself a Prandtl-Ishlinskii operator.

        Thresholds r'_i = |sum over j <= i of w_j (r_i - r_j)|; weights 1/w_0 and -w_i / (W_i W_{i-1}) with the
        running sums W (Kuhnen 2003). Its states come from `inverse_state`; its operating range is this operator's
        `output_range`. Raises ValueError if a running sum of the weights or a slope of the dead zones is zero: a
        plateau has no inverse.
        """
        w, r, sums = self.weights, self.thresholds, self._sums
        if not (self._sign * sums > 0.0).all():
            at = int(np.argmax(self._sign * sums <= 0.0))
            raise ValueError(f"weights: expected running sums > 0 for an inverse, got {sums[at]} at play {at}")
        thresholds = np.append(0.0, np.cumsum(np.abs(sums[:-1]) * np.diff(r)))
        weights = np.append(1.0 / w[0], -w[1:] / (sums[1:] * sums[:-1]))
        return PrandtlIshlinskii(
            thresholds,
            weights,
            bias=self.origin,
            origin=self.bias,
            before=None if self.after is None else self.after.inverse(),
            after=None if self.before is None else self.before.inverse(),
            input_range=self.output_range(),
            input_unit=self.output_unit,
            output_unit=self.input_unit,
        )

    def inverse_state(self, state: PlayState) -> PlayState:
        """Return the state of `inverse_operator()` that belongs to a state of this operator.

        z'_i = W_i z_i + sum over j > i of w_j z_j. Raises ValueError if the state has the wrong length or is not
        finite.
        """
        z = self._checked(state)
        weighted = self.weights * z
        beyond = np.append(np.cumsum(weighted[:0:-1])[::-1], 0.0)
        return tuple((self._sums * z + beyond).tolist())

    def rises(self) -> bool:
        """Return whether the running sums of the weights and the slopes of the dead zones make the output rise."""
        return self._direction > 0

    def inverse(self, policy: Policy = "nearest") -> Inverse[PlayState]:
        """Return the exact inverse, or the numerical one if the operator has a plateau."""
        from bench.models.inverses.inverse import NumericalInverse, PlayInverse

        slopes = [np.abs(zones.slopes).min() for zones in (self.before, self.after) if zones is not None]
        exact = min([*slopes, (self._sign * self._sums).min()]) > 0.0
        return PlayInverse(self) if exact else NumericalInverse(self, policy)
