"""The right instrument: model and serial number of the rig file are compared with those that the instrument says."""

from pathlib import Path

import pytest

from bench.base import ConfigurationError, DeviceConnectionError, VirtualClock
from bench.rig import Rig, load_rig
from sim_devices import protocol_emulated
from sim_devices.wire import WireServer

EXAMPLE = str(Path(__file__).parents[3] / "examples" / "bench-supply.toml")
RIGS = ["vo2", "sma", "hybrid", EXAMPLE]
SECOND = """
extends = "bench-supply.toml"

[devices.supply]
serial_number = "4711"

[devices.second]
driver = "scpi-sensor"
port = "emulated://second"
identity = "EXAMPLE,PS-3005,{any}"
serial_number = 4712

[devices.second.signals.current]
query = "MEAS:CURR?"
unit = "A"

[emulation.signals.second_current]
expression = "supply_voltage / resistance"
constants = { resistance = "10 ohm" }
"""


@pytest.mark.parametrize("name", RIGS)
def test_every_driver_knows_its_instrument_or_says_that_it_cannot(name):
    with Rig(load_rig(name), VirtualClock(), seed=0) as rig:
        for entry in rig.file.devices:
            identity = rig.devices[entry.name].identity

            def connect(entry=entry, **changes):
                settings = entry.settings.model_copy(update=changes)
                entry.driver.connect(entry.name, settings, rig.clock).close()

            connect(model=identity.model)
            with pytest.raises(DeviceConnectionError, match=rf"{entry.name}: is .*, expected model OTHER"):
                connect(model="OTHER")
            if identity.tells_serial_number:
                connect(serial_number=f" {identity.serial_number} ")
                for other in (f"{identity.serial_number}0", f"0{identity.serial_number}"):
                    with pytest.raises(DeviceConnectionError) as raised:
                        connect(serial_number=other)
                    assert f"serial number {identity.serial_number}" in str(raised.value)
                    assert f"expected serial number {other}" in str(raised.value)
            else:
                with pytest.raises(DeviceConnectionError, match="does not tell its serial number"):
                    connect(serial_number="1")


class Stranger(WireServer):
    """Another instrument, which has an answer of its own to everything."""

    def __init__(self, answer):
        self.answer = answer

    def receive(self, data):  # noqa: ARG002
        return self.answer


@pytest.mark.parametrize(
    ("name", "device"),
    [("vo2", "tec"), ("sma", "load_cell"), ("sma", "stage"), ("sma", "supply"), (EXAMPLE, "supply")],
)
def test_another_instrument_that_answers_in_its_own_way_is_no_silence(name, device):
    (entry,) = (entry for entry in load_rig(name).devices if entry.name == device)
    clock = VirtualClock()
    for answer in (b"ERR 12\r", b""):
        settings = entry.settings.model_copy(
            update={"port": protocol_emulated.register("stranger", Stranger(answer), clock)}
        )
        try:
            with pytest.raises(DeviceConnectionError) as raised:
                entry.driver.connect(device, settings, clock)
        finally:
            protocol_emulated.unregister("stranger")
        assert ("another instrument answers there" in str(raised.value)) == bool(answer)
        assert not answer or "ERR" in str(raised.value)


@pytest.fixture
def two(tmp_path):
    (tmp_path / "bench-supply.toml").write_text(Path(EXAMPLE).read_text())
    (tmp_path / "rig.toml").write_text(SECOND)
    return str(tmp_path / "rig.toml")


def test_two_equal_instruments_whose_ports_are_swapped_are_found_before_anything_moves(two):
    with Rig(load_rig(two), VirtualClock(), seed=0) as rig:
        supply, second = (entry for entry in rig.file.devices if entry.name in ("supply", "second"))
        assert rig.devices["second"].identity.serial_number == "4712"
        rig.devices["supply"].set(5.0)
        swapped = supply.settings.model_copy(update={"port": second.settings.port})
        with pytest.raises(DeviceConnectionError, match=r"serial number 4712, .* expected serial number 4711"):
            supply.driver.connect("supply", swapped, rig.clock)
        # What has to be made safe is made safe, whichever instrument it is.
        wrong = supply.settings.model_copy(update={"serial_number": "1"})
        assert rig.laboratory.instruments["supply"].on
        supply.driver.rescue("supply", wrong, rig.clock)
        assert not rig.laboratory.instruments["supply"].on


@pytest.mark.parametrize("value", [True, [1]])
def test_a_serial_number_is_a_text_or_a_number(two, value):
    with pytest.raises(ConfigurationError, match=r"devices\.supply\.serial_number"):
        load_rig(two, {"devices.supply.serial_number": value})
