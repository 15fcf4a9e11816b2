"""An emulated Flintec DAD 141.1, the amplifier of a strain-gauge load cell.

The register map is that of the Flintec DAD 141.1 Technical Manual, Modbus Communication, Rev 2.3; what the
commands do is that of the DAD 141.1 Technical Manual, Rev 2.5: 10.2 (calibration), 10.3 (motion detection),
10.4 (filters), 10.5 (taring and zeroing).

Assumptions, where these say nothing:

- The digital filter is two equal first-order lags in a row. The manual gives a filter of second order with
  Gaussian characteristics and its cut-off; two equal lags with that cut-off settle to 0.1 % within 6 % of the
  times that the manual gives for each setting. Setting 0, the anti-aliasing filter of 17 Hz alone, is emulated
  in the same way, although it falls by 60 dB a decade. Filter mode 1 (FIR) is stored and changes nothing.
- The noise of amplifier and cell is white before the filter.
- Conversions are made on request, not 600 times a second; between two of them the force is interpolated linearly.
  Those before a request are made together once it comes, where the plant keeps its course until then.
- Integer weights are the displayed digits without the decimal point. The ADC value is the filtered signal with
  24 bits.
- The range bits say that the gross weight is beyond the largest or the smallest value to be displayed; the
  converter itself saturates at 1.2 times these.
- Zero tracking follows the filtered weight, noise included, where this stands within its band after a step of at
  most 0.4 d a second; while it is on, the instrument is looked at every 0.1 s. It is set by the command CE with the
  present access code (TAC), then ZT, then CS; a refused one of these gives exception 4.
- The signal is still when the weight has stayed within the no-motion range around one of its values for the
  no-motion time. Setting tare or zero while it is not still is refused with Modbus exception 4, as the command
  language has ERR for it; so is a zero that is more than 2 % of the largest weight away from the calibrated one.
- An address that is not emulated, or a read of what can only be written, gives exception 2; half a 32-bit value
  or a value that is not allowed gives exception 3.
- The device identity reads as 1410 and the device status as the decimal number that the command IS returns.
- A power cycle brings back what was saved of filter and motion detection (WP) and of zero tracking (CS), and forgets
  zero and tare. The instrument is silent for 0.4 s after it, the time that the manual gives for the command SR.
- A request that only reads the set-up makes no conversion, unless something was written before: a look at the set-up
  leaves the noise of a record as it was.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np

from bench.base import DeferredModule, DeviceError
from bench.devices import Identity, LoadCell
from sim_devices.instruments.emulated import EmulatedDevice, Pluggable
from sim_devices.instruments.registers import Register, RegisterInstrument
from sim_devices.wire.modbus import DEVICE_FAILURE, ILLEGAL_VALUE, RegisterError
from sim_devices.world import World

if TYPE_CHECKING:
    from sim_devices.instruments import _flintec_kernels as kernels
else:
    kernels = DeferredModule("sim_devices.instruments._flintec_kernels")

CUTOFF_HZ = (17.0, 18.0, 8.0, 4.0, 3.0, 2.0, 1.0, 0.5, 0.25)
"""3 dB cut-off by filter setting 0 to 8 (Technical Manual, 10.4.2, IIR filter)."""

UNDER_RANGE = 0x0001
OVER_RANGE = 0x0002
NO_MOTION = 0x0010
TARE_SET = 0x0020

RESET_ZERO = 0x01
SET_ZERO = 0x02
RESET_TARE = 0x04
SET_TARE = 0x08
RESET_MAXIMUM = 0x10
TRIGGER_HOLD = 0x20

START_TIME = 0.4
"""Silence after the instrument is switched on, s (Technical Manual, command SR)."""

DEVICE_ID = 1410
ADC_BITS = 24
_FULL_SCALE = 2 ** (ADC_BITS - 1)

_SATURATION = 1.2
_ZERO_SHARE = 0.02
_LAGS_CUTOFF = math.sqrt(math.sqrt(2.0) - 1.0)  # cut-off of two equal lags over that of one
_MEMORY_LAGS = 16.0  # time constants after which two lags have forgotten, to 2e-6
_MOST_TRACKING = 255
_FINE_LAGS = 0.5  # time constants between two looks at the force
_FEW_LOOKS = 4  # looks that are not put off
_MOST_ASKED = 256  # readings whose conversions wait
_NORMALS = 2048  # random numbers drawn at once
_STILL_POLL = 0.05
_STILL_TIMEOUT = 10.0
_SET_UP_REGISTERS = frozenset((0x2106, 0x2110))
_COMMANDS = RESET_ZERO | SET_ZERO | RESET_TARE | SET_TARE | RESET_MAXIMUM | TRIGGER_HOLD
_SAVE_CALIBRATION = 0x0002
_SAVE_SET_UP = 0x0004
_SAVES = 0x0001 | _SAVE_CALIBRATION | _SAVE_SET_UP | 0x0010
_TRACKING_BAND = 0.5  # d for each unit of ZT (10.2.8)
_TRACKING_RATE = 0.4  # d in a second
_TRACKING_LOOK = 0.1  # s
_FIRST_ACCESS_CODE = 17
# The state of the converter, in the order of the kernels, and where its digits stand there.
_STATE = (
    *("_converted", "_input", "_first", "_second", "_noise_first", "_noise_second", "_still_since"),
    *("_reference", "_digits", "_gross", "_peak", "_zero"),
)
_DIGITS = slice(7, 11)
_STATE_OF = attrgetter(*_STATE)


def time_constant(setting: int) -> float:
    """Return the time constant in s of either lag of a filter setting, 0 to 8."""
    return _LAGS_CUTOFF / (2 * math.pi * CUTOFF_HZ[setting])


def reading_interval(setting: int) -> float:
    """Return the time in s between two readings whose noise is nearly independent: half a period at cut-off."""
    return 0.5 / CUTOFF_HZ[setting]


@lru_cache(maxsize=256)
def _fading(lags: float) -> tuple[float, float, float, float]:
    """Return `kernels.fading`; kept, as the instrument mostly converts at even intervals."""
    found: tuple[float, float, float, float] = kernels.fading.py_func(lags)  # type: ignore[attr-defined]
    return found


@dataclass(frozen=True)
class _SetUp:
    """The settings that command WP saves; the factory's values (Technical Manual, 10.3 and 10.4)."""

    filter: int = 3
    filter_mode: int = 0
    motion_range: int = 1  # d
    motion_time: int = 1000  # ms


