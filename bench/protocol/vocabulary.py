"""The vocabulary of protocols: the messages that they yield, and the readings that they receive.

A protocol is a generator. It yields messages, and for each `Step` it is sent the `Reading` that was taken
once the step had settled::

    class Parameters(ProtocolParameters):
        target: float = parameter(60.0, unit="°C", low=-10, high=95, help="where to go")

    @protocol(needs=("plate",))
    def soak(parameters: Parameters) -> Messages:
        \"\"\"Hold one temperature and read it.\"\"\"
        reading = yield Step({"plate": parameters.target}, Dwell(30.0))
        yield Note(f"arrived at {reading['plate_temperature']:.2f} °C")

Messages name devices and signals of a rig. A protocol for any rig asks for slots instead, and takes the names from
their binding in the rig file; see `bench.rig.slots`.

A protocol touches no device and no clock, and is deterministic given its parameters and its readings. So
it can be planned and rehearsed, to learn what it does before anything moves.
"""

from __future__ import annotations

import math
import numbers
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from typing import Any

from bench.control import BlockController, ControlTask, DelayedController, SampledController
from bench.devices import (
    Arrived as Arrived,
    Dwell as Dwell,
    Settle as Settle,
    Settled as Settled,
    Signal,
    UntilSteady as UntilSteady,
    durations,
)
from bench.operator import Desk
from bench.rig import SETPOINT, Slot as Slot, Slots as Slots


class Message(ABC):
    """What a protocol yields."""

    @abstractmethod
    def plan(self) -> Planned:
        """Return what it will do, as far as that is known before it is carried out."""


@dataclass(frozen=True, kw_only=True)
class Planned:
    """What one message will do.

    Attributes
    ----------
    seconds, at_most : float
        Shortest and longest laboratory time, s.
    extremes : mapping of str to (float, float)
        Smallest and largest set-point by device.
    watched : frozenset of str
        Signals that it looks at.
    prompts : int
        How often the operator is asked to do something by hand.
    settled : Settled or None
        How the step settles if all goes well; None where no reading follows.
    """

    seconds: float = 0.0
    at_most: float = 0.0
    extremes: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    watched: frozenset[str] = frozenset()
    prompts: int = 0
    settled: Settled | None = Settled.CONTROLLED


_MET = {Dwell: Settled.DWELL, UntilSteady: Settled.STEADY, Arrived: Settled.ARRIVED}
"""What a rule records when it is met."""


def _is_number(value: object) -> bool:
    return isinstance(value, numbers.Real) and math.isfinite(value)


def _watched(settle: Settle) -> frozenset[str]:
    return frozenset({settle.signal} if isinstance(settle, UntilSteady) else ())


@dataclass(frozen=True)
class Step(Message):
    """Send set-points, let the rig settle, and take a reading.

    Attributes
    ----------
    setpoints : mapping of str to float
        Set-point by device name, in the device's unit; empty to read again where the rig stands.
    settle : Dwell or UntilSteady
        How to wait before the reading.
    label : str
        A few words for the record, such as `reversal`.
    """

    setpoints: Mapping[str, float]
    settle: Settle
    label: str = field(default="", kw_only=True)

    def plan(self) -> Planned:
        """Return its set-points and the time that its settling rule takes."""
        for device, value in self.setpoints.items():
            if not _is_number(value):
                raise ValueError(f"a step sets {device} to {value!r}; expected a finite number")
        shortest, longest = durations(self.settle)
        return Planned(
            seconds=shortest,
            at_most=longest,
            extremes={device: (value, value) for device, value in self.setpoints.items()},
            watched=_watched(self.settle),
            settled=_MET[type(self.settle)],
        )


