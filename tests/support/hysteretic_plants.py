"""Hysteretic plants whose equations are none of the models': Bouc-Wen, Duhem, Jiles-Atherton, and a butterfly."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Steps of the integration between two samples.
_SUBSTEPS = 8


def settled(plant: Callable[[Floats], Floats], inputs: Floats) -> Floats:
    """Return the outputs of a plant that was at both ends before."""
    before = np.array([0.0, 1.0, -1.0, 1.0, -1.0]) * np.abs(inputs).max()
    return plant(np.concatenate([before, inputs]))[before.size :]


def _path(inputs: Floats) -> tuple[Floats, Floats]:
    """Return inputs between samples and the index of each sample among them."""
    fine = [inputs[:1]]
    for a, b in pairwise(inputs):
        fine.append(a + (b - a) * np.arange(1, _SUBSTEPS + 1) / _SUBSTEPS)
    return np.concatenate(fine), np.arange(inputs.size) * _SUBSTEPS


def bouc_wen(inputs: Floats, start: float = 0.0) -> Floats:
    """Return 0.6 u + z with dz = du (1 - (0.7 + 0.5 sign(du z)) |z|^1.5 / 0.5^1.5)."""
    u, samples = _path(inputs)
    z, out = start, np.empty(u.size)
    out[0] = z
    for n in range(1, u.size):
        step = u[n] - u[n - 1]
        z += step * (1.0 - (0.5 + 0.5 * np.sign(step * z)) * (abs(z) / 0.3) ** 1.5)
        out[n] = z
    return 0.6 * inputs + out[samples]


def duhem(inputs: Floats, start: float = 0.0) -> Floats:
    """Return y of the Coleman-Hodgdon equation dy = 3 |du| (f(u) - y) + f'(u) du with f = tanh(2 u)."""
    u, samples = _path(inputs)
    y, out = start, np.empty(u.size)
    out[0] = y
    for n in range(1, u.size):
        step = u[n] - u[n - 1]
        f = np.tanh(2.0 * u[n])
        y += 3.0 * abs(step) * (f - y) + 0.4 * (1.0 - f * f) * step
        out[n] = y
    return out[samples]


def jiles_atherton(inputs: Floats, start: float = 0.0) -> Floats:
    """Return the magnetization of Jiles and Atherton 1986 with a = 0.25, k = 0.35, c = 0.15, α = 0.1, Ms = 1."""
    a, k, c, alpha = 0.25, 0.35, 0.15, 0.1
    h, samples = _path(inputs)
    m, out = start, np.empty(h.size)
    out[0] = m
    for n in range(1, h.size):
        step = h[n] - h[n - 1]
        x = (h[n] + alpha * m) / a
        small = abs(x) < 1e-3
        langevin = x / 3.0 if small else 1.0 / np.tanh(x) - 1.0 / x
        slope = (1.0 / 3.0 if small else 1.0 / x**2 - 1.0 / np.sinh(x) ** 2) / a
        side = 1.0 if step >= 0.0 else -1.0
        lag = langevin - m
        irreversible = lag / (side * k * (1.0 - c) - alpha * lag) if lag * side > 0.0 else 0.0
        m += step * ((1.0 - c) * irreversible + c * slope) / (1.0 - alpha * c * slope)
        out[n] = m
    return out[samples]


def butterfly(inputs: Floats, start: float = 0.0) -> Floats:
    """Return the square of the Duhem output and a small part of itself, as of a strain over a field."""
    polarization = duhem(inputs, start)
    return polarization**2 + 0.1 * polarization


PLANTS = {"bouc-wen": bouc_wen, "duhem": duhem, "jiles-atherton": jiles_atherton}


def through(extrema: list[float], samples: int) -> Floats:
    """Return inputs on straight ramps through extrema, equally far apart, shape (samples,)."""
    points = np.array(extrema)
    lengths = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(points)))])
    return np.asarray(np.interp(np.linspace(0.0, lengths[-1], samples), lengths, points))


def damped(samples: int, half_cycles: int = 24, reach: float = 1.0) -> Floats:
    """Return a damped oscillation about 0."""
    parts = reach * (1.0 - np.arange(half_cycles) / half_cycles)
    return through([-reach, *(parts * np.where(np.arange(half_cycles) % 2, -1.0, 1.0))], samples)


def random_reversals(rng: np.random.Generator, samples: int, turns: int = 40, reach: float = 1.0) -> Floats:
    """Return ramps between random targets, from a whole sweep on."""
    return through([-reach, reach, *rng.uniform(-reach, reach, turns)], samples)
