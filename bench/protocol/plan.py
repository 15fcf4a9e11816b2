"""The dry run of a protocol: its length and the extremes of its set-points, before anything moves."""

from __future__ import annotations

import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field

from bench.binding import Slots
from bench.errors import BenchError, ConfigurationError
from bench.protocol.parameters import ProtocolDefinition, ProtocolParameters
from bench.protocol.vocabulary import Message, Reading, Step

_LONGEST_PLAN = 1_000_000

EXPECTED = "expected a Step, a Control, a FixedRate, a Prompt, a Phase or a Note"
"""What a protocol may yield, for messages."""


@dataclass(frozen=True)
class Plan:
    """What a protocol will do, learned by running it dry.

    Attributes
    ----------
    steps : int
        Number of steps.
    seconds : float
        Laboratory time in s, steps that settle until steady counted with their minimum, a `Control` not at all.
    at_most : float
        The same, counted with their timeouts.
    extremes : mapping of str to (float, float)
        Smallest and largest set-point by device.
    watched : frozenset of str
        Signals that have to become steady, are controlled or looked at.
    prompts : int
        How often the operator is asked to do something by hand.
    """

    steps: int
    seconds: float
    at_most: float
    extremes: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    watched: frozenset[str] = frozenset()
    prompts: int = 0


def plan(definition: ProtocolDefinition, parameters: ProtocolParameters, slots: Slots | None = None) -> Plan:
    """Run a protocol dry, echoing each set-point as `NAME_setpoint` and `NAME_temperature` and the like.

    Any other signal reads as 0. Raises ConfigurationError if the protocol does not end within a million messages, its
    parameters do not fit together, or it fails.
    """
    steps, others, prompts, seconds, at_most = 0, 0, 0, 0.0, 0.0
    watched: set[str] = set()
    extremes: dict[str, tuple[float, float]] = {}
    echo = _Echo()
    reading: Reading | None = None
    try:
        messages = definition.start(parameters, slots or {})
        while True:
            try:
                # The first `send` of a generator has to be that of None.
                message = messages.send(reading)  # type: ignore[arg-type]
            except StopIteration:
                return Plan(steps, seconds, at_most, extremes, frozenset(watched), prompts)
            if not isinstance(message, Message):
                raise ConfigurationError(f"protocol {definition.name} yielded {message!r}; {EXPECTED}")
            planned = message.plan()
            for device, (least, most) in planned.extremes.items():
                low, high = extremes.get(device, (least, most))
                extremes[device] = (min(low, least), max(high, most))
            if isinstance(message, Step):
                echo.setpoints |= message.setpoints
            watched |= planned.watched
            seconds, at_most = seconds + planned.seconds, at_most + planned.at_most
            prompts += planned.prompts
            if planned.settled is None:
                reading, others = None, others + 1
            else:
                reading, steps = Reading(steps, seconds, planned.settled, echo), steps + 1
            if max(steps, others) > _LONGEST_PLAN:
                what = "steps" if steps > others else "notes"
                raise ConfigurationError(f"protocol {definition.name} does not end within {_LONGEST_PLAN} {what}")
    except BenchError:
        raise
    except ValueError as error:
        raise ConfigurationError(f"protocol {definition.name}: {error}") from error
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        raise ConfigurationError(
            f"protocol {definition.name} failed in its dry run: {type(error).__name__}: {error} "
            f"({place.filename}, line {place.lineno})"
        ) from error


class _Echo(dict[str, float]):
    def __init__(self) -> None:
        super().__init__()
        self.setpoints: dict[str, float] = {}

    def __missing__(self, signal: str) -> float:
        # The longest name that fits: beside `plate` there may be `plate_two`.
        device = signal
        while device and device not in self.setpoints:
            device = device.rpartition("_")[0]
        return self.setpoints.get(device, 0.0)
