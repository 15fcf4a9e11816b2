"""Load cell and position sensor calibrated by dead weights and gauge blocks, through the command line."""

import json
from pathlib import Path

import pytest
from cases import cases

from bench.rig import Calibration

ERRORS = {"gain_error": 0.01, "offset": 5e-4, "nonlinearity": 0.0}


@cases(
    ("protocol", "table", "signal", "place", "known"),
    [
        ("calibration-load", "force_sensor", "load_cell_force", 5.0, 0.01),
        ("calibration-position", "position_sensor", "wire_end_position", 5e-3, 10e-6),
    ],
)
def test_what_is_set_up_by_hand_is_the_reference(bench, tmp_path, protocol, table, signal, place, known):
    code, _, err = bench(
        "run", protocol, "--rig", "sma", "--clock", "virtual", "--no-rehearse", "--out", tmp_path,
        "--json", tmp_path / "run.json",
        *(part for key, value in ERRORS.items() for part in ("--override", f"emulation.{table}.{key}={value}")),
    )  # fmt: skip
    assert (code, err) == (0, "")
    run = Path(json.loads((tmp_path / "run.json").read_text())["folder"])
    options = ("--uncertainty", 1e-6, "--interval", 365, "--out", tmp_path / "found.json")
    code, _, err = bench("rig", "calibrate", run, "--sensor", signal, *options)
    assert (code, err) == (0, "")
    found = Calibration.model_validate_json((tmp_path / "found.json").read_text())
    assert found.reference == "values that were set up"
    shown = 1.01 * place + 5e-4
    assert float(found.value(shown)) == pytest.approx(place, abs=known)
    assert found.uncertainty < 2 * known
