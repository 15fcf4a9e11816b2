"""Protocols that switch outputs of a rig on, and then go wrong or are to be disturbed."""

import ctypes
import json
import os
from collections.abc import Generator
from pathlib import Path

from bench.protocol import Dwell, Messages, Note, ProtocolParameters, Step, parameter, protocol
from bench.protocol.vocabulary import Message, Reading


class Parameters(ProtocolParameters):
    setpoints: str = parameter("{}", unit="", help="set-points by device, JSON")
    then: str = parameter("{}", unit="", help="set-points by device, JSON, sent once everything is on")
    seconds: float = parameter(600.0, unit="s", low=0, high=86400, help="how long it holds")
    before: float = parameter(1.0, unit="s", low=0, high=86400, help="how long it holds before it computes")


def _hold(parameters: Parameters, seconds: float) -> Generator[Message, Reading, Reading]:
    # Zero first, and one after the other: a supply that was off is not switched on by the first set-point.
    for device, value in json.loads(parameters.setpoints).items():
        yield Step({device: value}, Dwell(0.2))
    yield Note("everything is on")
    return (yield Step(json.loads(parameters.then), Dwell(seconds)))


@protocol(needs=())
def hold(parameters: Parameters) -> Messages:
    """Hold everything on."""
    yield from _hold(parameters, parameters.seconds)


@protocol(needs=())
def spin(parameters: Parameters) -> Messages:
    """Compute for ever."""
    reading = yield from _hold(parameters, parameters.before)
    yield Note("computing")
    # Not in the dry run, whose readings are empty.
    while reading.values:
        pass


@protocol(needs=())
def think(parameters: Parameters) -> Messages:
    """Compute for ever before anything is set."""
    yield Note("computing")
    reading = yield Step({}, Dwell(parameters.before))
    while reading.values:
        pass


@protocol(needs=())
def keep_interpreter(parameters: Parameters) -> Messages:
    """Run code that never gives up Python's lock."""
    reading = yield from _hold(parameters, 1.0)
    yield Note("computing")
    if reading.values:
        # PyDLL keeps the lock while the function runs.
        ctypes.PyDLL(None).sleep(60)
    yield Note("computed")


@protocol(needs=())
def talk(parameters: Parameters) -> Messages:
    """Print more than any terminal holds, in notes."""
    yield from _hold(parameters, 0.2)
    for _ in range(int(parameters.seconds / 0.2)):
        yield Note("x" * 1000)
        yield Note("x" * 1000)
        yield Step({}, Dwell(0.2))


@protocol(needs=())
def leave(parameters: Parameters) -> Messages:
    """End the process as if all were well."""
    reading = yield from _hold(parameters, parameters.before)
    if reading.values:
        os._exit(0)


class CycleParameters(ProtocolParameters):
    until: str = parameter("", unit="", help="file at which it ends, once it has cycled twice")


@protocol(needs=())
def cycle(parameters: CycleParameters) -> Messages:
    """Heat and cool the plate of the VO2 rig, and read it at rest."""
    cycles = 0
    while cycles < 2 or not Path(parameters.until).exists():
        yield Step({"tec": 30.0}, Dwell(4.0))
        reading = yield Step({"tec": 34.0}, Dwell(4.0))
        cycles += 1
        # The dry run waits for no file.
        if not reading.values:
            return
