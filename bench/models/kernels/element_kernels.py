"""Compiled loops over the elements of an operator. Imported on first use only, because numba is slow to load."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bench.base import Fixed, inlined, inner, kernel

Floats = NDArray[np.float64]

# Order of the series of one step of integration, and the error of the step as part of the scale. Source: measured; of
# the orders 6 to 14, 8 and 10 took the least time for 1e-10 to 1e-12. A search for the shape takes differences of
# 1e-6 of its parameters, whose slopes then are exact to 1e-5.
_ORDER, _TOLERANCE = 10, 1e-11
# Longest step, as part of the way to z = 0. Derivation: the solution has its nearest singularity there; within half
# of that way the terms of its series fall by half.
_REACH = 0.5
# Part of the slope that |z| takes away: below the first z is expanded about 0, until it is the second. Derivation:
# the expansion leaves out the cube, 8e-12 of z.
_NEAR, _LEFT = 1e-4, 2e-4
# Rate of the internal variable, as part of its scale, below which it has come to rest. Source: rounding of float64:
# the some 50 operations of a step err by no more than 50 times 1.1e-16, 6e-15.
_REST = 1e-13
# The internal variable is kept below this multiple of its scale: where it stiffens it would grow without end.
# Derivation: beside its square, 1e12, the 1 of the slope still counts to 2e-4.
_LIMIT = 1e6


@kernel
def tanh(values: Floats) -> Floats:
    """Return the hyperbolic tangent of each value by the C library, as exported C does; numpy's differs by 3 ulp."""
    result = np.empty(values.size)
    for k in range(values.size):
        result[k] = math.tanh(values[k])
    return result


@kernel
def stops(inputs: Floats, present: float, limits: Fixed, state: Floats) -> Floats:
    """Step stops through `inputs`; return their states sample by sample. `state` is changed."""
    result = np.empty((inputs.size, state.size))
    for t in range(inputs.size):
        move = inputs[t] - present
        for i in range(state.size):
            state[i] = max(-limits[i], min(limits[i], state[i] + move))
            result[t, i] = state[i]
        present = inputs[t]
    return result


@kernel
def ramps(inputs: Floats, rising: Floats, falling: Floats, width: float, state: Floats) -> Floats:
    """Step Krasnosel'skii-Pokrovskii kernels through `inputs`; return their states. `state` is changed.

    A kernel is lifted along the ramp from -1 at `rising` to 1 a width later, and lowered along that from -1 at
    `falling` to 1 a width later.
    """
    result = np.empty((inputs.size, state.size))
    for t in range(inputs.size):
        for k in range(state.size):
            low = max(-1.0, min(1.0, 2.0 * (inputs[t] - rising[k]) / width - 1.0))
            high = max(-1.0, min(1.0, 2.0 * (inputs[t] - falling[k]) / width - 1.0))
            state[k] = max(low, min(high, state[k]))
            result[t, k] = state[k]
    return result


@inlined
def _grown(rate: float, path: float) -> float:
    """Return (exp(rate path) - 1) / rate."""
    if abs(rate * path) < 1e-8:
        return path * (1.0 + 0.5 * rate * path)
    return math.expm1(rate * path) / rate


@inner
def _exponential(z: float, path: float, loading: float, unloading: float) -> float:
    """Return z, counted along the move, after a path with dz/dx = 1 - c |z|: the exact solution."""
    if z < 0.0:
        whole = 1.0 + unloading * z
        crossing = math.inf
        if whole > 0.0:
            argument = unloading * z
            crossing = -z if abs(argument) < 1e-8 else -math.log1p(argument) / unloading
            if abs(argument) < 1e-8:
                crossing = -z * (1.0 - 0.5 * argument)
        if path <= crossing:
            return z * math.exp(unloading * path) + _grown(unloading, path)
        path -= crossing
        z = 0.0
    return z * math.exp(-loading * path) + _grown(-loading, path)


@inlined
def _power(size: float, exponent: float) -> float:
    # A compiler of exported C takes a square for this power, which rounds otherwise.
    power: float = size * size if exponent == 2.0 else size**exponent
    return power


@inlined
def _path_to(z: float, c: float, exponent: float) -> float:
    """Return the path from 0 to a small z > 0 with dz/dx = 1 - c z^n."""
    part = c * _power(z, exponent)
    path: float = z * (1.0 + part / (exponent + 1.0) + part * part / (2.0 * exponent + 1.0))
    return path


@inlined
def _after(path: float, c: float, exponent: float) -> float:
    """Return z after a small path from 0 with dz/dx = 1 - c z^n."""
    part = c * _power(path, exponent) / (exponent + 1.0)
    z: float = path * (1.0 - part + exponent * (exponent + 1.0) / (2.0 * exponent + 1.0) * part * part)
    return z


