"""A device that falls silent keeps its line for a bounded time, and the interlocks of its neighbours act in time."""

from pathlib import Path

import pytest

from bench.base import DeviceConnectionError, InterlockError, VirtualClock
from bench.execution.station.local import LocalStation
from bench.rig import Look, Rig, load_rig

BUSES = str(Path(__file__).parent / "buses.toml")
TEXT = str(Path(__file__).parents[3] / "examples" / "shared-line.toml")
LOOKS = 5.0
"""Looks at the interlocks, Hz."""
ON_THE_WIRE = 0.1
"""Time that the messages of a look take on their lines, s."""


class Watched(VirtualClock):
    """A virtual clock on which something happens at an instant, and which notes when something has become true."""

    def __init__(self):
        super().__init__()
        self.events = []
        self.found = lambda: False
        self.found_at = None

    def sleep(self, seconds):
        self.sleep_until(self.now() + max(seconds, 0.0))

    def sleep_until(self, instant):
        while self.events and self.events[0][0] <= instant:
            at, event = self.events.pop(0)
            super().sleep_until(at)
            event()
        if self.found_at is None and self.found():
            self.found_at = self.now()
        super().sleep_until(instant)


@pytest.fixture
def rig(request):
    path, changes = request.param if isinstance(request.param, tuple) else (request.param, {})
    with Rig(load_rig(path, changes), Watched(), 0) as rig:
        yield rig
        for name in rig.devices:
            rig.laboratory.mend(name)


def cost(rig, call):
    """Return how long a call of a silent device takes, s."""
    before = rig.clock.now()
    with pytest.raises(DeviceConnectionError):
        call()
    return rig.clock.now() - before


@pytest.mark.parametrize(
    ("rig", "name", "attempt"),
    [
        (BUSES, "load1", 1.0),
        (BUSES, "heater1", 1.0),
        (BUSES, "servo1", 1.0),
        (BUSES, "tec1", 1.0),
        (BUSES, "supply1", 1.0),
        # The line rests until no late answer can come.
        (TEXT, "supply", 3.0),
        (TEXT, "room", 3.0),
    ],
    indirect=["rig"],
)
def test_a_silent_device_keeps_its_line_for_its_turn_once_and_then_for_one_request(rig, name, attempt):
    device = rig.devices[name]
    device.glance()
    rig.laboratory.inject(f"{name}.unplug")
    settings = next(entry.settings for entry in rig.file.devices if entry.name == name)
    assert cost(rig, device.glance) < settings.longest_turn + 0.5 * settings.timeout
    for _ in range(3):
        assert cost(rig, device.reconnect) < attempt * settings.timeout + 0.02
    rig.laboratory.mend(name)
    device.reconnect()
    device.glance()
    # It has its repetitions again.
    repeats = device.repeats
    rig.laboratory.inject(f"{name}.drop", {"probability": 1.0, "count": 1}, duration=1e6)
    device.glance()
    assert device.repeats == repeats + 1


def look_on(station):
    """Look until something goes wrong."""
    while station.look(Look.GLANCE):
        station.sleep_until(station.clock.now() + 0.1)


def load_a_cell(rig):
    rig.laboratory.operate("load2", 45.0)


def heat_a_plate(rig):
    rig.laboratory.loads["tec2"].rest += 1.0


def overheat_the_plate(rig):
    rig.laboratory.plant.set("supply_output", 14.0)


@pytest.mark.parametrize("known", [False, True], ids=["as it falls silent", "known to be silent"])
@pytest.mark.parametrize(
    ("rig", "silent", "setpoints", "cross"),
    [
        pytest.param(BUSES, "load1", {"tec1": 0.2}, load_a_cell, id="Modbus"),
        pytest.param(
            (BUSES, {"interlocks": '[{signal = "tec2_temperature", high = 37.5}]'}),
            "tec1",
            {"tec2": 0.2},
            heat_a_plate,
            id="MeCom",
        ),
        pytest.param(
            (TEXT, {"emulation.signals.plate_temperature.time_constant": "0"}),
            "room",
            {"supply": 5.0},
            overheat_the_plate,
            id="text",
        ),
    ],
    indirect=["rig"],
)
def test_an_interlock_acts_in_time_beside_a_silent_neighbour(rig, silent, setpoints, cross, known):
    station, clock = LocalStation(rig, LOOKS), rig.clock
    station.apply(setpoints)
    station.look(Look.GLANCE)
    (driven,) = setpoints
    settings = next(entry.settings for entry in rig.file.devices if entry.name == silent)
    began = clock.now()
    crossed = began + (1.9 if known else 0.2)
    clock.events = [(began + 0.15, lambda: rig.laboratory.inject(f"{silent}.unplug")), (crossed, lambda: cross(rig))]

    def is_off():
        return clock.now() > crossed and rig.laboratory.truth()[f"{driven}_output"].value == 0.0

    clock.found = is_off
    with pytest.raises(InterlockError):
        look_on(station)
    acted = clock.now() - crossed
    turn = 3.0 * settings.timeout if known else settings.longest_turn
    assert acted < 1.0 / LOOKS + turn + ON_THE_WIRE
    states = station.end()
    clock.sleep(0.1)
    assert {name: state for name, state in states.items() if state != "safe" and name != silent} == {}
    # Whether the silent one is known to be silent when the run ends, or tries first to become safe itself.
    trials = 0.0 if known else 8.0 * settings.timeout
    assert clock.found_at - crossed < 1.0 / LOOKS + turn + trials + 2.0 * ON_THE_WIRE
