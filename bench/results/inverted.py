"""A model's inverse for a sequence of targets: the columns that `bench invert` writes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bench.errors import ConfigurationError
from bench.hysteresis import Policy, Reach
from bench.hysteresis.timed import TimedSequence
from bench.model_file import ModelFile
from bench.results.starting_state import starting_state
from bench.results.times import bind_times

Floats = npt.NDArray[np.float64]

# Part of the span of all outputs and targets within which a target over time counts as met.
_TOLERANCE = 1e-9
# Part of the span of the set-points from which on their alternation is worth a warning.
_ALTERNATION = 1e-2


@dataclass(frozen=True)
class InvertedTargets:
    """Set-points that bring a model's output to one target after another.

    Attributes
    ----------
    targets : ndarray, shape (N,)
        Output units.
    setpoints : ndarray, shape (N,)
        Input units.
    passing : ndarray, shape (N,)
        Set-point to pass before it, where the target is met only after saturation; nan where there is none.
    predicted : ndarray, shape (N,)
        Output of the model at `setpoints`, output units.
    flags : tuple of str
        By target: `met`, `too high` or `too low`. What is not met is clamped to the nearest reachable value.
    times : ndarray, shape (N,), or None
        s, of a model with time. Its targets are met without passing another set-point, or not at all.
    """

    targets: Floats
    setpoints: Floats
    passing: Floats
    predicted: Floats
    flags: tuple[str, ...]
    times: Floats | None = None

    def warnings(self) -> list[str]:
        """Return what a person should know of set-points over time: targets that are not met, and ringing."""
        if self.times is None:
            return []
        found = []
        missed = [row for row, flag in enumerate(self.flags, 1) if flag != Reach.MET.value]
        if missed:
            found.append(
                f"{len(missed)} of {len(self.flags)} targets cannot be met (first: row {missed[0]}, "
                f"{self.flags[missed[0] - 1]}); their set-points are clamped"
            )
        ringing = self._ringing()
        if ringing.size:
            found.append(
                f"the set-points alternate from row to row where the targets do not in {ringing.size} of "
                f"{len(self.flags)} rows (first: row {ringing[0]}): the steps are short beside the response of the "
                "model; take longer steps, or targets without kinks"
            )
        return found

    def _ringing(self) -> npt.NDArray[np.int64]:
        """Return the rows, from 1, at which set-points turn for the second time in a row and targets do not."""
        moves, wanted = np.diff(self.setpoints), np.diff(self.targets)
        far = np.abs(moves) > _ALTERNATION * np.ptp(self.setpoints)
        turns = (moves[:-1] * moves[1:] < 0.0) & far[:-1] & far[1:] & (wanted[:-1] * wanted[1:] >= 0.0)
        return np.flatnonzero(turns[:-1] & turns[1:]) + 3


def invert_targets(
    model: ModelFile,
    targets: Floats,
    *,
    policy: Policy = "nearest",
    initial: str | None = None,
    continue_memory: bool = False,
    times: Floats | None = None,
) -> InvertedTargets:
    """Invert a model for a sequence of targets.

    Parameters
    ----------
    model : ModelFile
        Any model of one input: Preisach and Prandtl-Ishlinskii models are inverted exactly with their memory, a
        polynomial by its look-up table, others numerically. Of the models with time those that `TimedModel.follow`
        inverts.
    targets : ndarray, shape (N,)
        Output units, finite.
    policy : {"nearest", "paper"}
        Which answer is taken where there are several.
    initial, continue_memory
        The state before the first target, as for `starting_state`.
    times : ndarray, shape (N,), or None
        s, for a model with time.

    Raises
    ------
    DataError
        If it is a model of several inputs.
    ConfigurationError
        If a model with time has no times or another one has, or it has no inverse at these times.
    """
    state = starting_state(model, initial=initial, continue_memory=continue_memory).state
    bound = bind_times(model, times)
    if isinstance(bound, TimedSequence):
        try:
            setpoints = bound.model.follow(bound.times, targets, state, policy)
        except ValueError as error:
            raise ConfigurationError(f"model {model.name} cannot be inverted: {error}") from None
        predicted, passing = bound.evaluate(setpoints, state), np.full(targets.size, np.nan)
        both = np.concatenate([targets, predicted])
        met = np.abs(predicted - targets) <= _TOLERANCE * (np.ptp(both) or abs(both[0]))
    elif times is not None:
        raise ConfigurationError(f"--time: {model.name} is a model without time")
    else:
        found = bound.inverse(policy).follow(targets, state)
        setpoints, predicted, passing, met = found.setpoints, found.outputs, found.saturating, found.met
    flags = tuple(
        (Reach.MET if at else Reach.TOO_HIGH if target > output else Reach.TOO_LOW).value
        for at, target, output in zip(met.tolist(), targets.tolist(), predicted.tolist(), strict=True)
    )
    return InvertedTargets(targets, setpoints, passing, predicted, flags, times)
