"""The clients of Modbus: frames, and answers that are in pieces, belong to nothing, or refuse."""

import pytest
import serial
from cases import cases
from faulty_line import InPieces
from still_plant import sealed

from drivers.modbus import (
    NoReplyError,
    RefusedError,
    RtuClient,
    TcpClient,
    UnexpectedReplyError,
    crc16,
    exception_text,
    is_reply_to,
    pack,
    read_frame,
    read_request,
    reply_length,
    swapped,
    unpack,
    write_frame,
    write_request,
)
from drivers.pymodbus_client import SerialClient
from drivers.serial_line import MOST_STRAY, SerialSettings, open_port, settle_line
from sim_devices.protocol_emulated import register, unregister
from sim_devices.wire import WireServer

BLOCK = read_request(0x3500, 5)


class Answers(WireServer):
    """Answers one request after the other, and keeps what it received."""

    def __init__(self, *answers):
        self.answers = [answer if isinstance(answer, bytes) else bytes.fromhex(answer) for answer in answers]
        self.received = []

    def receive(self, data):
        self.received.append(data)
        return self.answers.pop(0) if self.answers else b""


@pytest.fixture
def plug(clock):
    """Plug an instrument in; return a port of pyserial to it."""
    ports = []

    def plug(server, timeout=0.2):
        register("modbus", server, clock)
        ports.append(serial.serial_for_url("emulated://modbus", baudrate=1_000_000, timeout=timeout))
        return ports[-1]

    yield plug
    for port in ports:
        port.close()
    unregister("modbus")


def test_requests_of_the_specification():
    # MODBUS Application Protocol Specification V1.1b3: 6.3, 6.4, 6.12; LabJack, Protocol Details.
    assert read_request(0x006B, 3) == bytes.fromhex("03 006B 0003")
    assert read_request(0x0008, 1, 4) == bytes.fromhex("04 0008 0001")
    assert write_request(0x0001, bytes.fromhex("000A 0102")) == bytes.fromhex("10 0001 0002 04 000A 0102")
    assert read_frame(40000, 2) == bytes.fromhex("00 9C40 02")
    assert write_frame(40000, bytes(4)) == bytes.fromhex("01 9C40 02 00000000")
    assert crc16(bytes.fromhex("01 03 35 00 00 05")) == bytes.fromhex("8A 05")
    assert crc16(b"") == b"\xff\xff"
    assert crc16(bytes(range(256))) == bytes.fromhex("DE6C")[::-1]


def test_exceptions_of_the_specification():
    names = [
        *("illegal function", "illegal data address", "illegal data value", "device failure", "acknowledge"),
        *("device busy", "negative acknowledge", "memory parity error", "unknown", "gateway path unavailable"),
        *("gateway target does not respond", "unknown"),
    ]
    assert [exception_text(code, "reading") for code in range(1, 13)] == [
        f"Modbus exception {code} ({name}) on reading" for code, name in enumerate(names, 1)
    ]


def test_values_in_registers():
    assert pack("fi", 2.5, -2) == [0x4020, 0, 0xFFFF, 0xFFFE]
    assert unpack("fi", [0x4020, 0, 0xFFFF, 0xFFFE]) == (2.5, -2)
    known = [0x1234, 0x5678]
    assert "words of a value" in swapped([0x5678, 0x1234], lambda order: list(order) == known)
    assert "bytes of a word" in swapped([0x3412, 0x7856], lambda order: list(order) == known)
    assert swapped(known[::-1], lambda _: False) == ""


@cases(
    ("head", "length"),
    [("0103 0A", 15), ("0104 02", 7), ("0110 20", 8), ("0106 20", 8), ("0183 02", 5), ("014C 09", 5), ("0105 09", 5)],
)
def test_length_of_a_reply(head, length):
    assert reply_length(bytes.fromhex(head)) == length


