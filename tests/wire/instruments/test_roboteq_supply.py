"""The emulated Roboteq controller: its objects, its watchdog, and the bytes of its slcan adapter."""

import math

import pytest
from hypothesis import example, given, strategies as st

from bench.base import VirtualClock, WallClock
from drivers.roboteq import RoboteqSupply
from sim_devices.instruments.emulated import RequestRefusedError
from sim_devices.instruments.roboteq import EmulatedRoboteq
from sim_devices.instruments.roboteq_objects import DICTIONARY, AbortCode, ChannelFlag, Fault, NodeState
from sim_devices.wire.canopen_slcan import BITRATES, LONGEST_LINE, CanopenSlcanServer
from sim_devices.world import World

COMMAND, EMERGENCY_STOP, RELEASE, STOP = 0x2000, 0x200C, 0x200D, 0x200E


class Resistor:
    def __init__(self, ohms=5.0):
        self.ohms = ohms
        self.voltage = 0.0
        self.world = None
        self.applied = []

    def apply(self, voltage):
        self.voltage = voltage
        self.applied.append((self.world.time, voltage))

    @property
    def current(self):
        return self.voltage / self.ohms

    def advance(self, dt):
        pass


def make_device(clock=None, load=None, **keys):
    load = load or Resistor()
    load.world = World(load, clock or VirtualClock())
    return EmulatedRoboteq("supply", load.world, load, **keys), load


@pytest.fixture
def load():
    return Resistor()


@pytest.fixture
def device(clock, load):
    return make_device(clock, load)[0]


@pytest.fixture
def server(device):
    server = CanopenSlcanServer(device)
    assert server.receive(b"S4\rO\r") == b"\r\r"
    return server


