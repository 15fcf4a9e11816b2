"""LabJack T7 over Modbus TCP, as a position sensor behind a position-sensitive detector.

Sources: `ljm_constants.json` (repository labjack/ljm_constants) for the register map; LabJack, Direct Modbus TCP,
Protocol Details, for the byte order; LabJack T-series datasheet 14.1.7 for averaging in the instrument, 14.3.0
for the analog inputs.

Assumptions: error details 2371, 2372 and 2374 belong to the names that stand between the known 2370, 2373 and
2375 in the error table; the instrument reads back the settings that were written; one request that spans the
averages of two inputs carries out both bursts, one after the other. The datasheet gives the
highest scan rate of each resolution index in appendix A-1: a rate beyond it makes the instrument refuse the
burst, and the error says so.
"""

from __future__ import annotations

import logging
import math
import re
import struct
from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal, NamedTuple, Self

from pydantic import Field, field_validator, model_validator
from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.pdu import ModbusPDU

from bench.clock import Clock
from bench.devices import DriverSettings, Identity, PositionSensor
from bench.errors import DeviceConnectionError, DeviceError

# Everything that pymodbus logs as an error is raised here with the name of the device.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

DEFAULT_PORT = 502
CHANNELS = 14

_UNIT = 1  # LabJack takes any
_SINGLE_ENDED = 199
_AVERAGE_MIN_MAX = 3  # AIN_EF_INDEX, datasheet 14.1.7
_LONGEST_BURST = 0.18  # s, datasheet 14.1.7
_MOST_SAMPLES = 16384
_MISSED_SAMPLE = -9999.0  # what a stream puts in place of a sample that it had to leave out
_RAIL = 0.999  # share of the nominal range from which on a reading counts as over-range
_USABLE = 0.95  # share of a detector's length that limits may use

_TEST_WORDS = (0x0011, 0x2233)
_TEST_FLOAT = -9999.0
_PRODUCT = 7.0
_PRODUCTS = {4.0: "a LabJack T4", 8.0: "a LabJack T8", 200.0: "a LabJack Digit"}

_AIN = 0
_STREAM_SETTLING_US = 4008
_STREAM_RESOLUTION_INDEX = 4010
_EF_READ_AVERAGE = 7000
_EF_READ_MAXIMUM = 7300
_EF_READ_MINIMUM = 7600
_EF_INDEX = 9000
_EF_SAMPLES = 9300
_EF_SCAN_RATE = 10200
_RANGE = 40000
_NEGATIVE_CH = 41000
_RESOLUTION_INDEX = 41500
_SETTLING_US = 42000
_LAST_ERR_DETAIL = 55000
_TEST = 55100
_TEST_FLOAT32 = 55124
_PRODUCT_ID = 60000
_FIRMWARE = 60004
_SERIAL = 60028

_EXCEPTIONS = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "device failure",
    5: "acknowledge",
    6: "device busy",
    7: "negative acknowledge",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target does not respond",
}
_DETAILS = {
    2370: "AIN range not available",
    2371: "AIN settling time too long",
    2372: "AIN is set to binary",
    2373: "AIN negative channel not allowed",
    2374: "only zero may be written",
    2375: "AIN resolution index not allowed",
}

_HOST = re.compile(r"(?:tcp://)?(?P<host>\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(?::(?P<port>[0-9]{1,5}))?/?")


