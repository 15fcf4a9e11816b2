"""The vocabulary of protocols: what an operator's script says, and what it gets back.

A protocol is a generator. It yields messages, and for each `Step` it is sent the `Reading` that was taken
once the step had settled::

    class Parameters(ProtocolParameters):
        target: float = parameter(60.0, unit="°C", low=-10, high=95, help="where to go")

    @protocol(needs=("tec",))
    def soak(parameters: Parameters) -> Messages:
        \"\"\"Hold one temperature and read it.\"\"\"
        reading = yield Step({"tec": parameters.target}, Dwell(30.0))
        yield Note(f"arrived at {reading['tec_temperature']:.2f} °C")

A protocol touches no device and no clock, and is deterministic given its parameters and its readings. So
it can be run dry to learn its length and the extremes of its set-points before anything moves.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import math
import numbers
import pkgutil
import sys
import traceback
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import PydanticUndefined

from bench.control.loops import ControlTask, SampledController
from bench.devices import Signal
from bench.errors import BenchError, ConfigurationError

PROTOCOL_PACKAGE = "protocols"
_LONGEST_PLAN = 1_000_000


@dataclass(frozen=True)
class Dwell:
    """Settle by waiting a fixed time.

    Raises
    ------
    ValueError
        If `seconds` is negative or not finite.
    """

    seconds: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.seconds) and self.seconds >= 0):
            raise ValueError(f"seconds: expected a finite number ≥ 0, got {self.seconds}")


@dataclass(frozen=True)
class UntilSteady:
    """Settle until a signal's remaining drift, as a Kalman filter estimates it, is below a limit.

    Attributes
    ----------
    signal : str
        Which signal has to come to rest.
    drift : float
        Largest drift allowed, in units of the signal per second. The estimate's magnitude and one
        standard deviation of its uncertainty must both fit within.
    noise : float
        Standard deviation of one quick reading of the signal, in units of the signal.
    timeout : float
        Seconds after which the step has failed and the run ends in the safe state.
    minimum : float
        Seconds to wait in any case.
    """

    signal: str
    drift: float
    noise: float
    timeout: float
    minimum: float = 0.0

    def __post_init__(self) -> None:
        if not (self.drift > 0 and self.noise > 0 and self.timeout > self.minimum >= 0):
            raise ValueError(
                "UntilSteady: expected drift > 0, noise > 0 and timeout > minimum ≥ 0, got "
                f"drift={self.drift}, noise={self.noise}, timeout={self.timeout}, minimum={self.minimum}"
            )


Settle = Dwell | UntilSteady


@dataclass(frozen=True)
class Step:
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
    label: str = ""


@dataclass(frozen=True)
class Control:
    """Let a controller move one actuator, reading by reading, until it is done; then take a reading.

    Attributes
    ----------
    loop : ControlTask
        The controller at work; it sees numbers only.
    actuator : str
        Device that takes the set-points.
    input : str
        Signal that says what the actuator did.
    output : str
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

    loop: ControlTask
    actuator: str
    input: str
    output: str
    limits: tuple[float, float] | None
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


@dataclass(frozen=True)
class FastLoop:
    """Let a controller move one or several actuators at a fixed rate, from quick readings; then take a reading.

    Sample k is due k periods after the beginning. One that is more than a period late is left out, and how late the
    others were is in the record, as the signal `lateness`.

    Attributes
    ----------
    controller : SampledController
        The controller at work; it sees numbers only.
    rate : float
        Samples in a second, Hz.
    duration : float
        How long it goes on, s.
    inputs : tuple of str
        Signals that the controller sees, in its order.
    actuators : tuple of str
        Devices that take its set-points, in its order.
    limits : tuple of (float, float)
        Set-points that the controller may ask for, for each actuator, in its unit; empty for all that they take.
    watched : tuple of str
        Further signals that are read with each sample, for the record alone.
    record_every : int
        Of so many samples one is recorded.
    label : str
        A few words for the record.
    """

    controller: SampledController
    rate: float
    duration: float
    inputs: tuple[str, ...]
    actuators: tuple[str, ...]
    limits: tuple[tuple[float, float], ...] = ()
    watched: tuple[str, ...] = ()
    record_every: int = 1
    label: str = ""

    def __post_init__(self) -> None:
        if not (0 < self.rate < math.inf and 0 < self.duration < math.inf and self.record_every >= 1):
            raise ValueError(
                "FastLoop: expected rate, duration > 0 and record_every ≥ 1, got "
                f"rate={self.rate}, duration={self.duration}, record_every={self.record_every}"
            )
        if self.limits and len(self.limits) != len(self.actuators):
            raise ValueError(
                f"FastLoop: expected limits for each of {len(self.actuators)} actuators, got {len(self.limits)}"
            )


