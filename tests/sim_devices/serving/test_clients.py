"""Clients in this process, instruments in another: what a line of a served instrument carries and survives."""

import os
import random
import socket
import struct
from contextlib import suppress

import pytest
from pymodbus.client import ModbusTcpClient

IDENTIFY = b"#0115AA?IF257D\r"
IDENTITY = b"!0115AA8065-TEC SW"
PING = bytes.fromhex("fffffd0001030001194e")
PONG = bytes.fromhex("fffffd00010700550000")
READ_PRODUCT = bytes.fromhex("0003ea600002")  # PRODUCT_ID, a float
"""Function 3 of Modbus at address 60000: unit and length are put before it."""


def request(transaction):
    return struct.pack(">HHHB", transaction, 0, 6, 1) + READ_PRODUCT[1:]


def receive(connection, count):
    data = b""
    while len(data) < count:
        piece = connection.recv(4096)
        assert piece, "the connection was closed"
        data += piece
    return data


def product(connection, transaction=1):
    """Ask a T7 for its product number, 7."""
    connection.sendall(request(transaction))
    reply = receive(connection, 13)
    assert struct.unpack_from(">H", reply)[0] == transaction
    return struct.unpack_from(">f", reply, 9)[0]


def identity(line):
    line.write(IDENTIFY)
    return line.read_until(b"\r")


def test_a_serial_port_carries_the_bytes_of_the_instrument(vo2, opened):
    assert identity(opened(vo2.port("tec"), baudrate=57600)).startswith(IDENTITY)


def test_pymodbus_reads_over_tcp(sma):
    client = ModbusTcpClient("127.0.0.1", port=int(sma.port("t7").rpartition(":")[2]), timeout=60)
    assert client.connect()
    words = client.read_holding_registers(60000, count=2).registers
    assert client.convert_from_registers(words, client.DATATYPE.FLOAT32) == 7.0
    client.close()


def test_bytes_may_come_one_by_one(vo2, opened, connect):
    line, connection = opened(vo2.port("tec")), connect(vo2.port("psd"))
    for index in range(len(IDENTIFY)):
        line.write(IDENTIFY[index : index + 1])
        line.flush()
    assert line.read_until(b"\r").startswith(IDENTITY)
    for byte in request(9):
        connection.sendall(bytes((byte,)))
    assert receive(connection, 13)[:2] == b"\x00\x09"


def test_requests_may_be_sent_before_their_answers_are_read(vo2, sma, opened, connect):
    line, connection = opened(vo2.port("tec")), connect(vo2.port("psd"))
    line.write(100 * IDENTIFY)
    assert all(line.read_until(b"\r").startswith(IDENTITY) for _ in range(100))
    connection.sendall(b"".join(map(request, range(300))))
    replies = receive(connection, 300 * 13)
    assert [struct.unpack_from(">H", replies, 13 * index)[0] for index in range(300)] == list(range(300))
    servo = opened(sma.port("stage"))
    servo.write(50 * PING)
    assert servo.read(50 * 14).count(PONG[:8]) == 50


def test_two_connections_are_served_in_turn_and_a_third_is_turned_away(vo2, connect):
    first, second = connect(vo2.port("psd")), connect(vo2.port("psd"))
    assert product(first) == product(second) == product(first, 2) == 7.0
    with suppress(ConnectionError):
        third = connect(vo2.port("psd"))
        third.sendall(request(1))
        assert third.recv(100) == b""
    assert product(first, 3) == product(second, 3) == 7.0


def test_a_client_that_leaves_makes_room_at_once(vo2, connect):
    keeper = connect(vo2.port("psd"))
    for _ in range(30):
        leaver = connect(vo2.port("psd"))
        assert product(leaver) == 7.0
        leaver.close()
    assert product(keeper) == 7.0


def test_a_terminal_is_opened_again_and_again(vo2, opened):
    for _ in range(10):
        line = opened(vo2.port("tec"))
        assert identity(line).startswith(IDENTITY)
        line.close()


def test_a_frame_that_was_left_unfinished_disturbs_nobody(vo2, opened, connect):
    line, connection = opened(vo2.port("tec")), connect(vo2.port("psd"))
    line.write(IDENTIFY[:7])
    line.flush()
    line.close()
    connection.sendall(request(1)[:9])
    connection.close()
    assert identity(opened(vo2.port("tec"))).startswith(IDENTITY)
    assert product(connect(vo2.port("psd"))) == 7.0


