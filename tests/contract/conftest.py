from contextlib import ExitStack

import pytest


@pytest.fixture
def stack():
    """What is closed at the end of the test."""
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def bench(request, kind, stack):
    """The device under test: what the function `connected` of the module returns."""
    return request.module.connected(kind, stack)


@pytest.fixture(params=["emulated", "driver"])
def kind(request):
    """Whether the device under test is the emulated one itself or the driver on its wire."""
    return request.param
