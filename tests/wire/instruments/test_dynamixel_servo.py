"""The emulated MX-28 and its bus: the maker's byte sequences, control table, motion, protections, nonsense."""

import itertools
import math
import struct
import warnings

import numpy as np
import pytest
import serial
from cases import cases
from hypothesis import example, given, strategies as st
from still_plant import Still

from bench.base import DeviceConnectionError, VirtualClock
from sim_devices.instruments.dynamixel import (
    REBOOT_TIME,
    EmulatedMX28,
)
from sim_devices.instruments.dynamixel_motion import NO_LOAD_SPEED_PER_VOLT, Trajectory
from sim_devices.instruments.dynamixel_table import (
    ACCELERATION_UNIT,
    COUNT,
    COUNTS_PER_TURN,
    ITEMS,
    VELOCITY_UNIT,
    ErrorNumber,
    HardwareError,
)
from sim_devices.instruments.emulated import RequestRefusedError
from sim_devices.protocol_emulated import register, unregister
from sim_devices.wire.dynamixel2 import LONGEST_FRAME, Dynamixel2Server, Instruction, crc16, frame
from sim_devices.world import World

TOP_SPEED = 12.0 * NO_LOAD_SPEED_PER_VOLT


class Spring:
    """Pulls the shaft back to `rest` by `rate` N·m/rad."""

    def __init__(self, rate, rest=math.pi):
        self.rate = rate
        self.rest = rest

    def torque(self, angle):
        return -self.rate * (angle - self.rest)

    def advance(self, dt):
        pass


def make_servos(*changes, clock=None):
    world = World(Still(), clock or VirtualClock())
    return [EmulatedMX28(f"servo-{number}", world, **keys) for number, keys in enumerate(changes)]


def make_servo(load=None, **changes):
    """Return a servo in extended position mode."""
    servo = EmulatedMX28("servo", World(Still(), VirtualClock()), load, **changes)
    servo.write_item(11, 4)
    return servo


def packet(text):
    """Return the bytes of a packet from hex digits without its header."""
    return bytes.fromhex("FFFFFD00" + text)


def status(servo_id, error=0, content=b""):
    return frame(servo_id, Instruction.STATUS, bytes((error,)) + content)


def refused(servo, address, data):
    with pytest.raises(RequestRefusedError) as caught:
        servo.write_bytes(address, data)
    return caught.value.reason


def refused_item(servo, address, value):
    with pytest.raises(RequestRefusedError) as caught:
        servo.write_item(address, value)
    return caught.value.reason


def wait(servo, seconds):
    servo.world.clock.sleep(seconds)
    servo.world.advance()


# The maker's byte sequences.


@pytest.fixture
def pair():
    """The two servos of the maker's examples."""
    keys = {"model_number": 1030, "firmware": 38}
    first, second = make_servos(
        {"bus_id": 1, "position": 166 * COUNT, "supply_voltage": 11.9, **keys},
        {"bus_id": 2, "position": 2079 * COUNT, "ambient_temperature": 36.0, **keys},
    )
    return Dynamixel2Server([second, first]), first, second


ACKNOWLEDGE = "01 04 00 55 00 A1 0C"


@pytest.mark.parametrize(
    ("sent", "replied"),
    [
        ("01 03 00 01 19 4E", ["01 07 00 55 00 06 04 26 65 5D"]),
        ("FE 03 00 01 31 42", ["01 07 00 55 00 06 04 26 65 5D", "02 07 00 55 00 06 04 26 6F 6D"]),
        ("01 07 00 02 84 00 04 00 1D 15", ["01 08 00 55 00 A6 00 00 00 8C C0"]),
        ("01 09 00 03 74 00 00 02 00 00 CA 89", [ACKNOWLEDGE]),
        ("01 06 00 03 62 00 05 68 E4", [ACKNOWLEDGE]),
        ("01 09 00 04 68 00 C8 00 00 00 AE 8E", [ACKNOWLEDGE]),
        ("01 04 00 06 01 A1 E6", [ACKNOWLEDGE]),
        ("01 03 00 08 2F 4E", [ACKNOWLEDGE]),
        (
            "FE 09 00 82 84 00 04 00 01 02 CE FA",
            ["01 08 00 55 00 A6 00 00 00 8C C0", "02 08 00 55 00 1F 08 00 00 BA BE"],
        ),
        ("FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87", []),
        (
            "FE 0D 00 92 01 90 00 02 00 02 92 00 01 00 1A 05",
            ["01 06 00 55 00 77 00 C3 69", "02 05 00 55 00 24 8B A9"],
        ),
        ("FE 10 00 93 01 20 00 02 00 A0 00 02 1F 00 01 00 50 B7 68", []),
    ],
)
def test_packets_of_the_maker(pair, sent, replied):
    assert pair[0].receive(packet(sent)) == b"".join(map(packet, replied))