@dataclass(frozen=True)
class Prompt:
    """Ask the operator to do something by hand, let the rig settle, and see by a reading that it was done.

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


@dataclass(frozen=True)
class Phase:
    """A part of the protocol begins; shown live and kept in the record."""

    name: str


@dataclass(frozen=True)
class Note:
    """A sentence for the log."""

    text: str


Message = Step | Control | FastLoop | Prompt | Phase | Note


@dataclass(frozen=True)
class Reading:
    """What was measured at the end of a step.

    Attributes
    ----------
    step : int
        Number of the step within the run, from 0.
    time : float
        Laboratory time of the reading, s.
    settled : bool
        Whether the settling rule was met; always true for a dwell.
    values : mapping of str to float
        Value by signal name, derived signals and set-points included.
    """

    step: int
    time: float
    settled: bool
    values: Mapping[str, float]

    def __getitem__(self, signal: str) -> float:
        return self.values[signal]


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


class ProtocolParameters(BaseModel):
    """Base of a protocol's parameters; declare each with `parameter`."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def parameter(
    default: Any,  # noqa: ANN401 - whatever type the field has
    *,
    unit: str,
    help: str,  # noqa: A002 - the word that the user sees
    low: float | None = None,
    high: float | None = None,
) -> Any:  # noqa: ANN401 - stands for a field's default
    """Declare a parameter of a protocol.

    Parameters
    ----------
    default
        Value when nothing is said; `...` if it must be given.
    unit : str
        Its unit; `1` for a count or a plain number, empty for a text.
    help : str
        What it does, in one sentence without a full stop.
    low, high : float, optional
        The allowed range, both ends included.
    """
    # A default that is a text may stand for another type, such as a list of numbers.
    return Field(
        default,
        description=help,
        ge=low,
        le=high,
        json_schema_extra={"unit": unit},
        validate_default=isinstance(default, str),
    )


@dataclass(frozen=True)
class ParameterHelp:
    """One parameter as help texts show it."""

    name: str
    default: str
    unit: str
    allowed: str
    text: str


@dataclass(frozen=True)
class ProtocolDefinition:
    """A protocol that can be run: its name, its parameters, and its generator function."""

    name: str
    summary: str
    description: str
    needs: tuple[str, ...]
    controls: str
    parameters: type[ProtocolParameters]
    generator: Callable[[Any], Messages]

    def parse(self, settings: Mapping[str, str]) -> ProtocolParameters:
        """Make parameters from texts such as those of `--set`.

        Raises
        ------
        ConfigurationError
            If a name is unknown or a value is not allowed; it names all that is wrong.
        """
        try:
            return self.parameters.model_validate(dict(settings))
        except ValidationError as error:
            raise ConfigurationError("\n".join(self._explain(error))) from None

    def help(self) -> tuple[ParameterHelp, ...]:
        """Return what there is to set."""
        return tuple(self._parameter_help(name) for name in self.parameters.model_fields)

    def _parameter_help(self, name: str) -> ParameterHelp:
        info = self.parameters.model_fields[name]
        extra = info.json_schema_extra
        unit = str(extra.get("unit", "")) if isinstance(extra, dict) else ""
        low = next((m.ge for m in info.metadata if getattr(m, "ge", None) is not None), None)
        high = next((m.le for m in info.metadata if getattr(m, "le", None) is not None), None)
        if low is not None and high is not None:
            allowed = f"{low:g} to {high:g}"
        elif low is not None:
            allowed = f"≥ {low:g}"
        elif high is not None:
            allowed = f"≤ {high:g}"
        elif get_origin(info.annotation) is Literal:
            allowed = ", ".join(map(str, get_args(info.annotation)))
        elif info.annotation is bool:
            allowed = "true, false"
        elif get_origin(info.annotation) is tuple:
            allowed = "numbers with commas between them"
        else:
            allowed = "any text" if info.annotation is str else "any number"
        default = "must be given" if info.default is PydanticUndefined else str(info.default)
        return ParameterHelp(name, default, unit, allowed, info.description or "")

    def _explain(self, error: ValidationError) -> Iterator[str]:
        for problem in error.errors():
            name = ".".join(str(part) for part in problem["loc"]) or "parameters"
            if problem["type"] == "extra_forbidden":
                known = ", ".join(self.parameters.model_fields) or "none"
                yield f"protocol {self.name}: there is no parameter {name!r}; there are: {known}"
            elif name in self.parameters.model_fields:
                entry = self._parameter_help(name)
                unit = f" {entry.unit}" if entry.unit not in ("", "1") else ""
                given = "is missing" if problem["type"] == "missing" else f"= {problem['input']!r} is not allowed"
                yield (
                    f"protocol {self.name}: parameter {name} {given}; "
                    f"allowed: {entry.allowed}{unit} ({problem['msg']})"
                )
            else:
                yield f"protocol {self.name}: {problem['msg'].removeprefix('Value error, ')}"