def test_form_of_a_reply():
    assert is_reply_to(BLOCK, 12, bytes(2 + 13).replace(b"\0", b"\3"))
    assert not is_reply_to(BLOCK, 12, b"\3" * 14)
    assert not is_reply_to(BLOCK, 12, b"\4" * 15)
    assert is_reply_to(BLOCK, 12, bytes.fromhex("01 83 02 0000"))
    assert not is_reply_to(BLOCK, 12, bytes.fromhex("01 84 02 0000"))


# Modbus TCP


GOOD = "0001 0000 0007 01 03 04 1234 5678"


@pytest.mark.parametrize("place", range(13))
def test_an_answer_of_tcp_in_pieces(clock, plug, place):
    client = TcpClient(plug(InPieces(Answers(GOOD), clock, place, 0.05)))
    begin = clock.now()
    assert client.read(0, 2) == bytes.fromhex("1234 5678")
    assert clock.now() - begin < 0.06


@pytest.mark.parametrize(
    "wrong",
    [
        "0002 0000 0007 01 03 04 1234 5678",
        "0001 0001 0007 01 03 04 1234 5678",
        "0001 0000 0007 02 03 04 1234 5678",
        "0001 0000 0007 01 04 04 1234 5678",
        "0001 0000 0008 01 03 04 1234 5678",
        "0001 0000 0005 01 03 02 1234",
        "0001 0000 0007 01 03 02 1234 5678",
        "0002 0000 0003 01 83 02",
        "0001 0000 0003 01 84 02",
        "0001 0000 0007 01 03 04 1234 56",
        "",
        "0001 0000",
    ],
)
def test_an_answer_of_tcp_that_belongs_to_nothing(plug, wrong):
    with pytest.raises(OSError, match=r"answer|bytes"):
        TcpClient(plug(Answers(wrong))).read(0, 2)


@pytest.mark.parametrize("expected", [2, 20])
def test_a_refusal_of_tcp(clock, plug, expected):
    client = TcpClient(plug(Answers("0001 0000 0003 01 83 0B")))
    begin = clock.now()
    with pytest.raises(RefusedError) as caught:
        client.request(BLOCK, expected)
    assert caught.value.code == 11
    assert clock.now() == pytest.approx(begin, abs=1e-3)


def test_transactions_of_tcp_begin_again(plug):
    server = Answers("FFFF 0000 0007 01 03 04 1234 5678", "0000 0000 0007 01 03 04 1234 5678")
    client = TcpClient(plug(server))
    client._transaction = 0xFFFE
    for _ in range(2):
        client.read(0, 2)
    assert [request[:2].hex() for request in server.received] == ["ffff", "0000"]
    assert server.received[0][2:] == bytes.fromhex("0000 0006 01 03 0000 0002")


def test_echo_of_a_write(plug):
    echoes = "0001 0001", "0002 0001", "0001 0002"
    answers = [f"000{number} 0000 0006 01 10 {echo}" for number, echo in enumerate(echoes, 1)]
    client = TcpClient(plug(Answers(*answers)))
    client.write(1, b"\0\1")
    for _ in range(2):
        with pytest.raises(OSError, match="is none to the request 10 00 01 00 01 02 00 01"):
            client.write(1, b"\0\1")


# Modbus RTU, by either client


@pytest.fixture(params=["ours", "pymodbus"])
def client(request, plug, clock):
    """Return what makes a client of address 1 of an instrument."""
    made = []

    def client(server):
        if request.param == "ours":
            made.append(RtuClient(plug(server), 1))
        else:
            plug(server)
            settings = SerialSettings(port="emulated://modbus", baudrate=1_000_000, timeout=0.2)
            made.append(SerialClient(open_port("load", settings), settings, 1, "N"))
        return made[-1]

    yield client
    for each in made:
        each.close()


VALUES = "4140 0000 4138 0000 0030"
REPLY = sealed("01 03 0A" + VALUES)
STRAY = sealed("01 03 04 0000 0000")


