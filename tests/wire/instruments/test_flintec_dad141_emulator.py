"""The emulated DAD 141.1: its registers, its filter and motion detection, its wire, and independent clients."""

import math
import struct
from itertools import pairwise

import numpy as np
import pytest
from cases import cases
from hypothesis import given, strategies as st
from still_plant import sealed

from bench.base import VirtualClock
from sim_devices.instruments.flintec_dad141 import (
    CUTOFF_HZ,
    EmulatedDAD141,
    reading_interval,
)
from sim_devices.wire.modbus import RegisterError
from sim_devices.wire.modbus_rtu import LONGEST_FRAME, ModbusRtuServer
from sim_devices.world import World


class Load:
    """A plant whose force the test sets, and which counts how often it is split."""

    def __init__(self, force: float = 0.0) -> None:
        self.force = force
        self.time = 0.0
        self.splits = 0

    def advance(self, dt: float) -> None:
        self.time += dt
        self.splits += 1


class Cell(EmulatedDAD141):
    """An instrument with its plant at hand."""

    def __init__(self, force: float = 0.0, *, noise: float = 0.0, seed: int = 5, clock=None, **options) -> None:
        self.load = Load(force)
        self.clock = clock or VirtualClock()
        world = World(self.load, self.clock)
        super().__init__(
            "load",
            world,
            lambda: self.load.force,
            rng=np.random.default_rng(seed),
            noise=noise,
            **{"zero_tracking": 0, **options},
        )

    def floats(self, address: int, count: int = 1) -> list[float]:
        words = self.read_registers(address, 2 * count)
        return list(struct.unpack(f">{count}f", struct.pack(f">{2 * count}H", *words)))

    def integer(self, address: int) -> int:
        return struct.unpack(">i", struct.pack(">2H", *self.read_registers(address, 2)))[0]

    def qualifier(self) -> int:
        return self.read_registers(0x2060, 1)[0]

    def rest(self, force: float) -> None:
        self.load.force = force
        self.clock.sleep(10.0)


def refused(code: int, call) -> None:
    with pytest.raises(RegisterError) as refusal:
        call()
    assert refusal.value.code == code


# The register map


def test_what_registers_read():
    cell = Cell()
    cell.rest(12.0)
    cell.write_registers(0x2061, [0x08])
    cell.rest(23.5)
    assert cell.floats(0x2000, 2) == [23.5, 11.5]
    assert (cell.integer(0x2020), cell.integer(0x2022)) == (23500, 11500)
    assert cell.integer(0x202A) == round(23.5 / 72.0 * 2**23)
    assert cell.integer(0x202C) == 1410
    assert cell.read_registers(0x202E, 2) == [0, 0x0A01]
    assert cell.integer(0x2030) == 5000  # still, tare
    assert cell.integer(0x2034) == 1410237
    assert cell.qualifier() == 0x0030
    assert cell.integer(0x2106) == 3
    assert cell.integer(0x2118) == 12000
    assert [cell.integer(each) for each in (0x220C, 0x220E, 0x2214, 0x2216)] == [60000, -60000, 3, 1]
    assert cell.read_registers(0x3500, 5) == [0x41BC, 0x0000, 0x4138, 0x0000, 0x0030]
    assert cell.read_registers(0x3300, 5) == [0, 23500, 0, 11500, 0x0030]


@cases("address", [0x0000, 0x1FFF, 0x2004, 0x2032, 0x3505, 0xFFFF])
def test_what_is_not_emulated_is_an_illegal_address(address):
    cell = Cell()
    refused(2, lambda: cell.read_registers(address, 1))
    refused(2, lambda: cell.write_registers(address, [0]))


def test_read_only_write_only_and_half_values():
    cell = Cell()
    refused(2, lambda: cell.write_registers(0x2000, [0, 0]))
    refused(2, lambda: cell.read_registers(0x2061, 1))
    refused(2, lambda: cell.read_registers(0x2066, 1))
    refused(3, lambda: cell.write_registers(0x2106, [0]))
    refused(3, lambda: cell.write_registers(0x2107, [0]))