class T7Settings(DriverSettings):
    """What a rig file says of a T7 that reads a position-sensitive detector."""

    port: str = Field(
        description="address as tcp://HOST:PORT, such as tcp://192.168.1.207:502; HOST alone means port 502"
    )
    timeout: float = Field(default=1.0, ge=0.05, le=60.0, description="longest wait for a reply in s, 0.05 to 60")
    readout: Literal["voltage", "currents"] = Field(
        default="voltage",
        description="voltage: one normalised voltage; currents: two amplified photocurrents",
    )
    channels: tuple[Annotated[int, Field(ge=0, lt=CHANNELS)], ...] = Field(
        default=(0,),
        description="analog inputs, 0 to 13: one for a voltage; those of current 1 and current 2 for currents",
    )
    range: float = Field(default=10.0, description="input range in V: 10, 1, 0.1 or 0.01, either sign")
    resolution_index: int = Field(
        default=4,
        ge=0,
        le=8,
        description="resolution index, 0 (default of the instrument) to 8 (least noise, slowest)",
    )
    settling_us: float = Field(
        default=0.0, ge=0.0, le=4400.0, description="settling time of an input in µs, 0 (automatic) to 4400"
    )
    samples: int = Field(
        default=10, ge=1, le=_MOST_SAMPLES, description="conversions averaged in one measurement, 1 to 16384"
    )
    sample_rate: float = Field(
        default=1000.0, gt=0.0, le=100_000.0, description="conversions in a second in Hz, above 0 to 100000"
    )
    volts_per_metre: float = Field(
        default=1e5, description="voltage readout: sensitivity in V/m, not 0; 1e5 is 0.1 V/µm"
    )
    zero_volts: float = Field(
        default=0.0, ge=-10.0, le=10.0, description="voltage readout: voltage at position zero in V, -10 to 10"
    )
    psd_length: float = Field(
        default=0.037,
        gt=0.0,
        le=1.0,
        description="currents readout: length of the detector in m, above 0 to 1; 0.037 for a Hamamatsu S3270",
    )
    metres_per_metre: float = Field(
        default=185.0,
        description="currents readout: movement of the spot per movement of the tip, not 0; its sign is kept",
    )
    minimum_sum_volts: float = Field(
        default=0.5,
        gt=0.0,
        le=20.0,
        description="currents readout: sum of both voltages in V below which the light is lost, above 0 to 20",
    )
    position_limits: tuple[float, float] = Field(
        default=(-90e-6, 90e-6), description="calibrated range in m, low and high; a reading beyond is an error"
    )

    @field_validator("port")
    @classmethod
    def _check_port(cls, value: str) -> str:
        if value.startswith("emulated://"):
            return value  # the rig puts the loopback address of its emulated laboratory in place of it
        match = _HOST.fullmatch(value.strip())
        number = int(match["port"] or DEFAULT_PORT) if match else 0
        if match is None or not 1 <= number <= 65535:
            raise ValueError(f"expected tcp://HOST:PORT with port 1 to 65535, got {value!r}")
        return f"tcp://{match['host']}:{number}"

    @field_validator("range")
    @classmethod
    def _check_range(cls, value: float) -> float:
        if value not in (10.0, 1.0, 0.1, 0.01):
            raise ValueError(f"allowed are 10, 1, 0.1 and 0.01 V, got {value:g}")
        return value

    @field_validator("volts_per_metre", "metres_per_metre")
    @classmethod
    def _check_slope(cls, value: float) -> float:
        if value == 0 or not math.isfinite(value):
            raise ValueError("must be a number other than 0")
        return value

    @model_validator(mode="after")
    def _check_together(self) -> Self:
        expected = 1 if self.readout == "voltage" else 2
        if len(set(self.channels)) != expected or len(self.channels) != expected:
            raise ValueError(
                f"channels: readout {self.readout!r} needs {expected} different, got {list(self.channels)}"
            )
        low, high = self.position_limits
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ValueError(f"position_limits: expected low < high, got {low:g} and {high:g} m")
        if self.readout == "currents":
            # A spot that leaves the detector reads as at its end, which must not pass for a position.
            reach = _USABLE * self.psd_length / 2 / abs(self.metres_per_metre)
            if max(-low, high) > reach:
                raise ValueError(
                    f"position_limits: the detector reaches ±{reach:.4g} m (95 % of its half length over the "
                    f"magnification), got {low:g} and {high:g} m"
                )
        duration = self.samples / self.sample_rate
        if self.samples > 1 and duration > _LONGEST_BURST:
            raise ValueError(
                f"samples / sample_rate: a T7 averages over at most {_LONGEST_BURST:g} s, got {duration:g} s"
            )
        if len(self.channels) * duration >= self.timeout:
            raise ValueError(f"timeout: a measurement alone takes {len(self.channels) * duration:g} s")
        return self