@pytest.mark.parametrize(
    ("sent", "replied"),
    [
        # Recorded from an XL330 (ScrapMeta/microduck-diy): its id; an address that does not exist; a wrong CRC.
        ("01 07 00 02 07 00 01 00 22 B7", ["01 05 00 55 00 01 56 A1"]),
        ("01 07 00 02 FF FF 01 00 05 5B", ["01 04 00 55 07 B0 8C"]),
        ("01 03 00 01 3A 6C", []),
        # A replayed fixture (pkinney/robotis): torque on and off.
        ("01 06 00 03 40 00 01 DB 66", [ACKNOWLEDGE]),
        ("01 06 00 03 40 00 00 DE E6", [ACKNOWLEDGE]),
    ],
)
def test_exchanges_with_real_servos(pair, sent, replied):
    assert pair[0].receive(packet(sent)) == b"".join(map(packet, replied))


def test_goals_of_the_maker_arrive(pair):
    server, first, second = pair
    server.receive(packet("FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87"))
    assert (first.read_item(116), second.read_item(116)) == (150, 170)
    server.receive(packet("01 09 00 04 68 00 C8 00 00 00 AE 8E"))
    assert (first.read_item(69), first.read_item(104)) == (1, 0)
    assert server.receive(packet("01 03 00 05 02 CE")) == packet(ACKNOWLEDGE)
    assert (first.read_item(69), first.read_item(104)) == (0, 200)
    assert server.receive(packet("01 03 00 05 02 CE")) == status(1, ErrorNumber.INSTRUCTION)


def test_clearing_of_the_maker():
    (servo,) = make_servos({"position": 3.0 * COUNTS_PER_TURN * COUNT})
    server = Dynamixel2Server([servo])
    clear = packet("01 08 00 10 01 44 58 4C 22 B1 DC")
    servo.write_item(11, 4)
    servo.write_item(64, 1)
    servo.write_item(116, 10000)
    assert server.receive(clear) == status(1, ErrorNumber.RESULT_FAIL)
    wait(servo, 10.0)
    assert servo.read_item(132) == 10000
    assert server.receive(clear) == packet(ACKNOWLEDGE)
    assert servo.read_item(132) == servo.read_item(116) == 10000 % 4096


def test_fast_reads_of_the_maker():
    three, seven, four = make_servos(
        {"bus_id": 3, "position": 166 * COUNT},
        {"bus_id": 7, "position": 2079 * COUNT},
        {"bus_id": 4, "position": 1023 * COUNT, "ambient_temperature": 31.0},
    )
    server = Dynamixel2Server([three, four, seven])
    answer = server.receive(packet("FE 0A 00 8A 84 00 04 00 03 07 04 20 F2"))
    assert answer[:24] == packet("FE 19 00 55 00 03 A6 00 00 00 84 08 00 07 1F 08 00 00 16 CA")[:24]
    assert answer[24:30] == bytes.fromhex("0004FF030000")
    assert int.from_bytes(answer[30:], "little") == crc16(answer[:30])
    seven.write_item(11, 16)
    seven.write_item(100, 421)
    seven.write_item(64, 1)
    request = bytes.fromhex("0384000400 077C000200 0492000100")
    assert server.receive(frame(0xFE, 0x9A, request)) == packet(
        "FE 14 00 55 00 03 A6 00 00 00 67 A4 00 07 A5 01 24 74 00 04 1F D9 C1"
    )


def test_stuffing_on_the_way_in():
    (servo,) = make_servos({})
    server = Dynamixel2Server([servo])
    # A goal of 0x00FDFFFF has FF FF FD in it; it is out of range, and of the right length.
    sent = packet("01 0A 00 03 74 00 FF FF FD FD 00 21 E7")
    assert frame(1, 3, bytes.fromhex("7400FFFFFD00")) == sent
    assert server.receive(sent) == status(1, ErrorNumber.DATA_RANGE)


