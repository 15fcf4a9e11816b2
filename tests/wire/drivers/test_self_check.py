"""What the drivers find when they compare their instrument with the rig file: `self_check`, for `bench rig check`."""

import pytest

from bench.base import VirtualClock
from bench.rig import Rig, load_rig


@pytest.fixture
def opened():
    """Open a rig on the virtual clock."""
    rigs = []

    def open_rig(name):
        rigs.append(Rig(load_rig(name), VirtualClock(), seed=0))
        return rigs[-1]

    yield open_rig
    for rig in rigs:
        rig.close()


def advised(device):
    return {finding.subject: finding.text for finding in device.self_check() if finding.advice}


def connect_again(rig, name, **changed):
    """Connect to the instrument of a device once more, as another program does."""
    device = rig.devices[name]
    settings = device._settings.model_copy(update=changed)
    return type(device).connect(name, settings, rig.clock)


@pytest.mark.parametrize("name", ["vo2", "hybrid", "sma"])
def test_a_healthy_rig_and_nothing_moves(opened, name):
    rig = opened(name)
    before = rig.laboratory.truth()
    for device in rig.devices.values():
        assert advised(device) == {}
    after = rig.laboratory.truth()
    outputs = [key for key, value in before.items() if value.is_output]
    assert outputs
    assert [after[key].value for key in outputs] == [before[key].value for key in outputs]


def test_a_watchdog_that_another_program_switched_off(opened):
    rig = opened("sma")
    connect_again(rig, "fan").close()
    assert advised(rig.devices["fan"]) == {"watchdog read back": "DIO0: does not switch it off"}


def test_a_watchdog_of_another_time(opened):
    rig = opened("sma")
    fan = rig.devices["fan"]
    fan._output.unguard()
    connect_again(rig, "fan", watchdog=60)
    assert advised(fan) == {"watchdog read back": "DIO0: 60 s"}
