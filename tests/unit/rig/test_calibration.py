"""Calibrations: found from readings beside a reference, kept in a file, and applied by a rig file that names it."""

import json
from datetime import date

import numpy as np
import pytest
from cases import cases

from bench.base import DataError, DeviceError
from bench.rig import Calibration, calibrate
from bench.rig.calibration import Calibrated, read_calibration

TEXTS = {
    "signal": "spot_position", "unit": "m", "serial_number": "7", "date": date(2026, 3, 1), "interval_days": 365,
    "reference": "interferometer", "reference_unit": "m", "reference_uncertainty": 1e-9,
}  # fmt: skip
RECORD = {
    **TEXTS, "date": "2026-03-01", "low": -1e-4, "high": 1e-4, "coefficients": [1e-6, 0.5e-6],
    "covariance": [[0, 0], [0, 0]], "degrees_of_freedom": 98, "repeatability": 1e-8, "readings": 100,
}  # fmt: skip


def sensed(truth):
    """A sensor of a range of ±1 that is off by 0.2 %, 3e-4, and 1e-3 of a wave that is no polynomial."""
    return 1.002 * truth + 3e-4 + 1e-3 * np.sin(4.5 * truth)


def swept(noise=1e-4, late=0.0, count=8000):
    rng = np.random.default_rng(0)
    times = np.arange(count) * 0.1
    truth = np.sin(2 * np.pi * times / 400.0)
    return times, sensed(np.sin(2 * np.pi * (times - late) / 400.0)) + noise * rng.standard_normal(count), truth


def test_it_finds_gain_offset_and_nonlinearity():
    times, readings, truth = swept()
    found = calibrate(readings, truth, times=times, **TEXTS)
    places = np.linspace(-0.98, 0.98, 201)
    errors = found.value(sensed(places)) - places
    # Before: up to 3 in a thousand. The stated accuracy is that of the errors that are left.
    assert np.sqrt(np.mean(errors**2)) < 1e-5
    assert np.sqrt(np.mean(errors**2)) < 3 * found.uncertainty < 5e-5
    assert found.repeatability == pytest.approx(1e-4, rel=0.05)
    assert found.lateness == 0.0
    assert (found.low, found.high) == (readings.min(), readings.max())


def test_accuracy_includes_that_of_the_reference_and_repeatability_does_not():
    times, readings, truth = swept()
    found = calibrate(readings, truth, times=times, **TEXTS | {"reference_uncertainty": 1e-3})
    assert found.uncertainty == pytest.approx(1e-3, rel=1e-3)
    assert found.repeatability == pytest.approx(1e-4, rel=0.05)


def test_it_finds_how_late_the_sensor_is():
    times, readings, truth = swept(late=0.3)
    found = calibrate(readings, truth, times=times, **TEXTS)
    assert found.lateness == pytest.approx(0.3, abs=0.01)
    assert abs(found.value(sensed(0.0))) < 2e-5


def test_few_weights_give_a_line():
    weights = np.array([0.98, 2.94, 4.90, 6.86, 8.82])
    noise = np.array([1, -1, 1, 0, -1]) * 1e-3
    found = calibrate(1.01 * weights + 0.05 + noise, weights, **TEXTS)
    assert len(found.coefficients) == 2
    assert found.value(1.01 * 5.0 + 0.05) == pytest.approx(5.0, abs=2e-3)


def angles_read(seed=0):
    """Ten readings of 0.01 mm at each of 13 angles, which are set to 0.005°."""
    rng = np.random.default_rng(seed)
    stated = np.arange(-3.0, 36.0, 3.0)
    true = stated + rng.uniform(-5e-3, 5e-3, stated.size)
    readings = 2e-6 * true + 1e-6 * np.sin(0.1 * true) + 1e-7
    return (readings[:, None] + 1e-8 * rng.standard_normal((13, 10))).ravel(), np.repeat(stated, 10)


