"""The emulated VO2 laboratory: a cantilever on a Peltier plate, its TEC controller, and the PSD on a T7."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from pydantic import Field

from bench.base import Clock, ConfigurationError
from rigs.vo2.curvature import curvature_to_deflection
from sim_devices.faults.fault import Fault, Quantity
from sim_devices.faults.sensor import FaultySensor
from sim_devices.faults.supply import ClippedPeltier
from sim_devices.instruments.labjack_t7 import EmulatedT7
from sim_devices.instruments.meerstetter_table import DeviceStatus
from sim_devices.instruments.meerstetter_tec import EmulatedTEC
from sim_devices.laboratory import EmulatedLaboratory, TrueValue, tec_faults
from sim_devices.plants.grid import changed
from sim_devices.plants.vo2 import VO2Cantilever, VO2Parameters
from sim_devices.transducers.data_sheets import GONIOMETER, MICROMETER, PSD, SETTING
from sim_devices.transducers.imperfect import SensorErrors, imperfect, shown
from sim_devices.transducers.photodetector import NormalisedPSD
from sim_devices.transducers.specimens import SensorSettings
from sim_devices.wire.mecom import MeComServer
from sim_devices.wire.modbus_tcp import ModbusTcpInstrument
from sim_devices.world import World

_SPOT, _HAND = 1, 2
"""Beside the seed, for the noise of a faulty sensor and for an operator."""

MIRROR, DETECTOR = "mirror", "detector"
"""Tasks of an operator: tilt a mirror in place of the cantilever (°), or move the detector while the mirror is at 0°
(m by the micrometer)."""


class VO2LaboratorySettings(SensorSettings):
    """Keys of the table `[emulation]`."""

    specimen_seed: int = Field(default=VO2Parameters.specimen_seed, ge=0, description="seed of the specimen")
    session_offset: float = Field(
        default=0.0, ge=-5, le=5, description="temperature of the film above the plate's, constant in a session, K"
    )
    disturbances: bool = Field(default=True, description="whether the film's temperature wanders and drifts")
    ambient_temperature: float = Field(default=22.0, ge=0, le=40, description="temperature of the room, °C")
    psd: SensorErrors = Field(
        default=SensorErrors(),
        description="systematic errors of the PSD with its laser, in deflection of the tip (m), range ±100 µm",
    )
    goniometer: SensorErrors = Field(
        default=SensorErrors(), description="errors of the mirror's angle against the goniometer's, °, range ±45°"
    )
    micrometer: SensorErrors = Field(
        default=SensorErrors(), description="errors of the detector's place against the micrometer's, m, range ±20 mm"
    )
    magnification: float = Field(
        default=4 * 14e-3 / 300e-6, gt=0, description="way of the spot for that of the tip, by the lever as measured"
    )
    psd_noise: float = Field(default=5e-3, ge=0, le=1, description="noise of the PSD in one conversion, V rms")
    plant: dict[str, float] = Field(
        default={},
        description="numbers of plate and film in place of their own, by the names in `sim_devices.plants.vo2`",
    )
    volts_per_metre: float = Field(
        default=1e5, gt=0, description="sensitivity of laser, beam and PSD together, V per m of tip deflection"
    )


class VO2Laboratory(EmulatedLaboratory):
    """The laboratory with the instruments `tec` (serial, MeCom) and `psd` (Modbus TCP).

    Parameters
    ----------
    settings : VO2LaboratorySettings
        From the rig file.
    clock : Clock
        The clock of the run.
    seed : int
        Seed of wander, drift and sensor noise; the specimen itself has its own.
    """

    Settings = VO2LaboratorySettings
    world: World
    kernels = ("sim_devices.plants._vo2_kernels", "sim_devices.transducers._imperfect_kernels")

    def __init__(self, settings: VO2LaboratorySettings, clock: Clock, seed: int) -> None:
        # One stream a source of noise: how often one instrument is read must not change the readings of another.
        plant_stream, tec_stream, psd_stream, t7_stream = np.random.default_rng(seed).spawn(4)
        specimen = VO2Parameters(
            specimen_seed=settings.specimen_seed,
            session_offset=settings.session_offset,
            ambient_temperature=settings.ambient_temperature,
        )
        if not settings.disturbances:
            specimen = replace(specimen, wander_sd=0.0, drift_sd=0.0)
        specimen = changed(specimen, settings.plant)
        self.plant = VO2Cantilever(specimen, plant_stream)
        self.world = World(self.plant, clock)
        peltier = ClippedPeltier(self.plant)
        self.tec = EmulatedTEC("tec", self.world, peltier, rng=tec_stream)
        self._settings = settings
        self._hand = np.random.default_rng((seed, _HAND))
        self._set_by_hand: float | None = None
        self._misalignment = 0.0
        self._stuck: tuple[float, float] | None = None
        self._shown = imperfect(self._spot, settings.errors_of("psd", PSD), *PSD.range, self.world)
        spot = FaultySensor(
            "spot",
            self.world,
            self._shown,
            "m",
            scale=10e-6,
            beyond=1e-3,
            seed=(seed, _SPOT),
        )
        detector = NormalisedPSD(spot, settings.volts_per_metre, settings.psd_noise, rng=psd_stream)
        self.t7 = EmulatedT7(self.world, {0: detector}, rng=t7_stream)
        super().__init__(
            "VO2 laboratory",
            {"psd": ModbusTcpInstrument(self.t7), "tec": MeComServer(self.tec)},
            clock,
            world=self.world,
            instruments={"psd": self.t7, "tec": self.tec},
            faults={
                **tec_faults(self.tec),
                "supply-clipped": peltier.fault(0.5),
                **spot.faults(),
                "displaced-spot": Fault(
                    "the laser spot stands where it would with more deflection",
                    self._displace,
                    {"metres": Quantity(20e-6, "m", -1e-3, 1e-3, "deflection that is added")},
                    undo=partial(self._displace, 0.0),
                    lies=True,
                ),
                "spot-off-the-psd": Fault(
                    "the laser spot is beyond the end of the PSD",
                    partial(self._displace, 1.0),
                    undo=partial(self._displace, 0.0),
                    lies=True,
                ),
                "cantilever-stuck": Fault(
                    "the cantilever stands still, as if it touched something", self._stick, undo=self._come_loose
                ),
            },
            seed=seed,
        )

    def operate(self, task: str, value: float) -> None:
        """Tilt a mirror in place of the cantilever to `value` °, or move the detector to `value` m under the spot.

        Raises ConfigurationError if it is another task.
        """
        settings = self._settings
        if task not in (MIRROR, DETECTOR):
            raise ConfigurationError(f"this laboratory cannot carry out {task!r}; it can: {MIRROR}, {DETECTOR}")
        with self.world.at_present():
            if task == MIRROR:
                angle = settings.characteristic_of("goniometer", GONIOMETER).value(value)
                if settings.sensors != "ideal":
                    angle += float(self._hand.uniform(-SETTING, SETTING))
                # The spot stands where that of a beam whose tip is turned by as much.
                length = self.plant.parameters.beam_length
                self._set_by_hand = float(curvature_to_deflection(np.radians(angle) / length, length))
                return
            place = settings.characteristic_of("micrometer", MICROMETER).value(value)
            # The lever is not in the way of the detector.
            lever = 1.0 + settings.errors_of("psd", PSD).gain_error
            self._set_by_hand = place / settings.magnification / lever

    def truth(self) -> dict[str, TrueValue]:
        """Return the state of film, plate and controller."""
        plant = self.plant
        curvature, deflection = self._bending()
        return {
            "plate_temperature": TrueValue(plant.plate_temperature, "°C"),
            "film_temperature": TrueValue(plant.film_temperature, "°C"),
            "sink_temperature": TrueValue(plant.sink_temperature, "°C"),
            "curvature": TrueValue(curvature, "1/m"),
            "tip_deflection": TrueValue(deflection, "m"),
            # Beside the true one what the PSD makes of it, without its noise.
            "deflection_shown": TrueValue(shown(self._shown), "m"),
            "tec_current": TrueValue(plant.current, "A"),
            "tec_voltage": TrueValue(plant.voltage, "V"),
            "tec_output": TrueValue(self.tec.status is DeviceStatus.RUN, is_output=True),
        }

    def _bending(self) -> tuple[float, float]:
        """Return curvature (1/m) and deflection of the tip (m)."""
        return (self.plant.curvature, self.plant.tip_deflection) if self._stuck is None else self._stuck

    def _spot(self) -> float:
        """Return the deflection of the tip that the spot shows, m."""
        if self._set_by_hand is not None:
            return self._set_by_hand + self._misalignment
        deflection = self.plant.tip_deflection if self._stuck is None else self._stuck[1]
        return deflection + self._misalignment

    def _stick(self) -> None:
        self._stuck = self._bending()

    def _come_loose(self) -> None:
        self._stuck = None

    def _displace(self, metres: float) -> None:
        self._misalignment = metres
