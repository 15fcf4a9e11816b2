"""A port that several devices share: turns, what is late, what is lost, and echoes."""

import os
import sys
import tty

import numpy as np
import pytest

from bench.base import DeviceConnectionError, VirtualClock
from drivers.flintec_dad141 import FlintecDAD141
from drivers.serial_line import LinePort, SerialSettings, open_port
from sim_devices.protocol_emulated import register, unregister
from sim_devices.wire import WireServer

needs_terminals = pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals")


class Parrot(WireServer):
    """Answers each message twice: at once, and again some time later."""

    def __init__(self, clock, late):
        self.clock, self.late, self.due = clock, late, []

    def receive(self, data):
        self.due.append((self.clock.now() + self.late, b"late " + data))
        return data

    def unsolicited(self):
        now = self.clock.now()
        sent = b"".join(data for instant, data in self.due if instant <= now)
        self.due = [each for each in self.due if each[0] > now]
        return sent

    def next_unsolicited(self):
        return min((instant for instant, _ in self.due), default=np.inf)


@pytest.fixture
def parrot():
    clock = VirtualClock()
    address = register("parrot", Parrot(clock, 0.3), clock)
    made = []

    def opened(device, timeout=0.1, **keys):
        made.append(
            open_port(device, SerialSettings(port=address, line="bus", baudrate=9600, timeout=timeout, **keys))
        )
        return made[-1]

    yield opened, clock
    for port in made:
        port.close()
    unregister(address)


def test_what_is_late_for_one_device_is_not_read_by_the_next(parrot):
    opened, clock = parrot
    first, second = opened("first"), opened("second")
    first.write(b"one")
    assert first.read(3) == b"one"
    clock.sleep(0.5)
    second.write(b"two")
    assert second.read_all() == b"two"
    assert (first.requests, second.requests) == (1, 1)


def test_each_device_waits_as_long_as_its_own_settings_say(parrot):
    opened, clock = parrot
    first, second = opened("first", timeout=0.1), opened("second", timeout=0.7)
    for _ in range(2):
        for port, timeout in ((first, 0.1), (second, 0.7)):
            port.reset_input_buffer()
            clock.sleep(1.0)
            port.reset_input_buffer()
            since = clock.now()
            assert port.read(1) == b""
            assert clock.now() - since == pytest.approx(timeout)
    first.timeout = 0.2
    since = clock.now()
    assert second.read(1) == first.read(1) == b""
    assert clock.now() - since == pytest.approx(0.9)


def test_a_device_that_leaves_closes_the_port_for_nobody_else(parrot):
    opened, _ = parrot
    first, second = opened("first"), opened("second")
    first.close()
    first.close()
    second.write(b"two")
    assert second.read(3) == b"two"
    with pytest.raises(OSError, match=r"not open"):
        first.write(b"one")


def test_a_device_does_not_open_its_port_twice(parrot):
    opened, _ = parrot
    first = opened("first")
    with pytest.raises(DeviceConnectionError, match="opened it already"):
        opened("first")
    first.close()
    opened("first")


@needs_terminals
def test_a_port_that_fails_is_lost_for_all_and_opened_once_again():
    master, slave = os.openpty()
    tty.setraw(master)
    tty.setraw(slave)
    settings = SerialSettings(port=os.ttyname(slave), line="bus", baudrate=9600, timeout=0.02)
    first, second = open_port("first", settings), open_port("second", settings)
    first.write(b"one")
    assert os.read(master, 10) == b"one"
    os.close(master)
    os.close(slave)
    for port in (first, second, second):
        with pytest.raises(OSError, match=r"."):
            port.write(b"x")
        assert not port.is_open
    first.close()
    second.close()
    # Another one in its place, which may have the same name: the lock is free.
    ends = os.openpty()
    again = SerialSettings(port=os.ttyname(ends[1]), line="bus", baudrate=9600, timeout=0.02)
    ports = [open_port(name, again) for name in ("first", "second")]
    for port in ports:
        port.write(b"x")
        port.close()
    unshared = open_port("third", SerialSettings(port=again.port, baudrate=9600))
    unshared.close()
    for end in ends:
        os.close(end)


