"""What the role of a servo promises, of the emulated device itself and of the driver over the wire."""

import itertools
import math
import sys

import pytest
from cases import cases
from emulated_bench import Bench, OnABench, OnALine, OnAServo, OnATorque, Spoilt, over_the_wire, serial_port

from bench.base import DeviceConnectionError, DeviceError, DeviceRestartedError, VirtualClock, WallClock
from bench.contracts import (
    ActuatorLineLostContract,
    RestartedActuatorContract,
    SafeOverAFreshLineContract,
    ServoContract,
    SilentInstrumentContract,
    SpoiltAnswerContract,
)
from drivers.dynamixel import DynamixelMX28
from sim_devices.instruments.dynamixel import EmulatedMX28
from sim_devices.instruments.dynamixel_table import (
    ACCELERATION_UNIT,
    COUNT,
    VELOCITY_UNIT,
    ErrorNumber,
    HardwareError,
)
from sim_devices.instruments.emulated import RequestRefusedError
from sim_devices.wire.dynamixel2 import Dynamixel2Server
from sim_devices.world import World

WATCHDOG = 2.5
VELOCITY = 42 * VELOCITY_UNIT
ACCELERATION = 10 * ACCELERATION_UNIT
TURN = 2.0 * math.pi


class Pendulum:
    """Weighs on the shaft by at most `weight` N·m, and notes where it saw the shaft."""

    def __init__(self):
        self.weight = 0.0
        self.stop = math.inf
        self.time = 0.0
        self.servo = None
        self.seen = []

    def torque(self, angle):
        beyond = max(angle - self.stop, 0.0)
        return -self.weight * math.sin(angle) - 1e4 * beyond

    def advance(self, dt):
        self.time += dt
        if self.servo is not None:
            self.seen.append((self.time, self.servo.position))


class ServoBench(Bench):
    """A servo and what hangs on its shaft."""

    def where(self):
        """Return where the shaft is at the clock's present time, rad, without asking the device."""
        self.instrument.world.advance()
        return self.instrument.position


def connected(kind, stack, loaded=False):
    clock, plant = VirtualClock(), Pendulum()
    instrument = EmulatedMX28("servo", World(plant, clock), plant if loaded else None)
    plant.servo = instrument
    if kind == "emulated":
        for address, value in ((11, 4), (108, 10), (112, 42), (98, 125)):
            instrument.write_item(address, value)
        return ServoBench(clock=clock, device=instrument, instrument=instrument, plant=plant)
    server = Dynamixel2Server([instrument])
    port, requests = serial_port(stack, server, clock)

    def connect(kind=DynamixelMX28.connect, **changes):
        keys = {
            "port": port,
            "position_limits": (-4 * math.pi, 6 * math.pi),
            "profile_velocity": 1.0072,
            "profile_acceleration": 3.746,
            "watchdog": WATCHDOG,
        }
        return kind("servo", DynamixelMX28.Settings(**keys | changes), clock)

    device = connect()
    stack.callback(device.close)
    return ServoBench(
        clock=clock, device=device, instrument=instrument, plant=plant, connect=connect, requests=requests,
        port=port, server=server,
    )  # fmt: skip


@pytest.fixture
def loaded(kind, stack):
    return connected(kind, stack, loaded=True)


class OnAShaft(OnABench):
    @pytest.fixture
    def set_points(self):
        return 4.0, 9.0

    @pytest.fixture
    def effects(self, bench):
        return lambda: bench.where() - math.pi


class TestContract(OnAServo, OnAShaft, ServoContract):
    pass


class TestSilence(OnAShaft, SilentInstrumentContract):
    def test_a_motion_ends_with_the_error(self, bench):
        status = bench.device.set(9.0)
        bench.instrument.unplug()
        with pytest.raises(DeviceConnectionError, match="servo: "):
            status.wait()