def protocol(
    *, needs: Sequence[str], controls: str = ""
) -> Callable[[Callable[[Any], Messages]], ProtocolDefinition]:
    """Make a generator function a protocol.

    Its name is the function's, with dashes; its one argument is annotated with its parameters' class; its
    docstring is its help.

    Parameters
    ----------
    needs : sequence of str
        Devices and signals that the rig must have, by name.
    controls : str
        Signal that the protocol's controllers control, if it has any: what they think of it (`TRACES`) is then
        recorded beside the rig's signals.

    Raises
    ------
    TypeError
        If the function is not of this form.
    """
    if isinstance(needs, str):
        raise TypeError(f"needs: expected a sequence of names, such as ({needs!r},), got the text {needs!r}")

    def define(function: Callable[[Any], Messages]) -> ProtocolDefinition:
        if not inspect.isgeneratorfunction(function):
            raise TypeError(f"{function.__qualname__}: a protocol is a generator, and this function yields nothing")
        hints = [hint for name, hint in get_type_hints(function).items() if name != "return"]
        if (
            len(inspect.signature(function).parameters) != 1
            or len(hints) != 1
            or not (isinstance(hints[0], type) and issubclass(hints[0], ProtocolParameters))
        ):
            raise TypeError(
                f"{function.__qualname__}: a protocol takes one argument, annotated with a ProtocolParameters"
            )
        description = inspect.getdoc(function)
        if not description:
            raise TypeError(f"{function.__qualname__}: a protocol has a docstring, which is its help")
        return ProtocolDefinition(
            name=function.__name__.replace("_", "-"),
            summary=description.splitlines()[0].rstrip("."),
            description=description,
            needs=tuple(needs),
            controls=controls,
            parameters=hints[0],
            generator=function,
        )

    return define


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


def plan(definition: ProtocolDefinition, parameters: ProtocolParameters) -> Plan:
    """Run a protocol dry, echoing each set-point as `NAME_setpoint` and `NAME_temperature` and the like.

    Any other signal reads as 0.

    Raises
    ------
    ConfigurationError
        If the protocol does not end within a million steps, its parameters do not fit together, or it fails.
    """
    steps, prompts, others, seconds, at_most = 0, 0, 0, 0.0, 0.0
    watched: set[str] = set()
    extremes: dict[str, tuple[float, float]] = {}
    echo = _Echo()
    try:
        messages = definition.generator(parameters)
        message = next(messages)
        while True:
            if isinstance(message, Step):
                for device, value in message.setpoints.items():
                    if not _is_number(value):
                        raise ConfigurationError(
                            f"protocol {definition.name} sets {device} to {value!r}; expected a finite number"
                        )
                    low, high = extremes.get(device, (value, value))
                    extremes[device] = (min(low, value), max(high, value))
                    echo.setpoints[device] = value
                if isinstance(message.settle, UntilSteady):
                    watched.add(message.settle.signal)
                shortest, longest = _durations(message.settle)
                seconds, at_most = seconds + shortest, at_most + longest
                reading = Reading(steps, seconds, True, echo)
                steps += 1
                if steps > _LONGEST_PLAN:
                    raise ConfigurationError(f"protocol {definition.name} does not end within {_LONGEST_PLAN} steps")
                message = messages.send(reading)
            elif isinstance(message, Control):
                if message.limits is not None:
                    low, high = extremes.get(message.actuator, message.limits)
                    extremes[message.actuator] = (min(low, message.limits[0]), max(high, message.limits[1]))
                watched |= {message.input, message.output, *message.others}
                at_most += message.timeout
                reading = Reading(steps, seconds, True, echo)
                steps += 1
                if steps > _LONGEST_PLAN:
                    raise ConfigurationError(f"protocol {definition.name} does not end within {_LONGEST_PLAN} steps")
                message = messages.send(reading)
            elif isinstance(message, FastLoop):
                for name, (least, most) in zip(message.actuators, message.limits, strict=False):
                    low, high = extremes.get(name, (least, most))
                    extremes[name] = (min(low, least), max(high, most))
                setpoints = (f"{name}_setpoint" for name in message.actuators)
                watched |= {*message.inputs, *message.watched, *setpoints}
                seconds, at_most = seconds + message.duration, at_most + message.duration
                reading = Reading(steps, seconds, True, echo)
                steps += 1
                if steps > _LONGEST_PLAN:
                    raise ConfigurationError(f"protocol {definition.name} does not end within {_LONGEST_PLAN} steps")
                message = messages.send(reading)
            elif isinstance(message, Prompt):
                watched.add(message.signal)
                if isinstance(message.settle, UntilSteady):
                    watched.add(message.settle.signal)
                shortest, longest = _durations(message.settle)
                seconds, at_most = seconds + shortest, at_most + longest
                reading = Reading(steps, seconds, True, echo)
                steps, prompts = steps + 1, prompts + 1
                if steps > _LONGEST_PLAN:
                    raise ConfigurationError(f"protocol {definition.name} does not end within {_LONGEST_PLAN} steps")
                message = messages.send(reading)
            elif isinstance(message, Phase | Note):
                others += 1
                if others > _LONGEST_PLAN:
                    raise ConfigurationError(f"protocol {definition.name} does not end within {_LONGEST_PLAN} notes")
                message = next(messages)
            else:
                raise ConfigurationError(
                    f"protocol {definition.name} yielded {message!r}; "
                    "expected a Step, a Control, a FastLoop, a Prompt, a Phase or a Note"
                )
    except StopIteration:
        return Plan(steps, seconds, at_most, extremes, frozenset(watched), prompts)
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
        # The longest name that fits: beside `tec` there may be `tec_two`.
        device = signal
        while device and device not in self.setpoints:
            device = device.rpartition("_")[0]
        return self.setpoints.get(device, 0.0)


