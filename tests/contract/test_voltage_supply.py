"""What the role of a voltage supply promises, of the emulated devices themselves and of the drivers over the wire."""

import math
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass

import numpy as np
import pytest
from cases import cases
from emulated_bench import Bench, OnABench, OnALine, serial_port, tcp_port
from faulty_line import halved, lost, spoil_next_answer
from hypothesis import given, strategies as st

from bench.base import DeviceError, VirtualClock
from bench.contracts import (
    ActuatorLineLostContract,
    RestartedActuatorContract,
    SafeOverAFreshLineContract,
    SilentInstrumentContract,
    VoltageSupplyContract,
    WatchdogContract,
)
from drivers.labjack_t7 import T7HighVoltageSupply
from drivers.roboteq import RoboteqSupply
from sim_devices.instruments.labjack_t7 import TDAC_STEP, EmulatedT7
from sim_devices.instruments.roboteq import EmulatedRoboteq
from sim_devices.instruments.roboteq_objects import ChannelFlag, Fault
from sim_devices.plants import _voltage_course_kernels as course_kernels
from sim_devices.transducers.piezo_amplifier import PiezoAmplifier
from sim_devices.wire import WireServer
from sim_devices.wire.canopen_slcan import CanopenSlcanServer
from sim_devices.world import World

WATCHDOG = 1
RESISTANCE = 5.0
GAIN = 4.0


class Resistor:
    """A load that notes when which voltage was applied to it."""

    def __init__(self):
        self.world = None
        self.voltage = 0.0
        self.applied = []
        self.course = np.zeros(course_kernels.SIZE)
        self.led_at = 0.0

    def apply(self, voltage):
        self.voltage = voltage
        self.applied.append((self.world.time, voltage))

    def lead(self, start, target, steps, time_constant):
        self.course[:] = start, target, steps, 0, time_constant
        self.led_at = self.world.time
        self.note(self.led_at, course_kernels.within(self.voltage, start, target))

    def note(self, instant, voltage):
        if voltage != self.voltage:
            self.voltage = voltage
            self.applied.append((instant, voltage))

    @property
    def current(self):
        return self.voltage / RESISTANCE

    def advance(self, dt):
        end = self.world.time + dt
        while (instant := self.led_at + course_kernels.next_instant(self.course)) <= end:
            self.note(instant, course_kernels.take_step(self.voltage, self.course))


class LosingServer(WireServer):
    """A wire server that can lose a command."""

    def __init__(self, server):
        self.server = server
        self.lose_next = b""

    def receive(self, data):
        if self.lose_next and self.lose_next in data:
            self.lose_next = b""
            return b"z\r"
        return self.server.receive(data)

    def unsolicited(self):
        return self.server.unsolicited()

    def next_unsolicited(self):
        return self.server.next_unsolicited()


class RecordingT7(EmulatedT7):
    """A T7 that keeps what was written to it."""

    def write_registers(self, address: int, values: list[int]) -> None:
        self.requests.append((address, values))
        super().write_registers(address, values)


@dataclass(frozen=True)
class Facts:
    """What differs between the devices.

    `driven_within` and `measured_within` are how close the load comes to a set-point, and a reading to the load.
    """

    identity: str
    shown_limits: str
    voltages: tuple[float, ...]
    driven_within: Callable[[float], float]
    measured_within: float
    current_within: float
    settling: float = 0.0


@dataclass(kw_only=True)
class SupplyBench(Bench):
    """A supply, and the resistor that it heats."""

    facts: Facts
    amplifier: PiezoAmplifier | None = None

    def tick(self, seconds, step=0.5):
        for _ in range(round(seconds / step)):
            self.clock.sleep(step)
            self.device.glance()

    def settle(self):
        self.clock.sleep(self.facts.settling)
        self.instrument.world.advance()

    def at_zero(self):
        """Whether the device measures nothing."""
        values = self.device.measure()
        assert list(values) == ["supply_voltage", "supply_current"]
        voltage, current = values.values()
        return abs(voltage) <= self.facts.measured_within and abs(current) <= self.facts.current_within


def falls_to_zero(volts):
    """Whether voltages only fall, and end at zero if there are any."""
    return volts == sorted(volts, reverse=True) and volts[-1:] in ([], [0.0])


PWM = ["emulated average", "emulated rms", "driver average", "driver rms"]
LINEAR = ["T7 driver dc"]


@pytest.fixture(params=[*PWM, *LINEAR])
def kind(request):
    return request.param