@cases("goal", [3.5, 0.0, 2.5 * TURN, -1.5 * TURN])
def test_arrives_and_holds(kind, stack, goal):
    bench = connected(kind, stack)
    start = bench.clock.now()
    status = bench.device.set(goal)
    assert not status.update()
    assert bench.device.torque_enabled
    assert bench.device.setpoint == goal
    status.wait()
    assert status.success
    distance = abs(goal - math.pi)
    if distance * ACCELERATION >= VELOCITY**2:
        expected = distance / VELOCITY + VELOCITY / ACCELERATION
    else:
        expected = 2.0 * math.sqrt(distance / ACCELERATION)
    assert bench.clock.now() - start == pytest.approx(expected, abs=0.15)
    for _ in range(5):
        bench.clock.sleep(2.0)
        values = bench.device.glance()
        assert values["servo_position"] == pytest.approx(goal, abs=0.5 * COUNT + 1e-9)
        assert values["servo_velocity"] == 0.0
    assert bench.where() == pytest.approx(goal, abs=0.5 * COUNT + 1e-9)


def test_where_it_stands_already_it_has_arrived_at_once(bench):
    status = bench.device.set(math.pi)
    assert status.update()
    assert status.success


def test_new_goal_on_the_way_turns_round_without_a_jump(bench):
    first = bench.device.set(9.0)
    bench.clock.sleep(1.5)
    bench.device.set(2.0).wait()
    assert bench.device.measure()["servo_position"] == pytest.approx(2.0, abs=COUNT)
    with pytest.raises(DeviceError, match="replaced"):
        first.wait()
    steps = [b - a for (_, a), (_, b) in itertools.pairwise(bench.plant.seen)]
    assert max(map(abs, steps)) <= 0.0201 * VELOCITY


def test_no_jump_to_the_goal_of_before(bench):
    status = bench.device.set(9.0)
    bench.clock.sleep(1.0)
    bench.device.safe()
    with pytest.raises(DeviceError, match="torque was switched off"):
        status.wait()
    where = bench.where()
    bench.plant.seen.clear()
    bench.device.set(where - 0.5).wait()
    assert max(position for _, position in bench.plant.seen) <= where + COUNT


@cases(
    ("error", "text"),
    [
        (HardwareError.INPUT_VOLTAGE, r"0x01 \(input voltage"),
        (HardwareError.OVERHEATING, r"0x04 \(overheating"),
        (HardwareError.MOTOR_ENCODER, r"0x08 \(motor encoder"),
        (HardwareError.ELECTRICAL_SHOCK, r"0x10 \(electrical shock"),
        (HardwareError.OVERLOAD, r"0x20 \(overload"),
    ],
)
def test_every_call_tells_of_a_hardware_error_and_safe_succeeds(kind, stack, error, text):
    bench = connected(kind, stack)
    status = bench.device.set(9.0)
    bench.instrument.trip(error)
    for call in (bench.device.measure, bench.device.glance, bench.device.read, lambda: bench.device.set(5.0)):
        with pytest.raises(DeviceError, match=f"servo: hardware error {text}"):
            call()
    with pytest.raises(DeviceError, match=f"hardware error {text}"):
        status.wait()
    assert status.done
    assert not status.success
    # As delivered, an encoder or a voltage error leaves the torque on.
    assert bench.device.torque_enabled is (error in (HardwareError.INPUT_VOLTAGE, HardwareError.MOTOR_ENCODER))
    bench.device.safe()
    bench.device.safe()
    assert not bench.device.torque_enabled


def test_silence_of_the_host_stops_the_shaft_at_that_instant(bench):
    status = bench.device.set(15.0)
    bench.device.glance()
    last_request = bench.clock.now()
    bench.clock.sleep(3600.0)
    assert bench.where() == pytest.approx(math.pi + VELOCITY * WATCHDOG, abs=0.3)
    held = bench.where()
    seen = [instant for instant, position in bench.plant.seen if position != held]
    # The answer to the last request took some milliseconds of the wire.
    assert seen[-1] <= last_request + WATCHDOG
    assert seen[-1] == pytest.approx(last_request + WATCHDOG, abs=0.03)
    for call in (bench.device.measure, bench.device.glance, lambda: bench.device.set(5.0), status.wait):
        with pytest.raises(DeviceError, match="bus watchdog"):
            call()
    assert bench.device.torque_enabled
    bench.device.stop()
    bench.device.safe()
    assert not bench.device.torque_enabled
    bench.device.measure()
    bench.device.set(5.0).wait()


