import sys
from pathlib import Path

import pytest

# The trials and protocols of the scripts in this folder.
sys.path.insert(0, str(Path(__file__).parent))
# What kills runs.
sys.path.append(str(Path(__file__).parents[1] / "bench"))

from sim_devices.serving.process import serve


@pytest.fixture(scope="module")
def vo2():
    """The VO2 laboratory, served to other processes."""
    with serve("vo2", clock="x1") as rig:
        yield rig
