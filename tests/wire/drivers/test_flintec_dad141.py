"""The DAD 141.1 driver: its settings, its bytes, and what it makes of wrong devices and bad lines."""

import logging
import math
import struct
import sys
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from cases import cases
from hypothesis import HealthCheck, given, settings, strategies as st
from refusals import blamed
from still_plant import Still, sealed

from bench.base import DeviceConnectionError, DeviceError, DeviceRestartedError, VirtualClock, WallClock
from drivers.flintec_dad141 import FlintecDAD141
from drivers.pymodbus_client import SerialClient
from sim_devices import protocol_emulated
from sim_devices.instruments.flintec_dad141 import EmulatedDAD141
from sim_devices.wire import WireServer
from sim_devices.wire.modbus import RegisterError
from sim_devices.wire.modbus_rtu import ModbusRtuServer, crc16
from sim_devices.world import World

Settings = FlintecDAD141.Settings
WIDE = (-100.0, 100.0)


class Tap(WireServer):
    """A line that keeps the bytes, and may alter what comes back."""

    def __init__(self, server: ModbusRtuServer) -> None:
        self.server = server
        self.sent: list[bytes] = []
        self.alter: Callable[[bytes], bytes] = lambda reply: reply

    def receive(self, data: bytes) -> bytes:
        self.sent.append(data)
        return self.alter(self.server.receive(data))


class Bank:
    """A DAD 141.1 of which some registers read differently."""

    def __init__(self, instrument: EmulatedDAD141) -> None:
        self._instrument = instrument
        self.alter: Callable[[int, list[int]], list[int]] = lambda _, words: words

    def read_registers(self, address: int, count: int) -> list[int]:
        return self.alter(address, self._instrument.read_registers(address, count))

    def write_registers(self, address: int, values: list[int]) -> None:
        self._instrument.write_registers(address, values)


class Bench:
    """An instrument on an emulated line, with the force in `force`."""

    def __init__(self, **options) -> None:
        self.force = 0.0
        self.clock = VirtualClock()
        self.world = World(Still(), self.clock)
        self.instrument = EmulatedDAD141(
            "load",
            self.world,
            lambda: self.force,
            **{"rng": np.random.default_rng(3), "noise": 0.0, "zero_tracking": 0, **options},
        )
        self.bank = Bank(self.instrument)
        self.tap = Tap(ModbusRtuServer(self.bank))
        self.port = protocol_emulated.register("load", self.tap, self.clock)
        self.cells: list[FlintecDAD141] = []

    def cell(self, **settings) -> FlintecDAD141:
        made = FlintecDAD141.connect(
            "load", Settings(port=self.port, **{"force_limits": WIDE, **settings}), self.clock
        )
        self.cells.append(made)
        return made

    def put(self, force: float) -> None:
        self.force = force
        self.clock.sleep(5.0)

    @staticmethod
    def line(cell: FlintecDAD141):
        """Return the port of a driver."""
        client = cell._line._client
        return client._line.socket if isinstance(client, SerialClient) else client._port

    def word(self, address: int) -> int:
        return self.instrument.read_registers(address, 2)[1]


@pytest.fixture(params=["ours", "pymodbus"])
def bench(request, monkeypatch) -> Iterator[Bench]:
    """Return a bench for either client: that of emulated lines, and that of real ones."""
    if request.param == "pymodbus":
        monkeypatch.setattr("drivers.modbus_rtu.EMULATED", "nothing://")
    bench = Bench()
    yield bench
    for cell in bench.cells:
        cell.close()
    protocol_emulated.unregister("load")


# Settings


def test_the_calibrated_range_has_to_be_given_and_is_not_empty():
    assert blamed(Settings, {"port": "/dev/ttyUSB0"}) == {"force_limits"}
    assert blamed(Settings, {"port": "/dev/ttyUSB0", "force_limits": (1.0, 1.0)}) == {"force_limits"}
    assert blamed(Settings, {"port": "/dev/ttyUSB0", "force_limits": WIDE, "newtons_per_unit": 0.0}) == {
        "newtons_per_unit"
    }


# Bytes


