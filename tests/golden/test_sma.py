"""The paper on three-dimensional hysteresis from bytes on the wire to control, through the command line."""

from pathlib import Path

import pytest

from bench.analysis import target_results
from bench.identification import load_model, measure_errors, measure_series
from bench.record import Record
from rigs.muscles.identification import FORCE, LENGTH, MODELS, SAMPLE, errors_json, read_resting, read_series

CONTROLLERS = ("open_loop_inverse", "proportional_integral", "closed_loop_inverse")
LENGTHS = ("length_4.9N", "length_8.82N", "length_changing_load")
SAMPLES = {"force-voltage": 37, "length-voltage": 185, "length-force": 138, "length-verification": 90}
SHORT_SAMPLES = {"force-voltage": 37, "length-voltage": 65, "length-force": 36, "length-verification": 35}
DEVICES = ("supply", "load_cell", "wire_end", "stage", "fan")
FIGURES = (
    "figure-06-force-voltage",
    "figure-07-length-voltage",
    "figure-08-length-force",
    "figure-09-densities",
    "figure-10a-errors-length-voltage",
    "figure-10b-errors-length-force",
    "figure-11-verification",
    "control-length-4.9N",
    "control-length-8.82N",
    "control-length-changing-load",
    "control-force",
)


def the_models_are_as_good_as_the_paper_s_and_in_its_order(campaign):
    for kind, greatest in (("fv", 1.9), ("lv", 7.2), ("lf", 6.5), ("verification", 6.9)):
        assert campaign[kind]["two_stage"]["rms"] <= greatest, kind
    for kind in ("lv", "verification"):
        errors = campaign[kind]
        assert errors["two_stage"]["rms"] < errors["summed"]["rms"] < errors["linear"]["rms"], kind
    assert campaign["fv"]["two_stage"]["rms"] < campaign["fv"]["linear"]["rms"]
    assert "summed" not in campaign["fv"]
    assert set(campaign["kkt"]) == {name.replace("-", "_") for name in MODELS}
    assert all(residual < 1e-10 for residual in campaign["kkt"].values())


def the_closed_loop_reaches_its_targets_and_is_the_best(campaign):
    for session in LENGTHS:
        assert campaign["units"][session] == "mm"
        assert campaign["control"][session]["closed_loop_inverse"]["rms"] <= 0.02, session
    assert campaign["units"]["force"] == "N"
    assert campaign["control"]["force"]["closed_loop_inverse"]["rms"] <= 0.05
    for session in LENGTHS:
        before, after = campaign["control"][session]["closed_loop_inverse"], campaign["calibrated"][session]
        assert after["true_rms"] <= 0.02 < before["true_rms"], session
    assert campaign["calibrated"]["force"]["true_rms"] <= 0.05
    assert 0 < campaign["calibration"]["length"] < 0.01
    assert 0 < campaign["calibration"]["force"] < 0.01
    for session in (*LENGTHS, "force"):
        errors = [campaign["control"][session][controller]["rms"] for controller in CONTROLLERS]
        assert errors[0] > errors[1] > errors[2], session


def every_run_is_complete_and_says_what_the_tables_say(campaign, samples, targets):
    folders = sorted(path.parent for path in Path(campaign["folder"]).glob("sma-*/journal.sqlite"))
    assert len(folders) == 16
    control = []
    for folder in folders:
        with Record(folder) as record:
            assert record.status == "completed"
            assert record.meta["safe_state"] == dict.fromkeys(DEVICES, "safe")
            # Of a run that was given one see `reproduce`.
            if "model" not in record.meta["parameters"]:
                assert "two-stage" in record.models()
            protocol, parameters = record.meta["protocol"], record.meta["parameters"]
            if protocol in SAMPLES:
                count = sum(step.label == SAMPLE for step in record.step_records())
                assert count == samples[protocol], protocol
                continue
            signal, scale = (LENGTH, 1e3) if protocol == "length-control" else (FORCE, 1.0)
            results = target_results(record, signal)
        assert results.targets.size == targets
        session = "force"
        if protocol == "length-control":
            session = "length_changing_load" if parameters["change"] else f"length_{parameters['load']:g}N"
        stated = campaign["control"][session][parameters["controller"].replace("-", "_")]
        for key in ("max", "rms", "median"):
            assert stated[key] == pytest.approx(scale * results.summary()[key], rel=1e-12)
        control.append((session, parameters["controller"]))
    assert len(set(control)) == 12


def the_saved_model_is_that_of_the_tables(campaign):
    folder = Path(campaign["folder"])
    assert {load_model(folder / f"{name}.json").name for name in MODELS} == set(MODELS)
    model = load_model(folder / "two-stage.json").model
    runs = {protocol: next(folder.glob(f"sma-{protocol}-*")) for protocol in SAMPLES}
    resting = read_resting(runs["force-voltage"])
    errors = {
        "fv": measure_errors(resting.forces, model.first.evaluate(resting.voltages)),
        "lv": measure_series(model, read_series(runs["length-voltage"])),
        "lf": measure_series(model, read_series(runs["length-force"])),
        "verification": measure_series(model, read_series(runs["length-verification"])),
    }
    for kind, found in errors.items():
        assert errors_json(found) == pytest.approx(campaign[kind]["two_stage"], rel=1e-9), kind


def everything_that_it_says_is_there(campaign):
    assert {Path(path).stem for path in campaign["figures"]} == set(FIGURES)
    # Nine of them with calibrated sensors, the calibrations among them.
    assert len(campaign["recordings"]) == 16 + 9


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "is_short"), [(0, True), *(pytest.param(seed, False, marks=pytest.mark.seeds) for seed in range(5))]
)
def test_campaign(reproduce, seed, is_short):
    """One campaign a seed: it takes most of a minute, so that everything is looked at in one test."""
    out, campaign = reproduce("sma", seed, is_short=is_short)
    assert "(proposed)" in out
    assert is_short or campaign["laboratory_seconds"] > 4 * 3600
    the_models_are_as_good_as_the_paper_s_and_in_its_order(campaign)
    the_closed_loop_reaches_its_targets_and_is_the_best(campaign)
    every_run_is_complete_and_says_what_the_tables_say(
        campaign, *((SHORT_SAMPLES, 10) if is_short else (SAMPLES, 40))
    )
    the_saved_model_is_that_of_the_tables(campaign)
    everything_that_it_says_is_there(campaign)
