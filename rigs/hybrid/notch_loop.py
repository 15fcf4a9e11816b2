"""A fast loop for a resonant actuator with hysteresis: integral, notch, and inverse of the hysteresis."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bench.base import ConvergenceError, Floats, checks as _checks
from bench.control import Reference, Trace, check_positive
from bench.models import PrandtlIshlinskii
from rigs.hybrid.play_inverse import SampledPlayInverse


def notch(frequency: float, rate: float, zero_damping: float, pole_damping: float = 0.7) -> Floats:
    """Return a notch against a resonance as second-order section, b0, b1, b2, 1, a1, a2, for `sosfilt`.

    (s² + 2 zero_damping ω s + ω²) / (s² + 2 pole_damping ω s + ω²), by the bilinear transform, which is exact at
    ω (prewarping). The zeros take the place of the resonant poles, and constants pass unchanged.

    Parameters
    ----------
    frequency : float
        Natural frequency ω, rad/s, below half the rate.
    rate : float
        Sampling rate, Hz.
    zero_damping : float
        Damping ratio of the zeros, >= 0: that of the resonance.
    pole_damping : float
        Damping ratio of the poles, > 0.

    Raises
    ------
    ValueError
        If a number is out of its range.
    """
    if not 0.0 < _checks.number("frequency", frequency) < math.pi * _checks.number("rate", rate):
        raise ValueError(f"frequency: expected rad/s between 0 and pi times the rate {rate:g} Hz, got {frequency:g}")
    if not _checks.number("zero_damping", zero_damping) >= 0.0:
        raise ValueError(f"zero_damping: expected a number >= 0, got {zero_damping}")
    _checks.positive("pole_damping", pole_damping)
    # s/ω becomes c (z - 1)/(z + 1).
    c = 1.0 / math.tan(0.5 * frequency / rate)
    numerator, denominator = (
        np.array([c**2 + 2.0 * d * c + 1.0, 2.0 - 2.0 * c**2, c**2 - 2.0 * d * c + 1.0])
        for d in (zero_damping, pole_damping)
    )
    return np.asarray(np.concatenate([numerator, denominator]) / denominator[0])


@dataclass(frozen=True)
class NotchLoopParameters:
    """Settings of the loop.

    Parameters
    ----------
    rate : float
        Sampling rate, Hz; well above twice the resonance.
    integral : float
        Gain of the integral, 1/s.
    stroke : float
        Largest output of either sign, output units from rest.
    pole_damping : float
        Damping ratio of the poles that the notch puts in place of the resonance.

    Raises
    ------
    ValueError
        If a setting is not positive.
    """

    rate: float
    integral: float
    stroke: float
    pole_damping: float = 0.7

    def __post_init__(self) -> None:
        check_positive(self)


RESERVE = 0.05
"""Part of the stroke that is left to the loop: a fast step lacks the creep that the slow loops of a model contain.

Source: a piezo creeps by 1 to 2 % of a step in each decade of time (Physik Instrumente, *Piezo Technology*); three
decades lie between a step and the end of its hold.
"""
_JUDGED = RESERVE
"""Least step of the reference that is judged by its overshoot, as a part of the stroke.

Derivation: a smaller one is no more than the creep of the steps before it may be.
"""
_OVERSHOOT = 0.05
"""Overshoot of a step from which on the loop is not the one that was designed, which has none.

Derivation: poles damped by 0.69 overshoot by e^(−π 0.69 / √(1 − 0.69²)), 5 %; those of the notch are damped by 0.7.
"""
_LASTING = 0.5e-3
"""Time for which it lasts then, s; noise does not.

Derivation: ten samples at 20 kHz; noise that is independent from sample to sample stays on one side for so long once
in 2¹⁰ samples, and beyond the limit less often.
"""
_AT_THE_END = 0.05
"""Time at the end of the stroke after which the reference counts as out of reach, s.

