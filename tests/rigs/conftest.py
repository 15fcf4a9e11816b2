"""Commands in this process; Hypothesis without deadlines, as the first call of a compiled loop loads it."""

import sys
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("compiled", deadline=None)
settings.load_profile("compiled")
# Tests of all rigs import `short_runs`.
sys.path.insert(0, str(Path(__file__).parent))
pytest.register_assert_rewrite("short_runs")
