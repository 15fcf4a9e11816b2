"""Who uses an operator asks what it can do, not of which class it is."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LADDER = re.compile(
    r"isinstance\([^()]*(\([^()]*\)[^()]*)*\b"
    r"(Preisach|PrandtlIshlinskii|Polynomial|TwoStage|Summed|Linear|QuadraticTerm|PolynomialTerm|ThermalExpansion)\b"
)


def test_what_is_looked_for_is_found():
    assert LADDER.search("if isinstance(model.first, Preisach):")
    assert LADDER.search("isinstance(found(a), int | TwoStage)")
    assert not LADDER.search("isinstance(model, Operator)")


@pytest.mark.parametrize("folder", ["bench", "protocols", "rigs"])
def test_no_class_of_operator_is_asked_for(folder):
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in (ROOT / folder).rglob("*.py")
        if ROOT / "bench" / "hysteresis" not in path.parents
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if LADDER.search(line)
    ]
    assert not found, "\n".join(found)