class TestInstrument:
    def test_every_object_can_be_read_or_written(self, device):
        for (index, sub), row in DICTIONARY.items():
            if row.readable:
                value = device.read_object(index, sub)
                assert isinstance(value, str if row.kind == "text" else int)
            else:
                with pytest.raises(RequestRefusedError, match="WRITE_ONLY"):
                    device.read_object(index, sub)
            if not row.writable:
                with pytest.raises(RequestRefusedError, match="READ_ONLY"):
                    device.write_object(index, 0, sub)

    @pytest.mark.parametrize(("output", "volts"), [("average", 6.0), ("rms", 12.0)])
    def test_quarter_of_the_duty_cycle(self, clock, output, volts):
        device, load = make_device(clock, output=output)
        device.write_object(COMMAND, 250, 1)
        assert load.voltage == pytest.approx(volts)
        assert device.voltage == load.voltage
        assert device.read_object(0x2101, 1) == device.read_object(0x2102, 1) == 250
        assert device.read_object(0x2100, 1) == round(2.0 * volts)
        assert device.read_object(0x210C, 1) == round(0.5 * volts)
        device.write_object(COMMAND, -250, 1)
        assert load.voltage == pytest.approx(-volts)

    def test_other_channel_is_connected_to_nothing(self, device, load):
        device.write_object(COMMAND, 500, 2)
        assert load.applied == []
        assert device.read_object(0x2101, 2) == 500
        assert device.read_object(0x2100, 2) == device.read_object(0x2102, 2) == device.read_object(0x2122, 2) == 0

    def test_stop_ends_the_channel_that_it_names(self, device, load):
        for channel in (1, 2):
            device.write_object(COMMAND, 500, channel)
        device.write_object(STOP, 2)
        assert (device.read_object(0x2101, 1), device.read_object(0x2101, 2)) == (500, 0)
        device.write_object(STOP, 7)
        device.write_object(STOP, 1)
        assert load.voltage == 0.0

    @pytest.mark.parametrize(("volts", "fault"), [(4.9, Fault.UNDER_VOLTAGE), (60.1, Fault.OVER_VOLTAGE)])
    def test_supply_beyond_its_range(self, device, load, volts, fault):
        device.write_object(COMMAND, 500, 1)
        device.battery_voltage = volts
        assert device.battery_voltage == volts
        assert (device.read_object(0x2112), load.voltage) == (fault, 0.0)
        device.battery_voltage = 20.0
        assert (device.read_object(0x2112), load.voltage) == (0, 10.0)

    @pytest.mark.parametrize("output", ["average", "rms"])
    def test_current_is_limited(self, clock, output):
        device, load = make_device(clock, Resistor(1.0), amps_limit=6.0, output=output)
        device.write_object(COMMAND, 1000, 1)
        assert 5.9 < load.current <= 6.0
        assert device.read_object(0x2122, 1) == ChannelFlag.AMPS_LIMIT
        assert device.read_object(0x2101, 1) == 1000
        device.write_object(COMMAND, 10, 1)
        assert device.read_object(0x2122, 1) == 0

    def test_watchdog_is_fed_by_commands_and_not_by_queries(self, device, clock):
        device.write_object(COMMAND, 500, 1)
        for _ in range(10):
            clock.sleep(0.9)
            device.write_object(COMMAND, 0, 2)
        assert device.power == 500
        for _ in range(10):
            clock.sleep(0.2)
            device.read_object(0x2102, 1)
            device.write_object(0x1017, 100)
        assert device.power == 0

    def test_first_command_after_an_expiry_resumes_the_power_of_before(self, device, clock):
        device.write_object(COMMAND, 500, 1)
        clock.sleep(2.0)
        device.write_object(COMMAND, 100, 1)
        assert device.power == 500
        device.write_object(COMMAND, 100, 1)
        assert device.power == 100

    @pytest.mark.parametrize(("index", "value", "sub"), [(COMMAND, 0, 2), (STOP, 2, 0), (RELEASE, 1, 0)])
    def test_any_command_resumes(self, device, clock, index, value, sub):
        device.write_object(COMMAND, 500, 1)
        clock.sleep(2.0)
        device.write_object(index, value, sub)
        assert device.power == 500

    def test_command_of_zero_resumes_nothing(self, device, load, clock):
        device.write_object(COMMAND, 500, 1)
        clock.sleep(2.0)
        device.write_object(COMMAND, 0, 1)
        device.write_object(COMMAND, 100, 1)
        assert [volts for _, volts in load.applied] == [12.0, 0.0, pytest.approx(2.4)]

    def test_heartbeats_of_a_silence_are_few(self, device, clock):
        assert device.heartbeats() == []
        clock.sleep(0.1)
        assert device.heartbeats() == [NodeState.OPERATIONAL]
        assert device.heartbeats() == []
        clock.sleep(0.25)
        assert len(device.heartbeats()) == 2
        clock.sleep(0.05)
        assert len(device.heartbeats()) == 1
        clock.sleep(1e6)
        assert len(device.heartbeats()) == 4
        device.write_object(0x1017, 0)
        clock.sleep(10.0)
        assert device.heartbeats() == []
        device.unplug()
        device.write_object(0x1017, 50)
        clock.sleep(10.0)
        assert device.heartbeats() == []
        clock.sleep(10.0)
        device.plug_in()
        assert device.heartbeats() == []
        clock.sleep(0.05)
        assert device.heartbeats() == [NodeState.OPERATIONAL]

    def test_reset_of_the_communication_keeps_the_output(self, device, load):
        device.write_object(COMMAND, 500, 1)
        device.manage(130)
        assert load.voltage == 12.0
        assert device.heartbeats() == [NodeState.BOOT_UP]
        device.manage(129)
        assert load.voltage == 0.0
        device.manage(77)
        assert device.state is NodeState.OPERATIONAL


