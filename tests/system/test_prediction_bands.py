"""Bands and recalibration through the command line."""

import csv
import json

import numpy as np
import pytest
from other_plants import measured, random_reversals

from bench import identify
from bench.identification import load_model

ASKED = ("--input", "u", "--output", "y")


def write(path, inputs, outputs):
    np.savetxt(path, np.column_stack([inputs, outputs]), delimiter=",", header="u [V],y [mm]", comments="")
    return path


def read(path):
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    return {head: [row[place] for row in rows[1:]] for place, head in enumerate(rows[0])}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("measurements"), np.random.default_rng(0)
    found = {}
    for name, make in (("training", random_reversals), ("same", random_reversals)):
        inputs = make(rng)
        found[name] = write(folder / f"{name}.csv", inputs, measured("duhem", inputs, rng))
    inputs = random_reversals(rng)
    moved = 0.2 + 1.05 * measured("duhem", inputs, rng)
    found["moved"] = write(folder / "moved.csv", inputs, moved)
    return found


@pytest.fixture(scope="module")
def model(files):
    """A model with a band."""
    path = files["training"].with_name("model.json")
    identify(files["training"], "preisach", input="u", output="y", reversible="linear", band=True).file.save(path)
    return path


def test_a_file_without_band_is_as_it_was(bench, files, tmp_path):
    path = tmp_path / "plain.json"
    assert bench("identify", files["training"], *ASKED, "--model", "preisach", "--out", path)[0] == 0
    assert "band" not in json.loads(path.read_text())
    code, out, _ = bench("predict", path, files["same"], *ASKED, "--out", tmp_path / "p.csv")
    assert code == 0
    assert " band: " not in out
    assert not any("lower" in head for head in read(tmp_path / "p.csv"))


def test_rows_that_are_not_fitted_calibrate_no_band(bench, files, tmp_path):
    path = tmp_path / "part.json"
    arguments = ("--model", "prandtl-ishlinskii", "--train", "0:600", "--band", "--out", path)
    code, out, text = bench("identify", files["training"], *ASKED, *arguments)
    assert code == 0, text
    assert "90 % band: ± " in out
    band = json.loads(path.read_text())["band"]
    assert 0 < band["rows"] <= 600
    assert band["half_width"] > 0.0


def test_predictions_have_the_band_and_its_coverage(bench, model, files, tmp_path):
    out, result = tmp_path / "p.csv", tmp_path / "p.json"
    code, text, err = bench("predict", model, files["same"], *ASKED, "--out", out, "--json", result)
    assert code == 0
    assert err == ""
    columns = read(out)
    predicted = np.array(next(values for head, values in columns.items() if head.startswith("predicted")), float)
    lower = np.array(columns["predicted lower [mm]"], float)
    upper = np.array(columns["predicted upper [mm]"], float)
    np.testing.assert_allclose(0.5 * (lower + upper), predicted, atol=1e-12)
    outputs = np.loadtxt(files["same"], delimiter=",", skiprows=1)[:, 1]
    covered = float(((lower <= outputs) & (outputs <= upper)).mean())
    band = json.loads(result.read_text())["band"]
    assert band["coverage"] == pytest.approx(covered)
    assert 0.8 < covered < 1.0
    assert f"covers {100 * covered:.1f} % of the rows measured" in text
    assert band["half_width"] == pytest.approx(np.median(upper - predicted))


def test_inverted_setpoints_have_bands(bench, model, tmp_path):
    targets = tmp_path / "targets.csv"
    targets.write_text("y [mm]\n-0.5\n0\n0.5\n0.2\n")
    code, out, _ = bench("invert", model, targets, "--column", "y", "--out", tmp_path / "s.csv")
    assert code == 0
    assert "90 % band" in out
    columns = {head: np.array(values) for head, values in read(tmp_path / "s.csv").items()}
    setpoints = columns["setpoint [V]"].astype(float)
    low, high = (columns[f"setpoint {end} [V]"].astype(float) for end in ("lower", "upper"))
    assert (low < setpoints).all()
    assert (setpoints < high).all()
    # By the slope on the way up: the output at the upper end is about the upper end of its band.
    operator = load_model(model).operator
    reached = operator.evaluate([setpoints[0], setpoints[1], high[1]])[2]
    upper = float(columns["predicted upper [mm]"][1])
    assert reached == pytest.approx(upper, abs=0.5 * (upper - float(columns["predicted [mm]"][1])))


def test_comparisons_show_coverage_on_request(bench, model, files, tmp_path):
    plain = tmp_path / "plain.json"
    assert bench("identify", files["training"], *ASKED, "--model", "polynomial", "--out", plain)[0] == 0
    code, out, err = bench("model", "test", model, plain, "--data", files["same"], "--bands")
    assert code == 0
    assert "model: 90 % band: ±" in out
    assert "plain has no prediction band; `bench identify --band` calibrates one" in err
    assert " band: " not in bench("model", "test", model, plain, "--data", files["same"])[1]


def test_a_session_is_recalibrated_and_judged_on_other_rows(bench, model, files, tmp_path):
    def errors(*options):
        result = tmp_path / "p.json"
        code, out, _ = bench(
            "predict", model, files["moved"], *ASKED, "--out", tmp_path / "p.csv", "--json", result, *options
        )
        assert code == 0
        return out, json.loads(result.read_text())

    _, raw = errors()
    out, mended = errors("--recalibrate", "offset,gain", "--recalibrate-rows", 400)
    assert mended["rms"] < 0.5 * raw["rms"]
    found = mended["recalibration"]
    assert found["errors_from_row"] == 401
    for kind, true in (("offset", 0.2), ("gain", 1.05)):
        assert abs(found[kind]["value"] - true) < 4.0 * found[kind]["uncertainty"]
    assert "first 400 of" in out
    assert mended["band"]["coverage"] > raw["band"]["coverage"]
    # The errors are those of the rows that are written and were not used.
    predicted = np.array(
        next(values for head, values in read(tmp_path / "p.csv").items() if head.startswith("predicted")), float
    )
    outputs = np.loadtxt(files["moved"], delimiter=",", skiprows=1)[:, 1]
    assert mended["rms"] == pytest.approx(np.sqrt(np.mean((outputs - predicted)[400:] ** 2)))
    out, whole = errors("--recalibrate", "offset")
    assert "so that errors are of rows it used" in out
    assert whole["recalibration"]["errors_from_row"] == 1


def test_compare_recalibrates_each_model(bench, model, files, tmp_path):
    result = tmp_path / "c.json"
    arguments = ("--recalibrate", "offset,gain", "--recalibrate-rows", 400, "--json", result)
    code, out, _ = bench("model", "test", model, "--data", files["moved"], *arguments)
    assert code == 0
    assert "recalibration of model" in out
    entry = json.loads(result.read_text())["model"]
    assert f"max {entry['recalibrated']['max']:.4g}, RMS {entry['recalibrated']['rms']:.4g} mm" in out
    assert entry["recalibrated"]["rms"] < 0.5 * entry["raw"]["rms"]
    assert entry["recalibration"]["errors_from_row"] == 401


def test_wrong_recalibrations_are_refused(bench, model, files, tmp_path):
    out = ("--out", tmp_path / "p.csv")
    for options, words in (
        ((*ASKED, "--recalibrate-rows", "50"), "--recalibrate-rows 50: say with --recalibrate what is estimated"),
        (("--input", "u", "--recalibrate", "offset"), "--recalibrate needs measured outputs"),
    ):
        code, _, err = bench("predict", model, files["moved"], *out, *options)
        assert code != 0
        assert words in " ".join(err.split())
