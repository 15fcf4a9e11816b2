"""Compiled loops of models with time. Imported on first use only, because numba is slow to load."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.base import Table, kernel
from bench.models.kernels import memory_kernels as memory

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@kernel
def filtered(
    columns: Table,
    steps: Floats,
    lag: float,
    free: Table,
    rows: Integers,
    offsets: Floats,
    late: Table,
    value: Floats,
    rate: Floats,
) -> Floats:
    """Return columns behind 1 / (1 + lag s + a2 s²), exact for inputs that are linear between samples.

    On a ramp of slope m the forced part is v - lag m; what is left decays freely. `value` and `rate`, shape (K,), are
    the filter's state at the first sample, and at the last on return.

    Parameters
    ----------
    columns : ndarray, shape (N, K)
        One column an input.
    steps : ndarray, shape (N - 1,)
        s.
    lag : float
        s.
    free : ndarray, shape (N - 1, 4)
        Free evolution of (value, rate) over each step, row by row.
    rows : ndarray of int64, shape (P,)
        The sample after which an output is wanted, in increasing order; -1 before the first.
    offsets : ndarray, shape (P,)
        How long after that sample, s.
    late : ndarray, shape (P, 2)
        First row of the free evolution over each offset.
    value, rate : ndarray, shape (K,)
        State, input units and input units / s.
    """
    samples, count = columns.shape
    result = np.empty((rows.size, count))
    wanted = 0
    while wanted < rows.size and rows[wanted] < 0:
        for k in range(count):
            result[wanted, k] = value[k]
        wanted += 1
    for n in range(samples):
        last = n == samples - 1
        while wanted < rows.size and rows[wanted] == n:
            for k in range(count):
                slope = 0.0 if last else (columns[n + 1, k] - columns[n, k]) / steps[n]
                left = value[k] - columns[n, k] + lag * slope
                forced = columns[n, k] + slope * (offsets[wanted] - lag)
                result[wanted, k] = forced + late[wanted, 0] * left + late[wanted, 1] * (rate[k] - slope)
            wanted += 1
        if last:
            break
        for k in range(count):
            slope = (columns[n + 1, k] - columns[n, k]) / steps[n]
            left, more = value[k] - columns[n, k] + lag * slope, rate[k] - slope
            value[k] = columns[n + 1, k] - lag * slope + free[n, 0] * left + free[n, 1] * more
            rate[k] = slope + free[n, 2] * left + free[n, 3] * more
    return result


@kernel
def oscillate(inputs: Table, steps: Floats, parameters: Floats, state: Floats, outputs: Floats) -> bool:
    """Integrate m y'' + c y' + k y + z = u, z' = a y' - b |y'| z - d y' |z| by Runge and Kutta's method of order 4.

    Parameters
    ----------
    inputs : ndarray, shape (N - 1, 2 S + 1)
        Input at the ends and middles of the S substeps of each step.
    steps : ndarray, shape (N - 1,)
        s.
    parameters : ndarray, shape (6,)
        m, c, k, a, b, d.
    state : ndarray, shape (3,)
        y, y' and z at the first sample, and at the last on return.
    outputs : ndarray, shape (N,)
        y at the samples; written.

    Returns
    -------
    Whether it stayed finite; outputs from there on are those of the last sample before.
    """
    m, c, k, a, b, d = parameters
    y, v, z = state
    substeps = (inputs.shape[1] - 1) // 2
    outputs[0] = y
    for n in range(steps.size):
        h = steps[n] / substeps
        for s in range(substeps):
            u0, u1, u2 = inputs[n, 2 * s], inputs[n, 2 * s + 1], inputs[n, 2 * s + 2]
            v1 = v
            f1 = (u0 - c * v - k * y - z) / m
            g1 = a * v - b * abs(v) * z - d * v * abs(z)
            v2 = v + 0.5 * h * f1
            z2 = z + 0.5 * h * g1
            f2 = (u1 - c * v2 - k * (y + 0.5 * h * v1) - z2) / m
            g2 = a * v2 - b * abs(v2) * z2 - d * v2 * abs(z2)
            v3 = v + 0.5 * h * f2
            z3 = z + 0.5 * h * g2
            f3 = (u1 - c * v3 - k * (y + 0.5 * h * v2) - z3) / m
            g3 = a * v3 - b * abs(v3) * z3 - d * v3 * abs(z3)
            v4 = v + h * f3
            z4 = z + h * g3
            f4 = (u2 - c * v4 - k * (y + h * v3) - z4) / m
            g4 = a * v4 - b * abs(v4) * z4 - d * v4 * abs(z4)
            y += h * (v1 + 2.0 * v2 + 2.0 * v3 + v4) / 6.0
            v += h * (f1 + 2.0 * f2 + 2.0 * f3 + f4) / 6.0
            z += h * (g1 + 2.0 * g2 + 2.0 * g3 + g4) / 6.0
        if not (abs(y) < 1e100 and abs(v) < 1e100 and abs(z) < 1e100):
            outputs[n + 1 :] = outputs[n]
            return False
        outputs[n + 1] = y
    state[0], state[1], state[2] = y, v, z
    return True


@kernel
def oscillate_on_plane(
    inputs: Table,
    steps: Floats,
    parameters: Floats,
    plane: memory.Plane,
    below: Floats,
    terms: memory.Terms,
    pieces: memory.Pieces,
    count: int,
    state: Floats,
    outputs: Table,
) -> tuple[int, bool]:
    """Integrate m y'' + c y' + F[y] = u, F a Preisach operator, by the leapfrog method (Störmer and Verlet).

    The memory moves with each substep: the method needs the force at y alone, once a substep.

    Parameters
    ----------
    inputs : ndarray, shape (N - 1, S + 1)
        Input at the ends of the S substeps of each step.
    steps : ndarray, shape (N - 1,)
        s.
    parameters : ndarray, shape (3,)
        m, c and the operator's offset.
    plane, below, terms
        The operator's `Lattice`.
    pieces, count
        The memory and its number of pieces, with room for two more each substep; written.
    state : ndarray, shape (2,)
        y and y' at the first sample, and at the last on return.
    outputs : ndarray, shape (N, 3)
        y, y' and F[y] at the samples; written.

    Returns
    -------
    The number of pieces, and whether it stayed finite; outputs from there on are those of the last sample before.
    """
    m, c, offset = parameters
    y, v = state
    low, high = plane[0][0], plane[0][-1]
    present = min(max(y, low), high)
    cell, mass = memory.load(plane, pieces, count, present)
    force = memory.output_at(plane, below, offset, terms, y, present, cell, mass)
    outputs[0, 0], outputs[0, 1], outputs[0, 2] = y, v, force
    substeps = inputs.shape[1] - 1
    for n in range(steps.size):
        half = 0.5 * steps[n] / substeps
        for s in range(substeps):
            # Damping is implicit in the first half of a step, explicit in the second: the method stays symmetric.
            middle = (v + half * (inputs[n, s] - force) / m) / (1.0 + half * c / m)
            y += 2.0 * half * middle
            if not abs(y) < 1e100 or count + 2 > pieces[0].size:
                for later in range(n + 1, outputs.shape[0]):
                    for i in range(3):
                        outputs[later, i] = outputs[n, i]
                return count, False
            u = min(max(y, low), high)
            count, cell, mass = memory.move(plane, pieces, count, present, cell, mass, u)
            present = u
            force = memory.output_at(plane, below, offset, terms, y, present, cell, mass)
            v = middle * (1.0 - half * c / m) + half * (inputs[n, s + 1] - force) / m
        outputs[n + 1, 0], outputs[n + 1, 1], outputs[n + 1, 2] = y, v, force
    state[0], state[1] = y, v
    return count, True
