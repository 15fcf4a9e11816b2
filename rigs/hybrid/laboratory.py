"""The emulated laboratory of the thermo-piezoelectric hybrid.

A cantilever of piezo-ceramic and copper on a Peltier element. A TEC controller drives the latter as a current
source; a high-voltage amplifier, set and enabled by a LabJack T7, drives the piezo. An optical sensor sees the
tip; two thermistors are at the base and the tip.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

import numpy as np
from pydantic import Field

from bench.base import Clock
from rigs.hybrid.scan import SensorScan
from rigs.hybrid.witness import WitnessRegisters
from sim_devices.faults.fault import Fault, Quantity
from sim_devices.faults.sensor import FaultySensor
from sim_devices.faults.supply import ClippedPeltier
from sim_devices.instruments.labjack_t7 import EmulatedT7
from sim_devices.instruments.meerstetter_table import DeviceStatus
from sim_devices.instruments.meerstetter_tec import EmulatedTEC
from sim_devices.laboratory import EmulatedLaboratory, TrueValue, tec_faults
from sim_devices.plants.grid import changed
from sim_devices.plants.hybrid import HybridCantilever
from sim_devices.plants.hybrid_parameters import HybridParameters
from sim_devices.transducers.data_sheets import DISPLACEMENT, THERMISTOR
from sim_devices.transducers.displacement import DisplacementSensor
from sim_devices.transducers.imperfect import SensorErrors, characteristic_of, imperfect, shown
from sim_devices.transducers.piezo_amplifier import PiezoAmplifier
from sim_devices.transducers.specimens import SensorSettings
from sim_devices.transducers.thermistor import Thermistor
from sim_devices.wire.mecom import MeComServer
from sim_devices.wire.modbus_tcp import ModbusTcpInstrument
from sim_devices.world import World

ENABLE_LINE = 4
"""Digital line of the amplifier's enable input, FIO4 of the T7; the LJTick-DAC is on FIO0 and FIO1."""
GAIN = 4.0
"""Of the amplifier, V/V: the LJTick-DAC's 14 bits over ±10 V then make steps of 4.9 mV, 1.4 nm of deflection."""
SETTLING_TIME = 20e-6
"""Time constant of the amplifier with this piezo, s: short beside the 1.4 ms of a period of the resonance."""
REACH = 199e-6
"""Displacement of either sign that counts as within range, m; the sensor itself stops at 200 µm."""

_CURRENT_LIMIT_PARAMETER = 2030
_COLDEST_PARAMETER = 4010
_COLDEST = -25.0
"""Below which the TEC controller switches itself off, °C; as delivered it would do so above the coldest used."""

FaultName = Literal[
    "none",
    "open-thermistor",
    "shorted-thermistor",
    "out-of-range",
    "tec-over-current",
    "tec-over-temperature",
    "amplifier-trips",
]


class HybridLaboratorySettings(SensorSettings):
    """Settings of this laboratory in a rig file."""

    ambient: float = Field(
        default=HybridParameters.ambient_temperature,
        ge=5,
        le=45,
        description="mean temperature of the room in which the rig stands from long before the start, °C",
    )
    ambient_deviation: float = Field(
        default=HybridParameters.ambient_sd, ge=0, le=5, description="standard deviation of the room temperature, K"
    )
    ambient_step: float = Field(default=0.0, ge=-20, le=20, description="step of the room temperature, K")
    ambient_step_time: float = Field(default=0.0, ge=0, description="time of that step, s")
    resonance_offset: float = Field(
        default=0.0, ge=-0.1, le=0.1, description="deviation of the resonance from the paper's, as a share"
    )
    plant: dict[str, float] = Field(
        default={}, description="numbers of the plant in place of its own; see `sim_devices.plants`"
    )
    current_limit: float = Field(
        default=0.15, gt=0, le=0.4, description="as set in the TEC controller, A; a driver sets its own"
    )
    displacement_sensor: SensorErrors = Field(
        default=SensorErrors(), description="systematic errors of the displacement sensor (m), range ±200 µm"
    )
    base_thermistor: SensorErrors = Field(
        default=SensorErrors(), description="systematic errors of the thermistor at the base (K), range -40 to 80 °C"
    )
    tip_thermistor: SensorErrors = Field(
        default=SensorErrors(), description="systematic errors of the thermistor at the tip (K), range -40 to 80 °C"
    )
    reference_sensor: SensorErrors = Field(
        default=SensorErrors(), description="systematic errors of the interferometer, the witness (m), range ±200 µm"
    )
    fault: FaultName = Field(
        default="none",
        description="fault at `fault_time`: open-thermistor, shorted-thermistor, out-of-range (of the "
        "displacement sensor), tec-over-current, tec-over-temperature, amplifier-trips (if it is on then)",
    )
    fault_time: float = Field(default=0.0, ge=0, description="time of the fault, s of laboratory time")


