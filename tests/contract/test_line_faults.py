"""What a restart, a lost line, a silent host and a disturbed line do to a TEC and to the devices on a T7."""

import itertools
from typing import ClassVar

import numpy as np
import pytest
from cases import cases
from faulty_line import KINDS, FaultyLine

from bench.base import DeviceConnectionError, DeviceError, DeviceRestartedError, VirtualClock
from bench.contracts import (
    ActuatorLineLostContract,
    LineLostContract,
    RestartedActuatorContract,
    RestartedInstrumentContract,
    SafeOverAFreshLineContract,
    WatchdogContract,
)
from bench.devices import TECMode
from drivers.labjack_t7 import T7HighVoltageSupply, T7PositionSensor, T7Switch
from drivers.meerstetter import MeerstetterTEC
from sim_devices.instruments.labjack_t7 import EmulatedT7
from sim_devices.instruments.meerstetter_tec import EmulatedTEC
from sim_devices.protocol_emulated import register, unregister
from sim_devices.transducers.piezo_amplifier import PiezoAmplifier
from sim_devices.wire import WireServer
from sim_devices.wire.mecom import MeComServer
from sim_devices.wire.modbus_tcp import ModbusTcpInstrument
from sim_devices.world import World

CURRENT_LIMIT = 1.0
LINE = 5

_numbers = itertools.count()


class Laboratory:
    """An instrument at an address, which can be cut off in two ways, and exchanged for another.

    Subclasses give `instrument` and `served`, which puts an instrument on the wire.
    """

    def __init__(self, stack, way="unplugged"):
        self.clock = VirtualClock()
        self.way = way
        self.instrument = self.made(serial=1)
        self.server = self.served(self.instrument)
        self.name = f"line-faults-{next(_numbers)}"
        self.address = register(self.name, self.server, self.clock)
        stack.callback(unregister, self.name)
        self.device = self.connect()
        stack.callback(self.device.close)

    def cut(self):
        if self.way == "silent":
            self.instrument.unplug()
        else:
            unregister(self.name)

    def mend(self):
        if self.way == "silent":
            self.instrument.plug_in()
        else:
            register(self.name, self.server, self.clock)

    def exchange(self):
        unregister(self.name)
        self.server = self.served(self.made(serial=2))
        if self.way == "silent":
            register(self.name, self.server, self.clock)

    def restart(self):
        self.instrument.power_cycle()


class Peltier:
    """A Peltier element whose current follows at once, and whose temperature follows the current."""

    sink_temperature = 22.0
    current = 0.0

    @property
    def voltage(self):
        return 2.0 * self.current

    @property
    def plate_temperature(self):
        return 25.0 + 10.0 * self.current

    def terminals(self):
        return self.plate_temperature, self.sink_temperature, self.current, self.voltage

    def drive(self, current_ampere):
        self.current = current_ampere

    def release(self):
        self.current = 0.0

    def advance(self, dt):
        pass


class Cooler(Laboratory):
    """A TEC in current mode; its flash allows 4 A."""

    def made(self, serial):
        load = Peltier()
        world = World(load, self.clock)
        made = EmulatedTEC("tec", world, load, serial_number=serial, rng=np.random.default_rng(2))
        made.write_parameter(2030, 4.0)
        if serial == 1:
            self.world, self.load = world, load
        return made

    def served(self, instrument):
        return MeComServer(instrument)

    def connect(self):
        return MeerstetterTEC.connect("tec", MeerstetterTEC.Settings(port=self.address, **self.said), self.clock)

    said: ClassVar = {
        "mode": TECMode.CURRENT, "temperature_limits": (5, 95), "voltage_limit": 15.0, "current_limit": CURRENT_LIMIT
    }  # fmt: skip

    def output(self):
        self.world.advance()
        return self.load.current

    def truth(self):
        return {"tec_current": self.load.current, "tec_voltage": self.load.voltage}

    set_points = 0.25, 0.75
    output_limits = -CURRENT_LIMIT, CURRENT_LIMIT
    tolerance = 2e-3


class Amplifier(Laboratory):
    """A high-voltage amplifier on a T7, whose enable input is pulled down."""

    def made(self, serial):
        world = World(_Still(), self.clock)
        amplifier = PiezoAmplifier(world, _Still(), scale_error=0.0, rng=np.random.default_rng(8))
        inputs = {0: amplifier.voltage_monitor, 1: amplifier.current_monitor, 2: amplifier.status, 3: self.volts}
        t7 = EmulatedT7(world, inputs, rng=np.random.default_rng(3), serial_number=serial)
        t7.add_follower(lambda: amplifier.drive(t7.tdac_volts(0), t7.dio_level(LINE, pulled_down=True)))
        if serial == 1:
            self.world, self.amplifier = world, amplifier
        return t7

    given = 1.0

    def volts(self):
        return self.given

    def served(self, instrument):
        return ModbusTcpInstrument(instrument)

    def connect(self):
        settings = T7HighVoltageSupply.Settings(port=self.address, **self.said)
        return T7HighVoltageSupply.connect("hv", settings, self.clock)

    said: ClassVar = {"line": LINE}

    def output(self):
        self.world.advance()
        t7 = self.instrument
        return 20.0 * t7.tdac_volts(0) if t7.dio_level(LINE, pulled_down=True) else 0.0

    def truth(self):
        return {"hv_voltage": self.amplifier.voltage}

    set_points = 12.0, -20.0
    output_limits = -40.0, 40.0
    tolerance = 0.1


