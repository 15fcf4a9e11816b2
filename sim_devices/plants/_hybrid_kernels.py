"""Compiled inner loops of the hybrid cantilever plant.

The constants below name the places in one plain array of all numbers, which passes into a compiled function within a
microsecond, where a tuple of arrays takes five; inside, its parts go by name. Temperatures here are rises above the
mean room temperature, in K; everything else is in SI units, and a positive current heats the beam.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from bench.base import inner, kernel
from sim_devices.plants import _voltage_course_kernels as course_kernels, cooler
from sim_devices.plants.cooler import CLOSED, COMMAND, LIMIT, TARGET
from sim_devices.plants.grid import Floats

# Nodes of the thermal chain, each joined to the next: insulated end and front of the block, back and
# actuator face of the TEC, then the elements of the beam from its base to its tip.
BLOCK_END, BLOCK_FRONT, BACK, FACE, BEAM = range(5)
BEAM_NODES = 10
NODES = BEAM + BEAM_NODES

# Rows of the node table: heat capacity (J/K), conductance to the next node, conductance to air, further
# conductance to air at 1 K above it, which grows with the fourth root (W/K).
CAPACITY, LINK, AIR, EXCESS = range(4)
NODE_ROWS = 4

# Rows of the factorised matrix of a step: inverse pivots, what elimination adds of the row before, and what
# substitution adds of the node behind.
PIVOT, FORWARD, BACKWARD = range(3)
FACTOR_ROWS = 3

# Slow state beside the node temperatures: fluctuation of the room, room and current of the step under way,
# current for which the matrix was factorised, heat that the regulator's integral asks for (W).
FLUCTUATION, ROOM, CURRENT, FACTORED, INTEGRAL = range(5)
STATE_SIZE = 5

# Command of the room, after those of the cooler: step of its temperature (K).
ROOM_STEP = cooler.COMMAND_SIZE
COMMAND_SIZE = ROOM_STEP + 1

# Fast state: voltage, hysteretic part (m), quasi-static piezo deflection that goes into the modes (m), then
# each mode's distance from its steady value when the voltage last changed (m), the resonance's as cosine
# and sine parts.
VOLTAGE, LAG, DRIVE, COSINE, SINE, FIRST_REAL = range(6)
REAL_MODES = 4
FAST_SIZE = FIRST_REAL + REAL_MODES

# Shape of the bent beam: rise at which it is straight (K), of the terms of its curvature (1/K, 1/K²), thermal
# deflection per rise (m/K), and growth of the piezo deflection (1/K).
STRAIGHT, QUADRATIC, CUBIC, SENSITIVITY, WARM_GAIN = range(5)
SHAPE_SIZE = 5

# Constants of the fast part: of the hysteresis, then steady gain, damping rate, angular frequency and gains
# of the resonance, then rate and gain of each real mode.
(
    GAIN,
    VOLTAGE_QUADRATIC,
    LAG_GAIN,
    LAG_WITH,
    LAG_AGAINST,
    STEADY,
    DAMPING,
    FREQUENCY,
    COSINE_GAIN,
    SINE_GAIN,
    FIRST_RATE,
) = range(11)
FIRST_GAIN = FIRST_RATE + REAL_MODES
FAST_COEFFICIENT_SIZE = FIRST_GAIN + REAL_MODES


class Coefficients(NamedTuple):
    """Constants of the thermal step, in SI units."""

    step: float
    kelvin: float
    seebeck: float
    resistance: float
    room_decay: float
    room_kick: float
    loop_proportional: float
    loop_integral: float
    maximum_current: float


# All numbers of a plant are one array: node temperatures, their change over the step under way, their shares in the
# bending, the shape of the bent beam, fast state, constants of the fast part, slow state, command, constants of the
# thermal step, node table, the factorised matrix of a step, and the course of the voltage.
PARTS = (
    NODES,
    NODES,
    NODES,
    SHAPE_SIZE,
    FAST_SIZE,
    FAST_COEFFICIENT_SIZE,
    STATE_SIZE,
    COMMAND_SIZE,
    len(Coefficients._fields),
    NODE_ROWS * NODES,
    FACTOR_ROWS * NODES,
    course_kernels.SIZE,
)
INCREMENT, SHARE, SHAPE = NODES, 2 * NODES, 3 * NODES
FAST = SHAPE + SHAPE_SIZE
FAST_COEFFICIENTS = FAST + FAST_SIZE
STATE = FAST_COEFFICIENTS + FAST_COEFFICIENT_SIZE
_COMMANDS = STATE + STATE_SIZE
_COEFFICIENTS = _COMMANDS + COMMAND_SIZE
_NODE_TABLE = _COEFFICIENTS + len(Coefficients._fields)
_FACTORS = _NODE_TABLE + NODE_ROWS * NODES
_COURSE = _FACTORS + FACTOR_ROWS * NODES


class Thermal(NamedTuple):
    """All numbers of the thermal part; the first three and the factors are changed in place."""

    rise: Floats
    """Node temperatures, K."""
    increment: Floats
    """Change of them over the latest step that is known, K."""
    state: Floats
    command: Floats
    c: Coefficients
    nodes: Floats
    factors: Floats
    """State, commands, coefficients, node table and factorised matrix."""


@inner
def _thermal(plant: Floats) -> Thermal:
    """Return the thermal part of a plant, as views."""
    c = plant[_COEFFICIENTS:_NODE_TABLE]
    return Thermal(
        plant[:INCREMENT],
        plant[INCREMENT:SHARE],
        plant[STATE:_COMMANDS],
        plant[_COMMANDS:_COEFFICIENTS],
        Coefficients(c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8]),
        plant[_NODE_TABLE:_FACTORS].reshape((NODE_ROWS, NODES)),
        plant[_FACTORS:_COURSE].reshape((FACTOR_ROWS, NODES)),
    )


@kernel
def take_commands(plant: Floats) -> None:
    """Set room temperature and current for the step that begins here."""
    _take_commands(_thermal(plant))


@inner
def _take_commands(thermal: Thermal) -> bool:
    """Set room temperature and current for the step that begins here; return whether the current is saturated."""
    rise, _, state, command, c, _, _ = thermal
    state[ROOM] = state[FLUCTUATION] + command[ROOM_STEP]
    if command[CLOSED] == 0.0:
        state[CURRENT] = command[COMMAND]
        return False
    heat = c.loop_proportional * (command[TARGET] - rise[FACE]) + state[INTEGRAL]
    pumped = c.seebeck * (c.kelvin + rise[FACE])
    square = pumped * pumped + 2.0 * c.resistance * heat
    # Of the two currents that give this heat the smaller; below the strongest cooling there is none.
    wanted = 2.0 * heat / (pumped + math.sqrt(max(square, 0.0)))
    limit = min(command[LIMIT], c.maximum_current)
    state[CURRENT] = min(max(wanted, -limit), limit)
    saturated: bool = square < 0.0 or abs(wanted) > limit
    return saturated


@inner
def factorise(current: float, c: Coefficients, nodes: Floats, factors: Floats) -> None:
    """Factorise the matrix of a step, which is tridiagonal and depends on the current alone."""
    half = 0.5 * c.seebeck * current
    before = 0.0
    for j in range(NODES):
        after = 0.5 * nodes[LINK, j]
        diagonal = nodes[CAPACITY, j] / c.step + 0.5 * nodes[AIR, j] + before + after
        if j == BACK:
            diagonal += half
        elif j == FACE:
            diagonal -= half
        factors[FORWARD, j] = 0.0
        if j > 0:
            factors[FORWARD, j] = before * factors[PIVOT, j - 1]
            diagonal -= before * factors[FORWARD, j]
        factors[PIVOT, j] = 1.0 / diagonal
        factors[BACKWARD, j] = after / diagonal
        before = after


@kernel
def look_ahead(plant: Floats) -> None:
    """Find the change of the temperatures over the step that begins here."""
    _look_ahead(_thermal(plant))


@inner
def _look_ahead(thermal: Thermal) -> None:
    """Find the change of the temperatures over the step that begins here."""
    # The implicit midpoint rule takes what is linear at a given current, and keeps the energy balance to rounding.
    # The rest of convection changes over seconds: it is extrapolated from the step before to the middle of this one.
    rise, increment, state, command, c, nodes, factors = thermal
    saturated = _take_commands(thermal)
    if command[CLOSED] != 0.0:
        error = command[TARGET] - rise[FACE]
        # A saturated loop integrates only what leads out of saturation.
        if not saturated or error * state[CURRENT] < 0.0:
            state[INTEGRAL] += c.loop_integral * error
    current = state[CURRENT]
    room = state[ROOM]
    if current != state[FACTORED]:
        factorise(current, c, nodes, factors)
        state[FACTORED] = current

    for j in range(BEAM, NODES):
        excess = rise[j] + 0.5 * increment[j] - room
        increment[j] = -nodes[EXCESS, j] * math.sqrt(math.sqrt(abs(excess))) * excess
    joule = 0.5 * c.resistance * current * current
    pumped = c.seebeck * current
    for j in range(BEAM):
        increment[j] = 0.0
    increment[BACK] = joule - pumped * (c.kelvin + rise[BACK])
    increment[FACE] = joule + pumped * (c.kelvin + rise[FACE])

    # Heat into each node, and forward elimination on the way.
    inflow = 0.0
    eliminated = 0.0
    for j in range(NODES):
        outflow = 0.0
        if j + 1 < NODES:
            outflow = nodes[LINK, j] * (rise[j] - rise[j + 1])
        heat = increment[j] + inflow - outflow - nodes[AIR, j] * (rise[j] - room)
        eliminated = heat + factors[FORWARD, j] * eliminated
        increment[j] = factors[PIVOT, j] * eliminated
        inflow = outflow
    after = 0.0
    for j in range(NODES - 1, -1, -1):
        after = increment[j] + factors[BACKWARD, j] * after
        increment[j] = after


@kernel
def advance_steps(normals: Floats, ahead: bool, begin_next: bool, plant: Floats) -> None:
    """Complete one grid step for each of `normals`; `ahead` says whether the first step's change is known.

    `begin_next` is whether that of the step behind them is to be found too.
    """
    thermal = _thermal(plant)
    rise, increment, state, _, c, _, _ = thermal
    for row in range(normals.size):
        if not ahead:
            _look_ahead(thermal)
        ahead = False
        for j in range(NODES):
            rise[j] += increment[j]
        state[FLUCTUATION] = c.room_decay * state[FLUCTUATION] + c.room_kick * normals[row]
    if begin_next:
        _look_ahead(thermal)
    else:
        _take_commands(thermal)


@kernel
def bending(fraction: float, plant: Floats) -> tuple[float, float]:
    """Add up the bending of the beam, after a fraction of the step under way, in [0, 1].

    Returns the thermal deflection of the tip and the factor of the piezo deflection. Either is the local value
    weighted by the distance to the tip.
    """
    shape = plant[SHAPE:FAST]
    bent = 0.0
    warm = 0.0
    for j in range(BEAM, NODES):
        weight = plant[SHARE + j]
        d = plant[j] + fraction * plant[INCREMENT + j] + shape[STRAIGHT]
        bent += weight * d * (1.0 + d * (shape[QUADRATIC] + d * shape[CUBIC]))
        warm += weight * d
    return shape[SENSITIVITY] * bent, 1.0 + shape[WARM_GAIN] * warm


@kernel
def terminals(fraction: float, ambient: float, plant: Floats) -> tuple[float, float, float, float]:
    """Return the temperatures of face and block's front (°C), current (A) and voltage (V) of the cooler.

    As a TEC controller sees them after a fraction of the step under way, with the mean temperature of the room (°C).
    """
    rise, increment, state, _, c, _, _ = _thermal(plant)
    face = ambient + (rise[FACE] + fraction * increment[FACE])
    back = ambient + (rise[BACK] + fraction * increment[BACK])
    front = ambient + (rise[BLOCK_FRONT] + fraction * increment[BLOCK_FRONT])
    current = state[CURRENT]
    return face, front, current, c.seebeck * (face - back) + c.resistance * current


@kernel
def heat_to_air(fraction: float, plant: Floats) -> float:
    """Add up the heat flow from all nodes to the air."""
    rise, increment, state, _, _, nodes, _ = _thermal(plant)
    total = 0.0
    for j in range(NODES):
        excess = rise[j] + fraction * increment[j] - state[ROOM]
        total += (nodes[AIR, j] + nodes[EXCESS, j] * math.sqrt(math.sqrt(abs(excess)))) * excess
    return total


@kernel
def piezo_deflection(elapsed: float, plant: Floats) -> float:
    """Evaluate the piezo deflection, at the temperature of the straight beam, some time after the last voltage."""
    fast, f = plant[FAST:FAST_COEFFICIENTS], plant[FAST_COEFFICIENTS:STATE]
    phase = f[FREQUENCY] * elapsed
    swing = math.exp(-f[DAMPING] * elapsed)
    total: float = f[STEADY] * fast[DRIVE]
    total += swing * (fast[COSINE] * math.cos(phase) + fast[SINE] * math.sin(phase))
    for m in range(REAL_MODES):
        total += math.exp(-f[FIRST_RATE + m] * elapsed) * fast[FIRST_REAL + m]
    return total


@kernel
def deflection(fraction: float, elapsed: float, plant: Floats) -> float:
    """Add up the deflection of the tip; takes what `bending` and `piezo_deflection` take."""
    thermal, warming = bending(fraction, plant)
    total: float = thermal + warming * piezo_deflection(elapsed, plant)
    return total


@kernel
def hysteresis(lag: float, change: float, f: Floats) -> float:
    """Move the Bouc-Wen part over a change of the voltage: the exact solution of its equation.

    Seen along the motion, ``g = sign(change) h`` obeys ``dg/dv = a - b g - c |g|``, which is linear on
    either side of zero; it crosses zero at most once, upwards.
    """
    sign = math.copysign(1.0, change)
    way = abs(change)
    g = sign * lag
    if g < 0.0:
        level = f[LAG_GAIN] / f[LAG_AGAINST]
        crossing = math.log1p(-g / level) / f[LAG_AGAINST]
        if way <= crossing:
            before: float = sign * (level + (g - level) * math.exp(-f[LAG_AGAINST] * way))
            return before
        way -= crossing
        g = 0.0
    level = f[LAG_GAIN] / f[LAG_WITH]
    after: float = sign * (level + (g - level) * math.exp(-f[LAG_WITH] * way))
    return after


@kernel
def apply_voltage(voltage: float, elapsed: float, plant: Floats) -> None:
    """Change the voltage, some time after the last change."""
    fast, f = plant[FAST:FAST_COEFFICIENTS], plant[FAST_COEFFICIENTS:STATE]
    lag = hysteresis(fast[LAG], voltage - fast[VOLTAGE], f)
    drive = f[GAIN] * voltage - lag + f[VOLTAGE_QUADRATIC] * voltage * voltage
    step = drive - fast[DRIVE]
    phase = f[FREQUENCY] * elapsed
    swing = math.exp(-f[DAMPING] * elapsed)
    sine, cosine = swing * math.sin(phase), swing * math.cos(phase)
    # What is C cos + S sin of the time since the last change, seen from now.
    fast[COSINE], fast[SINE] = (
        fast[COSINE] * cosine + fast[SINE] * sine - f[COSINE_GAIN] * step,
        fast[SINE] * cosine - fast[COSINE] * sine - f[SINE_GAIN] * step,
    )
    for m in range(REAL_MODES):
        remaining = math.exp(-f[FIRST_RATE + m] * elapsed) * fast[FIRST_REAL + m]
        fast[FIRST_REAL + m] = remaining - f[FIRST_GAIN + m] * step
    fast[VOLTAGE] = voltage
    fast[LAG] = lag
    fast[DRIVE] = drive


@kernel
def lead_voltage(
    start: float, target: float, steps: int, time_constant: float, elapsed: float, plant: Floats
) -> float:
    """Begin a course of the voltage, some time after its last change; return the time since that then."""
    course = plant[_COURSE:]
    course[course_kernels.START], course[course_kernels.TARGET] = start, target
    course[course_kernels.STEPS], course[course_kernels.TAKEN] = steps, 0.0
    course[course_kernels.TIME_CONSTANT] = time_constant
    before = plant[FAST + VOLTAGE]
    voltage = course_kernels.within(before, start, target)
    if voltage != before:
        apply_voltage(voltage, elapsed, plant)
        return 0.0
    return elapsed


@kernel
def follow_course(passed: float, elapsed: float, plant: Floats) -> tuple[float, bool]:
    """Take the steps of the course up to an instant that is `passed` (s) after its beginning.

    Takes and returns the time at that instant since the last change of the voltage, and returns whether the course
    has come to its end.
    """
    course = plant[_COURSE:]
    due = course_kernels.next_instant(course)
    while due <= passed:
        ago = passed - due
        before = plant[FAST + VOLTAGE]
        voltage = course_kernels.take_step(before, course)
        if voltage != before:
            apply_voltage(voltage, elapsed - ago, plant)
            elapsed = ago
        due = course_kernels.next_instant(course)
    return elapsed, due == math.inf
