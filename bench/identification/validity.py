"""Where a model is valid: the inputs that were fitted, and how far others lie beyond them.

A model with memory depends on the range of its input and on the moves from one turning point to the next, one with
time on the speed of these moves too. An input that exceeds the range by more than a hundredth is always named. Of two
records of one kind each has moves beyond those of the other, so moves are named where so many are no chance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.base import Floats, checks as _checks
from bench.identification.branches import NOISE, turning_points

_CHANCE = 0.05
"""Probability below which moves beyond those fitted are no chance. Source: the usual level of a test."""

_SAME = 0.01
"""Part of the range by which inputs may exceed it. Derivation: sampled turning points that are meant to be equal
differ by this much, see `overwritten_from`; a model that is continued by its tangent errs there as at its ends."""

Kind: TypeAlias = Literal["smaller", "larger", "slower", "faster"]


@dataclass(frozen=True)
class BeyondMoves:
    """Moves of an input that are smaller, larger, slower or faster than all that were fitted."""

    # How many, and of how many moves.
    count: int
    of: int
    farthest: float  # the smallest or greatest of them, input units, or their mean speed, input units a second
    by_chance: bool  # whether another record of one kind with that of the fit has so many


@dataclass(frozen=True)
class Beyond:
    """How far inputs lie beyond those that were fitted.

    Attributes
    ----------
    validity : Validity
        What was fitted.
    of : int
        Number of inputs.
    rows : ndarray of int, shape (n,)
        Rows beyond the range, from 1.
    distance : float
        Greatest distance from the range, input units; 0 if there are none.
    moves : mapping of str to BeyondMoves
        By kind, those that were judged: moves and speeds that the fit and the inputs both have.
    unit : str
        Unit of the input.
    """

    validity: Validity
    of: int
    rows: NDArray[np.int64]
    distance: float
    moves: Mapping[Kind, BeyondMoves]
    unit: str

    @property
    def percent(self) -> float:
        """Greatest distance as a part of the range, %."""
        span = self.validity.high - self.validity.low
        return 100.0 * self.distance / span if span else float("inf") if self.distance else 0.0

    def text(self, what: str = "inputs") -> str:
        """Return what a person should know, in a sentence without a full stop; empty if nothing is beyond."""
        known, unit, said = self.validity, self.unit, list[str]()
        if self.rows.size:
            said.append(
                f"{self.rows.size} of {self.of} {what} lie beyond those fitted, {known.range_text(unit)}, by up to "
                f"{self.percent:.2g} % of their range"
            )
        for kind, each in self.moves.items():
            if not each.by_chance:
                fitted = known.moves_text(unit) if kind in ("smaller", "larger") else known.rates_text(unit)
                said.append(
                    f"{each.count} of {each.of} moves of the input are {kind} than those fitted, {fitted} (as far as "
                    f"{each.farthest:.3g})"
                )
        return f"{', and '.join(said)}; the errors there are unknown" if said else ""

    def to_json(self) -> dict[str, Any]:
        """Return the same for programs; `rows` as first and last row of each stretch."""
        edges = np.flatnonzero(np.diff(self.rows) > 1)
        ends = np.append(edges, self.rows.size - 1) if self.rows.size else edges
        return {
            "count": self.rows.size,
            "of": self.of,
            "rows": np.column_stack([self.rows[np.append(0, edges + 1)[: ends.size]], self.rows[ends]]).tolist(),
            "distance": self.distance,
            "distance_percent": self.percent,
            **{kind: asdict(each) for kind, each in self.moves.items()},
        }


@dataclass(frozen=True)
class Validity:
    """The inputs that a model was fitted to.

    Attributes
    ----------
    low, high : float
        Range, input units.
    moves : tuple of float, or None
        Least and greatest move from one turning point to the next, peak to peak, input units; None if there is no
        reversal, the model has no memory, or nobody noted them.
    rates : tuple of float, or None
        Least and greatest mean speed of such a move, input units a second; None without times.
    count : int
        Number of moves.
    rows, skipped, left_out : int
        Rows that were fitted; first rows that only drove the memory; further rows that were not fitted.
    """

    low: float
    high: float
    moves: tuple[float, float] | None = None
    rates: tuple[float, float] | None = None
    count: int = 0
    rows: int = 0
    skipped: int = 0
    left_out: int = 0

    @classmethod
    def of_rows(
        cls, inputs: ArrayLike, fitted: NDArray[np.bool_], times: Floats | None = None, skipped: int = 0
    ) -> Validity:
        """Return the validity of a model that was fitted to some of a sequence of inputs.

        Parameters
        ----------
        inputs : array_like, shape (N,)
            Input units.
        fitted : ndarray of bool, shape (N,)
            The rows that were fitted.
        times : ndarray, shape (N,), or None
            s, if they matter.
        skipped : int
            Number of first rows that only drove the memory.

        Raises
        ------
        ValueError
            If no row was fitted, or an input is not finite.
        """
        values = _checks.samples("inputs", inputs)
        used = _checks.samples("inputs fitted", values[fitted])
        low, high = float(used.min()), float(used.max())
        lengths, rates = _moves(values, times, NOISE * (high - low), fitted)
        return cls(
            low,
            high,
            _ends(lengths),
            _ends(rates),
            max(lengths.size, rates.size),
            used.size,
            skipped,
            values.size - skipped - used.size,
        )

    def judge(self, inputs: ArrayLike, times: Floats | None = None, *, first: int = 0, unit: str = "") -> Beyond:
        """Return how far inputs lie beyond those that were fitted.

        A move that leaves the range is not named as a larger one too.

        Parameters
        ----------
        inputs : array_like, shape (N,)
            Input units.
        times : ndarray, shape (N,), or None
            s, for a model with time.
        first : int
            Row of the first input, from 0.
        unit : str
            Unit of the input.

        Raises
        ------
        ValueError
            If they are empty or not finite.
        """
        values = _checks.samples("inputs", inputs)
        distances = np.maximum(self.low - values, values - self.high)
        span = self.high - self.low
        lengths, rates = _moves(values, times, NOISE * span)
        moves = {
            **self._compared(("smaller", "larger"), self.moves, lengths, span),
            **self._compared(("slower", "faster"), self.rates, rates),
        }
        distances[distances <= _SAME * span] = 0.0
        rows = np.flatnonzero(distances) + first + 1
        return Beyond(self, values.size, rows, float(distances.max()), moves, unit)

    def text(self, unit: str) -> str:
        """Return range, moves and rates, as far as they are known, in a line."""
        parts = [self.range_text(unit)]
        parts += [f"moves of {self.moves_text(unit)}"] if self.moves else []
        parts += [f"at {self.rates_text(unit)}"] if self.rates else []
        return ", ".join(parts)

    def range_text(self, unit: str) -> str:
        """Return the range as text."""
        return f"{self.low:.6g} to {self.high:.6g} {unit}".rstrip()

    def moves_text(self, unit: str) -> str:
        """Return the moves as text."""
        return "unknown" if self.moves is None else f"{self.moves[0]:.4g} to {self.moves[1]:.4g} {unit}".rstrip()

    def rates_text(self, unit: str) -> str:
        """Return the rates as text."""
        return "unknown" if self.rates is None else f"{self.rates[0]:.4g} to {self.rates[1]:.4g} {unit}/s"

    def to_json(self) -> dict[str, Any]:
        """Return the validity as a JSON object."""
        return asdict(self)

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Validity:
        """Return the validity that `to_json` wrote.

        Raises ValueError if a key is missing or a value cannot be.
        """
        numbers = {name: _checks.json_field(document, name, "validity") for name in cls.__dataclass_fields__}
        values: dict[str, Any] = {}
        for name, value in numbers.items():
            if name in ("moves", "rates"):
                values[name] = None if value is None else tuple(_checks.samples(f"validity: {name}", value).tolist())
                if value is not None and not (len(values[name]) == 2 and 0.0 <= values[name][0] <= values[name][1]):
                    raise ValueError(f"validity: {name}: expected least and greatest, got {value!r}")
            else:
                number = _checks.number(f"validity: {name}", value)
                values[name] = number if name in ("low", "high") else int(number)
        if values["low"] > values["high"]:
            raise ValueError(f"validity: expected low ≤ high, got {values['low']} and {values['high']}")
        return cls(**values)

    def _compared(
        self, kinds: tuple[Kind, Kind], limits: tuple[float, float] | None, sample: Floats, most: float = np.inf
    ) -> dict[Kind, BeyondMoves]:
        """Return which of a sample lie below and above limits, but for noise and what is above `most`."""
        if limits is None or not sample.size:
            return {}
        (least, greatest), noise = limits, NOISE * limits[1]
        below, above = sample[sample < least - noise], sample[(sample > greatest + noise) & (sample <= most)]
        ends = float(below.min(initial=least)), float(above.max(initial=greatest))
        return {
            kind: BeyondMoves(beyond.size, sample.size, end, self._is_chance(beyond.size, sample.size))
            for kind, beyond, end in zip(kinds, (below, above), ends, strict=True)
        }

    def _is_chance(self, beyond: int, of: int) -> bool:
        """Return whether so many of some further moves may be beyond all that were fitted by chance."""
        further = of - np.arange(beyond)
        return bool(np.prod(further / (self.count + further)) > _CHANCE)


def _moves(
    inputs: Floats, times: Floats | None, noise: float, fitted: NDArray[np.bool_] | None = None
) -> tuple[Floats, Floats]:
    """Return lengths and mean speeds of the moves between turning points, those that were fitted at both ends.

    The first and the last one, which the record cuts, count only if there are no others. Without a reversal there are
    no lengths, and without times no speeds.
    """
    turns = turning_points(inputs, noise)
    lengths = np.abs(np.diff(inputs[turns]))
    speeds = np.empty(0) if times is None or turns.size < 2 else lengths / np.diff(times[turns])
    kept = np.ones(lengths.size, dtype=bool)
    if fitted is not None:
        kept &= fitted[turns[:-1]] & fitted[turns[1:]]
    if kept[1:-1].any():
        kept[[0, -1]] = False
    kept &= lengths > 0.0
    return (lengths[kept] if turns.size > 2 else np.empty(0)), (speeds[kept] if speeds.size else speeds)


def _ends(values: Floats) -> tuple[float, float] | None:
    return (float(values.min()), float(values.max())) if values.size else None
