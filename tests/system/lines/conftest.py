from contextlib import contextmanager
from pathlib import Path

import pytest

from bench.base import VirtualClock
from bench.rig import Rig, load_rig

BUSES = str(Path(__file__).parent / "buses.toml")


@contextmanager
def _connected(**overrides):
    values = {key.replace("__", "."): value for key, value in overrides.items()}
    with Rig(load_rig(BUSES, values), VirtualClock(), 0) as rig:
        yield rig


@pytest.fixture
def connected():
    """Connect the rig of five lines with some values of its file replaced."""
    return _connected


@pytest.fixture
def buses():
    """The path of the rig file."""
    return BUSES
