"""A small laboratory with real physics: a plate, a heater that regulates it, and a thermometer on it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from bench.base import Clock, ConfigurationError, DeviceConnectionError, DeviceError
from bench.devices import (
    DriverSettings,
    Identity,
    Limits,
    PositionSensor,
    Status,
    TECAmplifier,
    TECMode,
    TemperatureSensor,
)
from bench.rig import LaboratorySettings

RIG = """
[rig]
title = "a heated plate"

[devices.tec]
driver = "heater_laboratory:HeaterTEC"
port = "emulated://heater"
temperature_limits = [10.0, 95.0]

[devices.probe]
driver = "heater_laboratory:Thermometer"
port = "emulated://thermometer"

[[interlocks]]
signal = "probe_temperature"
high = 90.0

[telemetry]
period = 0.5

[emulation]
laboratory = "heater_laboratory:HeaterLaboratory"
noise = 0.002
"""

AMBIENT = 22.0
_plates: dict[str, Plate] = {}


class Plate:
    """First order: towards what is regulated, or slowly towards the ambient."""

    def __init__(self, clock: Clock, rng: np.random.Generator, noise: float, time_constant: float) -> None:
        self.clock = clock
        self.rng = rng
        self.noise = noise
        self.time_constant = time_constant
        self.temperature = AMBIENT
        self.target: float | None = None
        self._time = clock.now()

    def now(self) -> float:
        instant = self.clock.now()
        goal, constant = (AMBIENT, 50.0) if self.target is None else (self.target, self.time_constant)
        self.temperature = goal + (self.temperature - goal) * math.exp(-(instant - self._time) / constant)
        self._time = instant
        return self.temperature

    def sensed(self) -> float:
        return self.now() + self.noise * float(self.rng.standard_normal())


class HeaterLaboratory:
    class Settings(LaboratorySettings):
        noise: float = Field(default=0.0, ge=0, le=1, description="noise of one reading, K rms")
        time_constant: float = Field(default=1.0, gt=0, description="of the plate when regulated, s")

    opened = 0

    def __init__(self, settings: Settings, clock: Clock, seed: int) -> None:
        self.plate = Plate(clock, np.random.default_rng(seed), settings.noise, settings.time_constant)

    def open(self) -> Mapping[str, str]:
        _plates["plate"] = self.plate
        type(self).opened += 1
        return {"heater": "plate", "thermometer": "plate", "spot": "plate"}

    def operate(self, task: str, value: float) -> None:
        if task != "turn":
            raise ConfigurationError(f"the heater laboratory cannot carry out {task!r}")
        self.plate.now()
        self.plate.target = value

    def close(self) -> None:
        _plates.pop("plate", None)
        type(self).opened -= 1


class _Settings(DriverSettings):
    port: str = Field(min_length=1, description="address of the instrument")
    witness: str = Field(default="", description="file to which the safe state is written")
    safe_error: str = Field(default="", description="what `safe` raises after it has done its work")
    connect_error: str = Field(default="", description="what `connect` raises")


def _connect(cls, name, settings, clock):
    if settings.connect_error:
        raise DeviceConnectionError(name, settings.connect_error)
    if settings.port not in _plates:
        raise DeviceConnectionError(name, f"nothing answers at {settings.port}")
    return cls(name, settings, clock)


class _Wired:
    """What both instruments share; faults are switched on by plain attributes."""

    closed: list[str]

    def __init__(self, name: str, settings: Any, clock: Clock) -> None:
        super().__init__(name, clock)
        self.settings = settings
        self.plate = _plates[settings.port]
        self.calls: list[str] = []
        self.closed_times = 0
        self.safe_times = 0
        self.measure_error: BaseException | None = None
        self.glance_error: BaseException | None = None
        self.set_error: BaseException | None = None
        self.safe_error: BaseException | None = (
            DeviceError(self.name, settings.safe_error) if settings.safe_error else None
        )
        self.close_error: BaseException | None = None
        self.fail_at = math.inf

    connect = classmethod(_connect)

    def _fault(self, error: BaseException | None) -> None:
        if error is not None:
            raise error
        if self.plate.clock.now() >= self.fail_at:
            raise DeviceError(self.name, "open circuit at the sensor")

    def _was_made_safe(self) -> None:
        self.calls.append("safe")
        self.safe_times += 1
        if self.settings.witness:
            with Path(self.settings.witness).open("a", encoding="utf-8") as file:
                file.write(f"{self.name}\n")
        if self.safe_error is not None:
            raise self.safe_error

    def close(self) -> None:
        self.closed_times += 1
        CLOSED.append(self.name)
        if self.close_error is not None:
            raise self.close_error


CLOSED: list[str] = []


class HeaterTEC(_Wired, TECAmplifier):
    class Settings(_Settings):
        temperature_limits: tuple[float, float] = Field(description="allowed set-points, °C")

    def __init__(self, name: str, settings: Settings, clock: Clock) -> None:
        super().__init__(name, settings, clock)
        self._setpoint = math.nan
        self.sent: list[float] = []

    @property
    def identity(self) -> Identity:
        return Identity("Test", "Heater", "1", "1.0")

    @property
    def mode(self) -> TECMode:
        return TECMode.TEMPERATURE

    def select_mode(self, _mode: TECMode) -> None:
        raise DeviceError(self.name, "knows temperature mode only")

    @property
    def output_enabled(self) -> bool:
        return self.plate.target is not None

    @property
    def limits(self) -> Limits:
        return Limits(*self.settings.temperature_limits, "°C")

    @property
    def setpoint(self) -> float:
        return self._setpoint

    def set(self, value: float) -> Status:
        self.check(value)
        self.plate.now()
        if self.set_error is not None:
            raise self.set_error
        self.plate.target = self._setpoint = value
        self.sent.append(value)
        self.calls.append("set")
        return Status(self.name, self._clock, lambda: abs(self.plate.now() - value) < 0.1)

    def _read(self) -> dict[str, float]:
        temperature = self.plate.sensed()
        drive = 0.0 if self.plate.target is None else 0.05 * (self.plate.target - AMBIENT)
        return {
            f"{self.name}_temperature": temperature,
            f"{self.name}_sink_temperature": AMBIENT,
            f"{self.name}_current": drive,
            f"{self.name}_voltage": 3.0 * drive,
        }

    def measure(self) -> dict[str, float]:
        self._fault(self.measure_error)
        return self._read()

    def glance(self) -> dict[str, float]:
        self._fault(self.glance_error)
        return self._read()

    def safe(self) -> None:
        self.plate.now()
        self.plate.target = None
        self._was_made_safe()


class Thermometer(_Wired, TemperatureSensor):
    class Settings(_Settings):
        offset: float = Field(default=0.0, description="added to the reading, K")

    @property
    def identity(self) -> Identity:
        return Identity("Test", "Thermometer", "2", "1.0")

    def measure(self) -> dict[str, float]:
        self._fault(self.measure_error)
        return {f"{self.name}_temperature": self.plate.sensed() + self.settings.offset}

    def glance(self) -> dict[str, float]:
        self._fault(self.glance_error)
        return {f"{self.name}_temperature": self.plate.sensed() + self.settings.offset}

    def safe(self) -> None:
        self._was_made_safe()


class Spot(_Wired, PositionSensor):
    """Sees the plate bend by 1 µm/K."""

    class Settings(_Settings):
        pass

    @property
    def identity(self) -> Identity:
        return Identity("Test", "Spot", "3", "1.0")

    def measure(self) -> dict[str, float]:
        self._fault(self.measure_error)
        return {f"{self.name}_position": 1e-6 * (self.plate.sensed() - AMBIENT)}

    def safe(self) -> None:
        self._was_made_safe()


class NoDriver:
    """Has Settings, and plays no role."""

    Settings = _Settings
    connect = classmethod(_connect)


class NoSettings:
    """Plays no role and has no Settings."""