def test_stuffing_on_the_way_out():
    (servo,) = make_servos({"position": (0x00FDFFFF - 2048) * COUNT})
    servo.write_item(11, 4)
    servo.write_item(20, 2048)
    # Power-on has taken the turns off: move on by as many turns as are missing.
    servo._turns = 0
    answer = Dynamixel2Server([servo]).receive(frame(1, 2, bytes.fromhex("84000400")))
    assert answer == packet("01 09 00 55 00 FF FF FD FD 00") + answer[-2:]
    assert crc16(answer[:-2]) == int.from_bytes(answer[-2:], "little")


def test_fast_answer_ends_where_a_servo_is_missing():
    servos = make_servos({"bus_id": 1}, {"bus_id": 3})
    server = Dynamixel2Server(servos)
    whole = server.receive(frame(0xFE, 0x8A, bytes.fromhex("84000400 01 03")))
    cut = server.receive(frame(0xFE, 0x8A, bytes.fromhex("84000400 01 02 03")))
    assert len(whole) == 24
    assert len(cut) == 16
    assert server.receive(frame(0xFE, 0x8A, bytes.fromhex("84000400 02 01"))) == b""
    refusal = server.receive(frame(0xFE, 0x8A, bytes.fromhex("95000200 01")))
    assert refusal[8:12] == bytes((ErrorNumber.ACCESS, 1, 0, 0))


# The bus.


def test_damaged_packets_are_passed_over_in_silence(pair):
    server = pair[0]
    ping = packet("01 03 00 01 19 4E")
    for index in range(4, len(ping)):
        damaged = ping[:index] + bytes((ping[index] ^ 0x10,)) + ping[index + 1 :]
        # A damaged length makes it wait for more; the next header ends that.
        assert server.receive(damaged) == b""
        assert server.receive(ping) == packet("01 07 00 55 00 06 04 26 65 5D")


def test_others_are_not_answered_for(pair):
    server = pair[0]
    assert server.receive(frame(9, Instruction.PING)) == b""
    assert server.receive(frame(1, Instruction.STATUS, b"\x00")) == b""
    assert server.receive(frame(1, Instruction.SYNC_READ, bytes.fromhex("8400040001"))) == b""
    assert server.receive(frame(0xFE, Instruction.READ, bytes.fromhex("84000400"))) == b""


def test_instruction_that_does_not_exist(pair):
    server = pair[0]
    assert server.receive(frame(1, 0x77)) == status(1, ErrorNumber.INSTRUCTION)
    assert server.receive(frame(0xFE, 0x77)) == b""


@cases(("level", "answered"), [(0, {1}), (1, {1, 2}), (2, {1, 2, 3})])
def test_status_return_level(level, answered):
    (servo,) = make_servos({})
    server = Dynamixel2Server([servo])
    servo.write_item(68, level)
    for instruction, parameters in ((1, ""), (2, "84000400"), (3, "410001")):
        answer = server.receive(frame(1, instruction, bytes.fromhex(parameters)))
        assert bool(answer) is (instruction in answered)
    assert servo.read_item(65) == 1
    assert bool(server.receive(frame(0xFE, 0x82, bytes.fromhex("8400040001")))) is (2 in answered)


def test_write_to_all_and_bulk_write(pair):
    server, first, second = pair
    assert server.receive(frame(0xFE, Instruction.WRITE, bytes.fromhex("410001"))) == b""
    assert (first.read_item(65), second.read_item(65)) == (1, 1)
    # One that is refused does not keep the others from being carried out.
    assert (
        server.receive(frame(0xFE, Instruction.BULK_WRITE, bytes.fromhex("0180000400000000000241000100 00"))) == b""
    )
    assert (first.read_item(65), second.read_item(65)) == (1, 0)


@cases(
    ("instruction", "parameters"),
    [
        (0x82, ""),
        (0x82, "840004000101"),
        (0x83, "840004"),
        (0x83, "4100010001"),
        (0x83, "41000100010001"),
        (0x8A, "84000400"),
        (0x8A, "8400FF0301"),
        (0x92, "0184000400FF"),
        (0x93, "01410001"),
        (0x93, "0141000200 01"),
        (0x9A, "01"),
    ],
)
def test_packets_for_several_that_make_no_sense(pair, instruction, parameters):
    server, first, _ = pair
    assert server.receive(frame(0xFE, instruction, bytes.fromhex(parameters))) == b""
    assert first.read_item(65) == 0


