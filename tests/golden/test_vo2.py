"""The VO2 paper from bytes on the wire to tracking, through the command line, over six seeds and more."""

from pathlib import Path

import numpy as np
import pytest

from bench.identification import load_model
from bench.record import Record

MODELS = ("nonmonotonic", "signed", "polynomial")


def models_are_as_good_as_the_paper_s_and_in_its_order(campaign):
    errors = campaign["identification"]
    assert errors["nonmonotonic"]["max"] <= 60
    assert errors["nonmonotonic"]["rms"] <= 7
    assert errors["signed"]["max"] > errors["nonmonotonic"]["max"]
    assert errors["signed"]["rms"] > errors["nonmonotonic"]["rms"]
    assert errors["polynomial"]["max"] >= 8 * errors["nonmonotonic"]["max"]
    assert abs(campaign["session_offset"]) == 0.2
    errors = campaign["validation"]
    assert errors["nonmonotonic"]["max"] <= 110
    assert errors["nonmonotonic"]["max"] < errors["signed"]["max"] < errors["polynomial"]["max"]
    assert all(campaign["kkt"][model] < 1e-10 for model in MODELS)
    parameters = campaign["parameters"]
    assert parameters["c0"] == pytest.approx(1026.7, abs=15)
    assert parameters["k0"] == pytest.approx(2.8, abs=0.6)
    assert parameters["k1"] == pytest.approx(4.3, abs=0.4)
    assert parameters["κ min"] < parameters["κ−"] < parameters["κ+"] < parameters["κ max"]


def targets_are_tracked_and_a_slow_sine_is_followed(campaign, seed):
    errors = campaign["tracking"]
    assert errors["open_loop_inverse"]["rms"] <= 42
    # The paper's 78 1/m is the worst of one session's 60 targets; among our first six sessions the worst is 92.
    assert errors["open_loop_inverse"]["max"] <= (90 if seed == 0 else 100)
    assert errors["polynomial"]["rms"] > 5 * errors["open_loop_inverse"]["rms"]
    errors = campaign["tracking"]["closed_loop_inverse"]
    assert errors["rms"] <= 8
    # Each session has targets of its own: the median of ten is 6.6 s, the longest 8.8 s.
    assert errors["seconds_per_target"] <= (7 if seed == 0 else 9)
    assert campaign["tracking"]["integral"]["rms"] > 2 * errors["rms"]
    errors = campaign["tracking"]["latched"]
    assert errors["rms"] <= 2
    assert errors["max"] <= 15
    assert errors["median"] <= 0.2
    assert errors["rms"] < 0.1 * campaign["tracking"]["open_loop_inverse"]["rms"]
    assert campaign["continuous"]["period_200"]["closed_loop_inverse"]["rms"] <= 5
    for period in ("period_60", "period_200"):
        errors = campaign["continuous"][period]
        assert errors["closed_loop_inverse"]["rms"] < 0.5 * min(
            errors["open_loop_inverse"]["rms"], errors["integral"]["rms"]
        )
    for controller, allowed in (("closed_loop_inverse", 8), ("latched", 2)):
        before, after = campaign["tracking"][controller], campaign["calibrated"][controller]
        # Nonlinearity, gain and offset of the detector.
        assert before["true_rms"] > 7
        assert after["true_rms"] <= allowed
    assert 0.2 < campaign["calibration"]["accuracy"] < 0.8


def everything_that_it_says_is_there(campaign):
    folder = Path(campaign["folder"])
    assert all(Path(path).stat().st_size > 1000 for path in campaign["figures"] + campaign["recordings"])
    model = load_model(folder / "preisach-nonmonotonic.json")
    runs = sorted(folder.glob("vo2-*/journal.sqlite"))
    assert len(runs) == 14
    for run in runs:
        with Record(run) as record:
            assert record.status == "completed"
            assert record.meta["safe_state"] == {"tec": "safe", "psd": "safe"}
            # Of a run that was given one see `reproduce`.
            if "model" not in record.meta["parameters"]:
                assert "preisach-nonmonotonic" in record.models()
            steps = record.steps()
            # The model that was saved is the one that the table speaks of.
            if record.meta["protocol"] == "random-validation":
                error = steps["curvature"] - model.operator.evaluate(steps["tec_temperature"])
                assert np.max(np.abs(error)) == pytest.approx(
                    campaign["validation"]["nonmonotonic"]["max"], rel=1e-12
                )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "is_short"), [(0, True), *(pytest.param(seed, False, marks=pytest.mark.seeds) for seed in range(6))]
)
def test_campaign(reproduce, seed, is_short):
    """One campaign a seed: it takes most of a minute, so that everything is looked at in one test."""
    _, campaign = reproduce("vo2", seed, is_short=is_short)
    assert is_short or campaign["laboratory_seconds"] > 11 * 3600
    models_are_as_good_as_the_paper_s_and_in_its_order(campaign)
    targets_are_tracked_and_a_slow_sine_is_followed(campaign, seed)
    everything_that_it_says_is_there(campaign)