def test_bytes_on_the_line(client):
    server = Answers(REPLY, sealed("01 10 2106 0002"), sealed("01 06 2061 0008"))
    made = client(server)
    assert made.read(0x3500, 5) == bytes.fromhex(VALUES)
    made.write(0x2106, bytes.fromhex("0000 0003"))
    made.write_one(0x2061, 8)
    assert server.received == [
        bytes.fromhex("01 03 35 00 00 05 8A 05"),
        sealed("01 10 2106 0002 04 0000 0003"),
        bytes.fromhex("01 06 20 61 00 08 D2 12"),
    ]


@pytest.mark.parametrize("place", range(15))
def test_a_reply_in_pieces(client, clock, place):
    made = client(InPieces(Answers(REPLY), clock, place, 0.05))
    begin = clock.now()
    assert made.read(0x3500, 5) == bytes.fromhex(VALUES)
    assert clock.now() - begin < 0.06


@pytest.mark.parametrize("place", range(5))
def test_a_refusal_in_pieces(client, clock, place):
    made = client(InPieces(Answers(sealed("01 83 02")), clock, place, 0.05))
    begin = clock.now()
    with pytest.raises(RefusedError) as caught:
        made.read(0x3500, 5)
    assert caught.value.code == 2
    assert clock.now() - begin < 0.06


@pytest.mark.parametrize("strays", [1, 7])
def test_replies_of_another_form_are_passed_over(client, strays):
    assert client(Answers(STRAY * strays + REPLY)).read(0x3500, 5) == bytes.fromhex(VALUES)


def test_only_replies_of_another_form(client):
    with pytest.raises(UnexpectedReplyError, match=r"6 bytes where 12 were expected \(function 3 was .*, 3 answered"):
        client(Answers(STRAY)).read(0x3500, 5)


@pytest.mark.parametrize(
    "wrong", [b"", REPLY[:4], REPLY[:-1], REPLY[:-1] + b"\0", b"\2" + REPLY[1:], sealed("02 03 0A" + VALUES)]
)
def test_no_good_reply(client, wrong):
    with pytest.raises(NoReplyError):
        client(Answers(wrong)).read(0x3500, 5)


@pytest.mark.parametrize("wrong", ["01 10 2107 0002", "01 10 2106 0003"])
def test_echo_of_another_write(client, wrong):
    with pytest.raises(OSError, match="is none to the request"):
        client(Answers(sealed(wrong))).write(0x2106, bytes.fromhex("0000 0003"))


def test_what_comes_before_a_request_is_forgotten(client):
    made = client(Answers(REPLY))
    port = made._line.socket if isinstance(made, SerialClient) else made._port
    port._received += STRAY
    assert made.read(0x3500, 5) == bytes.fromhex(VALUES)


def test_a_line_is_settled_when_nothing_comes_for_a_while(client, clock):
    made = client(Answers())
    port = made._line.socket if isinstance(made, SerialClient) else made._port
    port._received += b"\xa5" * 1024
    begin = clock.now()
    made.settle(0.05)
    assert clock.now() - begin == pytest.approx(0.05)
    assert port.in_waiting == 0
    assert port.timeout == 0.2


@pytest.mark.parametrize(("quantity", "is_settled"), [(MOST_STRAY - 256, True), (MOST_STRAY, False)])
def test_a_line_that_does_not_fall_silent(plug, quantity, is_settled):
    port = plug(Answers())
    port._received += b"\xa5" * quantity
    if is_settled:
        settle_line(port, 0.05)
    else:
        with pytest.raises(OSError, match="does not fall silent"):
            settle_line(port, 0.05)
    assert port.timeout == 0.2


def test_a_line_that_was_closed_stays_closed(client, clock):
    made = client(Answers())
    made.close()
    assert not made.is_open
    with pytest.raises(OSError, match=r"[Pp]ort|closed|connect"):
        made.read(0x3500, 5)
    if isinstance(made, SerialClient):
        with pytest.raises(ConnectionError, match="the line is closed"):
            made.settle(0.05)
