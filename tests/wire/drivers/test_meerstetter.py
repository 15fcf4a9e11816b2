"""The driver of the Meerstetter TEC controllers, against a scripted device at the other end of its line."""

import math
import struct
import sys
from binascii import crc_hqx
from itertools import pairwise

import pytest
from cases import cases
from faulty_line import InPieces
from hypothesis import given, strategies as st
from refusals import blamed

from bench.base import (
    ConfigurationError,
    DeviceConnectionError,
    DeviceError,
    DeviceRestartedError,
    VirtualClock,
    WallClock,
)
from bench.devices import TECMode
from drivers.meerstetter import DEVICE_ERRORS, SERVER_ERRORS, MeerstetterTEC, tec as driver
from drivers.meerstetter.mecom import Parameter, RefusedError, TECLine, decode, encode
from sim_devices.instruments.meerstetter_table import PARAMETERS
from sim_devices.protocol_emulated import register, unregister
from sim_devices.wire import WireServer

PORT = "emulated://scripted-tec"
REALS = {1000, 1001, 1020, 1021, 1060, 1063, 2030, 2031, 2060, 3000, 4010, 4011, 4040, 4041, 5011, 6310}
REALS |= {50001, 50002, 50012}


def answer(body):
    return body + b"%04X\r" % crc_hqx(body, 0)


def bits(number, value):
    if number in REALS:
        return struct.pack(">f", value).hex().upper().encode()
    return b"%08X" % (value & 0xFFFFFFFF)


class Script(WireServer):
    """A device of a few lines: a table of values, what it received, and answers put into its mouth.

    `instead` holds, request by request, bytes to send in place of the right answer (None for the right
    one); `refusals` server errors by the beginning of a request.
    """

    def __init__(self):
        self.values = {100: 1091, 102: 4711, 103: 412, 104: 1, 105: 0, 106: 0, 107: 0, 3034: 1, 1200: 0}
        self.values |= {1000: 25.5, 1001: 24.0, 1020: 0.25, 1021: 1.5}
        self.limits = {2030: (0.0, 4.0), 2031: (0.0, 21.0), 3000: (-273.0, 1000.0)}
        self.received = []
        self.instead = []
        self.refusals = {}
        self.silent = False
        self.knows_blocks = True
        self.on_order = lambda _payload: None

    def receive(self, data):
        assert data.endswith(b"\r")
        self.received.append(data)
        if self.silent:
            return b""
        right = self.right_answer(data)
        if self.instead:
            other = self.instead.pop(0)
            if other is not None:
                return other(data, right) if callable(other) else other
        return right

    def right_answer(self, data):
        head, payload, crc = b"!" + data[1:7], data[7:-5], data[-5:]
        assert crc == b"%04X\r" % crc_hqx(data[:-5], 0)
        text = payload.decode()
        for start, code in self.refusals.items():
            if text.startswith(start):
                return answer(head + b"+%02X" % code)
        if text.startswith("?VX"):
            if not self.knows_blocks:
                return answer(head + b"+01")
            names = [int(text[at : at + 4], 16) for at in range(5, len(text), 6)]
            assert len(names) == int(text[3:5], 16)
            return answer(head + b"".join(bits(number, self.values.get(number, 0)) for number in names))
        if text.startswith("?VR"):
            number = int(text[3:7], 16)
            return answer(head + bits(number, self.values.get(number, 0)))
        if text.startswith("?VL"):
            number = int(text[3:7], 16)
            low, high = self.limits.get(number, (0.0, 100000.0))
            return answer(head + b"00" + bits(number, low) + bits(number, high))
        if text == "?IF":
            return answer(head + b"LDD-1121 v1.00      ")
        self.on_order(text)
        if text.startswith("VS"):
            number = int(text[2:6], 16)
            self.values[number] = struct.unpack(">f" if number in REALS else ">i", bytes.fromhex(text[8:]))[0]
            if self.values[104] in (1, 2):
                on = self.values.get(2010) == 2 and self.values.get(50000) == 1
                self.values[104] = 2 if on else 1
        return head + crc

    def orders(self):
        """Return the payloads of all that was written, once each."""
        frames = dict.fromkeys(data for data in self.received if data[7:8] != b"?")
        return [data[7:-5].decode() for data in frames]


