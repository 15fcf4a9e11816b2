"""Opening serial ports, whose lock keeps other programs out, and waiting until a line is quiet."""

import os
import subprocess
import sys
import threading
import tty

import pytest

from bench.base import DeviceConnectionError, VirtualClock, slowness
from drivers.serial_line import (
    MOST_STRAY,
    RESENDS,
    LinePort,
    OpenPort,
    PatientPort,
    SerialSettings,
    forget_received,
    holder_of,
    open_port,
    patient,
    settle_line,
)
from sim_devices.protocol_emulated import register, unregister
from sim_devices.wire import WireServer

OPEN_AND_WAIT = """
import sys
from drivers.serial_line import SerialSettings, open_port
port = open_port("first", SerialSettings(port=sys.argv[1], baudrate=9600))
print("open", flush=True)
sys.stdin.read()
"""


def test_the_holder_of_a_port_is_not_that_of_any_lock(node, tmp_path):
    fcntl = pytest.importorskip("fcntl")
    port = opened(node)
    with (tmp_path / "lock").open("w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        port.close()
        assert holder_of(node) is None


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
    with pytest.raises(DeviceConnectionError) as refusal:
        opened(node)
    # Nobody can end this program first.
    assert "end that program" not in str(refusal.value)
    assert ("opened it already" in str(refusal.value)) == (sys.platform == "linux")
    port.close()
    opened(node).close()


def test_a_request_that_a_busy_computer_sends_late_is_sent(node, monkeypatch):
    send = os.write

    def late(descriptor, data):
        threading.Event().wait(0.15)
        return send(descriptor, data)

    port = opened(node)
    assert port.timeout == 0.1
    monkeypatch.setattr(os, "write", late)
    port.write(b"*IDN?")
    port.close()


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


class LatePort:
    """A port whose answer comes some seconds of waiting after the request, whatever the machine does meanwhile."""

    def __init__(self, answer, late):
        self.answer, self.left = answer, late
        self.timeout = 0.1
        self.waited = 0.0

    def read(self, size=1):
        step = min(self.timeout, max(self.left, 0.0))
        self.left -= step
        if self.left > 1e-9:
            self.waited += step
            return b""
        found, self.answer = self.answer[:size], self.answer[size:]
        self.waited += self.timeout if len(found) < size else step
        return found

    def read_until(self, _, size):
        return self.read(size)


class TornPort(LatePort):
    """A port whose answer comes in pieces."""

    def read(self, size=1):
        return super().read(min(size, 3))


READS = pytest.mark.parametrize("read", [lambda port: port.read(4), lambda port: port.read_until(b"\n", 4)])


class TestPatience:
    @READS
    def test_an_answer_ends_where_it_ends(self, read):
        assert read(PatientPort(TornPort(b"yes\nyes\n", 0.0), 1.0, lambda: 8.0)) == b"yes\n"
        # What is there already says nothing of the machine.
        assert read(PatientPort(LatePort(b"yes\n", 0.0), 1.0, pytest.fail)) == b"yes\n"

    @READS
    @pytest.mark.parametrize(
        ("late", "slowness", "comes"),
        [
            (0.05, 1.0, True),
            (0.5, 1.0, False),
            (0.5, 8.0, True),
            # A hiccup is no busy machine.
            (0.12, 1.3, False),
            # Not for ever.
            (1.5, 100.0, False),
        ],
    )
    def test_an_answer_is_waited_for_as_long_as_the_machine_is_slow(self, read, late, slowness, comes):
        late_port = LatePort(b"yes\n", late)
        port = PatientPort(late_port, 1.0, lambda: slowness)
        assert read(port) == (b"yes\n" if comes else b"")
        assert late_port.timeout == port.timeout == 0.1
        assert late_port.waited <= 1.0 + 1e-9

    @pytest.mark.parametrize(("watchdog", "longest"), [(5.0, 1.0), (1.0, 0.2), (0.0, 1.0)])
    def test_a_request_and_its_repetitions_stay_within_the_watchdog(self, watchdog, longest):
        class Settings(SerialSettings):
            watchdog: float

        settings = Settings(port="/dev/ttyX", baudrate=9600, timeout=0.1, watchdog=watchdog)
        late_port = LatePort(b"", 0.0)
        port = patient(late_port, settings, lambda: 1e6)
        for _ in range(1 + RESENDS):
            assert port.read(1) == b""
        assert port.patience == pytest.approx(longest)
        assert late_port.waited == pytest.approx((1 + RESENDS) * longest)
        assert not watchdog or late_port.waited < watchdog

    def test_an_emulated_line_has_the_time_of_its_laboratory(self):
        settings = SerialSettings(port="emulated://tec", baudrate=9600)
        port = LatePort(b"", 0.0)
        assert patient(port, settings) is port


def test_a_late_answer_is_not_taken_for_an_echo():
    class EchoingPort(LatePort):
        def write(self, data):
            self.answer += data + b"yes\n"
            return len(data)

        def reset_input_buffer(self):
            self.answer = b""

    settings = SerialSettings(port="/dev/ttyX", baudrate=9600, echo=True)
    shared = OpenPort(EchoingPort(b"", 0.0), lambda: None)
    line = LinePort(shared, "tec", settings)
    line.write(b"first\n")
    # Its answer was given up, and comes now.
    line.write(b"second\n")
    assert line.read_until(b"\n", 4) == b"yes\n"


def test_slowness_is_that_of_this_process():
    assert slowness() >= 1.0
