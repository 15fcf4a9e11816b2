"""From measured inputs and outputs to a model, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from bench.hysteresis import (
    Operator,
    Polynomial,
    Preisach,
    QuadraticTerm,
    Reversible,
    ThermalExpansion,
    _checks,
    uniform_levels,
)
from bench.hysteresis._checks import Floats
from bench.identification.least_squares import Certificate, Fit, fit, fit_minimum_norm
from bench.identification.measures import Errors, measure_errors

ReversibleKind: TypeAlias = Literal["none", "linear", "quadratic"]


@dataclass(frozen=True, eq=False)
class Identification:
    """An identified model with the evidence for it.

    Parameters
    ----------
    model_name : str
        Key of `MODELS`.
    model : Operator
        The identified operator.
    residuals : ndarray, shape (N,)
        Measured minus model output for every sample, the skipped ones too, output units.
    errors : Errors
        Measures over the samples after `skip`.
    uncertainties : ndarray, shape (K + q,)
        Standard uncertainty of each coefficient; see `Fit`.
    certificate : Certificate
        Optimality, conditioning and coverage of the fit.
    skip : int
        Number of first samples left out of the cost.
    """

    model_name: str
    model: Operator[Any]
    residuals: Floats
    errors: Errors
    uncertainties: Floats
    certificate: Certificate
    skip: int


@dataclass(frozen=True)
class ModelSpec:
    """How a model of one name is set up and fitted.

    Parameters
    ----------
    summary : str
        What it is, in one line.
    template : callable
        Takes the inputs and the keyword options of `identify`; returns the operator with zero coefficients.
    constrained : bool
        Whether the density must not be negative; otherwise the least-norm solution is taken.
    """

    summary: str
    template: Callable[..., Operator[Any]]
    constrained: bool


def identify(
    model_name: str,
    inputs: ArrayLike,
    outputs: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    skip: int = 0,
    smoothing: float = 0.0,
    **options: Any,  # noqa: ANN401 - each template names and types its own
) -> Identification:
    """Return the model of a given name that fits a measured sequence best in the least-squares sense.

    ==========================  ==============================================================================
    `preisach`                  nonnegative density; options `levels` (20), `plane` (range of the inputs),
                                `reversible` ("none", "linear" or "quadratic"), `input_range`
    `preisach-signed`           density of either sign, least norm; options as `preisach`
    `preisach-nonmonotonic`     nonnegative density and thermal term (Zhang et al. 2013, eq. 12); options
                                `levels` (20), `plane` (30, 70), `reference` (20), `input_range`
    `polynomial`                without memory; options `degree` (12), `input_range`
    ==========================  ==============================================================================

    `input_unit` and `output_unit` are options of each. Every Preisach model starts from negative saturation.

    Parameters
    ----------
    model_name : str
        One of the names above, a key of `MODELS`.
    inputs, outputs : array_like, shape (N,)
        The measured sequence, in input and output units.
    weights : array_like, shape (N,), or None
        Weight per sample, >= 0; default 1.
    skip : int
        Number of first samples left out of the cost because their memory is unknown.
    smoothing : float
        Weight of the roughness penalty of `fit`; only for nonnegative densities.
    **options
        As listed above; `levels` is the number of intervals or the increasing levels themselves.

    Returns
    -------
    Identification
        Model, residuals, errors and certificate.

    Raises
    ------
    ValueError
        If the name is unknown, an option does not belong to it, or the data are unfit; see `fit`.
    """
    if model_name not in MODELS:
        raise ValueError(f"model_name: expected one of {', '.join(sorted(MODELS))}, got {model_name!r}")
    spec = MODELS[model_name]
    sequence = _checks.samples("inputs", inputs)
    measured = _checks.samples("outputs", outputs)
    if measured.size != sequence.size:
        raise ValueError(f"outputs: expected {sequence.size} values, one for each input, got {measured.size}")
    if smoothing and not spec.constrained:
        raise ValueError(f"smoothing: {model_name} takes the least-norm solution instead")
    try:
        template = spec.template(sequence, **options)
    except TypeError as error:
        raise ValueError(f"options of {model_name}: {error}") from None
    regressor = template.regressor(sequence)
    solution: Fit
    if spec.constrained:
        term: Reversible | None = getattr(template, "reversible", None)
        signs = np.ones(regressor.shape[1], dtype=bool)
        signs[regressor.base.size :] = term is not None and term.nonnegative
        solution = fit(regressor, measured, nonnegative=signs, weights=weights, skip=skip, smoothing=smoothing)
    else:
        solution = fit_minimum_norm(regressor, measured, weights=weights, skip=skip)
    model = template.with_coefficients(solution.coefficients, solution.bias)
    predicted = model.evaluate(sequence)
    return Identification(
        model_name=model_name,
        model=model,
        residuals=measured - predicted,
        errors=measure_errors(measured[skip:], predicted[skip:]),
        uncertainties=solution.uncertainties,
        certificate=solution.certificate,
        skip=skip,
    )


def _lattice(levels: int | ArrayLike, plane: tuple[float, float]) -> Floats:
    if isinstance(levels, int | np.integer):
        return uniform_levels(*plane, int(levels))
    return _checks.increasing("levels", levels)


def _operating(inputs: Floats, plane: tuple[float, float], given: tuple[float, float] | None) -> tuple[float, float]:
    """Return the operating range: what was given, else what the inputs and the plane span."""
    if given is not None:
        return given
    return min(float(inputs.min()), plane[0]), max(float(inputs.max()), plane[1])


def _input_span(inputs: Floats, name: str) -> tuple[float, float]:
    low, high = float(inputs.min()), float(inputs.max())
    if low == high:
        raise ValueError(f"inputs: constant at {low}; give {name} or inputs that vary")
    return low, high


def _preisach(
    inputs: Floats,
    *,
    levels: int | ArrayLike = 20,
    plane: tuple[float, float] | None = None,
    reversible: ReversibleKind = "none",
    input_range: tuple[float, float] | None = None,
    input_unit: str = "",
    output_unit: str = "",
) -> Preisach:
    if plane is None and isinstance(levels, int | np.integer):
        plane = _input_span(inputs, "plane")
    lattice = _lattice(levels, plane or (0.0, 0.0))
    middle = 0.5 * float(lattice[0] + lattice[-1])
    terms: dict[str, QuadraticTerm | None] = {
        "none": None,
        "linear": QuadraticTerm(origin=middle),
        "quadratic": QuadraticTerm(quadratic=0.0, origin=middle),
    }
    if reversible not in terms:
        raise ValueError(f"reversible: expected one of {', '.join(terms)}, got {reversible!r}")
    return Preisach(
        lattice,
        np.zeros(lattice.size * (lattice.size - 1) // 2),
        reversible=terms[reversible],
        input_range=_operating(inputs, (float(lattice[0]), float(lattice[-1])), input_range),
        input_unit=input_unit,
        output_unit=output_unit,
    )


def _nonmonotonic(
    inputs: Floats,
    *,
    levels: int | ArrayLike = 20,
    plane: tuple[float, float] = (30.0, 70.0),
    reference: float = 20.0,
    input_range: tuple[float, float] | None = None,
    input_unit: str = "°C",
    output_unit: str = "1/m",
) -> Preisach:
    lattice = _lattice(levels, plane)
    ends = float(lattice[0]), float(lattice[-1])
    return Preisach(
        lattice,
        np.zeros(lattice.size * (lattice.size - 1) // 2),
        reversible=ThermalExpansion(low=ends[0], high=ends[1], reference=reference),
        input_range=_operating(inputs, ends, input_range),
        input_unit=input_unit,
        output_unit=output_unit,
    )


def _polynomial(
    inputs: Floats,
    *,
    degree: int = 12,
    input_range: tuple[float, float] | None = None,
    input_unit: str = "",
    output_unit: str = "",
) -> Polynomial:
    if degree < 1:
        raise ValueError(f"degree: expected at least 1, got {degree}")
    span = _input_span(inputs, "input_range") if input_range is None else input_range
    return Polynomial(np.zeros(degree), span, input_unit=input_unit, output_unit=output_unit)


MODELS: dict[str, ModelSpec] = {
    "preisach": ModelSpec("Preisach operator with a nonnegative density", _preisach, constrained=True),
    "preisach-signed": ModelSpec("Preisach operator with a density of either sign", _preisach, constrained=False),
    "preisach-nonmonotonic": ModelSpec(
        "nonnegative Preisach operator and a quadratic thermal term, as for VO2", _nonmonotonic, constrained=True
    ),
    "polynomial": ModelSpec("single-valued polynomial, without memory", _polynomial, constrained=False),
}
