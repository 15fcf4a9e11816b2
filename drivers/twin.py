"""The devices of a twin: a sensor and an actuator whose signals, units and limits are those of the rig file."""

from __future__ import annotations

import math
from typing import ClassVar

from bench.base import Clock, DeviceConnectionError, DeviceError
from bench.devices import Actuator, Identity, Limits, Signal, Status
from bench.specimen import DONE, END, GLANCE, IDENTITY, MEASURE, OFF, OUTPUT, SET, TwinSettings, number_text
from drivers.device import LineActuator, LineDevice
from drivers.quantities import identity_of
from drivers.serial_line import RESENDS, RepeatingLine, SerialSettings, forget_received, lost_line, open_port

_ARRIVAL_TIMEOUT = 600.0  # s


class TwinLine(RepeatingLine):
    """The line to a device of a twin.

    Raises `DeviceConnectionError` if it cannot be opened.
    """

    def __init__(self, device: str, settings: TwinSettings) -> None:
        self._device = device
        self._settings = SerialSettings(port=settings.port, baudrate=settings.baudrate, timeout=settings.timeout)
        self._port = open_port(device, self._settings)

    def close(self) -> None:
        """Release the line."""
        self._port.close()

    def ask(self, request: str) -> str:
        """Return the answer to a request; it is sent three times at most.

        Raises `DeviceConnectionError` if none comes.
        """
        resends, self.resends = self.resends, RESENDS
        for _ in range(1 + resends):
            try:
                forget_received(self._port)
                self._port.write(request.encode() + END)
                answer: bytes = self._port.read_until(END)
            except OSError as error:  # pyserial's errors among them
                raise lost_line(self._device, self._settings.port, error) from None
            if answer.endswith(END):
                return answer[: -len(END)].decode("ascii", "replace")
        self.resends = 0
        raise DeviceConnectionError(self._device, f"no answer to {request!r} at {self._settings.port}")


class TwinSensor(LineDevice[TwinSettings, TwinLine]):
    """A device of a twin that measures; a reading takes the time that it took on the rig."""

    Settings: ClassVar[type[TwinSettings]] = TwinSettings

    @classmethod
    def _open_line(cls, name: str, settings: TwinSettings, clock: Clock) -> TwinLine:  # noqa: ARG003
        return TwinLine(name, settings)

    def _identify(self) -> Identity:
        return identity_of(self._line.ask(IDENTITY))

    def _start(self) -> None:
        pass

    @property
    def signals(self) -> tuple[Signal, ...]:
        """What it measures."""
        return tuple(each.signal for each in self._settings.signals)

    def measure(self) -> dict[str, float]:
        """Take a reading; values by signal name."""
        return self._take(MEASURE, self._settings.reading_time)

    def glance(self) -> dict[str, float]:
        """Take a quick reading; values by signal name."""
        return self._take(GLANCE, self._settings.quick_time)

    def _take(self, request: str, seconds: float) -> dict[str, float]:
        if seconds:
            self._clock.sleep(seconds)
        names = [each.name for each in self._settings.signals]
        answer = self._line.ask(request)
        try:
            values = [float(number) for number in answer.split()]
            return dict(zip(names, values, strict=True))
        except ValueError:
            raise DeviceError(
                self.name, f"answered {answer!r} to {request!r}, expected {len(names)} numbers"
            ) from None

    def safe(self) -> None:
        """Do nothing: a sensor is always safe."""


class TwinActuator(LineActuator[TwinSettings, TwinLine], TwinSensor, Actuator):
    """A device of a twin that takes a set-point; its safe state is the output off, as it was before the runs."""

    def __init__(self, name: str, settings: TwinSettings, clock: Clock, line: TwinLine) -> None:
        super().__init__(name, settings, clock, line)
        if settings.setpoint is None:
            raise DeviceError(name, "has no set-point; expected a table setpoint, or the driver twin-sensor")
        self._table = settings.setpoint

    @property
    def limits(self) -> Limits:
        """The set-points that are allowed."""
        return Limits(*self._table.limits, self._table.unit)

    @property
    def setpoint_signal(self) -> Signal:
        """What the set-point is."""
        return self._table.signal

    def set(self, value: float) -> Status:
        """Send a set-point; raises `LimitError` if it is outside of the limits, and then nothing is sent."""
        self.check(value)
        if self._settings.setpoint_time:
            self._clock.sleep(self._settings.setpoint_time)
        answer = self._line.ask(f"{SET} {number_text(value)}")
        if answer != DONE:
            raise DeviceError(self.name, f"answered {answer!r} to a set-point of {value:g} {self._table.unit}")
        self._setpoint = value
        if not self._table.tolerance or not self._settings.signals:
            return Status.completed(self.name, self._clock)
        signal = self._settings.signals[0].name
        return Status(
            self.name,
            self._clock,
            lambda: abs(self.glance()[signal] - value) <= self._table.tolerance,
            timeout=_ARRIVAL_TIMEOUT,
        )

    def _make_safe(self) -> None:
        self._line.ask(OFF)
        if self._line.ask(OUTPUT) != repr(math.nan):
            raise DeviceError(self.name, "does not confirm that its output is off")
        self._setpoint = math.nan
