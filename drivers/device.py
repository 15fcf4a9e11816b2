"""Devices that own their line: opening it, checking the identity of the instrument, and releasing it."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Annotated, Any, Generic, Protocol, Self, TypeVar

from pydantic import AfterValidator, Field

from bench.base import Clock, DeviceConnectionError, DeviceError
from bench.devices import Actuator, Device, DriverSettings, Identity

STATUS_AGE = 0.1
"""Time after which `set` looks at the status of its instrument again, s: a fast loop sets more often than that."""

_START_POLL = 0.1  # s


def _check_slope(value: float) -> float:
    if value == 0:
        raise ValueError("must be a number other than 0")
    return value


Slope = Annotated[float, AfterValidator(_check_slope)]
"""A setting by which a driver divides: any number but 0."""


def watchdog_field(default: float, longest: float, effect: str) -> Any:  # noqa: ANN401 - as pydantic's Field
    """Return the setting of an instrument's watchdog for its host, s; `effect` says what it does."""
    return Field(
        default=default,
        ge=0.0,
        le=longest,
        description=f"silence of the host after which {effect}; must exceed the longest pause between two readings, "
        "which is 2 s in a long hold",
    )


class Line(Protocol):
    """A connection to an instrument.

    One that knows them has attributes more: `lost`, whether it failed and has to be opened again; `repeats`, the
    number of requests that were repeated; `resends`, how often a request is sent again at most, which is 0 after one
    without an answer, until the next answer; and `port`, which counts the `requests` if it is shared.
    """

    def close(self) -> None:
        """Release the line."""


SettingsT = TypeVar("SettingsT", bound=DriverSettings)
LineT = TypeVar("LineT", bound=Line)


class LineDevice(Device, Generic[SettingsT, LineT]):
    """A device at the end of a line of its own.

    Made by `connect`. A driver implements how its line is opened (`_open_line`), which instrument is there
    (`_identify`), and how it is checked and configured (`_start`).

    Parameters
    ----------
    settings : DriverSettings
        The device's part of the rig file; each driver has its own, as `Settings`.
    """

    _identity: Identity
    _earlier_repeats = 0
    _earlier_requests = 0
    _closed = False

    def __init__(self, name: str, settings: SettingsT, clock: Clock, line: LineT) -> None:
        super().__init__(name, clock)
        self._settings = settings
        self._line = line

    @classmethod
    def connect(cls, name: str, settings: SettingsT, clock: Clock) -> Self:
        """Open the line, check that the right instrument answers and is healthy, and configure it; nothing moves.

        Raises
        ------
        DeviceConnectionError
            If the line cannot be opened, nothing answers, or another instrument does.
        DeviceError
            If the instrument reports an error, or does not take a setting.
        ConfigurationError
            If the instrument does not allow a value of the settings; nothing was saved in it then.
        """
        return cls._open(name, settings, clock, cls._start)

    @classmethod
    def identify_at(cls, name: str, settings: SettingsT, clock: Clock) -> Identity:
        """Return which instrument answers at the line of the settings; it is asked once, and the line is released.

        Raises
        ------
        DeviceConnectionError
            If the line cannot be opened, nothing answers, or another kind of instrument does.
        DeviceError
            If it reports an error.
        """
        line: Any = cls._open_line(name, settings, clock)
        line.resends = 0
        try:
            return cls(name, settings, clock, line)._identify()
        finally:
            line.close()

    @classmethod
    def _open(cls, name: str, settings: SettingsT, clock: Clock, start: Callable[[Self], None]) -> Self:
        line = cls._open_line(name, settings, clock)
        try:
            device = cls(name, settings, clock, line)
            device._identity = device._identify()
            device._check_identity()
            start(device)
        except BaseException:
            line.close()
            raise
        return device

    @classmethod
    @abstractmethod
    def _open_line(cls, name: str, settings: SettingsT, clock: Clock) -> LineT: ...

    @abstractmethod
    def _identify(self) -> Identity: ...

    @abstractmethod
    def _start(self) -> None: ...

    def _check_identity(self) -> None:
        """Raise `DeviceConnectionError` unless model and serial number are those of the settings, to the letter."""
        found, settings = self._identity, self._settings
        if settings.serial_number and not found.tells_serial_number:
            raise DeviceConnectionError(
                self.name,
                f"is {found.maker} {found.model}, which does not tell its serial number; leave out the key "
                f"serial_number = {settings.serial_number!r}",
            )
        for key, value, wanted in (
            ("model", found.model, settings.model),
            ("serial number", found.serial_number, settings.serial_number),
        ):
            if wanted and value.strip() != wanted.strip():
                raise DeviceConnectionError(
                    self.name, f"is {found}, expected {key} {wanted.strip()}; the ports may be swapped"
                )

    @property
    def identity(self) -> Identity:
        """Maker, model, serial number and firmware, as the instrument reported on connecting."""
        return self._identity

    @classmethod
    def rescue(cls, name: str, settings: SettingsT, clock: Clock) -> None:
        """Open the line of an instrument in any state, bring it into its safe state, and release the line.

        Which instrument answers is not checked, and nothing is configured.

        Raises
        ------
        DeviceConnectionError
            If the line cannot be opened.
        DeviceError
            If the safe state could not be confirmed, after everything was tried.
        """
        line = cls._open_line(name, settings, clock)
        device = cls(name, settings, clock, line)
        try:
            device.safe()
        finally:
            device.close()

    def reconnect(self) -> None:
        """Open the line again after it was lost, and check that the instrument is as it was left.

        Errors are those of `Device.reconnect`.
        """
        self._renew_line()
        found = self._identify()
        if (found.model, found.serial_number) != (self._identity.model, self._identity.serial_number):
            raise DeviceError(self.name, f"is another instrument now: {found}; it was {self._identity}")
        self._check_unchanged()

    def _renew_line(self) -> None:
        """Close the line, and open another to the same address."""
        repeats, requests = self.repeats, self.requests
        self._line.close()
        line: Any = self._open_line(self.name, self._settings, self._clock)
        # Until something answers, each request is sent once, as others wait for the line.
        line.resends = 0
        self._line = line
        self._earlier_repeats, self._earlier_requests, self._closed = repeats, requests, False

    def _begin(self) -> None:
        """Open the line again if it was lost."""
        if getattr(self._line, "lost", False) and not self._closed:
            self.reconnect()

    @property
    def repeats(self) -> int:
        """Number of requests that were repeated since the device was connected, as their answers were lost."""
        return self._earlier_repeats + getattr(self._line, "repeats", 0)

    @property
    def requests(self) -> int:
        """Number of messages sent since the device was connected, on a line that it shares; 0 on one of its own."""
        return self._earlier_requests + getattr(getattr(self._line, "port", None), "requests", 0)

    def _check_unchanged(self) -> None:
        """Raise `DeviceError` unless the instrument is as the driver left it: not restarted, without an error."""
        self.glance()

    def _check_range(self, text: str, value: float, limits: tuple[float, float], unit: str, advice: str) -> None:
        """Raise `DeviceError` if a value is outside of its limits; `text` and `advice` begin and end the message."""
        low, high = limits
        if not low <= value <= high:
            raise DeviceError(self.name, f"{text} {low:g} to {high:g} {unit}; {advice}")

    def close(self) -> None:
        """Release the line; an output that is on stays on until the instrument's watchdog acts."""
        self._closed = True
        self._line.close()


