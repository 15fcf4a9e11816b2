"""The options of a model on the command line: all can be set, and a wrong one is one clear message."""

import json
from pathlib import Path

import numpy as np
import pytest
from cases import cases

from bench.identification import check_options, load_model, model_options
from bench.identification.fit.levels import quantile_levels
from bench.models import identifiable_models, timed_models

COLUMNS = ("--input", "voltage", "--output", "displacement")


@pytest.fixture
def table(tmp_path):
    inputs = 5 * np.sin(np.linspace(0, 6 * np.pi, 400)) * np.linspace(1, 0.2, 400)
    play, outputs = 0.0, []
    for value in inputs:
        play = min(max(play, value - 1.0), value + 1.0)
        outputs.append(play + 0.2 * value)
    weights = np.where(np.arange(400) < 350, 1.0, 0.0)
    path = tmp_path / "loop.csv"
    rows = np.column_stack([inputs, outputs, weights])
    np.savetxt(
        path, rows, header="voltage [V],displacement [µm],weight", delimiter=",", comments="", encoding="utf-8"
    )
    return path


def identify(bench, table, *options):
    path, result = table.parent / "model.json", table.parent / "fit.json"
    code, out, err = bench("identify", table, *COLUMNS, *options, "--out", path, "--json", result)
    assert code == 0, err
    return load_model(path).operator, json.loads(result.read_text()), out


def test_the_options_of_plays(bench, table):
    operator, _, _ = identify(
        bench, table, "--model", "prandtl-ishlinskii", "-o", "plays=8", "-o", "maximum=4", "-o", "origin=0.5",
        "-o", "dead_zones=3", "-o", "input_range=-6,6",
    )  # fmt: skip
    assert operator.thresholds.tolist() == [0.5 * i for i in range(8)]
    assert (operator.origin, operator.input_range) == (0.5, (-6.0, 6.0))
    assert operator.after.thresholds.size == 3


@pytest.mark.parametrize(
    ("model", "sign"),
    [("bouc-wen", 1), ("generalized-prandtl-ishlinskii", -1), ("krasnoselskii-pokrovskii", 1), ("maxwell-slip", -1)],
)
def test_a_model_of_elements_predicts_and_inverts_what_it_was_identified_from(bench, table, model, sign):
    name = table.parent / "falling.csv"
    header, *rows = table.read_text().splitlines()
    values = [row.split(",") for row in rows]
    name.write_text("\n".join([header, *(f"{u},{sign * float(y)},{w}" for u, y, w in values)]) + "\n")
    _, found, _ = identify(bench, name, "--model", model)
    assert found["rms_percent"] < 10.0
    result, path = table.parent / "result.json", table.parent / "model.json"
    code, _, err = bench("predict", path, name, *COLUMNS, "--out", table.parent / "o.csv", "--json", result)
    assert code == 0, err
    assert json.loads(result.read_text())["rms"] == pytest.approx(found["rms"], rel=1e-9)
    targets = table.parent / "targets.csv"
    targets.write_text("\n".join((table.parent / "o.csv").read_text().splitlines()[:60]) + "\n")
    code, _, err = bench(
        "invert", path, targets, "--column", "predicted", "--out", table.parent / "i.csv",
        "--json", result,
    )  # fmt: skip
    assert code == 0, err
    inverted = json.loads(result.read_text())
    assert inverted["met"] == inverted["targets"]
    assert inverted["largest_residual"] < 1e-9


def test_of_several_levels_cross_validation_chooses(bench, table):
    operator, found, out = identify(bench, table, "--model", "preisach", "--levels", "4,20")
    assert "cross-validation" in out
    chosen = next(line.split() for line in out.splitlines() if line.startswith(" * "))
    assert found["levels"] == operator.order == int(chosen[1])
    assert sum(line.split()[-5:-4] in (["4"], ["20"]) for line in out.splitlines()) == 2


def test_levels_may_be_given_or_lie_where_the_input_turns(bench, table):
    operator, _, _ = identify(bench, table, "--model", "preisach", "-o", "levels=-5,-2,-1,0,0.5,3,5")
    assert operator.levels.tolist() == [-5.0, -2.0, -1.0, 0.0, 0.5, 3.0, 5.0]
    operator, found, _ = identify(bench, table, "--model", "preisach", "--levels", "10", "-o", "spacing=quantiles")
    assert operator.order == 10
    assert np.ptp(np.diff(operator.levels)) > 0.1
    assert found["rms_percent"] < 2.0
    targets = operator.evaluate(np.sin(np.arange(50.0)))
    np.testing.assert_allclose(operator.inverse().follow(targets).outputs, targets, atol=1e-12)


