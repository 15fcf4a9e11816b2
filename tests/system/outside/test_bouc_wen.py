"""A model of a package outside, one file and an entry point: identified, saved, predicted, inverted, shown."""

import csv
import json
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from bench.base import DataError, registry
from bench.control import ControllerSetup, make_controller
from bench.identification import ModelFile, damped_oscillation, identify, load_model
from bench.models import Preisach, QuadraticTerm, Reach, operator_from_json, uniform_levels

PACKAGE = Path(__file__).parent / "boucwen_package"
TRUE = {"rho": 1.2, "sigma": 1.6, "n": 1.8}
INPUTS = damped_oscillation(-5.0, 5.0, 0.0, 20, 0.2)


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Install the package as pip would: its module and its metadata on the import path; return the module."""
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text())["project"]
    site = tmp_path_factory.mktemp("site")
    info = site / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    lines = [
        f"[{group}]\n{name} = {value}\n"
        for group, all_ in project["entry-points"].items()
        for name, value in all_.items()
    ]
    (info / "entry_points.txt").write_text("".join(lines))
    (site / "bouc_wen.py").write_text((PACKAGE / "bouc_wen.py").read_text())
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(site))
        registry.forget()
        yield registry.load("models", "normalised-bouc-wen").model
    sys.modules.pop("bouc_wen")
    registry.forget()


@pytest.fixture(scope="module")
def true(installed):
    return installed(0.4, 3.0, 0.5, **TRUE, input_range=(-5.0, 5.0), input_unit="V", output_unit="µm")


@pytest.fixture(scope="module")
def found(true):
    outputs = true.evaluate(INPUTS) + 0.02 * np.random.default_rng(0).normal(size=INPUTS.size)
    return identify("normalised-bouc-wen", INPUTS, outputs, input_unit="V", output_unit="µm")


@pytest.fixture
def bench(bench):
    """Run a command in this process; return its standard output."""

    def run(*arguments):
        code, out, err = bench(*arguments)
        assert code == 0, err
        return out

    return run


def write(path, header, *columns):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *zip(*columns, strict=True)])
    return path


class TestOperator:
    def test_identification_recovers_its_parameters_from_noisy_data(self, true, found):
        model = found.model
        assert (model.rho, model.sigma, model.n) == pytest.approx(tuple(TRUE.values()), rel=0.03)
        assert (model.stiffness, model.amplitude, model.bias) == pytest.approx((0.4, 3.0, 0.5), rel=0.02)
        assert np.sqrt(np.mean((model.evaluate(INPUTS) - true.evaluate(INPUTS)) ** 2)) < 0.005
        assert found.errors.rms == pytest.approx(0.02, rel=0.1)

    def test_identification_is_deterministic(self, found):
        outputs = found.residuals + found.model.evaluate(INPUTS)
        assert identify("normalised-bouc-wen", INPUTS, outputs).model.coefficients == pytest.approx(
            found.model.coefficients, abs=0
        )

    @pytest.mark.usefixtures("installed")
    def test_fits_a_plant_of_another_structure(self):
        order = 20
        middle = 0.5 * (np.arange(order) + np.arange(1, order + 1)) / order * 10.0 - 5.0
        i, j = np.tril_indices(order)
        density = np.exp(-0.5 * ((middle[i] - middle[j] - 2.0) / 1.0) ** 2)
        plant = Preisach(uniform_levels(-5.0, 5.0, order), density, 1.0, QuadraticTerm(0.2))
        outputs = plant.evaluate(INPUTS)
        bouc_wen = identify("normalised-bouc-wen", INPUTS, outputs, initial="negative")
        polynomial = identify("polynomial", INPUTS, outputs, degree=5)
        assert bouc_wen.errors.rms_percent < 5.0
        assert bouc_wen.errors.rms < 0.5 * polynomial.errors.rms

    def test_the_defaults_of_the_base_class_agree_with_what_it_overrides(self, true):
        state = true.initial_state()
        outputs = []
        for value in INPUTS[:200]:
            state, output = true.step(state, value)
            outputs.append(output)
        np.testing.assert_allclose(true.evaluate(INPUTS[:200]), outputs, atol=1e-12)
        assert true.advance(true.initial_state(), INPUTS[:200]) == pytest.approx(state)
        assert true.value(state) == pytest.approx(output)
        np.testing.assert_allclose(
            true.bias + true.regressor(INPUTS).product(true.coefficients), true.evaluate(INPUTS), atol=1e-12
        )
        assert true.state_from_json(json.loads(json.dumps(true.state_to_json(state)))) == state
        low, high = true.output_range()
        assert (low, high) == pytest.approx((0.5 - 2.0 - 3.0, 0.5 + 2.0 + 3.0), abs=0.01)
        assert true.saturated_state(1).input == 5.0
        assert true.saturated_state(-1, 2.0).z == pytest.approx(true.step(true.saturated_state(-1), 2.0)[0].z)
        assert true.rises()
        assert 0 < true.unknown_until(INPUTS[30:]) < 200
        assert operator_from_json(json.loads(json.dumps(true.to_json()))).to_json() == true.to_json()

    def test_inverse_meets_targets_from_every_memory(self, true):
        rng = np.random.default_rng(1)
        inverse = true.inverse()
        state = true.initial_state()
        for target in rng.uniform(-4.5, 5.0, 100):
            inverted = inverse.invert(state, target)
            assert inverted.reach is Reach.MET
            for setpoint in inverted.setpoints:
                state, output = true.step(state, setpoint)
            assert output == pytest.approx(target, abs=1e-10)
            assert inverted.state == pytest.approx(state)
        assert inverse.invert(state, 50.0).reach is Reach.TOO_HIGH
        assert inverse.invert(state, -50.0).reach is Reach.TOO_LOW
        assert inverse.nearest_input(state, state.input, true.value(state)) == state.input

    def test_controllers_work_with_it(self, true):
        setup = ControllerSetup(model=ModelFile("normalised-bouc-wen", true), limits=(-5.0, 5.0), dwell=8.0)
        actuator = true.step(true.initial_state(), 0.0)
        for name in ("open-loop-inverse", "closed-loop-inverse"):
            controller = make_controller("target", name, setup)
            state, output = actuator
            command = controller.aim(2.5, 0.0, state.input, output)
            for n in range(1, 100):
                state, output = true.step(state, command.setpoint)
                command = controller.update(0.1 * n, state.input, output)
            assert output == pytest.approx(2.5, abs=1e-6)
            assert command.done
        with pytest.raises(DataError, match="latched needs a Preisach model with a reversible part"):
            make_controller("target", "latched", setup)
        with pytest.raises(DataError, match="polynomial needs a model without memory"):
            make_controller("target", "polynomial", setup)


class TestCommands:
    def test_identify_predict_compare_invert(self, bench, true, tmp_path):
        data = write(tmp_path / "loop.csv", ["voltage [V]", "position [µm]"], INPUTS, true.evaluate(INPUTS))
        columns = ["--input", "voltage", "--output", "position"]
        assert "normalised-bouc-wen" in bench("list")
        for model in ("normalised-bouc-wen", "polynomial"):
            path = tmp_path / f"{model}.json"
            fitted = tmp_path / f"{model}-fit.json"
            bench(
                "identify", data, *columns, "--model", model, "--out", path, "--figures", tmp_path / "figures",
                "--json", fitted,
            )  # fmt: skip
        assert json.loads((tmp_path / "normalised-bouc-wen-fit.json").read_text())["shape"] == pytest.approx(
            TRUE, rel=1e-3
        )
        assert "shape" not in json.loads((tmp_path / "polynomial-fit.json").read_text())
        drawn = {path.name for path in (tmp_path / "figures").iterdir()}
        assert {"normalised-bouc-wen-loops.png", "normalised-bouc-wen-errors.png"} <= drawn

        file = load_model(tmp_path / "normalised-bouc-wen.json", "normalised-bouc-wen")
        assert file.memory == pytest.approx(file.operator.advance(file.operator.initial_state(), INPUTS))
        assert (file.operator.input_unit, file.operator.output_unit) == ("V", "µm")

        result = tmp_path / "result.json"
        bench(
            "predict",
            tmp_path / "normalised-bouc-wen.json",
            data,
            *columns,
            "--out",
            tmp_path / "o.csv",
            "--json",
            result,
        )
        assert json.loads(result.read_text())["rms"] < 1e-5

        models = [tmp_path / "normalised-bouc-wen.json", tmp_path / "polynomial.json"]
        bench("model", "test", *models, "--data", data, "--json", result)
        compared = json.loads(result.read_text())
        assert compared["normalised-bouc-wen"]["raw"]["rms"] < 1e-3 * compared["polynomial"]["raw"]["rms"]

        targets = write(tmp_path / "targets.csv", ["target [µm]"], [1.0, -2.0, 3.0, 0.5, 50.0])
        bench("invert", models[0], targets, "--column", "target", "--out", tmp_path / "s.csv", "--json", result)
        inverted = json.loads(result.read_text())
        assert (inverted["met"], inverted["too_high"]) == (4, 1)
        assert inverted["largest_residual"] < 1e-10

    @pytest.mark.usefixtures("installed")
    def test_report_shows_it(self, bench, tmp_path):
        bench(
            "run", "damped-oscillation", "--rig", "vo2", "--clock", "virtual", "--set", "half_cycles=2",
            "--set", "increment=12", "--out", tmp_path, "--json", tmp_path / "run.json",
        )  # fmt: skip
        folder = json.loads((tmp_path / "run.json").read_text())["folder"]
        model = tmp_path / "normalised-bouc-wen.json"
        columns = ["--input", "tec_temperature", "--output", "curvature"]
        bench("identify", folder, *columns, "--model", "normalised-bouc-wen", "--out", model)
        bench("report", folder, "--model", model, "--out", tmp_path / "report", "--json", tmp_path / "report.json")
        report = json.loads((tmp_path / "report.json").read_text())
        assert report["models"]["normalised-bouc-wen"]["rms"] > 0
        assert all(Path(path).stat().st_size > 0 for path in report["figures"])

    def test_what_is_not_registered_is_not_saved(self, installed, tmp_path):
        class Other(installed):
            kind = "other-bouc-wen"

        with pytest.raises(DataError, match=r"is not written.*register it in an entry of the group bench\.models"):
            ModelFile("other", Other()).save(tmp_path / "m.json")
        assert not (tmp_path / "m.json").exists()
