"""The plan of a protocol: what is known of it before anything moves, without a reading being invented."""

from __future__ import annotations

import math
import traceback
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NoReturn, cast

from bench.base import BenchError, ConfigurationError
from bench.protocol.parameters import ProtocolDefinition, ProtocolParameters
from bench.protocol.vocabulary import Control, FixedRate, Message, Messages, Reading, Step
from bench.rig import SETPOINT, Slots

LONGEST = 1_000_000
"""Most steps of a protocol, and most notes."""

EXPECTED = "expected a Step, a Control, a FixedRate, a Prompt, a Phase or a Note"
"""What a protocol may yield, for messages."""


@dataclass(frozen=True)
class Plan:
    """What a protocol will do, as far as no reading decides how it goes on.

    Attributes
    ----------
    steps : int
        Number of steps.
    seconds : float
        Laboratory time in s, steps that settle until steady counted with their minimum, a `Control` not at all.
    at_most : float
        The same, counted with their timeouts; infinite if the plan is not complete.
    extremes : mapping of str to (float, float)
        Smallest and largest set-point by device.
    watched : frozenset of str
        Signals that have to become steady, are controlled or looked at.
    prompted : tuple of int
        Numbers of the steps in which the operator is asked to do something by hand.
    complete : bool
        Whether that is all. Otherwise the protocol goes on by what it reads: the numbers are those up to there, and
        the rest is unknown.
    finished : tuple of float
        Laboratory time from the start in s at which each step ends, counted as `seconds`.
    latest : tuple of float
        Longest time of each step, s.
    """

    steps: int
    seconds: float
    at_most: float
    extremes: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    watched: frozenset[str] = frozenset()
    prompted: tuple[int, ...] = ()
    complete: bool = True
    finished: tuple[float, ...] = ()
    latest: tuple[float, ...] = ()

    @property
    def prompts(self) -> int:
        """How often the operator is asked to do something by hand."""
        return len(self.prompted)


def plan(definition: ProtocolDefinition, parameters: ProtocolParameters, slots: Slots | None = None) -> Plan:
    """Run a protocol dry, set-point by set-point, as far as no reading decides how it goes on.

    Known are the number of a step, how it settles if all goes well, and as `NAME_setpoint` the set-point that a step
    has sent. Any other signal, and the time, is measured: a protocol may keep it, calculate with it and write it into
    a note; the plan ends where it compares it, turns it into a number, or sends it. What only the sentence of a
    `Summary` depends on may be compared there.

    Raises ConfigurationError if the protocol does not end within a million messages, its parameters do not fit
    together, or it fails.
    """
    others, seconds, at_most = 0, 0.0, 0.0
    watched: set[str] = set()
    extremes: dict[str, tuple[float, float]] = {}
    finished: list[float] = []
    latest: list[float] = []
    prompted: list[int] = []
    known = _KnownValues()
    reading: Reading | None = None
    try:
        messages = definition.start(parameters, slots or {})
        while True:
            message = _next(messages, reading, known)
            if message is _END:
                complete = not known.asked_too_much
                return Plan(
                    len(finished),
                    seconds,
                    at_most if complete else math.inf,
                    extremes,
                    frozenset(watched),
                    tuple(prompted),
                    complete,
                    tuple(finished),
                    tuple(latest),
                )
            if not isinstance(message, Message):
                raise ConfigurationError(f"protocol {definition.name} yielded {message!r}; {EXPECTED}")
            planned = message.plan()
            for device, (least, most) in planned.extremes.items():
                low, high = extremes.get(device, (least, most))
                extremes[device] = (min(low, least), max(high, most))
            known.take(message)
            watched |= planned.watched
            seconds, at_most = seconds + planned.seconds, at_most + planned.at_most
            prompted += [len(finished)] * planned.prompts
            if planned.settled is None:
                reading, others = None, others + 1
            else:
                reading = Reading(len(finished), cast("float", _Unknown(known)), planned.settled, known)
                finished.append(seconds)
                latest.append(planned.at_most)
            if max(len(finished), others) > LONGEST:
                what = "steps" if len(finished) > others else "notes"
                raise ConfigurationError(f"protocol {definition.name} does not end within {LONGEST} {what}")
    except BenchError:
        raise
    except ValueError as error:
        raise ConfigurationError(f"protocol {definition.name}: {error}") from error
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        raise ConfigurationError(
            f"protocol {definition.name} failed in its plan: {type(error).__name__}: {error} "
            f"({place.filename}, line {place.lineno})"
        ) from error


_END = object()


def _next(messages: Messages, reading: Reading | None, known: _KnownValues) -> object:
    """Return the next message; `_END` behind the last, and where the protocol has asked for what is not known."""
    message: object = _END
    try:
        # The first `send` of a generator has to be that of None.
        message = messages.send(reading)  # type: ignore[arg-type]
    except (StopIteration, _UnknownError):
        pass
    except Exception:
        if not known.asked_too_much:
            raise
    if isinstance(message, Step) and any(isinstance(each, _Unknown) for each in message.setpoints.values()):
        known.decide()
    # A protocol that catches what ends the plan goes on without ground.
    if known.asked_too_much and message is not _END:
        # What it does or raises on its way out does not matter.
        with suppress(Exception):
            messages.close()
        return _END
    return message


class _UnknownError(BaseException):
    """A measurement is to decide how a protocol goes on; not to be caught by `except Exception`."""


class _KnownValues(Mapping[str, float]):
    """The set-points that were sent, by signal; any other is unknown."""

    def __init__(self) -> None:
        self._setpoints: dict[str, float] = {}
        self.asked_too_much = False

    def take(self, message: Message) -> None:
        """Note what a message sends; where a controller leaves its actuators is not known."""
        if isinstance(message, Step):
            self._setpoints |= {f"{device}{SETPOINT}": value for device, value in message.setpoints.items()}
        elif isinstance(message, Control):
            self._setpoints.pop(f"{message.actuator}{SETPOINT}", None)
        elif isinstance(message, FixedRate):
            for device in message.actuators:
                self._setpoints.pop(f"{device}{SETPOINT}", None)

    def decide(self) -> _UnknownError:
        """Note that something unknown is to decide how the protocol goes on; return what to raise."""
        self.asked_too_much = True
        return _UnknownError()

    def __getitem__(self, signal: str) -> float:
        if signal not in self._setpoints:
            return cast("float", _Unknown(self))
        return self._setpoints[signal]

    def __contains__(self, signal: object) -> bool:
        raise self.decide()

    def __iter__(self) -> Iterator[str]:
        raise self.decide()

    def __len__(self) -> int:
        raise self.decide()


class _Unknown:
    """A number that only a measurement can tell."""

    def __init__(self, known: _KnownValues) -> None:
        self._known = known

    def __format__(self, _: str) -> str:
        return "unknown"

    def __repr__(self) -> str:
        return "unknown"

    def _calculate(self, *_: object) -> _Unknown:
        return self

    def _decide(self, *_: object) -> NoReturn:
        raise self._known.decide()

    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __truediv__ = __rtruediv__ = _calculate
    __pow__ = __rpow__ = __floordiv__ = __rfloordiv__ = __mod__ = __rmod__ = _calculate
    __neg__ = __pos__ = __abs__ = __round__ = _calculate
    __bool__ = __float__ = __int__ = __index__ = __complex__ = __hash__ = _decide
    __lt__ = __le__ = __gt__ = __ge__ = __eq__ = __ne__ = __floor__ = __ceil__ = __trunc__ = _decide