def make_settings(**changes):
    keys = {"port": PORT, "temperature_limits": (15, 90), "current_limit": 3.0, "voltage_limit": 12.0}
    return MeerstetterTEC.Settings(**keys | changes)


def connect(clock, **changes):
    return MeerstetterTEC.connect("tec", make_settings(**changes), clock)


@pytest.fixture
def line(script):
    # The maker's examples use the address that every device answers to.
    settings = make_settings().model_copy(update={"address": 0})
    return TECLine("tec", settings)


@pytest.fixture
def tec(script, clock):
    tec = connect(clock)
    script.received.clear()
    return tec


@pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals")
def test_over_a_pseudo_terminal(pseudo_terminal):
    class Whole(Script):
        """A device whose requests may come in pieces."""

        waiting = b""

        def receive(self, data):
            self.waiting += data
            if not self.waiting.endswith(b"\r"):
                return b""
            request, self.waiting = self.waiting, b""
            return super().receive(request)

    script = Whole()
    with pseudo_terminal(script) as path:
        tec = connect(WallClock(), port=path, timeout=10.0)
        script.received.clear()
        assert tec.measure()["tec_temperature"] == 25.5
        tec.set(30.0)
        # Nothing was sent twice, as no answer was missed.
        assert len(set(script.received)) == len(script.received) > 0
        assert tec.setpoint == 30.0
        tec.safe()
        tec.close()


@cases(
    ("sequence", "request_text", "digits", "sent", "replied", "content"),
    [
        # Meerstetter 5136AL, chapter 5, captured with a TEC-1089.
        (0x15AA, "?IF", 20, b"#0015AA?IF62AE\r", b"!0015AA8065-TEC SW G01     7199\r", "8065-TEC SW G01     "),
        (0x15AB, "?VR006401", 8, b"#0015AB?VR0064018000\r", b"!0015AB000004411DBD\r", "00000441"),
        (0x15AC, "?VR006601", 8, b"#0015AC?VR0066018125\r", b"!0015AC000000706F2C\r", "00000070"),
        (0x15AE, "VS07DA0100000002", 0, b"#0015AEVS07DA01000000028F97\r", b"!0015AE8F97\r", ""),
        (0x15AB, "?VR03E801", 8, b"#0015AB?VR03E801C21A\r", b"!0015AB41CD2F28D5C2\r", "41CD2F28"),
        (0x15B0, "VS0BB80141AE0000", 0, b"#0015B0VS0BB80141AE0000C482\r", b"!0015B0C482\r", ""),
        # Meerstetter 5117C.
        (0xBDE2, "RS", 0, b"#00BDE2RS9780\r", b"!00BDE29780\r", ""),
    ],
)
def test_sequences_of_the_maker(script, line, sequence, request_text, digits, sent, replied, content):
    script.received.clear()
    script.instead = [replied]
    line._sequence = sequence - 1
    assert line._exchange(request_text, digits) == content.encode()
    assert script.received == [sent]


def test_server_error_of_the_maker(script, line):
    script.instead = [b"!0015AC+0532DA\r"]
    line._sequence = 0x15AB
    with pytest.raises(RefusedError, match="parameter is not available") as caught:
        line.ask("?VR04D201", 8)
    assert caught.value.code == 5
    assert script.received == [b"#0015AC?VR04D2017BFE\r"]


def test_answers_of_the_maker_at_address_1(script):
    line = TECLine("tec", make_settings())
    line._sequence = 0x15A9
    script.instead = [b"!0115AA8065-TEC SW G01     342D\r", None, b"!0115AC+057509\r"]
    assert line.ask("?IF", 20) == "8065-TEC SW G01     "
    assert script.received == [b"#0115AA?IF257D\r"]
    line.ask("?VR006801", 8)
    with pytest.raises(RefusedError, match="parameter is not available"):
        line.ask("?VR04D201", 8)


def test_values_of_the_maker():
    temperature = decode("tec", driver._OBJECT_TEMPERATURE, "41CD2F28")
    assert temperature == pytest.approx(25.648, abs=5e-5)
    assert encode(driver._TARGET, 21.75) == "41AE0000"


