"""Tracking and following through the command line, and what they refuse before anything moves."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
from cases import cases
from film import film_model

from bench.analysis import following_result, target_results
from bench.identification import ModelFile, damped_oscillation, identify, load_model
from bench.models import Hammerstein, LinearPart, MemoryCurve, Preisach, uniform_levels
from bench.record import Record

VO2 = ["--rig", "vo2", "--clock", "virtual"]


@pytest.fixture(scope="module")
def operator():
    return film_model()


@pytest.fixture(scope="module")
def models(operator, tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    inputs = damped_oscillation(21.0, 84.0, 54.0, 36, 0.35)
    fitted = identify("polynomial", inputs, operator.evaluate(inputs), input_unit="°C", output_unit="1/m").model
    paths = {"preisach": folder / "preisach.json", "polynomial": folder / "polynomial.json"}
    ModelFile("preisach-nonmonotonic", operator, operator.initial_state().advance(inputs)).save(paths["preisach"])
    ModelFile("polynomial", fitted, None).save(paths["polynomial"])
    for name, creep in (("hammerstein", ()), ("creeping", (20.0,))):
        timed = Hammerstein(operator, LinearPart(0.0, (1.5, 0.0), creep, [0.05 for _ in creep]), drift=0.002)
        paths[name] = folder / f"{name}.json"
        ModelFile(name, timed, timed.run(8.0 * np.arange(inputs.size), inputs)[1]).save(paths[name])
    other = json.loads(paths["preisach"].read_text())
    other["model"]["output_unit"] = "µm"
    paths["micrometres"] = folder / "micrometres.json"
    paths["micrometres"].write_text(json.dumps(other))
    wide = Preisach(uniform_levels(10.0, 70.0, 20), operator.density, input_unit="°C", output_unit="1/m")
    paths["wide"] = folder / "wide.json"
    ModelFile("preisach", wide, None).save(paths["wide"])
    return paths


def write_table(path, header, rows):
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)
    return path


def assert_refused(bench, out, code, words, protocol, *options):
    found, _, err = bench("run", protocol, "--rig", "vo2", "--clock", "x1000", *options, "--out", out)
    assert found == code
    assert "Traceback" not in err
    for word in words:
        assert word in re.sub(r"\s+", " ", err)
    assert not out.exists()


class TestModelsWithTime:
    def test_the_operator_of_a_hammerstein_model_is_taken_and_what_is_left_out_is_said(self, bench, models, tmp_path):
        found = []
        for name in ("preisach", "hammerstein"):
            code, out, err = bench(
                "run", "tracking", *VO2, "--set", f"model={models[name]}", "--set", "controller=open-loop-inverse",
                "--set", "count=6", "--set", "hottest=90", "--out", tmp_path,
            )  # fmt: skip
            assert code == 0, err
            said = " ".join((out + err).split())
            words = "the model of an input that stands still, without time constant 1.5 s, drift 0.002 1/m/s"
            assert (words in said) is (name == "hammerstein")
            (folder,) = tmp_path.glob(f"*{name}*")
            with Record(folder) as record:
                found.append(target_results(record, "curvature").summary()["rms"])
                notes = [event.text for event in record.events()]
            assert any("lie beyond those fitted, 21 to 84 °C" in note for note in notes)
        assert found[0] == found[1]

    def test_one_that_creeps_is_refused(self, bench, models, tmp_path):
        words = ("goes on while the input stands still", "identify it with --time none")
        assert_refused(bench, tmp_path / "runs", 3, words, "tracking", "--set", f"model={models['creeping']}")


class TestAdaptation:
    def test_the_model_that_was_corrected_at_the_targets_is_kept_with_the_run(
        self, bench, models, operator, tmp_path
    ):
        # The model is one of curvature itself, not of what a detector with errors makes of it.
        code, _, _ = bench(
            "run", "tracking", *VO2, "--set", f"model={models['preisach']}", "--set", "controller=open-loop-inverse",
            "--set", "adaptation=session", "--set", "count=12", "--override", "emulation.sensors=ideal",
            "--out", tmp_path,
        )  # fmt: skip
        assert code == 0
        (folder,) = tmp_path.iterdir()
        with Record(folder) as record:
            notes = [event.text for event in record.events() if "adaptation by" in event.text]
            ticks = record.telemetry()
        assert len(notes) == 2
        assert "±" in notes[-1]
        assert np.nanmax(ticks["disturbance_uncertainty"]) > 0.0
        kept = load_model(folder / "models" / "adapted.json")
        assert kept.provenance["adapted"]["taken"] >= 10
        assert not np.array_equal(kept.operator.coefficients, operator.coefficients)

    def test_a_follower_is_corrected_while_it_follows(self, bench, models, tmp_path):
        code, _, _ = bench(
            "run", "following", *VO2, "--set", f"model={models['preisach']}", "--set", "adaptation=density",
            "--set", "duration=30", "--out", tmp_path,
        )  # fmt: skip
        assert code == 0
        (folder,) = tmp_path.iterdir()
        assert load_model(folder / "models" / "adapted.json").provenance["adapted"]["taken"] > 1


class TestTracking:
    def test_users_own_targets_are_reached_and_recorded(self, bench, models, tmp_path):
        targets = [300.0, 1200.0, 700.0, 1500.0]
        file = write_table(tmp_path / "targets.csv", ["target [1/m]"], [[target] for target in targets])
        code, out, _ = bench(
            "run", "tracking", *VO2, "--set", f"model={models['preisach']}", "--set", "controller=latched",
            "--set", f"targets={file}", "--seed", 3, "--out", tmp_path, "--json", tmp_path / "run.json",
        )  # fmt: skip
        assert code == 0
        assert "memory of the specimen is unknown" in re.sub(r"\s+", " ", out)
        folder = Path(json.loads((tmp_path / "run.json").read_text())["folder"])
        with Record(folder) as record:
            results = target_results(record, "curvature")
            names = [signal.name for signal in record.signals]
            ticks = record.telemetry()
        np.testing.assert_array_equal(results.targets, targets)
        assert np.max(np.abs(results.outputs - results.targets)) < 3.0
        assert {"reference", "predicted", "disturbance", "disturbance_uncertainty"} <= set(names)
        at_work = np.isfinite(ticks["reference"])
        assert set(ticks["reference"][at_work]) == set(targets)
        assert np.all(ticks["disturbance_uncertainty"][at_work & np.isfinite(ticks["disturbance"])] > 0)

    def test_a_session_is_recalibrated_before_the_targets(self, bench, models, tmp_path):
        file = write_table(tmp_path / "targets.csv", ["target"], [[400.0], [1400.0], [700.0], [1100.0]])
        errors = {}
        for kinds in ("", "input-offset"):
            code, out, _ = bench(
                "run", "tracking", *VO2, "--set", f"model={models['preisach']}", "--set", f"targets={file}",
                "--set", "controller=open-loop-inverse", "--set", f"recalibrate={kinds}",
                "--set", "recalibrate_readings=60", "--override", "emulation.session_offset=1.5", "--out", tmp_path,
                "--json", tmp_path / "run.json",
            )  # fmt: skip
            assert code == 0
            assert ("the model is corrected by it" in re.sub(r"\s+", " ", out)) == bool(kinds)
            with Record(Path(json.loads((tmp_path / "run.json").read_text())["folder"])) as record:
                labels = [step.label for step in record.step_records()]
                errors[kinds] = target_results(record, "curvature").summary()["rms"]
            assert labels.count("session") == (60 if kinds else 0)
        assert errors["input-offset"] < 0.6 * errors[""]

    @cases(
        ("settings", "code", "words"),
        [
            ([], 2, ["model", "missing"]),
            (["model={micrometres}"], 3, ["µm", "1/m"]),
            (["model={polynomial}"], 3, ["closed-loop-inverse", "Preisach"]),
            (["model={preisach}", "controller=polynomial"], 3, ["polynomial"]),
            (["model={preisach}", "hottest=120"], 2, ["120", "95 °C"]),
            (["model={preisach}", "reset=40"], 2, ["reset", "saturate"]),
            (["model={wide}"], 2, ["reset", "saturate"]),
            (["model={preisach}", "targets={gap}"], 3, ["gap.csv", "row 2", "empty"]),
            (["model={preisach}", "recalibrate=zero"], 2, ["recalibrate", "input-offset"]),
            (["model={preisach}", "recalibrate=offset,drift"], 2, ["drift", "a controller has no rows"]),
        ],
    )
    def test_what_does_not_fit_is_refused_before_anything_moves(self, bench, models, tmp_path, settings, code, words):
        write_table(tmp_path / "gap.csv", ["target", "comment"], [[300.0, ""], ["", "gap"], [500.0, ""]])
        places = {**models, "gap": tmp_path / "gap.csv"}
        options = [part for text in settings for part in ("--set", text.format(**places))]
        assert_refused(bench, tmp_path / "out", code, words, "tracking", *options)


class TestFollowing:
    def test_a_users_own_reference_is_followed(self, bench, models, tmp_path):
        times = np.arange(0.0, 121.0, 1.0)
        reference = 700.0 + 400.0 * np.sin(2 * np.pi * times / 120.0)
        file = write_table(
            tmp_path / "reference.csv", ["time [s]", "reference [1/m]"], zip(times, reference, strict=True)
        )
        code, _, _ = bench(
            "run", "following", *VO2, "--set", f"model={models['preisach']}", "--set", f"reference={file}",
            "--seed", 4, "--out", tmp_path, "--json", tmp_path / "run.json",
        )  # fmt: skip
        assert code == 0
        with Record(Path(json.loads((tmp_path / "run.json").read_text())["folder"])) as record:
            result = following_result(record, "curvature")
        assert result.times[-1] == pytest.approx(120.0, abs=0.6)
        np.testing.assert_allclose(result.reference, np.interp(result.times, times, reference), atol=1.0)
        assert result.summary()["rms"] < 40.0

    @cases(
        ("settings", "code", "words"),
        [
            (["period=5", "duration=20"], 2, ["K/s", "3 K/s at most"]),
            (["high=2500"], 2, ["range", "1/m"]),
            (["reference={unsorted}"], 2, ["unsorted.csv", "row 3", "increase"]),
            (["reference={gap}"], 3, ["gap.csv", "row 2", "reference"]),
        ],
    )
    def test_what_cannot_be_followed_is_refused_before_anything_moves(
        self, bench, models, tmp_path, settings, code, words
    ):
        write_table(tmp_path / "unsorted.csv", ["time", "reference"], [[0, 500], [2, 510], [1, 520], [3, 530]])
        write_table(tmp_path / "gap.csv", ["time", "reference"], [[0, 500], [1, ""], [2, 520], [3, 530]])
        places = {name: tmp_path / f"{name}.csv" for name in ("unsorted", "gap")}
        options = [part for text in settings for part in ("--set", text.format(**places))]
        options += ["--set", f"model={models['preisach']}"]
        assert_refused(bench, tmp_path / "out", code, words, "following", *options)


class TestInvert:
    def read(self, path):
        with path.open() as file:
            return list(csv.DictReader(file))

    def test_set_points_meet_the_targets_from_the_memory_that_they_leave(self, bench, operator, models, tmp_path):
        targets = [500.0, 1200.0, 300.0, 1835.0, -80.0, 3000.0, -500.0, 900.0]
        file = write_table(tmp_path / "targets.csv", ["wish [1/m]"], [[target] for target in targets])
        code, out, _ = bench(
            "invert", models["preisach"], file, "--column", "wish", "--out", tmp_path / "out.csv",
            "--json", tmp_path / "result.json",
        )  # fmt: skip
        assert code == 0
        assert "6 met, 1 too high, 1 too low" in out
        rows = self.read(tmp_path / "out.csv")
        assert list(rows[0]) == ["target [1/m]", "passing [°C]", "setpoint [°C]", "predicted [1/m]", "flag"]
        state: MemoryCurve = operator.initial_state()
        for target, row in zip(targets, rows, strict=True):
            if row["passing [°C]"]:
                state = state.step(float(row["passing [°C]"]))
            state, output = operator.step(state, float(row["setpoint [°C]"]))
            assert output == pytest.approx(float(row["predicted [1/m]"]), abs=1e-9)
            if row["flag"] == "met":
                assert output == pytest.approx(target, abs=1e-9)
        assert [row["flag"] for row in rows].count("too high") == 1
        result = json.loads((tmp_path / "result.json").read_text())
        assert result["met"] == 6
        assert result["largest_residual"] <= 1e-9

    def test_stored_memory_and_policy_change_the_answer(self, bench, models, tmp_path):
        file = write_table(tmp_path / "targets.csv", ["target"], [[500.0], [400.0]])
        answers = []
        for options in ([], ["--continue-memory"]):
            bench("invert", models["preisach"], file, "--column", "target", "--out", tmp_path / "out.csv", *options)
            answers.append([row["setpoint [°C]"] for row in self.read(tmp_path / "out.csv")])
        assert answers[0] != answers[1]

    def test_targets_in_another_unit_are_refused(self, bench, models, tmp_path):
        file = write_table(tmp_path / "targets.csv", ["target [mm]"], [["1"]])
        code, _, err = bench("invert", models["preisach"], file, "--column", "target")
        assert code == 3
        assert "mm" in err
