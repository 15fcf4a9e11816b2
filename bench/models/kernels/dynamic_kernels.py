"""Compiled loops of models with time. Imported on first use only, because numba is slow to load."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.base import Table, kernel
from bench.models.kernels import memory_kernels as memory

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@kernel
def delayed(columns: Table, rows: Integers, shares: Floats, gain: float) -> Floats:
    """Return `gain` times columns at delayed moments, shape (P, K), as straight lines between samples.

    Parameters
    ----------
    columns : ndarray, shape (N, K)
        One column an input.
    rows : ndarray of int64, shape (P,)
        The sample before each moment; -1 before the first.
    shares : ndarray, shape (P,)
        Part of the step after that sample.
    """
    samples, count = columns.shape
    result = np.empty((rows.size, count))
    for p in range(rows.size):
        before = max(rows[p], 0)
        after = min(rows[p] + 1, samples - 1)
        for k in range(count):
            result[p, k] = gain * (columns[before, k] + shares[p] * (columns[after, k] - columns[before, k]))
    return result


@kernel
def respond(
    columns: Table,
    passages: Table,
    rows: Integers,
    late: Table,
    strength: float,
    off: Floats,
    rate: Floats,
    result: Table,
) -> None:
    """Add by how much columns behind 1 / (1 + a1 s + a2 s²) are off their inputs, `strength` times.

    Exact for inputs that are linear between samples. The sums over the steps are compensated (Kahan, Commun. ACM 8,
    40, 1965), as slow creep moves by little in a step.

    Parameters
    ----------
    columns : ndarray, shape (N, K)
        One column an input.
    passages : ndarray, shape (N - 1, 6)
        How each step is passed, see `linear_parts.passages`.
    rows : ndarray of int64, shape (P,)
        The sample before each moment at which an output is wanted, in increasing order; -1 before the first.
    late : ndarray, shape (P, 6)
        How the time since that sample is passed.
    strength : float
        Factor.
    off, rate : ndarray, shape (K,)
        State at the first sample, and at the last on return: value less input, and rate.
    result : ndarray, shape (P, K)
        To which it is added.
    """
    samples, count = columns.shape
    lost = np.zeros(count)
    wanted = 0
    while wanted < rows.size and rows[wanted] < 0:
        for k in range(count):
            result[wanted, k] += strength * off[k]
        wanted += 1
    for n in range(samples):
        last = n == samples - 1
        while wanted < rows.size and rows[wanted] == n:
            leave, turn, behind = late[wanted, 0], late[wanted, 1], late[wanted, 2]
            for k in range(count):
                rise = 0.0 if last else columns[n + 1, k] - columns[n, k]
                turned = turn * rate[k] - leave * off[k] - behind * rise - lost[k]
                result[wanted, k] += strength * (off[k] + turned)
            wanted += 1
        if last:
            break
        leave, turn, behind = passages[n, 0], passages[n, 1], passages[n, 2]
        slope, pull, hold = passages[n, 3], passages[n, 4], passages[n, 5]
        for k in range(count):
            rise = columns[n + 1, k] - columns[n, k]
            before = off[k]
            turned = turn * rate[k] - leave * before - behind * rise - lost[k]
            rate[k] = slope * rise + pull * before + hold * rate[k]
            off[k] = before + turned
            lost[k] = (off[k] - before) - turned


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
