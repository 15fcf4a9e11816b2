"""The operators as C: for each class the constants of its template, and which inverse it has."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np

from bench.base import DataError, Floats
from bench.deployment.c_source import Real, Source, Value, constants, parts_of, rendered
from bench.models import (
    BoucWen,
    BranchInverse,
    Duhem,
    FallingInverse,
    GeneralizedPrandtlIshlinskii,
    MaxwellSlip,
    Operator,
    PlayInverse,
    PolynomialPlays,
    PrandtlIshlinskii,
    Preisach,
    PreisachInverse,
)

Starts: TypeAlias = tuple[Any, Any, Any, Any]
"""States: at the end of the data, before them, and at negative and positive saturation."""

_INFINITE = 1e30
"""More than any input or output. Derivation: within the range of `float`, whose greatest number is 3.4e38."""
_ROUNDING = {"double": 1.0, "float": 1e7}
"""Parts of tolerances that belong to rounding. Derivation: that of float, 6e-8, beside that of double, 1.1e-16, is
5e8; a sum of some 100 numbers in place of 10 000 errs by less."""
_LEAST_ROOM = 64
"""Pieces that a memory curve has room for at least. Derivation: an oscillation of 64 cycles that shrinks."""
_STEPS = 4096
"""Steps of integration within one move. Derivation: a move through the range takes some 100."""

_MACHINE_CODE = {
    "preisach.c.in": 8200,
    "prandtl_ishlinskii.c.in": 2500,
    "generalized_prandtl_ishlinskii.c.in": 3500,
    "maxwell_slip.c.in": 3000,
    "polynomial_plays.c.in": 3500,
    "bouc_wen.c.in": 5000,
    "duhem.c.in": 3500,
}
"""Bytes of machine code by template. Source: arm-none-eabi-gcc 12.2 -mcpu=cortex-m4 -O2 with `double`, rounded up."""

_Numbers: TypeAlias = dict[str, Value]


def operator_source(operator: Operator[Any], starts: Starts, real: Real, prefix: str, base: str) -> Source:
    """Return an operator as C.

    Raises DataError if there is no C for its class; the message says why.
    """
    writer = _WRITERS.get(type(operator))
    if writer is None:
        raise DataError(why_not(operator))
    return writer(operator, starts, real, prefix, base)


def why_not(model: Any) -> str:  # noqa: ANN401 - any registered model
    """Return why a model cannot be exported."""
    kinds = ", ".join(kind.kind for kind in _WRITERS)
    reason = _REASONS.get(model.kind, "there is no C for its class")
    return (
        f"a model of the kind {model.kind} cannot be exported: {reason}; what can be: {kinds}, two-stage, hammerstein"
    )


_REASONS = {
    "polynomial": "it has no memory, and its inverse is a table of 4001 points; fit polynomial-plays",
    "krasnoselskii-pokrovskii": "it steps an element for each cell of a plane, 820 at 40 levels; fit preisach",
    "summed": "it is the model to compare with; fit two-stage",
    "bouc-wen-oscillator": "it integrates a differential equation of the load and has no inverse from step to step",
    "preisach-oscillator": "it integrates a differential equation of the load and has no inverse from step to step",
    "rate-dependent-plays": "its plays follow their input in time; fit prandtl-ishlinskii, or -o dynamics=lag",
}


def _compose(
    template: str,
    words: Mapping[str, object],
    numbers: _Numbers,
    rest: list[str],
    state: int,
    bounds: tuple[str, str],
    real: Real,
    prefix: str,
    base: str,
) -> Source:
    parts = parts_of(template)
    declared, size = constants(numbers, real)
    code = parts["code"].replace("/*@constants*/\n", declared) + "".join(rest)
    names, (step, inverse) = (real, prefix, base), bounds
    return Source(
        rendered(parts["head"], *names, words),
        rendered(parts_of("operator.h.in")["head"], *names),
        rendered(code, *names, words),
        size,
        state,
        _MACHINE_CODE[template],
        step,
        inverse,
    )


def _elements(
    operator: Operator[Any],
    starts: Starts,
    template: str,
    words: Mapping[str, object],
    numbers: _Numbers,
    inverse: list[str],
    real: Real,
    prefix: str,
    base: str,
    *,
    skipped: int = 1,
    step: str = "",
) -> Source:
    """Return an operator whose state is its input and one number an element."""
    rows = [[operator.present_input(state), operator.value(state), *list(state)[skipped:]] for state in starts]
    table = np.array(rows, dtype=np.float64)
    width = 4 if real == "float" else 8
    count = table.shape[1] - 2
    rest = [parts_of("elements.c.in")["head"], *inverse]
    words = {"count": count, **words}
    numbers = {**numbers, "starts": table}
    bounds = (
        step or f"{count} elements",
        (
            "at most 4 times 256 steps, and 4 times 64 to halve the last of them"
            if "rounding" in numbers
            else f"at most {2 * count + 5} steps"
            if "close" in numbers
            else "two steps"
        ),
    )
    return _compose(template, words, numbers, rest, width * (count + 2), bounds, real, prefix, base)


def _numerical(operator: Operator[Any], real: Real) -> tuple[_Numbers, list[str]]:
    low, high = operator.input_range
    # Source: the tolerance of bench.models' numerical inverse, in float as much more as its rounding.
    rounding = 1e-14 if real == "double" else 1e-6
    return {"low": low, "high": high, "rounding": rounding}, [parts_of("numerical.c.in")["head"]]


def _branch(operator: Operator[Any], real: Real, along: str) -> tuple[_Numbers, list[str]]:
    low, high = operator.input_range
    # Source: the tolerances of bench.models' branch inverse, in float as much more as its rounding.
    tolerance, close = (2e-13, 1e-12) if real == "double" else (1e-6, 4e-6)
    far = (
        "static real OP_far(real x, real y)\n{\n    x = x < 0.0 ? -x : x;\n    y = y < 0.0 ? -y : y;\n"
        "    return x > y ? x : y;\n}\n\n"
    )
    return (
        {"low": low, "high": high, "tolerance": tolerance, "close": close},
        ["\n", along, "\n", far, parts_of("branch_inverse.c.in")["head"]],
    )


def _preisach(model: Preisach, starts: Starts, real: Real, prefix: str, base: str) -> Source:
    inverse = model.inverse()
    sign = ""
    if isinstance(inverse, FallingInverse):
        inverse, sign = inverse.opposite, "-"
    assert isinstance(inverse, PreisachInverse)
    operator = inverse.operator
    lattice = operator.lattice
    order, room = operator.order, max(_LEAST_ROOM, 2 * operator.order + 2)
    ways = [[operator.plane[state.saturation > 0], *state.extrema, state.input] for state in starts]
    low, high = operator.input_range
    numbers: _Numbers = {
        "levels": lattice.levels,
        "table": lattice.table[np.tril_indices(order)],
        "below": lattice.below,
        "breaks": np.append(lattice.breaks, high),
        "quadratics": _centred(lattice.breaks, lattice.quadratics, (low, high), real),
        "inverse_step": lattice.inverse_step,
        "offset": lattice.offset,
        "low": low,
        "high": high,
        "tolerance": inverse.tolerance * _ROUNDING[real],
        "INFINITE": _INFINITE,
        "gains": inverse.gains,
        "least": inverse.branches[:, 2].min(),
        "greatest": inverse.branches[:, 3].max(),
        "inputs": np.concatenate(ways),
        "starts": np.cumsum([0, *map(len, ways)]),
    }
    rises, points = operator.rises(), 0
    if not rises:
        numbers |= {"branches": inverse.branches}
        points = inverse.branches.shape[-1]
    parts, bits = parts_of("preisach.c.in"), max(order, room, points).bit_length() + 1
    words = {
        "order": order, "room": room, "breaks": lattice.breaks.size, "points": points,
        "bits": bits, "sign": sign, "plus": "-" if sign else "+",
    }  # fmt: skip
    width = 4 if real == "float" else 8
    state = width * (3 * room + 4) + 8
    # Segments between levels and breaks, in both directions and on a major branch each.
    cells = order + lattice.breaks.size + 8
    bounds = (
        f"at most {room} pieces wiped out, and as many looked at where the memory is full; two cells read",
        f"at most {4 * bits} corners and levels looked at, and {cells} segments walked"
        if rises
        else f"at most {cells + 2 * room} segments walked and as many cells passed over",
    )
    rest = [parts["rising" if rises else "everywhere"], parts["invert"]]
    return _compose("preisach.c.in", words, numbers, rest, state, bounds, real, prefix, base)


def _centred(breaks: Floats, quadratics: Floats, span: tuple[float, float], real: Real) -> Floats:
    """Return rows of origin and coefficients; about the middle of its piece in float, where powers would cancel."""
    origins: Floats = np.zeros(len(quadratics))
    if real == "float":
        ends = np.concatenate([[span[0]], breaks, [span[1]]])
        origins = np.asarray(0.5 * (ends[:-1] + ends[1:]), np.float32).astype(np.float64)
    c0, c1, c2 = quadratics.T
    return np.column_stack([origins, c0 + origins * (c1 + origins * c2), c1 + 2.0 * c2 * origins, c2])


def _lines(name: str, zones: Any) -> _Numbers:  # noqa: ANN401 - dead zones or None
    if zones is None:
        return {name: np.zeros(2), f"{name}_count": -1}
    return {name: np.concatenate(zones.lines), f"{name}_count": int(zones.thresholds.size)}


def _plays(model: PrandtlIshlinskii, starts: Starts, real: Real, prefix: str, base: str) -> Source:
    numbers: _Numbers = {
        "thresholds": model.thresholds, "weights": model.weights, "bias": model.bias, "origin": model.origin,
        **_lines("before", model.before), **_lines("after", model.after),
    }  # fmt: skip
    if isinstance(model.inverse(), PlayInverse):
        back = model.inverse_operator()
        least, greatest = model.output_range()
        numbers |= {
            "inverse_thresholds": back.thresholds, "inverse_weights": back.weights,
            "sums": np.cumsum(model.weights), "least": least, "greatest": greatest,
            **_lines("inverse_before", back.before), **_lines("inverse_after", back.after),
        }  # fmt: skip
        rest = [parts_of("play_inverse.c.in")["head"]]
    else:
        more, rest = _numerical(model, real)
        numbers |= more
    template = "prandtl_ishlinskii.c.in"
    return _elements(model, starts, template, {}, numbers, rest, real, prefix, base, skipped=0)


def _generalized(model: GeneralizedPrandtlIshlinskii, starts: Starts, real: Real, prefix: str, base: str) -> Source:
    parts = parts_of("generalized_prandtl_ishlinskii.c.in")
    exact = isinstance(model.inverse(), BranchInverse)
    more, rest = _branch(model, real, parts["inverse"]) if exact else _numerical(model, real)
    numbers: _Numbers = {
        "thresholds": model.thresholds,
        "weights": model.weights,
        "bias": model.bias,
        "envelopes": np.array([[*each, *each.ends()] for each in (model.falling, model.rising)]),
        **more,
    }
    if exact:
        # Source: of bench.models, one rounding below 1.
        numbers["edge"] = 1.0 - 1e-16 if real == "double" else float(np.nextafter(np.float32(1), np.float32(0)))
    template = "generalized_prandtl_ishlinskii.c.in"
    return _elements(model, starts, template, {"crosses": int(not model.ordered)}, numbers, rest, real, prefix, base)


def _maxwell(model: MaxwellSlip, starts: Starts, real: Real, prefix: str, base: str) -> Source:
    parts = parts_of("maxwell_slip.c.in")
    exact = isinstance(model.inverse(), BranchInverse)
    more, rest = _branch(model, real, parts["inverse"]) if exact else _numerical(model, real)
    numbers: _Numbers = {
        "slips": model.slips, "stiffnesses": model.stiffnesses, "spring": model.spring, "bias": model.bias,
        "origin": model.origin, **more,
    }  # fmt: skip
    return _elements(model, starts, "maxwell_slip.c.in", {}, numbers, rest, real, prefix, base)


def _polynomial_plays(model: PolynomialPlays, starts: Starts, real: Real, prefix: str, base: str) -> Source:
    more, rest = _numerical(model, real)
    low, high = model.input_range
    numbers: _Numbers = {
        "thresholds": model.thresholds, "weights": model.weights, "coefficients": model.series, "bias": model.bias,
        "middle": 0.5 * (low + high), "half": 0.5 * (high - low), **more,
    }  # fmt: skip
    words = {"powers": model.powers, "degree": model.series.size}
    return _elements(model, starts, "polynomial_plays.c.in", words, numbers, rest, real, prefix, base)


def _bouc_wen(model: BoucWen, starts: Starts, real: Real, prefix: str, base: str) -> Source:
    more, rest = _numerical(model, real)
    parts = parts_of("bouc_wen.c.in")
    numbers: _Numbers = {
        "stiffness": model.stiffness, "hysteretic": model.hysteretic, "bias": model.bias, "scale": model.scale,
        "origin": model.origin, "loading": model.beta + model.gamma, "unloading": model.gamma - model.beta,
        # Source: the limit of bench.models.
        "limit": 1e6, **more,
    }  # fmt: skip
    exact = model.exponent == 1.0
    if exact:
        numbers["INFINITE"] = _INFINITE
    else:
        # Source: the tolerances of bench.models, in float as much more as its rounding.
        allowed, rest_rate = (1e-11, 1e-13) if real == "double" else (1e-7, 1e-6)
        numbers |= {"exponent": model.exponent, "allowed": allowed, "rest": rest_rate, "near": 1e-4, "left": 2e-4}
    # Source: the order of the series of bench.models.
    words = {"steps": _STEPS, "order": 10, "solution": parts["exponential" if exact else "integrated"]}
    step = "two exponentials" if exact else f"at most {_STEPS} steps of integration"
    return _elements(model, starts, "bouc_wen.c.in", words, numbers, rest, real, prefix, base, step=step)


def _duhem(model: Duhem, starts: Starts, real: Real, prefix: str, base: str) -> Source:
    more, rest = _numerical(model, real)
    numbers: _Numbers = {"weights": model.coefficients, "rate": model.rate, "bias": model.bias, **more}
    # As many as three times the range takes, whose width is 2.
    parts = math.ceil(3 * 2 * max(model.rate, 1.0) / 0.5)
    words = {"degree": model.degree, "parts": parts}
    step = f"at most {parts} parts of 8 nodes on each side of an end of the range and {2 * model.degree} elements"
    return _elements(model, starts, "duhem.c.in", words, numbers, rest, real, prefix, base, step=step)


_WRITERS: Mapping[type[Any], Callable[[Any, Starts, Real, str, str], Source]] = {
    Preisach: _preisach,
    PrandtlIshlinskii: _plays,
    GeneralizedPrandtlIshlinskii: _generalized,
    MaxwellSlip: _maxwell,
    PolynomialPlays: _polynomial_plays,
    BoucWen: _bouc_wen,
    Duhem: _duhem,
}
