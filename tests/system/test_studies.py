"""Studies: their runs one after another and beside each other."""

import io
from pathlib import Path

import pytest
import small_study
from rich.console import Console

from bench.base import BenchError, ConfigurationError
from bench.batch import reproduce
from bench.record import Record

pytestmark = pytest.mark.usefixtures("warm_popen")


@pytest.fixture
def carried_out(tmp_path):
    """Carry a study out with a number of workers; return its result and what was printed."""

    def run(study, workers, **settings):
        text = io.StringIO()
        console = Console(file=text, width=100)
        settings = {"seed": 0, "live": False, **settings}
        out = tmp_path / str(workers)
        return reproduce("small", study, out=out, console=console, workers=workers, **settings), text.getvalue()

    return run


def test_a_study_gives_the_same_to_the_last_bit_with_one_worker_and_with_two(carried_out, tmp_path):
    results = {}
    for workers, figure_format in ((1, "png"), (2, "svg")):
        result, text = carried_out(small_study.STUDY, workers, figure_format=figure_format)
        assert {Path(path).suffix for path in result["figures"]} == {f".{figure_format}"}
        assert "runs" in text
        assert all(Path(path).stat().st_size > 1000 for path in result["figures"] + result["recordings"])
        assert len(result["recordings"]) == 4
        seeds = {}
        for folder in (tmp_path / str(workers)).glob("*/vo2-creep-*"):
            with Record(folder) as record:
                assert record.status == "completed"
                seeds[record.meta["seed"]] = record.steps()["curvature"].tolist()
        results[workers] = seeds, result["curvatures"], result["laboratory_seconds"]
    assert set(results[1][0]) == {0, 1, 100_000, 100_001}
    assert results[1] == results[2]


def test_parameters_are_set_in_each_run_of_a_protocol(carried_out, tmp_path):
    with pytest.raises(ConfigurationError, match="there is no protocol 'creeps'"):
        carried_out(small_study.STUDY, 1, settings={"creeps": {"duration": "3"}})
    assert not (tmp_path / "1").exists()
    _, text = carried_out(small_study.STUDY, 1, settings={"creep": {"duration": "3"}, "tracking": {"count": "9"}})
    assert "parameters of tracking are set" in text
    folders = [*(tmp_path / "1").glob("*/vo2-creep-*")]
    assert len(folders) == 4
    for folder in folders:
        with Record(folder) as record:
            assert record.meta["parameters"]["duration"] == 3.0


def test_a_run_that_fails_ends_the_study_with_its_error(carried_out, tmp_path):
    with pytest.raises(BenchError, match="1000"):
        carried_out(small_study.WRONG, 2)
    for folder in tmp_path.glob("2/*/vo2-*"):
        with Record(folder) as record:
            assert record.status == "aborted"
            assert set(record.meta["safe_state"].values()) == {"safe"}


def test_the_live_view_is_for_one_run_after_another(carried_out, tmp_path):
    with pytest.raises(ConfigurationError, match="--workers 2"):
        carried_out(small_study.STUDY, 2, live=True)
    assert not (tmp_path / "2").exists()
