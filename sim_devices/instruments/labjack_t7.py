"""An emulated LabJack T7, and the transducers and the high-voltage amplifier that are wired to it.

The register map is that of `ljm_constants.json` (repository labjack/ljm_constants), the behaviour that of the
LabJack T-series datasheet: 14.1.7 (average, minimum and maximum), 14.3.0 (T7 analog inputs), 15.0 (analog
outputs), A-3-1 (noise and resolution), the datasheet of the LJTick-DAC, and the descriptions of the watchdog
registers in the map. Thermistors follow Steinhart and Hart 1968, Deep-Sea Research 15.

Assumptions, where these say nothing:

- A refused value gives Modbus exception 4 with the reason in LAST_ERR_DETAIL; an address that is not emulated,
  or a read of a register that can only be written, gives exception 2; a write of half a 32-bit value gives
  exception 3; changing a watchdog setting while the watchdog is enabled gives exception 4.
- A refusal whose detail is not known leaves 0 in LAST_ERR_DETAIL.
- Detail 2371 belongs to the settling time, as the known 2370, 2373 and 2375 stand in the order of the error
  table with it in between.
- A burst longer than the 0.18 s that the datasheet allows is refused with exception 4.
- DAC outputs clip at 0 and 5 V, LJTick-DAC outputs at ±10 V; their steps are even, without error of gain or
  offset. The register of a DAC reads back what was written.
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
from typing import Literal, Protocol

import numpy as np

from bench.devices import Identity, Limits, PositionSensor, Status, Switch, TemperatureSensor, VoltageSupply
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

DAC_STEP = 5.0 / 4096
"""Step in V of DAC0 and DAC1, which have 12 bits (15.0)."""

TDAC_STEP = 20.0 / 16384
"""Step in V of an LJTick-DAC, which has 14 bits (its datasheet)."""

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
_KELVIN = 273.15

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


STEINHART_HART = (1.129148e-3, 2.34125e-4, 8.76741e-8)
"""A, B and C of a common thermistor of 10 kΩ at 25 °C, in 1/K, for the resistance in Ω."""


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
        self._followers: list[Callable[[], None]] = []
        self._words: dict[int, tuple[int, _Register]] = {}
        self._build_map()
        world.add(self)

    @property
    def identity(self) -> Identity:
        """What the instrument says of itself."""
        return Identity("LabJack", "T7", str(self.serial_number), f"{self.firmware:.4f}")

    # What the laboratory around the instrument sees of it.

    def dac_volts(self, number: int) -> float:
        """Return the voltage in V at DAC0 or DAC1, in its steps."""
        return DAC_STEP * round(self._dacs[number] / DAC_STEP)

    def tdac_volts(self, number: int) -> float:
        """Return the voltage in V at an output of an LJTick-DAC, 0 to 22, in its steps."""
        return TDAC_STEP * round(self._tdacs[number] / TDAC_STEP)

    def dio_level(self, number: int, *, pulled_down: bool = False) -> bool:
        """Return the level of a digital line, 0 to 22.

        A line that is not an output is pulled high by the instrument, weakly; `pulled_down` says that what it is
        wired to pulls it low all the same.
        """
        levels = self._dio_state & self._dio_direction if pulled_down else self._levels()
        return bool(levels >> number & 1)

    def add_follower(self, follow: Callable[[], None]) -> None:
        """Have `follow()` called now, after every request and when the watchdog acts.

        What is wired to the outputs looks at them then; the world stands at that instant.
        """
        with self.world.lock:
            self.world.advance()
            self._followers.append(follow)
            follow()

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
            finally:
                self._lead()

    def _lead(self) -> None:
        for follow in self._followers:
            follow()

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
        self._lead()

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

    def set_inputs_up(
        self, channels: Sequence[int], range_volts: float, resolution_index: int, samples: int, sample_rate: float
    ) -> None:
        """Set single-ended inputs up for `convert` and `burst`, as requests of a host would.

        Raises
        ------
        RegisterError
            If a setting is refused.
        """
        self.write_value(4010, resolution_index)
        for channel in channels:
            self.write_value(40000 + 2 * channel, range_volts)
            self.write_value(41000 + channel, SINGLE_ENDED)
            self.write_value(41500 + channel, resolution_index)
            self.write_value(9000 + 2 * channel, _EF_AVERAGE)
            self.write_value(9300 + 2 * channel, samples)
            self.write_value(10200 + 2 * channel, sample_rate)

    def convert(self, channel: int) -> float:
        """Return one reading of an input in V, as a read of AIN does."""
        # Nothing that a follower looks at changes, and nothing is refused.
        with self.world.lock:
            self._attend()
            return self._convert(channel, self._inputs[channel].resolution_index or _DEFAULT_INDEX)

    def burst(self, channel: int) -> Burst:
        """Let a burst of conversions pass and return what it gave, as a read of AIN_EF_READ_A does.

        Raises
        ------
        RegisterError
            If the input is not set up for it, or the burst would take longer than 0.18 s.
        """
        with self._request():
            settings = self._inputs[channel]
            if settings.feature != _EF_AVERAGE:
                raise RegisterError(ILLEGAL_ADDRESS, f"AIN{channel}_EF_INDEX is not {_EF_AVERAGE}")
            duration = settings.samples / settings.scan_rate
            if duration > _LONGEST_BURST:
                raise RegisterError(DEVICE_FAILURE, f"a burst of {duration:g} s is too long")
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
            self._add(
                1000 + 2 * number, "F32", partial(self._dacs.__getitem__, number), partial(self._set_dac, number)
            )
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


def _bursts(name: str, instrument: EmulatedT7, channels: Sequence[int]) -> list[Burst]:
    try:
        return [instrument.burst(channel) for channel in channels]
    except RegisterError as refusal:
        raise DeviceError(name, f"the instrument refuses to measure: {refusal}") from refusal


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
        instrument.set_inputs_up(self._channels, range_volts, resolution_index, samples, sample_rate)

    @property
    def identity(self) -> Identity:
        """Identity of the instrument."""
        return self._instrument.identity

    def measure(self) -> dict[str, float]:
        """Measure the position in m, as a mean of conversions."""
        return self._position(_bursts(self.name, self._instrument, self._channels))

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
        return self._instrument.identity

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


class EmulatedTemperatureSensor(TemperatureSensor):
    """The role of a temperature sensor, played by an emulated T7 that is called directly, without a wire.

    Parameters
    ----------
    name : str
        Name in the rig.
    instrument : EmulatedT7
        The instrument; its inputs are set up here.
    channels : tuple of int
        Inputs of a thermistor's divider and of its excitation, 0 to 13.
    reference_ohms, steinhart_hart : float and tuple of float
        The divider and the thermistor, as those of `Thermistor`.
    excitation_volts : float
        Excitation in V; 20 % off is an error.
    temperature_limits : tuple of float
        Range in °C.
    resolution_index, samples, sample_rate
        Resolution index 0 to 8, conversions that one measurement averages, and conversions in a second in Hz.

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
        channels: tuple[int, int] = (0, 1),
        reference_ohms: float = 10e3,
        excitation_volts: float = 2.5,
        steinhart_hart: tuple[float, float, float] = STEINHART_HART,
        temperature_limits: tuple[float, float] = (-40.0, 125.0),
        resolution_index: int = 4,
        samples: int = 10,
        sample_rate: float = 1000.0,
    ) -> None:
        super().__init__(name, instrument.world.clock)
        self._instrument = instrument
        self._channels = channels
        self._reference = reference_ohms
        self._excitation = excitation_volts
        self._steinhart_hart = steinhart_hart
        self._limits = temperature_limits
        instrument.set_inputs_up(channels, 10.0, resolution_index, samples, sample_rate)

    @property
    def identity(self) -> Identity:
        """Identity of the instrument."""
        return self._instrument.identity

    def measure(self) -> dict[str, float]:
        """Measure the temperature in °C, by means of conversions."""
        return self._temperature(*(each.average for each in _bursts(self.name, self._instrument, self._channels)))

    def glance(self) -> dict[str, float]:
        """Measure the temperature in °C by one conversion."""
        return self._temperature(*map(self._instrument.convert, self._channels))

    def safe(self) -> None:
        """Do nothing: a sensor is safe in any state."""

    def close(self) -> None:
        """Do nothing: there is no line."""

    def _temperature(self, divider: float, excitation: float) -> dict[str, float]:
        if not 0.8 <= excitation / self._excitation <= 1.2:
            raise DeviceError(self.name, f"excitation of the thermistor is {excitation:.3g} V")
        share = divider / excitation
        if not 0.01 < share < 0.99:
            raise DeviceError(self.name, f"thermistor {'open' if share > 0.5 else 'shorted'}")
        a, b, c = self._steinhart_hart
        log = math.log(self._reference * share / (1 - share))
        temperature = 1 / (a + b * log + c * log**3) - _KELVIN
        low, high = self._limits
        if not low <= temperature <= high:
            raise DeviceError(self.name, f"temperature {temperature:.4g} °C is outside of {low:g} to {high:g} °C")
        return {f"{self.name}_temperature": temperature}


