"""A file of measurements of another program becomes a run that reports and models take."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from written_run import measured

from bench.record import Record

ROWS = 60


@pytest.fixture
def file(tmp_path):
    inputs, outputs = measured(ROWS)
    path = tmp_path / "foreign loops.csv"
    lines = [f"{2.0 * i};{u:.6f};{1e6 * y:.6f};{i % 3}" for i, (u, y) in enumerate(zip(inputs, outputs, strict=True))]
    path.write_text("\n".join(["time [s];plate [°C];tip [µm];state", *lines]).replace(".", ","), encoding="utf-8")
    return path


@pytest.fixture
def imported(bench, file, tmp_path):
    code, out, err = bench(
        "runs", "import", file, "--input", "plate", "--output", "tip", "--column", "state", "--title", "A plate",
        "--out", tmp_path / "runs", "--json", tmp_path / "import.json",
    )  # fmt: skip
    assert code == 0, err
    assert "60 readings" in out
    assert "decimal comma" in out
    return json.loads((tmp_path / "import.json").read_text())["folder"]


def test_the_record_has_the_rows_with_units_and_times(imported, file):
    inputs, outputs = measured(ROWS)
    with Record(Path(imported)) as record:
        steps = record.steps()
        assert {signal.name: signal.unit for signal in record.signals} == {"plate": "°C", "tip": "µm", "state": "1"}
        np.testing.assert_allclose(steps["plate"], inputs, atol=1e-6)
        np.testing.assert_allclose(steps["tip"], 1e6 * outputs, atol=1e-6)
        assert steps["finished"].tolist() == [2.0 * i for i in range(ROWS)]
        assert record.status == "completed"
        assert record.files()[file.name] == file.read_bytes()


def test_it_is_a_run_for_the_other_commands(imported, bench, tmp_path):
    code, _, err = bench(
        "identify", imported, "--input", "plate", "--output", "tip", "--model", "polynomial",
        "--out", tmp_path / "model.json",
    )  # fmt: skip
    assert code == 0, err
    code, out, err = bench("report", imported, "--model", tmp_path / "model.json")
    assert code == 0, err
    # An imported run has neither.
    assert not re.search(r"^ *(seed|git)\b", out, re.MULTILINE)
    assert "models on this run" in out
    code, out, _ = bench("runs", tmp_path / "runs")
    assert code == 0
    assert "imported" in out
    assert bench("runs", "export", imported, "--format", "csv", "--out", tmp_path / "csv")[0] == 0
    assert bench("runs", "compare", imported, imported)[0] == 0


def test_a_model_with_time_takes_the_times_of_the_file(bench, imported):
    options = ("identify", imported, "--model", "hammerstein", "-o", "static=polynomial", "-o", "dynamics=lag")
    code, out, err = bench(*options)
    assert code == 0, err
    assert "time constant" in out


def test_without_times_rows_are_a_second_apart_and_that_is_said(bench, tmp_path):
    path = tmp_path / "plain.csv"
    path.write_text("a,b\n" + "\n".join(f"{i},{2 * i + i % 3}" for i in range(12)))
    code, out, _ = bench("runs", "import", path, "--input", "a", "--output", "b", "--out", tmp_path / "runs")
    assert code == 0
    assert "rows are 1 s apart" in out
    # These are no times to fit a model with.
    (folder,) = (tmp_path / "runs").iterdir()
    code, _, err = bench("identify", folder, "--model", "hammerstein")
    assert code == 2
    assert "--time" in err


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--input", "plate", "--output", "plate"], 2, "asked for twice"),
        (["--input", "plate", "--output", "absent"], 3, "absent"),
        (["--input", "plate", "--output", "tip", "--time", "state"], 3, "does not increase"),
    ],
)
def test_what_cannot_be_is_one_message(bench, file, tmp_path, arguments, code, words):
    found, _, err = bench("runs", "import", file, *arguments, "--out", tmp_path / "runs")
    assert found == code
    assert words in err
    assert not (tmp_path / "runs").exists()


def test_a_run_is_not_imported(bench, imported):
    code, _, err = bench("runs", "import", imported, "--input", "plate", "--output", "tip")
    assert code == 3
    assert "is a run already" in err