def test_first_frame_of_a_connection_is_whole(script, clock):
    settings = make_settings()
    line = TECLine("tec", settings)
    line.order("VS07E401BF000000")
    assert script.received == [b"#010001VS07E401BF000000E796\r"]


def test_sequence_number_turns_over(script, line):
    line._sequence = 0xFFFE
    for _ in range(3):
        line.ask("?VR006801", 8)
    assert [data[3:7] for data in script.received] == [b"FFFF", b"0000", b"0001"]


@given(st.floats(width=32, allow_nan=False), st.integers(-(2**31), 2**31 - 1))
def test_values_survive_coding(real, integer):
    for parameter, value in ((driver._TARGET, real), (driver._STATUS, integer)):
        digits = encode(parameter, value)
        assert len(digits) == 8
        assert digits == digits.upper()
        assert decode("tec", parameter, digits) == value


def test_connecting_configures_and_leaves_the_output_off(script, clock):
    script.values |= {104: 2, 2010: 2, 50000: 1}
    connect(clock, mode="current", stable_window=0.05, stable_time=2.0)
    orders = script.orders()
    assert orders[0] == "VS006C0100000001"  # saving to flash off, before anything else is written
    assert script.values[104] == 1
    expected = {108: 1, 2000: 1, 2010: 0, 2030: 3.0, 2031: 12.0, 2060: 0.0, 6310: 0.0, 50000: 0, 50001: 0.0}
    assert {number: script.values[number] for number in expected} == expected
    assert script.values[4040] == pytest.approx(0.05)
    assert script.values[4041] == 2.0


def test_channel_selects_the_instance_of_what_belongs_to_a_channel(script, clock):
    tec = connect(clock, channel=2)
    script.received.clear()
    tec.measure()
    assert [data[7:-5] for data in script.received] == [b"?VX0503E80203E90203FC0203FD02006801"]


def test_firmware_that_does_not_read_blocks_is_asked_one_by_one(script, clock):
    script.knows_blocks = False
    tec = connect(clock, channel=2)
    script.received.clear()
    script.values[1021] = 1.75
    assert list(tec.measure().values()) == [25.5, 24.0, 0.25, 1.75]
    assert [data[7:-5] for data in script.received] == [
        b"?VR03E802",
        b"?VR03E902",
        b"?VR03FC02",
        b"?VR03FD02",
        b"?VR006801",
    ]
    script.received.clear()
    tec.set(40.0)
    tec.measure()
    assert not any(data[7:10] == b"?VX" for data in script.received)  # found out once
    script.values |= {104: 3, 105: 138}
    with pytest.raises(DeviceError, match="error 138"):
        tec.measure()


def test_channel_that_the_device_does_not_have(script, clock):
    for knows_blocks in (True, False):
        script.knows_blocks = knows_blocks
        script.values[1001] = math.nan
        with pytest.raises(DeviceError, match="channel 2 reports no sink temperature: the TEC-1091 has no such"):
            connect(clock, channel=2)
        assert script.orders() == []


def test_temperature_set_point_is_live_and_guarded_by_the_watchdog(script, tec):
    status = tec.set(40.0)
    assert script.orders() == [
        "VSC35C0142200000",  # live target
        "VSC35B0100000001",  # live target selected
        "VS080C0140A00000",  # watchdog 5 s
        "VS07DA0100000002",  # enable by live enable
        "VSC3500100000001",  # live enable
    ]
    assert tec.output_enabled
    assert not status.update()
    # Stable still from before, as far as the device has noticed: that is not arriving.
    script.values[1200] = 2
    assert not status.update()
    script.values[1000] = 39.9
    assert status.update()
    assert status.success
    script.received.clear()
    tec.set(41.0)
    assert script.orders() == ["VSC35C0142240000"]


def test_current_set_point_is_live_and_complete_at_once(script, clock):
    tec = connect(clock, mode="current")
    script.received.clear()
    assert tec.set(-0.5).success
    assert script.orders()[:2] == ["VSC35101BF000000", "VSC3520141400000"]
    assert script.orders()[-1] == "VSC3500100000001"


