"""What `bench identify` refuses, warns of and says of the orientation."""

import json
import re

import numpy as np
from cases import cases

from bench.identification import load_model
from bench.models import Preisach, uniform_levels

COLUMNS = ("--input", "voltage", "--output", "displacement")


def write(path, inputs, outputs):
    table = np.column_stack([inputs, outputs])
    np.savetxt(path, table, delimiter=",", header="voltage [V],displacement [µm]", comments="", encoding="utf-8")
    return path


def loops(rows):
    inputs = 5.0 - 5.0 * np.cos(np.linspace(0.0, 30.0, rows)) * np.linspace(1.0, 0.2, rows)
    return inputs, Preisach(uniform_levels(0.0, 10.0, 8), np.ones(36), 3.0).evaluate(inputs)


@cases(("sign", "orientation"), [(1, "rising"), (-1, "falling")])
def test_the_orientation_is_printed_and_kept(bench, tmp_path, sign, orientation):
    inputs, outputs = loops(400)
    data, model, result = write(tmp_path / "d.csv", inputs, sign * outputs), tmp_path / "m.json", tmp_path / "r.json"
    options = ["--model", "preisach", "--levels", "8", "--out", model, "--json", result]
    code, out, err = bench("identify", data, *COLUMNS, *options)
    assert (code, err) == (0, "")
    assert re.search(rf"orientation\s+{orientation} with the input", out)
    found = json.loads(result.read_text())
    assert found["orientation"] == load_model(model).provenance["orientation"] == orientation
    assert found["rms_percent"] < 1e-6
    assert found["warnings"] == []
    operator = load_model(model).operator
    assert operator.rises() == (sign > 0)
    targets = tmp_path / "targets.csv"
    targets.write_text("target [µm]\n" + "".join(f"{value}\n" for value in sign * outputs[::40]))
    code, _, _ = bench("invert", model, targets, "--column", "target", "--out", tmp_path / "s.csv", "--json", result)
    assert code == 0
    assert json.loads(result.read_text())["met"] == 10
    assert json.loads(result.read_text())["largest_residual"] < 1e-9


def test_a_wrong_orientation_is_one_message(bench, tmp_path):
    data = write(tmp_path / "d.csv", *loops(100))
    for model, orientation, words in (
        ("preisach", "down", "orientation: expected 'auto', 'rising' or 'falling', got 'down'"),
        ("preisach-signed", "falling", "preisach-signed has coefficients of either sign"),
    ):
        code, _, err = bench("identify", data, *COLUMNS, "--model", model, "-o", f"orientation={orientation}")
        assert (code, err.count("error:")) == (2, 1)
        assert words in re.sub(r"\s+", " ", err)


def test_few_samples_are_warned_of(bench, tmp_path):
    data, result = write(tmp_path / "d.csv", *loops(61)), tmp_path / "r.json"
    code, _, err = bench("identify", data, *COLUMNS, "--model", "preisach", "--json", result)
    assert code == 0
    assert err.count("warning:") == len(json.loads(result.read_text())["warnings"]) > 0
    assert "61 samples are few for 210 coefficients" in re.sub(r"\s+", " ", err)


def test_a_time_constant_beyond_the_record_is_warned_of(bench, tmp_path):
    times = 0.1 * np.arange(200)
    inputs = np.sin(2.0 * times)
    # A lag of 200 s, in a record of 20 s.
    data = write(tmp_path / "d.csv", inputs, np.cumsum(inputs + 1.0) * 0.1 / 200.0)
    options = ["--format", "interval=0.1s", "-o", "static=polynomial-plays"]
    for dynamics, is_warned in (("lag", True), ("none", False)):
        code, _, err = bench(
            "identify", data, *COLUMNS, "--model", "hammerstein", *options, "-o", f"dynamics={dynamics}"
        )
        warned = re.search(r"warning: time constant: \S+ s is longer than the record, which lasts 19.9 s", err)
        assert (code, warned is not None) == (0, is_warned)


def test_a_constant_output_is_refused(bench, tmp_path):
    data = write(tmp_path / "d.csv", loops(100)[0], np.full(100, 2.5))
    for model in ("preisach", "prandtl-ishlinskii", "preisach-signed", "polynomial"):
        code, _, err = bench("identify", data, *COLUMNS, "--model", model, "--out", tmp_path / "m.json")
        assert (code, err.count("error:")) == (3, 1)
        assert "column displacement is 2.5 in all 100 rows, so nothing can be identified" in re.sub(r"\s+", " ", err)
    assert not (tmp_path / "m.json").exists()


def test_an_unknown_memory_that_leaves_nothing_is_refused(bench, tmp_path):
    inputs = loops(300)[0][::-1] * 1.0
    data = write(tmp_path / "d.csv", np.append(inputs, 12.0), np.append(inputs**1.5, 50.0))
    options = ["--model", "prandtl-ishlinskii", "--initial", "skip", "--out", tmp_path / "m.json"]
    code, _, err = bench("identify", data, *COLUMNS, *options)
    assert (code, err.count("error:")) == (2, 1)
    assert "'skip' leaves 1 of 301 samples" in re.sub(r"\s+", " ", err)
    assert "use --initial negative or positive instead" in re.sub(r"\s+", " ", err)
    assert not (tmp_path / "m.json").exists()
