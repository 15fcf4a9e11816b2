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

The paper's three actuators (table III) are this one plant: the thermal bimorph is this plant without `apply`,
the classic piezo cantilever this plant without `drive`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.base import DeferredModule
from sim_devices.plants.cooler import CooledPlant
from sim_devices.plants.grid import (
    ABSOLUTE_ZERO,
    GRID_TOLERANCE,
    Floats,
    check_temperature,
    fluctuation,
)
from sim_devices.plants.hybrid_parameters import HybridParameters, piezo_dynamics, thermal_sensitivity

if TYPE_CHECKING:
    from sim_devices.plants import _hybrid_kernels as kernels
else:
    kernels = DeferredModule("sim_devices.plants._hybrid_kernels")

# Rise (K) at which the free convection's share is that of the parameters.
_CONVECTION_RISE = 10.0


class HybridCantilever(CooledPlant[HybridParameters]):
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
    rng : numpy.random.Generator
        The session's randomness: the temperature of the room; see `GridPlant`.
    """

    def __init__(self, parameters: HybridParameters, rng: np.random.Generator) -> None:
        super().__init__(parameters, rng)
        self._ambient = parameters.ambient_temperature
        self._numbers = np.zeros(sum(kernels.PARTS))
        self._divide()
        share, shape, coefficients = self._constants
        share[:] = _shares()
        shape[:] = _shape(parameters)
        self._fast_coefficients[:] = _fast_coefficients(parameters)
        coefficients[:] = _coefficients(parameters)
        self._nodes[:] = _node_table(parameters)
        # Whether the change over the step under way is known, and the time since the voltage last changed.
        self._ahead = False
        self._elapsed = 0.0
        # Whether a course of the voltage goes on, and since when.
        self._is_led = False
        self._passed = 0.0

        deviation = parameters.ambient_sd * float(self._noise.standard_normal())
        self._rise[:] = deviation
        self._state[kernels.FLUCTUATION] = deviation
        self._state[kernels.FACTORED] = math.nan
        self._take_commands()

    def _divide(self) -> None:
        """Make the parts of the numbers, which are views."""
        (
            self._rise,
            self._increment,
            share,
            shape,
            self._fast,
            self._fast_coefficients,
            self._state,
            self._command,
            coefficients,
            nodes,
            _,
            _,
        ) = np.split(self._numbers, np.cumsum(kernels.PARTS)[:-1])
        self._nodes = nodes.reshape(kernels.NODE_ROWS, kernels.NODES)
        self._constants = share, shape, coefficients

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the state of another; its parts are views of the own numbers."""
        self.__dict__.update(state)
        self._divide()

    def advance(self, dt: float) -> None:
        """Advance the plant in time; see `GridPlant.advance`."""
        pending = self._pending + dt
        if dt >= 0.0 and pending + GRID_TOLERANCE < self._step:
            # What the base does with less than a step.
            self._pending = pending
            if not self._ahead and pending > GRID_TOLERANCE:
                kernels.look_ahead(self._numbers)
                self._ahead = True
        else:
            super().advance(dt)
        self._elapsed += dt
        if self._is_led:
            self._passed += dt
            self._elapsed, is_over = kernels.follow_course(self._passed, self._elapsed, self._numbers)
            self._is_led = not is_over

    def _take_steps(self, normals: Floats) -> None:
        begin_next = self._pending > GRID_TOLERANCE
        kernels.advance_steps(normals, self._ahead, begin_next, self._numbers)
        self._ahead = begin_next

    def _take_commands(self) -> None:
        if not self._ahead:
            kernels.take_commands(self._numbers)

    def _loop_target(self, celsius: float) -> float:
        return celsius - self._parameters.ambient_temperature

    def _take_over(self) -> None:
        # The loop takes over with the heat that the present current gives.
        current = self.current
        pumped = self._parameters.seebeck * (self.base_temperature - ABSOLUTE_ZERO)
        self._state[kernels.INTEGRAL] = current * (pumped + 0.5 * self._parameters.resistance * current)

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
        check_temperature("ambient temperature", self._parameters.ambient_temperature + change)
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
        self._check_voltage(voltage)
        kernels.apply_voltage(voltage, self._elapsed, self._numbers)
        self._elapsed = 0.0
        self._is_led = False

    def lead(self, start: float, target: float, steps: int, time_constant: float) -> None:
        """Let the voltage go as a lag of first order does, in even steps.

        Each step comes at the instant at which the lag passes its middle. A voltage that is ahead of the lag waits
        for it.

        Parameters
        ----------
        start, target : float
            Where the lag is now, and where it goes, V, within ±``parameters.maximum_voltage``.
        steps : int
            Number of steps, 0 or more.
        time_constant : float
            Of the lag, s.

        Raises
        ------
        ValueError
            If the voltage is out of range.
        """
        highest = self._parameters.maximum_voltage
        if not (-highest <= start <= highest and -highest <= target <= highest):
            self._check_voltage(start)
            self._check_voltage(target)
        self._elapsed = kernels.lead_voltage(start, target, steps, time_constant, self._elapsed, self._numbers)
        self._is_led, self._passed = steps > 0, 0.0

    def _check_voltage(self, voltage: float) -> None:
        if not abs(voltage) <= self._parameters.maximum_voltage:
            raise ValueError(f"voltage must lie within ±{self._parameters.maximum_voltage} V, not {voltage} V")

    @property
    def _fraction(self) -> float:
        return self._pending / self._step if self._ahead else 0.0

    @property
    def numbers(self) -> Floats:
        """All its numbers, as `_hybrid_kernels` takes them; read them only."""
        return self._numbers

    def moment(self) -> tuple[float, float]:
        """Return the fraction of the grid step under way, and the time since the voltage last changed, s."""
        return self._pending / self._step if self._ahead else 0.0, self._elapsed

    def _temperature(self, node: int) -> float:
        rise: float = self._rise.item(node)
        if self._ahead:
            rise += self._pending / self._step * self._increment.item(node)
        return self._ambient + rise

    def _bending(self) -> tuple[float, float]:
        parts: tuple[float, float] = kernels.bending(self._fraction, self._numbers)
        return parts

    def _unwarmed_piezo_deflection(self) -> float:
        return float(kernels.piezo_deflection(self._elapsed, self._numbers))

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
        return self.terminals()[3]

    def terminals(self) -> tuple[float, float, float, float]:
        """Return the temperatures of base and block's front (°C), current (A) and voltage (V) of the cooler."""
        # In one call, as a TEC controller looks with each request.
        seen: tuple[float, float, float, float] = kernels.terminals(
            self._pending / self._step if self._ahead else 0.0, self._ambient, self._numbers
        )
        return seen

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
        # In one call, as a fast loop asks for it with each sample.
        total: float = kernels.deflection(
            self._pending / self._step if self._ahead else 0.0, self._elapsed, self._numbers
        )
        return total

    @property
    def heat_to_air(self) -> float:
        """Heat flow from all parts to the air, W; in the steady state ``current * tec_voltage``."""
        return float(kernels.heat_to_air(self._fraction, self._numbers))

    @property
    def stored_heat(self) -> float:
        """Heat in all parts, J, from zero where they are at the room's mean temperature."""
        rise = self._rise + self._fraction * self._increment
        return float(self._nodes[kernels.CAPACITY] @ rise)


