"""Noise of the readings, and what drive and response do while the set-point stands.

Everything is found within holds: there the set-point, and with it the model, stand still. Noise is the difference of
neighbouring rows where the response depends least on the drive. Wander of the drive as the specimen sees it, and
drift of the response, are those with which a simulation shows the mean squares of differences that were measured, by
the time between two rows and by the slope of the response.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.hysteresis import Operator
from bench.hysteresis._checks import Floats
from bench.transients.actuator import MEDIAN_OF_DIFFERENCES, at_rows, latency
from bench.transients.recording import Recording
from bench.twin.specimen import Dynamics, Specimen, Unevenness, Wander

_LAGS = (0.3, 1.0, 3.0, 8.0, 20.0, 60.0)
"""Edges of the classes of the time between two rows, s."""
_SLOPES = 3
"""Classes of the slope of the response."""
_GAPS = (1, 2, 3, 6, 12, 25, 50, 100)
"""From row to row of a pair, in rows of their kind."""
_MIXED = 2
"""Kind of the pairs of a quick row and the reading after it; 0 and 1 are those of quick rows and of readings."""
_CLASSES = (len(_LAGS) + 1, _SLOPES, _MIXED + 1)
"""Numbers of classes of pairs: by time, slope and kind."""
_LONGEST = 4000.0
"""Part of a run that is simulated, s."""
_QUICKEST = 0.2
"""Least correlation time of wander and drift, s."""
_FEWEST = 12
"""Fewest differences of a class that counts."""
_SETTLED, _LAGGED = 4.0, 4.0
"""Time constants of the actuator and lags after which the set-point counts as reached. Behind a lag the response of a
steep model still moves by more than its noise, which would be taken for wander."""
_NEAR = 2e-3
"""Share of the range of the drive over which the slope is taken."""
_LEAST_OF_HOLD = 3
"""Readings of a hold whose middle counts."""
_FAR, _DIGITS = 6.0, 1.5
"""Distance of an outlier from that middle, in standard deviations and in last digits."""
_MOST, _MOST_OF_DIFFERENCES = 0.9, 1.6449 * math.sqrt(2.0)
"""A quantile of differences, and what it is of those of normal numbers of a standard deviation of 1."""
_RARE, _SEEN = 0.05, 3
"""Greatest share of outliers, and their least number."""
_QUANTILES = 9
"""How many of their quantiles are kept."""
_SIMULATIONS = 20
"""Whose mean is the effect of wander."""
_SEED = 0
"""Of the simulations, the same for each trial."""


@dataclass(frozen=True)
class Noise:
    """White noise of a signal, in its unit.

    Attributes
    ----------
    reading, quick : float
        Standard deviation of a reading, and of a quick one.
    resolution : float
        Last digit; 0 for none.
    outlier_share : float
        Share of readings that are further off than noise and last digit explain.
    outliers : tuple of float
        By how much these are off: quantiles.
    relative_outliers : bool
        Whether these are shares of what is read, not in its unit.
    """

    reading: float = 0.0
    quick: float = 0.0
    resolution: float = 0.0
    outlier_share: float = 0.0
    outliers: tuple[float, ...] = ()
    relative_outliers: bool = False


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Pairs of rows of one hold: their rows, class (time, slope), kind, the hold, and the direction of its move."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    time: NDArray[np.int64]
    slope: NDArray[np.int64]
    kind: NDArray[np.int64]
    hold: NDArray[np.int64]
    direction: Floats

    @property
    def place(self) -> NDArray[np.int64]:
        """Class of each pair, by time, slope and kind, as one number."""
        return np.asarray(np.ravel_multi_index((self.time, self.slope, self.kind), _CLASSES))


def noise_of(recordings: Sequence[Recording], signal: str, dynamics: Dynamics, *, outliers: bool = False) -> Noise:
    """Return the noise of a signal that stands still within holds, such as what is read of the drive."""
    holds = [hold for r in recordings for hold in _holds(r, signal, dynamics)]
    if not holds:
        return Noise()
    # Outliers that are in proportion to what is read are no multiples of its last digit.
    still = [hold.values for hold in holds if np.ptp(hold.values) == 0.0]
    values = np.concatenate(still if 2 * len(still) > len(holds) else [hold.values for hold in holds])
    resolution = _resolution(values)
    off, limit = [np.zeros(hold.values.size, dtype=bool) for hold in holds], 0.0
    if outliers:
        off, limit = _outliers(holds, resolution)
    found = []
    for kind in (True, False):
        kept = [h.values[(h.is_reading == kind) & ~o] for h, o in zip(holds, off, strict=True)]
        found.append(_deviation(np.concatenate([np.diff(each) for each in kept])))
    errors = np.concatenate([hold.values - hold.middle for hold in holds])
    levels = np.concatenate([np.full(hold.values.size, hold.middle) for hold in holds])
    return with_outliers(_noise(found, resolution), errors, levels, np.concatenate(off), limit)


def with_outliers(noise: Noise, errors: Floats, levels: Floats, off: NDArray[np.bool_], limit: float) -> Noise:
    """Return noise with outliers.

    Parameters
    ----------
    noise : Noise
        The noise without.
    errors, levels : ndarray, shape (N,)
        By how much each value is off, and what it should be.
    off : ndarray of bool, shape (N,)
        Which of them are outliers.
    limit : float
        A smaller error would not have been seen as one.
    """
    if int(off.sum()) < _SEEN:
        return noise
    relative = _is_relative(errors[off], levels[off])
    sizes = errors[off] / levels[off] if relative else errors[off]
    seen = off | (np.abs(levels) * float(np.median(np.abs(sizes))) > limit) if relative else np.ones_like(off)
    quantiles = np.quantile(sizes, (np.arange(_QUANTILES) + 0.5) / _QUANTILES)
    return replace(
        noise,
        outlier_share=float(np.mean(off[seen])),
        outliers=tuple(quantiles.tolist()),
        relative_outliers=relative,
    )


@dataclass(frozen=True, eq=False)
class _Hold:
    """What was read of a signal while it stood, and which of it are readings, not quick ones."""

    values: Floats
    is_reading: NDArray[np.bool_]

    @property
    def middle(self) -> float:
        return float(np.median(self.values))


def _holds(recording: Recording, signal: str, dynamics: Dynamics) -> list[_Hold]:
    """Return the settled part of each hold that has readings enough."""
    values = recording.columns[signal]
    rows = np.flatnonzero(_settled(recording, dynamics) & np.isfinite(values))
    parts = np.split(rows, np.flatnonzero(np.diff(recording.last_change[rows])) + 1)
    return [_Hold(values[part], recording.is_reading[part]) for part in parts if part.size >= _LEAST_OF_HOLD]


def _outliers(holds: Sequence[_Hold], resolution: float) -> tuple[list[NDArray[np.bool_]], float]:
    """Return which readings of each hold are off, and from which distance on they count as such.

    They are rare, and each is alone between two that are not off.
    """
    distances = [np.abs(hold.values - hold.middle) for hold in holds]
    limits = {}
    for kind in (True, False):
        every = np.abs(np.concatenate([np.diff(h.values[h.is_reading == kind]) for h in holds]))
        # A median knows nothing of outliers.
        deviation = float(np.median(every)) / MEDIAN_OF_DIFFERENCES if every.size else 0.0
        limits[kind] = max(_FAR * deviation, _DIGITS * resolution)
    found = []
    for distance, hold in zip(distances, holds, strict=True):
        off = distance > np.where(hold.is_reading, limits[True], limits[False])
        # What stays away from the middle moves; it is no outlier.
        beside = np.append(False, off[:-1]) | np.append(off[1:], False)
        found.append(off & ~beside)
    count = sum(int(each.sum()) for each in found)
    if not _SEEN <= count <= _RARE * sum(each.size for each in found):
        found = [np.zeros_like(each) for each in found]
    return found, max(limits.values())


def _is_relative(far: Floats, levels: Floats) -> bool:
    """Return whether outliers are in proportion to what is read, by the likelihood of log-normal magnitudes.

    Both hypotheses have as many numbers, and their magnitudes differ by a factor that is known: the one in which
    their logarithms scatter less is more likely.
    """
    if not np.all(levels != 0.0):
        return False
    magnitudes = np.log(np.abs(far))
    return float(np.std(magnitudes - np.log(np.abs(levels)))) < float(np.std(magnitudes))


def identify_disturbances(
    recordings: Sequence[Recording], operators: Sequence[Operator[Any]], dynamics: Dynamics, signal: str
) -> tuple[Noise, Wander, Wander]:
    """Return the noise of the response, the wander of the drive, and the drift of the response."""
    from scipy.optimize import minimize

    parts = [Part(r, tuple(operators), dynamics) for r in recordings]
    _classify(parts)
    noise = _response_noise(parts, recordings, signal)
    quick, reading = noise.quick**2, noise.reading**2
    counts, variances, trends = _moments(parts, [part.errors for part in parts])
    used = counts >= _FEWEST
    if not used.any():
        return noise, Wander(), Wander()
    variances = np.maximum(variances[used], 1e-300)
    white = np.broadcast_to([2.0 * quick, 2.0 * reading, quick + reading], counts.shape)[used]
    holds, independent = (each[used] for each in evidence(parts))
    # The logarithm of a mean of n independent squares is uncertain by the square root of 2 / n.
    weights = 0.5 * np.minimum(independent, 200.0)
    # How a hold goes on says the same of wander only once, and a few holds go on as their drift happens to.
    trusted = np.where(holds >= _FEWEST, np.minimum(holds, 200.0), 0.0)
    span = float(np.ptp(np.concatenate([r.driven for r in recordings])))
    height = float(np.ptp(np.concatenate([r.responded for r in recordings])))

    def trial(numbers: Floats) -> tuple[Wander, Wander]:
        wander, wander_time, drift, drift_time = np.exp(np.clip(numbers, -30.0, 12.0)).tolist()
        return Wander(wander * span, max(wander_time, _QUICKEST)), Wander(drift * height, drift_time)

    def cost(numbers: Floats) -> float:
        wander, drift = trial(numbers)
        disturbed = replace(dynamics, wander=wander, drift=drift)
        _, found, went = _moments(parts, [part.simulate(disturbed, _SEED + n) for n, part in enumerate(parts)])
        ratios = np.maximum(found[used] + white, 1e-300) / variances
        misses = weights * np.log(ratios) ** 2 + trusted * (went - trends)[used] ** 2 / variances
        penalty = float(np.sum(np.maximum(numbers[[1, 3]] - math.log(3000.0), 0.0) ** 2)) + float(
            np.sum(np.maximum(math.log(_QUICKEST) - numbers[[1, 3]], 0.0) ** 2)
        )
        return float(np.sum(misses)) + 100.0 * penalty

    start = np.log([3e-4, 5.0, 1e-4, 100.0])
    simplex = np.vstack([start, start + np.diag([1.0, 1.0, 1.0, 1.0])])
    solved = minimize(
        cost,
        start,
        method="Nelder-Mead",
        options={"maxfev": 90, "initial_simplex": simplex, "xatol": 0.02, "fatol": 0.1},
    )
    wander, drift = trial(solved.x)
    return noise, wander, drift


def mean_effects(
    recordings: Sequence[Recording], operators: Sequence[Operator[Any]], dynamics: Dynamics
) -> list[Floats]:
    """Return what wander adds to the response at each row of each run, on average over simulations.

    A specimen with hysteresis keeps the extremes of what it has seen: wander drives it on in the direction of the
    last move, further the longer a hold is.
    """
    if not dynamics.wander.deviation:
        return [np.zeros(r.times.size) for r in recordings]
    wandering = replace(dynamics, drift=Wander(), unevenness=Unevenness())
    effects = []
    for r in recordings:
        part = Part(r, tuple(operators), dynamics, math.inf)
        effects.append(np.mean([part.simulate(wandering, _SEED + n) for n in range(_SIMULATIONS)], axis=0))
    return effects


class Part:
    """A run, simulated without disturbances, and the pairs of its rows within holds."""

    def __init__(
        self,
        recording: Recording,
        operators: tuple[Operator[Any], ...],
        dynamics: Dynamics,
        longest: float = _LONGEST,
    ) -> None:
        self._recording, self._operators, self._dynamics = recording, operators, dynamics
        self._end = min(longest, float(recording.times[-1]))
        first = float(recording.driven[0])
        initial = (first - dynamics.actuator.offset) / dynamics.actuator.gain
        self._first = first
        self._setpoints = recording.on_grid(dynamics.step, initial, self._end)
        quiet = replace(dynamics, wander=Wander(), drift=Wander())
        self.still = self._run(quiet, None)
        count = self.still.size
        self.times = recording.times[:count]
        self.errors = recording.responded[:count] - self.still
        self.slopes = self._local_slopes(count)
        self.pairs: _Pairs

    def simulate(self, dynamics: Dynamics, seed: int) -> Floats:
        """Return what disturbances add to the response at each row."""
        return self._run(dynamics, np.random.default_rng(seed)) - self.still

    def _run(self, dynamics: Dynamics, rng: np.random.Generator | None) -> Floats:
        specimen = Specimen(self._operators, dynamics, self._first, rng)
        before = specimen.response
        _, response = specimen.advance(self._setpoints)
        times = self._recording.times
        return at_rows(times[times <= self._end], response, before, dynamics.step, latency(dynamics.actuator))

    def _local_slopes(self, count: int) -> Floats:
        """Return by how much the model's response depends on the drive at each row, by its greater slope."""
        r, model = self._recording, self._operators[0]
        near = _NEAR * float(np.ptp(r.driven))
        slopes = np.zeros(count)
        state, last = model.initial_state(), -2
        changes = r.last_change
        for row in range(count):
            if changes[row] != last:
                last = changes[row]
                place = float(r.driven[row]) if last < 0 else float(r.setpoints[last])
                state = model.advance(state, [place])
                here = model.value(state)
                slope = (
                    max(abs(float(model.evaluate([place + each], state)[0]) - here) for each in (near, -near)) / near
                )
            slopes[row] = slope
        return slopes

    def pair(self, edges: Floats) -> _Pairs:
        """Return the pairs of settled rows of a hold, by kind, the time between them, and slope."""
        r, count = self._recording, self.still.size
        settled = _settled(r, self._dynamics)[:count]
        quick, readings = (np.flatnonzero((r.is_reading[:count] == kind) & settled) for kind in (False, True))
        found = [(rows[:-gap], rows[gap:], kind) for kind, rows in enumerate((quick, readings)) for gap in _GAPS]
        # Of a hold with a single reading, how it went on until that.
        last = np.searchsorted(readings, quick)
        found.append((quick[last < readings.size], readings[last[last < readings.size]], _MIXED))
        pairs = []
        for first, second, kind in found:
            same = r.last_change[first] == r.last_change[second]
            pairs.append((first[same], second[same], np.full(int(same.sum()), kind)))
        first, second, kinds = (np.concatenate(each) for each in zip(*pairs, strict=True))
        time = np.searchsorted(_LAGS, r.times[second] - r.times[first])
        slope = np.searchsorted(edges, self.slopes[first])
        moves = np.diff(r.setpoints, prepend=r.driven[0])
        hold = r.last_change[first]
        # Before the first change there was no move.
        return _Pairs(first, second, time, slope, kinds, hold, np.append(np.sign(moves), 0.0)[hold])


