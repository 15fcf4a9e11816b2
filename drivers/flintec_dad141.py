"""The Flintec DAD 141.1, the amplifier of a strain-gauge load cell, by Modbus RTU.

Sources: Flintec DAD 141.1 Technical Manual, Modbus Communication, Rev 2.3, for the registers; Flintec DAD 141.1
Technical Manual, Rev 2.5, 10.1 (identity), 10.2 (zero tracking), 10.4 (filters) and 10.5 (taring).

The instrument is calibrated at its own keys, for a weight in a unit that the user chose; the settings convert it to
newtons. Nothing is saved in its EEPROM: a power cycle restores the filter that was saved, and forgets the tare. Zero
tracking takes loads that change slowly for a drift of the zero, so it has to be off (ZT = 0). It belongs to the
calibration, which is sealed by a counter (TAC); so the driver refuses an instrument that tracks, and changes nothing.

An instrument that is switched on is silent for longer than 0.3 s (0.4 s after the command SR, says the manual). So
after a longer silence, and after a lost reply, the filter is read again: if it has fallen back to the saved one, the
instrument has restarted. Where the saved filter is the same and there is no tare, a restart changes nothing, and is
not noticed.

Assumptions: functions 3 and 4 read the same, and registers 0x202A to 0x2031 may be read at once; register 0x202C
holds the 1410 that the command ID returns, as a number or digit by digit; the first byte of the firmware register is
the higher one, and holds the minor version; an integer weight has the digits of the floating-point one without the
decimal point; a tare that the instrument refuses leaves the tare bit as it was; characters have 8 bits and one stop
bit.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

from pydantic import Field, field_validator

from bench.base import Clock, DeviceConnectionError, DeviceError, DeviceRestartedError
from bench.devices import CheckFinding, Identity, LoadCell
from drivers.device import LineDevice, Slope
from drivers.modbus import READ, READ_INPUT, swapped, unpack
from drivers.modbus_rtu import RefusalError, Register, RtuLine, RtuSettings

CUTOFF_HZ = (17.0, 18.0, 8.0, 4.0, 3.0, 2.0, 1.0, 0.5, 0.25)
"""3 dB cut-off by filter setting (Technical Manual, 10.4.2); 0 is the anti-aliasing filter alone."""

_FIRST_OF_ECHO = 0x202A
_DEVICE_ID = 0x202C
_FIRMWARE = 0x202E
_COMMAND = 0x2061
_PEAK = 0x2080
_COMBINED = 0x3500

_RESET_TARE = 0x04
_SET_TARE = 0x08

_UNDER_RANGE = 0x0001
_OVER_RANGE = 0x0002
_NO_MOTION = 0x0010
_TARE_SET = 0x0020

_IIR = 0
_MOST_DECIMALS = 5
_ORDER_LOOKS = 3
_TARE_TIMEOUT = 1.0  # s that the instrument is given to show a change of tare
_POLL = 0.05
_CONVERSIONS = 5  # looked at by the check of the instrument itself

_BLOCK = struct.Struct(">ffH")
_READING, _WRITING, _COMMANDING = "reading register 0x{:04X}", "writing register 0x{:04X}", "command 0x{:02X}"
_SHORTEST_RESTART = 0.3  # s of silence that no restart of the instrument goes below
_SAME_TARE = 1e-6  # of the weights, by which a tare of single precision may differ from itself
_STALE_LOOKS = 10


class DAD141Settings(RtuSettings):
    """Rig-file settings of a DAD 141.1: address, speed, parity and mode RTU are those of its menu 8."""

    baudrate: int = Field(
        default=115200, ge=9600, le=115200, description="speed of the line (menu 8.1) in Bd, 9600 to 115200"
    )
    filter: int = Field(
        default=3,
        ge=0,
        le=8,
        description="low-pass filter (FL): 0 for none, 1 to 8 for 18, 8, 4, 3, 2, 1, 0.5, 0.25 Hz",
    )
    samples: int = Field(default=5, ge=1, le=1000, description="readings averaged in one measurement, 1 to 1000")
    interval: float | None = Field(
        default=None, ge=0.0, le=60.0, description="time between readings, s; default: half a period of the cut-off"
    )
    newtons_per_unit: Slope = Field(
        default=1.0,
        description="calibration: N for each unit of weight, not 0; 9.80665 for kg, negative to turn the sign",
    )
    zero_newtons: float = Field(
        default=0.0, description="calibration: force in N at which the gross weight reads zero"
    )
    force_limits: tuple[float, float] = Field(
        description="calibrated range in N, low and high; a gross force beyond, with any tare, is an error"
    )
    keep_tare: bool = Field(
        default=False, description="whether a tare found on connecting stays; otherwise it is reset"
    )
    still_timeout: float = Field(
        default=10.0, ge=0.0, le=600.0, description="longest wait for a still signal before taring in s, 0 to 600"
    )
    stale_after: float = Field(
        default=30.0,
        ge=0.0,
        le=86400.0,
        description="time in s, to 86400, for which neither weight nor converter may stand still to the last digit; "
        "0 for ever",
    )
    device_ids: tuple[int, ...] = Field(
        default=(1410, 0x1410), min_length=1, description="values of register 0x202C (device identity) to accept"
    )

    @field_validator("force_limits")
    @classmethod
    def _check_limits(cls, value: tuple[float, float]) -> tuple[float, float]:
        low, high = value
        if not low < high:
            raise ValueError(f"expected low < high, got {low:g} and {high:g} N")
        return value


class _Block(NamedTuple):
    """The combined registers, in the unit of weight."""

    gross: float
    net: float
    qualifier: int

    @property
    def tare(self) -> float:
        """The tare, in the unit of weight."""
        return self.gross - self.net


class _Line(RtuLine):
    """The line to a DAD 141.1, which reads its registers by functions 3 and 4 alike."""

    reading = (READ, READ_INPUT)
    first_of_echo = _FIRST_OF_ECHO
    set_at = ", see its menu 8"

    def read_block(self) -> _Block:
        """Get the combined registers."""
        return _Block(*_BLOCK.unpack(self.read_bytes(_COMBINED, 5)))

    def command(self, value: int) -> None:
        """Give a command of register 0x2061."""
        self.write_one("command 0x{:02X}", value, _COMMAND, value)


class FlintecDAD141(LineDevice[DAD141Settings, _Line], LoadCell):
    """A load cell on a DAD 141.1.

    Every reading is one request for gross weight, net weight and qualifier together, so that they belong to one
    conversion. The force is the net one while the instrument has a tare, and the gross one otherwise; a tare
    that was set, changed or lost without the bench is an error, as the force would jump by it. `measure` averages
    `samples` readings, `glance` takes one. A call after the line was lost opens it again (`reconnect`).

    `connect` checks the order of words in the instrument's values and that zero tracking is off, and sets filter and
    tare.
    """

    Settings: ClassVar[type[DAD141Settings]] = DAD141Settings

    conversion = Register(0x202A, int, "I32", "last result of the converter")
    serial_number = Register(0x2034, int, "I32", "serial number")
    filter = Register(0x2106, int, "I32", "filter")
    filter_mode = Register(0x2110, int, "I32", "filter mode")
    zero_tracking = Register(0x2122, int, "I32", "zero tracking")

    def __init__(self, name: str, settings: DAD141Settings, clock: Clock, line: _Line) -> None:
        super().__init__(name, settings, clock, line)
        self._signal = f"{name}_force"
        self._tared: bool
        self._tare: float
        self._restart = ""
        # Half a period of the filter's cut-off makes the noise of the readings nearly independent.
        self._interval = 0.5 / CUTOFF_HZ[settings.filter] if settings.interval is None else settings.interval
        self._gross = math.nan
        # Since when it has stood, and what the converter behind it showed since then.
        self._gross_since: float
        self._adc: int | None
        self._adc_since: float
        self._adc_seen: float
        self._adc_looks: int

    @classmethod
    def _open_line(cls, name: str, settings: DAD141Settings, clock: Clock) -> _Line:
        return _Line(name, settings, clock)

    def _start(self) -> None:
        settings, line = self._settings, self._line
        if (tracking := self.zero_tracking) != 0:
            raise DeviceError(
                self.name,
                f"zero tracking is on (ZT = {tracking}): it would take slow changes of a small load for drift; "
                "switch it off by the commands CE, ZT 0 and CS of the instrument, then connect again",
            )
        self.filter_mode = _IIR
        self.filter = settings.filter
        if settings.keep_tare and (block := line.read_block()).qualifier & _TARE_SET:
            self._tared, self._tare = True, block.tare
        else:
            self.clear_tare()
        line.longest_silence = 0.0

    def measure(self) -> dict[str, float]:
        """Measure the force in N, as the mean of `samples` readings.

        Raises
        ------
        DeviceError
            If the cell is under or over its range, the force is outside of its calibration, or a reading is
            stale or no number.
        DeviceConnectionError
            If the instrument does not answer.
        """
        begin = self._clock.now()
        forces = []
        for sample in range(self._settings.samples):
            self._clock.sleep_until(begin + sample * self._interval)
            forces.append(self._force())
        return {self._signal: math.fsum(forces) / len(forces)}

    def glance(self) -> dict[str, float]:
        """Measure the force in N by one reading; raises what `measure` does."""
        return {self._signal: self._force()}

    def tare(self) -> None:
        """Make the present force read zero from now on, as soon as the instrument finds the signal still.

        Raises `DeviceError` if the signal is out of range or does not become still, or the instrument does not take
        the tare.
        """
        end = self._clock.now() + self._settings.still_timeout
        while not self._checked_block().qualifier & _NO_MOTION:
            if self._clock.now() >= end:
                raise DeviceError(
                    self.name,
                    f"the signal was not still within {self._settings.still_timeout:g} s, so there is no tare; bring "
                    "the load to rest, choose a higher `filter`, or widen the no-motion range (menu 4)",
                )
            self._clock.sleep(_POLL)
        self._line.command(_SET_TARE)
        self._await_tare(wanted=True)

    def clear_tare(self) -> None:
        """Read gross force again.

        Raises `DeviceError` if the instrument keeps its tare.
        """
        self._begin()
        self._line.command(_RESET_TARE)
        self._await_tare(wanted=False)

    def safe(self) -> None:
        """Do nothing: a load cell is safe in any state."""

    @property
    def safe_within(self) -> float:
        """Longest time of `safe`, s: none."""
        return 0.0

    def _check_unchanged(self) -> None:
        self._checked_block()
        self._check_set_up()

    def _identify(self) -> Identity:
        """Check that the instrument is the right one and orders words as this driver does."""
        settings, line = self._settings, self._line
        try:
            words = line.read(_DEVICE_ID, 2)
            if _integer(words) not in settings.device_ids:
                known = " or ".join(str(each) for each in settings.device_ids)
                raise self._wrong(
                    swapped(words, lambda order: _integer(order) in settings.device_ids)
                    or f"is not a DAD 141.1: its identity is {_integer(words)}, not {known}; check the address, or "
                    "add the number to `device_ids` if it is one"
                )
            high, low = line.read(_FIRMWARE, 2)
            if high or not low:
                raise self._wrong(
                    f"gives 0x{high:04X}{low:04X} for its firmware, which no DAD 141.1 does; check the address"
                )
            serial_number = self.serial_number
            self._check_order()
        except RefusalError as error:
            raise self._wrong(f"is not a DAD 141.1: {error.text}; check the address") from error
        minor, major = low >> 8, low & 0xFF
        return Identity("Flintec", "DAD 141.1", str(serial_number), f"{major}.{minor:02d}")

    def _check_order(self) -> None:
        """Raise unless the peak weight as floating-point number and as integer has the same digits."""
        # Several times, as the weight may pass its peak between the two.
        for _ in range(_ORDER_LOOKS):
            weight, digits = unpack("fi", self._line.read(_PEAK, 4))
            if _agree(weight, digits):
                return
        raise self._wrong(
            f"gives the same weight as {weight:g} and, as an integer, {digits}; is there a gateway in between that "
            "changes the order of words or bytes?"
        )

    def _wrong(self, what: str) -> DeviceConnectionError:
        return DeviceConnectionError(
            self.name, f"the device at {self._settings.port}, address {self._settings.address}, {what}"
        )

    def _await_tare(self, *, wanted: bool) -> None:
        end = self._clock.now() + _TARE_TIMEOUT
        while bool((block := self._line.read_block()).qualifier & _TARE_SET) is not wanted:
            if self._clock.now() >= end:
                done, advice = (
                    ("took no tare", "is the load at rest?") if wanted else ("keeps its tare", "reset it by its keys")
                )
                raise DeviceError(self.name, f"the instrument {done}; {advice}")
            self._clock.sleep(_POLL)
        self._tared, self._tare = wanted, block.tare

    def _force(self) -> float:
        """Take one reading, in N."""
        settings = self._settings
        block = self._checked_block()
        if bool(block.qualifier & _TARE_SET) is not self._tared:
            what = (
                "lost its tare; was it switched off?" if self._tared else "was tared by its keys or another program;"
            )
            raise self._untrusted_tare(what)
        if self._tared and abs(block.tare - self._tare) > _SAME_TARE * (abs(block.gross) + abs(block.net)):
            raise self._untrusted_tare(f"has another tare than the bench set, {block.tare:.6g} not {self._tare:.6g};")
        gross = settings.newtons_per_unit * block.gross + settings.zero_newtons
        low, high = settings.force_limits
        if not low <= gross <= high:
            text = f"force {gross:.6g} N is outside of its calibrated range"
            advice = "take load off, or extend the calibration and `force_limits`"
            self._check_range(text, gross, settings.force_limits, "N", advice)
        self._check_fresh(block.gross)
        return settings.newtons_per_unit * block.net if self._tared else gross

    def _untrusted_tare(self, what: str) -> DeviceError:
        return DeviceError(
            self.name, f"the instrument {what} Set the tare again, or clear it, so that its force can be trusted"
        )

    def _begin(self) -> None:
        """Raise if the instrument has restarted; open the line again if it was lost."""
        if self._restart:
            raise DeviceRestartedError(self.name, self._restart)
        super()._begin()

    def _check_set_up(self) -> None:
        """Raise `DeviceRestartedError` if the instrument has lost its set-up."""
        found, wanted = self.filter, self._settings.filter
        if found != wanted:
            self._restart = (
                f"the instrument was switched off, or set up by its keys: its filter (FL) is {found}, not {wanted}; "
                "connect again, so that filter and tare are set"
            )
            raise DeviceRestartedError(self.name, self._restart)
        self._line.longest_silence = 0.0

    def _checked_block(self) -> _Block:
        """Read the combined registers; raise what they say is wrong."""
        self._begin()
        block = self._line.read_block()
        if self._line.longest_silence > _SHORTEST_RESTART:
            self._check_set_up()
        if block.qualifier & (_UNDER_RANGE | _OVER_RANGE):
            side = "over" if block.qualifier & _OVER_RANGE else "under"
            raise DeviceError(
                self.name,
                f"the load cell is {side} its range (qualifier 0x{block.qualifier:04X}, gross weight "
                f"{block.gross:.6g}); take load off and check the cell's cable",
            )
        if not (math.isfinite(block.gross) and math.isfinite(block.net)):
            raise DeviceError(
                self.name,
                f"sent a weight that is not finite (gross {block.gross}, net {block.net}); check its set-up",
            )
        return block

    def _check_fresh(self, gross: float) -> None:
        """Raise if neither the weight nor, after a while, the converter behind it has changed for too long."""
        limit, now = self._settings.stale_after, self._clock.now()
        if gross != self._gross:
            self._gross, self._gross_since, self._adc, self._adc_looks = gross, now, None, 0
            return
        if not limit or now - self._gross_since < limit:
            return
        # A quiet load shows one weight for hours, but a converter that works does not stand still to its last digit.
        suspicious = self._adc_looks >= _STALE_LOOKS
        if not suspicious and self._adc_looks and now - self._adc_seen < limit / _STALE_LOOKS:
            return
        adc = self.conversion
        if adc != self._adc:
            self._adc, self._adc_since, self._adc_looks = adc, now, 0
        self._adc_seen = now
        self._adc_looks += 1
        if self._adc_looks >= _STALE_LOOKS and now - self._adc_since >= limit:
            raise DeviceError(
                self.name,
                f"readings are stale: the converter has stood at {adc} for {now - self._adc_since:.3g} s; switch the "
                "instrument off and on, and connect again",
            )

    def self_check(self) -> tuple[CheckFinding, ...]:
        """Read the filter back, and see that the converter works.

        Raises DeviceError if the instrument does not answer.
        """
        wanted, found = self._settings.filter, self.filter
        advice = "" if found == wanted else f"another program changed it from {wanted}; end that"
        conversions = set()
        for _ in range(_CONVERSIONS):
            conversions.add(self.conversion)
            self._clock.sleep(_POLL)
        works = len(conversions) > 1
        return (
            CheckFinding("filter", f"{found} in the instrument", advice),
            CheckFinding(
                "converter",
                f"from {min(conversions)} to {max(conversions)} in {_CONVERSIONS} readings",
                "" if works else "switch the instrument off and on, if its converter stands still for longer",
            ),
        )


def _agree(weight: float, digits: int) -> bool:
    """Return whether an integer has the digits of a weight of single precision."""
    tolerance = 0.5 + 1e-6 * abs(digits)
    return any(abs(weight * 10.0**decimals - digits) <= tolerance for decimals in range(_MOST_DECIMALS + 1))


def _integer(words: Sequence[int]) -> int:
    return int(unpack("i", words)[0])
