"""A digital line of a LabJack T7 as a switch."""

from __future__ import annotations

from typing import ClassVar

from bench.base import DeviceError
from bench.devices import Status, Switch
from drivers.labjack_t7.lines import T7LineDevice, T7LineSettings


class T7Switch(T7LineDevice[T7LineSettings], Switch):
    """A digital line of a LabJack T7 that switches something on and off.

    While the line is on, ask for readings more often than the time of the watchdog. `connect` switches the line
    off, and raises `DeviceError` if it does not go off.
    """

    Settings: ClassVar[type[T7LineSettings]] = T7LineSettings

    def _start(self) -> None:
        self._line.claim(self._clock)
        self._output.switch(False)
        self._output.guard(self._settings.watchdog)

    def set(self, value: float) -> Status:
        """Switch on (1) or off (0), and see that the line is.

        Raises
        ------
        LimitError
            If `value` is neither 0 nor 1; nothing is sent.
        DeviceError
            If the instrument refuses, or if the line does not read back so.
        """
        self.check(value)
        self._output.switch(value == 1.0)
        self._setpoint = float(value)
        return Status.completed(self.name, self._clock)

    def measure(self) -> dict[str, float]:
        """Read back whether the line is on, and see that it is driven.

        Raises
        ------
        DeviceError
            Once, if the line went off by itself; if it is no output any more.
        DeviceConnectionError
            If the instrument does not answer.
        """
        return self._state(self._output.check_output())

    def glance(self) -> dict[str, float]:
        """Read back whether the line is on, in one request; does not check that it is driven."""
        return self._state(self._output.is_on)

    def _state(self, on: bool) -> dict[str, float]:
        if self._setpoint == 1.0 and not on:
            self._setpoint = 0.0
            raise DeviceError(
                self.name,
                f"{self._output} is off although it was switched on: the watchdog of the instrument has run out, as "
                f"no host communicated with it for {self._output.watchdog} s, or another program switched the line; "
                "ask for readings more often or lengthen `watchdog`, then switch it on again",
            )
        return {f"{self.name}_state": float(on)}

    def _make_safe(self) -> None:
        """Switch off and see that the line is off; one that cannot be reached is left to the watchdog."""
        self._setpoint = 0.0
        self._output.switch(False)
