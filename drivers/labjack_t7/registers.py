"""The registers of a LabJack T7, and a client that reads and writes them over Modbus TCP.

Sources: `ljm_constants.json` (repository labjack/ljm_constants) for the register map; LabJack, Direct Modbus TCP,
Protocol Details, for the byte order.

Assumptions: error details 2371, 2372 and 2374 belong to the names that stand between the known 2370, 2373 and
2375 in the error table; the instrument reads back the settings that were written.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from typing import NamedTuple

from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.pdu import ModbusPDU

from bench.devices import Identity
from bench.errors import DeviceConnectionError, DeviceError
from drivers.modbus import exception_text, pack, swapped, unpack


class Register(NamedTuple):
    """A register, or the first of several alike."""

    name: str
    """Name in the map, with # for the number of a channel."""
    address: int
    """Modbus address."""
    form: str
    """Type of its value by its letter in `struct`: f FLOAT32, I UINT32, H UINT16."""

    def of(self, channel: int) -> Register:
        """Return the register of a channel."""
        words = struct.calcsize(f">{self.form}") // 2
        return Register(self.name.replace("#", str(channel)), self.address + words * channel, self.form)


AIN = Register("AIN#", 0, "f")
DAC = Register("DAC#", 1000, "f")
DIO = Register("DIO#", 2000, "H")
DIO_STATE = Register("DIO_STATE", 2800, "I")
DIO_DIRECTION = Register("DIO_DIRECTION", 2850, "I")
STREAM_SETTLING_US = Register("STREAM_SETTLING_US", 4008, "f")
STREAM_RESOLUTION_INDEX = Register("STREAM_RESOLUTION_INDEX", 4010, "I")
AIN_EF_READ_AVERAGE = Register("AIN#_EF_READ_A", 7000, "f")
AIN_EF_READ_MAXIMUM = Register("AIN#_EF_READ_B", 7300, "f")
AIN_EF_READ_MINIMUM = Register("AIN#_EF_READ_C", 7600, "f")
AIN_EF_INDEX = Register("AIN#_EF_INDEX", 9000, "I")
AIN_EF_SAMPLES = Register("AIN#_EF_CONFIG_A", 9300, "I")
AIN_EF_SCAN_RATE = Register("AIN#_EF_CONFIG_D", 10200, "f")
TDAC = Register("TDAC#", 30000, "f")
AIN_RANGE = Register("AIN#_RANGE", 40000, "f")
AIN_NEGATIVE_CH = Register("AIN#_NEGATIVE_CH", 41000, "H")
AIN_RESOLUTION_INDEX = Register("AIN#_RESOLUTION_INDEX", 41500, "H")
AIN_SETTLING_US = Register("AIN#_SETTLING_US", 42000, "f")
LAST_ERR_DETAIL = Register("LAST_ERR_DETAIL", 55000, "H")
TEST = Register("TEST", 55100, "I")
TEST_FLOAT32 = Register("TEST_FLOAT32", 55124, "f")
PRODUCT_ID = Register("PRODUCT_ID", 60000, "f")
FIRMWARE_VERSION = Register("FIRMWARE_VERSION", 60004, "f")
SERIAL_NUMBER = Register("SERIAL_NUMBER", 60028, "I")
WATCHDOG_ENABLE = Register("WATCHDOG_ENABLE_DEFAULT", 61600, "I")
WATCHDOG_TIMEOUT_S = Register("WATCHDOG_TIMEOUT_S_DEFAULT", 61604, "I")
WATCHDOG_STRICT_ENABLE = Register("WATCHDOG_STRICT_ENABLE_DEFAULT", 61610, "I")
WATCHDOG_DIO_ENABLE = Register("WATCHDOG_DIO_ENABLE_DEFAULT", 61630, "I")
WATCHDOG_DIO_STATE = Register("WATCHDOG_DIO_STATE_DEFAULT", 61632, "I")
WATCHDOG_DIO_DIRECTION = Register("WATCHDOG_DIO_DIRECTION_DEFAULT", 61634, "I")
WATCHDOG_DIO_INHIBIT = Register("WATCHDOG_DIO_INHIBIT_DEFAULT", 61636, "I")
WATCHDOG_DAC_ENABLE = (
    Register("WATCHDOG_DAC0_ENABLE_DEFAULT", 61640, "I"),
    Register("WATCHDOG_DAC1_ENABLE_DEFAULT", 61650, "I"),
)

_UNIT = 1  # LabJack takes any
_TEST_WORDS = [0x0011, 0x2233]
_TEST_FLOAT = -9999.0
_PRODUCT = 7.0
_PRODUCTS = {4.0: "a LabJack T4", 8.0: "a LabJack T8", 200.0: "a LabJack Digit"}
_DETAILS = {
    2370: "AIN range not available",
    2371: "AIN settling time too long",
    2372: "AIN is set to binary",
    2373: "AIN negative channel not allowed",
    2374: "only zero may be written",
    2375: "AIN resolution index not allowed",
}


