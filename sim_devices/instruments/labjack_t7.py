"""An emulated LabJack T7, and the transducers that are wired to its inputs.

The register map is that of `ljm_constants.json` (repository labjack/ljm_constants), the behaviour that of the
LabJack T-series datasheet: 14.1.7 (average, minimum and maximum), 14.3.0 (T7 analog inputs), A-3-1 (noise and
resolution), and the descriptions of the watchdog registers in the map.

Assumptions, where these say nothing:

- A refused value gives Modbus exception 4 with the reason in LAST_ERR_DETAIL; an address that is not emulated,
  or a read of a register that can only be written, gives exception 2; a write of half a 32-bit value gives
  exception 3; changing a watchdog setting while the watchdog is enabled gives exception 4.
- A refusal whose detail is not known leaves 0 in LAST_ERR_DETAIL.
- Detail 2371 belongs to the settling time, as the known 2370, 2373 and 2375 stand in the order of the error
  table with it in between.
- A burst longer than the 0.18 s that the datasheet allows is refused with exception 4.
- DAC outputs clip at 0 and 5 V, LJTick-DAC outputs at ±10 V.
- After a timeout the watchdog timer begins anew, so that the actions are repeated; doing them again changes
  nothing as long as nobody communicates, so they are done once.
- A single conversion takes no laboratory time; a burst takes what its scan rate says.
- Reading the register of a single digital line makes it an input, as the map says that it configures the
  direction too; an input that nothing drives is pulled high, as all lines are after power-up.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from bench.devices import Identity, PositionSensor, Status, Switch
from bench.errors import DeviceError
from sim_devices.wire.modbus_tcp import DEVICE_FAILURE, ILLEGAL_ADDRESS, ILLEGAL_VALUE, RegisterError
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

_DEFAULT_INDEX = 8  # what index 0 means to a command-response reading of a T7
_DEFAULT_STREAM_INDEX = 1  # and to a burst, as ljm_constants.json says of STREAM_RESOLUTION_INDEX
_EF_OFF, _EF_AVERAGE = 0, 3
_MOST_SAMPLES = 16384
_LONGEST_BURST = 0.18
_LONGEST_SETTLING = 50_000.0
_LONGEST_STREAM_SETTLING = 4_400.0
_TDACS = 23
_DIOS = 23
_DAC_TOP = 5.0
_TDAC_TOP = 10.0

_FORMATS = {"F32": ">f", "U32": ">I", "U16": ">H"}


@dataclass(frozen=True)
class Burst:
    """What one burst of conversions gave, in V."""

    average: float
    maximum: float
    minimum: float


class _DetailedError(RegisterError):
    """A refusal that LAST_ERR_DETAIL explains."""

    def __init__(self, detail: int, message: str) -> None:
        super().__init__(DEVICE_FAILURE, message)
        self.detail = detail


@dataclass(frozen=True)
class _Register:
    kind: Literal["F32", "U32", "U16"]
    read: Callable[[], float] | None
    write: Callable[[float], None] | None

    @property
    def words(self) -> int:
        return 1 if self.kind == "U16" else 2

    def encode(self, value: float) -> tuple[int, ...]:
        raw = struct.pack(_FORMATS[self.kind], value if self.kind == "F32" else int(value))
        return struct.unpack(f">{self.words}H", raw)

    def decode(self, words: Sequence[int]) -> float:
        return float(struct.unpack(_FORMATS[self.kind], struct.pack(f">{self.words}H", *words))[0])


@dataclass
class _Input:
    range: float = 10.0
    negative: int = SINGLE_ENDED
    resolution_index: int = 0
    settling_us: float = 0.0
    feature: int = _EF_OFF
    samples: int = 200
    scan_rate: float = 6000.0
    burst: Burst = Burst(0.0, 0.0, 0.0)


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


class EmulatedT7:
    """A LabJack T7 as a bank of Modbus registers; a `Timed` instrument because of its watchdog.

    Every access brings the world up to date first and holds its lock. A burst lets the clock pass, as the
    real instrument keeps whoever reads the average waiting.

    Parameters
    ----------
    world : World
        The laboratory that the instrument stands in.
    inputs : mapping of int to callable
        Voltage in V at an analog input by its number, 0 to 13; an input that is not named is grounded.
    rng : numpy.random.Generator
        Source of the input noise.
    serial_number : int
        Serial number that the instrument reports.
    firmware : float
        Firmware version that the instrument reports.

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
        self._sources = dict(inputs)
        self._rng = rng
        self._inputs = [_Input() for _ in range(CHANNELS)]
        self._stream_index = 0
        self._stream_settling = 0.0
        self._dacs = [0.0, 0.0]
        self._tdacs = [0.0] * _TDACS
        self._dio_state = 0
        self._dio_direction = 0
        self._dio_inhibit = 0
        self._last_error = 0
        self._watchdog = _Watchdog()
        self._due = math.inf
        self._expired_at: float | None = None
        self._words: dict[int, tuple[int, _Register]] = {}
        self._build_map()
        world.add(self)

    # What the laboratory around the instrument sees of it.

    def dac_volts(self, number: int) -> float:
        """Return the voltage in V at DAC0 or DAC1."""
        return self._dacs[number]

    def tdac_volts(self, number: int) -> float:
        """Return the voltage in V at an output of an LJTick-DAC, 0 to 22."""
        return self._tdacs[number]

    def dio_level(self, number: int) -> bool:
        """Return the level of a digital line, 0 to 22; a line that is not an output is pulled high."""
        return bool(self._levels() >> number & 1)

    @property
    def watchdog_expired(self) -> bool:
        """Whether the watchdog has run out since the last communication that feeds it."""
        return self._expired_at is not None

    # The registers.

    def read_registers(self, address: int, count: int) -> list[int]:
        """Return `count` registers from `address` on; reading half a value is allowed.

        Raises
        ------
        RegisterError
            If one of them does not exist or cannot be read.
        """
        with self._request():
            values: dict[int, tuple[int, ...]] = {}
            words = []
            for each in range(address, address + count):
                start, register = self._at(each)
                if register.read is None:
                    raise RegisterError(ILLEGAL_ADDRESS, f"register {each} can only be written")
                if start not in values:
                    values[start] = register.encode(register.read())
                words.append(values[start][each - start])
            return words

    def write_registers(self, address: int, values: list[int]) -> None:
        """Write registers from `address` on, in whole values.

        Raises
        ------
        RegisterError
            If one of them does not exist or cannot be written, or if a value is not allowed; the values
            before it have been written then.
        """
        with self._request():
            position = 0
            while position < len(values):
                start, register = self._at(address + position)
                words = values[position : position + register.words]
                if start != address + position or len(words) < register.words:
                    raise RegisterError(ILLEGAL_VALUE, f"register {start} is to be written as a whole")
                if register.write is None:
                    raise RegisterError(ILLEGAL_ADDRESS, f"register {start} can only be read")
                value = register.decode(words)
                if not math.isfinite(value):
                    raise RegisterError(ILLEGAL_VALUE, f"register {start} takes numbers only")
                register.write(value)
                position += register.words

    @contextmanager
    def _request(self) -> Iterator[None]:
        with self.world.lock:
            self._attend()
            try:
                yield
            except RegisterError as refusal:
                self._last_error = refusal.detail if isinstance(refusal, _DetailedError) else 0
                raise

    def read_value(self, address: int) -> float:
        """Return the value that begins at `address`, as one request would."""
        _, register = self._at(address)
        return register.decode(self.read_registers(address, register.words))

    def write_value(self, address: int, value: float) -> None:
        """Write the value that begins at `address`, as one request would."""
        _, register = self._at(address)
        self.write_registers(address, list(register.encode(value)))

    # The watchdog.

    def deadline(self) -> float:
        """Return when the watchdog runs out, in laboratory seconds; infinity while it does not run."""
        return self._due

    def expire(self) -> None:
        """Do what the watchdog is set to do."""
        dog = self._watchdog
        if dog.dac0_enabled:
            self._set_dac(0, dog.dac0)
        if dog.dac1_enabled:
            self._set_dac(1, dog.dac1)
        if dog.dio_enabled:
            affected = ~dog.dio_inhibit & _all_dio()
            self._dio_state = self._dio_state & ~affected | dog.dio_state & affected
            self._dio_direction = self._dio_direction & ~affected | dog.dio_direction & affected
        self._expired_at = self._due
        self._due = math.inf

    def _attend(self) -> None:
        """Begin a request: time first, then the watchdog, which any communication feeds unless strict."""
        self.world.advance()
        dog = self._watchdog
        if not dog.enabled:
            return
        if not dog.strict:
            self._feed()
        elif self._expired_at is not None:
            # In strict mode the timer has gone on; what the request changes lasts until it next runs out.
            periods = math.floor((self.world.time - self._expired_at) / dog.timeout) + 1
            self._due = self._expired_at + periods * dog.timeout
            self._expired_at = None

    def _feed(self) -> None:
        self._due = self.world.time + self._watchdog.timeout
        self._expired_at = None

    def _enable_watchdog(self, value: float) -> None:
        if value not in (0, 1):
            raise RegisterError(DEVICE_FAILURE, "WATCHDOG_ENABLE: allowed are 0 and 1")
        if value and not self._watchdog.timeout:
            raise RegisterError(DEVICE_FAILURE, "WATCHDOG_ENABLE: WATCHDOG_TIMEOUT_S is 0")
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
        with self.world.lock:
            self.world.advance()
            return self._convert(channel, self._inputs[channel].resolution_index or _DEFAULT_INDEX)

    def burst(self, channel: int) -> Burst:
        """Let a burst of conversions pass and return what it gave, as a read of AIN_EF_READ_A does.

        Raises
        ------
        RegisterError
            If the input is not set up for it, or the burst would take longer than 0.18 s.
        """
        with self.world.lock:
            settings = self._inputs[channel]
            if settings.feature != _EF_AVERAGE:
                raise RegisterError(ILLEGAL_ADDRESS, f"AIN{channel}_EF_INDEX is not {_EF_AVERAGE}")
            duration = settings.samples / settings.scan_rate
            if duration > _LONGEST_BURST:
                raise RegisterError(DEVICE_FAILURE, f"a burst of {duration:g} s is too long")
            self.world.advance()
            begin = self.world.time
            readings = []
            for sample in range(1, settings.samples + 1):
                self.world.clock.sleep_until(begin + sample / settings.scan_rate)
                self.world.advance()
                readings.append(self._convert(channel, self._stream_index or _DEFAULT_STREAM_INDEX))
            settings.burst = Burst(math.fsum(readings) / len(readings), max(readings), min(readings))
            return settings.burst

    def _convert(self, channel: int, index: int) -> float:
        settings = self._inputs[channel]
        volts = self._terminal(channel)
        if settings.negative != SINGLE_ENDED:
            volts -= self._terminal(settings.negative)
        rail = RAIL * settings.range
        code = 2 * rail / CODES
        conversions = CONVERSIONS[index - 1]
        volts += code / math.sqrt(conversions) * self._rng.standard_normal()
        step = code / conversions
        return float(min(max(round(volts / step) * step, -rail), rail - step))

    def _terminal(self, channel: int) -> float:
        source = self._sources.get(channel)
        return 0.0 if source is None else source()

    def _set_range(self, channel: int, value: float) -> None:
        wanted = value or RANGES[0]  # 0 stands for the default
        for each in RANGES:
            if math.isclose(wanted, each, rel_tol=1e-6):
                self._inputs[channel].range = each
                return
        raise _DetailedError(ERROR_RANGE, f"AIN{channel}_RANGE: {value:g} is none of {RANGES}")

    def _set_negative(self, channel: int, value: float) -> None:
        if value != SINGLE_ENDED and not (channel % 2 == 0 and value == channel + 1):
            raise _DetailedError(ERROR_NEGATIVE_CHANNEL, f"AIN{channel}_NEGATIVE_CH: {value:g} is not allowed")
        self._inputs[channel].negative = int(value)

    def _checked_resolution(self, value: float) -> int:
        if not 0 <= value <= len(CONVERSIONS):
            raise _DetailedError(ERROR_RESOLUTION, f"resolution index: {value:g} is not 0 to {len(CONVERSIONS)}")
        return int(value)

    def _checked_settling(self, value: float, longest: float) -> float:
        if not 0 <= value <= longest:
            raise _DetailedError(ERROR_SETTLING, f"settling: {value:g} µs is not 0 to {longest:g} µs")
        return value

    def _set_resolution(self, channel: int, value: float) -> None:
        self._inputs[channel].resolution_index = self._checked_resolution(value)

    def _set_settling(self, channel: int, value: float) -> None:
        self._inputs[channel].settling_us = self._checked_settling(value, _LONGEST_SETTLING)

    def _set_stream_resolution(self, value: float) -> None:
        self._stream_index = self._checked_resolution(value)

    def _set_stream_settling(self, value: float) -> None:
        self._stream_settling = self._checked_settling(value, _LONGEST_STREAM_SETTLING)

    def _set_feature(self, channel: int, value: float) -> None:
        if value not in (_EF_OFF, _EF_AVERAGE):
            raise RegisterError(DEVICE_FAILURE, f"AIN{channel}_EF_INDEX: {value:g} is not emulated")
        self._inputs[channel].feature = int(value)

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
        self._dacs[number] = min(max(value, 0.0), _DAC_TOP)

    def _set_tdac(self, number: int, value: float) -> None:
        self._tdacs[number] = min(max(value, -_TDAC_TOP), _TDAC_TOP)

    def _read_dio(self, number: int) -> float:
        self._dio_direction &= ~(1 << number)
        return self.dio_level(number)

    def _set_dio(self, number: int, value: float) -> None:
        # Writing a line also makes it an output, as ljm_constants.json says of FIO0.
        bit = 1 << number
        self._dio_direction |= bit
        self._dio_state = self._dio_state | bit if value else self._dio_state & ~bit

    def _levels(self) -> int:
        return self._dio_state & self._dio_direction | ~self._dio_direction & _all_dio()

    def _set_dio_bank(self, attribute: str, value: float) -> None:
        affected = _all_dio() if attribute == "_dio_inhibit" else ~self._dio_inhibit & _all_dio()
        setattr(self, attribute, getattr(self, attribute) & ~affected | int(value) & affected)

    # The map.

    def _at(self, address: int) -> tuple[int, _Register]:
        try:
            return self._words[address]
        except KeyError:
            raise RegisterError(ILLEGAL_ADDRESS, f"register {address} is not emulated") from None

    def _add(
        self,
        address: int,
        kind: Literal["F32", "U32", "U16"],
        read: Callable[[], float] | None,
        write: Callable[[float], None] | None = None,
    ) -> None:
        register = _Register(kind, read, write)
        for word in range(register.words):
            self._words[address + word] = (address, register)

    def _build_map(self) -> None:
        for channel in range(CHANNELS):
            self._add_input(channel)
        for number in range(2):
            self._add(1000 + 2 * number, "F32", partial(self.dac_volts, number), partial(self._set_dac, number))
        for number in range(_TDACS):
            self._add(30000 + 2 * number, "F32", None, partial(self._set_tdac, number))
        for number in range(_DIOS):
            self._add(2000 + number, "U16", partial(self._read_dio, number), partial(self._set_dio, number))
        self._add(2800, "U32", self._levels, partial(self._set_dio_bank, "_dio_state"))
        for address, attribute in ((2850, "_dio_direction"), (2900, "_dio_inhibit")):
            self._add(
                address,
                "U32",
                partial(getattr, self, attribute),
                partial(self._set_dio_bank, attribute),
            )
        self._add(4008, "F32", lambda: self._stream_settling, self._set_stream_settling)
        self._add(4010, "U32", lambda: self._stream_index, self._set_stream_resolution)
        self._add(55000, "U16", lambda: self._last_error)
        self._add(55100, "U32", lambda: 0x00112233)
        self._add(55124, "F32", lambda: -9999.0)
        self._add(60000, "F32", lambda: 7.0)
        self._add(60004, "F32", lambda: self.firmware)
        self._add(60028, "U32", lambda: self.serial_number)
        self._add(61600, "U32", lambda: self._watchdog.enabled, self._enable_watchdog)
        self._add(61614, "U32", None, self._clear_watchdog)
        self._add_watchdog(61604, "U32", "timeout")
        self._add_watchdog(61610, "U32", "strict")
        self._add_watchdog(61612, "U32", "key")
        self._add_watchdog(61630, "U32", "dio_enabled")
        self._add_watchdog(61632, "U32", "dio_state")
        self._add_watchdog(61634, "U32", "dio_direction")
        self._add_watchdog(61636, "U32", "dio_inhibit")
        self._add_watchdog(61640, "U32", "dac0_enabled")
        self._add_watchdog(61642, "F32", "dac0")
        self._add_watchdog(61650, "U32", "dac1_enabled")
        self._add_watchdog(61652, "F32", "dac1")

    def _add_input(self, channel: int) -> None:
        settings = self._inputs[channel]
        two = 2 * channel
        self._add(two, "F32", partial(self.convert, channel))
        self._add(7000 + two, "F32", lambda: self.burst(channel).average)
        self._add(7300 + two, "F32", lambda: settings.burst.maximum)
        self._add(7600 + two, "F32", lambda: settings.burst.minimum)
        self._add(9000 + two, "U32", lambda: settings.feature, partial(self._set_feature, channel))
        self._add(9300 + two, "U32", lambda: settings.samples, partial(self._set_samples, channel))
        self._add(10200 + two, "F32", lambda: settings.scan_rate, partial(self._set_scan_rate, channel))
        self._add(40000 + two, "F32", lambda: settings.range, partial(self._set_range, channel))
        self._add(41000 + channel, "U16", lambda: settings.negative, partial(self._set_negative, channel))
        self._add(41500 + channel, "U16", lambda: settings.resolution_index, partial(self._set_resolution, channel))
        self._add(42000 + two, "F32", lambda: settings.settling_us, partial(self._set_settling, channel))

    def _add_watchdog(self, address: int, kind: Literal["F32", "U32"], attribute: str) -> None:
        def write(value: float) -> None:
            if self._watchdog.enabled:
                raise RegisterError(DEVICE_FAILURE, "the watchdog is to be disabled while it is set up")
            setattr(self._watchdog, attribute, value if kind == "F32" else int(value))

        self._add(address, kind, partial(getattr, self._watchdog, attribute), write)


