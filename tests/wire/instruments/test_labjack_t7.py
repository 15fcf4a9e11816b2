"""The emulated T7: its register map, its converter, its watchdog, its wire, and independent clients."""

import math
import socket
import struct
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from cases import cases
from hypothesis import given, strategies as st
from modbus_tcp import ModbusTcpServer

from bench.base import VirtualClock
from sim_devices.instruments.labjack_t7 import DAC_STEP, RAIL, EmulatedT7
from sim_devices.plants import _voltage_course_kernels as course_kernels
from sim_devices.transducers.displacement import DisplacementSensor
from sim_devices.transducers.magnet import RatiometricSensor
from sim_devices.transducers.piezo_amplifier import PiezoAmplifier
from sim_devices.wire.modbus import RegisterError, answer
from sim_devices.wire.modbus_tcp import FramingError, ModbusTcpInstrument, ModbusTcpStream
from sim_devices.world import World

LSB = 2 * RAIL * 10 / 65536


class Ramp:
    """A plant that counts its own time."""

    def __init__(self) -> None:
        self.time = 0.0

    def advance(self, dt: float) -> None:
        self.time += dt


class Quiet:
    """A generator without noise, for exact vectors."""

    def standard_normal(self, size: int) -> np.ndarray:
        return np.zeros(size)


def make(inputs: dict[int, Callable[[], float]] | None = None, *, seed: int | None = None) -> EmulatedT7:
    rng = Quiet() if seed is None else np.random.default_rng(seed)
    return EmulatedT7(World(Ramp(), VirtualClock()), inputs or {}, rng=rng)


@pytest.fixture
def t7() -> EmulatedT7:
    return make()


def frame(text: str) -> bytes:
    return bytes.fromhex(text)


# The register map


@cases(
    ("address", "words"),
    [
        (55100, [0x0011, 0x2233]),
        (55124, [0xC61C, 0x3C00]),
        (60000, [0x40E0, 0x0000]),
        (60004, list(struct.unpack(">2H", struct.pack(">f", 1.03)))),
        (60028, [470012345 >> 16, 470012345 & 0xFFFF]),
        (40000, [0x4120, 0x0000]),
        (41000, [199]),
        (9300, [0, 200]),
        (10200, [0x45BB, 0x8000]),
        (61600, [0, 0]),
    ],
)
def test_what_registers_read_after_power_up(t7, address, words):
    assert t7.read_registers(address, len(words)) == words


@cases("address", [28, 1004, 9028, 41014, 55102, 61616, 65535])
def test_what_is_not_emulated_is_an_illegal_address(t7, address):
    with pytest.raises(RegisterError) as refused:
        t7.read_registers(address, 1)
    assert refused.value.code == 2
    with pytest.raises(RegisterError) as refused:
        t7.write_registers(address, [0])
    assert refused.value.code == 2


def test_read_only_and_write_only(t7):
    for call in (lambda: t7.write_value(0, 1.0), lambda: t7.read_value(30000), lambda: t7.read_value(61614)):
        with pytest.raises(RegisterError) as refused:
            call()
        assert refused.value.code == 2


@cases(("address", "values"), [(1000, [0]), (1001, [0]), (1000, [0, 0, 0]), (40001, [0, 0])])
def test_half_a_value_cannot_be_written(t7, address, values):
    with pytest.raises(RegisterError) as refused:
        t7.write_registers(address, values)
    assert refused.value.code == 3


@cases(
    ("address", "value", "detail"),
    [
        (40006, 5.0, 2370),
        (40006, -10.0, 2370),
        (42006, 60_000.0, 2371),
        (4008, 5000.0, 2371),
        (41003, 4, 2373),
        (41002, 2, 2373),
        (41503, 9, 2375),
        (4010, 9, 2375),
    ],
)
def test_refused_settings_leave_a_detail(t7, address, value, detail):
    before = t7.read_value(address)
    with pytest.raises(RegisterError) as refused:
        t7.write_value(address, value)
    assert refused.value.code == 4
    assert t7.read_value(55000) == detail
    assert t7.read_value(address) == before
    with pytest.raises(RegisterError):
        t7.read_registers(50000, 1)
    assert t7.read_value(55000) == 0


