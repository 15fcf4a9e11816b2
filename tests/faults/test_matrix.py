"""A small part of the fault matrix; `make fault-matrix` runs all of it."""

import importlib.util

import pytest
from benches import TOOLS
from cases import cases


@pytest.fixture(scope="module")
def matrix():
    spec = importlib.util.spec_from_file_location("fault_matrix", TOOLS / "matrix.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cases(
    ("rig", "fault"),
    [
        ("vo2", "psd.drop"),
        ("vo2", "tec.unplug"),
        ("vo2", "tec-over-current"),
        ("sma", "supply.double"),
        ("sma", "stage.double"),
        ("sma", "broken-muscle"),
        ("hybrid", "tec.corrupt"),
        ("hybrid", "amplifier-trips"),
        ("hybrid", "displacement.out-of-range"),
    ],
)
def test_a_run_with_a_fault_ends_safe_and_true(matrix, rig, fault):
    cell = matrix.run_cell(rig, fault, 1)
    assert not cell.failures, cell


def test_an_instrument_that_keeps_others_waiting_is_named(matrix):
    # The watchdog of the servo is what ends the run, as the supply answers late again and again.
    cell = matrix.run_cell("sma", "supply.corrupt", 4)
    assert cell.results["names"] == "ok", cell


def test_a_wrong_value_is_found_out(matrix, monkeypatch):
    monkeypatch.setattr(matrix, "LYING", ())
    cell = matrix.run_cell("hybrid", "base.drifting", 1)
    assert cell.status == "completed"
    assert cell.results["true"] == "ok"
    monkeypatch.setattr(matrix, "entry", lambda name, *_: {"at": 5.0, "fault": name, "values": {"slope": 0.1}})
    cell = matrix.run_cell("hybrid", "base.drifting", 1)
    assert cell.failures == ["true"]
    assert cell.results["true"].startswith("base_temperature = ")


def test_every_fault_of_a_rig_has_cells(matrix):
    wanted = matrix.cells(seeds=5)
    assert len(wanted) == len(set(wanted)) > 600
    assert {rig for rig, _, _ in wanted} == {"vo2", "sma", "hybrid"}


def test_the_table_counts_the_seeds_that_passed(matrix):
    good = dict.fromkeys(matrix.CHECKS, "ok")
    done = [
        matrix.Cell("vo2", "tec.drop", 0, "failed", "tec: silent", good),
        matrix.Cell("vo2", "tec.drop", 1, "failed", "silent", good | {"names": "names none of tec"}),
    ]
    _, row = matrix.table(done).splitlines()
    assert row.split() == ["vo2", "tec.drop", "2", "failed", "ok", "ok", "ok", "1/2", "ok", "ok"]