def _all_dio() -> int:
    return (1 << _DIOS) - 1


class EmulatedPositionSensor(PositionSensor):
    """The role of a position sensor, played by an emulated T7 that is called directly, without a wire.

    Parameters
    ----------
    name : str
        Name in the rig.
    instrument : EmulatedT7
        The instrument; its inputs are set up here.
    readout : {"voltage", "currents", "ratiometric"}
        One normalised voltage, two amplified photocurrents, or an output that is a share of its supply.
    channels : sequence of int
        Inputs, 0 to 13: one for a voltage, those of the currents 1 and 2 for currents, those of output and supply
        for a ratiometric sensor.
    range_volts : float
        Input range in V: 10, 1, 0.1 or 0.01.
    resolution_index : int
        Resolution index, 0 to 8.
    samples : int
        Conversions that one measurement averages, 1 to 16384.
    sample_rate : float
        Conversions in a second, Hz.
    volts_per_metre, zero_volts : float
        Calibration of a voltage.
    psd_length, metres_per_metre, minimum_sum_volts : float
        Length of the detector in m, movement of the spot per deflection, and the sum of both voltages in V
        below which the light counts as lost.
    stroke, zero_position : float
        Stroke of a ratiometric sensor, and where on it the position reads zero, in m.
    position_limits : tuple of float
        Calibrated range in m.

    Raises
    ------
    RegisterError
        If the instrument refuses a setting.
    """

    def __init__(
        self,
        name: str,
        instrument: EmulatedT7,
        *,
        readout: Literal["voltage", "currents", "ratiometric"] = "voltage",
        channels: Sequence[int] = (0,),
        range_volts: float = 10.0,
        resolution_index: int = 4,
        samples: int = 10,
        sample_rate: float = 1000.0,
        volts_per_metre: float = 1e5,
        zero_volts: float = 0.0,
        psd_length: float = 0.037,
        metres_per_metre: float = 185.0,
        minimum_sum_volts: float = 0.5,
        stroke: float = 0.035,
        zero_position: float = 0.0,
        position_limits: tuple[float, float] = (-90e-6, 90e-6),
    ) -> None:
        super().__init__(name, instrument.world.clock)
        expected = 1 if readout == "voltage" else 2
        if len(channels) != expected:
            raise ValueError(f"channels: {readout} needs {expected}, got {len(channels)}")
        self._instrument = instrument
        self._readout = readout
        self._channels = tuple(channels)
        self._range = range_volts
        self._volts_per_metre = volts_per_metre
        self._zero_volts = zero_volts
        self._metres_per_ratio = psd_length / 2 / metres_per_metre
        self._minimum_sum = minimum_sum_volts
        self._stroke = stroke
        self._zero_position = zero_position
        self._limits = position_limits
        instrument.write_value(4010, resolution_index)
        for channel in self._channels:
            instrument.write_value(40000 + 2 * channel, range_volts)
            instrument.write_value(41000 + channel, SINGLE_ENDED)
            instrument.write_value(41500 + channel, resolution_index)
            instrument.write_value(9000 + 2 * channel, _EF_AVERAGE)
            instrument.write_value(9300 + 2 * channel, samples)
            instrument.write_value(10200 + 2 * channel, sample_rate)

    @property
    def identity(self) -> Identity:
        """Identity of the instrument."""
        return Identity("LabJack", "T7", str(self._instrument.serial_number), f"{self._instrument.firmware:.4f}")

    def measure(self) -> dict[str, float]:
        """Measure the position in m, as a mean of conversions."""
        try:
            bursts = [self._instrument.burst(channel) for channel in self._channels]
        except RegisterError as refusal:
            raise DeviceError(self.name, f"the instrument refuses to measure: {refusal}") from refusal
        return self._position(bursts)

    def glance(self) -> dict[str, float]:
        """Measure the position in m by one conversion."""
        readings = [self._instrument.convert(channel) for channel in self._channels]
        return self._position([Burst(volts, volts, volts) for volts in readings])

    def safe(self) -> None:
        """Do nothing: a sensor is safe in any state."""

    def close(self) -> None:
        """Do nothing: there is no line."""

    def _position(self, bursts: Sequence[Burst]) -> dict[str, float]:
        for channel, burst in zip(self._channels, bursts, strict=True):
            if max(burst.maximum, -burst.minimum) >= 0.999 * self._range:
                raise DeviceError(self.name, f"AIN{channel} is over its range of ±{self._range:g} V")
        if self._readout == "voltage":
            position = (bursts[0].average - self._zero_volts) / self._volts_per_metre
        elif self._readout == "ratiometric":
            position = self._along_the_stroke(*(burst.average for burst in bursts))
        else:
            first, second = (burst.average for burst in bursts)
            if first + second < self._minimum_sum:
                raise DeviceError(self.name, f"light lost: the currents add up to {first + second:.3g} V")
            position = self._metres_per_ratio * (second - first) / (first + second)
        low, high = self._limits
        if not low <= position <= high:
            raise DeviceError(self.name, f"position {position:g} m is outside of {low:g} to {high:g} m")
        return {f"{self.name}_position": position}

    def _along_the_stroke(self, output: float, supply: float) -> float:
        if not 4.5 <= supply <= 5.5:
            raise DeviceError(self.name, f"supply voltage of the sensor is {supply:.3g} V")
        # At 10 and 90 % of the supply the magnet may be anywhere beyond the end.
        share = (output / supply - 0.1) / 0.8
        if not 0.0005 <= share <= 0.9995:
            raise DeviceError(self.name, f"output of the sensor is {output / supply:.4g} of its supply")
        return self._stroke * share - self._zero_position


