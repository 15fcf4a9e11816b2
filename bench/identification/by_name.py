"""From measured inputs and outputs to a model, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Generic, Literal, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.identification.advice import Advice
from bench.identification.choose.splits import record_of
from bench.identification.fit.least_squares import Certificate, Fit, counted_weights
from bench.identification.fit.orientation import (
    NAMES,
    ORIENTATIONS,
    Orientation,
    Sign,
    better_sign,
    has_orientation,
    possible_signs,
)
from bench.identification.fit.regularization import Regularization, choose_regularization
from bench.identification.fit.shape import fit_operator, undetermined_shape
from bench.identification.fit.variable_projection import variable_projection
from bench.identification.inspection import check_data
from bench.identification.measures import Errors, measure_errors
from bench.identification.options import check_options, template_of
from bench.identification.trust import check_interpolation, check_record, check_skipped, judge_fit
from bench.models import ModelSpec, Operator, Regressor, TimedModel, find_model

M = TypeVar("M", bound=Operator[Any] | TimedModel[Any])
Initial: TypeAlias = Literal["negative", "positive", "skip", "estimate"]
INITIALS: tuple[Initial, ...] = ("negative", "positive", "skip", "estimate")

# Relative step of the differences by shape parameters. Derivation: the root of 1e-12, to which a constrained linear
# fit is exact.
_STEP = 1e-6


@dataclass(frozen=True)
class Candidate:
    """A model and the settings of its identification.

    Attributes
    ----------
    model : str
        Name of the operator in `bench.models`.
    options : mapping of str to object
        Options of the operator, as `identify` takes them.
    orientation : str
        Whether the output rises or falls with the input; `auto` leaves it to the fit, or to a model without signs.
    initial : str or None
        Memory before the first sample, as `identify` takes it.
    smoothing, ridge : float or None
        Weights of the penalties; None leaves them to the fit of a density of either sign.
    dynamics : str
        Dynamic elements behind the operator, as `identify_hammerstein` takes them; empty for the operator alone.
    shape : tuple of float
        Shape parameters of the operator; empty if they are to be found.
    parameters : mapping of str to float
        Nonlinear parameters of these elements, from which their search starts; others have several starts.
    """

    model: str
    options: Mapping[str, Any] = field(default_factory=dict)
    orientation: Orientation = "auto"
    initial: Initial | None = None
    smoothing: float | None = 0.0
    ridge: float | None = 0.0
    dynamics: str = ""
    shape: tuple[float, ...] = ()
    parameters: Mapping[str, float] = field(default_factory=dict)

    @property
    def fitted(self) -> tuple[str, dict[str, Any]]:
        """Name and options of the model that is identified: with dynamics, of a Hammerstein model."""
        if not self.dynamics:
            return self.model, dict(self.options)
        return "hammerstein", {"static": self.model, **self.options, "dynamics": self.dynamics}


@dataclass(frozen=True, eq=False)
class Identification(Generic[M]):
    """An identified model with the evidence for it.

    Parameters
    ----------
    model_name : str
        Name of the model in `bench.models`.
    model : Operator or TimedModel
        The identified model.
    residuals : ndarray, shape (N,)
        Measured output minus `model.evaluate(inputs, initial_state)` for every sample, the skipped ones too,
        output units.
    errors : Errors
        Measures over the samples after `skip`.
    uncertainties : ndarray, shape (K + q,)
        Standard uncertainty of each coefficient; see `Fit`.
    certificate : Certificate
        Optimality, conditioning and coverage of the fit.
    skip : int
        Number of first samples left out of the cost.
    initial_state : object
        State before the first sample from which the model was fitted.
    advice : tuple of Advice
        What is odd about the data or not covered by them, and why the fit should not be trusted; see `judge_fit`.
    regularization : Regularization or None
        The penalties of a density of either sign; None for other models, and without penalties.
    orientation : {"rising", "falling"} or None
        Whether the output rises or falls with the input; None for a model whose coefficients have either sign.
    """

    model_name: str
    model: M
    residuals: Floats
    errors: Errors
    uncertainties: Floats
    certificate: Certificate
    skip: int
    initial_state: Any = None
    advice: tuple[Advice, ...] = ()
    regularization: Regularization | None = None
    orientation: Orientation | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """The advice as sentences with their remedies."""
        return tuple(map(str, self.advice))


def identify(
    model_name: str,
    inputs: ArrayLike,
    outputs: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    skip: int = 0,
    smoothing: float | None = None,
    ridge: float | None = None,
    initial: Initial | None = None,
    orientation: Orientation = "auto",
    **options: Any,  # noqa: ANN401 - each template names and types its own
) -> Identification[Any]:
    """Return the model of a given name that fits a measured sequence best in the least-squares sense.

    The models are the entries of the group `bench.models`, to which packages may add; see `ModelSpec`. The command
    `bench show NAME` shows the options of one, and docs/reference/models.md explains them. The shape parameters of an
    operator (`Operator.shape_parameters`), on which its output does not depend linearly, are fitted together with its
    coefficients by variable projection.

    A model whose coefficients must not be negative has an output that rises with the input. With the `orientation`
    "falling" the coefficients must not be positive instead; with "auto" the one that fits better is taken.

    The memory before the first sample (`initial`) is one of

    - None: the operator's own initial state, negative saturation for a Preisach model, relaxed for plays;
    - "negative", "positive": saturation at the low or the high end of the operating range;
    - "skip": unknown; the first samples are left out of the cost until the inputs have overwritten every part
      of the memory that they overwrite at all (what they never do is constant, and the bias takes it);
    - "estimate": unknown and estimated, for Preisach models with a nonnegative density; see `initial_memory`.

    Parameters
    ----------
    model_name : str
        One of the names above, or that of another entry of `bench.models`.
    inputs, outputs : array_like, shape (N,)
        The measured sequence, in input and output units.
    weights : array_like, shape (N,), or None
        Weight per sample, >= 0; default 1.
    skip : int
        Number of first samples left out of the cost because their memory is unknown.
    smoothing, ridge : float or None
        Weights of the penalties of `fit` on the roughness and the size of a density. None is 0 for a nonnegative
        density; for one of either sign it is chosen by cross-validation, see `choose_regularization`. With both
        at 0 a density of either sign is the one of the least norm, which may be far off for other inputs.
    initial : {"negative", "positive", "skip", "estimate"} or None
        The memory before the first sample, as above.
    orientation : {"auto", "rising", "falling"}
        Whether the output rises or falls with the input; only "auto" for a model of free signs.
    **options
        The model's own; see `bench.identification.options.model_options`.

    Raises
    ------
    ValueError
        If the name is unknown, an option does not belong to it, or the data are unfit; see `fit`.
    """
    settings = Candidate(model_name, options, orientation, initial, smoothing, ridge)
    problem = set_up_problem(settings, inputs, outputs, weights, skip)
    penalties = problem.regularization(smoothing, ridge)
    solution = problem.fit(penalties.smoothing, ridge=penalties.ridge)
    is_penalised = not problem.spec.constrained and (penalties.smoothing > 0.0 or penalties.ridge > 0.0)
    if initial == "skip":
        check_interpolation(problem, solution)
    model = problem.template.with_coefficients(solution.coefficients, solution.bias)
    predicted = model.evaluate(problem.inputs, problem.state)
    residuals = problem.outputs - predicted
    doubts = judge_fit(problem, solution, residuals, initial=initial, smoothing=penalties.smoothing)
    return Identification(
        model_name=model_name,
        model=model,
        residuals=residuals,
        errors=measure_errors(problem.outputs[problem.skip :], predicted[problem.skip :]),
        uncertainties=solution.uncertainties,
        certificate=solution.certificate,
        skip=problem.skip,
        initial_state=problem.state,
        advice=(*problem.advice(), *doubts),
        regularization=penalties if is_penalised else None,
        orientation=NAMES[problem.orientation] if has_orientation(problem.spec, problem.template) else None,
    )


@dataclass(frozen=True, eq=False)
class FitProblem:
    """A measured sequence set up for a model: everything but the smoothing.

    `start` returns an operator's state before the first sample. `orientation` is -1 if the model is fitted to the
    opposite output and its coefficients are the opposite ones; `known` is the fit for one smoothing by which that was
    decided, if it had to be.
    """

    spec: ModelSpec
    inputs: Floats
    outputs: Floats
    weights: Floats
    skip: int
    template: Operator[Any]
    state: Any
    regressor: Regressor
    start: Callable[[Operator[Any]], Any]
    orientation: Sign = 1
    known: tuple[float, Fit] | None = None

    def regularization(self, smoothing: float | None, ridge: float | None) -> Regularization:
        """Return the weights of the penalties, those chosen by cross-validation that are None.

        They are 0 for models with signs, and for those without cells.
        """
        if self.spec.constrained:
            return Regularization(smoothing or 0.0, ridge or 0.0)
        if not self.regressor.base.size:
            if smoothing:
                raise ValueError("smoothing: this model has no cells of a density")
            return Regularization(0.0, ridge or 0.0)
        if smoothing is not None and ridge is not None:
            return Regularization(smoothing, ridge)
        return choose_regularization(self.regressor, self.outputs, self.weights, self.skip, smoothing, ridge)

    def fit(
        self, smoothing: float, weights: Floats | None = None, ridge: float = 0.0, start: Fit | None = None
    ) -> Fit:
        """Return the coefficients for the problem's weights or others; a fit to start from saves time."""
        if self.known is not None and weights is None and self.known[0] == smoothing and not ridge:
            return self.known[1]
        w = self.weights if weights is None else weights
        y = self.outputs if self.orientation > 0 else -self.outputs
        before = None if start is None else self.orientation * start.coefficients[: self.regressor.base.size]
        found = fit_operator(
            self.spec.constrained, self.template, self.regressor, y, w, self.skip, smoothing, ridge, before
        )
        if self.orientation > 0:
            return found
        return replace(found, coefficients=0.0 - found.coefficients, bias=0.0 - found.bias)

    def with_shape(self, values: Sequence[float]) -> FitProblem:
        """Return the problem with other shape parameters of the operator."""
        template = self.template.with_shape(values)
        state = self.start(template)
        return replace(
            self, template=template, state=state, regressor=template.regressor(self.inputs, state), known=None
        )

    def with_best_shape(self, smoothing: float, starts: Sequence[Sequence[float]] = ()) -> FitProblem:
        """Return the problem with the shape parameters that fit best; itself if its operator has none.

        They are searched by variable projection from the operator's own starts, or from others.
        """
        shape = self.template.shape_parameters()
        if not shape.names:
            return self

        def residuals(values: Floats) -> Floats:
            problem = self.with_shape(values.tolist())
            return problem.residuals(problem.fit(smoothing))

        points = [np.asarray(values, dtype=np.float64) for values in starts or self.template.shape_starts()]
        bounds = np.array(shape.low), np.array(shape.high)
        return self.with_shape(variable_projection(residuals, points, bounds, step=_STEP)[0].values.tolist())

    def residuals(self, fit: Fit) -> Floats:
        """Return the weighted errors that a fit leaves after the skipped samples, shape (N - skip,)."""
        errors = self.outputs - fit.bias - self.regressor.product(fit.coefficients)
        return np.asarray(np.sqrt(self.weights[self.skip :]) * errors[self.skip :])

    def cost(self, fit: Fit) -> float:
        """Return the weighted sum of squares that a fit leaves."""
        return float(np.sum(self.residuals(fit) ** 2))

    def advice(self) -> tuple[Advice, ...]:
        """Return what is odd about the data or not covered by them."""
        record = record_of(self.weights)
        found = check_data(self.inputs[record], self.outputs[record])
        coverage = self.template.coverage(self.inputs[record], self.state)
        if coverage is not None and coverage.never.size:
            found.append(Advice("coverage", coverage.summary()))
        found += undetermined_shape(self.template)
        return tuple(found)


