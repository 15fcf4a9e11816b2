"""Signals, ranges, read-back and arrival of instruments that the rig file describes."""

import pytest
from cases import cases

from bench.base import DeviceError, DeviceRestartedError
from bench.devices import QuantityTable, TargetTable
from drivers.device import attempt, watchdog_field
from drivers.quantities import arrival_of, check_ranges, check_read_back, identity_of, output_lost, signals_of


def target(**changes):
    return TargetTable(**{"unit": "V", "limits": (0.0, 10.0), "resolution": 0.25} | changes)


def test_signals_are_named_after_their_tables():
    tables = {
        "coil_current": QuantityTable(unit="A", precision=2),
        "field": QuantityTable(unit="V", description="Hall"),
    }
    assert [(each.name, each.unit, each.description, each.precision) for each in signals_of(tables)] == [
        ("coil_current", "A", "coil current", 2),
        ("field", "V", "Hall", 3),
    ]


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


def test_arrival_is_within_the_tolerance_and_asked_for_in_steps(clock):
    table = target(arrival={"signal": "voltage", "tolerance": 0.5, "timeout": 2.0})
    readings, times = [5.6, 5.6, 5.6, 5.5], []

    def read():
        times.append(clock.now())
        return {"voltage": readings.pop(0)}

    arrival_of("supply", clock, table, 5.0, read).wait()
    assert times == pytest.approx([0.0, 0.1, 0.2, 0.3])
    with pytest.raises(DeviceError, match="did not arrive within 2 s"):
        arrival_of("supply", clock, table, 5.0, lambda: {"voltage": 4.4}).wait()
    assert arrival_of("supply", clock, target(), 5.0, dict).done


@cases(
    ("answer", "fields"),
    [
        ("ACME,PSU-1,42,2.0", ("ACME", "PSU-1", "42", "2.0")),
        ("ACME, PSU-1 ,,2.0,beta", ("ACME", "PSU-1", "unknown", "2.0,beta")),
        ("ACME", ("ACME", "unknown", "unknown", "unknown")),
        ("", ("unknown", "unknown", "unknown", "unknown")),
    ],
)
def test_identity(answer, fields):
    found = identity_of(answer)
    assert (found.maker, found.model, found.serial_number, found.firmware) == fields


def test_every_step_is_tried():
    done = []

    def fail():
        done.append("failed")
        raise DeviceError("supply", "no")

    failures = attempt(lambda: done.append(1), fail, lambda: done.append(2))
    assert done == [1, "failed", 2]
    assert [str(each) for each in failures] == ["supply: no"]


def test_the_watchdog_of_an_instrument_may_be_off():
    field = watchdog_field(2.5, 10.0, "it stops")
    assert field.default == 2.5
    assert str(field.metadata) == "[Ge(ge=0.0), Le(le=10.0)]"
