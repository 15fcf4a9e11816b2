"""The MeCom server: the maker's byte sequences, framing, and input that makes no sense."""

import struct
from binascii import crc_hqx

import pytest
from hypothesis import example, given, strategies as st

from bench.base import VirtualClock
from sim_devices.instruments.meerstetter_table import PARAMETERS, DeviceStatus
from sim_devices.instruments.meerstetter_tec import EmulatedTEC
from sim_devices.wire.mecom import LONGEST_FRAME, MeComServer
from sim_devices.world import World


class Block:
    """A block of metal at one temperature; whatever the output does, it is too large to change."""

    plate_temperature = struct.unpack(">f", bytes.fromhex("41CD2F28"))[0]
    sink_temperature = 22.0
    current = -0.5
    voltage = -1.25

    def regulate(self, target_celsius, current_limit=4.0):
        pass

    def terminals(self):
        return self.plate_temperature, self.sink_temperature, self.current, self.voltage

    def drive(self, current_ampere):
        pass

    def release(self):
        pass

    def advance(self, dt):
        pass


def make_server():
    block = Block()
    device = EmulatedTEC("tec", World(block, VirtualClock()), block)
    return MeComServer(device), device


@pytest.fixture
def server():
    return make_server()[0]


@pytest.fixture
def pair():
    return make_server()


def frame(payload, address=1, sequence=1):
    body = b"#%02X%04X" % (address, sequence) + payload
    return body + b"%04X\r" % crc_hqx(body, 0)


def content(answer):
    """Return the payload of one answer, after checking all that is around it."""
    assert answer[:1] == b"!"
    assert answer[-1:] == b"\r"
    assert int(answer[-5:-1], 16) == crc_hqx(answer[:-5], 0)
    return answer[7:-5]


@pytest.mark.parametrize(
    ("sent", "replied"),
    [
        # Meerstetter 5136AL, chapter 5, captured with a TEC-1089: identification, acknowledges, a value, an error.
        (b"#0015AA?IF62AE\r", b"!0015AA8065-TEC SW G01     7199\r"),
        (b"#0015AEVS07DA01000000028F97\r", b"!0015AE8F97\r"),
        (b"#0015AB?VR03E801C21A\r", b"!0015AB41CD2F28D5C2\r"),
        (b"#0015B0VS0BB80141AE0000C482\r", b"!0015B0C482\r"),
        (b"#0015AC?VR04D2017BFE\r", b"!0015AC+0532DA\r"),
        # Meerstetter 5117C: reset, and identification at address 1.
        (b"#00BDE2RS9780\r", b"!00BDE29780\r"),
        (b"#0115AA?IF257D\r", b"!0115AA8065-TEC SW G01     342D\r"),
    ],
)
def test_sequences_of_the_maker(server, sent, replied):
    assert server.receive(sent) == replied


def test_several_parameters_at_once(pair):
    server, device = pair
    values = content(server.receive(frame(b"?VX0503E80103E90103FC0103FD01006801")))
    temperature, sink, current, voltage, status = struct.unpack(">ffffi", bytes.fromhex(values.decode()))
    assert (sink, current, voltage, status) == (22.0, -0.5, -1.25, 1)
    assert temperature == device.read_parameter(1000)
    assert values[:8] == b"41CD2F28"
    assert server.receive(frame(b"?VX00")) == b"!010001" + frame(b"?VX00")[-5:]
    many = content(server.receive(frame(b"?VX20" + 32 * b"0BB801")))
    assert many == 32 * b"41C80000"


def test_big_data_are_the_one_element_of_a_parameter(pair):
    server, device = pair
    assert content(server.receive(frame(b"?VB0BB80100000000FFFF"))) == b"000100" + b"41C80000"
    assert content(server.receive(frame(b"?VB0BB80100000001FFFF"))) == b"000000"
    write = frame(b"VB0BB8010000000000010141AE0000")
    assert server.receive(write) == b"!010001" + write[-5:]
    assert device.read_parameter(3000) == 21.75


def test_limits_and_metadata(server):
    real = [struct.pack(">f", value).hex().upper().encode() for value in (0.0, 4.0)]
    assert content(server.receive(frame(b"?VL07EE01"))) == b"00" + real[0] + real[1]
    assert content(server.receive(frame(b"?VM07EE01", sequence=2))) == (
        b"00" + b"03" + b"02" + b"00000001" + real[0] + real[1] + real[1]
    )
    assert content(server.receive(frame(b"?VM006801", sequence=3))) == (
        b"01" + b"01" + b"01" + b"00000001" + b"00000000" + b"7FFFFFFF" + b"00000001"
    )


@pytest.mark.parametrize(
    ("payload", "error"),
    [
        (b"?XX", b"+01"),
        (b"", b"+01"),
        (b"?VR", b"+04"),
        (b"?VR03E8", b"+04"),
        (b"?VR03e801", b"+04"),
        (b"VS18B001-0000001", b"+04"),
        (b"VS0BB80141AE", b"+04"),
        (b"ES1", b"+04"),
        (b"CS", b"+04"),
        (b"?VR04D201", b"+05"),
        (b"VS03E80141AE0000", b"+06"),
        (b"VS0BB8017FC00000", b"+07"),
        (b"VS07DA0100000004", b"+07"),
        (b"VS080C013D4CCCCD", b"+07"),
        (b"?VR03E803", b"+08"),
        (b"?VR17D409", b"+08"),
        (b"VS080C023F800000", b"+08"),
        (b"?VX", b"+04"),
        (b"?VX0103E80103E901", b"+04"),
        (b"?VX0203E80104D201", b"+05"),
        (b"?VB0BB801", b"+04"),
        (b"VB0BB80100000000000101", b"+04"),
        (b"VB0BB801000000010001" + b"01" + b"41AE0000", b"+07"),
        (b"?VR\xff\xfe3E801", b"+04"),
    ],
)
def test_refusals(server, payload, error):
    assert content(server.receive(frame(payload))) == error