@dataclass(frozen=True, kw_only=True)
class Control(Message):
    """Let a controller move one actuator, reading by reading, until it is done; then take a reading.

    Attributes
    ----------
    task : ControlTask
        The controller at work; it sees numbers only.
    actuator : str
        Device that takes the set-points.
    drive : str
        Signal that says what the actuator did.
    response : str
        Signal that is controlled.
    limits : (float, float) or None
        Set-points that the controller may ask for, in the actuator's unit; None for all that the actuator takes.
    timeout : float
        Seconds after which the step has failed and the run ends in the safe state.
    label : str
        A few words for the record.
    others : tuple of str
        Further signals that the controller wants to see.
    """

    task: ControlTask
    actuator: str
    drive: str
    response: str
    limits: tuple[float, float] | None = None
    timeout: float
    label: str = ""
    others: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        low, high = self.limits or (0.0, 0.0)
        if not (-math.inf < low <= high < math.inf and 0 < self.timeout < math.inf):
            raise ValueError(
                "Control: expected finite limits, the lower one first, and a finite timeout > 0, got "
                f"limits={self.limits}, timeout={self.timeout}"
            )

    def plan(self) -> Planned:
        """Return the limits of its set-points and its time-out."""
        extremes = {} if self.limits is None else {self.actuator: self.limits}
        return Planned(
            at_most=self.timeout, extremes=extremes, watched=frozenset({self.drive, self.response, *self.others})
        )


@dataclass(frozen=True, kw_only=True)
class FixedRate(Message):
    """Let a controller move one or several actuators at a fixed rate, from quick readings; then take a reading.

    Sample k is due k periods after the beginning. One that is more than a period late is left out, and how late the
    others were is in the record, as the signal `lateness`.

    Attributes
    ----------
    controller : SampledController or BlockController
        The controller at work; it sees numbers only.
    rate : float
        Samples in a second, Hz.
    duration : float
        How long it goes on, s.
    put_off : float
        Longest time by which the controller may put the end off, s: it does so by its `delay`, if it is a
        `DelayedController`; 0 for not at all.
    inputs : tuple of str
        Signals that the controller sees, in its order.
    actuators : tuple of str
        Devices that take its set-points, in its order.
    limits : tuple of (float, float)
        Set-points that the controller may ask for, for each actuator, in its unit; empty for all that they take.
    watched : tuple of str
        Further signals that are read with each recorded sample, for the record alone; in blocks with each sample.
    record_every : int
        Of so many samples one is recorded.
    label : str
        A few words for the record.
    block : int
        Samples for which the controller is asked at once, by `step_block`; 0 for a `SampledController`. Where an
        instrument can, it carries them out by itself; otherwise they are taken one by one, with the same result.
        Interlocks, watchdogs and the telemetry of other devices wait for the end of a block, which therefore may not
        be longer than the telemetry period of the rig.
    """

    controller: SampledController | BlockController
    rate: float
    duration: float
    inputs: tuple[str, ...]
    actuators: tuple[str, ...]
    limits: tuple[tuple[float, float], ...] = ()
    watched: tuple[str, ...] = ()
    record_every: int = 1
    label: str = ""
    block: int = 0
    put_off: float = 0.0

    def __post_init__(self) -> None:
        if not (0 <= self.put_off < math.inf) or (
            self.put_off and (self.block or not isinstance(self.controller, DelayedController))
        ):
            raise ValueError(
                "FixedRate: expected put_off ≥ 0, and without blocks a controller with a delay where it is not 0, "
                f"got {self.put_off}"
            )
        if self.block < 0 or (self.block and not isinstance(self.controller, BlockController)):
            raise ValueError(
                f"FixedRate: expected block ≥ 0, and a controller with step_block where it is not 0, got {self.block}"
            )
        if not (0 < self.rate < math.inf and 0 < self.duration < math.inf and self.record_every >= 1):
            raise ValueError(
                "FixedRate: expected rate, duration > 0 and record_every ≥ 1, got "
                f"rate={self.rate}, duration={self.duration}, record_every={self.record_every}"
            )
        if self.limits and len(self.limits) != len(self.actuators):
            raise ValueError(
                f"FixedRate: expected limits for each of {len(self.actuators)} actuators, got {len(self.limits)}"
            )

    @property
    def samples(self) -> int:
        """Number of samples as far as is known: more once the controller has put the end off."""
        delay = self.controller.delay if isinstance(self.controller, DelayedController) and self.put_off else 0.0
        return max(1, round((self.duration + min(delay, self.put_off)) * self.rate))

    def plan(self) -> Planned:
        """Return the limits of its set-points and its duration."""
        setpoints = (f"{name}{SETPOINT}" for name in self.actuators)
        return Planned(
            seconds=self.duration,
            at_most=self.duration + self.put_off,
            extremes=dict(zip(self.actuators, self.limits, strict=False)),
            watched=frozenset({*self.inputs, *self.watched, *setpoints}),
        )


