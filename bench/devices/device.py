"""The base classes of devices and their promises; the roles are in `bench.devices.roles`.

A protocol asks for slots, and a rig file binds them to devices. A driver (real wire) and an emulated instrument
implement the same role, and one contract test suite runs against both.

Promises of every device
------------------------
- Quantities are in SI units; temperatures are in degrees Celsius, as is usual in the field.
- The `measure` method takes the best reading that the instrument gives at rest, `glance` a quick one for
  watching. Both raise `DeviceError` if the instrument reports a fault, and never return a stale or an
  invalid number.
- `safe` brings the device into its safe state from any state; calling it again changes nothing.
  It tries everything that can make the device safer, and raises only after that.
- `stop` ends a motion and holds, `close` releases the line; neither replaces `safe`.
- An instrument that has restarted is found by the next reading, or by the next set-point before it is sent:
  `DeviceRestartedError`. Its limits and modes are lost, so nothing is sent to it but what makes it safe.
- An answer belongs to its question: a late, doubled or damaged one is discarded, and never taken for a reading.
- Methods may be called from one thread at a time.

Devices conform to `bluesky.protocols` by structure (`name`, `parent`, `read`, `describe`, `set`, `stop`),
so a bluesky RunEngine can drive them; nothing of bluesky is imported here.
"""

from __future__ import annotations

import math
import re
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import date
from typing import Any, ClassVar, Self, TypedDict

from pydantic import Field, model_validator

from bench.base import (
    CheckedTable,
    Clock,
    ConfigurationError,
    DeviceConnectionError,
    DeviceError,
    Display,
    LimitError,
)

_NO_SERIAL_NUMBER = re.compile(r"(|0+|none|unknown|id \d+)", re.IGNORECASE)
"""Serial numbers that tell no instrument from another: missing ones, and the address on a bus in the place of one."""


@dataclass(frozen=True)
class Identity:
    """Which instrument this is, as the instrument itself says; kept with every run."""

    maker: str
    model: str
    serial_number: str
    firmware: str

    @property
    def tells_serial_number(self) -> bool:
        """Whether the serial number tells the instrument from others of its kind."""
        return not _NO_SERIAL_NUMBER.fullmatch(self.serial_number.strip())

    def __str__(self) -> str:
        """Return the identity on one line."""
        return f"{self.maker} {self.model}, serial number {self.serial_number}, firmware {self.firmware}"


@dataclass(frozen=True)
class Signal:
    """One measured quantity of a device or of the rig.

    Attributes
    ----------
    name : str
        Unique within the rig, such as `plate_temperature`.
    unit : str
        Unit of the values, such as `°C`, `A`, `1/m`; `1` for a plain number.
    description : str
        What it is, in a few words, for axes and column headers.
    precision : int
        Digits after the point that are worth showing.
    accuracy : float or None
        Standard uncertainty against a reference, in its unit, of a signal that was calibrated; None if that is not
        known.
    extent : float or None
        Greatest magnitude that the limits and interlocks of its rig allow, in its unit; None if that is not known.
    """

    name: str
    unit: str
    description: str
    precision: int = 3
    accuracy: float | None = None
    extent: float | None = None

    @property
    def display(self) -> Display:
        """How its values are shown, in every table, figure and view."""
        return Display.of(self.unit, self.precision, self.extent)


RESERVED_NAMES = (
    "step",
    "started",
    "finished",
    "phase",
    "label",
    "settled",
    "setpoints",
    "seen",
    "tick",
    "t",
    "checksum",
)
"""Columns that a table of readings has beside the signals; see `bench.record`."""


def check_signal_names(names: Sequence[str]) -> None:
    """Check that the names of signals can be columns of one table.

    Raises ConfigurationError if two have one name, or one is in `RESERVED_NAMES`; case does not
    count.
    """
    seen = dict.fromkeys(RESERVED_NAMES, "is the name of a column of the journal")
    for name in names:
        if "\0" in name:
            raise ConfigurationError(f"signal {name!r}: a name may not have a null character")
        if (folded := name.lower()) in seen:
            raise ConfigurationError(f"signal {name!r}: {seen[folded]}; choose another")
        seen[folded] = "is the name of two signals (case does not count)"