def _classify(parts: Sequence[Part]) -> None:
    """Divide the pairs of all parts into classes of the slope that hold as many rows each."""
    every = np.concatenate([part.slopes for part in parts])
    edges = np.quantile(every, np.arange(1, _SLOPES) / _SLOPES)
    for part in parts:
        part.pairs = part.pair(edges)


def _moments(parts: Sequence[Part], values: Sequence[Floats]) -> tuple[Floats, Floats, Floats]:
    """Return number, variance and mean of the differences of pairs, by time, slope and kind.

    For the mean a difference counts in the direction of the move before the hold.
    """
    sums = np.zeros((3, math.prod(_CLASSES)))
    for part, each in zip(parts, values, strict=True):
        pairs = part.pairs
        place = pairs.place
        differences = each[pairs.second] - each[pairs.first]
        for row, weights in enumerate((np.ones(place.size), differences**2, pairs.direction * differences)):
            sums[row] += np.bincount(place, weights, sums.shape[1])
    counts, squares, means = sums.reshape(3, *_CLASSES)
    divisors = np.maximum(counts, 1.0)
    return counts, squares / divisors - (means / divisors) ** 2, means / divisors


def evidence(parts: Sequence[Part]) -> tuple[Floats, Floats]:
    """Return of how many holds the pairs of each class are, and how many of the pairs are independent.

    Both by time, slope and kind. Of one hold, pairs are independent as far as they do not overlap in time.
    """
    holds, independent = np.zeros(math.prod(_CLASSES)), np.zeros(math.prod(_CLASSES))
    for part in parts:
        pairs, times = part.pairs, part.times
        keys, members = np.unique(np.column_stack([pairs.place, pairs.hold]), axis=0, return_inverse=True)
        begins, ends = times[pairs.first], times[pairs.second]
        first, last = np.full(len(keys), np.inf), np.zeros(len(keys))
        np.minimum.at(first, members, begins)
        np.maximum.at(last, members, ends)
        counts = np.bincount(members)
        fitting = (last - first) * counts / np.bincount(members, ends - begins)
        holds += np.bincount(keys[:, 0], minlength=holds.size)
        independent += np.bincount(keys[:, 0], np.minimum(fitting, counts), independent.size)
    return holds.reshape(_CLASSES), independent.reshape(_CLASSES)