def set_up_problem(
    settings: Candidate, inputs: ArrayLike, outputs: ArrayLike, weights: ArrayLike | None = None, skip: int = 0
) -> FitProblem:
    """Return the problem that `identify` solves.

    Parameters
    ----------
    settings : Candidate
        Model and settings. Its shape parameters are found from the data, unless the settings have them.
    inputs, outputs, weights, skip
        As in `identify`.

    Raises
    ------
    ValueError
        As `identify`.
    """
    name, initial, spec = settings.model, settings.initial, find_model(settings.model)
    sequence = _checks.samples("inputs", inputs)
    measured = _checks.counted("outputs", outputs, sequence.size, "values, one for each input")
    w = counted_weights(sequence.size, weights, skip=0)
    check_words(initial, settings.orientation)
    if initial == "estimate" and spec.estimate_state is None:
        raise ValueError(f"initial: 'estimate' needs a nonnegative Preisach density, not {name}")
    check_options(name, settings.options)
    # Its range is that of the rows that are fitted: nothing is known of the output beyond it.
    template = template_of(spec, sequence[w > 0.0], settings.options)
    record = record_of(w)
    if initial == "skip":
        skip = max(skip, template.unknown_until(sequence[record]))
        check_skipped(record.stop, skip, template.coefficients.size, spec.estimate_state is not None)
    counted = counted_weights(sequence.size, w, skip)
    check_record(sequence[record], measured[record], skip)
    signs = possible_signs(settings.orientation, name, spec, template, sequence, measured, counted)
    problems = {sign: _orient(sign, settings, spec, template, sequence, measured, w, skip) for sign in signs}
    if len(problems) == 1:
        return problems[signs[0]]
    smoothing = settings.smoothing or 0.0
    fits = {sign: problem.fit(smoothing) for sign, problem in problems.items()}
    rising, falling = (problems[sign].cost(fits[sign]) for sign in signs)
    best = better_sign(rising, falling, measured, counted)
    return replace(problems[best], known=(smoothing, fits[best]))


