"""`bench rig torture` on drivers of others, and the faults of their libraries that their trackers know."""

from functools import cache
from pathlib import Path

import pytest
from cases import cases

from sim_devices.torture.running import Task, reference_of, torture

pytest.importorskip("minimalmodbus", reason="needs the package minimalmodbus")

TASK = Task(str(Path(__file__).with_name("strangers") / "wire.toml"), {})
SEED = 0


@cache
def reference():
    found = [reference_of(TASK, seed) for seed in (SEED, 1)]
    return found[0].widened(found)


@cases(
    ("fault", "problem"),
    [
        # https://github.com/hardbyte/python-can/issues/1821
        ("supply.corrupt", "ValueError"),
        # https://github.com/pyhys/minimalmodbus/issues/61
        ("load_cell.garbage", "InvalidResponseError"),
    ],
)
def test_a_known_fault_of_a_library_is_found(fault, problem):
    found = torture(TASK, fault, SEED, reference())
    assert found.failures == ["names"]
    assert found.reason.startswith(problem)
    assert found.results["safe"] == "ok"


@cases("fault", ["supply.delay", "load_cell.unplug"])
def test_what_a_library_copes_with_passes(fault):
    found = torture(TASK, fault, SEED, reference())
    assert not found.failures, found
