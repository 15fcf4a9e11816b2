"""Devices that a table describes: what they measure, what they are set to, and how their output is switched.

The table stands in a rig file, or as rows in a class, with the same keys::

    class LoadFrame(SCPIActuator, identity="LF-1,{any}", output={"on": ["PULL"], "off": ["LOOSE"], "query": "PULL?"}):
        force = Reading("FORCE?", "N", (-1.0, 50.0), "force in the specimen")
        pull = Setpoint("PULL {value:.2f}", "N", (0.0, 40.0), "force to hold", query="PULL?")

Which messages or registers that means is up to the line: `TableLine` and `SwitchedLine`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Self, TypeVar, cast, overload

from pydantic import Field, create_model, model_validator

from bench.base import Clock, DeviceConnectionError, DeviceError, DeviceRestartedError
from bench.devices import (
    DriverSettings,
    GeneralActuator,
    GeneralSensor,
    Identity,
    Limits,
    QuantityTable,
    Status,
    TargetTable,
)
from drivers.device import LineDevice, attempt, refuse_hiding
from drivers.quantities import arrival_of, check_ranges, check_read_back, output_lost, signals_of

_UNKNOWN = Identity("unknown", "unknown", "unknown", "unknown")


class TableLine(ABC):
    """The line to an instrument that a table describes.

    Attributes
    ----------
    source, target_source : str
        Key of a table that says where the instrument has a quantity and a set-point, such as `query` and `command`.
    tables : mapping of str to QuantityTable
        What is measured, by name.
    lost : bool
        Whether the line itself failed, so that it has to be opened again.
    repeats : int
        Number of requests that were repeated.
    """

    source: ClassVar[str]
    target_source: ClassVar[str]
    lost = False
    repeats = 0

    def __init__(self, device: str, tables: Mapping[str, QuantityTable]) -> None:
        self._device = device
        self.tables = tables

    @abstractmethod
    def identify(self) -> Identity:
        """Return which instrument answers.

        Raises `DeviceConnectionError` if it is none of the kind that the table describes.
        """

    def start(self) -> None:  # noqa: B027 - many need no set-up
        """Configure the instrument."""

    @abstractmethod
    def quantities(self, names: Iterable[str]) -> dict[str, float]:
        """Ask for quantities, in the unit of their tables."""

    def errors(self) -> list[str]:
        """Return the errors that the instrument has kept, oldest first, and have it forget them."""
        return []

    def raise_errors(self, doing: str) -> None:
        """Raise one `DeviceError` with all errors that the instrument has kept, if there are any."""
        found = self.errors()
        if found:
            raise DeviceError(self._device, f"reports after {doing}: {'; '.join(found)}")

    def shut_down(self) -> None:  # noqa: B027 - most need nothing
        """Do what the instrument needs before its line is released for good."""

    @abstractmethod
    def close(self) -> None:
        """Release the line."""


class SwitchedLine(TableLine):
    """The line to an instrument with a set-point and an output.

    Attributes
    ----------
    target : TargetTable
        What is set.
    off_changes_setpoint : bool
        Whether the instrument has another set-point after it was switched off.
    safe_within : float
        Longest time that switching off takes, s.
    """

    off_changes_setpoint = True
    safe_within = 1.0

    def __init__(self, device: str, tables: Mapping[str, QuantityTable], target: TargetTable) -> None:
        super().__init__(device, tables)
        self.target = target

    @abstractmethod
    def write_setpoint(self, value: float) -> None:
        """Send a set-point, in the unit of its table."""

    def written(self, value: float) -> float:
        """Return a set-point as the instrument is told it, with as many digits."""
        return value

    @abstractmethod
    def read_setpoint(self) -> float | None:
        """Return the set-point that the instrument has; None if it cannot be asked for."""

    def prepare(self) -> None:
        """Do what precedes the set-point with which the output goes on."""

    @abstractmethod
    def switch_on(self) -> None:
        """Switch the output on."""

    @abstractmethod
    def try_off(self, *, fresh: bool) -> list[DeviceError]:
        """Try everything that switches off, and have it confirmed; return what failed.

        A line that is `fresh` was opened for this.
        """

    @abstractmethod
    def reads_on(self) -> bool | None:
        """Return whether the output is on; None if it cannot be asked for."""


class Row:
    """A row of the table of a class.

    Parameters
    ----------
    source : str or int
        Where the instrument has it: a message, or the address of a register.
    unit : str
        Its unit on the bench.
    limits : tuple of float, optional
        Readings that are good, or set-points that are allowed.
    description : str
        A few words for axes and columns.
    keys
        Further keys of its table.
    """

    def __init__(
        self, source: str | int, unit: str, limits: tuple[float, float] | None, description: str, **keys: object
    ) -> None:
        self._source = source
        self._keys = {"unit": unit, "limits": limits, "description": description, **keys}
        self.__doc__ = f"{description[:1].upper()}{description[1:]}, {unit}."

    def __set_name__(self, owner: type, name: str) -> None:
        refuse_hiding(owner, name, Row)
        self._name = name

    def table(self, source: str) -> dict[str, object]:
        """Return the keys of the row, with the name of the key that its source has."""
        return {source: self._source, **self._keys}


class Reading(Row):
    """A quantity that the device measures. As an attribute of the device it is the present reading."""

    @overload
    def __get__(self, device: None, owner: object = None) -> Self: ...

    @overload
    def __get__(self, device: TableSensor[Any], owner: object = None) -> float: ...

    def __get__(self, device: TableSensor[Any] | None, owner: object = None) -> float | Self:
        return self if device is None else device.quantity(self._name)


class Setpoint(Row):
    """What the device is set to. Its attribute is the set-point as the instrument has it; assigning one sends it."""

    @overload
    def __get__(self, device: None, owner: object = None) -> Self: ...

    @overload
    def __get__(self, device: TableActuator, owner: object = None) -> float: ...

    def __get__(self, device: TableActuator | None, owner: object = None) -> float | Self:
        return self if device is None else device.read_setpoint()

    def __set__(self, device: TableActuator, value: float) -> None:
        device.set(value)


LineT = TypeVar("LineT", bound=TableLine)


class TableSensor(LineDevice[Any, LineT], GeneralSensor):
    """A device that measures what its table says.

    A class with rows has them as defaults of its `Settings`; further keys of the settings are given defaults as
    keyword arguments of the class. A rig file may give other values for single keys. `measure` also reads the errors
    that the instrument has kept, `glance` does not. A call after the line was lost opens it again.
    """

    Settings: ClassVar[type[DriverSettings]]
    Line: ClassVar[type[TableLine]]

    def __init_subclass__(cls, **defaults: object) -> None:
        super().__init_subclass__()
        rows = {
            name: row for base in reversed(cls.__mro__) for name, row in vars(base).items() if isinstance(row, Row)
        }
        signals = {name: row.table(cls.Line.source) for name, row in rows.items() if isinstance(row, Reading)}
        targets = [row.table(cls.Line.target_source) for row in rows.values() if isinstance(row, Setpoint)]
        if len(targets) > 1:
            raise TypeError(f"{cls.__name__} has {len(targets)} set-points; a device has one, more are more devices")
        if signals:
            defaults["signals"] = signals
        if targets:
            defaults["setpoint"] = targets[0]
        if defaults:
            cls.Settings = _with_defaults(cls, defaults)

    def __init__(self, name: str, settings: DriverSettings, clock: Clock, line: LineT) -> None:
        GeneralSensor.__init__(self, name, clock, _UNKNOWN, signals_of(line.tables))
        self._settings, self._line = settings, line

    @classmethod
    def _open_line(cls, name: str, settings: Any, clock: Clock) -> LineT:  # noqa: ANN401 - each line has its own
        make = cast("Any", cls.Line)
        line: LineT = make(name, settings, clock)
        return line

    def _identify(self) -> Identity:
        return self._line.identify()

    def _start(self) -> None:
        self._line.start()

    @property
    def reading_limits(self) -> Mapping[str, Limits]:
        """Ranges beyond which a reading is an error, by signal name: the limits of the tables."""
        return {
            f"{self.name}_{name}": Limits(*table.limits, table.unit)
            for name, table in self._line.tables.items()
            if table.limits is not None
        }

    def quantity(self, name: str) -> float:
        """Measure one quantity, by its name without that of the device; raises as `measure` does."""
        self._begin()
        value = self._ask([name])[name]
        self._check_output()
        return value

    def measure_quantities(self) -> dict[str, float]:
        """Measure every quantity, and read the errors that the instrument has kept."""
        self._begin()
        values = self._ask(self._line.tables)
        self._check_in_use()
        self._line.raise_errors("measuring")
        return values

    def glance(self) -> dict[str, float]:
        """Measure every signal, without a look at the errors that were kept; values by signal name."""
        self._begin()
        values = self._ask(self._line.tables)
        self._check_output()
        return {f"{self.name}_{name}": value for name, value in values.items()}

    def close(self) -> None:
        """Release the line; an output that is on stays on, unless the instrument is shut down on closing."""
        try:
            self._line.shut_down()
        finally:
            super().close()

    def _check_in_use(self) -> None:
        """Raise `DeviceError` unless output and set-point are as they were left; a sensor has none."""

    def _check_output(self) -> None:
        """Raise `DeviceError` unless the output is as it was left; a sensor has none."""

    def _check_unchanged(self) -> None:
        self._ask(self._line.tables)

    def _ask(self, names: Iterable[str]) -> dict[str, float]:
        tables = {name: self._line.tables[name] for name in names}
        values = self._line.quantities(tables)
        for name, value in values.items():
            if not math.isfinite(value):
                raise DeviceError(self.name, f"{name} is {value}, no number; check instrument and wiring")
        check_ranges(self.name, tables, values)
        return values


class TableActuator(TableSensor[SwitchedLine], GeneralActuator):
    """A device that takes a set-point, and measures what its table says.

    `set` checks that the output is as it was left, sends the set-point, reads it back, and reads the errors that the
    instrument has kept. It switches an output on that is off, after everything that precedes that once more. A
    reading finds an output that is off or a set-point that has changed without the bench: a protection, or a restart
    if both are lost, after which nothing is set. `safe` tries everything that switches off and has it confirmed, over
    a line of its own if the one in use does not answer. There is no watchdog: what was set stays when the bench dies.
    """

    def __init__(self, name: str, settings: DriverSettings, clock: Clock, line: SwitchedLine) -> None:
        target = line.target
        GeneralActuator.__init__(
            self,
            name,
            clock,
            _UNKNOWN,
            signals_of(line.tables),
            Limits(*target.limits, target.unit),
            description=target.description,
            precision=target.precision,
        )
        self._settings, self._line = settings, line
        self._on = False
        self._left = math.nan
        self._restart: DeviceRestartedError | None = None

    @property
    def safe_within(self) -> float:
        """Longest time of `safe` on a line that works, s."""
        return self._line.safe_within

    def read_setpoint(self) -> float:
        """Return the set-point that the instrument has; the one that was sent last if it cannot be asked for."""
        self._begin()
        found = self._line.read_setpoint()
        self._check_output()
        return self._setpoint if found is None else found

    def send(self, value: float) -> Status:
        """Send a set-point that is within the limits, and switch the output on if it is off."""
        self._begin()
        line, was_on = self._line, self._on
        self._check_output()
        if not was_on:
            self._check_left()
            line.prepare()
        self._left = math.nan
        line.write_setpoint(value)
        self._check_setpoint(value)
        self._left = value
        if not was_on:
            line.switch_on()
        line.raise_errors(f"set-point {value:g} {line.target.unit}")
        self._on = True
        if not was_on:
            self._check_output()
        return arrival_of(self.name, self._clock, line.target, value, lambda: self._ask(line.tables))

    def switch_off(self) -> None:
        """Try everything that switches off, and have it confirmed.

        A line that does not answer, or did not before, is opened again, and everything is tried once more.
        """
        self._on = False
        if self._line.off_changes_setpoint:
            self._left = math.nan
        failures = self._line.try_off(fresh=False)
        if any(isinstance(failure, DeviceConnectionError) for failure in failures):
            more = attempt(self._renew_line) or self._line.try_off(fresh=True)
            failures = [*failures, *more] if more else []
        if failures:
            said = "; ".join(map(str, failures))
            raise DeviceError(self.name, f"does not confirm that its output is off ({said}); switch it off by hand")

    def _begin(self) -> None:
        if self._restart is not None:
            raise self._restart
        super()._begin()

    def _check_in_use(self) -> None:
        if self._on and not math.isnan(self._setpoint):
            self._check_output()
            self._check_setpoint(self._setpoint)

    def _check_unchanged(self) -> None:
        if self._restart is not None:
            raise self._restart
        self._check_output()
        if not math.isnan(self._left):
            self._check_setpoint(self._left)

    def _check_setpoint(self, value: float) -> None:
        """Raise `DeviceError` unless the instrument reads a set-point back as it was written."""
        line = self._line
        found, written = line.read_setpoint(), line.written(value)
        if found is not None:
            wrong = abs(found - written) > line.target.tolerance
            check_read_back(self.name, line.target, written, found, "; ".join(line.errors()) if wrong else "")

    def _check_output(self) -> None:
        """Raise `DeviceError` if an output that was switched on is off without the bench."""
        if not self._on:
            return
        # One that has lost its set-point as well has restarted; if it cannot be asked for, that alone is looked at.
        is_on = self._line.reads_on()
        if is_on is None:
            self._check_left()
        elif not is_on:
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
                f"does not have the set-point {self._left:g} {self._line.target.unit} any more: it has restarted, or "
                "was set by another program or by hand; connect again",
            )
            raise self._restart

    def _has_lost_setpoint(self) -> bool:
        """Return whether the instrument has another set-point than was sent, as far as that can be asked."""
        if math.isnan(self._left):
            return False
        found = self._line.read_setpoint()
        tolerance = self._line.target.tolerance * (1.0 + 1e-9)
        return found is not None and not abs(found - self._line.written(self._left)) <= tolerance


def _with_defaults(device: type[TableSensor[Any]], defaults: Mapping[str, object]) -> type[DriverSettings]:
    """Return the settings of a device with defaults of its own; raise `TypeError` for a key that they do not have."""
    base = device.Settings
    fields: dict[str, Any] = {}
    for key, value in defaults.items():
        if key not in base.model_fields:
            raise TypeError(
                f"{device.__name__}: {key!r} is no key of its settings; allowed: {', '.join(base.model_fields)}"
            )
        known = base.model_fields[key]
        field = Field(default=value, validate_default=True, description=known.description)
        fields[key] = (known.rebuild_annotation(), field)
    fill = model_validator(mode="before")(lambda given: _merged(defaults, given))
    settings = create_model(
        "Settings",
        __base__=base,
        __module__=device.__module__,
        __doc__=base.__doc__,
        __validators__={"fill": cast("Any", fill)},
        **fields,
    )
    settings.__qualname__ = f"{device.__qualname__}.Settings"
    return settings


def _merged(defaults: object, given: object) -> object:
    """Return tables with the keys that are given, and the defaults of those that are not."""
    if not (isinstance(defaults, Mapping) and isinstance(given, Mapping)):
        return given
    return {**defaults, **{key: _merged(defaults.get(key), value) for key, value in given.items()}}
