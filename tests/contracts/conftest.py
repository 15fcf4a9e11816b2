import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

# The scaffold that the contracts of all instruments share.
sys.path.insert(0, str(Path(__file__).parent))
pytest.register_assert_rewrite("emulated_bench")


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
