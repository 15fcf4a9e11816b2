"""The table of a text instrument in a rig file: what it is told, what it is asked, and how its answers read.

The driver `drivers.scpi` and its emulated twin are made from the same table, so that a new supply or meter needs no
Python. Messages are templates: a number stands as `{value}`, in a reply any text as `{any}`::

    [devices.supply]
    identity = "EXAMPLE,PS-3005,{any}"      # of *IDN?; text without placeholders has to be answered literally
    error_query = "SYST:ERR?"

    [devices.supply.setpoint]
    command = "VOLT {value:.3f}"            # the number with the digits that Python's format gives it
    query = "VOLT?"
    unit = "V"
    limits = [0.0, 30.0]
    resolution = 0.001

    [devices.supply.output]
    on = ["CURR 1.0", "OUTP ON"]
    off = ["OUTP OFF"]
    query = "OUTP?"

    [devices.supply.signals.voltage]
    query = "MEAS:VOLT?"
    unit = "V"

Upper and lower case are the same, and so are one space and several; `bench.devices.templates` says how answers are
read. Sources: IEEE 488.2-1992 (common commands), SCPI-99 volume 2, 21.8 (error queue).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Annotated, Self

from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from bench.base import CheckedTable, check_unit, closest
from bench.devices.templates import ANY, ANY_TEXT, UNIT, VALUE, Decimal, Template, template

Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
"""Name of a signal, without that of its device."""


def _message(text: str) -> str:
    Template(text).check(())
    if not text.isprintable():
        raise ValueError("has a character that cannot be printed; terminators are keys of their own")
    return text


def _optional_message(text: str) -> str:
    return _message(text) if text else text


def _expected(text: str) -> str:
    Template(text).check({ANY})
    return text


def _optional_expected(text: str) -> str:
    return _expected(text) if text else text


def _with_number(text: str) -> str:
    Template(text).check({VALUE}, {VALUE})
    return text


def _scale(value: float) -> float:
    if value == 0.0:
        raise ValueError("must be a number other than 0")
    return value


def _range(value: tuple[float, float]) -> tuple[float, float]:
    low, high = value
    if not low < high:
        raise ValueError("expected the lower limit first, and a higher one")
    return value


def not_empty(messages: tuple[str, ...]) -> tuple[str, ...]:
    """Return the messages that reach the safe state; raise `ValueError` if there is none."""
    if not messages:
        raise ValueError("is empty; what reaches the safe state has to be said")
    return messages


def _terminator(text: str) -> str:
    if not text or text.strip(" \t") != text:
        raise ValueError('expected characters at the end of a message, such as "\\n" or "\\r\\n"')
    return text


def _encoding(name: str) -> str:
    try:
        known = "A?\n".encode(name) == b"A?\n"
    except (LookupError, ValueError):
        known = False
    if not known:
        raise ValueError("is no encoding that extends ASCII; expected one such as ascii, latin-1 or utf-8")
    return name


Message = Annotated[str, AfterValidator(_message)]
"""A message without placeholders."""

OptionalMessage = Annotated[str, AfterValidator(_optional_message)]
"""A message without placeholders, or nothing."""

Expected = Annotated[str, AfterValidator(_expected)]
"""A reply that is expected; `{any}` stands for text that does not matter."""

Unit = Annotated[str, AfterValidator(check_unit)]
"""A unit that is known."""

LimitPair = Annotated[tuple[float, float], AfterValidator(_range)]
"""A lower and a higher limit."""


def _with_unit_or_scale(text: str, info: ValidationInfo) -> Template:
    form = Template(text)
    if form.has_units and info.data.get("scale", 1.0) != 1.0:
        raise ValueError("the instrument sends the unit, so that scale is not needed; leave one of them out")
    return form


class QuantityTable(CheckedTable):
    """A quantity that an instrument of the rig file measures: its unit, and which readings of it are good."""

    unit: Unit = Field(description="unit of the signal, such as V, °C, or 1")
    scale: Annotated[float, AfterValidator(_scale)] = Field(
        default=1.0, description="by which the number is multiplied, not 0, such as 1e-3 for an answer in mA"
    )
    limits: LimitPair | None = Field(
        default=None, description="range of good readings, in the unit of the signal; one beyond is an error"
    )
    description: str = Field(default="", description="a few words for axes and column headers")
    precision: int = Field(default=3, ge=0, le=12, description="digits after the point that are worth showing")


class SignalTable(QuantityTable):
    """A quantity that a text instrument measures: `[devices.NAME.signals.QUANTITY]`."""

    query: Message = Field(description="question for the value, such as MEAS:VOLT?")
    reply: str = Field(
        default="{value}",
        description="form of the answer: {value} is the number, {unit} its unit, {any} is any text; signals with the "
        "same query have the same reply, in which each number stands by the name of its signal",
    )

    @field_validator("reply")
    @classmethod
    def _is_template(cls, text: str, info: ValidationInfo) -> str:
        form = _with_unit_or_scale(text, info)
        if not form.names:
            raise ValueError("has no placeholder for the number; expected {value}, or the name of the signal")
        return text


class ArrivalTable(CheckedTable):
    """When a set-point has been reached: `[devices.NAME.setpoint.arrival]`."""

    signal: str = Field(description="signal of this device that follows the set-point")
    tolerance: float = Field(gt=0, description="distance at which it has arrived, in its unit")
    timeout: float = Field(default=60.0, gt=0, le=86400, description="time after which it has failed to arrive, s")


class TargetTable(CheckedTable):
    """A set-point of an instrument of the rig file: its unit, its limits, and when it has been reached."""

    unit: Unit = Field(description="unit of the set-point, such as V")
    scale: Annotated[float, AfterValidator(_scale)] = Field(
        default=1.0, description="by which a number of the instrument is multiplied, not 0, such as 1e-3 for mA"
    )
    limits: LimitPair = Field(description="lowest and highest set-point, in its unit")
    resolution: float | None = Field(
        default=None,
        gt=0,
        description="difference between set-point and what is read back that is allowed, in its unit; a thousandth "
        "of the limits' distance if not given",
    )
    description: str = Field(default="set-point", min_length=1, description="a few words for axes and headers")
    precision: int = Field(default=3, ge=0, le=12, description="digits after the point that are worth showing")
    arrival: ArrivalTable | None = Field(default=None, description="when it has been reached; at once if not given")

    @property
    def tolerance(self) -> float:
        """Difference between what was set and what is read back that is allowed, in the unit of the set-point."""
        return self.resolution or 1e-3 * (self.limits[1] - self.limits[0])


class SetpointTable(TargetTable):
    """What a text instrument is set to: `[devices.NAME.setpoint]`."""

    command: Annotated[str, AfterValidator(_with_number)] = Field(
        description="message that sets it, with {value} and its format, such as VOLT {value:.3f}"
    )
    query: OptionalMessage = Field(default="", description="question that reads it back, such as VOLT?")
    reply: str = Field(
        default="{value}", description="form of the answer, with {value}; {unit} is its unit, {any} is any text"
    )
    range_queries: tuple[Message, Message] | None = Field(
        default=None,
        description="questions for the lowest and the highest set-point that the instrument takes, such as "
        '["VOLT? MIN", "VOLT? MAX"]; limits beyond are an error',
    )

    @field_validator("reply")
    @classmethod
    def _is_template(cls, text: str, info: ValidationInfo) -> str:
        _with_unit_or_scale(text, info).check({VALUE, UNIT, ANY}, {VALUE})
        return text

    @field_validator("command")
    @classmethod
    def _writes_the_limits(cls, text: str, info: ValidationInfo) -> str:
        if "limits" in info.data and "scale" in info.data:
            template, scale = Template(text), info.data["scale"]
            for limit in info.data["limits"]:
                written = written_number(template, limit / scale) * scale
                if not math.isclose(written, limit, rel_tol=1e-9, abs_tol=1e-12):
                    raise ValueError(
                        f"writes the limit {limit:.10g} as {written:.10g}; give it more digits, or round the limit"
                    )
        return text


def written_number(command: Template, number: float) -> float:
    """Return a number as a command writes it.

    Raises
    ------
    ValueError
        If the format of the command writes no decimal number.
    """
    (name,) = command.names
    read = command.match(command.fill({name: number}))
    if read is None:
        raise ValueError(
            f"the command {command.text!r} writes {number:g} as {command.fill({name: number})!r}, no number"
        )
    return read[name]


class OutputTable(CheckedTable):
    """How the output is switched: `[devices.NAME.output]`."""

    on: tuple[Message, ...] = Field(
        default=(),
        description='messages that switch it on, limits first, such as ["CURR 1.0", "OUTP ON"]; the last one counts',
    )
    off: Annotated[tuple[Message, ...], AfterValidator(not_empty)] = Field(
        description='messages that reach the safe state, such as ["OUTP OFF"]; the last one counts'
    )
    query: OptionalMessage = Field(default="", description="question for its state, such as OUTP?")
    is_on: Expected = Field(default="1", description="answer when it is on; {any} for any but `is_off`")
    is_off: Expected = Field(default="0", description="answer when it is off")


class CommandTable(CheckedTable):
    """What every text instrument has; a driver's settings extend it."""

    identity_query: OptionalMessage = Field(
        default="*IDN?", description="question for the identity; empty for an instrument that has none"
    )
    identity: Expected = Field(
        default=ANY_TEXT, description="form of its answer, such as EXAMPLE,PS-3005,{any}; another one is refused"
    )
    error_query: OptionalMessage = Field(
        default="", description="question for the oldest error of the queue, such as SYST:ERR?; none if empty"
    )
    no_error: Annotated[str, AfterValidator(_optional_expected)] = Field(
        default="", description="its answer when there is none, such as 0,{any}; if not given, any number 0 at first"
    )
    completion_query: OptionalMessage = Field(
        default="", description="question that is answered by 1 when a set-point was carried out, such as *OPC?"
    )
    setup: tuple[Message, ...] = Field(default=(), description="messages sent on connecting, in this order")
    write_terminator: Annotated[str, AfterValidator(_terminator)] = Field(
        default="\n", description="end of a message to the instrument"
    )
    read_terminator: Annotated[str, AfterValidator(_terminator)] = Field(default="\n", description="end of an answer")
    encoding: Annotated[str, AfterValidator(_encoding)] = Field(default="ascii", description="encoding of messages")
    delay: float = Field(default=0.0, ge=0, le=10, description="least time from one message to the next, s")
    decimal: Decimal | None = Field(
        default=None,
        description='decimal sign of its numbers, sent and received: "." or ","; if not given it is the point, and '
        "an answer in which a comma may be one is an error",
    )
    signals: dict[Name, SignalTable] = Field(min_length=1, description="what it measures, one table a signal")

    def form(self, text: str) -> Template:
        """Return a message as a template, with the decimal sign of the instrument."""
        return template(text, self.decimal)

    @model_validator(mode="after")
    def _reads_what_it_writes(self) -> Self:
        for key, text in self._forms():
            try:
                self.form(text)
            except ValueError as error:
                raise ValueError(f"{key} = {text!r}, decimal = {self.decimal!r}: {error}") from None
        return self

    def _forms(self) -> list[tuple[str, str]]:
        return [(f"signals.{name}.reply", signal.reply) for name, signal in self.signals.items()]

    @field_validator("signals")
    @classmethod
    def _share_their_queries(cls, signals: dict[str, SignalTable]) -> dict[str, SignalTable]:
        for text in signals_by_query(signals).values():
            first = signals[text[0]]
            for name in text[1:]:
                if signals[name].reply != first.reply:
                    raise ValueError(
                        f"{text[0]} and {name} have the same query {first.query!r}, so the same reply is expected, "
                        f"with {{{text[0]}}} and {{{name}}}"
                    )
            needed = {VALUE} if len(text) == 1 and VALUE in Template(first.reply).names else set(text)
            try:
                Template(first.reply).check({ANY, UNIT, *needed}, needed)
            except ValueError as error:
                raise ValueError(f"{text[0]}.reply = {first.reply!r}: {error}") from None
        return signals


