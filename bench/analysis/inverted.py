"""A model's inverse for a sequence of targets: the columns that `bench invert` writes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.analysis.applied import check_finite
from bench.analysis.band_columns import BandedPrediction, band_of
from bench.analysis.tables.starting_state import bind_times, starting_state
from bench.analysis.uncertain_models import predicted_uncertainty
from bench.base import ConfigurationError, DataError, Floats, difference_unit, header_with_unit
from bench.identification import Beyond, ModelFile, input_half_widths
from bench.models import Operator, Policy, Reach, TimedSequence

# Part of the span of all outputs and targets within which a target over time counts as met, and of a time step within
# which two times are the same. Derivation: a million times the rounding of one number, less than any sensor tells.
_TOLERANCE = _SAME_TIME = 1e-9
# Part of the span of the set-points from which on their alternation is worth a warning. Derivation: half the moves
# that count as noise of an input (`NOISE` of `bench.identification.branches`).
_ALTERNATION = 1e-2


@dataclass(frozen=True)
class InvertedTargets:
    """Set-points that bring a model's output to one target after another.

    Attributes
    ----------
    file : ModelFile
        The model.
    state : object
        Its state before the first target.
    targets : ndarray, shape (N,)
        Output units.
    setpoints : ndarray, shape (N,)
        Input units.
    passing : ndarray, shape (N,)
        Set-point to pass before it, where the target is met only after saturation; nan where there is none.
    predicted : ndarray, shape (N,)
        Output of the model at `setpoints`, output units.
    flags : tuple of str
        By target: `met`, `too high` or `too low`. What is not met is clamped to the nearest reachable value. Of a
        model with a delay also `too early`, before any set-point has an effect, and `near`, met but for targets
        between the rows.
    beyond : Beyond
        How far the set-points lie beyond the inputs that were fitted.
    times : ndarray, shape (N,), or None
        s, of a model with time. Its targets are met without passing another set-point, or not at all.
    delay : float
        Of a model with time, s.
    held : int
        Number of last set-points without an effect on any target, which repeat the one before.
    """

    file: ModelFile
    state: Any
    targets: Floats
    setpoints: Floats
    passing: Floats
    predicted: Floats
    flags: tuple[str, ...]
    beyond: Beyond
    times: Floats | None = None
    delay: float = 0.0
    held: int = 0

    @property
    def band(self) -> BandedPrediction | None:
        """The band about the predictions, if the model's file has one."""
        return band_of(self.file)

    @property
    def through_saturation(self) -> int:
        """Number of targets that are met only after another set-point."""
        return int(np.isfinite(self.passing).sum())

    def counts(self) -> dict[str, int]:
        """Return how many targets have each flag."""
        kinds = ("met", "too high", "too low", *((NEAR, TOO_EARLY) if self.delay else ()))
        return {flag: self.flags.count(flag) for flag in kinds}

    def table(self) -> list[tuple[str, Floats | list[object]]]:
        """Return the columns of a file with their heads; cells are empty where there is no value."""
        response = self.file.response
        driven, output = response.input_unit, response.output_unit
        ends: list[tuple[str, Floats]] = []
        uncertain: list[tuple[str, Floats | list[object]]] = []
        if isinstance(self.file.model, Operator):
            if self.file.band is not None:
                widths = self._input_widths(self.file.model, self.file.band.half_width)
                ends = [("lower", self.setpoints - widths), ("upper", self.setpoints + widths)]
            if (standard := predicted_uncertainty(self.file, self.predicted)) is not None:
                cells = _cells(self._input_widths(self.file.model, standard))
                uncertain.append((header_with_unit("u_setpoint", difference_unit(driven)), cells))
                uncertain.append((header_with_unit("u_predicted", output), standard))
        return [
            *([] if self.times is None else [(header_with_unit("time", "s"), self.times)]),
            (header_with_unit("target", output), self.targets),
            (header_with_unit("passing", driven), _cells(self.passing)),
            (header_with_unit("setpoint", driven), self.setpoints),
            (header_with_unit("predicted", output), self.predicted),
            ("flag", list(self.flags)),
            *uncertain,
            *((header_with_unit(f"setpoint {end}", driven), _cells(values)) for end, values in ends),
            *(self.band.columns(self.predicted) if self.band else ()),
        ]

    def _input_widths(self, operator: Operator[Any], half_widths: Floats | float) -> Floats:
        """Return half-widths of the output, shape (N,) or one, over the slopes at the set-points, shape (N,).

        The path of the memory has the set-points that are passed on the way. A width is nan where the output hardly
        moves with the input, see `input_half_widths`.
        """
        both = np.column_stack([self.passing, self.setpoints]).ravel()
        taken = np.isfinite(both)
        of_path = np.repeat(np.broadcast_to(half_widths, self.setpoints.shape), 2)[taken]
        places = (np.cumsum(taken) - 1)[1::2]
        return np.asarray(input_half_widths(operator, both[taken], of_path, self.state)[places])

    def to_json(self) -> dict[str, Any]:
        """Return what was found for programs."""
        met = np.array([flag == Reach.MET.value for flag in self.flags])
        return {
            "model": self.file.name,
            "targets": len(self.flags),
            **{flag.replace(" ", "_"): count for flag, count in self.counts().items()},
            "through_saturation": self.through_saturation,
            "largest_residual": float(np.abs(self.predicted - self.targets)[met].max()) if met.any() else None,
            "beyond": self.beyond.to_json(),
            **({"band": self.band.to_json()} if self.band else {}),
        }

    def warnings(self) -> list[str]:
        """Return what a person should know: set-points beyond the inputs fitted; over time misses and ringing."""
        text = self.beyond.text("set-points")
        found = [text] if text else []
        if self.times is None:
            return found
        missed = [row for row, flag in enumerate(self.flags, 1) if flag not in (Reach.MET.value, NEAR, TOO_EARLY)]
        if self.held:
            found += self._of_delay()
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

    def _of_delay(self) -> list[str]:
        found = [
            f"a set-point has an effect after {self.delay:.4g} s: on the first {self.flags.count(TOO_EARLY)} targets "
            f"none has any, and the last {self.held} set-points, which reach no target, repeat the one before"
        ]
        near = np.array([flag == NEAR for flag in self.flags])
        if near.any():
            errors, span = np.abs(self.predicted - self.targets)[near], float(np.ptp(self.targets))
            found.append(
                f"the delay of {self.delay:.4g} s is no multiple of the time steps: between the rows the targets are "
                f"straight lines, and {near.sum()} rows err by up to {errors.max():.3g} "
                f"({100.0 * errors.max() / span:.2g} % of their span); with steps that divide the delay it is exact"
            )
        return found

    def _ringing(self) -> npt.NDArray[np.int64]:
        """Return the rows, from 1, at which set-points turn for the second time in a row and targets do not."""
        moves, wanted = np.diff(self.setpoints), np.diff(self.targets)
        far = np.abs(moves) > _ALTERNATION * np.ptp(self.setpoints)
        turns = (moves[:-1] * moves[1:] < 0.0) & far[:-1] & far[1:] & (wanted[:-1] * wanted[1:] >= 0.0)
        return np.flatnonzero(turns[:-1] & turns[1:]) + 3


