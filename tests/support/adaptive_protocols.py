"""Protocols that go on by what they read."""

from bench.devices import Actuator, Signal
from bench.protocol import Dwell, Messages, Note, Phase, ProtocolParameters, Slots, Step, parameter, protocol

NEEDS = {"drive": Actuator, "response": Signal}


class Goal(ProtocolParameters):
    goal: float = parameter(..., unit="", help="response to reach")
    low: float = parameter(..., unit="", help="set-point to begin at")
    high: float = parameter(..., unit="", help="highest set-point")
    dwell: float = parameter(4.0, unit="s", low=0.1, help="hold")


def _read(slots, value, dwell):
    reading = yield Step({slots["drive"].device: value}, Dwell(dwell))
    return reading[slots["response"].signal]


@protocol(needs=NEEDS)
def climb(parameters: Goal, slots: Slots) -> Messages:
    """Raise the drive until the response has passed the goal."""
    p = parameters
    first = response = yield from _read(slots, p.low, p.dwell)
    value, increment = p.low, (p.high - p.low) / 40
    while (response - p.goal) * (first - p.goal) > 0:
        value += increment
        response = yield from _read(slots, value, p.dwell)
    yield Note(f"passed at {value:g}")


@protocol(needs=NEEDS)
def bisect(parameters: Goal, slots: Slots) -> Messages:
    """Halve an interval of the drive until the response there is the goal's."""
    p = parameters
    low, high = p.low, p.high
    below = yield from _read(slots, low, p.dwell)
    yield Phase("halving")
    while high - low > (p.high - p.low) / 100:
        middle = 0.5 * (low + high)
        response = yield from _read(slots, middle, p.dwell)
        if (response < p.goal) == (below < p.goal):
            low = middle
        else:
            high = middle


@protocol(needs=NEEDS)
def wait_for_ever(parameters: Goal, slots: Slots) -> Messages:
    """Wait until a response has gone that stays."""
    while True:
        response = yield from _read(slots, parameters.low, parameters.dwell)
        if response == parameters.goal:
            return
