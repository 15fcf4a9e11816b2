"""Clients in this process, instruments in another: connections over TCP, and what a line costs in time.

What serial lines carry and survive is tested on every protocol in `tests/wire/clients`.
"""

import random
import socket
import struct
from contextlib import suppress

import pytest

IDENTIFY = b"#0115AA?IF257D\r"
IDENTITY = b"!0115AA8065-TEC SW"
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


def test_garbage_on_tcp_ends_only_its_connection(vo2, connect):
    keeper, rude = connect(vo2.port("psd")), connect(vo2.port("psd"))
    with suppress(ConnectionError):
        rude.sendall(random.Random(6).randbytes(3000))
        while rude.recv(4096):
            pass
    assert product(keeper) == 7.0


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
    from bench.base import Stopwatch

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