class EmulatedSwitch(Switch):
    """The role of a switch, played by a digital line of an emulated T7 that is called directly, without a wire.

    Parameters
    ----------
    name : str
        Name in the rig.
    instrument : EmulatedT7
        The instrument; its line is switched off and put under its watchdog here.
    line : int
        Number of the line, 0 to 22.
    active_high : bool
        Whether a high level is on.
    watchdog : int
        Silence in s after which the instrument switches the line off, 1 or more; a shorter time that is set
        already for something else stays.

    Raises
    ------
    RegisterError
        If the instrument refuses a setting.
    """

    def __init__(
        self, name: str, instrument: EmulatedT7, *, line: int, active_high: bool = True, watchdog: int = 5
    ) -> None:
        super().__init__(name, instrument.world.clock)
        self._instrument = instrument
        self._line = line
        self._active_high = active_high
        self._setpoint = math.nan
        self._drive(False)
        self._guard(watchdog)

    @property
    def identity(self) -> Identity:
        """Identity of the instrument."""
        return Identity("LabJack", "T7", str(self._instrument.serial_number), f"{self._instrument.firmware:.4f}")

    @property
    def setpoint(self) -> float:
        """The set-point that was last sent, 0 or 1; 0 after the safe state and the watchdog, nan at first."""
        return self._setpoint

    def set(self, value: float) -> Status:
        """Switch on (1) or off (0)."""
        self.check(value)
        self._setpoint = float(value)
        self._drive(value == 1.0)
        return Status.completed(self.name, self._clock)

    def measure(self) -> dict[str, float]:
        """Read back whether the line is on."""
        level = int(self._instrument.read_value(2800)) >> self._line & 1
        on = bool(level) == self._active_high
        if self._setpoint == 1.0 and not on:
            self._setpoint = 0.0
            raise DeviceError(self.name, f"DIO{self._line} is off although it was switched on: the watchdog ran out")
        return {f"{self.name}_state": float(on)}

    def safe(self) -> None:
        """Switch off."""
        self._setpoint = 0.0
        self._drive(False)

    def close(self) -> None:
        """Do nothing: there is no line of communication, and the digital line is left to the watchdog."""

    def _drive(self, on: bool) -> None:
        self._instrument.write_value(2000 + self._line, on == self._active_high)

    def _guard(self, seconds: int) -> None:
        read, write = self._instrument.read_value, self._instrument.write_value
        bit = 1 << self._line
        inhibit = int(read(61636)) if read(61600) and read(61630) else _all_dio()
        if ~inhibit & ~bit & _all_dio() or (read(61600) and (read(61640) or read(61650))):
            seconds = min(seconds, int(read(61604)))
        state, direction = int(read(61632)), int(read(61634))
        write(61600, 0)
        write(61604, seconds)
        write(61630, 1)
        write(61632, state & ~bit if self._active_high else state | bit)
        write(61634, direction | bit)
        write(61636, inhibit & ~bit)
        write(61600, 1)


