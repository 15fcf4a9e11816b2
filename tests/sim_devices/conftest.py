import pytest

from bench.clock import VirtualClock


@pytest.fixture
def clock():
    return VirtualClock()
