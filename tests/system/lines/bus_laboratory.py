"""Pairs of instruments with addresses, which share lines; no two of them read the same."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from bench.base import Clock
from bench.rig import LaboratorySettings
from sim_devices.instruments.dynamixel import EmulatedMX28
from sim_devices.instruments.flintec_dad141 import EmulatedDAD141
from sim_devices.instruments.meerstetter_tec import EmulatedTEC
from sim_devices.instruments.roboteq import EmulatedRoboteq
from sim_devices.laboratory import EmulatedLaboratory, TrueValue
from sim_devices.wire import WireServer
from sim_devices.wire.canopen_slcan import CanopenSlcanServer
from sim_devices.wire.dynamixel2 import Dynamixel2Server
from sim_devices.wire.mecom import MeComServer
from sim_devices.wire.modbus import ILLEGAL_ADDRESS, RegisterError
from sim_devices.wire.modbus_rtu import ModbusRtuServer
from sim_devices.world import World

VALUES: Mapping[str, float] = {
    "load1": 10.0,
    "load2": -20.0,
    "heater1": 21.5,
    "heater2": 31.5,
    "tec1": 25.0,
    "tec2": 35.0,
    "servo1": math.pi,
    "servo2": math.pi + 0.5,
    "servo3": math.pi - 0.5,
    "supply1": 0.0,
    "supply2": 0.0,
}
"""What each instrument reads at rest: a force in N, a temperature in °C, an angle in rad, or a voltage in V."""


class Peltier:
    """A Peltier element whose current follows at once, and whose temperature follows the current."""

    sink_temperature = 22.0
    current = 0.0

    def __init__(self, rest: float) -> None:
        self.rest = rest

    @property
    def voltage(self) -> float:
        return 2.0 * self.current

    @property
    def plate_temperature(self) -> float:
        return self.rest + 10.0 * self.current

    def terminals(self) -> tuple[float, float, float, float]:
        return self.plate_temperature, self.sink_temperature, self.current, self.voltage

    def drive(self, current_ampere: float) -> None:
        self.current = current_ampere

    def release(self) -> None:
        self.current = 0.0


class Rest:
    """A plant that does nothing by itself."""

    def advance(self, dt: float) -> None:
        pass


class Resistor(Rest):
    """What a supply heats."""

    world: World
    voltage = 0.0

    def apply(self, voltage: float) -> None:
        self.voltage = voltage

    @property
    def current(self) -> float:
        return self.voltage / 5.0


class Heater:
    """The registers of a heater with a thermometer, one word each."""

    def __init__(self, serial: int, temperature: float) -> None:
        self.words = {0x00: 1410, 0x01: 0, 0x02: serial, 0x10: round(10 * temperature)}
        self.power_cycle()

    def power_cycle(self) -> None:
        self.words |= {0x20: 0, 0x21: 0, 0x30: 1}

    @property
    def output(self) -> float:
        return 0.1 * self.words[0x20] if self.words[0x21] else 0.0

    def read_registers(self, address: int, count: int) -> list[int]:
        self.words[0x12], self.words[0x13] = struct.unpack(">2H", struct.pack(">f", self.output))
        try:
            return [self.words[address + each] for each in range(count)]
        except KeyError:
            raise RegisterError(ILLEGAL_ADDRESS, "no such register") from None

    def write_registers(self, address: int, values: list[int]) -> None:
        self.words[address] = values[0]


class BusLaboratory(EmulatedLaboratory):
    """The instruments of `VALUES`; the address of each is the number in its name."""

    Settings: ClassVar[type[LaboratorySettings]] = LaboratorySettings

    def __init__(self, settings: LaboratorySettings, clock: Clock, seed: int) -> None:  # noqa: ARG002
        self.time = World(Rest(), clock)
        self.random = np.random.default_rng(seed)
        self.loads: dict[str, Peltier] = {}
        self.forces = {name: value for name, value in VALUES.items() if name.startswith("load")}
        made = {name: self.made(name, int(name[-1])) for name in VALUES}
        super().__init__(
            "laboratory of lines",
            {name: server for name, (_, server) in made.items()},
            clock,
            world=self.time,
            instruments={name: instrument for name, (instrument, _) in made.items()},
            seed=seed,
        )

    def made(self, name: str, serial: int) -> tuple[Any, WireServer]:
        """Return an instrument of a name and what serves it, with a serial number if it has one."""
        world, number, value, rng = self.time, int(name[-1]), VALUES[name], self.random.spawn(1)[0]
        match name[:-1]:
            case "load":
                cell = EmulatedDAD141(
                    name, world, lambda: self.forces[name], rng=rng, zero_tracking=0, serial_number=serial
                )
                return cell, ModbusRtuServer(cell, number)
            case "heater":
                heater = Heater(serial, value)
                return heater, ModbusRtuServer(heater, number)
            case "tec":
                self.loads[name] = Peltier(value)
                tec = EmulatedTEC(name, world, self.loads[name], serial_number=serial, rng=rng)
                tec.write_parameter(2051, number)
                return tec, MeComServer(tec)
            case "supply":
                limits = (0.0, 12.0)
                supply = EmulatedRoboteq(
                    name, world, Resistor(), voltage_limits=limits, watchdog=5.0, node=number, rng=rng
                )
                return supply, CanopenSlcanServer(supply)
            case _:
                servo = EmulatedMX28(name, world, bus_id=number, position=value, rng=rng)
                return servo, Dynamixel2Server([servo])

    def operate(self, task: str, value: float) -> None:
        """Load a cell by hand, N."""
        self.forces[task] = value

    def value(self, name: str) -> float:
        """Return what an instrument reads at rest."""
        return VALUES[name]

    def output(self, name: str) -> float:
        """Return what an actuator delivers, such as the current of a TEC or the torque of a servo; 0 if it is off."""
        instrument: Any = self.instruments[name]
        self.time.advance()
        match name[:-1]:
            case "tec":
                return self.loads[name].current
            case "servo":
                return float(instrument.read_item(64))
            case "supply":
                return float(instrument.voltage)
            case _:
                return float(instrument.output)

    def truth(self) -> dict[str, TrueValue]:
        """Return what the actuators deliver."""
        return {f"{name}_output": TrueValue(self.output(name)) for name in VALUES if name[:-1] != "load"}
