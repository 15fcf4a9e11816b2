"""Signals, ranges, read-back and arrival of instruments that the rig file describes."""

import pytest

from bench.base import DeviceError, DeviceRestartedError
from bench.devices import QuantityTable, TargetTable
from drivers.quantities import check_ranges, check_read_back, output_lost


def target(**changes):
    return TargetTable(**{"unit": "V", "limits": (0.0, 10.0), "resolution": 0.25} | changes)


def test_readings_at_the_ends_of_their_range_are_good():
    tables = {"voltage": QuantityTable(unit="V", limits=(-1.0, 2.0)), "free": QuantityTable(unit="A")}
    for value in (-1.0, 2.0):
        check_ranges("meter", tables, {"voltage": value, "free": 1e9})
    for value in (-1.001, 2.001, float("nan")):
        with pytest.raises(DeviceError, match=r"^meter: voltage is \S+ V, outside of -1 to 2 V; check instrument"):
            check_ranges("meter", tables, {"voltage": value, "free": 0.0})


def test_a_set_point_may_be_read_back_as_far_off_as_its_resolution():
    for found in (4.75, 5.25):
        check_read_back("supply", target(), 5.0, found)
    for found in (4.749, 5.251, float("nan")):
        with pytest.raises(DeviceError, match=r"reads its set-point back as \S+ V, not 5 V; was it restarted"):
            check_read_back("supply", target(), 5.0, found)
    with pytest.raises(DeviceError, match=r"not 5 V \(-222\); was"):
        check_read_back("supply", target(), 5.0, 9.0, "-222")
    # A thousandth of the distance of the limits, unless the rig file says.
    assert target(resolution=None).tolerance == 0.01


def test_an_output_that_is_off():
    lost = output_lost("supply", setpoint_lost=True, reported="-222")
    assert isinstance(lost, DeviceRestartedError)
    assert str(lost).endswith("it has restarted (-222); connect again")
    off = output_lost("supply", setpoint_lost=False)
    assert not isinstance(off, DeviceRestartedError)
    assert str(off).endswith("a restart, or another program")
