"""The command line: what it prints, what it writes, what it exits with."""

import csv
import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cases import cases

from bench.analysis import read_columns
from bench.cli import main
from bench.identification import load_model
from bench.record import FILE_NAME, Record

FAST = ["--rig", "vo2", "--clock", "virtual"]
# On the clock of a busy machine: neither the watchdog of the output nor a late answer ends the run.
WATCHED = ["--rig", "vo2", "--override", "devices.tec.watchdog=0", "--override", "devices.psd.timeout=60"]
SHORT_CREEP = ["--set", "duration=4", "--set", "settling=2"]


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
        "command",
        [
            "",
            "list",
            "run",
            "identify",
            "predict",
            "invert",
            "model test",
            "model design",
            "runs compare",
            "report",
            "runs export",
            "study",
            "study hybrid",
            "run damped-oscillation",
        ],
    )
    def test_every_command_has_help(self, bench, command):
        code, out, _ = bench(*command.split(), "--help")
        assert code == 0
        assert "Usage" in out

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

    def test_gives_a_copy_of_a_rig_file(self, bench, tmp_path):
        _, out, _ = bench("show", "vo2")
        copy = tmp_path / "copy.toml"
        copy.write_text(out)
        code, _, _ = bench("run", "creep", "--rig", copy, "--clock", "virtual", *SHORT_CREEP, "--out", tmp_path)
        assert code == 0

    def test_an_unknown_name_says_where_the_names_are(self, bench):
        code, _, err = bench("show", "nothing")
        assert code == 2
        assert "bench list" in err