def test_polarity_of_the_device(script, clock):
    script.values[3034] = 0
    tec = connect(clock, mode="current")
    tec.set(0.5)
    assert script.values[50001] == -0.5
    assert tec.measure()["tec_current"] == -0.25
    assert tec.measure()["tec_voltage"] == -1.5


def test_output_that_goes_off_by_itself_fails_the_status(script, tec):
    status = tec.set(40.0)
    script.values[104] = 1
    with pytest.raises(DeviceError, match="switched off before it reached 40 °C"):
        status.wait()


def test_a_fast_loop_of_currents_looks_at_the_output_every_tenth_of_a_second(script, clock):
    tec = connect(clock, mode="current", baudrate=1_000_000)
    tec.set(0.5)

    def sets_of(seconds):
        """Set a current every 20 ms; yield when, and what was sent for it."""
        while clock.now() < seconds:
            script.received.clear()
            begun = clock.now()
            tec.set(begun)
            yield begun, [data[7:14] for data in script.received]
            clock.sleep(0.02)

    sent = dict(sets_of(2.0))
    assert {requests[-1] for requests in sent.values()} == {b"VSC3510"}
    looks = [instant for instant, requests in sent.items() if b"?VR0068" in requests]
    gaps = [later - earlier for earlier, later in pairwise(looks)]
    # A set-point and the wait behind it come on top.
    assert 0.099 < min(gaps) <= max(gaps) < 0.122
    script.values[50000] = 0
    script.values[104] = 1
    with pytest.raises(DeviceError, match="its output is off although it was switched on"):
        list(sets_of(3.0))
    assert clock.now() < 2.0 + 0.15


def test_change_of_mode_switches_off_first(script, tec):
    tec.set(40.0)
    script.received.clear()
    tec.select_mode(TECMode.TEMPERATURE)
    assert script.received == []
    tec.select_mode(TECMode.CURRENT)
    assert script.orders() == [
        "VSC3500100000000",
        "VS07DA0100000000",
        "VS080C0100000000",
        "VSC3510100000000",
        "VS07D00100000001",
    ]
    assert math.isnan(tec.setpoint)
    assert tec.limits.unit == "A"


def test_error_that_the_driver_does_not_know(script, tec):
    script.values |= {104: 3, 105: 999}
    with pytest.raises(DeviceError, match=r"error 999 \(unknown to this driver"):
        tec.glance()


def test_refused_reading(script, tec):
    script.refusals["?VX"] = 8
    with pytest.raises(DeviceError, match=r"refused to report its object temperature, .*: the instance is not"):
        tec.measure()
    script.refusals = {"?VR03E8": 8}
    tec.set(40.0)
    with pytest.raises(DeviceError, match=r"object temperature \(parameter 1000\): the instance is not"):
        tec.stop()


@cases(("state", "title"), [(0, "init"), (4, "bootloader"), (5, "reset pending")])
def test_no_reading_of_a_device_that_is_not_ready(script, tec, state, title):
    script.values[104] = state
    with pytest.raises(DeviceError, match=rf"not ready \(device status {state}, {title}\)"):
        tec.measure()


def test_status_beyond_the_protocol_and_values_that_are_no_numbers(script, tec):
    script.values[104] = 9
    with pytest.raises(DeviceError, match="device status 9 that the protocol lacks"):
        tec.measure()
    script.values |= {104: 1, 1000: math.nan}
    with pytest.raises(DeviceError, match="not a number"):
        tec.measure()


def test_value_that_is_no_hex_number(script, tec):
    script.instead = [lambda _sent, right: answer(right[:7] + 5 * b"zzzzzzzz")]
    with pytest.raises(DeviceError, match=r"answered 'z{40}' for 5 parameters at once"):
        tec.measure()
    script.instead = [lambda _sent, right: answer(right[:7] + b"zzzzzzzz")]
    with pytest.raises(DeviceError, match="answered 'zzzzzzzz' for its device status"):
        _ = tec.output_enabled