READ = bytes.fromhex("01 03 35 00 00 05 8A 05")
READ_INPUT = sealed("01 04 35 00 00 05")
LOOK_AT_FILTER = (sealed("01 03 21 06 00 02"), sealed("01 04 21 06 00 02"))


def test_byte_vectors(bench):
    cell = bench.cell()
    bench.put(0.5)
    cell.glance()
    bench.tap.sent.clear()
    cell.tare()
    assert bench.tap.sent == [READ_INPUT, bytes.fromhex("01 06 20 61 00 08 D2 12"), READ]
    bench.put(12.0)
    cell.glance()
    bench.tap.sent.clear()
    replies = []
    bench.tap.alter = lambda reply: replies.append(reply) or reply
    assert [cell.glance() for _ in range(2)] == [{"load_force": 11.5}] * 2
    assert bench.tap.sent == [READ_INPUT, READ]
    assert replies == [
        sealed("01 04 0A 41 40 00 00 41 38 00 00 00 30"),
        bytes.fromhex("01 03 0A 41 40 00 00 41 38 00 00 00 30 E8 A4"),
    ]


def test_a_tare_may_be_kept(bench):
    bench.put(4.0)
    bench.instrument.tare()
    cell = bench.cell(keep_tare=True)
    bench.put(5.0)
    assert cell.measure()["load_force"] == pytest.approx(1.0)
    cell.clear_tare()
    assert bench.cell(keep_tare=True).measure()["load_force"] == pytest.approx(5.0)


def test_after_a_pause_the_filter_is_looked_at_once_and_costs_a_measurement_no_time(bench):
    cell = bench.cell(samples=3)
    for pause, looks in ((0.29, 0), (0.31, 1), (2.0, 1)):
        bench.clock.sleep(pause)
        bench.tap.sent.clear()
        begin = bench.clock.now()
        cell.measure()
        assert sum(frame in LOOK_AT_FILTER for frame in bench.tap.sent) == looks
        assert len(bench.tap.sent) == 3 + looks
        assert bench.clock.now() - begin == pytest.approx(0.25 + 23 * 10 / 115200)


@cases(
    ("settings", "pause"),
    [
        ({}, 1.75e-3),
        ({"baudrate": 38400}, 1.75e-3),
        ({"baudrate": 19200}, 35 / 19200),
        ({"baudrate": 9600, "parity": "E"}, 38.5 / 9600),
        ({"pause": 0.0}, 0.0),
        ({"pause": 0.02}, 0.02),
    ],
)
def test_the_pause_between_frames(bench, settings, pause):
    cell = bench.cell(**settings)

    def refuse(_address, _words):
        raise RegisterError(2, "not here")

    cell.glance()
    wire = 23 * 10 / settings.get("baudrate", 115200)
    for spoilt in (False, True):
        if spoilt:
            bench.bank.alter = refuse
            with pytest.raises(DeviceError, match="illegal data address"):
                cell.glance()
            bench.bank.alter = lambda _, words: words
        begin = bench.clock.now()
        cell.glance()
        assert bench.clock.now() - begin == pytest.approx(pause + wire)


@cases(
    ("settings", "interval"),
    [({}, 0.125), ({"filter": 7}, 1.0), ({"filter": 0}, 0.5 / 17), ({"interval": 0.05}, 0.05)],
)
def test_the_interval_of_a_measurement(bench, settings, interval):
    cell = bench.cell(samples=4, **settings)
    begin = bench.clock.now()
    cell.measure()
    assert bench.clock.now() - begin == pytest.approx(3 * interval, abs=0.01)


# Other lines


needs_pty = pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals")
# On a real line there is one client.
on_a_real_line = pytest.mark.parametrize("bench", ["pymodbus"], indirect=True)


@on_a_real_line
@needs_pty
def test_over_a_pseudo_terminal(bench, pseudo_terminal):
    bench.put(12.0)
    with pseudo_terminal(bench.tap) as path:
        settings = Settings(port=path, timeout=10.0, force_limits=WIDE, samples=3, interval=0.01)
        cell = FlintecDAD141.connect("load", settings, WallClock())
        assert cell.measure() == {"load_force": 12.0}
        cell.tare()
        assert cell.glance() == {"load_force": 0.0}
        cell.close()


