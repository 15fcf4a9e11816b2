"""Every wait of a driver for an emulated instrument is on the laboratory's clock: no busy machine makes it fail."""

import pytest

import bench
from bench.clock import Stopwatch
from bench.errors import DeviceError
from sim_devices import protocol_emulated
from sim_devices.wire import WireServer

INSTRUMENTS = [("vo2", "tec"), ("sma", "supply"), ("sma", "load_cell"), ("sma", "stage")]


class Line(WireServer):
    """An instrument's line that may fall silent, or be served by a process that is stopped meanwhile."""

    def __init__(self, server):
        self.server = server
        self.silent = False
        self.stops = 0.0
        self.requests = 0

    def receive(self, data):
        self.requests += 1
        watch = Stopwatch()
        while watch.seconds() < self.stops:
            pass
        answer = self.server.receive(data)
        return b"" if self.silent else answer

    def unsolicited(self):
        return b"" if self.silent else self.server.unsolicited()

    def next_unsolicited(self):
        return self.server.next_unsolicited()


@pytest.fixture
def open_with_lines(monkeypatch):
    """Return a function that opens a rig and returns it, with the lines of its serial instruments by name."""

    def open_rig(name, **overrides):
        lines = {}
        register = protocol_emulated.register

        def keep(port, server, *others):
            lines[port] = Line(server)
            return register(port, lines[port], *others)

        monkeypatch.setattr(protocol_emulated, "register", keep)
        return bench.open_rig(name, overrides=overrides), lines

    return open_rig


@pytest.mark.parametrize(("name", "device"), INSTRUMENTS)
class TestTimeouts:
    def test_a_process_that_is_stopped_makes_no_driver_fail(self, open_with_lines, name, device):
        rig, lines = open_with_lines(name, **{f"devices.{device}.timeout": "0.06"})
        with rig:
            line = lines[device]
            line.stops, before = 0.15, line.requests
            values = rig.devices[device].glance()
            line.stops = 0.0
            assert line.requests > before
            assert values

    def test_silence_costs_laboratory_time_only(self, open_with_lines, name, device):
        rig, lines = open_with_lines(name, **{f"devices.{device}.timeout": "10"})
        with rig:
            watch, start = Stopwatch(), rig.clock.now()
            lines[device].silent = True
            for _ in range(6):
                with pytest.raises(DeviceError):
                    rig.devices[device].measure()
            lines[device].silent = False
            assert rig.clock.now() - start >= 30.0
            assert watch.seconds() < 25.0