@pytest.fixture
def output(kind):
    return kind.split()[-1]


@pytest.fixture
def bench(kind, stack):
    return high_voltage(stack) if kind in LINEAR else switching("driver" in kind, kind.split()[-1], stack)


def switching(driver, output, stack):
    """A Roboteq and the resistor that it heats."""
    clock, load = VirtualClock(), Resistor()
    world = load.world = World(load, clock)
    instrument = EmulatedRoboteq("supply", world, load, output=output, voltage_limits=(0.0, 12.0), watchdog=WATCHDOG)
    facts = Facts(
        identity="Roboteq SDC2160, serial number unknown, firmware v2.0 11/20/2019",
        shown_limits="0 to 12 V",
        voltages=(1.0, 3.7, 6.0, 11.99, 12.0),
        driven_within=lambda volts: resolution(volts, output),
        measured_within=1e-9,
        current_within=0.0501,
    )
    if not driver:
        return SupplyBench(clock=clock, device=instrument, instrument=instrument, plant=load, facts=facts)
    server = LosingServer(CanopenSlcanServer(instrument))
    port, requests = serial_port(stack, server, clock)
    settings = RoboteqSupply.Settings(port=port, output=output, voltage_limits=(0.0, 12.0), watchdog=WATCHDOG)

    def connect(kind=RoboteqSupply.connect):
        return kind("supply", settings, clock)

    device = connect()
    stack.callback(device.close)
    return SupplyBench(
        clock=clock, device=device, instrument=instrument, plant=load, facts=facts,
        connect=connect, requests=requests, port=port, server=server,
    )  # fmt: skip


def high_voltage(stack):
    """A T7 and the amplifier behind it; its load draws a current only while the voltage changes."""
    clock, load = VirtualClock(), Resistor()
    world = load.world = World(load, clock)
    streams = np.random.default_rng(6).spawn(2)
    amplifier = PiezoAmplifier(world, load, gain=GAIN, scale_error=0.0, rng=streams[0])
    inputs = {0: amplifier.voltage_monitor, 1: amplifier.current_monitor, 2: amplifier.status}
    t7 = RecordingT7(world, inputs, rng=streams[1])
    t7.requests = []
    t7.add_follower(lambda: amplifier.drive(t7.tdac_volts(0), t7.dio_level(5, pulled_down=True)))
    facts = Facts(
        identity="LabJack T7, serial number 470012345, firmware 1.0300",
        shown_limits="-40 to 40 V",
        voltages=(-40.0, -0.01, 1.0, 3.7, 6.0, 39.99, 40.0),
        # Half a step of the set-point; five sigma of a reading, of 4 mV by the monitor and 3 mV by the converter.
        driven_within=lambda _: GAIN * TDAC_STEP / 2 + 1e-6,
        measured_within=25e-3,
        current_within=12e-6,
        settling=0.01,
    )
    said = {"line": 5, "gain": GAIN, "watchdog": WATCHDOG}
    settings = T7HighVoltageSupply.Settings(port=tcp_port(stack, t7, clock), **said)
    device = T7HighVoltageSupply.connect("supply", settings, clock)
    stack.callback(device.close)
    return SupplyBench(
        clock=clock, device=device, instrument=t7, plant=load, facts=facts, requests=t7.requests, amplifier=amplifier
    )


pwm = pytest.mark.parametrize("kind", PWM, indirect=True)
linear = pytest.mark.parametrize("kind", LINEAR, indirect=True)
over_the_wire = pytest.mark.parametrize("kind", ["driver average"], indirect=True)


def resolution(volts, output):
    """Return half a step of the command, and half a digit of the battery voltage, at a voltage."""
    slope = 24e-3 if output == "average" else 24e-3 * 24.0 / (2.0 * volts)
    return 0.5 * slope + 0.003 * volts


class TestContract(OnABench, VoltageSupplyContract):
    @pytest.fixture
    def identity(self, bench):
        return bench.facts.identity

    @pytest.fixture
    def allowed(self, bench):
        return f"is outside of {bench.facts.shown_limits}"

    @pytest.fixture
    def effects(self, bench):
        return lambda: [*bench.plant.applied]

    @pytest.fixture
    def tolerance(self, bench, set_points):
        return max(map(bench.facts.driven_within, set_points)) + bench.facts.measured_within

    def test_output_is_that_of_its_settings(self, device, output):
        assert device.output == output


@pwm
class TestSilence(OnABench, SilentInstrumentContract):
    @pytest.fixture
    def set_points(self):
        return 6.0, 5.0


