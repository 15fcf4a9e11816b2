"""Noise of the readings, and what of a specimen no model knows: wander, drift, unevenness.

They are those with which simulations show the mean squares of differences that were measured. Within holds, where the
set-point and with it the model stand still, that is noise, wander of the drive as the specimen sees it, and drift of
the response. From hold to hold there is also the error of the model on a history that it was not identified from: it
changes as the drive moves, and stands while that stands. A wander of minutes looks the same from hold to hold, so
that all are found together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.analysis import MEDIAN_OF_DIFFERENCES, TransientRecording, at_rows, latency
from bench.base import Floats
from bench.models import Operator
from bench.specimen.differences import SLOPES, Differences, least_known
from bench.specimen.specimen import Dynamics, Specimen, Unevenness, Wander

_LAGS = (0.3, 1.0, 3.0, 8.0, 20.0, 60.0)
"""Edges of the classes of the time between two rows, s."""
_GAPS = (1, 2, 3, 6, 12, 25, 50, 100)
"""From row to row of a pair, in rows of their kind."""
_MIXED = 2
"""Kind of the pairs of a quick row and the reading after it; 0 and 1 are those of quick rows and of readings."""
_CLASSES = (len(_LAGS) + 1, SLOPES, _MIXED + 1)
"""Numbers of classes of pairs: by time, slope and kind."""
_STEP = 0.05
"""Least step of the grid of time of simulations, s; finer ones change nothing that is settled."""
_FROM_HOLD_TO_HOLD = (1, 2, 3, 5, 8, 12, 20, 40, 100)
"""From reading to reading of a pair, whatever the holds."""
_START = (0.8, 0.8, 1e-3, 30.0, 1e-4, 0.2, 1e-3, 0.1)
_LEAST = (0.01, 0.01, 1e-7, 0.2, 1e-7, 0.01, 1e-7, 1e-3)
_GREATEST = (1.0, 1.0, 1.0, 3000.0, 1.0, 1.0, 1.0, 2.0)
"""Noise, quick and of readings, as shares of what neighbouring rows differ by; deviation and correlation of wander,
drift and unevenness. The time of the wander is in s, that of the drift a share of the longest hold: a slower one is
the error of the model. All others are shares of the range."""
_SHARES = 2
"""How many of them are of noise."""
_UNIT = 1e-9
"""Of which these are multiples; their logarithms are then far from 0, as steps in proportion to them have to be."""
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
_MOST, _BEYOND = 0.9, 2.5
"""A quantile of differences; those beyond so many times that are no noise."""
_RARE, _SEEN = 0.05, 3
"""Greatest share of outliers, and their least number."""
_QUANTILES = 9
"""How many of their quantiles are kept."""
_TRIALS, _SIMULATIONS = 2, 20
"""Simulations of each trial, the same random numbers in all; those whose mean is the effect of wander."""


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


def noise_of(
    recordings: Sequence[TransientRecording], signal: str, dynamics: Dynamics, *, outliers: bool = False
) -> Noise:
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


def _holds(recording: TransientRecording, signal: str, dynamics: Dynamics) -> list[_Hold]:
    """Return the settled part of each hold that has readings enough."""
    values = recording.columns[signal]
    rows = np.flatnonzero(settled_rows(recording, dynamics) & np.isfinite(values))
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
    recordings: Sequence[TransientRecording],
    operators: Sequence[Operator[Any]],
    dynamics: Dynamics,
    signal: str,
    of_model: Sequence[Floats],
    left: Sequence[Floats],
) -> tuple[Noise, Wander, Wander]:
    """Return the noise of the response, the wander of the drive, and the drift of the response.

    An unevenness is found with them, so that it is not taken for wander; `identify_unevenness` finds it again, when
    the correction is known without the effect of the wander.

    Parameters
    ----------
    recordings : sequence of TransientRecording
        The runs.
    operators, dynamics
        The specimen as far as it is known.
    signal : str
        The response.
    of_model, left : sequence of ndarray
        Errors of the model at the readings of each run, and what the correction leaves of them, output units.
    """
    from scipy.optimize import least_squares

    parts = [Part(r, tuple(operators), dynamics) for r in recordings]
    _classify(parts)
    most = _response_noise(parts, recordings, signal)
    counts, variances, trends = _moments(parts, [part.errors for part in parts])
    used = counts >= _FEWEST
    variances = np.maximum(variances[used], 1e-300)
    kinds = np.broadcast_to(np.arange(_MIXED + 1), counts.shape)[used]
    holds, independent = (each[used] for each in evidence(parts))
    # The logarithm of a mean of n independent squares is uncertain by the square root of 2 / n, and holds differ.
    weights = 1.0 / np.sqrt(2.0 / np.maximum(independent, 1.0) + 1.0 / holds)
    # How a hold goes on says the same of wander only once, and a few holds go on as their drift happens to.
    trusted = np.sqrt(np.where(holds >= _FEWEST, holds, 0.0) / variances)
    errors = _errors_of_model(parts, recordings, of_model, left)
    span = float(np.ptp(np.concatenate([r.driven for r in recordings])))
    height = float(np.ptp(np.concatenate([r.responded for r in recordings])))
    longest = max(float(np.max(r.since_change, where=r.last_change >= 0, initial=1.0)) for r in recordings)
    if errors is None and not used.any():
        return most, Wander(), Wander()
    start, low, high = (np.log(np.array(each) / _UNIT) for each in (_START, _LEAST, _GREATEST))

    def trial(numbers: Floats) -> tuple[Noise, Dynamics]:
        quick, reading, wander, wander_time, drift, drift_time, uneven, length = (_UNIT * np.exp(numbers)).tolist()
        return replace(most, quick=quick * most.quick, reading=reading * most.reading), replace(
            dynamics,
            wander=Wander(wander * span, wander_time),
            drift=Wander(drift * height, drift_time * longest),
            unevenness=Unevenness(uneven * span, length * span) if errors is not None else Unevenness(),
        )

    # Trials of other shares of noise take the same simulations.
    @lru_cache(maxsize=2)
    def simulated(disturbed: Dynamics) -> tuple[Floats, Floats, Floats]:
        # Other random numbers in each run, the same in each trial.
        found = [
            [part.simulate(disturbed, len(parts) * number + n) for n, part in enumerate(parts)]
            for number in range(_TRIALS)
        ]
        moments = [_moments(parts, each) for each in found]
        squares, went = (np.mean([each[i][used] for each in moments], axis=0) for i in (1, 2))
        between = np.empty(0) if errors is None else np.mean([errors.squares(each) for each in found], axis=0)
        return squares, went, between

    def misses(numbers: Floats) -> Floats:
        noise, disturbed = trial(numbers)
        squares, went, between = simulated(disturbed)
        rounding = noise.resolution**2 / 12.0
        quick, reading = noise.quick**2 + rounding, noise.reading**2 + rounding
        white = np.array([2.0 * quick, 2.0 * reading, quick + reading])
        within = weights * np.log(np.maximum(squares + white[kinds], 1e-300) / variances)
        if errors is not None:
            between = errors.misses(between + white[1])
        # What noise can be is noise, and not a quick drift.
        shares = numbers[:_SHARES] - high[:_SHARES]
        return np.concatenate([within, trusted * (went - trends[used]), between, shares])

    solved = least_squares(
        misses, start, bounds=(low, high), diff_step=np.full(start.size, 0.01), max_nfev=25, xtol=1e-3, ftol=1e-3
    )
    noise, found = trial(solved.x)
    return noise, found.wander, found.drift


class _Errors:
    """Mean squares of the differences of a model's errors at two readings of a run, by gap and slope.

    Parameters
    ----------
    parts : sequence of Part
        All runs.
    run : int
        The run whose errors count.
    of_model, left : ndarray
        Errors of the model at its readings, and what the correction leaves of them.
    """

    def __init__(self, parts: Sequence[Part], run: int, of_model: Floats, left: Floats) -> None:
        self._run, part = run, parts[run]
        self._rows = part.readings
        self._differences = Differences(part.slopes[self._rows], _FROM_HOLD_TO_HOLD)
        # With what is explained, the twin differs from the model as much as the specimen does.
        target = self._differences.squares(of_model) - self._differences.squares(of_model - left)
        self._used = np.isfinite(target) & (target > 0.0)
        self._target = target[self._used]
        # Where the response is steep, errors are great and matter most.
        weights = np.sqrt(0.5 * self._differences.counts() / np.array(_FROM_HOLD_TO_HOLD)[:, None])[self._used]
        self._weights = weights * np.sqrt(self._target / np.max(self._target, initial=0.0))

    def squares(self, values: Sequence[Floats]) -> Floats:
        """Return the mean squares of what simulations add to the rows of each run."""
        return self._differences.squares(values[self._run][self._rows])[self._used]

    def misses(self, squares: Floats) -> Floats:
        """Return by how much mean squares differ from those of the errors, weighted."""
        return np.asarray(self._weights * np.log(squares / self._target))


def _errors_of_model(
    parts: Sequence[Part],
    recordings: Sequence[TransientRecording],
    of_model: Sequence[Floats],
    left: Sequence[Floats],
) -> _Errors | None:
    """Return the errors in the run that the model knows least, of those that say something of other histories."""
    run = least_known(recordings, of_model)
    return None if run is None else _Errors(parts, run, of_model[run], left[run])


def mean_effects(
    recordings: Sequence[TransientRecording], operators: Sequence[Operator[Any]], dynamics: Dynamics
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
        part = Part(r, tuple(operators), dynamics)
        effects.append(np.mean([part.simulate(wandering, n) for n in range(_SIMULATIONS)], axis=0))
    return effects


class Part:
    """A run, simulated without disturbances, and the pairs of its rows within holds."""

    def __init__(
        self, recording: TransientRecording, operators: tuple[Operator[Any], ...], dynamics: Dynamics
    ) -> None:
        self._recording, self._operators, self._dynamics = recording, operators, dynamics
        self._step = max(dynamics.step, _STEP)
        first = float(recording.driven[0])
        initial = (first - dynamics.actuator.offset) / dynamics.actuator.gain
        self._first = first
        self._setpoints = recording.on_grid(self._step, initial, float(recording.times[-1]))
        quiet = replace(dynamics, wander=Wander(), drift=Wander())
        self.still = self._run(quiet, None)
        self.times = recording.times
        self.readings = np.flatnonzero(recording.is_reading)
        self.errors = recording.responded - self.still
        self.slopes = self._local_slopes()
        self.pairs: _Pairs

    def simulate(self, dynamics: Dynamics, seed: int) -> Floats:
        """Return what disturbances add to the response at each row."""
        return self._run(dynamics, np.random.default_rng(seed)) - self.still

    def _run(self, dynamics: Dynamics, rng: np.random.Generator | None) -> Floats:
        specimen = Specimen(self._operators, replace(dynamics, step=self._step), self._first, rng)
        before = specimen.response
        _, response = specimen.advance(self._setpoints)
        return at_rows(self._recording.times, response, before, self._step, latency(dynamics.actuator))

    def _local_slopes(self) -> Floats:
        """Return by how much the model's response depends on the drive at each row, by its greater slope."""
        r, model = self._recording, self._operators[0]
        near = _NEAR * float(np.ptp(r.driven))
        slopes = np.zeros(r.times.size)
        state, last = model.initial_state(), -2
        changes = r.last_change
        for row in range(slopes.size):
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
        r = self._recording
        settled = settled_rows(r, self._dynamics)
        quick, readings = (np.flatnonzero((r.is_reading == kind) & settled) for kind in (False, True))
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
    edges = np.quantile(every, np.arange(1, SLOPES) / SLOPES)
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


def _response_noise(parts: Sequence[Part], recordings: Sequence[TransientRecording], signal: str) -> Noise:
    """Return the noise of the response: of neighbouring rows in the class of slopes where they differ least."""
    found: list[float | None] = []
    for kind in (1, 0):
        pairs = [(part, part.pairs, part.pairs.kind == kind) for part in parts]
        nearest = min((int(each.time[of].min()) for _, each, of in pairs if of.any()), default=0)
        deviations = []
        for slope in range(SLOPES):
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
    # Rounding comes on top of it.
    reading, quick = (None if each is None else math.sqrt(max(each**2 - resolution**2 / 12.0, 0.0)) for each in found)
    known = reading if reading is not None else quick if quick is not None else 0.0
    return Noise(known if reading is None else reading, known if quick is None else quick, resolution)


def settled_rows(recording: TransientRecording, dynamics: Dynamics) -> NDArray[np.bool_]:
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
    sizes = np.abs(differences)
    return float(np.sqrt(0.5 * np.mean(sizes[sizes <= _BEYOND * np.quantile(sizes, _MOST)] ** 2)))


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