class NormalisedPSD:
    """A position-sensitive detector whose amplifier gives one voltage in proportion to the deflection.

    Parameters
    ----------
    deflection : callable
        The deflection in m, from the plant.
    volts_per_metre : float
        Sensitivity in V/m.
    noise_volts : float
        White noise of the amplifier in V rms, drawn anew for every conversion; zero or positive.
    rng : numpy.random.Generator
        Source of the noise.

    Notes
    -----
    The amplifier saturates at ±10 V, noise included.
    """

    SATURATION = 10.0

    def __init__(
        self,
        deflection: Callable[[], float],
        volts_per_metre: float = 1e5,
        noise_volts: float = 5e-3,
        *,
        rng: np.random.Generator,
    ) -> None:
        self._deflection = deflection
        self._volts_per_metre = volts_per_metre
        self._noise = noise_volts
        self._rng = rng

    def __call__(self) -> float:
        """Return the voltage in V at this instant."""
        volts = self._deflection() * self._volts_per_metre + self._noise * self._rng.standard_normal()
        return float(min(max(volts, -self.SATURATION), self.SATURATION))


class TwoCurrentPSD:
    """A position-sensitive detector whose two photocurrents are amplified to two voltages.

    The spot at x on a detector of length L gives x = (L/2)(I2 − I1)/(I1 + I2) (Hamamatsu, S3270 datasheet).

    Parameters
    ----------
    deflection : callable
        The deflection in m, from the plant.
    metres_per_metre : float
        Movement of the spot per deflection, by the optical lever.
    psd_length : float
        Length of the detector in m.
    sum_volts : float
        Sum of both voltages in V while the light is on.
    noise_volts : float
        White noise of either amplifier in V rms, drawn anew for every conversion; zero or positive.
    rng : numpy.random.Generator
        Source of the noise.

    Attributes
    ----------
    light : float
        Share of the light that reaches the detector, 0 to 1; for faults and drift.

    Notes
    -----
    A spot beyond the end of the detector gives no current at all. The amplifiers saturate at 0 and 10 V.
    """

    SATURATION = 10.0

    def __init__(
        self,
        deflection: Callable[[], float],
        metres_per_metre: float = 185.0,
        psd_length: float = 0.037,
        sum_volts: float = 8.0,
        noise_volts: float = 5e-3,
        *,
        rng: np.random.Generator,
    ) -> None:
        self.light = 1.0
        self._deflection = deflection
        self._ratio_per_metre = 2 * metres_per_metre / psd_length
        self._sum = sum_volts
        self._noise = noise_volts
        self._rng = rng

    def first(self) -> float:
        """Return the voltage in V of current 1 at this instant."""
        return self._amplified(-1.0)

    def second(self) -> float:
        """Return the voltage in V of current 2 at this instant."""
        return self._amplified(1.0)

    def _amplified(self, side: float) -> float:
        ratio = self._deflection() * self._ratio_per_metre
        share = (1 + side * ratio) / 2 if abs(ratio) <= 1 else 0.0
        volts = self.light * self._sum * share + self._noise * self._rng.standard_normal()
        return float(min(max(volts, 0.0), self.SATURATION))


