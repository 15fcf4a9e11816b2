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

Upper and lower case are the same, and so are one space and several. Sources: IEEE 488.2-1992 (common commands,
numeric formats), SCPI-99 volume 1, 7.2.1 (9.9E37 is infinity, 9.91E37 not a number) and volume 2, 21.8 (error queue).
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from string import Formatter
from typing import Annotated

from pydantic import AfterValidator, Field, ValidationInfo, field_validator

from bench.base import CheckedTable, check_unit

NUMBER = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
"""A decimal number as IEEE 488.2 writes it (NR1, NR2, NR3), as a regular expression."""

VALUE = "value"
"""The placeholder of a number where there is only one."""

ANY = "any"
"""The placeholder of any text."""

ANY_TEXT = f"{{{ANY}}}"
"""The form of a message that may be anything."""

_NOT_A_NUMBER = 9.9e37
"""From here on a number of SCPI stands for infinity or for no number."""


Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
"""Name of a signal, without that of its device."""


@dataclass(frozen=True)
class Template:
    """A message with placeholders for numbers, and for text that does not matter.

    Parameters
    ----------
    text : str
        The message; a placeholder may carry a format of Python's, as in `VOLT {value:.3f}`.

    Raises
    ------
    ValueError
        If the text is empty, has a placeholder without a name or with a format that is none, or one stands twice.
    """

    text: str

    def __post_init__(self) -> None:
        if not self.text.strip():
            raise ValueError("is empty; expected a message to or from the instrument")
        if len(set(self.names)) < len(self.names):
            raise ValueError("each number may stand once only")
        names = [name for _, name, _ in self._parts]
        for i, (text, name, _) in enumerate(self._parts):
            if i > 0 and name not in (None, ANY) and names[i - 1] not in (None, ANY) and not text:
                raise ValueError("text or a space is expected between two numbers")
        try:
            self.fill(dict.fromkeys(self.names, 0.5))
        except (ValueError, IndexError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"a number cannot be written so: {error}; expected a format such as {{value:.3f}}"
            ) from None

    @cached_property
    def _parts(self) -> tuple[tuple[str, str | None, str], ...]:
        """Literal text, the name of the placeholder after it, and its format."""
        try:
            parts = [(text, name, spec or "") for text, name, spec, _ in Formatter().parse(self.text.strip())]
        except ValueError as error:
            raise ValueError(f"{error}; a brace of the message itself is doubled: {{{{ or }}}}") from None
        for _, name, _ in parts:
            if name is not None and not name.isidentifier():
                raise ValueError(f"{{{name}}} is no placeholder; expected a name such as {{value}}")
        return tuple(parts)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers, in their order."""
        return tuple(name for _, name, _ in self._parts if name is not None and name != ANY)

    def check(self, allowed: Iterable[str], needed: Iterable[str] = ()) -> None:
        """Raise `ValueError` for a placeholder that is not allowed, or one that is missing."""
        known = set(allowed)
        found = [name for _, name, _ in self._parts if name is not None]
        shown = ", ".join(f"{{{name}}}" for name in sorted(known)) or "none"
        for name in found:
            if name not in known:
                raise ValueError(f"{{{name}}} is no placeholder here; allowed: {shown}")
        for name in needed:
            if name not in found:
                raise ValueError(f"the placeholder {{{name}}} is missing, which stands for the number")

    def fill(self, values: Mapping[str, float], any_text: str = "") -> str:
        """Return the message with these numbers; numbers without a format are written as `+1.23456789E+00`."""
        written = []
        for text, name, spec in self._parts:
            written.append(text)
            if name is not None:
                written.append(any_text if name == ANY else format(values[name], spec or "+.8E"))
        return "".join(written)

    @cached_property
    def _pattern(self) -> re.Pattern[str]:
        parts = []
        previous: str | None = None
        for text, name, _ in self._parts:
            parts.append(r"\s+".join(re.escape(piece) for piece in re.split(r"\s+", text)))
            if name is not None:
                # After any text, a number is not the end of a longer one.
                begin = r"(?<![0-9.+-])" if previous == ANY and not text else ""
                parts.append(".*" if name == ANY else rf"\s*{begin}(?P<{name}>{NUMBER})\s*")
            previous = name
        return re.compile("".join(parts), re.IGNORECASE | re.DOTALL)

    def match(self, message: str) -> dict[str, float] | None:
        """Return the numbers of a message by name, or None if it is not of this form or a number is none."""
        found = self._pattern.fullmatch(message.strip())
        if found is None:
            return None
        numbers = {name: float(text) for name, text in found.groupdict().items()}
        for number in numbers.values():
            if abs(number) >= _NOT_A_NUMBER:
                return None
        return numbers


@cache
def template(text: str) -> Template:
    """Return the template of a text, made once; raises as `Template`."""
    return Template(text)


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
        description="form of the answer: {value} is the number, {any} is any text; signals with the same query have "
        "the same reply, in which each number stands by the name of its signal",
    )

    @field_validator("reply")
    @classmethod
    def _is_template(cls, text: str) -> str:
        if not Template(text).names:
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
    reply: str = Field(default="{value}", description="form of the answer, with {value}; {any} is any text")
    range_queries: tuple[Message, Message] | None = Field(
        default=None,
        description="questions for the lowest and the highest set-point that the instrument takes, such as "
        '["VOLT? MIN", "VOLT? MAX"]; limits beyond are an error',
    )

    @field_validator("reply")
    @classmethod
    def _is_template(cls, text: str) -> str:
        Template(text).check({VALUE, ANY}, {VALUE})
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
    signals: dict[Name, SignalTable] = Field(min_length=1, description="what it measures, one table a signal")

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
                Template(first.reply).check({ANY, *needed}, needed)
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


def check_arrival(target: TargetTable, signals: Collection[str]) -> None:
    """Raise `ValueError` if a set-point arrives at a signal that is not among those of its device, unless empty."""
    if target.arrival is not None and signals and target.arrival.signal not in signals:
        raise ValueError(
            f"arrival.signal = {target.arrival.signal!r}: there is no such signal; there are: {', '.join(signals)}"
        )