def test_load_is_seen_and_holds_the_shaft_off_its_goal(loaded):
    device = loaded.device
    loaded.plant.weight = 0.1
    device.set(0.5 * math.pi).wait()
    values = device.measure()
    # It pushes up by 0.1 N·m of the 2.5 that it has, and stands 133 counts · 0.04 below.
    assert values["servo_load"] == pytest.approx(0.04, abs=1e-3)
    assert values["servo_position"] == pytest.approx(0.5 * math.pi - 133 * 0.04 * COUNT, abs=COUNT)


def test_shaft_that_is_blocked_ends_in_an_overload(loaded):
    loaded.plant.stop = 4.0
    status = loaded.device.set(6.0)
    with pytest.raises(DeviceError, match="overload"):
        status.wait()
    assert loaded.where() == pytest.approx(4.0, abs=0.01)
    assert not loaded.device.torque_enabled
    loaded.device.safe()


def test_torque_that_goes_off_lets_the_weight_fall(loaded):
    loaded.plant.weight = 0.5
    loaded.device.set(0.5 * math.pi)
    loaded.clock.sleep(2.4)
    loaded.device.safe()
    loaded.clock.sleep(5.0)
    # Down to where the gear holds it.
    assert loaded.where() == pytest.approx(math.asin(0.1 / 0.5), abs=1e-3)


# What only a wire can do.


class OnAServoLine(OnATorque, OnALine, OnAShaft):
    @pytest.fixture
    def another_server(self, bench):
        return Dynamixel2Server([EmulatedMX28("another", World(Pendulum(), bench.clock))])

    @pytest.fixture
    def truth(self, bench):
        return lambda: {"servo_position": bench.where()}

    @pytest.fixture
    def tolerance(self):
        return 0.51 * COUNT


@over_the_wire
class TestRestart(OnAServoLine, RestartedActuatorContract):
    pass


@over_the_wire
class TestLineLost(OnAServoLine, ActuatorLineLostContract):
    pass


@over_the_wire
class TestSafeOverAFreshLine(OnAServoLine, SafeOverAFreshLineContract):
    pass


@over_the_wire
def test_position_one_turn_off_is_never_reported(bench):
    bench.device.set(math.pi + 2 * TURN).wait()
    bench.instrument.power_cycle()
    bench.clock.sleep(0.5)
    for call in (bench.device.measure, bench.device.glance, lambda: bench.device.set(8.0)):
        with pytest.raises(DeviceRestartedError, match=r"servo: the servo has restarted: .*zero_counts"):
            call()
    assert bench.where() == pytest.approx(math.pi + 2 * TURN, abs=COUNT)


@over_the_wire
def test_motion_during_which_it_restarts_does_not_arrive_one_turn_off(bench):
    status = bench.device.set(1.0)
    bench.clock.sleep(1.0)
    bench.device.set(1.0 + 2 * TURN)
    bench.clock.sleep(8.0)
    bench.instrument.power_cycle()
    bench.clock.sleep(0.5)
    with pytest.raises(DeviceRestartedError):
        bench.device.glance()
    with pytest.raises(DeviceError):
        status.wait()


@over_the_wire
@cases(
    ("address", "value", "text"),
    [(116, 100, "goal was changed to .* by another host"), (64, 0, "torque was switched")],
)
def test_what_another_host_changed_is_an_error_of_the_next_reading(bench, address, value, text):
    bench.device.safe()
    bench.device.set(5.0).wait()
    bench.instrument.write_item(address, value)
    with pytest.raises(DeviceError, match=f"servo: its {text}"):
        bench.device.glance()


