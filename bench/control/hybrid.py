"""Mid-ranging control of a cantilever with a slow thermal part of long range and a fast piezo part of short range.

The controllers here are sampled: they are called at a fixed rate with all readings and return all set-points.
Units are SI; temperatures are in °C and a positive current heats. The thermal part is moved by heat that is fed
forward from the reference and fed back from the deflection that the thermal part is estimated to have. The piezo part
makes up the difference, through the inverse of its hysteresis, and so is driven back to the middle of its range.

Sources: Rakotondrabe and Ivan, "Development and dynamic modeling of a new hybrid thermo-piezoelectric
micro-actuator", IEEE Transactions on Robotics 26(6), 2010 (actuator and model); Allison and Isaksson, "Design and
performance of mid-ranging controllers", Journal of Process Control 8, 1998; Kuhnen, "Modeling, identification and
compensation of complex hysteretic nonlinearities", European Journal of Control 9, 2003 (inverse of the hysteresis);
Julier and Uhlmann, "Unscented filtering and nonlinear estimation", Proceedings of the IEEE 92, 2004.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from bench.control.tracking import Trace, check_positive
from bench.hysteresis import Polynomial, PrandtlIshlinskii, _checks
from bench.hysteresis._checks import Floats
from bench.identification.dynamics import notch
from bench.identification.hybrid_model import HybridModel
from bench.identification.thermal_network import ThermalNetwork

Reference: TypeAlias = Callable[[float], float]
"""Wanted deflection, m, at a time in s from the first complete reading; also before 0 and after the end."""

_ABSOLUTE_ZERO = -273.15
# Points at which the polynomial of the thermal deflection is tabulated for its inverse.
_TABLE = 2001


# References.


def _blend(x: float) -> float:
    """Return the part of the top speed reached after the part x of the blend: the minimum-jerk curve."""
    if x <= 0.0:
        return 0.0
    return x**3 * (10.0 + x * (6.0 * x - 15.0)) if x < 1.0 else 1.0


def _blended(x: float) -> float:
    """Return the integral of `_blend`."""
    if x <= 0.0:
        return 0.0
    return x**4 * (2.5 + x * (x - 3.0)) if x < 1.0 else x - 0.5


class SmoothMoves:
    """A reference that goes from position to position on S-curves of a given top speed, and holds at each.

    The speed rises to its top, and falls again, on minimum-jerk curves: position, speed and acceleration are
    continuous. A move so short that the top speed is not reached is the slower.

    Parameters
    ----------
    positions : sequence of float
        m; the first is where it starts, without a hold.
    speed : float
        Top speed, m/s.
    hold : float
        Time at each position but the first, s, >= 0.
    blend : float
        Time to the top speed, s.

    Raises
    ------
    ValueError
        If there are not two positions, one is not finite, or a number is out of range.
    """

    def __init__(self, positions: Sequence[float], speed: float, *, hold: float = 60.0, blend: float = 10.0) -> None:
        places = _checks.samples("positions", positions)
        if places.size < 2:
            raise ValueError(f"positions: expected at least 2, got {places.size}")
        if not (0.0 < speed < math.inf and 0.0 < blend < math.inf and 0.0 <= hold < math.inf):
            raise ValueError(
                "speed, blend, hold: expected positive numbers of m/s and s (hold may be 0), "
                f"got {speed}, {blend} and {hold}"
            )
        self._blend = blend
        self._places: list[float] = places.tolist()
        moves = np.diff(places)
        self._speeds: list[float] = (np.sign(moves) * speed).tolist()
        self._cruises: list[float] = (np.abs(moves) / speed).tolist()
        # A move takes what it would at top speed, and once the blend.
        ends = np.cumsum(np.abs(moves) / speed + blend + hold)
        self._starts: list[float] = [0.0, *ends.tolist()[:-1]]
        self.duration = float(ends[-1])
        """Time to the end of the last hold, s."""

    def _move(self, t: float) -> int:
        """Return the number of the move that has begun last at a time."""
        return max(bisect_right(self._starts, t) - 1, 0)

    def __call__(self, t: float) -> float:
        """Return the position at a time (s), m; before the start and after the end it rests."""
        k = self._move(t)
        x, cruise = (t - self._starts[k]) / self._blend, self._cruises[k] / self._blend
        if x >= cruise + 1.0:
            return self._places[k + 1]
        return self._places[k] + self._speeds[k] * self._blend * (_blended(x) - _blended(x - cruise))

    def rate(self, t: float) -> float:
        """Return the speed at a time (s), m/s."""
        k = self._move(t)
        x, cruise = (t - self._starts[k]) / self._blend, self._cruises[k] / self._blend
        return self._speeds[k] * (_blend(x) - _blend(x - cruise))

    def holding(self, t: float, settling: float = 0.0) -> bool:
        """Return whether a move has been over for a settling time (s) at a time."""
        k = self._move(t)
        return t - self._starts[k] >= self._cruises[k] + self._blend + settling


def staircase(
    low: float,
    high: float,
    steps: int,
    speed: float,
    *,
    start: float = 0.0,
    hold: float = 60.0,
    blend: float = 10.0,
) -> SmoothMoves:
    """Return a reference from the start to low, to high and back in equal steps (m); others as `SmoothMoves`.

    Raises
    ------
    ValueError
        If there is no step, low and high are not increasing, or as `SmoothMoves`.
    """
    bottom, top = _checks.increasing("low, high", [low, high]).tolist()
    if steps < 1:
        raise ValueError(f"steps: expected at least 1, got {steps}")
    up = np.linspace(bottom, top, steps + 1)
    return SmoothMoves([start, *up.tolist(), *up[-2::-1].tolist()], speed, hold=hold, blend=blend)


class AddedSine:
    """A sine on top of another reference; it swells within its first two periods.

    Parameters
    ----------
    base : callable
        The other reference.
    amplitude : float
        m.
    frequency : float
        Hz.

    Raises
    ------
    ValueError
        If the amplitude is not finite or the frequency not positive.
    """

    def __init__(self, base: Reference, amplitude: float, frequency: float) -> None:
        if not 0.0 < frequency < math.inf:
            raise ValueError(f"frequency: expected a positive number of Hz, got {frequency}")
        self._base = base
        self._amplitude = _checks.number("amplitude", amplitude)
        self._frequency = frequency

    def __call__(self, t: float) -> float:
        """Return the position at a time (s), m."""
        periods = self._frequency * t
        return self._base(t) + self._amplitude * _blend(0.5 * periods) * math.sin(2.0 * math.pi * periods)


# The piezo part.


class HysteresisInverse:
    """The inverse of a Prandtl-Ishlinskii operator one sample at a time, with its memory.

    The same as the operator's `inverse`, but cheap enough for every sample of a fast loop. The plays that a move
    drags are the first ones: neighbouring states never differ by more than their thresholds do, so that behind a
    play that is not dragged none is.

    Parameters
    ----------
    operator : PrandtlIshlinskii
        From V to m, without dead zones; relaxed.
    stroke : float
        Greatest deflection of either sign, m; no more than what the operating range gives.

    Raises
    ------
    ValueError
        If the operator has dead zones or no inverse, or the stroke is not positive.
    """

    def __init__(self, operator: PrandtlIshlinskii, stroke: float = math.inf) -> None:
        if operator.before is not None or operator.after is not None:
            raise ValueError("hysteresis: expected an operator of plays alone, got one with dead zones")
        if not stroke > 0.0:
            raise ValueError(f"stroke: expected a positive number of m, got {stroke}")
        inverse = operator.inverse_operator()
        self._offset = inverse.bias
        self._thresholds: list[float] = inverse.thresholds.tolist()
        self._weights: list[float] = inverse.weights.tolist()
        self._states: list[float] = list(operator.inverse_state(operator.initial_state()))
        self._total = 0.0
        low, high = operator.output_range()
        self.low = max(low - operator.bias, -stroke)
        """Least deflection, m."""
        self.high = min(high - operator.bias, stroke)
        """Greatest deflection, m."""
        self.deflection = 0.0
        """Deflection of the model at the last voltage, m from rest."""

    def voltage(self, deflection: float) -> float:
        """Move to the voltage (V) for a deflection (m from rest), or to that for the closest within the stroke."""
        x = min(max(deflection, self.low), self.high)
        self.deflection = x
        states, weights = self._states, self._weights
        total = self._total
        for k, r in enumerate(self._thresholds):
            z = states[k]
            if x - r > z:
                total += weights[k] * (x - r - z)
                states[k] = x - r
            elif x + r < z:
                total += weights[k] * (x + r - z)
                states[k] = x + r
            elif k:
                break
        self._total = total
        return self._offset + total


@dataclass(frozen=True)
class FineParameters:
    """Numbers of the fine loop.

    Parameters
    ----------
    rate : float
        Sampling rate, Hz; well above twice the resonance.
    integral : float
        Gain of the integral, 1/s.
    pole_damping : float
        Damping ratio of the poles that the notch has in place of the resonance.
    stroke : float
        Greatest deflection of either sign that the piezo part is asked for, m.
    """

    rate: float = 20e3
    integral: float = 300.0
    pole_damping: float = 0.7
    stroke: float = 9e-6

    def __post_init__(self) -> None:
        check_positive(self)


class FineController:
    """Piezo part alone, at a rate that sees its resonance: integral, notch, inverse of the hysteresis.

    The integral alone acts on the reference: fed forward, a step would ring. The notch stands behind the integral and
    before the inverse, so that inverse and piezo layer together are linear to it. Readings are (deflection, m) and
    whatever else; the set-point is (voltage, V). A missing reading holds it.

    Parameters
    ----------
    model : HybridModel
        Hysteresis and dynamics of the piezo part.
    reference : callable
        Wanted deflection.
    parameters : FineParameters
        Numbers of the loop.

    Raises
    ------
    ValueError
        If the resonance lies beyond half the rate, or the hysteresis has no inverse.
    """

    def __init__(self, model: HybridModel, reference: Reference, parameters: FineParameters | None = None) -> None:
        p = parameters or FineParameters()
        self._reference = reference
        self._inverse = HysteresisInverse(model.hysteresis, p.stroke)
        self._gain = p.integral / p.rate
        section = notch(model.dynamics.frequency, p.rate, model.dynamics.damping, p.pole_damping).tolist()
        self._b0, self._b1, self._b2, _, self._a1, self._a2 = section
        self._s1 = self._s2 = 0.0
        self._integral = 0.0
        self._start = math.nan
        self._wanted = math.nan
        self._voltage = self._inverse.voltage(0.0)
        self._measured = math.nan

    def update(self, t: float, measured: tuple[float, ...]) -> tuple[float]:
        """Take in the deflection (m, first of the readings) at a time (s) and return the voltage (V)."""
        y = measured[0]
        if not math.isfinite(y):
            return (self._voltage,)
        if math.isnan(self._start):
            self._start = t
        self._wanted = wanted = self._reference(t - self._start)
        self._measured = y
        inverse = self._inverse
        # Held within the stroke, the integral does not wind up.
        x = self._integral + self._gain * (wanted - y)
        x = inverse.low if x < inverse.low else inverse.high if x > inverse.high else x
        self._integral = x
        out = self._b0 * x + self._s1
        self._s1 = self._b1 * x - self._a1 * out + self._s2
        self._s2 = self._b2 * x - self._a2 * out
        self._voltage = inverse.voltage(out)
        return (self._voltage,)

    @property
    def trace(self) -> Trace:
        """What the controller thinks at present: disturbance is what is not due to the voltage."""
        return Trace(
            reference=self._wanted,
            predicted=self._measured,
            disturbance=self._measured - self._inverse.deflection,
        )


# The thermal part.


class _Bending:
    """The thermal deflection and its inverse for single values, beyond the fitted range along the end's tangent."""

    def __init__(self, polynomial: Polynomial) -> None:
        self.low, self.high = polynomial.input_range
        self._rises = np.linspace(self.low, self.high, _TABLE)
        self._deflections = polynomial.evaluate(self._rises) - polynomial.evaluate([0.0])[0]
        falls = np.diff(self._deflections)
        if not (falls < 0.0).all() and not (falls > 0.0).all():
            raise ValueError(
                f"polynomial: expected one that rises or falls all over its range, {self.low:g} to {self.high:g} K"
            )
        order = slice(None) if falls[0] > 0.0 else slice(None, None, -1)
        self._sorted = self._deflections[order].copy(), self._rises[order].copy()
        # Powers of the rise mapped to [-1, 1].
        self._middle, self._half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        series = np.append(polynomial.bias - polynomial.evaluate([0.0])[0], polynomial.series)
        powers = np.polynomial.chebyshev.cheb2poly(series)
        self._powers: list[float] = powers[::-1].tolist()
        self._slopes: list[float] = (powers[1:] * np.arange(1, powers.size))[::-1].tolist()

    def deflection(self, rise: float) -> float:
        """Return the deflection (m) at a rise of the tip (K)."""
        inside = min(max(rise, self.low), self.high)
        x = (inside - self._middle) / self._half
        total = 0.0
        for power in self._powers:
            total = total * x + power
        return total if inside == rise else total + self.slope(inside) * (rise - inside)

    def slope(self, rise: float) -> float:
        """Return the deflection per rise (m/K)."""
        x = (min(max(rise, self.low), self.high) - self._middle) / self._half
        total = 0.0
        for slope in self._slopes:
            total = total * x + slope
        return total / self._half

    def rise(self, deflection: float) -> float:
        """Return the rise of the tip (K) for a deflection (m), at most that at the end of the range."""
        return float(np.interp(deflection, *self._sorted))