@cases(
    ("address", "value"),
    [(9000, 1), (9300, 0), (9300, 16385), (10200, 0.0), (61600, 2), (61600, 1)],
)
def test_other_refused_settings(t7, address, value):
    with pytest.raises(RegisterError) as refused:
        t7.write_value(address, value)
    assert refused.value.code == 4


@cases(("written", "read"), [(10, 10), (1, 1), (0.1, 0.1), (0.01, 0.01), (0, 10)])
def test_ranges(t7, written, read):
    t7.write_value(40026, written)
    assert t7.read_value(40026) == pytest.approx(read, rel=1e-6)


def test_outputs(t7):
    for volts, kept in ((2.5, 2.5), (7.0, 5.0), (-1.0, 0.0)):
        t7.write_value(1002, volts)
        assert t7.read_value(1002) == t7.dac_volts(1) == kept
    t7.write_value(30004, -12.0)
    assert t7.tdac_volts(2) == -10.0


def test_followers_are_told_after_requests_and_when_the_watchdog_acts(t7):
    seen = []
    arm(t7)
    t7.add_follower(lambda: seen.append((t7.world.time, t7.dac_volts(0), t7.dio_level(0, pulled_down=True))))
    assert seen == [(0.0, 0.0, False)]
    t7.world.clock.sleep(1.0)
    t7.write_registers(1000, [0x4020, 0])
    t7.write_value(2000, 1)
    t7.world.clock.sleep(100.0)
    t7.world.advance()
    assert seen[1:] == [(1.0, 2.5, False), (1.0, 2.5, True), (3.0, pytest.approx(0.5, abs=DAC_STEP), False)]


def test_digital_lines(t7):
    assert t7.dio_level(3)
    t7.write_value(2003, 0)
    assert not t7.dio_level(3)
    assert t7.read_value(2800) == 0x7FFFFF & ~0b1000
    assert t7.read_value(2850) == 0b1000
    t7.write_value(2900, 0b1000)
    t7.write_value(2800, 0b1010)
    assert not t7.dio_level(3)
    t7.write_value(2850, 0b0010)
    assert t7.read_value(2850) == 0b1010
    assert t7.read_value(2800) == 0x7FFFFF & ~0b1000


# The converter


def test_quantisation_at_index_1():
    volts = 0.0
    t7 = make({0: lambda: volts})
    t7.write_value(41500, 1)
    seen = set()
    for volts in np.linspace(0.0, 10 * LSB, 1001):
        reading = t7.convert(0)
        assert abs(reading - volts) <= LSB / 2 + 1e-12
        seen.add(round(reading / LSB, 6))
    assert seen == set(range(11))


@cases("span", [10.0, 1.0, 0.1, 0.01])
def test_clipping(span):
    volts = 0.0
    t7 = make({0: lambda: volts})
    t7.write_value(40000, span)
    for volts in (1.05 * span, -1.05 * span):
        assert t7.convert(0) == pytest.approx(volts, abs=2 * RAIL * span / 65536)
    volts = 100.0
    assert t7.convert(0) == pytest.approx(1.06 * span, rel=1e-4)
    volts = -100.0
    assert t7.convert(0) == pytest.approx(-1.06 * span)


def test_differential():
    t7 = make({2: lambda: 3.0, 3: lambda: 1.0})
    t7.write_value(41002, 3)
    assert t7.convert(2) == pytest.approx(2.0, abs=LSB)