class EmulatedHighVoltageSupply(VoltageSupply):
    """The role of a voltage supply, played by an emulated T7 and the amplifier behind it, without a wire.

    Parameters
    ----------
    name : str
        Name in the rig.
    instrument : EmulatedT7
        The instrument; its inputs are set up here, its line is switched off and put under its watchdog.
    channels : tuple of int
        Inputs of the amplifier's voltage monitor, current monitor and status output, 0 to 13.
    analog_output : str
        Output of the set-point: dac0, dac1, or tdac0 to tdac22.
    line, active_high, watchdog
        Line of the enable input, as those of `EmulatedSwitch`.
    gain, offset_volts, volts_per_volt, amperes_per_volt : float
        The amplifier, as those of `PiezoAmplifier`.
    voltage_limits : tuple of float
        Lowest and highest set-point in V.
    resolution_index, samples, sample_rate
        Resolution index 0 to 8, conversions that one measurement averages, and conversions in a second in Hz.

    Raises
    ------
    RegisterError
        If the instrument refuses a setting.
    """

    _STATUS_AGE = 0.1  # s, after which `set` looks at the status again

    def __init__(
        self,
        name: str,
        instrument: EmulatedT7,
        *,
        line: int,
        channels: tuple[int, int, int] = (0, 1, 2),
        analog_output: str = "tdac0",
        active_high: bool = True,
        watchdog: int = 5,
        gain: float = 20.0,
        offset_volts: float = 0.0,
        volts_per_volt: float = 20.0,
        amperes_per_volt: float = 0.01,
        voltage_limits: tuple[float, float] = (-40.0, 40.0),
        resolution_index: int = 4,
        samples: int = 10,
        sample_rate: float = 1000.0,
    ) -> None:
        super().__init__(name, instrument.world.clock)
        self._instrument = instrument
        self._channels = channels
        kind, number = analog_output.split("dac")
        self._address = (30000 if kind else 1000) + 2 * int(number)
        self._gain = gain
        self._offset = offset_volts
        self._scales = (volts_per_volt, amperes_per_volt)
        self._limits = Limits(*voltage_limits, "V")
        self._setpoint = math.nan
        self._enabled = False
        self._looked = -math.inf
        self._sent = Status.completed(name, instrument.world.clock)
        instrument.set_inputs_up(channels, 10.0, resolution_index, samples, sample_rate)
        self._send(0.0)
        self._enable = EmulatedSwitch(name, instrument, line=line, active_high=active_high, watchdog=watchdog)

    @property
    def identity(self) -> Identity:
        """Identity of the instrument."""
        return self._instrument.identity

    @property
    def limits(self) -> Limits:
        """The voltages that are allowed."""
        return self._limits

    @property
    def output(self) -> str:
        """What the set-point is: a constant voltage."""
        return "dc"

    @property
    def setpoint(self) -> float:
        """The set-point that was last sent in V; 0 when the output went off, nan at first."""
        return self._setpoint

    def set(self, value: float) -> Status:
        """Send a voltage in V, and switch the amplifier on if it is off, at 0 V."""
        self.check(value)
        if not self._enabled:
            self._switch_on()
        elif self._clock.now() - self._looked >= self._STATUS_AGE:
            self.glance()
        self._setpoint = float(value)
        self._send(value)
        return self._sent

    def measure(self) -> dict[str, float]:
        """Measure voltage in V and current in A by the monitors, as means of conversions."""
        return self._values(*(each.average for each in _bursts(self.name, self._instrument, self._channels)))

    def glance(self) -> dict[str, float]:
        """Measure voltage in V and current in A by one conversion."""
        return self._values(*map(self._instrument.convert, self._channels))

    def safe(self) -> None:
        """Send 0 V and switch the enable line off."""
        self._setpoint = 0.0
        self._switch_off()

    def close(self) -> None:
        """Do nothing: there is no line of communication, and the enable line is left to the watchdog."""

    def _send(self, volts: float) -> None:
        self._instrument.write_value(self._address, self._offset + volts / self._gain)

    def _switch_on(self) -> None:
        self._setpoint = 0.0
        self._send(0.0)
        self._enable.set(1.0)
        self._enabled = True
        self.glance()

    def _switch_off(self) -> None:
        self._enabled = False
        self._send(0.0)
        self._enable.safe()

    def _values(self, voltage: float, current: float, status: float) -> dict[str, float]:
        self._looked = self._clock.now()
        on = status >= 2.0
        if on and not self._enabled:
            raise DeviceError(self.name, "the amplifier reports that it is on although it was switched off")
        if self._enabled and not on:
            self._setpoint = 0.0
            try:
                self._enable.measure()
                cause = "its enable line is on: its own protection has tripped"
            except DeviceError:
                cause = "its enable line is off: the watchdog has run out"
            self._switch_off()
            raise DeviceError(self.name, f"the amplifier went off by itself, while {cause}")
        volts, amperes = self._scales
        return {f"{self.name}_voltage": volts * voltage, f"{self.name}_current": amperes * current}


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


