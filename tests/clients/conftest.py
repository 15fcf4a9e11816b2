import sys
from pathlib import Path

import pytest

from sim_devices.serving.process import serve

# What these clients share.
sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="package")
def sma():
    """The laboratory of the SMA wire in another process, on the wall clock, with time that can be skipped."""
    with serve("sma", clock="x1") as rig:
        yield rig


@pytest.fixture(scope="package")
def vo2():
    """The VO2 laboratory, likewise."""
    with serve("vo2", clock="x1") as rig:
        yield rig
