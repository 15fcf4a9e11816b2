"""What a serial line may bring: requests in pieces, half of them, garbage, and a client that does not read."""

import random

import pytest
import serial
from dialects import Dynamixel, MalformedError, MeCom, ModbusRtu, SlcanCanopen
from served import PATIENCE

from bench.base import Stopwatch

LINES = {
    ("vo2", "tec"): MeCom(),
    ("sma", "stage"): Dynamixel(),
    ("sma", "load_cell"): ModbusRtu((0x2000,), ()),
    ("sma", "supply"): SlcanCanopen(),
}


@pytest.fixture(params=LINES, ids="/".join)
def line(request):
    """The line of an instrument."""
    rig, instrument = request.param
    return Line(request.getfixturevalue(rig), instrument, LINES[rig, instrument])


class Line:
    """A line that can be opened several times, and the request of its protocol that is always answered."""

    def __init__(self, rig, instrument, dialect):
        self.rig = rig
        self.instrument = instrument
        self.dialect = dialect
        self.rng = random.Random(0)

    def open(self):
        return serial.Serial(self.rig.port(self.instrument), 57_600, timeout=0.05, write_timeout=PATIENCE)

    def expect_answer(self, port, send=lambda port, data: port.write(data)):
        """Check that a request is answered, once or, where garbage was before it, when it is repeated."""
        request, check = self.dialect.probe(self.rng)
        watch, answer, sent = Stopwatch(), b"", -1.0
        while True:
            if sent < 0.0 or watch.seconds() - sent > PATIENCE / 4:
                sent = watch.seconds()
                send(port, request)
            try:
                answer += port.read(4096)
            except serial.SerialException:
                # The terminal forgot what an earlier client had left unread, just when it was to be read.
                assert watch.seconds() < PATIENCE
            try:
                check(answer)
            except (MalformedError, IndexError):
                assert watch.seconds() < PATIENCE, answer[-200:]
            else:
                return


def test_byte_by_byte(line):
    def send(port, data):
        for byte in data:
            port.write(bytes((byte,)))
            port.flush()

    with line.open() as port:
        line.expect_answer(port, send)


def test_several_requests_in_one_write(line):
    with line.open() as port:
        line.expect_answer(port)
        port.reset_input_buffer()
        request, _ = line.dialect.probe(line.rng)
        port.write(request)
        one, watch = b"", Stopwatch()
        while not line_is_silent(one, port):
            one = extended(one, port, watch)
        port.write(10 * request)
        many = b""
        while len(many) < 10 * len(one):
            many = extended(many, port, watch)
        assert line.dialect.check(many) >= 10 * line.dialect.check(one)


def extended(data, port, watch):
    assert watch.seconds() < PATIENCE
    return data + port.read(4096)


def line_is_silent(data, port):
    return bool(data) and not port.in_waiting


def test_garbage_before_a_request(line):
    for length in (1, 7, 300, 5000):
        with line.open() as port:
            port.write(line.rng.randbytes(length))
            line.expect_answer(port)


def test_a_disconnection_in_mid_frame(line):
    request, _ = line.dialect.probe(line.rng)
    for end in (1, len(request) // 2, len(request) - 1):
        with line.open() as port:
            port.write(request[:end])
        with line.open() as port:
            line.expect_answer(port)


def test_a_flood_that_nobody_reads_the_answers_of(line):
    request, _ = line.dialect.probe(line.rng)
    with line.open() as port:
        for _ in range(20):
            port.write(request * 100)
    # Others are served all the same, and this one too, once somebody reads.
    assert line.rig.control.time() > 0.0
    with line.open() as port:
        line.expect_answer(port)


def test_an_unplugged_line_is_silent_and_comes_back(line):
    request, _ = line.dialect.probe(line.rng)
    with line.open() as port:
        line.expect_answer(port)
        line.rig.control.fault(f"{line.instrument}.unplug")
        port.reset_input_buffer()
        port.write(request)
        assert port.read(1) == b""
        line.rig.control.plug_in(line.instrument)
        line.expect_answer(port)