@on_a_real_line
@needs_pty
def test_a_line_that_is_pulled_out(bench, pseudo_terminal):
    with pseudo_terminal(bench.tap) as path:
        cell = FlintecDAD141.connect("load", Settings(port=path, timeout=10.0, force_limits=WIDE), WallClock())
    with pytest.raises(DeviceConnectionError, match=r"^load: lost the line .*check the cable"):
        cell.glance()
    with pytest.raises(DeviceConnectionError, match=f"^load: cannot open {path}"):
        cell.glance()
    cell.close()
    with pytest.raises(DeviceConnectionError, match="closed"):
        cell.glance()


# Wrong devices


def bytes_swapped(words: list[int]) -> list[int]:
    return [(word & 0xFF) << 8 | word >> 8 for word in words]


def only(register: int, words: list[int]) -> Callable[[int, list[int]], list[int]]:
    return lambda address, actual: words if address == register else actual


@cases(
    ("alter", "message"),
    [
        (lambda _, words: words[::-1], "words of a value in swapped order"),
        (lambda _, words: bytes_swapped(words), "bytes of a word in swapped order"),
        (only(0x202C, [0, 7210]), "is not a DAD 141.1: its identity is 7210, not 1410 or 5136; .*device_ids"),
        (only(0x202E, [0x0A01, 0]), "0x0A010000 for its firmware"),
        (only(0x202E, [0, 0]), "0x00000000 for its firmware"),
        (only(0x2080, [0x4140, 0, 12000, 0]), "same weight as 12 and, as an integer, 786432000"),
        (only(0x2080, [0x4140, 0, 0, 13000]), "same weight as 12 and, as an integer, 13000"),
        (only(0x2080, [0x4140, 0, 0, 12001]), "same weight as 12 and, as an integer, 12001"),
        (only(0x2080, [0, 0x4140, 0, 12000]), "same weight as .*e-41 and, as an integer, 12000"),
        (only(0x2080, [0x7FC0, 0, 0, 12000]), "same weight as nan"),
    ],
)
def test_a_wrong_device_is_refused(bench, alter, message):
    bench.put(12.0)
    bench.bank.alter = alter
    with pytest.raises(DeviceConnectionError, match=rf"^load: the device at emulated://load, address 1, .*{message}"):
        bench.cell()


def test_a_device_without_these_registers_is_refused(bench):
    def refuse(address: int, words: list[int]) -> list[int]:
        raise RegisterError(2, "not here")

    bench.bank.alter = refuse
    with pytest.raises(
        DeviceConnectionError, match=r"is not a DAD 141\.1: Modbus exception 2 \(illegal data address\)"
    ):
        bench.cell()


@cases("number", [1410, 0x1410, 1411])
def test_identities_that_are_accepted(bench, number):
    bench.bank.alter = only(0x202C, [0, number])
    known = {} if number != 1411 else {"device_ids": (1411,)}
    bench.cell(**known).glance()


@cases("decimals", range(6))
@cases("force", [-7.5, 0.0, 0.02, 8.25])
def test_any_decimal_point_agrees(decimals, force):
    bench = Bench(decimals=decimals, weight_limits=(-9.0, 9.0))
    try:
        bench.put(force)
        cell = bench.cell()
        assert cell.glance()["load_force"] == pytest.approx(force, abs=0.51 * 10**-decimals)
    finally:
        cell.close()
        protocol_emulated.unregister("load")


def test_a_load_that_moves_does_not_make_a_wrong_device(bench):
    bench.put(10.0)
    bench.instrument._force = lambda: 10.0 + 8.0 * math.sin(30 * bench.world.time)
    bench.clock.sleep(1.0)
    for _ in range(20):
        bench.cell().close()


