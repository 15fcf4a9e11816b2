"""Third-order dynamics of a resonant actuator: the model, and its identification from a measured step.

Source: Ljung, "System Identification: Theory for the User", 2nd ed. 1999: prediction error method with an output
error structure. White noise is added to the output of the sensor, so that the best prediction is the simulation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bench.base import Floats, checks as _checks
from bench.identification.fit.variable_projection import End, Evidence, Separable, Stage, variable_projection
from bench.identification.measures import Errors, measure_errors

Complexes: TypeAlias = NDArray[np.complex128]

# Points per period, and per time constant, at which a step response is searched for its peak, and time constants that
# are searched. Derivation: between two of 40 points of a period a sine changes by 16 % of its amplitude, 2 π / 40, at
# most; after five time constants less than 1 % of a mode is left.
_RESOLUTION, _SETTLED = 40, 5.0
# Least ratio of a resonance to the median of the spectrum. Derivation: amplitudes of noise follow Rayleigh's law, by
# which one exceeds x times their median with the probability 2^(-x²): here 2^-100.
_PROMINENCE = 10.0
# A pole of greater relative standard uncertainty counts as not identified. Derivation: two standard deviations then
# are half of it.
_UNKNOWN = 0.25
# Fewest samples after the step, and range of the search for the delay about the first that differ, in samples.
# Source: a choice; eight numbers are fitted to the samples, and the threshold of noise finds the beginning early by
# chance or late on a slow response.
_LEAST = 50
_EARLIER, _LATER = 4, 2
# A search for the poles and the delay. Derivation: an exact record is followed down to the rounding of its numbers,
# 1e-16, but for two digits.
_SEARCH = Stage(1, 1e-14, 400)


@dataclass(frozen=True)
class ThirdOrder:
    """A stable linear system with one real pole, one pair of complex poles, and up to two zeros.

    D(s) = gain (1 + n1 s + n2 s²) / ((1 + s/p) (1 + 2 ζ s/ω + s²/ω²))

    Parameters
    ----------
    gain : float
        D(0), output per input units, not 0.
    real_pole : float
        p, rad/s.
    frequency : float
        Natural frequency ω of the pair, rad/s.
    damping : float
        Its damping ratio ζ, between 0 and 1.
    numerator : tuple of float
        n1 in s and n2 in s².

    Raises
    ------
    ValueError
        If a number is not finite, the gain 0, a pole not stable or the damping not in (0, 1).
    """

    gain: float
    real_pole: float
    frequency: float
    damping: float
    numerator: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("gain", "real_pole", "frequency", "damping"):
            check = _checks.number if name == "gain" else _checks.positive
            object.__setattr__(self, name, check(name, getattr(self, name)))
        if not self.damping < 1.0:
            raise ValueError(f"damping: expected less than 1, got {self.damping}; the pair of poles is complex")
        if self.gain == 0.0:
            raise ValueError("gain: expected a number other than 0")
        numerator = _checks.samples("numerator", self.numerator)
        if numerator.size != 2:
            raise ValueError(f"numerator: expected n1 and n2, got {numerator.size} values")
        object.__setattr__(self, "numerator", (float(numerator[0]), float(numerator[1])))

    @property
    def poles(self) -> Complexes:
        """The real pole, then the pair with the positive imaginary part first, rad/s, shape (3,)."""
        real, imaginary = -self.damping * self.frequency, self.frequency * math.sqrt(1.0 - self.damping**2)
        return np.array([-self.real_pole, complex(real, imaginary), complex(real, -imaginary)])

    @property
    def zeros(self) -> Complexes:
        """The zeros, rad/s, shape (0,) to (2,)."""
        return np.roots([self.numerator[1], self.numerator[0], 1.0]).astype(np.complex128)

    def normalised(self) -> ThirdOrder:
        """Return D(s) / D(0)."""
        return replace(self, gain=1.0)

    @property
    def _modes(self) -> tuple[Complexes, Complexes]:
        """Poles and residues of the real mode and of one of the pair, whose other is its conjugate, shape (2,)."""
        poles = self.poles
        pair = poles[:2]
        numerator = self.gain * self.real_pole * self.frequency**2 * np.polyval([*self.numerator[::-1], 1.0], pair)
        others = np.array([(pair[0] - poles[1]) * (pair[0] - poles[2]), (pair[1] - poles[0]) * (pair[1] - poles[2])])
        return pair, numerator / others

    def response(self, frequencies: ArrayLike) -> Complexes:
        """Return D(j 2π f) for frequencies in Hz, shape (N,)."""
        s = 2j * math.pi * _checks.samples("frequencies", frequencies)
        pair = 1.0 + 2.0 * self.damping * s / self.frequency + (s / self.frequency) ** 2
        return np.asarray(
            self.gain * np.polyval([*self.numerator[::-1], 1.0], s) / ((1.0 + s / self.real_pole) * pair)
        )

    def step_response(self, times: ArrayLike) -> Floats:
        """Return the response to a unit step at time 0, shape (N,); 0 before it."""
        t = _checks.samples("times", times)
        poles, residues = self._modes
        rise = np.expm1(poles * np.maximum(t, 0.0)[:, None]) * (residues / poles)
        return np.asarray(rise[:, 0].real + 2.0 * rise[:, 1].real)

    def overshoot(self) -> float:
        """Return by how much the step response exceeds its final value, as a share of it; 0 if it does not."""
        from scipy.optimize import minimize_scalar

        slowest = min(self.real_pole, self.damping * self.frequency)
        step = 1.0 / (_RESOLUTION * max(self.frequency / (2.0 * math.pi), self.real_pole))
        times = np.arange(0.0, _SETTLED / slowest + step, step)
        top = int(np.argmax(self.step_response(times) / self.gain))
        near = times[max(top - 1, 0)], times[min(top + 1, times.size - 1)]
        best = minimize_scalar(
            lambda t: -float(self.step_response([t])[0] / self.gain),
            bounds=near,
            method="bounded",
            options={"xatol": 1e-12},
        )
        return max(-float(best.fun) - 1.0, 0.0)

    def bandwidth(self) -> float:
        """Return the first frequency at which the response has fallen by 3 dB, Hz."""
        from scipy.optimize import brentq

        def excess(logarithm: float) -> float:
            return float(abs(self.response([math.exp(logarithm)])[0] / self.gain) - math.sqrt(0.5))

        corners = [self.real_pole, self.frequency, *np.abs(self.zeros).tolist()]
        # Strictly proper: far above all corners the response falls, at least as 1/s.
        grid = np.arange(math.log(min(corners)) - 6.0, math.log(max(corners)) + 12.0, 0.02)
        below = np.abs(self.response(np.exp(grid)) / self.gain) < math.sqrt(0.5)
        first = int(np.argmax(below))
        return math.exp(brentq(excess, grid[first - 1], grid[first]))

    def simulate(self, inputs: ArrayLike, dt: float) -> Floats:
        """Return the outputs to inputs that are held for dt each, from rest, exactly.

        Output k, of N, is at time k dt, before input k has acted.

        Parameters
        ----------
        inputs : array_like, shape (N,)
            Number k is held from k dt to (k + 1) dt.
        dt : float
            Time step, s, > 0.

        Raises
        ------
        ValueError
            If an input is not finite or dt is not positive.
        """
        # scipy.signal would take a third of a second to load for its `lfilter`.
        from bench.identification.kernels.mode_kernels import held_response

        u = _checks.samples("inputs", inputs)
        poles, residues = self._modes
        factors, entries = np.exp(poles * _checks.positive("dt", dt)), np.expm1(poles * dt) / poles
        real, pair = (np.asarray(residues[k] * held_response(factors[k], entries[k], u)).real for k in range(2))
        return np.asarray(real + 2.0 * pair)

    def to_json(self) -> dict[str, Any]:
        """Return the model as a JSON object."""
        return {"type": "third-order", **asdict(self), "numerator": list(self.numerator)}

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> ThirdOrder:
        """Return the model that `to_json` wrote.

        Raises ValueError if a key is missing or wrong.
        """
        return cls(*[_checks.json_field(document, each.name, "third-order dynamics") for each in fields(cls)])


@dataclass(frozen=True, eq=False)
class DynamicsIdentification:
    """Third-order dynamics fitted to a step response, with the evidence for them.

    Parameters
    ----------
    model : ThirdOrder
        The fitted dynamics; its gain is in output per input units.
    offset : float
        Output before the step.
    delay : float
        Time from the step to the start of the response, s, >= 0.
    uncertainties : mapping of str to float
        Standard uncertainties of "real_pole", "frequency", "damping", "gain", "offset" and "delay" in their units,
        from the Jacobian and the variance of the residuals.
    residuals : ndarray, shape (N,)
        Measured minus simulated output.
    errors : Errors
        Error measures, output units.
    condition : float
        Condition number of the Jacobian with its columns scaled to unit norm.
    gradient : float
        Greatest cosine between the residuals and a column of the Jacobian; 0 is exact optimality. That of the delay
        is left out, as the best delay may be at a sample, where the cost has a corner.
    """

    model: ThirdOrder
    offset: float
    delay: float
    uncertainties: Mapping[str, float]
    residuals: Floats
    errors: Errors
    condition: float
    gradient: float


def identify_dynamics(inputs: ArrayLike, outputs: ArrayLike, dt: float) -> DynamicsIdentification:
    """Return the third-order dynamics that simulate a measured step response best in the least-squares sense.

    Gain, zeros and offset enter the response linearly and are eliminated (variable projection); the search is over
    the logarithms of real pole, natural frequency and damping, and over the delay. It starts from the data: the
    frequency is that of the highest peak of the tail's spectrum, the damping that of the tail's decay, the real
    pole the best on a grid of rates that the sampling can see, and the delay that of the first samples that differ.

    Within a sample, a delay and the zeros act alike on the response; below some 20 samples per period of the
    resonance, noise trades one for the other. The poles do not depend on that.

    Parameters
    ----------
    inputs : array_like, shape (N,)
        Held inputs with exactly one step; number k is held from sample k to sample k + 1.
    outputs : array_like, shape (N,)
        Samples; settled before the step.
    dt : float
        Sampling time, s.

    Raises
    ------
    ValueError
        If a sequence is wrong, there is not exactly one step, too few samples follow it, no resonance stands out,
        or a pole's relative standard uncertainty exceeds 25 %.
    """
    u = _checks.samples("inputs", inputs)
    y = _checks.counted("outputs", outputs, u.size, "values, one for each input")
    _checks.positive("dt", dt)
    changes = np.flatnonzero(np.diff(u)) + 1
    if changes.size != 1:
        raise ValueError(f"inputs: expected exactly one step, got {changes.size}")
    at = int(changes[0])
    if u.size - at < _LEAST:
        raise ValueError(f"inputs: expected at least {_LEAST} samples from the step on, got {u.size - at}")
    size = float(u[at] - u[at - 1])
    times: Floats = np.asarray(dt * (np.arange(u.size) - at), dtype=np.float64)
    frequency, decay = _tail(y[at:], dt)
    late = _onset(y, at)

    def parameters(x: Floats) -> tuple[float, float, float, float]:
        return math.exp(x[0]), math.exp(x[1]), math.exp(x[2]), dt * x[3]

    model_of = Separable(y, np.ones(y.size), lambda x: _columns(times, *parameters(x)))
    rates = np.geomspace(3.0 / times[-1], math.pi / dt, 40)
    starts = [
        np.array([math.log(rate), math.log(frequency), math.log(min(decay * factor / frequency, 0.5)), late])
        for rate in rates
        for factor in (0.5, 1.0, 2.0)
    ]
    start = min(starts, key=lambda x: float(np.sum(model_of.residuals(x) ** 2)))
    margin = np.array([math.log(20.0), math.log(1.2), math.log(20.0), 0.5])
    tries: list[End] = []
    # The response has a corner where it starts: the cost is smooth in the delay between two samples only.
    for interval in range(max(late - _EARLIER, 0), late + _LATER):
        start[3] = interval + 0.5
        low, high = start - margin, start + margin
        high[2] = min(high[2], math.log(0.9))
        tries += variable_projection(model_of, [start.copy()], (low, high), stages=[_SEARCH])
    end = min(tries, key=lambda each: each.cost)
    x, linear, rest = end.values, model_of.coefficients(end.values), end.residuals
    model = _assemble(*parameters(x)[:3], linear[:-1] / size)
    free = np.full(x.size, np.inf)
    columns = [model_of.slopes(x, -free, free), _columns(times, *parameters(x)), np.ones(y.size)]
    evidence = Evidence.of(np.column_stack(columns), rest, y.size - x.size - linear.size)
    deviations = evidence.deviations
    poor = [
        f"{name} (± {100.0 * deviation:.0f} %)"
        for name, deviation in zip(("real_pole", "frequency", "damping"), deviations, strict=False)
        if deviation > _UNKNOWN
    ]
    if poor:
        raise ValueError(f"outputs: the step response does not identify {', '.join(poor)}; take a greater step")
    return DynamicsIdentification(
        model=model,
        offset=float(linear[-1]),
        delay=dt * float(x[3]),
        uncertainties={
            "real_pole": model.real_pole * float(deviations[0]),
            "frequency": model.frequency * float(deviations[1]),
            "damping": model.damping * float(deviations[2]),
            "gain": float(deviations[4]) / abs(size),
            "offset": float(deviations[-1]),
            "delay": dt * float(deviations[3]),
        },
        residuals=rest,
        errors=measure_errors(y, y - rest),
        condition=evidence.condition,
        gradient=float(np.delete(evidence.cosines, 3).max()),
    )


def _columns(times: Floats, real_pole: float, frequency: float, damping: float, delay: float) -> Floats:
    """Return the columns of final value, real mode, and sine of the pair, shape (N, 3).

    The cosine of the pair is in the first and second, so that the response starts from 0.
    """
    t = np.maximum(times - delay, 0.0)
    envelope = np.exp(-damping * frequency * t)
    phase = frequency * math.sqrt(1.0 - damping**2) * t
    cosine = envelope * np.cos(phase)
    return np.column_stack([1.0 - cosine, np.exp(-real_pole * t) - cosine, envelope * np.sin(phase)])


def _assemble(real_pole: float, frequency: float, damping: float, amplitudes: Floats) -> ThirdOrder:
    """Return the system whose unit step response has these amplitudes: final value, real mode, sine."""
    final, real, sine = amplitudes.tolist()
    pole = frequency * complex(-damping, math.sqrt(1.0 - damping**2))
    residue = 0.5 * pole * complex(-(final + real), -sine)
    first = -real_pole * real
    # First over s + p, second over the pair: over the common denominator.
    slope, constant = 2.0 * residue.real, -2.0 * (residue * pole.conjugate()).real
    level = first * frequency**2 + constant * real_pole
    linear = 2.0 * damping * frequency * first + slope * real_pole + constant
    return ThirdOrder(
        level / (real_pole * frequency**2),
        real_pole,
        frequency,
        damping,
        (linear / level, (first + slope) / level),
    )


def _tail(outputs: Floats, dt: float) -> tuple[float, float]:
    """Return angular frequency and decay rate of the resonance in a step response, rad/s and 1/s."""
    window = np.hanning(outputs.size)
    spectrum = np.abs(np.fft.rfft(window * (outputs - outputs.mean())))
    spectrum[:4] = 0.0
    top = int(np.argmax(spectrum))
    if top + 1 >= spectrum.size or not spectrum[top] > _PROMINENCE * np.median(spectrum):
        raise ValueError("outputs: no resonance stands out of the noise after the step")
    # Parabola through the logarithms of the peak and its neighbours.
    left, middle, right = np.log(np.maximum(spectrum[top - 1 : top + 2], 1e-300))
    shift = 0.5 * (left - right) / (left - 2.0 * middle + right)
    frequency = 2.0 * math.pi * (top + float(shift)) / (outputs.size * dt)
    # Amplitudes of the demodulated halves: the tail's mean is taken off with whole periods.
    phases = np.exp(-1j * frequency * dt * np.arange(outputs.size))
    demodulated = phases * (outputs - np.mean(outputs[outputs.size // 2 :]))
    parts = np.array_split(np.arange(outputs.size), 8)
    amplitudes = np.array([abs(np.mean(np.hanning(p.size) * demodulated[p])) for p in parts])
    middles = dt * np.array([p.mean() for p in parts])
    # The squares weigh down amplitudes lost in the noise.
    slope = np.polyfit(middles, np.log(np.maximum(amplitudes, 1e-300)), 1, w=amplitudes)[0]
    return frequency, max(-float(slope), 0.1 / (outputs.size * dt))


def _onset(outputs: Floats, at: int) -> int:
    """Return the number of samples after the step until the outputs differ from those before it."""
    before = outputs[: at + 1]
    change = np.abs(outputs[at:] - before.mean())
    threshold = max(6.0 * float(before.std()), 0.005 * float(change.max()))
    return max(int(np.argmax(change > threshold)) - 1, 0)