@dataclass(frozen=True)
class Limits:
    """A closed range of allowed values.

    Raises
    ------
    ValueError
        If the range is empty or a bound is not a number.
    """

    low: float
    high: float
    unit: str

    def __post_init__(self) -> None:
        if not self.low <= self.high:
            raise ValueError(f"limits: expected low ≤ high, got {self.low} and {self.high} {self.unit}")

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high

    def __str__(self) -> str:
        """Return the range with its unit."""
        return f"{self.low:g} to {self.high:g} {self.unit}"


@dataclass(frozen=True)
class CheckFinding:
    """What a check of an instrument found.

    Attributes
    ----------
    subject : str
        What was looked at, in a word or two, such as `watchdog`.
    text : str
        What was found, with numbers and units.
    advice : str
        What to do; empty if all is well.
    """

    subject: str
    text: str
    advice: str = ""


class BlueskyReading(TypedDict):
    """One value in the form of `bluesky.protocols.Reading`; the timestamp is seconds since 1970 UTC."""

    value: float
    timestamp: float


class DataKey(TypedDict):
    """Description of a value in the form of event-model's `DataKey`."""

    source: str
    dtype: str
    shape: list[int]
    units: str
    precision: int


class Status:
    """How far a commanded change has come; conforms to `bluesky.protocols.Status`.

    Parameters
    ----------
    device : str
        Name of the device, for messages.
    clock : Clock
        The clock on which the change happens.
    arrived : callable
        Asks the device once, and returns True when the change is complete. May raise `DeviceError`.
    timeout : float
        Seconds after which the change has failed.
    interval : float
        Seconds between two questions while `wait` waits.
    """

    def __init__(
        self,
        device: str,
        clock: Clock,
        arrived: Callable[[], bool],
        *,
        timeout: float = 60.0,
        interval: float = 0.1,
    ) -> None:
        self._device = device
        self._clock = clock
        self._arrived = arrived
        self._deadline = clock.now() + timeout
        self._timeout = timeout
        self._interval = interval
        self._lock = threading.RLock()
        self._callbacks: list[Callable[[Any], None]] = []
        self._done = False
        self._exception: Exception | None = None
        self._watcher: threading.Thread | None = None

    @classmethod
    def completed(cls, device: str, clock: Clock) -> Status:
        """Return a status that is complete already."""
        status = cls(device, clock, lambda: True)
        status._done = True
        return status

    @property
    def device(self) -> str:
        """Name of the device."""
        return self._device

    @property
    def done(self) -> bool:
        """Whether the change has ended, well or not."""
        return self._done

    @property
    def success(self) -> bool:
        """Whether the change has ended well."""
        return self._done and self._exception is None

    def exception(self, timeout: float | None = 0.0) -> BaseException | None:  # noqa: ARG002 - bluesky's form
        """Return what went wrong, or None."""
        return self._exception

    def update(self) -> bool:
        """Ask the device once; return `done`."""
        try:
            return self.ask()
        except DeviceConnectionError as error:
            with self._lock:
                if not self._done:
                    self._finish(error)
            return True

    def ask(self) -> bool:
        """Ask the device once; return `done`.

        Raises DeviceConnectionError if it cannot be reached; it may be asked again once its line is back.
        """
        with self._lock:
            if self._done:
                return True
            try:
                arrived = self._arrived()
            except DeviceConnectionError:
                raise
            # Every waiting thread must receive the exception.
            except Exception as error:
                self._finish(error)
            else:
                if arrived:
                    self._finish(None)
                elif self._clock.now() >= self._deadline:
                    self._finish(DeviceError(self._device, f"did not arrive within {self._timeout:g} s"))
            return self._done

    def wait(self) -> None:
        """Let time pass until the change is complete.

        Raises DeviceError if the change failed or took longer than its timeout.
        """
        while not self.update():
            self._clock.sleep(self._interval)
        if self._exception is not None:
            raise self._exception

    def add_callback(self, callback: Callable[[Any], None]) -> None:
        """Have `callback(status)` called once at the end.

        The bench itself polls by `update` or `wait`. A caller that waits by callback, as a bluesky RunEngine does,
        gets a thread that asks for it.
        """
        with self._lock:
            if not self._done:
                self._callbacks.append(callback)
                if self._watcher is None:
                    self._watcher = threading.Thread(target=self._watch, name=self._device, daemon=True)
                    self._watcher.start()
                return
        callback(self)

    def _watch(self) -> None:
        while not self.update():
            self._clock.sleep(self._interval)

    def _finish(self, exception: Exception | None) -> None:
        self._exception = exception
        self._done = True
        callbacks, self._callbacks = self._callbacks, []
        with ExitStack() as stack:
            # Each is called, also after one that raises.
            for callback in reversed(callbacks):
                stack.callback(callback, self)


