"""`bench identify` with penalties: what is chosen, printed, drawn and kept."""

import json

import numpy as np
import pytest

from bench.identification import load_model


@pytest.fixture
def identify(bench, tmp_path):
    """Identify a model of a butterfly loop with noise; return the result and what was printed."""
    rng = np.random.default_rng(0)
    corners = np.concatenate([[-1.0, 1.0], rng.uniform(-1.0, 1.0, 10), [-1.0]])
    inputs = np.interp(np.linspace(0.0, corners.size - 1.0, 240), np.arange(corners.size), corners)
    play = np.empty(inputs.size)
    held = -1.0
    for n, value in enumerate(inputs):
        held = min(max(held, value - 0.2), value + 0.2)
        play[n] = held
    outputs = play**2 + 0.01 * rng.normal(size=inputs.size)

    def run(*options, rows=240):
        path = tmp_path / "butterfly.csv"
        table = np.column_stack([inputs, outputs])[:rows]
        np.savetxt(path, table, delimiter=",", header="field,strain", comments="")
        found = tmp_path / "found.json"
        code, out, err = bench(
            "identify", path, "--input", "field", "--output", "strain", "--levels", 10, "--json", found,
            "--out", tmp_path / "model.json", "--verbose", *options,
        )  # fmt: skip
        assert code == 0, err
        return json.loads(found.read_text()), " ".join(out.split())

    return run


def test_a_signed_density_is_penalised_by_default(identify, tmp_path):
    found, out = identify("--model", "preisach-signed", "--figures", tmp_path / "figures")
    assert found["smoothing"] > 0.0 or found["ridge"] > 0.0
    assert found["rms"] < found["cross_validated_rms"] < 0.1
    assert "on blocks left out" in out
    assert f"{found['rank']} of 55" in out
    provenance = load_model(tmp_path / "model.json").provenance
    assert (provenance["smoothing"], provenance["ridge"]) == (found["smoothing"], found["ridge"])
    assert (tmp_path / "figures" / "preisach-signed-coverage.png").stat().st_size > 0


def test_without_penalties_the_null_space_is_named(identify):
    found, out = identify("--model", "preisach-signed", "--smoothing", 0, "-o", "ridge=0", rows=40)
    assert found["smoothing"] is found["ridge"] is found["cross_validated_rms"] is None
    assert f"rank {found['passive']}, null space of {found['active']} (least norm)" in out
    assert found["passive"] == found["rank"] < 40
    assert "the minimiser is not unique" in out


def test_a_model_without_cells_refuses_penalties(bench, tmp_path):
    (tmp_path / "line.csv").write_text("x,y\n" + "".join(f"{n},{2 * n}\n" for n in range(20)))
    columns = ("--input", "x", "--output", "y", "--model", "polynomial", "--smoothing", 1)
    code, _, err = bench("identify", tmp_path / "line.csv", *columns)
    assert code != 0
    assert "has no cells of a density" in " ".join(err.split())
