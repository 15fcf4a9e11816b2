import sys
from pathlib import Path

import pytest

# Rig files of these tests name their drivers as `heater_laboratory:HeaterTEC`.
sys.path.insert(0, str(Path(__file__).parent))

from heater_laboratory import RIG


@pytest.fixture
def rig_file(tmp_path):
    """Write a rig file: the heater's, with replacements and an appendix."""

    def write(*replacements, append="", text=RIG):
        for old, new in replacements:
            assert old in text, old
            text = text.replace(old, new)
        path = tmp_path / "heater.toml"
        path.write_text(text + append, encoding="utf-8")
        return str(path)

    return write
