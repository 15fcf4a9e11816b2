"""A model starts where its identification did: `predict` and `model test` give the errors of `identify`."""

import json

import numpy as np
import pytest

from bench import identify
from bench.analysis import ColumnNames, compare_models, load_models, read_dataset, starting_state
from bench.analysis.tables.dataset import digest
from bench.base import ConfigurationError
from bench.identification import ModelFile, load_model
from bench.models import PrandtlIshlinskii, Preisach, identifiable_models, uniform_levels

COLUMNS = ("--input", "voltage", "--output", "displacement")
NAMES = {"input": "voltage", "output": "displacement"}
LEVELS = uniform_levels(0.0, 10.0, 8)

INITIAL = [{}, *({"initial": kind} for kind in ("negative", "positive", "skip"))]
OPTIONS = [*INITIAL, {"initial": "positive", "skip": 30}, {"skip": 30}]
OF_MODELS = {
    "preisach": [
        {"levels": 6},
        {"levels": 6, "initial": "estimate"},
        {"levels": 6, "reversible": "linear"},
        {"levels": 6, "reversible": "polynomial", "degree": 3},
        {"levels": 6, "smoothing": 1e-2},
        {"levels": 6, "cross_validated": True},
        {"levels": 6, "plane": (1.0, 9.0), "initial": "skip", "skip": 20},
        {"levels": 6, "orientation": "rising"},
        {"levels": 6, "orientation": "falling"},
    ],
    "preisach-nonmonotonic": [{"levels": 6, "initial": "estimate"}, {"levels": 6, "reference": 2.0}],
    "preisach-signed": [{"levels": 6, "reversible": "quadratic"}],
    "prandtl-ishlinskii": [{"plays": 5}, {"dead_zones": 3, "initial": "skip"}],
    "polynomial": [{"degree": 3}],
}
CASES = [(name, options) for name in identifiable_models() for options in OPTIONS + OF_MODELS.get(name, [])]
SOME = [(name, options) for name, options in CASES if options in ({}, *OF_MODELS.get(name, []))]
SOME += [("preisach", options) for options in OPTIONS[-2:]]
FALLING = [(name, {}) for name in identifiable_models()]
"""What `make test` looks at; `make test-all` looks at all."""


def write(path, sign, rows=160):
    """Write a file that starts on the way down from positive saturation."""
    angles = np.linspace(1.2, 41.0, rows)
    inputs = 5.0 + 5.0 * np.cos(angles) * np.interp(angles, [0.0, 6.2, 41.0], [0.9, 1.0, 0.2])
    specimen = Preisach(LEVELS, np.random.default_rng(0).random(36), 3.0)
    outputs = specimen.evaluate(inputs, specimen.saturated_state(1))
    outputs = sign * outputs + 0.1 * np.random.default_rng(1).normal(size=inputs.size)
    table = np.column_stack([inputs, outputs])
    np.savetxt(path, table, delimiter=",", header="voltage [V],displacement [µm]", comments="", encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    return {sign: write(folder / f"data{sign}.csv", sign) for sign in (1, -1)}


@pytest.mark.parametrize(
    ("sign", "cases"),
    [
        pytest.param(1, SOME, id="rising"),
        pytest.param(-1, FALLING, id="falling"),
        pytest.param(1, CASES, id="rising-all", marks=pytest.mark.seeds),
        pytest.param(-1, CASES, id="falling-all", marks=pytest.mark.seeds),
    ],
)
def test_a_model_has_the_errors_of_its_identification_on_its_data(tmp_path, data, sign, cases):
    """For every registered model and option, to the last digit."""
    path = tmp_path / "model.json"
    for name, options in cases:
        found = identify(data[sign], name, **NAMES, **options)
        found.file.save(path)
        compared = compare_models(load_models([path]), read_dataset([data[sign]], ColumnNames(**NAMES)))
        skip = found.identification.skip
        assert compared.skip == skip == load_model(path).provenance["skipped"], (name, options)
        assert compared.comparisons["model"].raw == found.identification.errors, (name, options)
        np.testing.assert_array_equal(compared.comparisons["model"].residuals, found.identification.residuals)
        assert skip >= options.get("skip", 0), (name, options)


def printed_errors(out):
    return [line.split(None, 2)[2].rstrip() for line in out.splitlines() if "error" in line and "range" in line]


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("preisach", ["--initial", "estimate", "--levels", 5, "--skip", 12]),
        ("prandtl-ishlinskii", ["--initial", "skip"]),
    ],
)
def test_predict_prints_the_errors_of_identify(bench, tmp_path, data, name, options):
    model, result = tmp_path / "model.json", tmp_path / "result.json"
    code, identified, err = bench(
        "identify", data[1], *COLUMNS, "--model", name, *options, "--out", model, "--json", result
    )
    assert code == 0, err
    fit = json.loads(result.read_text())
    code, predicted, err = bench("predict", model, data[1], *COLUMNS, "--out", tmp_path / "out.csv", "--json", result)
    assert code == 0, err
    assert printed_errors(predicted) == printed_errors(identified) != []
    again = json.loads(result.read_text())
    assert fit["samples"] == 160 - again["skipped"]
    for key in ("max", "rms", "average", "max_percent", "rms_percent"):
        assert fit[key] == again[key]