Derivation: fifteen time constants of an integral of 300 1/s; a step that only passes the end is back by then.
"""


class NotchLoop:
    """A `SampledController` of one actuator at a rate that resolves its resonance.

    Only the integral acts on the reference: fed forward, a step would ring. The notch stands behind the integral and
    before the inverse, so that inverse and actuator together are linear to it. The first reading is the output;
    others are ignored. A missing reading holds the set-point.

    The loop watches itself: `update` raises `ConvergenceError` where a step overshoots, as it does with a sensor that
    lags or a line that delays, and where the actuator stays at the end of its stroke.

    Parameters
    ----------
    hysteresis : PrandtlIshlinskii
        Static output of the actuator.
    frequency, damping : float
        Natural frequency (rad/s) and damping ratio of the resonance.
    reference : callable
        Wanted output, output units from rest; its time starts at the first complete reading.
    parameters : NotchLoopParameters
        Settings of the loop.

    Raises
    ------
    ValueError
        If the resonance lies beyond half the rate, or the hysteresis has no inverse.
    """

    def __init__(
        self,
        hysteresis: PrandtlIshlinskii,
        frequency: float,
        damping: float,
        reference: Reference,
        parameters: NotchLoopParameters,
    ) -> None:
        p = parameters
        self._reference = reference
        self._inverse = SampledPlayInverse(hysteresis, p.stroke)
        self._gain = p.integral / p.rate
        section = notch(frequency, p.rate, damping, p.pole_damping).tolist()
        self._b0, self._b1, self._b2, _, self._a1, self._a2 = section
        self._s1 = self._s2 = 0.0
        self._integral = 0.0
        self._start = math.nan
        self._wanted = math.nan
        self._setpoint = self._inverse.input(0.0)
        self._measured = math.nan
        self._height = math.nan
        self._rate = p.rate
        self._beyond = self._stopped = 0

    @property
    def reach(self) -> tuple[float, float]:
        """Lowest and highest reference that the loop can hold, output units from rest; a reserve is left to it."""
        share = 1.0 - RESERVE
        return share * self._inverse.low, share * self._inverse.high

    def update(self, t: float, measured: tuple[float, ...]) -> tuple[float]:
        """Take the output (first of the readings) at a time (s) and return the set-point.

        Raises `ConvergenceError` if the loop does not do what it was designed for.
        """
        y = measured[0]
        if not math.isfinite(y):
            return (self._setpoint,)
        if math.isnan(self._start):
            self._start = t
        wanted = self._reference(t - self._start)
        if wanted != self._wanted:
            # The first reference is a start, not a step.
            self._height = 0.0 if math.isnan(self._wanted) else wanted - self._wanted
        self._wanted = wanted
        self._measured = y
        inverse = self._inverse
        # Held within the stroke, the integral does not wind up.
        x = self._integral + self._gain * (wanted - y)
        clipped = inverse.low if x < inverse.low else inverse.high if x > inverse.high else x
        self._watch(y - wanted, stopped=clipped != x)
        self._integral = x = clipped
        out = self._b0 * x + self._s1
        self._s1 = self._b1 * x - self._a1 * out + self._s2
        self._s2 = self._b2 * x - self._a2 * out
        self._setpoint = inverse.input(out)
        return (self._setpoint,)

    def _watch(self, error: float, *, stopped: bool) -> None:
        """Raise `ConvergenceError` if a step overshoots, or the actuator stays at the end of its stroke."""
        self._stopped = self._stopped + 1 if stopped else 0
        if self._stopped > _AT_THE_END * self._rate:
            raise ConvergenceError(
                f"the actuator is at the end of its stroke, {abs(error):.3g} short of the reference "
                f"{self._wanted:g}; the loop reaches {self.reach[0]:.3g} to {self.reach[1]:.3g}"
            )
        height = self._height
        if abs(height) < _JUDGED * (self._inverse.high - self._inverse.low):
            return
        overshoot = error / height
        self._beyond = self._beyond + 1 if overshoot > _OVERSHOOT else 0
        if self._beyond > _LASTING * self._rate:
            raise ConvergenceError(
                f"the output is {100.0 * overshoot:.1f} % beyond a step of {height:g}, for which the loop is "
                f"designed without overshoot (at most {100.0 * _OVERSHOOT:g} %): the sensor lags or the line delays "
                "by more than the loop bears, or the model is that of another specimen; lower its integral gain"
            )

    @property
    def trace(self) -> Trace:
        """State of the loop; the disturbance is the part of the output that the set-point does not explain."""
        return Trace(
            reference=self._wanted,
            predicted=self._measured,
            disturbance=self._measured - self._inverse.output,
        )
