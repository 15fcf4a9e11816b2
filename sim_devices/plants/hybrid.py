"""Thermo-piezoelectric cantilever on a thermoelectric cooler: the physics behind the ``hybrid`` rig.

A strip of PZT on copper bends when it is heated, slowly and far, and when a voltage is applied, fast and
little. The plant is deliberately not of the structure that identification fits. A fitted model is a lumped
thermal network with a polynomial and a Prandtl-Ishlinskii operator; the plant has a beam in ten elements,
free convection that grows with temperature, a cooler with two heat capacities, bending that is not linear
in the local temperature, a Bouc-Wen hysteresis with creep, and a room whose temperature wanders.

Source of geometry, materials, ranges, thermal network and piezo dynamics: Rakotondrabe and Ivan,
"Development and dynamic modeling of a new hybrid thermo-piezoelectric micro-actuator", IEEE Transactions on
Robotics 26(6), 2010. Where its printed equations do not balance, the network here is that of Kirchhoff's
laws, with the heat of the Peltier effect taken at the absolute temperature of each face. Numbers marked
*assumed* are ours, chosen so that the plant behaves as the paper's specimen does.

The paper's three actuators (table III) are this one plant: the thermal bimorph is the plant that `apply` is
never called of, the classic piezo cantilever the plant that `drive` is never called of.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_devices.plants import _hybrid_kernels as kernels
from sim_devices.plants.grid import GridPlant

_ABSOLUTE_ZERO = -273.15

# Time (s) after a grid point within which a command still counts as given there: rounding in the caller's
# clock must not decide on which side of the grid point it falls.
_GRID_TOLERANCE = 5e-7

# Rise (K) at which the free convection's share is that of the parameters.
_CONVECTION_RISE = 10.0

_POSITIVE = (
    "convection",
    "seebeck",
    "conductance",
    "resistance",
    "face_capacity",
    "back_capacity",
    "contact_resistance",
    "maximum_current",
    "block_capacity",
    "block_resistance",
    "block_side_resistance",
    "block_front_resistance",
    "glue_resistance",
    "step",
    "loop_frequency",
    "loop_damping",
    "ambient_time",
    "piezo_gain",
    "hysteresis_rate",
    "real_pole",
    "resonance_decay",
    "resonance_square",
    "numerator_linear",
    "numerator_constant",
    "maximum_voltage",
)
_NOT_NEGATIVE = ("base_loss", "ambient_sd", "hysteresis_share", "hysteresis_skew", "creep_share")


@dataclass(frozen=True)
class Bimorph:
    """The strip: a piezo layer and a passive layer, from the paper's tables I and II.

    Attributes
    ----------
    length, width : float
        Free length and width, m.
    piezo_thickness, passive_thickness : float
        Thickness of the PZT and of the copper layer, m.
    piezo_compliance, passive_compliance : float
        Axial compliance, m²/N.
    piezo_coefficient : float
        Transverse piezoelectric coefficient d31, m/V; negative.
    piezo_expansion, passive_expansion : float
        Coefficient of thermal expansion, 1/K. The table prints PZT's 3.3e-6 without its unit.
    piezo_conductivity, passive_conductivity : float
        Thermal conductivity, W/(m K). PZT's is 1.4; the table has a hundred times that.
    piezo_heat, passive_heat : float
        Heat capacity of the volume, J/(m³ K). Copper's with its density of 8960 kg/m³; the table has zinc's.
    """

    length: float = 15e-3
    width: float = 2e-3
    piezo_thickness: float = 0.2e-3
    passive_thickness: float = 0.1e-3
    piezo_compliance: float = 15e-12
    passive_compliance: float = 9.1e-12
    piezo_coefficient: float = -100e-12
    piezo_expansion: float = 3.3e-6
    passive_expansion: float = 17e-6
    piezo_conductivity: float = 1.4
    passive_conductivity: float = 381.5
    piezo_heat: float = 7500.0 * 420.0
    passive_heat: float = 8960.0 * 386.0

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if not math.isfinite(value):
                raise ValueError(f"{each.name} must be finite, not {value}")
            if each.name not in ("piezo_coefficient", "piezo_expansion", "passive_expansion") and not value > 0:
                raise ValueError(f"{each.name} must be positive, not {value}")

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

    Parameters
    ----------
    bimorph : Bimorph
        The strip.

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

    Parameters
    ----------
    bimorph : Bimorph
        The strip.

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


@dataclass(frozen=True)
class HybridParameters:
    """Every number of the plant.

    The strip, the block, the convection coefficient and the poles and zeros of the piezo dynamics come from
    the paper. All others are assumed. The capacities of the cooler's faces are what makes the paper's 4 mHz:
    the block, the strip and a cooler without mass would have ten times that.

    Attributes
    ----------
    bimorph : Bimorph
        The strip.
    convection : float
        Heat transfer coefficient to air at 10 K, W/(m² K) (paper: 30).
    convection_share : float
        Share of it that grows with the fourth root of the rise above the room, in [0, 1].
    seebeck : float
        Seebeck coefficient of the cooler, V/K (the paper's table: 12e-3).
    conductance : float
        Thermal conductance of the cooler, W/K (the paper's table: 12e-3).
    resistance : float
        Electrical resistance of the cooler, ohm.
    face_capacity, back_capacity : float
        Heat capacities of the cooler's actuator face with clamp and thermistor, and of its back face, J/K.
    contact_resistance : float
        Thermal resistance from the actuator face to the first element of the beam, K/W.
    base_loss : float
        Conductance from the actuator face to air, W/K.
    maximum_current : float
        Rating of the cooler, A; larger commands are refused. The beam is coldest at about -0.43 A; beyond,
        more current cools less.
    block_capacity : float
        Heat capacity of either half of the block, J/K (38 by 20 by 25 mm of aluminium).
    block_resistance : float
        Thermal resistance along the block, K/W.
    block_side_resistance : float
        Thermal resistance from the sides of either half to air, K/W.
    block_front_resistance : float
        Thermal resistance from the front beside the cooler to air, K/W.
    glue_resistance : float
        Thermal resistance of the glue between cooler and block, K/W: 0.1 mm of 1 W/(m K) on 8 by 5 mm.
    step : float
        Step of the thermal time grid, s.
    loop_frequency, loop_damping : float
        Natural frequency (rad/s) and damping ratio of the closed temperature loop.
    ambient_temperature : float
        Mean temperature of the room, °C.
    ambient_sd, ambient_time : float
        Standard deviation (K) and correlation time (s) of the room temperature.
    straight_temperature : float
        Temperature at which the strip has no thermal deflection, °C.
    bending_quadratic, bending_cubic : float
        How the local curvature departs from proportionality to the rise d above the straight temperature:
        it goes as ``d + bending_quadratic d² + bending_cubic d³`` (1/K and 1/K²).
    piezo_gain, piezo_quadratic : float
        Deflection per voltage (m/V) and its part with the square of the voltage (m/V²).
    hysteresis_share : float
        Share of the gain that the hysteretic part takes back after a reversal.
    hysteresis_rate, hysteresis_skew : float
        Rates at which it saturates, 1/V; the second adds while it grows and takes off while it shrinks and
        must be the smaller.
    creep_share : float
        What each of the creep's lags adds, as a share of the deflection.
    creep_times : tuple of float
        Time constants of the three lags, s.
    piezo_warming : float
        Relative growth of the piezo deflection with the beam's rise above the straight temperature, 1/K.
    maximum_voltage : float
        Largest voltage on the piezo, V, of either sign; larger commands are refused. The paper's range is ±40 V.
    real_pole : float
        Real pole of the piezo dynamics D(s), 1/s (paper, eq. 21).
    resonance_decay, resonance_square : float
        Coefficients of the resonance ``s² + resonance_decay s + resonance_square``, 1/s and 1/s² (paper, eq. 21).
    numerator_linear, numerator_constant : float
        Coefficients of the numerator, in the same form. The gain is normalised: D(s)/D(0) is what acts.
    resonance_offset : float
        Relative shift of the resonance frequency at constant damping ratio, within ±0.5; ±0.03 is a sensible
        test of a notch.
    """

    bimorph: Bimorph = field(default_factory=Bimorph)
    convection: float = 30.0
    convection_share: float = 0.25
    seebeck: float = 11.6e-3
    conductance: float = 12.5e-3
    resistance: float = 5.2
    face_capacity: float = 0.55
    back_capacity: float = 0.09
    contact_resistance: float = 6.0
    base_loss: float = 2e-3
    maximum_current: float = 0.4
    block_capacity: float = 23.14
    block_resistance: float = 0.148
    block_side_resistance: float = 23.0
    block_front_resistance: float = 46.3
    glue_resistance: float = 2.5
    step: float = 0.01
    loop_frequency: float = 0.3
    loop_damping: float = 1.0
    ambient_temperature: float = 22.0
    ambient_sd: float = 0.15
    ambient_time: float = 400.0
    straight_temperature: float = 22.0
    bending_quadratic: float = 0.006
    bending_cubic: float = -1e-4
    piezo_gain: float = 0.283e-6
    piezo_quadratic: float = 2.5e-10
    hysteresis_share: float = 0.30
    hysteresis_rate: float = 0.040
    hysteresis_skew: float = 0.006
    creep_share: float = 0.012
    creep_times: tuple[float, float, float] = (1.0, 10.0, 100.0)
    piezo_warming: float = 0.003
    maximum_voltage: float = 60.0
    real_pole: float = 1274.0
    resonance_decay: float = 34.1
    resonance_square: float = 1.9e7
    numerator_linear: float = 2.58e4
    numerator_constant: float = 2.4e8
    resonance_offset: float = 0.0

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if isinstance(value, float | int) and not math.isfinite(value):
                raise ValueError(f"{each.name} must be finite, not {value}")
        for name in _POSITIVE:
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, not {getattr(self, name)}")
        for name in _NOT_NEGATIVE:
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, not {getattr(self, name)}")
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
        for name in ("ambient_temperature", "straight_temperature"):
            _check_temperature(name, getattr(self, name))
        if not self.seebeck * self.maximum_current < self.conductance:
            raise ValueError(
                f"maximum_current must stay below the thermal runaway at "
                f"{self.conductance / self.seebeck:.3g} A, not {self.maximum_current}"
            )


class HybridSnapshot(NamedTuple):
    """Every output of the plant at one instant.

    Attributes
    ----------
    base_temperature, tip_temperature : float
        Temperatures at the two thermistors, °C.
    sink_temperature, ambient_temperature : float
        Temperatures of the block's front and of the room, °C.
    current : float
        Current of the cooler, A; positive heats the beam.
    tec_voltage : float
        Voltage across the cooler, V.
    piezo_voltage : float
        Voltage on the piezo layer, V.
    thermal_deflection, piezo_deflection, deflection : float
        Deflection of the tip: its two parts and their sum, m.
    """

    base_temperature: float
    tip_temperature: float
    sink_temperature: float
    ambient_temperature: float
    current: float
    tec_voltage: float
    piezo_voltage: float
    thermal_deflection: float
    piezo_deflection: float
    deflection: float


def piezo_dynamics(parameters: HybridParameters) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Split D(s)/D(0) together with the creep into modes.

    Parameters
    ----------
    parameters : HybridParameters
        The numbers.

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


class HybridCantilever(GridPlant):
    """Deflection of a bimorph strip by temperature and by voltage, advanced in time.

    The cooler's current is positive when it heats the beam, as everywhere on the bench (the paper's is
    positive when it cools). Heating deflects the tip negatively, a positive voltage positively; both add.
    With I the current and absolute temperatures T, face and back of the cooler obey::

        C_face dT_face/dt = S T_face I + R I²/2 + K (T_back - T_face) + to the beam and to air
        C_back dT_back/dt = -S T_back I + R I²/2 + K (T_face - T_back) + to the block through the glue

    The block has two nodes, the beam ten elements of equal length. The thermal deflection is the local
    curvature ``(2 f/L²)(d + q d² + c d³)``, with f from `thermal_sensitivity`, times the distance to the tip,
    integrated over the beam. The piezo deflection comes from a Bouc-Wen hysteresis with creep, is filtered
    by D(s)/D(0) and grows with the temperature of the beam. There is no sensor noise here and no protection.

    Time has two parts, which act in one simulation:

    - Temperatures run on a fixed grid of ``parameters.step`` seconds from construction. What they do between
      two grid points is settled at the first of them, so that in between they are interpolated, without a
      delay: the deflection is continuous, with no staircase that a fine loop could see. A current or a
      change of the room acts at once where the plant stands at a grid point and from the next grid point
      otherwise.
    - A voltage acts at once, at any time. Between two voltages the piezo's hysteresis rests, and the modes
      of creep and dynamics follow in closed form: a microsecond costs as much as an hour.

    So neither the number nor the size of the calls of `advance` changes the trajectory, the noise included.

    At the start everything is at the temperature of the room, the hysteresis is virgin, and there is neither
    current nor voltage.

    Parameters
    ----------
    parameters : HybridParameters
        The numbers.
    rng : numpy.random.Generator
        The session's randomness: the temperature of the room. The plant spawns its own generator from it
        and never draws from `rng` itself, so that other users of it do not disturb the trajectory.
    """

    def __init__(self, parameters: HybridParameters, rng: np.random.Generator) -> None:
        super().__init__(parameters.step, rng)
        self._parameters = parameters
        self._nodes = _node_table(parameters)
        self._coefficients = _coefficients(parameters)
        self._fast_coefficients = _fast_coefficients(parameters)
        self._factors = np.zeros((kernels.FACTOR_ROWS, kernels.NODES))
        self._increment = np.zeros(kernels.NODES)
        self._state = np.zeros(kernels.STATE_SIZE)
        self._command = np.zeros(kernels.COMMAND_SIZE)
        self._fast = np.zeros(kernels.FAST_SIZE)
        # Whether the change over the step under way is known, and the time since the voltage last changed.
        self._ahead = False
        self._elapsed = 0.0

        fluctuation = parameters.ambient_sd * float(self._noise.standard_normal())
        self._rise = np.full(kernels.NODES, fluctuation)
        self._state[kernels.FLUCTUATION] = fluctuation
        self._state[kernels.FACTORED] = math.nan
        self._take_commands()

    @property
    def parameters(self) -> HybridParameters:
        """The numbers of this plant."""
        return self._parameters

    def advance(self, dt: float) -> None:
        """Advance the plant in time.

        Parameters
        ----------
        dt : float
            Time to advance, s, at least 0; any size.

        Raises
        ------
        ValueError
            If `dt` is negative or not finite.
        """
        super().advance(dt)
        self._elapsed += dt
        if not self._ahead and self._pending > _GRID_TOLERANCE:
            kernels.look_ahead(
                self._rise,
                self._increment,
                self._state,
                self._command,
                self._coefficients,
                self._nodes,
                self._factors,
            )
            self._ahead = True

    def _take_steps(self, normals: NDArray[np.float64]) -> None:
        kernels.advance_steps(
            normals,
            self._ahead,
            self._rise,
            self._increment,
            self._state,
            self._command,
            self._coefficients,
            self._nodes,
            self._factors,
        )
        self._ahead = False

    def _take_commands(self) -> None:
        if not self._ahead:
            kernels.take_commands(self._rise, self._state, self._command, self._coefficients)

    def drive(self, current_ampere: float) -> None:
        """Drive a constant current through the cooler.

        Parameters
        ----------
        current_ampere : float
            Current, A; positive heats the beam.

        Raises
        ------
        ValueError
            If the magnitude exceeds ``parameters.maximum_current``.
        """
        if not abs(current_ampere) <= self._parameters.maximum_current:
            raise ValueError(f"current must lie within ±{self._parameters.maximum_current} A, not {current_ampere} A")
        self._command[kernels.CLOSED] = 0.0
        self._command[kernels.COMMAND] = current_ampere
        self._take_commands()

    def release(self) -> None:
        """Switch the cooler's output off; the beam relaxes towards block and room."""
        self.drive(0.0)

    def regulate(self, target_celsius: float, current_limit: float = math.inf) -> None:
        """Close a temperature loop around the base: proportional and integral in the heat, not beyond the rating.

        Parameters
        ----------
        target_celsius : float
            Target of the base temperature, °C.
        current_limit : float, optional
            Largest current of either sign that the amplifier may give, A. A target out of its reach is
            approached and not reached.

        Raises
        ------
        ValueError
            If the target is not a temperature or the limit is negative or not a number.
        """
        _check_temperature("target_celsius", target_celsius)
        if not current_limit >= 0.0:
            raise ValueError(f"current_limit must not be negative, not {current_limit} A")
        if not self._command[kernels.CLOSED]:
            # The loop takes over with the heat that the present current gives.
            current = self.current
            pumped = self._parameters.seebeck * (self.base_temperature - _ABSOLUTE_ZERO)
            self._state[kernels.INTEGRAL] = current * (pumped + 0.5 * self._parameters.resistance * current)
        self._command[kernels.CLOSED] = 1.0
        self._command[kernels.TARGET] = target_celsius - self._parameters.ambient_temperature
        self._command[kernels.LIMIT] = current_limit
        self._take_commands()

    def step_ambient(self, change_kelvin: float) -> None:
        """Change the mean temperature of the room, as an opened window does; changes add up.

        Parameters
        ----------
        change_kelvin : float
            Change, K.

        Raises
        ------
        ValueError
            If the room's mean temperature would not be a temperature.
        """
        change = float(self._command[kernels.ROOM_STEP]) + change_kelvin
        _check_temperature("ambient temperature", self._parameters.ambient_temperature + change)
        self._command[kernels.ROOM_STEP] = change
        self._take_commands()

    def apply(self, voltage: float) -> None:
        """Apply a voltage to the piezo layer, at once.

        Parameters
        ----------
        voltage : float
            Voltage, V, within ±``parameters.maximum_voltage``.

        Raises
        ------
        ValueError
            If the voltage is out of range.
        """
        if not abs(voltage) <= self._parameters.maximum_voltage:
            raise ValueError(f"voltage must lie within ±{self._parameters.maximum_voltage} V, not {voltage} V")
        kernels.apply_voltage(voltage, self._elapsed, self._fast, self._fast_coefficients)
        self._elapsed = 0.0

    @property
    def _fraction(self) -> float:
        return self._pending / self._step if self._ahead else 0.0

    def _temperature(self, node: int) -> float:
        rise = float(self._rise[node]) + self._fraction * float(self._increment[node])
        return self._parameters.ambient_temperature + rise

    def _bending(self) -> tuple[float, float]:
        parts: tuple[float, float] = kernels.bending(
            self._fraction, self._rise, self._increment, self._coefficients, self._nodes
        )
        return parts

    def _unwarmed_piezo_deflection(self) -> float:
        return float(kernels.piezo_deflection(self._elapsed, self._fast, self._fast_coefficients))

    @property
    def base_temperature(self) -> float:
        """Temperature of the cooler's actuator face, where the beam is clamped, °C."""
        return self._temperature(kernels.FACE)

    @property
    def tip_temperature(self) -> float:
        """Temperature of the beam's last element, °C."""
        return self._temperature(kernels.NODES - 1)

    @property
    def sink_temperature(self) -> float:
        """Temperature of the block's front, behind the cooler, °C."""
        return self._temperature(kernels.BLOCK_FRONT)

    @property
    def ambient_temperature(self) -> float:
        """Temperature of the room, °C; constant between grid points."""
        return self._parameters.ambient_temperature + float(self._state[kernels.ROOM])

    @property
    def current(self) -> float:
        """Current of the cooler, A; positive heats the beam."""
        return float(self._state[kernels.CURRENT])

    @property
    def tec_voltage(self) -> float:
        """Voltage across the cooler, V: Seebeck and ohmic part, of the sign of a heating current."""
        p = self._parameters
        difference = self._temperature(kernels.FACE) - self._temperature(kernels.BACK)
        return p.seebeck * difference + p.resistance * self.current

    @property
    def peltier(self) -> PeltierTerminals:
        """The cooler as a TEC controller sees it."""
        return PeltierTerminals(self)

    @property
    def piezo_voltage(self) -> float:
        """Voltage on the piezo layer, V."""
        return float(self._fast[kernels.VOLTAGE])

    @property
    def thermal_deflection(self) -> float:
        """Deflection of the tip by temperature, m; about -175 to 101 µm at ±0.1 A."""
        return self._bending()[0]

    @property
    def piezo_deflection(self) -> float:
        """Deflection of the tip by voltage, m; about -9.3 to 10.1 µm at ±40 V."""
        return self._bending()[1] * self._unwarmed_piezo_deflection()

    @property
    def deflection(self) -> float:
        """Deflection of the tip, m."""
        thermal, warming = self._bending()
        return thermal + warming * self._unwarmed_piezo_deflection()

    @property
    def heat_to_air(self) -> float:
        """Heat flow from all parts to the air, W; in the steady state ``current * tec_voltage``."""
        return float(kernels.heat_to_air(self._fraction, self._rise, self._increment, self._state, self._nodes))

    @property
    def stored_heat(self) -> float:
        """Heat in all parts, J, from zero where they are at the room's mean temperature."""
        rise = self._rise + self._fraction * self._increment
        return float(self._nodes[kernels.CAPACITY] @ rise)

    def snapshot(self) -> HybridSnapshot:
        """Take all outputs at the present instant.

        Returns
        -------
        HybridSnapshot
            The outputs.
        """
        return HybridSnapshot(
            base_temperature=self.base_temperature,
            tip_temperature=self.tip_temperature,
            sink_temperature=self.sink_temperature,
            ambient_temperature=self.ambient_temperature,
            current=self.current,
            tec_voltage=self.tec_voltage,
            piezo_voltage=self.piezo_voltage,
            thermal_deflection=self.thermal_deflection,
            piezo_deflection=self.piezo_deflection,
            deflection=self.deflection,
        )


class PeltierTerminals:
    """The cooler of a hybrid cantilever with its two thermistors, as a TEC controller is wired to them.

    Parameters
    ----------
    plant : HybridCantilever
        The plant.
    """

    def __init__(self, plant: HybridCantilever) -> None:
        self._plant = plant
        self.regulate = plant.regulate
        self.drive = plant.drive
        self.release = plant.release

    @property
    def plate_temperature(self) -> float:
        """Temperature of the object sensor, at the base of the beam, °C."""
        return self._plant.base_temperature

    @property
    def sink_temperature(self) -> float:
        """Temperature of the block's front, °C."""
        return self._plant.sink_temperature

    @property
    def current(self) -> float:
        """Current, A; positive heats."""
        return self._plant.current

    @property
    def voltage(self) -> float:
        """Voltage across the cooler, V."""
        return self._plant.tec_voltage


def _check_temperature(name: str, celsius: float) -> None:
    if not _ABSOLUTE_ZERO < celsius < math.inf:
        raise ValueError(f"{name} must be a temperature above absolute zero, not {celsius} °C")


def _node_table(parameters: HybridParameters) -> NDArray[np.float64]:
    """Build the thermal chain: heat capacities and conductances of its nodes."""
    p, strip = parameters, parameters.bimorph
    beam = slice(kernels.BEAM, kernels.NODES)
    part = strip.length / kernels.BEAM_NODES
    nodes = np.zeros((kernels.NODE_ROWS, kernels.NODES))

    nodes[kernels.CAPACITY, [kernels.BLOCK_END, kernels.BLOCK_FRONT]] = p.block_capacity
    nodes[kernels.CAPACITY, kernels.BACK] = p.back_capacity
    nodes[kernels.CAPACITY, kernels.FACE] = p.face_capacity
    nodes[kernels.CAPACITY, beam] = strip.line_capacity * part

    nodes[kernels.LINK, kernels.BLOCK_END] = 1.0 / p.block_resistance
    nodes[kernels.LINK, kernels.BLOCK_FRONT] = 1.0 / p.glue_resistance
    nodes[kernels.LINK, kernels.BACK] = p.conductance
    nodes[kernels.LINK, kernels.FACE] = 1.0 / p.contact_resistance
    nodes[kernels.LINK, kernels.BEAM : kernels.NODES - 1] = strip.axial_conductance / part

    nodes[kernels.AIR, kernels.BLOCK_END] = 1.0 / p.block_side_resistance
    nodes[kernels.AIR, kernels.BLOCK_FRONT] = 1.0 / p.block_side_resistance + 1.0 / p.block_front_resistance
    nodes[kernels.AIR, kernels.FACE] = p.base_loss
    area = np.full(kernels.BEAM_NODES, strip.perimeter * part)
    area[-1] += strip.section  # the end face
    nodes[kernels.AIR, beam] = p.convection * (1.0 - p.convection_share) * area
    nodes[kernels.EXCESS, beam] = p.convection * p.convection_share * area / _CONVECTION_RISE**0.25

    # (2/L²) times the distance to the tip, integrated over each element.
    edges = np.linspace(0.0, 1.0, kernels.BEAM_NODES + 1)
    nodes[kernels.WEIGHT, beam] = np.diff(2.0 * edges - edges**2)
    return nodes


def _coefficients(parameters: HybridParameters) -> NDArray[np.float64]:
    """Prepare the numbers that the compiled thermal step needs."""
    p = parameters
    room_decay = math.exp(-p.step / p.ambient_time)
    capacity = p.face_capacity + p.bimorph.line_capacity * p.bimorph.length
    values = {
        kernels.STEP: p.step,
        kernels.KELVIN: p.ambient_temperature - _ABSOLUTE_ZERO,
        kernels.SEEBECK: p.seebeck,
        kernels.RESISTANCE: p.resistance,
        kernels.ROOM_DECAY: room_decay,
        kernels.ROOM_KICK: p.ambient_sd * math.sqrt(1.0 - room_decay**2),
        kernels.LOOP_PROPORTIONAL: 2.0 * p.loop_damping * p.loop_frequency * capacity,
        kernels.LOOP_INTEGRAL: p.loop_frequency**2 * capacity * p.step,
        kernels.MAXIMUM_CURRENT: p.maximum_current,
        kernels.STRAIGHT: p.ambient_temperature - p.straight_temperature,
        kernels.SENSITIVITY: thermal_sensitivity(p.bimorph),
        kernels.QUADRATIC: p.bending_quadratic,
        kernels.CUBIC: p.bending_cubic,
        kernels.WARM_GAIN: p.piezo_warming,
    }
    return np.array([values[place] for place in range(kernels.COEFFICIENT_SIZE)])


def _fast_coefficients(parameters: HybridParameters) -> NDArray[np.float64]:
    """Prepare the numbers that the compiled piezo part needs."""
    p = parameters
    poles, shares = piezo_dynamics(p)
    values = np.zeros(kernels.FAST_COEFFICIENT_SIZE)
    values[kernels.GAIN] = p.piezo_gain
    values[kernels.VOLTAGE_QUADRATIC] = p.piezo_quadratic
    values[kernels.LAG_GAIN] = p.hysteresis_share * p.piezo_gain
    values[kernels.LAG_WITH] = p.hysteresis_rate + p.hysteresis_skew
    values[kernels.LAG_AGAINST] = p.hysteresis_rate - p.hysteresis_skew
    values[kernels.STEADY] = 1.0 + len(p.creep_times) * p.creep_share
    values[kernels.DAMPING] = -poles[0].real
    values[kernels.FREQUENCY] = poles[0].imag
    values[kernels.COSINE_GAIN] = 2.0 * shares[0].real
    values[kernels.SINE_GAIN] = -2.0 * shares[0].imag
    values[kernels.FIRST_RATE : kernels.FIRST_RATE + kernels.REAL_MODES] = -poles[2:].real
    values[kernels.FIRST_GAIN :] = shares[2:].real
    return values