def test_voltage_is_applied_and_measured(bench):
    for volts in bench.facts.voltages:
        status = bench.device.set(volts)
        status.wait()
        assert status.success
        assert bench.device.setpoint == volts
        bench.settle()
        assert bench.plant.voltage == pytest.approx(volts, abs=bench.facts.driven_within(volts))
        values = bench.device.measure()
        assert values["supply_voltage"] == pytest.approx(bench.plant.voltage, abs=bench.facts.measured_within)


@pwm
def test_current_is_measured_in_steps(bench):
    for volts in bench.facts.voltages:
        bench.device.set(volts).wait()
        current = bench.device.measure()["supply_current"]
        assert current == pytest.approx(bench.plant.current, abs=bench.facts.current_within)
        assert current == round(current, 1)


@linear
def test_current_is_that_of_a_capacitor(bench):
    bench.device.set(0.0)
    bench.settle()
    bench.device.set(40.0)
    bench.clock.sleep(0.1e-3)
    # 20 nF by a lag of 0.2 ms, half a time constant later.
    expected = 20e-9 * 40.0 / 0.2e-3 * math.exp(-0.5)
    assert bench.device.glance()["supply_current"] == pytest.approx(expected, abs=bench.facts.current_within)
    bench.settle()
    assert bench.device.measure()["supply_current"] == pytest.approx(0.0, abs=bench.facts.current_within)


def test_held_for_long_by_looking_at_it(bench):
    bench.device.set(6.0)
    bench.settle()
    applied = len(bench.plant.applied)
    bench.tick(60.0)
    assert bench.plant.applied[applied:] == []
    within = bench.facts.driven_within(6.0) + bench.facts.measured_within
    assert bench.device.measure()["supply_voltage"] == pytest.approx(6.0, abs=within)


@pwm
@cases("battery", [15.0, 30.0])
def test_voltage_follows_a_supply_that_changes(bench, output, battery):
    bench.instrument.battery_voltage = 24.0
    bench.device.set(6.0)
    before = bench.plant.voltage
    bench.instrument.battery_voltage = battery
    assert bench.plant.voltage == pytest.approx(before * battery / 24.0, abs=1e-9)
    bench.device.glance()
    assert bench.plant.voltage == pytest.approx(6.0, abs=0.05)
    assert bench.device.glance()["supply_voltage"] == pytest.approx(bench.plant.voltage, abs=1e-9)
    assert bench.device.setpoint == 6.0


@pwm
def test_supply_that_is_too_low(bench):
    bench.instrument.battery_voltage = 10.0
    with pytest.raises(DeviceError, match=r"supply: the .*supply of 10\.0 V is too low for 12 V"):
        bench.device.set(12.0)
    assert bench.plant.applied == []
    bench.device.set(10.0).wait()
    assert bench.instrument.power == 1000


def test_safe_after_the_watchdog_has_expired(bench):
    bench.device.set(6.0)
    bench.settle()
    bench.clock.sleep(10.0)
    applied = len(bench.plant.applied)
    bench.device.safe()
    assert falls_to_zero([volts for _, volts in bench.plant.applied[applied:]])
    assert bench.plant.voltage == 0.0


@pwm
@cases("fault", [*Fault, *ChannelFlag])
def test_every_call_tells_of_a_fault_and_safe_succeeds(kind, output, stack, fault):
    bench = switching("driver" in kind, output, stack)
    text = fault.name.replace("_", ".")
    bench.device.set(6.0)
    bench.instrument.trip(fault)
    for call in (bench.device.measure, bench.device.glance, bench.device.read, lambda: bench.device.set(5.0)):
        with pytest.raises(DeviceError, match=f"(?i)supply: .*{text}"):
            call()
    if isinstance(fault, Fault):
        assert bench.plant.voltage == 0.0
        bench.device.safe()
        bench.device.safe()
        assert bench.plant.voltage == 0.0


@linear
@pytest.mark.parametrize("call", ["measure", "glance", "read", "set"])
def test_an_amplifier_that_went_off_is_told_once(bench, call):
    bench.device.set(6.0)
    bench.clock.sleep(0.1)
    bench.amplifier.trip()
    with pytest.raises(DeviceError, match=r"^supply: the amplifier went off by itself, while .* protection"):
        bench.device.set(7.0) if call == "set" else getattr(bench.device, call)()
    assert bench.device.setpoint == 0.0
    bench.settle()
    assert bench.plant.voltage == 0.0
    assert bench.at_zero()
    bench.device.set(5.0).wait()
    bench.settle()
    assert bench.plant.voltage > 4.9


