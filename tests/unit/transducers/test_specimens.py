"""Specimens of sensors: what data sheets leave open is drawn once, and one key makes all of them ideal."""

import numpy as np
import pytest
from cases import cases

from sim_devices.transducers import data_sheets
from sim_devices.transducers.imperfect import SensorErrors
from sim_devices.transducers.specimens import DataSheet, SensorSettings

SHEET = DataSheet((0.0, 2.0), SensorErrors(nonlinearity=1e-3, offset=0.5), gain_tolerance=0.02, offset_tolerance=0.1)


class Settings(SensorSettings):
    probe: SensorErrors = SensorErrors()


def test_a_specimen_is_its_seed_s_and_its_place_s():
    assert SHEET.specimen(3, "probe") == SHEET.specimen(3, "probe")
    assert SHEET.specimen(3, "probe") != SHEET.specimen(4, "probe")
    assert SHEET.specimen(3, "probe") != SHEET.specimen(3, "other")


def test_specimens_fill_their_tolerances():
    found = [SHEET.specimen(seed, "probe") for seed in range(300)]
    for drawn, middle, tolerance in (
        ([each.gain_error for each in found], 0.0, 0.02),
        ([each.offset for each in found], 0.5, 0.1),
    ):
        deviations = (np.array(drawn) - middle) / tolerance
        assert np.abs(deviations).max() <= 1.0
        # Uniform: a standard deviation of 1/sqrt(3).
        assert np.std(deviations) == pytest.approx(3**-0.5, rel=0.1)
        assert abs(np.mean(deviations)) < 0.1
    assert {each.nonlinearity for each in found} == {1e-3}


def test_what_is_given_replaces_what_the_data_sheet_states():
    given = Settings(probe={"gain_error": 0.0, "lag": 0.5}).errors_of("probe", SHEET)
    drawn = SHEET.specimen(0, "probe")
    assert given == drawn.model_copy(update={"gain_error": 0.0, "lag": 0.5})
    assert drawn.gain_error != 0.0


def test_one_key_makes_sensors_ideal():
    assert Settings(sensors="ideal").errors_of("probe", SHEET) == SensorErrors()
    assert Settings(sensors="ideal", probe={"lag": 0.5}).errors_of("probe", SHEET) == SensorErrors(lag=0.5)


def test_a_characteristic_counts_from_the_zero_of_its_signal():
    settings = Settings(probe={"offset": 0.0, "gain_error": 0.0})
    from_zero, from_middle = (settings.characteristic_of("probe", SHEET, zero) for zero in (0.0, 1.0))
    assert from_zero.value(1.0) == pytest.approx(1.0, abs=1e-12)
    assert from_zero.value(1.6) - 1.6 == pytest.approx(from_middle.value(0.6) - 0.6, abs=1e-12)
    assert abs(from_zero.value(1.6) - 1.6) > 1e-4


@cases("name", [name for name, sheet in vars(data_sheets).items() if isinstance(sheet, type(SHEET))])
def test_errors_of_data_sheets_are_small_and_the_quantity_can_be_found_behind_them(name):
    sheet = getattr(data_sheets, name)
    low, high = sheet.range
    quantities = np.linspace(low, high, 101)
    for seed in range(20):
        sensor = Settings(sensor_seed=seed).characteristic_of("probe", sheet)
        shown = sensor.course(quantities)
        assert 0.0 < np.abs(shown - quantities).max() < 0.01 * (high - low)
        assert sensor.quantities(shown) == pytest.approx(quantities, abs=1e-9 * (high - low))
