"""Sequences that are designed, written, carried out, and continued."""

import json
from pathlib import Path

import numpy as np
import pytest
from cases import cases

from bench.analysis import read_columns
from bench.record import Record

RUN = ("--rig", "vo2", "--clock", "virtual")


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """A file of a play's output, and its model."""
    from bench import identify
    from bench.analysis import write_csv
    from bench.identification import covering_sequence
    from bench.models import uniform_levels

    folder = tmp_path_factory.mktemp("measured")
    inputs = np.concatenate([[21.0], covering_sequence(uniform_levels(21.0, 84.0, 8), per_cell=2)])
    play, outputs = 21.0, []
    for value in inputs:
        play = min(max(play, value - 6.0), value + 6.0)
        outputs.append(play)
    outputs = np.array(outputs) + 0.1 * np.random.default_rng(0).standard_normal(inputs.size)
    write_csv(folder / "data.csv", [("tec [°C]", inputs), ("curvature [1/m]", outputs)])
    found = identify(folder / "data.csv", "preisach", input="tec", output="curvature", levels=10)
    found.file.save(folder / "model.json")
    return folder


def test_a_sequence_is_written_and_carried_out(bench, tmp_path):
    path = tmp_path / "sequence.csv"
    options = ["--levels", 2, "--dwell", 0.5, "--sequence", "first-order-reversals"]
    code, out, err = bench("model", "design", "--rig", "vo2", *options, "--out", path)
    assert code == 0, err
    assert f"setpoints={path}" in out.replace("\n", "")
    columns = read_columns(path, ["time", "input", "dwell"])
    assert columns.units == {"time": "s", "input": "°C", "dwell": "s"}
    np.testing.assert_allclose(columns.values["time"], np.cumsum(columns.values["dwell"]))

    result = tmp_path / "run.json"
    code, _, err = bench(
        *("run", "sequence", *RUN, "--set", f"setpoints={path}", "--out", tmp_path, "--json", result)
    )
    assert code == 0, err
    outcome = json.loads(result.read_text())
    assert outcome["status"] == "completed"
    with Record(Path(outcome["folder"])) as record:
        steps = record.steps()
        # The file goes with the record.
        assert path.read_bytes() in record.files().values()
    np.testing.assert_array_equal(steps["tec_setpoint"][1:], columns.values["input"])
    held = steps["finished"][1:] - steps["started"][1:]
    np.testing.assert_allclose(held, 0.5, atol=0.2)


@cases(
    ("text", "settings", "words"),
    [
        ("input,dwell\n30,1\n95,1\n", (), ["row 2", "column input", "95", "21 to 84 °C"]),
        ("input,dwell\n30,1\n50,1\n", ("low=40",), ["row 1", "30", "40 to 84"]),
        ("input,dwell\n30,1\n40,0\n", (), ["row 2", "column dwell"]),
        ("input [V],dwell\n30,1\n40,1\n", (), ["column input is in V", "°C"]),
        ("input,dwell [min]\n30,1\n40,1\n", (), ["column dwell is in min"]),
        ("input\n30\n40\n", (), ["no column 'dwell'"]),
        ("drive,dwell\n30,1\n40,1\n", (), ["no column 'input'"]),
    ],
)
def test_a_wrong_sequence_is_refused_before_anything_moves(bench, tmp_path, text, settings, words):
    path = tmp_path / "sequence.csv"
    path.write_text(text, encoding="utf-8")
    further = [part for each in settings for part in ("--set", each)]
    code, _, err = bench("run", "sequence", *RUN, "--set", f"setpoints={path}", *further, "--out", tmp_path / "runs")
    assert code in (2, 3)
    for word in words:
        assert word in err.replace("\n", " ")
    assert not list((tmp_path / "runs").glob("*"))


def test_columns_and_dwell_may_be_named(bench, tmp_path):
    path = tmp_path / "sequence.csv"
    path.write_text("drive [°C];other\n30;a\n40;b\n", encoding="utf-8")
    settings = [f"setpoints={path}", "column=drive", "dwells=", "dwell=1"]
    code, _, err = bench(
        *("run", "sequence", *RUN, "--out", tmp_path), *(part for each in settings for part in ("--set", each))
    )
    assert code == 0, err


def test_measurements_are_continued(bench, tmp_path, measured):
    out, result = tmp_path / "more.csv", tmp_path / "more.json"
    code, text, err = bench(
        "model", "design", "--model", measured / "model.json", "--data", measured / "data.csv", "--continue", 0.25,
        "--dwell", 8, "--out", out, "--json", result,
    )  # fmt: skip
    assert code == 0, err
    found = json.loads(result.read_text())
    columns = read_columns(out, ["input", "time"])
    assert columns.units["input"] == "°C"
    setpoints = columns.values["input"]
    assert setpoints.size == found["setpoints"]
    assert 21.0 <= setpoints.min() < setpoints.max() <= 84.0
    assert columns.values["time"][-1] == found["time"] <= 900.0
    for first, second in found["visits"]:
        assert setpoints[first] == setpoints[second]
    gains, variances = found["log_determinant"], found["prediction_variance"]
    assert gains["before"] < gains["after"]
    assert variances["after"] < variances["before"]
    assert f"{gains['after']:.3f}" in text
    assert "return-point test" in text


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["--rig", "vo2", "--sequence", "none", "--out", "DIR/s.csv"], 2, ["'none'", "covering, fewest"]),
        (["--rig", "vo2", "--out", "DIR/s.csv"], 2, ["--sequence", "--out"]),
        (["--continue", "1"], 2, ["--model", "--data"]),
        (["--model", "MODEL", "--data", "DATA", "--continue", "1"], 2, ["--dwell"]),
        (["--model", "MODEL", "--data", "DATA", "--continue", "0.001", "--dwell", "8"], 2, ["shortest tail"]),
        (["--model", "MODEL", "--data", "DATA", "--continue", "1", "--dwell", "8", "--input", "x"], 3, ["'x'"]),
        (["--model", "MODEL", "--data", "DATA", "--continue", "1", "--out", "DATA"], 3, ["it is read"]),
        (["--rig", "vo2", "--input", "x"], 2, ["--continue"]),
    ],
)
def test_what_does_not_fit_together_is_said(bench, tmp_path, measured, options, code, words):
    places = {"MODEL": measured / "model.json", "DATA": measured / "data.csv"}
    arguments = [places.get(option, option.replace("DIR", str(tmp_path))) for option in options]
    found, _, err = bench("model", "design", *arguments)
    assert found == code, err
    for word in words:
        assert word in err.replace("\n", " ")