@cases(
    "damaged",
    [
        b"",
        lambda _sent, right: right[:9] + bytes((right[9] ^ 1,)) + right[10:],
        lambda _sent, right: right[:-1],
        lambda _sent, _right: b"\r",
        lambda _sent, _right: b"noise\r",
        lambda _sent, right: b"!" + right,
        lambda _sent, right: b"\x00\xff" + right,
        lambda sent, _right: sent[:1].replace(b"#", b"!") + sent[1:7] + sent[-5:],  # an acknowledge
        lambda _sent, right: answer(right[:7] + b"+0Z"),
        lambda _sent, right: answer(right[:7] + b"00"),
        lambda _sent, right: answer(b"!02" + right[3:-5]),
    ],
)
def test_a_damaged_answer_costs_a_resend_with_the_same_sequence_number(script, tec, damaged):
    script.received.clear()
    script.instead = [damaged, damaged]
    assert tec.measure()["tec_temperature"] == 25.5
    assert tec.measure()["tec_sink_temperature"] == 24.0
    numbers = {data[3:7] for data in script.received}
    assert len(numbers) == len(set(script.received)) == 2


def test_acknowledge_must_carry_the_crc_of_the_request(script, tec):
    wrong = lambda _sent, right: right[:7] + b"%04X\r" % crc_hqx(right[:7], 0)  # noqa: E731
    script.instead = [None, wrong]
    tec.set(40.0)
    assert script.received[1] == script.received[2]


def test_late_answers_are_passed_over(script, tec):
    late = answer(b"!01000142C80000")
    script.instead = [lambda _sent, right: late + right, lambda _sent, right: late * 3 + right]
    for _ in range(2):
        values = tec.measure()
        assert (values["tec_temperature"], values["tec_sink_temperature"]) == (25.5, 24.0)
    assert len(script.received) == 2


def test_endless_nonsense_ends(script, tec):
    script.instead = [b"x" * 3000] * 3
    with pytest.raises(DeviceConnectionError, match="at emulated://scripted-tec, address 1, after 3 requests"):
        tec.measure()
    script.instead = [answer(b"!01000142C80000") * 20] * 3
    with pytest.raises(DeviceConnectionError, match="only late or damaged answers"):
        tec.measure()


@given(st.lists(st.one_of(st.binary(max_size=40), st.just(b"!010001+05ABCD\r")), min_size=3, max_size=3))
def test_no_bytes_are_taken_for_an_answer_that_they_are_not(replies):
    script, clock = Script(), VirtualClock()
    register("fuzzed-tec", script, clock)
    try:
        line = TECLine("tec", make_settings(port="emulated://fuzzed-tec"))
        script.instead = list(replies)
        with pytest.raises(DeviceConnectionError):
            line.ask("?VR03E801", 8)
        assert line.ask("?VR03E801", 8) == "41CC0000"
    finally:
        unregister("fuzzed-tec")


@cases("port", ["emulated://nobody", "/dev/no-such-port", "nonsense://x"])
def test_port_that_cannot_be_opened(script, clock, port):
    with pytest.raises(DeviceConnectionError, match=f"tec: cannot open {port}"):
        connect(clock, port=port)


def test_wrong_device(script, clock):
    script.values[100] = 1121
    with pytest.raises(DeviceConnectionError, match=r"found device type 1121, LDD-1121 v1\.00; check port"):
        connect(clock)
    script.refusals["?IF"] = 1
    with pytest.raises(DeviceConnectionError, match="found device type 1121; check port"):
        connect(clock)
    assert script.orders() == []


def test_reset_is_sent_once_and_what_is_safe_to_repeat_again(script, tec):
    script.instead = [b""]
    tec.reset()
    assert [data[7:-5] for data in script.received].count(b"RS") == 1
    script.received.clear()
    script.instead = [b"", b""]
    script.refusals = {"VSC350": 2}
    script.on_order = lambda text: script.values.update({104: 3, 105: 11} if text == "ES" else {})
    tec.safe()
    assert len({data for data in script.received if data[7:9] == b"ES"}) == 1


def test_device_that_does_not_come_back_from_a_reset(script, tec):
    script.on_order = lambda _text: setattr(script, "silent", True)
    with pytest.raises(DeviceConnectionError, match="no answer"):
        tec.reset()
    script.silent = False
    script.on_order = lambda _text: script.values.update({104: 5})
    with pytest.raises(DeviceError, match="did not start within 5 s"):
        tec.reset()


