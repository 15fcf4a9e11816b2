"""LabJack T7 over Modbus TCP: sensors of position and temperature, a switch, and a high-voltage supply for a piezo.

Several devices may stand for one instrument, each with a connection of its own; they are set up one after the
other.

Sources: `ljm_constants.json` (repository labjack/ljm_constants) for the register map; LabJack, Direct Modbus TCP,
Protocol Details, for the byte order; LabJack T-series datasheet 14.1.7 for averaging in the instrument, 14.3.0
for the analog inputs, 15.0 for the analog outputs, 13.0 for the digital lines, 23.0 for the watchdog; LJTick-DAC
datasheet for the outputs TDAC; Steinhart and Hart 1968, Deep-Sea Research 15, for thermistors.

Assumptions: error details 2371, 2372 and 2374 belong to the names that stand between the known 2370, 2373 and
2375 in the error table; the instrument reads back the settings that were written; one request that spans the
averages of two inputs carries out both bursts, one after the other. The datasheet gives the
highest scan rate of each resolution index in appendix A-1: a rate beyond it makes the instrument refuse the
burst, and the error says so. A linear magnet sensor such as the SPS-L035-LATS gives 10 to 90 % of its supply of
5 V over its stroke of 35 mm, and stays at 10 or 90 % when the magnet is beyond the end. The settings of
the watchdog outlast a restart of the instrument, as their names (..._DEFAULT) suggest, and reading the register of
a single digital line makes it an input, as the map says that it configures the direction too.
"""

from __future__ import annotations

import logging
import math
import re
import struct
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, ClassVar, Literal, NamedTuple, Self

from pydantic import Field, field_validator, model_validator
from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.pdu import ModbusPDU

from bench.clock import Clock
from bench.devices import (
    DriverSettings,
    Identity,
    Limits,
    PositionSensor,
    Status,
    Switch,
    TemperatureSensor,
    VoltageSupply,
)
from bench.errors import DeviceConnectionError, DeviceError

# Everything that pymodbus logs as an error is raised here with the name of the device.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

DEFAULT_PORT = 502
CHANNELS = 14
LINES = 23

_UNIT = 1  # LabJack takes any
_SINGLE_ENDED = 199
_AVERAGE_MIN_MAX = 3  # AIN_EF_INDEX, datasheet 14.1.7
_LONGEST_BURST = 0.18  # s, datasheet 14.1.7
_MOST_SAMPLES = 16384
_MISSED_SAMPLE = -9999.0  # what a stream puts in place of a sample that it had to leave out
_LARGEST_RANGE = 10.0  # V
_RAIL = 0.999  # share of the nominal range from which on a reading counts as over-range
_USABLE = 0.95  # share of a detector's length that limits may use
_READOUTS = {"voltage": 1, "currents": 2, "ratiometric": 2}  # inputs that each takes
_SUPPLY = (4.5, 5.5)  # V, of a ratiometric sensor
_OUTPUT = (0.1, 0.9)  # share of the supply that its output takes over the stroke
_END = 5e-4  # share of the stroke next to its ends that may be the magnet beyond them; half a step of the sensor
_ALL_LINES = (1 << LINES) - 1

_SHORTED, _OPEN = 0.01, 0.99  # shares of the excitation at a divider below and above which its thermistor is no more
_EXCITATION = 0.2  # share by which an excitation may be off
_KELVIN = 273.15

_DAC_REACH = (0.0, 5.0)  # V, datasheet 15.0
_TDAC_REACH = (-10.0, 10.0)  # V, datasheet of the LJTick-DAC
_STATUS_ON = 2.0  # V, from which on a status output is high, as TTL has it
_STATUS_AGE = 0.1  # s, after which `set` looks at the status again
_LOOKS, _LOOK_INTERVAL = 50, 0.01  # how often, and every how many s, a change of the status is looked for
_DISCHARGED = 1.0  # V, below which an output counts as 0 V

_TEST_WORDS = (0x0011, 0x2233)
_TEST_FLOAT = -9999.0
_PRODUCT = 7.0
_PRODUCTS = {4.0: "a LabJack T4", 8.0: "a LabJack T8", 200.0: "a LabJack Digit"}

_AIN = 0
_DAC = 1000
_DIO = 2000
_DIO_STATE = 2800
_DIO_DIRECTION = 2850
_STREAM_SETTLING_US = 4008
_STREAM_RESOLUTION_INDEX = 4010
_EF_READ_AVERAGE = 7000
_EF_READ_MAXIMUM = 7300
_EF_READ_MINIMUM = 7600
_EF_INDEX = 9000
_EF_SAMPLES = 9300
_EF_SCAN_RATE = 10200
_TDAC = 30000
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
_WATCHDOG_ENABLE = 61600
_WATCHDOG_TIMEOUT_S = 61604
_WATCHDOG_STRICT = 61610
_WATCHDOG_DIO = 61630  # enable, state, direction, inhibit
_WATCHDOG_DAC_ENABLE = (61640, 61650)

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

_Channel = Annotated[int, Field(ge=0, lt=CHANNELS)]

_HOST = re.compile(r"(?:tcp://)?(?P<host>\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(?::(?P<port>[0-9]{1,5}))?/?")


