"""The reference runs in `recordings/`: whole records, from which identification finds the same models as ever."""

from pathlib import Path

import pytest
from cases import cases

import bench
from bench.record import Record, recover
from rigs.muscles.identification import identify_muscle, read_resting, read_series

FOLDER = Path(__file__).parents[2] / "recordings" / "reference"
RUNS = sorted(path.parent.name for path in FOLDER.glob("*/journal.sqlite"))


def test_there_is_a_run_of_each_rig():
    assert {name.partition("-")[0] for name in RUNS} == {"vo2", "sma", "hybrid"}
    assert sum(file.stat().st_size for file in FOLDER.rglob("*")) < 2e6


@cases("name", RUNS)
def test_the_record_is_whole(name, tmp_path):
    found = recover(FOLDER / name / "journal.sqlite", [], tmp_path / "copy.sqlite")
    assert found.copy is None
    assert not any(state.missing for state in found.tables.values())
    with Record(FOLDER / name) as record:
        assert record.meta["status"] == "completed"
        assert record.meta["counts"]["steps"] == len(record.steps()["step"])


# Each number as it was found when the runs were made; the same code gives the same to rounding.
@cases(
    ("rig", "signals", "model", "options", "rms", "largest", "passive", "bias"),
    [
        (
            "vo2",
            ("tec_temperature", "curvature"),
            "preisach-nonmonotonic",
            {"levels": 10, "plane": (30.0, 70.0)},
            20.11003808,
            118.8773069,
            23,
            1038.041931,
        ),
        (
            "hybrid",
            ("piezo_voltage", "displacement_position"),
            "prandtl-ishlinskii",
            {"plays": 15},
            9.08094001e-8,
            3.44515671e-7,
            14,
            -7.62609081e-7,
        ),
    ],
)
def test_the_same_model_is_found(rig, signals, model, options, rms, largest, passive, bias):
    folder = FOLDER / f"{rig}-damped-oscillation"
    found = bench.identify(folder, model, input=signals[0], output=signals[1], **options)
    assert found.identification.errors.rms == pytest.approx(rms, rel=1e-6)
    assert found.identification.errors.maximum == pytest.approx(largest, rel=1e-6)
    assert found.identification.certificate.passive == passive
    assert found.identification.certificate.kkt_residual < 1e-12
    assert found.file.operator.bias == pytest.approx(bias, rel=1e-6)


def test_the_same_muscle_is_found():
    resting = read_resting(FOLDER / "sma-force-voltage")
    series = [one for name in ("voltage", "force") for one in read_series(FOLDER / f"sma-length-{name}")]
    found = identify_muscle("two-stage", resting, series)
    rms = {kind: errors.rms_percent for kind, errors in found.errors.items()}
    expected = {"force-voltage": 0.7396707647, "length-voltage": 5.5134796876, "length-force": 3.2158518630}
    assert rms == pytest.approx(expected, rel=1e-6)