def test_settings_beyond_the_device_are_told_by_their_key_and_nothing_is_written(script, clock):
    for changes, key, allowed in (
        ({"current_limit": 6.0}, "current_limit: 6", "0 to 4"),
        ({"voltage_limit": 20.0}, "voltage_limit: 20", "0 to 12"),
        ({"temperature_limits": (10, 95)}, "temperature_limits: 95", "5 to 90"),
    ):
        script.limits |= {2031: (0.0, 12.0), 3000: (5.0, 90.0)}
        with pytest.raises(ConfigurationError) as caught:
            connect(clock, **changes)
        assert key in str(caught.value)
        assert str(caught.value).endswith(f"TEC-1091 allows, {allowed}")
    assert script.orders() == []


def test_settings_that_make_no_sense():
    for limits in ((50, 20), (30, 30), (20, 2000), (math.nan, 50)):
        assert blamed(make_settings, {"temperature_limits": limits}) == {"temperature_limits"}
    assert blamed(make_settings, {"watchdog": 0.05}) == {"watchdog"}
    assert make_settings(watchdog=0).watchdog == 0.0
    assert make_settings(mode="current").mode is TECMode.CURRENT


def test_safe_switches_off_both_ways_and_disarms(script, tec):
    tec.set(40.0)
    script.received.clear()
    tec.safe()
    assert script.orders() == ["VSC3500100000000", "VS07DA0100000000", "VS080C0100000000"]
    assert not tec.output_enabled


@pytest.mark.parametrize("refused", ["VSC350", "VS07DA"])
def test_safe_goes_on_to_the_emergency_stop(script, tec, refused):
    tec.set(40.0)
    script.refusals[refused] = 2
    script.on_order = lambda text: script.values.update({104: 3, 105: 11} if text == "ES" else {})
    tec.safe()
    assert "ES" in script.orders()
    assert script.values[104] == 3


def test_safe_raises_only_after_everything_was_tried(script, tec):
    tec.set(40.0)
    script.received.clear()
    script.refusals |= {"VSC350": 9, "VS07DA": 9, "ES": 1}
    with pytest.raises(DeviceError, match=r"does not confirm .*general error.*disconnect its power"):
        tec.safe()
    assert [data[7:-5][:6] for data in script.received if data[7:8] != b"?"] == [b"VSC350", b"VS07DA", b"ES"]


def test_safe_of_a_silent_device_tries_everything(script, tec):
    script.silent = True
    with pytest.raises(DeviceError, match=r"does not confirm .*no answer"):
        tec.safe()
    assert {data[7:-5][:6] for data in script.received} == {b"VSC350", b"VS07DA", b"ES"}


def test_safe_succeeds_when_only_an_answer_was_lost(script, tec):
    tec.set(40.0)
    script.instead = [b"", None, b"", None]
    tec.safe()
    assert "ES" not in script.orders()


def test_parameters_are_those_that_a_real_controller_reports():
    for parameter in (each for each in vars(driver).values() if isinstance(each, Parameter)):
        row = PARAMETERS[parameter.number]
        assert ("FLOAT32" if parameter.real else "INT32") == row.kind
        assert parameter.of_channel == (row.instances > 1)


def test_error_numbers_are_those_of_the_maker():
    """Meerstetter 5216G and 5136AL."""
    ranges = "1-12 20-33 36-37 50-53 60-61 100-111 120-123 130-134 137-144 150-153 160-165 170-173 175-176 180-184"
    known = {
        number for each in ranges.split() for number in range(int(each.split("-")[0]), int(each.split("-")[1]) + 1)
    }
    assert set(DEVICE_ERRORS) == known
    assert set(SERVER_ERRORS) == set(range(1, 10))


def test_settings_at_the_bounds_of_the_device(script, clock):
    script.limits = {2030: (1.0, 3.0), 2031: (2.0, 12.0), 3000: (15.0, 90.0), 4040: (0.1, 0.5), 4041: (1.0, 5.0)}
    connect(clock)
    connect(clock, current_limit=1.0, voltage_limit=2.0, stable_window=0.5, stable_time=5.0)
    for key, wrong in (("stable_window", 0.6), ("stable_time", 0.5), ("temperature_limits", (14.0, 90.0))):
        with pytest.raises(ConfigurationError, match=f"tec: {key}: "):
            connect(clock, **{key: wrong})


