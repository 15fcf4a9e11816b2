"""McKibben muscle: a rubber bladder in a braid, inflated through a pressure regulator that a voltage sets.

The plant is deliberately not of the structure that identification fits. A fitted model is a pair of nested
hysteresis operators in voltage and force; in the plant the pressure multiplies a stiffness that depends on the
length, and it presses the threads together, so that friction, too, is a matter of pressure and length.

Sources: the static force is that of Chou and Hannaford, "Measurement and modeling of McKibben pneumatic
artificial muscles", IEEE Transactions on Robotics and Automation 12, 1996; a dry friction in proportion to
pressure and contact surface is that of Tondu and Lopez, "Modeling and control of McKibben artificial muscle robot
actuators", IEEE Control Systems Magazine 20, 2000; friction as many springs behind sliders is that of Iwan,
Journal of Applied Mechanics 33, 1966, used for such muscles by Vo-Minh et al., "A new approach to modeling
hysteresis in a pneumatic artificial muscle using the Maxwell-slip model", IEEE/ASME Transactions on Mechatronics
16, 2011. The nominal diameter of 8 mm is that of the muscle in Zhang and Yip, Robotics: Science and Systems, 2017,
Fig. 1b. All numbers are *assumed*, chosen so that the loads and voltages of the other muscles suit this one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sim_devices.plants.friction_muscle import FrictionMuscle, FrictionParameters, coefficients
from sim_devices.plants.grid import NotNegative, Record
from sim_devices.plants.muscle import MILLIMETRE

_BAR = 1e5
# One bar, N/mm².
_BAR_NEWTON = 0.1


@dataclass(frozen=True, kw_only=True)
class McKibbenParameters(FrictionParameters):
    """Every number of the plant; those shared with other muscles are described in its base classes."""

    contact_stiffness: float = 1.2e3
    contact_spread: float = 0.8
    rest_length: float = 110e-3
    force_limit: float = 40.0
    length_step: float = 0.25e-3
    resistance: float = 10e3
    thread_length: float = 131e-3
    """Length of a braid thread, m; with `turns` and `rest_length` it makes a rest angle of 33° and a braid diameter
    of 6.5 mm at rest, 9.7 mm at the angle of 54.7° where the muscle pulls no longer."""
    turns: float = 3.5
    """Turns of a thread around the muscle."""
    bladder_stiffness: float = 300.0
    """Stiffness of the bladder and the braid about the resting length, N/m."""
    bladder_cube: NotNegative = 0.12e6
    """Cubic stiffening of the bladder, N/m³."""
    jam: NotNegative = 0.22e6
    """Force with which the braid jams on the bladder, per square of the elongation, N/m²."""
    friction: NotNegative = 0.2
    """Yield force of all contacts of the empty muscle, N."""
    friction_coefficient: NotNegative = 0.0025
    """Yield force of all contacts per pressure and contact surface, the latter being that of the resting braid. The
    surface changes by less than a tenth over the stroke, which is left out."""
    friction_jam: NotNegative = 0.08
    """Yield force of all contacts per jamming force, in [0, 1)."""
    slip: NotNegative = 1.5e-8
    """How far an average contact slips at constant length as the bladder presses the braid outward, m/Pa."""
    pressure_gain: float = 0.5e5
    """Pressure per voltage, Pa/V."""
    pressure_band: NotNegative = 1.25e3
    """Half-width of the regulator's hysteresis, Pa: a quarter of a percent of a span of 5 bar."""
    time_constant: float = 0.3
    """Time constant of the pressure, s."""
    exhaust_time_constant: float = 0.1
    """Time constant of a falling pressure with the quick exhaust open, s."""
    pressure_step: float = 2e3
    """Largest sub-step of the pressure, Pa."""
    supply_sd: NotNegative = 0.0
    supply_time: float = 10.0
    """Standard deviation (Pa) and correlation time (s) of the pressure that the regulator gives. Zero, the default,
    switches it off; 500 Pa is sensible for dynamic tests."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.friction_jam < 1.0:
            # Otherwise a muscle that is stretched further could pull less.
            raise ValueError(f"friction_jam must lie in [0, 1), not {self.friction_jam}")
        shortest = self.thread_length / math.sqrt(3.0)
        if not shortest < self.rest_length < self.thread_length:
            # At the lower limit the threads are at 54.7° and the muscle pulls no longer.
            raise ValueError(
                f"rest_length must lie between {shortest:.4g} and {self.thread_length} m (thread_length / √3 and "
                f"thread_length), not {self.rest_length} m"
            )

    @property
    def braid_diameter(self) -> float:
        """Diameter of the resting braid, m."""
        return math.sqrt(self.thread_length**2 - self.rest_length**2) / (self.turns * math.pi)

    @property
    def braid_surface(self) -> float:
        """Surface of the resting braid, m²."""
        return math.pi * self.braid_diameter * self.rest_length


class McKibbenMuscle(FrictionMuscle[McKibbenParameters]):
    """Length and force of a braided pneumatic muscle, advanced in time.

    At gauge pressure p and braid length L the tension is::

        F = p (3 L² - b²) / (4 π n²)            threads of length b, n turns (Chou and Hannaford 1996)
            + k (L - L0) + k3 (L - L0)³         bladder
            + j (L - L0)², if L > L0            the braid jams on the bladder
            + sum of the contacts               each limited by its share of y0 + f p S + g j (L - L0)²

    The first term is p (π D²/4) (3 cos²θ - 1)/sin²θ in the braid's diameter D and angle θ. A contact moves with
    L and, by a share of its own, with the pressure at constant length. The bladder does not creep, so the loops
    do not depend on the rate once the pressure has settled, which takes some 3 s.

    At the start the muscle is empty and hangs without load, after it was inflated under the pretension and went
    twice through 0 V, rated voltage, 0 V at constant position; `length` counts from there.

    Parameters
    ----------
    rng : numpy.random.Generator
        The session's randomness: the regulator's supply; see `GridPlant`.
    """

    def __init__(self, parameters: McKibbenParameters, rng: np.random.Generator) -> None:
        rated = parameters.pressure_gain * parameters.rated_voltage / _BAR
        super().__init__(parameters, _coefficients(parameters), 0.0, rated, rng)
        self._state["offset"] = parameters.supply_sd / _BAR * float(self._noise.standard_normal())

    @property
    def pressure(self) -> float:
        """Gauge pressure in the muscle, Pa; 1.5 bar at 3 V."""
        return float(self._state["drive"] * _BAR)


def _coefficients(parameters: McKibbenParameters) -> Record:
    """Prepare the numbers that the compiled loops need every step."""
    p = parameters
    return coefficients(
        p,
        p.supply_sd / _BAR,
        p.supply_time,
        pneumatic=1.0,
        drive_step=p.pressure_step / _BAR,
        gain=p.pressure_gain / _BAR,
        band=p.pressure_band / _BAR,
        decay=math.exp(-p.step / p.time_constant),
        fan_decay=math.exp(-p.step / p.exhaust_time_constant),
        friction=p.friction,
        friction_stretch=p.friction_jam,
        friction_drive=p.friction_coefficient * p.braid_surface * _BAR,
        slip=p.slip * _BAR / MILLIMETRE,
        pressure_area=_BAR_NEWTON / (4.0 * math.pi * p.turns**2),
        thread_length=p.thread_length / MILLIMETRE,
        bladder=p.bladder_stiffness * MILLIMETRE,
        bladder_cube=p.bladder_cube * MILLIMETRE**3,
        jam=p.jam * MILLIMETRE**2,
    )
