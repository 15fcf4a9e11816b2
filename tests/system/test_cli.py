"""The command line: what it prints, what it writes, what it exits with."""

import csv
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cases import cases

from bench.cli import main
from bench.record import Record

FAST = ["--rig", "vo2", "--clock", "virtual"]


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    result = folder / "run.json"
    command = ["damped-oscillation", *FAST, "--set", "half_cycles=2", "--set", "increment=3", "--out", str(folder)]
    with pytest.raises(SystemExit) as stopped:
        main(["run", *command, "--json", str(result)])
    assert not stopped.value.code
    return json.loads(result.read_text())


def write_loop(path, rows=400):
    """A CSV file of a rate-independent loop that a Preisach operator fits."""
    inputs = 5 * np.sin(np.linspace(0, 6 * np.pi, rows)) * np.linspace(1, 0.2, rows)
    play, outputs = 0.0, []
    for value in inputs:
        play = min(max(play, value - 1.0), value + 1.0)
        outputs.append(play + 0.2 * value)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["voltage [V]", "displacement [µm]"])
        writer.writerows(zip(inputs, outputs, strict=True))
    return inputs, np.array(outputs)


class TestHelp:
    @cases(
        ("protocol", "parameters"),
        [
            ("length-voltage", {"points": ("37", "1"), "loads": ("the rig's: 5 over the range of load", "N")}),
            ("length-control", {"model": ("must be given", ""), "controller": ("closed-loop-inverse", "")}),
            ("piezo-step", {"voltage": ("the rig's: `high` of fine", "V"), "rate": ("20000.0", "Hz")}),
            ("hybrid-control", {"speed": ("must be given", "m/s"), "witness": ("False", "")}),
        ],
    )
    def test_the_help_of_a_protocol_has_its_parameters_with_units(self, bench, tmp_path, protocol, parameters):
        code, out, _ = bench("run", protocol, "--help")
        assert code == 0
        bench("show", protocol, "--json", tmp_path / "list.json")
        shown = {entry["name"]: entry for entry in json.loads((tmp_path / "list.json").read_text())["parameters"]}
        # As everywhere, what stands in brackets.
        assert "[default: rehearse]" in out
        for name, (default, unit) in parameters.items():
            assert name in out
            assert (shown[name]["default"], shown[name]["unit"]) == (default, unit)
            assert shown[name]["text"]

    def test_a_parameter_of_a_study_is_set_with_its_protocol(self, bench, tmp_path):
        for wrong in ("count=9", "nothing.count=9"):
            code, _, err = bench("study", "vo2", "--set", wrong, "--out", tmp_path / "out")
            assert (code, err.count("error: ")) == (2, 1)
            assert not (tmp_path / "out").exists()

    def test_help_does_not_import_what_it_does_not_need(self):
        code = (
            "import sys\n"
            "from bench.cli import main\n"
            "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
            "heavy = {'numpy', 'pydantic', 'numba', 'scipy', 'rerun', 'matplotlib', 'pymodbus', 'pyarrow'}\n"
            "heavy &= set(sys.modules)\n"
            "assert not heavy, heavy\n"
        )
        subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


class TestList:
    def test_shows_rigs_protocols_and_models(self, bench, tmp_path):
        code, out, _ = bench("list", "--json", tmp_path / "list.json")
        assert code == 0
        content = json.loads((tmp_path / "list.json").read_text())
        assert {"vo2", "vo2-hardware"} <= set(content["rigs"])
        assert {"creep", "damped-oscillation", "random-validation"} <= set(content["protocols"])
        assert {"preisach", "preisach-signed", "preisach-nonmonotonic", "polynomial"} <= set(content["models"])
        assert "vo2-hardware" in out