def test_a_burst_lets_time_pass_and_averages_over_it():
    world = World(Ramp(), VirtualClock())
    t7 = EmulatedT7(world, {0: lambda: world._plant.time}, rng=Quiet())
    t7.write_value(9000, 3)
    t7.write_value(9300, 4)
    t7.write_value(10200, 100.0)
    world.clock.sleep(1.0)
    assert t7.read_value(7000) == pytest.approx(1.025, abs=LSB)
    assert world.clock.now() == pytest.approx(1.04)
    assert t7.read_value(7300) == pytest.approx(1.04, abs=LSB)
    assert t7.read_value(7600) == pytest.approx(1.01, abs=LSB)
    assert world.clock.now() == pytest.approx(1.04)  # only the average starts a burst


def test_bursts_that_cannot_be(t7):
    with pytest.raises(RegisterError, match="EF_INDEX"):
        t7.read_value(7000)
    t7.write_value(9000, 3)
    t7.write_value(10200, 1000.0)
    with pytest.raises(RegisterError, match="too long"):
        t7.read_value(7000)


# The watchdog


def arm(t7: EmulatedT7, *, strict: bool = False, timeout: int = 2) -> None:
    for address, value in (
        (61600, 0),
        (61604, timeout),
        (61610, int(strict)),
        (61612, 0xCAFE1234),
        (61640, 1),
        (61642, 0.5),
        (61630, 1),
        (61632, 0),
        (61634, 0b11),
        (61636, 0b10),
        (61600, 1),
    ):
        t7.write_value(address, value)


def test_watchdog_expires_at_its_instant():
    t7 = make()
    clock = t7.world.clock
    arm(t7)
    t7.write_value(1000, 4.0)
    t7.write_value(1002, 3.0)
    t7.write_value(2000, 1)
    assert t7.deadline() == 2.0
    clock.sleep_until(math.nextafter(2.0, 0.0))
    t7.world.advance()
    assert t7.dac_volts(0) == pytest.approx(4.0, abs=DAC_STEP / 2)
    assert not t7.watchdog_expired
    clock.sleep_until(2.0)
    t7.world.advance()
    assert t7.dac_volts(0) == pytest.approx(0.5, abs=DAC_STEP / 2)
    assert t7.dac_volts(1) == pytest.approx(3.0, abs=DAC_STEP / 2)  # not enabled
    assert not t7.dio_level(0)
    assert t7.dio_level(1)  # inhibited
    assert t7.watchdog_expired
    assert t7.deadline() == math.inf


def test_strict_is_fed_by_the_key_only():
    t7 = make()
    arm(t7, strict=True)
    for _ in range(4):
        t7.world.clock.sleep(1.5)
        t7.write_value(61614, 0xCAFE1234)
    assert t7.deadline() == 8.0
    t7.world.clock.sleep(1.5)
    t7.read_value(0)
    t7.write_value(61614, 1)
    assert t7.deadline() == 8.0
    t7.world.clock.sleep(0.5)
    t7.world.advance()
    assert t7.watchdog_expired


def test_strict_goes_on_after_it_expired():
    t7 = make()
    arm(t7, strict=True)
    t7.world.clock.sleep(5.0)
    t7.write_value(1000, 4.0)  # lasts until the next timeout, which is at 6 s
    assert t7.dac_volts(0) == pytest.approx(4.0, abs=DAC_STEP / 2)
    assert t7.deadline() == 6.0
    t7.world.clock.sleep_until(6.0)
    t7.world.advance()
    assert t7.dac_volts(0) == pytest.approx(0.5, abs=DAC_STEP / 2)


def test_watchdog_is_set_up_while_disabled_only(t7):
    arm(t7)
    for address in (61604, 61610, 61612, 61630, 61632, 61634, 61636, 61640, 61642, 61650, 61652):
        with pytest.raises(RegisterError) as refused:
            t7.write_value(address, 1)
        assert refused.value.code == 4
    t7.write_value(61600, 0)
    assert t7.deadline() == math.inf
    t7.write_value(61604, 7)
    assert t7.read_value(61604) == 7


# The transducers