def test_new_id_counts_from_the_next_packet_on():
    (servo,) = make_servos({})
    server = Dynamixel2Server([servo])
    assert server.receive(frame(1, 3, bytes.fromhex("070005"))) == status(1)
    assert server.receive(frame(1, 1)) == b""
    assert server.receive(frame(5, 1)) == status(5, 0, struct.pack("<HB", 30, 45))


def test_alert_comes_with_every_answer():
    (servo,) = make_servos({})
    server = Dynamixel2Server([servo])
    servo.trip(HardwareError.OVERLOAD)
    assert server.receive(frame(1, 1))[8] == 0x80
    assert server.receive(frame(1, 2, bytes.fromhex("46000100"))) == status(1, 0x80, b"\x20")
    assert server.receive(frame(1, 3, bytes.fromhex("410009"))) == status(1, 0x84)


def whole_packets():
    instructions = st.one_of(st.sampled_from(list(Instruction)).map(int), st.integers(0, 255))
    addresses = st.sampled_from(sorted(ITEMS)).map(lambda address: address.to_bytes(2, "little"))
    parameters = st.one_of(
        st.binary(max_size=24),
        st.tuples(addresses, st.binary(max_size=8)).map(b"".join),
        st.tuples(addresses, st.just(b"\x04\x00"), st.lists(st.integers(0, 3)).map(bytes)).map(b"".join),
    )
    return st.builds(frame, st.sampled_from((0, 1, 2, 0xFE)), instructions, parameters)


@given(st.lists(st.one_of(whole_packets(), st.binary(max_size=40)), max_size=12), st.integers(0, 3), st.booleans())
@example([b"\xff\xff\xfd\x00\x01\xff\x03"], 0, False)
@example([b"\xff\xff\xfd\x00\x01\xf9\x03" + bytes(990)], 1, True)
def test_no_bytes_upset_the_bus(pieces, pause, loaded):
    clock = VirtualClock()
    spring = Spring(1.0)
    world = World(spring, clock)
    servos = [EmulatedMX28(f"servo-{number}", world, spring if loaded else None, bus_id=number) for number in (1, 2)]
    server = Dynamixel2Server(servos)
    for piece in pieces:
        answer = server.receive(piece)
        assert isinstance(answer, bytes)
        assert len(server._received) <= LONGEST_FRAME
        clock.sleep(0.1 * pause)
    world.advance()
    for servo in servos:
        assert math.isfinite(servo.position)
        assert servo.deadline() > world.time


@given(st.lists(st.binary(max_size=60), max_size=6), st.binary(max_size=8))
@example([b"\xff\xff\xfd\x00\x01\x0c\x00"], b"")
@example([b"\xff\xff\xfd\x00\x01"], b"\xff\xff\xfd")
def test_noise_does_not_hide_a_packet(noise, last):
    (servo,) = make_servos({})
    server = Dynamixel2Server([servo])
    for piece in (*noise, last):
        server.receive(piece)
    assert server.receive(frame(1, Instruction.PING)).endswith(status(1, 0, struct.pack("<HB", 30, 45)))


@given(st.lists(whole_packets(), max_size=4), st.lists(st.integers(0, 200), max_size=8))
def test_pieces_do_not_matter(packets, cuts):
    stream = b"".join(packets)
    at_once = Dynamixel2Server(make_servos({})).receive(stream)
    edges = [0, *sorted(cut for cut in cuts if cut < len(stream)), len(stream)]
    server = Dynamixel2Server(make_servos({}))
    assert b"".join(server.receive(stream[a:b]) for a, b in itertools.pairwise(edges)) == at_once


# The maker's own software as the host.


@pytest.fixture
def sdk():
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=DeprecationWarning, module="dynamixel_sdk")
        return pytest.importorskip("dynamixel_sdk", reason="dynamixel-sdk is not installed")


