"""Adaptation of a model while it controls: Kalman filters of what it takes to explain the outputs that were reached.

Both filters are extended Kalman filters (Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking and
Navigation*, 2001, section 10.3). `SessionFilter` estimates what moves a whole specimen from one session to the next;
`DensityFilter` the density of a Preisach plane, cell by cell. Of that a few readings tell little unless cells change
together: the covariance before the first reading says how they do.

Both have in common:

* How far a reading may be from any model of the family is learnt too, within bounds, by how surprising they are.
* What was learnt long ago is forgotten: the covariance grows with each reading.
* A reading far from what the model can explain is refused, as that of a sensor that jumped is. While readings are
  refused nothing is forgotten, so that a sensor that stays wrong is not believed after a while.
* All estimates are bounded. If the model as it was identified explains refused readings much better than the adapted
  one does, the adaptation begins again from it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, TypeAlias, cast, get_args

import numpy as np

from bench.base import DeferredModule, Floats, counted
from bench.control.tuning import Spans
from bench.models import Operator, Preisach, transported, widened, widening

if TYPE_CHECKING:
    from filterpy import kalman
else:
    kalman = DeferredModule("filterpy.kalman")

AdaptationName: TypeAlias = Literal["off", "session", "density"]
ADAPTATIONS: tuple[AdaptationName, ...] = get_args(AdaptationName)

GATE = 4.0
"""Standard deviations beyond which a reading is refused.

Derivation: a normal error is beyond them once in 16 000 readings, more than a session has.
"""
MODEL_ERROR = 5e-3
"""Standard deviation of what no estimate explains in one reading, in spans of the output, at the least.

Source: Preisach models of 20 levels leave 0.2 to 0.5 % RMS of the data from which they are identified
(docs/explanation/measured.md).
"""
WORST = GATE**2
"""Most that its variance grows by where readings are surprising.

Derivation: then even a reading at the gate is no surprise.
"""
_LATELY, _LOST = 20, 6
"""Number of last readings, and of those refused among them that begin the adaptation again.

Derivation: a sensor that jumps in one reading of twenty has six of twenty refused with a probability of 3e-4.
"""
_SHARE = 0.03
"""Weight of each reading in the growth of the variance. Derivation: 1 / 0.03 count, half of a session of 60."""
_BETTER = 0.5
"""Ratio of the error of the identified model to that of the adapted one, below which it does so.

Derivation: by chance the mean squares of six errors each differ by a factor of four in 6 % of cases (F test).
"""
INPUT_ERROR = 5e-4
"""Standard deviation of what the specimen's input differs unseen from the measured one, in spans of the input.

Source: a film on a plate wanders by 0.03 K of 63 K beside the plate's sensor (docs/reference/robustness.md).
"""
APART = 10.0 * INPUT_ERROR
"""Least distance of the input from that of the last reading taken, in spans: nearer ones say the same once more.

Derivation: ten standard deviations of the input, so that its error is a tenth of the difference.
"""
FORGETTING = 0.01
"""Standard deviation by which an estimate may change from reading to reading, in parts of that at the beginning.