@linear
def test_an_amplifier_is_clipped_and_the_monitor_says_so(bench):
    bench.device.set(40.0)
    bench.amplifier._gain = 5.0  # another gain than the driver was told
    bench.device.set(39.0)
    bench.settle()
    assert bench.plant.voltage == 45.0
    assert bench.device.measure()["supply_voltage"] == pytest.approx(45.0, abs=bench.facts.measured_within)


def test_silence_of_the_host_drops_the_output_at_that_instant(bench):
    bench.device.set(6.0)
    bench.device.glance()
    last_command = bench.clock.now()
    bench.clock.sleep(3600.0)
    bench.instrument.world.advance()
    instant, volts = bench.plant.applied[-1]
    assert volts == 0.0
    # The answer to the last command took a few milliseconds of the wire.
    assert instant == pytest.approx(last_command + WATCHDOG, abs=0.005)


def test_reading_after_too_long_a_silence_raises_and_resumes_nothing(bench):
    bench.device.set(6.0)
    bench.settle()
    bench.clock.sleep(1.001 * WATCHDOG)
    applied = len(bench.plant.applied)
    with pytest.raises(DeviceError, match=r"supply: .*watchdog"):
        bench.device.measure()
    assert falls_to_zero([volts for _, volts in bench.plant.applied[applied:]])
    assert bench.device.setpoint == 0.0
    bench.tick(3.0)
    assert bench.plant.voltage == 0.0
    assert bench.at_zero()


def test_set_point_after_a_silence_does_not_resume_the_voltage_of_before(bench, kind):
    bench.device.set(12.0)
    bench.settle()
    bench.clock.sleep(1.001 * WATCHDOG)
    bench.instrument.world.advance()
    applied = len(bench.plant.applied)
    if kind in LINEAR:
        with pytest.raises(DeviceError, match=r"supply: .*watchdog"):
            bench.device.set(3.0)
    bench.device.set(3.0)
    bench.settle()
    within = bench.facts.driven_within(3.0)
    assert max(volts for _, volts in bench.plant.applied[applied:]) == pytest.approx(3.0, abs=within)
    assert bench.plant.voltage == pytest.approx(3.0, abs=within)


@pwm
def test_device_that_comes_back_resumes_nothing(bench):
    bench.device.set(6.0)
    bench.instrument.unplug()
    bench.clock.sleep(5.0)
    bench.instrument.world.advance()
    bench.instrument.plug_in()
    applied = len(bench.plant.applied)
    with pytest.raises(DeviceError):
        bench.device.measure()
    assert all(volts == 0.0 for _, volts in bench.plant.applied[applied:])
    bench.device.set(5.0).wait()
    assert bench.plant.voltage > 4.9


# What only a wire can do.


class OnASupplyLine(OnALine):
    @pytest.fixture
    def set_points(self):
        return 6.0, 5.0

    @pytest.fixture
    def output(self, bench):
        def output():
            bench.instrument.world.advance()
            return bench.plant.voltage

        return output

    @pytest.fixture
    def another_server(self, bench):
        load = Resistor()
        world = load.world = World(load, bench.clock)
        return CanopenSlcanServer(EmulatedRoboteq("another", world, load))

    @pytest.fixture
    def truth(self, output):
        return lambda: {"supply_voltage": output()}

    @pytest.fixture
    def tolerance(self, bench):
        return bench.facts.measured_within


@over_the_wire
class TestRestart(OnASupplyLine, RestartedActuatorContract):
    pass


@over_the_wire
class TestLineLost(OnASupplyLine, ActuatorLineLostContract):
    pass


@over_the_wire
class TestSafeOverAFreshLine(OnASupplyLine, SafeOverAFreshLineContract):
    pass


@over_the_wire
class TestWatchdog(OnASupplyLine, WatchdogContract):
    pass


@over_the_wire
def test_command_of_another_host_is_an_error_of_the_next_reading(bench):
    for volts in (6.0, 0.0):
        bench.device.set(volts).wait()
        bench.device.glance()
        bench.instrument.write_object(0x2000, 300, 1)
        with pytest.raises(DeviceError, match=r"supply: its command was changed to 300 by another host"):
            bench.device.glance()
        bench.device.safe()


@over_the_wire
def test_rescue_of_a_voltage_that_a_dead_host_left(bench):
    bench.device.set(6.0).wait()
    RoboteqSupply.rescue("supply", bench.device._settings, bench.clock)
    assert bench.plant.voltage == 0.0