@cases("tracking", [1, 100])
def test_zero_tracking_is_refused_and_nothing_is_changed(tracking):
    bench = Bench(zero_tracking=tracking)
    try:
        with pytest.raises(DeviceError, match=rf"zero tracking is on \(ZT = {tracking}\).*CE, ZT 0 and CS"):
            bench.cell()
        assert all(frame[1] in (3, 4) for frame in bench.tap.sent)
        bench.instrument.write_registers(0x2204, [0, 17])
        bench.instrument.write_registers(0x2122, [0, 0])
        bench.instrument.write_registers(0x2066, [0x0002])
        bench.cell().close()
    finally:
        protocol_emulated.unregister("load")


def test_a_setting_that_is_not_taken_is_noticed(bench):
    bench.bank.alter = only(0x2106, [0, 3])
    with pytest.raises(DeviceError, match="filter reads back 3 after 6"):
        bench.cell(filter=6)


def test_another_address_is_silent(bench):
    begin = bench.clock.now()
    with pytest.raises(
        DeviceConnectionError, match=r"no good reply within 0\.2 s at emulated://load, address 2, after 3"
    ):
        bench.cell(address=2)
    assert bench.clock.now() - begin == pytest.approx(0.7, abs=0.01)  # three requests, and two short silences


# Bad lines


def test_an_instrument_that_falls_silent_and_comes_back(bench, caplog, capfd):
    cell = bench.cell()
    bench.put(3.0)
    with caplog.at_level(logging.INFO):
        bench.tap.alter = lambda _: b""
        for take in (cell.measure, cell.glance, cell.tare, cell.clear_tare):
            with pytest.raises(DeviceConnectionError, match=r"no good reply.*check power, cable"):
                take()
        bench.tap.alter = lambda reply: reply
        assert cell.measure() == {"load_force": 3.0}
    assert not caplog.records
    assert capfd.readouterr() == ("", "")


class Once:
    """Alters one reply, and lets the others pass."""

    def __init__(self, alter: Callable[[bytes], bytes]) -> None:
        self._alter = alter
        self.done = False

    def __call__(self, reply: bytes) -> bytes:
        if self.done:
            return reply
        self.done = True
        return self._alter(reply)


OTHERS = sealed("05 03 0A 00 00 00 00 00 00 00 00 00 00")


@cases(
    "damage",
    [
        lambda _: b"",
        lambda reply: reply[:4],
        lambda reply: reply[:-1],
        lambda reply: reply[:-1] + bytes([reply[-1] ^ 1]),
        lambda reply: reply[:2] + b"\xff" + reply[3:],
        lambda reply: b"\x99" * 5 + reply,
        lambda reply: b"\x00" + reply,
        lambda _: OTHERS,
        lambda _: b"\xa5" * 40,
    ],
)
def test_a_damaged_reply_is_asked_for_again(bench, damage):
    cell = bench.cell()
    bench.put(7.0)
    bench.tap.alter = Once(damage)
    assert cell.glance() == {"load_force": 7.0}
    assert bench.tap.alter.done
    bench.put(8.0)
    assert cell.glance() == {"load_force": 8.0}


@on_a_real_line
@needs_pty
@pytest.mark.slow
def test_a_late_reply_is_not_taken_for_the_next(bench, pseudo_terminal):
    class Late(WireServer):
        slow = False

        def receive(self, data: bytes) -> bytes:
            reply = bench.tap.server.receive(data)
            if self.slow:
                self.slow = False
                threading.Event().wait(1.3)
                bench.put(9.0)
            return reply

    late = Late()
    bench.put(1.0)
    with pseudo_terminal(late) as path:
        cell = FlintecDAD141.connect("load", Settings(port=path, timeout=1.0, force_limits=WIDE), WallClock())
        late.slow = True
        assert cell.glance() == {"load_force": 9.0}
        assert cell.glance() == {"load_force": 9.0}
        cell.close()


# Bad readings


@cases(("bits", "side"), [(0x0001, "under"), (0x0002, "over"), (0x0033, "over")])
def test_range_bits(bench, bits, side):
    cell = bench.cell()
    bench.bank.alter = only(0x3500, [0x4140, 0, 0x4140, 0, bits])
    for take in (cell.measure, cell.glance, cell.tare):
        with pytest.raises(
            DeviceError, match=rf"{side} its range \(qualifier 0x{bits:04X}, gross weight 12\); take load"
        ):
            take()


