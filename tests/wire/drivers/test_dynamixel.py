"""The driver of the MX-28, against a scripted servo at the other end of its line."""

import math
import struct

import pytest
from cases import cases
from faulty_line import InPieces
from hypothesis import given, strategies as st
from refusals import blamed

from bench.base import ConfigurationError, DeviceConnectionError, DeviceError, DeviceRestartedError, VirtualClock
from drivers.dynamixel import DynamixelDrum, DynamixelMX28, mx28 as driver
from drivers.dynamixel.mx28 import MX28Settings
from drivers.dynamixel.protocol2 import RefusedError, ServoLine, crc as driver_crc, frame
from sim_devices.instruments.dynamixel_table import ITEMS
from sim_devices.protocol_emulated import register, unregister
from sim_devices.wire import WireServer

PORT = "emulated://scripted-servo"
COUNT = 2.0 * math.pi / 4096
SIGNED = {20, 116, 126, 128, 132}
SIZES = {0: 2, 6: 1, 9: 1, 10: 1, 11: 1, 12: 1, 20: 4, 40: 4, 44: 4, 63: 1, 64: 1, 68: 1, 70: 1, 98: 1, 100: 2}
SIZES |= {108: 4, 112: 4}
SIZES |= {116: 4, 120: 2, 122: 1, 123: 1, 124: 2, 126: 2, 128: 4, 132: 4, 136: 4, 140: 4, 144: 2, 146: 1}


def crc(data):
    """Return the CRC, bit by bit."""
    value = 0
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1) ^ (0x18005 if value & 0x8000 else 0)
    return struct.pack("<H", value)


def packet(servo_id, instruction, parameters=b""):
    body = (bytes((instruction,)) + parameters).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    head = b"\xff\xff\xfd\x00" + struct.pack("<BH", servo_id, len(body) + 2) + body
    return head + crc(head)


FEEDBACK_BYTES = [68, 64, 70, 98, *range(116, 120), 122, *range(126, 136), 120, 121]