class T7ConnectionSettings(DriverSettings):
    """Where a T7 is; every device on one extends it."""

    port: str = Field(
        description="address as tcp://HOST:PORT, such as tcp://192.168.1.207:502; HOST alone means port 502"
    )
    timeout: float = Field(default=1.0, ge=0.05, le=60.0, description="longest wait for a reply in s, 0.05 to 60")

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


class T7InputSettings(T7ConnectionSettings):
    """How analog inputs are read; every sensor on a T7 extends it."""

    channels: tuple[_Channel, ...] = Field(
        default=(0,), description="analog inputs, 0 to 13; neighbours in ascending order are read at once"
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

    @field_validator("range")
    @classmethod
    def _check_range(cls, value: float) -> float:
        if value not in (10.0, 1.0, 0.1, 0.01):
            raise ValueError(f"allowed are 10, 1, 0.1 and 0.01 V, got {value:g}")
        return value

    @model_validator(mode="after")
    def _check_burst(self) -> Self:
        if len(set(self.channels)) != len(self.channels):
            raise ValueError(f"channels: expected different ones, got {list(self.channels)}")
        duration = self.samples / self.sample_rate
        if self.samples > 1 and duration > _LONGEST_BURST:
            raise ValueError(
                f"samples / sample_rate: a T7 averages over at most {_LONGEST_BURST:g} s, got {duration:g} s"
            )
        if len(self.channels) * duration >= self.timeout:
            raise ValueError(f"timeout: a measurement alone takes {len(self.channels) * duration:g} s")
        return self


class T7Settings(T7InputSettings):
    """What a rig file says of a T7 that reads a position."""

    readout: Literal["voltage", "currents", "ratiometric"] = Field(
        default="voltage",
        description="voltage: one normalised voltage; currents: two amplified photocurrents, 1 and 2; ratiometric: "
        "output and supply of a sensor whose output is a share of its supply",
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
    stroke: float = Field(
        default=0.035,
        gt=0.0,
        le=1.0,
        description="ratiometric readout: stroke of the sensor in m, above 0 to 1; 0.035 for an SPS-L035-LATS",
    )
    zero_position: float = Field(
        default=0.0,
        ge=0.0,
        le=1.0,
        description="ratiometric readout: where on the stroke the position reads zero in m, 0 to the stroke",
    )
    position_limits: tuple[float, float] = Field(
        default=(-90e-6, 90e-6), description="calibrated range in m, low and high; a reading beyond is an error"
    )

    @field_validator("volts_per_metre", "metres_per_metre")
    @classmethod
    def _check_slope(cls, value: float) -> float:
        if value == 0 or not math.isfinite(value):
            raise ValueError("must be a number other than 0")
        return value

    @model_validator(mode="after")
    def _check_readout(self) -> Self:
        expected = _READOUTS[self.readout]
        if len(self.channels) != expected:
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
        if self.readout == "ratiometric":
            self._check_stroke()
        return self

    def _check_stroke(self) -> None:
        if self.range != 10.0:
            raise ValueError(f"range: a supply of 5 V needs 10 V, got {self.range:g} V")
        if self.zero_position > self.stroke:
            raise ValueError(f"zero_position: {self.zero_position:g} m is beyond the stroke of {self.stroke:g} m")
        low, high = self.position_limits
        first, last = -self.zero_position, self.stroke - self.zero_position
        rounding = 1e-9
        if low < first - rounding or high > last + rounding:
            raise ValueError(
                f"position_limits: the stroke of the sensor is {first:g} to {last:g} m, got {low:g} and {high:g} m"
            )


class T7SwitchSettings(T7ConnectionSettings):
    """What a rig file says of a T7 that switches something by a digital line."""

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


class T7ThermistorSettings(T7InputSettings):
    """What a rig file says of a T7 that reads a thermistor.

    The thermistor is between the input of the divider and ground, the reference resistor between that input and
    the excitation.
    """

    channels: tuple[_Channel, _Channel] = Field(
        default=(0, 1),
        description="analog inputs of the divider and of its excitation, 0 to 13; neighbours in ascending order are "
        "read at once",
    )
    reference_ohms: float = Field(
        default=10e3, gt=0.0, le=1e7, description="reference resistor of the divider in Ω, above 0 to 1e7"
    )
    excitation_volts: float = Field(
        default=2.5, gt=0.0, le=8.0, description="excitation of the divider in V, above 0 to 8; 20 % off is an error"
    )
    steinhart_hart: tuple[float, float, float] = Field(
        default=(1.129148e-3, 2.34125e-4, 8.76741e-8),
        description="A, B and C of 1/T = A + B ln R + C (ln R)³, T in K and R in Ω; the default is a common "
        "thermistor of 10 kΩ at 25 °C",
    )
    temperature_limits: tuple[float, float] = Field(
        default=(-40.0, 125.0), description="range in °C, low and high; a reading beyond is an error"
    )

    @model_validator(mode="after")
    def _check_divider(self) -> Self:
        highest = (1 + _EXCITATION) * self.excitation_volts
        if highest >= _RAIL * self.range:
            raise ValueError(
                f"range: an excitation of up to {highest:g} V needs more than ±{self.range:g} V; choose a larger one"
            )
        a, b, c = self.steinhart_hart
        least, most = (math.log(self.reference_ohms * share / (1 - share)) for share in (_SHORTED, _OPEN))
        # The slope of 1/T over ln R has its extremes at the ends and where |ln R| is least.
        slope = min(b + 3 * c * log**2 for log in (least, most, min(max(0.0, least), most)))
        if slope <= 0 or a + b * least + c * least**3 <= 0:
            raise ValueError(
                f"steinhart_hart: the temperature must fall all the way from {math.exp(least):.3g} to "
                f"{math.exp(most):.3g} Ω, which the divider tells apart; got {a:g}, {b:g} and {c:g}"
            )
        low, high = self.temperature_limits
        coldest, hottest = (_celsius(self.steinhart_hart, math.exp(log)) for log in (most, least))
        if not coldest < low < high < hottest:
            raise ValueError(
                f"temperature_limits: expected low < high within {coldest:.4g} to {hottest:.4g} °C, which the "
                f"divider tells from an open and a shorted thermistor; got {low:g} and {high:g} °C"
            )
        return self


class T7HighVoltageSettings(T7InputSettings, T7SwitchSettings):
    """What a rig file says of a T7 with a high-voltage amplifier of fixed gain behind it."""

    channels: tuple[_Channel, _Channel, _Channel] = Field(
        default=(0, 1, 2),
        description="analog inputs of the amplifier's voltage monitor, current monitor and status output (5 V while "
        "it is on), 0 to 13; neighbours in ascending order are read at once",
    )
    line: int = Field(
        ge=0, lt=LINES, description="digital line of the amplifier's enable input, 0 to 22, FIO0-7 are 0-7"
    )
    analog_output: str = Field(
        default="tdac0",
        pattern=r"^(dac[01]|tdac(1?\d|2[0-2]))$",
        description="output of the set-point: dac0 or dac1 (0 to 5 V), or tdac0 to tdac22 (LJTick-DAC, -10 to 10 V)",
    )
    gain: float = Field(default=20.0, description="gain of the amplifier in V/V, not 0")
    offset_volts: float = Field(
        default=0.0, ge=-10.0, le=10.0, description="input of the amplifier in V at which it gives 0 V, -10 to 10"
    )
    volts_per_volt: float = Field(default=20.0, description="output voltage per volt of the voltage monitor, not 0")
    amperes_per_volt: float = Field(default=0.01, description="output current in A per volt of its monitor, not 0")
    voltage_limits: tuple[float, float] = Field(
        default=(-40.0, 40.0), description="lowest and highest set-point in V, with 0 V between or at them"
    )

    @field_validator("gain", "volts_per_volt", "amperes_per_volt")
    @classmethod
    def _check_slope(cls, value: float) -> float:
        if value == 0:
            raise ValueError("must be a number other than 0")
        return value

    @model_validator(mode="after")
    def _check_amplifier(self) -> Self:
        if self.range != 10.0:
            raise ValueError(f"range: a status output of 5 V needs 10 V, got {self.range:g} V")
        low, high = self.voltage_limits
        if not (low <= 0 <= high and low < high):
            raise ValueError(f"voltage_limits: expected low ≤ 0 ≤ high and low < high, got {low:g} and {high:g} V")
        first, last = _TDAC_REACH if self.analog_output.startswith("t") else _DAC_REACH
        for volts in self.voltage_limits:
            sent = self.sent(volts)
            if not first <= sent <= last:
                raise ValueError(
                    f"voltage_limits: {volts:g} V takes {sent:g} V at {self.analog_output}, which gives {first:g} to "
                    f"{last:g} V"
                )
        if max(-low, high) >= abs(self.volts_per_volt) * _RAIL * self.range:
            raise ValueError(f"volts_per_volt: the voltage monitor would be over its range of ±{self.range:g} V")
        if self.analog_output.startswith("t") and self.line // 2 == int(self.analog_output[4:]) // 2:
            raise ValueError(f"line: DIO{self.line} is taken by the LJTick-DAC of {self.analog_output}")
        return self

    def sent(self, volts: float) -> float:
        """Return the voltage in V at the analog output that makes the amplifier give `volts`."""
        return self.offset_volts + volts / self.gain


def _celsius(steinhart_hart: tuple[float, float, float], ohms: float) -> float:
    """Return the temperature in °C of a thermistor by its resistance in Ω (Steinhart and Hart 1968)."""
    a, b, c = steinhart_hart
    log = math.log(ohms)
    return 1 / (a + b * log + c * log**3) - _KELVIN


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
        return self.read_u32s(address, 1)[0]

    def read_u32s(self, address: int, count: int) -> list[int]:
        """Get `count` UINT32 values from `address` on."""
        words = self.read_words(address, 2 * count)
        return list(struct.unpack(f">{count}I", struct.pack(f">{2 * count}H", *words)))

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
        self.set_u32s((register,), address, (value,))

    def set_u32s(self, registers: Sequence[str], address: int, values: Sequence[int]) -> None:
        """Set UINT32 values from `address` on and read them back; `registers` are their names for messages."""
        words = struct.unpack(f">{2 * len(values)}H", struct.pack(f">{len(values)}I", *values))
        self.write_words(address, words)
        for register, value, actual in zip(registers, values, self.read_u32s(address, len(values)), strict=True):
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


class AnalogInputs:
    """The analog inputs of a T7 that one sensor reads.

    The settings of bursts (STREAM_RESOLUTION_INDEX, STREAM_SETTLING_US) are common to all inputs of one
    instrument: sensors on the same one are given the same `resolution_index` and `settling_us`.

    Parameters
    ----------
    name : str
        Name of the device, for messages.
    instrument : LabJackT7
        The connection.
    settings : T7InputSettings
        Which inputs, and how they are read.
    """

    def __init__(self, name: str, instrument: LabJackT7, settings: T7InputSettings) -> None:
        self._name = name
        self._instrument = instrument
        self._settings = settings

    def set_up(self) -> None:
        """Write the settings to the instrument.

        Raises
        ------
        DeviceError
            If the instrument does not take one.
        """
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

    def average(self) -> list[float]:
        """Get the mean of `samples` conversions of each input in V; the inputs are averaged one after the other.

        Takes three requests, or three for each input if they are not neighbours in ascending order.

        Raises
        ------
        DeviceError
            If a conversion is not valid or over the range, as clipped conversions would shift the mean.
        DeviceConnectionError
            If the instrument does not answer.
        """
        if self._settings.samples == 1:
            return self.convert()
        means = self._read(_EF_READ_AVERAGE)  # this one starts the burst and waits for its end
        maxima = self._read(_EF_READ_MAXIMUM)
        minima = self._read(_EF_READ_MINIMUM)
        return self._checked([_Voltage(*each) for each in zip(means, maxima, minima, strict=True)])

    def convert(self) -> list[float]:
        """Get one conversion of each input in V; raises what `average` does.

        Takes one request, or one for each input if they are not neighbours in ascending order.
        """
        return self._checked([_Voltage(volts, volts, volts) for volts in self._read(_AIN)])

    def _read(self, register: int) -> list[float]:
        """Get the FLOAT32 at `register` of every input, in one request where they are neighbours."""
        channels = self._settings.channels
        if channels == tuple(range(channels[0], channels[0] + len(channels))):
            return self._instrument.read_f32(register + 2 * channels[0], len(channels))
        return [self._instrument.read_f32(register + 2 * channel)[0] for channel in channels]

    def _checked(self, voltages: Sequence[_Voltage]) -> list[float]:
        for channel, voltage in zip(self._settings.channels, voltages, strict=True):
            if not all(map(math.isfinite, voltage)) or _MISSED_SAMPLE in voltage:
                raise DeviceError(
                    self._name,
                    f"AIN{channel} gave no valid conversion; choose a lower `sample_rate` or `resolution_index`",
                )
            limit = self._settings.range
            extreme = max(voltage, key=abs)
            if abs(extreme) >= _RAIL * limit:
                larger = "choose a larger `range`, or " if limit < _LARGEST_RANGE else ""
                raise DeviceError(
                    self._name,
                    f"AIN{channel} reads {extreme:.4g} V and is over its range of ±{limit:g} V; {larger}bring what "
                    "is measured back into it",
                )
        return [voltage.mean for voltage in voltages]


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

    The instrument has one watchdog with one time. Any communication of any host feeds it, over whichever
    connection. When it runs out it drives the lines that are under it, and goes on. It must be switched off for a
    change of its settings, which takes some milliseconds. The settings are kept in the memory of the
    instrument for good, so they are written only if they differ.

    Parameters
    ----------
    name : str
        Name of the device, for messages.
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
        """Whether the level of the line is the one that is on, as the instrument says now."""
        return bool(self._instrument.read_u32(_DIO_STATE) & self._bit) == self._active_high

    def switch(self, on: bool) -> None:
        """Make the line an output with the level for on or off.

        Raises
        ------
        DeviceError
            If the instrument refuses, or if the line does not read back so.
        """
        self._instrument.write_words(_DIO + self._line, (int(on == self._active_high),))
        self.check_output()
        if self.is_on != on:
            raise DeviceError(
                self._name,
                f"{self} is {'off' if on else 'on'} right after it was switched {'on' if on else 'off'}; check the "
                "wiring for a short circuit, and that no other program uses the line",
            )

    def check_output(self) -> None:
        """Raise `DeviceError` if the line is not an output."""
        if not self._instrument.read_u32(_DIO_DIRECTION) & self._bit:
            raise DeviceError(
                self._name,
                f"{self} is an input and drives nothing; is another program using the line, or has the instrument "
                "restarted?",
            )

    @property
    def watchdog(self) -> int:
        """The time of the watchdog in s, as the instrument says now."""
        return self._instrument.read_u32(_WATCHDOG_TIMEOUT_S)

    def guard(self, seconds: int) -> None:
        """Have the watchdog switch the line off after `seconds` without communication.

        Whatever else is under the watchdog stays so, and then the shorter one of its present time and `seconds`
        holds. What a watchdog that is switched off was once set to drive is not taken over.

        Raises
        ------
        DeviceError
            If the watchdog is in strict mode, which another program feeds, or if the instrument refuses.
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
        """Take the line out of the watchdog's hands, and switch the watchdog off if nothing else is under it.

        Raises
        ------
        DeviceError
            If the instrument refuses.
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
        return bool(watchdog.enabled) and any(self._instrument.read_u32(dac) for dac in _WATCHDOG_DAC_ENABLE)

    def _watchdog(self) -> _Watchdog:
        read = self._instrument.read_u32
        return _Watchdog(
            read(_WATCHDOG_ENABLE),
            read(_WATCHDOG_TIMEOUT_S),
            read(_WATCHDOG_STRICT),
            *self._instrument.read_u32s(_WATCHDOG_DIO, 4),
        )

    def _change(self, present: _Watchdog, wanted: _Watchdog) -> None:
        if wanted == present:
            return
        instrument = self._instrument
        instrument.set_u32("WATCHDOG_ENABLE_DEFAULT", _WATCHDOG_ENABLE, 0)
        try:
            instrument.set_u32("WATCHDOG_TIMEOUT_S_DEFAULT", _WATCHDOG_TIMEOUT_S, wanted.seconds)
            instrument.set_u32("WATCHDOG_STRICT_ENABLE_DEFAULT", _WATCHDOG_STRICT, wanted.strict)
            instrument.set_u32s(
                [f"WATCHDOG_DIO_{what}_DEFAULT" for what in ("ENABLE", "STATE", "DIRECTION", "INHIBIT")],
                _WATCHDOG_DIO,
                (wanted.dio_enabled, wanted.state, wanted.direction, wanted.inhibit),
            )
        except BaseException:
            # Other outputs may depend on it, whatever is refused here.
            with suppress(DeviceError):
                instrument.set_u32("WATCHDOG_ENABLE_DEFAULT", _WATCHDOG_ENABLE, present.enabled)
            raise
        if wanted.enabled:
            instrument.set_u32("WATCHDOG_ENABLE_DEFAULT", _WATCHDOG_ENABLE, 1)


class T7PositionSensor(PositionSensor):
    """A position sensor on one or two analog inputs of a LabJack T7: a detector of light, or a linear sensor.

    `measure` has the instrument average a burst of `samples` conversions (datasheet 14.1.7) and looks at the
    extremes of the burst too. Two inputs are averaged one after the other, and the position comes from the ratio
    of the means. `glance` takes one conversion. With two inputs that are neighbours in ascending order these take
    three requests and one.

    A ratiometric sensor whose magnet is beyond the end of its stroke reads as if it were at the end, so readings
    within 0.05 % of the stroke from its ends are errors.

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
        self._inputs = AnalogInputs(name, instrument, settings)
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
            sensor._inputs.set_up()
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
            If an input is over its range, the light is lost, the sensor has no supply or its output is not what
            it gives over its stroke, or the position is outside of its calibration.
        DeviceConnectionError
            If the instrument does not answer.
        """
        return self._position(self._inputs.average())

    def glance(self) -> dict[str, float]:
        """Measure the position in m by one conversion; raises what `measure` does."""
        return self._position(self._inputs.convert())

    def safe(self) -> None:
        """Do nothing: a sensor is safe in any state."""

    def close(self) -> None:
        """Release the connection."""
        self._instrument.close()

    def _position(self, volts: Sequence[float]) -> dict[str, float]:
        settings = self._settings
        if settings.readout == "voltage":
            position = (volts[0] - settings.zero_volts) / settings.volts_per_metre
        elif settings.readout == "currents":
            position = self._from_currents(*volts)
        else:
            position = self._from_ratio(*volts)
        low, high = settings.position_limits
        if not low <= position <= high:
            raise DeviceError(
                self.name,
                f"position {position:.6g} m is outside of its calibrated range {low:g} to {high:g} m; "
                "bring the actuator back or extend the calibration and `position_limits`",
            )
        return {f"{self.name}_position": position}

    def _from_currents(self, first: float, second: float) -> float:
        settings = self._settings
        total = first + second
        if total < settings.minimum_sum_volts:
            raise DeviceError(
                self.name,
                f"light lost: both currents together give {total:.3g} V, "
                f"less than {settings.minimum_sum_volts:g} V; check the laser and the spot on the detector",
            )
        return settings.psd_length / 2 * (second - first) / total / settings.metres_per_metre

    def _from_ratio(self, output: float, supply: float) -> float:
        settings = self._settings
        output_channel, supply_channel = settings.channels
        if not _SUPPLY[0] <= supply <= _SUPPLY[1]:
            raise DeviceError(
                self.name,
                f"supply voltage of the sensor is {supply:.3g} V at AIN{supply_channel}, expected {_SUPPLY[0]:g} to "
                f"{_SUPPLY[1]:g} V; the supply has failed or is not connected",
            )
        low, high = _OUTPUT
        share = (output / supply - low) / (high - low)
        if not _END <= share <= 1 - _END:
            raise DeviceError(
                self.name,
                f"output of the sensor at AIN{output_channel} is {100 * output / supply:.4g} % of its supply, "
                f"expected {100 * low:g} to {100 * high:g} %; the magnet is at or beyond the end of the stroke, or "
                "a wire is broken",
            )
        return settings.stroke * share - settings.zero_position


class T7Switch(Switch):
    """A digital line of a LabJack T7 that switches something on and off.

    The watchdog of the instrument switches the line off when no host has talked to the instrument for its time.
    The time is the `watchdog` of the settings, or a shorter one that another output of the same instrument asked
    for (see `DigitalOutput`): whoever keeps the line on asks for readings more often.

    Until `connect`, and after a restart of the instrument, the line is an input that is pulled up weakly: what an
    active high line switches needs a pull-down to be off then.

    Parameters
    ----------
    name : str
        Name in the rig.
    clock : Clock
        The clock of the run.
    instrument : LabJackT7
        The connection; `connect` makes it.
    identity : Identity
        What the instrument said of itself.
    output : DigitalOutput
        The line.
    """

    Settings: ClassVar[type[T7SwitchSettings]] = T7SwitchSettings

    def __init__(
        self, name: str, clock: Clock, instrument: LabJackT7, identity: Identity, output: DigitalOutput
    ) -> None:
        super().__init__(name, clock)
        self._instrument = instrument
        self._identity = identity
        self._output = output
        self._setpoint = math.nan

    @classmethod
    def connect(cls, name: str, settings: T7SwitchSettings, clock: Clock) -> T7Switch:
        """Open the connection, check that a T7 answers, switch the line off and put it under the watchdog.

        Raises
        ------
        DeviceConnectionError
            If nobody answers, or another device, or with swapped words.
        DeviceError
            If the instrument does not take a setting, or the line does not go off.
        """
        instrument = LabJackT7(name, settings.port, settings.timeout)
        try:
            identity = instrument.identify()
            output = DigitalOutput(name, instrument, settings.line, active_high=settings.active_high)
            switch = cls(name, clock, instrument, identity, output)
            output.switch(False)
            output.guard(settings.watchdog)
        except BaseException:
            instrument.close()
            raise
        return switch

    @property
    def identity(self) -> Identity:
        """Get the identity that the instrument gave on connecting."""
        return self._identity

    @property
    def setpoint(self) -> float:
        """The set-point that was last sent, 0 or 1; 0 after the safe state and the watchdog, nan at first."""
        return self._setpoint

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
        self._setpoint = float(value)
        self._output.switch(value == 1.0)
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
        self._output.check_output()
        return self.glance()

    def glance(self) -> dict[str, float]:
        """Read back whether the line is on, in one request; raises what `measure` does but for the output."""
        on = self._output.is_on
        if self._setpoint == 1.0 and not on:
            self._setpoint = 0.0
            raise DeviceError(
                self.name,
                f"{self._output} is off although it was switched on: the watchdog of the instrument has run out, as "
                f"nobody talked to it for {self._output.watchdog} s, or another program switched the line; ask for "
                "readings more often or lengthen `watchdog`, then switch it on again",
            )
        return {f"{self.name}_state": float(on)}

    def safe(self) -> None:
        """Switch off and see that the line is off.

        Raises
        ------
        DeviceError
            If that could not be confirmed; a line that cannot be reached is left to the watchdog.
        """
        self._setpoint = 0.0
        self._output.switch(False)

    def close(self) -> None:
        """Release the connection; a line that is on is left to the watchdog."""
        # An instrument that cannot be reached any more keeps its watchdog, which is as well.
        with suppress(DeviceError):
            if not self._output.is_on:
                self._output.unguard()
        self._instrument.close()


class T7Thermistor(TemperatureSensor):
    """A thermistor in a divider, of which a LabJack T7 measures the voltage and the excitation.

    The temperature comes from the ratio of both by the equation of Steinhart and Hart, so that the excitation
    need not be accurate. `measure` averages a burst of each input, `glance` takes one conversion: three requests
    and one, with inputs that are neighbours in ascending order.

    Parameters
    ----------
    name : str
        Name in the rig.
    clock : Clock
        The clock of the run.
    settings : T7Thermistor.Settings
        What the rig file says.
    instrument : LabJackT7
        The connection; `connect` makes it.
    identity : Identity
        What the instrument said of itself.
    """

    Settings: ClassVar[type[T7ThermistorSettings]] = T7ThermistorSettings

    def __init__(
        self, name: str, clock: Clock, settings: T7ThermistorSettings, instrument: LabJackT7, identity: Identity
    ) -> None:
        super().__init__(name, clock)
        self._settings = settings
        self._instrument = instrument
        self._inputs = AnalogInputs(name, instrument, settings)
        self._identity = identity

    @classmethod
    def connect(cls, name: str, settings: T7ThermistorSettings, clock: Clock) -> T7Thermistor:
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
            sensor._inputs.set_up()
        except BaseException:
            instrument.close()
            raise
        return sensor

    @property
    def identity(self) -> Identity:
        """Get the identity that the instrument gave on connecting."""
        return self._identity

    def measure(self) -> dict[str, float]:
        """Measure the temperature in °C, by the means of `samples` conversions.

        Raises
        ------
        DeviceError
            If an input is over its range, the excitation has failed, the thermistor is open or shorted, or the
            temperature is outside of its limits.
        DeviceConnectionError
            If the instrument does not answer.
        """
        return self._temperature(*self._inputs.average())

    def glance(self) -> dict[str, float]:
        """Measure the temperature in °C by one conversion; raises what `measure` does."""
        return self._temperature(*self._inputs.convert())

    def safe(self) -> None:
        """Do nothing: a sensor is safe in any state."""

    def close(self) -> None:
        """Release the connection."""
        self._instrument.close()

    def _temperature(self, divider: float, excitation: float) -> dict[str, float]:
        settings = self._settings
        divider_channel, excitation_channel = settings.channels
        low, high = ((1 + side * _EXCITATION) * settings.excitation_volts for side in (-1, 1))
        if not low <= excitation <= high:
            raise DeviceError(
                self.name,
                f"excitation of the thermistor is {excitation:.3g} V at AIN{excitation_channel}, expected {low:g} to "
                f"{high:g} V; it has failed or is not connected",
            )
        share = divider / excitation
        if share >= _OPEN:
            raise DeviceError(
                self.name,
                f"thermistor open: the divider at AIN{divider_channel} is at {100 * share:.4g} % of its excitation; "
                "a wire is broken or not connected",
            )
        if share <= _SHORTED:
            raise DeviceError(
                self.name,
                f"thermistor shorted: the divider at AIN{divider_channel} is at {100 * share:.4g} % of its "
                "excitation; check its wires for a short circuit",
            )
        temperature = _celsius(settings.steinhart_hart, settings.reference_ohms * share / (1 - share))
        lowest, highest = settings.temperature_limits
        if not lowest <= temperature <= highest:
            raise DeviceError(
                self.name,
                f"temperature {temperature:.4g} °C is outside of {lowest:g} to {highest:g} °C; bring it back, or "
                "check the thermistor and `temperature_limits`",
            )
        return {f"{self.name}_temperature": temperature}


class T7HighVoltageSupply(VoltageSupply):
    """A high-voltage amplifier of fixed gain, which a LabJack T7 gives its set-point, switches on and reads.

    An analog output gives the set-point, a digital line enables the amplifier, and three analog inputs read its
    voltage monitor, its current monitor and its status output. The watchdog of the instrument switches the enable
    line off when no host has talked to the instrument for its time (see `DigitalOutput`); it cannot drive an
    LJTick-DAC, which cannot be read back either: the voltage monitor confirms 0 V. An LJTick-DAC has 14 bits over
    ±10 V, DAC0 and DAC1 have 12 over 5 V, so a gain that uses the whole range gives the finest steps.

    Until `connect`, and after a restart of the instrument, the enable line is an input that is pulled up weakly: an
    active high enable input needs a pull-down.

    With inputs that are neighbours in ascending order, `glance` takes one request, `measure` three, and `safe`
    five or more. `set` takes one request; the first one, and the first after the output went off, six or more, and
    one whose last look at the status, by any call, was 0.1 s ago or more takes one more.

    When the amplifier went off by itself, the next `measure` or `glance` says so once, and so does the next `set`
    that looks at the status. The set-point is 0 then and the enable line off; `set` switches on again.

    Parameters
    ----------
    name : str
        Name in the rig.
    clock : Clock
        The clock of the run.
    settings : T7HighVoltageSupply.Settings
        What the rig file says.
    instrument : LabJackT7
        The connection; `connect` makes it.
    identity : Identity
        What the instrument said of itself.
    """

    Settings: ClassVar[type[T7HighVoltageSettings]] = T7HighVoltageSettings

    def __init__(
        self, name: str, clock: Clock, settings: T7HighVoltageSettings, instrument: LabJackT7, identity: Identity
    ) -> None:
        super().__init__(name, clock)
        self._settings = settings
        self._instrument = instrument
        self._inputs = AnalogInputs(name, instrument, settings)
        self._enable = DigitalOutput(name, instrument, settings.line, active_high=settings.active_high)
        self._identity = identity
        self._limits = Limits(*settings.voltage_limits, "V")
        kind, number = settings.analog_output.split("dac")
        self._address = (_TDAC if kind else _DAC) + 2 * int(number)
        self._setpoint = math.nan
        self._enabled = False
        self._looked = -math.inf
        self._sent = Status.completed(name, clock)

    @classmethod
    def connect(cls, name: str, settings: T7HighVoltageSettings, clock: Clock) -> T7HighVoltageSupply:
        """Open the connection, check that a T7 answers, switch off and put the enable line under the watchdog.

        Raises
        ------
        DeviceConnectionError
            If nobody answers, or another device, or with swapped words.
        DeviceError
            If the instrument does not take a setting, or the amplifier does not go off.
        """
        instrument = LabJackT7(name, settings.port, settings.timeout)
        try:
            supply = cls(name, clock, settings, instrument, instrument.identify())
            supply._inputs.set_up()
            supply._switch_off()
            supply._enable.guard(settings.watchdog)
        except BaseException:
            instrument.close()
            raise
        return supply

    @property
    def identity(self) -> Identity:
        """Get the identity that the instrument gave on connecting."""
        return self._identity

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
        """Send a voltage in V, and switch the amplifier on if it is off, at 0 V.

        The status is complete at once: an amplifier settles while the request goes back.

        Raises
        ------
        LimitError
            If `value` is outside of the limits; nothing is sent.
        DeviceError
            If the amplifier does not go on or went off by itself, or the instrument refuses.
        DeviceConnectionError
            If the instrument does not answer.
        """
        self.check(value)
        if not self._enabled:
            self._switch_on()
        elif self._clock.now() - self._looked >= _STATUS_AGE:
            self.glance()
        self._setpoint = float(value)
        self._send(value)
        return self._sent

    def measure(self) -> dict[str, float]:
        """Measure voltage in V and current in A by the monitors, as means of `samples` conversions.

        Raises
        ------
        DeviceError
            Once, if the amplifier went off by itself; if it is on although it was switched off, or an input is
            over its range.
        DeviceConnectionError
            If the instrument does not answer.
        """
        return self._values(*self._inputs.average())

    def glance(self) -> dict[str, float]:
        """Measure voltage in V and current in A by one conversion; raises what `measure` does."""
        return self._values(*self._inputs.convert())

    def safe(self) -> None:
        """Send 0 V, switch the enable line off, and see that the amplifier is off and its output at 0 V.

        Raises
        ------
        DeviceError
            If that could not be confirmed; everything was tried.
        """
        self._setpoint = 0.0
        self._switch_off()

    def close(self) -> None:
        """Release the connection; an output that is on is left to the watchdog."""
        # An instrument that cannot be reached any more keeps its watchdog, which is as well.
        with suppress(DeviceError):
            if not self._enable.is_on:
                self._enable.unguard()
        self._instrument.close()

    def _send(self, volts: float) -> None:
        words = struct.unpack(">2H", struct.pack(">f", self._settings.sent(volts)))
        self._instrument.write_words(self._address, words)

    def _switch_on(self) -> None:
        self._setpoint = 0.0
        try:
            self._send(0.0)
            self._enable.switch(True)
            for _ in range(_LOOKS):
                if self._look()[2]:
                    self._enabled = True
                    return
                self._clock.sleep(_LOOK_INTERVAL)
            raise DeviceError(
                self.name,
                f"the amplifier does not report that it is on {_LOOKS * _LOOK_INTERVAL:g} s after {self._enable}, "
                "its enable line, was switched on; check its power, its own protection and interlocks, and the wire "
                f"from its status output to AIN{self._settings.channels[2]}",
            )
        except BaseException:
            with suppress(DeviceError):
                self._switch_off()
            raise

    def _switch_off(self) -> None:
        """Try every step whatever comes of the others, and raise the first error."""
        self._enabled = False
        first: DeviceError | None = None
        for step in (partial(self._send, 0.0), partial(self._enable.switch, False), self._check_off):
            try:
                step()
            except DeviceError as error:
                first = first or error
        if first is not None:
            raise first

    def _check_off(self) -> None:
        for _ in range(_LOOKS):
            voltage, _, on = self._look()
            if not on and abs(voltage) < _DISCHARGED:
                return
            self._clock.sleep(_LOOK_INTERVAL)
        if on:
            raise self._still_on()
        raise DeviceError(
            self.name,
            f"the output is at {voltage:.3g} V although it was switched off; keep away from it and switch the "
            "amplifier off by hand",
        )

    def _look(self) -> tuple[float, float, bool]:
        """Get voltage in V, current in A, and whether the amplifier says that it is on, by one conversion."""
        return self._monitored(*self._inputs.convert())

    def _monitored(self, voltage: float, current: float, status: float) -> tuple[float, float, bool]:
        self._looked = self._clock.now()
        settings = self._settings
        return settings.volts_per_volt * voltage, settings.amperes_per_volt * current, status >= _STATUS_ON

    def _values(self, *volts: float) -> dict[str, float]:
        voltage, current, on = self._monitored(*volts)
        if on and not self._enabled:
            raise self._still_on()
        if self._enabled and not on:
            raise self._went_off()
        return {f"{self.name}_voltage": voltage, f"{self.name}_current": current}

    def _still_on(self) -> DeviceError:
        return DeviceError(
            self.name,
            f"the amplifier reports that it is on although {self._enable}, its enable line, was switched off; check "
            "the wiring, and that no other program uses the line",
        )

    def _went_off(self) -> DeviceError:
        """Bring everything into the safe state, and return what is known of the cause."""
        self._setpoint = 0.0
        if self._enable.is_on:
            cause = (
                f"{self._enable}, its enable line, is on: its own protection has tripped, an interlock is open, or "
                "it has lost its power"
            )
        else:
            cause = (
                f"{self._enable}, its enable line, is off: the watchdog of the instrument has run out, as nobody "
                f"talked to it for {self._enable.watchdog} s, or another program switched the line"
            )
        try:
            self._switch_off()
        except DeviceError as error:
            cause += f"; that it is safe could not be confirmed ({error})"
        return DeviceError(
            self.name,
            f"the amplifier went off by itself, while {cause}; the set-point is 0 V now: remove the cause, then set "
            "it again",
        )
