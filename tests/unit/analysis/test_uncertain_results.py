"""What is known of the true errors of a run, and of a model that was identified from it."""

import json

import numpy as np
import pytest
from film import film_model
from typer.testing import CliRunner

import bench
from bench.analysis import export_run
from bench.analysis.inverted import invert_targets
from bench.analysis.uncertain_models import PROVENANCE, predicted_uncertainty, propagated
from bench.analysis.uncertain_results import control_uncertainties, draw_errors, signal_budgets, uncertain_signals
from bench.base import ConfigurationError
from bench.cli import app
from bench.identification import ModelFile
from bench.record import Record


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short run of the cantilever, with a signal that is computed from two."""
    folder = tmp_path_factory.mktemp("run")
    rig = folder / "rig.toml"
    rig.write_text(
        'extends = "vo2"\n[derived.product]\nexpression = "curvature * tec_temperature / norm"\nunit = "1/m"\n'
        'constants = { norm = "300 K" }\n'
    )
    return bench.run("creep", str(rig), out=folder, hot=70.0, cool=50.0, duration=8.0).folder


def test_drawn_errors_have_the_standard_uncertainty_and_the_correlation_of_the_budgets(run):
    with Record(run) as record:
        signals = uncertain_signals(record)
    readings = [signals.reading("curvature", {"psd_position": each}) for each in (2e-5, 7e-5, 7e-5)]
    drawn = draw_errors(readings, 40_000)
    assert drawn.std(axis=0) == pytest.approx([each.standard for each in readings], rel=0.02)
    # The same place has the same error, but for noise.
    assert np.corrcoef(drawn[:, 1], drawn[:, 2])[0, 1] > 0.99
    expanded = [each.budget().expanded for each in readings]
    assert np.mean(np.abs(drawn) <= expanded, axis=0) == pytest.approx(0.95, abs=0.015)


def test_every_signal_of_a_run_has_a_budget_or_says_that_none_is_stated(run):
    with Record(run) as record:
        budgets = signal_budgets(record, record.steps())
        assert control_uncertainties(record, "curvature") == {}
    assert {name for name, each in budgets.items() if each.stated} == {
        "psd_position", "curvature", "product", "tec_temperature"
    }  # fmt: skip
    assert budgets["tec_current"].not_stated == ("tec_current",)


def test_reports_and_exports_have_the_uncertainty(run, tmp_path):
    result = CliRunner().invoke(
        app, ["report", str(run), "--json", str(tmp_path / "report.json"), "--out", str(tmp_path)]
    )
    assert result.exit_code == 0, result.output
    found = json.loads((tmp_path / "report.json").read_text())["uncertainty"]["signals"]["curvature"]
    shares = [each["share"] for each in found["components"]]
    assert shares == sorted(shares, reverse=True)
    assert sum(shares) == pytest.approx(1.0)
    assert found["expanded"] == pytest.approx(found["coverage_factor"] * found["standard"])
    assert found["advice"] in " ".join(result.output.split())
    export_run(run, "csv", tmp_path)
    heads = (tmp_path / "readings.csv").read_text().splitlines()[0].split(",")
    assert {"u_curvature [1/m]", "u_psd_position [m]", "u_tec_temperature [°C]"} <= {*heads}
    table = np.genfromtxt(
        tmp_path / "readings.csv", delimiter=",", skip_header=1, usecols=heads.index("u_curvature [1/m]")
    )
    with Record(run) as record:
        signals, steps = uncertain_signals(record), record.steps()
    position = float(steps["psd_position"][3])
    assert table[3] == pytest.approx(signals.reading("curvature", {"psd_position": position}).standard, rel=1e-9)


def test_a_model_of_a_run_has_the_uncertainty_of_its_sensor(run):
    found = bench.identify(run, "polynomial", degree=3)
    assert found.uncertainty is not None
    highest = found.uncertainty.quantities["highest output"]
    rows = {each.component: each.contribution for each in highest.rows}
    # A gain moves a fit that is linear in the outputs by its share of them.
    lever = 0.005 / np.sqrt(3.0) * highest.value
    assert rows["lever"] == pytest.approx(lever, rel=0.1)
    # Noise of input and output, and a drift that changes within the run.
    assert min(rows[name] for name in ("fit", "laser")) > 0.0
    standard = predicted_uncertainty(found.file, np.array([100.0, 1500.0]))
    assert standard is not None
    assert (standard > found.file.provenance["rms"]).all()


def test_the_uncertainty_of_a_setpoint_behind_saturation_is_by_the_branch_from_there():
    operator = film_model()
    least, greatest = operator.output_range()
    known = {"outputs": [least, greatest], "standard": [0.0, 0.0]}
    file = ModelFile("film", operator, provenance={"rms": 2.0, PROVENANCE: known})
    state = operator.initial_state()
    targets = np.linspace(least + 60.0, greatest - 1.0, 12)[[6, 11, 3, 10]]
    found = invert_targets(file, targets)
    widths = dict(found.table())["u_setpoint [K]"]
    assert found.through_saturation
    for passed, setpoint, width in zip(found.passing.tolist(), found.setpoints.tolist(), widths, strict=True):
        state = state if np.isnan(passed) else state.step(passed)
        near = setpoint + 1e-3 * np.sign(state.input - setpoint)
        before = state.step(near)
        slope = (operator.value(before.step(setpoint)) - operator.value(before)) / (setpoint - near)
        assert width == pytest.approx(2.0 / abs(slope), rel=0.05)
        state = state.step(setpoint)


def test_a_model_of_a_computed_signal_has_the_uncertainty_of_all_behind_it(run):
    data = {"input": "tec_temperature", "degree": 1}
    product, curvature = (bench.identify(run, "polynomial", output=name, **data) for name in ("product", "curvature"))
    rows = {each.component: each.contribution for each in product.uncertainty.quantities["highest output"].rows}
    lever = 0.005 / np.sqrt(3.0) * product.uncertainty.quantities["highest output"].value
    assert rows["lever"] == pytest.approx(lever, rel=0.1)
    assert product.uncertainty.standard.shape == curvature.uncertainty.standard.shape
    assert "not stated, as the rig file states none of tec_voltage" in repr(
        bench.identify(run, "polynomial", output="tec_voltage", **data)
    )


def test_an_error_that_input_and_output_share_moves_both(run):
    with Record(run) as record:
        signals, table = uncertain_signals(record), record.steps()
        rows = {each.name: table[each.name] for each in record.signals}
    columns = {name: rows[name] for name in ("psd_position", "curvature")}

    def slopes(others):
        return [{"slope": (float(np.polyfit(*each.values(), 1)[0]), "1/m²")} for each in others]

    (nominal,) = slopes([columns])
    budget = propagated(signals, columns, rows, table["finished"], nominal, {"slope": []}, slopes)["slope"]
    parts = {row.component: row.contribution / budget.value for row in budget.rows}
    # The curvature is in proportion to the deflection, with the square of the length.
    assert parts["length"] == pytest.approx(2.0 * 1e-3 / np.sqrt(3.0), rel=0.1)
    assert parts["lever"] < 0.1 * 5e-3 / np.sqrt(3.0)


@pytest.mark.parametrize(
    ("protocol", "accuracy", "text"),
    [
        ("tracking", "2", "linearity of psd_position"),
        ("tracking", "2 K", "expected a number in 1/m"),
        ("tracking", "-2", "above 0"),
        ("tracking", "", "expected a number in 1/m"),
        ("creep", "2", "controls no signal"),
    ],
)
def test_an_accuracy_that_the_budget_does_not_support_is_refused(run, tmp_path, protocol, accuracy, text):
    arguments = [
        "run",
        protocol,
        "--rig",
        "vo2",
        "--clock",
        "virtual",
        "--accuracy",
        accuracy,
        "--out",
        str(tmp_path / "runs"),
    ]
    if protocol == "tracking":
        model = tmp_path / "model.json"
        bench.identify(run, "polynomial", degree=3).file.save(model)
        arguments += ["--set", f"model={model}", "--set", "controller=polynomial"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code != 0
    assert text in " ".join(str(result.exception or result.output).split())
    assert not (tmp_path / "runs").exists()


def test_an_accuracy_is_checked_at_the_targets_of_a_file(run, tmp_path):
    targets = tmp_path / "targets.csv"
    targets.write_text("target\n150\n250\n")
    model = tmp_path / "model.json"
    bench.identify(run, "polynomial", degree=3).file.save(model)
    asked = {"out": tmp_path / "runs", "model": str(model), "controller": "integral", "readings": 2}
    with pytest.raises(ConfigurationError, match="accuracy 14: the budget of curvature supports"):
        bench.run("tracking", "vo2", accuracy=14, **asked)
    assert not (tmp_path / "runs").exists()
    done = bench.run("tracking", "vo2", accuracy="0.014 1/mm", targets=str(targets), **asked)
    with Record(done.folder) as record:
        found = record.meta["accuracy"]
    assert found["asked"] == pytest.approx(14.0)
    assert 12.0 < found["supported"] < 14.0