def test_a_reference_in_another_unit_gives_values_in_that():
    readings, angles = angles_read()
    found = calibrate(readings, angles, **TEXTS | {"reference_unit": "°"})
    assert np.abs(found.value(readings) - angles).max() < 0.03
    inner = readings[10:-10]
    steps = found.value(inner + 1e-9) - found.value(inner - 1e-9)
    assert found.sensitivity(inner) == pytest.approx(steps / 2e-9, rel=1e-5)
    # Of one reading, not of the setting of an angle.
    assert found.repeatability == pytest.approx(1e-8 / 2e-6, rel=0.2)


def test_the_covariance_is_that_of_calibrations_made_again():
    """The settings of the angles are what differs: ten readings at one place are no ten places."""
    places = np.linspace(0.0, 6e-5, 7)
    made = [calibrate(*angles_read(seed), **TEXTS | {"reference_unit": "°"}) for seed in range(200)]
    stated = np.sqrt(np.mean([each.coefficient_uncertainty(places) ** 2 for each in made], axis=0))
    spread = np.std([each.value(places) for each in made], axis=0)
    assert stated == pytest.approx(spread, rel=0.25)


def test_the_scale_of_a_reference_counts_with_the_value():
    found = Calibration.model_validate(RECORD | {"reference_gain_uncertainty": 0.005})
    # 0.5 % of 0.1 mm at the ends, RMS over the range.
    assert found.uncertainty == pytest.approx(0.005 * 1e-4 / np.sqrt(3.0), rel=0.1)


@cases("readings", [[1.0, 2.0], [1.0, 1.0, 1.0], [1.0, np.nan, 2.0]])
def test_too_few_readings_are_refused(readings):
    with pytest.raises(DataError, match="readings at 3 values of the reference at least"):
        calibrate(readings, readings, **TEXTS)


def test_a_file_keeps_it(tmp_path):
    record = Calibration.model_validate(RECORD)
    record.save(tmp_path / "calibration.json")
    assert read_calibration(tmp_path / "calibration.json") == record


@cases(
    ("change", "words"),
    [
        ({"low": 1.0}, "expected low < high"),
        ({"version": 1}, "version"),
        ({"coefficients": []}, "coefficients"),
        ({"covariance": [[-1.0, 0.0], [0.0, 1.0]]}, "no variance below 0"),
        ({"covariance": [[1e-16, 2e-16], [2e-16, 1e-16]]}, "no variance below 0"),
        ({"covariance": [[1e-16, 2e-17], [0.0, 1e-16]]}, "symmetric"),
        ({"extra": 1}, "extra"),
    ],
)
def test_a_wrong_file_is_named(tmp_path, change, words):
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(RECORD | change))
    with pytest.raises(DataError, match=words) as caught:
        read_calibration(path)
    assert str(path) in str(caught.value)
    with pytest.raises(DataError, match="cannot be read"):
        read_calibration(tmp_path / "none.json")


def bound(**units):
    signal = Calibrated(kind="calibrated", source="spot_position", calibration=RECORD)
    return signal.bind("spot", units or {"spot_position": "m"})


def test_the_derived_signal_is_the_corrected_reading():
    derived = bound()
    assert derived.signal.unit == "m"
    assert derived.signal.accuracy == pytest.approx(1e-9)
    for value in (-1e-4, -3e-5, 0.0, 9e-5):
        expected = Calibration.model_validate(RECORD).value(value)
        assert derived.compute({"spot_position": value}) == pytest.approx(expected, abs=1e-18)
    # A little beyond, the correction at the end holds.
    assert derived.compute({"spot_position": 1.01e-4}) == pytest.approx(1.01e-4 + 1.5e-6)


def test_a_reading_beyond_the_calibration_is_an_error():
    with pytest.raises(DeviceError, match=r"spot: spot_position reads 0.000105 m, beyond its calibration of 2026"):
        bound().compute({"spot_position": 1.05e-4})


def test_another_unit_or_signal_is_refused():
    with pytest.raises(ValueError, match="is in V; the calibration is in m"):
        bound(spot_position="V")
    with pytest.raises(ValueError, match="is of spot_position; expected source = 'other'"):
        Calibrated(kind="calibrated", source="other", calibration=RECORD)