@cases(
    ("position", "shown"),
    [
        (0.0, 0.0),
        (1.981e-3, 2e-3),
        (2.019e-3, 2e-3),
        (2.021e-3, 2.04e-3),
        (0.035, 0.035),
        (-1e-3, 0.0),
        (-1.0, 0.0),
        (0.036, 0.035),
        (1.0, 0.035),
    ],
)
def test_ratiometric_sensor_without_noise(position, shown):
    sensor = RatiometricSensor(lambda: position, noise=0.0, supply_error=0.0, rng=np.random.default_rng(2))
    for volts in (5.0, 4.0):
        assert sensor.supply() == volts
        assert sensor.output() == pytest.approx(volts * (0.1 + 0.8 * shown / 0.035), abs=1e-9)
        sensor.supply_volts = 4.0


@cases(
    ("displacement", "shown"),
    [(0.0, 0.0), (14e-9, 10e-9), (-16e-9, -20e-9), (199.994e-6, 199.99e-6), (200e-6, 200e-6), (1.0, 200e-6)],
)
def test_displacement_sensor_without_noise(displacement, shown):
    sensor = DisplacementSensor(lambda: displacement, noise=0.0, rng=np.random.default_rng(2))
    assert sensor() == pytest.approx(5e4 * shown, abs=1e-9)
    displacement = -displacement
    assert sensor() == pytest.approx(-5e4 * shown, abs=1e-9)


class Capacitor:
    """A load that notes when which voltage was applied to it, with the voltage integrated over time."""

    def __init__(self) -> None:
        self.time = self.volts = self.integral = self.passed = 0.0
        self.applied: list[tuple[float, float]] = []
        self.course = np.zeros(course_kernels.SIZE)

    def lead(self, start: float, target: float, steps: int, time_constant: float) -> None:
        self.course[:] = start, target, steps, 0, time_constant
        self.passed = 0.0
        self.apply(course_kernels.within(self.volts, start, target))

    def apply(self, voltage: float) -> None:
        if voltage != self.volts:
            self.volts = voltage
            self.applied.append((self.time, voltage))

    def advance(self, dt: float) -> None:
        end = self.passed + dt
        while (due := course_kernels.next_instant(self.course)) <= end:
            self.pass_by(due - self.passed)
            self.apply(course_kernels.take_step(self.volts, self.course))
        self.pass_by(end - self.passed)

    def pass_by(self, dt: float) -> None:
        self.time += dt
        self.passed += dt
        self.integral += self.volts * dt


def amplifier(**said) -> tuple[PiezoAmplifier, Capacitor, World]:
    load = Capacitor()
    world = World(load, VirtualClock())
    said = {"scale_error": 0.0, "noise_volts": 0.0, "rng": np.random.default_rng(1)} | said
    return PiezoAmplifier(world, load, **said), load, world


def wait(world: World, seconds: float) -> None:
    world.clock.sleep(seconds)
    world.advance()


def test_amplifier_settles_by_its_time_constant():
    hv, load, world = amplifier()
    wait(world, 1.0)
    hv.drive(1.0, True)
    assert load.applied == []
    for _ in range(60):
        wait(world, 23e-6)
        exact = 20.0 * (1 - math.exp(-(world.time - 1.0) / 0.2e-3))
        assert hv.voltage == pytest.approx(exact, abs=1e-9)
        assert hv.voltage_monitor() == pytest.approx(exact / 20.0, abs=1e-9)
        assert hv.current_monitor() == pytest.approx(20e-9 * (20.0 - exact) / 0.2e-3 / 0.01, abs=1e-9)
        assert abs(load.volts - exact) <= hv.STEP / 2 + 1e-9
    wait(world, 1.0)
    assert load.volts == 20.0
    assert course_kernels.next_instant(load.course) == math.inf
    volts = [volts for _, volts in load.applied]
    assert len(volts) == 160
    assert volts == sorted(volts)
    # The area that is missing is that of the exponential.
    assert 20.0 * (world.time - 1.0) - load.integral == pytest.approx(20.0 * 0.2e-3, rel=0.01)


