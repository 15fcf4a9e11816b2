"""The hybrid plant beside scipy's general-purpose integrator on the same equations. Prints, asserts no time."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bench.base import Stopwatch
from sim_devices.plants import _hybrid_kernels as kernels
from sim_devices.plants.hybrid import HybridCantilever
from sim_devices.plants.hybrid_parameters import HybridParameters

pytestmark = pytest.mark.benchmark

QUIET = HybridParameters(ambient_sd=0.0)
STEP = 50e-6


def make():
    return HybridCantilever(QUIET, np.random.default_rng(1))


def thermal_rates(plant, rise, current):
    """The thermal chain's rates, from the plant's own capacities and conductances."""
    nodes, p = plant._nodes, plant.parameters
    flow = nodes[kernels.LINK, :-1] * np.diff(rise)
    heat = -(nodes[kernels.AIR] + nodes[kernels.EXCESS] * np.abs(rise) ** 0.25) * rise
    heat[:-1] += flow
    heat[1:] -= flow
    joule = 0.5 * p.resistance * current**2
    heat[kernels.BACK] += joule - p.seebeck * current * (295.15 + rise[kernels.BACK])
    heat[kernels.FACE] += joule + p.seebeck * current * (295.15 + rise[kernels.FACE])
    return heat / nodes[kernels.CAPACITY]


def fast_rates(state, drive):
    """D(s)/D(0) in controllable form and the three creep lags."""
    p = QUIET
    x, creep = state[:3], state[3:]
    asked = drive + creep.sum()
    a2, a1, a0 = np.polymul([1.0, p.real_pole], [1.0, p.resonance_decay, p.resonance_square])[1:]
    times = np.array(p.creep_times)
    return np.concatenate(
        [[x[1], x[2], a0 * asked - a0 * x[0] - a1 * x[1] - a2 * x[2]], (0.012 * drive - creep) / times]
    )


def median_ratio(ours, theirs):
    return float(np.median(theirs) / np.median(ours))


@pytest.mark.parametrize(("interval", "count"), [(600.0, 6), (0.02, 500)])
def test_temperature(interval, count, capsys):
    """An hour with few currents, and ten seconds of a loop that gives a new one every 20 ms."""
    currents = [0.15 * math.sin(2.0 * n) for n in range(count)]

    def by_plant():
        plant = make()
        for current in currents:
            plant.drive(current)
            plant.advance(interval)
        return plant._rise

    def by_scipy(tolerance):
        plant, rise = make(), np.zeros(kernels.NODES)
        for current in currents:
            rise = solve_ivp(
                lambda _, y, current=current: thermal_rates(plant, y, current),
                (0.0, interval),
                rise,
                method="LSODA",
                rtol=tolerance,
                atol=tolerance,
            ).y[:, -1]
        return rise

    exact = by_scipy(1e-11)
    by_plant()
    ours, theirs = [], []
    for _ in range(5):
        watch = Stopwatch()
        mine = by_plant()
        ours.append(watch.seconds())
        watch = Stopwatch()
        stock = by_scipy(1e-6)
        theirs.append(watch.seconds())
    steps = round(count * interval / QUIET.step)
    with capsys.disabled():
        print(
            f"\n{count} currents of {interval:g} s each: plant {np.median(ours) * 1e3:.1f} ms for {steps} grid steps "
            f"with noise (error {np.abs(mine - exact).max():.0e} K), LSODA at 1e-6 {np.median(theirs) * 1e3:.1f} ms "
            f"without (error {np.abs(stock - exact).max():.0e} K), ratio {median_ratio(ours, theirs):.1f}"
        )
    assert np.abs(mine - exact).max() < 1e-3


def test_a_loop_at_20_khz(capsys):
    """Every sample a new voltage: the integrator has to start anew with the whole plant."""
    count, fewer = 20_000, 200
    voltages = [5.0 * math.sin(2e-3 * n) for n in range(count)]

    def by_plant(voltages):
        plant, deflection = make(), []
        for voltage in voltages:
            plant.apply(voltage)
            plant.advance(STEP)
            deflection.append(plant.deflection)
        return deflection

    def by_scipy(voltages):
        plant, state, deflection = make(), np.zeros(kernels.NODES + 6), []
        p = QUIET
        numerator = np.array([p.numerator_constant, p.numerator_linear, 1.0]) / p.numerator_constant
        for voltage in voltages:
            # The hysteresis is rate-independent and moves before time does.
            plant.apply(voltage)
            drive = plant._fast[kernels.DRIVE] * 1e6
            state = solve_ivp(
                lambda _, y, drive=drive: np.concatenate(
                    [thermal_rates(plant, y[: kernels.NODES], 0.0), fast_rates(y[kernels.NODES :], drive)]
                ),
                (0.0, STEP),
                state,
                rtol=1e-6,
                atol=1e-9,
            ).y[:, -1]
            deflection.append(1e-6 * (numerator @ state[kernels.NODES : kernels.NODES + 3]))
        return deflection

    by_plant(voltages[:10])
    ours, theirs = [], []
    for _ in range(3):
        watch = Stopwatch()
        mine = by_plant(voltages)
        ours.append(watch.seconds() / count)
        watch = Stopwatch()
        stock = by_scipy(voltages[:fewer])
        theirs.append(watch.seconds() / fewer)
    error = np.abs(np.array(stock) - mine[:fewer]).max()
    with capsys.disabled():
        print(
            f"\n20 kHz loop, per sample: plant {np.median(ours) * 1e6:.1f} µs, RK45 {np.median(theirs) * 1e6:.0f} µs"
            f", ratio {median_ratio(ours, theirs):.0f} (difference {error * 1e9:.1e} nm)"
        )
    assert error < 1e-12