def _is_number(value: object) -> bool:
    return isinstance(value, numbers.Real) and math.isfinite(value)


def _durations(settle: Settle) -> tuple[float, float]:
    if isinstance(settle, Dwell):
        return settle.seconds, settle.seconds
    return settle.minimum, settle.timeout


def packaged_protocols() -> dict[str, ProtocolDefinition]:
    """Return the protocols of the `protocols` package by name.

    Raises
    ------
    ConfigurationError
        If two protocols share a name.
    """
    found: dict[str, ProtocolDefinition] = {}
    package = importlib.import_module(PROTOCOL_PACKAGE)
    for module in pkgutil.walk_packages(package.__path__, f"{PROTOCOL_PACKAGE}."):
        try:
            imported = importlib.import_module(module.name)
        except Exception as error:
            raise ConfigurationError(
                f"protocol module {module.name} cannot be loaded: {type(error).__name__}: {error}"
            ) from error
        for definition in _definitions(imported):
            if definition.name in found:
                raise ConfigurationError(f"two protocols of the package are named {definition.name}")
            found[definition.name] = definition
    return dict(sorted(found.items()))


def find_protocol(name: str) -> ProtocolDefinition:
    """Return a protocol by its name, or from a file as `path/to/file.py` or `path/to/file.py:NAME`.

    Raises
    ------
    ConfigurationError
        If there is none, or the file cannot be loaded or holds several.
    """
    path, _, wanted = (name, "", "") if name.endswith(".py") else name.rpartition(":")
    if path.endswith(".py"):
        return _protocol_from_file(Path(path), wanted)
    protocols = packaged_protocols()
    if name not in protocols:
        raise ConfigurationError(
            f"there is no protocol {name!r}; there are: {', '.join(protocols)} "
            "(or a file of your own, path/to/file.py)"
        )
    return protocols[name]


def _protocol_from_file(path: Path, wanted: str) -> ProtocolDefinition:
    if not path.is_file():
        raise ConfigurationError(f"protocol file {path} does not exist")
    spec = importlib.util.spec_from_file_location(f"protocol_file_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ConfigurationError(f"protocol file {path} cannot be loaded as Python")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    # A file of the operator's may fail in any way, and may even leave by sys.exit.
    except (Exception, SystemExit) as error:
        del sys.modules[spec.name]
        raise ConfigurationError(f"protocol file {path}: {type(error).__name__}: {error}") from error
    found = {definition.name: definition for definition in _definitions(module)}
    names = ", ".join(found) or "none"
    if wanted:
        if wanted not in found:
            raise ConfigurationError(f"protocol file {path} has no protocol {wanted!r}; it has: {names}")
        return found[wanted]
    if len(found) != 1:
        raise ConfigurationError(f"protocol file {path}: choose one by {path}:NAME; it has: {names}")
    return next(iter(found.values()))


def _definitions(module: ModuleType) -> list[ProtocolDefinition]:
    return [
        value
        for value in vars(module).values()
        if isinstance(value, ProtocolDefinition) and value.generator.__module__ == module.__name__
    ]
