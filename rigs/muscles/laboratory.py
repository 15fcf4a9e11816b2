"""Emulated laboratories for artificial muscles: one muscle at a time in a test frame, and the instruments around it.

The muscle hangs from a load cell. Its lower end, where the magnet of a position sensor sits, either carries
weights or is fastened to the drum of a servo; the operator changes between the two. A PWM supply drives the
muscle, a fan blows at it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from bench.base import Clock, ConfigurationError
from sim_devices.faults.fault import Fault, Quantity
from sim_devices.faults.sensor import FaultySensor
from sim_devices.instruments.dynamixel import EmulatedMX28
from sim_devices.instruments.dynamixel_drum import EmulatedDrum
from sim_devices.instruments.dynamixel_table import COUNT, HardwareError
from sim_devices.instruments.flintec_dad141 import EmulatedDAD141
from sim_devices.instruments.labjack_t7 import EmulatedT7
from sim_devices.instruments.roboteq import EmulatedRoboteq
from sim_devices.instruments.roboteq_objects import Fault as SupplyFault
from sim_devices.laboratory import EmulatedLaboratory, TrueValue
from sim_devices.plants.coiled_polymer import CoiledPolymerMuscle, CoiledPolymerParameters
from sim_devices.plants.grid import GRID_TOLERANCE, Floats, changed
from sim_devices.plants.mckibben import McKibbenMuscle, McKibbenParameters
from sim_devices.plants.muscle import Muscle
from sim_devices.plants.sma import SMAParameters, SMAWire
from sim_devices.transducers.data_sheets import GAUGE_BLOCKS, LOAD_CELL, POSITION, WEIGHTS
from sim_devices.transducers.imperfect import ImperfectSensor, SensorErrors, imperfect, shown
from sim_devices.transducers.magnet import RatiometricSensor
from sim_devices.transducers.specimens import SensorSettings
from sim_devices.wire.canopen_slcan import CanopenSlcanServer
from sim_devices.wire.dynamixel2 import Dynamixel2Server
from sim_devices.wire.modbus_rtu import ModbusRtuServer
from sim_devices.wire.modbus_tcp import ModbusTcpInstrument
from sim_devices.world import World

LOAD, STAGE, GAUGE = "load", "stage", "gauge"
"""Tasks of an operator in these laboratories: hang a load (N) on the muscle, fasten it to the stage, or hold the
magnet by gauge blocks (m from rest)."""

FAN_LINE = 0
"""Digital line of the T7 that switches the fan: FIO0, on when high."""

_HEARTBEAT_TIME = 0x1017
"""Object of the supply with the period of its heartbeat, ms; 0 for none."""
_BROKEN_CELL = -1e3
"""Reading of a load cell with a broken wire, N."""
_BOTTOM = 0.05
"""Where the end of a broken muscle lies, m from rest: beyond the stroke of the position sensor."""

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


_SENSOR_KERNELS = ("sim_devices.instruments._flintec_kernels", "sim_devices.transducers._imperfect_kernels")


class MuscleLaboratorySettings(SensorSettings, ABC):
    """Keys of the table `[emulation]` that all these laboratories have."""

    battery_voltage: float = Field(default=10.0, gt=0, le=60, description="voltage behind the PWM supply, V")
    supply_watchdog: float = Field(default=5.0, ge=0, le=65, description="as set in the supply by ^RWD, s")
    drum_radius: float = Field(default=4.5e-3, gt=0, le=0.1, description="radius of the servo's drum, m")
    drum_zero_counts: int = Field(
        default=2200, ge=0, le=4095, description="counts of the servo where the muscle is at rest"
    )
    rest_position: float = Field(
        default=17.5e-3, gt=0, le=35e-3, description="where along its stroke the sensor sees the muscle at rest, m"
    )
    force_sensor: SensorErrors = Field(
        default=SensorErrors(), description="systematic errors of the load cell (N), range 0 to 20 N"
    )
    position_sensor: SensorErrors = Field(
        default=SensorErrors(), description="systematic errors of the position sensor (m), range 0 to 35 mm"
    )
    weights: SensorErrors = Field(
        default=SensorErrors(), description="errors of true weights against those stated (N), range 0 to 20 N"
    )
    gauge_blocks: SensorErrors = Field(
        default=SensorErrors(), description="errors of the true place of the magnet against the blocks' (m), ±17.5 mm"
    )
    force_noise: float = Field(default=0.04, ge=0, le=1, description="noise of the load cell, unfiltered, N rms")
    plant: dict[str, float] = Field(
        default={}, description="numbers of the muscle in place of its own; see `sim_devices.plants`"
    )
    fault: FaultName = Field(
        default="none",
        description="fault at `fault_time`; forgotten-load (the operator hangs nothing) and heavy-load "
        "(twice the weight) from then on",
    )
    fault_time: float = Field(default=0.0, ge=0, description="time of the fault, s of laboratory time")

    @abstractmethod
    def make_muscle(self, rng: np.random.Generator) -> Muscle[Any]:
        """Return the muscle of this laboratory."""


class Frame:
    """The muscle with its load or stage: a `sim_devices.world.Plant`.

    No command of a host breaks the muscle: a diode in the muscle's wires blocks a reversed voltage, a suppressor
    holds a higher one at the largest that the muscle takes, and the stage has an end stop to either side.

    Parameters
    ----------
    muscle : Muscle
        The specimen; it begins without a load.

    Attributes
    ----------
    drum : EmulatedDrum or None
        The stage's drum, once it is there.
    gauge : float or None
        Where gauge blocks hold the magnet of the position sensor, m from rest; None if they do not.
    is_broken : bool
        A fault: the muscle is torn, so that no current flows, nothing pulls, and its end lies at the bottom.
    """

    def __init__(self, muscle: Muscle[Any]) -> None:
        self.muscle = muscle
        self.drum: EmulatedDrum | None = None
        self.gauge: float | None = None
        self.is_broken = False
        self._fastened = False
        self._voltage = 0.0

    def apply(self, voltage: float) -> None:
        """Apply the voltage of the supply, V, to the muscle's wires."""
        self._voltage = voltage
        if self.is_broken:
            voltage = 0.0
        self.muscle.apply(min(max(voltage, 0.0), self.muscle.parameters.maximum_voltage))

    @property
    def current(self) -> float:
        """Current through the muscle, A."""
        return 0.0 if self.is_broken else self.muscle.current

    @property
    def force(self) -> float:
        """Tension, N."""
        return 0.0 if self.is_broken else self.muscle.force

    @property
    def position(self) -> float:
        """Position of the magnet, m from rest: at the end of the muscle, of a broken one at the bottom."""
        if self.gauge is not None:
            return self.gauge
        return _BOTTOM if self.is_broken else self.muscle.position

    def tear(self, broken: bool = True) -> None:
        """Break the muscle, or put it together again."""
        self.is_broken = broken
        self.apply(self._voltage)

    def hang(self, newton: float) -> None:
        """Take the end off the stage, if it is there, and hang a load on it."""
        self._fastened = False
        self.muscle.hang(newton)

    def fasten(self) -> None:
        """Take the load off and fasten the end to the stage, so that both stand at the same number of metres."""
        self._fastened = True

    @property
    def is_moving(self) -> bool:
        """Whether the end follows a stage that is on its way."""
        return self._fastened and self.drum is not None and self.drum.is_moving

    def advance(self, dt: float) -> None:
        """Integrate over `dt` seconds, with the end following the stage."""
        if self._fastened and self.drum is not None:
            # A servo on its way is due every 20 ms, so that the world advances in pieces as short as that.
            reach = self.muscle.parameters.reach
            self.muscle.clamp(min(max(self.drum.position_after(dt), -reach), reach))
        self.muscle.advance(dt)


