"""The driver of the Roboteq controllers, against a scripted adapter and node at the other end of its line."""

import math

import pytest
import serial
from cases import cases
from faulty_line import InPieces
from hypothesis import given, strategies as st
from refusals import blamed

from bench.base import ConfigurationError, DeviceConnectionError, DeviceError, DeviceRestartedError, VirtualClock
from drivers.roboteq import ABORT_CODES, RoboteqSupply, supply as driver
from drivers.roboteq.canopen import NodeLine
from drivers.roboteq.process_data import ProcessData
from drivers.roboteq.supply import _POWER, _VOLTS
from sim_devices.protocol_emulated import register, unregister
from sim_devices.wire import WireServer

PORT = "emulated://scripted-supply"
QUERIES = 0x40


def line(identifier, data):
    return b"t%03X%d%s\r" % (identifier, len(data), bytes(data).hex().upper().encode())


class Script(WireServer):
    """An adapter and a node of a few lines: objects, what was received, and answers put into its mouth.

    It refuses to configure process data.

    `objects` holds (value, size) by index and subindex; `instead`, request by request, lines to send in place
    of the right one (None for the right one); `aborts` abort codes by index and subindex.
    """

    def __init__(self):
        self.objects = {
            (0x1000, 0): (0x000F0191, 4),
            (0x1018, 1): (0x2A, 4),
            (0x1017, 0): (100, 2),
            (0x2100, 1): (12, 2),
            (0x2102, 1): (0, 2),
            (0x210D, 2): (240, 2),
            (0x2112, 0): (0, 1),
            (0x2122, 1): (0, 4),
        }
        self.texts = {0x1008: b"Roboteq", 0x1009: b"A", 0x100A: b"v2.0"}
        self.received = []
        self.adapter = []
        self.instead = []
        self.before = b""
        self.aborts = {}
        self.silent = False
        self.follow = True
        self.rest = b""
        self.node = 1

    def receive(self, data):
        *lines, self.rest = (self.rest + data).split(b"\r")
        return b"".join(self.obey(line) for line in lines)

    def obey(self, text):
        if not text.startswith(b"t"):
            self.adapter.append(text)
            return b"\r"
        assert len(text) == 21
        assert text[4:5] == b"8"
        identifier, data = int(text[1:4], 16), bytes.fromhex(text[5:].decode())
        self.received.append((identifier, data))
        if self.silent or identifier != 0x600 + self.node:
            return b"z\r"
        right = line(0x580 + self.node, self.answer(data))
        sent, self.before = self.before, b""
        if self.instead:
            other = self.instead.pop(0)
            if other is not None:
                return sent + (other(right) if callable(other) else other)
        return sent + b"z\r" + right

    def answer(self, data):
        command, key = data[0], (int.from_bytes(data[1:3], "little"), data[3])
        if command >> 5 == 3:
            part, self.text = self.text[:7], self.text[7:]
            head = (command & 0x10) | (7 - len(part)) << 1 | (not self.text)
            return bytes((head,)) + part.ljust(7, b"\0")
        if key in self.aborts:
            return b"\x80" + data[1:4] + self.aborts[key].to_bytes(4, "little")
        if command == QUERIES:
            if key[0] in self.texts and key[1] == 0:
                self.text = self.texts[key[0]]
                return b"\x41" + data[1:4] + len(self.text).to_bytes(4, "little")
            if key not in self.objects:
                return b"\x80" + data[1:4] + (0x06020000).to_bytes(4, "little")
            value, size = self.objects[key]
            raw = (value & (1 << 8 * size) - 1).to_bytes(size, "little")
            return bytes((0x43 | (4 - size) << 2,)) + data[1:4] + raw.ljust(4, b"\0")
        if 0x1400 <= key[0] < 0x1C00:
            return b"\x80" + data[1:4] + (0x06010000).to_bytes(4, "little")
        if key[0] == 0x2000 and (0x2102, key[1]) not in self.objects:
            return b"\x80" + data[1:4] + (0x06090011).to_bytes(4, "little")
        if key[0] == 0x2000 and self.follow:
            self.objects[0x2102, key[1]] = (int.from_bytes(data[4:], "little", signed=True), 2)
        if key[0] == 0x1017:
            self.objects[key] = (int.from_bytes(data[4:6], "little"), 2)
        return b"\x60" + data[1:4] + bytes(4)

    def orders(self):
        """Return all that was written but the process data's configuration: index, subindex and value."""
        return [
            (int.from_bytes(data[1:3], "little"), data[3], int.from_bytes(data[4:], "little", signed=True))
            for _, data in self.received
            if data[0] >> 5 == 1 and not 0x1400 <= int.from_bytes(data[1:3], "little") < 0x1C00
        ]


def make_settings(**changes):
    keys = {"port": PORT, "output": "average", "voltage_limits": (0, 12), "heartbeat": 60}
    return RoboteqSupply.Settings(**keys | changes)


@pytest.fixture
def connect(clock):
    devices = []

    def connect(how=RoboteqSupply.connect, **changes):
        device = how("supply", make_settings(**changes), clock)
        devices.append(device)
        return device

    yield connect
    for device in devices:
        device.close()


@pytest.fixture
def supply(script, connect):
    supply = connect()
    script.received.clear()
    script.adapter.clear()
    return supply


def test_bytes_of_opening_and_closing(script, connect):
    supply = connect()
    assert [text for text in script.adapter if text] == [b"C", b"S4", b"O", b"O"]
    supply.close()
    assert script.adapter[-1] == b"C"
    connect(bitrate=500_000)
    assert b"S6" in script.adapter


def test_bytes_of_connecting(script, connect):
    connect()
    sent = [data.hex(" ").upper() for _, data in script.received]
    assert {identifier for identifier, _ in script.received} == {0x601}
    assert sent[:2] == ["40 08 10 00 00 00 00 00", "60 00 00 00 00 00 00 00"]
    assert "23 00 20 01 00 00 00 00" in sent
    assert script.orders() == [(0x2000, 1, 0), (0x2000, 2, 0), (0x2000, 3, 0)]