class Script(WireServer):
    """A servo of a few lines: a table of values, what it received, and answers put into its mouth.

    Its indirect data stand for what the driver reads at once; its realtime tick goes on with each reading of them.

    `instead` holds, request by request, bytes to send in place of the right answer (None for the right
    one); `refusals` error numbers by instruction and address.
    """

    def __init__(self):
        self.values = dict.fromkeys(SIZES, 0) | {0: 30, 6: 45, 9: 250, 11: 3, 40: 32767, 44: 380, 63: 52, 68: 2}
        self.indirect = [0] * 21
        self.values |= {126: 100, 128: -42, 132: 1000, 144: 121, 146: 31}
        self.received = []
        self.instead = []
        self.refusals = {}
        self.silent = False
        self.keeps = set()
        self.on_write = lambda _address, _value: None

    def receive(self, data):
        assert data[:4] == b"\xff\xff\xfd\x00"
        assert crc(data[:-2]) == data[-2:]
        self.received.append(data)
        right = self.right_answer(data)
        if self.silent:
            return b""
        if self.instead:
            other = self.instead.pop(0)
            if other is not None:
                return other(data, right) if callable(other) else other
        return right

    def right_answer(self, data):
        servo_id, instruction, parameters = data[4], data[7], data[8:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
        address = int.from_bytes(parameters[:2], "little")
        error = self.refusals.get((instruction, address), 0)
        content, level = b"", 2
        if error:
            pass
        elif instruction == 1:
            content, level = struct.pack("<HB", self.values[0], self.values[6]), 0
        elif instruction == 2:
            content, level = self.table(address, int.from_bytes(parameters[2:], "little")), 1
        elif instruction == 3:
            if address == 168:
                self.indirect = list(struct.unpack(f"<{(len(parameters) - 2) // 2}H", parameters[2:]))
                return packet(servo_id, 0x55, bytes((0x80 if self.values[70] else 0,)))
            size = SIZES[address]
            assert len(parameters) == 2 + size
            value = int.from_bytes(parameters[2:], "little", signed=address in SIGNED)
            self.on_write(address, value)
            if address not in self.keeps:
                self.values[address] = value
        elif instruction == 8:
            self.values |= {64: 0, 70: 0, 98: 0}
            self.on_write("reboot", 0)
        if self.values[68] < level:
            return b""
        flags = error | (0x80 if self.values[70] else 0)
        return packet(servo_id, 0x55, bytes((flags,)) + content)

    def table(self, address, length):
        data = b""
        if address == 224:
            self.values[120] = (self.values[120] + 1) % 32768
            assert length == len(self.indirect)
            return bytes(self.byte(meant) for meant in self.indirect)
        while len(data) < length:
            at = address + len(data)
            data += (self.values[at]).to_bytes(SIZES[at], "little", signed=at in SIGNED)
        assert len(data) == length
        return data

    def byte(self, address):
        first = max(known for known in SIZES if known <= address)
        value = self.values[first] & (1 << 8 * SIZES[first]) - 1
        return value.to_bytes(SIZES[first], "little")[address - first]

    def orders(self):
        """Return address and value of all that was written, and the names of other orders, once each."""
        orders = []
        for data in dict.fromkeys(self.received):
            if data[7] == 3:
                address = int.from_bytes(data[8:10], "little")
                if address == 168:
                    continue
                orders.append((address, int.from_bytes(data[10:-2], "little", signed=address in SIGNED)))
            elif data[7] == 8:
                orders.append("reboot")
        return orders


def make_settings(**changes):
    keys = {"port": PORT, "position_limits": (-3.0, 3.0)}
    return DynamixelMX28.Settings(**keys | changes)


def connect(clock, **changes):
    return DynamixelMX28.connect("servo", make_settings(**changes), clock)


@pytest.fixture
def servo(script, clock):
    servo = connect(clock)
    script.received.clear()
    return servo


# Packets.


@cases(
    ("instruction", "parameters", "sent"),
    [
        (0x01, "", "FFFFFD00 01 0300 01 194E"),
        (0x02, "84000400", "FFFFFD00 01 0700 02 84000400 1D15"),
        (0x03, "7400FFFFFD00", "FFFFFD00 01 0A00 03 7400FFFFFDFD00 21E7"),
        (0x03, "620005", "FFFFFD00 01 0600 03 620005 68E4"),
        (0x03, "740000020000", "FFFFFD00 01 0900 03 740000020000 CA89"),
        (0x08, "", "FFFFFD00 01 0300 08 2F4E"),
    ],
)
def test_packets_of_the_maker(instruction, parameters, sent):
    assert frame(1, instruction, bytes.fromhex(parameters)) == bytes.fromhex(sent)


# Requests and replies as published: of an XL330, recorded from hardware (ScrapMeta/microduck-diy, Reachy Mini); from
# a replayed fixture (pkinney/robotis); and of the e-Manual, Protocol 2.0. They test packets, not the MX-28's table.
# Id, instruction, parameters, request, reply, error number, content.
EXCHANGES = """
 1  0x01  -           FFFFFD0001030001194E                FFFFFD000107005500B00435B754       0  B00435
 1  0x02  00000200    FFFFFD0001070002000002002151        FFFFFD000106005500B004D47B         0  B004
 1  0x02  07000100    FFFFFD00010700020700010022B7        FFFFFD0001050055000156A1           0  01
 1  0x02  FFFF0100    FFFFFD0001070002FFFF0100055B        FFFFFD000104005507B08C             7  00
15  0x02  92000100    FFFFFD000F070002920001003FD3        FFFFFD000F050055801B0C71         128  1B
 1  0x01  -           FFFFFD0001030001194E                FFFFFD000107005500B00431ACD4       0  B00431
 1  0x03  740056F9FFFF  FFFFFD0001090003740056F9FFFF833D    FFFFFD000104005506B50C             6  -
 1  0x03  400001      FFFFFD0001060003400001DB66          FFFFFD000104005500A10C             0  -
 1  0x03  400000      FFFFFD0001060003400000DEE6          FFFFFD000104005500A10C             0  -
 1  0x02  3F000100    FFFFFD00010700023F0001002B57        FFFFFD00010500550035ED21           0  35
 1  0x02  40000100    FFFFFD0001070002400001003CDB        FFFFFD0001050055000156A1           0  01
 1  0x08  -           FFFFFD00010300082F4E                FFFFFD000104005500A10C             0  -
 1  0x10  0144584C22  FFFFFD00010800100144584C22B1DC      FFFFFD000104005500A10C             0  -
"""


@cases("exchange", EXCHANGES.strip().splitlines())
def test_published_exchanges(script, clock, exchange):
    servo_id, instruction, *data, error, content = (field.strip("-") for field in exchange.split())
    parameters, sent, replied, content = map(bytes.fromhex, (*data, content))
    line = ServoLine("servo", make_settings(id=int(servo_id)), clock)
    script.received.clear()
    script.right_answer = lambda _data: replied
    if int(error) & 0x7F:
        with pytest.raises(RefusedError) as caught:
            line.ask(int(instruction, 16), parameters, len(content))
        assert caught.value.code == int(error)
    else:
        assert line.ask(int(instruction, 16), parameters, len(content)) == content
        # With the alert the data are good.
        assert line.alert is (int(error) == 0x80)
    assert script.received == [sent]


@given(st.integers(0, 252), st.binary(max_size=30))
def test_content_survives_the_stuffing(servo_id, content):
    script, clock = Script(), VirtualClock()
    register("stuffed-servo", script, clock)
    try:
        line = ServoLine("servo", make_settings(port="emulated://stuffed-servo", id=servo_id), clock)
        script.instead = [packet(servo_id, 0x55, b"\x00" + content)]
        assert line.ask(0x10, b"\xff\xff\xfd\x00", len(content)) == content
        assert script.received == [packet(servo_id, 0x10, b"\xff\xff\xfd\x00")]
    finally:
        unregister("stuffed-servo")


@given(st.binary(max_size=60))
def test_crc_is_that_of_the_polynomial(data):
    assert struct.pack("<H", driver_crc(data)) == crc(data)


# Connecting.


def test_connecting_configures_and_leaves_the_torque_off(script, clock):
    script.values |= {64: 1, 98: 255, 10: 1, 63: 1}
    connect(clock, return_delay=100e-6)
    assert script.orders() == [(64, 0), (98, 0), (11, 4), (10, 0), (9, 50), (63, 0b110101)]
    script.received.clear()
    connect(clock, return_delay=100e-6)
    assert script.orders() == [(64, 0), (98, 0)]


def test_torque_that_does_not_go_off_ends_the_connection_before_the_eeprom(script, clock):
    script.values[64] = 1
    script.keeps.add(64)
    with pytest.raises(DeviceError, match="does not switch its torque off"):
        connect(clock)
    assert script.orders() == [(64, 0)]


def test_eeprom_that_does_not_take_a_value(script, clock):
    script.keeps.add(11)
    with pytest.raises(DeviceError, match="keeps its operating mode at 3 instead of 4"):
        connect(clock)


@cases("level", [0, 1])
def test_servo_that_does_not_answer_everything_is_made_to(script, clock, level):
    script.values[68] = level
    servo = connect(clock)
    assert script.values[68] == 2
    assert servo.measure()["servo_position"] == pytest.approx(1000 * COUNT)


@pytest.mark.parametrize("offset", [1, -1024])
def test_homing_offset_is_refused_with_the_watchdog(script, clock, offset):
    script.values[20] = offset
    with pytest.raises(
        ConfigurationError, match=rf"servo: watchdog: .* offset of {offset} counts, .* zero_counts"
    ) as caught:
        connect(clock)
    assert "without end" in str(caught.value)
    assert script.orders() == []
    connect(clock, watchdog=0)


def test_wrong_device(script, clock, monkeypatch):
    closed = []
    close = ServoLine.close
    monkeypatch.setattr(ServoLine, "close", lambda line: (closed.append(line), close(line)))
    script.values[0] = 29
    with pytest.raises(DeviceConnectionError, match=r"expected a Dynamixel MX-28 .* id 1, found model 29"):
        connect(clock)
    script.values |= {0: 30, 6: 38}
    with pytest.raises(DeviceConnectionError, match=r"firmware 38, expected 39 or newer"):
        connect(clock)
    assert script.orders() == []
    # A line that stayed open would keep the port from the next one who tries.
    assert len({id(line) for line in closed}) == 2


def test_settings_beyond_the_limits_of_the_servo_are_told_by_their_key(script, clock):
    for changes, key in (({44: 40}, "profile_velocity"), ({40: 4}, "profile_acceleration")):
        script.values |= {40: 32767, 44: 380}
        script.values |= changes
        with pytest.raises(ConfigurationError, match=rf"servo: {key}: .* is beyond the .* limit that is set"):
            connect(clock)
    assert script.orders() == []


def test_servo_that_never_answered(script, clock):
    script.silent = True
    with pytest.raises(DeviceConnectionError, match=r"no answer within 0\.1 s at emulated://scripted-servo, id 7"):
        connect(clock, id=7)


@cases(
    ("key", "changes"),
    [
        ("position_limits", {"position_limits": (1.0, 1.0)}),
        ("position_limits", {"position_limits": (2.0, 1.0)}),
        ("position_limits", {"position_limits": (0.0, 1700.0)}),
        ("position_limits", {"position_limits": (0.0, 1000.0), "zero_counts": 500_000}),
        ("position_limits", {"position_limits": (-1000.0, 0.0), "zero_counts": 500_000, "direction": -1}),
        ("direction", {"direction": 0}),
        ("watchdog", {"watchdog": 0.01}),
    ],
)
def test_settings_that_make_no_sense(key, changes):
    assert blamed(make_settings, changes) == {key}
    assert make_settings(watchdog=0).watchdog == 0.0
    assert make_settings(direction=-1, zero_counts=500_000, position_limits=(0.0, 1000.0)).zero_counts == 500_000


# Measuring.


def test_feedback_is_one_read_of_one_block(script, servo):
    assert servo.measure() == pytest.approx(
        {"servo_position": 1000 * COUNT, "servo_velocity": -42 * 0.229 * 2 * math.pi / 60, "servo_load": 0.1}
    )
    assert script.received == [packet(1, 0x02, bytes.fromhex("E0001500"))]
    assert script.indirect == FEEDBACK_BYTES


def test_zero_and_direction(script, clock):
    servo = connect(clock, zero_counts=1200, direction=-1, id=9)
    values = servo.measure()
    assert values["servo_position"] == pytest.approx(200 * COUNT)
    assert values["servo_velocity"] > 0
    assert values["servo_load"] == -0.1
    servo.set(-1.0)
    assert script.values[116] == 1200 + 652
    assert all(data[4] == 9 for data in script.received)


def test_alert_whose_cause_has_gone(script, servo):
    script.values[70] = 1
    script.instead = [lambda _sent, right: (script.values.update({70: 0}), right)[1]]
    with pytest.raises(DeviceError, match=r"0x00 \(none any more"):
        servo.measure()


@pytest.mark.parametrize(("key", "text"), [((2, 224), "feedback"), ((2, 11), "operating mode")])
def test_refused_reading(script, servo, key, text):
    script.refusals[key] = 7
    with pytest.raises(DeviceError, match=f"refused to report its {text}: the address cannot be accessed"):
        servo.set(1.0)


# Moving.


def test_first_set_point_switches_on_under_the_watchdog_where_it_stands(script, servo):
    status = servo.set(2.0)
    assert script.orders() == [
        (98, 0),
        (108, 5),
        (112, 41),
        (116, 1000),
        (98, 125),
        (64, 1),
        (116, 1304),
    ]
    assert servo.torque_enabled
    script.values |= {122: 1, 132: 1304}
    assert not status.update()
    script.values[122] = 0
    assert status.update()
    assert status.success
    script.received.clear()
    servo.set(1.0)
    assert script.orders() == [(116, 652)]


def test_profile_is_rounded_down(script, clock):
    for acceleration, units in ((0.7, 1), (3 * 214.577 * 2 * math.pi / 3600, 3)):
        servo = connect(clock, profile_velocity=42 * 0.229 * 2 * math.pi / 60, profile_acceleration=acceleration)
        servo.set(1.0)
        assert (script.values[112], script.values[108]) == (42, units)


def test_tolerance_decides_about_the_arrival(script, clock):
    servo = connect(clock, tolerance=0.02)
    status = servo.set(2.0)
    script.values[132] = 1304 - 14
    assert not status.update()
    script.values[132] = 1304 + 13
    assert status.update()
    assert status.success


def test_shaft_that_stands_elsewhere(script, servo, clock):
    status = servo.set(2.0)
    script.values |= {132: 1200, 126: -350}
    begin = clock.now()
    with pytest.raises(DeviceError, match=r"stands at 1\.841 rad instead of 2 rad, under a load of 35 %: take away"):
        status.wait()
    assert clock.now() - begin == pytest.approx(1.0, abs=0.2)


def test_hardware_error_when_the_torque_is_switched_on(script, servo):
    script.on_write = lambda address, value: script.values.update({70: 0x10} if (address, value) == (64, 1) else {})
    with pytest.raises(DeviceError, match="electrical shock"):
        servo.set(1.0)
    assert script.orders()[-1] == (64, 1)


def test_stop_takes_the_present_position_for_the_goal(script, servo):
    servo.stop()
    assert script.orders() == []
    servo.set(2.0)
    script.values[132] = -1100
    servo.stop()
    assert script.values[116] == -1100
    assert servo.setpoint == pytest.approx(-1100 * COUNT)
    script.values[98] = 255
    script.received.clear()
    servo.stop()
    assert script.orders() == []


# The watchdog.


def test_goal_that_an_expired_watchdog_refuses(script, servo):
    servo.set(2.0)
    script.refusals[3, 116] = 4
    with pytest.raises(
        DeviceError, match=r"refused 1 rad \(652 counts\) as its goal position: the value is out of range"
    ):
        servo.set(1.0)
    script.values[98] = 255
    with pytest.raises(DeviceError, match="bus watchdog"):
        servo.set(1.0)


def test_without_a_watchdog_it_is_not_asked_for(script, clock):
    servo = connect(clock, watchdog=0.0)
    servo.set(2.0)
    clock.sleep(100.0)
    script.received.clear()
    servo.measure()
    assert len(script.received) == 1
    assert script.values[98] == 0


# Safe state, reboot.


def test_safe_switches_off_and_disarms(script, servo):
    servo.set(2.0)
    script.received.clear()
    servo.safe()
    assert script.orders() == [(64, 0), (98, 0)]
    script.received.clear()
    servo.safe()
    assert script.orders() == [(64, 0), (98, 0)]


def test_safe_goes_on_to_the_reboot(script, servo):
    servo.set(2.0)
    script.refusals[3, 64] = 1
    script.received.clear()
    servo.safe()
    assert script.orders() == [(64, 0), (100, 0), "reboot", (98, 0)]
    assert script.values[64] == 0


def test_safe_raises_only_after_everything_was_tried(script, servo):
    servo.set(2.0)
    script.refusals |= {(3, 64): 1, (3, 100): 1, (8, 0): 1}
    script.received.clear()
    with pytest.raises(DeviceError, match=r"does not confirm .*refused 0 as its torque enable.*disconnect its power"):
        servo.safe()
    assert script.orders() == [(64, 0), (100, 0), "reboot"]


def test_safe_of_a_silent_servo_tries_everything_and_does_not_take_long(script, servo, clock):
    script.silent = True
    begin = clock.now()
    with pytest.raises(DeviceError, match=r"does not confirm .*no answer"):
        servo.safe()
    assert script.orders() == [(64, 0), (100, 0), "reboot"]
    assert clock.now() - begin < 4.0


def test_safe_succeeds_when_only_answers_were_lost(script, servo):
    servo.set(2.0)
    script.instead = [b"", b"", b"", None]
    servo.safe()
    assert "reboot" not in script.orders()
    assert script.values[64] == 0


def test_reboot_waits_and_configures_again(script, servo):
    servo.set(2.0)
    script.values[70] = 0x20
    script.on_write = lambda address, _value: (
        script.instead.extend([b""] * 7 * (not script.instead)) if address == "reboot" else None
    )
    script.received.clear()
    servo.reboot()
    assert script.orders()[0] == "reboot"
    assert math.isnan(servo.setpoint)
    servo.measure()


def test_servo_that_does_not_come_back(script, servo, clock):
    script.silent = True
    begin = clock.now()
    with pytest.raises(DeviceConnectionError, match="no answer"):
        servo.reboot()
    assert clock.now() - begin == pytest.approx(5.5, abs=0.7)


# The drum.


RADIUS = 0.012


def make_drum_settings(**changes):
    keys = {"port": PORT, "drum_radius": RADIUS, "stage_limits": (-0.036, 0.036)}
    return DynamixelDrum.Settings(**keys | changes)


def connect_drum(clock, **changes):
    drum = DynamixelDrum.connect("stage", make_drum_settings(**changes), clock)
    assert math.isnan(drum.setpoint)
    return drum


@cases("direction", [1, -1])
@cases("zero_counts", [0, 1200, -70_000])
@cases("metres", [0.0, 0.012, -0.0213, 0.036, -0.036])
def test_metres_to_counts_and_back(script, clock, direction, zero_counts, metres):
    drum = connect_drum(clock, direction=direction, zero_counts=zero_counts)
    drum.set(metres)
    counts = script.values[116]
    assert counts == zero_counts + direction * round(metres / RADIUS * 4096 / (2 * math.pi))
    assert drum.setpoint == metres
    script.values |= {126: 100, 128: -42, 132: counts}
    assert drum.measure() == pytest.approx(
        {
            "stage_position": metres,
            "stage_velocity": -direction * 42 * 0.229 * 2 * math.pi / 60 * RADIUS,
            "stage_load": direction * 0.1,
        },
        abs=0.5 * COUNT * RADIUS,
    )


@cases(
    "changes",
    [
        {"stage_limits": (0.0, 20.0)},
        {"stage_limits": (0.0, 12.0), "zero_counts": 500_000},
        {"stage_limits": (-12.0, 0.0), "zero_counts": 500_000, "direction": -1},
        {"stage_limits": (0.0, 1.0), "drum_radius": 1e-4},
        {"stage_limits": (0.02, 0.01)},
        {"stage_limits": (0.01, 0.01)},
    ],
)
def test_stage_limits_that_the_servo_does_not_reach(changes):
    assert blamed(make_drum_settings, changes) == {"stage_limits"}


def test_stage_limits_on_the_side_where_the_servo_reaches_far():
    make_drum_settings(stage_limits=(-12.0, 0.0), zero_counts=500_000)
    make_drum_settings(stage_limits=(0.0, 12.0), zero_counts=500_000, direction=-1)


def test_settings_of_a_drum_reach_the_servo():
    changes = {"id": 7, "baudrate": 1_000_000, "direction": -1, "zero_counts": 5, "watchdog": 1.0, "tolerance": 0.02}
    shared = set(MX28Settings.model_fields)
    servo = make_settings(position_limits=(-0.036 / 0.012, 0.036 / 0.012), **changes)
    assert make_drum_settings(**changes).model_dump(include=shared) == servo.model_dump(include=shared)


def test_messages_of_the_drum_speak_metres(script, clock):
    drum = connect_drum(clock)
    status = drum.set(0.024)
    script.values |= {132: 1200, 126: -350}
    with pytest.raises(
        DeviceError, match=r"stage: stands at 0\.0220893 m instead of 0\.0240037 m, under a load of 35 %"
    ):
        status.wait()
    first = drum.set(0.024)
    drum.set(0.012)
    with pytest.raises(DeviceError, match=r"stage: 0\.0240037 m was replaced by another goal"):
        first.wait()
    script.refusals[3, 116] = 6
    with pytest.raises(DeviceError, match=r"stage: refused 0\.0240037 m \(1304 counts\) as its goal position"):
        drum.set(0.024)
    assert drum.setpoint == 0.012
    del script.refusals[3, 116]
    status = drum.set(0.024)
    script.values[64] = 0
    with pytest.raises(DeviceError, match=r"stage: the torque was switched off before it reached 0\.0240037 m"):
        status.wait()


# A line that is not good.


@cases(
    "damaged",
    [
        b"",
        lambda _sent, right: right[:9] + bytes((right[9] ^ 1,)) + right[10:],
        lambda _sent, right: right[1:],
        lambda _sent, right: right[:5] + b"\x10\x02" + right[7:],
        lambda _sent, right: right[:5] + b"\xff\xff" + right[7:],
        lambda _sent, right: right[:5] + b"\x30\x00" + right[7:],
        lambda _sent, right: packet(1, 0x55, right[8:-3]),
        lambda _sent, _right: packet(1, 0x55, b"\x00"),
        lambda _sent, _right: packet(1, 0x55, b"\x03"),
        lambda _sent, _right: packet(1, 0x55),
        lambda _sent, right: packet(2, 0x55, right[8:-2]),
        b"\xff" * 3000,
    ],
)
def test_a_damaged_answer_costs_a_resend(script, servo, damaged):
    script.received.clear()
    script.instead = [damaged, damaged]
    assert servo.measure()["servo_position"] == pytest.approx(1000 * COUNT)
    assert len(script.received) == 3
    assert len(set(script.received)) == 1
    assert servo.torque_enabled is False


@cases(
    "before",
    [
        lambda sent, _right: sent,
        lambda _sent, _right: b"noise\xff\xff",
        lambda _sent, right: packet(2, 0x55, right[8:-2]),
        lambda sent, _right: sent + packet(2, 0x55, b"\x00"),
        lambda _sent, _right: b"\xff\xff\xfd\x00\xff\xff\xff",
    ],
)
def test_what_is_not_the_answer_is_passed_over(script, servo, before):
    script.received.clear()
    script.instead = [lambda sent, right: before(sent, right) + right] * 2
    assert servo.measure()["servo_position"] == pytest.approx(1000 * COUNT)
    assert not servo.torque_enabled
    assert len(script.received) == 2


def test_answer_that_comes_after_its_resend_is_not_taken_for_the_next(script, servo):
    late = packet(1, 0x55, b"\x00\x01")
    script.instead = [b"", lambda _sent, right: right + late]
    assert servo.torque_enabled is False
    assert servo.torque_enabled is False
    script.instead = [b"", b"", b""]
    with pytest.raises(DeviceConnectionError):
        servo.measure()
    servo._line.port._received += late
    assert servo.torque_enabled is False


def test_only_packets_of_others(script, servo):
    script.instead = [packet(2, 0x55, b"\x00") * 20] * 3
    with pytest.raises(DeviceConnectionError, match="only packets of others"):
        servo.measure()


@given(st.lists(st.one_of(st.binary(max_size=40), st.just(packet(1, 0x55, b"\x00")[:-1])), min_size=3, max_size=3))
def test_no_bytes_are_taken_for_an_answer_that_they_are_not(replies):
    script, clock = Script(), VirtualClock()
    register("fuzzed-servo", script, clock)
    try:
        line = ServoLine("servo", make_settings(port="emulated://fuzzed-servo"), clock)
        script.instead = list(replies)
        with pytest.raises(DeviceConnectionError):
            line.reading(224, 21)()
        assert line.ask(0x02, bytes.fromhex("84000400"), 4) == (1000).to_bytes(4, "little")
    finally:
        unregister("fuzzed-servo")


# What stands in the manual, from which the emulated servo has its table.


def test_items_are_those_of_the_control_table():
    for item in (each for each in vars(driver).values() if isinstance(each, driver._Item)):
        addresses = (9, 10, 11, 12) if item is driver._MODES else (item.address,)
        assert sum(ITEMS[address].size for address in addresses) == item.size


def test_own_check_tells_supply_and_turns(script, clock):
    supply, turns = connect(clock, position_limits=(-math.pi, math.pi)).self_check()
    assert supply.text == "12.1 V, servo 31 °C"
    assert turns.text == "the limits span 1 turns; which of them it is in is lost when it is switched off"
    _, turns = connect(clock, position_limits=(-math.pi, 0.9 * math.pi)).self_check()
    assert turns.text == "the limits span 0.95 turns"
    assert connect(clock).safe_within == 2.0


def test_servo_without_feedback_is_not_connected(script, clock):
    for key in ((2, 224), (3, 168)):
        script.refusals = {key: 7}
        with pytest.raises(DeviceError, match="refused"):
            connect(clock)


# Readings that stand still, and goals whose answer is lost.


def test_tick_that_stands_still(script, servo, clock):
    servo.measure()
    still = [script.values[120]]

    def unmoved(_sent, _right):
        script.values[120] = still[0] - 1
        return packet(1, 0x55, b"\x00" + script.table(224, 21))

    script.instead = [unmoved] * 3
    script.received.clear()
    servo.measure()
    assert len(script.received) == 1  # within 5 ms the tick may be the same
    clock.sleep(0.006)
    script.instead = [unmoved] * 3
    script.received.clear()
    servo.measure()
    assert len(script.received) == 4
    assert servo.repeats == 3
    still[0] = script.values[120]
    clock.sleep(0.006)
    script.instead = [unmoved] * 4
    with pytest.raises(DeviceError, match="tick stands still"):
        servo.measure()


def test_goal_whose_answer_is_lost_may_be_the_former_or_the_new_one(script, servo):
    servo.set(2.0)
    script.instead = [None, b"", b"", b""]
    with pytest.raises(DeviceConnectionError):
        servo.set(1.0)
    for goal in (1304, 652):
        script.values[116] = goal
        servo.measure()
    servo.set(1.0)
    script.values[116] = 1304
    with pytest.raises(DeviceError, match="its goal was changed to 2 rad by another host, from 1 rad"):
        servo.measure()


def test_error_that_comes_with_the_goal(script, servo):
    servo.set(2.0)
    script.on_write = lambda address, _value: script.values.update({70: 0x20} if address == 116 else {})
    with pytest.raises(DeviceError, match="overload"):
        servo.set(1.0)


def test_watchdog_that_expires_just_before_the_goal(script, servo):
    servo.set(2.0)

    def expired(_sent, _right):
        script.values[98] = 255
        return packet(1, 0x55, b"\x04")

    script.instead = [None, expired]
    with pytest.raises(DeviceError, match="the bus watchdog stopped the servo"):
        servo.set(1.0)


def test_restart_is_told_until_the_servo_is_connected_again(script, servo, clock):
    servo.set(2.0)
    script.indirect = [200] * 21  # nothing is there
    script.values |= {64: 0}
    SIZES[200] = 1
    script.values[200] = 0
    for action in (servo.measure, lambda: servo.set(1.0), servo.measure):
        with pytest.raises(DeviceRestartedError, match="the servo has restarted"):
            action()
    connect(clock).measure()
    # That another driver has set the servo up does not bring the turns back.
    with pytest.raises(DeviceRestartedError, match="the servo has restarted"):
        servo.measure()
    servo.reboot()
    servo.measure()


def test_time_that_a_motion_is_given(script, clock):
    servo = connect(clock, profile_velocity=0.5, profile_acceleration=1.0, arrival_timeout=2.0)
    velocity, acceleration = 20 * 0.229 * 2 * math.pi / 60, 2 * 214.577 * 2 * math.pi / 3600
    begin = clock.now()
    status = servo.set(1000 * COUNT - 1.0)
    script.values[122] = 1
    with pytest.raises(DeviceError, match="did not arrive within"):
        status.wait()
    expected = 2.0 + 1.0 / velocity + 4.0 * velocity / acceleration
    assert clock.now() - begin == pytest.approx(expected, abs=0.12)


# How long things take.


def sending_times(script, clock):
    """Return a list that fills with the times at which requests come."""
    times, receive = [], script.receive
    script.receive = lambda data: times.append(clock.now()) or receive(data)
    return times


def test_after_a_lost_answer_the_next_request_waits_for_it(script, servo, clock):
    times = sending_times(script, clock)
    script.instead = [b""]
    servo.measure()
    assert servo.repeats == 1
    assert servo.torque_enabled is False
    assert times[2] - times[1] == pytest.approx(0.3, abs=0.01)  # three time-outs after the second request
    servo.torque_enabled  # noqa: B018 - asks the servo
    assert times[3] - times[2] < 0.02


def test_safe_state_does_not_wait_for_late_answers(script, servo, clock):
    times = sending_times(script, clock)
    script.instead = [b""]
    servo.measure()
    servo.safe()
    assert times[2] - times[1] < 0.02
    assert times[3] - times[1] == pytest.approx(0.3, abs=0.01)


def test_reboot_on_the_way_to_the_safe_state_takes_a_second(script, servo, clock):
    servo.set(2.0)
    script.refusals[3, 64] = 1
    script.keeps.add(64)
    times = sending_times(script, clock)
    rebooted = []

    def silence(address, _value):
        if address == "reboot":
            rebooted.append(clock.now())
            script.silent = True

    script.on_write = silence
    with pytest.raises(DeviceError, match="does not confirm"):
        servo.safe()
    after = [time - rebooted[0] for time in times if time > rebooted[0]]
    assert 0.9 < max(after) < 2.1


@cases("noise", [b"", b"no\xff\xff\xfd"])
@cases("place", range(20))
@cases("kind", ["value", "acknowledge"])
def test_an_answer_in_pieces_is_put_together_and_costs_no_more_than_its_pause(clock, place, kind, noise):
    script = Script()
    answered = script.right_answer
    script.right_answer = lambda data: noise + answered(data)
    register("pieces-servo", InPieces(script, clock, place, 0.02), clock)
    try:
        line = ServoLine("servo", make_settings(port="emulated://pieces-servo"), clock)
        before = clock.now()
        if kind == "value":
            assert line.ask(0x02, bytes.fromhex("84000400"), 4) == (1000).to_bytes(4, "little")
        else:
            line.order(0x03, bytes.fromhex("620005"))
        assert clock.now() - before < 0.03
        assert line.repeats == 0
    finally:
        unregister("pieces-servo")


@cases(("head", "requests"), [("0200", 1), ("0101", 1), ("0000", 1), ("ffff", 1), ("0300", 2), ("0001", 2)])
def test_heads_that_are_none_are_passed_over(script, servo, clock, head, requests):
    # Lengths are 3 to 256 bytes; what seems to have one of them is waited for, and is damaged.
    script.received.clear()
    script.instead = [lambda _sent, right: b"\xff\xff\xfd\x00\x01" + bytes.fromhex(head) + right]
    before = clock.now()
    servo.measure()
    assert len(script.received) == requests
    assert requests == 2 or clock.now() - before < 0.02