class _Network:
    """The thermal network in single numbers, reduced to base and tip, with one node for the block.

    The block is slower than the rest by a factor of ten. It is carried along with the current, in open loop, and
    not estimated. Rises are above the reference temperature of the model.
    """

    def __init__(self, network: ThermalNetwork, reference: float) -> None:
        self.kelvin = reference - _ABSOLUTE_ZERO
        self._network = network
        self.base_capacity, self.tip_capacity = (float(c) for c in network.capacities[2:])
        self.base_air, self.tip_air = (float(g) for g in network.air_conductances[2:])
        self.along = 1.0 / network.beam_resistance
        self.glue, self.cooler = 1.0 / network.glue_resistance, 1.0 / network.tec_resistance
        self._block_capacity = 2.0 * network.block_capacity
        self._block_air = float(network.air_conductances[:2].sum())
        self.block = 0.0
        """Rise of the block, K."""

    def _back(self, base: float, current: float) -> float:
        """Return the rise of the face between cooler and glue, K."""
        n = self._network
        pumped = n.seebeck * current
        flow = 0.5 * n.electrical_resistance * current**2 - pumped * self.kelvin
        return (flow + base * self.cooler + self.block * self.glue) / (self.glue + self.cooler + pumped)

    def advance(self, base: float, current: float, dt: float) -> None:
        """Carry the block along, with the rise of the base (K) and the current (A) over dt (s)."""
        flow = (self._back(base, current) - self.block) * self.glue - self.block * self._block_air
        self.block += dt * flow / self._block_capacity

    def heat_flow(self, current: float) -> tuple[float, float]:
        """Return the heat into the base as constant (W) and slope (W/K) of its rise, at a current (A)."""
        n = self._network
        pumped = n.seebeck * current
        constant = pumped * self.kelvin + 0.5 * n.electrical_resistance * current**2
        slope = pumped - self.cooler
        total = self.glue + self.cooler + pumped
        back = 0.5 * n.electrical_resistance * current**2 - pumped * self.kelvin + self.block * self.glue
        return constant + self.cooler * back / total, slope + self.cooler**2 / total - self.base_air

    def heat_for(self, rise: float, rate: float, base: float, current: float) -> float:
        """Return the heat from the cooler (W) that moves the tip's rise (K) at a rate (K/s), quasi-statically.

        The base is ahead of the tip by what the heat loss of the tip asks for; the heat through the cooler is that
        at the present rise of the base (K) and current (A).
        """
        share = 1.0 + self.tip_air / self.along
        stored = (self.base_capacity * share + self.tip_capacity) * rate
        lost = (self.base_air * share + self.tip_air) * rise
        return stored + lost + (share * rise - self._back(base, current)) * self.cooler

    def current_for(self, heat: float, base: float) -> float:
        """Return the smaller of the currents (A) that give a heat (W) at the rise of the base (K)."""
        n = self._network
        pumped = n.seebeck * (self.kelvin + base)
        # Below the strongest cooling there is none; the strongest then.
        square = max(pumped * pumped + 2.0 * n.electrical_resistance * heat, 0.0)
        return 2.0 * heat / (pumped + math.sqrt(square))