def test_bytes_of_a_set_point_and_a_measurement(script, supply):
    supply.set(6.0)
    assert script.received[-1] == (0x601, bytes.fromhex("23002001FA000000"))
    assert script.orders() == [(0x2000, 1, 250)]
    script.received.clear()
    assert supply.measure() == {"supply_voltage": 6.0, "supply_current": 1.2}
    assert [data.hex(" ").upper() for _, data in script.received] == [
        # A value that is new has to come twice.
        "40 02 21 01 00 00 00 00",
        "40 02 21 01 00 00 00 00",
        "40 0D 21 02 00 00 00 00",
        "40 00 21 01 00 00 00 00",
        "40 12 21 00 00 00 00 00",
        "40 22 21 01 00 00 00 00",
        "23 00 20 01 FA 00 00 00",
    ]


def test_bytes_of_the_emergency_stop_and_its_release(script, supply):
    supply.set(6.0)
    script.received.clear()
    supply.emergency_stop()
    assert supply.setpoint == 0.0
    assert script.received == [(0x601, bytes.fromhex("2F0C200001000000"))]
    script.received.clear()
    supply.release()
    assert script.orders() == [(0x2000, 1, 0), (0x200D, 0, 1), (0x2000, 1, 0)]


def test_node_and_channel(script, connect):
    script.node = 77
    script.objects |= {(index, 2): script.objects[index, 1] for index in (0x2100, 0x2102, 0x2122)}
    supply = connect(node=77, channel=2)
    supply.set(6.0)
    supply.safe()
    assert {identifier for identifier, _ in script.received} == {0x64D}
    assert script.orders()[-3:] == [(0x2000, 2, 250), (0x2000, 2, 0), (0x200E, 0, 2)]


def test_channel_that_is_not_there(script, connect):
    with pytest.raises(ConfigurationError, match=r"supply: channel: the controller does not have channel 3"):
        connect(channel=3)
    assert script.orders() == [(0x2000, 3, 0)]


@cases(
    ("name", "model"),
    [
        (b"Roboteq SDC2160", "SDC2160"),
        (b"SDC2160 by ROBOTEQ", "SDC2160 by"),
        (b"roboteq", "motor controller"),
        (b"Roboteq\0\0\0", "motor controller"),
        (b"A Roboteq whose name has twenty-eight", "A  whose name has twenty-eight"),
    ],
)
def test_names_in_segments(script, connect, name, model):
    script.texts[0x1008] = name
    assert connect().identity.model == model


def test_controller_without_a_name_is_known_by_its_type(script, connect):
    script.aborts |= {(index, 0): 0x06020000 for index in (0x1008, 0x1009, 0x100A)}
    assert str(connect().identity) == "Roboteq motor controller, serial number unknown, firmware unknown"
    script.objects[0x1000, 0] = (0x00020192, 4)
    script.aborts[0x1018, 1] = 0x06020000
    with pytest.raises(DeviceConnectionError, match=r"found '' \(device type 0x00020192\); check port and node"):
        connect()


def test_lost_segment_is_asked_for_again_with_the_whole_text(script, connect):
    script.instead = [None, b"z\r"]
    assert connect().identity.model == "motor controller"
    assert [data[0] for _, data in script.received[:5]] == [0x40, 0x60, 0x80, 0x40, 0x60]
    # The client ends the transfer (CiA 301): timed out.
    assert script.received[2][1] == bytes.fromhex("8008100000000405")


def test_answer_that_comes_after_the_abort_is_not_taken_for_the_next(script, connect):
    late = line(0x581, bytes.fromhex("07584C4154450000"))
    original = script.obey
    waiting = []

    def obey(text):
        sent = original(text)
        if text.startswith(b"t601880"):
            waiting.append(late)
            return b"z\r"
        return (waiting.pop() if waiting else b"") + sent

    script.obey = obey
    script.instead = [None, b"z\r"]
    script.texts[0x1008] = b"Roboteq SDC2160"
    assert connect().identity.model == "SDC2160"
    assert waiting == []


def test_wrong_toggle_bit(script, connect):
    script.instead = [None, line(0x581, bytes.fromhex("11526F0000000000"))]
    with pytest.raises(DeviceError, match="answered 11 52"):
        connect()


@pytest.mark.parametrize(("milliseconds", "written"), [(100, None), (0, 166), (5000, 166), (166, None)])
def test_heartbeat_of_the_device_is_made_frequent_enough(script, connect, milliseconds, written):
    script.objects[0x1017, 0] = (milliseconds, 2)
    script.before = b"t701105\r"
    connect(heartbeat=0.5)
    assert [value for index, _, value in script.orders() if index == 0x1017] == ([] if written is None else [written])


@cases(
    ("output", "battery", "volts", "command"),
    [
        ("average", 240, 0.0, 0),
        ("average", 240, 12.0, 500),
        ("average", 240, -6.0, -250),
        ("average", 237, 12.0, 506),
        ("average", 235, 12.0, 510),  # 510.64, but 511 would be 12.0085 V, beyond the limit
        ("rms", 240, 12.0, 250),
        ("rms", 240, 0.5, 0),
        ("rms", 120, 12.0, 1000),
    ],
)
def test_conversion(script, connect, output, battery, volts, command):
    script.objects[0x210D, 2] = (battery, 2)
    limits = (-12, 12) if volts < 0 else (0, 12)
    supply = connect(output=output, voltage_limits=limits)
    supply.set(volts)
    assert script.orders()[-1] == (0x2000, 1, command)
    values = supply.measure()
    duty = command / 1000
    expected = battery / 10 * (duty if output == "average" else math.sqrt(duty))
    assert values["supply_voltage"] == pytest.approx(expected, abs=1e-12)


def test_supply_that_moves_is_followed_and_its_last_digit_is_not(script, supply):
    supply.set(6.0)
    script.received.clear()
    for battery in (241, 239, 240, 242, 241, 243, 200):
        script.objects[0x210D, 2] = (battery, 2)
        supply.glance()
    assert [value for _, _, value in script.orders()] == [250, 250, 250, 248, 248, 248, 300]


@pytest.mark.parametrize(("watchdog", "pause", "zero"), [(1.0, 0.9, False), (1.0, 1.0, True), (0.0, 50.0, False)])
def test_zero_comes_first_after_a_gap(script, connect, clock, watchdog, pause, zero):
    supply = connect(watchdog=watchdog)
    supply.set(6.0)
    script.received.clear()
    clock.sleep(pause)
    supply.set(3.0)
    assert [value for _, _, value in script.orders()] == ([0, 125] if zero else [125])


