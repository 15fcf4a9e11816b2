"""Characterization of a muscle under dead loads: its length over the voltage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.protocol import Messages, NumberList, Phase, Slots, parameter, protocol
from protocols.muscles.force_voltage import scaled_steps
from protocols.muscles.parts import (
    LENGTH_LOOPS,
    ON_WEIGHTS,
    ResetParameters,
    hang,
    over_range,
    reset_under_weights,
    sample_voltages,
)


class Loaded(ResetParameters):
    """Parameters of either sequence of voltages."""

    loads: NumberList = parameter(over_range("load", 5), unit="N", help="dead loads, one after another")


class Parameters(Loaded):
    """Parameters."""

    points: int = parameter(37, unit="1", low=11, high=10000, help="number of voltages at each load")


class RandomParameters(Loaded):
    """Parameters."""

    points: int = parameter(18, unit="1", low=1, high=10000, help="number of voltages at each load")
    sequence_seed: int = parameter(1, unit="1", low=0, help="seed of the voltages")


@protocol(needs=ON_WEIGHTS, views=LENGTH_LOOPS)
def length_voltage(parameters: Parameters, slots: Slots) -> Messages:
    """Characterize the length of a muscle over the voltage, under one dead load after another.

    For each load the operator hangs the pretension alone, the memory is reset, the load is hung on, and the
    voltage goes through a damped oscillation, with one reading after each dwell (Zhang and Yip 2017, sections
    II-A and V-A: five loads, 37 voltages, 30 s).
    """
    yield from _under_loads(parameters, slots, scaled_steps(parameters.highest, parameters.points))


@protocol(needs=ON_WEIGHTS, views=LENGTH_LOOPS)
def length_verification(parameters: RandomParameters, slots: Slots) -> Messages:
    """Verify a model of a muscle by random voltages, the same under one dead load after another.

    As `length-voltage`, with uniformly distributed voltages (Zhang and Yip 2017, section V-C: five loads, 18
    voltages).
    """
    rng = np.random.default_rng(parameters.sequence_seed)
    yield from _under_loads(parameters, slots, rng.uniform(0.0, parameters.highest, parameters.points).tolist())


def _under_loads(parameters: Loaded, slots: Slots, voltages: Sequence[float]) -> Messages:
    if min(parameters.loads) <= 0:
        loads = ", ".join(f"{load:g}" for load in parameters.loads)
        raise ValueError(f"parameter loads = {loads} N is not allowed; allowed: positive numbers")
    for load in parameters.loads:
        yield from reset_under_weights(parameters, slots)
        yield from hang(parameters, slots, load)
        yield Phase(f"length over voltage at {load:g} N")
        yield from sample_voltages(parameters, slots, voltages)