@pytest.fixture
def bus(sdk):
    """Three servos, and the maker's software with its port at them."""
    clock = VirtualClock()
    servos = make_servos(
        *({"bus_id": number, "position": 1000 * number * COUNT} for number in (3, 1, 2)), clock=clock
    )
    url = register("sdk-bus", Dynamixel2Server(servos), clock)

    class UrlPort(sdk.PortHandler):
        def setupPort(self, cflag_baud):
            self.ser = serial.serial_for_url(self.port_name, baudrate=cflag_baud, timeout=0)
            self.is_open = True
            self.tx_time_per_byte = 1e4 / cflag_baud
            return True

    port = UrlPort(url)
    assert port.setBaudRate(4_000_000)
    yield sdk, sdk.PacketHandler(2.0), port, {servo.bus_id: servo for servo in servos}, clock
    port.closePort()
    unregister("sdk-bus")


def test_sdk_pings(bus):
    sdk, handler, port, _, _ = bus
    assert handler.ping(port, 2) == (30, sdk.COMM_SUCCESS, 0)
    assert handler.ping(port, 9)[1] == sdk.COMM_RX_TIMEOUT
    found, result = handler.broadcastPing(port)
    assert result == sdk.COMM_SUCCESS
    assert found == {1: [30, 45], 2: [30, 45], 3: [30, 45]}
    assert list(found) == [1, 2, 3]


def test_sdk_reads_writes_and_is_refused(bus):
    sdk, handler, port, servos, clock = bus
    assert handler.read4ByteTxRx(port, 2, 132) == (2000, sdk.COMM_SUCCESS, 0)
    assert handler.write1ByteTxRx(port, 2, 64, 1) == (sdk.COMM_SUCCESS, 0)
    assert handler.write4ByteTxRx(port, 2, 116, 3000) == (sdk.COMM_SUCCESS, 0)
    clock.sleep(3.0)
    assert handler.read4ByteTxRx(port, 2, 132) == (3000, sdk.COMM_SUCCESS, 0)
    for address, value, error in (
        (65, 7, 4),
        (11, 4, 7),
        (122, 1, 7),
        (60, 1, 7),
    ):
        result, refusal = handler.write1ByteTxRx(port, 2, address, value)
        assert (result, refusal) == (sdk.COMM_SUCCESS, error)
    assert handler.write2ByteTxRx(port, 2, 116, 0) == (sdk.COMM_SUCCESS, 5)
    assert handler.write4ByteTxRx(port, 2, 116, 4096) == (sdk.COMM_SUCCESS, 6)
    assert servos[2].read_item(116) == 3000


def test_sdk_reboot_clear_and_factory_reset(bus):
    sdk, handler, port, servos, clock = bus
    servos[1].trip(HardwareError.OVERLOAD)
    assert handler.read1ByteTxRx(port, 1, 70) == (0x20, sdk.COMM_SUCCESS, 0x80)
    assert handler.reboot(port, 1) == (sdk.COMM_SUCCESS, 0x80)
    assert handler.ping(port, 1)[1] == sdk.COMM_RX_TIMEOUT
    clock.sleep(REBOOT_TIME)
    assert handler.ping(port, 1) == (30, sdk.COMM_SUCCESS, 0)
    assert handler.clearMultiTurn(port, 1) == (sdk.COMM_SUCCESS, 0)
    servos[2].write_item(11, 4)
    assert handler.factoryReset(port, 2, 0x02) == (sdk.COMM_SUCCESS, 0)
    clock.sleep(REBOOT_TIME)
    assert handler.read1ByteTxRx(port, 2, 11) == (3, sdk.COMM_SUCCESS, 0)


# Control table.


def test_example_of_the_maker_for_indirect_data():
    """E-Manual, Indirect Address, Indirect Data: the LED, then a goal position in four bytes."""
    servo = make_servo()
    servo.write_item(168, 65)
    servo.write_item(224, 1)
    assert servo.read_item(65) == servo.read_bytes(224, 1)[0] == 1
    for place in range(4):
        servo.write_item(170 + 2 * place, 116 + place)
    servo.write_bytes(225, struct.pack("<i", 1024))
    assert servo.read_item(116) == 1024
    servo.write_bytes(224, b"\x00" + struct.pack("<i", -5))
    assert (servo.read_item(65), servo.read_item(116)) == (0, -5)


