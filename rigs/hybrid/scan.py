"""The sensors at the first inputs of the T7 in one compiled call: a fast loop reads all of them with each sample."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bench.base import DeferredModule
from sim_devices.faults.sensor import FaultySensor
from sim_devices.plants.hybrid import HybridCantilever
from sim_devices.transducers.displacement import DisplacementSensor
from sim_devices.transducers.imperfect import Characteristic
from sim_devices.transducers.thermistor import Thermistor

if TYPE_CHECKING:
    from rigs.hybrid import _scan_kernels as kernels
else:
    kernels = DeferredModule("rigs.hybrid._scan_kernels")

Floats = NDArray[np.float64]


class SensorScan:
    """Displacement sensor and both thermistors as a `sim_devices.instruments.labjack_t7.Scan`.

    It gives what the sensors give one by one, from the same random numbers.

    Parameters
    ----------
    plant : HybridCantilever
        What they look at.
    displacement, base, tip
        The sensors; each thermistor takes two inputs.
    characteristics : sequence of Characteristic
        Their systematic errors, in that order.
    faults : sequence of FaultySensor
        Their faults, in that order.
    is_free : callable
        Whether nothing else stands between plant and sensors.
    """

    count = 5

    def __init__(
        self,
        plant: HybridCantilever,
        displacement: DisplacementSensor,
        base: Thermistor,
        tip: Thermistor,
        characteristics: Sequence[Characteristic],
        faults: Sequence[FaultySensor],
        is_free: Callable[[], bool],
    ) -> None:
        self._plant, self._plant_numbers = plant, plant.numbers
        self._base, self._tip = base, tip
        self._faults = faults
        self._is_free = is_free
        own = (
            (displacement.noise, displacement.resolution, displacement.reach, displacement.volts_per_metre),
            (base.noise, *base.circuit),
            (tip.noise, *tip.circuit),
        )
        numbers = [plant.parameters.ambient_temperature]
        for characteristic, of_sensor in zip(characteristics, own, strict=True):
            numbers += [*characteristic.numbers, *of_sensor]
        self._numbers = np.array(numbers)
        self._draws = displacement.draw, base.draw, tip.draw
        # Compiled when a laboratory opens, before a driver waits for an answer.
        kernels.scan(0.0, 0.0, plant.numbers, self._numbers, np.ones((self.count, 4)), 1.0, 1.0, *[0.0] * 8)

    def __call__(self, scales: Floats, draw: Callable[[], float]) -> tuple[float, ...] | None:
        """Return a reading of each input, V; None if a fault asks for single ones."""
        base, tip = self._base, self._tip
        first, second, third = self._faults
        if not (first.is_whole and second.is_whole and third.is_whole and self._is_free()):
            return None
        if base.open or base.shorted or tip.open or tip.shorted:
            return None
        draw_displacement, draw_base, draw_tip = self._draws
        fraction, elapsed = self._plant.moment()
        readings: tuple[float, ...] = kernels.scan(
            fraction,
            elapsed,
            self._plant_numbers,
            self._numbers,
            scales,
            base.excitation_volts,
            tip.excitation_volts,
            draw_displacement(),
            draw_base(),
            draw_tip(),
            draw(),
            draw(),
            draw(),
            draw(),
            draw(),
        )
        return readings
