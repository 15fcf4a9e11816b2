from contextlib import ExitStack

import pytest

from sim_devices.serving.process import serve


@pytest.fixture(scope="session")
def sma(warmly):
    """The laboratory of the SMA wire in another process, on the wall clock, with time that can be skipped."""
    with ExitStack() as stack:
        with warmly():
            rig = stack.enter_context(serve("sma", clock="x1"))
        yield rig


@pytest.fixture(scope="session")
def vo2(warmly):
    """The VO2 laboratory, likewise."""
    with ExitStack() as stack:
        with warmly():
            rig = stack.enter_context(serve("vo2", clock="x1"))
        yield rig