class EmulatedDAD141(Pluggable, EmulatedDevice, RegisterInstrument, LoadCell):
    """A DAD 141.1 with its load cell: the role, called directly, and a bank of Modbus registers for the wire.

    Every access brings the world up to date first and holds its lock. The filter sees the force as often as
    its cut-off asks for, however seldom it is read; so the instrument is a `Timed` one.

    Parameters
    ----------
    force : callable
        The force on the cell in N, positive in tension, from the plant.
    course : sim_devices.instruments._flintec_kernels.Course, optional
        The same force over time: with it conversions wait until the instrument is asked.
    newtons_per_unit : float
        How the instrument was calibrated: N for each unit that it displays, not 0; 9.80665 for kg.
    zero_newtons : float
        Force in N at which the gross weight reads zero.
    weight_limits : tuple of float
        Smallest (command CI, zero or negative) and largest weight (CM, positive) to be displayed, in units.
    decimals : int
        Digits after the decimal point of the display (DP), 0 to 5.
    step : int
        Step of the last digit (DS): 1, 2, 5, 10, 20, 50, 100, 200 or 500.
    zero_tracking : int
        Zero tracking as it was calibrated (ZT), 0 (off) to 255; 1 as delivered: within ±0.5 d.
    noise : float
        Noise in N rms as filter setting 0 lets it through; zero or positive. Less in proportion to the root of
        the cut-off at other settings: 0.49 times at setting 3.
    samples : int
        Readings that `measure` averages, 1 or more.
    firmware : tuple of int
        Major and minor version that the instrument reports.

    Raises
    ------
    ValueError
        If a parameter is not allowed.
    """

    def __init__(
        self,
        name: str,
        world: World,
        force: Callable[[], float],
        *,
        rng: np.random.Generator,
        newtons_per_unit: float = 1.0,
        zero_newtons: float = 0.0,
        weight_limits: tuple[float, float] = (-60.0, 60.0),
        decimals: int = 3,
        step: int = 1,
        zero_tracking: int = 1,
        noise: float = 5e-4,
        course: kernels.Course | None = None,
        samples: int = 5,
        serial_number: int = 1410237,
        firmware: tuple[int, int] = (1, 10),
    ) -> None:
        super().__init__(name, world)
        self._rng = rng
        self._block = np.empty(0)
        """Normal random numbers, and how many of them are used."""
        self._used = 0
        if not (math.isfinite(newtons_per_unit) and newtons_per_unit != 0):
            raise ValueError(f"newtons_per_unit: expected a number other than 0, got {newtons_per_unit}")
        if not 0 <= decimals <= 5:
            raise ValueError(f"decimals: allowed are 0 to 5, got {decimals}")
        if step not in (1, 2, 5, 10, 20, 50, 100, 200, 500):
            raise ValueError(f"step: allowed are 1, 2 and 5, times 1, 10 and 100, got {step}")
        low, high = (round(limit * int(10**decimals)) for limit in weight_limits)
        if not -999_999 <= low <= 0 < high <= 999_999:
            raise ValueError(f"weight_limits: allowed are -999999 to 0 and 1 to 999999 digits, got {low} and {high}")
        if not 0 <= zero_tracking <= _MOST_TRACKING:
            raise ValueError(f"zero_tracking: allowed are 0 to {_MOST_TRACKING}, got {zero_tracking}")
        if not noise >= 0:
            raise ValueError(f"noise: expected zero or a positive number, got {noise}")
        if samples < 1:
            raise ValueError(f"samples: expected 1 or more, got {samples}")
        self._now = world.clock.now
        self.serial_number = serial_number
        self.firmware = firmware
        self.frozen = False
        """A fault: the converter stands still, and with it everything that is read."""
        self._force = force
        self._course = course
        self._asked: list[float] = []
        """Instants up to which conversions wait, s, and where the world stood before the first of them."""
        self._asked_since = world.time
        self._kept = 0.0 if course is None else (course.forces.size - 3) * course.step
        """Time for which the course of the force is kept, s."""
        self._newtons_per_unit = newtons_per_unit
        self._zero_newtons = zero_newtons
        self._lowest, self._highest = low, high
        self._scale = int(10**decimals)
        self._decimals = decimals
        self._step = step
        self._noise = noise / abs(newtons_per_unit)
        self._samples = samples
        self._saved = _SetUp()
        self._saved_tracking = zero_tracking
        self._access_code = _FIRST_ACCESS_CODE
        self._span = _SATURATION * max(self._highest, -self._lowest) / self._scale
        self._peak = 0
        self._set_map_up(self._register_map())
        self._written = True
        self.power_cycle()
        self._starts_at = -math.inf
        if course is not None:
            # Compiled before a driver waits for an answer.
            self._convert_along(course)
        world.add(self, catch_up=self._catch_up)

    # The power supply.

    def power_cycle(self) -> None:
        """Switch the instrument off and on again."""
        with self.world.at_present():
            self._use(self._saved)
            self._tracking = self._saved_tracking
            self._calibrating = False
            self._zero = 0.0
            self._tare = self._hold = 0
            self._tare_set = False
            self._settle()
            self._peak = self._gross
            self._starts_at = self.world.time + START_TIME

    @property
    def answering(self) -> bool:
        """Whether the instrument answers requests at the clock's present time."""
        return self.plugged_in and self.world.clock.now() >= self._starts_at

    def freeze(self) -> None:
        """Let the converter stand still, and with it everything that is read."""
        with self.world.at_present():
            self.frozen = True

    def thaw(self) -> None:
        """Undo `freeze`."""
        with self.world.at_present():
            self.frozen = False

    # The conversion.

    def deadline(self) -> float:
        """Return when the filter has to look at the force next, in laboratory seconds, if it is asked by now."""
        if self.frozen:
            return math.inf
        now = self._now()
        if self._course is not None and (self._asked or now - self._converted > self._near):
            if self._may_wait(self._course, now):
                return math.inf
            if self._asked:
                self._catch_up()
                self._asked.clear()
        if self._tracking:
            return self._converted + _TRACKING_LOOK
        if now - self._converted <= self._near:
            # As a rule, and what the kernel says of it.
            return self._converted + self._fine
        due: float = kernels.next_look.py_func(  # type: ignore[attr-defined]
            self._converted, now, self._conversion
        )
        return due

    def _may_wait(self, course: kernels.Course, now: float) -> bool:
        """Return whether the conversions for a reading at the present can wait, and note that they do."""
        asked = self._asked
        # Zero tracking leaves the zero between two digits.
        if self._tracking or not course.is_known or not self._zero.is_integer():
            return False
        if not asked:
            if self._memory + kernels.COARSE > self._kept:
                return False
            # Before the plant goes on to the present.
            self._asked_since = self.world.time
        elif asked[-1] == now:
            return True
        elif len(asked) == _MOST_ASKED or now - max(self._converted, asked[0] - self._memory) > self._kept:
            self._catch_up()
            self._asked_since = self.world.time
        asked.append(now)
        return True

    def _catch_up(self) -> None:
        """Make the conversions that have waited, up to where the world stands."""
        if self._asked and self._course is not None:
            self._convert_along(self._course)

    def _convert_along(self, course: kernels.Course) -> None:
        until = self.world.time
        state = np.array(_STATE_OF(self), dtype=np.float64)
        point = until - course.since_point()
        done = 0
        while True:
            more, self._asked_since, taken = kernels.convert_along(
                state,
                self._conversion,
                np.array(self._asked[done:]),
                self._asked_since,
                until,
                course.forces,
                course.step,
                point,
                course.tolerance,
                self._block[self._used :],
            )
            done += more
            self._used += taken
            if self._block.size - self._used >= 2:
                break
            self._draw_more()
        del self._asked[:done]
        values = state.tolist()
        values[_DIGITS] = map(int, values[_DIGITS])
        vars(self).update(zip(_STATE, values, strict=True))

    def _draw_more(self) -> None:
        self._block = np.concatenate((self._block[self._used :], self._rng.standard_normal(_NORMALS)))
        self._used = 0

    def _draw(self, deviation: float) -> float:
        if self._used == self._block.size:
            self._draw_more()
        self._used += 1
        return deviation * self._block.item(self._used - 1)

    def expire(self) -> None:
        """Look at the force."""
        self._convert()

    def _signal(self) -> float:
        """Return the weight at this instant, in units, as far as the converter goes."""
        weight = (self._force() - self._zero_newtons) / self._newtons_per_unit
        limit = self._span
        return min(max(weight, -limit), limit)

    def _use(self, set_up: _SetUp) -> None:
        self._set_up = set_up
        self._lag = time_constant(set_up.filter)
        self._spread = self._noise * math.sqrt(time_constant(0) / self._lag)
        self._motion_time = set_up.motion_time / 1000
        # How long before a reading the force matters to it.
        self._memory = _MEMORY_LAGS * self._lag + self._motion_time + 2 * kernels.COARSE
        self._fine = _FINE_LAGS * self._lag
        self._near = _FEW_LOOKS * self._fine
        self._conversion = kernels.SetUp(
            self._lag,
            self._spread,
            self._memory,
            self._fine,
            _MEMORY_LAGS * self._lag + kernels.COARSE,
            float(set_up.motion_range),
            self._span,
            self._newtons_per_unit,
            self._zero_newtons,
            float(self._scale),
            float(self._step),
        )

    def _settle(self) -> None:
        """Begin with a filter that has settled, at this instant."""
        self._converted = self._still_since = self.world.time
        self._input = self._first = self._second = self._signal()
        # The noise behind the first lag has twice the variance of that behind the second, and a covariance with
        # it that equals the latter.
        spread = self._spread
        self._noise_second = self._draw(spread)
        self._noise_first = self._noise_second + self._draw(spread)
        self._display()
        self._reference = self._digits

    def _convert(self) -> None:
        """Bring the filter from the last conversion to this instant."""
        now = self.world.time
        elapsed = now - self._converted
        lags = elapsed / self._lag
        if self.frozen or lags < kernels.LEAST_LAGS:
            return
        decay, along, across, alone = _fading(lags)
        # Two equal lags with an input that runs straight from the last look to this one.
        signal = self._signal()
        trail = (signal - self._input) / lags
        first = self._first - self._input + trail
        second = self._second - self._input + 2 * trail
        self._first = signal - trail + first * decay
        self._second = signal - 2 * trail + (second + first * lags) * decay
        self._input = signal
        self._converted = now
        spread = self._spread
        fresh, other = self._draw(spread), self._draw(spread)
        self._noise_second = decay * (self._noise_second + lags * self._noise_first) + along * fresh + across * other
        self._noise_first = decay * self._noise_first + alone * fresh
        if self._tracking:
            self._track(elapsed)
        self._display()
        if abs(self._digits - self._reference) > self._set_up.motion_range:
            self._reference = self._digits
            self._still_since = now

    def _track(self, elapsed: float) -> None:
        """Move the zero towards the weight, if that is near enough (10.2.8)."""
        offset = (self._second + self._noise_second) * self._scale - self._zero
        limit = _TRACKING_RATE * self._step * elapsed
        shift = min(max(offset, -limit), limit)
        zero = self._zero + shift
        near = abs(offset - shift) <= _TRACKING_BAND * self._tracking * self._step
        if near and abs(zero) <= _ZERO_SHARE * self._highest:
            self._zero = zero

    def _display(self) -> None:
        weight = self._second + self._noise_second
        self._digits = round(weight * self._scale / self._step) * self._step
        self._weigh()
        if self._gross > self._peak:
            self._peak = self._gross

    def _weigh(self) -> None:
        """Count the gross weight from the zero."""
        if self._zero.is_integer():
            self._gross = self._digits - int(self._zero)
        else:
            weight = (self._second + self._noise_second) * self._scale - self._zero
            self._gross = round(weight / self._step) * self._step

    @property
    def _adc(self) -> int:
        code = round((self._second + self._noise_second) / self._span * _FULL_SCALE)
        return int(min(max(code, -_FULL_SCALE), _FULL_SCALE - 1))

    @property
    def _net(self) -> int:
        return self._gross - self._tare

    @property
    def _still(self) -> bool:
        return self._converted - self._still_since >= self._motion_time

    @property
    def _qualifier(self) -> int:
        return (
            (UNDER_RANGE if self._digits < self._lowest else 0)
            | (OVER_RANGE if self._digits > self._highest else 0)
            | (NO_MOTION if self._still else 0)
            | (TARE_SET if self._tare_set else 0)
        )

    @property
    def _status(self) -> int:
        return (1 if self._still else 0) | (2 if self._zero else 0) | (4 if self._tare_set else 0)

    # The registers.

    def read_registers(self, address: int, count: int) -> list[int]:
        """Return `count` registers from `address` on, of one instant; errors are those of the base class."""
        if address in _SET_UP_REGISTERS and not self._written:
            reads = self._known_reads.get((address, count)) or self._reads(address, count)
            with self.world.lock:
                return list(
                    reads.words.unpack_from(reads.values.pack(*[read() for read in reads.read]), reads.skipped)
                )
        return super().read_registers(address, count)

    def write_registers(self, address: int, values: list[int]) -> None:
        """Write registers from `address` on, in whole values; errors are those of the base class."""
        super().write_registers(address, values)
        self._written = True

    def _begin(self) -> None:
        self.world.lock.acquire()
        try:
            self.world.advance_locked()
            if self._asked:
                self._catch_up()
            self._convert()
            self._written = False
        except BaseException:
            self.world.lock.release()
            raise

    def _end(self, error: BaseException | None) -> None:  # noqa: ARG002
        self.world.lock.release()

    def _check_write(self, register: Register, whole: bool) -> None:
        # Here a register that can only be read is refused as such, also where half of it is written.
        super()._check_write(register, whole or register.write is None)

    def _register_map(self) -> tuple[Register, ...]:
        major, minor = self.firmware
        return (
            Register("gross weight", 0x2000, "F32", lambda: self._gross / self._scale),
            Register("net weight", 0x2002, "F32", lambda: self._net / self._scale),
            Register("gross digits", 0x2020, "I32", lambda: self._gross),
            Register("net digits", 0x2022, "I32", lambda: self._net),
            Register("ADC value", 0x202A, "I32", lambda: self._adc),
            Register("device identity", 0x202C, "I32", lambda: DEVICE_ID),
            Register("firmware version", 0x202E, "I32", lambda: minor << 8 | major),
            Register("device status", 0x2030, "I32", lambda: 1000 * self._status),
            Register("serial number", 0x2034, "I32", lambda: self.serial_number),
            Register("weight status", 0x2060, "U16", lambda: self._qualifier),
            Register("command", 0x2061, "U16", None, self._command),
            Register("save", 0x2066, "U16", None, self._save),
            Register("peak weight", 0x2080, "F32", lambda: self._peak / self._scale),
            Register("peak digits", 0x2082, "I32", lambda: self._peak),
            Register("hold weight", 0x2084, "F32", lambda: self._hold / self._scale),
            Register("hold digits", 0x2086, "I32", lambda: self._hold),
            self._set_up_register("filter", 0x2106, 0, len(CUTOFF_HZ) - 1),
            self._set_up_register("filter_mode", 0x2110, 0, 1),
            self._set_up_register("motion_range", 0x2112, 1, 65535),
            self._set_up_register("motion_time", 0x2114, 1, 65535),
            Register("zero tracking", 0x2122, "I32", lambda: self._tracking, self._set_tracking),
            Register("access code", 0x2204, "I32", lambda: self._access_code, self._open_calibration),
            Register("tare digits", 0x2118, "I32", lambda: self._tare),
            Register("largest weight", 0x220C, "I32", lambda: self._highest),
            Register("smallest weight", 0x220E, "I32", lambda: self._lowest),
            Register("decimals", 0x2214, "I32", lambda: self._decimals),
            Register("display step", 0x2216, "I32", lambda: self._step),
            Register("gross digits with status", 0x3300, "I32", lambda: self._gross),
            Register("net digits with status", 0x3302, "I32", lambda: self._net),
            Register("status of digits", 0x3304, "U16", lambda: self._qualifier),
            Register("gross weight with status", 0x3500, "F32", lambda: self._gross / self._scale),
            Register("net weight with status", 0x3502, "F32", lambda: self._net / self._scale),
            Register("status of weights", 0x3504, "U16", lambda: self._qualifier),
        )

    def _set_up_register(self, field: str, address: int, low: int, high: int) -> Register:
        def write(value: int) -> None:
            if not low <= value <= high:
                raise RegisterError(ILLEGAL_VALUE, f"{field}: allowed are {low} to {high}, got {value}")
            changed = replace(self._set_up, **{field: value})
            if changed != self._set_up:
                self._use(changed)
                self._settle()

        return Register(field, address, "I32", lambda: getattr(self._set_up, field), write)

    # The commands.

    def _command(self, value: int) -> None:
        if not value or value & ~_COMMANDS:
            raise RegisterError(ILLEGAL_VALUE, f"command 0x{value:04X} does not exist")
        if value & RESET_ZERO:
            self._zero = 0.0
            self._weigh()
        if value & SET_ZERO:
            self._check_still("set zero")
            if abs(self._digits) > _ZERO_SHARE * self._highest:
                raise RegisterError(DEVICE_FAILURE, "set zero: too far from the calibrated zero")
            self._zero = float(self._digits)
            self._weigh()
        if value & RESET_TARE:
            self._tare, self._tare_set = 0, False
        if value & SET_TARE:
            self._check_still("set tare")
            self._tare, self._tare_set = self._gross, True
        if value & RESET_MAXIMUM:
            self._peak = self._gross
        if value & TRIGGER_HOLD:
            self._hold = self._gross

    def _check_still(self, command: str) -> None:
        if not self._still:
            raise RegisterError(DEVICE_FAILURE, f"{command}: the signal is not still")

    def _save(self, value: int) -> None:
        if not value or value & ~_SAVES:
            raise RegisterError(ILLEGAL_VALUE, f"saving 0x{value:04X} is not emulated")
        if value & _SAVE_SET_UP:
            self._saved = self._set_up
        if value & _SAVE_CALIBRATION:
            self._check_calibrating("save calibration")
            self._saved_tracking = self._tracking
            self._access_code += 1
            self._calibrating = False

    def _open_calibration(self, value: float) -> None:
        if value != self._access_code:
            raise RegisterError(DEVICE_FAILURE, f"calibration: the access code is not {value:g}")
        self._calibrating = True

    def _set_tracking(self, value: float) -> None:
        self._check_calibrating("zero tracking")
        if not 0 <= value <= _MOST_TRACKING:
            raise RegisterError(ILLEGAL_VALUE, f"zero tracking: allowed are 0 to {_MOST_TRACKING}, got {value:g}")
        self._tracking = int(value)

    def _check_calibrating(self, command: str) -> None:
        if not self._calibrating:
            raise RegisterError(DEVICE_FAILURE, f"{command}: no calibration is open")

    # The role.

    @property
    def identity(self) -> Identity:
        """Identity of the instrument."""
        major, minor = self.firmware
        return Identity("Flintec", "DAD 141.1", str(self.serial_number), f"{major}.{minor:02d}")

    def measure(self) -> dict[str, float]:
        """Measure the force in N, as a mean of readings that are half a period of the cut-off apart."""
        begin = self.world.clock.now()
        interval = reading_interval(self._set_up.filter)
        forces = []
        for sample in range(self._samples):
            self.world.clock.sleep_until(begin + sample * interval)
            forces.append(self._reading())
        return {f"{self.name}_force": math.fsum(forces) / len(forces)}

    def glance(self) -> dict[str, float]:
        """Measure the force in N by one reading."""
        return {f"{self.name}_force": self._reading()}

    def tare(self) -> None:
        """Set the tare, as soon as the signal is still; waits 10 s for it at most.

        Raises `DeviceError` if the signal does not become still.
        """
        clock = self.world.clock
        end = clock.now() + _STILL_TIMEOUT
        while True:
            try:
                self.write_registers(0x2061, [SET_TARE])
            except RegisterError as refusal:
                if clock.now() >= end:
                    raise DeviceError(self.name, f"the tare was refused: {refusal}") from refusal
                clock.sleep(_STILL_POLL)
            else:
                return

    def clear_tare(self) -> None:
        """Reset the tare."""
        self.write_registers(0x2061, [RESET_TARE])

    def safe(self) -> None:
        """Do nothing: a load cell is safe in any state."""

    def _reading(self) -> float:
        with self._request():
            if self._qualifier & (UNDER_RANGE | OVER_RANGE):
                side = "over" if self._qualifier & OVER_RANGE else "under"
                raise DeviceError(self.name, f"is {side} its range: the weight is {self._gross / self._scale}")
            zero = 0.0 if self._tare_set else self._zero_newtons
            return self._newtons_per_unit * self._net / self._scale + zero
