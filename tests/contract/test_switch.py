"""What every switch promises, run against the driver of a T7 on the wire of the emulated one."""

from contextlib import ExitStack
from dataclasses import dataclass, field

import numpy as np
import pytest
from cases import cases
from emulated_bench import tcp_port

from bench.base import DeviceError, VirtualClock
from bench.contracts import SwitchContract
from bench.devices import Switch
from drivers.labjack_t7 import T7Switch
from sim_devices.instruments.labjack_t7 import EmulatedT7
from sim_devices.world import World

WATCHDOG = 5


class Lamp:
    """A plant that the switch does not move."""

    def advance(self, dt: float) -> None:
        pass


class RecordingT7(EmulatedT7):
    """An instrument that keeps what was asked of it."""

    def read_registers(self, address: int, count: int) -> list[int]:
        self.requests.append(("read", address, count))
        return super().read_registers(address, count)

    def write_registers(self, address: int, values: list[int]) -> None:
        self.requests.append(("write", address, values))
        super().write_registers(address, values)

    def prepare(self, frames: object, head: int) -> None:
        """Each request is to be seen, also one that comes again."""


@dataclass
class Laboratory:
    """Makes switches on the lines of one instrument."""

    active_high: bool
    stack: ExitStack
    clock: VirtualClock = field(default_factory=VirtualClock)

    def __post_init__(self) -> None:
        self.t7 = RecordingT7(World(Lamp(), self.clock), {}, rng=np.random.default_rng(4))
        self.t7.requests = []
        self.port = tcp_port(self.stack, self.t7, self.clock)

    def connect(self, line: int, watchdog: int = WATCHDOG, name: str = "fan") -> Switch:
        said = {"line": line, "active_high": self.active_high, "watchdog": watchdog}
        switch = T7Switch.connect(name, T7Switch.Settings(port=self.port, **said), self.clock)
        self.stack.callback(switch.close)
        return switch

    def on(self, line: int) -> bool:
        """Whether a line is on, without a request that would feed the watchdog."""
        return self.t7.dio_level(line) == self.active_high

    def silence(self, seconds: float) -> None:
        self.clock.sleep(seconds)
        self.t7.world.advance()


@pytest.fixture(params=[True, False], ids=["active high", "active low"])
def lab(request, stack) -> Laboratory:
    return Laboratory(request.param, stack)


@pytest.fixture
def fan(lab) -> Switch:
    return lab.connect(3)


class TestContract(SwitchContract):
    @pytest.fixture
    def device(self, fan):
        return fan

    @pytest.fixture
    def clock(self, lab):
        return lab.clock

    @pytest.fixture
    def identity(self):
        return "LabJack T7, serial number 470012345, firmware 1.0300"

    @pytest.fixture
    def effects(self, lab):
        return lambda: lab.on(3)

    @pytest.fixture
    def sent(self, lab):
        return lambda: len(lab.t7.requests)


def test_off_after_another_program_left_it_on(lab):
    lab.t7.write_value(2003, lab.active_high)
    fan = lab.connect(3)
    assert not lab.on(3)
    assert fan.measure() == {"fan_state": 0.0}


def bring_on(lab: Laboratory, fan: Switch) -> None:
    fan.set(1.0)


def bring_off(lab: Laboratory, fan: Switch) -> None:
    fan.set(0.0)


def run_out(lab: Laboratory, fan: Switch) -> None:
    fan.set(1.0)
    lab.silence(2 * WATCHDOG)


def make_an_input(lab: Laboratory, fan: Switch) -> None:
    fan.set(1.0)
    lab.t7.write_value(2850, 0)


def switch_on_from_elsewhere(lab: Laboratory, fan: Switch) -> None:
    lab.t7.write_value(2003, lab.active_high)


@cases("bring", [None, bring_on, bring_off, run_out, make_an_input, switch_on_from_elsewhere])
def test_safe_is_off_from_any_state(fan, lab, bring):
    if bring is not None:
        bring(lab, fan)
    for _ in range(2):
        fan.safe()
        assert not lab.on(3)
        assert int(lab.t7.read_value(2850)) >> 3 & 1
        assert fan.setpoint == 0.0
        assert fan.measure() == {"fan_state": 0.0}
    fan.set(1.0)
    assert lab.on(3)


@pytest.mark.parametrize("take", ["measure", "glance", "read"])
def test_the_watchdog_switches_off_and_is_told_once(fan, lab, take):
    fan.set(1.0)
    lab.silence(WATCHDOG - 0.001)
    assert lab.on(3)
    lab.silence(0.001)
    assert not lab.on(3)
    with pytest.raises(DeviceError, match=r"fan: DIO3 is off although it was switched on: the watchdog"):
        getattr(fan, take)()
    assert fan.setpoint == 0.0
    assert fan.measure() == {"fan_state": 0.0}
    fan.set(1.0)
    assert lab.on(3)
    assert fan.measure() == {"fan_state": 1.0}


def test_the_watchdog_of_a_switch_that_is_off_is_not_told(fan, lab):
    fan.set(1.0)
    fan.set(0.0)
    lab.silence(10 * WATCHDOG)
    assert fan.measure() == {"fan_state": 0.0}


def test_looking_at_it_keeps_it_on(fan, lab):
    fan.set(1.0)
    for _ in range(50):
        lab.silence(0.9 * WATCHDOG)
        assert fan.glance() == {"fan_state": 1.0}
    assert lab.on(3)


def test_closed_while_on_it_is_left_to_the_watchdog(fan, lab):
    fan.set(1.0)
    fan.close()
    lab.silence(WATCHDOG - 0.001)
    assert lab.on(3)
    lab.silence(0.001)
    assert not lab.on(3)


def test_switches_of_one_instrument_share_its_watchdog(lab):
    fan, pump = lab.connect(3), lab.connect(12, watchdog=3, name="pump")
    lab.t7.write_value(2005, lab.active_high)
    fan.set(1.0)
    pump.set(1.0)
    assert lab.on(3)
    assert lab.on(12)
    pump.safe()
    assert lab.on(3)
    pump.set(1.0)
    lab.silence(3)
    assert not lab.on(3)
    assert not lab.on(12)
    assert lab.on(5)  # is not under it
    for switch in (fan, pump):
        with pytest.raises(DeviceError, match="watchdog"):
            switch.glance()


def test_a_later_switch_does_not_lengthen_the_time_of_an_earlier_one(lab):
    fan = lab.connect(3, watchdog=3)
    lab.connect(12, watchdog=60, name="pump")
    fan.set(1.0)
    lab.silence(3)
    assert not lab.on(3)


def test_a_switch_alone_sets_its_own_time(lab):
    lab.connect(3, watchdog=2).close()
    fan = lab.connect(3, watchdog=60)
    fan.set(1.0)
    lab.silence(59)
    assert lab.on(3)