class ForceCourse:
    """The force of a muscle over time: a `sim_devices.instruments._flintec_kernels.Course`.

    Parameters
    ----------
    frame : Frame
        The muscle's frame.
    muscle : Muscle
        The muscle, which keeps its force.
    sensor : FaultySensor
        What the load cell sees of the force.
    cell : callable
        What the load cell makes of the force, without a fault.
    """

    tolerance = GRID_TOLERANCE

    def __init__(self, frame: Frame, muscle: Muscle[Any], sensor: FaultySensor, cell: Callable[[], float]) -> None:
        self._frame = frame
        self._muscle = muscle
        self._sensor = sensor
        self._imperfect = cell if isinstance(cell, ImperfectSensor) else None
        self.step = muscle.parameters.step

    @property
    def is_known(self) -> bool:
        """Whether it goes by what the muscle keeps: a stage on its way moves in pieces, from look to look."""
        frame = self._frame
        is_static = self._imperfect is None or self._imperfect.is_static
        return is_static and not frame.is_broken and not frame.is_moving and self._sensor.is_whole

    @property
    def forces(self) -> Floats:
        """What the load cell makes of the forces that the muscle keeps, N; see `Course.forces`."""
        kept: Floats = self._muscle.forces
        if self._imperfect is None:
            return kept
        shown = kept.copy()
        # Behind the ring stands the number of the last one.
        self._imperfect.characteristic.show(shown[:-1])
        return shown

    def since_point(self) -> float:
        """Return the time for which the muscle has stood at the last grid point, s."""
        return self._muscle.since_point()