def test_indirect_addresses_are_lost_in_a_restart():
    servo = make_servo()
    servo.write_item(168, 65)
    servo.power_cycle()
    wait(servo, REBOOT_TIME)
    assert servo.read_item(168) == 224


@cases(
    ("address", "length"),
    [(14, 1), (130, 30), (147, 1), (167, 2), (252, 1), (577, 2), (660, 3), (65535, 4), (126, 65535)],
)
def test_reading_what_is_not_defined(address, length):
    (servo,) = make_servos({})
    with pytest.raises(RequestRefusedError) as caught:
        servo.read_bytes(address, length)
    assert caught.value.reason is ErrorNumber.ACCESS


@cases(
    ("address", "value"),
    [
        (7, 253), (9, 255), (10, 4), (11, 0), (11, 5), (12, 254), (13, 1), (20, 1_044_480), (31, 101), (32, 49),
        (34, 161), (36, 886), (44, 1024), (48, 4096), (63, 2), (63, 64), (64, 2), (68, 3), (98, -1), (98, -128),
        (100, 886), (104, -1024), (108, 32768), (112, 32768), (116, -1_048_576),
    ],
)  # fmt: skip
def test_values_out_of_their_range(address, value):
    servo = make_servo()
    before = servo.read_item(address)
    assert refused_item(servo, address, value) is ErrorNumber.DATA_RANGE
    assert servo.read_item(address) == before


def test_values_beyond_limits_that_are_set():
    servo = make_servo()
    for address, value in ((36, 500), (40, 100), (44, 50)):
        servo.write_item(address, value)
    assert servo.read_item(100) == 500
    for address, value in ((100, 501), (104, -51), (108, 101), (112, 51)):
        assert refused_item(servo, address, value) is ErrorNumber.DATA_LIMIT
        servo.write_item(address, value - 1 if value > 0 else value + 1)
    servo.write_item(11, 3)
    assert refused_item(servo, 116, 4096) is ErrorNumber.DATA_LIMIT
    assert refused_item(servo, 116, -1) is ErrorNumber.DATA_LIMIT


def test_writes_are_of_whole_items_and_all_or_nothing():
    servo = make_servo()
    assert refused(servo, 116, b"\x00\x00") is ErrorNumber.DATA_LENGTH
    assert refused(servo, 117, b"\x00\x00\x00") is ErrorNumber.DATA_LENGTH
    assert refused(servo, 116, b"") is ErrorNumber.DATA_LENGTH
    assert refused(servo, 102, b"\x00") is ErrorNumber.ACCESS
    assert refused(servo, 132, bytes(4)) is ErrorNumber.ACCESS
    assert refused(servo, 108, struct.pack("<IIi", 5, 40, 2_000_000)) is ErrorNumber.DATA_RANGE
    assert servo.read_item(108) == 0
    servo.write_bytes(108, struct.pack("<IIi", 5, 40, -3000))
    assert [servo.read_item(address) for address in (108, 112, 116)] == [5, 40, -3000]


def test_eeprom_is_locked_by_the_torque_and_counts_its_wear():
    servo = make_servo()
    writes = servo.eeprom_writes
    servo.write_item(31, 70)
    servo.write_item(31, 70)
    assert servo.eeprom_writes == writes + 2
    servo.write_item(64, 1)
    for address in (7, 11, 31, 63):
        assert refused_item(servo, address, servo.read_item(address)) is ErrorNumber.ACCESS
    servo.write_item(64, 0)
    servo.reboot()
    wait(servo, REBOOT_TIME)
    assert (servo.read_item(31), servo.read_item(11)) == (70, 4)
    assert servo.eeprom_writes == writes + 2


def test_reboot_forgets_ram_and_turns():
    servo = make_servo(position=2.25 * COUNTS_PER_TURN * COUNT)
    servo.write_item(64, 1)
    servo.write_item(112, 100)
    servo.write_item(116, -5000)
    wait(servo, 10.0)
    servo.write_item(68, 1)
    where = servo.position
    servo.reboot()
    assert not servo.answering
    wait(servo, 0.99 * REBOOT_TIME)
    assert not servo.answering
    with pytest.raises(DeviceConnectionError, match="does not answer"):
        servo.measure()
    wait(servo, 0.01 * REBOOT_TIME)
    assert servo.answering
    assert servo.position == where
    assert servo.read_item(132) == servo.read_item(116) == -5000 % 4096
    assert [servo.read_item(address) for address in (64, 68, 98, 112)] == [0, 2, 0, 0]


