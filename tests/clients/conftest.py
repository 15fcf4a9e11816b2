import sys
from pathlib import Path

import pytest

# The clients of these tests, and the protocols that the fuzzer knows.
for folder in ("clients", "fuzz"):
    sys.path.insert(0, str(Path(__file__).parents[1] / folder))
pytest.register_assert_rewrite("served")


@pytest.fixture(scope="session")
def served(tmp_path_factory):
    """Two rigs that another process serves on the wall clock, with time that can be skipped."""
    from served import served_rigs

    with served_rigs(tmp_path_factory.mktemp("served"), "sma", "vo2", "--clock", "x1") as served:
        yield served