class MuscleLaboratory(EmulatedLaboratory):
    """A laboratory with the instruments `supply`, `load_cell`, `stage` (serial lines) and `t7` (TCP).

    Parameters
    ----------
    settings : MuscleLaboratorySettings
        From the rig file.
    clock : Clock
        The clock of the run.
    seed : int
        Seed of the room and of the noise; the specimen has its own.
    """

    Settings: ClassVar[type[MuscleLaboratorySettings]]
    world: World

    def __init__(self, settings: MuscleLaboratorySettings, clock: Clock, seed: int) -> None:
        if not isinstance(settings, self.Settings):
            raise TypeError(f"settings: expected {self.Settings.__name__}, got {type(settings).__name__}")
        # One stream a source of noise: how often one instrument is read must not change the readings of another.
        plant, supply, cell, sensor, t7 = np.random.default_rng(seed).spawn(5)
        self._settings = settings
        self.muscle = settings.make_muscle(plant)
        self.frame = Frame(self.muscle)
        self.world = World(self.frame, clock)
        self._load_is_forgotten = False
        self._load_factor = 1.0
        self._force_shown = imperfect(
            lambda: self.frame.force, settings.errors_of("force_sensor", LOAD_CELL), *LOAD_CELL.range, self.world
        )
        self._position_shown = imperfect(
            lambda: self.frame.position,
            settings.errors_of("position_sensor", POSITION),
            POSITION.range[0] - settings.rest_position,
            POSITION.range[1] - settings.rest_position,
            self.world,
        )
        self._force_sensor, self._position_sensor = (
            FaultySensor(name, self.world, seen, unit, scale=scale, beyond=beyond, seed=(seed, i))
            for i, (name, seen, unit, scale, beyond) in enumerate(
                (
                    ("force", self._force_shown, "N", 2.0, _BROKEN_CELL),
                    ("position", self._position_shown, "m", 1e-3, _BOTTOM),
                ),
                1,
            )
        )
        self.supply = EmulatedRoboteq(
            "supply",
            self.world,
            self.frame,
            battery_voltage=settings.battery_voltage,
            watchdog=settings.supply_watchdog,
            rng=supply,
        )
        self.load_cell = EmulatedDAD141(
            "load_cell",
            self.world,
            self._force_sensor,
            rng=cell,
            weight_limits=(-5.0, 50.0),
            zero_tracking=0,
            noise=settings.force_noise,
            course=ForceCourse(self.frame, self.muscle, self._force_sensor, self._force_shown),
        )
        self.servo = EmulatedMX28("stage", self.world, position=settings.drum_zero_counts * COUNT)
        self.frame.drum = EmulatedDrum(self.servo, settings.drum_radius, zero_counts=settings.drum_zero_counts)
        self.magnet = RatiometricSensor(lambda: self._position_sensor() + settings.rest_position, rng=sensor)
        self.t7 = EmulatedT7(self.world, {0: self.magnet.output, 1: self.magnet.supply}, rng=t7)
        self._fan_stands = False
        self.t7.add_follower(self._blow)
        super().__init__(
            "muscle laboratory",
            {
                "t7": ModbusTcpInstrument(self.t7),
                "supply": CanopenSlcanServer(self.supply),
                "load_cell": ModbusRtuServer(self.load_cell),
                "stage": Dynamixel2Server([self.servo]),
            },
            clock,
            world=self.world,
            instruments={"t7": self.t7, "supply": self.supply, "load_cell": self.load_cell, "stage": self.servo},
            faults=self._faults(),
            seed=seed,
        )
        if settings.fault != "none":
            self.at(settings.fault_time, partial(self.inject, settings.fault))

    def operate(self, task: str, value: float) -> None:
        """Hang a load of `value` N on the muscle, fasten its end to the stage, or hold the magnet at `value` m.

        Raises ConfigurationError if it is another task, or the muscle does not bear the load.
        """
        if task not in (LOAD, STAGE, GAUGE):
            raise ConfigurationError(f"this laboratory cannot carry out {task!r}; it can: {LOAD}, {STAGE}, {GAUGE}")
        with self.world.at_present():
            self.frame.gauge = None
            if task == GAUGE:
                self.frame.gauge = self._settings.characteristic_of("gauge_blocks", GAUGE_BLOCKS).value(value)
                return
            if task == STAGE:
                self.frame.fasten()
            elif not self._load_is_forgotten:
                load = self._load_factor * value
                try:
                    self.frame.hang(self._settings.characteristic_of("weights", WEIGHTS).value(load))
                except ValueError as error:
                    raise ConfigurationError(f"a load of {load:g} N cannot be hung on the muscle: {error}") from None

    def truth(self) -> dict[str, TrueValue]:
        """Return the state of muscle, supply, stage and fan."""
        return {
            **self.muscle_truth(),
            "force": TrueValue(self.frame.force, "N"),
            "position": TrueValue(self.frame.position, "m"),
            # Beside the true ones what the sensors make of them, without their noise.
            "force_shown": TrueValue(shown(self._force_shown), "N"),
            "position_shown": TrueValue(shown(self._position_shown), "m"),
            "supply_voltage": TrueValue(self.supply.voltage, "V", is_output=True),
            "supply_current": TrueValue(self.frame.current, "A"),
            "stage_angle": TrueValue(self.servo.position, "rad"),
            "stage_torque": TrueValue(self.servo.holds, is_output=True),
            "fan": TrueValue(self.t7.dio_level(FAN_LINE), is_output=True),
        }

    def muscle_truth(self) -> dict[str, TrueValue]:
        """Return what only muscles of this kind have: the temperature of one that is heated."""
        if not isinstance(self.muscle, SMAWire | CoiledPolymerMuscle):
            return {}
        return {"muscle_temperature": TrueValue(self.muscle.temperature, "°C")}

    def _faults(self) -> dict[str, Fault]:
        return {
            "silent-supply": Fault(
                "nothing reaches the supply, and nothing comes from it", self.supply.unplug, undo=self.supply.plug_in
            ),
            "missing-heartbeat": Fault(
                "the supply sends no heartbeat any more", partial(self.supply.write_object, _HEARTBEAT_TIME, 0)
            ),
            "low-battery": Fault(
                "the voltage behind the supply changes, and clips its output",
                self._charge,
                {"volts": Quantity(4.5, "V", 0.0, 60.0, "voltage behind the supply")},
                undo=partial(self._charge, self._settings.battery_voltage),
            ),
            "supply-short-circuit": Fault(
                "the supply sees a short circuit, and drops its output",
                partial(self.supply.trip, SupplyFault.SHORT_CIRCUIT),
                undo=self.supply.clear,
            ),
            "unplugged-sensor": Fault(
                "the position sensor loses its supply",
                partial(setattr, self.magnet, "supply_volts", 0.0),
                undo=partial(setattr, self.magnet, "supply_volts", self.magnet.supply_volts),
                lies=True,
            ),
            "servo-overload": Fault("the servo trips and lets go", partial(self.servo.trip, HardwareError.OVERLOAD)),
            "broken-load-cell": self._force_sensor.faults()["force.out-of-range"],
            "broken-muscle": Fault("the muscle is torn", self.frame.tear, undo=partial(self.frame.tear, False)),
            "fan-stands": Fault(
                "the fan does not turn, also when it is on",
                partial(self._stop_fan, True),
                undo=partial(self._stop_fan, False),
            ),
            "forgotten-load": Fault(
                "the operator hangs nothing from now on",
                partial(setattr, self, "_load_is_forgotten", True),
                undo=partial(setattr, self, "_load_is_forgotten", False),
            ),
            "heavy-load": Fault(
                "the operator hangs a multiple of the load from now on",
                self._overload,
                {"factor": Quantity(2.0, "", 0.0, 100.0, "multiple of the load")},
                undo=partial(setattr, self, "_load_factor", 1.0),
            ),
            **self._force_sensor.faults(),
            **self._position_sensor.faults(),
        }

    def _blow(self) -> None:
        self.muscle.blow(self.t7.dio_level(FAN_LINE) and not self._fan_stands)

    def _stop_fan(self, stands: bool) -> None:
        self._fan_stands = stands
        self._blow()

    def _overload(self, factor: float) -> None:
        self._load_factor = factor

    def _charge(self, volts: float) -> None:
        self.supply.battery_voltage = volts


