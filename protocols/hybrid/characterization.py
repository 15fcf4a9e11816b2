"""Characterization of the thermo-piezoelectric hybrid, part by part.

Rakotondrabe and Ivan, "Development and Dynamic Modeling of a New Hybrid Thermopiezoelectric Microactuator", IEEE
Transactions on Robotics 26(6), 2010, section V; here "Rakotondrabe and Ivan 2010". Positive currents heat, so that
the paper's steps of 0.1, 0.05 and 0.025 A, which cool, are negative.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from bench.control import Playback
from bench.protocol import (
    Dwell,
    FixedRate,
    Messages,
    NumberList,
    Phase,
    ProtocolParameters,
    Slots,
    Step,
    Views,
    from_slot,
    parameter,
    protocol,
)
from bench.rig import RoleTable
from protocols.hybrid import BOTH_LOOPS, FINE, FINE_OVER_TIME, HEATING, SENSORS, THERMAL


def _play(
    slots: Slots,
    label: str,
    rate: float,
    duration: float,
    setpoints: dict[str, Callable[[float], float]],
    limits: tuple[tuple[float, float], ...],
    sensors: tuple[str, ...] = SENSORS,
    block: int = 0,
) -> FixedRate:
    """Return a loop that plays functions of time back on slots, within limits, and reads sensors."""
    return FixedRate(
        controller=Playback(*setpoints.values()),
        rate=rate,
        duration=duration,
        inputs=tuple(slots[name].signal for name in sensors),
        actuators=tuple(slots[name].device for name in setpoints),
        limits=limits,
        label=label,
        block=block,
    )


class CurrentSineParameters(ProtocolParameters):
    """What can be set."""

    amplitude: float = parameter(..., unit="A", low=0.001, high=1, help="amplitude of the current")
    frequencies: NumberList = parameter(..., unit="Hz", help="frequencies, one after another")
    periods: int = parameter(2, unit="1", low=2, high=100, help="periods at each; the first is the transient")
    rate: float = parameter(0.5, unit="Hz", low=0.01, high=100, help="samples in a second")


@protocol(needs=THERMAL, controls="response", views=HEATING)
def current_sine(parameters: CurrentSineParameters, slots: Slots) -> Messages:
    """Drive the Peltier element by a slow sine, and watch temperatures and deflection.

    By default a sine of 0.1 A at 0.001 Hz, for the static characteristics (Rakotondrabe and Ivan 2010, section V-B,
    Fig. 12); with a small amplitude and several frequencies, for the bandwidth.
    """
    amplitude = parameters.amplitude
    for frequency in parameters.frequencies:
        if not 0 < frequency <= parameters.rate / 10:
            raise ValueError(
                f"parameter frequencies: {frequency:g} Hz is not allowed; allowed: more than 0 and at most "
                f"{parameters.rate / 10:g} Hz, a tenth of rate"
            )
        yield Phase(f"sine of {frequency:g} Hz")
        yield _play(
            slots,
            f"{frequency:g} Hz",
            parameters.rate,
            parameters.periods / frequency,
            {"coarse": _sine(amplitude, frequency)},
            ((-amplitude, amplitude),),
        )


class CurrentStepsParameters(ProtocolParameters):
    """What can be set."""

    levels: NumberList = parameter(..., unit="A", help="currents, one after another")
    on: float = parameter(..., unit="s", low=1, high=36000, help="how long each is held")
    off: float = parameter(..., unit="s", low=1, high=36000, help="how long the current is off after each")
    rate: float = parameter(1.0, unit="Hz", low=0.01, high=100, help="samples in a second")


@protocol(needs=THERMAL, controls="response", views=HEATING)
def current_steps(parameters: CurrentStepsParameters, slots: Slots) -> Messages:
    """Step the current of the Peltier element, and watch temperatures and deflection.

    Steps of 0.1, 0.05 and 0.025 A that cool (Rakotondrabe and Ivan 2010, section V-B, Fig. 13), and one that heats,
    to separate Joule heat and Seebeck effect.
    """
    levels = parameters.levels
    cycle = parameters.on + parameters.off

    def current(t: float) -> float:
        number, within = divmod(t, cycle)
        return levels[min(int(number), len(levels) - 1)] if within < parameters.on else 0.0

    yield Phase("steps of the current")
    yield _play(
        slots,
        "current steps",
        parameters.rate,
        len(levels) * cycle,
        {"coarse": current},
        ((min(0.0, *levels), max(0.0, *levels)),),
    )


class ThermomechanicalParameters(ProtocolParameters):
    """What can be set."""

    coldest: float = parameter(..., unit="A", low=-1, high=0, help="lowest current, which cools most")
    hottest: float = parameter(..., unit="A", low=0, high=1, help="highest current")
    levels: int = parameter(9, unit="1", low=2, high=1000, help="currents on each way")
    dwell: float = parameter(
        ..., unit="s", low=1, high=36000, help="hold at each before the reading", changeable=True
    )


@protocol(needs=THERMAL, views=HEATING)
def thermomechanical(parameters: ThermomechanicalParameters, slots: Slots) -> Messages:
    """Measure the static deflection over the temperature of the tip, without voltage.

    The current goes down in steps, up, and back (Rakotondrabe and Ivan 2010, section V-C, Fig. 14).
    """
    down = np.linspace(0.0, parameters.coldest, parameters.levels)
    up = np.linspace(parameters.coldest, parameters.hottest, 2 * parameters.levels)[1:]
    back = np.linspace(parameters.hottest, 0.0, parameters.levels)[1:]
    yield Phase("staircase of the current")
    for current in [*down, *up, *back]:
        yield Step({slots["coarse"].device: float(current)}, Dwell(parameters.dwell), label="sample")


def _decreasing(fine: RoleTable) -> tuple[float, ...] | None:
    return None if fine.high is None else tuple(part * fine.high for part in (1.0, 1.0, 0.75, 0.5, 0.25))


class PiezoLoopsParameters(ProtocolParameters):
    """What can be set."""

    amplitudes: NumberList = parameter(
        from_slot("fine", _decreasing, "its highest voltage twice, and three quarters, half and a quarter of it"),
        unit="V",
        help="amplitude of each cycle",
    )
    frequency: float = parameter(0.1, unit="Hz", low=1e-3, high=10, help="cycles in a second")
    rate: float = parameter(50.0, unit="Hz", low=1, high=1e5, help="samples in a second")


@protocol(
    needs=FINE | {name: THERMAL[name] for name in SENSORS}, controls="response", views=Views((("fine", "response"),))
)
def piezo_loops(parameters: PiezoLoopsParameters, slots: Slots) -> Messages:
    """Measure the hysteresis of the piezo by a slow sine, with minor loops of decreasing amplitude.

    Rakotondrabe and Ivan 2010, section V-D, Fig. 15: 40 V, 0.1 Hz.
    """
    amplitudes = parameters.amplitudes
    largest = max(map(abs, amplitudes))

    def voltage(t: float) -> float:
        cycle = min(int(t * parameters.frequency), len(amplitudes) - 1)
        return amplitudes[cycle] * math.sin(2.0 * math.pi * parameters.frequency * t)

    yield Phase("loops of the voltage")
    yield _play(
        slots,
        "piezo loops",
        parameters.rate,
        len(amplitudes) / parameters.frequency,
        {"fine": voltage},
        ((-largest, largest),),
    )


class PiezoStepParameters(ProtocolParameters):
    """What can be set."""

    voltage: float = parameter(from_slot("fine", "high"), unit="V", low=-1000, high=1000, help="height of the step")
    rest: float = parameter(0.02, unit="s", low=0, high=10, help="time at 0 V before it")
    duration: float = parameter(0.3, unit="s", low=1e-3, high=100, help="time after it")
    rate: float = parameter(20e3, unit="Hz", low=10, high=1e6, help="samples in a second")
    block: int = parameter(
        0, unit="1", low=0, high=1000, help="samples in one request, as the step is known; 0: one by one"
    )


@protocol(needs=FINE, controls="response", views=FINE_OVER_TIME)
def piezo_step(parameters: PiezoStepParameters, slots: Slots) -> Messages:
    """Measure the deflection after a step of the voltage, fast enough for the resonance.

    Rakotondrabe and Ivan 2010, section V-D, Fig. 16: 40 V. The default rate is for an emulated rig: over a network a
    T7 answers one or two requests in a millisecond. With `block` it carries so many samples out by itself.
    """
    height = parameters.voltage
    # Half a sample sooner, as the instants of samples are rounded.
    begin = parameters.rest - 0.5 / parameters.rate
    yield Phase("step of the voltage")
    yield _play(
        slots,
        "piezo step",
        parameters.rate,
        parameters.rest + parameters.duration,
        {"fine": lambda t: height if t >= begin else 0.0},
        ((min(0.0, height), max(0.0, height)),),
        ("response",),
        parameters.block,
    )


class ExcitationParameters(ProtocolParameters):
    """What can be set."""

    current: float = parameter(..., unit="A", low=0, high=1, help="amplitude of the current")
    current_frequency: float = parameter(..., unit="Hz", low=1e-5, high=1, help="frequency of the current")
    voltage: float = parameter(..., unit="V", low=0, high=1000, help="amplitude of the voltage")
    voltage_frequency: float = parameter(0.05, unit="Hz", low=1e-4, high=10, help="frequency of the voltage")
    duration: float = parameter(2000.0, unit="s", low=1, high=36000, help="how long")
    rate: float = parameter(2.0, unit="Hz", low=0.01, high=1000, help="samples in a second")


@protocol(needs=THERMAL | FINE, controls="response", views=BOTH_LOOPS)
def hybrid_excitation(parameters: ExcitationParameters, slots: Slots) -> Messages:
    """Drive heat and voltage at once, a sine each, to validate a model of the whole.

    Rakotondrabe and Ivan 2010, eq. 22, has both parts.
    """
    p = parameters
    yield Phase("both at once")
    yield _play(
        slots,
        "both at once",
        p.rate,
        p.duration,
        {"coarse": _sine(p.current, p.current_frequency), "fine": _sine(p.voltage, p.voltage_frequency)},
        ((-p.current, p.current), (-p.voltage, p.voltage)),
    )


def _sine(amplitude: float, frequency: float) -> Callable[[float], float]:
    return lambda t: amplitude * math.sin(2.0 * math.pi * frequency * t)
