"""Super-coiled polymer muscle: silver-plated nylon thread, twisted until it coils, heated by a voltage.

The plant is deliberately not of the structure that identification fits. A fitted model is a pair of nested
hysteresis operators in voltage and force; in the plant heat contracts and softens the coil at once, coils that
touch end the contraction, and the friction between them depends on temperature, load and contact.

Sources: coils that contract as heat untwists the thread, and that cannot contract where they touch, are those of
Haines et al., "Artificial muscles from fishing line and sewing thread", Science 343, 2014; Joule heating of plated
thread, a single thermal time constant, and stiffness, damping and thermal force side by side are those of Yip and
Niemeyer, "On the control and properties of supercoiled polymer artificial muscles", IEEE Transactions on Robotics
33, 2017; springs behind sliders as friction are those of Iwan, Journal of Applied Mechanics 33, 1966. The size is
that of the muscle in Zhang and Yip, Robotics: Science and Systems, 2017, Fig. 1c: a coil of 0.62 mm. All other
numbers are *assumed*, chosen so that the loads and voltages of the other muscles suit this one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sim_devices.plants.friction_muscle import FrictionMuscle, FrictionParameters, coefficients
from sim_devices.plants.grid import NotNegative, Record, Signed
from sim_devices.plants.muscle import MILLIMETRE, HeatedParameters


@dataclass(frozen=True, kw_only=True)
class CoiledPolymerParameters(FrictionParameters, HeatedParameters):
    """Every number of the plant; those shared with other muscles are described in its base classes.

    The heat of 100 mm of coil, some 0.06 J/K, and 0.75 W at 3 V go with a time constant of 8 s and a rise of 95 K.
    3 V are 120 °C. Nylon is spoilt above some 180 °C, at 3.8 V, which the plant leaves to the rig's limits.
    """

    contact_stiffness: float = 600.0
    contact_spread: float = 0.8
    rest_length: float = 100e-3
    force_limit: float = 15.0
    resistance: float = 12.0
    time_constant: float = 8.0
    fan_time_constant: float = 3.0
    rise: float = 95.0
    cold_stiffness: float = 1.3e3
    hot_stiffness: float = 0.9e3
    """Stiffness of the coil well below and well above the glass transition, N/m."""
    softening: Signed = 60.0
    softening_width: float = 15.0
    """Middle and width of the softening, °C and K; nylon 6,6 has its glass transition near 50 °C."""
    expansion: NotNegative = 0.07e-3
    expansion_above: NotNegative = 0.07e-3
    """Contraction of the unloaded coil per temperature below the softening, and what is added above it, m/K."""
    coil_contact: NotNegative = 1.0e6
    """Force with which touching coils resist contraction, per square of it, N/m²."""
    coil_length: Signed = -6.0e-3
    """Elongation below which coils touch, m."""
    friction: NotNegative = 0.35
    """Yield force of all contacts of the cold unloaded muscle, N. It softens with the coil."""
    friction_load: NotNegative = 0.06
    """Yield force of all contacts per tension of the coil, in [0, 1)."""
    friction_coils: NotNegative = 0.1
    """Yield force of all contacts per force between touching coils, in [0, 1)."""
    slip: NotNegative = 0.4
    """How much of the free contraction an average contact sees as the heated thread untwists at constant length."""
    arm_stiffness: NotNegative = 100.0
    arm_time: float = 6.0
    """Stiffness (N/m) and relaxation time (s) of the Maxwell arm: the viscoelastic part."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("friction_load", "friction_coils"):
            if not getattr(self, name) < 1.0:
                # Otherwise a muscle that is stretched further could pull less.
                raise ValueError(f"{name} must lie in [0, 1), not {getattr(self, name)}")
        if not self.hot_stiffness <= self.cold_stiffness:
            raise ValueError(
                f"hot_stiffness must not exceed cold_stiffness, not {self.hot_stiffness} > {self.cold_stiffness} N/m"
            )


class CoiledPolymerMuscle(FrictionMuscle[CoiledPolymerParameters]):
    """Length and force of a coiled polymer muscle, advanced in time.

    At temperature T and elongation x the tension is::

        F = k(T) [x + a(T)]                     coil: k falls at the softening, a rises
            - c (x1 - x)², if x < x1            touching coils
            + Maxwell arm                       stiffness and relaxation time
            + sum of the contacts               each limited by its share of
                                                y0 k(T)/k(cold) + m k(T) [x + a(T)] + n c (x1 - x)²

    A contact moves with x and, by a share of its own, against a(T): the thread untwists even where the length is
    held. The contacts do not depend on the rate; temperature and Maxwell arm need some 60 s to settle.

    At the start the muscle is cold and hangs without load, after it was heated under the pretension and went twice
    through 0 V, rated voltage, 0 V at constant position; `length` counts from there.

    Parameters
    ----------
    rng : numpy.random.Generator
        The session's randomness: the temperature of the room; see `GridPlant`.
    """

    def __init__(self, parameters: CoiledPolymerParameters, rng: np.random.Generator) -> None:
        room = parameters.ambient_temperature
        super().__init__(parameters, _coefficients(parameters), room, room + parameters.rise, rng)
        offset = parameters.ambient_sd * float(self._noise.standard_normal())
        self._state["offset"] = offset
        self._drive(room + offset, clamped=False)
        self._keep_first_force()

    @property
    def temperature(self) -> float:
        """Temperature of the muscle, °C; 120 °C at 3 V."""
        return float(self._state["drive"])

    @property
    def ambient_temperature(self) -> float:
        """Temperature of the room, °C."""
        return float(self._parameters.ambient_temperature + self._state["offset"])


def _coefficients(parameters: CoiledPolymerParameters) -> Record:
    """Prepare the numbers that the compiled loops need every step."""
    p = parameters
    return coefficients(
        p,
        p.ambient_sd,
        p.ambient_time,
        drive_step=p.temperature_step,
        base=p.ambient_temperature,
        gain=p.rise / p.rated_voltage**2,
        decay=math.exp(-p.step / p.time_constant),
        fan_decay=math.exp(-p.step / p.fan_time_constant),
        fan_share=p.fan_time_constant / p.time_constant,
        offset_gain=p.ambient_gain,
        arm=p.arm_stiffness * MILLIMETRE,
        arm_time=p.arm_time,
        friction=p.friction,
        friction_press=p.friction_coils,
        friction_drive=p.friction_load,
        slip=p.slip,
        cold_stiffness=p.cold_stiffness * MILLIMETRE,
        hot_stiffness=p.hot_stiffness * MILLIMETRE,
        softening=p.softening,
        softening_width=p.softening_width,
        expansion=p.expansion / MILLIMETRE,
        expansion_above=p.expansion_above / MILLIMETRE,
        contact=p.coil_contact * MILLIMETRE**2,
        contact_at=p.coil_length / MILLIMETRE,
    )
