"""The DAD 141.1 driver on a line that spoils its replies: a reading is of the present, or there is none."""

import struct

import numpy as np
import pytest
from faulty_line import KINDS, FaultyLine
from still_plant import Still

from bench.base import DeviceConnectionError, VirtualClock
from drivers.flintec_dad141 import FlintecDAD141
from sim_devices import protocol_emulated
from sim_devices.instruments.flintec_dad141 import EmulatedDAD141
from sim_devices.wire.modbus_rtu import ModbusRtuServer
from sim_devices.world import World

TIMEOUT = 0.2


class Counting:
    """A DAD 141.1 whose weight is the number of readings that it has given, with the time of each."""

    def __init__(self, instrument, clock):
        self.instrument = instrument
        self.clock = clock
        self.given = []

    def read_registers(self, address, count):
        words = self.instrument.read_registers(address, count)
        if address == 0x3500 and count == 5:
            self.given.append(self.clock.now())
            weight = struct.unpack(">2H", struct.pack(">f", len(self.given) - 1))
            return [*weight, *weight, words[4]]
        return words

    def write_registers(self, address, values):
        self.instrument.write_registers(address, values)


@pytest.fixture
def clock():
    return VirtualClock()


@pytest.fixture
def counting(clock):
    instrument = EmulatedDAD141(
        "load", World(Still(), clock), lambda: 0.0, rng=np.random.default_rng(3), zero_tracking=0
    )
    return Counting(instrument, clock)


@pytest.mark.parametrize(
    ("kinds", "overtaking", "calls"),
    [*(((kind,), False, 200) for kind in KINDS), (KINDS, False, 600), (("drop", "corrupt", "delay"), True, 600)],
    ids=[*KINDS, "all", "overtaking"],
)
@pytest.mark.slow
def test_a_reading_was_taken_during_its_call(counting, clock, kinds, overtaking, calls):
    line = FaultyLine(
        ModbusRtuServer(counting),
        clock,
        np.random.default_rng(1),
        kinds=kinds,
        share=0.0,
        latest=2.8 * TIMEOUT,
        overtaking=overtaking,
    )
    port = protocol_emulated.register("load", line, clock)
    cell = FlintecDAD141.connect(
        "load", FlintecDAD141.Settings(port=port, timeout=TIMEOUT, force_limits=(-1e6, 1e6)), clock
    )
    pauses = np.random.default_rng(2)
    line.share = 0.4
    taken, wrong = 0, []
    try:
        for _ in range(calls):
            clock.sleep(pauses.choice([0.0, 0.01, 0.25]))
            begin = clock.now()
            try:
                (value,) = cell.glance().values()
            except DeviceConnectionError:
                continue
            taken += 1
            if not (value.is_integer() and begin <= counting.given[int(value)]):
                wrong.append(value)
        line.share = 0.0
        clock.sleep(1.0)
        assert cell.glance()["load_force"] == len(counting.given) - 1
    finally:
        protocol_emulated.unregister("load")
    assert not wrong
    assert taken > calls / 2
    if kinds != ("double",):
        assert cell.repeats > 0.1 * line.spoilt
