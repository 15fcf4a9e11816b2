"""Protocols that switch outputs of a rig on, and then go wrong or are to be disturbed."""

import ctypes
import json
import os
from collections.abc import Generator
from pathlib import Path

from bench.protocol import Dwell, Message, Messages, Note, ProtocolParameters, Reading, Step, parameter, protocol


class Parameters(ProtocolParameters):
    setpoints: str = parameter("{}", unit="", help="set-points by device, JSON")
    then: str = parameter("{}", unit="", help="set-points by device, JSON, sent once everything is on")
    seconds: float = parameter(600.0, unit="s", low=0, high=86400, help="how long it holds")
    until: str = parameter("", unit="", help="file at which it goes wrong, once everything is on")


def _hold(parameters: Parameters, seconds: float) -> Generator[Message, Reading, Reading]:
    # Zero first, and one after the other: a supply that was off is not switched on by the first set-point.
    for device, value in json.loads(parameters.setpoints).items():
        yield Step({device: value}, Dwell(0.2))
    yield Note("everything is on")
    return (yield Step(json.loads(parameters.then), Dwell(seconds)))


def _hold_until(parameters: Parameters) -> Generator[Message, Reading, bool]:
    """Hold everything on until the file is there; return False in the dry run, whose readings are empty."""
    reading = yield from _hold(parameters, 0.2)
    while reading.values and not Path(parameters.until).exists():
        reading = yield Step({}, Dwell(0.2))
    yield Note("computing")
    return bool(reading.values)


@protocol(needs=())
def hold(parameters: Parameters) -> Messages:
    """Hold everything on."""
    yield from _hold(parameters, parameters.seconds)


@protocol(needs=())
def spin(parameters: Parameters) -> Messages:
    """Compute for ever."""
    goes_wrong = yield from _hold_until(parameters)
    while goes_wrong:
        pass


@protocol(needs=())
def keep_interpreter(parameters: Parameters) -> Messages:
    """Run code that never gives up Python's lock."""
    if (yield from _hold_until(parameters)):
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
    if (yield from _hold_until(parameters)):
        os._exit(0)