def test_output_that_does_not_go_on_is_switched_off_again(script, tec, clock):
    looks = []

    def ready(sent, right):
        if sent[7:14] != b"?VR0068":
            return right
        looks.append(clock.now())
        return answer(right[:7] + b"00000001")

    script.instead = [ready] * 100
    with pytest.raises(DeviceError, match="its output is off although it was switched on"):
        tec.set(40.0)
    assert len(looks) == 11  # and the last word
    assert looks[-1] - looks[0] == pytest.approx(10 * 0.02, abs=0.08)
    assert script.orders()[-2:] == ["VSC3500100000000", "VS07DA0100000000"]


def test_all_settings_are_read_back_after_an_answer_that_was_missing(script, tec):
    script.instead = [None, b""]
    tec.set(40.0)
    blocks = [data[7:12].decode() for data in script.received if data[7:10] == b"?VX"]
    # Seven that are configured and four of the output, five at once, before the last step and after it.
    assert blocks == ["?VX05", "?VX05", "?VX01"] * 2
    assert tec.repeats == 1
    script.instead = [None, b""]
    script.received.clear()
    tec.set(41.0)
    assert [data[7:-5] for data in script.received][-1] == b"?VR006801"


@pytest.mark.parametrize(
    ("number", "value"),
    [
        *((108, 0), (2000, 1), (2030, 2.5), (2031, 11.0), (4040, 0.2), (4041, 2.0), (6310, 1.0)),
        *((50012, 41.0), (50011, 0), (2060, 4.0), (2010, 0), (104, 1)),
    ],
)
def test_a_parameter_that_changed_is_found_by_reconnecting(script, tec, number, value):
    tec.set(40.0)
    tec.reconnect()
    script.values[number] = value
    with pytest.raises(DeviceError) as caught:
        tec.reconnect()
    assert isinstance(caught.value, DeviceRestartedError) == (number == 108)
    if number not in (104, 108):
        assert f"(parameter {number}) is {value:g}" in str(caught.value)


@pytest.mark.parametrize("is_taken", [True, False])
def test_a_set_point_whose_acknowledges_are_lost_is_nobody_elses(script, tec, is_taken):
    tec.set(40.0)
    script.instead = [None, *[b""] * 3]
    with pytest.raises(DeviceConnectionError):
        tec.set(45.0)
    assert script.values[50012] == 45.0
    if not is_taken:
        script.values[50012] = 40.0
    tec.reconnect()
    tec.set(45.0)
    script.values[50012] = 41.0
    with pytest.raises(DeviceError, match="end the program that changed it"):
        tec.reconnect()


def test_device_that_restarted_is_told_each_time_and_nothing_is_written_to_its_flash(script, tec):
    tec.set(40.0)
    script.values |= {108: 0, 104: 1, 2010: 0, 50000: 0}
    script.received.clear()
    for action in (tec.measure, lambda: tec.set(41.0), tec.reconnect):
        with pytest.raises(DeviceRestartedError):
            action()
    assert script.orders() == []
    tec.safe()
    assert not any(order.startswith("VS080C") for order in script.orders())
    tec.reset()
    script.received.clear()
    assert tec.measure()["tec_temperature"] == 25.5
    tec.safe()
    assert script.orders()[-1] == "VS080C0100000000"


def test_reset_leaves_the_device_alone_until_it_restarts(script, tec, clock):
    heard = []
    script.on_order = lambda text: heard.append((clock.now(), text))
    script.instead = [None, lambda _sent, right: heard.append((clock.now(), "asked")) or right]
    tec.reset()
    (sent, order), (asked, _) = heard[:2]
    assert order == "RS"
    assert asked - sent == pytest.approx(0.3, abs=0.02)


