"""A thermoelectric cooler (Peltier module) as part of a plant: driven by a current, or regulated in temperature."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sim_devices.plants.grid import GridPlant, PlantParameters, Signed, check_temperature

# Places of the command: regulated (1) or driven (0), target of the temperature, current limit (A), current (A).
CLOSED, TARGET, LIMIT, COMMAND = range(4)
COMMAND_SIZE = 4


@dataclass(frozen=True, kw_only=True)
class CooledParameters(PlantParameters):
    """Numbers of a plant with a cooler; the subclasses describe them."""

    seebeck: float
    conductance: float
    resistance: float
    maximum_current: float
    ambient_temperature: Signed

    def __post_init__(self) -> None:
        super().__post_init__()
        check_temperature("ambient_temperature", self.ambient_temperature)
        if not self.seebeck * self.maximum_current < self.conductance:
            raise ValueError(
                f"maximum_current must stay below the thermal runaway at "
                f"{self.conductance / self.seebeck:.3g} A, not {self.maximum_current}"
            )


C = TypeVar("C", bound=CooledParameters)


class CooledPlant(GridPlant[C]):
    """A plant whose plate is regulated, driven by a constant current, or left alone."""

    _command: NDArray[np.float64]

    def drive(self, current_ampere: float) -> None:
        """Drive a constant current; the loop is open.

        Parameters
        ----------
        current_ampere : float
            Current, A; positive heats the plate.

        Raises
        ------
        ValueError
            If the magnitude exceeds the rating ``parameters.maximum_current``.
        """
        if not abs(current_ampere) <= self._parameters.maximum_current:
            raise ValueError(f"current must lie within ±{self._parameters.maximum_current} A, not {current_ampere} A")
        self._command[CLOSED] = 0.0
        self._command[COMMAND] = current_ampere
        self._take_commands()

    def release(self) -> None:
        """Switch the output off; the plate relaxes towards heat sink and room."""
        self.drive(0.0)

    def regulate(self, target_celsius: float, current_limit: float = math.inf) -> None:
        """Close the temperature loop.

        Parameters
        ----------
        target_celsius : float
            Target of the plate temperature, °C.
        current_limit : float, optional
            Largest current of either sign that the amplifier may give, A. A target out of its reach is approached
            and not reached.

        Raises
        ------
        ValueError
            If the target is not a temperature or the limit is negative or not a number.
        """
        check_temperature("target_celsius", target_celsius)
        if not current_limit >= 0.0:
            raise ValueError(f"current_limit must not be negative, not {current_limit} A")
        if not self._command[CLOSED]:
            self._take_over()
        self._command[CLOSED] = 1.0
        self._command[TARGET] = self._loop_target(target_celsius)
        self._command[LIMIT] = current_limit
        self._take_commands()

    def _loop_target(self, celsius: float) -> float:
        """Return a target in the unit of the command."""
        return celsius

    def _take_over(self) -> None:
        """Prepare the closed loop for the present state."""

    def _take_commands(self) -> None:
        """Apply the commands at once, if the plant does so between grid points."""