# What the manual prints, with the standard command bytes where it leaves the bits e and s clear.
VECTORS = [
    ("battery 24.0 V", b"t6018400D210200000000\r", b"t58184B0D2102F0000000\r"),
    ("simplified query", b"t6018480D21020A000000\r", b"t5818480D2102F0000000\r"),
    ("emergency stop", b"t60182F0C200001000000\r", b"t5818600C200000000000\r"),
    ("simplified emergency stop", b"t60182C0C200001000000\r", b"t5818600C200000000000\r"),
    ("command 500", b"t601823002001F4010000\r", b"t58186000200100000000\r"),
    ("command −500", b"t6018230020010CFEFFFF\r", b"t58186000200100000000\r"),
    ("simplified command", b"t601820002001F4010000\r", b"t58186000200100000000\r"),
    ("without its size", b"t601822002001F4010000\r", b"t58186000200100000000\r"),
    ("heartbeat time", b"t60184017100000000000\r", b"t58184B17100064000000\r"),
    ("device type", b"t60184000100000000000\r", b"t58184300100091010F00\r"),
    ("temperature", b"t6018400F210100000000\r", b"t58184F0F210120000000\r"),
    ("lower case", b"t6018400d210200000000\r", b"t58184B0D2102F0000000\r"),
    ("no object", b"t60184000300000000000\r", b"t58188000300000000206\r"),
    ("no subindex", b"t60184000200900000000\r", b"t58188000200911000906\r"),
    ("write-only", b"t60184000200100000000\r", b"t58188000200101000106\r"),
    ("read-only", b"t60182B02210100000000\r", b"t58188002210102000106\r"),
    ("wrong length", b"t60182F00200101000000\r", b"t58188000200110000706\r"),
    ("out of range", b"t601823002001E9030000\r", b"t58188000200130000906\r"),
    ("segmented download", b"t60182100200104000000\r", b"t58186000200100000000\r"),
    ("segmented download of a wrong length", b"t60182100200105000000\r", b"t58188000200110000706\r"),
    ("segment of no download", b"t60180000000000000000\r", b"t58188000000001000405\r"),
    ("block upload", b"t6018A00D210200000000\r", b"t5818800D210201000405\r"),
    ("segment of nothing", b"t60186000000000000000\r", b"t58188000000001000405\r"),
    ("abort", b"t6018800D210200000000\r", b""),
    ("another node", b"t6028400D210200000000\r", b""),
    ("too short", b"t6017400D2102000000\r", b""),
    ("empty", b"t6010\r", b""),
    ("remote", b"r6018\r", b""),
]


# Sent and replied, from Roboteq CANBus Networking Manual V2.0, p. 39 to 41 (SDO examples 1 to 3), whose command bytes
# have the bits e and s clear; the second as its data bytes say, the text misprints its identifier as 601Ch.
SDO_EXAMPLES = [
    ({}, b"t6018200320020A000000\r", b"t58186003200200000000\r"),
    ({"node": 12}, b"t60C82C0C200001000000\r", b"t58C8600C200000000000\r"),
    ({"battery_voltage": 40.0}, b"t6018480D21020A000000\r", b"t5818480D210290010000\r"),
]

# The same manual, p. 32: other objects for TPDO1 of node 1.
MAPPING_EXAMPLE = [
    b"t601823001801810100C0\r",
    b"t60182F001A0000000000\r",
    b"t601823001A0110010021\r",
    b"t601823001A0210020021\r",
    b"t601823001A0310010D21\r",
    b"t601823001A0408010F21\r",
    b"t60182F001A0004000000\r",
    b"t60182300180181010040\r",
]