def test_zero_goes_to_every_channel_back_to_back(script, connect, clock):
    script.objects |= {(0x2102, 2): (0, 2), (0x2102, 3): (0, 2)}
    script.objects |= {(index, 2): script.objects[index, 1] for index in (0x2100, 0x2122)}
    supply = connect(channel=2)
    assert script.orders() == [(0x2000, 2, 0), (0x2000, 1, 0), (0x2000, 3, 0)]
    supply.set(6.0)
    for call, last in ((lambda: supply.set(3.0), [(0x2000, 2, 125)]), (supply.safe, [(0x200E, 0, 2)])):
        clock.sleep(2.0)
        script.received.clear()
        call()
        zeros = [(0x2000, 2, 0), (0x2000, 1, 0), (0x2000, 3, 0)]
        assert script.orders() == zeros + last
    script.aborts[0x2000, 1] = 0x08000000
    with pytest.raises(DeviceError, match="refused 0"):
        connect(RoboteqSupply.recover, channel=2)


def test_command_that_would_arrive_too_late_is_not_sent_again(script, supply, clock):
    supply.set(6.0)
    clock.sleep(0.9)
    script.received.clear()
    script.instead = [None] * 6 + [b"z\r"]
    with pytest.raises(DeviceError, match="output was dropped"):
        supply.measure()
    assert script.orders() == [(0x2000, 1, 250), (0x2000, 1, 0)]


def test_watchdog_that_is_shorter_than_the_settings_say_is_noticed(script, connect, clock):
    supply = connect(watchdog=60)
    supply.set(6.0)
    supply.measure()
    clock.sleep(6.0)
    script.objects[0x2102, 1] = (0, 2)
    script.received.clear()
    with pytest.raises(DeviceError, match="output was dropped"):
        supply.measure()
    assert script.orders() == [(0x2000, 1, 0)]


def test_ramp_of_the_device(script, supply, clock):
    script.follow = False
    status = supply.set(6.0)
    assert not status.update()
    script.objects[0x2102, 1] = (248, 2)
    assert not status.update()
    assert supply.measure()["supply_voltage"] == pytest.approx(5.952)
    script.objects[0x2102, 1] = (249, 2)
    assert status.update()
    assert status.success


def test_ramp_through_zero_is_no_drop(script, connect):
    supply = connect(voltage_limits=(-12, 12))
    supply.set(6.0).wait()
    script.follow = False
    supply.set(-6.0)
    for power in (100, 0, -100, -250):
        script.objects[0x2102, 1] = (power, 2)
        supply.measure()
    script.objects[0x2102, 1] = (0, 2)
    with pytest.raises(DeviceError, match="output was dropped"):
        supply.measure()


def test_waiting_for_a_ramp_feeds_the_watchdog(script, connect, clock):
    supply = connect(watchdog=0.2)
    script.follow = False
    status = supply.set(6.0)
    script.received.clear()
    with pytest.raises(DeviceError, match="did not arrive within 5 s"):
        status.wait()
    assert {value for _, _, value in script.orders()} == {250}
    assert len(script.orders()) > 25


def test_several_faults_and_unknown_ones(script, supply):
    script.objects |= {(0x2112, 0): (0x8105, 2), (0x2122, 1): (0x80000001, 4)}
    with pytest.raises(DeviceError) as caught:
        supply.measure()
    for part in ("overheat", "under-voltage", "amps limit", "fault flags 0x8100, unknown"):
        assert part in str(caught.value)


GOOD = bytes.fromhex("4B0D2102F0000000")


@cases(
    "spoilt",
    [
        b"",
        b"z\r",
        b"z\r\a\r\r",
        b"z\rt58184B0D2102F000000\r",
        b"t5819" + b"00" * 9 + b"\r",
        b"t5x1" + b"00" * 9 + b"\r",
        b"\xff\xfe\r",
        b"x" * 300 + b"\r",
        b"t58184B0D2102F0000000",
        line(0x582, GOOD),
        line(0x581, GOOD[:7]),
        line(0x581, b"\x80\x0d\x21\x01" + bytes(4)),
        b"T000005818" + GOOD.hex().encode() + b"\r",
        line(0x705, b"\x05"),
        line(0x701, b"\x05") * 50,
    ],
)
def test_a_spoilt_answer_costs_a_resend(script, supply, spoilt):
    script.received.clear()
    script.instead = [None, spoilt, spoilt]
    values = supply.measure()
    assert values["supply_voltage"] == 0.0
    assert script.received[1] == script.received[2] == script.received[3]
    assert len(script.received) == 5 + 2


def test_late_answers_are_passed_over(script, supply):
    late = line(0x581, bytes.fromhex("4B022101E8030000"))
    script.instead = [None, lambda right: late + b"z\r" + right]
    assert supply.measure()["supply_voltage"] == 0.0
    script.instead = [lambda right: b"z\r" + right + late, None]
    assert supply.measure()["supply_voltage"] == 0.0


def test_answers_to_a_request_that_was_sent_again_are_waited_for(script, supply, clock):
    """The first answer comes with that of the resend, and again with the next question for the same object."""
    stale = line(0x581, bytes.fromhex("4B022101E8030000"))
    script.instead = [b"z\r", lambda right: right]
    assert supply._read(_POWER, 1) == 0
    supply._line._adapter._port._received += stale
    assert supply._read(_POWER, 1) == 0
    script.instead = [b"z\r", lambda right: right]
    assert supply._read(_POWER, 1) == 0
    before = clock.now()
    assert supply._read(_POWER, 1) == 0
    assert clock.now() - before == pytest.approx(0.3, abs=0.01)
    before = clock.now()
    assert supply._read(_POWER, 1) == 0
    assert clock.now() - before < 0.01


@cases(
    "ends", [(b"\r", b"\r"), (b"\n", b"\r"), (b"\r\n", b"\r\n"), (b"\n", b"\n"), (b"", b"\r"), (b"z\r\n", b"\n\r")]
)
def test_acknowledgements_and_line_ends_of_all_adapters(script, supply, ends):
    acknowledgement, end = ends
    script.received.clear()
    script.instead = [lambda right: acknowledgement + right[:-1] + end] * 5
    assert supply.measure() == {"supply_voltage": 0.0, "supply_current": 1.2}
    assert len(script.received) == 5


def test_simplified_answers_of_the_manual_are_understood(script, supply):
    simplified = line(0x581, bytes.fromhex("480D210290010000"))
    script.instead = [None, None, simplified, simplified]
    script.objects[0x2102, 1] = (1000, 2)
    assert supply.measure()["supply_voltage"] == 40.0
    script.instead = [line(0x581, bytes.fromhex("40022101F4010000"))] * 2
    assert supply.measure()["supply_voltage"] == 12.0