class _Preview:
    """Thermal part of the reference: smoothed by a window in time, with its derivative, now and ahead.

    Whatever is faster than the window is left to the piezo part. The reference is known, so that the window may
    extend into the future and delays nothing.
    """

    def __init__(self, reference: Reference, window: float, lead: float, period: float) -> None:
        half = max(1, round(0.5 * window / period))
        self._reference = reference
        self._period = period
        x = np.arange(-half, half + 1) / (half + 1.0)
        weights = 0.5 + 0.5 * np.cos(math.pi * x)
        self._weights = weights / weights.sum()
        slopes = np.sin(math.pi * x)
        # Exact for a ramp.
        self._slopes = slopes / (slopes @ (x * (half + 1.0) * period))
        self._width = 2 * half + 1
        ahead = round(lead / period)
        self._values = np.array([reference(k * period) for k in range(-half, half + 1 + ahead)])
        self._next = half + 1 + ahead

    def advance(self, t: float) -> tuple[float, float, float]:
        """Return the smoothed reference now (m), and ahead (m) with its derivative (m/s)."""
        values = self._values
        now = float(self._weights @ values[: self._width])
        window = values[-self._width :]
        ahead, rate = float(self._weights @ window), float(self._slopes @ window)
        values[:-1] = values[1:]
        values[-1] = self._reference(t + self._next * self._period)
        return now, ahead, rate


