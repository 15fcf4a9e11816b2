import sys
from pathlib import Path

# The fuzzers are scripts of their own.
sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
