"""Modbus RTU instruments that a table describes, in a rig file or as rows of a class.

    [devices.controller]
    driver = "modbus-actuator"              # or "modbus-sensor", for one that only measures
    port = "/dev/ttyUSB0"
    address = 3
    identity = { at = 0x0000, value = 1410 }

    [devices.controller.signals.temperature]
    at = 0x0010
    kind = "I16"
    scale = 0.1
    unit = "°C"
    limits = [-20.0, 150.0]

    [devices.controller.setpoint]
    at = 0x0020
    kind = "U16"
    unit = "W"
    limits = [0.0, 50.0]

    [devices.controller.output]
    at = 0x0021                       # 1 switches on, 0 off; see on and off

Registers are read by function 3, one is written by function 6 and two by function 16.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import ClassVar

from pydantic import Field, ValidationInfo, field_validator, model_validator

from bench.base import CheckedTable, Clock, DeviceConnectionError, DeviceError
from bench.devices import DriverSettings, Identity, Name, QuantityTable, TargetTable, check_arrival
from drivers.device import attempt
from drivers.modbus_rtu import Kind, RefusalError, RtuLine, RtuSettings, pack_number, unpack_number
from drivers.table import SwitchedLine, TableActuator, TableLine, TableSensor


def _address(description: str) -> int:
    value: int = Field(ge=0, le=0xFFFF, description=description)
    return value


def _kind(default: Kind) -> Kind:
    value: Kind = Field(default=default, description="what is in it: U16, I16, or in two registers U32, I32 or F32")
    return value


class RegisterTable(QuantityTable):
    """A quantity that a Modbus instrument measures: `[devices.NAME.signals.QUANTITY]`."""

    at: int = _address("address of its first register, 0 to 0xFFFF")
    kind: Kind = _kind("F32")


class RegisterTargetTable(TargetTable):
    """What a Modbus instrument is set to: `[devices.NAME.setpoint]`."""

    at: int = _address("address of its first register, 0 to 0xFFFF")
    kind: Kind = _kind("F32")

    @model_validator(mode="after")
    def _holds_the_limits(self) -> RegisterTargetTable:
        for limit in self.limits:
            pack_number(self.kind, limit / self.scale)
        return self


class RegisterValue(CheckedTable):
    """A register and what stands in it."""

    at: int = _address("address of its first register, 0 to 0xFFFF")
    kind: Kind = _kind("U16")
    value: int = Field(description="what stands in it")

    @model_validator(mode="after")
    def _fits(self) -> RegisterValue:
        pack_number(self.kind, self.value)
        return self


class RegisterOutputTable(CheckedTable):
    """How the output is switched: `[devices.NAME.output]`."""

    at: int = _address("address of the register that switches it, and reads whether it is on")
    on: int = Field(default=1, ge=0, le=0xFFFF, description="what switches it on")
    off: int = Field(default=0, ge=0, le=0xFFFF, description="what switches it off")

    @model_validator(mode="after")
    def _differ(self) -> RegisterOutputTable:
        if self.on == self.off:
            raise ValueError(f"on and off are both {self.on}")
        return self


class SensorSettings(RtuSettings):
    """Rig-file settings of a Modbus instrument that measures."""

    identity: RegisterValue | None = Field(
        default=None, description="register that says which instrument it is, and its value; not checked if not given"
    )
    serial_number_at: int | None = Field(
        default=None, ge=0, le=0xFFFF, description="first of two registers with the serial number, if there are any"
    )
    setup: tuple[RegisterValue, ...] = Field(
        default=(), description="registers that are written on connecting, and before the output goes on"
    )
    low_word_first: bool = Field(default=False, description="whether the low word of two registers comes first")
    signals: dict[Name, RegisterTable] = Field(min_length=1, description="what it measures, one table a signal")


class ActuatorSettings(SensorSettings):
    """Rig-file settings of a Modbus instrument that takes a set-point."""

    setpoint: RegisterTargetTable = Field(description="what is set")
    output: RegisterOutputTable = Field(description="how the output is switched on and off")

    @field_validator("setpoint")
    @classmethod
    def _arrives_at_a_signal(cls, setpoint: RegisterTargetTable, info: ValidationInfo) -> RegisterTargetTable:
        check_arrival(setpoint, info.data.get("signals", {}))
        return setpoint


class _MeasuringLine(RtuLine, TableLine):
    """What a Modbus instrument is asked and told to measure."""

    source = target_source = "at"

    def __init__(self, name: str, settings: SensorSettings, clock: Clock) -> None:
        TableLine.__init__(self, name, settings.signals)
        RtuLine.__init__(self, name, settings, clock)
        self._keys = settings
        self.swaps_words = settings.low_word_first
        self.first_of_echo = min(table.at for table in settings.signals.values())

    def identify(self) -> Identity:
        keys = self._keys
        model = "Modbus instrument"
        if keys.identity is not None:
            wanted = keys.identity
            found = self._identifying(wanted.at, wanted.kind)
            if found != wanted.value:
                raise self._other(f"has {found:g} in register 0x{wanted.at:04X}, expected {wanted.value}")
            model = f"{model} {wanted.value}"
        number = (
            "unknown" if keys.serial_number_at is None else f"{self._identifying(keys.serial_number_at, 'U32'):.0f}"
        )
        if keys.identity is None and keys.serial_number_at is None:
            # So that something has answered at least.
            self.quantities(list(keys.signals)[:1])
        return Identity("unknown", model, number, "unknown")

    def start(self) -> None:
        for each in self._keys.setup:
            self.write_number(f"register 0x{each.at:04X}", each.at, each.kind, each.value)

    def quantities(self, names: Iterable[str]) -> dict[str, float]:
        tables = self._keys.signals
        return {name: self.read_number(tables[name].at, tables[name].kind) * tables[name].scale for name in names}

    def _identifying(self, register: int, kind: Kind) -> float:
        try:
            return self.read_number(register, kind)
        except RefusalError as error:
            raise self._other(f"refuses: {str(error).removeprefix(f'{self._name}: ')}") from error

    def _other(self, what: str) -> DeviceConnectionError:
        return DeviceConnectionError(
            self._name, f"the device at {self._keys.port}, address {self._keys.address}, {what}; check the address"
        )


class _SwitchingLine(_MeasuringLine, SwitchedLine):
    """What a Modbus instrument is told to be set, and to be switched on and off."""

    def __init__(self, name: str, settings: ActuatorSettings, clock: Clock) -> None:
        _MeasuringLine.__init__(self, name, settings, clock)
        self.target = self._target = settings.setpoint
        self._output = settings.output
        self.off_changes_setpoint = settings.output.at == settings.setpoint.at
        # Two writes, a question that brings the line into step, and reading back.
        self.safe_within = 5.0 * settings.timeout

    def write_setpoint(self, value: float) -> None:
        target = self._target
        self.write_number("set-point", target.at, target.kind, value / target.scale)

    def written(self, value: float) -> float:
        target = self._target
        return unpack_number(target.kind, pack_number(target.kind, value / target.scale)) * target.scale

    def read_setpoint(self) -> float | None:
        return self.read_number(self._target.at, self._target.kind) * self._target.scale

    def prepare(self) -> None:
        self.start()

    def switch_on(self) -> None:
        self.write_number("output", self._output.at, "U16", self._output.on)

    def try_off(self, *, fresh: bool) -> list[DeviceError]:  # noqa: ARG002 - a line finds its step by itself
        self.tell(self._output.at, self._output.off)
        return attempt(partial(self.write_number, "output", self._output.at, "U16", self._output.off))

    def reads_on(self) -> bool | None:
        output = self._output
        found = self.read_number(output.at, "U16")
        if found not in (output.on, output.off):
            raise DeviceError(self._name, f"has {found:g} for its output, expected {output.on} or {output.off}")
        return found == output.on


class ModbusSensor(TableSensor[_MeasuringLine]):
    """A Modbus RTU instrument that measures."""

    Settings: ClassVar[type[DriverSettings]] = SensorSettings
    Line: ClassVar[type[TableLine]] = _MeasuringLine


class ModbusActuator(TableActuator):
    """A Modbus RTU instrument that takes a set-point, and measures."""

    Settings: ClassVar[type[DriverSettings]] = ActuatorSettings
    Line: ClassVar[type[TableLine]] = _SwitchingLine
