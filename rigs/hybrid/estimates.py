"""Estimates of the thermal deflection: the model in single numbers, and the filters that the controllers choose from.

Units are SI; rises are temperatures above that of the room at the start, in K, and a positive current heats.

Sources: Rakotondrabe and Ivan, "Development and dynamic modeling of a new hybrid thermo-piezoelectric
micro-actuator", IEEE Transactions on Robotics 26(6), 2010 (the model); Julier and Uhlmann, "Unscented filtering and
nonlinear estimation", Proceedings of the IEEE 92, 2004.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bench.base import DeferredModule
from bench.control import check_positive
from bench.models import Polynomial
from rigs.hybrid.network import ABSOLUTE_ZERO, ThermalNetwork

if TYPE_CHECKING:
    from rigs.hybrid import _kernels as kernels
else:
    kernels = DeferredModule("rigs.hybrid._kernels")

# Points at which the polynomial of the thermal deflection is tabulated for its inverse.
_TABLE = 2001


class Bending:
    """The thermal deflection and its inverse for single values, beyond the fitted range along the end's tangent.

    Parameters
    ----------
    polynomial : Polynomial
        Deflection (m) over the rise above the reference of the model (K).
    zero : float
        Rise above that reference from which rises are counted here, K.
    """

    def __init__(self, polynomial: Polynomial, zero: float = 0.0) -> None:
        low, high = polynomial.input_range
        self.low, self.high = low - zero, high - zero
        rises = np.linspace(low, high, _TABLE)
        deflections = polynomial.evaluate(rises) - polynomial.evaluate([0.0])[0]
        falls = np.diff(deflections)
        if not (falls < 0.0).all() and not (falls > 0.0).all():
            raise ValueError(
                f"polynomial: expected one that rises or falls all over its range, {low:g} to {high:g} K"
            )
        order = slice(None) if falls[0] > 0.0 else slice(None, None, -1)
        self.table = np.array([deflections[order], rises[order] - zero])
        """Increasing deflections, m, and their rises, K; shape (2, N)."""
        middle, half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        self.range = np.array([self.low, self.high, middle, half])
        """Range of the rise, its middle and half its width, K."""
        series = np.append(polynomial.bias - polynomial.evaluate([0.0])[0], polynomial.series)
        powers = np.polynomial.chebyshev.cheb2poly(series)
        self.powers = powers[::-1].copy()
        """Of the polynomial of the rise mapped to [-1, 1], highest first."""
        self.slopes = (powers[1:] * np.arange(1.0, powers.size))[::-1].copy()
        """Of its derivative, likewise."""

    def deflection(self, rise: float) -> float:
        """Return the deflection (m) at a rise of the tip (K)."""
        return float(kernels.deflection(rise, self.range, self.powers, self.slopes))

    def slope(self, rise: float) -> float:
        """Return the deflection per rise (m/K)."""
        return float(kernels.slope(rise, self.range, self.slopes))

    def rise(self, deflection: float) -> float:
        """Return the rise of the tip (K) for a deflection (m), at most that at the end of the range."""
        return float(kernels.rise_for(deflection, self.table))


class ReducedNetwork:
    """The thermal network in single numbers, reduced to base and tip, with one node for the block.

    The block is ten times slower than the rest. It is simulated from the current, in open loop, and not estimated.

    Parameters
    ----------
    network : ThermalNetwork
        The whole network.
    room : float
        Temperature of the air, and of everything at the start, from which rises are counted, °C.
    """

    def __init__(self, network: ThermalNetwork, room: float) -> None:
        self.base_capacity, self.tip_capacity = (float(c) for c in network.capacities[2:])
        base_air, self.tip_air = (float(g) for g in network.air_conductances[2:])
        self.along = 1.0 / network.beam_resistance
        self.numbers = np.array(
            kernels.Network(
                kelvin=room - ABSOLUTE_ZERO,
                seebeck=network.seebeck,
                resistance=network.electrical_resistance,
                along=self.along,
                glue=1.0 / network.glue_resistance,
                cooler=1.0 / network.tec_resistance,
                base_air=base_air,
                tip_air=self.tip_air,
                block_air=float(network.air_conductances[:2].sum()),
                base_capacity=self.base_capacity,
                tip_capacity=self.tip_capacity,
                block_capacity=2.0 * network.block_capacity,
                block=0.0,
            )
        )
        """As `rigs.hybrid._kernels.Network`; the last one is the rise of the block, K, which is changed in place."""

    def advance(self, base: float, current: float, dt: float) -> None:
        """Advance the block by dt (s), under the rise of the base (K) and the current (A)."""
        kernels.advance_block(base, current, dt, self.numbers)

    def heat_flow(self, current: float) -> tuple[float, float]:
        """Return the heat into the base as constant (W) and slope (W/K) of its rise, at a current (A)."""
        constant, slope = kernels.heat_flow(current, self.numbers)
        return constant, slope

    def heat_for(self, rise: float, rate: float, base: float, current: float) -> float:
        """Return the heat from the cooler (W) that moves the tip's rise (K) at a rate (K/s), quasi-statically.

        The base leads the tip by the heat loss of the tip; the heat through the cooler is that at the present rise of
        the base (K) and current (A).
        """
        return float(kernels.heat_for(rise, rate, base, current, self.numbers))

    def current_for(self, heat: float, base: float) -> float:
        """Return the smaller of the currents (A) that give a heat (W) at the rise of the base (K)."""
        return float(kernels.current_for(heat, base, self.numbers))


class ThermalEstimate:
    """Estimate of the thermal deflection; by itself the first one, held."""

    def __init__(self, bending: Bending) -> None:
        self._bending = bending
        self.value = 0.0
        """Estimate at the last sample, m."""
        self.rate = 0.0
        """Its rate of change, m/s; 0 where it is not known."""

    def begin(self, deflection: float, base: float, tip: float) -> None:  # noqa: ARG002
        """Start from the first readings: thermal deflection (m), rises of base and tip (K)."""
        self.value = deflection

    def sample(self, deflection: float) -> None:
        """Use one value of the measured deflection less the piezo part (m), and advance by one fast period."""

    def correct(self, base: float, tip: float, current: float) -> None:
        """Use the rises of base and tip (K) and the current (A) since the last thermal sample."""

    def describe(self, rise: float) -> tuple[float, float]:  # noqa: ARG002
        """Return difference to the model, m, and its standard deviation, m, at the measured rise of the tip (K)."""
        return math.nan, math.nan


class LowPass(ThermalEstimate):
    """First-order low-pass of the measured deflection less the piezo part; share: weight of a new value, 0 to 1."""

    def __init__(self, bending: Bending, share: float) -> None:
        super().__init__(bending)
        self._share = share

    def sample(self, deflection: float) -> None:
        """Follow the deflection."""
        self.value += self._share * (deflection - self.value)

    def describe(self, rise: float) -> tuple[float, float]:
        """Return the difference to the polynomial; its uncertainty is not known."""
        return self.value - self._bending.deflection(rise), math.nan


class Thermistor(ThermalEstimate):
    """The polynomial at the low-passed temperature of the tip, without the deflection; share as in `LowPass`."""

    def __init__(self, bending: Bending, share: float) -> None:
        super().__init__(bending)
        self._share = share
        self._tip = 0.0

    def begin(self, deflection: float, base: float, tip: float) -> None:  # noqa: ARG002
        """Start from the temperature of the tip."""
        self._tip = tip
        self.value = self._bending.deflection(tip)

    def correct(self, base: float, tip: float, current: float) -> None:  # noqa: ARG002
        """Follow the temperature of the tip."""
        self._tip += self._share * (tip - self._tip)
        self.value = self._bending.deflection(self._tip)


@dataclass(frozen=True)
class ThermalNoise:
    """Standard deviations of the Kalman filter of the thermal part.

    Parameters
    ----------
    thermistor : float
        Noise of one reading of a thermistor, K.
    deflection : float
        Noise of one reading of the deflection, m.
    base, tip : float
        Random walk of base and tip off the model, K/√s.
    heat : float
        Random walk of the disturbing heat flow into the base, W/√s.
    offset : float
        Random walk of the deflection off the polynomial, m/√s.
    """

    thermistor: float
    deflection: float
    base: float
    tip: float
    heat: float
    offset: float

    def __post_init__(self) -> None:
        check_positive(self)


class UnscentedEstimate(ThermalEstimate):
    """Unscented Kalman filter of base, tip, a disturbing heat and an offset of the deflection.

    The heat stands for deviations of room, block and network from the model, the offset for the error of the
    polynomial, creep of the piezo part and drift of the sensor; both are random walks. The filter runs once in a
    thermal period, with the mean of the deflections since; in between, the estimate advances at the model's rate.
    """

    def __init__(
        self,
        bending: Bending,
        network: ReducedNetwork,
        noise: ThermalNoise,
        period: float,
        every: int,
        lateness: float = 0.0,
    ) -> None:
        super().__init__(bending)
        self._network = network
        self._period = period
        self._lateness = lateness
        self._step = period * every
        self._noise = noise
        self._numbers, self._filter = kernels.allocate(len(bending.powers))
        parts = self._filter
        parts.covariance[:] = np.eye(kernels.STATES)
        parts.walk[:] = np.square([noise.base, noise.tip, noise.heat, noise.offset]) * self._step
        parts.reading_noise[:] = np.square([noise.thermistor, noise.thermistor, noise.deflection])
        parts.reading_noise[2] /= every
        parts.network[:] = [self._step, network.along, network.tip_air, network.base_capacity, network.tip_capacity]
        parts.bending[:] = bending.range
        parts.powers[:] = bending.powers
        parts.slopes[:] = bending.slopes
        self._sum, self._count = 0.0, 0

    def begin(self, deflection: float, base: float, tip: float) -> None:
        """Start in equilibrium with the first readings."""
        n = self._noise
        self._filter.mean[:] = [base, tip, 0.0, deflection - self._bending.deflection(tip)]
        spread = 2.0 * abs(self._bending.slope(tip)) * n.thermistor
        self._filter.covariance[:] = np.diag(np.square([n.thermistor, n.thermistor, 10.0 * n.heat, spread]))
        self.value = deflection

    def sample(self, deflection: float) -> None:
        """Advance at the rate of the model, and keep the deflection for the next correction."""
        self._sum += deflection
        self._count += 1
        self.value += self.rate * self._period

    def correct(self, base: float, tip: float, current: float) -> None:
        """Predict, and update with the mean of the deflections since the last thermal sample."""
        network = self._network.numbers
        if self._count:
            # The mean of the readings is that of half a period before their last, which may be late itself.
            age = 0.5 * (self._count - 1) * self._period + self._lateness
            mean = self._sum / self._count + self.rate * age
            self._sum, self._count = 0.0, 0
            self.value, self.rate = kernels.predict_and_correct(current, base, tip, mean, network, self._numbers)
        else:
            self.value, self.rate = kernels.predict(current, network, self._numbers)

    def describe(self, rise: float) -> tuple[float, float]:  # noqa: ARG002
        """Return the offset of the deflection and its standard deviation, m."""
        return self._filter.mean.item(3), math.sqrt(self._filter.covariance.item(3, 3))
