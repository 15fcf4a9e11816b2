"""An emulated supply or meter that speaks the messages of a table of the rig file (`bench.devices.command_table`).

It answers the questions of the table, takes its messages, and keeps a queue of errors (SCPI-99 volume 2, 21.8). The
common commands `*CLS`, `*RST`, `*OPC` and `*OPC?` of IEEE 488.2 are there even if the table does not name them. A
message may begin with a colon, and several may stand on one line, separated by semicolons.

Assumptions: an instrument of the table starts with its output off and its set-point at the value that is allowed next
to 0; a message that it does not know changes nothing; a set-point is kept to the digits of its resolution.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from bench.devices import VALUE, ActuatorTable, CommandTable, Identity, Signal, signals_by_query, template
from sim_devices.instruments.emulated import EmulatedInstrument
from sim_devices.world import World

LONGEST_MESSAGE = 4096
"""Characters after which a message without an end is dropped."""

_LONGEST_QUEUE = 20
_MOST_HEARD = 64

Action = Callable[[], str | None]
"""Carries a message out, and returns the answer, or None if it has none."""

NO_ERROR = '0,"No error"'
UNDEFINED_HEADER = '-113,"Undefined header"'
OUT_OF_RANGE = '-222,"Data out of range"'
QUEUE_OVERFLOW = '-350,"Queue overflow"'
INPUT_OVERRUN = '-363,"Input buffer overrun"'
"""Errors of SCPI-99 volume 2, 21.8."""


@dataclass(frozen=True)
class Meter:
    """How the instrument sees one quantity.

    Attributes
    ----------
    read : callable
        Returns the true value, in the unit of the signal.
    noise : float
        Standard deviation of a reading.
    resolution : float
        Last digit of a reading; 0 for none.
    """

    read: Callable[[], float]
    noise: float = 0.0
    resolution: float = 0.0


class EmulatedTextInstrument(EmulatedInstrument):
    """A text instrument behind its front panel.

    Parameters
    ----------
    table : CommandTable
        What it understands; an `ActuatorTable` for one with an output.
    meters : mapping of str to Meter
        How it measures each signal of the table.
    drive : callable, optional
        Takes what the output delivers from now on, in the unit of the set-point; 0 when it is off.
    """

    def __init__(
        self,
        name: str,
        world: World,
        table: CommandTable,
        meters: Mapping[str, Meter],
        rng: np.random.Generator,
        drive: Callable[[float], None] | None = None,
    ) -> None:
        super().__init__(name, world, rng)
        self.table = table
        self._meters = meters
        self._drive = drive
        self._frozen: dict[str, float] | None = None
        self.errors: deque[str] = deque()
        self._actions = self._all_actions()
        # The same, by messages as they were sent: a host sends the same few again and again.
        self._heard: dict[str, Action] = {}
        self._identity = Identity("emulated", "text instrument", name, "emulated")
        self.power_cycle()

    @property
    def signals(self) -> tuple[Signal, ...]:
        """What it measures."""
        return tuple(
            Signal(f"{self.name}_{name}", table.unit, table.description or name.replace("_", " "), table.precision)
            for name, table in self.table.signals.items()
        )

    def measure(self) -> dict[str, float]:
        """Measure every signal as on its display; values by signal name."""
        with self._request():
            return {f"{self.name}_{name}": self._reading(name) for name in self.table.signals}

    def safe(self) -> None:
        """Switch the output off, as at the front panel."""
        with self._request():
            self.switch(False)

    @property
    def output(self) -> float:
        """What the output delivers, in the unit of the set-point; 0 when it is off."""
        return self._level if self.on else 0.0

    def power_cycle(self) -> None:
        """Switch the instrument off and on: the output is off, the set-point and the errors are forgotten."""
        with self.world.at_present():
            self.errors.clear()
            table = self.table
            low, high = table.setpoint.limits if isinstance(table, ActuatorTable) else (0.0, 0.0)
            self._level = min(max(0.0, low), high)
            # Without messages that switch it on, the set-point alone acts.
            self.switch(isinstance(table, ActuatorTable) and not table.output.on)

    def switch(self, on: bool) -> None:
        """Switch the output, as a protection or a hand at the front panel does."""
        self.on = on
        self._act()

    def obey(self, line: str) -> str | None:
        """Carry out the messages of one line; return their answers, or None if there is none."""
        act = self._action(line)
        if act is not None:
            return act() or None
        answers = [self._obey_one(message) for message in line.split(";") if message.strip()]
        return ";".join(answer for answer in answers if answer is not None) or None

    def _obey_one(self, message: str) -> str | None:
        act = self._action(message)
        if act is None:
            # On a line that it shares, it is meant for another one, or another one has sent it.
            if not getattr(self.table, "line", ""):
                self.report(UNDEFINED_HEADER)
            return None
        return act()

    def _action(self, message: str) -> Action | None:
        """Return what a message makes the instrument do, or None if it is unknown."""
        known = self._heard.get(message)
        if known is not None:
            return known
        normal = _normal(message)
        known = self._actions.get(normal)
        if known is not None and len(self._heard) < _MOST_HEARD:
            self._heard[message] = known
        if known is None and isinstance(self.table, ActuatorTable):
            # Of many spaces, a pattern tries every division.
            numbers = self.table.form(self.table.setpoint.command).match(normal)
            return None if numbers is None else partial(self._set, numbers[VALUE])
        return known

    def report(self, error: str) -> None:
        """Put an error into the queue."""
        if len(self.errors) < _LONGEST_QUEUE:
            self.errors.append(error)
        else:
            self.errors[-1] = QUEUE_OVERFLOW

    def _all_actions(self) -> dict[str, Action]:
        """Return what each message without a number does; of messages that are named twice, the first."""
        table = self.table
        named: list[tuple[str, Action]] = []
        if isinstance(table, ActuatorTable):
            setpoint, output = table.setpoint, table.output
            named += [(message, partial(self._switch, message, True)) for message in output.on[-1:]]
            named += [(message, partial(self._switch, message, False)) for message in output.off[-1:]]
            named += [(message, _nothing) for message in (*output.on, *output.off)]
            named += [(setpoint.query, self._answer_setpoint), (output.query, self._answer_output)]
            for query, limit in zip(setpoint.range_queries or (), setpoint.limits, strict=False):
                named.append((query, partial(table.form("{value}").fill, {VALUE: limit / setpoint.scale})))
        for query, names in signals_by_query(table.signals).items():
            named.append((query, partial(self._answer_signals, names)))
        named += [
            (table.identity_query, self._answer_identity),
            (table.error_query, self._answer_error),
            (table.completion_query, _complete),
            *((message, _nothing) for message in table.setup),
            ("*OPC?", _complete),
            ("*OPC", _nothing),
            ("*CLS", self.errors.clear),
            ("*RST", self._reset),
        ]
        return {_normal(template(message).fill({})): act for message, act in reversed(named) if message}

    def _switch(self, message: str, on: bool) -> None:
        table = self.table
        assert isinstance(table, ActuatorTable)
        numbers = table.form(table.setpoint.command).match(message)
        if numbers is not None:
            self._set(numbers[VALUE])
        if on or table.output.on:
            self.switch(on)

    def _set(self, number: float) -> None:
        table = self.table
        assert isinstance(table, ActuatorTable)
        setpoint = table.setpoint
        value = number * setpoint.scale
        low, high = setpoint.limits
        margin = 1e-9 * (high - low)
        if not low - margin <= value <= high + margin:
            self.report(OUT_OF_RANGE)
            return
        self._level = _rounded(value, setpoint.resolution or 0.0)
        self._act()

    def _reset(self) -> None:
        errors = [*self.errors]
        self.power_cycle()
        self.errors.extend(errors)

    def _answer_setpoint(self) -> str:
        table = self.table
        assert isinstance(table, ActuatorTable)
        setpoint = table.setpoint
        return table.form(setpoint.reply).fill({VALUE: self._level / setpoint.scale}, units={VALUE: setpoint.unit})

    def _answer_output(self) -> str:
        table = self.table
        assert isinstance(table, ActuatorTable)
        return template(table.output.is_on if self.on else table.output.is_off).fill({}, "1")

    def _act(self) -> None:
        if self._drive is not None:
            self._drive(self.output)

    def freeze(self) -> None:
        """Let each signal stand at its next reading; the output is obeyed as ever."""
        self._frozen = {}

    def thaw(self) -> None:
        """Undo `freeze`."""
        self._frozen = None

    def _reading(self, name: str) -> float:
        if self._frozen is None:
            return self._measured(name)
        if name not in self._frozen:
            self._frozen[name] = self._measured(name)
        return self._frozen[name]

    def _measured(self, name: str) -> float:
        meter = self._meters[name]
        return _rounded(meter.read() + self._draw(meter.noise), meter.resolution)

    def _answer_signals(self, names: list[str]) -> str:
        tables = self.table.signals
        values = {name: self._reading(name) / tables[name].scale for name in names}
        values[VALUE] = values[names[0]]
        units = {VALUE: tables[names[0]].unit, **{name: tables[name].unit for name in names}}
        return self.table.form(tables[names[0]].reply).fill(values, units=units)

    def _answer_identity(self) -> str:
        """Answer with the form of the table; model and serial number (IEEE 488.2, 10.14) are those of its keys."""
        fields = template(self.table.identity).fill({}, "emulated").split(",")
        for place, key in ((1, "model"), (2, "serial_number")):
            if wanted := getattr(self.table, key, ""):
                fields += ["emulated"] * (place + 1 - len(fields))
                fields[place] = wanted
        return ",".join(fields)

    def _answer_error(self) -> str:
        if self.errors:
            return self.errors.popleft()
        form = self.table.no_error
        return template(form).fill({}, '"No error"') if form else NO_ERROR


def _rounded(value: float, resolution: float) -> float:
    if not resolution:
        return value
    digits = max(0, 2 - math.floor(math.log10(resolution)))
    return round(round(value / resolution) * resolution, digits)


def _normal(message: str) -> str:
    """Return a message as it is compared: without case, a colon at first, and spaces beyond one."""
    return " ".join(message.strip().removeprefix(":").upper().split())


def _nothing() -> None:
    """Take a message that changes nothing here, such as a range or a limit of current."""


def _complete() -> str:
    return "1"
