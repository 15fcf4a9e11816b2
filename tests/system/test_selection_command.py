"""`bench identify` without a model, with rows or files kept for the test, and from several files."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from cases import cases

from bench.analysis import ColumnNames, read_dataset
from bench.identification import load_model, ramps
from bench.models import PrandtlIshlinskii

COLUMNS = ("--input", "voltage", "--output", "travel")
# Few models keep this short; `all` is tested once.
SOME = ("--model", "polynomial,polynomial-plays,prandtl-ishlinskii")
TWO = ("--model", "polynomial,prandtl-ishlinskii", "-o", "plays=5")


def measure(path: Path, seed: int = 0, offset: float = 0.0, unit: str = "V") -> None:
    """Write a record of plays between random turns: 0 to 10 V first, and noise of 0.5 % of the range."""
    rng = np.random.default_rng(seed)
    inputs = ramps([0.0, 10.0, *rng.uniform(0.0, 10.0, 16)], 0.4)
    plays = PrandtlIshlinskii(np.arange(5.0), [1.0, 0.4, 0.8, 0.3, 0.5], input_range=(0.0, 10.0))
    outputs = plays.evaluate(inputs, plays.saturated_state(-1)) + offset
    outputs += 0.005 * np.ptp(outputs) * rng.standard_normal(outputs.size)
    rows = np.column_stack([inputs, outputs])
    np.savetxt(path, rows, header=f"voltage [{unit}],travel [mm]", delimiter=",", comments="")


@pytest.fixture
def record(tmp_path):
    measure(tmp_path / "record.csv")
    return tmp_path / "record.csv"


def test_without_a_model_all_are_compared_and_one_is_saved(bench, record, tmp_path):
    out, table, result = tmp_path / "model.json", tmp_path / "table.csv", tmp_path / "result.json"
    code, text, err = bench(
        "identify", record, *COLUMNS, "--levels", 5, "--out", out, "--table-out", table, "--json", result
    )
    assert code == 0, err
    assert "return-point memory" in text
    content = json.loads(result.read_text())
    rows = list(csv.DictReader(table.read_text().splitlines()))
    chosen = [row for row in rows if row["note"] == "chosen"]
    assert len(chosen) == 1
    assert chosen[0]["model"] == content["model"] == load_model(out).name
    assert {"preisach", "polynomial-plays", "polynomial"} <= {row["model"] for row in rows}
    assert float(chosen[0]["score_percent"]) < 2.0
    # The choice can be made by hand: the fewest degrees of freedom within 2 % of the least score.
    least = min(float(row["score"]) for row in rows)
    near = [row for row in rows if float(row["score"]) <= 1.02 * least]
    assert chosen[0] == min(near, key=lambda row: float(row["free"]))
    assert len(content["selection"]["table"]) == len(rows)
    assert load_model(out).provenance["selection"]["table"] == content["selection"]["table"]
    assert content["return_points"]["holds"] is True


def test_the_chosen_model_is_found_and_has_its_errors_again(bench, record, tmp_path):
    out, result, predicted = tmp_path / "model.json", tmp_path / "result.json", tmp_path / "predicted.json"
    code, text, err = bench("identify", record, *COLUMNS, *SOME, "--out", out, "--json", result)
    assert code == 0, err
    # Each row of the table is one line, with a time at its end.
    lines = text.splitlines()
    head = next(place for place, line in enumerate(lines) if "score" in line and "freedom" not in line) + 1
    rows = lines[head + 2 : next(k for k, line in enumerate(lines) if line.startswith("* chosen"))]
    assert sum(row.startswith("*") for row in rows) == 1
    assert all(float(row.split()[-1]) >= 0.0 for row in rows)
    content = json.loads(result.read_text())
    assert content["model"] == "prandtl-ishlinskii"
    code, _, err = bench("predict", out, record, *COLUMNS, "--out", tmp_path / "p.csv", "--json", predicted)
    assert code == 0, err
    assert json.loads(predicted.read_text())["rms"] == pytest.approx(content["rms"], rel=1e-6)


def test_errors_of_all_rows_beside_those_fitted_are_those_of_predict(bench, record, tmp_path):
    out, result, predicted = tmp_path / "model.json", tmp_path / "result.json", tmp_path / "predicted.json"
    code, text, err = bench(
        "identify", record, *COLUMNS, "--model", "preisach", "--train", "0:150", "--out", out, "--json", result
    )
    assert code == 0, err
    content = json.loads(result.read_text())
    assert content["fitted"] == 150
    assert f"150 fitted of {content['samples']} (skipped: 0)" in text
    code, text_of_predict, err = bench(
        "predict", out, record, *COLUMNS, "--out", tmp_path / "p.csv", "--json", predicted
    )
    assert code == 0, err
    assert json.loads(predicted.read_text())["rms"] == pytest.approx(content["all_rows"]["rms"], rel=1e-9)
    assert content["rms"] != pytest.approx(content["all_rows"]["rms"], rel=1e-3)

    def stated(text, name):
        return next(line for line in text.splitlines() if line.strip().startswith(name)).strip()[len(name) :].strip()

    assert stated(text, "RMS error of all rows") == stated(text_of_predict, "RMS error")


def test_the_model_is_kept_where_the_rows_of_the_test_are_not_there(bench, record, tmp_path):
    out = tmp_path / "model.json"
    code, _, err = bench("identify", record, *COLUMNS, "--model", "polynomial", "--test", "9000:", "--out", out)
    assert code == 2
    assert "--test 9000: goes beyond the last row" in err
    assert load_model(out).name == "polynomial"


def test_a_file_for_the_test_is_read_before_anything_is_fitted(bench, record):
    code, text, err = bench("identify", record, *COLUMNS, *SOME, "--test", "missing.csv")
    assert code == 3
    assert "missing.csv does not exist" in err
    assert "score" not in text


def test_an_exact_line_is_chosen_as_such(bench, tmp_path):
    inputs = ramps([0.0, 10.0, *np.random.default_rng(3).uniform(0.0, 10.0, 16)], 0.4)
    np.savetxt(
        tmp_path / "line.csv", np.column_stack([inputs, 2.0 * inputs + 1.0]),
        header="voltage [V],travel [mm]", delimiter=",", comments="",
    )  # fmt: skip
    result = tmp_path / "result.json"
    # An equation, and models with and without cells.
    models = ("--model", "polynomial,duhem,prandtl-ishlinskii,preisach", "--levels", 5)
    code, _, err = bench("identify", tmp_path / "line.csv", *COLUMNS, *models, "--json", result)
    assert code == 0, err
    assert json.loads(result.read_text())["rms_percent"] < 1e-9
    assert "hardly answers" not in err


def test_a_coarse_output_gives_a_model(bench, tmp_path):
    measure(tmp_path / "record.csv")
    rows = np.loadtxt(tmp_path / "record.csv", delimiter=",", skiprows=1)
    rows[:, 1] = np.round(rows[:, 1] / 4.0) * 4.0
    np.savetxt(tmp_path / "coarse.csv", rows, header="voltage [V],travel [mm]", delimiter=",", comments="")
    code, _, err = bench(
        "identify", tmp_path / "coarse.csv", *COLUMNS, "--model", "preisach-signed,polynomial", "--levels", "30",
        "--initial", "skip",
    )  # fmt: skip
    assert code == 0, err


def test_fewer_samples_than_cells_are_smoothed_by_cross_validation(bench, tmp_path):
    measure(tmp_path / "long.csv", seed=4)
    lines = (tmp_path / "long.csv").read_text().splitlines()
    (tmp_path / "few.csv").write_text("\n".join(lines[:62]) + "\n")
    errors = {}
    for smoothing in ((), ("--smoothing", "0")):
        result = tmp_path / "result.json"
        code, _, err = bench(
            "identify", tmp_path / "few.csv", *COLUMNS, "--model", "preisach", "-o", "reversible=linear",
            "--test", tmp_path / "long.csv", *smoothing, "--json", result,
        )  # fmt: skip
        assert code == 0, err
        assert ("by cross-validation: --smoothing" in " ".join(err.split())) is not bool(smoothing)
        errors[smoothing] = json.loads(result.read_text())["test"]["raw"]["rms"]
    assert errors[()] < errors["--smoothing", "0"]


def test_the_rows_of_the_test_are_not_fitted(bench, record, tmp_path):
    """With the rows of the test spoilt, the model is the same and the test is bad."""
    lines = record.read_text().splitlines()
    spoilt = tmp_path / "spoilt.csv"
    changed = [f"{line.split(',')[0]},{1e3 + row}" for row, line in enumerate(lines[151:])]
    spoilt.write_text("\n".join([*lines[:151], *changed]) + "\n")
    models = []
    for path in (record, spoilt):
        out, result = tmp_path / f"{path.stem}.json", tmp_path / f"{path.stem}-result.json"
        code, _, err = bench(
            "identify", path, *COLUMNS, "--model", "prandtl-ishlinskii", "--train", ":150", "--test", "150:",
            "--out", out, "--json", result,
        )  # fmt: skip
        assert code == 0, err
        models.append((load_model(out).operator.coefficients, json.loads(result.read_text())))
    assert models[0][1]["test"]["source"] == "rows 150:"
    assert models[0][1]["test"]["raw"]["rms_percent"] < 5.0
    np.testing.assert_allclose(models[0][0], models[1][0], rtol=1e-9)
    assert models[1][1]["rms"] == pytest.approx(models[0][1]["rms"])
    assert models[1][1]["test"]["raw"]["rms"] > 100 * models[0][1]["test"]["raw"]["rms"]


def test_another_file_is_the_test(bench, record, tmp_path):
    measure(tmp_path / "other.csv", seed=1, offset=3.0)
    result = tmp_path / "result.json"
    code, _, err = bench(
        "identify", record, *COLUMNS, "--model", "prandtl-ishlinskii", "--test", tmp_path / "other.csv", "--json",
        result,
    )  # fmt: skip
    assert code == 0, err
    test = json.loads(result.read_text())["test"]
    assert test["source"] == "other.csv"
    assert test["offset"] == pytest.approx(3.0, abs=0.2)
    assert test["rezeroed"]["rms_percent"] < 3.0 < test["raw"]["rms_percent"]


def test_one_model_of_several_files(bench, record, tmp_path):
    """The second starts from a memory of its own: its rows count once its inputs have overwritten that."""
    measure(tmp_path / "second.csv", seed=1)
    result = tmp_path / "result.json"
    code, _, err = bench(
        "identify", record, tmp_path / "second.csv", *COLUMNS, "--model", "prandtl-ishlinskii", "--json", result
    )
    assert code == 0, err
    assert json.loads(result.read_text())["rms_percent"] < 3.0
    data = read_dataset([record, tmp_path / "second.csv"], ColumnNames("voltage", "travel"))
    assert data.starts[1] == len(record.read_text().splitlines()) - 1


@cases(
    ("options", "word"),
    [
        (("--model", "polynomial", "--train", "5"), "--train"),
        (("--model", "polynomial", "--train", "0:9000"), "--train 0:9000"),
        (("--model", "polynomial,plain"), "'plain'"),
        (("--model", "polynomial,hammerstein"), "--time COLUMN"),
        ((*SOME, "--initial", "Negative"), "--initial"),
        (("--output", "voltage"), "--output"),
        (("--model", "polynomial", "--table-out", "t.csv"), "--table-out"),
        ((*SOME, "--cross-validate"), "--cross-validate"),
        ((*SOME, "--levels", "5"), "levels"),
        ((*SOME, "-o", "dynamics=lag"), "dynamics: none of the models has this option"),
    ],
)
def test_wrong_options_are_named(bench, record, options, word):
    code, _, err = bench("identify", record, *COLUMNS, *options)
    assert code == 2
    assert word in err


def test_a_second_file_in_another_unit_is_refused(bench, record, tmp_path):
    measure(tmp_path / "second.csv", unit="kV")
    code, _, err = bench("identify", record, tmp_path / "second.csv", *COLUMNS, *SOME)
    assert code == 3
    assert "kV" in err


def test_a_ratcheting_output_is_warned_of(bench, record, tmp_path):
    lines = record.read_text().splitlines()
    drifting = [f"{u},{float(y) + 0.2 * row}" for row, (u, y) in enumerate(line.split(",") for line in lines[1:])]
    (tmp_path / "drift.csv").write_text("\n".join([lines[0], *drifting]) + "\n")
    code, _, err = bench("identify", tmp_path / "drift.csv", *COLUMNS, "--model", "preisach")
    assert code == 0
    assert "no return-point memory" in err
    assert "may not be used" in " ".join(err.split())


def drifting(path: Path) -> None:
    """Write the record of `measure` with times, and a drift of a tenth of the range."""
    measure(path)
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    times = 0.1 * np.arange(len(rows))
    rows[:, 1] += 0.1 * np.ptp(rows[:, 1]) * times / times[-1]
    content = np.column_stack([times, rows])
    np.savetxt(path, content, header="time [s],voltage [V],travel [mm]", delimiter=",", comments="")


def test_a_drift_is_found_with_the_times_of_the_file(bench, tmp_path):
    file, out, result = tmp_path / "drifting.csv", tmp_path / "model.json", tmp_path / "result.json"
    predicted = tmp_path / "predicted.json"
    drifting(file)
    for time, model in (
        (("--time", "none"), "prandtl-ishlinskii"),
        ((), "hammerstein"),
        (("--time", "time"), "hammerstein"),
    ):
        code, _, err = bench(
            "identify", file, *COLUMNS, *TWO, *time, "--test", "150:", "--out", out, "--json", result
        )
        assert code == 0, err
        content = json.loads(result.read_text())
        assert content["model"] == load_model(out).name == model
        assert (content["test"]["raw"]["rms_percent"] < 1.0) is (model == "hammerstein")
        code, _, err = bench("predict", out, file, *COLUMNS, "--out", tmp_path / "p.csv", "--json", predicted)
        assert code == 0, err
        assert json.loads(predicted.read_text())["rms"] == pytest.approx(content["rms"], rel=1e-6)


def timed(path: Path, times: np.ndarray, head: str = "time [s]") -> Path:
    """Write the record of `measure` with a column of times."""
    measure(path)
    rows = np.column_stack([times, np.loadtxt(path, delimiter=",", skiprows=1)])
    np.savetxt(path, rows, header=f"{head},voltage [V],travel [mm]", delimiter=",", comments="")
    return path


def test_times_that_cannot_be_used_are_left_out_and_named(bench, record, tmp_path):
    count = len(record.read_text().splitlines()) - 1
    back = timed(tmp_path / "back.csv", np.where(np.arange(count) < 6, np.arange(count), np.arange(count) - 3))
    code, text, err = bench("identify", back, *COLUMNS, *TWO)
    assert code == 0, err
    assert "row 7" in text
    assert "time is left out" in text
    file = timed(tmp_path / "timed.csv", 0.1 * np.arange(count))
    code, text, err = bench("identify", file, *COLUMNS, *TWO, "--test", record)
    assert code == 0, err
    assert "record.csv has no column time" in text
    # A column so named that holds something else.
    warm = timed(tmp_path / "warm.csv", 20.0 + np.zeros(count), head="t [degC]")
    code, text, err = bench("identify", warm, *COLUMNS, *TWO)
    assert code == 0, err
    assert "time is left out" not in text


def test_half_a_loop_is_doubted_once_and_nothing_is_proposed_that_was_tried(bench, tmp_path):
    inputs = np.linspace(1.0, -1.0, 46)
    rows = [f"{u},{np.tanh(3.0 * u + 0.5)}" for u in inputs.tolist()]
    (tmp_path / "half.csv").write_text("\n".join(["u,y", *rows]) + "\n")
    result = tmp_path / "result.json"
    code, _, err = bench("identify", tmp_path / "half.csv", "--input", "u", "--output", "y", "--json", result)
    assert code == 0, err
    advice = json.loads(result.read_text())["advice"]
    codes = [one["code"] for one in advice]
    assert len(set(codes)) == len(codes)
    assert {"few-reversals", "one-run"} <= set(codes)
    assert "branch" not in err
    assert not [one for one in advice if "--levels" in one["remedy"] or "--model" in one["remedy"]]