@cases("position", [0, 2])
@cases("value", [math.nan, math.inf, -math.inf])
def test_a_weight_that_is_no_number(bench, position, value):
    cell = bench.cell()
    words = [0, 0, 0, 0, 0x10]
    words[position : position + 2] = struct.unpack(">2H", struct.pack(">f", value))
    bench.bank.alter = only(0x3500, words)
    for take in (cell.measure, cell.glance, cell.tare):
        with pytest.raises(DeviceError, match="not finite"):
            take()


def test_a_tare_that_is_lost_is_noticed(bench):
    cell = bench.cell()
    bench.put(5.0)
    cell.tare()
    bench.instrument.power_cycle()
    for take in (cell.measure, cell.glance):
        with pytest.raises(DeviceError, match="lost its tare; was it switched off"):
            take()
    cell.clear_tare()
    assert cell.glance()["load_force"] == pytest.approx(5.0)


def test_another_tare_of_somebody_else_is_noticed(bench):
    cell = bench.cell()
    bench.put(5.0)
    cell.tare()
    bench.put(7.0)
    assert cell.glance() == {"load_force": 2.0}
    bench.instrument.tare()
    for take in (cell.measure, cell.glance):
        with pytest.raises(DeviceError, match="has another tare than the bench set, 7 not 5"):
            take()
    cell.tare()
    bench.put(8.5)
    assert cell.glance()["load_force"] == pytest.approx(1.5)


@pytest.mark.parametrize(("action", "message"), [("tare", "took no tare"), ("clear_tare", "keeps its tare")])
def test_a_command_without_effect_is_noticed(bench, action, message):
    cell = bench.cell()
    bench.put(5.0)
    if action == "clear_tare":
        cell.tare()
    bench.bank.write_registers = lambda *_: None
    with pytest.raises(DeviceError, match=message):
        getattr(cell, action)()


def test_taring_does_not_wait_for_ever(bench):
    cell = bench.cell(still_timeout=0.5)
    bench.instrument._force = lambda: math.sin(10 * bench.world.time)
    begin = bench.clock.now()
    with pytest.raises(DeviceError, match=r"not still within 0\.5 s"):
        cell.tare()
    assert bench.clock.now() - begin == pytest.approx(0.5, abs=0.1)


def test_a_converter_that_stands_still(bench):
    bench.instrument._noise = 2e-4
    bench.instrument.power_cycle()
    cell = bench.cell(stale_after=10.0, samples=1)
    bench.instrument.frozen = True
    begin = bench.clock.now()

    def watch() -> None:
        for _ in range(100):
            bench.clock.sleep(1.0)
            cell.glance()

    stale = r"readings are stale: the converter has stood at -?\d+ for 1\d"
    with pytest.raises(DeviceError, match=stale):
        watch()
    assert 20.0 <= bench.clock.now() - begin <= 23.0
    with pytest.raises(DeviceError, match=stale):
        cell.glance()
    bench.instrument.frozen = False
    bench.clock.sleep(1.0)
    cell.glance()


def test_a_quiet_load_is_not_stale(bench):
    bench.instrument._noise = 2e-5  # far below a digit, though not below a step of the converter
    bench.instrument.power_cycle()
    cell = bench.cell(stale_after=1.0)
    bench.put(5.0)
    readings = []
    for _ in range(50):
        bench.clock.sleep(1.0)
        readings.append(cell.glance()["load_force"])
    assert set(readings) == {5.0}


# Anything at all


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    reply=st.binary(max_size=40),
    whole=st.booleans(),
    head=st.sampled_from([b"", b"\x01", b"\x01\x03", b"\x01\x03\x0a"]),
)
def test_any_reply_is_a_reading_or_an_error(bench, reply, whole, head):
    cell = bench.cell()
    frame = head + reply
    bench.tap.alter = lambda _: frame + crc16(frame) if whole else frame
    try:
        force = cell.glance()["load_force"]
    except DeviceError:
        force = 0.0
    finally:
        bench.tap.alter = lambda reply: reply
        bench.cells.remove(cell)
        cell.close()
    assert math.isfinite(force)


# What stands in the manual, and what time takes


