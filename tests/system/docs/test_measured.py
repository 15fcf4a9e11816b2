"""The numbers of the README are those of the tables of the studies, and these hold the session that is recorded."""

import json
import re
from pathlib import Path

import pytest
from cases import cases

ROOT = Path(__file__).parents[3]
README = (ROOT / "README.md").read_text(encoding="utf-8")
MEASURED = (ROOT / "docs" / "explanation" / "measured.md").read_text(encoding="utf-8")
RECORDED = ROOT / "tests" / "golden" / "recorded"
RANGE = re.compile(r"([\d.]+)(?: \(([\d.]+)–([\d.]+)\))?$")
SHOWN = re.compile(r"(?:^|/ )([\d.]+)(?: \(([\d.]+)\))?")


def tables(text):
    """Return the rows of each table of a text by its title; a row is a mapping of heads to cells."""
    found = {}
    for title, table in re.findall(r"^\*\*(.+)\*\*\n\n((?:\|.*\|\n)+)", text, re.MULTILINE):
        heads, _, *body = ([cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines())
        found[title] = [[*zip(heads, cells, strict=True)] for cells in body]
    return found


def measured(title, row, head):
    """Return a cell; its table and its row are found by what they begin with, a row by two cells if need be.

    The first cell of a row may stand for the rows below it.
    """
    (table,) = (rows for name, rows in tables(MEASURED).items() if name.startswith(title))
    first, found = "", []
    for cells in table:
        first = cells[0][1] or first
        if f"{first} | {cells[1][1]}".startswith(row):
            found += [cell for name, cell in cells if name == head]
    (cell,) = found
    return cell


VO2 = "Tracking of 60 targets, errors in 1/m"
ROWS = {
    "VO2 microcantilever": [("Identification, errors in 1/m", "proposed model", "bench max")],
    "the same: 60 targets": [(VO2, "open-loop inverse", "RMS"), (VO2, "closed-loop inverse", "RMS")],
    "SMA wire": [("Errors, average / RMS", "verification (Fig. 11) | two-stage (proposed)", "bench")],
    "thermo-piezoelectric hybrid": [("True errors of the same in nm", "hybrid, sensor calibrated", "hold RMS")],
}
"""Rows of the README, by what they begin with, and the cells that their numbers come from."""


@cases("row", ROWS)
def test_the_readme_shows_median_and_worst_of_the_tables(row):
    (line,) = (line for line in README.splitlines() if line.startswith(f"| {row}"))
    shown = SHOWN.findall(line.split("|")[3].strip())
    assert len(shown) == len(ROWS[row])
    for numbers, place in zip(shown, ROWS[row], strict=True):
        median, _, greatest = RANGE.findall(measured(*place))[-1]
        assert bool(numbers[1]) == bool(greatest)
        for number, printed in zip(filter(None, numbers), filter(None, (median, greatest)), strict=True):
            digits = len(number.partition(".")[2])
            assert float(number) == pytest.approx(float(printed), abs=0.501 * 10.0**-digits), (row, place)


@cases(
    ("study", "number", "place"),
    [
        ("vo2", "identification.nonmonotonic.max", ROWS["VO2 microcantilever"][0]),
        ("sma", "verification.two_stage.rms", ROWS["SMA wire"][0]),
    ],
)
def test_the_session_that_is_recorded_lies_within_the_ten(study, number, place):
    """Where the one that is recorded, which is shorter, has the same runs."""
    recorded = json.loads((RECORDED / f"{study}.json").read_text(encoding="utf-8"))[number]
    median, least, greatest = RANGE.findall(measured(*place))[-1]
    # Printed numbers are rounded.
    assert 0.97 * float(least or median) - 0.06 <= recorded <= 1.03 * float(greatest or median) + 0.06
