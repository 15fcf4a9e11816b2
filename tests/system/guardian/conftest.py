import pytest

from sim_devices.serving.process import serve


@pytest.fixture(scope="module")
def vo2():
    """The VO2 laboratory, served to other processes."""
    with serve("vo2", clock="x1") as rig:
        yield rig
