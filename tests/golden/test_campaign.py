"""A campaign that identifies the model of a muscle from several runs together, and uses it."""

import csv

import pytest

from bench.batch.campaign.tasks import MODEL_NAME
from bench.cli import main
from bench.identification import load_model

# The runs and the identification take some 20 s.
pytestmark = [pytest.mark.seeds, pytest.mark.usefixtures("warm_popen")]

# Few points, and dwells in which the wire only just settles.
PARTS = """
[[runs]]
protocol = "force-voltage"
rigs = ["sma"]
[runs.parameters]
points = 13
conditioning = 1
dwell = 20.0

[[runs]]
protocol = "length-voltage"
rigs = ["sma"]
[runs.parameters]
points = 13
loads = "0.98, 4.9, 8.82"
dwell = 8.0

[[runs]]
protocol = "length-force"
rigs = ["sma"]
[runs.parameters]
points = 4
voltages = "0.0, 1.5, 3.0"
dwell = 8.0
"""
MODEL = """
[[models]]
name = "wire"
runs = ["force-voltage", "length-voltage", "length-force"]
model = "two-stage"

[[runs]]
protocol = "length-control"
rigs = ["sma"]
seed_offset = 1000
[runs.parameters]
model = "@wire"
count = 2
duration = 10.0
controller = ["open-loop-inverse", "closed-loop-inverse"]
"""


def test_a_model_of_several_runs_is_identified_from_those_of_a_rig_and_seed(tmp_path):
    file, out = tmp_path / "wire.toml", tmp_path / "out"
    file.write_text(PARTS + MODEL)
    with pytest.raises(SystemExit) as end:
        main(["study", str(file), "--out", str(out), "--workers", "1"])
    assert end.value.code == 0
    (folder,) = (out / "wire").iterdir()
    assert folder.name.startswith("sma-seed=0-")
    model = load_model(folder / MODEL_NAME, "two-stage")
    assert len(model.provenance["sources"]) == 3
    assert model.dynamics is not None
    with (out / "results.csv").open(newline="") as results:
        rows = {row["controller"]: row for row in csv.DictReader(results) if row["protocol"] == "length-control"}
    assert {row["status"] for row in rows.values()} == {"completed"}
    errors = {name: float(row["tracking_rms [m]"]) for name, row in rows.items()}
    assert 0.0 < errors["closed-loop-inverse"] < errors["open-loop-inverse"]