class _ThermalEstimate(ABC):
    """Estimates the deflection of the thermal part."""

    value = 0.0
    """The estimate at the last sample, m."""
    rate = 0.0
    """How fast it changes, m/s, where that is known."""

    @abstractmethod
    def begin(self, deflection: float, base: float, tip: float) -> None:
        """Start from the first readings: thermal deflection (m), rises of base and tip (K)."""

    @abstractmethod
    def sample(self, deflection: float) -> None:
        """Take in one value of the measured deflection less the piezo part (m), and go on by one fast period."""

    @abstractmethod
    def correct(self, base: float, tip: float, current: float) -> None:
        """Take in the rises of base and tip (K) and the current (A) since the last thermal sample."""

    def describe(self, rise: float) -> tuple[float, float]:  # noqa: ARG002
        """Return difference to the model, m, and its standard deviation, m, at the measured rise of the tip (K)."""
        return math.nan, math.nan


class _LowPass(_ThermalEstimate):
    """First-order low-pass of the measured deflection less the piezo part."""

    def __init__(self, bending: _Bending, share: float) -> None:
        self._bending = bending
        self._share = share

    def begin(self, deflection: float, base: float, tip: float) -> None:  # noqa: ARG002
        self.value = deflection

    def sample(self, deflection: float) -> None:
        self.value += self._share * (deflection - self.value)

    def correct(self, base: float, tip: float, current: float) -> None:
        pass

    def describe(self, rise: float) -> tuple[float, float]:
        return self.value - self._bending.deflection(rise), math.nan