def test_the_start_is_kept_and_can_be_chosen(bench, tmp_path, data):
    model, result = tmp_path / "model.json", tmp_path / "result.json"
    options = ["--model", "preisach", "--levels", "8", "--initial", "positive"]
    bench("identify", data[1], *COLUMNS, *options, "--out", model)
    errors = {}
    for initial in (None, "file", "positive", "negative", "skip"):
        chosen = () if initial is None else ("--initial", initial)
        out = tmp_path / f"{initial}.csv"
        assert bench("predict", model, data[1], *COLUMNS, *chosen, "--out", out, "--json", result)[0] == 0
        found = json.loads(result.read_text())
        errors[initial] = found["rms_percent"], found["skipped"]
        assert bench("model", "test", model, "--data", data[1], *chosen, "--json", result)[0] == 0
        assert json.loads(result.read_text())["model"]["raw"]["rms_percent"] == found["rms_percent"]
    assert errors[None] == errors["file"] == errors["positive"]
    assert errors[None][0] < 1.0
    assert errors["negative"][0] > 2.0 * errors[None][0]
    assert errors["skip"][0] < 1.0
    assert errors["skip"][1] > 0
    targets = tmp_path / "targets.csv"
    targets.write_text("target\n" + "".join(f"{value}\n" for value in (4.0, 8.0, 5.0)))
    setpoints = {}
    for chosen in ((), ("--initial", "file"), ("--initial", "positive"), ("--initial", "negative")):
        out = tmp_path / "setpoints.csv"
        assert bench("invert", model, targets, "--column", "target", *chosen, "--out", out)[0] == 0
        setpoints[chosen[-1:]] = out.read_text()
    assert setpoints[()] == setpoints[("file",)] == setpoints[("positive",)] != setpoints[("negative",)]
    for command in (
        ["predict", model, data[1], *COLUMNS, "--out", tmp_path / "o.csv", "--initial", "somewhere"],
        ["predict", model, data[1], *COLUMNS, "--out", tmp_path / "o.csv", "--initial", "file", "--continue-memory"],
        ["predict", model, data[1], *COLUMNS, "--out", tmp_path / "o.csv", "--skip", "160"],
        ["invert", model, targets, "--column", "target", "--out", tmp_path / "o.csv", "--initial", "skip"],
    ):
        code, _, err = bench(*command)
        assert (code, err.count("error:")) == (2, 1), err


class TestStartingState:
    INPUTS = np.array([5.0, 0.0, 10.0, 2.0, 8.0])
    OPERATOR = Preisach(LEVELS, np.ones(36), input_range=(0.0, 10.0))

    def file(self, **provenance):
        return ModelFile("m", self.OPERATOR, None, provenance, self.OPERATOR.saturated_state(1))

    def test_its_own_data_leave_out_what_identification_left_out(self):
        own = self.file(skipped=3, input_sha256=digest(self.INPUTS))
        assert starting_state(own, self.INPUTS).skip == 3
        assert starting_state(own, self.INPUTS, skip=1).skip == 1
        assert starting_state(own, self.INPUTS[:4]).skip == 0

    def test_unknown_memory_leaves_out_what_the_inputs_leave_unknown(self):
        unknown = self.file(skipped=3, initial="skip", input_sha256="of others")
        assert starting_state(unknown, self.INPUTS).skip == self.OPERATOR.unknown_until(self.INPUTS) == 1
        assert starting_state(unknown, self.INPUTS, skip=0).skip == 0
        assert starting_state(self.file(), self.INPUTS, initial="skip", skip=4).skip == 4

    def test_a_file_without_a_start_has_that_of_its_operator(self):
        old = ModelFile("m", self.OPERATOR, None)
        assert starting_state(old).state == self.OPERATOR.initial_state()
        assert starting_state(self.file()).state == self.OPERATOR.saturated_state(1)
        plays = PrandtlIshlinskii([0.0, 1.0], [1.0, 1.0])
        assert starting_state(ModelFile("m", plays), initial="negative").state == plays.saturated_state(-1)

    def test_the_end_of_its_data(self):
        file = ModelFile("m", self.OPERATOR, self.OPERATOR.saturated_state(1, 4.0))
        assert starting_state(file, continue_memory=True).state == file.memory
        with pytest.raises(ConfigurationError, match="--initial file and --continue-memory exclude each other"):
            starting_state(file, initial="file", continue_memory=True)

    def test_the_start_survives_the_file(self, tmp_path):
        file = self.file(source="x.csv")
        file.save(tmp_path / "m.json")
        assert load_model(tmp_path / "m.json").initial == file.initial
        document = json.loads((tmp_path / "m.json").read_text())
        del document["initial"]
        (tmp_path / "old.json").write_text(json.dumps(document))
        assert load_model(tmp_path / "old.json").initial is None
