"""An emulated laboratory of text instruments, made from their tables in the rig file and a few lines of physics.

    [emulation]
    laboratory = "scpi"

    [emulation.signals.supply_voltage]                  # by the name of the signal on the rig
    time_constant = 0.05                                # s
    noise = 1e-3

    [emulation.signals.meter_temperature]
    expression = "ambient + supply_voltage**2 / resistance * thermal_resistance"
    constants = { ambient = "22 °C", resistance = "10 ohm", thermal_resistance = "4 K/W" }
    time_constant = 20.0
    initial = 22.0

A device whose driver has no messages in the rig file, such as one of PyMeasure, is emulated by a table of its own,
with the keys of a text instrument and the signals of the device::

    [emulation.instruments.smu]
    identity = "KEITHLEY INSTRUMENTS INC.,MODEL 2400,{any}"
    signals.current = { query = "READ?", unit = "A" }

An expression may name every signal, and `NAME_output`, which is what the output of an instrument delivers: its
set-point when it is on, 0 when it is off. A signal without an expression follows the output of its instrument, if it
has the same unit.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Discriminator, Field, InstanceOf, Tag, ValidationInfo, field_validator

from bench.base import Clock
from bench.devices import ActuatorTable, CommandTable, DriverSettings
from bench.rig import EMULATED, JOIN, Expression, LaboratorySettings
from sim_devices.instruments.scpi import EmulatedTextInstrument, Meter
from sim_devices.laboratory import EmulatedLaboratory, TrueValue
from sim_devices.plants.lag_network import Lag, LagNetwork
from sim_devices.wire.text import TextServer
from sim_devices.world import World


class PhysicsTable(LaboratorySettings):
    """How one signal comes about, and how its instrument sees it: `[emulation.signals.NAME]`."""

    expression: str = Field(
        default="", description="what it follows: arithmetic over signals, NAME_output and constants"
    )
    constants: dict[str, str | float] = Field(
        default_factory=dict, description='numbers of the expression by name, with units as in "10 ohm"'
    )
    time_constant: float = Field(default=0.0, ge=0, le=1e6, description="lag of first order with which it follows, s")
    initial: float | None = Field(
        default=None, description="value at the beginning, in the unit of the signal; at rest if not given"
    )
    noise: float = Field(default=0.0, ge=0, description="noise of one reading, rms, in the unit of the signal")
    resolution: float = Field(default=0.0, ge=0, description="last digit of a reading, in the unit of the signal")


def _kind(table: object) -> str:
    return "actuator" if isinstance(table, Mapping) and "setpoint" in table else "sensor"


InstrumentTable = Annotated[
    Annotated[ActuatorTable, Tag("actuator")] | Annotated[CommandTable, Tag("sensor")], Discriminator(_kind)
]


class SCPILaboratorySettings(LaboratorySettings):
    """What `[emulation]` says of a laboratory of text instruments."""

    instruments: dict[str, InstrumentTable] = Field(
        default_factory=dict, description="messages of the devices whose drivers have none in the rig file"
    )
    devices: dict[str, InstanceOf[DriverSettings]] = Field(
        default_factory=dict, description="the devices of the rig file, which the bench fills in"
    )
    signals: dict[str, PhysicsTable] = Field(
        default_factory=dict, validate_default=True, description="physics by signal of the rig"
    )

    @field_validator("devices")
    @classmethod
    def _have_ports_of_their_own(
        cls, devices: dict[str, DriverSettings], info: ValidationInfo
    ) -> dict[str, DriverSettings]:
        found = tables(devices, info.data.get("instruments", {}))
        for name, (port, _) in found.items():
            others = [other for other, (same, _) in found.items() if same == port and other != name]
            if others:
                raise ValueError(
                    f"{name} and {others[0]} have the same port {EMULATED}{port}; each needs its own, or all of a "
                    f"line one that joins the names of its devices, such as {EMULATED}{name}{JOIN}{others[0]}"
                )
        return devices

    @field_validator("signals")
    @classmethod
    def _come_about(cls, signals: dict[str, PhysicsTable], info: ValidationInfo) -> dict[str, PhysicsTable]:
        devices, instruments = info.data.get("devices"), info.data.get("instruments")
        if devices is not None and instruments is not None:
            network(tables(devices, instruments), signals)
        return signals


def tables(
    devices: Mapping[str, DriverSettings], instruments: Mapping[str, CommandTable]
) -> dict[str, tuple[str, CommandTable]]:
    """Return the name of the emulated port and the table of each text instrument, by device.

    Raises ValueError if a table of `instruments` belongs to no device.
    """
    found: dict[str, tuple[str, CommandTable]] = {}
    for name, settings in devices.items():
        table = settings if isinstance(settings, CommandTable) else instruments.get(name)
        port = getattr(settings, "port", "")
        if table is not None and port.startswith(EMULATED):
            instrument = port.removeprefix(EMULATED)
            # On a shared line each instrument has the name of its device.
            found[name] = (name if name in instrument.split(JOIN) else instrument, table)
    for name in instruments.keys() - found.keys():
        raise ValueError(f"{name}: there is no such device on a port {EMULATED}NAME; {_listed(devices)}")
    return found


def network(instruments: Mapping[str, tuple[str, CommandTable]], physics: Mapping[str, PhysicsTable]) -> LagNetwork:
    """Return the plant behind instruments.

    Raises
    ------
    ValueError
        If a signal is unknown, or cannot come about as it is said; names it.
    """
    units: dict[str, str] = {}
    followed: dict[str, str] = {}
    for device, (_, table) in instruments.items():
        output = f"{device}_output"
        if isinstance(table, ActuatorTable):
            units[output] = table.setpoint.unit
        for name, signal in table.signals.items():
            units[f"{device}_{name}"] = signal.unit
            followed[f"{device}_{name}"] = output if units.get(output) == signal.unit else ""
    for name in physics:
        if name not in followed:
            raise ValueError(f"{name}: there is no such signal of an emulated text instrument; {_listed(followed)}")
    lags = {}
    for name, source in followed.items():
        described = physics.get(name, PhysicsTable())
        expression = described.expression or source
        if not expression:
            raise ValueError(f"{name}: needs an expression over {', '.join(each for each in units if each != name)}")
        try:
            parsed = Expression(expression=expression, unit=units[name], constants=described.constants)
            unknown = [each for each in parsed.sources if each not in units]
            if unknown:
                raise ValueError(f"expression = {expression!r}: there is no {unknown[0]}; {_listed(units)}")
            derived = parsed.bind(name, {each: units[each] for each in parsed.sources})
        except ValueError as error:
            raise ValueError(f"{name}: {_first_line(error)}") from None
        lags[name] = Lag(derived.sources, derived.compute, described.time_constant, described.initial)
    return LagNetwork({name: 0.0 for name in units if name not in followed}, lags)


def _listed(names: Iterable[str]) -> str:
    return f"there are: {', '.join(names) or 'none'}"


def _first_line(error: ValueError) -> str:
    errors = getattr(error, "errors", None)
    return errors()[0]["msg"].removeprefix("Value error, ") if callable(errors) else str(error)


class SCPILaboratory(EmulatedLaboratory):
    """Text instruments around a plant of lags; see the module."""

    Settings: ClassVar[type[LaboratorySettings]] = SCPILaboratorySettings

    def __init__(self, settings: SCPILaboratorySettings, clock: Clock, seed: int) -> None:
        found = tables(settings.devices, settings.instruments)
        self.plant = network(found, settings.signals)
        world = World(self.plant, clock)
        generators = np.random.default_rng(seed).spawn(len(found))
        instruments: dict[str, EmulatedTextInstrument] = {}
        for (device, (port, table)), rng in zip(found.items(), generators, strict=True):
            meters = {}
            for name in table.signals:
                physics = settings.signals.get(f"{device}_{name}", PhysicsTable())
                read = partial(self.plant.value, f"{device}_{name}")
                meters[name] = Meter(read, physics.noise, physics.resolution)
            drive = partial(self.plant.set, f"{device}_output") if isinstance(table, ActuatorTable) else None
            instruments[port] = EmulatedTextInstrument(device, world, table, meters, rng, drive)
        servers = {port: TextServer(instrument) for port, instrument in instruments.items()}
        super().__init__(
            "laboratory of text instruments", servers, clock, world=world, instruments=instruments, seed=seed
        )
        self._units: dict[str, str] = {}
        for device, (_, table) in found.items():
            self._units |= {f"{device}_{name}": signal.unit for name, signal in table.signals.items()}
            if isinstance(table, ActuatorTable):
                self._units[f"{device}_output"] = table.setpoint.unit

    def truth(self) -> dict[str, TrueValue]:
        """Return the quantities behind the signals, and what the outputs deliver, by name."""
        return {
            name: TrueValue(self.plant.value(name), unit, is_output=name.endswith("_output"))
            for name, unit in self._units.items()
        }
