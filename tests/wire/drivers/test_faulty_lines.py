"""Readings and set-points over lines that lose, damage, double and delay answers: none is ever a wrong one.

The truth is that of the emulated instrument, which is another one at each call.
"""

import math
import random
from collections import Counter
from contextlib import contextmanager

import numpy as np
import pytest
from cases import cases
from faulty_line import KINDS, FaultyLine

from bench.base import DeviceError, VirtualClock
from drivers.dynamixel import DynamixelMX28
from drivers.roboteq import RoboteqSupply
from sim_devices.instruments.dynamixel import EmulatedMX28
from sim_devices.instruments.dynamixel_table import COUNT
from sim_devices.instruments.roboteq import EmulatedRoboteq
from sim_devices.protocol_emulated import register, unregister
from sim_devices.wire.canopen_slcan import CanopenSlcanServer
from sim_devices.wire.dynamixel2 import Dynamixel2Server
from sim_devices.world import World

CALLS = 300
TIMEOUT = 0.1
LATEST = 2.8 * TIMEOUT


def damaged(answer, rng):
    """Return the answer with one character that is another one, a digit for a digit as a rule."""
    place = rng.integers(len(answer))
    other = rng.choice([*b"0123456789ABCDEF"]) if rng.random() < 0.8 else rng.integers(256)
    return answer[:place] + bytes((other,)) + answer[place + 1 :]


class Load:
    """A resistor that is heated, and nothing else."""

    resistance = 5.0
    voltage = 0.0

    def apply(self, voltage):
        self.voltage = voltage

    @property
    def current(self):
        return self.voltage / self.resistance

    def advance(self, dt):
        pass


@contextmanager
def on_a_faulty_line(server, clock, faults, seed):
    rng = np.random.default_rng(seed)
    line = FaultyLine(server, clock, rng, kinds=faults, share=0.0, latest=LATEST, overtaking=True, corrupted=damaged)
    address = register("faulty", line, clock)
    try:
        yield line, address
    finally:
        unregister(address)


def count_supply(faults, share, seed=0, calls=CALLS):
    """Return how many calls of a supply went well, failed, and were wrong, and the requests that were repeated."""
    clock, load, rng = VirtualClock(), Load(), random.Random(seed)
    instrument = EmulatedRoboteq("supply", World(load, clock), load, watchdog=0.0, amps_limit=100.0)
    counts = Counter()
    with on_a_faulty_line(CanopenSlcanServer(instrument), clock, faults, seed) as (line, port):
        settings = RoboteqSupply.Settings(
            port=port, output="average", voltage_limits=(0, 12), watchdog=0, timeout=TIMEOUT, heartbeat=60
        )
        supply = RoboteqSupply.connect("supply", settings, clock)
        supply.set(6.0).wait()
        line.share = share
        for _ in range(calls):
            clock.sleep(rng.uniform(0.0, 0.5))
            instrument.battery_voltage = 24.0 + rng.randrange(-20, 20) / 10
            load.resistance = rng.uniform(1.0, 10.0)
            power = instrument.power
            expected = {
                "supply_voltage": power * round(10 * instrument.battery_voltage) / 1e4,
                "supply_current": round(10 * load.current) / 10,
            }
            goal = rng.uniform(0.5, 12.0) if rng.random() < 0.2 else None
            try:
                if goal is None:
                    right = supply.glance() == pytest.approx(expected, abs=1e-9)
                else:
                    supply.set(goal)
                    right = abs(load.voltage - goal) < 0.02
            except DeviceError:
                counts["failed"] += 1
            else:
                counts["right" if right else "wrong"] += 1
                assert load.voltage <= 12.3
        line.share = 0.0
        clock.sleep(1.0)
        counts["repeats"], counts["spoilt"] = supply.repeats, line.spoilt
        supply.safe()
        assert load.voltage == 0.0
        supply.set(3.0).wait()
        assert supply.glance()["supply_voltage"] == pytest.approx(load.voltage, abs=1e-9)
        supply.close()
    return counts


def count_servo(faults, share, seed=0, calls=CALLS):
    """Return how many calls of a servo went well, failed, and were wrong, and the requests that were repeated."""
    clock, rng = VirtualClock(), random.Random(seed)
    instrument = EmulatedMX28("servo", World(Load(), clock))
    counts = Counter()
    with on_a_faulty_line(Dynamixel2Server([instrument]), clock, faults, seed) as (line, port):
        settings = DynamixelMX28.Settings(
            port=port, position_limits=(-9.0, 9.0), watchdog=0, timeout=TIMEOUT, profile_velocity=9.0,
            profile_acceleration=12_000.0,
        )  # fmt: skip
        servo = DynamixelMX28.connect("servo", settings, clock)
        servo.set(1.0).wait()
        line.share = share
        for _ in range(calls):
            clock.sleep(rng.uniform(0.0, 0.5))
            instrument.write_item(116, rng.randrange(-5000, 5000))
            # Each motion is over by then.
            clock.sleep(4.0)
            servo._goal = instrument.read_item(116)
            goal = rng.uniform(-9.0, 9.0) if rng.random() < 0.2 else None
            try:
                if goal is None:
                    right = servo.glance()["servo_position"] == pytest.approx(instrument.position, abs=COUNT)
                else:
                    servo.set(goal)
                    right = abs(instrument.read_item(116) * COUNT - goal) < COUNT
            except DeviceError:
                counts["failed"] += 1
            else:
                counts["right" if right else "wrong"] += 1
        line.share = 0.0
        clock.sleep(2.0)
        counts["repeats"], counts["spoilt"] = servo.repeats, line.spoilt
        servo.safe()
        assert instrument.read_item(64) == 0
        servo.set(2.0).wait()
        assert servo.glance()["servo_position"] == pytest.approx(2.0, abs=COUNT)
        servo.close()
    return counts


@cases("faults", [*((kind,) for kind in KINDS), KINDS])
@cases("count", [count_supply, count_servo])
def test_no_answer_is_taken_for_what_it_is_not(count, faults):
    counts = count(faults, 0.35)
    assert counts["wrong"] == 0
    assert counts["right"] > CALLS / 4
    assert counts["repeats"] > 0 or faults == ("double",)


def test_a_line_without_faults_repeats_nothing():
    for count in (count_supply, count_servo):
        counts = count(("drop",), 0.0, calls=200)
        assert counts == Counter(right=200)
    assert math.isfinite(sum(counts.values()))
