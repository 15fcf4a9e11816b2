"""What the tests of the plants share: `plant_outputs` becomes importable here."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
