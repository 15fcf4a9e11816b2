"""The true state of a laboratory: looking at it changes nothing."""

import math

import pytest
from cases import cases

from bench.base import VirtualClock
from bench.rig import Rig, load_rig, packaged_rigs

RIGS = sorted(name for name in packaged_rigs() if "hardware" not in name)


@cases("name", RIGS)
def test_it_feeds_no_watchdog(name):
    """An output that its instrument switches off without its host goes off as well while somebody looks."""
    rig = Rig(load_rig(name), VirtualClock(), seed=0)
    try:
        watched = {
            each: device.watchdog for each, device in rig.actuators.items() if device.heats and device.watchdog
        }
        for each in watched:
            limits = rig.actuators[each].limits
            rig.actuators[each].set(0.75 * limits.low + 0.25 * limits.high)
        left = on = outputs(rig, watched)
        end = rig.clock.now() + 3.0 * max(watched.values(), default=0.0)
        while rig.clock.now() < end:
            rig.clock.sleep(0.05)
            left = outputs(rig, watched)
        # Not every output is named after its device.
        assert on or name not in ("vo2", "hybrid")
        assert not left
    finally:
        rig.close()


def outputs(rig, devices):
    """Return the true outputs of some devices that are on."""
    truth = rig.laboratory.truth()
    return {
        name
        for name, each in truth.items()
        if each.is_output and name.startswith(tuple(devices)) and not math.isclose(each.value, 0.0, abs_tol=1e-6)
    }


SENSORS = [
    ("vo2", "psd", "tip_deflection", "deflection_shown"),
    ("hybrid", "displacement_sensor", "deflection", "displacement_shown"),
    ("hybrid", "tip_thermistor", "tip_temperature", "tip_shown"),
    ("sma", "force_sensor", "force", "force_shown"),
    ("mckibben", "position_sensor", "position", "position_shown"),
    ("coiled-polymer", "position_sensor", "position", "position_shown"),
]


@cases(("name", "table", "quantity", "as_shown"), SENSORS)
@cases("sensors", ["data-sheet", "ideal"])
def test_sensors_have_the_errors_of_their_data_sheets_or_none(name, table, quantity, as_shown, sensors):
    rig = Rig(load_rig(name, {"emulation.sensors": sensors}), VirtualClock(), seed=0)
    try:
        truth = rig.laboratory.truth()
        assert (truth[as_shown].value == truth[quantity].value) == (sensors == "ideal")
    finally:
        rig.close()


@cases(("name", "table", "quantity", "as_shown"), SENSORS)
def test_it_has_the_true_quantity_beside_the_one_that_a_sensor_shows(name, table, quantity, as_shown):
    errors = {"gain_error": "0.01", "offset": "1e-6", "nonlinearity": "0"}
    rig = Rig(
        load_rig(name, {f"emulation.{table}.{key}": value for key, value in errors.items()}), VirtualClock(), seed=0
    )
    try:
        truth = rig.laboratory.truth()
        assert truth[as_shown].value == pytest.approx(1.01 * truth[quantity].value + 1e-6, rel=1e-12)
        assert truth[as_shown].unit == truth[quantity].unit
    finally:
        rig.close()
