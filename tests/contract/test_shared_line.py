"""The contracts of every driver on a line that it shares with an instrument of its kind, which is asked as well."""

import math
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

from bench.base import DeviceConnectionError, VirtualClock
from bench.contracts import (
    ActuatorContract,
    ActuatorLineLostContract,
    LineLostContract,
    LoadCellContract,
    OnEmulatedRig,
    RestartedActuatorContract,
    RestartedInstrumentContract,
    SafeOverAFreshLineContract,
    ServoContract,
    SilentInstrumentContract,
    TECAmplifierContract,
    VoltageSupplyContract,
    WatchdogContract,
)
from bench.devices import Actuator
from bench.rig import Rig, load_rig
from sim_devices.protocol_emulated import register, unregister

load_once = cache(load_rig)
_CALLS = "measure", "glance", "set", "safe", "stop", "reconnect"


class Beside(OnEmulatedRig):
    """A device whose neighbour on the line is asked before each of its calls, and whose line can be cut."""

    rig_file = "../system/lines/buses.toml"
    neighbour_name = ""
    points = ()
    within = 0.0
    other = None
    port_was_lost = False

    @pytest.fixture
    def rig(self):
        """Connect the devices of one line of the rig."""
        file = load_once(str(Path(__file__).parent / self.rig_file))
        ports = {entry.name: entry.settings.port for entry in file.devices}
        beside = tuple(entry for entry in file.devices if ports[entry.name] == ports[self.device_name])
        with Rig(replace(file, devices=beside, interlocks=()), VirtualClock(), seed=0) as rig:
            yield rig

    def lose_port(self):
        self.port_was_lost = True
        unregister(f"emulated://{self.device_name}")

    @pytest.fixture
    def neighbour(self, rig):
        return rig.devices[self.neighbour_name or self.device_name[:-1] + "2"]

    @pytest.fixture
    def device(self, rig, neighbour):
        device = rig.devices[self.device_name]

        def between(call):
            def called(*args, **keys):
                self.ask(neighbour)
                return call(*args, **keys)

            return called

        for name in _CALLS:
            if hasattr(device, name):
                setattr(device, name, between(getattr(device, name)))
        return device

    def ask(self, neighbour):
        """Ask the neighbour, which may only be lost if the port was."""
        try:
            neighbour.glance()
        except DeviceConnectionError:
            assert self.port_was_lost
            with suppress(DeviceConnectionError):
                neighbour.reconnect()
                neighbour.glance()

    @pytest.fixture(autouse=True)
    def left(self, rig, neighbour):
        """The neighbour is as it was, whatever has become of the device; that one is left as it is."""
        yield
        if self.port_was_lost:
            self.lose_port()
            register(self.device_name, rig.laboratory.servers[self.device_name], rig.clock)
        self.ask(neighbour)
        neighbour.glance()
        neighbour.safe()
        rig.devices.clear()

    @pytest.fixture
    def output(self, rig):
        return lambda: rig.laboratory.output(self.device_name)

    @pytest.fixture
    def effects(self, device, output):
        return output if isinstance(device, Actuator) else lambda: None

    @pytest.fixture
    def set_points(self):
        return self.points

    @pytest.fixture
    def tolerance(self):
        return self.within

    @pytest.fixture
    def unplug(self, rig):
        return lambda: rig.laboratory.inject(f"{self.device_name}.unplug")

    @pytest.fixture(params=["port", "silent"])
    def way(self, request):
        return request.param

    @pytest.fixture
    def cut(self, way, unplug):
        return unplug if way == "silent" else self.lose_port

    @pytest.fixture
    def mend(self, rig, way, clock):
        def mend():
            if way == "silent":
                rig.laboratory.mend(self.device_name)
            else:
                register(self.device_name, self.other or rig.laboratory.servers[self.device_name], clock)

        return mend

    @pytest.fixture
    def exchange(self, rig, way, clock):
        def exchange():
            self.other = rig.laboratory.made(self.device_name, serial=77)[1]
            if way == "silent":
                self.lose_port()
                register(self.device_name, self.other, clock)

        return exchange

    @pytest.fixture
    def restart(self, rig, clock):
        def restart():
            rig.laboratory.instruments[self.device_name].power_cycle()
            # The longest that an instrument takes to start.
            clock.sleep(0.5)

        return restart

    @pytest.fixture
    def truth(self, rig):
        return lambda: self.true(rig.laboratory)


class OnACell(Beside):
    device_name = "load1"
    within = 2e-3

    def true(self, laboratory):
        return {"load1_force": laboratory.value("load1")}


class TestLoadCell(OnACell, LoadCellContract):
    @pytest.fixture
    def resolution(self):
        return self.within


class TestLoadCellRestarted(OnACell, RestartedInstrumentContract):
    pass


class TestLoadCellLost(OnACell, LineLostContract):
    pass


class OnAHeater(Beside):
    device_name = "heater1"
    driven = "power"
    points = 10.0, 30.0
    within = 0.06

    def true(self, laboratory):
        return {"heater1_power": laboratory.output("heater1"), "heater1_temperature": 21.5}


class TestHeater(OnAHeater, ActuatorContract):
    pass


class TestHeaterFaults(OnAHeater, RestartedActuatorContract, SilentInstrumentContract, SafeOverAFreshLineContract):
    pass


class OnATEC(Beside):
    device_name = "tec1"
    points = 0.25, 0.75
    within = 5e-3

    def true(self, laboratory):
        return {"tec1_current": laboratory.output("tec1")}


class TestTEC(OnATEC, TECAmplifierContract):
    pass


class TestTECFaults(
    OnATEC, RestartedActuatorContract, SilentInstrumentContract, SafeOverAFreshLineContract, WatchdogContract
):
    pass


class TestTECLost(OnATEC, ActuatorLineLostContract):
    pass


class OnAServo(Beside):
    device_name = "servo1"
    points = 3.3, 3.6
    within = 2e-3

    def true(self, laboratory):
        laboratory.time.advance()
        return {"servo1_position": laboratory.instruments["servo1"].position}


class TestServo(OnAServo, ServoContract):
    @pytest.fixture
    def effects(self, rig):
        return lambda: self.true(rig.laboratory)["servo1_position"] - math.pi


class ServoFaults(OnAServo):
    @pytest.fixture
    def output_limits(self):
        return 0, 1


class TestServoFaults(ServoFaults, RestartedActuatorContract, SilentInstrumentContract, SafeOverAFreshLineContract):
    pass


class TestServoLost(OnAServo, ActuatorLineLostContract):
    pass


class OnASupply(Beside):
    device_name = "supply1"
    points = 6.0, 5.0
    within = 0.1

    def true(self, laboratory):
        return {"supply1_voltage": laboratory.output("supply1")}


class TestSupply(OnASupply, VoltageSupplyContract):
    pass


class TestSupplyFaults(
    OnASupply, RestartedActuatorContract, SilentInstrumentContract, SafeOverAFreshLineContract, WatchdogContract
):
    pass


class TestSupplyLost(OnASupply, ActuatorLineLostContract):
    pass


class OnATextSupply(Beside):
    rig_file = "../../examples/shared-line.toml"
    device_name, neighbour_name = "supply", "plate"
    points = 5.0, 8.0
    within = 5e-3

    @pytest.fixture
    def output(self, twin):
        return lambda: twin.output


class TestTextSupply(OnATextSupply, VoltageSupplyContract):
    pass


class TestTextSupplyFaults(
    OnATextSupply, RestartedActuatorContract, SilentInstrumentContract, SafeOverAFreshLineContract
):
    pass
