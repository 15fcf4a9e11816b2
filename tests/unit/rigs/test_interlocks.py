"""The interlocks of the packaged rigs: none acts in a laboratory without a fault, each acts in time."""

import math

import pytest
from cases import cases

from bench.base import Display, VirtualClock
from bench.rig import InterlockWatch, Rig, load_rig, packaged_rigs

RIGS = sorted(name for name in packaged_rigs() if "hardware" not in name)
LOOKS = 5.0  # Hz


def displays(file):
    names = [name for lock in file.interlocks for name in (lock.signal, lock.minus) if name]
    return dict.fromkeys(
        [*names, *(f"{lock.setpoint}_setpoint" for lock in file.interlocks if lock.setpoint)], Display.of("1", 3)
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in ("vo2", "sma", "hybrid") else pytest.mark.seeds) for name in RIGS]
)
def test_none_acts_in_an_hour_without_a_fault(name):
    file = load_rig(name)
    clock = VirtualClock()
    rig = Rig(file, clock, seed=0)
    try:
        watch = InterlockWatch(file.interlocks, {signal.name: signal.display for signal in rig.signals})
        drive = file.roles["drive"]
        low, high = drive.range
        hours, period, minutes = 1.0, 2.0, 5.0
        step, looks = -1, 0
        while clock.now() < 3600.0 * hours:
            clock.sleep(period)
            assert watch.look(clock.now(), rig.glance()) == ()
            looks += 1
            if (at := math.floor(clock.now() / (60.0 * minutes))) != step:
                # To both ends at once, and in steps between them.
                step = at
                rig.actuators[drive.device].set((high, low, 0.5 * (low + high))[step % 3])
        assert looks > 1500
    finally:
        rig.close()


@cases("name", [*RIGS, "vo2-hardware", "sma-hardware", "hybrid-hardware"])
def test_each_limit_acts_within_a_period_and_its_seconds(name):
    file = load_rig(name)
    limits = [(lock, limit) for lock in file.interlocks for limit in (lock.low, lock.high) if math.isfinite(limit)]
    assert limits
    for lock, limit in limits:
        outside = limit + math.copysign(1e-3, 1.0 if limit == lock.high else -1.0)
        for crossing in (10.0, 10.03, 10.17):
            # On the limit it warns already.
            watch = InterlockWatch([lock.model_copy(update={"warn": 0.0})], displays(file))
            t = 0.0
            while not watch.look(t, {lock.signal: limit if t < crossing else outside}):
                t = min(t + 1.0 / LOOKS, watch.due)
            assert crossing + lock.seconds <= t <= crossing + 1.0 / LOOKS + lock.seconds + 1e-9
