"""Digital lines of a LabJack T7, and the watchdog of the instrument that switches them off.

Sources: LabJack T-series datasheet 13.0 for the digital lines, 23.0 for the watchdog, 24.0 for what outlasts a
restart.

Assumption: reading the register of a single digital line makes it an input, as the map says that it configures the
direction too.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import astuple, dataclass, replace
from typing import TypeVar

from pydantic import Field

from bench.base import Clock, DeviceError
from bench.devices import CheckFinding
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
    Packet,
    Span,
)

LINES = 23
_ALL_LINES = (1 << LINES) - 1


class T7LineSettings(T7ConnectionSettings):
    """Rig-file settings of a device that is switched by a digital line of a T7."""

    line: int = Field(
        ge=0,
        lt=LINES,
        description="digital line, 0 to 22: FIO0-7 are 0-7, EIO0-7 8-15, CIO0-3 16-19, MIO0-2 20-22; high until the "
        "driver connects",
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


_WATCHDOG_REGISTERS = (
    WATCHDOG_ENABLE,
    WATCHDOG_TIMEOUT_S,
    WATCHDOG_STRICT_ENABLE,
    WATCHDOG_DIO_ENABLE,
    WATCHDOG_DIO_STATE,
    WATCHDOG_DIO_DIRECTION,
    WATCHDOG_DIO_INHIBIT,
)
"""In the order of the settings of `_Watchdog`."""

_SETTINGS = Packet.of([Span.of(register) for register in _WATCHDOG_REGISTERS])
_DIRECTION, _STATE = Span.of(DIO_DIRECTION), Span.of(DIO_STATE)
_STATE_PACKET = Packet.of((_STATE,))


class DigitalOutput:
    """One digital line of a T7, which the watchdog of the instrument can switch off.

    The level is read by DIO_STATE, as reading the register of a single line would make it an input.

    The instrument has one watchdog with one time. Any communication of any host feeds it, over any connection.
    When it runs out it drives the lines that are under it, and goes on. It must be switched off to change its
    settings, which takes some milliseconds. The settings are kept in the instrument's flash memory, which wears with
    each write: a register is written only if it differs.

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
        self._register = DIO.of(line)
        self._bit = 1 << line
        self._active_high = active_high

    def __str__(self) -> str:
        """Return the name of the line."""
        return f"DIO{self._line}"

    @property
    def is_on(self) -> bool:
        """Whether the level of the line is the one that is on, as the instrument reports now."""
        (state,) = self._instrument.read_packet(_STATE_PACKET)
        return self._level(state)

    def switch(self, on: bool) -> None:
        """Make the line an output with the level for on or off.

        Raises `DeviceError` if the instrument refuses, or if the line does not read back so.
        """
        data = self._instrument.encode(self._register, int(on == self._active_high))
        if self._look((self._register.address, data)) != on:
            raise DeviceError(
                self._name,
                f"{self} is {'off' if on else 'on'} right after it was switched {'on' if on else 'off'}; check the "
                "wiring for a short circuit, and that no other program uses the line",
            )

    def check_output(self) -> bool:
        """Return whether the level of the line is the one that is on.

        Raises `DeviceError` if the line is not an output.
        """
        return self._look()

    def _look(self, *writes: tuple[int, bytes]) -> bool:
        direction, state = self._instrument.read_packet(Packet.of((_DIRECTION, _STATE), *writes))
        if not int(direction) & self._bit:
            raise DeviceError(
                self._name,
                f"{self} is an input and drives nothing; is another program using the line, or has the instrument "
                "restarted?",
            )
        return self._level(state)

    def _level(self, state: float) -> bool:
        return bool(int(state) & self._bit) == self._active_high

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
        if not self._others(present):
            # The rest may stay as it is: one write to the flash memory, and one when the line is guarded again.
            self._instrument.set({WATCHDOG_ENABLE: 0})
            return
        lines = present.lines & ~self._bit
        self._change(present, replace(present, dio_enabled=int(bool(lines)), inhibit=~lines & _ALL_LINES))

    @property
    def guarded_for(self) -> int | None:
        """Silence of all hosts, s, after which the watchdog switches the line off; None if it does not."""
        present = self._watchdog()
        off = 0 if self._active_high else self._bit
        switches_off = present.lines & present.direction & self._bit and present.state & self._bit == off
        return present.seconds if switches_off else None

    def _others(self, watchdog: _Watchdog) -> bool:
        """Return whether something else than this line is under the watchdog."""
        if watchdog.lines & ~self._bit:
            return True
        return bool(watchdog.enabled) and any(map(self._instrument.read_integer, WATCHDOG_DAC_ENABLE))

    def _watchdog(self) -> _Watchdog:
        return _Watchdog(*map(int, self._instrument.read_packet(_SETTINGS)))

    def _change(self, present: _Watchdog, wanted: _Watchdog) -> None:
        if wanted == present:
            return
        instrument = self._instrument
        settings = zip(_WATCHDOG_REGISTERS[1:], astuple(present)[1:], astuple(wanted)[1:], strict=True)
        different = {register: value for register, old, value in settings if value != old}
        # Only a watchdog that is off takes other settings.
        enabled = present.enabled
        try:
            if different and enabled:
                instrument.set({WATCHDOG_ENABLE: 0})
                enabled = 0
            for register, value in different.items():
                instrument.set({register: value})
        except BaseException:
            # Other outputs may depend on it, also after a refusal.
            if present.enabled:
                with suppress(DeviceError):
                    instrument.set({WATCHDOG_ENABLE: 1})
            raise
        if wanted.enabled != enabled:
            instrument.set({WATCHDOG_ENABLE: wanted.enabled})