@over_the_wire
@pytest.mark.parametrize("fault", [halved, lost])
def test_spoilt_answer_is_asked_for_again(bench, output, fault):
    def set_and_wait():
        bench.device.set(5.0).wait()

    bench.device.set(6.0)
    for call in (bench.device.measure, set_and_wait, bench.device.safe):
        spoil_next_answer(bench.server.server, fault)
        call()
    assert bench.plant.voltage == 0.0


@over_the_wire
def test_command_that_was_lost_until_the_watchdog_expired_does_not_resume(bench, output):
    bench.device.set(12.0)
    bench.clock.sleep(0.95)
    bench.server.lose_next = b"t601823002001"
    bench.device.set(3.0)
    assert bench.server.lose_next == b""
    assert bench.plant.voltage == pytest.approx(3.0, abs=resolution(3.0, output))


SUPPLY_CALLS = st.one_of(
    st.tuples(st.just("set"), st.sampled_from([0.0, 3.0, 6.0, 12.0])),
    st.tuples(st.just("sleep"), st.sampled_from([0.05, 0.5, 0.9, 0.995, 0.999, 1.0, 1.5, 100.0])),
    st.tuples(st.sampled_from([lost, halved]), st.none()),
    st.tuples(st.sampled_from(["measure", "glance", "safe", "release", "emergency_stop"]), st.none()),
    st.tuples(st.sampled_from(["connect", "recover"]), st.none()),
)


@given(st.lists(SUPPLY_CALLS, max_size=25))
def test_power_that_was_dropped_never_comes_back(calls):
    with ExitStack() as stack:
        bench = switching(True, "average", stack)
        load, supply = bench.plant, bench.device
        for call, value in calls:
            held = load.voltage
            bench.instrument.world.advance()
            dropped = load.voltage != held
            asked = value if call == "set" else 0.0
            before = len(load.applied)
            with suppress(DeviceError):
                if call == "sleep":
                    bench.clock.sleep(value)
                elif call in ("connect", "recover"):
                    supply.close()
                    supply = bench.connect(getattr(RoboteqSupply, call))
                    stack.callback(supply.close)
                elif call == "set":
                    supply.set(value)
                elif call in (lost, halved):
                    spoil_next_answer(bench.server.server, call)
                else:
                    getattr(supply, call)()
            bench.instrument.world.advance()
            for _, volts in load.applied[before:]:
                # What was dropped stays off; nothing but a set-point brings a voltage.
                assert volts in (0.0, pytest.approx(asked, abs=0.02)) or (volts == held and not dropped)
                dropped = dropped or volts == 0.0
            assert bench.instrument.read_object(0x2101, 2) == 0


@over_the_wire
def test_closing_while_the_output_is_on_leaves_it_to_the_watchdog(bench):
    bench.device.set(6.0)
    bench.device.close()
    bench.clock.sleep(WATCHDOG - 0.1)
    assert bench.instrument.power > 0
    bench.clock.sleep(0.2)
    assert bench.instrument.power == 0


@over_the_wire
def test_emergency_stop_stays_until_it_is_released(bench):
    bench.device.set(6.0)
    bench.device.emergency_stop()
    assert bench.plant.voltage == 0.0
    with pytest.raises(DeviceError, match=r"emergency stop; .*off and on"):
        bench.device.set(5.0)
    with pytest.raises(DeviceError, match="emergency stop"):
        bench.device.measure()
    applied = len(bench.plant.applied)
    bench.device.release()
    assert len(bench.plant.applied) == applied
    bench.device.set(5.0).wait()


@over_the_wire
def test_emergency_stop_of_before_is_refused_and_recovered(bench):
    bench.device.set(6.0)
    bench.instrument.write_object(0x200C, 1)
    bench.device.close()
    with pytest.raises(DeviceError, match=r"emergency stop; .*off and on"):
        bench.connect()
    applied = len(bench.plant.applied)
    device = bench.connect(RoboteqSupply.recover)
    assert len(bench.plant.applied) == applied
    device.set(5.0).wait()
    device.close()


@over_the_wire
def test_status_of_a_command_that_was_replaced(bench):
    first = bench.device.set(6.0)
    second = bench.device.set(5.0)
    with pytest.raises(DeviceError, match="another command"):
        first.wait()
    second.wait()
    third = bench.device.set(4.0)
    bench.device.safe()
    with pytest.raises(DeviceError, match="another command"):
        third.wait()