def test_write_that_is_answered_like_a_query(script, supply):
    script.instead = [None] * 5 + [line(0x581, bytes.fromhex("4300200100000000"))]
    with pytest.raises(DeviceError, match=r"answered 43 00 20 01 .* for its motor command"):
        supply.set(6.0)


@given(st.lists(st.one_of(st.binary(max_size=60), st.just(line(0x701, b"\x05"))), min_size=3, max_size=3))
def test_no_bytes_are_taken_for_an_answer_that_they_are_not(replies):
    script, clock = Script(), VirtualClock()
    register("fuzzed-supply", script, clock)
    try:
        access = NodeLine("supply", make_settings(port="emulated://fuzzed-supply"), clock)
        script.instead = list(replies)
        with pytest.raises(DeviceConnectionError):
            access.read(_VOLTS, 2)
        assert access.read(_VOLTS, 2) == 240
        access.close()
    finally:
        unregister("fuzzed-supply")


def test_silence_names_port_and_node_and_takes_its_time(script, supply, clock):
    script.silent = True
    before = clock.now()
    with pytest.raises(DeviceConnectionError) as caught:
        supply.measure()
    assert str(caught.value) == (
        "supply: no answer within 0.1 s at emulated://scripted-supply, node 1, after 3 requests; check power, "
        "cable, node and speed (125000 bit/s)"
    )
    assert len(script.received) == 3
    assert clock.now() - before == pytest.approx(0.3, abs=0.02)


def test_heartbeats_that_never_end_do_not_prolong_the_timeout(script, supply, clock, monkeypatch):
    def heartbeat(*, wait=True):
        if not wait:
            return None
        clock.sleep(0.04)
        return b"t701105"

    monkeypatch.setattr(supply._line._adapter, "line", heartbeat)
    before = clock.now()
    with pytest.raises(DeviceConnectionError, match="no answer within"):
        supply.measure()
    assert clock.now() - before == pytest.approx(0.36, abs=0.02)


def test_nonsense_without_an_end_does_not_pile_up(script, supply):
    script.instead = [b"x" * 5000] * 3
    with pytest.raises(DeviceConnectionError, match="no answer within"):
        supply.measure()
    assert len(supply._line._adapter._rest) <= 64
    supply.measure()


def test_errors_of_the_adapter_are_counted_and_named(script, supply):
    script.instead = [b"\a", b"\a\a", b""]
    with pytest.raises(DeviceConnectionError, match=r"the adapter reports an error \(3 BEL\)"):
        supply.measure()
    supply.measure()
    script.silent = True
    with pytest.raises(DeviceConnectionError, match=r"3 requests; check"):
        supply.measure()


def test_heartbeat_that_becomes_stale(script, connect, clock):
    script.before = line(0x701, b"\x05")
    supply = connect(heartbeat=0.5)
    for _ in range(20):
        clock.sleep(0.3)
        script.before = line(0x701, b"\x05") * 3
        supply.measure()
    clock.sleep(0.51)
    with pytest.raises(DeviceConnectionError, match=r"no heartbeat of node 1 for 0\.\d+ s, 0\.5 s are allowed"):
        supply.measure()
    with pytest.raises(DeviceConnectionError, match="no heartbeat"):
        supply.set(6.0)
    assert script.orders() == [(0x2000, channel, 0) for channel in (1, 2, 3)]
    script.before = line(0x702, b"\x05") + line(0x701, b"\x05\x05") + line(0x700, b"\x05")
    with pytest.raises(DeviceConnectionError, match="no heartbeat"):
        supply.measure()
    script.before = line(0x701, b"\x7f")
    supply.measure()


def test_heartbeats_that_wait_in_the_line_count_when_they_are_read(script, supply, connect, clock):
    supply = connect(heartbeat=1)
    port = supply._line._adapter.serialPortOrig
    clock.sleep(100.0)
    port._received += line(0x701, b"\x05") * 400 + b"t7011"
    supply.measure()


def test_after_a_restart_nothing_is_sent_but_the_safe_state(script, supply):
    supply.set(6.0)
    script.received.clear()
    script.before = line(0x701, b"\x00")
    for call in (supply.measure, supply.glance, lambda: supply.set(3.0)):
        with pytest.raises(DeviceRestartedError, match="has restarted and its output dropped"):
            call()
    assert script.orders() == []
    supply.safe()
    assert script.orders() == [(0x2000, 1, 0), (0x200E, 0, 1)]
    with pytest.raises(DeviceRestartedError):
        supply.set(3.0)


def test_damaged_digit_is_no_reading(script, supply):
    for number in range(5):
        spoilt = [None] * 5
        spoilt[number] = lambda right: right[:14] + b"1" + right[15:]
        script.instead = spoilt
        assert supply.measure() == {"supply_voltage": 0.0, "supply_current": 1.2}


def test_closing_twice_and_using_afterwards(script, supply):
    supply.set(6.0)
    before = len(script.received)
    supply.close()
    supply.close()
    assert len(script.received) == before
    with pytest.raises(DeviceConnectionError):
        supply.measure()


def test_safe_waits_for_the_ramp(script, supply, clock):
    supply.set(6.0)
    script.follow = False
    original, left = script.answer, [200, 100, 0]

    def answer(data):
        if data[1:3] == b"\x02\x21":
            script.objects[0x2102, 1] = (left.pop(0) if left else 0, 2)
        return original(data)

    script.answer = answer
    supply.safe()
    assert all(index != 0x200C for index, _, _ in script.orders())


@pytest.mark.parametrize("refused", [(0x2000, 1), (0x200E, 0)])
def test_safe_goes_on_to_the_emergency_stop(script, supply, refused):
    supply.set(6.0)
    script.received.clear()
    script.aborts[refused] = 0x08000022
    script.objects[0x2102, 1] = (0, 2)
    supply.safe()
    assert script.orders() == [(0x2000, 1, 0), (0x200E, 0, 1), (0x200C, 0, 1)]


def test_safe_that_is_not_confirmed_raises_after_everything_was_tried(script, supply, clock):
    supply.set(6.0)
    script.follow = False
    script.received.clear()
    with pytest.raises(DeviceError, match=r"does not confirm that its output is off; disconnect its power"):
        supply.safe()
    assert script.orders() == [(0x2000, 1, 0), (0x200E, 0, 1), (0x200C, 0, 1)]
    script.aborts = dict.fromkeys([(0x2000, 1), (0x200E, 0), (0x200C, 0)], 0x08000000)
    with pytest.raises(DeviceError, match=r"does not confirm .*refused 0 as its motor command.*general error"):
        supply.safe()


