"""Compiled inner loops of the SMA wire plant.

The constants below name the places in the plain arrays of the state, which pass into a compiled function within a
microsecond; coefficients go by name. Here stresses are in MPa, forces in N, lengths in mm and temperatures in °C.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.base import Table, inner, kernel
from sim_devices.plants.grid import Floats, record_type
from sim_devices.plants.muscle import CLAMPED, FAN, LOAD, PLACE, VOLTAGE

# Continuous state: wire temperature, ambient deviation (K), stress, position of the moving end (mm),
# number of martensite grains and of oriented martensite grains.
TEMPERATURE, AMBIENT_OFFSET, STRESS, POSITION, MARTENSITE, ORIENTED = range(6)
STATE_SIZE = 6

# Rows of the grain table: austenite finish (°C) and width (K) of the transformation, Clausius-Clapeyron
# slope (MPa/K), detwinning stress, orientation stress on cooling, re-twinning stress (MPa).
AUSTENITE, WIDTH, SLOPE, DETWIN, ORIENT, RETWIN = range(6)
GRAIN_ROWS = 6

# Quiet surroundings of a temperature and a stress, see `look_around`: the middle (°C, MPa), how far the temperature
# (K, by which stress counts at the smallest slope) and the stress (MPa) may move, and that slope (MPa/K).
MIDDLE_TEMPERATURE, MIDDLE_STRESS, KELVIN, MEGAPASCAL, LEAST_SLOPE = range(5)
QUIET_SIZE = 5

# Kept free of what quiet surroundings allow (K, MPa) and of an imposed position (mm): far more than rounding.
GUARD = 1e-9

# Halvings of the stress interval: 600 MPa come down to 3.5e-8 MPa, a nanonewton of force.
HALVINGS = 34
FIRST_HALVINGS = 5

Flags = NDArray[np.bool_]

COEFFICIENTS = record_type(
    "ambient heating still_decay fan_decay fan_share ambient_decay ambient_kick ambient_gain area "
    "rest_length series_compliance martensite_modulus austenite_modulus expansion expansion_reference "
    "transformation_strain unoriented_share rest_strain stress_limit temperature_step stress_step "
    "length_step"
)
"""Coefficients, prepared once from the parameters."""
Coefficients = Annotated[Any, COEFFICIENTS, 1]


class Parts(NamedTuple):
    """All numbers of a wire, as the compiled loops take them."""

    state: Floats
    c: Coefficients
    """State, and coefficients."""
    grains: Table
    """Grain table, `GRAIN_ROWS` rows."""
    martensite: Flags
    oriented: Flags
    """Committed grain states."""
    scratch: Table
    """Two rows of stresses, MPa."""
    quiet: Floats
    """Quiet surroundings of the committed grain states; none while KELVIN and MEGAPASCAL are 0."""


@kernel
def update_grains(
    temperature: float, stress: float, unoriented_share: float, grains: Table, martensite: Flags, oriented: Flags
) -> tuple[int, int]:
    """Bring every grain to a temperature and a stress; return the number of martensite and of oriented grains."""
    martensites = 0
    orienteds = 0
    for g in range(martensite.size):
        cold = temperature - stress / grains[SLOPE, g] < grains[AUSTENITE, g] - grains[WIDTH, g]
        m = martensite[g]
        o = oriented[g]
        if m:
            share = 1.0 if o else unoriented_share
            # Where the stress would bring the austenite back at once, the grain stays what it is.
            if temperature - share * stress / grains[SLOPE, g] > grains[AUSTENITE, g] and not cold:
                m = False
                o = False
        elif cold:
            m = True
            o = stress > grains[ORIENT, g]
        if m:
            if stress > grains[DETWIN, g]:
                o = True
            elif stress < grains[RETWIN, g]:
                o = False
            martensites += 1
            if o:
                orienteds += 1
        martensite[g] = m
        oriented[g] = o
    return martensites, orienteds


@inner
def look_around(temperature: float, stress: float, parts: Parts) -> None:
    """Find how far temperature and stress may move until the first of the committed grains switches."""
    _, c, grains, martensite, oriented, _, quiet = parts
    kelvin = math.inf
    megapascal = math.inf
    least_slope = math.inf
    for g in range(martensite.size):
        slope = grains[SLOPE, g]
        least_slope = min(least_slope, slope)
        above_cold = temperature - stress / slope - (grains[AUSTENITE, g] - grains[WIDTH, g])
        if martensite[g]:
            if oriented[g]:
                share = 1.0
                megapascal = min(megapascal, stress - grains[RETWIN, g])
            else:
                share = c[0].unoriented_share
                megapascal = min(megapascal, grains[DETWIN, g] - stress)
            # The grain stays as long as it is not hot, or is cold.
            below_hot = grains[AUSTENITE, g] - (temperature - share * stress / slope)
            kelvin = min(kelvin, max(below_hot, -above_cold))
        else:
            kelvin = min(kelvin, above_cold)
    quiet[MIDDLE_TEMPERATURE] = temperature
    quiet[MIDDLE_STRESS] = stress
    quiet[KELVIN] = kelvin - GUARD
    quiet[MEGAPASCAL] = megapascal - GUARD
    quiet[LEAST_SLOPE] = least_slope


@inner
def quiet_stress(temperature: float, quiet: Floats) -> float:
    """How far the stress may be from the middle of the quiet surroundings at a temperature, MPa; 0 if not at all."""
    kelvin = quiet[KELVIN] - abs(temperature - quiet[MIDDLE_TEMPERATURE])
    megapascal: float = max(min(quiet[MEGAPASCAL], kelvin * quiet[LEAST_SLOPE]), 0.0)
    return megapascal


@kernel
def wire_length(
    temperature: float, stress: float, martensites: float, orienteds: float, count: int, c: Coefficients
) -> float:
    """Elongation of the wire from its resting length, mm."""
    share = martensites / count
    strain = stress * (share / c[0].martensite_modulus + (1.0 - share) / c[0].austenite_modulus)
    strain += (
        c[0].expansion * (temperature - c[0].expansion_reference) + c[0].transformation_strain * orienteds / count
    )
    length: float = c[0].rest_length * (strain - c[0].rest_strain)
    return length


@inner
def end_position(
    temperature: float, stress: float, martensites: float, orienteds: float, count: int, c: Coefficients
) -> float:
    """Position of the moving end of a taut wire: its elongation and that of frame and load cell, mm."""
    length = wire_length(temperature, stress, martensites, orienteds, count, c)
    position: float = length + stress * c[0].area * c[0].series_compliance
    return position


@inner
def switching_stresses(temperature: float, parts: Parts) -> None:
    """Write the stresses above which each grain will be martensite, and oriented, to the rows of `scratch`."""
    _, c, grains, martensite, oriented, scratch, _ = parts
    for g in range(martensite.size):
        cold = (temperature - grains[AUSTENITE, g] + grains[WIDTH, g]) * grains[SLOPE, g]
        hot = (temperature - grains[AUSTENITE, g]) * grains[SLOPE, g]
        if not martensite[g]:
            switch = cold
            orient = max(min(grains[ORIENT, g], grains[DETWIN, g]), grains[RETWIN, g])
        elif oriented[g]:
            switch = hot
            orient = grains[RETWIN, g]
        else:
            switch = min(hot / c[0].unoriented_share, cold)
            orient = grains[DETWIN, g]
        scratch[0, g] = switch
        scratch[1, g] = max(switch, orient)


@inner
def solve_quietly(position: float, temperature: float, committed: float, parts: Parts) -> float:
    """Return what `solve_stress` would if that lies where no grain switches, otherwise -1."""
    state, c, quiet = parts.state, parts.c, parts.quiet
    count = parts.martensite.size
    martensites = state[MARTENSITE]
    orienteds = state[ORIENTED]
    limit = float(c[0].stress_limit)
    reach = quiet_stress(temperature, quiet)
    first = max(quiet[MIDDLE_STRESS] - reach, 0.0)
    last = min(quiet[MIDDLE_STRESS] + reach, limit)
    if (
        reach == 0.0
        or end_position(temperature, first, martensites, orienteds, count, c) > position - GUARD
        or end_position(temperature, last, martensites, orienteds, count, c) < position + GUARD
    ):
        return -1.0
    low = 0.0
    high = limit
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        # Beyond the ends the wire is shorter, or longer, than imposed: a trial length never falls with stress.
        if middle <= first or (
            middle < last and end_position(temperature, middle, martensites, orienteds, count, c) <= position
        ):
            low = middle
        else:
            high = middle
    return low if low >= committed else high


@kernel
def solve_stress(position: float, temperature: float, committed: float, parts: Parts) -> float:
    """Find the stress at which the wire is as long as imposed, by bisection on trials from the committed state.

    It is 0 if the wire is slack, and the stress limit if it cannot be stretched so far.

    The trial length is non-decreasing in stress with a jump where a grain switches. Of the last
    interval the end next to the committed stress is taken, so that a grain whose switch alone would
    overshoot the imposed length waits. Grains that the interval has left behind need not be looked at
    again, so the whole bisection costs little more than one trial. Where no grain switches at all, none is looked at.
    """
    quietly = solve_quietly(position, temperature, committed, parts)
    if quietly >= 0.0:
        return quietly
    c, scratch = parts.c, parts.scratch
    count = parts.martensite.size
    limit = float(c[0].stress_limit)
    # As floats: the counts of the state are, and the lengths are compiled once.
    below = np.zeros(2)
    inside = np.zeros(2, dtype=np.int64)
    low = 0.0
    high = limit
    halvings = HALVINGS
    # Mostly the stress stays in the interval that the first halvings would end in: look there first.
    for attempt in range(2):
        if attempt == 0:
            halvings = HALVINGS - FIRST_HALVINGS
            part = limit / 2**FIRST_HALVINGS
            low = part * math.floor(min(committed, limit - 0.5 * part) / part)
            high = low + part
        else:
            halvings = HALVINGS
            low = 0.0
            high = limit
        switching_stresses(temperature, parts)
        # Count the switches below the interval and move those inside it to the front of their row.
        for row in range(2):
            passed_by = 0
            kept = 0
            for g in range(count):
                value = scratch[row, g]
                passed_by += value < low
                if low <= value < high:
                    scratch[row, kept] = value
                    kept += 1
            below[row] = passed_by
            inside[row] = kept
        shortest = end_position(temperature, low, below[0], below[1], count, c)
        longest = end_position(temperature, high, below[0] + inside[0], below[1] + inside[1], count, c)
        if low == 0.0 and shortest >= position:
            return low
        if high >= limit and longest <= position:
            return high
        if shortest <= position < longest:
            break
    passed = np.zeros(2, dtype=np.int64)
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        for row in range(2):
            passed[row] = 0
            for g in range(inside[row]):
                if scratch[row, g] < middle:
                    passed[row] += 1
        upwards = end_position(temperature, middle, below[0] + passed[0], below[1] + passed[1], count, c) <= position
        for row in range(2):
            if 0 < passed[row] < inside[row]:
                kept = 0
                for g in range(inside[row]):
                    value = scratch[row, g]
                    if (value >= middle) == upwards:
                        scratch[row, kept] = value
                        kept += 1
                inside[row] = kept
            elif (passed[row] == 0) != upwards:
                inside[row] = 0
            if upwards:
                below[row] += passed[row]
        if upwards:
            low = middle
        else:
            high = middle
    return low if low >= committed else high


@inner
def commit(temperature: float, stress: float, parts: Parts) -> None:
    """Take over temperature and stress and bring the grains there."""
    state, c, grains, martensite, oriented, _, quiet = parts
    state[TEMPERATURE] = temperature
    state[STRESS] = stress
    if abs(stress - quiet[MIDDLE_STRESS]) < quiet_stress(temperature, quiet):
        return
    martensites, orienteds = update_grains(temperature, stress, c[0].unoriented_share, grains, martensite, oriented)
    if martensites == state[MARTENSITE] and orienteds == state[ORIENTED]:
        # Probably at rest: grains mostly come one way.
        look_around(temperature, stress, parts)
    else:
        quiet[KELVIN] = 0.0
        quiet[MEGAPASCAL] = 0.0
    state[MARTENSITE] = martensites
    state[ORIENTED] = orienteds


@kernel
def load_to(stress: float, parts: Parts) -> None:
    """Move the imposed stress at constant temperature, in sub-steps."""
    state, c = parts.state, parts.c
    temperature = state[TEMPERATURE]
    begin = state[STRESS]
    steps = math.ceil(abs(stress - begin) / c[0].stress_step)
    for k in range(1, steps + 1):
        commit(temperature, begin + (stress - begin) * k / steps, parts)
    state[STRESS] = stress
    state[POSITION] = end_position(temperature, stress, state[MARTENSITE], state[ORIENTED], parts.martensite.size, c)


@inner
def stretch_to(position: float, parts: Parts) -> None:
    """Move the imposed position at constant temperature, in sub-steps."""
    state, c = parts.state, parts.c
    temperature = state[TEMPERATURE]
    begin = state[POSITION]
    steps = math.ceil(abs(position - begin) / c[0].length_step)
    for k in range(1, steps + 1):
        place = begin + (position - begin) * k / steps
        stress = solve_stress(place, temperature, state[STRESS], parts)
        commit(temperature, stress, parts)
    state[POSITION] = position


@kernel
def heat_to(temperature: float, clamped: bool, parts: Parts) -> None:
    """Move the temperature at constant load or at constant position, in sub-steps."""
    state, c = parts.state, parts.c
    begin = state[TEMPERATURE]
    position = state[POSITION]
    steps = math.ceil(abs(temperature - begin) / c[0].temperature_step)
    for k in range(1, steps + 1):
        warm = begin + (temperature - begin) * k / steps
        stress = state[STRESS]
        if clamped:
            stress = solve_stress(position, warm, stress, parts)
        commit(warm, stress, parts)
    state[TEMPERATURE] = temperature
    if not clamped:
        state[POSITION] = end_position(
            temperature, state[STRESS], state[MARTENSITE], state[ORIENTED], parts.martensite.size, c
        )


@kernel
def advance_steps(normals: Floats, command: Floats, forces: Floats, parts: Parts) -> None:
    """Advance the whole plant by one grid step for each element of `normals`, and keep the force (N) at each.

    `forces` is a ring: that of the n-th step is in place n modulo its size, and behind the ring stands n.

    The mechanical command is carried out first, at the temperature of the step before, and then the
    wire is heated: this order of the two moves decides the memory when both change in one step.
    """
    state, c = parts.state, parts.c
    clamped = command[CLAMPED] != 0.0
    for row in range(normals.size):
        if clamped:
            stretch_to(command[PLACE], parts)
        else:
            load_to(command[LOAD] / c[0].area, parts)
        offset = c[0].ambient_decay * state[AMBIENT_OFFSET] + c[0].ambient_kick * normals[row]
        state[AMBIENT_OFFSET] = offset
        rise = c[0].heating * (1.0 + c[0].ambient_gain * offset) * command[VOLTAGE] * command[VOLTAGE]
        decay = c[0].still_decay
        if command[FAN] != 0.0:
            rise *= c[0].fan_share
            decay = c[0].fan_decay
        steady = c[0].ambient + offset + rise
        warm = steady + (state[TEMPERATURE] - steady) * decay
        heat_to(warm, clamped, parts)
        step = int(forces[-1]) + 1
        forces[step % (forces.size - 1)] = state[STRESS] * c[0].area
        forces[-1] = step