class TestAdapter:
    @pytest.mark.parametrize(("changes", "sent", "replied"), SDO_EXAMPLES)
    def test_examples_of_the_maker(self, clock, changes, sent, replied):
        device, _ = make_device(clock, **changes)
        server = CanopenSlcanServer(device)
        server.receive(b"S4\rO\r")
        assert server.receive(sent) == b"z\r" + replied

    @pytest.mark.parametrize(("sent", "received"), [row[1:] for row in VECTORS], ids=[row[0] for row in VECTORS])
    def test_bytes(self, server, sent, received):
        assert server.receive(sent) == b"z\r" + received

    def test_segmented_download(self, server, load):
        assert server.receive(b"t60182100200104000000\r").endswith(b"t58186000200100000000\r")
        assert server.receive(b"t60180AF4010000000000\r").endswith(b"t58182000000000000000\r")
        assert load.applied == []
        assert server.receive(b"t60181D00000000000000\r").endswith(b"t58188000200110000706\r")
        assert server.receive(b"t60182100200104000000\r").endswith(b"t58186000200100000000\r")
        assert server.receive(b"t601807F4010000000000\r").endswith(b"t58182000000000000000\r")
        assert load.voltage == 12.0

    def test_wrong_toggle_bit_ends_the_segmented_download(self, server, load):
        server.receive(b"t60182100200104000000\r")
        assert server.receive(b"t601817F4010000000000\r") == b"z\rt58188000200100000305\r"
        assert server.receive(b"t601807F4010000000000\r") == b"z\rt58188000200101000405\r"
        assert load.applied == []

    def test_wrong_toggle_bit_ends_the_transfer(self, server):
        server.receive(b"t60184008100000000000\r")
        assert server.receive(b"t60187000000000000000\r") == b"z\rt58188008100000000305\r"
        assert server.receive(b"t60186000000000000000\r") == b"z\rt58188008100001000405\r"

    @pytest.mark.parametrize(
        "line",
        [b"t60184", b"t601840", b"t601940" * 18, b"t80180" * 16, b"T6018", b"x", b"S9", b"Z1", b"\xff"],
    )
    def test_lines_that_make_no_sense(self, server, line):
        assert server.receive(line + b"\r") == b"\a"
        assert server.receive(b"t6018400D210200000000\r").startswith(b"z\rt58184B")

    def test_closed_channel_and_listening(self, device):
        server = CanopenSlcanServer(device)
        frame = b"t6018400D210200000000\r"
        assert server.receive(frame) == b"\a"
        assert server.receive(b"S4\rL\r" + frame) == b"\r\r\a"
        assert server.receive(b"C\rO\r" + frame).endswith(b"0000\r")
        assert server.receive(b"S4\r") == b"\a"
        assert server.receive(b"Z0\r") == b"\a"

    def test_questions_to_the_adapter(self, device):
        server = CanopenSlcanServer(device)
        assert server.receive(b"V\rN\rZ0\rF\r") == b"V1013\rNEMUL\r\r\a"
        assert server.receive(b"S4\rO\rF\r") == b"\r\rF00\r"

    @pytest.mark.parametrize("code", [code for code in BITRATES if code != b"S4"])
    def test_other_bit_rates_reach_nobody(self, device, clock, code):
        server = CanopenSlcanServer(device)
        server.receive(code + b"\rO\r")
        clock.sleep(1.0)
        assert server.receive(b"t6018400D210200000000\r") == b"z\r"

    def test_pieces(self, server):
        whole = b"t6018400D210200000000\r"
        answers = [server.receive(bytes((byte,))) for byte in whole]
        assert answers[:-1] == [b""] * (len(whole) - 1)
        assert answers[-1] == b"z\rt58184B0D2102F0000000\r"
        assert len(server.receive(whole * 3)) == 3 * len(answers[-1])

    def test_heartbeats_come_on_an_idle_line(self, server, device, clock):
        assert server.unsolicited() == b""
        for due in (0.1, 0.2, 0.3):
            assert server.next_unsolicited() == pytest.approx(due)
            clock.sleep_until(server.next_unsolicited())
            assert server.unsolicited() == b"t701105\r"
            assert server.unsolicited() == b""
        clock.sleep(0.05)
        device.power_cycle()
        assert server.next_unsolicited() == clock.now()
        assert server.unsolicited() == b"t701100\r"
        assert server.next_unsolicited() == pytest.approx(0.45)

    @given(st.lists(st.one_of(st.binary(max_size=80), st.sampled_from([b"\r", b"O\r", b"C\r", b"S4\r", b"t"]))))
    @example([b"O\r", b"t601\r" * 100])
    @example([b"t\xb2\xb3\xb9\r"])
    def test_no_bytes_bring_it_down(self, pieces):
        server = CanopenSlcanServer(make_device()[0])
        for piece in pieces:
            server.receive(piece)
            assert len(server._received) <= LONGEST_LINE
        server.receive(b"\rC\rS4\rO\r")
        server.receive(b"t00020101\r")
        assert server.receive(b"t60184001100000000000\r").endswith(b"t58184F01100000000000\r")