def test_answers_to_its_address_and_to_all_and_to_nobody_else(pair):
    server, device = pair
    assert server.receive(frame(b"?VR03E801", address=0))[:3] == b"!00"
    assert server.receive(frame(b"?VR03E801", address=2)) == b""
    assert server.receive(frame(b"VS0BB80141F00000", address=255)) == b""
    assert device.read_parameter(3000) == 30.0
    device.write_parameter(2051, 2)
    assert server.receive(frame(b"?VR03E801", address=2))[:3] == b"!02"
    assert server.receive(frame(b"?VR03E801", address=1)) == b""


@pytest.mark.parametrize(
    "spoilt",
    [
        b"#010001VS0BB80141F00000FFFF\r",
        b"#010001\r",
        b"\r\r",
        b"hello\r",
        frame(b"VS0BB80141F00000")[1:],
        b"!" + frame(b"VS0BB80141F00000")[1:],
        frame(b"VS0BB80141F00000").lower(),
    ],
)
def test_what_no_crc_vouches_for_is_dropped_in_silence(pair, spoilt):
    server, device = pair
    assert server.receive(spoilt) == b""
    assert device.read_parameter(3000) == 25.0
    assert server.receive(frame(b"?VR03E801")) != b""


def test_the_same_request_again_is_carried_out_again(pair):
    server, device = pair
    first = server.receive(frame(b"VS0BB80141F00000"))
    device.write_parameter(3000, 50.0)
    assert server.receive(frame(b"VS0BB80141F00000")) == first
    assert device.read_parameter(3000) == 30.0
    before = server.receive(frame(b"?VR006801"))
    device.trip(138)
    assert server.receive(frame(b"?VR006801")) != before


def test_the_watchdog_is_fed_by_any_valid_package_to_the_device():
    block, clock = Block(), VirtualClock()
    device = EmulatedTEC("tec", World(block, clock), block)
    server = MeComServer(device)
    device.write_parameter(2060, 1.0)
    for payload in (b"?VR006801", b"?VR04D201", b"?XX"):
        clock.sleep(0.8)
        server.receive(frame(payload))
    assert device.status is DeviceStatus.READY
    for _ in range(3):
        clock.sleep(0.8)
        server.receive(frame(b"?VR006801", address=9))
    assert device.status is DeviceStatus.ERROR


def test_every_parameter_goes_over_the_wire_and_back(pair):
    server, device = pair
    device.write_parameter(108, 1)
    for number, row in PARAMETERS.items():
        for instance in range(1, row.instances + 1):
            answer = content(server.receive(frame(b"?VR%04X%02X" % (number, instance))))
            kind = ">i" if row.kind == "INT32" else ">f"
            value = struct.unpack(kind, bytes.fromhex(answer.decode()))[0]
            assert value == pytest.approx(device.read_parameter(number, instance), abs=0, nan_ok=True)
            if row.writable and number != 2051:
                write = frame(b"VS%04X%02X" % (number, instance) + answer)
                assert server.receive(write) == b"!" + write[1:7] + write[-5:]


payloads = st.one_of(
    st.binary(max_size=40),
    st.from_regex(rb"(\?V[RLMBX]|V[SB]|ES|RS|SP|CS|\?IF)[0-9A-F+-]{0,32}", fullmatch=True),
    st.builds(
        lambda number, bits: b"VS%04X01%08X" % (number, bits),
        st.sampled_from(sorted(PARAMETERS)),
        st.integers(0, 2**32 - 1),
    ),
)
chunks = st.one_of(
    st.binary(max_size=200),
    st.builds(frame, payloads, st.sampled_from([0, 1, 2, 255]), st.integers(0, 0xFFFF)),
    st.just(b"#" * 700),
)


@given(st.lists(chunks, max_size=12))
@example([b"#0" * 400, b"\r"])
@example([b"#" + b"0" * 600, b"00\r"])
def test_any_bytes_do_no_harm(stream):
    server, device = make_server()
    for chunk in stream:
        for answer in server.receive(chunk).split(b"\r")[:-1]:
            assert answer.startswith(b"!")
        assert len(server._received) <= LONGEST_FRAME
    device.write_parameter(2051, 1)
    if server.receive(b"\r" + frame(b"?VR03E801", sequence=0)) == b"":
        pytest.fail("the server no longer answers")


@given(st.lists(payloads, min_size=1, max_size=5), st.data())
def test_how_the_bytes_are_split_does_not_matter(requests, data):
    whole, _ = make_server()
    pieces, _ = make_server()
    stream = b"".join(frame(each.replace(b"\r", b""), sequence=i) for i, each in enumerate(requests))
    answers, position = b"", 0
    while position < len(stream):
        step = data.draw(st.integers(1, 30))
        answers += pieces.receive(stream[position : position + step])
        position += step
    assert answers == whole.receive(stream)