class _Thermistor(_ThermalEstimate):
    """The polynomial at the low-passed temperature of the tip; the deflection is not used."""

    def __init__(self, bending: _Bending, share: float) -> None:
        self._bending = bending
        self._share = share
        self._tip = 0.0

    def begin(self, deflection: float, base: float, tip: float) -> None:  # noqa: ARG002
        self._tip = tip
        self.value = self._bending.deflection(tip)

    def sample(self, deflection: float) -> None:
        pass

    def correct(self, base: float, tip: float, current: float) -> None:  # noqa: ARG002
        self._tip += self._share * (tip - self._tip)
        self.value = self._bending.deflection(self._tip)


@dataclass(frozen=True)
class ThermalNoise:
    """Variances of the Kalman filter of the thermal part, as standard deviations.

    Parameters
    ----------
    thermistor : float
        Of one reading of a thermistor, K.
    deflection : float
        Of one reading of the deflection, m.
    base, tip : float
        By which base and tip may wander off the model in one second, K/√s.
    heat : float
        By which the disturbing heat flow into the base may change in one second, W/√s.
    offset : float
        By which the deflection may wander off the polynomial in one second, m/√s.
    """

    thermistor: float = 0.02
    deflection: float = 10e-9
    base: float = 1e-3
    tip: float = 2e-4
    heat: float = 2e-3
    offset: float = 3e-9

    def __post_init__(self) -> None:
        check_positive(self)