def test_safe_over_another_line_needs_no_emergency_stop(script, supply):
    supply.set(6.0)
    script.received.clear()
    script.instead = [lambda _right: b""] * 3
    supply.safe()
    assert script.instead == []
    assert (0x200C, 0, 1) not in script.orders()
    assert script.orders()[-1] == (0x200E, 0, 1)


def test_safe_of_a_silent_device_tries_everything(script, supply):
    script.silent = True
    with pytest.raises(DeviceError, match=r"does not confirm .*no answer"):
        supply.safe()
    assert {data[1:3].hex() for _, data in script.received} == {"0020", "0e20", "0c20", "0221"}


def test_safe_with_a_stale_heartbeat_or_a_fault_needs_no_emergency_stop(script, connect, clock):
    supply = connect(heartbeat=0.5)
    supply.set(6.0)
    clock.sleep(10.0)
    script.objects[0x2112, 0] = (1, 2)
    supply.safe()
    assert all(index != 0x200C for index, _, _ in script.orders())


@cases(
    ("key", "changes"),
    [
        ("port", {"port": "/dev/ttyUSB0@9600"}),
        ("bitrate", {"bitrate": 250_001}),
        ("voltage_limits", {"voltage_limits": (12, 0)}),
        ("voltage_limits", {"voltage_limits": (0, 0)}),
        ("voltage_limits", {"voltage_limits": (1, 12)}),
        ("voltage_limits", {"voltage_limits": (0, 61)}),
        ("voltage_limits", {"output": "rms", "voltage_limits": (-12, 12)}),
    ],
)
def test_settings_that_make_no_sense(key, changes):
    assert blamed(make_settings, changes) == {key}


class LocalNode(WireServer):
    """A node of the package canopen behind slcan lines; no emulator of ours takes part."""

    def __init__(self, canopen):
        types = canopen.objectdictionary.datatypes
        objects = canopen.ObjectDictionary()
        for index, sub, kind, access, value in (
            (0x1000, 0, types.UNSIGNED32, "ro", 0x000F0191),
            (0x1008, 0, types.VISIBLE_STRING, "const", "Roboteq SDC3260"),
            (0x1009, 0, types.VISIBLE_STRING, "const", "1"),
            (0x100A, 0, types.VISIBLE_STRING, "const", "v2.1 beta"),
            (0x1017, 0, types.UNSIGNED16, "rw", 0),
            (0x2000, 1, types.INTEGER32, "wo", 0),
            (0x200C, 0, types.UNSIGNED8, "wo", 0),
            (0x200D, 0, types.UNSIGNED8, "wo", 0),
            (0x200E, 0, types.UNSIGNED8, "wo", 0),
            (0x2100, 1, types.INTEGER16, "ro", 23),
            (0x2102, 1, types.INTEGER16, "ro", 0),
            (0x210D, 2, types.UNSIGNED16, "ro", 240),
            (0x2112, 0, types.UNSIGNED8, "ro", 0),
            (0x2122, 1, types.UNSIGNED32, "ro", 0),
        ):
            variable = canopen.objectdictionary.ODVariable(f"{index:04X}sub{sub}", index, sub)
            variable.data_type, variable.access_type, variable.default = kind, access, value
            if sub:
                record = canopen.objectdictionary.ODRecord(f"{index:04X}", index)
                record.add_member(variable)
                objects.add_object(record)
            else:
                objects.add_object(variable)
        self.sent = b""

        class Network(canopen.Network):
            def send_message(_, can_id, data, **_options):
                self.sent += line(can_id, data)

        self.node = canopen.LocalNode(9, objects)
        Network().add_node(self.node)
        self.network = self.node.network
        self.written = []
        self.node.add_write_callback(self.write)

    def write(self, *, index, subindex, data, **_):
        self.written.append((index, subindex, bytes(data)))
        if index == 0x2000:
            power = int.from_bytes(data, "little", signed=True)
            self.node.data_store[0x2102] = {1: power.to_bytes(2, "little", signed=True)}

    def receive(self, data):
        for text in data.split(b"\r"):
            if text.startswith(b"t"):
                self.network.notify(int(text[1:4], 16), bytearray.fromhex(text[5:].decode()), 0.0)
        # Its heartbeat would come from a wall-clock timer.
        sent, self.sent = line(0x709, b"\x05") + self.sent, b""
        return sent


@pytest.fixture
def local_node(clock):
    canopen = pytest.importorskip("canopen")
    local = LocalNode(canopen)
    register("local-node", local, clock)
    yield local
    unregister("local-node")


def test_against_a_node_of_the_package_canopen(local_node, connect):
    local_node.node.object_dictionary[0x1017].default = 100
    supply = connect(port="emulated://local-node", node=9)
    assert str(supply.identity) == "Roboteq SDC3260, serial number unknown, firmware v2.1 beta"
    supply.set(6.0).wait()
    assert local_node.written[-1] == (0x2000, 1, bytes.fromhex("FA000000"))
    assert supply.measure() == {"supply_voltage": 6.0, "supply_current": 2.3}
    supply.safe()
    assert [row[:2] for row in local_node.written[-2:]] == [(0x2000, 1), (0x200E, 0)]
    supply.emergency_stop()
    assert local_node.written[-1] == (0x200C, 0, b"\x01")
    supply.release()


def test_abort_codes_are_those_of_the_standard():
    standard = pytest.importorskip("canopen").sdo.exceptions.SdoAbortedError.CODES
    # What belongs to block transfers, or is no reason of its own, is left out.
    assert set(standard) - set(ABORT_CODES) == {0x05040002, 0x05040003, 0x05040004, 0x060A0023, 0x08000024}
    assert set(ABORT_CODES) <= set(standard)


# Reading and writing objects.


@cases(
    ("command", "data", "text"),
    [
        (0x43, b"v1.2", "v1.2"),
        (0x47, b"v12x", "v12"),
        (0x4F, b"vxxx", "v"),
        (0x4E, b"v1.2", "v1.2"),
        (0x43, b"v1\0x", "v1"),
        (0x43, b" v1 ", "v1"),
    ],
)
def test_expedited_text(script, connect, command, data, text):
    original = script.answer
    head = b"\x40\x0a\x10\x00"
    script.answer = lambda sent: bytes((command,)) + head[1:] + data if sent[:4] == head else original(sent)
    assert connect().identity.firmware == text


