"""The VO2 paper from bytes on the wire to identified models, through the command line, over eight seeds."""

import json
from pathlib import Path

import numpy as np
import pytest

from bench.cli import main
from bench.journal import Record
from bench.model_file import load_model

MODELS = ("nonmonotonic", "signed", "polynomial")


@pytest.fixture(
    scope="module", params=[pytest.param(seed, marks=pytest.mark.xdist_group(f"vo2-{seed}")) for seed in range(8)]
)
def campaign(request, tmp_path_factory):
    out = tmp_path_factory.mktemp(f"vo2-{request.param}")
    command = [
        "reproduce",
        "vo2",
        "--seed",
        str(request.param),
        "--out",
        str(out),
        "--json",
        str(out / "result.json"),
    ]
    with pytest.raises(SystemExit) as stopped:
        main(command)
    assert not stopped.value.code
    return json.loads((out / "result.json").read_text())


def test_it_is_a_day_in_the_laboratory(campaign):
    assert campaign["laboratory_seconds"] > 4000 * 8


def test_identification_is_as_good_as_the_paper_and_in_its_order(campaign):
    errors = campaign["identification"]
    assert errors["nonmonotonic"]["max"] <= 60
    assert errors["nonmonotonic"]["rms"] <= 7
    assert errors["signed"]["max"] > errors["nonmonotonic"]["max"]
    assert errors["signed"]["rms"] > errors["nonmonotonic"]["rms"]
    assert errors["polynomial"]["max"] >= 8 * errors["nonmonotonic"]["max"]


def test_validation_holds_in_a_session_with_an_offset(campaign):
    assert abs(campaign["session_offset"]) == 0.2
    errors = campaign["validation"]
    assert errors["nonmonotonic"]["max"] <= 110
    assert errors["nonmonotonic"]["rms"] < errors["signed"]["rms"] < errors["polynomial"]["rms"]


def test_every_fit_is_certified(campaign):
    assert all(campaign["kkt"][model] < 1e-10 for model in MODELS)


def test_parameters_are_near_the_paper_s(campaign):
    parameters = campaign["parameters"]
    assert parameters["c0"] == pytest.approx(1026.7, abs=15)
    assert parameters["k0"] == pytest.approx(2.8, abs=0.6)
    assert parameters["k1"] == pytest.approx(4.3, abs=0.4)
    assert parameters["κ min"] < parameters["κ−"] < parameters["κ+"] < parameters["κ max"]


def test_everything_that_it_says_is_there(campaign):
    folder = Path(campaign["folder"])
    assert all(Path(path).stat().st_size > 1000 for path in campaign["figures"] + campaign["recordings"])
    model = load_model(folder / "preisach-nonmonotonic.json")
    runs = sorted(folder.glob("vo2-*/journal.sqlite"))
    assert len(runs) == 2
    for run in runs:
        with Record(run) as record:
            assert record.status == "completed"
            assert len(record.models()) == len(MODELS)
            steps = record.steps()
            # The model that was saved is the one that the table speaks of.
            if "random" in record.path.parent.name:
                error = steps["curvature"] - model.operator.evaluate(steps["tec_temperature"])
                assert np.max(np.abs(error)) == pytest.approx(
                    campaign["validation"]["nonmonotonic"]["max"], rel=1e-12
                )
