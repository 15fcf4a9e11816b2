"""Instruments of the PyMeasure library in a role of the bench; needs the extra `pymeasure`.

    [devices.smu]
    driver = "pymeasure"                            # or "pymeasure-sensor", for one that only measures
    instrument = "pymeasure.instruments.keithley:Keithley2400"
    address = "GPIB0::24::INSTR"                    # a VISA resource
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
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import reduce
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, Field, ValidationInfo, field_validator

from bench.base import Clock, ConfigurationError, DeviceConnectionError, DeviceError, DeviceRestartedError, registry
from bench.devices import (
    ANY_TEXT,
    DriverSettings,
    Expected,
    GeneralActuator,
    GeneralSensor,
    Identity,
    Limits,
    Name,
    QuantityTable,
    Status,
    TargetTable,
    check_arrival,
    not_empty,
    template,
)
from drivers.device import LineDevice, attempt
from drivers.quantities import arrival_of, check_ranges, check_read_back, identity_of, output_lost, signals_of

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
        raise ValueError("needs PyMeasure; install it by: pip install 'actuator-bench[pymeasure]'")
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
    address: str | int = Field(
        description="VISA resource, such as GPIB0::24::INSTR or TCPIP0::192.0.2.5::5025::SOCKET"
    )
    options: dict[str, Any] = Field(
        default_factory=dict, description='keyword arguments of the class, such as { visa_library = "@py" }'
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


class InstrumentLine:
    """A connected PyMeasure instrument, whose errors are those of the bench.

    Attributes
    ----------
    lost : bool
        Whether a request has failed on the line. As a late answer could be taken for the next, it is opened again.
    """

    def __init__(self, device: str, instrument: Any) -> None:  # noqa: ANN401 - of an optional library
        self._device = device
        self.instrument = instrument
        self.lost = False

    def get(self, path: str) -> Any:  # noqa: ANN401 - of any type
        """Return a property."""
        with self._errors(f"reading {path}"):
            return _get(self.instrument, path)

    def number(self, path: str) -> float:
        """Return a property that is a number; raises `DeviceError` if it is none."""
        value = self.get(path)
        try:
            number = float(value)
        except (TypeError, ValueError):
            raise DeviceError(self._device, f"{path} is {value!r}, expected a number") from None
        if not abs(number) < _NOT_A_NUMBER:
            raise DeviceError(self._device, f"{path} is {number:g}; is it out of its range?")
        return number

    def set(self, path: str, value: float) -> None:
        """Set a property."""
        with self._errors(f"setting {path} to {value:g}"):
            _set(self.instrument, path, value)

    def act(self, text: str) -> None:
        """Carry out a call or an assignment."""
        with self._errors(text):
            parse_action(text)(self.instrument)

    def close(self) -> None:
        """Release the line; the instrument keeps its state."""
        with self._errors("closing"):
            self.instrument.adapter.close()

    @contextmanager
    def _errors(self, doing: str) -> Iterator[None]:
        try:
            yield
        # The library passes on the errors of each of its adapters, and those of its validators.
        except Exception as error:
            kind = DeviceConnectionError if _is_of_the_line(error) else DeviceError
            self.lost = self.lost or kind is DeviceConnectionError
            raise kind(self._device, f"{doing}: {type(error).__name__}: {error}") from None


def _is_of_the_line(error: Exception) -> bool:
    import pyvisa

    return isinstance(error, OSError | pyvisa.errors.Error)


class SensorAdapter(LineDevice[SensorSettings, InstrumentLine], GeneralSensor):
    """A PyMeasure instrument that measures: its signals are those of the rig file."""

    Settings: ClassVar[type[SensorSettings]] = SensorSettings

    def __init__(self, name: str, settings: SensorSettings, clock: Clock, line: InstrumentLine) -> None:
        unknown = Identity("unknown", settings.instrument.partition(":")[2], "unknown", "unknown")
        GeneralSensor.__init__(self, name, clock, unknown, signals_of(settings.signals))
        self._settings, self._line = settings, line

    @classmethod
    def _open_line(cls, name: str, settings: SensorSettings, clock: Clock) -> InstrumentLine:  # noqa: ARG003
        try:
            return InstrumentLine(name, instrument_class(settings.instrument)(settings.address, **settings.options))
        # Each class and each adapter fails in a way of its own.
        except Exception as error:
            raise DeviceConnectionError(
                name, f"cannot open {settings.address}: {type(error).__name__}: {error}"
            ) from None

    def _begin(self) -> None:
        """Open the line again if it was lost."""
        if self._line.lost:
            self.reconnect()

    def _check_unchanged(self) -> None:
        self._read_quantities()

    def _identify(self) -> Identity:
        settings = self._settings
        if not hasattr(type(self._line.instrument), "id"):
            return self._identity
        answer = str(self._line.get("id")).strip()
        if template(settings.identity).match(answer) is None:
            raise DeviceConnectionError(
                self.name, f"{settings.address} is {answer!r}, expected {settings.identity!r}; check the address"
            )
        return identity_of(answer)

    def _start(self) -> None:
        for action in self._settings.setup:
            self._line.act(action)

    def measure_quantities(self) -> dict[str, float]:
        """Measure every quantity."""
        self._begin()
        values = self._read_quantities()
        self._check_errors("measuring")
        return values

    def close(self) -> None:
        """Shut the instrument down, unless the settings say otherwise, and release the line."""
        try:
            if self._settings.shutdown:
                self._line.act("shutdown()")
        finally:
            super().close()

    def _read_quantities(self) -> dict[str, float]:
        tables = self._settings.signals
        values = {name: self._line.number(table.property) * table.scale for name, table in tables.items()}
        check_ranges(self.name, tables, values)
        return values

    def _check_errors(self, doing: str) -> None:
        if self._settings.check_errors:
            found = self._line.get("check_errors")()
            if found:
                raise DeviceError(self.name, f"reports after {doing}: {'; '.join(map(str, found))}")


class Adapter(SensorAdapter, GeneralActuator):
    """A PyMeasure instrument that takes a set-point, and measures its signals.

    `set` checks that the output is as it was left, sets the property and reads it back. It switches an output on that
    is off by `on`, after `setup` and `before_on` once more. `safe` carries out all of the key `safe`, over a line of
    its own if the one in use does not answer; it is confirmed by the property `output` where there is one. An output
    that is off without the bench is found by the next reading: a protection, or a restart if the set-point is lost
    as well, after which nothing is set.
    """

    Settings: ClassVar[type[SensorSettings]] = ActuatorSettings

    def __init__(self, name: str, settings: ActuatorSettings, clock: Clock, line: InstrumentLine) -> None:
        target = settings.setpoint
        limits = Limits(*target.limits, target.unit)
        GeneralActuator.__init__(
            self,
            name,
            clock,
            Identity("unknown", settings.instrument.partition(":")[2], "unknown", "unknown"),
            signals_of(settings.signals),
            limits,
            description=target.description,
            precision=target.precision,
        )
        self._settings, self._line = settings, line
        self._actuator_settings = settings
        self._on = False
        self._left = math.nan
        self._restart: DeviceRestartedError | None = None

    def send(self, value: float) -> Status:
        """Send a set-point that is within the limits, and switch the output on if it is off."""
        settings, was_on = self._actuator_settings, self._on
        target = settings.setpoint
        self._begin()
        self._check_output()
        for action in () if was_on else (*settings.setup, *settings.before_on):
            self._line.act(action)
        self._line.set(target.property, value / target.scale)
        if target.read_back:
            check_read_back(self.name, target, value, self._ask_setpoint())
        for action in () if was_on else settings.on:
            self._line.act(action)
        self._check_errors(f"set-point {value:g} {target.unit}")
        self._on, self._left = True, value
        if not was_on:
            self._check_output()
        return arrival_of(self.name, self._clock, target, value, self._read_quantities)

    def switch_off(self) -> None:
        """Carry out what reaches the safe state, over a fresh line if the one in use does not answer."""
        self._on = False
        # A lost line may take its whole time-out for each message.
        failures = [] if self._line.lost else self._try_off()
        if self._line.lost:
            try:
                self._renew_line()
            except DeviceError as error:
                failures = failures or [error]
            else:
                failures = self._try_off()
        if failures:
            raise DeviceError(
                self.name, f"does not confirm that its output is off ({failures[0]}); switch it off by hand"
            )

    def _try_off(self) -> list[DeviceError]:
        """Try everything that switches off; return what failed."""
        settings = self._actuator_settings
        failures = attempt(*(lambda action=action: self._line.act(action) for action in settings.safe))
        return failures or attempt(self._confirm_off)

    def _confirm_off(self) -> None:
        output = self._actuator_settings.output
        if output is not None and self._line.get(output):
            raise DeviceError(self.name, f"{output} is true")

    def _begin(self) -> None:
        if self._restart is not None:
            raise self._restart
        super()._begin()

    def _check_unchanged(self) -> None:
        self._check_output()
        if self._on:
            target = self._actuator_settings.setpoint
            if target.read_back:
                check_read_back(self.name, target, self._left, self._ask_setpoint())

    def _ask_setpoint(self) -> float:
        target = self._actuator_settings.setpoint
        return self._line.number(target.property) * target.scale

    def measure_quantities(self) -> dict[str, float]:
        """Measure every quantity, and check that the output is still on if it was switched on."""
        values = super().measure_quantities()
        self._check_output()
        return values

    def _check_output(self) -> None:
        """Raise if an output that was switched on is off, or the instrument has restarted before."""
        if self._restart is not None:
            raise self._restart
        settings = self._actuator_settings
        target = settings.setpoint
        if not self._on or settings.output is None or self._line.get(settings.output):
            return
        lost = target.read_back and abs(self._ask_setpoint() - self._left) > target.tolerance * (1.0 + 1e-9)
        problem = output_lost(self.name, setpoint_lost=lost)
        if isinstance(problem, DeviceRestartedError):
            self._restart = problem
        raise problem