@cases(
    ("address", "values"),
    [(0x2106, [0, 9]), (0x2106, [0xFFFF, 0xFFFF]), (0x2110, [0, 2]), (0x2112, [0, 0]), (0x2114, [1, 0])]
    + [(0x2061, [each]) for each in (0x00, 0x40, 0x100)]
    + [(0x2066, [each]) for each in (0x00, 0x8000)],
)
def test_values_that_are_not_allowed(address, values):
    refused(3, lambda: Cell().write_registers(address, values))


@cases(("decimals", "step", "shown"), [(3, 1, 12.346), (3, 5, 12.345), (1, 2, 12.4), (0, 10, 10.0)])
def test_resolution(decimals, step, shown):
    cell = Cell(12.3456, decimals=decimals, step=step)
    assert cell.floats(0x2000) == [pytest.approx(shown, rel=1e-7)]
    assert cell.integer(0x2020) == round(shown * 10**decimals)


# Commands


def test_set_and_reset_zero():
    cell = Cell()
    cell.rest(1.0)
    cell.write_registers(0x2061, [0x02])
    assert cell.floats(0x2000, 2) == [0.0, 0.0]
    assert cell.integer(0x2030) == 3000
    cell.write_registers(0x2061, [0x01])
    assert cell.floats(0x2000) == [1.0]
    cell.rest(1.3)  # more than 2 % of 60
    refused(4, lambda: cell.write_registers(0x2061, [0x02]))


# Zero tracking


def delivered(force: float = 0.0, **options) -> Cell:
    """Return an instrument as it is delivered: it tracks the zero within ±0.5 d."""
    return Cell(force, **{"zero_tracking": 1, **options})


def test_a_load_that_grows_slowly_is_tracked_away():
    cell, plain = delivered(), Cell()
    for step in range(1, 201):
        for each in (cell, plain):
            each.load.force = 0.0003 * step  # 0.3 d a second
            each.clock.sleep(1.0)
            each.qualifier()
    assert plain.integer(0x2020) == 60
    assert cell.integer(0x2020) == 0
    assert cell.floats(0x2000) == [0.0]
    assert cell.integer(0x2030) & 2000


def test_the_zero_moves_at_its_rate_within_its_band_and_range():
    cell = delivered(zero_tracking=100, decimals=3, weight_limits=(-1.0, 1.0))
    cell.rest(0.0)
    cell.load.force = 0.03  # 30 d of 50 d that are tracked
    cell.clock.sleep(1.0)
    before = cell.integer(0x2020)
    cell.clock.sleep(10.0)
    assert before - cell.integer(0x2020) == pytest.approx(4, abs=1)
    cell.clock.sleep(3600.0)
    assert cell.integer(0x2020) == 10  # 2 % of the largest weight


def test_zero_tracking_belongs_to_the_calibration():
    cell = delivered()
    refused(4, lambda: cell.write_registers(0x2122, [0, 0]))
    refused(4, lambda: cell.write_registers(0x2066, [0x0002]))
    refused(4, lambda: cell.write_registers(0x2204, [0, 16]))
    cell.write_registers(0x2204, [0, cell.integer(0x2204)])
    refused(3, lambda: cell.write_registers(0x2122, [0, 256]))
    cell.write_registers(0x2122, [0, 0])
    cell.power_cycle()
    assert (cell.integer(0x2122), cell.integer(0x2204)) == (1, 17)
    cell.write_registers(0x2204, [0, 17])
    cell.write_registers(0x2122, [0, 0])
    cell.write_registers(0x2066, [0x0002])
    cell.power_cycle()
    assert (cell.integer(0x2122), cell.integer(0x2204)) == (0, 18)


# The filter

SETTLING_MS = {1: 55, 2: 122, 3: 242, 4: 322, 5: 482, 6: 963, 7: 1923, 8: 3847}
"""To 0.1 %, by setting (Technical Manual, 10.4.2, IIR filter)."""


def filtered(setting: int, **options) -> Cell:
    cell = Cell(decimals=5, weight_limits=(-9.0, 9.0), **options)
    cell.write_registers(0x2106, [0, setting])
    return cell


