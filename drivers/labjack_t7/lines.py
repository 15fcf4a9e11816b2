"""Digital lines of a LabJack T7, and the watchdog of the instrument that switches them off.

Sources: LabJack T-series datasheet 13.0 for the digital lines, 23.0 for the watchdog.

Assumptions: the settings of the watchdog outlast a restart of the instrument, as their names (..._DEFAULT) suggest;
reading the register of a single digital line makes it an input, as the map says that it configures the direction
too.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TypeVar

from pydantic import Field

from bench.clock import Clock
from bench.errors import DeviceError
from drivers.device import LineActuator
from drivers.labjack_t7.device import T7ConnectionSettings, T7Device
from drivers.labjack_t7.registers import (
    DIO,
    DIO_DIRECTION,
    DIO_STATE,
    WATCHDOG_DAC_ENABLE,
    WATCHDOG_DIO_DIRECTION,
    WATCHDOG_DIO_ENABLE,
    WATCHDOG_DIO_INHIBIT,
    WATCHDOG_DIO_STATE,
    WATCHDOG_ENABLE,
    WATCHDOG_STRICT_ENABLE,
    WATCHDOG_TIMEOUT_S,
    LabJackT7,
)

LINES = 23
_ALL_LINES = (1 << LINES) - 1


class T7LineSettings(T7ConnectionSettings):
    """Rig-file settings of a device that is switched by a digital line of a T7."""

    line: int = Field(
        ge=0, lt=LINES, description="digital line, 0 to 22: FIO0-7 are 0-7, EIO0-7 8-15, CIO0-3 16-19, MIO0-2 20-22"
    )
    active_high: bool = Field(default=True, description="whether a high level is on; false where a low one is")
    watchdog: int = Field(
        default=5,
        ge=1,
        le=3600,
        description="silence of all hosts in s after which the instrument switches the line off, 1 to 3600",
    )


@dataclass(frozen=True)
class _Watchdog:
    """The settings of the watchdog that concern digital lines."""

    enabled: int
    seconds: int
    strict: int
    dio_enabled: int
    state: int
    direction: int
    inhibit: int

    @property
    def lines(self) -> int:
        """The lines that it drives when it runs out, one bit each."""
        return ~self.inhibit & _ALL_LINES if self.enabled and self.dio_enabled else 0


class DigitalOutput:
    """One digital line of a T7, which the watchdog of the instrument can switch off.

    The level is read by DIO_STATE, as reading the register of a single line would make it an input.

    The instrument has one watchdog with one time. Any communication of any host feeds it, over any connection.
    When it runs out it drives the lines that are under it, and goes on. It must be switched off to change its
    settings, which takes some milliseconds. The settings are kept in the instrument's non-volatile memory, so
    they are written only if they differ.

    Parameters
    ----------
    instrument : LabJackT7
        The connection.
    line : int
        Number of the line, 0 to 22.
    active_high : bool
        Whether a high level is on.
    """

    def __init__(self, name: str, instrument: LabJackT7, line: int, *, active_high: bool) -> None:
        self._name = name
        self._instrument = instrument
        self._line = line
        self._bit = 1 << line
        self._active_high = active_high

    def __str__(self) -> str:
        """Return the name of the line."""
        return f"DIO{self._line}"

    @property
    def is_on(self) -> bool:
        """Whether the level of the line is the one that is on, as the instrument reports now."""
        return bool(self._instrument.read_integer(DIO_STATE) & self._bit) == self._active_high

    def switch(self, on: bool) -> None:
        """Make the line an output with the level for on or off.

        Raises `DeviceError` if the instrument refuses, or if the line does not read back so.
        """
        self._instrument.write(DIO.of(self._line), int(on == self._active_high))
        self.check_output()
        if self.is_on != on:
            raise DeviceError(
                self._name,
                f"{self} is {'off' if on else 'on'} right after it was switched {'on' if on else 'off'}; check the "
                "wiring for a short circuit, and that no other program uses the line",
            )

    def check_output(self) -> None:
        """Raise `DeviceError` if the line is not an output."""
        if not self._instrument.read_integer(DIO_DIRECTION) & self._bit:
            raise DeviceError(
                self._name,
                f"{self} is an input and drives nothing; is another program using the line, or has the instrument "
                "restarted?",
            )

    @property
    def watchdog(self) -> int:
        """The time of the watchdog in s, as the instrument reports now."""
        return self._instrument.read_integer(WATCHDOG_TIMEOUT_S)

    def guard(self, seconds: int) -> None:
        """Have the watchdog switch the line off after `seconds` without communication.

        Other outputs under the watchdog stay so, and then the shorter of its present time and `seconds` holds. The
        outputs of a watchdog that is switched off are not taken over.

        Raises `DeviceError` if the watchdog is in strict mode, which another program feeds, or if the instrument
        refuses.
        """
        present = self._watchdog()
        if present.enabled and present.strict:
            raise DeviceError(
                self._name,
                "the watchdog of the instrument is in strict mode, so another program is using it; end that "
                "program and write 0 to WATCHDOG_ENABLE_DEFAULT",
            )
        if self._others(present):
            seconds = min(seconds, present.seconds)
        off = 0 if self._active_high else self._bit
        wanted = _Watchdog(
            enabled=1,
            seconds=seconds,
            strict=0,
            dio_enabled=1,
            state=present.state & ~self._bit | off,
            direction=present.direction | self._bit,
            inhibit=~(present.lines | self._bit) & _ALL_LINES,
        )
        self._change(present, wanted)

    def unguard(self) -> None:
        """Take the line from the watchdog, and switch the watchdog off if nothing else is under it.

        Raises `DeviceError` if the instrument refuses.
        """
        present = self._watchdog()
        if not present.lines & self._bit:
            return
        lines = present.lines & ~self._bit
        self._change(
            present,
            replace(
                present,
                enabled=int(self._others(present)),
                dio_enabled=int(bool(lines)),
                inhibit=~lines & _ALL_LINES,
            ),
        )

    def _others(self, watchdog: _Watchdog) -> bool:
        """Return whether something else than this line is under the watchdog."""
        if watchdog.lines & ~self._bit:
            return True
        return bool(watchdog.enabled) and any(map(self._instrument.read_integer, WATCHDOG_DAC_ENABLE))

    def _watchdog(self) -> _Watchdog:
        read = self._instrument.read_integer
        return _Watchdog(
            read(WATCHDOG_ENABLE),
            read(WATCHDOG_TIMEOUT_S),
            read(WATCHDOG_STRICT_ENABLE),
            *map(int, self._instrument.read(WATCHDOG_DIO_ENABLE, 4)),
        )

    def _change(self, present: _Watchdog, wanted: _Watchdog) -> None:
        if wanted == present:
            return
        instrument = self._instrument
        instrument.set({WATCHDOG_ENABLE: 0})
        try:
            instrument.set({WATCHDOG_TIMEOUT_S: wanted.seconds})
            instrument.set({WATCHDOG_STRICT_ENABLE: wanted.strict})
            instrument.set(
                {
                    WATCHDOG_DIO_ENABLE: wanted.dio_enabled,
                    WATCHDOG_DIO_STATE: wanted.state,
                    WATCHDOG_DIO_DIRECTION: wanted.direction,
                    WATCHDOG_DIO_INHIBIT: wanted.inhibit,
                }
            )
        except BaseException:
            # Other outputs may depend on it, also after a refusal.
            with suppress(DeviceError):
                instrument.set({WATCHDOG_ENABLE: present.enabled})
            raise
        if wanted.enabled:
            instrument.set({WATCHDOG_ENABLE: 1})


LineSettingsT = TypeVar("LineSettingsT", bound=T7LineSettings)


class T7LineDevice(T7Device[LineSettingsT], LineActuator[LineSettingsT, LabJackT7]):
    """A device that a digital line of a LabJack T7 switches.

    The watchdog of the instrument switches the line off when no host has communicated with the instrument for its
    time. The time is the `watchdog` of the settings, or a shorter one that another output of the same instrument
    asked for (see `DigitalOutput`).

    Until `connect`, and after a restart of the instrument, the line is an input that is pulled up weakly: what an
    active high line switches needs a pull-down to be off then.
    """

    def __init__(self, name: str, settings: LineSettingsT, clock: Clock, line: LabJackT7) -> None:
        super().__init__(name, settings, clock, line)
        self._output = DigitalOutput(name, line, settings.line, active_high=settings.active_high)

    def close(self) -> None:
        """Release the connection; a line that is on is left to the watchdog."""
        # An instrument that cannot be reached any more keeps its watchdog, as it should.
        with suppress(DeviceError):
            if not self._output.is_on:
                self._output.unguard()
        super().close()