@dataclass(frozen=True, kw_only=True)
class Prompt(Message):
    """Prompt for a manual action, wait until the rig has settled, and verify the action with a reading.

    An emulated laboratory does it by itself, from `task` and `value`.

    Attributes
    ----------
    text : str
        What to do, as an imperative sentence without a full stop.
    task : str
        The same for an emulated laboratory, such as `load`.
    value : float
        What the task is about, such as the load in N.
    settle : Dwell or UntilSteady
        How to wait between the operator's answer and the reading.
    signal : str
        Signal that tells whether it was done.
    low, high : float
        Where the signal then has to be, in its unit; if it is not, the run ends in the safe state.
    """

    text: str
    task: str
    value: float
    settle: Settle
    signal: str
    low: float
    high: float

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ValueError(f"Prompt: expected low < high, got low={self.low}, high={self.high}")

    def plan(self) -> Planned:
        """Return the time that it settles, without the operator's."""
        shortest, longest = durations(self.settle)
        watched = _watched(self.settle) | {self.signal}
        return Planned(seconds=shortest, at_most=longest, watched=watched, prompts=1, settled=_MET[type(self.settle)])


@dataclass(frozen=True, kw_only=True)
class ByHand(Message):
    """Let an operator move the rig, command by command, until there are no more; then take a reading.

    Attributes
    ----------
    desk : Desk
        Where the commands come from.
    """

    desk: Desk

    def plan(self) -> Planned:
        """Return that nothing is known."""
        return Planned(at_most=math.inf, settled=Settled.UNRECORDED)


@dataclass(frozen=True)
class Phase(Message):
    """A part of the protocol begins; shown live and kept in the record."""

    name: str

    def plan(self) -> Planned:
        """Return that nothing moves."""
        return Planned(settled=None)


@dataclass(frozen=True)
class Note(Message):
    """A sentence for the log."""

    text: str

    def plan(self) -> Planned:
        """Return that nothing moves."""
        return Planned(settled=None)


@dataclass(frozen=True)
class Caution(Note):
    """A warning for the log."""


class Summary(Note):
    """A sentence for the log about readings, such as the greatest of them.

    A plan has no readings, and does not ask for the sentence. So it goes on where a note that compares them would end
    it.

    Parameters
    ----------
    tell : callable
        Returns the sentence.
    """

    def __init__(self, tell: Callable[[], str]) -> None:
        object.__setattr__(self, "_tell", tell)

    @property
    def text(self) -> str:
        """The sentence."""
        told: str = vars(self)["_tell"]()
        return told


@dataclass(frozen=True)
class KeptModel(Note):
    """A model that is kept with the run, in place of an earlier one of this name; the text goes to the log.

    Parameters
    ----------
    text : str
        A sentence for the log.
    name : str
        Name of the model among those of the run.
    content : mapping
        The model file's content.
    """

    name: str
    content: Mapping[str, Any]


@dataclass(frozen=True)
class Reading:
    """What was measured at the end of a step.

    Attributes
    ----------
    step : int
        Number of the step within the run, from 0.
    time : float
        Laboratory time of the reading, s.
    settled : Settled
        How the step settled.
    values : mapping of str to float
        Value by signal name, derived signals and set-points included.
    """

    step: int
    time: float
    settled: Settled
    values: Mapping[str, float]

    def __getitem__(self, signal: str) -> float:
        return self.values[signal]


PROMPT = "prompt"
"""Label of the reading that follows a prompt."""

Messages = Generator[Message, Reading, None]

TRACES = (
    Signal("reference", "", "reference", 2),
    Signal("predicted", "", "output that the model predicts", 2),
    Signal("disturbance", "", "estimated disturbance of the output", 2),
    Signal("disturbance_uncertainty", "", "standard deviation of the estimated disturbance", 2),
)
"""What is recorded of a controller, in the unit of the signal that it controls; nan while none is at work."""

LATENESS = Signal("lateness", "s", "time by which a sample of a fast loop came too late", 6)
"""Recorded beside them; nan where no fast loop is at work."""