class DisplacementSensor:
    """An optical displacement sensor with a voltage in proportion to the displacement.

    Parameters
    ----------
    displacement : callable
        The displacement in m, from the plant.
    volts_per_metre : float
        Sensitivity in V/m.
    reach : float
        Displacement of either sign in m beyond which the output stays where it is.
    noise : float
        White noise in m rms, drawn anew for every conversion; zero or positive.
    resolution : float
        Steps in which the sensor gives the displacement, in m.
    rng : numpy.random.Generator
        Source of the noise.
    """

    def __init__(
        self,
        displacement: Callable[[], float],
        volts_per_metre: float = 5e4,
        reach: float = 200e-6,
        noise: float = 10e-9,
        resolution: float = 10e-9,
        *,
        rng: np.random.Generator,
    ) -> None:
        self._displacement = displacement
        self._volts_per_metre = volts_per_metre
        self._reach = reach
        self._noise = noise
        self._resolution = resolution
        self._rng = rng

    def __call__(self) -> float:
        """Return the voltage in V at this instant."""
        noisy = self._displacement() + self._noise * self._rng.standard_normal()
        shown = round(noisy / self._resolution) * self._resolution
        return self._volts_per_metre * min(max(shown, -self._reach), self._reach)


class Thermistor:
    """An NTC thermistor from the input of a divider to ground, with a reference resistor to the excitation.

    Assumptions: no self-heating, an exact reference resistor.

    Parameters
    ----------
    temperature : callable
        The temperature in °C, from the plant.
    reference_ohms : float
        Reference resistor in Ω.
    steinhart_hart : tuple of float
        A, B and C of 1/T = A + B ln R + C (ln R)³, T in K and R in Ω; B and C positive.
    excitation_volts : float
        Excitation in V.
    excitation_error : float
        How far the excitation of one instance is from that, in V rms; drawn once.
    noise : float
        White noise in K rms, drawn anew for every conversion; zero or positive.
    rng : numpy.random.Generator
        Source of the noise and of the error of the excitation.

    Attributes
    ----------
    excitation_volts : float
        Voltage of the excitation in V; for faults and drift.
    open, shorted : bool
        Whether a wire of the thermistor is broken, or its wires touch; for faults.
    """

    def __init__(
        self,
        temperature: Callable[[], float],
        reference_ohms: float = 10e3,
        steinhart_hart: tuple[float, float, float] = STEINHART_HART,
        excitation_volts: float = 2.5,
        excitation_error: float = 10e-3,
        noise: float = 0.02,
        *,
        rng: np.random.Generator,
    ) -> None:
        self.excitation_volts = excitation_volts + excitation_error * rng.standard_normal()
        self.open = False
        self.shorted = False
        self._temperature = temperature
        self._reference = reference_ohms
        self._steinhart_hart = steinhart_hart
        self._noise = noise
        self._rng = rng

    def divider(self) -> float:
        """Return the voltage in V at the input of the divider at this instant."""
        if self.shorted:
            return 0.0
        if self.open:
            return self.excitation_volts
        ohms = self._ohms(self._temperature() + self._noise * self._rng.standard_normal())
        return self.excitation_volts * ohms / (ohms + self._reference)

    def excitation(self) -> float:
        """Return the voltage in V of the excitation at this instant."""
        return self.excitation_volts

    def _ohms(self, celsius: float) -> float:
        """Return the resistance in Ω: the one real root of a cubic equation in ln R."""
        a, b, c = self._steinhart_hart
        half = (a - 1 / (celsius + _KELVIN)) / (2 * c)
        root = math.sqrt((b / (3 * c)) ** 3 + half**2)
        return math.exp(math.cbrt(root - half) - math.cbrt(root + half))


