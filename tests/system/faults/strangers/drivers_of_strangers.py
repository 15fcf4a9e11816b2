"""Drivers as their users write them on the libraries of others: no request is repeated, and no answer doubted."""

import math
from typing import ClassVar

import can
import minimalmodbus
import serial

from bench.base import DeviceConnectionError, DeviceError
from bench.devices import DriverSettings, Identity, Limits, LoadCell, Status, VoltageSupply
from drivers.device import LineActuator, LineDevice

GROSS, SET_TARE, COMMAND = 0x2000, 8, 0x2061
"""Registers of the load cell."""
GO, APPLIED, AMPS, VOLTS = 0x2000, 0x2102, 0x2100, 0x210D
"""Objects of the supply; the second volts are those of its battery, in 0.1 V."""


class Settings(DriverSettings):
    port: str


class CellLine:
    def __init__(self, settings):
        self._serial = serial.serial_for_url(settings.port, 38_400, timeout=0.1)
        self._instrument = minimalmodbus.Instrument(self._serial, 1)

    def ask(self, device, method, *arguments):
        try:
            return getattr(self._instrument, method)(*arguments)
        except minimalmodbus.NoResponseError as error:
            raise DeviceConnectionError(device, str(error)) from None

    def close(self):
        self._serial.close()


class MinimalModbusCell(LineDevice, LoadCell):
    """The load cell by minimalmodbus."""

    Settings: ClassVar = Settings

    @classmethod
    def _open_line(cls, name, settings, clock):  # noqa: ARG003
        return CellLine(settings)

    def _identify(self):
        self.glance()
        return Identity("Flintec", "DAD 141", "", "")

    def _start(self):
        pass

    def measure(self):
        return {self.signals[0].name: self._line.ask(self.name, "read_float", GROSS)}

    glance = measure

    def tare(self):
        self._line.ask(self.name, "write_register", COMMAND, SET_TARE, 0, 6)

    def clear_tare(self):
        raise NotImplementedError

    def safe(self):
        pass


class CanLine:
    def __init__(self, settings):
        self._bus = can.Bus(
            interface="slcan", channel=settings.port, bitrate=125_000, sleep_after_open=0, timeout=0.1
        )

    def request(self, device, data):
        self._bus.send(can.Message(arbitration_id=0x601, data=data.ljust(8, b"\0"), is_extended_id=False))
        for _ in range(20):
            message = self._bus.recv(0)
            if message is not None and message.arbitration_id == 0x581:
                return bytes(message.data)
        raise DeviceConnectionError(device, "no answer")

    def close(self):
        self._bus.shutdown()


class PythonCanSupply(LineActuator, VoltageSupply):
    """The supply by python-can's slcan."""

    Settings: ClassVar = Settings
    output = "average"
    limits = Limits(0.0, 3.2, "V")

    @classmethod
    def _open_line(cls, name, settings, clock):  # noqa: ARG003
        return CanLine(settings)

    def _read(self, index, subindex=1):
        answer = self._line.request(self.name, bytes((0x40, index & 0xFF, index >> 8, subindex)))
        return int.from_bytes(answer[4:6], "little", signed=True)

    def _write(self, index, value):
        order = bytes((0x23, index & 0xFF, index >> 8, 1)) + value.to_bytes(4, "little", signed=True)
        if self._line.request(self.name, order)[0] != 0x60:
            raise DeviceError(self.name, "refuses an order")

    def _identify(self):
        self._read(VOLTS, 2)
        return Identity("Roboteq", "SDC2160", "", "")

    def _start(self):
        self._write(GO, 0)

    def set(self, value):
        self.check(value)
        self._write(GO, round(1000 * value / (self._read(VOLTS, 2) / 10)))
        self._setpoint = value
        return Status.completed(self.name, self._clock)

    def measure(self):
        if not math.isnan(self.setpoint):
            self.set(self.setpoint)
        voltage, current = (signal.name for signal in self.signals)
        return {voltage: self._read(APPLIED) / 1000 * self._read(VOLTS, 2) / 10, current: self._read(AMPS) / 10}

    glance = measure

    def _make_safe(self):
        self._write(GO, 0)
        self._setpoint = math.nan
