"""Compiled inner loops of the VO2 cantilever plant.

The constants below name the places in the plain arrays of the state, which pass into a compiled function within a
microsecond; coefficients go by name. All temperatures are in degrees Celsius except inside the Peltier terms.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.base import Table, inner, kernel
from sim_devices.plants.cooler import CLOSED, COMMAND, LIMIT, TARGET
from sim_devices.plants.grid import Floats, record_type

ZERO_CELSIUS = 273.15

# Continuous state.
PLATE, RATE, CURRENT, SINK, WANDER, DRIFT, DRIVE = range(7)
STATE_SIZE = 7

# Relay counters: relays that are on, up-thresholds and down-thresholds below the present drive.
ON_COUNT, UP_BELOW, DOWN_BELOW = range(3)
COUNTER_SIZE = 3

Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

COEFFICIENTS = record_type(
    "step loop_ee loop_ev loop_ve loop_vv slew slew_decay current_decay seebeck resistance conductance "
    "plate_loss plate_capacity sink_capacity sink_loss ambient wander_decay wander_kick drift_decay "
    "drift_kick offset coupling relay_step"
)
"""Coefficients, prepared once from the parameters."""
Coefficients = Annotated[Any, COEFFICIENTS, 1]


class Parts(NamedTuple):
    """All numbers of the film and its plate, as the compiled loops take them."""

    state: Floats
    c: Coefficients
    """State and coefficients."""
    counters: Integers
    """Relay counters."""
    up: Floats
    down: Floats
    """Up- and down-thresholds, °C, each sorted."""
    down_relay: Integers
    """Relay number of each element of `down`."""
    on: Flags
    """Relay states."""


@kernel
def switch_relays(
    drive: float, counters: Integers, up: Floats, down: Floats, down_relay: Integers, on: Flags
) -> None:
    """Bring every relay to one new value of the drive.

    A relay is on above its up-threshold, off below its down-threshold and otherwise keeps its state.
    Relays are numbered in the order of their up-thresholds, so only those whose threshold lies in the
    swept interval are touched.
    """
    size = up.size
    count = counters[ON_COUNT]
    above = counters[UP_BELOW]
    while above < size and up[above] < drive:
        if not on[above]:
            on[above] = True
            count += 1
        above += 1
    while above > 0 and up[above - 1] >= drive:
        above -= 1
    below = counters[DOWN_BELOW]
    while below < size and down[below] < drive:
        below += 1
    while below > 0 and down[below - 1] > drive:
        below -= 1
        relay = down_relay[below]
        if on[relay]:
            on[relay] = False
            count -= 1
    counters[ON_COUNT] = count
    counters[UP_BELOW] = above
    counters[DOWN_BELOW] = below


@kernel
def settle_film(film: float, parts: Parts) -> None:
    """Sweep the effective temperature towards what the film temperature and the R fraction ask for.

    The R fraction of the previous sub-step feeds back (causal), so relays that switch in the last
    sub-step act one grid step later, as an avalanche does.
    """
    state, c, counters, up, down, down_relay, on = parts
    relay_step = c[0].relay_step
    while True:
        wanted = film + c[0].coupling * (counters[ON_COUNT] / up.size - 0.5)
        move = wanted - state[DRIVE]
        if abs(move) <= relay_step:
            state[DRIVE] = wanted
            switch_relays(wanted, counters, up, down, down_relay, on)
            return
        state[DRIVE] += math.copysign(relay_step, move)
        switch_relays(state[DRIVE], counters, up, down, down_relay, on)


@kernel
def plate_rate(plate: float, current: float, sink: float, c: Coefficients) -> float:
    """Evaluate the heat balance: rate of the plate temperature (K/s) under a current (A, positive heats)."""
    heat = c[0].seebeck * (plate + ZERO_CELSIUS) * current + 0.5 * c[0].resistance * current * current
    heat -= c[0].conductance * (plate - sink) + c[0].plate_loss * (plate - c[0].ambient)
    rate: float = heat / c[0].plate_capacity
    return rate


@inner
def current_for(plate: float, rate: float, sink: float, c: Coefficients) -> float:
    """Find the current (A) that gives the plate a rate: inverse of `plate_rate`, the root of smaller magnitude."""
    heat = c[0].plate_capacity * rate
    heat += c[0].conductance * (plate - sink) + c[0].plate_loss * (plate - c[0].ambient)
    pumped = c[0].seebeck * (plate + ZERO_CELSIUS)
    # The rate never asks for more cooling than the Peltier maximum: a negative root is rounding only.
    root = math.sqrt(max(pumped * pumped + 2.0 * c[0].resistance * heat, 0.0))
    current: float = 2.0 * heat / (pumped + root)
    return current


@inner
def limited_rate(rate: float, slew: float, limit: float, plate: float, sink: float, c: Coefficients) -> float:
    """Limit a rate (K/s) to the slew limit and the heat flow that the current limit (A, may be infinite) allows."""
    # Beyond this current the Joule heat outgrows the pumping and more current cools less.
    best_cooling = c[0].seebeck * (plate + ZERO_CELSIUS) / c[0].resistance
    rate = min(max(rate, -slew), slew)
    rate = min(rate, plate_rate(plate, limit, sink, c))
    return max(rate, plate_rate(plate, -min(limit, best_cooling), sink, c))


@inner
def step_plate(state: Floats, command: Floats, c: Coefficients) -> None:
    """Advance plate, current and sink by one grid step."""
    step = c[0].step
    plate = state[PLATE]
    rate = state[RATE]
    current = state[CURRENT]
    sink = state[SINK]

    taken = c[0].seebeck * (sink + ZERO_CELSIUS) * current - 0.5 * c[0].resistance * current * current
    taken -= c[0].conductance * (plate - sink)
    sink += step * (-taken - c[0].sink_loss * (sink - c[0].ambient)) / c[0].sink_capacity

    if command[CLOSED] == 0.0:
        current = command[COMMAND] + (current - command[COMMAND]) * c[0].current_decay
        ahead = plate_rate(plate + step * rate, current, sink, c)
        plate += 0.5 * step * (rate + ahead)
        rate = plate_rate(plate, current, sink, c)
    else:
        error = command[TARGET] - plate
        wanted = c[0].loop_ve * error + c[0].loop_vv * rate
        moved = command[TARGET] - (c[0].loop_ee * error + c[0].loop_ev * rate)
        # A mode change may hand over more speed or current than the limits allow: it decays into them.
        slew = c[0].slew + max(abs(rate) - c[0].slew, 0.0) * c[0].slew_decay
        limit = command[LIMIT] + max(abs(current) - command[LIMIT], 0.0) * c[0].current_decay
        reached = limited_rate(wanted, slew, limit, plate + step * rate, sink, c)
        plate = moved if reached == wanted else plate + 0.5 * step * (rate + reached)
        # Once more where the plate has come to, so that the current never leaves its limit.
        rate = limited_rate(wanted, slew, limit, plate, sink, c)
        current = current_for(plate, rate, sink, c)

    state[PLATE] = plate
    state[RATE] = rate
    state[CURRENT] = current
    state[SINK] = sink


@kernel
def advance_steps(normals: Table, command: Floats, parts: Parts) -> None:
    """Advance the whole plant by one grid step for each row of `normals`: wander, drift."""
    state, c = parts.state, parts.c
    for row in range(normals.shape[0]):
        step_plate(state, command, c)
        state[WANDER] = c[0].wander_decay * state[WANDER] + c[0].wander_kick * normals[row, 0]
        state[DRIFT] = c[0].drift_decay * state[DRIFT] + c[0].drift_kick * normals[row, 1]
        film = state[PLATE] + state[WANDER] + state[DRIFT] + c[0].offset
        settle_film(film, parts)