def test_homing_offset_and_reverse_mode():
    servo = make_servo()
    servo.write_item(20, 100)
    assert servo.read_item(132) == servo.read_item(116) == 2148
    servo.write_item(10, 1)
    assert servo.read_item(132) == -2048 % 4096 + 100
    servo.write_item(64, 1)
    servo.write_item(112, 100)
    servo.write_item(116, servo.read_item(132) + 1000)
    wait(servo, 0.2)
    assert servo.read_item(128) == 100
    wait(servo, 5.0)
    assert servo.read_item(132) == 3148
    assert servo.position == pytest.approx(math.pi - 1000 * COUNT)


def test_change_of_mode_resets_the_profile():
    servo = make_servo(position=20.0)
    servo.write_item(108, 5)
    servo.write_item(112, 50)
    servo.write_item(100, 400)
    servo.write_item(11, 3)
    assert [servo.read_item(address) for address in (108, 112, 100)] == [0, 0, 885]
    assert 0 <= servo.read_item(132) < 4096


# Motion.


@given(
    st.floats(-50.0, 50.0),
    st.floats(-6.0, 6.0),
    st.floats(-50.0, 50.0),
    st.floats(0.02, 6.0),
    st.floats(0.3, 1000.0),
)
@example(0.0, 5.0, 0.1, 1.0, 1.0)
@example(0.0, 5.0, 0.0, 1.0, 1.0)
@example(0.0, -2.0, 30.0, 1.0, 0.5)
def test_profiles_are_smooth_and_keep_their_limits(origin, initial, target, velocity, acceleration):
    trajectory = Trajectory.to_position(10.0, origin, initial, target, velocity, acceleration)
    assert trajectory.at(10.0) == pytest.approx((origin, initial if trajectory.pieces else 0.0), abs=1e-9)
    assert trajectory.at(trajectory.end) == (target, 0.0)
    edges = np.cumsum([10.0, *(duration for duration, _, _ in trajectory.pieces)])
    for edge in edges[1:]:
        before, after = trajectory.at(edge - 1e-9), trajectory.at(edge + 1e-9)
        assert before[0] == pytest.approx(after[0], abs=1e-6)
        assert before[1] == pytest.approx(after[1], abs=1e-4)
    fastest = max(velocity, abs(initial))
    for instant in np.linspace(10.0, trajectory.end, 50):
        assert abs(trajectory.at(instant)[1]) <= fastest * (1.0 + 1e-9) + 1e-9


def test_trapezoidal_motion_takes_its_time_to_the_digit():
    servo = make_servo()
    for address, value in ((108, 10), (112, 42), (64, 1)):
        servo.write_item(address, value)
    velocity, acceleration = 42 * VELOCITY_UNIT, 10 * ACCELERATION_UNIT
    start = servo.world.time
    servo.write_item(116, 2048 + 4096)
    expected = 4096 * COUNT / velocity + velocity / acceleration
    wait(servo, expected - 1e-6)
    assert (servo.read_item(122), servo.read_item(123)) == (1, 0x32)
    wait(servo, 2e-6)
    assert (servo.read_item(122), servo.read_item(123)) == (0, 0x31)
    assert servo.read_item(132) == 2048 + 4096
    assert servo.world.time - start == pytest.approx(expected, abs=1e-5)


@cases(
    ("acceleration", "velocity", "distance", "profile", "seconds"),
    [
        (0, 0, 1000, 0x00, 1000 * COUNT / TOP_SPEED),
        (5, 0, 1000, 0x00, 1000 * COUNT / TOP_SPEED),
        (0, 42, 1000, 0x10, 1000 * COUNT / (42 * VELOCITY_UNIT)),
        (1, 42, 100, 0x20, 2.0 * math.sqrt(100 * COUNT / ACCELERATION_UNIT)),
        (0, 380, 1000, 0x10, 1000 * COUNT / TOP_SPEED),
    ],
)
def test_kinds_of_profile(acceleration, velocity, distance, profile, seconds):
    servo = make_servo()
    for address, value in ((108, acceleration), (112, velocity), (64, 1), (116, 2048 - distance)):
        servo.write_item(address, value)
    wait(servo, 0.5 * seconds)
    assert servo.read_item(123) == profile | 0x02
    assert servo.read_item(132) == 2048 - distance // 2
    assert servo.read_item(140) == 2048 - distance // 2
    wait(servo, 0.501 * seconds)
    assert servo.read_item(132) == 2048 - distance
    assert servo.read_item(123) == profile | 0x01