# The wire


VECTORS = [
    ("0001 0000 0006 01 03 d73c 0002", "0001 0000 0007 01 03 04 0011 2233"),  # TEST
    ("0002 0000 0006 01 04 d754 0002", "0002 0000 0007 01 04 04 c61c 3c00"),  # TEST_FLOAT32, function 4
    ("0003 0000 0006 ff 03 0000 0002", "0003 0000 0007 ff 03 04 401f fe66"),  # AIN0 at 2.5 V, any unit
    ("0004 0000 000b 01 10 9c40 0002 04 3dcc cccd", "0004 0000 0006 01 10 9c40 0002"),  # AIN0_RANGE 0.1
    ("0005 0000 0006 01 06 a21c 0008", "0005 0000 0006 01 06 a21c 0008"),  # AIN0_RESOLUTION_INDEX 8
    ("0006 0000 000b 01 10 9c40 0002 04 40a0 0000", "0006 0000 0003 01 90 04"),  # range 5 V: device failure
    ("0007 0000 0006 01 03 d6d8 0001", "0007 0000 0005 01 03 02 0942"),  # LAST_ERR_DETAIL 2370
    ("0008 0000 0002 01 2b", "0008 0000 0003 01 ab 01"),  # illegal function
    ("0009 0000 0006 01 03 ffff 0002", "0009 0000 0003 01 83 02"),  # beyond the last address
    ("000a 0000 0006 01 03 0000 007e", "000a 0000 0003 01 83 03"),  # 126 registers
    ("000b 0000 0006 01 03 0000 0000", "000b 0000 0003 01 83 03"),  # none
    ("000c 0000 0003 01 03 00", "000c 0000 0003 01 83 03"),  # too short
    ("000d 0000 0009 01 10 9c40 0002 04 0000", "000d 0000 0003 01 90 03"),  # count and data disagree
    ("000e 0000 0007 01 06 a21c 0008 00", "000e 0000 0003 01 86 03"),  # too long
]


@pytest.fixture
def wired() -> EmulatedT7:
    t7 = make({0: lambda: 2.5})
    t7.write_value(41500, 1)
    return t7


def test_byte_vectors(wired):
    stream = ModbusTcpStream(wired)
    for sent, reply in VECTORS:
        assert stream.receive(frame(sent)).hex(" ") == frame(reply).hex(" ")


def test_the_vector_of_ain0_is_its_nearest_code(wired):
    assert struct.unpack(">f", frame("401ffe66"))[0] == pytest.approx(round(2.5 / LSB) * LSB, rel=1e-7)


@given(cuts=st.lists(st.integers(0, 200), max_size=20))
def test_requests_may_come_in_any_pieces(cuts):
    t7 = make({0: lambda: 2.5})
    t7.write_value(41500, 1)
    stream = ModbusTcpStream(t7)
    data = b"".join(frame(sent) for sent, _ in VECTORS)
    edges = sorted({0, len(data), *(cut for cut in cuts if cut < len(data))})
    replies = b"".join(stream.receive(data[a:b]) for a, b in pairwise(edges))
    assert replies == b"".join(frame(reply) for _, reply in VECTORS)


