"""An emulated LabJack T7 as a bank of Modbus registers.

The register map is that of `ljm_constants.json` (repository labjack/ljm_constants), the behaviour that of the
LabJack T-series datasheet: 14.1.7 (average, minimum and maximum), 14.3.0 (T7 analog inputs), 15.0 (analog
outputs), A-3-1 (noise and resolution), the datasheet of the LJTick-DAC, and the descriptions of the watchdog
registers in the map; LabJack's letter of volatility for USER_RAM, which is a plain memory here, as no script runs.

Assumptions, where these say nothing:

- A refused value gives Modbus exception 4 with the reason in LAST_ERR_DETAIL; an address that is not emulated,
  or a read of a register that can only be written, gives exception 2; a write of half a 32-bit value gives
  exception 3; changing a watchdog setting while the watchdog is enabled gives exception 4.
- A refusal whose detail is not known leaves 0 in LAST_ERR_DETAIL.
- What is written to AIN#_EF_READ_B and C, which the map has as writable, stays there until the next burst.
- A register of the watchdog counts as written to the flash memory with every write, also of the value that it has.
- A power cycle drops the connections; DAC and LJTick-DAC outputs are at 0 V after it.
- A burst longer than the 0.18 s that the datasheet allows is refused with exception 4.
- DAC outputs clip at 0 and 5 V, LJTick-DAC outputs at ±10 V; their steps are even, without error of gain or
  offset. The register of a DAC reads back what was written.
- After a timeout the watchdog timer begins again, so that the actions are repeated; doing them again changes
  nothing while there is no communication, so they are done once.
- WAIT_US_BLOCKING, which the versions of the map at hand do not have, is a UINT32 at 61590 that takes 0 to
  100 000 µs; a longer wait is refused with exception 4. The frames of a packet of function 76 are carried out one
  after the other, those behind a wait after it.
- A single conversion takes no laboratory time; a burst takes what its scan rate says.
- Reading the register of a single digital line makes it an input, as the map says that it configures the
  direction too; an input that nothing drives is pulled high, as all lines are after power-up.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from bench.devices import Identity
from sim_devices.instruments.emulated import Pluggable
from sim_devices.instruments.registers import FrameParts, Register, RegisterInstrument
from sim_devices.noise import normals
from sim_devices.wire.modbus import DEVICE_FAILURE, ILLEGAL_ADDRESS, Packet, RegisterError
from sim_devices.world import World

CHANNELS = 14
RANGES = (10.0, 1.0, 0.1, 0.01)
SINGLE_ENDED = 199

ERROR_RANGE = 2370
ERROR_SETTLING = 2371
ERROR_NEGATIVE_CHANNEL = 2373
ERROR_RESOLUTION = 2375

CODES = 65536
RAIL = 1.06
"""A range of ±10 V reads to ±10.6 V before it clips, and the others in proportion.

The datasheet's A-3-2 shows a signal range a little beyond the nominal one; that it is 6 %, the same for every
range and symmetrical, is an assumption.
"""

CONVERSIONS = (1, 2, 3, 6, 11, 20, 35, 64)
"""How many conversions of the 16-bit converter one reading averages, by resolution index 1 to 8.

The datasheet gives 16 bits of effective resolution at index 1 and 19 bits at index 8 (14.3.0), where effective
resolution is span over rms noise (A-3-1). The steps in between are taken as even, and the noise as white, so
that a reading of n conversions has 1/√n of the noise of one and steps n times as fine:

index        1    2    3    4    5    6    7    8
noise at ±10 V, µV rms
            323  229  187  132   98   72   55   40

