"""Every file of JSON that a command writes is JSON (RFC 8259): no NaN and no Infinity stands in it."""

import json
import math

import numpy as np
import pytest
from written_run import META, SIGNALS

from bench.analysis import write_csv
from bench.base import json_text
from bench.batch import StudyResult
from bench.batch.campaign.study_tables import over_seeds, write_study
from bench.devices import Settled
from bench.execution.guardian.black_box import BlackBox
from bench.record import BLACK_BOX_NAME, FILE_NAME, Journal, StepRecord, add_model
from bench.record.model_files import models_beside

NAN, INFINITY = math.nan, math.inf


def refuse(word):
    raise AssertionError(f"{word} is no JSON")


def strict(path):
    """Return what a file says, a list of JSON lines if it is one."""
    text = path.read_text(encoding="utf-8")
    parts = text.splitlines() if path.suffix == ".jsonl" else [text]
    return [json.loads(part, parse_constant=refuse) for part in parts]


def assert_strict(folder):
    """Check every file of JSON below a folder; return how many there are."""
    files = [path for path in folder.rglob("*") if path.suffix in (".json", ".jsonl")]
    for path in files:
        strict(path)
    return len(files)


@pytest.fixture
def run(tmp_path):
    """A run in which a signal has no value in some rows, and one a set-point that is not finite."""
    folder = tmp_path / "run"
    folder.mkdir()
    meta = {**META, "overrides": {}, "limits": {"plate": [-INFINITY, INFINITY]}, "parameters": {"high": NAN}}
    journal = Journal(folder / FILE_NAME, SIGNALS, meta)
    for i in range(40):
        values = (20.0 + i % 9, 20.0 + i % 9, 1e-6 * (i % 9) ** 2, NAN if i % 2 else 0.0)
        journal.telemetry(8.0 * i, i, (*values[:3], NAN))
        journal.step(StepRecord(i, 8.0 * i, 8.0 * i + 8.0, "loops", "", Settled.DWELL, {"plate": 1.0}, values))
    late = {"hold": {"rate": None, "samples": 1, "left_out": 0, "mean": NAN, "worst": INFINITY, "edges": [1.0],
                     "counts": [1, 0]}}  # fmt: skip
    journal.finish(status="completed", reason="", finished=NAN, safe_state={"plate": "safe"}, lateness=late)
    journal.close()
    return folder


@pytest.mark.parametrize(
    ("content", "read"),
    [
        ({"a": NAN, "b": [INFINITY, -INFINITY, 1.5]}, {"a": None, "b": [None, None, 1.5]}),
        ({"a": (np.float64("nan"), {"b": NAN})}, {"a": [None, {"b": None}]}),
        ({"a": 0.1, "b": None, "c": True}, {"a": 0.1, "b": None, "c": True}),
    ],
)
def test_a_number_that_is_not_finite_is_null(content, read):
    assert json.loads(json_text(content), parse_constant=refuse) == read


@pytest.mark.slow
def test_every_command_that_reads_a_run(run, tmp_path, bench):
    out = tmp_path / "out"
    for kind in ("csv", "parquet", "bluesky"):
        words = ("runs", "export", run, "--format", kind, "--out", out, "--json", out.parent / f"{kind}.json")
        assert bench(*words)[0] == 0
    for number, words in enumerate((("runs", "compare", run, run), ("runs", run), ("report", run, "--out", out))):
        assert bench(*words, "--json", tmp_path / f"{number}.json")[0] == 0
    assert assert_strict(tmp_path) >= 8
    metadata = strict(out / "metadata.json")[0]
    assert metadata["limits"] == {"plate": [None, None]}


def test_what_the_guardian_has_seen(tmp_path):
    box = BlackBox()
    box.saw({"force": NAN})
    box.keep_in(tmp_path, rig="vo2")
    box.note("failed", reason="it hung", rate=INFINITY)
    box.close()
    # A look from before the run stands behind the beginning of its record.
    begin, look, note = strict(tmp_path / BLACK_BOX_NAME)
    assert begin["rig"] == "vo2"
    assert look["values"] == {"force": None}
    assert note["reason"] == "it hung"


def test_a_model_beside_a_run(run):
    add_model(run, "fit", 1.0, {"rms": NAN, "levels": [1.0, 2.0]})
    assert assert_strict(run) == 1
    assert models_beside(run)["fit"] == {"rms": None, "levels": [1.0, 2.0]}


def test_a_value_that_a_study_does_not_have_is_none_again(tmp_path):
    for seed, value in enumerate((NAN, 2.0)):
        (tmp_path / str(seed)).mkdir()
        write_study(StudyResult({"error": value, "name": "x"}, (), ()), tmp_path / str(seed))
    contents = [strict(tmp_path / str(seed) / "study.json")[0] for seed in (0, 1)]
    error = over_seeds([content["values"] for content in contents])["error"]
    assert math.isnan(error.values[0])
    assert f"{error:.1f}" == "2.0"


class TestOverflow:
    """A model whose numbers are too great has no outputs, and none are written."""

    @pytest.fixture
    def model(self, tmp_path, bench):
        inputs = np.tile([0.0, 1.0, 2.0, 3.0, 2.0, 1.0], 5)
        write_csv(tmp_path / "loop.csv", [("u", inputs), ("y", inputs + inputs**2)])
        model = tmp_path / "model.json"
        words = ("--model", "polynomial", "--input", "u", "--output", "y", "--out", model)
        assert bench("identify", tmp_path / "loop.csv", *words)[0] == 0
        content = json.loads(model.read_text())
        content["model"]["series"] = [1.7e308 for _ in content["model"]["series"]]
        model.write_text(json.dumps(content))
        return model

    def test_of_predictions_is_an_error_that_names_the_row(self, model, tmp_path, bench):
        out = tmp_path / "predicted.csv"
        code, _, err = bench("predict", model, tmp_path / "loop.csv", "--input", "u", "--out", out)
        assert code == 3
        assert "row 1," in err
        assert "overflow" in err
        assert not out.exists()

    def test_of_an_inverse_is_an_error(self, model, tmp_path, bench):
        out = tmp_path / "setpoints.csv"
        code, _, err = bench("invert", model, tmp_path / "loop.csv", "--column", "y", "--out", out)
        assert code == 3
        assert "model polynomial" in err
        assert not out.exists()