FEEDBACK_VECTORS = [  # LabJack's function 76: kind, address, number of registers, and the values of a write
    ("0001 0000 0006 01 4c 00 d73c 02", "0001 0000 0006 01 4c 0011 2233"),
    ("0002 0000 000a 01 4c 00 d73c 02 00 d754 02", "0002 0000 000a 01 4c 0011 2233 c61c 3c00"),
    ("0003 0000 000e 01 4c 01 03e8 02 4020 0000 00 03e8 02", "0003 0000 0006 01 4c 4020 0000"),  # DAC0 and back
    ("0004 0000 000a 01 4c 01 03ea 02 3fc0 0000", "0004 0000 0002 01 4c"),  # a write alone has no values
    ("0005 0000 0002 01 4c", "0005 0000 0003 01 cc 03"),
    ("0006 0000 0005 01 4c 00 d73c", "0006 0000 0003 01 cc 03"),
    ("0007 0000 0006 01 4c 02 d73c 02", "0007 0000 0003 01 cc 03"),  # a kind that there is not
    ("0008 0000 0006 01 4c 00 d73c 00", "0008 0000 0003 01 cc 03"),
    ("0009 0000 0008 01 4c 01 03e8 02 4020", "0009 0000 0003 01 cc 03"),  # half of the value
    ("000a 0000 0006 01 4c 00 7530 02", "000a 0000 0003 01 cc 02"),  # TDAC0 can only be written
    ("000b 0000 0006 01 4c 00 ffff 02", "000b 0000 0003 01 cc 02"),
]


def test_byte_vectors_of_feedback(wired):
    stream = ModbusTcpStream(wired)
    for sent, reply in FEEDBACK_VECTORS:
        assert stream.receive(frame(sent)).hex(" ") == frame(reply).hex(" ")
    assert [wired.dac_volts(n) for n in (0, 1)] == pytest.approx([2.5, 1.5], abs=DAC_STEP)


def test_feedback_carries_out_what_is_before_a_refusal(wired):
    stream = ModbusTcpStream(wired)
    request = "0001 0000 0013 01 4c 01 03e8 02 4020 0000 01 a21c 01 0009 00 d73c 02"
    assert stream.receive(frame(request)) == frame("0001 0000 0003 01 cc 04")
    assert wired.dac_volts(0) == pytest.approx(2.5, abs=DAC_STEP)
    assert wired.read_value("LAST_ERR_DETAIL") == 2375


def test_a_reply_to_feedback_that_does_not_fit_into_a_packet_is_refused(wired):
    stream = ModbusTcpStream(wired)
    body = "4c" + "00 0000 1c" * 19  # AIN0 to AIN13, 56 bytes each
    request = f"0001 0000 {len(frame(body)) + 1:04x} 01" + body
    assert stream.receive(frame(request)) == frame("0001 0000 0003 01 cc 03")


def test_feedback_is_no_function_of_other_instruments(wired):
    assert answer(wired, frame("4c 00 d73c 02")) == frame("cc 01")


@given(st.binary(min_size=1, max_size=253))
def test_any_request_is_answered(request_bytes):
    reply = answer(make(), request_bytes)
    assert reply[0] in (request_bytes[0], request_bytes[0] | 0x80)
    if reply[0] != request_bytes[0]:
        assert reply[1] in (1, 2, 3, 4)


@cases("bad", ["0001 0001 0006 01 03 0000 0001", "0001 0000 0001 01", "0001 0000 040b 01"])
def test_a_foreign_header_ends_the_connection_and_no_other(wired, bad):
    with ModbusTcpServer(wired) as server:
        with socket.create_connection(("127.0.0.1", server.port), timeout=60) as spoilt:
            spoilt.sendall(frame(bad))
            assert spoilt.recv(100) == b""
        with socket.create_connection(("127.0.0.1", server.port), timeout=60) as client:
            client.sendall(frame(VECTORS[0][0]))
            assert client.recv(100) == frame(VECTORS[0][1])


def test_a_third_connection_is_refused_until_one_ends(wired):
    instrument = ModbusTcpInstrument(wired)
    first, second = instrument.connect(), instrument.connect()
    with pytest.raises(ConnectionRefusedError, match="the instrument has 2 open already"):
        instrument.connect()
    second.close()
    second.close()
    with pytest.raises(ConnectionResetError, match="closed"):
        second.receive(frame(VECTORS[0][0]))
    third = instrument.connect()
    with pytest.raises(FramingError):
        third.receive(frame("0001 0001 0006 01 03 0000 0001"))
    for each in (first, instrument.connect()):
        assert each.receive(frame(VECTORS[0][0])) == frame(VECTORS[0][1])


