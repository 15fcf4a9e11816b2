"""A small part of the journal's faults and kills; `make journal-faults` and `make journal-kills` run all of it."""

import importlib.util
import json
import sqlite3
import sys
import tempfile
from pathlib import Path

import pytest
from benches import TOOLS

from bench.base import IncompleteRecordWarning
from bench.record import Journal, Record, keeping
from bench.record.store import Store


@pytest.fixture(scope="module")
def faults():
    spec = importlib.util.spec_from_file_location("journal_faults", TOOLS / "journal_faults.py")
    module = importlib.util.module_from_spec(spec)
    # It finds the fault matrix beside it.
    path = list(sys.path)
    spec.loader.exec_module(module)
    sys.path[:] = path
    return module


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
@pytest.mark.parametrize(("rig", "fault"), [("vo2", "page"), ("sma", "removed"), ("hybrid", "eio")])
def test_no_acknowledged_row_is_lost_and_the_rig_is_safe(faults, monkeypatch, rig, fault):
    # What the fault replaces is put back afterwards.
    for owner, name in ((Journal, "step"), (Store, "_connect"), (tempfile, "tempdir")):
        monkeypatch.setattr(owner, name, getattr(owner, name))
    monkeypatch.setattr(keeping, "OTHERS", 0.05)
    cell = faults.run_cell(rig, fault, "virtual")
    assert cell.verdict == "ok", cell
    assert cell.ended == "failed (8)"


def test_a_run_whose_journal_stays_locked_has_a_code_of_its_own(bench, monkeypatch, tmp_path):
    def locked(store, entries):
        raise sqlite3.OperationalError("database is locked")

    monkeypatch.setattr(Store, "write", locked)
    (tmp_path / "warm.py").write_text(
        "from bench.protocol import *\n\n"
        "@protocol(needs=('tec',))\n"
        "def warm(parameters: ProtocolParameters):\n"
        "    '''Warm the plate.'''\n"
        "    for celsius in range(30, 46):\n"
        "        yield Step({'tec': float(celsius)}, Dwell(2.0))\n"
    )
    code, _, err = bench(
        "run", tmp_path / "warm.py", "--rig", "vo2", "--clock", "virtual", "--out", tmp_path / "runs"
    )
    assert code == 8
    assert "database is locked" in err
    assert "bench runs repair" in err
    monkeypatch.undo()
    (folder,) = (tmp_path / "runs").iterdir()
    with pytest.warns(IncompleteRecordWarning, match="its second file"):
        opened = Record(folder)
    with opened as record:
        assert (record.status, len(record.steps())) == ("failed", 16)
    code, _, err = bench("runs", "repair", folder, "--json", tmp_path / "found.json")
    assert (code, err) == (0, "")
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["tables"]["steps"] == {"good": 0, "added": 16, "missing": 0, "first_bad": "0"}
    with Record(Path(found["copy"])) as record:
        assert (record.status, len(record.steps())) == ("failed", 16)
        assert set(record.meta["safe_state"].values()) == {"safe"}
