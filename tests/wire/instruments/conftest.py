import pytest

from bench.base import VirtualClock


@pytest.fixture
def clock():
    return VirtualClock()