That the noise is in proportion to the range is an assumption: the real one falls less at high gain.
"""

DAC_STEP = 5.0 / 4096
"""Step in V of DAC0 and DAC1, which have 12 bits (15.0)."""

TDAC_STEP = 20.0 / 16384
"""Step in V of an LJTick-DAC, which has 14 bits (its datasheet)."""

_DEFAULT_INDEX = 8  # what index 0 means to a command-response reading of a T7
_DEFAULT_STREAM_INDEX = 1  # and to a burst, as ljm_constants.json says of STREAM_RESOLUTION_INDEX
_EF_OFF, _EF_AVERAGE = 0, 3
_MOST_SAMPLES = 16384
_LONGEST_BURST = 0.18
_LONGEST_WAIT = 100_000  # µs
_LONGEST_SETTLING = 50_000.0
_LONGEST_STREAM_SETTLING = 4_400.0
_TDACS = 23
_USER_RAM = 40
_DIOS = 23
_DAC_TOP = 5.0
_TDAC_TOP = 10.0

ALL_DIO = (1 << _DIOS) - 1
"""Mask of all digital lines."""


class Burst(NamedTuple):
    """Result of one burst of conversions, V."""

    average: float
    maximum: float
    minimum: float


_NO_BURST = Burst(0.0, 0.0, 0.0)


class _DetailedError(RegisterError):
    """A refusal with a detail for LAST_ERR_DETAIL."""

    def __init__(self, detail: int, message: str) -> None:
        super().__init__(DEVICE_FAILURE, message)
        self.detail = detail


@dataclass
class _Watchdog:
    enabled: int = 0
    timeout: int = 0
    strict: int = 0
    key: int = 0
    dio_enabled: int = 0
    dio_state: int = 0
    dio_direction: int = 0
    dio_inhibit: int = 0
    dac0_enabled: int = 0
    dac0: float = 0.0
    dac1_enabled: int = 0
    dac1: float = 0.0


class _Scale(NamedTuple):
    """What a reading of the converter is made of, V."""

    noise: float
    step: float
    lowest: float
    highest: float


def _scale(volts: float, index: int) -> _Scale:
    rail = RAIL * volts
    code = 2 * rail / CODES
    conversions = CONVERSIONS[index - 1]
    step = code / conversions
    return _Scale(code / math.sqrt(conversions), step, -rail, rail - step)


_SCALES = {(volts, index): _scale(volts, index) for volts in RANGES for index in range(1, len(CONVERSIONS) + 1)}
"""By range and resolution index."""


class Scan(Protocol):
    """The wires at the first inputs, with the conversion of each, in one call."""

    count: int
    """How many inputs."""

    def __call__(self, scales: NDArray[np.float64], draw: Callable[[], float]) -> Sequence[float] | None:
        """Return a reading (V) of each input, as conversions one after the other give it.

        Parameters
        ----------
        scales : numpy.ndarray, shape (14, 4)
            Noise, step, lowest and highest reading of each input, V.
        draw : callable
            Returns the next number of the standard normal distribution, one a conversion.

        Returns
        -------
        sequence of float or None
            None, and nothing drawn, if the inputs have to be converted one by one.
        """


def _ground() -> float:
    return 0.0


@dataclass
class _Input:
    range: float = 10.0
    negative: int = SINGLE_ENDED
    resolution: int = 0
    settling: float = 0.0
    feature: int = _EF_OFF
    samples: int = 200
    scan_rate: float = 6000.0
    burst: Burst = _NO_BURST
    scale: _Scale = _SCALES[10.0, _DEFAULT_INDEX]

    def set_up(self, volts: float, resolution: int) -> None:
        """Take a range and a resolution index, and what a single conversion is made of then."""
        self.range = volts
        self.resolution = resolution
        self.scale = _SCALES[volts, resolution or _DEFAULT_INDEX]


class EmulatedT7(Pluggable, RegisterInstrument):
    """A LabJack T7 as a bank of Modbus registers; a `Timed` instrument because of its watchdog.

    Every access first brings the world up to date and holds its lock. A burst lets the clock pass, as the
    real instrument answers only after the burst.

    Parameters
    ----------
    inputs : mapping of int to callable
        Voltage in V at an analog input by its number, 0 to 13; an input that is not named is grounded.

    Attributes
    ----------
    flash_writes : int
        How often a register of the flash memory was written, since the instrument was made.

    Raises
    ------
    ValueError
        If an input does not exist.
    """

    def __init__(
        self,
        world: World,
        inputs: Mapping[int, Callable[[], float]],
        *,
        rng: np.random.Generator,
        serial_number: int = 470012345,
        firmware: float = 1.0300,
    ) -> None:
        for channel in inputs:
            if not 0 <= channel < CHANNELS:
                raise ValueError(f"inputs: expected channels 0 to {CHANNELS - 1}, got {channel}")
        self.world = world
        self.serial_number = serial_number
        self.firmware = firmware
        self._sources = {channel: inputs.get(channel, _ground) for channel in range(CHANNELS)}
        self._draw = normals(rng).__next__
        self._held: dict[int, float] | None = None
        self._scan: Scan | None = None
        self._scales = np.zeros((CHANNELS, len(_Scale._fields)))
        self._watchdog = _Watchdog()
        self._expired_at: float | None = None
        self._followers: list[Callable[[], None]] = []
        self._restart_followers: list[Callable[[], None]] = []
        self.flash_writes = 0
        self._announce = world.add(self, announces=True)
        self._start()
        self._set_map_up(self._register_map())

    def _start(self) -> None:
        """Set everything up that is not kept in the flash memory."""
        self._inputs = [_Input() for _ in range(CHANNELS)]
        self._scales[:] = [settings.scale for settings in self._inputs]
        self._are_single_ended = True
        self._stream_index = 0
        self._stream_settling = 0.0
        self._dacs = [0.0, 0.0]
        self._tdac_codes = [0] * _TDACS
        self._dio_state = 0
        self._dio_direction = 0
        self._dio_inhibit = 0
        self._last_error = 0
        self._user_ram = [0.0] * _USER_RAM
        self._expired_at = None
        self._due = self.world.time + self._watchdog.timeout if self._watchdog.enabled else math.inf
        self._announce(self._due)

    def power_cycle(self) -> None:
        """Switch the instrument off and on: what is in its RAM is lost, what is in its flash memory stays.

        All digital lines are inputs then, which are pulled high (datasheet 24.0); the watchdog runs again if it is
        enabled (23.0); the connections are lost.
        """
        with self.world.at_present():
            self._start()
            self._set_map_up(self._register_map())
            for follow in self._restart_followers:
                follow()
            self._lead()

    def freeze(self) -> None:
        """Let each input stand at its next reading."""
        self._held = {}

    def thaw(self) -> None:
        """Undo `freeze`."""
        self._held = None

    def scan_by(self, scan: Scan | None) -> None:
        """Convert the first inputs in one call wherever a packet reads all of them first; None for one by one."""
        self._scan = scan

    def on_restart(self, follow: Callable[[], None]) -> None:
        """Call `follow()` at each power cycle."""
        self._restart_followers.append(follow)

    @property
    def identity(self) -> Identity:
        """Identity of the instrument."""
        return Identity("LabJack", "T7", str(self.serial_number), f"{self.firmware:.4f}")

    # The outputs as the laboratory sees them.

    def dac_volts(self, number: int) -> float:
        """Return the voltage in V at DAC0 or DAC1, in its steps."""
        return DAC_STEP * round(self._dacs[number] / DAC_STEP)

    def tdac_volts(self, number: int) -> float:
        """Return the voltage in V at an output of an LJTick-DAC, 0 to 22, in its steps."""
        return TDAC_STEP * self._tdac_codes[number]

    def dio_level(self, number: int, *, pulled_down: bool = False) -> bool:
        """Return the level of a digital line, 0 to 22.

        The instrument pulls a line that is not an output weakly high; `pulled_down` says that the load pulls it
        low all the same.
        """
        levels = self._dio_state & self._dio_direction if pulled_down else self._levels()
        return bool(levels >> number & 1)

    def add_follower(self, follow: Callable[[], None]) -> None:
        """Call `follow()` now, after every request that may change an output, and when the watchdog acts.

        A load at the outputs reads them then; the world stands at that instant.
        """
        with self.world.at_present():
            self._followers.append(follow)
            follow()

    @property
    def watchdog_expired(self) -> bool:
        """Whether the watchdog has run out since the last communication that feeds it."""
        return self._expired_at is not None

    # The requests.

    def _begin(self) -> None:
        """Begin a request: time first, then the watchdog, which any communication feeds unless strict."""
        world, dog = self.world, self._watchdog
        world.lock.acquire()
        try:
            world.advance_locked()
            if not dog.enabled:
                return
            if not dog.strict:
                self._due = world.time + dog.timeout
                if self._expired_at is not None:
                    self._expired_at = None
                    self._announce(self._due)
            elif self._expired_at is not None:
                # In strict mode the timer has gone on; what the request changes lasts until it next runs out.
                periods = math.floor((world.time - self._expired_at) / dog.timeout) + 1
                self._due = self._expired_at + periods * dog.timeout
                self._expired_at = None
                self._announce(self._due)
        except BaseException:
            world.lock.release()
            raise

    def _end(self, error: BaseException | None) -> None:
        if error is None and not self._touched:
            self.world.lock.release()
            return
        try:
            if isinstance(error, RegisterError):
                self._last_error = error.detail if isinstance(error, _DetailedError) else 0
            if self._touched:
                self._lead()
        finally:
            self.world.lock.release()

    def _wait(self, microseconds: float) -> None:
        if microseconds > _LONGEST_WAIT:
            raise RegisterError(DEVICE_FAILURE, f"WAIT_US_BLOCKING: {microseconds:g} is not 0 to {_LONGEST_WAIT}")
        world = self.world
        world.clock.sleep_until(world.time + 1e-6 * microseconds)
        world.advance()

    def _lead(self) -> None:
        self._touched = False
        for follow in self._followers:
            follow()

    # The watchdog.

    def deadline(self) -> float:
        """Return when the watchdog runs out, in laboratory seconds; infinity while it does not run."""
        return self._due

    def expire(self) -> None:
        """Take the actions of the watchdog."""
        dog = self._watchdog
        if dog.dac0_enabled:
            self._set_dac(0, dog.dac0)
        if dog.dac1_enabled:
            self._set_dac(1, dog.dac1)
        if dog.dio_enabled:
            affected = ~dog.dio_inhibit & ALL_DIO
            self._dio_state = self._dio_state & ~affected | dog.dio_state & affected
            self._dio_direction = self._dio_direction & ~affected | dog.dio_direction & affected
        self._expired_at = self._due
        self._due = math.inf
        self._lead()

    def _feed(self) -> None:
        self._due = self.world.time + self._watchdog.timeout
        self._expired_at = None
        self._announce(self._due)

    def _enable_watchdog(self, value: float) -> None:
        if value not in (0, 1):
            raise RegisterError(DEVICE_FAILURE, "WATCHDOG_ENABLE: allowed are 0 and 1")
        if value and not self._watchdog.timeout:
            raise RegisterError(DEVICE_FAILURE, "WATCHDOG_ENABLE: WATCHDOG_TIMEOUT_S is 0")
        self.flash_writes += 1
        self._watchdog.enabled = int(value)
        if value:
            self._feed()
        else:
            self._due = math.inf
            self._expired_at = None

    def _clear_watchdog(self, value: float) -> None:
        dog = self._watchdog
        if dog.enabled and (not dog.strict or value == dog.key):
            self._feed()

    # The analog inputs.

    def convert(self, channel: int) -> float:
        """Return one reading of an input in V, as a read of AIN does."""
        with self._request():
            return self._convert(channel)

    def burst(self, channel: int) -> Burst:
        """Let a burst of conversions pass and return what it gave, as a read of AIN_EF_READ_A does.

        Raises `RegisterError` if the input is not set up for it, or the burst would take longer than 0.18 s.
        """
        with self._request():
            settings = self._inputs[channel]
            if settings.feature != _EF_AVERAGE:
                raise RegisterError(ILLEGAL_ADDRESS, f"AIN{channel}_EF_INDEX is not {_EF_AVERAGE}")
            duration = settings.samples / settings.scan_rate
            if duration > _LONGEST_BURST:
                raise RegisterError(DEVICE_FAILURE, f"a burst of {duration:g} s is too long")
            world = self.world
            begin, scan_rate = world.time, settings.scan_rate
            readings = []
            scale = _SCALES[settings.range, self._stream_index or _DEFAULT_STREAM_INDEX]
            sleep_until, advance, convert = world.clock.sleep_until, world.advance_locked, self._convert
            for sample in range(1, settings.samples + 1):
                sleep_until(begin + sample / scan_rate)
                advance()
                readings.append(convert(channel, scale))
            settings.burst = Burst(math.fsum(readings) / len(readings), max(readings), min(readings))
            return settings.burst

    def _convert(self, channel: int, scale: _Scale | None = None) -> float:
        held = self._held
        if held is not None and channel in held:
            return held[channel]
        settings = self._inputs[channel]
        volts = self._sources[channel]()
        if settings.negative != SINGLE_ENDED:
            volts -= self._sources[settings.negative]()
        noise, step, lowest, highest = scale or settings.scale
        volts = round((volts + noise * self._draw()) / step) * step
        if not lowest <= volts <= highest:
            volts = min(max(volts, lowest), highest)
        if held is not None:
            held[channel] = volts
        return volts

    def _carrying_out(
        self,
        parts: Sequence[FrameParts],
        unpack: Callable[[bytes], tuple[float, ...]],
        pack: Callable[..., bytes],
    ) -> Packet:
        """Return what carries frames out; those that only read, and begin with a scan, have it in one call."""
        scan, first, left = self._scan, 0, [] if self._scan is None else self._conversions(self._scan.count)
        while left and first < len(parts) and left[: len(parts[first][0])] == list(parts[first][0]):
            left = left[len(parts[first][0]) :]
            first += 1
        if scan is None or left or any(registers for _, registers in parts):
            return super()._carrying_out(parts, unpack, pack)
        one_by_one, lead = self._conversions(scan.count), self._lead
        draw, scales = self._draw, self._scales

        def read_scan(packet: bytes) -> bytes:  # noqa: ARG001
            volts = scan(scales, draw) if self._held is None and self._are_single_ended else None
            values = [read() for read in one_by_one] if volts is None else [*volts]
            for readers, _ in parts[first:]:
                for read in readers:
                    values.append(read())
                if self._touched:
                    lead()
            return pack(*values)

        return read_scan

    def _conversions(self, count: int) -> list[Callable[[], float]]:
        """Return what converts the first inputs, for the register map."""
        return [read for n in range(count) if (read := self._named[f"AIN{n}"].read) is not None]

    def _set_range(self, channel: int, value: float) -> None:
        wanted = value or RANGES[0]  # 0 stands for the default
        for each in RANGES:
            if math.isclose(wanted, each, rel_tol=1e-6):
                self._set_input_up(channel, each, self._inputs[channel].resolution)
                return
        raise _DetailedError(ERROR_RANGE, f"AIN{channel}_RANGE: {value:g} is none of {RANGES}")

    def _set_negative(self, channel: int, value: float) -> None:
        if value != SINGLE_ENDED and not (channel % 2 == 0 and value == channel + 1):
            raise _DetailedError(ERROR_NEGATIVE_CHANNEL, f"AIN{channel}_NEGATIVE_CH: {value:g} is not allowed")
        self._inputs[channel].negative = int(value)
        self._are_single_ended = all(settings.negative == SINGLE_ENDED for settings in self._inputs)

    def _checked_resolution(self, value: float) -> int:
        if not 0 <= value <= len(CONVERSIONS):
            raise _DetailedError(ERROR_RESOLUTION, f"resolution index: {value:g} is not 0 to {len(CONVERSIONS)}")
        return int(value)

    def _checked_settling(self, value: float, longest: float) -> float:
        if not 0 <= value <= longest:
            raise _DetailedError(ERROR_SETTLING, f"settling: {value:g} µs is not 0 to {longest:g} µs")
        return value

    def _set_index(self, channel: int, value: float) -> None:
        self._set_input_up(channel, self._inputs[channel].range, self._checked_resolution(value))

    def _set_input_up(self, channel: int, volts: float, resolution: int) -> None:
        self._inputs[channel].set_up(volts, resolution)
        self._scales[channel] = self._inputs[channel].scale

    def _set_settling(self, channel: int, value: float) -> None:
        self._inputs[channel].settling = self._checked_settling(value, _LONGEST_SETTLING)

    def _set_stream_resolution(self, value: float) -> None:
        self._stream_index = self._checked_resolution(value)

    def _set_stream_settling(self, value: float) -> None:
        self._stream_settling = self._checked_settling(value, _LONGEST_STREAM_SETTLING)

    def _set_feature(self, channel: int, value: float) -> None:
        if value not in (_EF_OFF, _EF_AVERAGE):
            raise RegisterError(DEVICE_FAILURE, f"AIN{channel}_EF_INDEX: {value:g} is not emulated")
        self._inputs[channel].feature = int(value)

    def _set_maximum(self, channel: int, value: float) -> None:
        self._inputs[channel].burst = self._inputs[channel].burst._replace(maximum=value)

    def _set_minimum(self, channel: int, value: float) -> None:
        self._inputs[channel].burst = self._inputs[channel].burst._replace(minimum=value)

    def _set_samples(self, channel: int, value: float) -> None:
        if not 1 <= value <= _MOST_SAMPLES:
            raise RegisterError(DEVICE_FAILURE, f"AIN{channel}_EF_CONFIG_A: 1 to {_MOST_SAMPLES} samples")
        self._inputs[channel].samples = int(value)

    def _set_scan_rate(self, channel: int, value: float) -> None:
        if not value > 0:
            raise RegisterError(DEVICE_FAILURE, f"AIN{channel}_EF_CONFIG_D: the scan rate is above 0 Hz")
        self._inputs[channel].scan_rate = value

    # The outputs, and the digital lines.

    def _set_dac(self, number: int, value: float) -> None:
        self._touched = True
        self._dacs[number] = min(max(value, 0.0), _DAC_TOP)

    def _set_tdac(self, number: int, value: float) -> None:
        # Without `min` and `max`, which take longer than all else here: this is written with each sample of a loop.
        if not -_TDAC_TOP <= value <= _TDAC_TOP:
            value = math.copysign(_TDAC_TOP, value)
        code = round(value / TDAC_STEP)
        if code != self._tdac_codes[number]:
            self._tdac_codes[number] = code
            self._touched = True

    def _read_dio(self, number: int) -> float:
        self._touched = True
        self._dio_direction &= ~(1 << number)
        return self.dio_level(number)

    def _set_dio(self, number: int, value: float) -> None:
        # Writing a line also makes it an output, as ljm_constants.json says of FIO0.
        self._touched = True
        bit = 1 << number
        self._dio_direction |= bit
        self._dio_state = self._dio_state | bit if value else self._dio_state & ~bit

    def _levels(self) -> int:
        return self._dio_state & self._dio_direction | ~self._dio_direction & ALL_DIO

    def _set_dio_bank(self, attribute: str, value: float) -> None:
        self._touched = True
        affected = ALL_DIO if attribute == "_dio_inhibit" else ~self._dio_inhibit & ALL_DIO
        setattr(self, attribute, getattr(self, attribute) & ~affected | int(value) & affected)

    # The map.

    def _register_map(self) -> tuple[Register, ...]:
        """Return the emulated rows of `ljm_constants.json`."""
        inputs, dog = self._inputs, self._dog
        return (
            Register("AIN#", 0, "F32", self._convert, None, CHANNELS),
            Register("DAC#", 1000, "F32", self._dacs.__getitem__, self._set_dac, len(self._dacs)),
            Register("DIO#", 2000, "U16", self._read_dio, self._set_dio, _DIOS),
            Register("DIO_STATE", 2800, "U32", self._levels, partial(self._set_dio_bank, "_dio_state")),
            Register("DIO_DIRECTION", 2850, "U32", *self._dio_bank("_dio_direction")),
            Register("DIO_INHIBIT", 2900, "U32", *self._dio_bank("_dio_inhibit")),
            Register("STREAM_SETTLING_US", 4008, "F32", lambda: self._stream_settling, self._set_stream_settling),
            Register("STREAM_RESOLUTION_INDEX", 4010, "U32", lambda: self._stream_index, self._set_stream_resolution),
            Register("AIN#_EF_READ_A", 7000, "F32", lambda n: self.burst(n).average, None, CHANNELS),
            Register("AIN#_EF_READ_B", 7300, "F32", lambda n: inputs[n].burst.maximum, self._set_maximum, CHANNELS),
            Register("AIN#_EF_READ_C", 7600, "F32", lambda n: inputs[n].burst.minimum, self._set_minimum, CHANNELS),
            Register("AIN#_EF_INDEX", 9000, "U32", lambda n: inputs[n].feature, self._set_feature, CHANNELS),
            Register("AIN#_EF_CONFIG_A", 9300, "U32", lambda n: inputs[n].samples, self._set_samples, CHANNELS),
            Register("AIN#_EF_CONFIG_D", 10200, "F32", lambda n: inputs[n].scan_rate, self._set_scan_rate, CHANNELS),
            Register("TDAC#", 30000, "F32", None, self._set_tdac, _TDACS),
            Register("AIN#_RANGE", 40000, "F32", lambda n: inputs[n].range, self._set_range, CHANNELS),
            Register("AIN#_NEGATIVE_CH", 41000, "U16", lambda n: inputs[n].negative, self._set_negative, CHANNELS),
            Register(
                "AIN#_RESOLUTION_INDEX", 41500, "U16", lambda n: inputs[n].resolution, self._set_index, CHANNELS
            ),
            Register("AIN#_SETTLING_US", 42000, "F32", lambda n: inputs[n].settling, self._set_settling, CHANNELS),
            Register(
                "USER_RAM#_U32", 46100, "U32", self._user_ram.__getitem__, self._user_ram.__setitem__, _USER_RAM
            ),
            Register("LAST_ERR_DETAIL", 55000, "U16", lambda: self._last_error),
            Register("TEST", 55100, "U32", lambda: 0x00112233),
            Register("TEST_FLOAT32", 55124, "F32", lambda: -9999.0),
            Register("PRODUCT_ID", 60000, "F32", lambda: 7.0),
            Register("FIRMWARE_VERSION", 60004, "F32", lambda: self.firmware),
            Register("SERIAL_NUMBER", 60028, "U32", lambda: self.serial_number),
            Register("WAIT_US_BLOCKING", 61590, "U32", None, self._wait),
            Register("WATCHDOG_ENABLE_DEFAULT", 61600, "U32", dog("enabled")[0], self._enable_watchdog),
            Register("WATCHDOG_TIMEOUT_S_DEFAULT", 61604, "U32", *dog("timeout")),
            Register("WATCHDOG_STRICT_ENABLE_DEFAULT", 61610, "U32", *dog("strict")),
            Register("WATCHDOG_STRICT_KEY_DEFAULT", 61612, "U32", *dog("key")),
            Register("WATCHDOG_STRICT_CLEAR", 61614, "U32", None, self._clear_watchdog),
            Register("WATCHDOG_DIO_ENABLE_DEFAULT", 61630, "U32", *dog("dio_enabled")),
            Register("WATCHDOG_DIO_STATE_DEFAULT", 61632, "U32", *dog("dio_state")),
            Register("WATCHDOG_DIO_DIRECTION_DEFAULT", 61634, "U32", *dog("dio_direction")),
            Register("WATCHDOG_DIO_INHIBIT_DEFAULT", 61636, "U32", *dog("dio_inhibit")),
            Register("WATCHDOG_DAC0_ENABLE_DEFAULT", 61640, "U32", *dog("dac0_enabled")),
            Register("WATCHDOG_DAC0_DEFAULT", 61642, "F32", *dog("dac0")),
            Register("WATCHDOG_DAC1_ENABLE_DEFAULT", 61650, "U32", *dog("dac1_enabled")),
            Register("WATCHDOG_DAC1_DEFAULT", 61652, "F32", *dog("dac1")),
        )

    def _dog(self, attribute: str) -> tuple[Callable[[], float], Callable[[float], None]]:
        """Return the functions that read and write a setting of the watchdog."""

        def write(value: float) -> None:
            if self._watchdog.enabled:
                raise RegisterError(DEVICE_FAILURE, "the watchdog must be disabled before its settings change")
            self.flash_writes += 1
            setattr(self._watchdog, attribute, value)

        return partial(getattr, self._watchdog, attribute), write

    def _dio_bank(self, attribute: str) -> tuple[Callable[[], float], Callable[[float], None]]:
        return partial(getattr, self, attribute), partial(self._set_dio_bank, attribute)
