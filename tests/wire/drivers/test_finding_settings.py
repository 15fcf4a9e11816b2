"""An instrument at another speed or parity, or behind an adapter that echoes, is found with what its line needs.

The line is emulated in this process, one for each dialect; all ports that are asked are on the virtual clock.
"""

from pathlib import Path
from typing import ClassVar

import pytest

from bench.base import VirtualClock
from bench.rig import load_rig
from drivers.finding.places import answers, placements
from drivers.finding.ports import Port
from sim_devices import protocol_emulated

DESK = str(Path(__file__).with_name("desk.toml"))
DIALECTS = {
    "tec_a": ("baudrate",),
    "supply": ("baudrate",),
    "load_cell": ("baudrate", "parity"),
    "stage": ("baudrate",),
    "heater": ("baudrate", "parity"),
}
"""Settings of the line that a test sets wrong, by instrument: MeCom, slcan, Modbus RTU, Dynamixel, text."""


class AtItsSettings(protocol_emulated.Serial):
    """A line whose instruments hear what is sent at their own speed and parity; an adapter echoes at any."""

    own: ClassVar = {}

    def _answer(self, sent):
        if all(getattr(self, key) == value for key, value in self.own.items()):
            return super()._answer(sent)
        # What arrives at another speed or parity is other bytes.
        super()._answer(bytes(0x80 | each for each in sent))
        return sent if "echo+" in self._name else b""


@pytest.fixture
def desk(monkeypatch, request):
    """Make the instruments of the desk with the speed and parity that they have; return what finds one of them."""
    monkeypatch.setattr(protocol_emulated, "Serial", AtItsSettings)
    file = load_rig(DESK, getattr(request, "param", {}))
    clock = VirtualClock()
    laboratory = file.laboratory(file.laboratory_settings, clock, 0)
    addresses = [protocol_emulated.register(name, server, clock) for name, server in laboratory.servers.items()]

    def find(name, *, echo=False, **others):
        """Ask for one device whose instrument has other settings than the rig file."""
        settings = next(entry.settings for entry in file.devices if entry.name == name)
        monkeypatch.setattr(
            AtItsSettings,
            "own",
            {key: others.get(key, getattr(settings, key, "N")) for key in ("baudrate", "parity")},
        )
        known = [Port(f"emulated://echo+{name}" if echo else f"emulated://{name}")]
        begin = clock.now()
        found = [each for each in answers(file, known) if each.device == name]
        assert clock.now() - begin < LONGEST
        return found, {each.device: each for each in placements(file, found, known)}[name]

    find.laboratory = laboratory
    yield find
    for address in addresses:
        protocol_emulated.unregister(address)


CHANGES = {"baudrate": 38400, "parity": "O"}
LONGEST = 10.0
"""Time that a desk may take, s, whose ports are asked at the same time."""


@pytest.mark.parametrize("echo", [False, True], ids=["", "echo"])
@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        (name, wrong)
        for name, settings in DIALECTS.items()
        for wrong in ((), ("baudrate",), ("parity",), ("baudrate", "parity"))
        if set(wrong) <= set(settings)
    ],
)
def test_an_instrument_is_found_with_the_settings_of_its_line(desk, name, wrong, echo):
    ((answer,), placed) = desk(name, echo=echo, **{key: CHANGES[key] for key in wrong})
    expected = {key: CHANGES[key] for key in wrong} | ({"echo": True} if echo else {})
    assert dict(answer.changed) == expected
    assert all(f"answers with {key} = {value}" in placed.remark for key, value in expected.items())


@pytest.mark.parametrize(
    ("desk", "name"),
    [*(({}, name) for name in DIALECTS), ({"devices.heater.identity": '"{any}"'}, "heater")],
    indirect=["desk"],
)
def test_an_adapter_that_echoes_is_no_instrument(desk, name):
    desk.laboratory.inject(f"{name}.unplug")
    found, placed = desk(name, echo=True)
    assert not found
    assert not placed.is_settled
    desk.laboratory.mend(name)


@pytest.mark.parametrize("desk", [{"devices.heater.identity_query": '""'}], indirect=True)
def test_an_instrument_without_a_question_for_its_identity_is_found_nowhere(desk):
    found, placed = desk("heater")
    assert not found
    assert "identity_query" in placed.remark