def test_requests_of_connecting(bench):
    bench.cell(filter=5)
    assert bench.tap.sent == [
        sealed("01 04 202C 0002"),  # identity
        sealed("01 03 202E 0002"),  # firmware
        sealed("01 04 2034 0002"),  # serial number
        sealed("01 03 2080 0004"),  # peak, as floating-point number and as integer
        sealed("01 04 2122 0002"),  # zero tracking
        sealed("01 10 2110 0002 04 0000 0000"),  # filter mode: IIR
        sealed("01 03 2110 0002"),
        sealed("01 10 2106 0002 04 0000 0005"),  # filter
        sealed("01 04 2106 0002"),
        sealed("01 06 2061 0004"),  # reset of the tare
        sealed("01 03 3500 0005"),  # gross, net and qualifier
    ]


def test_after_a_lost_reply_a_request_like_no_other_brings_the_line_into_step(bench):
    cell = bench.cell()
    echoes = []
    for _ in range(5):
        times, lose = [], Once(lambda _: b"")
        bench.tap.sent.clear()
        bench.tap.alter = lambda reply, times=times, lose=lose: times.append(bench.clock.now()) or lose(reply)
        cell.glance()
        block, echo, again, look = bench.tap.sent
        assert again == block
        assert look in LOOK_AT_FILTER
        echoes.append(echo)
        # The time-out and a quarter of it in silence; three time-outs until nothing late can come.
        assert times[1] - times[0] == pytest.approx(1.25 * 0.2, abs=0.01)
        assert times[2] - times[0] == pytest.approx(3.0 * 0.2, abs=0.01)
    forms = [
        sealed(f"01 {function} 202A 000{count}") for function, count in (("04", 8), ("03", 6), ("03", 8), ("04", 6))
    ]
    assert echoes == [*forms, forms[0]]
    assert cell.repeats == 5


def test_a_line_that_was_lost_is_not_asked(bench):
    cell = bench.cell()
    protocol_emulated.unregister("load")
    with pytest.raises(DeviceConnectionError, match="lost the line"):
        cell.glance()
    with pytest.raises(DeviceConnectionError, match="was lost; open it again"):
        cell.self_check()
    protocol_emulated.register("load", bench.tap, bench.clock)
    cell.glance()


def test_a_force_at_its_limits_is_good(bench):
    cell = bench.cell(force_limits=(-4.0, 8.0), newtons_per_unit=2.0, zero_newtons=-2.0)
    for weight, force in ((5.0, 8.0), (-1.0, -4.0)):
        bench.put(weight)
        assert cell.glance() == {"load_force": force}
    for weight in (5.1, -1.1):
        bench.put(weight)
        with pytest.raises(DeviceError, match="outside of its calibrated range -4 to 8 N"):
            cell.glance()


def test_own_check_reads_the_filter_and_looks_at_the_converter(bench):
    bench.instrument._noise = 2e-4
    bench.instrument.power_cycle()
    cell = bench.cell()
    bench.tap.sent.clear()
    begin = bench.clock.now()
    filtered, converter = cell.self_check()
    assert bench.clock.now() - begin == pytest.approx(5 * 0.05, abs=0.03)
    assert (filtered.text, filtered.advice) == ("3 in the instrument", "")
    assert converter.text.endswith("in 5 readings")
    assert converter.advice == ""
    assert len(bench.tap.sent) == 6
    bench.instrument.frozen = True
    bench.instrument.write_registers(0x2106, [0, 4])
    filtered, converter = cell.self_check()
    assert "from 3" in filtered.advice
    assert "off and on" in converter.advice


def test_a_cell_over_its_range_is_told_on_reconnecting(bench):
    cell = bench.cell()
    cell.reconnect()
    bench.bank.alter = lambda address, words: [*words[:4], 0x12] if address == 0x3500 else words
    with pytest.raises(DeviceError, match="over its range"):
        cell.reconnect()
    bench.bank.alter = lambda _, words: words
    bench.instrument.write_registers(0x2106, [0, 4])
    with pytest.raises(DeviceRestartedError, match=r"its filter \(FL\) is 4, not 3"):
        cell.reconnect()
