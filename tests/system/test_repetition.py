"""Repeating a run from its record alone, and what the record holds for that."""

import io
import json
import shutil
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from heater_laboratory import RIG
from places import SUPPORT
from rerun.chunk import RrdReader
from rich.console import Console

from bench.analysis import compare_runs
from bench.base import Interrupts
from bench.cli import main
from bench.execution import Run, carry_out as carry_out_run, repeat
from bench.identification import ModelFile
from bench.models import Preisach, uniform_levels
from bench.protocol import find_protocol
from bench.record import FILE_NAME, Record
from bench.record.rows import checksum

FAULTS = '[[fault]]\nat = 12\nfault = "tec.delay"\nvalues = { seconds = 0.05 }\nduration = 2\n'
SCRIPT = """
from beside_the_script import HOTTER
from bench.protocol import Dwell
from bench.protocol import ProtocolParameters, Step, parameter, protocol

class Parameters(ProtocolParameters):
    start: float = parameter(30.0, unit="°C", help="set-point")

@protocol(needs=("tec",))
def climb(parameters):
    "Climb."
    for k in range(3):
        yield Step({"tec": parameters.start + k * HOTTER}, Dwell(0.2))
""".replace("(parameters):", "(parameters: Parameters):")


def model_text(tmp_path):
    levels = uniform_levels(30.0, 70.0, 8)
    operator = Preisach(levels, np.full(36, 1.0), 900.0, None, (21.0, 84.0), "°C", "1/m")
    ModelFile("preisach", operator, None).save(tmp_path / "model.json")
    return (tmp_path / "model.json").read_bytes()


def carry_out(*arguments):
    with pytest.raises(SystemExit) as stopped:
        main([str(argument) for argument in arguments])
    assert not stopped.value.code


def put_meta(run, **values):
    with closing(sqlite3.connect(run / FILE_NAME)) as db, db:
        for key, value in values.items():
            db.execute("DELETE FROM meta WHERE key = ?", (key,))
            if value is not None:
                row = key, json.dumps(value)
                db.execute("INSERT INTO meta VALUES (?, ?, ?)", (*row, checksum(row)))


@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    """A run that was given three files, two of them of one name; all are gone."""
    folder = tmp_path_factory.mktemp("tracked")
    given = {"model": model_text(folder), "targets": b"target\n400\n600\n", "faults.toml": FAULTS.encode()}
    paths = {name: folder / name / ("m.json" if name != "faults.toml" else name) for name in given}
    for name, path in paths.items():
        path.parent.mkdir()
        path.write_bytes(given[name])
    carry_out(
        "run", "tracking", "--rig", "vo2", "--clock", "virtual", "--seed", 3, "--out", folder / "runs",
        "--set", f"model={paths['model']}", "--set", f"targets={paths['targets']}", "--set", "readings=2",
        "--faults", paths["faults.toml"], "--override", "telemetry.period=0.5", "--interlock-rate", 2,
    )  # fmt: skip
    for path in paths.values():
        shutil.rmtree(path.parent)
    return next((folder / "runs").iterdir()), given


@pytest.fixture
def climbed(tmp_path):
    """A run of a script with a module beside it, which are gone."""
    here = tmp_path / "scripts"
    here.mkdir()
    (here / "climb.py").write_text(SCRIPT, encoding="utf-8")
    (here / "beside_the_script.py").write_text("HOTTER = 5.0\n", encoding="utf-8")
    (here / "heater.toml").write_text(RIG, encoding="utf-8")
    run = ["--rig", here / "heater.toml", "--clock", "virtual", "--out", tmp_path / "runs"]
    carry_out("run", here / "climb.py", *run, "--set", "start=40")
    shutil.rmtree(here)
    del sys.modules["beside_the_script"]
    return next((tmp_path / "runs").iterdir())


def test_the_content_of_every_file_is_kept_under_the_name_of_its_parameter(tracked):
    run, given = tracked
    with Record(run) as record:
        files = record.files()
        assert {name: files[name] for name in given} == given
        assert files["rig.toml"].decode() == record.meta["rig_file"]
        assert record.meta["packages"].keys() >= {"actuator-bench", "numba", "numpy", "scipy"}


def test_the_same_comes_out_when_every_file_is_gone(bench, tracked, tmp_path):
    run, _ = tracked
    code, out, err = bench("run", "--from", run, "--out", tmp_path, "--json", tmp_path / "result.json")
    assert (code, err) == (0, "")
    assert "as the original: steps, telemetry, events are equal to the last bit" in out
    result = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    assert result["equal"] == {"steps": True, "telemetry": True, "events": True}
    assert result["differences"] == []
    with Record(run) as before, Record(Path(result["folder"])) as now:
        assert now.meta["repeats"] == before.meta["run"]
        assert now.files() == before.files()
        for key in ("parameters", "changed", "overrides", "interlock_rate", "seed", "clock"):
            assert now.meta[key] == before.meta[key], key
        assert len(now.telemetry()) == len(before.telemetry()) > 50
    # Named by what was set; the model is told from the targets by its parameter.
    assert Path(result["folder"]).name.startswith("vo2-tracking-readings-2-model-m-targets-m-period-0.5-2")


def test_the_density_is_in_both_recordings(bench, tracked, tmp_path):
    run, _ = tracked
    code, *_ = bench("runs", "export", run, "--format", "rrd", "--out", tmp_path)
    assert code == 0
    for path in (run / "run.rrd", tmp_path / "run.rrd"):
        entities = {str(chunk.entity_path) for chunk in RrdReader(path).stream()}
        assert "/plane/density" in entities, path