NEAR, TOO_EARLY = "near", "too early"
"""Flags of targets behind a delay; see `InvertedTargets`."""


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
        If it is a model of several inputs, or a set-point or an output is not finite.
    ConfigurationError
        If a model with time has no times or another one has, or it has no inverse at these times.
    """
    state = starting_state(model, initial=initial, continue_memory=continue_memory).state
    bound = bind_times(model, times)
    with np.errstate(over="ignore", invalid="ignore"):
        if isinstance(bound, TimedSequence):
            try:
                found = _invert_in_time(model, bound, targets, state, policy)
            except ValueError as error:
                raise ConfigurationError(f"model {model.name} cannot be inverted: {error}") from None
        elif times is not None:
            raise ConfigurationError(f"--time: {model.name} is a model without time")
        else:
            try:
                path = bound.inverse(policy).follow(targets, state)
            except (ValueError, ArithmeticError) as error:
                raise DataError(f"model {model.name} cannot be inverted: {error}") from None
            flags, beyond = tuple(_flags(path.met, targets, path.outputs)), model.beyond(path.setpoints)
            found = InvertedTargets(
                model, state, targets, path.setpoints, path.saturating, path.outputs, flags, beyond
            )
    units = model.response.input_unit, model.response.output_unit
    check_finite(model.name, "set-point", found.setpoints, units[0], targets, "target", units[1])
    check_finite(model.name, "output", found.predicted, units[1], found.setpoints, "set-point", units[0])
    return found


def _invert_in_time(
    file: ModelFile,
    bound: TimedSequence,
    targets: Floats,
    state: Any,  # noqa: ANN401 - the model's own
    policy: Policy,
) -> InvertedTargets:
    """Return the set-points of a model with time; raises ValueError if it has no inverse, or none at these times."""
    times, delay = bound.times, bound.model.delay
    same = _SAME_TIME * float(np.median(np.diff(times)))
    # A set-point is for the target that its effect meets, a delay later.
    effective = int(np.count_nonzero(times + delay <= times[-1] + same))
    if effective < 2:
        raise ValueError(f"its delay of {delay:.4g} s is as long as the {np.ptp(times):.4g} s of the targets")
    prompt, before = bound.model.ahead(state)
    wanted = np.interp(times[:effective] + delay, times, targets)
    found = prompt.follow(times[:effective], wanted, before, policy)
    reached = _are_equal(prompt.evaluate(times[:effective], found, before), wanted)
    setpoints = np.append(found, np.full(times.size - effective, found[-1]))
    predicted = bound.evaluate(setpoints, state)
    flags = _flags(_are_equal(predicted, targets), targets, predicted)
    if delay:
        # Each target is between the effects of two set-points, or at that of one.
        after = np.searchsorted(times, times - delay - same)
        for row, last in enumerate(after.tolist()):
            if times[row] < times[0] + delay - same:
                flags[row] = TOO_EARLY
            elif flags[row] != Reach.MET.value and reached[max(last - 1, 0) : last + 1].all():
                flags[row] = NEAR
    held = times.size - effective
    beyond, passing = file.beyond(setpoints, times), np.full(times.size, np.nan)
    return InvertedTargets(
        file, state, targets, setpoints, passing, predicted, tuple(flags), beyond, times, delay, held
    )


def _cells(values: Floats) -> list[object]:
    return ["" if value != value else value for value in values.tolist()]


def _are_equal(outputs: Floats, targets: Floats) -> npt.NDArray[np.bool_]:
    both = np.concatenate([targets, outputs])
    return np.asarray(np.abs(outputs - targets) <= _TOLERANCE * (np.ptp(both) or abs(both[0])))


def _flags(met: npt.NDArray[np.bool_], targets: Floats, outputs: Floats) -> list[str]:
    return [Reach.of(at, short).value for at, short in zip(met.tolist(), (targets - outputs).tolist(), strict=True)]