@cases(
    ("command", "data", "value"),
    [
        (0x43, "F0000000", 240),
        (0x47, "F00000FF", 240),
        (0x4F, "F0FFFFFF", 240),
        (0x40, "F0000000", 240),  # as in the manual
        (0x4F, "F0000001", 240),
    ],
)
def test_numbers_of_every_size(script, supply, command, data, value):
    script.instead = [line(0x581, bytes((command,)) + bytes.fromhex("0D2102" + data))]
    assert supply._line.read(_VOLTS, 2) == value


@cases("command", [0x41, 0x45, 0x60, 0x20, 0x00])
def test_answers_with_other_commands_are_no_numbers(script, supply, command):
    script.instead = [line(0x581, bytes((command,)) + bytes.fromhex("0D2102F0000000"))]
    with pytest.raises(DeviceError, match=f"answered {command:02x} 0d 21 02"):
        supply._line.read(_VOLTS, 2)


def test_value_that_is_never_the_same(script, supply):
    values = iter(range(100, 200))
    original = script.answer

    def answer(data):
        if data[:3] == b"\x40\x0d\x21":
            script.objects[0x210D, 2] = (next(values), 2)
        return original(data)

    script.answer = answer
    with pytest.raises(DeviceError, match=r"never reports the same battery voltage \(object 0x210D:2\) twice"):
        supply._read(_VOLTS, 2)
    assert len(script.received) == 6


def test_time_stamps_of_the_adapter_are_passed_over(script, supply, connect, clock):
    stamped = lambda right: right[:-1] + b"12AB\r"  # noqa: E731
    script.instead = [stamped] * 5
    assert supply.measure() == {"supply_voltage": 0.0, "supply_current": 1.2}
    assert len(script.received) == 5
    supply = connect(heartbeat=1)
    clock.sleep(2.0)
    script.before = b"t701105FFFF\r"
    supply.measure()


@cases(("identifier", "heard"), [(0x700, ""), (0x780, ""), (0x6FF, ""), (0x702, "2"), (0x77F, "2, 127")])
def test_nodes_whose_heartbeats_are_heard(script, supply, identifier, heard):
    script.instead = [line(identifier, b"\x05")] * 3
    with pytest.raises(DeviceConnectionError) as caught:
        supply.measure()
    assert (f"heard of node {heard} instead" in str(caught.value)) == bool(heard)
    assert ("heard" in str(caught.value)) == bool(heard)


@cases("place", range(26))
def test_an_answer_in_pieces_is_put_together_and_costs_no_more_than_its_pause(clock, place):
    script = Script()
    register("pieces-supply", InPieces(script, clock, place, 0.02), clock)
    try:
        node = NodeLine("supply", make_settings(port="emulated://pieces-supply"), clock)
        before = clock.now()
        assert node.read(_VOLTS, 2) == 240
        assert clock.now() - before < 0.03
        assert node.repeats == 0
        node.close()
    finally:
        unregister("pieces-supply")


def test_line_that_is_lost_while_something_is_sent(script, supply):
    unregister("scripted-supply")
    for action in (
        lambda: supply._line.transmit(b"t0800\r"),
        lambda: supply._line.await_heartbeat(1.0),
        lambda: supply._line.synchronize((b"t1814",)),
        lambda: supply._line.tell(driver._STOP, 1, 0),
    ):
        with pytest.raises(DeviceConnectionError, match="lost the line"):
            action()


def test_text_whose_segments_are_lost_again_and_again(script, connect):
    script.instead = [None, b"z\r", b"z\r"] * 3
    with pytest.raises(DeviceConnectionError, match="no answer within"):
        connect()
    assert [data[0] for _, data in script.received] == [0x40, 0x60, 0x80] * 3


# The voltage.


def test_no_command_is_beyond_the_limits(script, connect):
    supply = connect(voltage_limits=(-7, 5))
    for battery in range(121, 240, 7):
        script.objects[0x210D, 2] = (battery, 2)
        for volts in (5.0, -7.0, 4.9991, -6.9991):
            supply.set(volts)
            found = script.orders()[-1][2] * battery / 1e4
            assert -7.0 <= found <= 5.0
            assert abs(found - volts) <= 1.5 * battery / 1e4


def test_own_check_compares_the_supply_with_the_limits(script, connect):
    for limits, battery, advice in (
        ((0, 12), 120, ""),
        ((-12, 6), 119, "12 V cannot be reached"),
        ((0, 12), 119, "12"),
    ):
        script.objects[0x210D, 2] = (battery, 2)
        supply, watchdog = connect(voltage_limits=limits).self_check()
        assert supply.text == f"{battery / 10:.1f} V"
        assert advice in supply.advice
        assert bool(advice) == bool(supply.advice)
        assert watchdog.text.endswith("the rig file says 1000 ms")


def test_another_line_to_a_controller_without_a_heartbeat(script, connect):
    supply = connect(heartbeat=0.5)
    script.before = b""
    with pytest.raises(DeviceConnectionError, match="no heartbeat"):
        supply.reconnect()


# Process data.