class LabJackT7:
    """The registers of a LabJack T7, over Modbus TCP.

    Parameters
    ----------
    name : str
        Name of the device, for messages.
    port : str
        Address as `tcp://HOST:PORT`.
    timeout : float
        Longest wait for a connection or a reply in s.

    Raises
    ------
    DeviceConnectionError
        If nobody accepts the connection.
    """

    def __init__(self, name: str, port: str, timeout: float) -> None:
        self._name = name
        self._address = port
        host, _, number = port.removeprefix("tcp://").rpartition(":")
        # TCP repeats what gets lost by itself: repeating a request would only make a dead device dearer.
        self._client = ModbusTcpClient(host.strip("[]"), port=int(number), timeout=timeout, retries=0)
        self._timeout = timeout
        self._connected: bool = self._client.connect()  # type: ignore[no-untyped-call]
        if not self._connected:
            self.close()
            raise DeviceConnectionError(
                name,
                f"nobody accepts a connection at {port}; "
                "check the address, the cable and that the instrument has power",
            )

    def close(self) -> None:
        """Release the connection."""
        self._connected = False
        self._client.close()  # type: ignore[no-untyped-call]

    def read_words(self, address: int, count: int) -> list[int]:
        """Get `count` registers from `address` on, each 0 to 65535."""
        if not self._connected:
            raise self._lost()
        try:
            response = self._client.read_holding_registers(address, count=count, device_id=_UNIT)
        except (ModbusException, OSError) as error:
            raise self._broken(error) from error
        self._check(response, f"reading register {address}")
        if len(response.registers) != count:
            raise DeviceError(self._name, f"sent {len(response.registers)} registers where {count} were asked for")
        return list(response.registers)

    def write_words(self, address: int, words: Sequence[int]) -> None:
        """Set registers from `address` on, each 0 to 65535."""
        if not self._connected:
            raise self._lost()
        try:
            response = self._client.write_registers(address, list(words), device_id=_UNIT)
        except (ModbusException, OSError) as error:
            raise self._broken(error) from error
        self._check(response, f"writing register {address}")

    def read_f32(self, address: int, count: int = 1) -> list[float]:
        """Get `count` FLOAT32 values from `address` on."""
        words = self.read_words(address, 2 * count)
        return list(struct.unpack(f">{count}f", struct.pack(f">{2 * count}H", *words)))

    def read_u32(self, address: int) -> int:
        """Get a UINT32 value."""
        high, low = self.read_words(address, 2)
        return high << 16 | low

    def read_u16(self, address: int) -> int:
        """Get a UINT16 value."""
        return self.read_words(address, 1)[0]

    def set_f32(self, register: str, address: int, value: float) -> None:
        """Set a FLOAT32 value and read it back; `register` is its name for messages."""
        self.write_words(address, struct.unpack(">2H", struct.pack(">f", value)))
        (actual,) = self.read_f32(address)
        if not math.isclose(actual, value, rel_tol=1e-5, abs_tol=1e-6):
            raise self._not_taken(register, value, actual)

    def set_u32(self, register: str, address: int, value: int) -> None:
        """Set a UINT32 value and read it back; `register` is its name for messages."""
        self.write_words(address, (value >> 16, value & 0xFFFF))
        actual = self.read_u32(address)
        if actual != value:
            raise self._not_taken(register, value, actual)

    def set_u16(self, register: str, address: int, value: int) -> None:
        """Set a UINT16 value and read it back; `register` is its name for messages."""
        self.write_words(address, (value,))
        actual = self.read_u16(address)
        if actual != value:
            raise self._not_taken(register, value, actual)

    def identify(self) -> Identity:
        """Check the byte order and the product, and get the identity.

        Raises
        ------
        DeviceConnectionError
            If another device answers, or words or bytes arrive in another order than LabJack's.
        """
        try:
            words = tuple(self.read_words(_TEST, 2))
        except DeviceConnectionError:
            raise
        except DeviceError as error:
            reason = str(error).removeprefix(f"{self._name}: ")
            raise self._wrong(f"is no LabJack T-series: register TEST gave {reason}") from error
        if words == _TEST_WORDS[::-1]:
            raise self._wrong("sends the words of a value in swapped order; is there a gateway in between?")
        if words == tuple((word & 0xFF) << 8 | word >> 8 for word in _TEST_WORDS):
            raise self._wrong("sends the bytes of a word in swapped order; is there a gateway in between?")
        if words != _TEST_WORDS:
            raise self._wrong(
                f"is no LabJack T-series: register TEST is 0x{words[0]:04X}{words[1]:04X}, not 0x00112233"
            )
        (value,) = self.read_f32(_TEST_FLOAT32)
        if value != _TEST_FLOAT:
            raise self._wrong(f"sends FLOAT32 in another form: TEST_FLOAT32 is {value:g}, not -9999")
        (product,) = self.read_f32(_PRODUCT_ID)
        if product != _PRODUCT:
            known = _PRODUCTS.get(product, "another product")
            raise self._wrong(f"is {known}, not a T7: PRODUCT_ID is {product:g}, not 7")
        (firmware,) = self.read_f32(_FIRMWARE)
        return Identity("LabJack", "T7", str(self.read_u32(_SERIAL)), f"{firmware:.4f}")

    def _check(self, response: ModbusPDU, doing: str) -> None:
        if not response.isError():
            return
        code = response.exception_code
        message = f"Modbus exception {code} ({_EXCEPTIONS.get(code, 'unknown')}) on {doing}"
        detail = self._last_error()
        if detail:
            message += f"; LAST_ERR_DETAIL {detail} ({_DETAILS.get(detail, 'see the LabJack error codes')})"
        raise DeviceError(self._name, message)

    def _last_error(self) -> int:
        """Get what the instrument says of its last error; 0 when it says nothing."""
        try:
            response = self._client.read_holding_registers(_LAST_ERR_DETAIL, count=1, device_id=_UNIT)
        except (ModbusException, OSError) as error:
            raise self._broken(error) from error
        return response.registers[0] if not response.isError() and response.registers else 0

    def _broken(self, error: Exception) -> DeviceConnectionError:
        # A late reply must not be taken for that to the next request, and an instrument that restarted has
        # lost its settings: the connection ends here.
        self.close()
        return DeviceConnectionError(
            self._name,
            f"no reply from {self._address} within {self._timeout:g} s, or the connection broke; "
            f"check cable and power, then connect again ({error})",
        )

    def _lost(self) -> DeviceConnectionError:
        return DeviceConnectionError(
            self._name,
            f"the connection to {self._address} is closed; connect again, so that the instrument is set up again",
        )

    def _wrong(self, what: str) -> DeviceConnectionError:
        return DeviceConnectionError(self._name, f"the device at {self._address} {what}")

    def _not_taken(self, register: str, value: float, actual: float) -> DeviceError:
        return DeviceError(
            self._name,
            f"{register} reads back {actual:g} after {value:g} was written; is another program using the instrument?",
        )


