"""Every wait of a driver for an emulated instrument is on the laboratory's clock: no busy machine makes it fail."""

import pytest

import bench
from bench.base import DeviceError, Stopwatch
from sim_devices import protocol_emulated
from sim_devices.wire import TcpServer

INSTRUMENTS = [("vo2", "tec"), ("vo2", "psd"), ("sma", "supply"), ("sma", "load_cell"), ("sma", "stage")]


class Line:
    """The line of an instrument, which may fall silent, or whose process may be stopped for some seconds."""

    def __init__(self, server):
        self.silent = False
        self.stopped = 0.0
        self.requests = 0
        if isinstance(server, TcpServer):
            connect = server.connect
            server.connect = lambda: self._tap(connect())
        else:
            self._tap(server)
            unsolicited = server.unsolicited
            server.unsolicited = lambda: b"" if self.silent else unsolicited()

    def _tap(self, side):
        receive = side.receive

        def answer(data):
            self.requests += 1
            watch = Stopwatch()
            while watch.seconds() < self.stopped:
                pass
            reply = receive(data)
            return b"" if self.silent else reply

        side.receive = answer
        return side


@pytest.fixture
def open_with_lines(monkeypatch):
    """Return a function that opens a rig and returns it, with the lines of its instruments by name."""

    def open_rig(name, **overrides):
        lines = {}
        register = protocol_emulated.register

        def keep(port, server, clock):
            lines[port] = Line(server)
            return register(port, server, clock)

        monkeypatch.setattr(protocol_emulated, "register", keep)
        return bench.open_rig(name, overrides=overrides), lines

    return open_rig


@pytest.mark.parametrize(("name", "device"), INSTRUMENTS)
class TestTimeouts:
    def test_a_process_that_is_stopped_makes_no_driver_fail(self, open_with_lines, name, device):
        rig, lines = open_with_lines(name, **{f"devices.{device}.timeout": "0.06"})
        with rig:
            line = lines[device]
            line.stopped, before = 0.15, line.requests
            values = rig.devices[device].glance()
            line.stopped = 0.0
            assert line.requests > before
            assert values

    def test_silence_costs_laboratory_time_only(self, open_with_lines, name, device):
        rig, lines = open_with_lines(name, **{f"devices.{device}.timeout": "40" if device == "psd" else "10"})
        with rig:
            watch, start = Stopwatch(), rig.clock.now()
            lines[device].silent = True
            for _ in range(6):
                with pytest.raises(DeviceError):
                    rig.devices[device].measure()
            lines[device].silent = False
            assert rig.clock.now() - start >= 30.0
            assert watch.seconds() < 25.0