class DriverSettings(CheckedTable):
    """What a rig file says of one device; every driver extends it with its own keys.

    A driver class carries its extension as `Settings`, and opens its instrument by the class method
    `connect(name, settings, clock)`, which checks that the right instrument answers, configures it and
    moves nothing. An unknown key is an error.

    One whose instrument may share a line with others has a field `line`, and says what has to be checked of it.

    Attributes
    ----------
    address_key : str
        Key of the address that tells the instrument from others on its line; empty if it needs a line of its own.
    keys_of_line : frozenset of str
        Keys that have one value for all devices of a line.
    """

    address_key: ClassVar[str] = ""
    keys_of_line: ClassVar[frozenset[str]] = frozenset()

    serial_number: str = Field(
        default="",
        coerce_numbers_to_str=True,
        description="serial number of the instrument, as it says it itself; another instrument is refused",
    )
    model: str = Field(
        default="", description="model of the instrument, as it says it itself; another one is refused"
    )
    calibrated: date | None = Field(default=None, description="day of the last calibration, such as 2026-03-01")
    calibration_due: date | None = Field(default=None, description="day from which a new calibration is due")

    @property
    def longest_turn(self) -> float:
        """Longest time that a request and its repetitions keep the line while nothing answers, s."""
        return 0.0

    @model_validator(mode="after")
    def _dates_in_order(self) -> Self:
        if self.calibrated and self.calibration_due and self.calibration_due <= self.calibrated:
            raise ValueError(
                f"calibration_due: expected a day after {self.calibrated}, that of the calibration, got "
                f"{self.calibration_due}"
            )
        return self


class Device(ABC):
    """Anything on the bench that can be read.

    Parameters
    ----------
    name : str
        Name in the rig; its signals are named after it.
    clock : Clock
        The clock of the run.
    """

    def __init__(self, name: str, clock: Clock) -> None:
        self._name = name
        self._clock = clock

    @property
    def name(self) -> str:
        """Name in the rig."""
        return self._name

    @property
    def parent(self) -> None:
        """Always None: devices of the bench are not nested (bluesky asks)."""
        return

    @property
    def hints(self) -> dict[str, list[str]]:
        """What a live table shows of this device (bluesky asks): its first signal."""
        return {"fields": [self.signals[0].name]}

    @property
    @abstractmethod
    def identity(self) -> Identity:
        """Maker, model, serial number and firmware, as the instrument said when it was connected."""

    @property
    @abstractmethod
    def signals(self) -> tuple[Signal, ...]:
        """What `measure` and `glance` deliver, in this order."""

    @abstractmethod
    def measure(self) -> dict[str, float]:
        """Measure every signal as well as the instrument can; values by signal name.

        Raises DeviceError if the instrument reports a fault, is out of its range, or does not answer.
        """

    def glance(self) -> dict[str, float]:
        """Measure every signal quickly, for telemetry and interlocks; values by signal name."""
        return self.measure()

    def read(self) -> dict[str, BlueskyReading]:
        """Measure every signal; values with time stamps, as bluesky has them."""
        values = self.measure()
        timestamp = self._clock.timestamp()
        return {name: {"value": value, "timestamp": timestamp} for name, value in values.items()}

    def trigger(self) -> Status:
        """Return a completed status: `read` measures by itself (bluesky asks)."""
        return Status.completed(self.name, self._clock)

    def describe(self) -> dict[str, DataKey]:
        """Describe what `read` returns, in the form that bluesky expects."""
        source = f"{self.identity.model}:{self.identity.serial_number}"
        return {
            signal.name: {
                "source": f"{source}:{signal.name}",
                "dtype": "number",
                "shape": [],
                "units": signal.unit,
                "precision": signal.precision,
            }
            for signal in self.signals
        }

    @property
    def reading_limits(self) -> Mapping[str, Limits]:
        """Ranges beyond which a reading is an error, by signal name; signals without one are left out."""
        return {}

    @property
    def watchdog(self) -> float | None:
        """Silence of the host, s, after which the instrument itself goes to its safe state; None if it never does."""
        return None

    @property
    def safe_within(self) -> float:
        """Longest time that `safe` takes on a line that works, s."""
        return 1.0

    @property
    def repeats(self) -> int:
        """Number of requests that were repeated since the device was connected, as their answers were lost."""
        return 0

    @property
    def requests(self) -> int:
        """Number of messages sent since the device was connected, on a line that it shares; 0 on one of its own."""
        return 0

    def self_check(self) -> tuple[CheckFinding, ...]:
        """Compare what the instrument itself says with the settings; nothing moves, and nothing is changed.

        Raises DeviceError if the instrument does not answer.
        """
        return ()

    def reconnect(self) -> None:
        """Open the line again after it was lost, and check that the instrument is as it was left.

        Nothing is configured and nothing moves. One attempt takes 1 s at most.

        Raises
        ------
        DeviceConnectionError
            If the line cannot be opened or nothing answers; it may be tried again.
        DeviceRestartedError
            If the instrument has restarted.
        DeviceError
            If another instrument answers, it reports an error, or its set-point is not the one that was sent; also
            of a device that has no line to open.
        """
        raise DeviceError(self.name, "its driver cannot open the line again")

    def stop(self, success: bool = True) -> None:  # noqa: B027 - bluesky's form; sensors do not move
        """End a motion where it is and hold; does nothing to a device that only measures."""

    @abstractmethod
    def safe(self) -> None:
        """Bring the device into its safe state; what that is, each role says.

        Raises DeviceError if the safe state could not be confirmed, after everything was tried.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the line; the device keeps the state that it is in."""