def check_words(initial: str | None, orientation: str | None) -> None:
    """Check the words for the memory before the first sample and for the orientation; None is neither.

    Raises ValueError if one is unknown: names those that are allowed.
    """
    if initial not in (None, *INITIALS):
        raise ValueError(f"initial: expected {_listed(INITIALS)}, got {initial!r}")
    if orientation not in (None, *ORIENTATIONS):
        raise ValueError(f"orientation: expected {_listed(ORIENTATIONS)}, got {orientation!r}")


def _listed(words: Sequence[str]) -> str:
    return f"{', '.join(map(repr, words[:-1]))} or {words[-1]!r}"


def _orient(
    sign: Sign,
    settings: Candidate,
    spec: ModelSpec,
    template: Operator[Any],
    inputs: Floats,
    outputs: Floats,
    weights: Floats,
    skip: int,
) -> FitProblem:
    """Return the problem with the output of one sign, its initial memory and its shape found from the data."""
    measured, initial, smoothing = outputs if sign > 0 else -outputs, settings.initial, settings.smoothing or 0.0
    state: Any = None
    if initial == "estimate":
        assert spec.estimate_state is not None
        state = spec.estimate_state(template, inputs, measured, weights, skip, smoothing)

    def start(operator: Operator[Any]) -> Any:  # noqa: ANN401 - each operator has its own state
        if initial in ("negative", "positive"):
            return operator.saturated_state(-1 if initial == "negative" else 1)
        return state if initial == "estimate" else operator.initial_state()

    if spec.refine is not None:
        template = spec.refine(template, inputs, measured, weights, skip, start(template))
    before = start(template)
    regressor = template.regressor(inputs, before)
    problem = FitProblem(spec, inputs, outputs, weights, skip, template, before, regressor, start, sign)
    return problem.with_shape(settings.shape) if settings.shape else problem.with_best_shape(smoothing)
