"""The roles that a text instrument of the rig file plays: a sensor, an actuator, or a voltage supply.

Sources: IEEE 488.2-1992, SCPI-99; the messages themselves are those of the rig file.
"""

from __future__ import annotations

import math
from contextlib import suppress
from functools import partial
from typing import ClassVar, Self

from pydantic import ValidationInfo, field_validator, model_validator

from bench.base import Clock, ConfigurationError, DeviceConnectionError, DeviceError, DeviceRestartedError
from bench.devices import (
    ANY_TEXT,
    ActuatorTable,
    GeneralActuator,
    GeneralSensor,
    Identity,
    Limits,
    SetpointTable,
    Signal,
    Status,
    Template,
    VoltageSupply,
    signals_by_query,
    template,
    written_number,
)
from drivers.device import LineDevice, attempt
from drivers.quantities import arrival_of, check_ranges, check_read_back, identity_of, output_lost, signals_of
from drivers.scpi.line import LineTable, TextLine
from drivers.serial_line import RESENDS

_UNKNOWN = Identity("unknown", "unknown", "unknown", "unknown")
_DONE = template("1")
_MESSAGE_TIME = 0.1  # s that a message takes on a slow line


class SensorSettings(LineTable):
    """Rig-file settings of a text instrument that measures."""


class ActuatorSettings(LineTable, ActuatorTable):
    """Rig-file settings of a text instrument that takes a set-point."""


class SCPISensor(LineDevice[LineTable, TextLine], GeneralSensor):
    """A text instrument that measures: its signals are those of the rig file.

    A query that several signals share is sent once. `measure` reads the queue of errors as well, `glance` does not.
    """

    Settings: ClassVar[type[LineTable]] = SensorSettings
    _earlier_repeats = 0

    def __init__(self, name: str, settings: LineTable, clock: Clock, line: TextLine) -> None:
        GeneralSensor.__init__(self, name, clock, _UNKNOWN, signals_of(settings.signals))
        self._settings, self._line = settings, line

    @property
    def repeats(self) -> int:
        """Number of questions that were repeated since the device was connected, as their answers were lost."""
        return self._earlier_repeats + self._line.repeats

    def _renew_line(self) -> None:
        repeats = self.repeats
        super()._renew_line()
        self._earlier_repeats = repeats

    def close(self) -> None:
        """Release the line; an output that is on stays on."""
        super().close()
        self._line.lost = False

    def _begin(self) -> None:
        """Open the line again if it was lost."""
        if self._line.lost:
            self.reconnect()

    @classmethod
    def _open_line(cls, name: str, settings: LineTable, clock: Clock) -> TextLine:
        return TextLine(name, settings, clock)

    def _identify(self) -> Identity:
        settings = self._settings
        if not settings.identity_query:
            return Identity("unknown", "text instrument", settings.port, "unknown")
        # An attempt to reconnect is one question, as others wait for it.
        resends = RESENDS if self._identity is _UNKNOWN else 0
        answer, _ = self._line.ask(settings.identity_query, template(ANY_TEXT), resends)
        if template(settings.identity).match(answer) is None:
            raise DeviceConnectionError(
                self.name,
                f"{settings.port} is {answer!r}, expected {settings.identity!r}; "
                "check the address and the key identity",
            )
        return identity_of(answer)

    def _start(self) -> None:
        # What happened before is nobody's fault here.
        self._line.errors()
        for message in self._settings.setup:
            self._line.tell(message)
        if self._settings.setup:
            self._line.raise_errors("the messages of setup")

    def measure_quantities(self) -> dict[str, float]:
        """Measure every quantity, and read the queue of errors."""
        self._begin()
        values = self._ask_quantities()
        self._line.raise_errors("measuring")
        return values

    def glance(self) -> dict[str, float]:
        """Measure every signal, without a look at the queue of errors; values by signal name."""
        self._begin()
        return {f"{self.name}_{name}": value for name, value in self._ask_quantities().items()}

    def _check_unchanged(self) -> None:
        self._ask_quantities()

    def _ask_quantities(self) -> dict[str, float]:
        tables = self._settings.signals
        values = {}
        for query, names in signals_by_query(tables).items():
            _, numbers = self._line.ask(query, template(tables[names[0]].reply))
            for name in names:
                values[name] = numbers.get(name, numbers.get("value", math.nan)) * tables[name].scale
        check_ranges(self.name, tables, values)
        return {name: values[name] for name in tables}