class Actuator(Device):
    """A device that takes a set-point.

    Attributes
    ----------
    heats : bool
        Whether its output heats, so that it may not be left on without a watchdog and an interlock.
    """

    heats: ClassVar[bool] = False

    @property
    @abstractmethod
    def limits(self) -> Limits:
        """The set-points that are allowed now."""

    @property
    @abstractmethod
    def setpoint(self) -> float:
        """The set-point that was last sent, in the unit of `limits`; nan before the first."""

    @property
    @abstractmethod
    def setpoint_signal(self) -> Signal:
        """What the set-point is, for axes and columns: its name is that of the device and `_setpoint`."""

    @abstractmethod
    def set(self, value: float) -> Status:
        """Send a set-point, and switch the output on if it is off.

        Parameters
        ----------
        value : float
            In the unit of `limits`.

        Returns
        -------
        Status
            Completes when the device has arrived, as far as it can tell.

        Raises
        ------
        LimitError
            If the value is outside of `limits`; nothing is sent.
        DeviceError
            If the device refuses.
        """

    def check(self, value: float) -> None:
        """Raise `LimitError` if `set` would not take `value`."""
        limits = self.limits
        if not (limits.low <= value <= limits.high and math.isfinite(value)):
            raise LimitError(self.name, f"set-point {value:g} {limits.unit} is outside of {limits}")


@dataclass(frozen=True)
class DeviceDescription:
    """What can be known of a connected device without asking it again, also where another process holds it.

    Attributes
    ----------
    name : str
        Name in the rig.
    kind : type
        Its class.
    identity : Identity
        Which instrument it is.
    signals : tuple of Signal
        What it delivers.
    setpoint_signal : Signal or None
        What its set-point is; None of a device that takes none.
    limits : Limits or None
        The set-points that it takes.
    watchdog : float or None
        Silence of the host after which the instrument goes to its safe state by itself, s.
    safe_within : float
        Longest time that its safe state takes, s.
    reading_limits : mapping of str to Limits
        Ranges beyond which a reading is an error, by signal.
    """

    name: str
    kind: type[Device]
    identity: Identity
    signals: tuple[Signal, ...]
    setpoint_signal: Signal | None
    limits: Limits | None
    watchdog: float | None
    safe_within: float
    reading_limits: Mapping[str, Limits] = field(default_factory=dict)

    @classmethod
    def of(cls, device: Device) -> DeviceDescription:
        """Describe a connected device."""
        actuator = device if isinstance(device, Actuator) else None
        return cls(
            name=device.name,
            kind=type(device),
            identity=device.identity,
            signals=device.signals,
            setpoint_signal=actuator.setpoint_signal if actuator else None,
            limits=actuator.limits if actuator else None,
            watchdog=device.watchdog,
            safe_within=device.safe_within,
            reading_limits=device.reading_limits,
        )