class PeltierTerminals:
    """The cooler of a hybrid cantilever with its two thermistors, as a TEC controller is wired to them.

    A limiter in the wires holds a current beyond the cooler's rating at that rating, as the closed loop does.
    """

    def __init__(self, plant: HybridCantilever) -> None:
        self._plant = plant
        self._rating = plant.parameters.maximum_current
        self.terminals = plant.terminals
        self.regulate = plant.regulate
        self.release = plant.release

    def drive(self, current_ampere: float) -> None:
        """Drive a constant current, A."""
        self._plant.drive(min(max(current_ampere, -self._rating), self._rating))

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


def _node_table(parameters: HybridParameters) -> Floats:
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
    return nodes


def _shares() -> Floats:
    """Return the share of each node in the bending: (2/L²) times the distance to the tip, integrated over it."""
    shares = np.zeros(kernels.NODES)
    edges = np.linspace(0.0, 1.0, kernels.BEAM_NODES + 1)
    shares[kernels.BEAM :] = np.diff(2.0 * edges - edges**2)
    return shares


def _shape(parameters: HybridParameters) -> Floats:
    """Prepare the numbers that the bending needs."""
    p = parameters
    values = np.zeros(kernels.SHAPE_SIZE)
    values[kernels.STRAIGHT] = p.ambient_temperature - p.straight_temperature
    values[kernels.QUADRATIC] = p.bending_quadratic
    values[kernels.CUBIC] = p.bending_cubic
    values[kernels.SENSITIVITY] = thermal_sensitivity(p.bimorph)
    values[kernels.WARM_GAIN] = p.piezo_warming
    return values


def _coefficients(parameters: HybridParameters) -> kernels.Coefficients:
    """Prepare the numbers that the compiled thermal step needs."""
    p = parameters
    room_decay, room_kick = fluctuation(p.ambient_sd, p.ambient_time, p.step)
    capacity = p.face_capacity + p.bimorph.line_capacity * p.bimorph.length
    return kernels.Coefficients(
        step=p.step,
        kelvin=p.ambient_temperature - ABSOLUTE_ZERO,
        seebeck=p.seebeck,
        resistance=p.resistance,
        room_decay=room_decay,
        room_kick=room_kick,
        loop_proportional=2.0 * p.loop_damping * p.loop_frequency * capacity,
        loop_integral=p.loop_frequency**2 * capacity * p.step,
        maximum_current=p.maximum_current,
    )


def _fast_coefficients(parameters: HybridParameters) -> Floats:
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
