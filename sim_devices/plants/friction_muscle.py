"""What the braided pneumatic muscle and the coiled polymer muscle share: friction, equilibrium and time.

Both are an elastic backbone whose law depends on what drives it, pressure or temperature, in parallel with
many dry contacts and with one weak Maxwell arm. The compiled loops keep their state in plain arrays, because
passing a few arrays into a compiled function costs a microsecond and a plant is advanced hundreds of thousands
of times a run. The constants below name the places in these arrays. Here lengths are in mm, forces in N,
pressures in bar and temperatures in °C; `MuscleParameters` and the muscles' commands and outputs are in SI units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim_devices.plants.grid import NotNegative, PlantParameters, Seed, fluctuation
from sim_devices.plants.muscle import CLAMPED, FAN, LOAD, MILLIMETRE, PLACE, VOLTAGE, Muscle

# What drives the muscle.
PNEUMATIC, THERMAL = range(2)

# Continuous state: pressure (bar) or temperature (°C), its free displacement (mm), pressure that the regulator
# aims at (bar), deviation of supply (bar) or room (K), tension, length, position of the moving end (mm), force of
# the Maxwell arm.
DRIVE, FREED, SETTING, OFFSET, FORCE, LENGTH, POSITION, RELAXING = range(8)
STATE_SIZE = 8

# Rows of the contact table: stiffness (N/mm), share of the yield force, share of the free displacement.
STIFFNESS, WEIGHT, SHARE = range(3)
CONTACT_ROWS = 3

# The law at one value of the drive. Backbone: polynomial in the length, then two one-sided squares, one that
# resists stretching beyond a length and one that resists contraction beyond a length. Yield force of all
# contacts: a constant, and shares of the two one-sided forces and of the polynomial. Free displacement.
(
    LEVEL,
    SLOPE,
    SQUARE,
    CUBE,
    STRETCH,
    PRESS,
    PRESS_FROM,
    YIELD,
    YIELD_STRETCH,
    YIELD_PRESS,
    YIELD_LOAD,
    FREE,
) = range(12)
LAW_SIZE = 12

# Coefficients, prepared once from the parameters. Those of the laws mean what the muscle's parameters say.
(
    KIND,
    STEP,
    REST_LENGTH,
    REST,
    SERIES_COMPLIANCE,
    FORCE_LIMIT,
    FORCE_STEP,
    LENGTH_STEP,
    DRIVE_STEP,
    BASE,
    GAIN,
    BAND,
    DECAY,
    FAN_DECAY,
    FAN_SHARE,
    OFFSET_DECAY,
    OFFSET_KICK,
    OFFSET_GAIN,
    ARM,
    ARM_TIME,
    FRICTION,
    FRICTION_STRETCH,
    FRICTION_PRESS,
    FRICTION_DRIVE,
    SLIP,
    PRESSURE_AREA,
    THREAD_LENGTH,
    BLADDER,
    BLADDER_CUBE,
    JAM,
    COLD_STIFFNESS,
    HOT_STIFFNESS,
    SOFTENING,
    SOFTENING_WIDTH,
    EXPANSION,
    EXPANSION_ABOVE,
    CONTACT,
    CONTACT_AT,
) = range(38)
COEFFICIENT_SIZE = 38

# A tension counts as found this close, N, and the search never leaves this share of the resting length.
TENSION_TOLERANCE = 1e-10
SHORTEST = -0.8
LONGEST = 1.0
_MOST_TRIALS = 200
# An arm that carries less has relaxed, N.
_RELAXED = 1e-12

Floats = NDArray[np.float64]


@njit(cache=True)
def expansion(temperature: float, c: Floats) -> float:
    """Contraction of the unloaded coiled muscle, mm, from 0 °C on; steeper above the softening temperature.

    Parameters
    ----------
    temperature : float
        Temperature, °C.
    c : ndarray
        Coefficients.

    Returns
    -------
    float
        Contraction, mm; rises with temperature.
    """
    above = (temperature - c[SOFTENING]) / c[SOFTENING_WIDTH]
    # log(1 + exp(above)) without overflow.
    soft = max(above, 0.0) + math.log1p(math.exp(-abs(above)))
    contraction: float = c[EXPANSION] * temperature + c[EXPANSION_ABOVE] * c[SOFTENING_WIDTH] * soft
    return contraction


@njit(cache=True)
def law_at(drive: float, c: Floats, law: Floats) -> None:
    """Write the muscle's law at one value of its drive.

    Parameters
    ----------
    drive : float
        Pressure (bar) or temperature (°C).
    c : ndarray
        Coefficients.
    law : ndarray
        Written to.
    """
    law[:] = 0.0
    if c[KIND] == PNEUMATIC:
        per_area = c[PRESSURE_AREA] * drive
        rest = c[REST_LENGTH]
        law[LEVEL] = per_area * (3.0 * rest * rest - c[THREAD_LENGTH] * c[THREAD_LENGTH])
        law[SLOPE] = 6.0 * per_area * rest + c[BLADDER]
        law[SQUARE] = 3.0 * per_area
        law[CUBE] = c[BLADDER_CUBE]
        law[STRETCH] = c[JAM]
        law[YIELD] = c[FRICTION] + c[FRICTION_DRIVE] * drive
        law[YIELD_STRETCH] = c[FRICTION_STRETCH]
        law[FREE] = c[SLIP] * drive
    else:
        cold = 1.0 / (1.0 + math.exp(min((drive - c[SOFTENING]) / c[SOFTENING_WIDTH], 700.0)))
        stiffness = c[HOT_STIFFNESS] + (c[COLD_STIFFNESS] - c[HOT_STIFFNESS]) * cold
        contraction = expansion(drive, c) - expansion(c[BASE], c)
        law[LEVEL] = stiffness * contraction
        law[SLOPE] = stiffness
        law[PRESS] = c[CONTACT]
        law[PRESS_FROM] = c[CONTACT_AT]
        law[YIELD] = c[FRICTION] * stiffness / c[COLD_STIFFNESS]
        law[YIELD_PRESS] = c[FRICTION_PRESS]
        law[YIELD_LOAD] = c[FRICTION_DRIVE]
        law[FREE] = c[SLIP] * contraction


@njit(cache=True)
def backbone(length: float, law: Floats) -> tuple[float, float, float, float]:
    """Tension of the elastic backbone and yield force of all contacts together.

    Parameters
    ----------
    length : float
        Length, mm.
    law : ndarray
        Law at the present drive.

    Returns
    -------
    tuple of float
        Tension (N) and its slope (N/mm), yield force and its slope; the tension rises with the length.
    """
    smooth = law[LEVEL] + length * (law[SLOPE] + length * (law[SQUARE] + length * law[CUBE]))
    smooth_slope = law[SLOPE] + length * (2.0 * law[SQUARE] + 3.0 * length * law[CUBE])
    beyond = max(length, 0.0)
    short = max(law[PRESS_FROM] - length, 0.0)
    stretch = law[STRETCH] * beyond * beyond
    stretch_slope = 2.0 * law[STRETCH] * beyond
    press = law[PRESS] * short * short
    press_slope = -2.0 * law[PRESS] * short
    yielding = law[YIELD] + law[YIELD_STRETCH] * stretch + law[YIELD_PRESS] * press
    yielding_slope = law[YIELD_STRETCH] * stretch_slope + law[YIELD_PRESS] * press_slope
    if smooth > 0.0:
        yielding += law[YIELD_LOAD] * smooth
        yielding_slope += law[YIELD_LOAD] * smooth_slope
    return smooth + stretch - press, smooth_slope + stretch_slope - press_slope, yielding, yielding_slope


@njit(cache=True)
def tension(length: float, state: Floats, law: Floats, contacts: Floats, forces: Floats) -> tuple[float, float]:
    """Tension of a trial from the committed state.

    Parameters
    ----------
    length : float
        Length of the trial, mm.
    state, law, contacts, forces : ndarray
        Committed state, law at the trial's drive, contact table and committed forces of the contacts, N.

    Returns
    -------
    tuple of float
        Tension, N, and its slope, N/mm.
    """
    total, slope, yielding, yielding_slope = backbone(length, law)
    moved = length - state[LENGTH]
    freed = law[FREE] - state[FREED]
    for i in range(forces.size):
        trial = forces[i] + contacts[STIFFNESS, i] * (moved - contacts[SHARE, i] * freed)
        most = contacts[WEIGHT, i] * yielding
        if trial > most:
            total += most
            slope += contacts[WEIGHT, i] * yielding_slope
        elif trial < -most:
            total -= most
            slope -= contacts[WEIGHT, i] * yielding_slope
        else:
            total += trial
            slope += contacts[STIFFNESS, i]
    return total, slope


@njit(cache=True)
def solve_length(
    clamped: bool, target: float, state: Floats, c: Floats, law: Floats, contacts: Floats, forces: Floats
) -> float:
    """Find the length at which the tension is what the load or the held end asks for.

    The tension of a trial rises with its length, in smooth pieces: Newton's steps, inside an interval that
    holds the solution and is halved where they leave it. A state that is the solution already stays.

    Parameters
    ----------
    clamped : bool
        Whether the position is imposed; the load is otherwise.
    target : float
        Position, mm, or load, N.
    state, c, law, contacts, forces : ndarray
        See `tension`; nothing is changed.

    Returns
    -------
    float
        Length, mm.
    """
    length = float(state[LENGTH])
    low = SHORTEST * c[REST_LENGTH]
    high = LONGEST * c[REST_LENGTH]
    for _ in range(_MOST_TRIALS):
        excess, slope = tension(length, state, law, contacts, forces)
        if clamped:
            excess -= (target + c[REST] - length) / c[SERIES_COMPLIANCE]
            slope += 1.0 / c[SERIES_COMPLIANCE]
        else:
            excess -= target
        if abs(excess) <= TENSION_TOLERANCE:
            break
        if excess > 0.0:
            high = length
        else:
            low = length
        following = length - excess / slope
        if not low < following < high:
            following = 0.5 * (low + high)
        if following == length:
            break
        length = following
    return length


@njit(cache=True)
def settle(
    clamped: bool, target: float, state: Floats, c: Floats, law: Floats, contacts: Floats, forces: Floats
) -> None:
    """Find the equilibrium at the law's drive and take it over.

    Parameters
    ----------
    clamped, target
        See `solve_length`.
    state, forces : ndarray
        Changed in place.
    c, law, contacts : ndarray
        See `tension`.
    """
    length = solve_length(clamped, target, state, c, law, contacts, forces)
    force = target
    if clamped:
        force = (target + c[REST] - length) / c[SERIES_COMPLIANCE]
        if force < 0.0 or force > c[FORCE_LIMIT]:
            # Slack, or stretched further than can be.
            force = 0.0 if force < 0.0 else c[FORCE_LIMIT]
            length = solve_length(False, force, state, c, law, contacts, forces)
    yielding = backbone(length, law)[2]
    moved = length - state[LENGTH]
    freed = law[FREE] - state[FREED]
    for i in range(forces.size):
        trial = forces[i] + contacts[STIFFNESS, i] * (moved - contacts[SHARE, i] * freed)
        most = contacts[WEIGHT, i] * yielding
        forces[i] = min(max(trial, -most), most)
    state[LENGTH] = length
    state[FORCE] = force
    state[FREED] = law[FREE]
    state[POSITION] = target if clamped else length - c[REST] + force * c[SERIES_COMPLIANCE]


@njit(cache=True)
def carry(
    clamped: bool,
    target: float,
    seconds: float,
    state: Floats,
    c: Floats,
    law: Floats,
    contacts: Floats,
    forces: Floats,
) -> None:
    """Go to an equilibrium while the Maxwell arm relaxes for some time: exact for a length that moves evenly.

    Parameters
    ----------
    clamped, target
        See `solve_length`.
    seconds : float
        Time that passes, s; 0 for a move at once.
    state, c, law, contacts, forces : ndarray
        See `settle`; the arm is added to `law`.
    """
    if c[ARM] == 0.0:
        settle(clamped, target, state, c, law, contacts, forces)
        return
    left = 1.0
    mean = 1.0
    if seconds > 0.0:
        left = math.exp(-seconds / c[ARM_TIME])
        mean = -math.expm1(-seconds / c[ARM_TIME]) * c[ARM_TIME] / seconds
    before = float(state[LENGTH])
    kept = state[RELAXING] * left
    law[LEVEL] += kept - c[ARM] * mean * before
    law[SLOPE] += c[ARM] * mean
    settle(clamped, target, state, c, law, contacts, forces)
    arm = kept + c[ARM] * mean * (state[LENGTH] - before)
    state[RELAXING] = arm if abs(arm) > _RELAXED else 0.0


@njit(cache=True)
def load_to(load: float, state: Floats, c: Floats, law: Floats, contacts: Floats, forces: Floats) -> None:
    """Move the imposed force at a constant drive, at once, in sub-steps.

    Parameters
    ----------
    load : float
        Force to reach, N.
    state, c, law, contacts, forces : ndarray
        See `carry`.
    """
    begin = state[FORCE]
    steps = math.ceil(abs(load - begin) / c[FORCE_STEP])
    for k in range(1, steps + 1):
        law_at(state[DRIVE], c, law)
        carry(False, begin + (load - begin) * k / steps, 0.0, state, c, law, contacts, forces)
    # A slack end comes back to the muscle without any change of force.
    state[FORCE] = load
    state[POSITION] = state[LENGTH] - c[REST] + load * c[SERIES_COMPLIANCE]


@njit(cache=True)
def stretch_to(position: float, state: Floats, c: Floats, law: Floats, contacts: Floats, forces: Floats) -> None:
    """Move the imposed position at a constant drive, at once, in sub-steps.

    Parameters
    ----------
    position : float
        Position to reach, mm.
    state, c, law, contacts, forces : ndarray
        See `carry`.
    """
    begin = state[POSITION]
    steps = math.ceil(abs(position - begin) / c[LENGTH_STEP])
    for k in range(1, steps + 1):
        law_at(state[DRIVE], c, law)
        carry(True, begin + (position - begin) * k / steps, 0.0, state, c, law, contacts, forces)
    state[POSITION] = position


@njit(cache=True)
def drive_to(
    drive: float,
    seconds: float,
    clamped: bool,
    state: Floats,
    c: Floats,
    law: Floats,
    contacts: Floats,
    forces: Floats,
) -> None:
    """Move pressure or temperature at constant load or at constant position, in sub-steps.

    Parameters
    ----------
    drive : float
        Pressure (bar) or temperature (°C) to reach.
    seconds : float
        Time that it takes, s.
    clamped : bool
        Whether the position is held; the load is otherwise.
    state, c, law, contacts, forces : ndarray
        See `carry`.
    """
    begin = state[DRIVE]
    if drive == begin and state[RELAXING] == 0.0:
        return
    target = state[POSITION] if clamped else state[FORCE]
    steps = max(math.ceil(abs(drive - begin) / c[DRIVE_STEP]), 1)
    for k in range(1, steps + 1):
        law_at(begin + (drive - begin) * k / steps, c, law)
        carry(clamped, target, seconds / steps, state, c, law, contacts, forces)
    state[DRIVE] = drive


@njit(cache=True)
def next_drive(state: Floats, command: Floats, c: Floats) -> float:
    """Pressure or temperature after one grid step: exact for a constant command.

    Parameters
    ----------
    state : ndarray
        State; the regulator's aim is changed in place.
    command, c : ndarray
        Command and coefficients.

    Returns
    -------
    float
        Pressure, bar, or temperature, °C.
    """
    decay = c[DECAY]
    if c[KIND] == PNEUMATIC:
        wanted = c[GAIN] * command[VOLTAGE]
        state[SETTING] = min(max(state[SETTING], wanted - c[BAND]), wanted + c[BAND])
        steady = max(state[SETTING] + state[OFFSET], 0.0)
        if command[FAN] != 0.0 and steady < state[DRIVE]:
            decay = c[FAN_DECAY]
    else:
        rise = c[GAIN] * (1.0 + c[OFFSET_GAIN] * state[OFFSET]) * command[VOLTAGE] * command[VOLTAGE]
        if command[FAN] != 0.0:
            rise *= c[FAN_SHARE]
            decay = c[FAN_DECAY]
        steady = c[BASE] + state[OFFSET] + rise
    after: float = steady + (state[DRIVE] - steady) * decay
    return after


@njit(cache=True)
def advance_steps(
    normals: Floats,
    state: Floats,
    command: Floats,
    c: Floats,
    law: Floats,
    contacts: Floats,
    forces: Floats,
) -> None:
    """Advance the whole plant by one grid step for each element of `normals`.

    The mechanical command is carried out first, at the drive of the step before, and then the drive moves.

    Parameters
    ----------
    normals : ndarray
        Standard normal numbers, one a step: the deviation of supply or room.
    state, command, c, law, contacts, forces : ndarray
        See the functions above; `state`, `law` and `forces` are changed in place.
    """
    clamped = command[CLAMPED] != 0.0
    for row in range(normals.size):
        if clamped:
            stretch_to(command[PLACE], state, c, law, contacts, forces)
        else:
            load_to(command[LOAD], state, c, law, contacts, forces)
        state[OFFSET] = c[OFFSET_DECAY] * state[OFFSET] + c[OFFSET_KICK] * normals[row]
        drive_to(next_drive(state, command, c), c[STEP], clamped, state, c, law, contacts, forces)


@dataclass(frozen=True, kw_only=True)
class MuscleParameters(PlantParameters):
    """Numbers that both muscles have; the defaults are theirs.

    Attributes
    ----------
    contact_count : int
        Number of dry contacts, at least 1.
    specimen_seed : int
        Seed of the contacts. The specimen is the same piece whatever the session's seed.
    contact_stiffness : float
        Stiffness of all contacts together before any has slipped, N/m.
    contact_spread : float
        Standard deviation of the logarithm of a contact's share of the yield force.
    rest_length : float
        Length of the unloaded muscle as made, m.
    series_stiffness : float
        Stiffness of frame and load cell in series with the muscle, N/m.
    force_limit : float
        Largest load, N. A larger one is refused, and the force of a muscle that is stretched further stays there.
    pretension : float
        Load under which the muscle is first driven when it is conditioned, N.
    step : float
        Step of the internal time grid, s.
    force_step, length_step : float
        Largest sub-steps of a path: N and m.
    rated_voltage, maximum_voltage : float
        Voltage to which the muscle is conditioned and highest voltage, V. Higher commands are refused.
    resistance : float
        Electrical resistance that the supply sees, ohm.
    """

    contact_count: int = 40
    specimen_seed: Seed = 2017
    contact_stiffness: float
    contact_spread: NotNegative
    rest_length: float
    series_stiffness: float = 20e3
    force_limit: float
    pretension: NotNegative = 0.3
    step: float = 0.1
    force_step: float = 0.1
    length_step: float = 0.1e-3
    rated_voltage: float = 3.0
    maximum_voltage: float = 5.0
    resistance: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.pretension <= self.force_limit:
            raise ValueError(f"pretension must not exceed {self.force_limit:.4g} N, not {self.pretension} N")
        if not self.rated_voltage <= self.maximum_voltage:
            raise ValueError(f"rated_voltage must not exceed {self.maximum_voltage} V, not {self.rated_voltage} V")


def contact_table(parameters: MuscleParameters) -> Floats:
    """Make the specimen: the properties of its contacts.

    Parameters
    ----------
    parameters : MuscleParameters
        Parameters of the population.

    Returns
    -------
    ndarray
        One column a contact. Rows: stiffness (N/mm), share of the yield force (the sum is 1, lognormal), and how
        much of the free displacement the contact sees (uniform in 0 to 2, 1 on average).
    """
    p = parameters
    rng = np.random.default_rng(p.specimen_seed)
    weight = np.exp(p.contact_spread * rng.standard_normal(p.contact_count))
    share = rng.uniform(0.0, 2.0, p.contact_count)
    stiffness = np.full(p.contact_count, p.contact_stiffness * MILLIMETRE / p.contact_count)
    return np.array([stiffness, weight / weight.sum(), share / share.mean()])


def shared_coefficients(parameters: MuscleParameters, deviation: float, time: float) -> dict[int, float]:
    """Return the coefficients that do not depend on the kind of muscle, by place.

    Parameters
    ----------
    parameters : MuscleParameters
        The numbers.
    deviation, time : float
        Standard deviation (bar or K) and correlation time (s) of supply or room.
    """
    p = parameters
    values = dict.fromkeys(range(COEFFICIENT_SIZE), 0.0)
    values[STEP] = p.step
    values[REST_LENGTH] = p.rest_length / MILLIMETRE
    values[SERIES_COMPLIANCE] = 1.0 / (p.series_stiffness * MILLIMETRE)
    values[FORCE_LIMIT] = p.force_limit
    values[FORCE_STEP] = p.force_step
    values[LENGTH_STEP] = p.length_step / MILLIMETRE
    values[ARM_TIME] = 1.0
    values[OFFSET_DECAY], values[OFFSET_KICK] = fluctuation(deviation, time, p.step)
    return values


M = TypeVar("M", bound=MuscleParameters)


class FrictionMuscle(Muscle[M]):
    """A muscle with dry contacts, driven by pressure or temperature, that carries a load or is held.

    Each contact is a spring behind a slider (Iwan, Journal of Applied Mechanics 33, 1966): its force follows the
    motion that it sees, which is the elongation minus its own share of the drive's free displacement, and is
    limited by its share of the yield force of the moment. As that yield force changes with drive, load and length,
    the loops depend on all of them.

    Parameters
    ----------
    parameters : MuscleParameters
        The numbers.
    coefficients : dict of int to float
        Coefficients of the compiled loops, by place.
    cold, rated : float
        Drive at 0 V and at the rated voltage: bar or °C.
    rng : numpy.random.Generator
        The session's randomness. The plant spawns its own generator from it and never draws from `rng` itself.
    """

    def __init__(
        self,
        parameters: M,
        coefficients: dict[int, float],
        cold: float,
        rated: float,
        rng: np.random.Generator,
    ) -> None:
        super().__init__(
            parameters,
            rng,
            maximum_voltage=parameters.maximum_voltage,
            resistance=parameters.resistance,
            largest_load=parameters.force_limit,
            reach=0.5 * parameters.rest_length,
        )
        self._coefficients = np.array([coefficients[place] for place in range(COEFFICIENT_SIZE)])
        self._contacts = contact_table(parameters)
        self._forces = np.zeros(parameters.contact_count)
        self._law = np.zeros(LAW_SIZE)
        self._state = np.zeros(STATE_SIZE)
        self._condition(parameters.pretension, cold, rated)

    @property
    def force(self) -> float:
        """Tension of the muscle, N."""
        return float(self._state[FORCE])

    @property
    def length(self) -> float:
        """Elongation of the muscle from its resting length, m; contraction is negative.

        A slack muscle has the length that it has without tension.
        """
        return float((self._state[LENGTH] - self._coefficients[REST]) * MILLIMETRE)

    @property
    def position(self) -> float:
        """Position of the moving end, m: elongation of muscle, frame and load cell; a servo imposes it."""
        return float(self._state[POSITION] * MILLIMETRE)

    def _take_steps(self, normals: Floats) -> None:
        advance_steps(
            normals, self._state, self._command, self._coefficients, self._law, self._contacts, self._forces
        )

    def _drive(self, drive: float, *, clamped: bool) -> None:
        """Move pressure or temperature so slowly that the Maxwell arm has no part in it."""
        slowly = 1e6 * float(self._coefficients[ARM_TIME])
        drive_to(drive, slowly, clamped, self._state, self._coefficients, self._law, self._contacts, self._forces)

    def _load(self, newton: float) -> None:
        load_to(newton, self._state, self._coefficients, self._law, self._contacts, self._forces)

    def _condition(self, pretension: float, cold: float, rated: float) -> None:
        """Train the muscle and find its resting length, outside time."""
        self._state[DRIVE] = cold
        law_at(cold, self._coefficients, self._law)
        self._state[FREED] = self._law[FREE]
        self._load(pretension)
        self._drive(rated, clamped=False)
        self._drive(cold, clamped=False)
        for _ in range(2):
            self._drive(rated, clamped=True)
            self._drive(cold, clamped=True)
        self._load(0.0)
        self._state[RELAXING] = 0.0
        law_at(cold, self._coefficients, self._law)
        settle(False, 0.0, self._state, self._coefficients, self._law, self._contacts, self._forces)
        # Lengths so far count from the muscle as made.
        self._coefficients[REST] = self._state[LENGTH]
        self._load(0.0)
