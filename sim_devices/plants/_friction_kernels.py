"""Compiled loops of the braided pneumatic and the coiled polymer muscle. Imported on first use only.

Both are an elastic backbone whose law depends on the drive, pressure or temperature, in parallel with many dry
contacts and with one weak Maxwell arm. The compiled loops keep their numbers in records, which they change in
place: passing records into a compiled function costs a few microseconds, and a plant is advanced hundreds of
thousands of times a run. Here lengths are in mm, forces in N, pressures in bar and temperatures in °C;
`friction_muscle` converts from and to SI units.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, NamedTuple

from bench.base import Table, inner, kernel
from sim_devices.plants.grid import Floats, record_type
from sim_devices.plants.muscle import CLAMPED, FAN, LOAD, PLACE, VOLTAGE

STATE = record_type("drive freed setting offset force length position relaxing")
"""State: pressure (bar) or temperature (°C), its free displacement (mm), pressure that the regulator aims at (bar),
deviation of supply (bar) or room (K), tension, length, position of the moving end (mm), force of the Maxwell arm."""

LAW = record_type(
    "level slope square cube stretch press press_from yielding yield_stretch yield_press yield_load free"
)
"""The law at one value of the drive.

Backbone: polynomial in the length, then two one-sided squares, one that resists stretching beyond a length and one
that resists contraction beyond a length. Yield force of all contacts: a constant, and shares of the two one-sided
forces and of the polynomial. Free displacement."""

COEFFICIENTS = record_type(
    "pneumatic step rest_length rest series_compliance force_limit force_step length_step drive_step "
    "base gain band decay fan_decay fan_share offset_decay offset_kick offset_gain arm arm_time "
    "friction friction_stretch friction_press friction_drive slip pressure_area thread_length "
    "bladder bladder_cube jam cold_stiffness hot_stiffness softening softening_width expansion expansion_above "
    "contact contact_at"
)
"""Coefficients, prepared once from the parameters; `pneumatic` is 1 if pressure drives the muscle, 0 if temperature
does. Those of the laws mean what the muscle's parameters say."""

State = Annotated[Any, STATE]
Law = Annotated[Any, LAW]
Coefficients = Annotated[Any, COEFFICIENTS]

# Rows of the contact table: stiffness (N/mm), share of the yield force, share of the free displacement.
STIFFNESS, WEIGHT, SHARE = range(3)

# A tension counts as found this close, N, and the search never leaves this share of the resting length.
TENSION_TOLERANCE = 1e-10
SHORTEST = -0.8
LONGEST = 1.0
_MOST_TRIALS = 200
# An arm that carries less has relaxed, N.
_RELAXED = 1e-12


class Parts(NamedTuple):
    """All numbers of a muscle, as the compiled loops take them; state, law and forces are changed in place."""

    state: State
    law: Law
    c: Coefficients
    """State, law at the present drive, and coefficients."""
    contacts: Table
    """Contact table, three rows."""
    forces: Floats
    """Forces of the contacts, N."""


@inner
def expansion(temperature: float, c: Coefficients) -> float:
    """Contraction of the unloaded coiled muscle, mm, from 0 °C on; steeper above the softening temperature."""
    above = (temperature - c.softening) / c.softening_width
    # log(1 + exp(above)) without overflow.
    soft = max(above, 0.0) + math.log1p(math.exp(-abs(above)))
    contraction: float = c.expansion * temperature + c.expansion_above * c.softening_width * soft
    return contraction