@cases("setting", SETTLING_MS)
@cases("watch", [0.001, 0.004, 0.02])
def test_settles_in_the_time_of_the_manual(setting, watch):
    cell = filtered(setting)
    cell.clock.sleep(1.0)
    cell.qualifier()
    cell.load.force = 1.0
    start = cell.clock.now()
    while abs(cell.floats(0x2000)[0] - 1.0) > 1e-3:
        cell.clock.sleep(watch)
    assert 1000 * (cell.clock.now() - start) == pytest.approx(SETTLING_MS[setting], rel=0.06, abs=1000 * watch)


@cases("setting", range(9))
def test_cut_off(setting):
    """The response to a sine wave at the cut-off, by the plant's own clock."""
    cell = filtered(setting)
    omega = 2 * math.pi * CUTOFF_HZ[setting]
    cell._force = lambda: 5.0 * math.sin(omega * cell.world.time)
    peak = 0.0
    for step in range(400):
        cell.clock.sleep_until((step + 1) / 40 / CUTOFF_HZ[setting])
        if step >= 200:
            peak = max(peak, abs(cell.floats(0x2000)[0]))
    assert peak == pytest.approx(5.0 / math.sqrt(2), rel=0.015)


def test_how_often_it_is_asked_does_not_matter():
    def response(instants) -> float:
        cell = filtered(4)
        cell._force = lambda: math.sin(3 * cell.world.time)
        for instant in instants:
            cell.clock.sleep_until(instant)
            cell.qualifier()
        return cell.floats(0x2000)[0]

    often = response(np.linspace(0, 5, 5001)[1:])
    assert response([5.0]) == pytest.approx(often, abs=5e-4)
    assert response([4.99, 5.0]) == pytest.approx(often, abs=5e-4)
    assert response([0.3, 1.7, 5.0]) == pytest.approx(often, abs=5e-4)


@cases("setting", range(9))
def test_a_long_silence_costs_no_more_than_a_short_one(setting):
    cell = filtered(setting)
    cell.load.splits = 0
    cell.clock.sleep(1e6)
    cell.qualifier()
    assert cell.load.splits < 80


@cases("setting", [0, 7])
def test_noise_is_that_of_the_setting(setting):
    cell = filtered(setting, noise=0.01, seed=11)
    readings = []
    for _ in range(1000):
        cell.clock.sleep(4 * reading_interval(setting))
        readings.append(cell.floats(0x2000)[0])
    assert np.std(readings) == pytest.approx(0.01 * math.sqrt(CUTOFF_HZ[setting] / 17), rel=0.07)
    assert abs(np.mean(readings)) < 4 * np.std(readings) / math.sqrt(1000)


# Motion detection


def test_still_after_the_no_motion_time():
    cell = Cell()
    cell.rest(5.0)
    assert cell.qualifier() == 0x0010
    cell.load.force = 5.0025
    cell.clock.sleep(0.3)
    assert cell.qualifier() == 0x0000
    cell.clock.sleep(0.5)
    assert cell.qualifier() == 0x0000
    cell.clock.sleep(0.4)
    assert cell.qualifier() == 0x0010


# The wire

READ = bytes.fromhex("01 03 35 00 00 05 8A 05")
READ_REPLY = bytes.fromhex("01 03 0A 41 40 00 00 41 38 00 00 00 30 E8 A4")
TARE = bytes.fromhex("01 06 20 61 00 08 D2 12")


def vector_cell() -> Cell:
    """12.0 gross, 11.5 net, still, tare set."""
    cell = Cell()
    cell.rest(0.5)
    cell.write_registers(0x2061, [0x08])
    cell.rest(12.0)
    return cell


