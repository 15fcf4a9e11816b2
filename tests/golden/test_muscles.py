"""The muscles of the paper's outlook: the protocols and models of the wire on two more rigs."""

from pathlib import Path

import numpy as np
import pytest

import bench
from bench.analysis import target_results
from bench.record import Record
from rigs.muscles.identification import FORCE, LENGTH, MODELS, SAMPLE

MUSCLES = ("mckibben", "coiled_polymer")
SAMPLES = {"force-voltage": 37, "length-voltage": 185, "length-force": 138, "length-verification": 90}
SHORT_SAMPLES = {"force-voltage": 37, "length-voltage": 65, "length-force": 36, "length-verification": 35}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "is_short"), [(0, True), *(pytest.param(seed, False, marks=pytest.mark.seeds) for seed in range(2))]
)
def test_campaign(reproduce, seed, is_short):
    out, campaign = reproduce("muscles", seed, is_short=is_short)
    assert "McKibben muscle" in out
    assert "super-coiled polymer muscle" in out
    assert campaign["laboratory_seconds"] > (2 if is_short else 8) * 3600
    for muscle in MUSCLES:
        errors = campaign[muscle]
        assert errors["fv"]["two_stage"]["rms"] < 1.0
        for kind in ("lv", "lf", "verification"):
            # What the paper reaches on its wire.
            assert errors[kind]["two_stage"]["rms"] < 4.9, (muscle, kind)
            assert set(errors[kind]) == {name.replace("-", "_") for name in MODELS}
        assert errors["fv"]["two_stage"]["rms"] < 0.5 * errors["fv"]["linear"]["rms"]
        for kind in ("lv", "verification"):
            found = {model: entry["rms"] for model, entry in errors[kind].items()}
            assert found["two_stage"] < found["summed"], muscle
            assert found["two_stage"] < found["two_stage_prandtl_ishlinskii"], muscle
            # The McKibben muscle's force is nearly a line over its voltage: there a line is as good a first stage.
            assert found["two_stage"] < found["linear"] * (1.1 if muscle == "mckibben" else 1.0), muscle
        folder = Path(campaign["folder"]) / muscle
        assert {path.stem for path in folder.glob("*.json")} == set(MODELS)
        runs = sorted(folder.glob("*/journal.sqlite"))
        counts = {}
        for run in runs:
            with Record(run) as record:
                assert record.status == "completed"
                assert set(record.meta["safe_state"].values()) == {"safe"}
                assert "two-stage" in record.models()
                counts[record.meta["protocol"]] = sum(step.label == SAMPLE for step in record.step_records())
        assert counts == (SHORT_SAMPLES if is_short else SAMPLES)
    assert [Path(path).stem for path in campaign["figures"]] == 2 * [
        "force-voltage",
        "length-voltage",
        "length-force",
    ]
    assert len(campaign["recordings"]) == 8
    assert all(Path(path).stat().st_size > 1000 for path in campaign["figures"] + campaign["recordings"])


@pytest.mark.slow
@pytest.mark.seeds
def test_closed_loop(reproduce, tmp_path):
    _, campaign = reproduce("muscles", 0)
    for muscle in MUSCLES:
        model = Path(campaign["folder"]) / muscle / "two-stage.json"
        # Recorded with seeds 0 to 12: at most 0.036 mm and 0.044 N.
        for protocol, signal, most in (("length-control", LENGTH, 0.05e-3), ("force-control", FORCE, 0.1)):
            for seed in (0, 1):
                run = bench.run(
                    protocol, muscle.replace("_", "-"), out=tmp_path, clock="virtual", seed=10 + seed,
                    model=str(model), sequence_seed=seed + 1, count=20,
                )  # fmt: skip
                with Record(run.folder) as record:
                    results = target_results(record, signal)
                assert np.sqrt(np.mean((results.outputs - results.targets) ** 2)) <= most, (muscle, protocol, seed)