class SCPIActuator(SCPISensor, GeneralActuator):
    """A text instrument that takes a set-point, and measures its signals.

    `set` checks that the output is as it was left, sends the set-point, reads it back, and reads the queue of
    errors. It switches an output on that is off, after the messages of `setup` once more. A reading finds an output
    that is off or a set-point that has changed without the bench: a protection, or a restart if both are lost, after
    which nothing is set. `safe` sends the messages of `output.off` and asks for the state, over a line of its own if
    the one in use does not answer; an instrument without such a question has to answer at least, and to report no
    error. There is no watchdog: what was set stays when the bench dies.
    """

    Settings: ClassVar[type[LineTable]] = ActuatorSettings

    def __init__(self, name: str, settings: ActuatorSettings, clock: Clock, line: TextLine) -> None:
        table = settings.setpoint
        GeneralActuator.__init__(
            self,
            name,
            clock,
            _UNKNOWN,
            signals_of(settings.signals),
            Limits(*table.limits, table.unit),
            description=table.description,
            precision=table.precision,
        )
        self._settings, self._line = settings, line
        self._table, self._output = table, settings.output
        self._command = template(table.command)
        self._on = False
        self._left = math.nan
        self._restart: DeviceRestartedError | None = None

    @property
    def safe_within(self) -> float:
        """Longest time of `safe` on a line that works, s: its messages and one question."""
        settings = self._settings
        return settings.timeout + (len(self._output.off) + 2) * (settings.delay + _MESSAGE_TIME)

    def _begin(self) -> None:
        if self._restart is not None:
            raise self._restart
        super()._begin()

    def _check_unchanged(self) -> None:
        if self._restart is not None:
            raise self._restart
        self._check_output()
        if not math.isnan(self._left):
            self._check_setpoint(self._left)

    def _start(self) -> None:
        super()._start()
        if self._table.range_queries is not None:
            ends = [self._ask_number(query, template("{value}")) for query in self._table.range_queries]
            low, high = min(ends), max(ends)
            if not low <= self._limits.low < self._limits.high <= high:
                raise ConfigurationError(
                    f"{self.name}: setpoint.limits = {self._limits}: the instrument takes {low:g} to {high:g} "
                    f"{self._limits.unit}"
                )
            self._line.raise_errors("the questions of range_queries")

    def send(self, value: float) -> Status:
        """Send a set-point that is within the limits, and switch the output on if it is off."""
        self._begin()
        table, was_on = self._table, self._on
        self._check_output()
        if not was_on:
            self._check_left()
            for message in self._settings.setup:
                self._line.tell(message)
        number = value / table.scale
        self._left = math.nan
        self._line.tell(self._command.fill({self._command.names[0]: number}))
        if self._settings.completion_query:
            self._line.ask(self._settings.completion_query, _DONE)
        self._check_setpoint(value)
        self._left = value
        if not was_on:
            for message in self._output.on:
                self._line.tell(message)
        self._line.raise_errors(f"set-point {value:g} {table.unit}")
        self._on = True
        if not was_on:
            self._check_output()
        return arrival_of(self.name, self._clock, table, value, self._ask_quantities)

    def switch_off(self) -> None:
        """Send the messages that reach the safe state, and have the instrument confirm it.

        A line that does not answer, or did not before, is opened again, and everything is tried once more.
        """
        self._on = False
        failures = self._try_off()
        if any(isinstance(failure, DeviceConnectionError) for failure in failures):
            with suppress(DeviceError):
                self._renew_line()
                failures = self._try_off(fresh=True)
        if failures:
            raise DeviceError(
                self.name,
                f"does not confirm that its output is off ({failures[-1]}); switch it off by hand",
            )

    def _try_off(self, *, fresh: bool = False) -> list[DeviceError]:
        """Try everything that switches off; return what failed."""
        if any(self._command.match(message) for message in self._output.off):
            self._left = math.nan
        failures = attempt(*(partial(self._line.tell, message) for message in self._output.off))
        if failures:
            return failures
        # What comes first on a fresh line may be an answer from before; on one out of step it certainly may.
        in_step = self._line.in_step and (not fresh or self._line.find_identity())
        if not in_step:
            return [DeviceConnectionError(self.name, f"does not answer at {self._settings.port}")]
        return attempt(self._confirm_off if self._output.query else self._confirm_heard)

    def _confirm_heard(self) -> None:
        self._line.raise_errors("switching off")
        if self._settings.identity_query:
            self._line.ask(self._settings.identity_query, template(ANY_TEXT), 0)

    def measure_quantities(self) -> dict[str, float]:
        """Measure every quantity, check output and set-point, and read the queue of errors."""
        self._begin()
        values = self._ask_quantities()
        if self._on and not math.isnan(self._setpoint):
            self._check_output()
            self._check_setpoint(self._setpoint)
        self._line.raise_errors("measuring")
        return values

    def glance(self) -> dict[str, float]:
        """Measure every signal and check the output; values by signal name."""
        values = super().glance()
        self._check_output()
        return values

    def _ask_number(self, query: str, form: Template) -> float:
        _, numbers = self._line.ask(query, form)
        return numbers["value"] * self._table.scale

    def _check_setpoint(self, value: float) -> None:
        """Raise `DeviceError` unless the instrument reads a set-point back as it was written."""
        table = self._table
        if not table.query:
            return
        written = self._written(value)
        found = self._ask_number(table.query, template(table.reply))
        wrong = abs(found - written) > table.tolerance
        check_read_back(self.name, table, written, found, "; ".join(self._line.errors()) if wrong else "")

    def _check_output(self) -> None:
        """Raise `DeviceError` if an output that was switched on is off without the bench.

        One that has lost its set-point as well has restarted: `DeviceRestartedError`, now and at each later call. Of
        an output that cannot be asked for, only the set-point is looked at.
        """
        if not self._on:
            return
        if not self._output.query:
            self._check_left()
        elif not self._reads_on():
            reported = "; ".join(self._line.errors())
            problem = output_lost(self.name, setpoint_lost=self._has_lost_setpoint(), reported=reported)
            if isinstance(problem, DeviceRestartedError):
                self._restart = problem
            raise problem

    def _check_left(self) -> None:
        """Raise `DeviceRestartedError`, now and at each later call, if the set-point is not what was left."""
        if self._has_lost_setpoint():
            self._restart = DeviceRestartedError(
                self.name,
                f"does not have the set-point {self._left:g} {self._table.unit} any more: it has restarted, or was "
                "set by another program or by hand; connect again",
            )
            raise self._restart

    def _has_lost_setpoint(self) -> bool:
        """Return whether the instrument has another set-point than was sent, as far as that can be asked."""
        table = self._table
        if not table.query or math.isnan(self._left):
            return False
        found = self._ask_number(table.query, template(table.reply))
        return not abs(found - self._written(self._left)) <= table.tolerance * (1.0 + 1e-9)

    def _written(self, value: float) -> float:
        """Return a set-point as its message says it."""
        return written_number(self._command, value / self._table.scale) * self._table.scale

    def _reads_on(self) -> bool:
        output = self._output
        answer, _ = self._line.ask(output.query, template(ANY_TEXT), RESENDS if self._on else 0)
        if _is(answer, output.is_off):
            return False
        if _is(answer, output.is_on):
            return True
        raise DeviceError(
            self.name, f"answered {answer!r} to {output.query!r}, expected {output.is_on!r} or {output.is_off!r}"
        )

    def _confirm_off(self) -> None:
        if self._reads_on():
            raise DeviceError(self.name, "says that its output is on")