class TestRun:
    def test_leaves_a_record_and_a_recording(self, finished_run):
        folder = Path(finished_run["folder"])
        assert finished_run["status"] == "completed"
        assert finished_run["safe_state"] == {"tec": "safe", "psd": "safe"}
        assert finished_run["laboratory_seconds"] > 8 * finished_run["steps"]
        assert (folder / "run.rrd").stat().st_size > 0
        with Record(folder) as record:
            steps = record.steps()
            assert len(steps) == finished_run["steps"]
            assert record.meta["seed"] == 0
            assert "Meerstetter" in record.meta["devices"]["tec"]
            assert record.meta["parameters"]["half_cycles"] == 2
            assert record.meta["calibration"]["psd"]["volts_per_metre"] == 1e5
            # The plate arrives at each set-point, and the beam bends by about what the film makes it.
            assert np.max(np.abs(steps["tec_temperature"] - steps["tec_setpoint"])) < 0.2
            assert np.ptp(steps["curvature"]) > 1500

    def test_a_name_is_never_markup(self, bench, tmp_path):
        folder = tmp_path / "runs[" / "red]"
        script = tmp_path / "x[" / "red].py"
        script.parent.mkdir()
        script.write_text(
            "from bench.protocol import Dwell, Phase, ProtocolParameters, Step, protocol\n"
            "@protocol(needs=('tec',))\n"
            "def hold(parameters: ProtocolParameters):\n"
            "    'Hold [/red].'\n"
            "    yield Phase('[/red] phase')\n"
            "    yield Step({'tec': 30.0}, Dwell(1.0), label='[/red]')\n"
        )
        code, out, err = bench("run", script, *FAST, "--out", folder)
        assert (code, err) == (0, "")
        assert f"record: {folder}" in out

    def test_hardware_that_does_not_answer_is_one_message(self, bench, tmp_path):
        override = f"devices.tec.port={tmp_path}/none"
        code, _, err = bench("run", "creep", "--rig", "vo2-hardware", "--override", override, "--out", tmp_path)
        assert code == 4
        assert "tec" in err
        assert "Traceback" not in err

    def test_interlock_ends_the_run_and_keeps_the_record(self, bench, tmp_path):
        rig = tmp_path / "tight.toml"
        _, text, _ = bench("show", "vo2")
        rig.write_text(text.replace("high = 100.0", "high = 60.0"))
        code, _, err = bench(
            "run", "creep", "--rig", rig, "--clock", "virtual", "--out", tmp_path, "--json", tmp_path / "r.json"
        )
        assert code == 5
        assert "tec_temperature" in err
        result = json.loads((tmp_path / "r.json").read_text())
        assert result["status"] == "failed"
        assert result["safe_state"] == {"tec": "safe", "psd": "safe"}
        with Record(Path(result["folder"])) as record:
            assert record.status == "failed"
            assert len(record.steps()) == result["steps"] > 0


class TestIdentifyAndPredict:
    def test_round_trip(self, bench, tmp_path):
        inputs, outputs = write_loop(tmp_path / "loop.csv")
        arguments = ["--input", "voltage", "--output", "displacement", "--model", "preisach", "--levels", "20"]
        code, out, _ = bench(
            "identify", tmp_path / "loop.csv", *arguments, "--skip", 70,
            "--out", tmp_path / "model.json", "--json", tmp_path / "fit.json", "--figures", tmp_path / "figures",
        )  # fmt: skip
        assert code == 0
        assert re.match(r"(Good|Fair|Poor) fit: .* of range; \d+ coefficients", out)
        assert "KKT" not in out
        fit = json.loads((tmp_path / "fit.json").read_text())
        assert {"samples", "levels", "max", "rms", "rms_percent", "kkt"} <= set(fit)
        assert fit["samples"] == 330
        assert fit["levels"] == 20
        assert fit["kkt"] < 1e-10
        assert fit["rms_percent"] < 1.5
        assert len(list((tmp_path / "figures").iterdir())) == 4

        code, _, _ = bench(
            "predict", tmp_path / "model.json", tmp_path / "loop.csv", "--input", "voltage",
            "--output", "displacement", "--out", tmp_path / "out.csv", "--json", tmp_path / "predict.json",
        )  # fmt: skip
        assert code == 0
        with (tmp_path / "out.csv").open() as file:
            rows = list(csv.DictReader(file))
        assert list(rows[0]) == ["voltage [V]", "measured [µm]", "predicted [µm]", "residual [µm]"]
        predicted = np.array([float(row["predicted [µm]"]) for row in rows])
        np.testing.assert_array_equal([float(row["voltage [V]"]) for row in rows], inputs)
        assert np.sqrt(np.mean((predicted - outputs)[70:] ** 2)) == pytest.approx(fit["rms"], rel=1e-9)

    def test_a_run_is_as_good_as_a_file(self, bench, tmp_path, finished_run):
        options = ["--input", "tec_temperature", "--output", "curvature", "--model", "polynomial"]
        bench("runs", "export", finished_run["folder"], "--format", "csv", "--out", tmp_path)
        results = []
        for source in (finished_run["folder"], tmp_path / "readings.csv"):
            code, _, _ = bench(
                "identify", source, *options, "--out", tmp_path / "m.json", "--json", tmp_path / "r.json"
            )
            assert code == 0
            results.append(json.loads((tmp_path / "r.json").read_text()))
            operator = json.loads((tmp_path / "m.json").read_text())["model"]
            assert (operator["input_unit"], operator["output_unit"]) == ("°C", "1/m")
        # A file of readings alone says nothing of their uncertainty.
        assert results[0].pop("uncertainty")
        assert results[0] == results[1]

    def test_a_column_of_another_unit_is_refused(self, bench, tmp_path):
        write_loop(tmp_path / "loop.csv")
        path = tmp_path / "model.json"
        options = ["--input", "voltage", "--output", "displacement", "--model", "polynomial", "--out", path]
        bench("identify", tmp_path / "loop.csv", *options)
        other = tmp_path / "other.csv"
        other.write_text((tmp_path / "loop.csv").read_text().replace("[V]", "[mV]"))
        code, _, err = bench("predict", path, other, "--input", "voltage", "--out", tmp_path / "o.csv")
        assert code == 3
        assert "mV" in err


