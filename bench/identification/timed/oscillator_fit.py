"""Fit of a Bouc-Wen oscillator by output error: the simulated output against the measured one.

White noise on the output makes this the maximum-likelihood estimate (Ljung, "System Identification", 2nd ed. 1999,
section 7.4). The search starts without outside help: mass, damping and stiffness from a fit of the frequency response
(Sanathanan and Koerner, IEEE Trans. Automatic Control 8(1), 56-58, 1963), shares of the hysteresis from a grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats
from bench.identification.advice import Advice
from bench.identification.by_name import Identification
from bench.identification.fit.least_squares import Certificate, counted_weights
from bench.identification.fit.variable_projection import End, Evidence, Stage, variable_projection
from bench.identification.measures import measure_errors
from bench.models import BoucWenOscillator, Drive, Interpolation, Start, check_sequence, respond, substeps_for

# Shares of the small-amplitude stiffness that is hysteretic, and loop rate and shape in 1 / (3 RMS output). Source: a
# choice; three of each divide its range: a share is from 0 to 1, a rate is tried by factors of three, a shape on
# either side of none.
_SHARES, _RATES, _SHAPES = (0.3, 0.6, 0.9), (0.3, 1.0, 3.0), (-1.2, 0.0, 1.2)
# Searches with a coarse integration, and the one with the fine. Source: a choice; the coarse ones only lead to the
# valley; the fine one ends at the root of the rounding of a cost, 1e-8, but for two digits.
_COARSE, _FINE = Stage(4, 1e-10, 12), Stage(1, 1e-10, 100)
# Substeps of the integration in the end beside those of the first searches. Derivation: by the fourth order of the
# integration the coarser one errs 256 times as much.
_COARSER = 4
# Least part of the greatest input amplitude that a frequency needs to count in the start. Source: noise of 1 % of the
# range, which instruments here stay below, and a factor of two.
_EXCITED = 0.02
# Source: near the cube root of the rounding of a number, 6e-6, at which central differences err least (Press et al.,
# Numerical Recipes, 3rd ed. 2007, section 5.7).
_STEP = 1e-6
# Relative standard deviation from which a parameter counts as not identified. Derivation: two standard deviations
# then reach to 0.
_UNKNOWN = 0.5
_NAMES = ("mass", "damping", "stiffness", "hysteretic stiffness", "loop rate", "loop shape")


@dataclass(frozen=True, eq=False)
class _Simulation:
    """Residuals of the simulated output, the best offset taken off."""

    drive: Drive
    outputs: Floats
    roots: Floats
    scales: Floats

    def offset(self, values: Floats) -> tuple[float, Floats]:
        """Return the offset, and the residuals without it."""
        simulated, finite = respond(self.drive, values * self.scales, np.zeros(3))
        if not finite or np.abs(simulated).max() > 1e6 * np.ptp(self.outputs):
            return 0.0, np.full(simulated.size, 1e6 * float(np.ptp(self.outputs)))
        rest = self.outputs - simulated
        squares = self.roots**2
        mean = float(squares @ rest / squares.sum())
        return mean, rest - mean

    def residuals(self, values: Floats) -> Floats:
        return self.roots * self.offset(values)[1]


def identify_bouc_wen_oscillator(
    times: ArrayLike,
    inputs: ArrayLike,
    outputs: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    skip: int = 0,
    initial: str | None = None,
    orientation: str = "auto",
    interpolation: Interpolation = "smooth",
    input_unit: str = "",
    output_unit: str = "",
) -> Identification[BoucWenOscillator]:
    """Return the oscillator whose simulated output fits a measured sequence best in the least-squares sense.

    Parameters
    ----------
    times : array_like, shape (N,)
        s, strictly increasing; even if the sequence is periodic.
    inputs, outputs : array_like, shape (N,)
        The force, and the displacement that follows from it, or what stands for them.
    weights : array_like, shape (N,), or None
        Weight per sample, >= 0, such as the inverse variance of the noise; default 1.
    skip : int
        Number of first samples left out of the cost.
    initial : {"rest", "periodic"} or None
        Before the first sample: at rest, or the steady state of a sequence that repeats itself. None takes what fits
        better.
    orientation : "auto"
        The sign of the output follows from the data.
    interpolation : {"smooth", "linear", "held"}
        The input between samples.
    input_unit, output_unit : str
        Units, for labels.

    Raises
    ------
    ValueError
        If an option is wrong or the data are unfit.
    """
    clock, u, y, w, starts = check_record(times, inputs, outputs, weights, skip, initial)
    if orientation != "auto":
        raise ValueError(f"orientation: an oscillator finds it from the data; expected 'auto', got {orientation!r}")
    roots = np.sqrt(w)
    linear = linear_start(clock, u, y)
    substeps = substeps_for(np.array([*linear, 0.0, 0.0, 0.0]), clock)
    ends: dict[Start, tuple[_Simulation, End]] = {}
    for start in starts:
        try:
            drives = [
                Drive.of(clock, u, interpolation, number, periodic=start == "periodic")
                for number in (max(substeps // _COARSER, 1), substeps)
            ]
        except ValueError:
            if initial is not None:
                raise
            continue
        ends[start] = _fit(drives, y, roots, linear)
    start = min(ends, key=lambda each: ends[each][1].cost)
    simulation, end = ends[start]
    offset, _ = simulation.offset(end.values)
    found: list[float] = (end.values * simulation.scales).tolist()
    mass, damping, stiffness, hysteretic, rate, shape = found
    model = BoucWenOscillator(
        mass=mass,
        damping=damping,
        stiffness=stiffness,
        hysteretic_stiffness=hysteretic,
        loop_rate=rate,
        loop_shape=shape,
        offset=offset,
        input_range=(float(u.min()), float(u.max())),
        interpolation=interpolation,
        input_unit=input_unit,
        output_unit=output_unit,
    )
    predicted = model.evaluate(clock, u, start)
    evidence = Evidence.of(end.jacobian, end.residuals, int(np.count_nonzero(roots)) - 7)
    deviations = evidence.deviations * np.abs(simulation.scales)
    poor = [
        name
        for name, value, deviation in zip(_NAMES, found, deviations.tolist(), strict=True)
        if not deviation < _UNKNOWN * abs(value)
    ]
    advice = []
    if poor:
        remedy = "give a record with a greater amplitude, or with several"
        advice.append(Advice("parameters-unknown", f"the data do not determine {', '.join(poor)}", remedy))
    if substeps_for(model.vector, clock) > 1.5 * substeps:
        text = "the time step is long for the oscillation that was found"
        advice.append(Advice("long-step", text, "sample faster"))
    return Identification(
        model_name="bouc-wen-oscillator",
        model=model,
        residuals=y - predicted,
        errors=measure_errors(y[skip:], predicted[skip:]),
        uncertainties=deviations,
        certificate=Certificate(
            kkt_residual=float(evidence.cosines.max()),
            passive=7,
            active=0,
            exchangeable=0,
            condition=evidence.condition,
            swept=np.ones(7, dtype=bool),
            iterations=end.evaluations,
            converged=end.converged,
        ),
        skip=skip,
        initial_state=start,
        advice=tuple(advice),
    )


def _fit(drives: Sequence[Drive], outputs: Floats, roots: Floats, linear: Floats) -> tuple[_Simulation, End]:
    """Return the finer simulation and the end of the best search, which starts with the coarser one."""
    size = 3.0 * float(outputs.std())
    mass, damping, stiffness = linear.tolist()
    scales = np.array([mass, damping, stiffness, stiffness, 1.0 / size, 1.0 / size])
    coarse, fine = (_Simulation(drive, outputs, roots, scales) for drive in drives)
    grid = [
        # What the hysteresis dissipates is no longer the damper's.
        np.array([1.0, 0.5, 1.0 - share, share, rate, shape])
        for share, rate, shape in product(_SHARES, _RATES, _SHAPES)
    ]
    best = variable_projection(coarse.residuals, grid, stages=[_COARSE], step=_STEP, central=True)[0]
    return fine, variable_projection(fine.residuals, [best.values], stages=[_FINE], step=_STEP, central=True)[0]


def check_record(
    times: ArrayLike,
    inputs: ArrayLike,
    outputs: ArrayLike,
    weights: ArrayLike | None,
    skip: int,
    initial: str | None,
) -> tuple[Floats, Floats, Floats, Floats, tuple[Start, ...]]:
    """Return times, inputs, outputs and weights (0 for what is skipped), shape (N,), and the starts to be tried.

    Raises ValueError if they are no record that an oscillator can be identified from, or `initial` is unknown.
    """
    clock, u, y = check_sequence(times, inputs=inputs, outputs=outputs)
    if initial not in (None, "rest", "periodic"):
        raise ValueError(f"initial: expected 'rest', 'periodic' or None, got {initial!r}")
    if u.size - skip < 50:
        raise ValueError(f"inputs: expected at least 50 samples, got {u.size - skip}")
    if np.ptp(u) == 0.0 or np.ptp(y) == 0.0:
        raise ValueError("inputs and outputs: expected sequences that vary")
    starts: tuple[Start, ...] = ("rest", "periodic") if initial is None else (initial,)  # type: ignore[assignment]
    return clock, u, y, counted_weights(u.size, weights, skip), starts


def linear_start(times: Floats, inputs: Floats, outputs: Floats) -> Floats:
    """Return m, c and k of the linear oscillator that fits the spectra best, shape (3,).

    Raises ValueError if there is none.
    """
    even = np.linspace(times[0], times[-1], times.size)
    window = np.hanning(times.size)
    u, y = (np.interp(even, times, values) for values in (inputs, outputs))
    spectra = [np.fft.rfft(window * (values - values.mean())) for values in (u, y)]
    frequencies = 2.0 * np.pi * np.fft.rfftfreq(times.size, even[1] - even[0])
    used = (np.abs(spectra[0]) > _EXCITED * np.abs(spectra[0]).max()) & (frequencies > 0.0)
    s, force, motion = 1j * frequencies[used], spectra[0][used], spectra[1][used]
    if s.size < 3:
        raise ValueError("inputs: expected several frequencies, such as a sweep or a multisine")
    scale = float(np.abs(s).max())
    powers = np.column_stack([(s / scale) ** 2, s / scale, np.ones(s.size)])
    found = np.array([0.0, 0.0, 1.0])
    weight = np.ones(s.size)
    for _ in range(20):
        matrix = (motion * weight)[:, None] * powers
        target = force * weight
        found = np.linalg.lstsq(
            np.concatenate([matrix.real, matrix.imag]), np.concatenate([target.real, target.imag]), rcond=None
        )[0]
        weight = 1.0 / np.maximum(np.abs(powers @ found), 1e-12 * np.abs(found).max())
    mass, damping, stiffness = found[0] / scale**2, found[1] / scale, found[2]
    if mass == 0.0 or stiffness / mass <= 0.0:
        raise ValueError(
            "inputs and outputs: no oscillator fits their spectra; the output must be a displacement, and the inputs "
            "must pass the resonance"
        )
    # Noise may turn the sign of a small damping.
    damping = np.sign(mass) * max(abs(damping), 0.002 * float(np.sqrt(mass * stiffness)))
    return np.array([mass, damping, stiffness])