@over_the_wire
class TestSpoiltAnswer(Spoilt, OnAShaft, SpoiltAnswerContract):
    pass


@over_the_wire
def test_nothing_is_worn_out(bench):
    assert bench.instrument.eeprom_writes == 2  # operating mode and return delay, at the first connection
    for target in range(-5, 5):
        bench.device.set(float(target))
    bench.device.safe()
    bench.connect().close()
    bench.connect(direction=-1, zero_counts=100).close()
    bench.device.reboot()
    assert bench.instrument.eeprom_writes == 2


@over_the_wire
def test_hardware_error_is_told_and_cleared_by_a_reboot(bench):
    bench.device.set(5.0).wait()
    bench.instrument.trip(HardwareError.OVERLOAD | HardwareError.OVERHEATING)
    with pytest.raises(DeviceError, match=r"0x24 \(overheating, overload; 12\.0 V, 25 °C\): .*off and on"):
        bench.device.measure()
    with pytest.raises(RequestRefusedError) as refused:
        bench.instrument.write_item(64, 1)
    assert refused.value.reason is ErrorNumber.RESULT_FAIL
    bench.device.reboot()
    assert math.isnan(bench.device.setpoint)
    assert not bench.device.torque_enabled
    bench.device.set(4.0).wait()


@over_the_wire
def test_cause_that_is_still_there_survives_the_reboot(bench):
    bench.instrument.supply(9.0)
    with pytest.raises(DeviceError, match=r"input voltage; 9\.0 V"):
        bench.device.measure()
    with pytest.raises(DeviceError, match=r"input voltage; 9\.0 V"):
        bench.device.reboot()
    bench.instrument.supply(12.0)
    bench.device.reboot()
    bench.device.measure()


@over_the_wire
def test_error_of_before_is_refused_and_recovered(bench):
    bench.instrument.trip(HardwareError.ELECTRICAL_SHOCK)
    bench.device.close()
    with pytest.raises(DeviceError, match=r"electrical shock.*off and on"):
        bench.connect()
    device = bench.connect(DynamixelMX28.recover)
    device.set(5.0).wait()
    device.safe()
    device.close()


@over_the_wire
def test_host_that_died_leaves_a_servo_that_the_next_one_takes_over(bench):
    bench.device.set(15.0)
    bench.device.close()
    bench.clock.sleep(60.0)
    assert bench.instrument.read_item(98) == -1
    device = bench.connect()
    assert not device.torque_enabled
    assert bench.instrument.read_item(98) == 0
    device.set(5.0).wait()
    device.close()


@over_the_wire
def test_watchdog_is_idle_while_the_torque_is_off(bench):
    bench.clock.sleep(100.0)
    bench.device.measure()
    bench.device.set(5.0).wait()
    bench.device.safe()
    bench.clock.sleep(100.0)
    bench.device.measure()
    bench.device.set(4.0).wait()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pty")
def test_over_a_pty_in_wall_clock_time(pseudo_terminal):
    clock = WallClock()
    instrument = EmulatedMX28("servo", World(Pendulum(), clock))
    with pseudo_terminal(Dynamixel2Server([instrument])) as path:
        settings = DynamixelMX28.Settings(
            port=path, timeout=10.0, position_limits=(0.0, 6.0), profile_velocity=5.0, watchdog=0,
            arrival_timeout=60.0,
        )  # fmt: skip
        device = DynamixelMX28.connect("servo", settings, clock)
        device.set(3.3).wait()
        assert device.measure()["servo_position"] == pytest.approx(3.3, abs=COUNT)
        device.close()
        device = DynamixelMX28.connect("servo", settings.model_copy(update={"watchdog": 0.2}), clock)

        def fall_silent():
            device.set(3.4)
            clock.sleep(0.3)
            device.measure()

        # On a busy machine the watchdog expires already while the set-point is sent.
        with pytest.raises(DeviceError, match="bus watchdog"):
            fall_silent()
        device.safe()
        assert not device.torque_enabled
        device.close()