def _response_noise(parts: Sequence[Part], recordings: Sequence[Recording], signal: str) -> Noise:
    """Return the noise of the response: of neighbouring rows in the class of slopes where they differ least."""
    found: list[float | None] = []
    for kind in (1, 0):
        pairs = [(part, part.pairs, part.pairs.kind == kind) for part in parts]
        nearest = min((int(each.time[of].min()) for _, each, of in pairs if of.any()), default=0)
        deviations = []
        for slope in range(_SLOPES):
            differences = [
                part.errors[each.second[chosen]] - part.errors[each.first[chosen]]
                for part, each, of in pairs
                if (chosen := of & (each.slope == slope) & (each.time == nearest)).any()
            ]
            deviations.append(_deviation(np.concatenate(differences)) if differences else None)
        found.append(min((each for each in deviations if each is not None), default=None))
    every = np.concatenate([r.columns[signal] for r in recordings])
    return _noise(found, _resolution(every[np.isfinite(every)]))


def _noise(found: Sequence[float | None], resolution: float) -> Noise:
    """Return the noise of readings and quick readings; where one is not known, it is that of the other."""
    reading, quick = found
    known = reading if reading is not None else quick if quick is not None else 0.0
    return Noise(
        known if reading is None else reading,
        known if quick is None else quick,
        resolution,
    )