class SyncScript(Script):
    """A controller that takes the configuration of its process data, and sends what it maps upon a SYNC.

    `spoilt` holds, SYNC by SYNC, what is made of the lines (None for the right ones).
    """

    def __init__(self, clock):
        super().__init__()
        self.clock = clock
        self.beat_at = math.inf
        self.mapped = {}
        self.configured = []
        self.synchronized = 0
        self.spoilt = []
        self.marks = []
        self.objects |= {(0x2106, 16): (0, 4), (0x2101, 1): (0, 2)}

    def obey(self, text):
        if text == b"t0800":
            self.synchronized += 1
            sent = [line(identifier, self.content(mapping)) for identifier, mapping in self.process_data()]
            other = self.spoilt.pop(0) if self.spoilt else None
            return b"z\r" + b"".join(other(sent) if other else sent)
        if text.startswith(b"t%03X4" % (0x500 + self.node)):
            self.marks.append(text)
            if self.mapped.get((0x1603, 0)) != 1:
                return b"z\r"  # as delivered there are two variables, and a frame that is too short is not taken
            self.objects[0x2106, 16] = (int.from_bytes(bytes.fromhex(text[5:].decode()), "little"), 4)
            return b"z\r"
        return super().obey(text)

    def answer(self, data):
        index, sub, value = int.from_bytes(data[1:3], "little"), data[3], int.from_bytes(data[4:], "little")
        if data[0] >> 5 == 1 and 0x1400 <= index < 0x1C00:
            self.configured.append((index, sub, value, 4 - (data[0] >> 2 & 3)))
            self.mapped[index, sub] = value
            return b"\x60" + data[1:4] + bytes(4)
        reply = super().answer(data)
        if index == 0x2000 and data[0] >> 5 == 1:
            self.objects[0x2101, sub] = (int.from_bytes(data[4:], "little", signed=True), 2)
        return reply

    def unsolicited(self):
        if self.clock.now() < self.beat_at:
            return b""
        self.beat_at = self.clock.now() + 0.1
        return line(0x700 + self.node, b"\x05")

    def next_unsolicited(self):
        return self.beat_at

    def process_data(self):
        for number in range(4):
            identifier = self.mapped.get((0x1800 + number, 1), 1 << 31)
            if not identifier >> 31:
                count = self.mapped[0x1A00 + number, 0]
                yield identifier & 0x7FF, [self.mapped[0x1A00 + number, 1 + place] for place in range(count)]

    def content(self, mapping):
        data = b""
        for each in mapping:
            index, sub, bits = each >> 16, each >> 8 & 0xFF, each & 0xFF
            data += (self.objects[index, sub][0] & (1 << bits) - 1).to_bytes(bits // 8, "little")
        return data


@pytest.fixture
def controller(clock):
    controller = SyncScript(clock)
    register("synchronous-supply", controller, clock)
    yield controller
    unregister("synchronous-supply")


@pytest.fixture
def synchronous(controller, connect):
    controller.objects[0x2102, 1] = (0, 2)
    supply = connect(port="emulated://synchronous-supply", voltage_limits=(-12, 12))
    controller.received.clear()
    controller.marks.clear()
    controller.synchronized = 0
    return supply


def pdo(number, first, mapping, kind, *, remote=0x40000000):
    """Return what configures a process data object: index, subindex, value and bytes."""
    parameters, objects = (0x1800 + number, 0x1A00 + number) if number < 4 else (0x1403, 0x1603)
    return [
        (parameters, 1, 0x80000000 | remote | first, 4),
        (objects, 0, 0, 1),
        *((objects, 1 + place, each, 4) for place, each in enumerate(mapping)),
        (objects, 0, len(mapping), 1),
        (parameters, 2, kind, 1),
        (parameters, 1, remote | first, 4),
    ]


@pytest.mark.parametrize(("node", "channel"), [(1, 1), (77, 2)])
def test_configuration_of_the_process_data(controller, connect, node, channel):
    controller.node = node
    for index in (0x2100, 0x2101, 0x2102, 0x2122):
        controller.objects[index, channel] = controller.objects[index, 1]
    connect(port="emulated://synchronous-supply", node=node, channel=channel)
    one = channel << 8
    electrical = [0x21020010 | one, 0x210D0210, 0x21000010 | one, 0x21120010]
    assert controller.configured == [
        *pdo(0, 0x180 + node, electrical, 1),
        *pdo(1, 0x280 + node, [0x21220020 | one, 0x21061020], 1),
        *pdo(2, 0x380 + node, electrical, 1),
        *pdo(3, 0x480 + node, [0x21220020 | one, 0x21010010 | one], 1),
        *pdo(4, 0x500 + node, [0x20051020], 255, remote=0),
    ]
    assert controller.marks == [b"t%03X401000000" % (0x500 + node)]


def test_reading_is_one_synchronization(controller, synchronous):
    synchronous.set(-6.0)
    controller.objects |= {(0x2100, 1): (-15, 2), (0x210D, 2): (241, 2)}
    controller.received.clear()
    controller.marks.clear()
    controller.synchronized = 0
    assert synchronous.measure() == {"supply_voltage": pytest.approx(-6.025), "supply_current": -1.5}
    assert controller.synchronized == 1
    assert len(controller.marks) == 1
    assert [data[:4].hex() for _, data in controller.received] == ["23002001"]
    assert synchronous.repeats == 0


def test_marks_count_and_begin_again():
    data = ProcessData("supply", 1, 1)
    assert [data.next_mark() for _ in range(3)][1:] == [b"t501402000000\r", b"t501403000000\r"]
    data._mark = 0x7FFFFFFE
    assert [data.next_mark(), data.next_mark()] == [b"t5014FFFFFF7F\r", b"t501401000000\r"]


def damaged(number, place=5):
    """Return what makes one character of one of the lines another digit."""

    def spoil(sent):
        text = sent[number]
        digit = b"1" if text[place : place + 1] == b"0" else b"0"
        return [*sent[:number], text[:place] + digit + text[place + 1 :], *sent[number + 1 :]]

    return spoil


@cases(("number", "place"), [(0, 5), (2, 9), (1, 5), (3, 12), (1, 14), (3, 13)])
def test_damaged_process_data_are_asked_for_again(controller, synchronous, number, place):
    synchronous.set(6.0)
    controller.synchronized = 0
    before = synchronous.repeats
    controller.spoilt = [damaged(number, place)]
    assert synchronous.measure() == {"supply_voltage": 6.0, "supply_current": 1.2}
    assert controller.synchronized == 2
    assert synchronous.repeats == before + 1


@cases("left_out", range(4))
def test_process_data_that_are_not_whole_are_asked_for_again(controller, synchronous, clock, left_out):
    controller.synchronized = 0
    controller.spoilt = [lambda sent: sent[:left_out] + sent[left_out + 1 :]]
    before = clock.now()
    assert synchronous.measure()["supply_voltage"] == 0.0
    assert controller.synchronized == 2
    assert clock.now() - before == pytest.approx(0.1, abs=0.03)


def test_process_data_that_never_come(controller, synchronous):
    controller.spoilt = [lambda _sent: []] * 4
    with pytest.raises(DeviceConnectionError, match="no process data follow a SYNC"):
        synchronous.measure()
    assert controller.synchronized == 4
    # Each with another mark, as what comes late would have the former one.
    assert len(controller.marks) == 3


def test_process_data_that_never_agree(controller, synchronous):
    values = iter(range(100))

    def another(sent):
        first = b"t1818%02X" % next(values) + sent[0][7:]
        third = b"t3818%02X" % next(values) + sent[2][7:]
        return [first, sent[1], third, sent[3]]

    controller.spoilt = [another] * 4
    with pytest.raises(DeviceError, match="do not agree with each other"):
        synchronous.measure()
    assert controller.synchronized == 4


def test_process_data_of_an_earlier_synchronization_are_not_taken(controller, synchronous):
    sent = []
    controller.spoilt = [lambda right: sent.extend(right) or right]
    synchronous.measure()
    controller.objects |= {(0x2100, 1): (20, 2)}
    controller.spoilt = [lambda _right: list(sent), None]
    assert synchronous.measure()["supply_current"] == 2.0
    assert controller.synchronized == 3
    # A rest of the earlier ones in front of those of now.
    controller.spoilt = [lambda right: [*sent[:2], *right]]
    assert synchronous.measure()["supply_current"] == 2.0
    controller.spoilt = [lambda right: [line(0x702, b"\x05"), *right]]
    assert synchronous.measure()["supply_current"] == 2.0


def test_a_command_need_not_be_obeyed_at_once(controller, synchronous):
    synchronous.set(6.0).wait()
    synchronous.measure()
    synchronous.set(3.0)
    for command in (250, 125):
        controller.objects[0x2101, 1] = (command, 2)
        synchronous.measure()
    controller.objects[0x2101, 1] = (250, 2)
    with pytest.raises(DeviceError, match="its command was changed to 250 by another host, from 125"):
        synchronous.measure()


def test_command_of_another_host_has_to_come_twice(controller, synchronous):
    synchronous.set(6.0).wait()
    controller.spoilt = [damaged(3, 13)]
    synchronous.measure()
    controller.objects[0x2101, 1] = (700, 2)
    with pytest.raises(DeviceError, match="its command was changed to 700 by another host, from 250"):
        synchronous.measure()


def test_restart_that_is_announced_ends_the_reading(controller, synchronous):
    controller.spoilt = [lambda _sent: [line(0x701, b"\x00")]]
    with pytest.raises(DeviceRestartedError):
        synchronous.measure()
    assert controller.synchronized == 1


def test_mark_that_the_controller_does_not_report_is_none(controller, synchronous):
    assert synchronous._process_data.is_marked(synchronous._line) is True
    controller.aborts[0x2106, 16] = 0x06020000
    assert synchronous._process_data.is_marked(synchronous._line) is False


def test_configuration_without_effect_is_done_without(controller, connect):
    controller.spoilt = [lambda _sent: []] * 4
    supply = connect(port="emulated://synchronous-supply")
    controller.synchronized = 0
    assert supply.measure()["supply_voltage"] == 0.0
    assert controller.synchronized == 0


def test_zero_is_held_without_a_command(controller, synchronous, clock):
    synchronous.measure()
    clock.sleep(5.0)
    synchronous.measure()
    assert controller.received == []
    assert len(controller.marks) == 2


def test_command_that_may_have_arrived(controller, synchronous):
    synchronous.set(6.0).wait()
    controller.instead = [b"z\r"] * 3
    with pytest.raises(DeviceConnectionError):
        synchronous.set(3.0)
    # Whichever of them the controller obeys, it is no other host's.
    for power in (125, 250):
        controller.objects[0x2101, 1] = controller.objects[0x2102, 1] = (power, 2)
        synchronous.measure()


@pytest.mark.parametrize(("volts", "pause", "marks"), [(0.0, 2.0, 3), (6.0, 0.1, 3), (6.0, 2.0, 0)])
def test_marks_feed_the_watchdog_only_where_they_may(controller, synchronous, clock, volts, pause, marks):
    if volts:
        synchronous.set(volts).wait()
    clock.sleep(pause)
    controller.spoilt = [lambda _sent: []] * 4
    controller.marks.clear()
    with pytest.raises(DeviceError):
        synchronous.measure()
    sent = [mark for mark in controller.marks if mark]
    assert len(sent) >= marks
    assert (len(sent) == 0) == (marks == 0)


def test_zero_goes_to_the_own_channel_alone_after_a_command_of_zero(script, connect, clock):
    script.objects |= {(0x2102, 2): (0, 2)}
    supply = connect()
    supply.set(0.0)
    clock.sleep(5.0)
    script.received.clear()
    supply.safe()
    assert script.orders() == [(0x2000, 1, 0), (0x200E, 0, 1)]


def test_adapter_that_could_not_be_opened_releases_its_port(script, connect, monkeypatch):
    ports, usual = [], serial.serial_for_url
    monkeypatch.setattr(serial, "serial_for_url", lambda *a, **k: ports.append(usual(*a, **k)) or ports[-1])

    def receive(_data):
        raise OSError("gone")

    right, script.receive = script.receive, receive
    with pytest.raises(DeviceConnectionError, match="cannot open"):
        connect()
    assert [port.is_open for port in ports] == [False]
    script.receive = right
    supply = connect()
    assert ports[-1].is_open
    assert 0.1 <= ports[-1].write_timeout <= 1.0
    supply.close()
    assert not ports[-1].is_open


def test_command_that_is_acknowledged_too_late_counts_as_dropped(script, connect, clock):
    supply = connect(watchdog=0.1)
    original = script.answer

    def answer(data):
        if data[:3] == b"\x23\x00\x20":
            clock.sleep(0.15)
        return original(data)

    script.answer = answer
    with pytest.raises(DeviceError, match=r"no command arrives within the watchdog of 0\.1 s"):
        supply.set(6.0)
    # Once it has been seen how long a request takes, it is not sent again.
    assert [value for index, _, value in script.orders()[-3:] if index == 0x2000] == [250, 0, 0]


@pytest.mark.parametrize("code", [0x06090011, 0x06020000])
def test_other_channels_that_are_not_there_do_not_matter_to_a_rescue(script, clock, code):
    script.aborts = {(0x2000, 2): code, (0x2000, 3): code}
    RoboteqSupply.rescue("supply", make_settings(), clock)
    assert script.orders() == [(0x2000, 1, 0), (0x2000, 2, 0), (0x2000, 3, 0), (0x200E, 0, 1)]


@pytest.mark.parametrize(("channel", "code"), [(1, 0x06090011), (1, 0x08000022), (2, 0x08000022)])
def test_zero_that_is_refused_after_a_gap_is_told(script, connect, clock, channel, code):
    script.objects |= {(0x2102, 2): (0, 2)}
    supply = connect()
    supply.set(6.0)
    clock.sleep(2.0)
    script.aborts[0x2000, channel] = code
    with pytest.raises(DeviceError, match=f"refused 0 as its motor command \\(object 0x2000:{channel}\\)"):
        supply.measure()
