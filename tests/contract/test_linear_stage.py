"""What the role of a linear stage promises, of the emulated drum itself and of the driver over the wire."""

import math
from dataclasses import dataclass

import pytest
from cases import cases
from emulated_bench import Bench, OnABench, OnALine, OnAServo, OnATorque, over_the_wire, serial_port

from bench.base import VirtualClock
from bench.contracts import ActuatorLineLostContract, LinearStageContract, SilentInstrumentContract
from drivers.dynamixel import DynamixelDrum
from sim_devices.instruments.dynamixel import EmulatedMX28
from sim_devices.instruments.dynamixel_drum import EmulatedDrum
from sim_devices.instruments.dynamixel_table import COUNT
from sim_devices.wire.dynamixel2 import Dynamixel2Server
from sim_devices.world import World

WATCHDOG = 2.5
RADIUS = 0.012
RESOLUTION = COUNT * RADIUS
ZERO = 2048
TURN = 2.0 * math.pi * RADIUS


class Wall:
    """Nothing hangs on the shaft until it turns to an angle below `stop`, where it is blocked."""

    stop = -math.inf

    def torque(self, angle):
        return 1e4 * max(self.stop - angle, 0.0)

    def advance(self, dt):
        pass


@dataclass(kw_only=True)
class StageBench(Bench):
    """A stage on a servo; its position grows against the counts, from half a turn."""

    drum: EmulatedDrum

    def where(self):
        """Return where the wire's end is at the clock's present time, m, without asking the device."""
        self.instrument.world.advance()
        return (math.pi - self.instrument.position) * RADIUS


def connected(kind, stack):
    clock, plant = VirtualClock(), Wall()
    servo = EmulatedMX28("stage", World(plant, clock), plant)
    drum = EmulatedDrum(servo, RADIUS, zero_counts=ZERO, direction=-1)
    if kind == "emulated":
        for address, value in ((11, 4), (108, 10), (112, 42), (98, 125)):
            servo.write_item(address, value)
        return StageBench(clock=clock, device=drum, instrument=servo, plant=plant, drum=drum)
    server = Dynamixel2Server([servo])
    port, requests = serial_port(stack, server, clock)

    def connect(kind=DynamixelDrum.connect):
        settings = DynamixelDrum.Settings(
            port=port,
            drum_radius=RADIUS,
            stage_limits=(-0.2, 0.2),
            zero_counts=ZERO,
            direction=-1,
            profile_velocity=1.0072,
            profile_acceleration=3.746,
            watchdog=WATCHDOG,
        )
        return kind("stage", settings, clock)

    device = connect()
    stack.callback(device.close)
    return StageBench(
        clock=clock, device=device, instrument=servo, plant=plant, drum=drum, connect=connect, requests=requests,
        port=port, server=server,
    )  # fmt: skip


class OnADrum(OnABench):
    @pytest.fixture
    def set_points(self):
        return 0.01, 0.1

    @pytest.fixture
    def effects(self, bench):
        return lambda: bench.where()


class TestContract(OnAServo, OnADrum, LinearStageContract):
    @pytest.fixture
    def tolerance(self):
        return 0.02 * RADIUS


class TestSilence(OnADrum, SilentInstrumentContract):
    pass


# What only a wire can do.


class OnADrumLine(OnATorque, OnALine, OnADrum):
    @pytest.fixture
    def another_server(self, bench):
        plant = Wall()
        return Dynamixel2Server([EmulatedMX28("another", World(plant, bench.clock), plant)])

    @pytest.fixture
    def truth(self, bench):
        return lambda: {"stage_position": bench.where()}

    @pytest.fixture
    def tolerance(self):
        return 0.51 * RESOLUTION


@over_the_wire
class TestLineLost(OnADrumLine, ActuatorLineLostContract):
    pass


@over_the_wire
def test_shaft_that_was_turned_a_whole_turn_is_off_by_a_circumference_after_a_reboot(bench):
    bench.device.set(TURN).wait()
    bench.device.reboot()
    assert bench.device.measure()["stage_position"] == pytest.approx(0.0, abs=RESOLUTION)
    assert bench.drum.position == pytest.approx(TURN, abs=RESOLUTION)


@cases(("radius", "direction"), [(0.0, 1), (-1.0, 1), (math.nan, 1), (math.inf, 1), (0.01, 0)])
def test_drum_that_makes_no_sense(radius, direction):
    plant = Wall()
    servo = EmulatedMX28("stage", World(plant, VirtualClock()))
    with pytest.raises(ValueError, match="expected"):
        EmulatedDrum(servo, radius, direction=direction)


@cases("radius", [0.001, 0.007, 0.012, 0.033, 0.1])
@cases("zero_counts", [0, 1, 1000, -12345])
@cases("direction", [1, -1])
def test_rounding_keeps_no_limit_of_the_drum_from_being_reached(radius, zero_counts, direction):
    servo = EmulatedMX28("stage", World(Wall(), VirtualClock()))
    drum = EmulatedDrum(servo, radius, zero_counts=zero_counts, direction=direction)
    for value in (drum.limits.low, drum.limits.high):
        drum.set(value)
        assert drum.setpoint == value
    assert servo.read_item(116) == (4095 if direction > 0 else 0)
