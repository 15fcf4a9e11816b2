"""A device under test, emulated or on the wire of the emulated one, and what is behind it."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest
from faulty_line import damaged, lost, spoil_next_answer

from bench.base import VirtualClock
from bench.devices import Device
from sim_devices.protocol_emulated import register, unregister
from sim_devices.wire import WireServer
from sim_devices.wire.modbus_tcp import ModbusTcpInstrument

_numbers = itertools.count()

over_the_wire = pytest.mark.parametrize("kind", ["driver"], indirect=True)


@dataclass(kw_only=True)
class Bench:
    """One device under test; the last four are those of a driver on its wire."""

    clock: VirtualClock
    device: Device
    instrument: Any
    plant: Any
    connect: Callable[..., Device] | None = None
    port: str = ""
    server: Any = None
    requests: list = field(default_factory=list)


class Given:
    """A plant of one value that the test sets, and that grows at a rate, per second."""

    def __init__(self, value=0.0):
        self.value = value
        self.rate = 0.0

    def advance(self, dt):
        self.value += self.rate * dt


class RecordingServer(WireServer):
    """A wire server that keeps the requests."""

    def __init__(self, server):
        self.server = server
        self.requests = []

    def receive(self, data):
        self.requests.append(data)
        return self.server.receive(data)

    def unsolicited(self):
        return self.server.unsolicited()

    def next_unsolicited(self):
        return self.server.next_unsolicited()


def serial_port(stack, server, clock):
    """Put a server at a port of its own until the stack is closed; return the port and the list of its requests."""
    name = f"contract-{next(_numbers)}"
    recording = RecordingServer(server)
    stack.callback(unregister, name)
    return register(name, recording, clock), recording.requests


def tcp_port(stack, bank, clock):
    """Put a bank of registers at a port of its own until the stack is closed, and return the port."""
    port = register(f"contract-{next(_numbers)}", ModbusTcpInstrument(bank), clock)
    stack.callback(unregister, port)
    return port


class OnABench:
    """The fixtures of the contracts, from the fixture `bench` of a module."""

    @pytest.fixture
    def device(self, bench):
        return bench.device

    @pytest.fixture
    def clock(self, bench):
        return bench.clock

    @pytest.fixture
    def requests(self, bench):
        return bench.requests

    @pytest.fixture
    def sent(self, bench):
        return lambda: len(bench.requests)

    @pytest.fixture
    def unplug(self, bench):
        return bench.instrument.unplug


class OnALine(OnABench):
    """The fixtures of the contracts of a line that is lost, over the wire; `exchange` needs `another_server`."""

    @pytest.fixture
    def cut(self, bench):
        return lambda: unregister(bench.port)

    @pytest.fixture
    def mend(self, bench):
        return lambda: register(bench.port.removeprefix("emulated://"), bench.server, bench.clock)

    @pytest.fixture
    def exchange(self, bench, another_server):
        def exchange():
            bench.server = another_server

        return exchange

    @pytest.fixture
    def restart(self, bench):
        def restart():
            bench.instrument.power_cycle()
            # The longest that an instrument takes to start.
            bench.clock.sleep(0.5)

        return restart


class OnAServo(OnABench):
    """The fixtures of the contracts that an MX-28 keeps."""

    @pytest.fixture
    def identity(self):
        return "ROBOTIS MX-28, serial number id 1, firmware 45"

    @pytest.fixture
    def sent(self, bench):
        return lambda: (len(bench.requests), bench.instrument.read_item(116))


class OnATorque:
    """The fixtures of the contracts of an output that is the torque of a servo."""

    @pytest.fixture
    def output(self, bench):
        return lambda: bench.instrument.read_item(64)

    @pytest.fixture
    def output_limits(self):
        return 0, 1


class Spoilt(OnABench):
    """The fixture that spoils the next answer by a `fault`, over the wire."""

    @pytest.fixture(params=[damaged, lost])
    def spoil(self, bench, request):
        return lambda: spoil_next_answer(bench.server, request.param)