class LineActuator(LineDevice[SettingsT, LineT], Actuator):
    """An actuator at the end of a line of its own."""

    def __init__(self, name: str, settings: SettingsT, clock: Clock, line: LineT) -> None:
        super().__init__(name, settings, clock, line)
        self._setpoint = math.nan

    @property
    def setpoint(self) -> float:
        """The set-point that was last sent, in the unit of `limits`; nan before the first."""
        return self._setpoint

    def safe(self) -> None:
        """Bring the device into its safe state, over a line of its own if the one in use is gone.

        Raises DeviceError if the safe state could not be confirmed, after everything was tried.
        """
        try:
            self._make_safe()
        except DeviceConnectionError as failure:
            try:
                self._renew_line()
            except DeviceError:
                raise failure from None
            self._make_safe()

    @abstractmethod
    def _make_safe(self) -> None:
        """Try everything that makes the device safe; raise `DeviceError` if that is not confirmed."""

    def _unconfirmed(self, part: str, failures: list[DeviceError]) -> DeviceError:
        """Return the error for a part that may still be on, after everything was tried."""
        reason = f" ({failures[0]})" if failures else ""
        # If the connection failed, a fresh line may help.
        lost = bool(failures) and isinstance(failures[0], DeviceConnectionError)
        kind = DeviceConnectionError if lost else DeviceError
        return kind(self.name, f"does not confirm that its {part} is off{reason}; disconnect its power supply")


class RecoverableDevice(LineActuator[SettingsT, LineT]):
    """An actuator whose instrument keeps an error until it is restarted or released."""

    @classmethod
    def recover(cls, name: str, settings: SettingsT, clock: Clock) -> Self:
        """Connect to an instrument in its error state: restart or release it, and configure it.

        Use it once the cause of the error is found. Parameters and errors are those of `connect`.
        """
        return cls._open(name, settings, clock, cls._restart)

    @abstractmethod
    def _restart(self) -> None: ...

    def _wait_until(self, ready: Callable[[], bool], patience: float) -> None:
        """Wait until the instrument answers that it is ready, for so many seconds at most."""
        end = self._clock.now() + patience
        while True:
            problem: DeviceError | None = None
            try:
                if ready():
                    return
            except DeviceConnectionError as error:
                problem = error
            if self._clock.now() >= end:
                raise problem or DeviceError(self.name, f"did not start within {patience:g} s")
            self._clock.sleep(_START_POLL)


def refuse_hiding(device: type, name: str, kind: type) -> None:
    """Raise `TypeError` if a row of a class hides what its bases have, unless that is a row of that kind as well."""
    for base in device.__mro__[1:]:
        if name in vars(base) and not isinstance(vars(base)[name], kind):
            raise TypeError(f"{device.__name__}.{name}: {base.__name__} has this name already; choose another")


def other_answer(heard: bytes) -> str:
    """Return what to say of bytes that came and are no answer of this kind of instrument; nothing if none came."""
    return f"; another instrument answers there, or at another speed: {bytes(heard[:40])!r}" if heard else ""


def attempt(*steps: Callable[[], object]) -> list[DeviceError]:
    """Take every step, also after one that fails; return the failures."""
    failures = []
    for step in steps:
        try:
            step()
        except DeviceError as error:
            failures.append(error)
    return failures
