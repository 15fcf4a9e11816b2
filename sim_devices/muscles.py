"""Emulated laboratories for artificial muscles: one muscle at a time in a test frame, and the instruments around it.

The muscle hangs from a load cell. Its lower end, where the magnet of a position sensor sits, either carries
weights or is fastened to the drum of a servo; the operator changes between the two. A PWM supply drives the
muscle, a fan blows at it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from contextlib import ExitStack
from typing import Literal, Protocol

import numpy as np
from pydantic import Field

from bench.clock import Clock
from bench.errors import ConfigurationError
from bench.rig_file import LaboratorySettings
from sim_devices import protocol_emulated
from sim_devices.instruments.dynamixel import EmulatedMX28
from sim_devices.instruments.dynamixel_drum import EmulatedDrum
from sim_devices.instruments.dynamixel_table import COUNT, HardwareError
from sim_devices.instruments.flintec_dad141 import EmulatedDAD141
from sim_devices.instruments.labjack_t7 import EmulatedT7
from sim_devices.instruments.roboteq import EmulatedRoboteq
from sim_devices.plants.coiled_polymer import CoiledPolymerMuscle, CoiledPolymerParameters
from sim_devices.plants.mckibben import McKibbenMuscle, McKibbenParameters
from sim_devices.plants.sma import SMAParameters, SMAWire
from sim_devices.transducers.magnet import RatiometricSensor
from sim_devices.wire import WireServer
from sim_devices.wire.canopen_slcan import CanopenSlcanServer
from sim_devices.wire.dynamixel2 import Dynamixel2Server
from sim_devices.wire.modbus_rtu import ModbusRtuServer
from sim_devices.wire.modbus_tcp import ModbusTcpServer
from sim_devices.world import World

LOAD, STAGE = "load", "stage"
"""What an operator does in these laboratories: hang a load of so many N on the muscle, or fasten it to the stage."""

FAN_LINE = 0
"""Digital line of the T7 that switches the fan: FIO0, on when high."""

_HEARTBEAT_TIME = 0x1017
"""Object of the supply with the period of its heartbeat, ms; 0 for none."""
_BROKEN_CELL = -1e3
"""What a load cell with a broken wire shows, N."""

FaultName = Literal[
    "none",
    "silent-supply",
    "missing-heartbeat",
    "servo-overload",
    "broken-load-cell",
    "forgotten-load",
    "heavy-load",
    "unplugged-sensor",
]


class Muscle(Protocol):
    """What the frame and its instruments ask of a muscle."""

    def advance(self, dt: float) -> None:
        """Integrate over `dt` seconds."""

    def apply(self, voltage: float) -> None:
        """Apply a voltage, V."""

    def blow(self, on: bool) -> None:
        """Switch the fan."""

    def hang(self, load_newton: float) -> None:
        """Hang a dead load on the end."""

    def clamp(self, length_metre: float) -> None:
        """Hold the end at a position, m from rest."""

    @property
    def current(self) -> float:
        """Current, A."""

    @property
    def force(self) -> float:
        """Tension, N."""

    @property
    def position(self) -> float:
        """Position of the end, m from rest."""


class MuscleLaboratorySettings(LaboratorySettings):
    """What a rig file may say of these laboratories."""

    battery_voltage: float = Field(default=10.0, gt=0, le=60, description="voltage behind the PWM supply, V")
    supply_watchdog: float = Field(default=5.0, ge=0, le=65, description="as set in the supply by ^RWD, s")
    drum_radius: float = Field(default=4.5e-3, gt=0, le=0.1, description="radius of the servo's drum, m")
    drum_zero_counts: int = Field(
        default=2200, ge=0, le=4095, description="counts of the servo where the muscle is at rest"
    )
    rest_position: float = Field(
        default=17.5e-3, gt=0, le=35e-3, description="where along its stroke the sensor sees the muscle at rest, m"
    )
    force_noise: float = Field(default=0.04, ge=0, le=1, description="noise of the load cell, unfiltered, N rms")
    fault: FaultName = Field(
        default="none",
        description="what goes wrong at `fault_time`; forgotten-load (the operator hangs nothing) and heavy-load "
        "(twice the weight) from then on",
    )
    fault_time: float = Field(default=0.0, ge=0, description="when it goes wrong, s of laboratory time")


class Frame:
    """The muscle with what its lower end is fastened to: a `sim_devices.world.Plant`.

    Parameters
    ----------
    muscle : Muscle
        What is tested; it begins without a load.

    Attributes
    ----------
    drum : EmulatedDrum or None
        The stage's drum, once it is there.
    t7 : EmulatedT7 or None
        The instrument that switches the fan, once it is there.
    """

    def __init__(self, muscle: Muscle) -> None:
        self.muscle = muscle
        self.drum: EmulatedDrum | None = None
        self.t7: EmulatedT7 | None = None
        self._fastened = False

    def hang(self, newton: float) -> None:
        """Take the end off the stage, if it is there, and hang a load on it."""
        self._fastened = False
        self.muscle.hang(newton)

    def fasten(self) -> None:
        """Take the load off and fasten the end to the stage, so that both stand at the same number of metres."""
        self._fastened = True

    def advance(self, dt: float) -> None:
        """Integrate over `dt` seconds, with the end following the stage."""
        if self.t7 is not None:
            self.muscle.blow(self.t7.dio_level(FAN_LINE))
        if self._fastened and self.drum is not None:
            # A servo on its way is due every 20 ms, so that the world advances in pieces as short as that.
            self.muscle.clamp(self.drum.position_after(dt))
        self.muscle.advance(dt)


class MuscleLaboratory(ABC):
    """A `bench.rig.Laboratory` with the instruments `supply`, `load_cell`, `stage` (serial lines) and `t7` (TCP).

    Parameters
    ----------
    settings : MuscleLaboratorySettings
        From the rig file.
    clock : Clock
        The clock of the run.
    seed : int
        Seed of the room and of the noise; the specimen has its own.
    """

    Settings: type[MuscleLaboratorySettings] = MuscleLaboratorySettings

    def __init__(self, settings: MuscleLaboratorySettings, clock: Clock, seed: int) -> None:
        # One stream a source of noise: how often one instrument is asked must not change what another says.
        plant, supply, cell, sensor, t7 = np.random.default_rng(seed).spawn(5)
        self._settings = settings
        self._clock = clock
        self.muscle = self.make_muscle(settings, plant)
        self.frame = Frame(self.muscle)
        self.world = World(self.frame, clock)
        self._cell_is_broken = False
        self.supply = EmulatedRoboteq(
            "supply",
            self.world,
            self.muscle,
            battery_voltage=settings.battery_voltage,
            watchdog=settings.supply_watchdog,
            rng=supply,
        )
        self.load_cell = EmulatedDAD141(
            "load_cell",
            self.world,
            self._sensed_force,
            rng=cell,
            weight_limits=(-5.0, 50.0),
            noise=settings.force_noise,
        )
        self.servo = EmulatedMX28("stage", self.world, position=settings.drum_zero_counts * COUNT)
        self.frame.drum = EmulatedDrum(self.servo, settings.drum_radius, zero_counts=settings.drum_zero_counts)
        self.magnet = RatiometricSensor(lambda: self.muscle.position + settings.rest_position, rng=sensor)
        self.t7 = EmulatedT7(self.world, {0: self.magnet.output, 1: self.magnet.supply}, rng=t7)
        self.frame.t7 = self.t7
        self._t7_server = ModbusTcpServer(self.t7)
        self._opened = ExitStack()
        if settings.fault != "none":
            self.world.add(_Fault(self, settings.fault_time))

    @abstractmethod
    def make_muscle(self, settings: MuscleLaboratorySettings, rng: np.random.Generator) -> Muscle:
        """Return the muscle of this laboratory."""

    def open(self) -> Mapping[str, str]:
        """Switch the instruments on; return the port of each by name.

        Raises
        ------
        ValueError
            If another laboratory of this process has the same ports open; it keeps them.
        """
        servers: dict[str, WireServer] = {
            "supply": CanopenSlcanServer(self.supply),
            "load_cell": ModbusRtuServer(self.load_cell),
            "stage": Dynamixel2Server([self.servo]),
        }
        with ExitStack() as started:
            self._t7_server.start()
            started.callback(self._t7_server.close)
            ports = {"t7": self._t7_server.address}
            for name, server in servers.items():
                ports[name] = protocol_emulated.register(name, server, self._clock)
                started.callback(protocol_emulated.unregister, name)
            self._opened = started.pop_all()
        return ports

    def operate(self, task: str, value: float) -> None:
        """Hang a load of `value` N on the muscle, or fasten its end to the stage.

        Raises
        ------
        ConfigurationError
            If it is another task, or the muscle does not bear the load.
        """
        if task not in (LOAD, STAGE):
            raise ConfigurationError(f"this laboratory cannot carry out {task!r}; it can: {LOAD}, {STAGE}")
        with self.world.lock:
            self.world.advance()
            fault = self._settings.fault if self._clock.now() >= self._settings.fault_time else "none"
            if task == STAGE:
                self.frame.fasten()
            elif fault != "forgotten-load":
                load = 2.0 * value if fault == "heavy-load" else value
                try:
                    self.frame.hang(load)
                except ValueError as error:
                    raise ConfigurationError(f"a load of {load:g} N cannot be hung on the muscle: {error}") from None

    def close(self) -> None:
        """Switch the instruments off."""
        self._opened.close()

    def go_wrong(self) -> None:
        """Have the fault of the settings happen, if it is one that happens at an instant."""
        fault = self._settings.fault
        if fault == "silent-supply":
            self.supply.unplug()
        elif fault == "missing-heartbeat":
            self.supply.write_object(_HEARTBEAT_TIME, 0)
        elif fault == "unplugged-sensor":
            self.magnet.supply_volts = 0.0
        elif fault == "servo-overload":
            self.servo.trip(HardwareError.OVERLOAD)
        elif fault == "broken-load-cell":
            self._cell_is_broken = True

    def _sensed_force(self) -> float:
        return _BROKEN_CELL if self._cell_is_broken else self.muscle.force


class _Fault:
    """Something that goes wrong at its time; a `Timed` part of the world."""

    def __init__(self, laboratory: MuscleLaboratory, instant: float) -> None:
        self._laboratory = laboratory
        self._due = instant

    def deadline(self) -> float:
        """Return when it is due, s."""
        return self._due

    def expire(self) -> None:
        """Let it happen, once."""
        self._due = math.inf
        self._laboratory.go_wrong()


class SMALaboratorySettings(MuscleLaboratorySettings):
    """What a rig file may say of the laboratory with the SMA wire."""

    ambient_deviation: float = Field(
        default=0.3, ge=0, le=5, description="standard deviation of the room temperature, K"
    )
    specimen_seed: int = Field(default=SMAParameters.specimen_seed, ge=0, description="which specimen it is")


class SMALaboratory(MuscleLaboratory):
    """The laboratory with a shape-memory-alloy wire."""

    Settings = SMALaboratorySettings

    def make_muscle(self, settings: MuscleLaboratorySettings, rng: np.random.Generator) -> Muscle:
        """Return the wire."""
        if not isinstance(settings, SMALaboratorySettings):
            raise TypeError(f"settings: expected SMALaboratorySettings, got {type(settings).__name__}")
        return SMAWire(
            SMAParameters(specimen_seed=settings.specimen_seed, ambient_sd=settings.ambient_deviation), rng
        )


class McKibbenLaboratorySettings(MuscleLaboratorySettings):
    """What a rig file may say of the laboratory with the McKibben muscle."""

    pressure_deviation: float = Field(
        default=500.0, ge=0, le=1e5, description="standard deviation of the regulated pressure, Pa"
    )


class McKibbenLaboratory(MuscleLaboratory):
    """The laboratory with a McKibben muscle, whose pressure a proportional valve regulates to the voltage.

    The T7's line opens a quick exhaust where the other muscles have a fan.
    """

    Settings = McKibbenLaboratorySettings

    def make_muscle(self, settings: MuscleLaboratorySettings, rng: np.random.Generator) -> Muscle:
        """Return the muscle."""
        if not isinstance(settings, McKibbenLaboratorySettings):
            raise TypeError(f"settings: expected McKibbenLaboratorySettings, got {type(settings).__name__}")
        return McKibbenMuscle(McKibbenParameters(supply_sd=settings.pressure_deviation), rng)


class CoiledPolymerLaboratorySettings(MuscleLaboratorySettings):
    """What a rig file may say of the laboratory with the super-coiled polymer muscle."""

    ambient_deviation: float = Field(
        default=0.3, ge=0, le=5, description="standard deviation of the room temperature, K"
    )


class CoiledPolymerLaboratory(MuscleLaboratory):
    """The laboratory with a super-coiled polymer muscle."""

    Settings = CoiledPolymerLaboratorySettings

    def make_muscle(self, settings: MuscleLaboratorySettings, rng: np.random.Generator) -> Muscle:
        """Return the muscle."""
        if not isinstance(settings, CoiledPolymerLaboratorySettings):
            raise TypeError(f"settings: expected CoiledPolymerLaboratorySettings, got {type(settings).__name__}")
        return CoiledPolymerMuscle(CoiledPolymerParameters(ambient_sd=settings.ambient_deviation), rng)