def test_the_weight_of_a_row(bench, table):
    lines = table.read_text().splitlines()
    spoilt = [line if n < 351 else ",".join([line.split(",")[0], "99", "0"]) for n, line in enumerate(lines)]
    table.write_text("\n".join(spoilt) + "\n")
    spoilt, _, _ = identify(bench, table, "--model", "prandtl-ishlinskii", "--weights", "weight")
    plain, _, _ = identify(bench, table, "--model", "prandtl-ishlinskii")
    top = spoilt.evaluate(np.linspace(0.0, 5.0, 50))[-1]
    assert top == pytest.approx(5.0, abs=0.1)
    assert plain.evaluate(np.linspace(0.0, 5.0, 50))[-1] != pytest.approx(5.0, abs=0.5)


@cases(
    ("options", "words"),
    [
        (["--model", "prandtl-ishlinskii", "--levels", "20"], ["there is no levels", "plays (15)", "dead_zones (0)"]),
        (["--model", "prandtl-ishlinskii", "-o", "plays=many"], ["plays: expected an integer, got 'many'"]),
        (["--model", "preisach", "-o", "plays=3"], ["there is no plays", "levels (20)", "reversible (none)"]),
        (["--model", "preisach", "-o", "spacing=odd"], ["spacing: expected one of uniform, quantiles"]),
        (["--model", "preisach", "--levels", "1"], ["--levels 1", "from 2 to 1000"]),
        (["--model", "preisach", "--levels", "4", "-o", "levels=1,2"], ["levels is given twice"]),
        (["--model", "preisach", "--plane", "0", "1", "-o", "plane=1,2"], ["plane is given twice"]),
    ],
)
def test_a_wrong_option_is_one_message(bench, table, options, words):
    code, _, err = bench("identify", table, *COLUMNS, *options)
    assert code in (2, 3)
    assert "Traceback" not in err
    for word in words:
        assert word in " ".join(err.split())


def test_the_list_says_what_each_model_takes(bench, tmp_path):
    code, out, _ = bench("show", "models", "--json", tmp_path / "models.json")
    assert code == 0
    listed = json.loads((tmp_path / "models.json").read_text())
    assert listed.keys() == identifiable_models().keys() | timed_models().keys()
    assert {"exact", "numerical", "table", "none"} >= {each["inverse"] for each in listed.values()}
    assert "inverse" in out
    for name in ("preisach", "prandtl-ishlinskii"):
        _, shown, _ = bench("show", name)
        assert all(option in shown for option in listed[name]["options"])
        assert "inverse: exact" in shown


def test_every_model_is_described():
    page = (Path(__file__).parents[2] / "docs" / "reference" / "models.md").read_text(encoding="utf-8")
    for name in identifiable_models():
        assert f"| `{name}` |" in page


def test_every_option_of_every_model_is_explained():
    for spec in identifiable_models().values():
        for option in model_options(spec):
            assert option.text, option
            assert option.default not in ("", "none" if option.name != "reversible" else ""), option


def test_an_option_of_the_wrong_kind_is_refused():
    for options in ({"plays": 2.5}, {"plays": True}, {"input_range": (1.0, 2.0, 3.0)}, {"maximum": "wide"}):
        with pytest.raises(ValueError, match=rf"^{next(iter(options))}: expected"):
            check_options("prandtl-ishlinskii", options)
    check_options("prandtl-ishlinskii", {"input_range": [0, 1], "maximum": np.float64(3.0)})


def test_quantile_levels_follow_the_reversals():
    inputs = np.concatenate([[0.0, 10.0], *[[2.0 + 0.01 * k, 3.0] for k in range(40)], [10.0]])
    levels = quantile_levels(inputs, (0.0, 10.0), 20)
    assert (levels[0], levels[-1], levels.size) == (0.0, 10.0, 21)
    assert ((levels > 1.9) & (levels < 3.1)).sum() >= 10
    assert np.diff(levels).min() > 0.02