class PiezoLoad(Protocol):
    """What a high-voltage amplifier drives."""

    def apply(self, voltage: float) -> None:
        """Apply a voltage, V; held until the next."""


class PiezoAmplifier:
    """A high-voltage amplifier of fixed gain with an enable input, two monitors and a status output; `Timed`.

    The output goes to a new value as a lag of first order does. The monitors show it exactly. The load, which
    holds a voltage until the next, gets it in even steps of `STEP` or less, each at the instant at which the
    output passes the middle of the step, so that it is half a step off at most, and arrives. It never goes back on
    its way, also when the next set-point comes before it arrives. The output is clipped at ±`SATURATION`, and goes
    to 0 V while the amplifier is off.

    Assumptions: the protection stays tripped until the enable input is taken away; the status output changes at
    once.

    Parameters
    ----------
    world : World
        The laboratory that the amplifier stands in.
    load : PiezoLoad
        What is driven, 0 V at first.
    gain : float
        Gain in V/V.
    offset_volts : float
        Input in V at which the output is 0 V.
    settling_time : float
        Time constant of the output in s.
    capacitance : float
        Capacitance of the load in F, for the current.
    volts_per_volt, amperes_per_volt : float
        Output voltage and current per volt of their monitors.
    scale_error : float
        How far gain and voltage monitor of one instance are from their values, as a share, rms; drawn once.
    noise_volts : float
        White noise of either monitor in V rms, drawn anew for every conversion; zero or positive.
    rng : numpy.random.Generator
        Source of the noise and of the errors of scale.
    """

    SATURATION = 45.0
    STEP = 0.125
    STATUS = 5.0

    def __init__(
        self,
        world: World,
        load: PiezoLoad,
        *,
        gain: float = 20.0,
        offset_volts: float = 0.0,
        settling_time: float = 0.2e-3,
        capacitance: float = 20e-9,
        volts_per_volt: float = 20.0,
        amperes_per_volt: float = 0.01,
        scale_error: float = 1e-3,
        noise_volts: float = 0.2e-3,
        rng: np.random.Generator,
    ) -> None:
        self._world = world
        self._load = load
        self._gain = gain * (1 + scale_error * rng.standard_normal())
        self._offset = offset_volts
        self._time_constant = settling_time
        self._capacitance = capacitance
        self._volts_per_volt = volts_per_volt * (1 + scale_error * rng.standard_normal())
        self._amperes_per_volt = amperes_per_volt
        self._noise = noise_volts
        self._rng = rng
        self._input = offset_volts
        self._enabled = False
        self._tripped = False
        self._start = self._target = self._applied = 0.0
        self._since = world.time
        self._step = self._steps = 0
        self._due = math.inf
        world.add(self)

    @property
    def on(self) -> bool:
        """Whether the output follows the input."""
        return self._enabled and not self._tripped

    @property
    def voltage(self) -> float:
        """Voltage of the output in V, where the world stands."""
        elapsed = self._world.time - self._since
        return self._target + (self._start - self._target) * math.exp(-elapsed / self._time_constant)

    def drive(self, volts: float, enable: bool) -> None:
        """Take what is at the inputs: the set-point in V, and whether the amplifier is enabled."""
        if volts == self._input and enable == self._enabled:
            return
        self._input = volts
        self._enabled = enable
        self._tripped = self._tripped and enable
        self._follow()

    def trip(self) -> None:
        """Have the protection switch the amplifier off, until the enable input is taken away."""
        with self._world.lock:
            self._world.advance()
            self._tripped = self._enabled
            self._follow()

    def voltage_monitor(self) -> float:
        """Return the voltage in V of the voltage monitor at this instant."""
        return self.voltage / self._volts_per_volt + self._noise * self._rng.standard_normal()

    def current_monitor(self) -> float:
        """Return the voltage in V of the current monitor at this instant."""
        amperes = self._capacitance * (self._target - self.voltage) / self._time_constant
        return amperes / self._amperes_per_volt + self._noise * self._rng.standard_normal()

    def status(self) -> float:
        """Return the voltage in V of the status output: high while the amplifier is on."""
        return self.STATUS if self.on else 0.0

    def deadline(self) -> float:
        """Return when the load gets its next step, in laboratory seconds; infinity when the output has settled."""
        return self._due

    def expire(self) -> None:
        """Give the load its next step."""
        self._step += 1
        share = self._step / self._steps
        self._apply(self._start + share * (self._target - self._start) if share < 1 else self._target)
        self._schedule()

    def _follow(self) -> None:
        output = self._gain * (self._input - self._offset) if self.on else 0.0
        target = min(max(output, -self.SATURATION), self.SATURATION)
        if target == self._target:
            return
        self._start = self.voltage
        self._target = target
        self._since = self._world.time
        self._apply(self._start)
        self._step = 0
        self._steps = math.ceil(abs(target - self._start) / self.STEP)
        self._schedule()

    def _schedule(self) -> None:
        left = self._steps - self._step - 0.5
        self._due = self._since + self._time_constant * math.log(self._steps / left) if left > 0 else math.inf

    def _apply(self, volts: float) -> None:
        # A load that is ahead of the output waits for it: going back would be a loop of its hysteresis.
        low, high = (volts, self._target) if volts < self._target else (self._target, volts)
        volts = min(max(self._applied, low), high)
        if volts != self._applied:
            self._applied = volts
            self._load.apply(volts)
