"""The roles that a text instrument of the rig file plays: a sensor, an actuator, or a voltage supply.

Sources: IEEE 488.2-1992, SCPI-99; the messages themselves are those of the rig file.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import partial
from typing import ClassVar, Self

from pydantic import ValidationInfo, field_validator, model_validator

from bench.base import Clock, ConfigurationError, DeviceConnectionError, DeviceError
from bench.devices import (
    ANY_TEXT,
    VALUE,
    ActuatorTable,
    DriverSettings,
    Identity,
    Limits,
    SetpointTable,
    Signal,
    VoltageSupply,
    signals_by_query,
    template,
    written_number,
)
from drivers.device import attempt
from drivers.quantities import expected_identity
from drivers.scpi.line import LineTable, TextLine
from drivers.serial_line import RESENDS
from drivers.table import SwitchedLine, TableActuator, TableLine, TableSensor

_DONE = template("1")
_MESSAGE_TIME = 0.1  # s that a message takes on a slow line


class SensorSettings(LineTable):
    """Rig-file settings of a text instrument that measures."""


class ActuatorSettings(LineTable, ActuatorTable):
    """Rig-file settings of a text instrument that takes a set-point."""


class _MeasuringLine(TextLine, TableLine):
    """What a text instrument is asked and told to measure. A query that several signals share is sent once."""

    source = "query"
    target_source = "command"

    def __init__(self, name: str, settings: LineTable, clock: Clock) -> None:
        TableLine.__init__(self, name, settings.signals)
        TextLine.__init__(self, name, settings, clock)

    def identify(self) -> Identity:
        settings = self._settings
        if not settings.identity_query:
            return Identity("unknown", "text instrument", "unknown", "unknown")
        answer, _ = self.ask(settings.identity_query, template(ANY_TEXT))
        return expected_identity(self._device, settings.port, answer, settings.identity)

    def start(self) -> None:
        # What happened before is nobody's fault here.
        self.errors()
        self.set_up()
        if self._settings.setup:
            self.raise_errors("the messages of setup")

    def set_up(self) -> None:
        for message in self._settings.setup:
            self.tell(message)

    def quantities(self, names: Iterable[str]) -> dict[str, float]:
        tables = {name: self._settings.signals[name] for name in names}
        units = {name: table.unit for name, table in self._settings.signals.items()}
        values = {}
        for query, sharing in signals_by_query(tables).items():
            first = tables[sharing[0]]
            _, numbers = self.ask(query, self._settings.form(first.reply), units={**units, VALUE: first.unit})
            for name in sharing:
                values[name] = numbers.get(name, numbers.get(VALUE, math.nan)) * tables[name].scale
        return {name: values[name] for name in tables}


class _SwitchingLine(_MeasuringLine, SwitchedLine):
    """What a text instrument is told to be set, and to be switched on and off."""

    def __init__(self, name: str, settings: ActuatorSettings, clock: Clock) -> None:
        SwitchedLine.__init__(self, name, settings.signals, settings.setpoint)
        TextLine.__init__(self, name, settings, clock)
        self._table, self._output = settings.setpoint, settings.output
        self._command = settings.form(self._table.command)
        self.off_changes_setpoint = any(self._command.match(message) for message in self._output.off)
        # Its messages and one question.
        self.safe_within = settings.timeout + (len(self._output.off) + 2) * (settings.delay + _MESSAGE_TIME)

    def start(self) -> None:
        super().start()
        table = self._table
        if table.range_queries is not None:
            ends = [self._ask_number(query, "{value}") for query in table.range_queries]
            low, high = min(ends), max(ends)
            if not low <= table.limits[0] < table.limits[1] <= high:
                raise ConfigurationError(
                    f"{self._device}: setpoint.limits = {Limits(*table.limits, table.unit)}: the instrument takes "
                    f"{low:g} to {high:g} {table.unit}"
                )
            self.raise_errors("the questions of range_queries")

    def write_setpoint(self, value: float) -> None:
        self.tell(self._command.fill({self._command.names[0]: value / self._table.scale}))
        if self._settings.completion_query:
            self.ask(self._settings.completion_query, _DONE)

    def written(self, value: float) -> float:
        return written_number(self._command, value / self._table.scale) * self._table.scale

    def read_setpoint(self) -> float | None:
        return self._ask_number(self._table.query, self._table.reply) if self._table.query else None

    def prepare(self) -> None:
        self.set_up()

    def switch_on(self) -> None:
        for message in self._output.on:
            self.tell(message)

    def try_off(self, *, fresh: bool) -> list[DeviceError]:
        """Send the messages of `output.off` and ask for the state.

        An instrument without a question for it has to answer at least, and to report no error.
        """
        failures = attempt(*(partial(self.tell, message) for message in self._output.off))
        if failures:
            return failures
        # What comes first on a fresh line may be an answer from before; on one out of step it certainly may.
        in_step = self.in_step and (not fresh or self.find_identity())
        if not in_step:
            return [DeviceConnectionError(self._device, f"does not answer at {self._settings.port}")]
        return attempt(self._confirm_off if self._output.query else self._confirm_heard)

    def reads_on(self) -> bool | None:
        return self._is_on(RESENDS) if self._output.query else None

    def _is_on(self, resends: int) -> bool:
        output = self._output
        answer, _ = self.ask(output.query, template(ANY_TEXT), resends)
        if _is(answer, output.is_off):
            return False
        if _is(answer, output.is_on):
            return True
        raise DeviceError(
            self._device, f"answered {answer!r} to {output.query!r}, expected {output.is_on!r} or {output.is_off!r}"
        )

    def _confirm_off(self) -> None:
        if self._is_on(0):
            raise DeviceError(self._device, "says that its output is on")

    def _confirm_heard(self) -> None:
        self.raise_errors("switching off")
        if self._settings.identity_query:
            self.ask(self._settings.identity_query, template(ANY_TEXT), 0)

    def _ask_number(self, query: str, reply: str) -> float:
        _, numbers = self.ask(query, self._settings.form(reply), units={VALUE: self._table.unit})
        return numbers[VALUE] * self._table.scale


class SCPISensor(TableSensor[_MeasuringLine]):
    """A text instrument that measures."""

    Settings: ClassVar[type[DriverSettings]] = SensorSettings
    Line: ClassVar[type[TableLine]] = _MeasuringLine


class SCPIActuator(TableActuator):
    """A text instrument that takes a set-point, and measures."""

    Settings: ClassVar[type[DriverSettings]] = ActuatorSettings
    Line: ClassVar[type[TableLine]] = _SwitchingLine


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

    Settings: ClassVar[type[DriverSettings]] = VoltageSupplySettings

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
