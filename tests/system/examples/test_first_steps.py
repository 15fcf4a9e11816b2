"""The notebook-like script, run as it stands."""

import subprocess
import sys
from pathlib import Path

import pytest

import bench

SCRIPT = Path(__file__).parents[3] / "examples" / "first_steps.py"


@pytest.mark.seeds
def test_it_runs_and_shows_what_it_says(tmp_path, warm_popen):
    done = subprocess.run(
        [sys.executable, SCRIPT], cwd=tmp_path, capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "tec_temperature" in done.stdout
    assert "<damped-oscillation on vo2: completed" in done.stdout
    assert done.stdout.count(": met") == 3
    (folder,) = (tmp_path / "recordings").iterdir()
    assert bench.load(folder).status == "completed"
    low, high = bench.predict(folder / "model.json", [30.0, 58.0, 80.0, 58.0])[[1, 3]]
    assert abs(high - low) > 100.0
    assert list((folder / "report").glob("*.png"))


def test_its_cells_alternate_text_and_code():
    cells = SCRIPT.read_text().split("\n# %%")[1:]
    kinds = ["text" if cell.startswith(" [markdown]") else "code" for cell in cells]
    assert kinds == ["text", "code"] * (len(kinds) // 2)
    assert len(kinds) >= 10