def test_a_port_on_which_nothing_answers_is_opened_again(parrot):
    opened, clock = parrot
    first, second = opened("first"), opened("second")
    second.write(b"two")
    assert second.read(3) == b"two"
    first.close()
    first = opened("first")
    clock.sleep(1.0)
    second.reset_input_buffer()
    assert second.is_open
    # One alone may be the instrument's own silence.
    assert first.read(1) == b""
    first.close()
    first = opened("first")
    assert second.is_open
    assert first.read(1) == second.read(1) == b""
    first.close()
    first = opened("first")
    assert first.is_open
    assert not second.is_open


@pytest.mark.parametrize("line", ["cells", "heaters", "tecs", "servos", "can"])
def test_an_echo_is_passed_over_on_each_kind_of_line(connected, line):
    with connected() as rig:
        wanted = rig.measure()
        port = next(e.settings.port for e in rig.file.devices if e.settings.line == line)
    names = port.removeprefix("emulated://")
    echoing = {f"lines__{line}__port": f"emulated://echo+{names}", f"lines__{line}__echo": "true"}
    with connected(**echoing) as rig:
        found = rig.measure()
        for name, value in wanted.items():
            assert found[name] == pytest.approx(value, abs=0.03, nan_ok=True)
        for name in names.split("+"):
            assert rig.devices[name].repeats == 0


@pytest.mark.parametrize("line", ["tecs", "servos"])
def test_an_echo_that_nobody_announced_does_no_harm_where_frames_have_a_direction(connected, line):
    with connected() as rig:
        port = next(e.settings.port for e in rig.file.devices if e.settings.line == line)
    with connected(**{f"lines__{line}__port": port.replace("emulated://", "emulated://echo+")}) as rig:
        assert rig.measure()["tec2_temperature"] == pytest.approx(35.0, abs=0.03)


def test_the_key_is_named_where_nothing_echoes(connected):
    with pytest.raises(DeviceConnectionError, match=r"^load1: .*the key echo"), connected(lines__cells__echo="true"):
        pass


class Crowded(WireServer):
    """An adapter that echoes, on a line where others send at the same time now and then."""

    def __init__(self, server, rng):
        self.server, self.rng, self.share, self.spoilt = server, rng, 0.0, 0

    def receive(self, data):
        echo = bytearray(data)
        if self.rng.random() < self.share:
            self.spoilt += 1
            match self.rng.integers(3):
                case 0:
                    echo[self.rng.integers(len(echo))] ^= 1 << self.rng.integers(8)
                case 1:
                    del echo[self.rng.integers(len(echo)) :]
                case _:
                    echo[:0] = b"\x55"
        return bytes(echo) + self.server.receive(data)


def test_an_echo_that_is_not_what_was_sent_costs_a_repetition(connected):
    with connected() as rig:
        laboratory, clock = rig.laboratory, rig.clock
        crowded = Crowded(laboratory.servers["load1"], np.random.default_rng(4))
        address = register("crowded", crowded, clock)
        settings = FlintecDAD141.Settings(port=address, echo=True, force_limits=(-50.0, 50.0))
        cell = FlintecDAD141.connect("cell", settings, clock)
        assert isinstance(cell._line.port, LinePort)
        crowded.share, failed = 0.1, 0
        for _ in range(500):
            try:
                assert cell.glance()["cell_force"] == pytest.approx(10.0, abs=0.01)
            except DeviceConnectionError:
                failed += 1
        assert failed < 25
        assert cell.repeats >= 0.8 * crowded.spoilt > 20
        cell.close()
        unregister(address)


def test_what_is_late_is_no_part_of_an_echo(connected):
    with connected(lines__tecs__port="emulated://echo+tec1+tec2", lines__tecs__echo="true") as rig:
        device = rig.devices["tec1"]
        for _ in range(20):
            rig.laboratory.inject("tec1.delay", {"seconds": 0.25})
            assert device.glance()["tec1_temperature"] == pytest.approx(25.0, abs=0.06)
            assert rig.devices["tec2"].glance()["tec2_temperature"] == pytest.approx(35.0, abs=0.06)
        assert 20 <= device.repeats <= 40
        assert rig.devices["tec2"].repeats == 0