def folders_of_runs(folder, rig, runs):
    """Carry runs out, each a protocol and its options; return their folders by name, of which `failed` fails."""
    found = {}
    for name, (protocol, *options) in runs.items():
        result = folder / "run.json"
        words = [part for each in options for part in ("--set", each)]
        with pytest.raises(SystemExit) as stopped:
            main(["run", protocol, "--rig", rig, *FAST[2:], *words, "--out", str(folder), "--json", str(result)])
        assert bool(stopped.value.code) == (name == "failed")
        found[name] = json.loads(result.read_text())["folder"]
    return found


@pytest.fixture(scope="module")
def muscle_runs(tmp_path_factory):
    """Folders of short runs of a muscle by protocol, and `failed` for one that was not completed."""
    runs = {
        "force-voltage": ("force-voltage", "points=13", "conditioning=1", "dwell=15"),
        "length-voltage": ("length-voltage", "points=13", "loads=2.94, 6.86", "dwell=8"),
        "length-force": ("length-force", "points=4", "voltages=0, 3", "dwell=8"),
        "length-verification": ("length-verification", "points=6", "loads=4.9", "dwell=8"),
        "failed": ("length-voltage", "points=11", "loads=20", "dwell=2"),
    }
    return folders_of_runs(tmp_path_factory.mktemp("muscle"), "sma", runs)


def assert_no_model_of_one_input(bench, model, kind, run, signal):
    code, _, err = bench("predict", model, run, "--input", signal, "--out", model.with_name("out.csv"))
    assert code == 3
    assert err.count("error:") == 1
    assert f"is of the kind {kind}; expected one of one input" in re.sub(r"\s+", " ", err)