Derivation: after 10 000 readings, 22 h at 8 s each, an estimate is as uncertain again as at the beginning.
"""


class Estimate(NamedTuple):
    """An estimate with its standard deviation and unit."""

    value: float
    uncertainty: float
    unit: str

    def __str__(self) -> str:
        """Return the three as text."""
        return f"{self.value:.4g} ± {self.uncertainty:.2g} {self.unit}".rstrip()


class ModelFilter(ABC):
    """A model that readings correct.

    Parameters
    ----------
    identified : Operator
        The model to begin with.

    Attributes
    ----------
    identified, model : Operator
        The model to begin with, and the corrected one. States of one are states of the other.
    taken, refused, restarts : int
        Readings that were learnt from, readings that were refused, and how often the adaptation began again.
    uncertainty : float
        Standard deviation of the corrected model's output at the last reading, output units; nan before.
    """

    name: ClassVar[AdaptationName]

    def __init__(self, identified: Operator[Any]) -> None:
        self.identified = identified
        self._spans = Spans.of(identified)
        self.taken = self.refused = self.restarts = 0
        # Stays when the adaptation begins again, so that it does not believe readings that err as much as before.
        self._excess = 1.0
        self._begin()

    def _begin(self) -> None:
        """Begin with the identified model."""
        self.model = self.identified
        self.uncertainty = self._last = math.nan
        # Of the last readings: errors of the adapted and the identified model if it was refused, else None.
        self._lately: deque[tuple[float, float] | None] = deque(maxlen=_LATELY)
        self._start, self._first = self._prior()
        self._filter = kalman.ExtendedKalmanFilter(dim_x=self._start.size, dim_z=1)
        self._filter.x, self._filter.P = self._start, self._first

    @abstractmethod
    def _prior(self) -> tuple[Floats, Floats]:
        """Return the estimates at the beginning, shape (n,), and their covariance, shape (n, n)."""

    @abstractmethod
    def _row(self, state: Any) -> Floats:  # noqa: ANN401 - each operator has its own
        """Return the derivatives of the output in a state by the estimates, shape (n,)."""

    @abstractmethod
    def _bounded(self, values: Floats) -> Floats:
        """Return estimates within their bounds."""

    @abstractmethod
    def _built(self, values: Floats) -> Operator[Any]:
        """Return the model of some estimates."""

    def update(self, state: Any, output: float) -> bool:  # noqa: ANN401 - each operator has its own
        """Learn from the output (output units) that was measured in a state; return whether the model changed.

        A reading that is not finite, or next to the last one, changes nothing.
        """
        if not math.isfinite(output):
            return False
        value = self.model.present_input(state)
        if abs(value - self._last) < APART * self._spans.input:
            return False
        row = self._row(state)
        covariance = self._filter.P + FORGETTING**2 * self._first
        explained = float(row @ (covariance @ row))
        step = 2.0 * INPUT_ERROR * self._spans.input
        slope = (self.model.step(state, value + step)[1] - self.model.step(state, value - step)[1]) / (2.0 * step)
        noise = (MODEL_ERROR * self._spans.output) ** 2 + (INPUT_ERROR * self._spans.input * slope) ** 2
        noise *= self._excess
        expected = self.model.value(state)
        error = output - expected
        surprise = min(error**2 / (explained + noise), GATE**2)
        self._excess = min(max(self._excess * (1.0 + _SHARE * (surprise - 1.0)), 1.0), WORST)
        if abs(error) > GATE * math.sqrt(explained + noise):
            return self._refuse(error, output - self.identified.value(state))
        self._lately.append(None)
        self._last = value
        self.taken += 1
        # Not by `predict`, as nothing is forgotten of a reading that is refused.
        self._filter.P = covariance
        self._filter.update(output, lambda _: row[np.newaxis], lambda _: expected, noise)
        self._filter.x = self._bounded(self._filter.x)
        self.model = self._built(self._filter.x)
        self.uncertainty = math.sqrt(max(float(row @ self._filter.P @ row), 0.0))
        return True

    def _refuse(self, error: float, identified_error: float) -> bool:
        self.refused += 1
        self._lately.append((error, identified_error))
        refused = [errors for errors in self._lately if errors is not None]
        if len(refused) < _LOST:
            return False
        adapted, identified = np.sqrt(np.mean(np.square(refused), axis=0)).tolist()
        if not identified < _BETTER * adapted:
            return False
        self.restarts += 1
        self._begin()
        return True

    @abstractmethod
    def estimates(self) -> Mapping[str, Estimate]:
        """Return what was estimated, by name."""

    def summary(self) -> str:
        """Return what was estimated, and from how many readings, in a line."""
        texts = ", ".join(f"{name} {estimate}" for name, estimate in self.estimates().items())
        more = f", {self.refused} refused" if self.refused else ""
        again = f", begun again {counted(self.restarts, 'time')}" if self.restarts else ""
        return f"{texts}, from {counted(self.taken, 'reading')}{more}{again}"

    def to_json(self) -> dict[str, Any]:
        """Return what was estimated and from how many readings, for the provenance of the corrected model."""
        return {
            "adaptation": self.name,
            "taken": self.taken,
            "refused": self.refused,
            "restarts": self.restarts,
            "estimates": {
                name: {"value": estimate.value, "uncertainty": estimate.uncertainty, "unit": estimate.unit}
                for name, estimate in self.estimates().items()
            },
        }


class SessionFilter(ModelFilter):
    """Estimates offset and gain of the output, and of a Preisach operator also input offset and width of the loops.

    With the identified model f the corrected one is offset + gain f_w(u + input offset), where f_w is f with loops
    that are w times as wide (`widened`).
    """

    name = "session"
    # By estimate: standard deviation at the beginning, least and greatest value; the first in spans of the output,
    # the third in spans of the input.
    _NUMBERS: ClassVar[Mapping[str, tuple[float, float, float]]] = {
        "offset": (0.05, -0.15, 0.15),
        "gain": (0.1, 0.7, 1.4),
        "input-offset": (0.02, -0.06, 0.06),
        "width": (0.25, 0.5, 2.0),
    }

    def __init__(self, identified: Operator[Any]) -> None:
        self._names = tuple(self._NUMBERS)[: None if identified.kind == Preisach.kind else 2]
        self._wide: tuple[float, Any] = (1.0, identified)
        super().__init__(identified)

    def _prior(self) -> tuple[Floats, Floats]:
        units = np.array([self._spans.output, 1.0, self._spans.input, 1.0])[: len(self._names)]
        numbers = np.array([self._NUMBERS[name] for name in self._names])
        deviation, self._low, self._high = units * numbers.T
        return np.array([0.0, 1.0, 0.0, 1.0])[: units.size], np.diag(deviation**2)

    def _row(self, state: Any) -> Floats:  # noqa: ANN401
        _, gain, *others = self._filter.x.tolist()
        row = [1.0, self._inner(*others).value(state)]
        for k, value in enumerate(others):
            step = 0.02 * math.sqrt(self._first[2 + k, 2 + k])
            ends = ([*others[:k], value + sign * step, *others[k + 1 :]] for sign in (1.0, -1.0))
            above, below = (self._inner(*end).value(state) for end in ends)
            row.append(gain * (above - below) / (2.0 * step))
        return np.array(row)

    def _inner(self, moved: float = 0.0, width: float = 1.0) -> Any:  # noqa: ANN401 - an operator of the model's class
        """Return the model before gain and offset."""
        if len(self._names) == 2:
            return self.identified
        if self._wide[0] != width:
            self._wide = width, widened(self.identified, width)  # type: ignore[arg-type]
        return self._wide[1].shifted(moved)

    def _bounded(self, values: Floats) -> Floats:
        return np.clip(values, self._low, self._high)

    def _built(self, values: Floats) -> Operator[Any]:
        offset, gain, *others = values.tolist()
        inner: Operator[Any] = self._inner(*others)
        return inner.with_coefficients(gain * inner.coefficients, gain * inner.bias + offset)

    def estimates(self) -> Mapping[str, Estimate]:
        """Return those of `name`s offset, gain, and for a Preisach operator input-offset and width."""
        units = (self.identified.output_unit, "", self.identified.input_unit, "")
        deviations = np.sqrt(np.diag(self._filter.P)).tolist()
        found = zip(self._names, self._filter.x.tolist(), deviations, units, strict=False)
        return {name: Estimate(value, deviation, unit) for name, value, deviation, unit in found}


class DensityFilter(ModelFilter):
    """Estimates the density of a Preisach operator, its bias, and the coefficients of its reversible part.

    Before the first reading the density may differ from the identified one as a session does (gain, shift of both
    thresholds, width of the loops), and from that by a random field which is smooth in the plane and in proportion to
    the density about. A density that was identified without a negative value keeps none.
    """

    name = "density"
    identified: Preisach
    _FIELD = 0.15
    """Standard deviation of the random field, in densities about."""
    _LENGTH = 0.12
    """Its correlation length, in widths of the plane."""
    _FARTHEST = 5.0
    """Bound of each estimate, in standard deviations at the beginning."""

    def __init__(self, identified: Preisach) -> None:
        self._areas = identified.cell_areas()
        self._sign = 1.0 if (identified.density >= 0.0).all() else -1.0 if (identified.density <= 0.0).all() else 0.0
        super().__init__(identified)

    def _prior(self) -> tuple[Floats, Floats]:
        operator, levels = self.identified, self.identified.levels
        masses = operator.density * self._areas
        cells, number = masses.size, operator.coefficients.size + 1
        directions = np.zeros((4, number))
        offset, gain, moved, width = (numbers[0] for numbers in SessionFilter._NUMBERS.values())
        directions[0, cells] = offset * self._spans.output
        directions[1, :cells] = gain * masses
        shift = moved * self._spans.input

        def both(sign: float) -> Floats:
            return transported(
                levels,
                masses,
                lambda alpha, beta: (np.full_like(alpha, sign * shift), np.full_like(beta, sign * shift)),
            )

        directions[2, :cells] = 0.5 * (both(-1.0) - both(1.0))
        wider, narrower = (transported(levels, masses, widening(1.0 + each)) for each in (width, -width))
        directions[3, :cells] = 0.5 * (wider - narrower)
        covariance = directions.T @ directions
        middle = 0.5 * (levels[1:] + levels[:-1])
        places = np.column_stack([middle[each] for each in np.tril_indices(operator.order)])
        length = self._LENGTH * (levels[-1] - levels[0])
        near = np.exp(-0.5 * ((places[:, None] - places) ** 2).sum(axis=2) / length**2)
        about = near @ np.abs(masses) / near.sum(axis=1)
        # Where there was nothing there may be a little.
        sizes = self._FIELD * (about + 0.02 * about.max())
        covariance[:cells, :cells] += sizes[:, None] * near * sizes
        return np.concatenate([masses, [operator.bias], operator.coefficients[cells:]]), covariance

    def _row(self, state: Any) -> Floats:  # noqa: ANN401
        row = self.identified.regressor([state.input], state).dense()[0]
        cells = self._areas.size
        return np.concatenate([row[:cells] / self._areas, [1.0], row[cells:]])

    def _bounded(self, values: Floats) -> Floats:
        most = self._FARTHEST * np.sqrt(np.diag(self._first))
        bounded = np.clip(values, self._start - most, self._start + most)
        cells = slice(0, self._areas.size)
        if self._sign:
            bounded[cells] = self._sign * np.maximum(self._sign * bounded[cells], 0.0)
        return bounded

    def _built(self, values: Floats) -> Operator[Any]:
        cells = self._areas.size
        coefficients = np.concatenate([values[:cells] / self._areas, values[cells + 1 :]])
        return self.identified.with_coefficients(coefficients, float(values[cells]))

    def estimates(self) -> Mapping[str, Estimate]:
        """Return `offset`, that of the bias, and `mass`, that of the whole density in parts of the identified one."""
        cells, values, covariance = self._areas.size, self._filter.x, self._filter.P
        whole = float(self._start[:cells].sum())
        mass, deviation = (
            float(values[:cells].sum()),
            math.sqrt(max(float(covariance[:cells, :cells].sum()), 0)),
        )
        moved = float(values[cells] - self._start[cells])
        return {
            "offset": Estimate(moved, math.sqrt(float(covariance[cells, cells])), self.identified.output_unit),
            "mass": Estimate(mass / whole, abs(deviation / whole), "") if whole else Estimate(math.nan, math.nan, ""),
        }


def model_filter(name: AdaptationName, operator: Operator[Any]) -> ModelFilter | None:
    """Return the filter of an adaptation; None for `off`.

    Raises ValueError if the model is not of the kind that the adaptation needs.
    """
    if name == "off":
        return None
    if operator.memoryless:
        raise ValueError(f"adaptation {name} needs a model with memory; this one is of the kind {operator.kind}")
    if name == "session":
        return SessionFilter(operator)
    if operator.kind != Preisach.kind:
        raise ValueError(
            f"adaptation density needs a Preisach model, whose density it changes; this one is of the kind "
            f"{operator.kind}; adaptation = session takes it"
        )
    return DensityFilter(cast("Preisach", operator))