def signals_by_query(signals: Mapping[str, SignalTable]) -> dict[str, list[str]]:
    """Return the names of the signals that each query answers."""
    grouped: dict[str, list[str]] = {}
    for name, signal in signals.items():
        grouped.setdefault(signal.query, []).append(name)
    return grouped


class ActuatorTable(CommandTable):
    """A text instrument that takes a set-point."""

    setpoint: SetpointTable = Field(description="what is set")
    output: OutputTable = Field(description="how the output is switched on and off")

    @field_validator("setpoint")
    @classmethod
    def _arrives_at_a_signal(cls, setpoint: SetpointTable, info: ValidationInfo) -> SetpointTable:
        check_arrival(setpoint, info.data.get("signals", {}))
        return setpoint

    def _forms(self) -> list[tuple[str, str]]:
        messages = [("setpoint.command", self.setpoint.command), ("setpoint.reply", self.setpoint.reply)]
        return [*super()._forms(), *messages]


def check_arrival(target: TargetTable, signals: Collection[str]) -> None:
    """Raise `ValueError` if a set-point arrives at a signal that is not among those of its device, unless empty."""
    if target.arrival is not None and signals and target.arrival.signal not in signals:
        raise ValueError(
            f"arrival.signal = {target.arrival.signal!r}: there is no such signal; "
            f"{closest(target.arrival.signal, signals)}"
        )