class Fan(Amplifier):
    """A switch on a T7."""

    def connect(self):
        return T7Switch.connect("fan", T7Switch.Settings(port=self.address, **self.said), self.clock)

    def output(self):
        self.world.advance()
        return float(self.instrument.dio_level(LINE, pulled_down=True))

    def truth(self):
        return {"fan_state": self.output()}

    set_points = 1.0, 1.0
    output_limits = 0.0, 1.0


class Detector(Amplifier):
    """A position sensor on a T7."""

    def connect(self):
        settings = T7PositionSensor.Settings(
            port=self.address, channels=(3,), volts_per_metre=1.0, position_limits=(-9, 9)
        )
        return T7PositionSensor.connect("psd", settings, self.clock)

    def truth(self):
        return {"psd_position": self.given}

    tolerance = 2e-3


class _Still:
    def advance(self, dt):
        pass

    def lead(self, start, target, steps, time_constant):
        pass


class OnALine:
    @pytest.fixture(params=["unplugged", "silent"])
    def laboratory(self, request, stack, kind):
        return kind(stack, request.param)

    @pytest.fixture(autouse=True)
    def settled(self, request, clock):
        """Let the output settle."""
        request.getfixturevalue("in_use")
        clock.sleep(0.05)

    @pytest.fixture
    def device(self, laboratory):
        return laboratory.device

    @pytest.fixture
    def clock(self, laboratory):
        return laboratory.clock

    @pytest.fixture
    def set_points(self, laboratory):
        return laboratory.set_points

    @pytest.fixture
    def output_limits(self, laboratory):
        return laboratory.output_limits

    @pytest.fixture
    def tolerance(self, laboratory):
        return laboratory.tolerance

    @pytest.fixture
    def restart(self, laboratory):
        return laboratory.restart

    @pytest.fixture
    def cut(self, laboratory):
        return laboratory.cut

    @pytest.fixture
    def mend(self, laboratory):
        return laboratory.mend

    @pytest.fixture
    def exchange(self, laboratory):
        return laboratory.exchange

    @pytest.fixture
    def output(self, laboratory):
        return laboratory.output

    @pytest.fixture
    def truth(self, laboratory):
        return laboratory.truth


class Once:
    """For contracts that do not cut the line."""

    @pytest.fixture
    def laboratory(self, stack, kind):
        return kind(stack)


actuators = pytest.mark.parametrize("kind", [Cooler, Amplifier, Fan])


@actuators
class TestRestart(Once, OnALine, RestartedActuatorContract):
    pass


@pytest.mark.parametrize("kind", [Detector])
class TestRestartOfASensor(Once, OnALine, RestartedInstrumentContract):
    pass


@actuators
class TestLineLost(OnALine, ActuatorLineLostContract):
    pass


@pytest.mark.parametrize("kind", [Detector])
class TestLineOfASensorLost(OnALine, LineLostContract):
    pass


@actuators
class TestSafe(OnALine, SafeOverAFreshLineContract):
    @pytest.fixture
    def in_use(self, device):
        return device


@actuators
class TestWatchdog(Once, OnALine, WatchdogContract):
    @pytest.fixture
    def in_use(self, device):
        return device


@actuators
def test_rescue_switches_off_what_another_program_left_on(stack, kind):
    laboratory = kind(stack)
    device = laboratory.device
    device.set(laboratory.set_points[1])
    device.rescue("rescued", device.Settings(port=laboratory.address, **laboratory.said), laboratory.clock)
    assert laboratory.output() == 0.0
    with pytest.raises(DeviceError, match=f"^{device.name}: "):
        device.glance()


class RestartingServer(WireServer):
    """A wire server of a device that restarts at a request of a number, and does not answer that one."""

    def __init__(self, instrument):
        self.server = MeComServer(instrument)
        self.restart = instrument.power_cycle
        self.left = -1

    def receive(self, data):
        self.left -= 1
        if self.left == 0:
            self.restart()
            return b""
        return self.server.receive(data)


class RestartingCooler(Cooler):
    def served(self, instrument):
        return RestartingServer(instrument)


@cases("number", range(1, 8))
def test_a_restart_while_the_output_goes_on_is_found(stack, number):
    laboratory = RestartingCooler(stack)
    laboratory.server.left = number
    with pytest.raises(DeviceRestartedError):
        laboratory.device.set(0.5)
    assert laboratory.server.left <= 0
    assert laboratory.output() == 0.0
    laboratory.device.safe()
    laboratory.device.close()
    laboratory.device = laboratory.connect()
    laboratory.device.set(0.5)
    assert laboratory.output() == 0.5


