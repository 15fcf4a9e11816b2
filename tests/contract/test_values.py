"""Values that pass from part to part are never changed in place, so that whoever keeps one keeps what it was."""

import dataclasses
import importlib
import inspect
import pkgutil

import pytest

PACKAGES = ("bench.control", "bench.record", "drivers")
CHANGING = {
    "bench.control.approach.Approach",
    "bench.control.predictive._Lag",
    "bench.record.lateness.Lateness",
    "drivers.dynamixel.mx28._Standstill",
}
"""What is no value but a state."""
BY_IDENTITY = {
    "bench.control.approach.Approach",
    "bench.control.predictive._Lag",
}
"""What is not compared by its content, such as arrays."""


@pytest.fixture(scope="module")
def values():
    """The data classes of the packages, by their full names."""
    names = ["bench.execution.engine"]
    for package in map(importlib.import_module, PACKAGES):
        names += [found.name for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")]
    found = {}
    for module in map(importlib.import_module, names):
        for name, part in inspect.getmembers(module, inspect.isclass):
            if part.__module__ == module.__name__ and dataclasses.is_dataclass(part):
                found[f"{module.__name__}.{name}"] = part.__dataclass_params__
    return found


def test_values_cannot_be_changed(values):
    assert len(values) > 20
    assert {name for name, parameters in values.items() if not parameters.frozen} == CHANGING


def test_values_are_equal_by_their_content(values):
    assert {name for name, parameters in values.items() if not parameters.eq} == BY_IDENTITY
