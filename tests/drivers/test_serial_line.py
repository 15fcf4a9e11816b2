"""Opening serial ports, whose lock keeps other programs out, and waiting until a line is quiet."""

import os
import subprocess
import sys
import tty

import pytest

from bench.clock import VirtualClock
from bench.errors import DeviceConnectionError
from drivers.serial_line import MOST_STRAY, SerialSettings, forget_received, open_port, settle_line
from sim_devices.protocol_emulated import register, unregister
from sim_devices.wire import WireServer

OPEN_AND_WAIT = """
import sys
from drivers.serial_line import SerialSettings, open_port
port = open_port("first", SerialSettings(port=sys.argv[1], baudrate=9600))
print("open", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def node():
    """The path of a serial node."""
    if sys.platform == "win32":
        pytest.skip("needs pseudo-terminals")
    ends = os.openpty()
    for end in ends:
        tty.setraw(end)
    yield os.ttyname(ends[1])
    for end in ends:
        os.close(end)


def opened(node):
    return open_port("second", SerialSettings(port=node, baudrate=9600))


def test_a_port_in_use_is_refused_and_free_when_its_process_was_killed(node):
    with subprocess.Popen(
        [sys.executable, "-c", OPEN_AND_WAIT, node], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as first:
        try:
            assert first.stdout.readline() == b"open\n"
            held = rf"^second: cannot open {node}: it is in use by .*; end that program first$"
            with pytest.raises(DeviceConnectionError, match=held) as refusal:
                opened(node)
            if sys.platform == "linux":
                assert f"process {first.pid} (python" in str(refusal.value)
        finally:
            first.kill()
            first.wait()
    for _ in range(2):
        opened(node).close()


def test_a_port_that_is_open_here_is_refused_until_it_is_closed(node):
    port = opened(node)
    with pytest.raises(DeviceConnectionError, match="in use by"):
        opened(node)
    port.close()
    opened(node).close()


class Chatter(WireServer):
    """An instrument that sends a byte every 0.1 s, so many in all."""

    def __init__(self, clock, count):
        self.clock = clock
        self.left = count
        self.next = 0.1

    def receive(self, data):
        return data

    def unsolicited(self):
        sent = b""
        while self.left and self.next <= self.clock.now():
            sent += b"\xa5"
            self.left -= 1
            self.next += 0.1
        return sent

    def next_unsolicited(self):
        return self.next


@pytest.fixture
def chatter(request):
    clock = VirtualClock()
    port = open_port(
        "line",
        SerialSettings(port=register("chatter", Chatter(clock, request.param), clock), baudrate=9600, timeout=0.7),
    )
    yield port, clock
    unregister("chatter")


@pytest.mark.parametrize("chatter", [5], indirect=True)
def test_a_line_is_settled_once_it_was_silent_so_long(chatter):
    port, clock = chatter
    port.write(b"echo")
    settle_line(port, 0.25)
    assert clock.now() == pytest.approx(0.75, abs=0.26)
    assert port.in_waiting == 0
    assert port.timeout == 0.7


@pytest.mark.parametrize("chatter", [10 * MOST_STRAY], indirect=True)
def test_a_line_that_never_falls_silent_is_an_error(chatter):
    port, _ = chatter
    with pytest.raises(OSError, match="does not fall silent"):
        settle_line(port, 0.25)
    assert port.timeout == 0.7


@pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals")
def test_what_a_port_has_received_cannot_be_forgotten_once_it_is_gone():
    master, slave = os.openpty()
    port = opened(os.ttyname(slave))
    os.write(master, b"abc")
    forget_received(port)
    assert port.in_waiting == 0
    os.close(master)
    os.close(slave)
    # termios raises an error of its own here, which is no OSError.
    with pytest.raises(OSError, match=r"5|error"):
        forget_received(port)
    port.close()
    with pytest.raises(OSError, match="not open"):
        forget_received(port)