def test_stop_keeps_within_the_limits_and_leaves_a_current_alone(script, clock):
    tec = connect(clock)
    tec.set(40.0)
    script.values[1000] = 95.0
    tec.stop()
    assert script.values[50012] == tec.setpoint == 90.0
    tec.select_mode(TECMode.CURRENT)
    tec.set(0.5)
    script.received.clear()
    tec.stop()
    assert script.received == []
    tec.select_mode(TECMode.TEMPERATURE)
    assert script.orders()[-1] == "VS07D00100000002"
    assert str(tec.limits) == "15 to 90 °C"


def test_only_a_value_out_of_range_is_told_with_what_is_allowed(script, tec):
    script.limits[50012] = (20.0, 30.0)
    script.refusals["VSC35C"] = 7
    with pytest.raises(DeviceError, match=r"refused 40 as .*; allowed are 20 to 30$"):
        tec.set(40.0)
    script.refusals["VSC35C"] = 6
    with pytest.raises(DeviceError) as caught:
        tec.set(40.0)
    assert "allowed" not in str(caught.value)


def test_own_check_compares_limits_and_thresholds(script, tec):
    script.values |= {4010: 15.0, 4011: 90.0, 5011: 70.0, 1060: 24.1, 1063: 30.5}
    current, voltage, thresholds, supply = tec.self_check()
    assert (current.text, current.advice) == ("3 A in the device", "")
    assert (voltage.text, voltage.advice) == ("12 V in the device", "")
    assert thresholds.text == "15 to 90 °C of the object, up to 70 °C of the sink"
    assert thresholds.advice == ""
    assert supply.text == "24.1 V, base plate 30.5 °C"
    script.values |= {2030: 2.0, 2031: 11.0, 4010: 15.5}
    current, voltage, thresholds, _ = tec.self_check()
    assert "from 3 A" in current.advice
    assert "from 12 V" in voltage.advice
    assert "within the thresholds" in thresholds.advice
    script.values |= {4010: 15.0, 4011: 89.5}
    assert "within the thresholds" in tec.self_check()[2].advice
    tec.select_mode(TECMode.CURRENT)
    assert tec.self_check()[2].advice == ""


def test_safe_state_is_reached_in_haste_and_patience_comes_back(script, clock):
    tec = connect(clock, timeout=1.0)
    tec.set(40.0)
    script.silent = True
    script.received.clear()
    before = clock.now()
    with pytest.raises(DeviceError, match="does not confirm"):
        tec.safe()
    # Three orders over this line and over a fresh one; the first is repeated once.
    assert len(script.received) == 7
    assert clock.now() - before == pytest.approx(7 * 0.2, abs=0.05)
    script.silent = False
    tec.measure()
    script.silent = True
    script.received.clear()
    before = clock.now()
    with pytest.raises(DeviceConnectionError):
        tec.measure()
    assert len(script.received) == 3
    assert clock.now() - before == pytest.approx(3.0, abs=0.05)


def test_a_rescue_switches_off_and_disarms_the_watchdog(script, clock):
    MeerstetterTEC.rescue("tec", make_settings(), clock)
    assert script.orders() == ["VSC3500100000000", "VS07DA0100000000", "VS080C0100000000"]


def test_another_line_goes_on_counting(script, tec):
    script.instead = [b""]
    tec.measure()
    last = int(script.received[-1][3:7], 16)
    script.received.clear()
    before = tec._line
    tec.reconnect()
    assert tec._line is not before
    assert int(script.received[0][3:7], 16) == last + 1
    assert tec.repeats == 1


@cases("place", range(21))
@cases("kind", ["value", "acknowledge", "refusal"])
def test_an_answer_in_pieces_is_put_together_and_costs_no_more_than_its_pause(clock, place, kind):
    script = Script()
    script.refusals["?VR03E9"] = 5
    register("pieces-tec", InPieces(script, clock, place, 0.05), clock)
    try:
        line = TECLine("tec", make_settings(port="emulated://pieces-tec"))
        before = clock.now()
        if kind == "value":
            assert line.ask("?VR03E801", 8) == "41CC0000"
        elif kind == "acknowledge":
            line.order("VS07DA0100000002")
        else:
            with pytest.raises(RefusedError):
                line.ask("?VR03E901", 8)
        assert clock.now() - before < 0.06
        assert line.repeats == 0
    finally:
        unregister("pieces-tec")