class _ThermalSettings(MuscleLaboratorySettings):
    ambient_deviation: float = Field(
        default=0.3, ge=0, le=5, description="standard deviation of the room temperature, K"
    )


class SMALaboratorySettings(_ThermalSettings):
    """Keys of the laboratory with the SMA wire."""

    specimen_seed: int = Field(default=SMAParameters.specimen_seed, ge=0, description="seed of the specimen")

    def make_muscle(self, rng: np.random.Generator) -> Muscle[Any]:
        """Return the wire."""
        return SMAWire(
            changed(SMAParameters(specimen_seed=self.specimen_seed, ambient_sd=self.ambient_deviation), self.plant),
            rng,
        )


class SMALaboratory(MuscleLaboratory):
    """The laboratory with a shape-memory-alloy wire."""

    Settings = SMALaboratorySettings
    kernels = ("sim_devices.plants._sma_kernels", *_SENSOR_KERNELS)


class McKibbenLaboratorySettings(MuscleLaboratorySettings):
    """Keys of the laboratory with the McKibben muscle."""

    pressure_deviation: float = Field(
        default=500.0, ge=0, le=1e5, description="standard deviation of the regulated pressure, Pa"
    )

    def make_muscle(self, rng: np.random.Generator) -> Muscle[Any]:
        """Return the muscle."""
        return McKibbenMuscle(changed(McKibbenParameters(supply_sd=self.pressure_deviation), self.plant), rng)


class McKibbenLaboratory(MuscleLaboratory):
    """The laboratory with a McKibben muscle, whose pressure a proportional valve regulates to the voltage.

    The T7's line opens a quick exhaust where the other muscles have a fan.
    """

    Settings = McKibbenLaboratorySettings
    kernels = ("sim_devices.plants._friction_kernels", *_SENSOR_KERNELS)


class CoiledPolymerLaboratorySettings(_ThermalSettings):
    """Keys of the laboratory with the super-coiled polymer muscle."""

    def make_muscle(self, rng: np.random.Generator) -> Muscle[Any]:
        """Return the muscle."""
        return CoiledPolymerMuscle(
            changed(CoiledPolymerParameters(ambient_sd=self.ambient_deviation), self.plant), rng
        )


class CoiledPolymerLaboratory(MuscleLaboratory):
    """The laboratory with a super-coiled polymer muscle."""

    Settings = CoiledPolymerLaboratorySettings
    kernels = ("sim_devices.plants._friction_kernels", *_SENSOR_KERNELS)
