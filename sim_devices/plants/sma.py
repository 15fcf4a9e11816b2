"""Shape-memory-alloy wire, heated by a voltage: the physics behind the ``sma`` rig.

The plant is deliberately not of the structure that identification fits. A fitted model is a pair of
nested Preisach operators in voltage and force; the plant is a population of grains that transform
between austenite and martensite at stress-dependent temperatures, remember whether their martensite
is oriented, and share one stress. The same grains answer an imposed force and an imposed length.

Source of the dimensions, of the ranges and of the observed behaviour: Zhang and Yip, "Three-dimensional
hysteresis modeling of robotic artificial muscles with application to shape memory alloy actuators",
Robotics: Science and Systems, 2017: a Flexinol wire of 0.20 mm by 105 mm, 0 to 3 V, force range
[0.3, 11.2] N at constant length, dead loads of 0.98 to 8.82 N, a thermal time constant of about 5 s.
Numbers marked *assumed* are ours, chosen so that the plant behaves as the paper's specimen does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bench.base import DeferredModule
from sim_devices.plants.grid import Floats, NotNegative, Record, Signed, fluctuation, record
from sim_devices.plants.muscle import MILLIMETRE, HeatedParameters, Muscle

if TYPE_CHECKING:
    from sim_devices.plants import _sma_kernels as kernels
else:
    kernels = DeferredModule("sim_devices.plants._sma_kernels")

_MEGAPASCAL = 1e6

# The smallest transformation width (K), Clausius-Clapeyron slope (MPa/K) and detwinning stress (MPa) of a
# grain, and how far below its detwinning stress a grain re-twins at the latest (MPa).
_LEAST_WIDTH = 3.0
_LEAST_SLOPE = 1.0
_LEAST_DETWIN = 5.0
_RETWIN_GAP = 10.0


@dataclass(frozen=True, kw_only=True)
class SMAParameters(HeatedParameters):
    """Every number of the plant.

    The values that come from the paper are the wire's length (105 mm) and diameter, the rated voltage, the time
    constant in still air (about 5 s), the pretension and the ranges that the rest was tuned to. All others are
    assumed: the fan's time constant, 0.20 mm by 105 mm of NiTi with about 3 ohm, and 261 °C at 5 V.
    """

    rest_length: float = 105e-3
    length_step: float = 0.03e-3
    time_constant: float = 5.0
    fan_time_constant: float = 2.0
    rise: float = 85.0
    resistance: float = 3.05
    grain_count: int = 2000
    """Number of grains; at least 1."""
    austenite_finish: float = 48.0
    austenite_finish_spread: NotNegative = 15.0
    """Mean (°C) and standard deviation (K) of the temperature at which an unstressed grain becomes austenite."""
    width: float = 11.0
    width_spread: NotNegative = 3.0
    """Mean and standard deviation of a grain's transformation hysteresis, K; at least 3 K each."""
    slope: float = 7.0
    slope_spread: NotNegative = 0.8
    """Mean and standard deviation of the Clausius-Clapeyron slope, MPa/K."""
    unoriented_share: float = 0.4
    """Share of the stress that stabilises an unoriented grain against austenite, in (0, 1]."""
    detwin: Signed = 110.0
    detwin_spread: NotNegative = 60.0
    """Mean and standard deviation of the stress that orients martensite, MPa; at least 5 MPa each."""
    orient: Signed = -5.0
    orient_spread: NotNegative = 60.0
    """Mean and standard deviation of the stress above which a grain that cools to martensite comes out oriented, MPa.
    Negative is a trained grain."""
    orient_correlation: Signed = 0.6
    """Correlation of orientation and detwinning stress, in [-1, 1]."""
    retwin: Signed = -40.0
    retwin_spread: NotNegative = 35.0
    """Mean and standard deviation of the stress below which martensite loses its orientation, MPa; at least 10 MPa
    below the detwinning stress."""
    martensite_modulus: float = 28e9
    austenite_modulus: float = 55e9
    """Elastic moduli, Pa."""
    transformation_strain: NotNegative = 0.045
    """Strain of a completely oriented wire."""
    expansion: NotNegative = 6.6e-6
    """Coefficient of thermal expansion, 1/K."""
    diameter: float = 0.20e-3
    """Diameter of the wire, m (paper: 0.20 mm)."""
    stress_limit: float = 600e6
    """Largest stress that is solved for, Pa; 600 MPa are 18.85 N. A load beyond it is refused, and the force of a
    wire that is stretched further stays there."""
    stress_step: float = 4e6
    """Largest sub-step of the stress, Pa."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.unoriented_share <= 1.0:
            raise ValueError(f"unoriented_share must lie in (0, 1], not {self.unoriented_share}")
        if not -1.0 <= self.orient_correlation <= 1.0:
            raise ValueError(f"orient_correlation must lie in [-1, 1], not {self.orient_correlation}")
        if not self.martensite_modulus <= self.austenite_modulus:
            # Otherwise the wire would shorten under a rising load where austenite turns to martensite.
            raise ValueError(
                f"martensite_modulus must not exceed austenite_modulus, not {self.martensite_modulus} "
                f"> {self.austenite_modulus} Pa"
            )

    @property
    def area(self) -> float:
        """Cross-section of the wire, m²."""
        return 0.25 * math.pi * self.diameter**2

    @property
    def largest_load(self) -> float:
        """Force at the stress limit, N."""
        return self.stress_limit * self.area

    @property
    def reach(self) -> float:
        """Farthest that the end may be held from its resting position, to either side, m."""
        return self.rest_length


def grain_table(parameters: SMAParameters) -> Floats:
    """Make the specimen: the properties of its grains.

    Returns
    -------
    ndarray
        One column a grain. Rows: austenite finish (°C), transformation width (K), Clausius-Clapeyron
        slope (MPa/K), detwinning, orientation and re-twinning stress (MPa).
    """
    p = parameters
    score = np.random.default_rng(p.specimen_seed).standard_normal((kernels.GRAIN_ROWS, p.grain_count))
    mixed = p.orient_correlation * score[3] + math.sqrt(1.0 - p.orient_correlation**2) * score[4]
    detwin = np.maximum(p.detwin + p.detwin_spread * score[3], _LEAST_DETWIN)
    return np.array(
        [
            p.austenite_finish + p.austenite_finish_spread * score[0],
            np.maximum(p.width + p.width_spread * score[1], _LEAST_WIDTH),
            np.maximum(p.slope + p.slope_spread * score[2], _LEAST_SLOPE),
            detwin,
            p.orient + p.orient_spread * mixed,
            np.minimum(p.retwin + p.retwin_spread * score[5], detwin - _RETWIN_GAP),
        ]
    )


class SMAWire(Muscle[SMAParameters]):
    """Length and force of a shape-memory-alloy wire, advanced in time.

    Each grain follows, at temperature T and tensile stress s::

        martensite to austenite   T - k s/C > A       k = 1 if oriented, 0.4 if not
        austenite to martensite   T - s/C < A - w     then oriented if s > s_f
        martensite                oriented if s > s_d, no longer if s < s_r
        strain = s [x/E_M + (1 - x)/E_A] + a (T - 25 °C) + e <oriented>

    An unoriented martensite grain that would have to turn to austenite and at once back stays as it
    is: so a constant temperature and stress hold every grain, and a trial's strain never falls with
    stress.

    At the start the wire is cold and hangs without load, after it was cooled from austenite under the
    pretension and went twice through 0 V, rated voltage, 0 V at constant position; `length` counts from
    there.

    Parameters
    ----------
    rng : numpy.random.Generator
        The session's randomness: the temperature of the room; see `GridPlant`.
    """

    def __init__(self, parameters: SMAParameters, rng: np.random.Generator) -> None:
        super().__init__(parameters, rng)
        self._coefficients = _coefficients(parameters)
        self._state = np.zeros(kernels.STATE_SIZE)
        self._parts = kernels.Parts(
            self._state,
            self._coefficients,
            grain_table(parameters),
            np.zeros(parameters.grain_count, dtype=np.bool_),
            np.zeros(parameters.grain_count, dtype=np.bool_),
            np.empty((2, parameters.grain_count)),
            np.zeros(kernels.QUIET_SIZE),
        )
        self._condition()

        offset = parameters.ambient_sd * float(self._noise.standard_normal())
        self._state[kernels.AMBIENT_OFFSET] = offset
        self._heat(parameters.ambient_temperature + offset, clamped=False)
        self._keep_first_force()

    def _take_steps(self, normals: Floats) -> None:
        kernels.advance_steps(normals, self._command, self.forces, self._parts)

    @property
    def temperature(self) -> float:
        """Temperature of the wire, °C."""
        return float(self._state[kernels.TEMPERATURE])

    @property
    def ambient_temperature(self) -> float:
        """Temperature of the room, °C."""
        return float(self._parameters.ambient_temperature + self._state[kernels.AMBIENT_OFFSET])

    @property
    def force(self) -> float:
        """Tension of the wire, N; 0 to about 11.3 N at constant length between 0 and 3 V."""
        return float(self._state[kernels.STRESS] * self._coefficients["area"][0])

    @property
    def length(self) -> float:
        """Elongation of the wire from its resting length, m; contraction is negative.

        About 5.7 mm of travel under dead loads of 0.98 to 8.82 N between 0 and 3 V. A slack wire has the
        length that it has without stress.
        """
        state = self._state
        length = kernels.wire_length(
            state[kernels.TEMPERATURE],
            state[kernels.STRESS],
            state[kernels.MARTENSITE],
            state[kernels.ORIENTED],
            self._parameters.grain_count,
            self._coefficients,
        )
        return float(length * MILLIMETRE)

    @property
    def position(self) -> float:
        """Position of the moving end, m: the elongation of wire, frame and load cell; a servo imposes it."""
        return float(self._state[kernels.POSITION] * MILLIMETRE)

    @property
    def martensite_fraction(self) -> float:
        """Share of the wire that is martensite, in [0, 1]."""
        return float(self._state[kernels.MARTENSITE] / self._parameters.grain_count)

    @property
    def oriented_fraction(self) -> float:
        """Share of the wire that is oriented martensite, in [0, 1]."""
        return float(self._state[kernels.ORIENTED] / self._parameters.grain_count)

    def _condition(self) -> None:
        """Erase the memory, train the wire and find its resting length, outside time."""
        p = self._parameters
        cold, hot = p.ambient_temperature, p.ambient_temperature + p.rise
        self._state[kernels.TEMPERATURE] = hot
        self._load(p.pretension)
        self._heat(cold, clamped=False)
        for _ in range(2):
            self._heat(hot, clamped=True)
            self._heat(cold, clamped=True)
        self._load(0.0)
        # Lengths so far count from the strain-free state: the cold length is the resting strain.
        self._coefficients["rest_strain"] = self.length / p.rest_length
        self._load(0.0)

    def _load(self, newton: float) -> None:
        kernels.load_to(newton / self._coefficients["area"][0], self._parts)

    def _heat(self, celsius: float, clamped: bool) -> None:
        kernels.heat_to(celsius, clamped, self._parts)


def _coefficients(parameters: SMAParameters) -> Record:
    """Prepare the numbers that the compiled loop needs every step."""
    p = parameters
    ambient_decay, ambient_kick = fluctuation(p.ambient_sd, p.ambient_time, p.step)
    return record(
        kernels.COEFFICIENTS,
        ambient=p.ambient_temperature,
        heating=p.rise / p.rated_voltage**2,
        still_decay=math.exp(-p.step / p.time_constant),
        fan_decay=math.exp(-p.step / p.fan_time_constant),
        fan_share=p.fan_time_constant / p.time_constant,
        ambient_decay=ambient_decay,
        ambient_kick=ambient_kick,
        ambient_gain=p.ambient_gain,
        area=p.area / MILLIMETRE**2,
        rest_length=p.rest_length / MILLIMETRE,
        series_compliance=1.0 / (p.series_stiffness * MILLIMETRE),
        martensite_modulus=p.martensite_modulus / _MEGAPASCAL,
        austenite_modulus=p.austenite_modulus / _MEGAPASCAL,
        expansion=p.expansion,
        expansion_reference=p.ambient_temperature,
        transformation_strain=p.transformation_strain,
        unoriented_share=p.unoriented_share,
        rest_strain=0.0,
        stress_limit=p.stress_limit / _MEGAPASCAL,
        temperature_step=p.temperature_step,
        stress_step=p.stress_step / _MEGAPASCAL,
        length_step=p.length_step / MILLIMETRE,
    )
