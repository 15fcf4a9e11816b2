"""VO2-coated silicon microcantilever on a Peltier plate: the physics behind the ``vo2`` rig.

The plant is deliberately not of the structure that identification fits. A fitted model is a Preisach
operator with a piecewise constant density plus a quadratic in temperature; the plant has a smooth,
correlated density made of two relay populations, a mean-field coupling that breaks congruency, and
*one* hysteretic phase fraction that drives both the transition strain and the thermal expansion. On
top of that the film temperature wanders, drifts and differs by a constant from session to session.

Source of the geometry, of the ranges and of the observed behaviour: Zhang et al., "Modeling and inverse
compensation of nonmonotonic hysteresis in VO2-coated microactuators", IEEE/ASME Transactions on
Mechatronics, 2013. Numbers marked *assumed* are ours, chosen so that the plant behaves as the paper's
specimen does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bench.base import DeferredModule
from sim_devices.plants.cooler import COMMAND_SIZE, CooledParameters, CooledPlant
from sim_devices.plants.grid import Floats, NotNegative, Record, Seed, Signed, check_temperature, fluctuation, record

if TYPE_CHECKING:
    from sim_devices.plants import _vo2_kernels as kernels
else:
    kernels = DeferredModule("sim_devices.plants._vo2_kernels")


@dataclass(frozen=True, kw_only=True)
class VO2Parameters(CooledParameters):
    """Every number of the plant.

    The values that come from the paper are the beam length and the operating range that the rest was
    tuned to: curvature change about [-104, 1846] 1/m between 21 and 84 °C, transition within 30 to
    70 °C, temperature held to ±0.1 K. All others are assumed.
    """

    relay_count: int = 16384
    """Number of hysteresis relays; at least 1."""
    specimen_seed: Seed = 2013
    """Seed of the relay thresholds. The specimen does not depend on the session's seed."""
    correlation: Signed = -0.3
    """Correlation of threshold and width in normal scores, in (-1, 1)."""
    minor_share: Signed = 0.05
    """Share of relays in population B (the wide loops), in [0, 1]."""
    major_centre: Signed = 63.5
    minor_centre: Signed = 62.0
    """Mean up-threshold of populations A and B, °C."""
    major_spread: NotNegative = 3.0
    minor_spread: NotNegative = 3.0
    """Standard deviation of the up-threshold of populations A and B, K."""
    major_width: float = 4.0
    minor_width: float = 14.0
    """Mean of the lognormal loop width of populations A and B, K."""
    major_width_spread: NotNegative = 2.0
    minor_width_spread: NotNegative = 6.0
    """Standard deviation of the loop width of populations A and B, K."""
    highest_threshold: Signed = 69.8
    lowest_threshold: Signed = 30.2
    """Thresholds beyond these are reflected back, °C, so that none sits on the limits of the transition range."""
    coupling: NotNegative = 1.0
    """Mean-field (stress) coupling lambda of R fraction and drive, K."""
    relay_step: float = 0.05
    """Largest sub-step of the effective temperature, K."""
    curvature_offset: Signed = 8.0
    """Curvature at the expansion reference without transition, 1/m."""
    transition_curvature: Signed = 2034.0
    """Curvature of the complete transition, 1/m."""
    cold_expansion: Signed = 3.05
    hot_expansion: Signed = 4.25
    """Bending by thermal expansion mismatch in the M1 and in the R phase, 1/(m K)."""
    expansion_reference: Signed = 20.0
    """Temperature of no expansion bending, °C."""
    beam_length: float = 300e-6
    """Length of the cantilever, m (paper: 300 µm)."""
    residual_curvature: Signed = 0.0
    """Curvature of the beam before any change, 1/m."""
    step: float = 0.05
    """Step of the internal time grid, s."""
    loop_frequency: float = 2.2
    """Natural frequency of the closed temperature loop, rad/s."""
    loop_damping: Signed = 0.9
    """Damping ratio of the closed temperature loop, in (0, 1)."""
    slew_limit: float = 15.0
    """Largest rate of the regulated plate, K/s."""
    ambient_temperature: Signed = 22.0
    """Temperature of the room, °C."""
    seebeck: float = 0.051
    """Seebeck coefficient of the Peltier module, V/K (a 127-couple module)."""
    resistance: float = 3.1
    """Electrical resistance of the module, ohm."""
    conductance: float = 0.35
    """Thermal conductance of the module between plate and heat sink, W/K."""
    plate_loss: NotNegative = 0.01
    """Conductance from plate to room, W/K."""
    plate_capacity: float = 2.2
    """Heat capacity of the plate with cantilever chip, glass and sensor, J/K."""
    sink_capacity: float = 300.0
    """Heat capacity of the heat sink, J/K."""
    sink_resistance: float = 0.4
    """Thermal resistance from heat sink to room, K/W."""
    current_lag: float = 0.1
    """Time constant with which the amplifier's current follows a change of command, s."""
    maximum_current: float = 5.0
    """Rating of the module, A; larger commands are refused. Must stay below the thermal runaway ``conductance /
    seebeck``."""
    wander_sd: NotNegative = 0.03
    wander_time: float = 5.0
    """Standard deviation (K) and correlation time (s) of the fast temperature wander, which stands for the ±0.1 K of
    the controller."""
    drift_sd: NotNegative = 0.04
    drift_time: float = 1800.0
    """Standard deviation (K) and correlation time (s) of the drift of laser heating."""
    session_offset: Signed = 0.0
    """Constant difference of the film temperature in this session, K. Zero while a model is identified; ±0.2 K for a
    later validation and ±0.12 K for tracking are sensible."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.loop_damping < 1.0:
            raise ValueError(f"loop_damping must lie in (0, 1), not {self.loop_damping}")
        if not -1.0 < self.correlation < 1.0:
            raise ValueError(f"correlation must lie in (-1, 1), not {self.correlation}")
        if not 0.0 <= self.minor_share <= 1.0:
            raise ValueError(f"minor_share must lie in [0, 1], not {self.minor_share}")


def relay_thresholds(parameters: VO2Parameters) -> tuple[Floats, Floats]:
    """Make the specimen: the thresholds of its relays.

    The relays of each population are an R2 sequence (M. Roberts, The unreasonable effectiveness of quasirandom
    sequences, 2018), shifted by the specimen's seed: a smooth density with less grain than a random sample has, even
    in the small triangles of the Preisach plane that short moves sweep.

    Returns
    -------
    tuple of ndarray
        Up-thresholds (sorted) and the down-thresholds of the same relays, °C; the down-threshold is
        nowhere above the up-threshold.
    """
    # A third of a second of import, which a list of the rigs does not need.
    from scipy.special import ndtri

    p = parameters
    # Powers of the inverse plastic number, the root of x^3 = x + 1. The sequence of three dimensions would give the
    # population as well, but is striped in the plane of the first two.
    powers = 1.324717957244746 ** -np.arange(1.0, 3.0)
    wide = round(p.minor_share * p.relay_count)
    shifts = np.random.default_rng(p.specimen_seed).random((2, 2))
    points = [
        (shift + np.arange(1, count + 1)[:, None] * powers) % 1.0
        for shift, count in zip(shifts, (wide, p.relay_count - wide), strict=True)
    ]
    # Zero has no normal score; it can turn up only by rounding.
    scores = ndtri(np.maximum(np.concatenate(points), np.finfo(float).tiny))
    minor = np.arange(p.relay_count) < wide
    first = scores[:, 0]
    second = p.correlation * first + math.sqrt(1.0 - p.correlation**2) * scores[:, 1]

    up = np.where(minor, p.minor_centre + p.minor_spread * first, p.major_centre + p.major_spread * first)
    up = np.where(up > p.highest_threshold, 2.0 * p.highest_threshold - up, up)
    mean = np.where(minor, p.minor_width, p.major_width)
    spread = np.where(minor, p.minor_width_spread, p.major_width_spread)
    log_variance = np.log1p((spread / mean) ** 2)
    down = up - mean * np.exp(np.sqrt(log_variance) * second - 0.5 * log_variance)
    down = np.where(down < p.lowest_threshold, 2.0 * p.lowest_threshold - down, down)
    # A width in the far tail may be reflected past its own up-threshold.
    down = np.minimum(down, up)
    order = np.argsort(up, kind="stable")
    return up[order], down[order]


class VO2Cantilever(CooledPlant[VO2Parameters]):
    """Curvature of a VO2 microcantilever on a Peltier plate, advanced in time.

    The plate is either regulated (`regulate`: the closed second-order loop of a temperature
    controller), driven by a constant current (`drive`) or left alone (`release`). Changing between
    them keeps the plate's temperature and rate. A positive current heats the plate. There is no sensor
    noise here and no protection either: nothing clamps a temperature, that is for the instruments.

    Time runs on a fixed grid of ``parameters.step`` seconds from construction. `advance` carries out
    the grid steps that have become due and holds the remainder, and outputs stay constant between
    grid points. A command acts from the next grid step on. So neither the number nor the size of the
    calls of `advance` changes the trajectory, the noise included.

    A step of the regulated plate is the exact solution of the linear loop; where slew limit, current
    limit or the module's strongest cooling bind, the rate saturates. The current is what the Peltier
    balance asks for at the plate's temperature and rate::

        C dT/dt = S T I + R I²/2 - K (T - T_sink) - G (T - T_ambient)        (T in kelvin)

    Parameters
    ----------
    rng : numpy.random.Generator
        The session's randomness: wander and drift; see `GridPlant`.
    initial_temperature : float, optional
        Temperature of the plate at the start, °C; the room's by default. The film arrives there from
        negative saturation (cold), the heat sink is at room temperature, the output is off.

    Raises
    ------
    ValueError
        If `initial_temperature` is not a temperature.
    """

    def __init__(
        self,
        parameters: VO2Parameters,
        rng: np.random.Generator,
        initial_temperature: float | None = None,
    ) -> None:
        start = parameters.ambient_temperature if initial_temperature is None else initial_temperature
        check_temperature("initial_temperature", start)
        super().__init__(parameters, rng, (2,))
        self._coefficients = _coefficients(parameters)
        up, down = relay_thresholds(parameters)
        order = np.argsort(down, kind="stable")
        self._counters = np.zeros(kernels.COUNTER_SIZE, dtype=np.int64)
        on = np.zeros(parameters.relay_count, dtype=np.bool_)
        self._command = np.zeros(COMMAND_SIZE)
        self._state = np.zeros(kernels.STATE_SIZE)
        self._parts = kernels.Parts(self._state, self._coefficients, self._counters, up, down[order], order, on)

        state = self._state
        wander = float(self._noise.standard_normal())
        state[kernels.PLATE] = start
        state[kernels.SINK] = parameters.ambient_temperature
        state[kernels.WANDER] = parameters.wander_sd * wander
        # The session's offset is that of the moment at which the laser is aligned: drift begins there.
        state[kernels.DRIFT] = 0.0
        state[kernels.DRIVE] = min(float(self._parts.down[0]), start) - parameters.coupling - 1.0
        state[kernels.RATE] = kernels.plate_rate(start, 0.0, state[kernels.SINK], self._coefficients)
        self._outputs: list[float] = state.tolist()
        """The state at the last grid point, for those who ask."""
        kernels.settle_film(self.film_temperature, self._parts)
        self._deflection: float | None = None

    def _take_steps(self, normals: Floats) -> None:
        kernels.advance_steps(normals, self._command, self._parts)
        self._outputs = self._state.tolist()
        self._deflection = None

    @property
    def plate_temperature(self) -> float:
        """Temperature of the plate, where the controller's sensor sits, °C."""
        return self._outputs[kernels.PLATE]

    @property
    def plate_rate(self) -> float:
        """Rate of the plate temperature, K/s."""
        return self._outputs[kernels.RATE]

    @property
    def sink_temperature(self) -> float:
        """Temperature of the heat sink, °C."""
        return self._outputs[kernels.SINK]

    @property
    def film_temperature(self) -> float:
        """Temperature of the VO2 film: plate, wander, drift and the session's offset, °C."""
        state = self._outputs
        film = state[kernels.PLATE] + state[kernels.WANDER] + state[kernels.DRIFT]
        return film + self._parameters.session_offset

    @property
    def current(self) -> float:
        """Peltier current, A; positive heats the plate."""
        return self._outputs[kernels.CURRENT]

    @property
    def voltage(self) -> float:
        """Voltage across the Peltier module, V: Seebeck and ohmic part, of the sign of a heating current."""
        p = self._parameters
        return p.seebeck * (self.plate_temperature - self.sink_temperature) + p.resistance * self.current

    def terminals(self) -> tuple[float, float, float, float]:
        """Return the temperatures of plate and sink (°C), current (A) and voltage (V) of this instant."""
        return self.plate_temperature, self.sink_temperature, self.current, self.voltage

    @property
    def r_fraction(self) -> float:
        """Share of the film in the R (hot) phase, in [0, 1]."""
        return int(self._counters[kernels.ON_COUNT]) / self._parameters.relay_count

    @property
    def curvature(self) -> float:
        """Curvature change of the beam, 1/m: about -96 to 1838 between 21 and 84 °C."""
        p = self._parameters
        hot = self.r_fraction
        expansion = p.cold_expansion * (1.0 - hot) + p.hot_expansion * hot
        return (
            p.curvature_offset
            + p.transition_curvature * hot
            - expansion * (self.film_temperature - p.expansion_reference)
        )

    @property
    def tip_deflection(self) -> float:
        """Deflection of the tip from where the beam of residual curvature has it, m."""
        if self._deflection is None:
            p = self._parameters
            bent = arc_deflection(p.residual_curvature + self.curvature, p.beam_length)
            self._deflection = bent - arc_deflection(p.residual_curvature, p.beam_length)
        return self._deflection