class HybridLaboratory(EmulatedLaboratory):
    """A `bench.rig.Laboratory` with the instruments `tec` (serial, MeCom) and `t7` (Modbus TCP), and the `witness`.

    Parameters
    ----------
    settings : HybridLaboratorySettings
        From the rig file.
    clock : Clock
        The clock of the run.
    seed : int
        Seed of the room and of the noise of the sensors.
    """

    Settings = HybridLaboratorySettings
    kernels = (
        "sim_devices.plants._hybrid_kernels",
        "sim_devices.plants._voltage_course_kernels",
        "sim_devices.transducers._imperfect_kernels",
        "sim_devices.transducers._voltage_kernels",
    )

    def __init__(self, settings: HybridLaboratorySettings, clock: Clock, seed: int) -> None:
        # One stream a source of noise: reading one instrument must not change the noise of another.
        plant, tec, sensor, base, tip, amplifier, t7 = np.random.default_rng(seed).spawn(7)
        self._settings = settings
        self.plant = HybridCantilever(
            changed(
                HybridParameters(
                    ambient_temperature=settings.ambient,
                    ambient_sd=settings.ambient_deviation,
                    resonance_offset=settings.resonance_offset,
                ),
                settings.plant,
            ),
            plant,
        )
        self.world = World(self.plant, clock)
        peltier = ClippedPeltier(self.plant.peltier)
        self.tec = EmulatedTEC("tec", self.world, peltier, rng=tec)
        self.tec.write_parameter(_CURRENT_LIMIT_PARAMETER, settings.current_limit)
        self.tec.write_parameter(_COLDEST_PARAMETER, _COLDEST)
        self._beyond = 0.0
        self._stuck: float | None = None
        self._shown = {
            name: imperfect(quantity, settings.errors_of(table, sheet), *sheet.range, self.world)
            for name, quantity, table, sheet in (
                ("displacement", self._seen_deflection, "displacement_sensor", DISPLACEMENT),
                ("base", lambda: self.plant.base_temperature, "base_thermistor", THERMISTOR),
                ("tip", lambda: self.plant.tip_temperature, "tip_thermistor", THERMISTOR),
            )
        }
        witness = imperfect(self._deflection, settings.reference_sensor, *DISPLACEMENT.range, self.world)
        sensors = [
            FaultySensor(name, self.world, seen, unit, scale=scale, beyond=beyond, seed=(seed, i))
            for i, (name, seen, unit, scale, beyond) in enumerate(
                (
                    ("displacement", self._shown["displacement"], "m", 5e-6, 1e-3),
                    ("base", self._shown["base"], "K", 5.0, 140.0),
                    ("tip", self._shown["tip"], "K", 5.0, 140.0),
                ),
                1,
            )
        ]
        self.displacement = DisplacementSensor(sensors[0], rng=sensor)
        self.base = Thermistor(sensors[1], rng=base)
        self.tip = Thermistor(sensors[2], rng=tip)
        self.amplifier = PiezoAmplifier(self.world, self.plant, gain=GAIN, settling_time=SETTLING_TIME, rng=amplifier)
        wires: list[Callable[[], float]] = [
            self.displacement,
            self.base.divider,
            self.base.excitation,
            self.tip.divider,
            self.tip.excitation,
            self.amplifier.voltage_monitor,
            self.amplifier.current_monitor,
            self.amplifier.status,
        ]
        self.t7 = EmulatedT7(self.world, dict(enumerate(wires)), rng=t7)
        characteristics = [characteristic_of(seen) for seen in self._shown.values()]
        if None not in characteristics:
            scan = SensorScan(
                self.plant,
                self.displacement,
                self.base,
                self.tip,
                [each for each in characteristics if each is not None],
                sensors,
                lambda: self._stuck is None and not self._beyond,
            )
            self.t7.scan_by(scan)
        self.t7.add_follower(
            lambda: self.amplifier.drive(self.t7.tdac_volts(0), self.t7.dio_level(ENABLE_LINE, pulled_down=True))
        )
        super().__init__(
            "hybrid laboratory",
            {
                "t7": ModbusTcpInstrument(self.t7),
                "tec": MeComServer(self.tec),
                "witness": ModbusTcpInstrument(WitnessRegisters(self.world, witness)),
            },
            clock,
            world=self.world,
            instruments={"t7": self.t7, "tec": self.tec},
            faults={
                "open-thermistor": Fault(
                    "a wire of the thermistor at the base breaks",
                    partial(setattr, self.base, "open", True),
                    undo=partial(setattr, self.base, "open", False),
                    lies=True,
                ),
                "shorted-thermistor": Fault(
                    "the wires of the thermistor at the tip touch",
                    partial(setattr, self.tip, "shorted", True),
                    undo=partial(setattr, self.tip, "shorted", False),
                    lies=True,
                ),
                "out-of-range": Fault(
                    "the displacement sensor sees the tip further away",
                    self._go_beyond,
                    {"metres": Quantity(1e-3, "m", -1.0, 1.0, "displacement that is added")},
                    undo=partial(self._go_beyond, 0.0),
                    lies=True,
                ),
                **tec_faults(self.tec),
                "amplifier-trips": Fault("the amplifier switches itself off, if it is on", self.amplifier.trip),
                "amplifier-clipped": Fault(
                    "the output of the amplifier is clipped",
                    self.amplifier.clip,
                    {"volts": Quantity(10.0, "V", 0.0, PiezoAmplifier.SATURATION, "highest output of either sign")},
                    undo=partial(self.amplifier.clip, PiezoAmplifier.SATURATION),
                ),
                "supply-clipped": peltier.fault(0.02),
                "cantilever-stuck": Fault(
                    "the cantilever stands still, as if it touched something", self._stick, undo=self._come_loose
                ),
                **{name: fault for each in sensors for name, fault in each.faults().items()},
            },
            seed=seed,
        )
        if settings.ambient_step:
            self.at(settings.ambient_step_time, self._step_room)
        if settings.fault != "none":
            self.at(settings.fault_time, partial(self.inject, settings.fault))

    def truth(self) -> dict[str, TrueValue]:
        """Return the state of cantilever, controller and amplifier."""
        plant = self.plant
        return {
            "base_temperature": TrueValue(plant.base_temperature, "°C"),
            "tip_temperature": TrueValue(plant.tip_temperature, "°C"),
            "sink_temperature": TrueValue(plant.sink_temperature, "°C"),
            "ambient_temperature": TrueValue(plant.ambient_temperature, "°C"),
            "deflection": TrueValue(self._deflection(), "m"),
            # Beside the true ones what the sensors make of them, without their noise.
            "displacement_shown": TrueValue(shown(self._shown["displacement"]), "m"),
            "base_shown": TrueValue(shown(self._shown["base"]), "°C"),
            "tip_shown": TrueValue(shown(self._shown["tip"]), "°C"),
            "tec_current": TrueValue(plant.current, "A"),
            "tec_voltage": TrueValue(plant.tec_voltage, "V"),
            "tec_output": TrueValue(self.tec.status is DeviceStatus.RUN, is_output=True),
            "piezo_voltage": TrueValue(plant.piezo_voltage, "V"),
            "amplifier_command": TrueValue(self.t7.tdac_volts(0), "V", is_output=True, behind="amplifier_enable"),
            "amplifier_enable": TrueValue(self.t7.dio_level(ENABLE_LINE, pulled_down=True), is_output=True),
        }

    def _deflection(self) -> float:
        return self.plant.deflection if self._stuck is None else self._stuck

    def _seen_deflection(self) -> float:
        return self._deflection() + self._beyond

    def _stick(self) -> None:
        self._stuck = self._deflection()

    def _come_loose(self) -> None:
        self._stuck = None

    def _step_room(self) -> None:
        self.plant.step_ambient(self._settings.ambient_step)

    def _go_beyond(self, metres: float) -> None:
        self._beyond = metres