@pytest.mark.usefixtures("warm_popen")
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

    @cases(
        ("arguments", "words"),
        [
            (["nothing", *FAST], ["there is no protocol", "bench list"]),
            (["creep", "--rig", "nothing"], ["there is no rig", "bench list"]),
            (["creep"], ["--rig"]),
            (["creep", "--rig", "vo2", "--clock", "fast"], ["clock", "virtual"]),
            (["creep", *FAST, "--set", "heat=3"], ["heat", "hot"]),
            (["creep", *FAST, "--set", "hot=warm"], ["hot", "warm", "any number"]),
            (["creep", *FAST, "--set", "hot"], ["KEY=VALUE"]),
            (["creep", *FAST, "--set", "hot=140"], ["140", "15 to 95 °C", "tec"]),
            (["creep", *FAST, "--set", "settling=90"], ["settling", "duration"]),
            (["creep", *FAST, "--override", "devices.tec.watchdog=700"], ["vo2.toml", "devices.tec.watchdog", "700"]),
            (["creep", *FAST, "--override", "devices.psd.colour=1"], ["devices.psd.colour", "there are"]),
            (["creep", "--rig", "vo2-hardware", "--clock", "virtual"], ["wall clock"]),
        ],
    )
    def test_bad_input_is_one_message_before_anything_moves(self, bench, tmp_path, arguments, words):
        code, _, err = bench("run", *arguments, "--out", tmp_path)
        assert code == 2
        assert "Traceback" not in err
        for word in words:
            assert word in re.sub(r"\s+", " ", err)
        assert not list(tmp_path.iterdir())

    def test_hardware_that_does_not_answer_is_one_message(self, bench, tmp_path):
        code, _, err = bench(
            "run",
            "creep",
            "--rig",
            "vo2-hardware",
            "--override",
            f"devices.tec.port={tmp_path}/none",
            "--out",
            tmp_path,
        )
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

    def test_a_signal_ends_the_process_in_the_safe_state(self, tmp_path):
        command = ["run", "creep", *WATCHED, "--no-rehearse", "--clock", "x2", "--out", str(tmp_path)]
        process = subprocess.Popen(
            [sys.executable, "-c", f"from bench.cli import main; main({command!r})"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        try:
            wait_for_a_tick(process, tmp_path)
            process.send_signal(signal.SIGTERM)
            output, _ = process.communicate(timeout=200)
        finally:
            process.kill()
        assert process.returncode == 130, output
        assert "Traceback" not in output
        (folder,) = (path for path in tmp_path.iterdir() if path.is_dir())
        with Record(folder) as record:
            assert record.status == "aborted"
            assert record.meta["safe_state"] == {"tec": "safe", "psd": "safe"}


def wait_for_a_tick(process, folder):
    """Return once the run that a process carries out has recorded telemetry."""
    from bench.base import WallClock

    clock = WallClock()
    while clock.now() < 200:
        assert process.poll() is None
        for path in folder.glob(f"*/{FILE_NAME}"):
            try:
                with Record(path) as record:
                    if len(record.telemetry()) > 0:
                        return
            except Exception:
                continue
        clock.sleep(0.05)
    raise AssertionError("the run did not begin within 200 s")


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

    @cases(
        ("mend", "words"),
        [
            (lambda text: replace_cell(text, 5, "1 V"), ["row 5", "voltage", "'1 V' is not a number"]),
            (lambda text: re.sub(r"(?m)^-?[0-9.e-]+,", "1.5,", text), ["voltage", "1.5"]),
        ],
    )
    def test_trouble_in_a_file_is_one_message_with_row_and_column(self, bench, tmp_path, mend, words):
        write_loop(tmp_path / "loop.csv")
        path = tmp_path / "bad.csv"
        path.write_text(mend((tmp_path / "loop.csv").read_text()))
        code, _, err = bench(
            "identify", path, "--input", "voltage", "--output", "displacement", "--model", "preisach"
        )
        assert code == 3
        assert err.count("error:") == 1
        for word in ["bad.csv", *words]:
            assert word in re.sub(r"\s+", " ", err)

    @cases(
        ("options", "words"),
        [
            (["--model", "nothing"], ["nothing", "bench show models"]),
            (["--model", "polynomial", "--levels", "20"], ["levels"]),
            (["--model", "preisach", "--plane", "3", "1"], ["increasing", "3", "1"]),
            (["--model", "preisach", "-o", "reversible=cubic"], ["reversible", "quadratic"]),
            (["--model", "preisach", "--skip", "-3"], ["--skip"]),
        ],
    )
    def test_wrong_options_are_one_message(self, bench, tmp_path, options, words):
        write_loop(tmp_path / "loop.csv")
        code, _, err = bench(
            "identify", tmp_path / "loop.csv", "--input", "voltage", "--output", "displacement", *options
        )
        assert code == 2
        assert "Traceback" not in err
        for word in words:
            assert word in err

    def test_a_damaged_model_file_is_one_message(self, bench, tmp_path):
        write_loop(tmp_path / "loop.csv")
        path = tmp_path / "model.json"
        bench(
            "identify", tmp_path / "loop.csv", "--input", "voltage", "--output", "displacement",
            "--model", "preisach", "--levels", "5", "--out", path,
        )  # fmt: skip
        path.write_text(json.dumps({**json.loads(path.read_text()), "version": 99}))
        code, _, err = bench(
            "predict", path, tmp_path / "loop.csv", "--input", "voltage", "--out", tmp_path / "o.csv"
        )
        assert code == 3
        assert err.count("error:") == 1
        assert not (tmp_path / "o.csv").exists()

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


class TestTheCoreOnTheCommandLine:
    COLUMNS = ("--input", "voltage", "--output", "displacement")

    def identify(self, bench, tmp_path, name, *options):
        path, result = tmp_path / f"{name}.json", tmp_path / "result.json"
        code, out, err = bench(
            "identify", tmp_path / "loop.csv", *self.COLUMNS, *options, "--out", path, "--json", result
        )
        assert code == 0, err
        return json.loads(result.read_text()), out

    def test_smoothing_is_chosen_by_cross_validation(self, bench, tmp_path):
        write_loop(tmp_path / "loop.csv")
        found, out = self.identify(
            bench, tmp_path, "smooth", "--model", "preisach", "--levels", "10", "--cross-validate"
        )
        assert "cross-validation" in out
        assert out.count("*") == 1
        assert found["smoothing"] >= 0

    def test_unknown_memory_can_be_estimated(self, bench, tmp_path):
        write_loop(tmp_path / "loop.csv")
        header, *rows = (tmp_path / "loop.csv").read_text().splitlines()
        (tmp_path / "loop.csv").write_text("\n".join([header, *rows[60:]]) + "\n")
        plain, _ = self.identify(bench, tmp_path, "plain", "--model", "preisach")
        estimated, _ = self.identify(bench, tmp_path, "estimated", "--model", "preisach", "--initial", "estimate")
        assert estimated["rms"] < plain["rms"]

    def test_plays_are_found_and_inverted_by_their_own_inverse(self, bench, tmp_path):
        write_loop(tmp_path / "loop.csv")
        found, _ = self.identify(bench, tmp_path, "plays", "--model", "prandtl-ishlinskii")
        assert found["rms_percent"] < 2.0
        code, _, err = bench(
            "invert", tmp_path / "plays.json", tmp_path / "loop.csv", "--column", "displacement", "--out",
            tmp_path / "inverse.csv", "--json", tmp_path / "inverse.json",
        )  # fmt: skip
        assert code == 0, err
        assert json.loads((tmp_path / "inverse.json").read_text())["largest_residual"] < 1e-9

    def test_a_model_with_plateaus_is_inverted_numerically(self, bench, tmp_path):
        _, outputs = write_loop(tmp_path / "loop.csv")
        self.identify(bench, tmp_path, "plays", "--model", "prandtl-ishlinskii")
        model = json.loads((tmp_path / "plays.json").read_text())
        model["model"]["weights"][0] = 0.0
        (tmp_path / "plays.json").write_text(json.dumps(model))
        code, _, err = bench(
            "invert", tmp_path / "plays.json", tmp_path / "loop.csv", "--column", "displacement", "--out",
            tmp_path / "inverse.csv", "--json", tmp_path / "inverse.json",
        )  # fmt: skip
        assert code == 0, err
        inverted = json.loads((tmp_path / "inverse.json").read_text())
        low, high = load_model(tmp_path / "plays.json").operator.output_range()
        assert inverted["met"] == np.count_nonzero((low <= outputs) & (outputs <= high)) > 300
        assert inverted["largest_residual"] < 1e-9

    def test_models_are_compared_raw_and_rezeroed(self, bench, tmp_path):
        inputs, outputs = write_loop(tmp_path / "loop.csv")
        self.identify(bench, tmp_path, "a", "--model", "preisach", "--levels", "20")
        self.identify(bench, tmp_path, "b", "--model", "polynomial")
        with (tmp_path / "session.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["voltage [V]", "displacement [µm]"])
            writer.writerows(zip(inputs, outputs + 0.75, strict=True))
        code, out, _ = bench(
            "model", "test", tmp_path / "a.json", tmp_path / "b.json", "--data", tmp_path / "session.csv",
            "--json", tmp_path / "compared.json", "--figures", tmp_path / "figures",
        )  # fmt: skip
        assert code == 0
        assert "removed" in re.sub(r"\s+", " ", out)
        compared = json.loads((tmp_path / "compared.json").read_text())
        assert compared["a"]["offset"] == pytest.approx(0.75, abs=0.05)
        assert compared["a"]["rezeroed"]["rms"] < 0.2 * compared["a"]["raw"]["rms"]
        assert compared["a"]["rezeroed"]["rms"] < compared["b"]["rezeroed"]["rms"]
        assert (tmp_path / "figures" / "residuals.png").stat().st_size > 0

    def test_designs_are_compared_by_what_they_cover_and_cost(self, bench, tmp_path):
        code, out, _ = bench("model", "design", "--rig", "vo2", "--levels", "8", "--json", tmp_path / "design.json")
        assert code == 0
        assert "covering" in out
        designs = json.loads((tmp_path / "design.json").read_text())
        assert set(designs) == {"damped-oscillation", "first-order-reversals", "covering, fewest", "covering, fine"}
        for design in designs.values():
            assert design["covered"] == design["cells"] == 36
            assert 0.0 < design["prediction_variance"] < 2.0
        assert designs["covering, fine"]["time"] < 0.5 * designs["damped-oscillation"]["time"]
        per_hour = {name: design["log_determinant"] for name, design in designs.items()}
        assert per_hour["covering, fewest"] == max(per_hour.values()) > per_hour["damped-oscillation"]
        code, _, err = bench("model", "design", "--rig", "vo2", "--plane", "30", "90")
        assert code == 2
        assert "design" in err


def replace_cell(text, row, value):
    lines = text.splitlines()
    lines[row] = f"{value},{lines[row].partition(',')[2]}"
    return "\n".join(lines) + "\n"


@pytest.fixture(scope="module")
def muscle_runs(tmp_path_factory):
    """Folders of short runs of a muscle by protocol, and `failed` for one that was not completed."""
    folder = tmp_path_factory.mktemp("muscle")
    runs = {}
    for name, protocol, *options in (
        ("force-voltage", "force-voltage", "points=13", "conditioning=1", "dwell=15"),
        ("length-voltage", "length-voltage", "points=13", "loads=2.94, 6.86", "dwell=8"),
        ("length-force", "length-force", "points=4", "voltages=0, 3", "dwell=8"),
        ("length-verification", "length-verification", "points=6", "loads=4.9", "dwell=8"),
        ("failed", "length-voltage", "points=11", "loads=20", "dwell=2"),
    ):
        result = folder / "run.json"
        settings = [part for option in options for part in ("--set", option)]
        with pytest.raises(SystemExit) as stopped:
            main(
                ["run", protocol, "--rig", "sma", "--clock", "virtual", *settings, "--out", str(folder),
                 "--json", str(result)]
            )  # fmt: skip
        assert bool(stopped.value.code) == (name == "failed")
        runs[name] = json.loads(result.read_text())["folder"]
    return runs


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

    def test_another_model(self, bench, muscle_runs, tmp_path):
        code, out, _ = self.identify(
            bench, muscle_runs, "--model", "summed", "--out", tmp_path / "model.json",
            "--json", tmp_path / "result.json",
        )  # fmt: skip
        assert code == 0
        assert "summed from 4 series" in re.sub(r"\s+", " ", out)
        result = json.loads((tmp_path / "result.json").read_text())
        assert result["model"] == json.loads((tmp_path / "model.json").read_text())["name"] == "summed"
        assert set(self.KINDS) - set(result["errors"]) == {"force-voltage"}

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
        options = ["--input", "tec_temperature", "--output", "curvature", "--model", "polynomial"]
        bench("identify", finished_run["folder"], *options, "--out", tmp_path / "model.json")
        code, out, _ = bench(
            "report", finished_run["folder"], "--model", tmp_path / "model.json",
            "--out", tmp_path / "figures", "--json", tmp_path / "report.json",
        )  # fmt: skip
        assert code == 0
        assert "completed" in out
        report = json.loads((tmp_path / "report.json").read_text())
        assert report["steps"] == finished_run["steps"]
        assert report["models"]["polynomial"]["rms"] > 0
        assert report["extremes"]["tec_temperature"]["high"] == pytest.approx(84, abs=0.2)
        assert all(Path(path).stat().st_size > 0 for path in report["figures"])
        page = (tmp_path / "figures" / "report.html").read_text()
        assert report["page"] == str(tmp_path / "figures" / "report.html")
        # What the paper states of this protocol, beside what the model does.
        assert "proposed model, largest error" in page
        assert "46.8" in page

    @pytest.mark.parametrize("format_", ["csv", "parquet"])
    def test_export_holds_the_journal_with_units(self, bench, tmp_path, finished_run, format_):
        code, _, _ = bench("runs", "export", finished_run["folder"], "--format", format_, "--out", tmp_path)
        assert code == 0
        with Record(Path(finished_run["folder"])) as record:
            tables = {"readings": record.steps(), "telemetry": record.telemetry()}
        for name, table in tables.items():
            columns = read_columns(tmp_path / f"{name}.{format_}", ["tec_temperature", "curvature"])
            assert columns.units == {"tec_temperature": "°C", "curvature": "1/m"}
            np.testing.assert_array_equal(columns.values["curvature"], table["curvature"])

    def test_recording_is_rebuilt_but_never_overwritten(self, bench, tmp_path, finished_run):
        code, _, _ = bench("runs", "export", finished_run["folder"], "--format", "rrd", "--out", tmp_path)
        assert code == 0
        assert (tmp_path / "run.rrd").stat().st_size > 0
        code, _, err = bench("runs", "export", finished_run["folder"], "--format", "rrd")
        assert code == 2
        assert "exists already" in err

    def test_what_is_no_run_is_one_message(self, bench, tmp_path):
        code, _, err = bench("report", tmp_path)
        assert code == 3
        assert "not a run" in err


@pytest.fixture(scope="module")
def hybrid_runs(tmp_path_factory):
    """Folders of short runs of the hybrid by protocol, and `failed` for one that was not completed."""
    folder = tmp_path_factory.mktemp("hybrid")
    runs = {}
    for name, protocol, *options in (
        ("current-steps", "current-steps", "levels=-0.1, 0.1", "on=300", "off=300"),
        ("thermomechanical", "thermomechanical", "levels=4", "dwell=150"),
        ("piezo-loops", "piezo-loops", "amplitudes=40, 20"),
        ("piezo-step", "piezo-step", "duration=0.15"),
        ("flat", "piezo-loops", "amplitudes=0"),
        ("failed", "piezo-loops", "amplitudes=40"),
    ):
        result = folder / "run.json"
        settings = [part for option in options for part in ("--set", option)]
        if name == "failed":
            for option in ("emulation.fault=amplifier-trips", "emulation.fault_time=5"):
                settings += ["--override", option]
        with pytest.raises(SystemExit) as stopped:
            main(
                ["run", protocol, "--rig", "hybrid", "--clock", "virtual", *settings, "--out", str(folder),
                 "--json", str(result)]
            )  # fmt: skip
        assert bool(stopped.value.code) == (name == "failed")
        runs[name] = json.loads(result.read_text())["folder"]
    return runs


class TestIdentifyHybrid:
    PARTS = ("current-steps", "thermomechanical", "piezo-loops", "piezo-step")

    def identify(self, bench, runs, *options, **others):
        return bench(
            "identify",
            *(runs[others.get(part.replace("-", "_"), part)] for part in self.PARTS),
            "--model",
            "hybrid",
            *options,
        )

    def test_a_model_part_by_part_that_is_none_of_one_input(self, bench, hybrid_runs, tmp_path):
        code, out, err = self.identify(
            bench, hybrid_runs, "--out", tmp_path / "model.json", "--json", tmp_path / "result.json"
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
        assert f"15 plays, RMS {result['prandtl_ishlinskii_rms_percent']:.2f} % of" in text
        for name in ("seebeck", "electrical", "real pole", "frequency", "damping"):
            assert name in text
        model = json.loads((tmp_path / "model.json").read_text())
        assert (model["format"], model["kind"]) == ("bench-model", "hybrid")
        assert model["provenance"]["sources"] == [Path(hybrid_runs[part]).name for part in self.PARTS]
        assert model["model"]["dynamics"]["frequency"] == result["poles_rad_s"]["resonance"]
        assert_no_model_of_one_input(
            bench, tmp_path / "model.json", "hybrid", hybrid_runs["piezo-loops"], "piezo_voltage"
        )

    def test_a_protocol_can_use_what_it_writes(self, bench, hybrid_runs, tmp_path):
        model = tmp_path / "model.json"
        self.identify(bench, hybrid_runs, "-o", "plays=6", "--out", model)
        assert len(json.loads(model.read_text())["model"]["hysteresis"]["weights"]) == 6
        code, _, err = bench(
            "run", "fine-step", "--rig", "hybrid", "--clock", "virtual", "--set", f"model={model}",
            "--out", tmp_path, "--json", tmp_path / "run.json",
        )  # fmt: skip
        assert (code, err) == (0, "")
        assert json.loads((tmp_path / "run.json").read_text())["is_safe"]

    @cases(
        ("others", "words"),
        [
            ({"current_steps": "piezo-loops"}, ["needs one run of current-steps; given are: 2 of piezo-loops"]),
            (
                {"thermomechanical": "current-steps"},
                ["given are: 2 of current-steps, 1 of piezo-loops"],
            ),
            ({"piezo_loops": "failed"}, ["the run is failed; a model needs a completed one"]),
            ({"piezo_loops": "flat"}, ["the hybrid cannot be identified: voltages: expected values that vary"]),
            ({"piezo_step": "none"}, ["is not a run"]),
        ],
    )
    def test_runs_that_do_not_fit_are_one_message(self, bench, hybrid_runs, tmp_path, others, words):
        places = {**hybrid_runs, "none": tmp_path / "none"}
        code, _, err = self.identify(bench, places, "--out", tmp_path / "model.json", **others)
        assert code == 3
        assert err.count("error:") == 1
        for word in words:
            assert word in re.sub(r"\s+", " ", err)
        assert not list(tmp_path.iterdir())

    def test_wrong_commands_are_refused(self, bench, hybrid_runs, tmp_path):
        for plays in ("0", "201", "some"):
            code, _, err = self.identify(bench, hybrid_runs, "-o", f"plays={plays}")
            assert code == 2
            assert "plays" in err
        code, _, err = self.identify(bench, hybrid_runs, "--input", "piezo_voltage")
        assert code == 2
        assert "leave --input out" in err
        code, _, err = self.identify(bench, hybrid_runs, "--out", tmp_path / "none" / "model.json")
        assert code == 3
        assert "cannot be written" in err
