"""Compiled path from the plant to the readings of the T7's first inputs."""

from __future__ import annotations

from bench.base import Floats, Table, inner, kernel
from sim_devices.instruments._labjack_t7_kernels import converted
from sim_devices.plants._hybrid_kernels import FACE, INCREMENT, NODES, deflection
from sim_devices.transducers._imperfect_kernels import shown
from sim_devices.transducers._voltage_kernels import displacement_volts, divider_volts

CHARACTERISTIC_SIZE = 8
DISPLACEMENT_SIZE = 4
THERMISTOR_SIZE = 5
_BASE = 1 + CHARACTERISTIC_SIZE + DISPLACEMENT_SIZE
_TIP = _BASE + CHARACTERISTIC_SIZE + THERMISTOR_SIZE
SIZE = _TIP + CHARACTERISTIC_SIZE + THERMISTOR_SIZE
"""Numbers that `scan` takes: mean temperature of the room (°C); what `shown` takes of the displacement, its noise,
and what `displacement_volts` takes; then of either thermistor what `shown` takes, its noise, and what `divider_volts`
takes."""


@inner
def _shown(quantity: float, numbers: Floats, at: int) -> float:
    n = numbers[at : at + CHARACTERISTIC_SIZE]
    value: float = shown(quantity, n[0], n[1], n[2], n[3], n[4], n[5], n[6], n[7])
    return value


@inner
def _divided(
    node: int, fraction: float, excitation: float, normal: float, plant: Floats, n: Floats, at: int
) -> float:
    celsius = _shown(n[0] + (plant[node] + fraction * plant[INCREMENT + node]), n, at)
    at += CHARACTERISTIC_SIZE
    volts: float = divider_volts(celsius + n[at] * normal, excitation, n[at + 1], n[at + 2], n[at + 3], n[at + 4])
    return volts


@kernel
def scan(
    fraction: float,
    elapsed: float,
    plant: Floats,
    n: Floats,
    scales: Table,
    base_excitation: float,
    tip_excitation: float,
    displacement_normal: float,
    base_normal: float,
    tip_normal: float,
    first: float,
    second: float,
    third: float,
    fourth: float,
    fifth: float,
) -> tuple[float, float, float, float, float]:
    """Convert displacement, divider and excitation of the base, and divider and excitation of the tip.

    Parameters
    ----------
    fraction, elapsed : float
        Moment of the plant; see `sim_devices.plants.hybrid.HybridCantilever.moment`.
    plant, n : numpy.ndarray
        Numbers of the plant, and of the sensors (`SIZE`).
    scales : numpy.ndarray, shape (14, 4)
        Of the T7's inputs.
    base_excitation, tip_excitation : float
        Voltages at the dividers, V.
    displacement_normal, base_normal, tip_normal, first, second, third, fourth, fifth : float
        Numbers of the standard normal distribution, of the sensors and of the conversions.

    Returns
    -------
    tuple of float
        Readings, V.
    """
    at = 1 + CHARACTERISTIC_SIZE
    seen = _shown(deflection(fraction, elapsed, plant), n, 1) + n[at] * displacement_normal
    return (
        converted(displacement_volts(seen, n[at + 1], n[at + 2], n[at + 3]), first, scales[0]),
        converted(_divided(FACE, fraction, base_excitation, base_normal, plant, n, _BASE), second, scales[1]),
        converted(base_excitation, third, scales[2]),
        converted(_divided(NODES - 1, fraction, tip_excitation, tip_normal, plant, n, _TIP), fourth, scales[3]),
        converted(tip_excitation, fifth, scales[4]),
    )
