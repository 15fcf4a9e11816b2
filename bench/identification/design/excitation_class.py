"""The class of an excitation: what kind of input sequence it is, in a few numbers, and whether another is of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.identification.branches import turning_points

LEAST_SWING = 0.02
"""A swing below this part of the range is noise of the measured input."""

# Values this close, as part of the range, count as equal.
_TOLERANCE = 0.03
# A swing of at least this part of the range is one of the major loop.
_MAJOR = 0.95
# Share of the reversals that must follow a rule.
_MOST = 0.8
# Fewer reversals than this say nothing of a class.
_FEWEST = 4
_DECILES = np.linspace(0.0, 1.0, 11)
# Factors of the two-sample Kolmogorov-Smirnov statistic. Independent samples of one distribution exceed 1.36 in 5 %
# of the cases. Swings, distances and rates of random reversals exceed theirs in 1 to 2 %, as measured; corners of the
# memory depend on each other over many reversals, so that theirs is greater.
_SMIRNOV = 1.36
_OF_SWINGS, _OF_REACHES, _OF_DEPTHS, _OF_RATES = 1.08, 0.9, 2.1, 0.6
# Rates this close, as a factor, count as equal.
_RATE = 1.25

DAMPED = "damped oscillations"
GROWING = "growing oscillations"
PERIODIC = "periodic cycles"
FROM_ABOVE = "first-order reversals from above"
FROM_BELOW = "first-order reversals from below"
RANDOM = "random reversals"
RAMPS = "single ramps"


@dataclass(frozen=True)
class ExcitationClass:
    """What a sequence of inputs is like, as far as rate-independent memory can tell; with times its rates as well.

    Parameters
    ----------
    kind : str
        In words, such as `damped oscillations` or `random reversals`.
    low, high : float
        Range of the inputs, input units.
    reversals : int
        Number of turning points.
    minor : float
        Share of the swings from one turning point to the next that belong to minor loops, 0 to 1.
    contracting : float
        Share of the swings that are shorter than the one before, 0 to 1: near 1 for a damped oscillation.
    swings : tuple of float
        Deciles of the lengths of the swings, as parts of the range, 11 numbers; none without a swing.
    highs, lows : tuple of float
        Deciles of the upper and of the lower turning points, input units, 11 numbers each; none without one.
    reaches : tuple of float
        Deciles of the distances of the turning points from the middle of the range, parts of the range, 11 numbers.
    depths : tuple of float
        Deciles of the number of corners of the memory at the turning points, 11 numbers.
    rates : tuple of float
        Deciles of the mean speed of each swing, input units a second, 11 numbers; none where no times were given.
    """

    kind: str
    low: float
    high: float
    reversals: int
    minor: float
    contracting: float
    swings: tuple[float, ...]
    highs: tuple[float, ...]
    lows: tuple[float, ...]
    reaches: tuple[float, ...] = ()
    depths: tuple[float, ...] = ()
    rates: tuple[float, ...] = ()

    @classmethod
    def of(cls, inputs: ArrayLike, times: Floats | None = None) -> ExcitationClass:
        """Return the class of a sequence of inputs, shape (N,), at times, s, if these matter.

        Raises ValueError if it is empty or not finite.
        """
        values = _checks.samples("inputs", inputs)
        low, high = float(values.min()), float(values.max())
        points = _reversals(values)
        lengths = np.abs(np.diff(points)) / max(high - low, 1e-300)
        upper, lower = _turning(points)
        shorter = lengths[1:] < lengths[:-1]
        contracting = float(shorter.mean()) if shorter.size else 0.0
        return cls(
            kind=_kind(upper, lower, contracting, low, high),
            low=low,
            high=high,
            reversals=upper.size + lower.size,
            minor=float((lengths < _MAJOR).mean()) if lengths.size else 0.0,
            contracting=contracting,
            swings=_deciles(lengths),
            highs=_deciles(upper),
            lows=_deciles(lower),
            reaches=_deciles(_reaches(points, low, high)),
            depths=_deciles(_depths(points)),
            rates=() if times is None else _deciles(_rates(values, times)),
        )

    @property
    def center(self) -> float:
        """Where the innermost swing lies, input units; the middle of the range without a swing."""
        return 0.5 * (self.highs[0] + self.lows[-1] if self.highs and self.lows else self.low + self.high)

    def departures(self, inputs: ArrayLike, times: Floats | None = None) -> tuple[str, ...]:
        """Return in which ways other inputs, shape (N,), are not of this class; none if they are.

        They are of the class if they stay in its range (to 3 % of it), are of its kind, die out at the same place (to
        3 % of the range) if they are damped oscillations, and the distributions of the swings, of the turning points
        and of the corners of the memory differ by no more than those of two sequences of one kind (two-sample
        Kolmogorov-Smirnov test on the deciles). Where the class has rates and the inputs times, s, so do their rates.

        Raises ValueError if they are empty or not finite.
        """
        values = _checks.samples("inputs", inputs)
        span = self.high - self.low
        margin = _TOLERANCE * span
        other = ExcitationClass.of(values)
        found = []
        if other.low < self.low - margin or other.high > self.high + margin:
            found.append(f"it spans {other.low:g} to {other.high:g}, not {self.low:g} to {self.high:g}")
        if other.reversals < _FEWEST <= self.reversals:
            found.append(f"it has {other.reversals} reversals, too few to tell its class")
        elif other.kind != self.kind:
            found.append(f"it is of the kind {other.kind}")
        elif self.kind == DAMPED and abs(other.center - self.center) > margin:
            found.append(f"it dies out at {other.center:g}, not at {self.center:g}")
        points = _reversals(values)
        upper, lower = _turning(points)
        swings = np.abs(np.diff(points)) / max(span, 1e-300)
        # A turning point belongs to two swings: half of them are independent, at most.
        independent = float(np.sqrt(2.0 / max(self.reversals, 1) + 2.0 / max(other.reversals, 1)))
        reaches = _reaches(points, self.low, self.high)
        for name, deciles, sample, tolerance, factor in (
            ("swings", self.swings, swings, _TOLERANCE, _OF_SWINGS),
            ("upper reversals", self.highs, upper, margin, _SMIRNOV),
            ("lower reversals", self.lows, lower, margin, _SMIRNOV),
            ("reversals about the middle", self.reaches, reaches, 0.5 * _TOLERANCE, _OF_REACHES),
            ("corners of the memory", self.depths, _depths(points), 0.0, _OF_DEPTHS),
        ):
            if not deciles or not sample.size:
                continue
            # The others have half of their turning points in common.
            limit = (factor if self.kind == RANDOM else max(factor, _SMIRNOV)) * independent
            distance = _distance(deciles, sample, tolerance)
            if distance > limit:
                found.append(f"its {name} are distributed otherwise (distance {distance:.2f}, allowed {limit:.2f})")
        if self.rates and times is not None and (rates := _rates(values, times)).size:
            known = tuple(np.log(self.rates).tolist())
            limit = _OF_RATES * independent
            if (distance := _distance(known, np.log(rates), float(np.log(_RATE)))) > limit:
                usual = f"{np.median(rates):.3g} a second, not {self.rates[5]:.3g}"
                found.append(f"it moves at about {usual} (distance {distance:.2f}, allowed {limit:.2f})")
        return tuple(found)

    def to_json(self) -> dict[str, Any]:
        """Return the class as a JSON object."""
        return {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(self).items()}

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> ExcitationClass:
        """Return the class that `to_json` wrote.

        Raises ValueError if a key is missing, unknown or wrong.
        """
        try:
            values: dict[str, Any] = {
                key: tuple(value) if isinstance(value, list) else value for key, value in document.items()
            }
            found = cls(**values)
        except TypeError as error:
            raise ValueError(f"calibrated_on: {error}") from None
        if not isinstance(found.kind, str):
            raise ValueError(f"calibrated_on: expected a text for kind, got {found.kind!r}")
        for name in ("low", "high", "reversals", "minor", "contracting"):
            _checks.number(f"calibrated_on: {name}", getattr(found, name))
        for name in ("swings", "highs", "lows", "reaches", "depths", "rates"):
            deciles = getattr(found, name)
            if deciles and _checks.samples(f"calibrated_on: {name}", deciles).size != _DECILES.size:
                raise ValueError(f"calibrated_on: {name}: expected {_DECILES.size} deciles, got {len(deciles)}")
        return found


def _reversals(values: Floats) -> Floats:
    """Return the first input, the values at which the inputs turn, and the last one."""
    return values[turning_points(values, LEAST_SWING * float(np.ptp(values)))]


def _rates(values: Floats, times: Floats) -> Floats:
    """Return the mean speed of each swing, input units a second."""
    turns = turning_points(values, LEAST_SWING * float(np.ptp(values)))
    return np.abs(np.diff(values[turns])) / np.diff(times[turns])


def _turning(points: Floats) -> tuple[Floats, Floats]:
    """Return the upper and the lower turning points among points that alternate; both ends are none."""
    inner = points[1:-1]
    above = inner > points[:-2]
    return inner[above], inner[~above]


def _reaches(points: Floats, low: float, high: float) -> Floats:
    """Return the distances of the turning points from the middle of a range, as parts of it."""
    return np.abs(points[1:-1] - 0.5 * (low + high)) / max(high - low, 1e-300)


def _depths(points: Floats) -> Floats:
    """Return the number of corners of the memory at each turning point but the first; a closed loop leaves none."""
    corners: list[float] = []
    depths = []
    for point in points[:-1].tolist():
        while len(corners) >= 2 and abs(point - corners[-1]) >= abs(corners[-1] - corners[-2]):
            del corners[-2:]
        corners.append(point)
        depths.append(len(corners))
    return np.array(depths[2:], dtype=np.float64)


def _deciles(values: Floats) -> tuple[float, ...]:
    if not values.size:
        return ()
    return tuple(float(f"{value:.6g}") for value in np.quantile(values, _DECILES))


def _kind(upper: Floats, lower: Floats, contracting: float, low: float, high: float) -> str:
    count = upper.size + lower.size
    if count < _FEWEST:
        return RAMPS
    margin = _TOLERANCE * (high - low)
    # The first turn ends the approach.
    if max(np.ptp(upper[1:]), np.ptp(lower[1:])) <= 2.0 * margin:
        return PERIODIC
    if (upper >= high - margin).mean() >= _MOST:
        return FROM_ABOVE
    if (lower <= low + margin).mean() >= _MOST:
        return FROM_BELOW
    if contracting >= _MOST:
        return DAMPED
    return GROWING if contracting <= 1.0 - _MOST else RANDOM


def _distance(deciles: tuple[float, ...], sample: Floats, tolerance: float) -> float:
    """Return the greatest difference of two distributions at the deciles of one.

    Values within the tolerance count as equal.
    """
    ordered = np.sort(sample)
    points = np.array(deciles)
    below = np.searchsorted(ordered, points - tolerance, side="left") / ordered.size
    up_to = np.searchsorted(ordered, points + tolerance, side="right") / ordered.size
    return float(np.maximum(below - _DECILES, _DECILES - up_to).max())