LineSettingsT = TypeVar("LineSettingsT", bound=T7LineSettings)


class T7LineDevice(T7Device[LineSettingsT], LineActuator[LineSettingsT, LabJackT7]):
    """A device that a digital line of a LabJack T7 switches.

    The watchdog of the instrument switches the line off when no host has communicated with the instrument for its
    time. The time is the `watchdog` of the settings, or a shorter one that another output of the same instrument
    asked for (see `DigitalOutput`).

    Until `connect`, and after a restart of the instrument, the line is an input that 100 kΩ pull up to 3.3 V: what an
    active high line switches needs a strong pull-down, or an interlock of its own, to be off then.
    """

    def __init__(self, name: str, settings: LineSettingsT, clock: Clock, line: LabJackT7) -> None:
        super().__init__(name, settings, clock, line)
        self._output = DigitalOutput(name, line, settings.line, active_high=settings.active_high)

    @property
    def watchdog(self) -> float:
        """Silence of all hosts, s, after which the instrument switches the line off, at the latest."""
        return float(self._settings.watchdog)

    def safe(self) -> None:
        """Bring the device into its safe state, over a connection of its own if the one in use is gone.

        Raises `DeviceError` if the safe state could not be confirmed, after everything was tried: within 3 s.
        """
        with self._line.in_haste(unchecked=True):
            self._make_safe()

    def close(self) -> None:
        """Release the connection; a line that is on is left to the watchdog."""
        # An instrument that cannot be reached any more keeps its watchdog, as it should.
        with suppress(DeviceError), self._line.in_haste():
            if not self._output.is_on:
                self._output.unguard()
        super().close()

    def self_check(self) -> tuple[CheckFinding, ...]:
        """Read the watchdog of the instrument back.

        Raises DeviceError if the instrument does not answer.
        """
        found, wanted = self._output.guarded_for, self._settings.watchdog
        if found is not None and found <= wanted:
            return (CheckFinding("watchdog read back", f"{found} s in the instrument, switches {self._output} off"),)
        text = "does not switch it off" if found is None else f"{found} s"
        advice = f"end what else uses the instrument: {wanted} s was written on connecting"
        return (CheckFinding("watchdog read back", f"{self._output}: {text}", advice),)
