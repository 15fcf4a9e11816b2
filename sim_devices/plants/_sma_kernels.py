"""Compiled inner loops of the SMA wire plant.

The plant keeps its state in plain arrays, because passing a few arrays into a compiled function costs
a microsecond and the plant is advanced hundreds of thousands of times a run. The constants below name
the places in these arrays. Here stresses are in MPa, forces in N, lengths in mm and temperatures in °C.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim_devices.plants.grid import Floats, Record
from sim_devices.plants.muscle import CLAMPED, FAN, LOAD, PLACE, VOLTAGE

# Continuous state: wire temperature, ambient deviation (K), stress, position of the moving end (mm),
# number of martensite grains and of oriented martensite grains.
TEMPERATURE, AMBIENT_OFFSET, STRESS, POSITION, MARTENSITE, ORIENTED = range(6)
STATE_SIZE = 6

# Rows of the grain table: austenite finish (°C) and width (K) of the transformation, Clausius-Clapeyron
# slope (MPa/K), detwinning stress, orientation stress on cooling, re-twinning stress (MPa).
AUSTENITE, WIDTH, SLOPE, DETWIN, ORIENT, RETWIN = range(6)
GRAIN_ROWS = 6

# Halvings of the stress interval: 600 MPa come down to 3.5e-8 MPa, a nanonewton of force.
HALVINGS = 34
FIRST_HALVINGS = 5

Flags = NDArray[np.bool_]


class Parts(NamedTuple):
    """All numbers of a wire, as the compiled loops take them."""

    state: Floats
    c: Record
    """State, and coefficients."""
    grains: Floats
    """Grain table, `GRAIN_ROWS` rows."""
    martensite: Flags
    oriented: Flags
    """Committed grain states."""
    scratch: Floats
    """Two rows of stresses, MPa."""


@njit(cache=True)
def update_grains(
    temperature: float, stress: float, unoriented_share: float, grains: Floats, martensite: Flags, oriented: Flags
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


@njit(cache=True)
def wire_length(
    temperature: float, stress: float, martensites: float, orienteds: float, count: int, c: Record
) -> float:
    """Elongation of the wire from its resting length, mm."""
    share = martensites / count
    strain = stress * (share / c.martensite_modulus + (1.0 - share) / c.austenite_modulus)
    strain += c.expansion * (temperature - c.expansion_reference) + c.transformation_strain * orienteds / count
    length: float = c.rest_length * (strain - c.rest_strain)
    return length


@njit(cache=True)
def end_position(
    temperature: float, stress: float, martensites: float, orienteds: float, count: int, c: Record
) -> float:
    """Position of the moving end of a taut wire: its elongation and that of frame and load cell, mm."""
    length = wire_length(temperature, stress, martensites, orienteds, count, c)
    position: float = length + stress * c.area * c.series_compliance
    return position


@njit(cache=True)
def switching_stresses(temperature: float, parts: Parts) -> None:
    """Write the stresses above which each grain will be martensite, and oriented, to the rows of `scratch`."""
    _, c, grains, martensite, oriented, scratch = parts
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
            switch = min(hot / c.unoriented_share, cold)
            orient = grains[DETWIN, g]
        scratch[0, g] = switch
        scratch[1, g] = max(switch, orient)


@njit(cache=True)
def solve_stress(position: float, temperature: float, committed: float, parts: Parts) -> float:
    """Find the stress at which the wire is as long as imposed, by bisection on trials from the committed state.

    It is 0 if the wire is slack, and the stress limit if it cannot be stretched so far.

    The trial length is non-decreasing in stress with a jump where a grain switches. Of the last
    interval the end next to the committed stress is taken, so that a grain whose switch alone would
    overshoot the imposed length waits. Grains that the interval has left behind need not be looked at
    again, so the whole bisection costs little more than one trial.
    """
    c, scratch = parts.c, parts.scratch
    count = parts.martensite.size
    limit = float(c.stress_limit)
    below = np.zeros(2, dtype=np.int64)
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


@njit(cache=True)
def commit(temperature: float, stress: float, parts: Parts) -> None:
    """Take over temperature and stress and bring the grains there."""
    state, c, grains, martensite, oriented, _ = parts
    martensites, orienteds = update_grains(temperature, stress, c.unoriented_share, grains, martensite, oriented)
    state[TEMPERATURE] = temperature
    state[STRESS] = stress
    state[MARTENSITE] = martensites
    state[ORIENTED] = orienteds


@njit(cache=True)
def load_to(stress: float, parts: Parts) -> None:
    """Move the imposed stress at constant temperature, in sub-steps."""
    state, c = parts.state, parts.c
    temperature = state[TEMPERATURE]
    begin = state[STRESS]
    steps = math.ceil(abs(stress - begin) / c.stress_step)
    for k in range(1, steps + 1):
        commit(temperature, begin + (stress - begin) * k / steps, parts)
    state[STRESS] = stress
    state[POSITION] = end_position(temperature, stress, state[MARTENSITE], state[ORIENTED], parts.martensite.size, c)


@njit(cache=True)
def stretch_to(position: float, parts: Parts) -> None:
    """Move the imposed position at constant temperature, in sub-steps."""
    state, c = parts.state, parts.c
    temperature = state[TEMPERATURE]
    begin = state[POSITION]
    steps = math.ceil(abs(position - begin) / c.length_step)
    for k in range(1, steps + 1):
        place = begin + (position - begin) * k / steps
        stress = solve_stress(place, temperature, state[STRESS], parts)
        commit(temperature, stress, parts)
    state[POSITION] = position


@njit(cache=True)
def heat_to(temperature: float, clamped: bool, parts: Parts) -> None:
    """Move the temperature at constant load or at constant position, in sub-steps."""
    state, c = parts.state, parts.c
    begin = state[TEMPERATURE]
    position = state[POSITION]
    steps = math.ceil(abs(temperature - begin) / c.temperature_step)
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


@njit(cache=True)
def advance_steps(normals: Floats, command: Floats, parts: Parts) -> None:
    """Advance the whole plant by one grid step for each element of `normals`.

    The mechanical command is carried out first, at the temperature of the step before, and then the
    wire is heated: this order of the two moves decides the memory when both change in one step.
    """
    state, c = parts.state, parts.c
    clamped = command[CLAMPED] != 0.0
    for row in range(normals.size):
        if clamped:
            stretch_to(command[PLACE], parts)
        else:
            load_to(command[LOAD] / c.area, parts)
        offset = c.ambient_decay * state[AMBIENT_OFFSET] + c.ambient_kick * normals[row]
        state[AMBIENT_OFFSET] = offset
        rise = c.heating * (1.0 + c.ambient_gain * offset) * command[VOLTAGE] * command[VOLTAGE]
        decay = c.still_decay
        if command[FAN] != 0.0:
            rise *= c.fan_share
            decay = c.fan_decay
        steady = c.ambient + offset + rise
        warm = steady + (state[TEMPERATURE] - steady) * decay
        heat_to(warm, clamped, parts)