class RatiometricSensor:
    """A linear magnet sensor, of the kind of the SPS-L035-LATS, whose output is a share of its supply.

    Assumption: the output goes from 10 to 90 % of a supply of 5 V over the stroke, and stays at its end for a
    magnet that is beyond it.

    Parameters
    ----------
    position : callable
        The position of the magnet in m, counted from the start of the stroke, from the plant.
    stroke : float
        Stroke in m.
    noise : float
        White noise in m rms, drawn anew for every conversion; zero or positive.
    resolution : float
        Steps in which the sensor gives the position, in m.
    supply_error : float
        How far the supply of one instance is from 5 V, in V rms; drawn once.
    rng : numpy.random.Generator
        Source of the noise and of the error of the supply.

    Attributes
    ----------
    supply_volts : float
        Voltage of the supply in V; for faults and drift.
    """

    def __init__(
        self,
        position: Callable[[], float],
        stroke: float = 0.035,
        noise: float = 0.01e-3,
        resolution: float = 0.04e-3,
        supply_error: float = 20e-3,
        *,
        rng: np.random.Generator,
    ) -> None:
        self.supply_volts = 5.0 + supply_error * rng.standard_normal()
        self._position = position
        self._stroke = stroke
        self._noise = noise
        self._resolution = resolution
        self._rng = rng

    def output(self) -> float:
        """Return the output voltage in V at this instant."""
        noisy = self._position() + self._noise * self._rng.standard_normal()
        step = round(noisy / self._resolution) * self._resolution
        share = min(max(step / self._stroke, 0.0), 1.0)
        return self.supply_volts * (0.1 + 0.8 * share)

    def supply(self) -> float:
        """Return the voltage in V of the supply at this instant."""
        return self.supply_volts