@pytest.mark.parametrize("instrument", ["supply", "load_cell", "stage"])
def test_garbage_on_a_line_is_survived(sma, opened, instrument):
    line = opened(sma.port(instrument), timeout=0.0)
    rng = random.Random(5)
    for _ in range(100):
        line.write(rng.randbytes(200))
        line.read(100_000)
    line.close()
    assert sma.control.state()["force"] is not None
    if instrument == "stage":
        again = opened(sma.port(instrument))
        # What was begun by the garbage is completed by zeros.
        again.write(bytes(70_000))
        again.reset_input_buffer()
        again.write(PING)
        assert PONG[:8] in again.read_until(PONG[:8])


def test_garbage_on_tcp_ends_only_its_connection(vo2, connect):
    keeper, rude = connect(vo2.port("psd")), connect(vo2.port("psd"))
    with suppress(ConnectionError):
        rude.sendall(random.Random(6).randbytes(3000))
        while rude.recv(4096):
            pass
    assert product(keeper) == 7.0


def test_a_client_that_floods_and_reads_nothing_is_not_read_any_further(vo2, connect):
    keeper, flooding = connect(vo2.port("psd")), connect(vo2.port("psd"))
    flooding.settimeout(2.0)
    # More than any buffers of the system hold.
    with pytest.raises(TimeoutError):
        flooding.sendall(3_000_000 * request(3))
    assert product(keeper) == 7.0
    assert vo2.control.time() > 0.0


def test_a_terminal_whose_client_reads_nothing_serves_the_next_one(vo2):
    descriptor = os.open(vo2.port("tec"), os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    with suppress(BlockingIOError):
        for _ in range(10_000):
            os.write(descriptor, 20 * IDENTIFY)
    os.close(descriptor)
    import serial

    with serial.Serial(vo2.port("tec"), timeout=0.2) as line:
        # What the other has left is answered or lost within a second; then the line is clear.
        for _ in range(200):
            line.reset_input_buffer()
            line.write(b"\r" + IDENTIFY)
            if line.read_until(b"\r").startswith(IDENTITY) and line.read(1) == b"":
                return
    pytest.fail("the line never became clear")


def test_a_heartbeat_arrives_on_an_idle_line(sma, opened):
    line = opened(sma.port("supply"))
    line.write(b"\rC\rS4\rO\r")
    assert line.read_until(b"t701105\r").endswith(b"t701105\r")
    # Nothing is asked from here on.
    assert line.read(3 * len(b"t701105\r")) == 3 * b"t701105\r"
    line.write(b"C\r")


def test_raw_bytes_on_tcp_have_one_client_at_a_time(emulate, opened, connect):
    with emulate("vo2", "--tcp") as (_, endpoints):
        address = endpoints["instruments"]["tec"]["port"]
        assert address.startswith("socket://127.0.0.1:")
        line = opened(address)
        assert identity(line).startswith(IDENTITY)
        with suppress(ConnectionError):
            assert connect(address).recv(10) == b""
        assert identity(line).startswith(IDENTITY)
        line.close()
        assert identity(opened(address)).startswith(IDENTITY)


def test_bytes_take_the_time_of_the_line_on_request(emulate, opened):
    from bench.clock import Stopwatch

    with emulate("vo2", "--baud-time") as (_, endpoints):
        line = opened(endpoints["instruments"]["tec"]["port"], baudrate=1200)
        watch = Stopwatch()
        answer = identity(line)
    assert answer.startswith(IDENTITY)
    assert watch.seconds() >= (len(IDENTIFY) + len(answer)) * 10 / 1200


def test_a_burst_of_conversions_takes_its_time(sma, connect):
    """AIN0_EF: an average of 600 samples at 6 kHz takes 0.1 s."""
    connection = connect(sma.port("t7"))

    def write(address, value, form):
        data = struct.pack(form, value)
        body = struct.pack(">BBHHB", 1, 16, address, len(data) // 2, len(data)) + data
        connection.sendall(struct.pack(">HHH", 1, 0, len(body)) + body)
        assert receive(connection, 12)[7] == 16

    write(9000, 3, ">I")
    write(9300, 600, ">I")
    write(10200, 6000.0, ">f")
    begun = sma.control.time()
    connection.sendall(struct.pack(">HHHBBHH", 2, 0, 6, 1, 3, 7000, 2))
    assert receive(connection, 13)[7] == 3
    assert sma.control.time() - begun >= 0.1


def test_nothing_listens_beyond_the_loopback_interface(vo2):
    assert vo2.port("psd").startswith("tcp://127.0.0.1:")
    port = int(vo2.port("psd").rpartition(":")[2])
    with socket.socket() as probe, pytest.raises(OSError, match="refused"):
        probe.connect(("127.0.0.2", port))