class _Unscented(_ThermalEstimate):
    """Unscented Kalman filter of base, tip, a disturbing heat and an offset of the deflection, by filterpy.

    The heat stands for a room and a block that are not as assumed and for what the network lacks, the offset for
    the error of the polynomial, creep of the piezo part and drift of the sensor; both are random walks. The filter
    runs once in a thermal period, with the mean of the deflections since; in between the estimate goes on at the
    rate that the model gives.
    """

    def __init__(self, bending: _Bending, network: _Network, noise: ThermalNoise, period: float, every: int) -> None:
        # Half a second of import that only those who estimate shall pay.
        from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

        self._bending = bending
        self._network = network
        self._period = period
        self._step = period * every
        self._noise = noise
        # These three numbers make it the cubature rule: equal positive weights, nothing cancels.
        points = MerweScaledSigmaPoints(
            4, alpha=1.0, beta=0.0, kappa=0.0, sqrt_method=lambda matrix: np.linalg.cholesky(matrix).T
        )
        self._filter = UnscentedKalmanFilter(4, 3, self._step, self._observe, self._move, points)
        self._filter.Q = np.diag(np.square([noise.base, noise.tip, noise.heat, noise.offset])) * self._step
        self._filter.R = np.diag(np.square([noise.thermistor, noise.thermistor, noise.deflection]))
        self._filter.R[2, 2] /= every
        self._heat = 0.0, 0.0
        self._sum, self._count = 0.0, 0

    def begin(self, deflection: float, base: float, tip: float) -> None:
        n = self._noise
        self._filter.x = np.array([base, tip, 0.0, deflection - self._bending.deflection(tip)])
        spread = 2.0 * abs(self._bending.slope(tip)) * n.thermistor
        self._filter.P = np.diag(np.square([n.thermistor, n.thermistor, 10.0 * n.heat, spread]))
        self.value = deflection

    def _move(self, state: Floats, dt: float) -> list[float]:
        base, tip, heat, offset = state.tolist()
        n = self._network
        constant, slope = self._heat
        along = (base - tip) * n.along
        return [
            base + dt * (constant + slope * base + heat - along) / n.base_capacity,
            tip + dt * (along - n.tip_air * tip) / n.tip_capacity,
            heat,
            offset,
        ]

    def _observe(self, state: Floats) -> list[float]:
        base, tip, _, offset = state.tolist()
        return [base, tip, self._bending.deflection(tip) + offset]

    def sample(self, deflection: float) -> None:
        self._sum += deflection
        self._count += 1
        self.value += self.rate * self._period

    def correct(self, base: float, tip: float, current: float) -> None:
        self._heat = self._network.heat_flow(current)
        self._filter.predict()
        if self._count:
            self._take_in(base, tip)
        here, there, _, offset = self._filter.x.tolist()
        n = self._network
        cooling = ((here - there) * n.along - n.tip_air * there) / n.tip_capacity
        self.rate = self._bending.slope(there) * cooling
        self.value = self._bending.deflection(there) + offset

    def _take_in(self, base: float, tip: float) -> None:
        # The mean of the readings is that of half a period before their last.
        age = 0.5 * (self._count - 1) * self._period
        mean = self._sum / self._count + self.rate * age
        self._sum, self._count = 0.0, 0
        self._filter.update(np.array([base, tip, mean]))

    def describe(self, rise: float) -> tuple[float, float]:  # noqa: ARG002
        return float(self._filter.x[3]), math.sqrt(float(self._filter.P[3, 3]))


