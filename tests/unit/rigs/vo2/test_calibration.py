"""The detector of the cantilever calibrated by a mirror, or moved by a micrometer, through the command line."""

import json
from pathlib import Path

import numpy as np
import pytest

from bench.base import ConfigurationError, DataError, VirtualClock
from bench.record import Record
from bench.rig import Calibration, Rig, load_rig
from rigs.vo2.curvature import curvature_to_deflection
from sim_devices.transducers.data_sheets import PSD

CURVATURES = np.linspace(-100.0, 1840.0, 40)
DEFLECTIONS = curvature_to_deflection(CURVATURES, 300e-6)
CALIBRATED = """
extends = "vo2"
[derived.tip_angle]
kind = "calibrated"
source = "psd_position"
calibration = "psd.json"
[derived.curvature]
source = "tip_angle"
"""
MIRROR = (
    "--unit",
    "°",
    "--uncertainty",
    0.006,
    "--gain-uncertainty",
    1.3e-4,
    "--interval",
    365,
    "--name",
    "goniometer",
)


@pytest.fixture
def calibrated(bench, tmp_path):
    def calibrate(protocol, *options, **overrides):
        code, _, err = bench(
            "run", protocol, "--rig", "vo2", "--clock", "virtual", "--no-rehearse", "--out", tmp_path,
            "--json", tmp_path / "run.json",
            *(part for key, value in overrides.items() for part in ("--override", f"{key}={value}")),
        )  # fmt: skip
        assert code == 0, err
        run = json.loads((tmp_path / "run.json").read_text())["folder"]
        code, _, err = bench(
            "rig", "calibrate", run, "--sensor", "psd_position", *options, "--out", tmp_path / "psd.json"
        )
        assert (code, err) == (0, "")
        return Calibration.model_validate_json((tmp_path / "psd.json").read_text())

    return calibrate


def settings_of(seed):
    return load_rig("vo2", {"emulation.sensor_seed": str(seed)}).laboratory_settings


def shown_by(seed):
    """Return what the detector of a laboratory shows of the deflections, m."""
    return settings_of(seed).characteristic_of("psd", PSD).course(DEFLECTIONS)


def test_a_mirror_calibrates_nonlinearity_offset_and_lever(calibrated):
    seed = 3
    found = calibrated("calibration-mirror", *MIRROR, **{"emulation.sensor_seed": seed})
    curvatures = np.radians(found.value(shown_by(seed))) / 300e-6
    errors = curvatures - CURVATURES
    # Of the mirror's angle 0.01 degrees are 0.58 1/m, and the scale of its goniometer 0.4 1/m; before it is 12 1/m.
    assert np.abs(errors).max() < 1.3
    assert np.sqrt(np.mean(errors**2)) < 3 * np.radians(found.uncertainty) / 300e-6
    assert found.serial_number == "470012345"


def test_moving_the_detector_leaves_the_gain_of_the_lever(calibrated):
    stage = ("--uncertainty", 6e-9, "--gain-uncertainty", 0.0029, "--interval", 365)
    found = calibrated("calibration-detector", *stage, **{"emulation.sensor_seed": 3})
    gain = 1.0 + settings_of(3).errors_of("psd", PSD).gain_error
    left = found.value(shown_by(3)) - gain * DEFLECTIONS
    assert np.abs(left).max() < 50e-9
    # As the uncertainty says, which is that of the lever.
    assert np.abs((gain - 1.0) * DEFLECTIONS).max() > 100e-9
    assert 100e-9 < found.uncertainty < 200e-9


def test_a_calibrated_rig_and_the_one_message_for_each_calibration_that_does_not_fit(bench, tmp_path, calibrated):
    found = calibrated("calibration-mirror", *MIRROR, **{"devices.tec.calibration_due": "1999-12-01"})
    path, file = tmp_path / "calibrated.toml", tmp_path / "psd.json"
    path.write_text(CALIBRATED)
    with Rig(load_rig(str(path)), VirtualClock(), seed=1) as rig:
        readings = rig.measure()
        assert readings["curvature"] == pytest.approx(rig.laboratory.truth()["curvature"].value, abs=2.0)

    for changes, words in (
        ({"reference_uncertainty": -0.01}, "reference_uncertainty = -0.01"),
        ({"reference_uncertainty": None}, "reference_uncertainty"),
        ({"unit": "V"}, "is in m; the calibration is in V"),
        ({"reference_unit": "banana"}, "reference_unit = 'banana': is no unit"),
        ({"reference_unit": "rad"}, "expected a deflection in m or an angle in °"),
        ({"serial_number": "470000001"}, "serial number 470000001, but psd has 470012345"),
    ):
        content = {
            key: value for key, value in (found.model_dump(mode="json") | changes).items() if value is not None
        }
        file.write_text(json.dumps(content))
        with pytest.raises((ConfigurationError, DataError)) as caught:
            Rig(load_rig(str(path)), VirtualClock(), 1).close()
        (line,) = str(caught.value).splitlines()
        assert words in line

    # One that is too old is said before the run and on its page.
    file.write_text(json.dumps(found.model_dump(mode="json") | {"date": "1998-12-31"}))
    code, out, err = bench(
        "run", "creep", "--rig", path, "--clock", "virtual", "--no-rehearse", "--out", tmp_path / "runs",
        "--set", "hot=30", "--set", "cool=25", "--json", tmp_path / "run.json",
    )  # fmt: skip
    assert code == 0
    assert "was due on 1999-12-31" in " ".join((out + err).split())
    run = Path(json.loads((tmp_path / "run.json").read_text())["folder"])
    with Record(run) as record:
        applied = record.meta["calibration"]["tip_angle"]["calibration"]
    assert (applied["reference"], applied["date"]) == ("goniometer", "1998-12-31")
    assert bench("report", run, "--out", tmp_path / "page")[0] == 0
    (page,) = (tmp_path / "page").rglob("*.html")
    assert "1999-12-31: overdue" in page.read_text()

    run = next(tmp_path.glob("vo2-calibration-mirror-*"))
    # Nothing was set, so that a curvature over a temperature shows no more than noise.
    _, out, _ = bench("report", run)
    assert "signals.png" in out
    assert "loop.png" not in out
    both = tmp_path / "both.html"
    assert bench("runs", "compare", run, run, "--html", both)[0] == 0
    assert 'id="signals"' in both.read_text()
    assert 'id="loops"' not in both.read_text()
    for options in (("--interval", 365), ("--uncertainty", -1, "--interval", 365), ("--uncertainty", 1)):
        code, _, err = bench("rig", "calibrate", run, "--sensor", "psd_position", "--unit", "°", *options)
        assert code
        assert "uncertainty" in err or "--interval" in err
    of_plate = ("--sensor", "psd_position", "--reference", "tec_temperature", "--uncertainty", 0.1, "--interval", 365)
    for options, words in (
        ((), "tec_temperature is in °C, not in m"),
        (("--unit", "°C"), "the certificate of the reference tec ended on 1999-12-01"),
    ):
        code, _, err = bench("rig", "calibrate", run, *of_plate, *options)
        assert code
        assert words in " ".join(err.split())