@kernel
def law_at(drive: float, c: Coefficients, law: Law) -> None:
    """Write the muscle's law at one value of its drive, pressure or temperature."""
    law.square = law.cube = law.stretch = law.press = law.press_from = 0.0
    law.yield_stretch = law.yield_press = law.yield_load = 0.0
    if c.pneumatic:
        per_area = c.pressure_area * drive
        rest = c.rest_length
        law.level = per_area * (3.0 * rest * rest - c.thread_length * c.thread_length)
        law.slope = 6.0 * per_area * rest + c.bladder
        law.square = 3.0 * per_area
        law.cube = c.bladder_cube
        law.stretch = c.jam
        law.yielding = c.friction + c.friction_drive * drive
        law.yield_stretch = c.friction_stretch
        law.free = c.slip * drive
    else:
        cold = 1.0 / (1.0 + math.exp(min((drive - c.softening) / c.softening_width, 700.0)))
        stiffness = c.hot_stiffness + (c.cold_stiffness - c.hot_stiffness) * cold
        contraction = expansion(drive, c) - expansion(c.base, c)
        law.level = stiffness * contraction
        law.slope = stiffness
        law.press = c.contact
        law.press_from = c.contact_at
        law.yielding = c.friction * stiffness / c.cold_stiffness
        law.yield_press = c.friction_press
        law.yield_load = c.friction_drive
        law.free = c.slip * contraction


@inner
def backbone(length: float, law: Law) -> tuple[float, float, float, float]:
    """Tension of the elastic backbone and its slope, yield force of all contacts together and its slope."""
    smooth = law.level + length * (law.slope + length * (law.square + length * law.cube))
    smooth_slope = law.slope + length * (2.0 * law.square + 3.0 * length * law.cube)
    beyond = max(length, 0.0)
    short = max(law.press_from - length, 0.0)
    stretch = law.stretch * beyond * beyond
    stretch_slope = 2.0 * law.stretch * beyond
    press = law.press * short * short
    press_slope = -2.0 * law.press * short
    yielding = law.yielding + law.yield_stretch * stretch + law.yield_press * press
    yielding_slope = law.yield_stretch * stretch_slope + law.yield_press * press_slope
    if smooth > 0.0:
        yielding += law.yield_load * smooth
        yielding_slope += law.yield_load * smooth_slope
    return smooth + stretch - press, smooth_slope + stretch_slope - press_slope, yielding, yielding_slope


@inner
def tension(length: float, parts: Parts) -> tuple[float, float]:
    """Tension of a trial from the committed state, and its slope; nothing is changed."""
    state, law, contacts, forces = parts.state, parts.law, parts.contacts, parts.forces
    total, slope, yielding, yielding_slope = backbone(length, law)
    moved = length - state.length
    freed = law.free - state.freed
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


@inner
def solve_length(clamped: bool, target: float, parts: Parts) -> float:
    """Find the length at which the tension is that of a load, or of a held end (clamped) at a position.

    The tension of a trial rises with its length, in smooth pieces: Newton's steps, inside an interval that
    holds the solution and is halved where they leave it. A state that is the solution already stays.
    """
    c = parts.c
    length = float(parts.state.length)
    low = SHORTEST * c.rest_length
    high = LONGEST * c.rest_length
    for _ in range(_MOST_TRIALS):
        excess, slope = tension(length, parts)
        if clamped:
            excess -= (target + c.rest - length) / c.series_compliance
            slope += 1.0 / c.series_compliance
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


@kernel
def settle(clamped: bool, target: float, parts: Parts) -> None:
    """Find the equilibrium at the law's drive and take over its length, force and forces of the contacts."""
    state, law, c, contacts, forces = parts
    length = solve_length(clamped, target, parts)
    force = target
    if clamped:
        force = (target + c.rest - length) / c.series_compliance
        if force < 0.0 or force > c.force_limit:
            # Slack, or stretched further than can be.
            force = 0.0 if force < 0.0 else c.force_limit
            # Not False: for a literal numba would compile once more.
            length = solve_length(bool(0.0), force, parts)
    yielding = backbone(length, law)[2]
    moved = length - state.length
    freed = law.free - state.freed
    for i in range(forces.size):
        trial = forces[i] + contacts[STIFFNESS, i] * (moved - contacts[SHARE, i] * freed)
        most = contacts[WEIGHT, i] * yielding
        forces[i] = min(max(trial, -most), most)
    state.length = length
    state.force = force
    state.freed = law.free
    state.position = target if clamped else length - c.rest + force * c.series_compliance