def test_a_defect_of_the_instrument_is_a_device_failure(caplog):
    def broken() -> float:
        raise ZeroDivisionError

    t7 = make({0: broken})
    assert answer(t7, frame("03 0000 0002")) == frame("83 04")
    assert "the emulated instrument failed on request 03 00 00 00 02" in caplog.text


# Packets that come again, and waits between their frames


def packet(volts, wait_us, count=3):
    """A read of AIN0, a write of DAC0 and a wait, `count` times."""
    sample = "00 0000 02" + "01 03e8 02" + struct.pack(">f", volts).hex() + "01 f096 02" + f"{wait_us:08x}"
    return frame("4c" + sample * count)


def send(stream, body):
    return stream.receive(struct.pack(">HHHB", 1, 0, len(body) + 1, 1) + body)


def test_frames_behind_a_wait_are_carried_out_after_it():
    seen = []
    t7 = make({0: lambda: 0.1 * t7.world.time})
    t7.add_follower(lambda: seen.append((t7.world.time, t7.dac_volts(0))))
    stream = ModbusTcpStream(t7)
    start = t7.world.time
    for volts in (1.25, 2.5):
        reply = send(stream, packet(volts, 50_000))
        values = struct.unpack(">3f", reply[8:])
        assert np.diff(values) == pytest.approx([5e-3, 5e-3], abs=1e-3)
    assert t7.world.time == pytest.approx(start + 0.3)
    changed = [(t - start, volts) for t, volts in seen[1:]]
    assert [t for t, _ in changed] == pytest.approx([0.0, 0.05, 0.1, 0.15, 0.2, 0.25])
    assert [volts for _, volts in changed] == pytest.approx([1.25] * 3 + [2.5] * 3, abs=DAC_STEP)


def test_a_packet_that_comes_again_is_carried_out_as_the_first_time():
    # The same frames one by one, each in a packet of its own that no other resembles.
    known, plain = make({0: lambda: 2.5}), make({0: lambda: 2.5})
    stream = ModbusTcpStream(known)
    for volts in (1.0, 2.0, 7.0):
        reply = send(stream, packet(volts, 0))
        readings = []
        for _ in range(3):
            readings += plain.read_registers(0, 2)
            plain.write_value("DAC0", volts)
            plain.write_value("WAIT_US_BLOCKING", 0)
        assert reply[8:] == struct.pack(">6H", *readings)
        assert known.dac_volts(0) == plain.dac_volts(0)


def test_a_refused_value_ends_a_packet_that_is_known():
    t7 = make({0: lambda: 2.5})
    stream = ModbusTcpStream(t7)
    assert send(stream, packet(1.0, 0))[7] == 76
    for body, code in ((packet(2.0, 100_001), 4), (packet(math.nan, 0), 3)):
        assert send(stream, body)[7:] == bytes((0xCC, code))
    assert t7.dac_volts(0) == pytest.approx(2.0, abs=DAC_STEP)
    assert send(stream, packet(3.0, 0))[7] == 76


def test_a_wait_is_no_communication():
    t7 = make()
    t7.write_value("WATCHDOG_TIMEOUT_S_DEFAULT", 1)
    t7.write_value("WATCHDOG_DAC0_ENABLE_DEFAULT", 1)
    t7.write_value("WATCHDOG_ENABLE_DEFAULT", 1)
    send(ModbusTcpStream(t7), packet(2.0, 100_000, 12))
    assert t7.watchdog_expired


def test_unplugged_lines():
    t7 = make()
    stream = ModbusTcpStream(t7)
    request = frame("0101 0000 0006 01 03 d73c 0002")
    reply = frame("0101 0000 0007 01 03 04 0011 2233")
    t7.unplug()
    assert stream.receive(request) == b""
    t7.plug_in()
    assert stream.receive(request) == reply
