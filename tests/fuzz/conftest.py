import sys
from pathlib import Path

# The fuzzer is a script of its own beside these tests.
sys.path.insert(0, str(Path(__file__).parent))