@dataclass(frozen=True)
class MidRangingParameters:
    """Numbers of the mid-ranging controllers.

    Parameters
    ----------
    period : float
        Time between two calls, s.
    every : int
        Number of calls for each new current.
    gain : float
        Heat fed back per deflection that the thermal part lacks, W/m.
    integral_time : float
        Of the integral in that feedback, s.
    lead : float
        Time by which the heat is ahead of the reference, s: the lag of the bending behind the base.
    window : float
        Time over which the reference is smoothed for the thermal part, s.
    maximum_current : float
        Greatest current of either sign, A.
    filter_time : float
        Time constant of the low-pass that estimates the thermal part where no Kalman filter does, s.
    integral : float
        Gain of the piezo part's integral, 1/s, below half the rate of the calls.
    stroke : float
        Greatest deflection of either sign that the piezo part is asked for, m.
    """

    period: float = 5e-3
    every: int = 4
    gain: float = 1.6e4
    integral_time: float = 40.0
    lead: float = 1.0
    window: float = 4.0
    maximum_current: float = 0.15
    filter_time: float = 0.15
    integral: float = 25.0
    stroke: float = 9e-6

    def __post_init__(self) -> None:
        check_positive(self)
        if not 2.0 * self.integral * self.period < 1.0:
            raise ValueError(f"integral: expected less than {0.5 / self.period:g} 1/s, got {self.integral}")


class _MidRanging:
    """Thermal and piezo part under one reference; the three controllers differ in what they leave out.

    Readings are (deflection, m; temperature of the base, °C; temperature of the tip, °C), set-points (current, A;
    voltage, V). If one of the readings is missing, both are held.
    """

    def __init__(
        self,
        model: HybridModel,
        reference: Reference,
        parameters: MidRangingParameters,
        bending: _Bending,
        network: _Network,
        estimate: _ThermalEstimate,
        inverse: HysteresisInverse | None,
        integral: float,
    ) -> None:
        self._p = parameters
        self._reference = reference
        self._celsius = model.reference
        self._bending, self._network, self._estimate = bending, network, estimate
        self._inverse = inverse
        self._step = parameters.period * parameters.every
        self._preview = _Preview(reference, parameters.window, parameters.lead, self._step)
        self._integral_gain = integral * parameters.period
        self._integral = 0.0
        self._fed_back = 0.0
        self._start = math.nan
        self._samples = 0
        self._current = 0.0
        self._voltage = 0.0 if inverse is None else inverse.voltage(0.0)
        self._wanted = math.nan
        self._base = self._tip = math.nan

    def update(self, t: float, measured: tuple[float, ...]) -> tuple[float, float]:
        """Take in deflection (m) and temperatures of base and tip (°C) at a time (s); return current and voltage.

        Raises
        ------
        ValueError
            If there are not three readings.
        """
        if len(measured) != 3:
            raise ValueError(f"measured: expected deflection and two temperatures, got {len(measured)} readings")
        deflection, base, tip = measured
        complete = math.isfinite(deflection + base + tip)
        if complete:
            self._base, self._tip = base - self._celsius, tip - self._celsius
            piezo = 0.0 if self._inverse is None else self._inverse.deflection
            if math.isnan(self._start):
                self._start = t
                self._estimate.begin(deflection - piezo, self._base, self._tip)
            self._estimate.sample(deflection - piezo)
        elif math.isnan(self._start):
            return self._current, self._voltage
        now = t - self._start
        self._wanted = wanted = self._reference(now)
        if self._samples % self._p.every == 0:
            self._heat(now, hold=not complete)
        self._samples += 1
        if complete and self._inverse is not None:
            # The voltage brings the tip to where it is to be at the end of the coming period.
            thermal = self._estimate.value + self._p.period * self._estimate.rate
            feedforward = self._reference(now + self._p.period) - thermal
            total = feedforward + self._integral + self._integral_gain * (wanted - deflection)
            self._voltage = self._inverse.voltage(total)
            if self._integral_gain:
                # What the stroke has cut off is taken back: the integral does not wind up.
                self._integral = self._inverse.deflection - feedforward
        return self._current, self._voltage

    def _heat(self, now: float, *, hold: bool) -> None:
        """Take the thermal part over the past period; set the current of the coming one, or hold it."""
        p, network, base = self._p, self._network, self._base
        network.advance(base, self._current, self._step)
        self._estimate.correct(base, self._tip, self._current)
        wanted, ahead, rate = self._preview.advance(now)
        if hold:
            return
        rise = self._bending.rise(ahead)
        slope = self._bending.slope(rise)
        heat = network.heat_for(rise, rate / slope, base, self._current)
        # Heat deflects negatively: the sign is that of the slope.
        lacking = math.copysign(p.gain, slope) * (wanted - self._estimate.value)
        further = self._fed_back + lacking * self._step / p.integral_time
        current = network.current_for(heat + lacking + further, base)
        self._current = min(max(current, -p.maximum_current), p.maximum_current)
        # At the limit the integral takes only what leads away from it.
        if self._current == current or lacking * current < 0.0:
            self._fed_back = further

    @property
    def trace(self) -> Trace:
        """What the controller thinks at present: disturbance is what the model lacks of the thermal deflection."""
        disturbance, uncertainty = self._estimate.describe(self._tip)
        piezo = 0.0 if self._inverse is None else self._inverse.deflection
        return Trace(
            reference=self._wanted,
            predicted=self._estimate.value + piezo,
            disturbance=disturbance,
            uncertainty=uncertainty,
        )