class TestIdentifyMuscle:
    KINDS = ("force-voltage", "length-voltage", "length-force")

    def identify(self, bench, runs, *options):
        return bench("identify", *(runs[kind] for kind in self.KINDS), "--model", "two-stage", *options)

    def test_a_model_with_its_errors_that_is_none_of_one_input(self, bench, muscle_runs, tmp_path):
        code, out, err = self.identify(
            bench, muscle_runs, "--test", muscle_runs["length-verification"],
            "--out", tmp_path / "model.json", "--json", tmp_path / "result.json",
        )  # fmt: skip
        assert (code, err) == (0, "")
        text = re.sub(r"\s+", " ", out)
        assert "two-stage from 4 series of lengths" in text
        assert "KKT residual, first" in text
        assert "KKT residual, second" in text
        result = json.loads((tmp_path / "result.json").read_text())
        assert result["model"] == "two-stage"
        assert list(result["errors"]) == [*self.KINDS, "verification"]
        for kind, errors in result["errors"].items():
            assert set(errors) == {"average", "rms"}
            assert 0 < errors["average"] <= errors["rms"] < 20
            assert f"{kind} average {errors['average']:.2f} %, RMS {errors['rms']:.2f} %" in text
        model = json.loads((tmp_path / "model.json").read_text())
        assert (model["format"], model["kind"]) == ("bench-model", "two-stage")
        assert model["provenance"]["sources"] == [Path(muscle_runs[kind]).name for kind in self.KINDS]
        assert all(residual < 1e-10 for residual in model["provenance"]["kkt"].values())
        assert_no_model_of_one_input(
            bench, tmp_path / "model.json", "two-stage", muscle_runs["force-voltage"], "supply_voltage"
        )

    @cases(
        ("names", "words"),
        [
            (["length-voltage", "length-force"], ["needs one run of force-voltage; given are: 1 of length-voltage"]),
            (["force-voltage", "force-voltage"], ["needs one run of force-voltage; given are: 2 of force-voltage"]),
            (["force-voltage", "failed"], ["the run is failed; a model needs a completed one"]),
            (["force-voltage", "none"], ["is not a run"]),
        ],
    )
    def test_runs_that_do_not_fit_are_one_message(self, bench, muscle_runs, tmp_path, names, words):
        places = {**muscle_runs, "none": tmp_path / "none"}
        code, _, err = bench(
            "identify", *(places[name] for name in names), "--model", "two-stage", "--out", tmp_path / "model.json"
        )
        assert code == 3
        assert err.count("error:") == 1
        for word in words:
            assert word in re.sub(r"\s+", " ", err)
        assert not list(tmp_path.iterdir())

    def test_wrong_commands_are_refused(self, bench, muscle_runs, tmp_path):
        code, _, err = bench("identify", muscle_runs["force-voltage"], "--model", "two-stage")
        assert code == 3
        assert "needs runs of length-voltage or length-force" in err
        code, _, err = self.identify(bench, muscle_runs, "--out", tmp_path / "none" / "model.json")
        assert code == 3
        assert "cannot be written" in err


class TestReportAndExport:
    def test_report_compares_models_of_the_run_and_others(self, bench, tmp_path, finished_run):
        columns = ["--input", "tec_temperature", "--output", "curvature"]
        bench("identify", finished_run["folder"], *columns, "--model", "polynomial")
        preisach = ["--model", "preisach-signed", "--levels", "5", "--out", tmp_path / "model.json"]
        bench("identify", finished_run["folder"], *columns, *preisach)
        code, out, _ = bench(
            "report", finished_run["folder"], "--model", tmp_path / "model.json",
            "--out", tmp_path / "figures", "--json", tmp_path / "report.json",
        )  # fmt: skip
        assert code == 0
        assert "completed" in out
        report = json.loads((tmp_path / "report.json").read_text())
        assert report["steps"] == finished_run["steps"]
        assert set(report["models"]) == {"polynomial", "preisach-signed"}
        assert all(model["rms"] > 0 for model in report["models"].values())
        assert report["extremes"]["tec_temperature"]["high"] == pytest.approx(84, abs=0.2)
        assert all(Path(path).stat().st_size > 0 for path in report["figures"])
        page = (tmp_path / "figures" / "report.html").read_text()
        assert report["page"] == str(tmp_path / "figures" / "report.html")
        # What the paper states of this protocol, beside what the model does.
        assert "proposed model, largest error" in page
        assert "46.8" in page

    def test_recording_is_rebuilt_but_never_overwritten(self, bench, tmp_path, finished_run):
        code, _, _ = bench("runs", "export", finished_run["folder"], "--format", "rrd", "--out", tmp_path)
        assert code == 0
        assert (tmp_path / "run.rrd").stat().st_size > 0
        code, _, err = bench("runs", "export", finished_run["folder"], "--format", "rrd")
        assert code == 2
        assert "exists already" in err