def _settled(recording: Recording, dynamics: Dynamics) -> NDArray[np.bool_]:
    """Return at which rows the rest counts as still: so long after a change of the set-point, by its size."""
    actuator, response = dynamics.actuator, dynamics.response
    constant = 0.0 if actuator.order == 0 else max(1.0, 2.0 * actuator.damping) / actuator.frequency
    moves = np.abs(np.diff(recording.setpoints, prepend=recording.driven[0]))[recording.last_change]
    needed = _SETTLED * constant + _LAGGED * response.lag + actuator.delay + moves / actuator.rate
    return np.asarray(recording.since_change > np.maximum(needed, 0.5))


def _deviation(differences: Floats) -> float | None:
    """Return the standard deviation of the numbers of which these are differences; None of too few."""
    if differences.size < _FEWEST:
        return None
    return float(np.quantile(np.abs(differences), _MOST)) / _MOST_OF_DIFFERENCES


def _resolution(values: Floats) -> float:
    """Return the last digit of readings that are multiples of one; 0 if they are not."""
    distinct = np.unique(values)
    if distinct.size < 3 or distinct.size > 0.9 * values.size:
        return 0.0
    gaps = np.diff(distinct)
    gaps = gaps[gaps > 1e-9 * float(np.ptp(distinct))]
    digit = float(gaps.min())
    multiples = gaps / digit
    return (
        digit if float(np.abs(multiples - np.round(multiples)).max()) < 0.02 * float(multiples.max()) ** 0.5 else 0.0
    )
