"""The Bouc-Wen benchmark of Noël and Schoukens (2016), simulated from its published equations.

The plant is integrated by Newmark's method at 15 kHz, low-pass filtered and decimated to 750 Hz, as published; the
models are integrated by another method. Scores are the RMS of the simulation error in dB relative to 1 m.
"""

import numpy as np
import pytest
from numba import njit
from rich.console import Console
from rich.table import Table
from scipy.signal import decimate

from bench.identification import identify_in_time

pytestmark = pytest.mark.benchmark

RATE, UP = 750.0, 20
PERIOD = 8192
PUBLISHED = {
    "gr-SS-NN (arXiv 2507.09646)": -102.5,
    "polynomial state space, 217 parameters (arXiv 1610.09138)": -98.3,
    "Koopman, 100 observables (arXiv 2507.09646)": -96.9,
    "linear, subspace, order 3": -75.6,
}


@njit
def newmark(u, dt, periods):
    """Return displacements by the average acceleration method with Newton's iteration; z by the trapezoidal rule."""
    m, c, k, alpha, beta, gamma, delta = 2.0, 10.0, 5e4, 5e4, 1e3, 0.8, -1.1
    y = v = z = 0.0
    a = u[0] / m
    out = np.empty(u.size)
    for period in range(periods):
        for n in range(u.size):
            if n == 0 and period == 0:
                out[0] = y
                continue
            rate = alpha * v - beta * (gamma * abs(v) * z + delta * v * abs(z))
            new, force = a, z
            for _ in range(50):
                speed = v + 0.5 * dt * (a + new)
                place = y + dt * v + 0.25 * dt * dt * (a + new)
                # The trapezoidal rule for z, solved for each branch of sign by a fixed point.
                for _ in range(50):
                    later = alpha * speed - beta * (gamma * abs(speed) * force + delta * speed * abs(force))
                    next_force = z + 0.5 * dt * (rate + later)
                    moved = abs(next_force - force)
                    force = next_force
                    if moved < 1e-12:
                        break
                residual = m * new + c * speed + k * place + force - u[n]
                change = residual / (m + 0.5 * dt * c + 0.25 * dt * dt * (k + alpha))
                new -= change
                if abs(change) < 1e-11:
                    break
            y, v, z, a = place, speed, force, new
            out[n] = y
    return out


def multisine(rng):
    """Return one period of a random-phase multisine, 5 to 150 Hz at 50 N RMS, at 15 kHz."""
    spectrum = np.zeros(PERIOD * UP // 2 + 1, dtype=complex)
    lines = np.arange(PERIOD // 2 + 1) * RATE / PERIOD
    used = np.flatnonzero((lines >= 5.0) & (lines <= 150.0))
    spectrum[used] = np.exp(2j * np.pi * rng.random(used.size))
    u = np.fft.irfft(spectrum, PERIOD * UP)
    return 50.0 * u / np.sqrt(np.mean(u**2))


def steady(u):
    """Return input and displacement of a steady period at 750 Hz."""
    y = newmark(u, 1.0 / (RATE * UP), 4)
    spectrum = np.fft.rfft(y)[: PERIOD // 2 + 1]
    spectrum[-1] = 0.0
    return u[::UP].copy(), np.fft.irfft(spectrum, PERIOD) / UP


def sweep():
    """Return time, input and displacement of the sweep of ±40 N, 20 to 50 Hz at 10 Hz/min, from rest, at 750 Hz."""
    count = 153_000
    t = np.arange(count * UP) / (RATE * UP)
    u = 40.0 * np.sin(2.0 * np.pi * (20.0 * t + 0.5 * (10.0 / 60.0) * t**2))
    # The published sweep ends at 50 Hz, after 180 s.
    u[t > 180.0] = 0.0
    y = newmark(u, 1.0 / (RATE * UP), 1)
    return t[::UP].copy(), u[::UP].copy(), decimate(y, UP, n=20 * UP * 5, ftype="fir")


def decibels(error):
    return 20.0 * np.log10(np.sqrt(np.mean(error**2)))


def test_oscillator_beats_every_published_score():
    rng = np.random.default_rng(0)
    u, clean = steady(multisine(rng))
    times = np.arange(PERIOD) / RATE
    measured = clean + rng.normal(0.0, 8e-6, PERIOD)
    found = identify_in_time("bouc-wen-oscillator", times, u, measured, input_unit="N", output_unit="m")
    model = found.model
    on_plane = identify_in_time("preisach-oscillator", times, u, measured, input_unit="N", output_unit="m")
    assert found.initial_state == "periodic"
    u, y = steady(multisine(rng))
    on_multisine = decibels(y - model.evaluate(times, u, "periodic"))
    plane_on_multisine = decibels(y - on_plane.model.evaluate(times, u, "periodic"))
    t, u, y = sweep()
    on_sweep = decibels(y - model.evaluate(t, u))
    table = Table("model", "multisine / dB", "sweep / dB", title="Bouc-Wen benchmark")
    table.add_row("bench: bouc-wen-oscillator, 7 parameters", f"{on_multisine:.1f}", f"{on_sweep:.1f}")
    plane_on_sweep = decibels(y - on_plane.model.evaluate(t, u))
    name = f"bench: preisach-oscillator, {on_plane.certificate.passive} parameters"
    table.add_row(name, f"{plane_on_multisine:.1f}", f"{plane_on_sweep:.1f}")
    for name, score in PUBLISHED.items():
        table.add_row(name, f"{score:.1f}", "")
    Console(width=110).print(table)
    for name, (value, unit) in model.parameters().items():
        print(f"{name:22} {value:12.6g} {unit}")
    assert on_multisine <= -120.0
    assert on_sweep <= -105.0
    # Loops of this plant drift, which a Preisach force cannot follow; it still does better than a linear oscillator.
    assert plane_on_multisine < PUBLISHED["linear, subspace, order 3"]
