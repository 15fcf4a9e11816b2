"""The worked example of docs/explanation/uncertainty.md, by hand and by the bench."""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.stats import norm

from bench.analysis.report.uncertainty_tables import budget_heads, budget_rows, budget_title
from bench.rig import UncertainSignals, load_rig

PAGE = Path(__file__).parents[3] / "docs/explanation/uncertainty.md"
DEFLECTION, LENGTH, SPREAD, FREEDOM = 44.5e-6, 300e-6, 0.34, 540


def by_hand():
    """Return curvature, rows of name, u, sensitivity and contribution, combined uncertainty, and coverage factor."""
    curvature = brentq(lambda k: (1 - math.cos(k * LENGTH)) / k - DEFLECTION, 1.0, 3000.0, xtol=1e-10)
    angle = curvature * LENGTH
    slope = LENGTH * math.sin(angle) / curvature - (1 - math.cos(angle)) / curvature**2
    of_deflection = 1 / slope
    rows = [
        ("linearity", 0.54e-6 / math.sqrt(2), of_deflection),
        ("lever", 0.5 / math.sqrt(3), 0.01 * DEFLECTION * of_deflection),
        ("zero", 0.1e-6 / math.sqrt(3), of_deflection),
        ("length", 0.3e-6 / math.sqrt(3), of_deflection * math.sin(angle)),
        ("repeatability", SPREAD / math.sqrt(10), 1.0),
    ]
    parts = [u * c for _, u, c in rows]
    combined = math.sqrt(sum(part**2 for part in parts))
    amplitude, rest = math.sqrt(2) * parts[0], math.sqrt(sum(part**2 for part in parts[1:]))

    def missing(k):
        def covered(phase):
            wave = amplitude * math.sin(phase)
            return norm.cdf((k * combined - wave) / rest) - norm.cdf((-k * combined - wave) / rest)

        return quad(covered, -math.pi / 2, math.pi / 2, epsabs=1e-10)[0] / math.pi - 0.95

    return curvature, rows, parts, combined, brentq(missing, 1.0, 3.0)


@pytest.fixture(scope="module")
def budget():
    """The budget of the bench, by the packaged rig file."""
    file = load_rig("vo2")
    units = {"psd_position": "m", "curvature": "1/m", "tec_temperature": "°C"}
    signals = UncertainSignals(file.uncertainty, file.derived, units, file.path)
    reading = signals.reading("curvature", {"psd_position": DEFLECTION}, noise=False)
    return reading.repeated(SPREAD / math.sqrt(10), FREEDOM, "10 readings").budget()


def test_the_budget_by_hand_equals_that_of_the_bench_to_the_last_digit(budget):
    curvature, rows, parts, combined, factor = by_hand()
    expected = [
        (f"{u:.3g}", f"{c:.3g}", f"{part:.3g}", f"{100 * (part / combined) ** 2:.1f}")
        for (_, u, c), part in zip(rows, parts, strict=True)
    ]
    printed = [(cells[2].split()[0], cells[3], cells[5], cells[6]) for cells in budget_rows(budget)]
    assert printed == expected
    assert [row.component for row in budget.rows] == [name for name, _, _ in rows]
    expanded = f"{factor * combined:.0f}"
    assert f"({curvature:.0f} ± {expanded}) 1/m; 95 %, k = {factor:.2f}, ν = ∞" in budget_title(budget)


def test_the_page_shows_both(budget):
    page = PAGE.read_text(encoding="utf-8")
    assert budget_title(budget) in page
    for cells in (budget_heads(budget), *budget_rows(budget)):
        assert f"| {' | '.join(cells)} |" in page
    curvature, rows, parts, combined, factor = by_hand()
    shown = [curvature, *parts[:4], combined]
    for number in (*(f"{each:.6g}" for each in shown), f"k = {factor:.4f}", f"{factor * combined:.3f} 1/m"):
        assert number in page
    standards = {name: np.format_float_positional(u, 6, fractional=False) for name, u, _ in rows}
    assert standards["lever"] in page
    assert f"{SPREAD / math.sqrt(10):.6g}" in page
