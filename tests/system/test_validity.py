"""Every command that applies a model says which inputs lie beyond those that were fitted."""

import json

import numpy as np
import pytest

from bench.identification import load_model, ramps

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


def check(bench, tmp_path, *arguments, part=()):
    """Return the result of a command that says once how far the inputs of 6 V lie beyond 4 V."""
    code, _, err = bench(*arguments, "--json", tmp_path / "result.json")
    assert code == 0, err
    assert err.count("lie beyond those fitted") == 1
    content = json.loads((tmp_path / "result.json").read_text())
    beyond = (content[part[0]] if part else content)["beyond"]
    assert (beyond["count"], beyond["of"]) == (int((np.abs(LARGE) > 4.0).sum()), LARGE.size)
    assert (beyond["distance"], beyond["distance_percent"]) == (2.0, 25.0)
    return content


def test_commands_say_how_many_inputs_lie_beyond_and_how_far(bench, files, tmp_path):
    model, large = files["model"], files["large"]
    check(bench, tmp_path, "predict", model, large, *ASKED[:4], "--out", tmp_path / "p.csv")
    check(bench, tmp_path, "model", "test", model, "--data", large, part=["model"])
    check(bench, tmp_path, "identify", files["small"], *ASKED, "--test", large, part=["test"])
    assert bench("model", "test", model, "--data", files["small"])[2] == ""
    # An older file has the operating range of its model.
    content = json.loads(model.read_text())
    del content["validity"]
    model.write_text(json.dumps(content))
    assert load_model(model).validity is None
    check(bench, tmp_path, "model", "test", model, "--data", large, part=["model"])


def test_it_is_of_the_rows_that_were_fitted(bench, files, tmp_path):
    out, rows = tmp_path / "part.json", ("--train", f"0:{SMALL.size}", "--test", f"{SMALL.size}:")
    content = check(bench, tmp_path, "identify", files["both"], *ASKED, *rows, "--out", out, part=["test"])
    assert content["test"]["beyond"]["rows"][0][0] > SMALL.size
    known = content["validity"]
    assert (known["low"], known["high"], known["rows"], known["left_out"]) == (-4.0, 4.0, SMALL.size, LARGE.size)
    # The operating range is that of the rows that were fitted, so that no set-point lies beyond it.
    (tmp_path / "targets.csv").write_text("y [mm]\n0\n10\n1\n")
    arguments = ("--column", "y", "--out", tmp_path / "s.csv", "--json", tmp_path / "result.json")
    assert bench("invert", out, tmp_path / "targets.csv", *arguments)[0] == 0
    inverted = json.loads((tmp_path / "result.json").read_text())
    assert (inverted["met"], inverted["too_high"], inverted["beyond"]["count"]) == (2, 1, 0)


def test_it_is_saved_with_the_model_and_named_where_it_is_damaged(bench, files, tmp_path):
    file = load_model(files["model"])
    file.save(tmp_path / "again.json")
    assert load_model(tmp_path / "again.json").validity == file.validity
    content = json.loads(files["model"].read_text())
    content["validity"]["low"] = "x"
    files["model"].write_text(json.dumps(content))
    code, _, err = bench("predict", files["model"], files["small"], *ASKED[:4], "--out", tmp_path / "p.csv")
    assert (code != 0, "validity: low" in err) == (True, True)
