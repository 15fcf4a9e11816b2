"""Instruments of the PyMeasure library in a role of the bench; needs the extra `pymeasure`.

    [devices.smu]
    driver = "pymeasure"                            # or "pymeasure-sensor", for one that only measures
    instrument = "pymeasure.instruments.keithley:Keithley2400"
    port = "GPIB0::24::INSTR"                       # a VISA resource, or a line of pyserial
    before_on = ["compliance_current = 0.1"]        # assignments and calls, in this order
    on = ["enable_source()"]
    safe = ["source_voltage = 0", "disable_source()"]

    [devices.smu.setpoint]
    property = "source_voltage"
    unit = "V"
    limits = [0.0, 20.0]

    [devices.smu.signals.current]
    property = "current"
    unit = "A"

Properties of a channel are written with a point, `ch_1.voltage`. Source: the documentation of PyMeasure 0.16.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial, reduce
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, Field, ValidationInfo, field_validator

from bench.base import Clock, ConfigurationError, DeviceConnectionError, DeviceError, how_to_install, registry
from bench.devices import (
    ANY_TEXT,
    DriverSettings,
    Expected,
    Identity,
    Name,
    QuantityTable,
    TargetTable,
    check_arrival,
    not_empty,
)
from drivers.device import attempt
from drivers.quantities import expected_identity
from drivers.serial_line import lost_line, open_locked
from drivers.table import SwitchedLine, TableActuator, TableLine, TableSensor

_NOT_A_NUMBER = 9.9e37  # SCPI's infinity


def _action(text: str) -> str:
    parse_action(text)
    return text


def _path(text: str) -> str:
    if not all(part.isidentifier() and not part.startswith("_") for part in text.split(".")):
        raise ValueError("expected the name of a property, such as voltage or ch_1.voltage")
    return text


def _instrument(reference: str) -> str:
    instrument_class(reference)
    return reference


Action = Annotated[str, AfterValidator(_action)]
"""A call such as `enable_source()` or an assignment such as `source_voltage = 0`."""

Path = Annotated[str, AfterValidator(_path)]
"""A property of the instrument."""


def parse_action(text: str) -> Callable[[object], object]:
    """Return what carries an action out on an instrument.

    Raises
    ------
    ValueError
        If the text is neither a call nor an assignment of literal values.
    """
    try:
        (statement,) = ast.parse(text.strip()).body
        if isinstance(statement, ast.Assign):
            (target,) = statement.targets
            path, value = _path(ast.unparse(target)), ast.literal_eval(statement.value)
            return lambda instrument: _set(instrument, path, value)
        if isinstance(statement, ast.Expr) and isinstance(call := statement.value, ast.Call):
            path = _path(ast.unparse(call.func))
            positional = [ast.literal_eval(argument) for argument in call.args]
            named = {word.arg: ast.literal_eval(word.value) for word in call.keywords if word.arg}
            if len(named) == len(call.keywords):
                return lambda instrument: _get(instrument, path)(*positional, **named)
    except (SyntaxError, ValueError):
        pass
    raise ValueError("expected a call such as enable_source(), or an assignment such as source_voltage = 0")


def instrument_class(reference: str) -> Any:  # noqa: ANN401 - a class of the library, which is optional
    """Return the class that `module:Class` names.

    Raises
    ------
    ValueError
        If PyMeasure is not installed, the class may not be imported, there is none, or it is no instrument.
    """
    if importlib.util.find_spec("pymeasure") is None:
        raise ValueError(f"needs PyMeasure; install it by: {how_to_install('pymeasure')}")
    from pymeasure.instruments import Instrument

    module, _, name = reference.partition(":")
    try:
        if module.partition(".")[0] != "pymeasure":
            registry.check_import(module)
    except ConfigurationError as error:
        raise ValueError(str(error)) from None
    try:
        found = getattr(importlib.import_module(module), name)
    # A module of the user's own may fail in any way.
    except Exception as error:
        raise ValueError(f"cannot be loaded: {type(error).__name__}: {error}") from None
    if not (isinstance(found, type) and issubclass(found, Instrument)):
        raise ValueError("is no instrument of PyMeasure; expected module:Class")
    return found


def _get(instrument: object, path: str) -> Any:  # noqa: ANN401 - of any type
    return reduce(getattr, path.split("."), instrument)


def _set(instrument: object, path: str, value: object) -> None:
    *owner, name = path.split(".")
    setattr(reduce(getattr, owner, instrument), name, value)


class PropertyTable(QuantityTable):
    """A quantity that the instrument measures: `[devices.NAME.signals.QUANTITY]`."""

    property: Path = Field(description="property of the instrument that delivers the value, such as current")


class PropertySetpointTable(TargetTable):
    """What the instrument is set to: `[devices.NAME.setpoint]`."""

    property: Path = Field(description="property of the instrument that is set, such as source_voltage")
    read_back: bool = Field(default=True, description="whether the property is read after it was set, and compared")


class SensorSettings(DriverSettings):
    """Rig-file settings of a PyMeasure instrument that measures."""

    instrument: Annotated[str, AfterValidator(_instrument)] = Field(
        description="class of the instrument, such as pymeasure.instruments.keithley:Keithley2400"
    )
    port: str = Field(
        min_length=1,
        description="VISA resource, such as GPIB0::24::INSTR, or URL of pyserial, such as socket://192.0.2.5:5025 or "
        "emulated://NAME",
    )
    options: dict[str, Any] = Field(
        default_factory=dict,
        description='keyword arguments of the class, such as { visa_library = "@py" }; with an URL those of '
        "its port, and read_termination and write_termination",
    )
    identity: Expected = Field(
        default=ANY_TEXT, description="form of the identity, such as KEITHLEY INSTRUMENTS INC.,MODEL 2400,{any}"
    )
    setup: tuple[Action, ...] = Field(default=(), description="calls and assignments on connecting, in this order")
    check_errors: bool = Field(
        default=False, description="whether the instrument's check_errors() is called after setting and measuring"
    )
    shutdown: bool = Field(default=True, description="whether the instrument's shutdown() is called on closing")
    signals: dict[Name, PropertyTable] = Field(min_length=1, description="what it measures, one table a signal")

    @field_validator("signals")
    @classmethod
    def _has_the_properties(cls, signals: dict[str, PropertyTable], info: ValidationInfo) -> dict[str, PropertyTable]:
        for name, table in signals.items():
            _check_property(info, f"{name}.property", table.property)
        return signals


class ActuatorSettings(SensorSettings):
    """Rig-file settings of a PyMeasure instrument that takes a set-point."""

    setpoint: PropertySetpointTable = Field(description="what is set")
    before_on: tuple[Action, ...] = Field(
        default=(), description="calls and assignments before the set-point that switches on, limits as a rule"
    )
    on: tuple[Action, ...] = Field(default=(), description="calls and assignments that switch the output on")
    safe: Annotated[tuple[Action, ...], AfterValidator(not_empty)] = Field(
        description="calls and assignments that reach the safe state"
    )
    output: Path | None = Field(
        default=None, description="property that is true while the output is on, such as source_enabled"
    )

    @field_validator("setpoint")
    @classmethod
    def _can_be_set(cls, setpoint: PropertySetpointTable, info: ValidationInfo) -> PropertySetpointTable:
        _check_property(info, "property", setpoint.property)
        check_arrival(setpoint, info.data.get("signals", {}))
        return setpoint


def _check_property(info: ValidationInfo, key: str, path: str) -> None:
    """Raise `ValueError` if the class has no such property; channels and what is below them are made later."""
    reference = info.data.get("instrument")
    if reference is not None and "." not in path and not hasattr(instrument_class(reference), path):
        raise ValueError(f"{key} = {path!r}: {reference} has no such property")


class _MeasuringLine(TableLine):
    """A connected PyMeasure instrument, whose errors are those of the bench.

    As a late answer could be taken for the next, the line is opened again after each request that failed on it.
    """

    source = target_source = "property"

    def __init__(self, device: str, settings: SensorSettings, clock: Clock) -> None:  # noqa: ARG002 - as lines are made
        TableLine.__init__(self, device, settings.signals)
        self._settings = settings
        # Each class and each adapter fails in a way of its own.
        try:
            kind = instrument_class(settings.instrument)
            if "://" in settings.port:
                self.instrument = kind(_serial_adapter(device, settings.port, **settings.options))
            else:
                self.instrument = kind(settings.port, **settings.options)
        except DeviceConnectionError:
            raise
        except Exception as error:
            raise DeviceConnectionError(
                device, f"cannot open {settings.port}: {type(error).__name__}: {error}"
            ) from None

    def identify(self) -> Identity:
        settings = self._settings
        if not hasattr(type(self.instrument), "id"):
            return Identity("unknown", settings.instrument.partition(":")[2], "unknown", "unknown")
        return expected_identity(self._device, settings.port, str(self.get("id")).strip(), settings.identity)

    def start(self) -> None:
        self.act_all(self._settings.setup)

    def quantities(self, names: Iterable[str]) -> dict[str, float]:
        tables = self._settings.signals
        return {name: self.number(tables[name].property) * tables[name].scale for name in names}

    def errors(self) -> list[str]:
        if not self._settings.check_errors:
            return []
        with self._errors("check_errors()"):
            return [str(error) for error in self.instrument.check_errors() or ()]

    def shut_down(self) -> None:
        if self._settings.shutdown:
            self.act("shutdown()")

    def act_all(self, actions: Iterable[str]) -> None:
        for action in actions:
            self.act(action)

    def get(self, path: str) -> Any:  # noqa: ANN401 - of any type
        with self._errors(f"reading {path}"):
            return _get(self.instrument, path)

    def number(self, path: str) -> float:
        value = self.get(path)
        try:
            number = float(value)
        except (TypeError, ValueError):
            raise DeviceError(self._device, f"{path} is {value!r}, expected a number") from None
        if not abs(number) < _NOT_A_NUMBER:
            raise DeviceError(self._device, f"{path} is {number:g}; is it out of its range?")
        return number

    def set(self, path: str, value: float) -> None:
        with self._errors(f"setting {path} to {value:g}"):
            _set(self.instrument, path, value)

    def act(self, text: str) -> None:
        with self._errors(text):
            parse_action(text)(self.instrument)

    def close(self) -> None:
        with self._errors("closing"):
            self.instrument.adapter.close()

    @contextmanager
    def _errors(self, doing: str) -> Iterator[None]:
        try:
            yield
        # The library passes on the errors of each of its adapters, and those of its validators.
        except Exception as error:
            problem = f"{doing}: {type(error).__name__}: {error}"
            if not _is_of_the_line(error):
                raise DeviceError(self._device, problem) from None
            self.lost = True
            raise lost_line(self._device, self._settings.port, problem) from None


def _serial_adapter(
    device: str,
    url: str,
    *,
    read_termination: str = "\n",
    write_termination: str = "\n",
    timeout: float = 1.0,
    **options: object,
) -> object:
    """Return PyMeasure's adapter on a line of pyserial; an answer that does not come is an error of the line."""
    import serial
    from pymeasure.adapters import SerialAdapter

    class Adapter(SerialAdapter):  # type: ignore[misc]
        def _read(self, **kwargs: object) -> str:
            answer = self._read_bytes(-1, break_on_termchar=True, **kwargs)
            if not answer.endswith(read_termination.encode()):
                raise serial.SerialException(f"no answer within {timeout:g} s")
            return str(answer.decode().removesuffix(read_termination))

    return Adapter(open_locked(device, url, timeout=timeout, **options), write_termination, read_termination)