@inner
def carry(clamped: bool, target: float, seconds: float, parts: Parts) -> None:
    """Go to an equilibrium while the Maxwell arm relaxes for some time: exact for a length that moves evenly."""
    state, law, c = parts.state, parts.law, parts.c
    if c.arm == 0.0:
        settle(clamped, target, parts)
        return
    left = 1.0
    mean = 1.0
    if seconds > 0.0:
        left = math.exp(-seconds / c.arm_time)
        mean = -math.expm1(-seconds / c.arm_time) * c.arm_time / seconds
    before = float(state.length)
    kept = state.relaxing * left
    law.level += kept - c.arm * mean * before
    law.slope += c.arm * mean
    settle(clamped, target, parts)
    arm = kept + c.arm * mean * (state.length - before)
    state.relaxing = arm if abs(arm) > _RELAXED else 0.0


@kernel
def load_to(load: float, parts: Parts) -> None:
    """Move the imposed force at a constant drive, at once, in sub-steps."""
    state, law, c = parts.state, parts.law, parts.c
    begin = state.force
    steps = math.ceil(abs(load - begin) / c.force_step)
    for k in range(1, steps + 1):
        law_at(state.drive, c, law)
        carry(bool(0.0), begin + (load - begin) * k / steps, 0.0, parts)
    # A slack end comes back to the muscle without any change of force.
    state.force = load
    state.position = state.length - c.rest + load * c.series_compliance


@inner
def stretch_to(position: float, parts: Parts) -> None:
    """Move the imposed position at a constant drive, at once, in sub-steps."""
    state, law, c = parts.state, parts.law, parts.c
    begin = state.position
    steps = math.ceil(abs(position - begin) / c.length_step)
    for k in range(1, steps + 1):
        law_at(state.drive, c, law)
        carry(bool(1.0), begin + (position - begin) * k / steps, 0.0, parts)
    state.position = position


@kernel
def drive_to(drive: float, seconds: float, clamped: bool, parts: Parts) -> None:
    """Move pressure or temperature at constant load or at constant position, in sub-steps."""
    state, law, c = parts.state, parts.law, parts.c
    begin = state.drive
    if drive == begin and state.relaxing == 0.0:
        return
    target = state.position if clamped else state.force
    steps = max(math.ceil(abs(drive - begin) / c.drive_step), 1)
    for k in range(1, steps + 1):
        law_at(begin + (drive - begin) * k / steps, c, law)
        carry(clamped, target, seconds / steps, parts)
    state.drive = drive


@inner
def next_drive(state: State, command: Floats, c: Coefficients) -> float:
    """Pressure or temperature after one grid step: exact for a constant command; moves the regulator's aim."""
    decay = c.decay
    if c.pneumatic:
        wanted = c.gain * command[VOLTAGE]
        state.setting = min(max(state.setting, wanted - c.band), wanted + c.band)
        steady = max(state.setting + state.offset, 0.0)
        if command[FAN] != 0.0 and steady < state.drive:
            decay = c.fan_decay
    else:
        rise = c.gain * (1.0 + c.offset_gain * state.offset) * command[VOLTAGE] * command[VOLTAGE]
        if command[FAN] != 0.0:
            rise *= c.fan_share
            decay = c.fan_decay
        steady = c.base + state.offset + rise
    after: float = steady + (state.drive - steady) * decay
    return after


@kernel
def advance_steps(normals: Floats, command: Floats, forces: Floats, parts: Parts) -> None:
    """Advance the whole plant by one grid step for each element of `normals`, and keep the force (N) at each.

    `forces` is a ring: that of the n-th step is in place n modulo its size, and behind the ring stands n.

    The mechanical command is carried out first, at the drive of the step before, and then the drive moves.
    """
    state, c = parts.state, parts.c
    clamped = command[CLAMPED] != 0.0
    for row in range(normals.size):
        if clamped:
            stretch_to(command[PLACE], parts)
        else:
            load_to(command[LOAD], parts)
        state.offset = c.offset_decay * state.offset + c.offset_kick * normals[row]
        drive_to(next_drive(state, command, c), c.step, clamped, parts)
        step = int(forces[-1]) + 1
        forces[step % (forces.size - 1)] = state.force
        forces[-1] = step
