import pytest

from sim_devices.serving.process import serve


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
