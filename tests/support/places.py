"""The folder of what tests share."""

from pathlib import Path

SUPPORT = Path(__file__).parent
