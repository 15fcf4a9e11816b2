"""The commands of every muscle: a voltage, the fan, and a load to carry or a length to be held at."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from sim_devices.plants.grid import (
    GridPlant,
    NotNegative,
    PlantParameters,
    Seed,
    Signed,
    check_temperature,
)

MILLIMETRE = 1e-3

# Command: voltage (V), fan or exhaust (1 on), length imposed (1) or force imposed (0), load (N), position (mm).
VOLTAGE, FAN, CLAMPED, LOAD, PLACE = range(5)
COMMAND_SIZE = 5

_FORCES = 128
"""Grid points of which the force is kept."""


@dataclass(frozen=True, kw_only=True)
class MuscleParameters(PlantParameters):
    """Numbers that all muscles have."""

    specimen_seed: Seed = 2017
    """Seed of the grains or contacts. The specimen does not depend on the session's seed."""
    rest_length: float
    """Length of the unloaded muscle as made, cold or empty, m."""
    series_stiffness: float = 20e3
    """Stiffness of frame and load cell in series with the muscle, N/m."""
    pretension: NotNegative = 0.3
    """Load under which the muscle is first driven when it is conditioned, N."""
    step: float = 0.1
    """Step of the internal time grid, s."""
    length_step: float = 0.1e-3
    """Largest sub-step of the position, m."""
    rated_voltage: float = 3.0
    maximum_voltage: float = 5.0
    """Voltage to which the muscle is conditioned and highest effective voltage, V. Higher commands are refused."""
    resistance: float
    """Electrical resistance that the supply sees, ohm; constant."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.pretension <= self.largest_load:
            raise ValueError(f"pretension must not exceed {self.largest_load:.4g} N, not {self.pretension} N")
        if not self.rated_voltage <= self.maximum_voltage:
            raise ValueError(f"rated_voltage must not exceed {self.maximum_voltage} V, not {self.rated_voltage} V")

    @property
    @abstractmethod
    def largest_load(self) -> float:
        """Largest load, N; a larger one is refused, and the force of a muscle stretched further stays there."""

    @property
    def reach(self) -> float:
        """Farthest that the end may be held from its resting position, to either side, m."""
        return 0.5 * self.rest_length


@dataclass(frozen=True, kw_only=True)
class HeatedParameters(MuscleParameters):
    """Numbers of a muscle that the voltage heats."""

    ambient_temperature: Signed = 25.0
    """Mean temperature of the room, °C."""
    time_constant: float
    fan_time_constant: float
    """Thermal time constants in still air and with the fan on, s. The fan raises the heat loss, so that the steady
    temperature rise falls in the same ratio."""
    rise: float
    """Steady temperature rise in still air at the rated voltage, K. It goes as the voltage squared."""
    temperature_step: float = 1.0
    """Largest sub-step of the temperature, K."""
    ambient_sd: NotNegative = 0.0
    ambient_time: float = 120.0
    """Standard deviation (K) and correlation time (s) of the room temperature. Zero, the default, switches it off;
    0.3 K is sensible for dynamic tests."""
    ambient_gain: Signed = 0.004
    """Relative change of the heating gain with the deviation of the room temperature, 1/K."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_temperature("ambient_temperature", self.ambient_temperature)


M = TypeVar("M", bound=MuscleParameters)


class Muscle(GridPlant[M]):
    """A muscle that a voltage drives, and that carries a load or is held.

    The muscle's lower end carries a dead load (`hang`: the force is imposed, the length follows) or is held by a
    servo (`clamp`: the length is imposed, the force follows). Changing between them keeps the muscle's memory, its
    force and its position: clamping starts from where the end hangs, hanging from the force it has. Only a slack
    muscle's end has a position of the servo's alone; it comes back to the muscle when a load is hung on. Frame and
    load cell are in series with the muscle, so its position, which is what `clamp` imposes, exceeds its length by
    the force over their stiffness.

    Time runs on a fixed grid from construction. `advance` carries out the grid steps that have become due and holds
    the remainder, and outputs stay constant between grid points. A command acts from the next grid step on, at
    once: first the load or the position is moved there, at the pressure or temperature of the step before, then
    the muscle is inflated or heated. So neither the number nor the size of the calls of `advance` changes the
    trajectory, the noise included. There is no sensor noise here and no protection either.

    Attributes
    ----------
    forces : ndarray
        The force (N) at the last grid points, in a ring: that of the n-th step is in place n modulo its size, and
        behind the ring stands n.
    """

    def __init__(self, parameters: M, rng: np.random.Generator) -> None:
        super().__init__(parameters, rng)
        self._command = np.zeros(COMMAND_SIZE)
        self.forces = np.zeros(_FORCES + 1)

    def apply(self, voltage: float) -> None:
        """Apply a voltage.

        Parameters
        ----------
        voltage : float
            Effective (root mean square) voltage, V, from 0 to ``parameters.maximum_voltage``.

        Raises
        ------
        ValueError
            If the voltage is out of range.
        """
        if not 0.0 <= voltage <= self._parameters.maximum_voltage:
            raise ValueError(f"voltage must lie within 0 and {self._parameters.maximum_voltage} V, not {voltage} V")
        self._command[VOLTAGE] = voltage

    def blow(self, on: bool) -> None:
        """Switch the fan of a heated muscle, or open the quick exhaust of an inflated one.

        Parameters
        ----------
        on : bool
            Whether the fan runs or the exhaust is open; it is not at the start. The fan shortens the time constant
            and lowers the steady rise alike; the exhaust shortens the time constant of a falling pressure and
            leaves the steady pressure as it is.
        """
        self._command[FAN] = float(on)

    def hang(self, load_newton: float) -> None:
        """Hang a dead load on the muscle: force imposed, length follows.

        Parameters
        ----------
        load_newton : float
            Load, N, from 0 to the largest that the muscle's parameters allow.

        Raises
        ------
        ValueError
            If the load is out of range.
        """
        largest = self._parameters.largest_load
        if not 0.0 <= load_newton <= largest:
            raise ValueError(f"load_newton must lie within 0 and {largest:.4g} N, not {load_newton} N")
        self._command[CLAMPED] = 0.0
        self._command[LOAD] = load_newton

    def clamp(self, length_metre: float) -> None:
        """Hold the muscle's end by the servo: length imposed, force follows.

        Parameters
        ----------
        length_metre : float
            Position of the moving end, m, positive when the muscle is elongated; to either side within
            ``parameters.rest_length`` for the wire and half of it for the other muscles. It is the elongation of
            the muscle with frame and load cell. A muscle that is longer is slack, at 0 N.

        Raises
        ------
        ValueError
            If the position is out of range.
        """
        if not abs(length_metre) <= self._parameters.reach:
            raise ValueError(f"length_metre must lie within ±{self._parameters.reach} m, not {length_metre} m")
        self._command[CLAMPED] = 1.0
        self._command[PLACE] = length_metre / MILLIMETRE

    @property
    @abstractmethod
    def force(self) -> float:
        """Tension, N."""

    @property
    @abstractmethod
    def position(self) -> float:
        """Position of the moving end, m from rest: the elongation of muscle, frame and load cell."""

    def _keep_first_force(self) -> None:
        """Keep the force with which time begins."""
        self.forces[0] = self.force

    @property
    def voltage(self) -> float:
        """Effective voltage, V."""
        return float(self._command[VOLTAGE])

    @property
    def current(self) -> float:
        """Current from the supply, A: the voltage over the (constant) resistance, without delay."""
        return self.voltage / self._parameters.resistance
