"""The numbers of the thermo-piezoelectric cantilever: its strip, its cooler and block, and its piezo dynamics.

Source: Rakotondrabe and Ivan, "Development and dynamic modeling of a new hybrid thermo-piezoelectric
micro-actuator", IEEE Transactions on Robotics 26(6), 2010.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sim_devices.plants.cooler import CooledParameters
from sim_devices.plants.grid import NotNegative, Numbers, Signed, check_temperature


@dataclass(frozen=True, kw_only=True)
class Bimorph(Numbers):
    """The strip: a piezo layer and a passive layer, from the paper's tables I and II."""

    length: float = 15e-3
    width: float = 2e-3
    """Free length and width, m."""
    piezo_thickness: float = 0.2e-3
    passive_thickness: float = 0.1e-3
    """Thickness of the PZT and of the copper layer, m."""
    piezo_compliance: float = 15e-12
    passive_compliance: float = 9.1e-12
    """Axial compliance, m²/N."""
    piezo_coefficient: Signed = -100e-12
    """Transverse piezoelectric coefficient d31, m/V; negative."""
    piezo_expansion: Signed = 3.3e-6
    passive_expansion: Signed = 17e-6
    """Coefficient of thermal expansion, 1/K. The table prints PZT's 3.3e-6 without its unit."""
    piezo_conductivity: float = 1.4
    passive_conductivity: float = 381.5
    """Thermal conductivity, W/(m K). PZT's is 1.4; the table has a hundred times that."""
    piezo_heat: float = 7500.0 * 420.0
    passive_heat: float = 8960.0 * 386.0
    """Heat capacity of the volume, J/(m³ K). Copper's with its density of 8960 kg/m³; the table has zinc's."""

    @property
    def perimeter(self) -> float:
        """Perimeter of the cross-section, m."""
        return 2.0 * (self.width + self.piezo_thickness + self.passive_thickness)

    @property
    def section(self) -> float:
        """Area of the cross-section, m²."""
        return self.width * (self.piezo_thickness + self.passive_thickness)

    @property
    def axial_conductance(self) -> float:
        """Thermal conductance of the layers side by side, times length, W m/K."""
        return self.width * (
            self.piezo_conductivity * self.piezo_thickness + self.passive_conductivity * self.passive_thickness
        )

    @property
    def line_capacity(self) -> float:
        """Heat capacity of a length, J/(m K)."""
        return self.width * (self.piezo_heat * self.piezo_thickness + self.passive_heat * self.passive_thickness)


def piezo_sensitivity(bimorph: Bimorph) -> float:
    """Compute the tip deflection per volt (Rakotondrabe and Ivan, eq. 10, after Smits and Choi 1992).

    Returns
    -------
    float
        Deflection, m/V; 0.2687 µm/V for the paper's strip.
    """
    return -_curvature_gain(bimorph) * bimorph.piezo_coefficient


def thermal_sensitivity(bimorph: Bimorph) -> float:
    """Compute the tip deflection per kelvin of a strip at one temperature.

    Rakotondrabe and Ivan, eq. 10, with the thickness of the piezo layer that the printed coefficient lacks:
    an electric field is a voltage over that thickness, an expansion is not.

    Returns
    -------
    float
        Deflection, m/K; -7.363 µm/K for the paper's strip: cooling deflects it positively.
    """
    expansion = bimorph.piezo_expansion - bimorph.passive_expansion
    return _curvature_gain(bimorph) * bimorph.piezo_thickness * expansion


def _curvature_gain(bimorph: Bimorph) -> float:
    # 3 A B L² / K of the paper's eq. 10: the deflection per strain difference and piezo thickness, dimensionless.
    sc, sp = bimorph.passive_compliance, bimorph.piezo_compliance
    ec, ep = bimorph.passive_thickness, bimorph.piezo_thickness
    a = sc * sp * (sc * ep + sp * ec)
    b = ec * (ep + ec) / (sc * ep + sp * ec)
    k = sc**2 * ep**4 + sp**2 * ec**4 + 4.0 * sc * sp * (ec * ep**3 + ep * ec**3) + 6.0 * sc * sp * ec**2 * ep**2
    return 3.0 * a * b * bimorph.length**2 / k


