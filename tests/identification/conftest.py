"""Hypothesis without deadlines: the first call of a compiled loop loads it."""

import sys
from pathlib import Path

from hypothesis import settings

settings.register_profile("compiled", deadline=None)
settings.load_profile("compiled")

# Several of these tests share the plants of `other_plants`.
sys.path.insert(0, str(Path(__file__).parent))