def arc_deflection(curvature: float, length: float) -> float:
    """Tip deflection of a beam bent to an arc (Zhang et al., 2013, eq. 1).

    Parameters
    ----------
    curvature : float
        Curvature, 1/m, of either sign.
    length : float
        Length of the arc, m.

    Returns
    -------
    float
        ``(1 - cos(curvature * length)) / curvature``, m; odd in the curvature.
    """
    half = 0.5 * curvature * length
    # Half-angle form: no cancellation near a straight beam, where the ratio's series is 1 - half²/6.
    ratio = math.sin(half) / half if abs(half) > 1e-4 else 1.0 - half * half / 6.0
    return length * half * ratio * ratio


def _coefficients(parameters: VO2Parameters) -> Record:
    """Prepare the numbers that the compiled loop needs every step."""
    p = parameters
    step = p.step
    # Exact transition of x'' = w² (target - x) - 2 zeta w x' over one step, in (target - x, x').
    decay = p.loop_damping * p.loop_frequency
    swing = p.loop_frequency * math.sqrt(1.0 - p.loop_damping**2)
    shrink = math.exp(-decay * step)
    cosine = shrink * math.cos(swing * step)
    sine = shrink * math.sin(swing * step) / swing
    wander_decay, wander_kick = fluctuation(p.wander_sd, p.wander_time, step)
    drift_decay, drift_kick = fluctuation(p.drift_sd, p.drift_time, step)
    return record(
        kernels.COEFFICIENTS,
        step=step,
        loop_ee=cosine + decay * sine,
        loop_ev=-sine,
        loop_ve=p.loop_frequency**2 * sine,
        loop_vv=cosine - decay * sine,
        slew=p.slew_limit,
        slew_decay=math.exp(-2.0 * decay * step),
        current_decay=math.exp(-step / p.current_lag),
        seebeck=p.seebeck,
        resistance=p.resistance,
        conductance=p.conductance,
        plate_loss=p.plate_loss,
        plate_capacity=p.plate_capacity,
        sink_capacity=p.sink_capacity,
        sink_loss=1.0 / p.sink_resistance,
        ambient=p.ambient_temperature,
        wander_decay=wander_decay,
        wander_kick=wander_kick,
        drift_decay=drift_decay,
        drift_kick=drift_kick,
        offset=p.session_offset,
        coupling=p.coupling,
        relay_step=p.relay_step,
    )
