"""Fit of a Hammerstein model: operator, linear part and drift at once.

The response is linear in the operator's coefficients: filtered columns of its regressor are a regressor again. Time
constants, delay and creep enter nonlinearly. They are found by variable projection (Golub and Pereyra, Inverse
Problems 19(2), R1-R26, 2003; Kaufman's form of the Jacobian) over the coefficients that a constrained fit
leaves free, in turns with that fit, from several starts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats
from bench.identification.advice import Advice
from bench.identification.by_name import Candidate, FitProblem, Identification, Initial, set_up_problem
from bench.identification.choose.cross_validation import compare_smoothing
from bench.identification.fit.least_squares import Fit, one_thread
from bench.identification.fit.orientation import NAMES, Orientation, has_orientation
from bench.identification.fit.regularization import Regularization
from bench.identification.fit.variable_projection import Evidence, Stage, variable_projection
from bench.identification.measures import measure_errors
from bench.identification.options import OptionHelp
from bench.identification.timed.hammerstein_search import COMPARING, Found, Search, beside, find_best, search_ends
from bench.identification.timed.parsimony import check_size, schwarz
from bench.identification.trust import judge_fit
from bench.models import Hammerstein, HammersteinState, check_sequence

ELEMENTS = ("lag", "resonance", "delay", "creep", "kelvin-voigt", "drift", "fading-drift", "viscous", "friction")
"""What can follow the operator or stand beside it: see `identify_hammerstein`."""

CHOICE = ("lag", "resonance", "delay", "creep", "drift", "viscous", "friction")
"""What is chosen among if nobody says what follows."""

# What cannot stand beside each other.
_EXCLUSIVE = ({"lag", "resonance"}, {"creep", "kelvin-voigt"}, {"drift", "fading-drift"})
# Numbers of a regressor up to which the shape of the operator is found anew with what follows it, and the relative
# step of its differences. Derivation: a regressor of that size takes 4 MB, and each step forms some; the step is the
# root of 1e-12, to which a fit is exact.
_RESHAPED, _STEP_OF_SHAPE = 500_000, 1e-6
# Evaluations of a search for a shape: it and a lag stand for each other along a valley. Source: measured; 40 may
# leave three times the error on other inputs.
_EVALUATIONS = 200


def identify_hammerstein(
    times: ArrayLike,
    inputs: ArrayLike,
    outputs: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    skip: int = 0,
    initial: Initial | None = None,
    orientation: Orientation = "auto",
    static: Annotated[str, OptionHelp("operator, the name of a model without time")] = "preisach",
    dynamics: Annotated[str | None, OptionHelp("what follows it, with commas", "chosen by the data")] = None,
    smoothing: Annotated[
        float | Sequence[float], OptionHelp("weight of the roughness penalty on the density; of several the best")
    ] = 0.0,
    ridge: Annotated[float, OptionHelp("weight of the penalty on coefficients of free signs")] = 0.0,
    **options: Any,  # noqa: ANN401 - those of the operator
) -> Identification[Any]:
    """Return the Hammerstein model that fits a measured sequence best in the least-squares sense.

    ================  ==========================================================================================
    `lag`             1 / (1 + τ s)
    `resonance`       1 / (1 + 2 ζ s/ω + s²/ω²); ζ above 1 stands for two real poles
    `delay`           exp(-delay s)
    `creep`           with the logarithm of time, by a part of the response per decade
    `kelvin-voigt`    one Kelvin-Voigt element a decade, each with a strength of its own
    `drift`           in proportion to time
    `fading-drift`    1 - exp(-time / time constant)
    `viscous`         in proportion to the velocity of the input
    `friction`        tanh(velocity / speed)
    `none`            the operator alone
    ================  ==========================================================================================

    Parameters
    ----------
    times : array_like, shape (N,)
        s, strictly increasing.
    inputs, outputs : array_like, shape (N,)
        The measured sequence.
    weights, skip, initial, orientation
        As `identify`; the orientation is that of the operator.
    static : str
        Name of the operator in `bench.models`.
    dynamics : str or None
        Elements as listed above, separated by commas. None chooses among all but `kelvin-voigt` and `fading-drift`:
        one after the other as long as it lowers the criterion of Schwarz (Annals of Statistics 6, 461, 1978).
    smoothing : float or sequence of float
        Weight of the roughness penalty on the density, see `fit`; 0 for an operator without one. Of several, the one
        of the least error on blocks left out of the fit of the coefficients, see `cross_validate`.
    ridge : float
        Weight of the penalty on the coefficients of an operator of free signs without a density, see `fit_ridge`.
    **options
        Those of the operator; see `identify`. A Preisach operator has a linear reversible part unless they say
        otherwise.

    Raises
    ------
    ValueError
        If an option is wrong or the data are unfit.
    """
    moments, sequence, measured = check_sequence(times, inputs=inputs, outputs=outputs)
    chosen = None if dynamics is None else _elements(dynamics)
    tried = [float(weight) for weight in np.atleast_1d(np.asarray(smoothing, dtype=np.float64))]
    # The dynamic elements hardly depend on the penalty, but without one a fine plane takes them for hysteresis.
    settings = Candidate(static, options, orientation, initial, tried[len(tried) // 2], ridge)
    search = set_up_search(settings, moments, sequence, measured, weights, skip)
    advice = list(search.static.advice())
    penalties = Regularization(tried[0], 0.0) if any(tried) else None
    with one_thread():
        search, found = choose_elements(search) if chosen is None else reshape(search, find_best(search, chosen, {}))
        if len(tried) > 1:
            penalties = _cross_validated(search, found, tried)
            search = replace(search, smoothing=penalties.smoothing)
            found = find_best(search, found.elements, search.named(found))
    problem = search.static
    parameters = search.parameters(found.elements)
    for parameter, value, deviation in zip(parameters, found.values, found.deviations, strict=True):
        # A delay or creep of 0 is an answer; a time at its bound is not.
        if parameter.name in ("lag", "frequency", "damping", "drift", "friction") and not deviation < 1.0:
            text = f"the data do not determine the {parameter.name} of the linear part"
            remedy = "record faster and slower inputs, or leave it out with -o dynamics=..."
            advice.append(Advice("dynamics-unknown", text, remedy))
        elif parameter.name == "delay" and value > 0.99 * parameter.high:
            advice.append(
                Advice("long-delay", "the delay is the longest that is tried", "check the columns of time and output")
            )
    follows = search.linear(parameters, found.values)
    count = search.columns.shape[1]
    strengths = dict(zip(beside(found.elements), found.fit.coefficients[count:].tolist(), strict=True))
    operator = problem.template.with_coefficients(found.fit.coefficients[:count], found.fit.bias)
    model = Hammerstein(
        operator,
        follows.part,
        strengths.get("drift", strengths.get("fading-drift", 0.0)),
        follows.drift_time,
        strengths.get("viscous", 0.0),
        strengths.get("friction", 0.0),
        follows.friction_speed,
    )
    state = HammersteinState(problem.state)
    predicted = model.evaluate(moments, sequence, state)
    residuals = measured - predicted
    advice += judge_fit(problem, found.fit, residuals, initial=initial, smoothing=search.smoothing)
    return Identification(
        model_name="hammerstein",
        model=model,
        residuals=residuals,
        errors=measure_errors(measured[problem.skip :], predicted[problem.skip :]),
        uncertainties=found.fit.uncertainties,
        certificate=found.fit.certificate,
        skip=problem.skip,
        initial_state=state,
        advice=tuple(advice),
        regularization=penalties,
        orientation=NAMES[search.sign(found.fit)] if has_orientation(problem.spec, problem.template) else None,
    )


def _elements(text: str) -> tuple[str, ...]:
    """Return the elements that a text names; ValueError if one is unknown or two exclude each other."""
    names = tuple(name.strip() for name in text.split(",") if name.strip() not in ("", "none"))
    if unknown := [name for name in names if name not in ELEMENTS]:
        raise ValueError(f"dynamics: expected none or {', '.join(ELEMENTS)}, got {', '.join(unknown)}")
    for group in _EXCLUSIVE:
        if len(group & set(names)) > 1:
            raise ValueError(f"dynamics: expected one of {' and '.join(sorted(group))}, got both")
    return tuple(dict.fromkeys(names))


def with_element(elements: Sequence[str], element: str) -> tuple[str, ...]:
    """Return elements with one more, in place of what cannot stand beside it."""
    return (*(name for name in elements if not any({name, element} <= group for group in _EXCLUSIVE)), element)


def set_up_search(
    settings: Candidate,
    times: Floats,
    inputs: Floats,
    outputs: Floats,
    weights: ArrayLike | None = None,
    skip: int = 0,
) -> Search:
    """Return the search for the dynamic elements behind an operator with its settings; see `identify_hammerstein`."""
    static, smoothing, ridge = settings.model, settings.smoothing or 0.0, settings.ridge or 0.0
    if static == "preisach":
        settings = replace(settings, options={"reversible": "linear", **settings.options})
    problem = set_up_problem(settings, inputs, outputs, weights, skip)
    if smoothing and not problem.regressor.base.size:
        raise ValueError(f"smoothing: {static} has no cells of a density")
    if ridge and (problem.spec.constrained or problem.regressor.base.size):
        raise ValueError(f"ridge: {static} has coefficients with signs, or cells of a density")
    check_size(*problem.regressor.shape, "levels")
    # The output of a lag may fall while the operator rises: the sign is found with the linear part.
    oriented = has_orientation(problem.spec, problem.template)
    signs: tuple[Literal[1, -1], ...] = (
        (1, -1) if oriented and settings.orientation == "auto" else (problem.orientation,)
    )
    roots = np.sqrt(problem.weights)
    roots[: problem.skip] = 0.0
    return Search(times, problem, problem.regressor.dense(), roots, signs, smoothing, ridge)


def _cross_validated(search: Search, found: Found, tried: Sequence[float]) -> Regularization:
    """Return the smoothing of the least error on blocks left out of the fit of the coefficients."""
    responses, sign = search.responses(found.elements, found.values), search.sign(found.fit)

    def fitted(weight: float, weights: Floats) -> Fit:
        return search.fit(responses, sign, weights, weight)

    return compare_smoothing(fitted, responses.regressor, search.static.outputs, search.roots**2, tried).best


def choose_elements(search: Search) -> tuple[Search, Found]:
    """Return the elements that lower the criterion of Schwarz, added one after the other, with the rest.

    The search that is returned has the operator's shape as it is with them.
    """
    used = max(int(np.count_nonzero(search.roots)), 1)

    def criterion(trial: Found) -> float:
        return schwarz(trial.cost, trial.values.size + len(beside(trial.elements)), used)

    found = search.alone
    shortest, longest = search.creep_span
    among = [name for name in CHOICE if name != "creep" or longest >= 10.0 * shortest]
    while found.cost > 0.0:
        trials = []
        for element in among:
            if element not in found.elements:
                elements = with_element(found.elements, element)
                trials += search_ends(search, elements, search.named(found), COMPARING)
        # Only the most promising is worth the constrained fit.
        least = min(trials, key=criterion)
        reshaped, best = reshape(search, find_best(search, least.elements, search.named(found), rounds=1))
        if criterion(best) >= criterion(found):
            break
        search, found = reshaped, best
    return search, min(find_best(search, found.elements, {}), found, key=lambda each: each.cost)


def reshape(search: Search, found: Found, tolerance: float = 1e-10) -> tuple[Search, Found]:
    """Return search and parameters with the operator's shape fitted together with them, to a relative tolerance.

    A shape that was found without what follows the operator has taken some of that for hysteresis. Both are varied at
    once: in turns they would creep along the valley in which one stands for the other.
    """
    shape = search.static.template.shape_parameters()
    if not shape.names or search.columns.size > _RESHAPED:
        return search, found
    parameters, count = search.parameters(found.elements), len(shape.names)
    low = np.array([*shape.low, *(each.low for each in parameters)])
    high = np.array([*shape.high, *(each.high for each in parameters)])
    sign = search.sign(found.fit)

    # The operator is computed once for all differences of what follows it.
    shaped = lru_cache(maxsize=count + 1)(search.static.with_shape)

    def at(values: Floats) -> tuple[FitProblem, Fit, Floats]:
        static = shaped(tuple(values[:count].tolist()))
        follows = search.linear(parameters, values[count:])
        responses = search.behind(follows, static.regressor.dense(), found.elements)
        return static, *search.fit_and_rest(responses, sign)

    def residuals(values: Floats) -> Floats:
        return at(values)[2]

    start = np.array([*shape.values, *found.values])
    stages = [Stage(1, tolerance, _EVALUATIONS)]
    end = variable_projection(residuals, [start], (low, high), stages=stages, step=_STEP_OF_SHAPE)[0]
    static, fitted, rest = at(end.values)
    cost = float(rest @ rest)
    if not cost < found.cost:
        return search, found
    other = replace(search, static=static, columns=static.regressor.dense())
    freedom = search.times.size - fitted.coefficients.size - start.size - 1
    deviations = Evidence.of(end.jacobian, rest, freedom).deviations[count:]
    return other, Found(found.elements, end.values[count:], fitted, cost, deviations)