def _is_of_the_line(error: Exception) -> bool:
    import pyvisa

    return isinstance(error, OSError | pyvisa.errors.Error)


class _SwitchingLine(_MeasuringLine, SwitchedLine):
    """A connected PyMeasure instrument that takes a set-point."""

    def __init__(self, device: str, settings: ActuatorSettings, clock: Clock) -> None:
        _MeasuringLine.__init__(self, device, settings, clock)
        self.target = self._target = settings.setpoint
        self._actions = settings

    def write_setpoint(self, value: float) -> None:
        self.set(self._target.property, value / self._target.scale)

    def read_setpoint(self) -> float | None:
        return self.number(self._target.property) * self._target.scale if self._target.read_back else None

    def prepare(self) -> None:
        self.act_all((*self._actions.setup, *self._actions.before_on))

    def switch_on(self) -> None:
        self.act_all(self._actions.on)

    def try_off(self, *, fresh: bool) -> list[DeviceError]:  # noqa: ARG002 - a new instance is always fresh
        # A lost line may take its whole time-out for each message.
        if self.lost:
            return [DeviceConnectionError(self._device, "the line was lost before")]
        return attempt(*(partial(self.act, action) for action in self._actions.safe)) or attempt(self._confirm_off)

    def reads_on(self) -> bool | None:
        return None if self._actions.output is None else bool(self.get(self._actions.output))

    def _confirm_off(self) -> None:
        if self.reads_on():
            raise DeviceError(self._device, f"{self._actions.output} is true")


class SensorAdapter(TableSensor[_MeasuringLine]):
    """A PyMeasure instrument that measures."""

    Settings: ClassVar[type[DriverSettings]] = SensorSettings
    Line: ClassVar[type[TableLine]] = _MeasuringLine


class Adapter(TableActuator):
    """A PyMeasure instrument that takes a set-point, and measures."""

    Settings: ClassVar[type[DriverSettings]] = ActuatorSettings
    Line: ClassVar[type[TableLine]] = _SwitchingLine