def test_what_another_program_switches_is_an_error(stack):
    laboratory = Cooler(stack)
    device, instrument = laboratory.device, laboratory.instrument
    device.set(0.5)
    instrument.write_parameter(2010, 0)
    for call in (device.glance, device.measure, lambda: device.set(0.6)):
        with pytest.raises(DeviceError, match="tec: its output is off although it was switched on"):
            call()
    device.safe()
    for number, value in ((50001, 0.9), (2010, 2), (50000, 1)):
        instrument.write_parameter(number, value)
    for call in (device.glance, device.measure):
        with pytest.raises(DeviceError, match="tec: its output is on although it was switched off"):
            call()
    device.safe()
    assert laboratory.output() == 0.0


def test_an_output_that_would_come_back_by_itself_is_refused(stack):
    laboratory = Cooler(stack)
    laboratory.device.close()
    laboratory.instrument.write_parameter(2010, 1)
    with pytest.raises(DeviceError, match="static on"):
        laboratory.connect()


class DisturbedCooler(Cooler):
    def served(self, instrument):
        kinds = (*KINDS, "cut")
        return FaultyLine(
            MeComServer(instrument), self.clock, np.random.default_rng(11), kinds=kinds, share=0.0, latest=0.7
        )


def test_a_disturbed_line_gives_no_wrong_value_of_a_tec(stack):
    laboratory = DisturbedCooler(stack)
    device, server = laboratory.device, laboratory.server
    rng = np.random.default_rng(5)
    assert device.repeats == server.repeats == 0
    device.set(0.1)
    server.share = 0.35
    good, failed = 0, 0
    for _ in range(400):
        current = round(rng.uniform(-0.3, 0.3), 3)
        try:
            device.set(current)
            assert laboratory.output() == pytest.approx(current, abs=1e-6)
        except DeviceConnectionError:
            failed += 1
        try:
            values = device.glance()
        except DeviceConnectionError:
            failed += 1
            continue
        good += 1
        assert values["tec_current"] == pytest.approx(laboratory.output(), abs=2e-3)
        assert values["tec_temperature"] == pytest.approx(laboratory.load.plate_temperature, abs=0.05)
    assert good > 300
    assert failed > 4
    assert device.repeats == server.repeats > 100
    server.share = 0.0
    laboratory.clock.sleep(1.0)
    device.reconnect()
    device.safe()
    assert laboratory.output() == 0.0


class DisturbedInstrument(ModbusTcpInstrument):
    """A T7 whose connections break, fall silent, or deliver answers late or twice."""

    faults = 0.0

    def __init__(self, bank):
        super().__init__(bank)
        self.rng = np.random.default_rng(12)

    def connect(self):
        stream = super().connect()
        receive, held = stream.receive, b""

        def disturbed(data):
            nonlocal held
            answer, held = held + receive(data), b""
            if self.rng.random() >= self.faults:
                return answer
            match self.rng.integers(5):
                case 0:
                    stream.close()
                    raise ConnectionResetError
                case 1:
                    return b""
                case 2:
                    return 2 * answer
                case 3:
                    return answer[: self.rng.integers(len(answer))]
                case _:
                    held = answer
                    return b""

        stream.receive = disturbed
        return stream


class DisturbedDetector(Detector):
    def served(self, instrument):
        return DisturbedInstrument(instrument)


def test_disturbed_connections_give_no_wrong_value_of_a_t7(stack):
    laboratory = DisturbedDetector(stack)
    psd, server = laboratory.device, laboratory.server
    settings = T7HighVoltageSupply.Settings(port=laboratory.address, line=LINE, watchdog=60)
    supply = T7HighVoltageSupply.connect("hv", settings, laboratory.clock)
    rng = np.random.default_rng(6)
    supply.set(0.0)
    assert psd.repeats == supply.repeats == 0
    server.faults = 0.2
    good = failed = 0
    for round_ in range(300):
        laboratory.given = rng.uniform(-5.0, 5.0)
        volts = rng.uniform(-30.0, 30.0)
        laboratory.clock.sleep(0.02)
        try:
            supply.set(volts)
            assert laboratory.output() == pytest.approx(volts, abs=0.02)
            good += 1
        except DeviceConnectionError:
            failed += 1
        laboratory.clock.sleep(0.02)
        for name, device, take in (
            ("psd_position", psd, psd.glance if round_ % 2 else psd.measure),
            ("hv_voltage", supply, supply.glance),
        ):
            true = laboratory.given if device is psd else laboratory.amplifier.voltage
            try:
                assert take()[name] == pytest.approx(true, abs=0.1)
                good += 1
            except DeviceConnectionError:
                failed += 1
    assert good > 600
    assert failed > 4
    assert psd.repeats + supply.repeats > 80
    server.faults = 0.0
    for device in (psd, supply):
        device.reconnect()
    supply.safe()
    assert laboratory.output() == 0.0
    supply.close()
