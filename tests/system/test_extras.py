"""The base without the libraries of the extras: what works, and what says which extra is missing."""

import json
import os
import sys

import pytest
from places import SUPPORT

from bench.base.compilation_display import MESSAGE
from bench.record import Record

SCRIPT = SUPPORT / "run_without_extras.py"
RUN = ("run", "creep", "--rig", "vo2", "--clock", "virtual", "--set", "duration=4", "--set", "settling=2")
IDENTIFY = ("--input", "tec_temperature", "--output", "curvature", "--model", "polynomial", "-o", "degree=3")
# The tests run in a checkout, and there is where the extras are to be installed from.
DASHBOARD, REPORT, FILES = (
    f"pip install '{SUPPORT.parents[1]}[{extra}]'" for extra in ("dashboard", "report", "files")
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("base")


@pytest.fixture(scope="module")
def without_extras(folder, finished_process):
    """Run each command in one process without the libraries; return their results by name, and what was imported."""
    commands = {
        "list": ["list"],
        "run": [*RUN, "--out", folder / "runs"],
        "live": [*RUN, "--live", "--out", folder / "live"],
        "identify": ["identify", "RUN", *IDENTIFY, "--out", folder / "model.json"],
        "identify with figures": ["identify", "RUN", *IDENTIFY, "--figures", folder, "--out", folder / "no.json"],
        "compare": ["model", "test", folder / "model.json", "--data", "RUN", "--figures", folder / "figures"],
        "report": ["report", "RUN"],
        "export csv": ["runs", "export", "RUN", "--format", "csv", "--out", folder],
        "identify csv": ["identify", folder / "readings.csv", *IDENTIFY],
        "identify xlsx": ["identify", folder / "data.xlsx", *IDENTIFY],
        "identify parquet": ["identify", folder / "data.parquet", *IDENTIFY],
        "export parquet": ["runs", "export", "RUN", "--format", "parquet", "--out", folder],
        "export rrd": ["runs", "export", "RUN", "--format", "rrd", "--out", folder],
        "export png": ["runs", "export", "RUN", "--format", "png", "--out", folder],
        "reproduce": ["study", "vo2", "--out", folder / "studies"],
    }
    (folder / "data.xlsx").write_bytes(b"PK\x03\x04")
    (folder / "data.parquet").write_bytes(b"PAR1")
    texts = [[str(argument) for argument in command] for command in commands.values()]
    finished = finished_process(
        [sys.executable, str(SCRIPT), json.dumps(texts), str(folder / "runs")], folder, {**os.environ}
    )
    assert finished.returncode == 0, finished.stderr
    found = json.loads(finished.stdout)
    # Without the line of a first use, which depends on what ran before on this machine.
    results = [(code, out, err.replace(f"{MESSAGE}\n", "")) for code, out, err in found["results"]]
    return dict(zip(commands, results, strict=True)), found["imported"]


def test_all_modules_but_those_of_the_dashboard_are_imported(without_extras):
    _, imported = without_extras
    assert {"drivers.meerstetter.tec", "sim_devices.laboratory", "bench.analysis.figures", "rigs.vo2.study"} <= set(
        imported
    )


def test_a_run_says_once_that_it_has_no_recording(without_extras, folder):
    code, out, err = without_extras[0]["run"]
    assert (code, err) == (0, "")
    assert out.count(DASHBOARD) == 1
    assert "no recording: an .rrd file needs a library that is not installed" in out
    (run,) = (folder / "runs").iterdir()
    with Record(run) as record:
        assert record.status == "completed"
        assert len(record.steps()) > 0
    assert not list((folder / "runs").glob("**/*.rrd"))


def test_what_needs_no_extra_works(without_extras, folder):
    for name in ("list", "identify", "export csv", "identify csv"):
        code, out, err = without_extras[0][name]
        assert code == 0, name + err
        assert "needs" not in err
        assert "not installed" not in out
    assert (folder / "model.json").stat().st_size > 0
    assert (folder / "readings.csv").stat().st_size > 0


@pytest.mark.parametrize(
    ("name", "purpose", "cure"),
    [
        ("live", "the live view", DASHBOARD),
        ("identify with figures", "a figure", REPORT),
        ("identify xlsx", "reading a spreadsheet", FILES),
        ("identify parquet", "reading a parquet file", REPORT),
        ("compare", "a figure", REPORT),
        ("report", "a figure", REPORT),
        ("reproduce", "a figure", REPORT),
        ("export parquet", "a parquet file", REPORT),
        ("export rrd", "an .rrd file", DASHBOARD),
        ("export png", "a picture of the dashboard", DASHBOARD),
    ],
)
def test_what_needs_one_says_which_before_it_does_anything(without_extras, folder, name, purpose, cure):
    code, out, err = without_extras[0][name]
    assert code == 2
    assert out == ""
    assert err.startswith(f"error: {purpose} needs a library that is not installed (No module named ")
    assert err.endswith(f"): {cure}\n")
    assert err.count("\n") == 1
    left = ("live", "no.json", "figures", "studies", "readings.parquet", "run.rrd", "dashboard.png")
    assert not [name for name in left if (folder / name).exists()]