class HybridController(_MidRanging):
    """Mid-ranging control: the thermal part takes the range, the piezo part the accuracy.

    Parameters
    ----------
    model : HybridModel
        The identified model.
    reference : callable
        Wanted deflection.
    parameters : MidRangingParameters
        Numbers of the loops.
    estimator : {"unscented", "low-pass"}
        What estimates the thermal part: a Kalman filter of the thermal state, or a plain low-pass.
    noise : ThermalNoise
        Variances of the Kalman filter.
    """

    def __init__(
        self,
        model: HybridModel,
        reference: Reference,
        parameters: MidRangingParameters | None = None,
        *,
        estimator: Literal["unscented", "low-pass"] = "unscented",
        noise: ThermalNoise | None = None,
    ) -> None:
        p = parameters or MidRangingParameters()
        bending, network = _Bending(model.polynomial), _Network(model.network, model.reference)
        estimate: _ThermalEstimate
        if estimator == "unscented":
            estimate = _Unscented(bending, network, noise or ThermalNoise(), p.period, p.every)
        elif estimator == "low-pass":
            estimate = _LowPass(bending, -math.expm1(-p.period / p.filter_time))
        else:
            raise ValueError(f"estimator: expected unscented or low-pass, got {estimator!r}")
        inverse = HysteresisInverse(model.hysteresis, p.stroke)
        super().__init__(model, reference, p, bending, network, estimate, inverse, p.integral)


class OpenLoopHybrid(_MidRanging):
    """Inverse of the model without the sensor of the deflection: what the thermistor at the tip says must do.

    The thermal part follows the inverted polynomial, the piezo part adds what the polynomial at the measured
    temperature lacks, through the inverse of the hysteresis. Parameters as `HybridController`.
    """

    def __init__(
        self, model: HybridModel, reference: Reference, parameters: MidRangingParameters | None = None
    ) -> None:
        p = parameters or MidRangingParameters()
        bending, network = _Bending(model.polynomial), _Network(model.network, model.reference)
        estimate = _Thermistor(bending, -math.expm1(-p.period * p.every / p.filter_time))
        inverse = HysteresisInverse(model.hysteresis, p.stroke)
        super().__init__(model, reference, p, bending, network, estimate, inverse, 0.0)


class ThermalFeedback(_MidRanging):
    """Thermal part alone, fed forward and fed back from the deflection; the voltage stays 0.

    Parameters as `HybridController`; the default gain is greater, since no piezo part does the rest.
    """

    def __init__(
        self, model: HybridModel, reference: Reference, parameters: MidRangingParameters | None = None
    ) -> None:
        p = parameters or MidRangingParameters(gain=3e4)
        bending, network = _Bending(model.polynomial), _Network(model.network, model.reference)
        estimate = _LowPass(bending, -math.expm1(-p.period / p.filter_time))
        super().__init__(model, reference, p, bending, network, estimate, None, 0.0)