class VoltageSupplySettings(ActuatorSettings):
    """Rig-file settings of a bench supply: the set-point in V, the signals `voltage` in V and `current` in A."""

    @field_validator("setpoint")
    @classmethod
    def _is_a_voltage(cls, setpoint: SetpointTable, info: ValidationInfo) -> SetpointTable:
        signals = {name: signal.unit for name, signal in info.data.get("signals", {}).items()}
        if setpoint.unit != "V" or not setpoint.limits[0] <= 0.0 <= setpoint.limits[1]:
            raise ValueError("a voltage supply is set in V, and its limits are around 0 V")
        if signals and signals != {"voltage": "V", "current": "A"}:
            raise ValueError(
                "a voltage supply has the signals voltage in V and current in A; see scpi-actuator for others"
            )
        return setpoint

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if list(self.signals) != ["voltage", "current"]:
            raise ValueError("signals: expected voltage before current")
        return self


class SCPIVoltageSupply(SCPIActuator, VoltageSupply):
    """A direct-current bench supply. The safe state is the output off; its set-point counts as 0 V then."""

    Settings: ClassVar[type[LineTable]] = VoltageSupplySettings

    @property
    def output(self) -> str:
        """Which voltage the set-point is: `dc`."""
        return "dc"

    @property
    def signals(self) -> tuple[Signal, ...]:
        """What is measured."""
        named: tuple[Signal, ...] = VoltageSupply.signals.__get__(self)
        return named

    @property
    def setpoint_signal(self) -> Signal:
        """The voltage asked for."""
        named: Signal = VoltageSupply.setpoint_signal.__get__(self)
        return named

    def safe(self) -> None:
        """Switch the output off."""
        try:
            self.switch_off()
        finally:
            self._setpoint = 0.0


def _is(answer: str, expected: str) -> bool:
    """Return whether an answer is as expected, as text or as a number."""
    if template(expected).match(answer) is not None:
        return True
    number = template("{value}")
    numbers = number.match(answer), number.match(expected)
    return None not in numbers and numbers[0] == numbers[1]