@pytest.fixture(scope="module")
def hybrid_runs(tmp_path_factory):
    """Folders of short runs of the hybrid by protocol, and `flat` for one that says nothing."""
    runs = {
        "current-steps": ("current-steps", "levels=-0.1, 0.1", "on=300", "off=300"),
        "thermomechanical": ("thermomechanical", "levels=4", "dwell=150"),
        "piezo-loops": ("piezo-loops", "amplitudes=40, 20"),
        "piezo-step": ("piezo-step", "duration=0.15"),
        "flat": ("piezo-loops", "amplitudes=0"),
    }
    return folders_of_runs(tmp_path_factory.mktemp("hybrid"), "hybrid", runs)


class TestIdentifyHybrid:
    PARTS = ("current-steps", "thermomechanical", "piezo-loops", "piezo-step")

    def identify(self, bench, runs, *options, parts=PARTS):
        return bench("identify", *(runs[part] for part in parts), "--model", "hybrid", *options)

    def test_a_model_part_by_part_that_is_none_of_one_input(self, bench, hybrid_runs, tmp_path):
        code, out, err = self.identify(
            bench, hybrid_runs, "-o", "plays=12", "--out", tmp_path / "model.json", "--json", tmp_path / "result.json"
        )
        assert (code, err) == (0, "")
        text = re.sub(r"\s+", " ", out)
        result = json.loads((tmp_path / "result.json").read_text())
        assert set(result) == {
            "network_rms_K", "polynomial_order", "polynomial_rms_um", "prandtl_ishlinskii_rms_percent", "poles_rad_s",
            "damping", "uncertainty",
        }  # fmt: skip
        assert 0 < result["network_rms_K"]["base"] < 0.15
        assert 0 < result["network_rms_K"]["tip"] < 0.15
        assert 0 < result["prandtl_ishlinskii_rms_percent"] <= 1
        assert result["poles_rad_s"]["resonance"] == pytest.approx(2 * np.pi * 693.7, rel=2e-3)
        assert f"polynomial of order {result['polynomial_order']}, RMS {result['polynomial_rms_um']:.3f} µm" in text
        assert f"12 plays, RMS {result['prandtl_ishlinskii_rms_percent']:.2f} % of" in text
        for name in ("seebeck", "electrical", "real pole", "frequency", "damping"):
            assert name in text
        model = json.loads((tmp_path / "model.json").read_text())
        assert (model["format"], model["kind"]) == ("bench-model", "hybrid")
        assert len(model["model"]["hysteresis"]["weights"]) == 12
        assert model["provenance"]["sources"] == [Path(hybrid_runs[part]).name for part in self.PARTS]
        assert model["model"]["dynamics"]["frequency"] == result["poles_rad_s"]["resonance"]
        assert_no_model_of_one_input(
            bench, tmp_path / "model.json", "hybrid", hybrid_runs["piezo-loops"], "piezo_voltage"
        )
        # And a protocol takes it.
        code, _, err = bench(
            "run", "fine-step", "--rig", "hybrid", "--clock", "virtual", "--set", f"model={tmp_path / 'model.json'}",
            "--set", "duration=0.08", "--out", tmp_path, "--json", tmp_path / "run.json",
        )  # fmt: skip
        assert (code, err) == (0, "")
        assert json.loads((tmp_path / "run.json").read_text())["is_safe"]

    @cases(
        ("loops", "words"),
        [
            ("current-steps", "needs one run of current-steps; given are: 2 of current-steps"),
            ("flat", "the hybrid cannot be identified: voltages: expected values that vary"),
        ],
    )
    def test_runs_that_do_not_fit_are_one_message(self, bench, hybrid_runs, tmp_path, loops, words):
        parts = [loops if part == "piezo-loops" else part for part in self.PARTS]
        code, _, err = self.identify(bench, hybrid_runs, "--out", tmp_path / "model.json", parts=parts)
        assert (code, err.count("error:")) == (3, 1)
        assert words in re.sub(r"\s+", " ", err)
        assert not list(tmp_path.iterdir())

    def test_wrong_commands_are_refused(self, bench, hybrid_runs):
        for plays in ("0", "some"):
            code, _, err = self.identify(bench, hybrid_runs, "-o", f"plays={plays}")
            assert code == 2
            assert "plays" in err
        code, _, err = self.identify(bench, hybrid_runs, "--input", "piezo_voltage")
        assert code == 2
        assert "leave --input out" in err
