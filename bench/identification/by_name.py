"""From measured inputs and outputs to a model, by name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from bench.hysteresis import ModelSpec, Operator, Regressor, TimedModel, _checks, find_model
from bench.hysteresis._checks import Floats
from bench.identification.inspection import check_data
from bench.identification.least_squares import Certificate, Fit
from bench.identification.measures import Errors, measure_errors
from bench.identification.shape import fit_operator, fit_shape

M = TypeVar("M", bound=Operator[Any] | TimedModel[Any])
Initial: TypeAlias = Literal["negative", "positive", "skip", "estimate"]


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
    warnings : tuple of str
        What is odd about the data or not covered by them.
    """

    model_name: str
    model: M
    residuals: Floats
    errors: Errors
    uncertainties: Floats
    certificate: Certificate
    skip: int
    initial_state: Any = None
    warnings: tuple[str, ...] = ()


def identify(
    model_name: str,
    inputs: ArrayLike,
    outputs: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    skip: int = 0,
    smoothing: float = 0.0,
    initial: Initial | None = None,
    **options: Any,  # noqa: ANN401 - each template names and types its own
) -> Identification[Any]:
    """Return the model of a given name that fits a measured sequence best in the least-squares sense.

    ==========================  ==============================================================================
    `preisach`                  nonnegative density; options `levels` (20), `plane` (range of the inputs),
                                `reversible` ("none", "linear", "quadratic", or "polynomial" of `degree` 5 unless
                                given), `input_range`
    `preisach-signed`           density of either sign, least norm; options as `preisach`
    `preisach-nonmonotonic`     nonnegative density and thermal term (Zhang et al. 2013, eq. 12); options
                                `levels` (20), `plane` (range of the inputs), `reference` (low end of the
                                operating range: where the term is zero), `input_range`
    `prandtl-ishlinskii`        nonnegative weights of plays; options `plays` (15), `maximum` (half the range of
                                the inputs: thresholds are i maximum / plays), `origin` (0), `dead_zones` (0:
                                number of thresholds of a map after the plays), `input_range`
    `polynomial`                without memory; options `degree` (12), `input_range`
    ==========================  ==============================================================================

    `input_unit` and `output_unit` are options of each. Packages may register further models in `bench.models`; see
    `ModelSpec`. The shape parameters of an operator (`Operator.shape_parameters`), on which its output does not
    depend linearly, are fitted together with its coefficients by variable projection.

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
    smoothing : float
        Weight of the roughness penalty of `fit`; only for nonnegative densities.
    initial : {"negative", "positive", "skip", "estimate"} or None
        The memory before the first sample, as above.
    **options
        As listed above; `levels` is the number of intervals or the increasing levels themselves.

    Raises
    ------
    ValueError
        If the name is unknown, an option does not belong to it, or the data are unfit; see `fit`.
    """
    problem = set_up_problem(model_name, inputs, outputs, weights, skip, smoothing, initial, options)
    solution = problem.fit(smoothing)
    model = problem.template.with_coefficients(solution.coefficients, solution.bias)
    predicted = model.evaluate(problem.inputs, problem.state)
    return Identification(
        model_name=model_name,
        model=model,
        residuals=problem.outputs - predicted,
        errors=measure_errors(problem.outputs[problem.skip :], predicted[problem.skip :]),
        uncertainties=solution.uncertainties,
        certificate=solution.certificate,
        skip=problem.skip,
        initial_state=problem.state,
        warnings=problem.warnings(),
    )


@dataclass(frozen=True, eq=False)
class FitProblem:
    """A measured sequence set up for a model: everything but the smoothing."""

    spec: ModelSpec
    inputs: Floats
    outputs: Floats
    weights: Floats
    skip: int
    template: Operator[Any]
    state: Any
    regressor: Regressor

    def fit(self, smoothing: float, weights: Floats | None = None) -> Fit:
        """Return the coefficients for the problem's weights or others."""
        w = self.weights if weights is None else weights
        return fit_operator(
            self.spec.constrained, self.template, self.regressor, self.outputs, w, self.skip, smoothing
        )

    def warnings(self) -> tuple[str, ...]:
        """Return what is odd about the data or not covered by them."""
        found = check_data(self.inputs, self.outputs)
        coverage = self.template.coverage(self.inputs, self.state)
        if coverage is not None and coverage.never.size:
            found.append(coverage.summary())
        return tuple(found)


def set_up_problem(
    model_name: str,
    inputs: ArrayLike,
    outputs: ArrayLike,
    weights: ArrayLike | None,
    skip: int,
    smoothing: float,
    initial: Initial | None,
    options: dict[str, Any],
) -> FitProblem:
    """Return the problem that `identify` solves; its arguments are those of `identify`."""
    spec = find_model(model_name)
    assert spec.template is not None
    sequence = _checks.samples("inputs", inputs)
    measured = _checks.samples("outputs", outputs)
    if measured.size != sequence.size:
        raise ValueError(f"outputs: expected {sequence.size} values, one for each input, got {measured.size}")
    w = np.ones(sequence.size) if weights is None else _checks.samples("weights", weights)
    if initial not in (None, "negative", "positive", "skip", "estimate"):
        raise ValueError(f"initial: expected 'negative', 'positive', 'skip', 'estimate' or None, got {initial!r}")
    if smoothing and not spec.constrained:
        raise ValueError(f"smoothing: {model_name} takes the least-norm solution instead")
    try:
        template: Operator[Any] = spec.template(sequence, **options)
    except TypeError as error:
        raise ValueError(f"options of {model_name}: {error}") from None
    if initial == "skip":
        skip = max(skip, template.unknown_until(sequence))
    elif initial == "estimate":
        if spec.estimate_state is None:
            raise ValueError(f"initial: 'estimate' needs a nonnegative Preisach density, not {model_name}")
        state = spec.estimate_state(template, sequence, measured, w, skip, smoothing)

    def start(operator: Operator[Any]) -> Any:  # noqa: ANN401 - each operator has its own state
        if initial in ("negative", "positive"):
            return operator.saturated_state(-1 if initial == "negative" else 1)
        return state if initial == "estimate" else operator.initial_state()

    if spec.refine is not None:
        template = spec.refine(template, sequence, measured, w, skip, start(template))
    template = fit_shape(template, spec.constrained, start, sequence, measured, w, skip, smoothing)
    before = start(template)
    return FitProblem(spec, sequence, measured, w, skip, template, before, template.regressor(sequence, before))