class TestProcessData:
    def test_mapping_of_the_example_is_sent_after_each_sync(self, server, device):
        for sent in MAPPING_EXAMPLE:
            assert server.receive(sent).endswith(b"t581860%s00000000\r" % sent[7:13])
        assert server.receive(b"t0800\r") == b"z\r"
        assert server.receive(b"t60182F00180200000000\r").endswith(b"t58186000180200000000\r")
        device.write_object(COMMAND, 500, 1)
        amps = device.read_object(0x2100, 1).to_bytes(2, "little").hex().upper().encode()
        frame = b"t1817%s00007600%02X\r" % (amps, device.read_object(0x210F, 1))
        assert server.receive(b"t0800\rt0800\r") == b"z\r" + frame + b"z\r" + frame
        device.write_object(0x1800, 3, 2)
        assert server.receive(b"t0800\r" * 7) == b"z\rz\rz\r" + frame + b"z\rz\rz\r" + frame + b"z\r"
        device.manage(128)
        assert server.receive(b"t0800\r" * 3) == b"z\r" * 3

    def test_send_rate(self, clock):
        device, _ = make_device(clock, send_rates=(50, 0, 200, 0))
        server = CanopenSlcanServer(device)
        server.receive(b"S4\rO\r")
        device.write_object(0x1017, 0)
        for instant, frames in ((0.05, (1,)), (0.1, (1,)), (0.15, (1,)), (0.2, (1, 3))):
            assert server.next_unsolicited() == pytest.approx(instant)
            clock.sleep_until(server.next_unsolicited())
            assert server.unsolicited() == b"".join(b"t%d818%s\r" % (number, b"0" * 16) for number in frames)
            assert server.unsolicited() == b""
        clock.sleep(3600.0)
        assert len(server.unsolicited()) == 2 * 22
        server.receive(b"t00020201\r")
        assert server.next_unsolicited() == math.inf
        clock.sleep(1.0)
        assert server.unsolicited() == b""

    def test_variables_come_in_and_are_no_power(self, server, device, load):
        assert server.receive(b"t2018F401000018FCFFFF\r") == b"z\r"
        assert (device.read_object(0x2106, 9), device.read_object(0x2106, 10)) == (500, -1000)
        assert server.receive(b"t5018F40100000C000000\r") == b"z\r"
        assert (device.read_object(0x2106, 15), device.read_object(0x2106, 16)) == (500, 12)
        server.receive(b"t2017F4010000000000\r")
        server.receive(b"t2028F4010000F4010000\r")
        assert device.read_object(0x2106, 9) == 500
        assert load.applied == []

    def test_command_that_comes_in_feeds_the_watchdog(self, server, device, clock):
        for index, sub, value in ((0x1400, 1, 0x80000201), (0x1600, 0, 0), (0x1600, 1, 0x20000120), (0x1600, 0, 1)):
            device.write_object(index, value, sub)
        device.write_object(0x1400, 0x201, 1)
        for _ in range(10):
            server.receive(b"t2014F4010000\r")
            clock.sleep(0.9)
        assert device.power == 500
        server.receive(b"t2014E9030000\r")
        assert device.power == 500
        clock.sleep(1.1)
        assert device.power == 0

    @pytest.mark.parametrize(
        ("index", "sub", "value", "code"),
        [
            (0x1A00, 0, 0, AbortCode.UNSUPPORTED),
            (0x1A00, 1, 0x21000110, AbortCode.UNSUPPORTED),
            (0x1800, 1, 0x1_0000_0, AbortCode.VALUE),
            (0x1800, 2, 252, AbortCode.VALUE),
            (0x1800, 0, 2, AbortCode.READ_ONLY),
            (0x1800, 3, 2, AbortCode.NO_SUBINDEX),
            (0x1804, 1, 2, AbortCode.NO_OBJECT),
        ],
    )
    def test_configuration_that_is_refused(self, device, index, sub, value, code):
        with pytest.raises(RequestRefusedError) as caught:
            device.write_object(index, value, sub)
        assert caught.value.reason == code

    @pytest.mark.parametrize(
        ("base", "entries", "code"),
        [
            (0x1A00, [0x20000120], AbortCode.NOT_MAPPABLE),
            (0x1A00, [0x21000120], AbortCode.NOT_MAPPABLE),
            (0x1A00, [0x30000020], AbortCode.NOT_MAPPABLE),
            (0x1A00, [0x10080020], AbortCode.NOT_MAPPABLE),
            (0x1600, [0x21000110], AbortCode.NOT_MAPPABLE),
            (0x1A00, [0x21060120, 0x21060220, 0x21000110], AbortCode.MAPPING_TOO_LONG),
            (0x1A00, [0] * 9, AbortCode.VALUE),
        ],
    )
    def test_mapping_that_is_refused(self, device, base, entries, code):
        device.write_object(base - 0x200, 1 << 31, 1)
        device.write_object(base, 0, 0)
        for place, entry in enumerate(entries[:8]):
            device.write_object(base, entry, 1 + place)
        with pytest.raises(RequestRefusedError) as caught:
            device.write_object(base, len(entries), 0)
        assert caught.value.reason == code


def test_driver_over_a_pseudo_terminal(pseudo_terminal):
    clock = WallClock()
    device, load = make_device(clock, watchdog=0.0)
    with pseudo_terminal(CanopenSlcanServer(device)) as path:
        settings = RoboteqSupply.Settings(
            port=path, output="average", voltage_limits=(0, 12), watchdog=0, heartbeat=60, timeout=10
        )
        supply = RoboteqSupply.connect("supply", settings, clock)
        supply.set(6.0).wait()
        assert supply.measure() == {"supply_voltage": 6.0, "supply_current": 1.2}
        supply.safe()
        assert load.voltage == 0.0
        supply.close()