# Protections and the watchdog.


def arm(servo, units):
    """Start a motion under the watchdog; return its velocity."""
    for address, value in ((112, 42), (98, units), (64, 1), (116, 500_000)):
        servo.write_item(address, value)
    return 42 * VELOCITY_UNIT


@cases("units", [1, 5, 127])
def test_watchdog_stops_the_shaft_at_its_instant(units):
    servo = make_servo()
    velocity = arm(servo, units)
    silence = units * 0.02
    clock = servo.world.clock
    clock.sleep(silence - 1e-9)
    servo.world.advance()
    assert servo._values[98] == units
    clock.sleep(1000.0)
    servo.world.advance()
    assert servo.position == pytest.approx(math.pi + velocity * silence, abs=1e-9)
    assert servo.read_bytes(98, 1) == b"\xff"
    assert servo.read_item(98) == -1
    assert servo.read_item(64) == 1
    assert servo.read_item(116) == servo.read_item(132)
    assert (servo.read_item(122), servo.read_item(128)) == (0, 0)


def test_expired_watchdog_takes_no_goals_until_it_is_cleared():
    servo = make_servo()
    arm(servo, 5)
    wait(servo, 1.0)
    for address in (100, 104, 116):
        assert refused_item(servo, address, 0) is ErrorNumber.DATA_RANGE
    assert refused_item(servo, 98, 5) is ErrorNumber.DATA_RANGE
    servo.write_item(112, 50)
    servo.write_item(98, 0)
    servo.write_item(116, 3000)
    wait(servo, 5.0)
    assert servo.read_item(132) == 3000


@cases(("offset", "mode", "runs"), [(0, 4, False), (100, 4, True), (-100, 4, True), (100, 1, False)])
def test_expired_watchdog_with_a_homing_offset_makes_it_run_away(offset, mode, runs):
    """ROBOTIS DynamixelSDK, issue 584."""
    servo = make_servo()
    servo.write_item(20, offset)
    servo.write_item(11, mode)
    arm(servo, 10)
    clock = servo.world.clock
    clock.sleep(0.2)
    servo.world.advance()
    start = servo.position
    clock.sleep(100.0)
    servo.world.advance()
    turned = servo.position - start
    assert (abs(turned) > 500.0) is runs
    assert turned * offset >= 0.0
    assert refused(servo, 116, bytes(4)) is ErrorNumber.DATA_RANGE
    servo.write_item(64, 0)
    start = servo.position
    clock.sleep(1.0)
    servo.world.advance()
    assert servo.position == start


def test_any_packet_on_the_bus_feeds_the_watchdog():
    servos = make_servos({"bus_id": 1}, {"bus_id": 2})
    server = Dynamixel2Server(servos)
    for servo in servos:
        servo.write_item(11, 4)
        arm(servo, 10)
    clock = servos[0].world.clock
    for instruction in (1, 2, 0x77, 3, 5):
        clock.sleep(0.15)
        server.receive(frame(1, instruction, bytes.fromhex("84000400") if instruction == 2 else b""))
    servos[0].world.advance()
    # Those for the other servo as well (e-Manual, Bus Watchdog: all instruction packets); a damaged one does not.
    assert [servo._values[98] for servo in servos] == [10, 10]
    clock.sleep(0.15)
    server.receive(frame(1, 1)[:-1] + b"\x00")
    clock.sleep(0.1)
    servos[0].world.advance()
    assert [servo._values[98] for servo in servos] == [-1, -1]


def test_overheating_shuts_down():
    servo = make_servo()
    servo.write_item(64, 1)
    servo.heat(80.0)
    assert not servo.alert
    servo.heat(81.0)
    assert servo.read_item(70) == HardwareError.OVERHEATING
    assert servo.read_item(64) == 0
    servo.reboot()
    wait(servo, REBOOT_TIME)
    assert servo.alert
    wait(servo, 600.0)
    servo.reboot()
    wait(servo, REBOOT_TIME)
    assert not servo.alert