@dataclass(frozen=True, kw_only=True)
class HybridParameters(CooledParameters):
    """Every number of the plant.

    The strip, the block, the convection coefficient and the poles and zeros of the piezo dynamics come from
    the paper. All others are assumed. The capacities of the cooler's faces are what makes the paper's 4 mHz:
    the block, the strip and a cooler without mass would have ten times that.
    """

    bimorph: Bimorph = field(default_factory=Bimorph)
    """The strip."""
    convection: float = 30.0
    """Heat transfer coefficient to air at 10 K, W/(m² K) (paper: 30)."""
    convection_share: Signed = 0.25
    """Share of it that grows with the fourth root of the rise above the room, in [0, 1]."""
    seebeck: float = 11.6e-3
    """Seebeck coefficient of the cooler, V/K (the paper's table: 12e-3)."""
    conductance: float = 12.5e-3
    """Thermal conductance of the cooler, W/K (the paper's table: 12e-3)."""
    resistance: float = 5.2
    """Electrical resistance of the cooler, ohm."""
    face_capacity: float = 0.55
    back_capacity: float = 0.09
    """Heat capacities of the cooler's actuator face with clamp and thermistor, and of its back face, J/K."""
    contact_resistance: float = 6.0
    """Thermal resistance from the actuator face to the first element of the beam, K/W."""
    base_loss: NotNegative = 2e-3
    """Conductance from the actuator face to air, W/K."""
    maximum_current: float = 0.4
    """Rating of the cooler, A; larger commands are refused. The beam is coldest at about -0.43 A; beyond, more
    current cools less."""
    block_capacity: float = 23.14
    """Heat capacity of either half of the block, J/K (38 by 20 by 25 mm of aluminium)."""
    block_resistance: float = 0.148
    """Thermal resistance along the block, K/W."""
    block_side_resistance: float = 23.0
    """Thermal resistance from the sides of either half to air, K/W."""
    block_front_resistance: float = 46.3
    """Thermal resistance from the front beside the cooler to air, K/W."""
    glue_resistance: float = 2.5
    """Thermal resistance of the glue between cooler and block, K/W: 0.1 mm of 1 W/(m K) on 8 by 5 mm."""
    step: float = 0.01
    """Step of the thermal time grid, s."""
    loop_frequency: float = 0.3
    loop_damping: float = 1.0
    """Natural frequency (rad/s) and damping ratio of the closed temperature loop."""
    ambient_temperature: Signed = 22.0
    """Mean temperature of the room, °C."""
    ambient_sd: NotNegative = 0.15
    ambient_time: float = 400.0
    """Standard deviation (K) and correlation time (s) of the room temperature."""
    straight_temperature: Signed = 22.0
    """Temperature at which the strip has no thermal deflection, °C."""
    bending_quadratic: Signed = 0.006
    bending_cubic: Signed = -1e-4
    """How the local curvature departs from proportionality to the rise d above the straight temperature: it goes as
    ``d + bending_quadratic d² + bending_cubic d³`` (1/K and 1/K²)."""
    piezo_gain: float = 0.283e-6
    piezo_quadratic: Signed = 2.5e-10
    """Deflection per voltage (m/V) and its part with the square of the voltage (m/V²)."""
    hysteresis_share: NotNegative = 0.30
    """Share of the gain that the hysteretic part takes back after a reversal."""
    hysteresis_rate: float = 0.040
    hysteresis_skew: NotNegative = 0.006
    """Rates at which it saturates, 1/V; the second adds while it grows and takes off while it shrinks and must be the
    smaller."""
    creep_share: NotNegative = 0.012
    """Contribution of each of the creep's lags, as a share of the deflection."""
    creep_times: tuple[float, float, float] = (1.0, 10.0, 100.0)
    """Time constants of the three lags, s."""
    piezo_warming: Signed = 0.003
    """Relative growth of the piezo deflection with the beam's rise above the straight temperature, 1/K."""
    maximum_voltage: float = 60.0
    """Largest voltage on the piezo, V, of either sign; larger commands are refused. The paper's range is ±40 V."""
    real_pole: float = 1274.0
    """Real pole of the piezo dynamics D(s), 1/s (paper, eq. 21)."""
    resonance_decay: float = 34.1
    resonance_square: float = 1.9e7
    """Coefficients of the resonance ``s² + resonance_decay s + resonance_square``, 1/s and 1/s² (paper, eq. 21)."""
    numerator_linear: float = 2.58e4
    numerator_constant: float = 2.4e8
    """Coefficients of the numerator, in the same form. The gain is normalised: D(s)/D(0) acts."""
    resonance_offset: Signed = 0.0
    """Relative shift of the resonance frequency at constant damping ratio, within ±0.5; ±0.03 is a sensible test of a
    notch."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.convection_share <= 1.0:
            raise ValueError(f"convection_share must lie in [0, 1], not {self.convection_share}")
        if not self.hysteresis_skew < self.hysteresis_rate:
            raise ValueError(f"hysteresis_skew must be below {self.hysteresis_rate} 1/V, not {self.hysteresis_skew}")
        if len(self.creep_times) != 3 or not all(1e-2 <= t < math.inf for t in self.creep_times):
            raise ValueError(f"creep_times must be three times of at least 0.01 s, not {self.creep_times}")
        if len(set(self.creep_times)) != 3:
            raise ValueError(f"creep_times must differ from one another, not {self.creep_times}")
        if not abs(self.resonance_offset) <= 0.5:
            raise ValueError(f"resonance_offset must lie within ±0.5, not {self.resonance_offset}")
        if not self.resonance_decay**2 < 4.0 * self.resonance_square:
            raise ValueError(f"resonance_decay must leave the resonance a frequency, not {self.resonance_decay} 1/s")
        check_temperature("straight_temperature", self.straight_temperature)


def piezo_dynamics(parameters: HybridParameters) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Split D(s)/D(0) together with the creep into modes.

    Returns
    -------
    tuple of ndarray
        Poles p (1/s) of the six modes and their shares g of the steady deflection: the step response is
        ``sum(g (1 - exp(p t)))``. First the pole of the resonance with positive frequency and its conjugate, then the
        real pole, then the creep's.
    """
    p = parameters
    # The offset moves the resonance along its ray from the origin: the damping ratio stays.
    decay = 0.5 * p.resonance_decay
    pole = complex(-decay, math.sqrt(p.resonance_square - decay**2)) * (1.0 + p.resonance_offset)
    rates = 1.0 / np.array(p.creep_times)
    fast = np.array([pole, pole.conjugate(), -p.real_pole])
    poles = np.concatenate([fast, -rates])

    def numerator(s: complex) -> complex:
        return (s * s + p.numerator_linear * s + p.numerator_constant) / p.numerator_constant

    def creep(s: complex) -> complex:
        return 1.0 + p.creep_share * complex(np.sum(rates / (s + rates)))

    shares = np.empty(poles.size, dtype=np.complex128)
    for m, s in enumerate(fast):
        others = np.delete(fast, m)
        # Residue over -s, every denominator normalised to 1 at s = 0.
        shares[m] = numerator(s) * creep(s) / np.prod(1.0 - s / others)
    for m, rate in enumerate(rates, fast.size):
        shares[m] = p.creep_share * numerator(-rate) / np.prod(1.0 + rate / fast)
    return poles, shares