def test_a_script_and_the_module_beside_it_are_kept(bench, climbed, tmp_path):
    code, out, _ = bench("run", "--from", climbed, "--out", tmp_path / "again")
    assert code == 0
    assert "are equal to the last bit" in out
    again = next((tmp_path / "again").iterdir())
    with Record(again) as record:
        assert record.steps()["tec_setpoint"].tolist() == [40.0, 45.0, 50.0]
        assert {"protocol.py", "modules/beside_the_script.py"} <= record.files().keys()
    # A repetition is a whole record as well.
    del sys.modules["beside_the_script"]
    assert bench("run", "--from", again, "--out", tmp_path / "third")[0] == 0


@pytest.mark.parametrize(
    ("meta", "expected"),
    [
        ({"protocol_source": None}, "it is a recovered copy of a record whose metadata were lost"),
        ({"protocol": "juggling"}, "there is no protocol 'juggling'"),
        ({"protocol_source": {"installed": True, "module": "m", "sha256": "0"}}, "(m) was changed since it ran"),
        ({"protocol_source": {"installed": False, "module": "__main__"}}, "in the program or notebook"),
        ({"protocol_source": {"installed": False, "module": "m"}}, "not in a file of its own"),
        ({"clock": "attached x1"}, "name the rig on which it is to be repeated by --rig"),
    ],
)
def test_a_record_that_cannot_be_repeated_gets_one_message(bench, tracked, tmp_path, meta, expected):
    run = tmp_path / "run"
    run.mkdir()
    shutil.copy(tracked[0] / FILE_NAME, run)
    put_meta(run, **meta)
    code, _, err = bench("run", "--from", run, "--out", tmp_path / "again")
    assert code in (2, 3)
    assert expected in err
    assert err.count("error:") == 1
    assert not (tmp_path / "again").exists()


@pytest.mark.parametrize("change", ["UPDATE telemetry SET t = t + 1 WHERE tick = 3", "UPDATE steps SET label = 'no'"])
def test_a_damaged_record_is_refused_before_anything_moves(bench, tracked, tmp_path, change):
    run = tmp_path / "run"
    run.mkdir()
    shutil.copy(tracked[0] / FILE_NAME, run)
    with closing(sqlite3.connect(run / FILE_NAME)) as db, db:
        db.execute(change)
    code, _, err = bench("run", "--from", run, "--out", tmp_path / "again")
    assert code == 3
    assert "its checksum does not fit; `bench runs repair" in err
    assert not (tmp_path / "again").exists()


def test_a_rig_whose_module_is_gone_and_a_rig_that_is_in_the_record(bench, climbed, tmp_path):
    code, _, err = bench("run", "--from", climbed, "--rig", "vo2", "--out", tmp_path / "again")
    assert code == 2
    assert "was emulated, so that its rig is in the record; leave --rig" in err
    with Record(climbed) as record:
        content = record.meta["rig_content"]
    content["emulation"]["laboratory"] = "a_lost_module:Laboratory"
    put_meta(climbed, rig_content=content)
    code, _, err = bench("run", "--from", climbed, "--out", tmp_path / "again")
    assert code == 3
    assert "cannot be repeated: its rig is no longer the same here" in err
    assert "a_lost_module" in err
    assert not (tmp_path / "again").exists()


def test_a_run_at_a_served_laboratory_is_repeated_on_the_rig_that_is_named(bench, climbed, tmp_path, rig_file):
    put_meta(climbed, clock="attached x1")
    other = rig_file(("high = 90.0", "high = 89.0"))
    code, out, _ = bench("run", "--from", climbed, "--rig", other, "--out", tmp_path / "again")
    assert code == 0
    assert "not as in the original: clock: attached x1 → wall" in out
    assert "not as in the original: rig_content.interlocks.probe_temperature.high: 90.0 → 89.0" in out


class TestParametersChangedAtAPause:
    """On the virtual clock, where a repetition is exact."""

    @pytest.fixture
    def paused(self, tmp_path, rig_file, monkeypatch):
        """A run that was paused before its first step, where the dwell was changed."""

        class Terminal(io.StringIO):
            def isatty(self):
                return True

        monkeypatch.setattr("sys.stdin", Terminal("set dwell=0.5\nnote shorter\nr\n"))
        interrupts = Interrupts()
        interrupts.pause_requested = True
        protocol = find_protocol(f"{SUPPORT / 'heater_protocols.py'}:stairs")
        run = Run(
            protocol=protocol, settings={}, rig=rig_file(), folder=tmp_path / "runs", clock="virtual", recording=False
        )
        result = carry_out_run(run, Console(quiet=True), interrupts)
        assert result.outcome.status == "completed"
        return result.folder

    @staticmethod
    def durations(folder):
        with Record(folder) as record:
            return [step.finished - step.started for step in record.step_records()]

    def test_they_are_changed_again(self, paused, tmp_path):
        assert self.durations(paused) == [2.0, 0.5, 0.5, 0.5]
        found = repeat(paused, out=tmp_path / "again", console=Console(quiet=True))
        assert self.durations(found.result.folder) == [2.0, 0.5, 0.5, 0.5]
        assert found.is_exact
        with Record(paused) as before, Record(found.result.folder) as now:
            equal = compare_runs(before, now).equal
        assert equal["steps"]
        assert equal["telemetry"]