class LabJackT7:
    """The connection to a LabJack T7 over Modbus TCP.

    Methods raise `DeviceError` if the instrument refuses, and `DeviceConnectionError` if it does not answer; the
    connection is closed then.

    Parameters
    ----------
    port : str
        Address as `tcp://HOST:PORT`.
    timeout : float
        Longest wait for a connection or a reply in s.

    Raises
    ------
    DeviceConnectionError
        If no connection can be made.
    """

    def __init__(self, name: str, port: str, timeout: float) -> None:
        self._name = name
        self._address = port
        host, _, number = port.removeprefix("tcp://").rpartition(":")
        # TCP repeats lost packets by itself: repeating a request would only delay the report of a dead device.
        self._client = ModbusTcpClient(host.strip("[]"), port=int(number), timeout=timeout, retries=0)
        self._timeout = timeout
        self._connected: bool = self._client.connect()  # type: ignore[no-untyped-call]
        if not self._connected:
            self.close()
            raise DeviceConnectionError(
                name, f"cannot connect to {port}; check the address, the cable and that the instrument has power"
            )

    def close(self) -> None:
        """Release the connection."""
        self._connected = False
        self._client.close()  # type: ignore[no-untyped-call]

    def read_words(self, address: int, count: int) -> list[int]:
        """Get `count` 16-bit registers from `address` on, each 0 to 65535."""
        response = self._exchange(
            lambda: self._client.read_holding_registers(address, count=count, device_id=_UNIT),
            f"reading register {address}",
        )
        if len(response.registers) != count:
            raise DeviceError(self._name, f"sent {len(response.registers)} registers where {count} were asked for")
        return list(response.registers)

    def read(self, register: Register, count: int = 1) -> list[float]:
        """Get the values of `count` registers of one type from `register` on."""
        form = f"{count}{register.form}"
        return list(unpack(form, self.read_words(register.address, struct.calcsize(f">{form}") // 2)))

    def read_integer(self, register: Register) -> int:
        """Get the value of a UINT32 or UINT16 register."""
        return int(self.read(register)[0])

    def write(self, register: Register, *values: float) -> None:
        """Set registers of one type from `register` on, in one request."""
        words = pack(f"{len(values)}{register.form}", *values)
        self._exchange(
            lambda: self._client.write_registers(register.address, words, device_id=_UNIT),
            f"writing register {register.address}",
        )

    def set(self, values: Mapping[Register, float]) -> None:
        """Set neighbouring registers of one type in one request, and read them back.

        Raises `DeviceError` if a register reads back another value.
        """
        first = next(iter(values))
        self.write(first, *values.values())
        for (register, value), actual in zip(values.items(), self.read(first, len(values)), strict=True):
            tolerance = 1e-5 if register.form == "f" else 0.0
            if not math.isclose(actual, value, rel_tol=tolerance, abs_tol=0.1 * tolerance):
                raise DeviceError(
                    self._name,
                    f"{register.name} reads back {actual:g} after {value:g} was written; is another program using "
                    "the instrument?",
                )

    def identify(self) -> Identity:
        """Check the byte order and the product, and get the identity.

        Raises `DeviceConnectionError` if another device answers, or words or bytes arrive in another order than
        LabJack's.
        """
        try:
            words = self.read_words(TEST.address, 2)
        except DeviceConnectionError:
            raise
        except DeviceError as error:
            reason = str(error).removeprefix(f"{self._name}: ")
            raise self._wrong(f"is not a LabJack T-series: register TEST gave {reason}") from error
        if words != _TEST_WORDS:
            raise self._wrong(
                swapped(words, lambda order: list(order) == _TEST_WORDS)
                or f"is not a LabJack T-series: register TEST is 0x{words[0]:04X}{words[1]:04X}, not 0x00112233"
            )
        (value,) = self.read(TEST_FLOAT32)
        if value != _TEST_FLOAT:
            raise self._wrong(f"sends FLOAT32 in another form: TEST_FLOAT32 is {value:g}, not -9999")
        (product,) = self.read(PRODUCT_ID)
        if product != _PRODUCT:
            known = _PRODUCTS.get(product, "another product")
            raise self._wrong(f"is {known}, not a T7: PRODUCT_ID is {product:g}, not 7")
        (firmware,) = self.read(FIRMWARE_VERSION)
        return Identity("LabJack", "T7", str(self.read_integer(SERIAL_NUMBER)), f"{firmware:.4f}")

    def _exchange(self, request: Callable[[], ModbusPDU], doing: str) -> ModbusPDU:
        if not self._connected:
            raise DeviceConnectionError(
                self._name,
                f"the connection to {self._address} is closed; connect again, so that the instrument is set up again",
            )
        response = self._answer(request)
        if not response.isError():
            return response
        message = exception_text(response.exception_code, doing)
        cause = self._answer(
            lambda: self._client.read_holding_registers(LAST_ERR_DETAIL.address, count=1, device_id=_UNIT)
        )
        if not cause.isError() and cause.registers and (detail := cause.registers[0]):
            message += f"; LAST_ERR_DETAIL {detail} ({_DETAILS.get(detail, 'see the LabJack error codes')})"
        raise DeviceError(self._name, message)

    def _answer(self, request: Callable[[], ModbusPDU]) -> ModbusPDU:
        try:
            return request()
        except (ModbusException, OSError) as error:
            # A late reply must not be taken for that to the next request, and an instrument that restarted has
            # lost its settings: the connection ends here.
            self.close()
            raise DeviceConnectionError(
                self._name,
                f"no reply from {self._address} within {self._timeout:g} s, or the connection broke; "
                f"check cable and power, then connect again ({error})",
            ) from error

    def _wrong(self, what: str) -> DeviceConnectionError:
        return DeviceConnectionError(self._name, f"the device at {self._address} {what}")
