"""Every command that applies a model says which inputs lie beyond those that were fitted."""

import json

import numpy as np
import pytest

from bench.identification import ModelFile, load_model, ramps

ASKED = ("--input", "u", "--output", "y", "--model", "prandtl-ishlinskii")
SMALL = ramps([0.0, 4.0, -4.0, 3.0, -3.0, 4.0, -4.0], 0.25)
LARGE = ramps([0.0, 6.0, -6.0, 0.0], 0.25)


def write(path, inputs):
    lagging = np.empty(inputs.size)
    output = 0.0
    for k, u in enumerate(inputs):
        output = min(max(output, u - 1.0), u + 1.0)
        lagging[k] = u + output
    np.savetxt(path, np.column_stack([inputs, lagging]), delimiter=",", header="u [V],y [mm]", comments="")
    return path


@pytest.fixture
def files(bench, tmp_path):
    """Files of inputs of 4 V and 6 V, both in one, and the model of the first."""
    found = {name: write(tmp_path / f"{name}.csv", inputs) for name, inputs in (
        ("small", SMALL), ("large", LARGE), ("both", np.concatenate([SMALL, LARGE]))
    )}  # fmt: skip
    found["model"] = tmp_path / "model.json"
    code, _, err = bench("identify", found["small"], *ASKED, "--out", found["model"])
    assert code == 0, err
    return found


COUNT = int((np.abs(LARGE) > 4.0).sum())


def check(beyond, err, of=LARGE.size, count=COUNT):
    assert (beyond["count"], beyond["of"]) == (count, of)
    assert (beyond["distance"], beyond["distance_percent"]) == (2.0, 25.0)
    assert err.count("lie beyond those fitted") == 1


def test_predictions_and_comparisons_say_it(bench, files, tmp_path):
    result = tmp_path / "result.json"
    code, _, err = bench("predict", files["model"], files["large"], *ASKED[:4], "--out", tmp_path / "p.csv",
                         "--json", result)  # fmt: skip
    assert code == 0, err
    check(json.loads(result.read_text())["beyond"], err)
    code, _, err = bench("compare", files["model"], "--data", files["large"], "--json", result)
    assert code == 0, err
    check(json.loads(result.read_text())["model"]["beyond"], err)
    code, _, err = bench("compare", files["model"], "--data", files["small"], "--json", result)
    assert (code, err) == (0, "")
    assert json.loads(result.read_text())["model"]["beyond"]["count"] == 0


def test_a_test_says_it_of_rows_and_of_another_file(bench, files, tmp_path):
    result, out = tmp_path / "result.json", tmp_path / "part.json"
    rows = ("--train", f"0:{SMALL.size}", "--test", f"{SMALL.size}:")
    code, _, err = bench("identify", files["both"], *ASKED, *rows, "--out", out, "--json", result)
    assert code == 0, err
    content = json.loads(result.read_text())
    check(content["test"]["beyond"], err)
    assert content["test"]["beyond"]["rows"][0][0] > SMALL.size
    known = content["validity"]
    assert (known["low"], known["high"], known["rows"], known["left_out"]) == (-4.0, 4.0, SMALL.size, LARGE.size)
    # The rows that were fitted, not the range of the file.
    assert load_model(out).valid.high == 4.0
    code, _, err = bench("identify", files["small"], *ASKED, "--test", files["large"], "--json", result)
    assert code == 0, err
    check(json.loads(result.read_text())["test"]["beyond"], err)
    # Set-points within the operating range, but not among what was fitted.
    targets = tmp_path / "targets.csv"
    targets.write_text("y [mm]\n0\n10\n1\n")
    code, _, err = bench("invert", out, targets, "--column", "y", "--out", tmp_path / "s.csv", "--json", result)
    assert code == 0, err
    beyond = json.loads(result.read_text())["beyond"]
    assert (beyond["count"], beyond["rows"]) == (1, [[2, 2]])


def test_an_older_file_has_the_range_of_its_model(bench, files, tmp_path):
    content = json.loads(files["model"].read_text())
    del content["validity"]
    files["model"].write_text(json.dumps(content))
    file = load_model(files["model"])
    assert file.validity is None
    assert (file.valid.low, file.valid.high) == file.operator.input_range
    code, _, err = bench("compare", files["model"], "--data", files["large"], "--json", tmp_path / "result.json")
    assert code == 0, err
    check(json.loads((tmp_path / "result.json").read_text())["model"]["beyond"], err)


def test_a_damaged_validity_is_named(bench, files, tmp_path):
    content = json.loads(files["model"].read_text())
    content["validity"]["low"] = "x"
    files["model"].write_text(json.dumps(content))
    code, _, err = bench("predict", files["model"], files["small"], *ASKED[:4], "--out", tmp_path / "p.csv")
    assert code != 0
    assert "validity: low" in err


def test_a_saved_model_keeps_it(files, tmp_path):
    file = load_model(files["model"])
    file.save(tmp_path / "again.json")
    assert load_model(tmp_path / "again.json").validity == file.validity
    assert ModelFile("plain", file.model).valid.moves is None