EXCHANGES = [
    (READ, READ_REPLY),
    (sealed("01 04 35 00 00 05"), sealed("01 04 0A 41 40 00 00 41 38 00 00 00 30")),
    (sealed("01 06 20 61 00 04"), sealed("01 06 20 61 00 04")),  # reset tare
    (sealed("01 03 20 60 00 01"), sealed("01 03 02 00 10")),
    (TARE, TARE),
    (sealed("01 03 20 60 00 01"), sealed("01 03 02 00 30")),
    (sealed("01 10 21 06 00 02 04 00 00 00 05"), sealed("01 10 21 06 00 02")),  # filter 5
    (sealed("01 03 21 06 00 02"), sealed("01 03 04 00 00 00 05")),
    (sealed("01 06 20 61 00 08"), sealed("01 86 04")),  # not still, as the filter has just begun anew
    (sealed("01 03 20 04 00 01"), sealed("01 83 02")),
    (sealed("01 03 20 00 00 7E"), sealed("01 83 03")),
    (sealed("01 10 21 06 00 02 04 00 00 00 09"), sealed("01 90 03")),
    (sealed("01 10 21 06 00 02 02 00 00"), sealed("01 90 03")),
    (sealed("01 01 00 00 00 01"), sealed("01 81 01")),
    (sealed("01 2B 0E 01 00"), sealed("01 AB 01")),
    (sealed("01 11"), sealed("01 91 01")),
    (sealed("02 03 35 00 00 05"), b""),  # another device's
    (sealed("02 10 21 06 00 02 04 00 00 00 01"), b""),
    (sealed("00 03 35 00 00 05"), b""),  # nobody answers a broadcast
    (sealed("00 10 21 06 00 02 04 00 00 00 02"), b""),
    (sealed("01 03 21 06 00 02"), sealed("01 03 04 00 00 00 02")),  # but it was carried out
]


def test_exchanges():
    server = ModbusRtuServer(vector_cell())
    for sent, reply in EXCHANGES:
        assert server.receive(sent).hex(" ") == reply.hex(" "), sent.hex(" ")


@given(cuts=st.lists(st.integers(0, 250), max_size=25))
def test_requests_may_come_in_any_pieces(cuts):
    server = ModbusRtuServer(vector_cell())
    data = b"".join(sent for sent, _ in EXCHANGES)
    edges = sorted({0, len(data), *(cut for cut in cuts if cut < len(data))})
    replies = b"".join(server.receive(data[a:b]) for a, b in pairwise(edges))
    assert replies == b"".join(reply for _, reply in EXCHANGES)


@cases(
    "garbage",
    [
        b"\x00",
        b"\xff" * 1000,
        READ[:-1],  # a request without its end
        READ[:3],
        READ[:-2] + b"\x00\x00",  # with a wrong CRC
        READ_REPLY[:-1] + b"\x00",
        sealed("05 03 0A 41 40 00 00 41 38 00 00 00 30"),  # another device's reply
        bytes.fromhex("01 10 21 06 00 7B F6"),  # announces 246 bytes
        bytes.fromhex("01 10 21 06 00 7B FF"),
        bytes.fromhex("01 17 21 06 00 01 21 06 00 01 F0"),
        b"\x01",
        b"\x01\x03",
        b"\x01\x99" * 300,
    ],
)
def test_the_request_behind_garbage_is_answered(garbage):
    server = ModbusRtuServer(vector_cell())
    assert server.receive(garbage) == b""
    assert server.receive(READ) == READ_REPLY
    assert server.receive(READ) == READ_REPLY
    assert server.receive(garbage + READ + READ) == 2 * READ_REPLY


@given(garbage=st.binary(max_size=600), pieces=st.lists(st.integers(1, 50), max_size=20))
def test_any_garbage_is_passed_over(garbage, pieces):
    server = ModbusRtuServer(vector_cell())
    position = 0
    for piece in pieces:
        server.receive(garbage[position : position + piece])
        position += piece
    server.receive(garbage[position:])
    assert server.receive(READ)[-15:-12] == READ_REPLY[:3]
    assert len(server._received) < LONGEST_FRAME


def test_a_defect_of_the_instrument_is_a_device_failure(caplog):
    cell = Cell()

    def broken() -> float:
        raise ZeroDivisionError

    cell._force = broken
    cell.clock.sleep(1.0)
    assert ModbusRtuServer(cell).receive(READ) == sealed("01 83 04")
    assert "the emulated instrument failed" in caplog.text