class _Voltage(NamedTuple):
    """What was read of one input, in V."""

    mean: float
    maximum: float
    minimum: float


class T7PositionSensor(PositionSensor):
    """A position-sensitive detector on one or two analog inputs of a LabJack T7.

    `measure` has the instrument average a burst of `samples` conversions (datasheet 14.1.7) and looks at the
    extremes of the burst too, as clipped conversions would shift the mean. It takes three requests, or three
    for each current if the inputs are not neighbours in ascending order. The two currents are averaged one
    after the other, and the position is the ratio of the means. `glance` takes one conversion.

    The settings of bursts (STREAM_RESOLUTION_INDEX, STREAM_SETTLING_US) are common to all inputs of one
    instrument.

    Parameters
    ----------
    name : str
        Name in the rig.
    clock : Clock
        The clock of the run.
    settings : T7PositionSensor.Settings
        What the rig file says.
    instrument : LabJackT7
        The connection; `connect` makes it.
    identity : Identity
        What the instrument said of itself.
    """

    Settings: ClassVar[type[T7Settings]] = T7Settings

    def __init__(
        self, name: str, clock: Clock, settings: T7Settings, instrument: LabJackT7, identity: Identity
    ) -> None:
        super().__init__(name, clock)
        self._settings = settings
        self._instrument = instrument
        self._identity = identity

    @classmethod
    def connect(cls, name: str, settings: T7Settings, clock: Clock) -> T7PositionSensor:
        """Open the connection, check that a T7 answers, and set its inputs up.

        Raises
        ------
        DeviceConnectionError
            If nobody answers, or another device, or with swapped words.
        DeviceError
            If the instrument does not take a setting.
        """
        instrument = LabJackT7(name, settings.port, settings.timeout)
        try:
            sensor = cls(name, clock, settings, instrument, instrument.identify())
            sensor._set_up()
        except BaseException:
            instrument.close()
            raise
        return sensor

    @property
    def identity(self) -> Identity:
        """Get the identity that the instrument gave on connecting."""
        return self._identity

    def measure(self) -> dict[str, float]:
        """Measure the position in m, as the mean of `samples` conversions.

        Raises
        ------
        DeviceError
            If an input is over its range, the light is lost, or the position is outside of its calibration.
        DeviceConnectionError
            If the instrument does not answer.
        """
        if self._settings.samples == 1:
            return self.glance()
        means = self._read(_EF_READ_AVERAGE)  # this one starts the burst and waits for its end
        maxima = self._read(_EF_READ_MAXIMUM)
        minima = self._read(_EF_READ_MINIMUM)
        return self._position([_Voltage(*each) for each in zip(means, maxima, minima, strict=True)])

    def glance(self) -> dict[str, float]:
        """Measure the position in m by one conversion; raises what `measure` does."""
        return self._position([_Voltage(volts, volts, volts) for volts in self._read(_AIN)])

    def safe(self) -> None:
        """Do nothing: a sensor is safe in any state."""

    def close(self) -> None:
        """Release the connection."""
        self._instrument.close()

    def _set_up(self) -> None:
        settings, instrument = self._settings, self._instrument
        instrument.set_u32("STREAM_RESOLUTION_INDEX", _STREAM_RESOLUTION_INDEX, settings.resolution_index)
        instrument.set_f32("STREAM_SETTLING_US", _STREAM_SETTLING_US, settings.settling_us)
        for channel in settings.channels:
            ain, two = f"AIN{channel}", 2 * channel
            instrument.set_f32(f"{ain}_RANGE", _RANGE + two, settings.range)
            instrument.set_u16(f"{ain}_NEGATIVE_CH", _NEGATIVE_CH + channel, _SINGLE_ENDED)
            instrument.set_u16(f"{ain}_RESOLUTION_INDEX", _RESOLUTION_INDEX + channel, settings.resolution_index)
            instrument.set_f32(f"{ain}_SETTLING_US", _SETTLING_US + two, settings.settling_us)
            # Off first, so that nothing of an earlier set-up stays.
            instrument.set_u32(f"{ain}_EF_INDEX", _EF_INDEX + two, 0)
            if settings.samples > 1:
                instrument.set_u32(f"{ain}_EF_INDEX", _EF_INDEX + two, _AVERAGE_MIN_MAX)
                instrument.set_u32(f"{ain}_EF_CONFIG_A", _EF_SAMPLES + two, settings.samples)
                instrument.set_f32(f"{ain}_EF_CONFIG_D", _EF_SCAN_RATE + two, settings.sample_rate)

    def _read(self, register: int) -> list[float]:
        """Get the FLOAT32 at `register` of every input, in one request where they are neighbours."""
        channels = self._settings.channels
        if channels == tuple(range(channels[0], channels[0] + len(channels))):
            return self._instrument.read_f32(register + 2 * channels[0], len(channels))
        return [self._instrument.read_f32(register + 2 * channel)[0] for channel in channels]

    def _position(self, voltages: Sequence[_Voltage]) -> dict[str, float]:
        settings = self._settings
        for channel, voltage in zip(settings.channels, voltages, strict=True):
            self._check_range(channel, voltage)
        if settings.readout == "voltage":
            position = (voltages[0].mean - settings.zero_volts) / settings.volts_per_metre
        else:
            first, second = (voltage.mean for voltage in voltages)
            total = first + second
            if total < settings.minimum_sum_volts:
                raise DeviceError(
                    self.name,
                    f"light lost: both currents together give {total:.3g} V, "
                    f"less than {settings.minimum_sum_volts:g} V; check the laser and the spot on the detector",
                )
            spot = settings.psd_length / 2 * (second - first) / total
            position = spot / settings.metres_per_metre
        low, high = settings.position_limits
        if not low <= position <= high:
            raise DeviceError(
                self.name,
                f"position {position:.6g} m is outside of its calibrated range {low:g} to {high:g} m; "
                "bring the actuator back or extend the calibration and `position_limits`",
            )
        return {f"{self.name}_position": position}

    def _check_range(self, channel: int, voltage: _Voltage) -> None:
        if not all(map(math.isfinite, voltage)) or _MISSED_SAMPLE in voltage:
            raise DeviceError(
                self.name,
                f"AIN{channel} gave no valid conversion; choose a lower `sample_rate` or `resolution_index`",
            )
        limit = self._settings.range
        extreme = max(voltage, key=abs)
        if abs(extreme) >= _RAIL * limit:
            raise DeviceError(
                self.name,
                f"AIN{channel} reads {extreme:.4g} V and is over its range of ±{limit:g} V; choose a larger "
                "`range`, or bring the spot back onto the detector",
            )