@inner
def _integrated(
    z: float, path: float, loading: float, unloading: float, exponent: float, size: Floats, power: Floats
) -> float:
    """Return z, counted along the move, after a path with dz/dx = 1 - c |z|^n, by Taylor's series of |z|.

    `size` and `power` have room for the coefficients of |z|, and of |z|^n as parts of the first.
    """
    greatest = max(abs(loading), abs(unloading))
    if greatest == 0.0:
        return z + path
    power[0] = 1.0
    while path > 0.0:
        side, c = (1.0, loading) if z >= 0.0 else (-1.0, unloading)
        size[0] = abs(z)
        whole_power = _power(size[0], exponent)
        if greatest * whole_power < _NEAR:
            end = (_LEFT / greatest) ** (1.0 / exponent)
            place = path + side * _path_to(size[0], c, exponent)
            if place < 0.0:
                return -_after(-place, unloading, exponent)
            path = place - _path_to(end, loading, exponent)
            if path <= 0.0:
                return _after(place, loading, exponent)
            z = end
            continue
        taken = c * whole_power
        slope = 1.0 - taken
        # Of a sharp exponent the slope may overflow before z reaches its limit.
        if abs(slope) < _REST or z > _LIMIT or math.isinf(slope):
            return z
        # The series is in the share of this length.
        length = size[0] / max(1.0, abs(slope))
        size[1] = side * length * slope
        for k in range(1, _ORDER):
            total, factor = 0.0, exponent + 1.0 - k
            for j in range(1, k + 1):
                total += factor * size[j] * power[k - j]
                factor += exponent + 1.0
            power[k] = total / (k * size[0])
            size[k + 1] = -side * length * taken * power[k] / (k + 1)
        whole = path / length
        share = min(_REACH, whole)
        allowed = _TOLERANCE * max(1.0, size[0])
        while True:
            left = abs(size[_ORDER]) * share + abs(size[_ORDER - 1])
            for _ in range(1, _ORDER):
                left *= share
            if not left > allowed:
                break
            share *= 0.8
        after = size[_ORDER]
        for k in range(_ORDER - 1, -1, -1):
            after = after * share + size[k]
        z = side * after
        if share == whole:
            return z
        path -= share * length
    return z


@kernel
def bouc_wen(inputs: Floats, present: float, z: float, beta: float, gamma: float, exponent: float) -> Floats:
    """Return z after each input, where dz/du = 1 - |z|^n (beta sgn(z du) + gamma)."""
    result = np.empty(inputs.size)
    size, power = np.empty(_ORDER + 1), np.empty(_ORDER + 1)
    loading, unloading = beta + gamma, gamma - beta
    for t in range(inputs.size):
        move = inputs[t] - present
        if move != 0.0:
            sign = 1.0 if move > 0.0 else -1.0
            if exponent == 1.0:
                z = sign * _exponential(sign * z, abs(move), loading, unloading)
            else:
                z = sign * _integrated(sign * z, abs(move), loading, unloading, exponent, size, power)
            z = max(-_LIMIT, min(_LIMIT, z))
        present = inputs[t]
        result[t] = z
    return result


# Nodes and weights of Gauss and Legendre on [0, 1], exact to degree 15.
# Source: Abramowitz and Stegun, *Handbook of Mathematical Functions*, 1964, table 25.4, n = 8, halved.
_NODES = (
    0.019855071751231884,
    0.10166676129318664,
    0.2372337950418355,
    0.4082826787521751,
    0.5917173212478249,
    0.7627662049581645,
    0.8983332387068134,
    0.9801449282487681,
)
_WEIGHTS = (
    0.05061426814518813,
    0.11119051722668724,
    0.15685332293894363,
    0.18134189168918100,
    0.18134189168918100,
    0.15685332293894363,
    0.11119051722668724,
    0.05061426814518813,
)


@inlined
def _duhem_terms(x: float, terms: Floats, slopes: Floats) -> None:
    """Write T_0 ... T_n at `x`, beyond [-1, 1] `terms` by tangents and `slopes` by their values at the ends."""
    inside = min(max(x, -1.0), 1.0)
    slopes[0] = 1.0
    slopes[1] = inside
    for k in range(2, slopes.size):
        slopes[k] = 2.0 * inside * slopes[k - 1] - slopes[k - 2]
    for k in range(slopes.size):
        # T_k'(1) = k^2 and T_k'(-1) = (-1)^(k + 1) k^2, where T_k(-1) = (-1)^k.
        terms[k] = slopes[k] * (1.0 + k * k * (abs(x) - abs(inside)))


@inlined
def _leg_end(present: float, target: float) -> float:
    """Return the first end of [-1, 1] between two inputs, or the target: a curve bends at the ends."""
    if present < target:
        return min(target, -1.0) if present < -1.0 else (min(target, 1.0) if present < 1.0 else target)
    return max(target, 1.0) if present > 1.0 else (max(target, -1.0) if present > -1.0 else target)


@kernel
def duhem(inputs: Floats, present: float, rate: float, degree: int, state: Floats) -> Floats:
    """Step the elements of a Duhem operator through `inputs`; return their states. `state` is changed.

    The first `degree` elements follow T_1 ... T_degree of the input, dw/d|x| = rate (T - w), and the others take
    T_0 ... T_(degree - 1) up, dv/dx = T - rate sgn(dx) v. Beyond [-1, 1] the first are continued by their tangents
    and the others by their values at the ends.
    """
    result = np.empty((inputs.size, 2 * degree))
    terms = np.empty(degree + 1)
    slopes = np.empty(degree + 1)
    total = np.empty(2 * degree)
    for t in range(inputs.size):
        for _ in range(3):
            end = _leg_end(present, inputs[t])
            count = math.ceil(abs(end - present) * max(rate, 1.0) / 0.5)
            step = (end - present) / max(count, 1)
            decay = math.exp(-rate * abs(step))
            for part in range(count):
                start = present + part * step
                total[:] = 0.0
                for n in range(8):
                    _duhem_terms(start + _NODES[n] * step, terms, slopes)
                    left = _WEIGHTS[n] * math.exp(-rate * abs(step) * (1.0 - _NODES[n]))
                    for k in range(degree):
                        total[k] += left * rate * abs(step) * terms[k + 1]
                        total[degree + k] += left * step * slopes[k]
                for k in range(2 * degree):
                    state[k] = state[k] * decay + total[k]
            present = end
        result[t] = state
    return result
