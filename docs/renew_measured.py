"""Put the tables of two campaigns into docs/explanation/measured.md, each between its marks.

`python docs/renew_measured.py recordings` after `make studies` and the campaign examples/campaign-validation.toml.
"""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Mapping
from pathlib import Path

PAGE = Path(__file__).parent / "explanation" / "measured.md"
MARKS = re.compile(r"^<!-- table (.+?) -->$", re.MULTILINE)
MODELS = {
    "proposed": "proposed model, the paper's cells of 2.0 K",
    "proposed-chosen": "proposed model, cells and smoothing by cross-validation",
    "signed-paper": "signed Preisach, the paper's cells of 3.15 K",
    "signed-same-cells": "signed Preisach, cells of 2.0 K",
    "signed-chosen": "signed Preisach, cells and penalties by cross-validation",
    "polynomial": "polynomial, degree 12",
}
"""Titles of the models in the validation, by their names in the campaign file."""
WHAT = ("median", "worst")
MAX = "max [1/m]"
PAPERS = 110
"""The largest error that the paper's models reach in its one session is 108.1 1/m."""


def studies(file: Path) -> dict[str, str]:
    """Return title, table and note of each table of the studies, by study and number from 1 on."""
    found = {}
    for section in re.split(r"^## ", file.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]:
        study = section.partition(",")[0]
        blocks: list[str] = []
        for part in section.strip().split("\n\n")[1:]:
            if part.startswith("**"):
                blocks.append(part)
            else:
                blocks[-1] += f"\n\n{part}"
        found |= {f"{study} {number}": block for number, block in enumerate(blocks, start=1)}
    return found


def validation(folder: Path) -> str:
    """Return the table of the largest errors of each model in the sessions of the validation."""
    summary = {(row["comparison"], row["model"]): row for row in _rows(folder / "comparisons-summary.csv")}
    sessions = _rows(folder / "comparisons.csv")

    def cells(comparison: str, model: str) -> list[str]:
        row = summary.get((comparison, model))
        if row is None:
            return ["–"] * (len(WHAT) + 1)
        errors = [float(each[MAX]) for each in sessions if (each["comparison"], each["model"]) == (comparison, model)]
        above = sum(error > PAPERS for error in errors) / len(errors)
        return [*(f"{float(row[MAX.replace(' ', f' {what} ')]):.0f}" for what in WHAT), f"{100.0 * above:.0f} %"]

    heads = [*WHAT, f"above {PAPERS}"]
    rows = [
        ["largest error in 1/m", *heads, *(f"offset estimated: {head}" for head in heads)],
        ["---"] * (2 * len(heads) + 1),
        *([title, *cells("as-identified", name), *cells("recalibrated", name)] for name, title in MODELS.items()),
    ]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _rows(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8", newline="") as lines:
        return list(csv.DictReader(lines))


def put(page: Path, tables: Mapping[str, str]) -> None:
    """Put tables between the marks of a page that bear their names."""
    text = page.read_text(encoding="utf-8")
    known = [name for name in MARKS.findall(text) if name in tables]
    for name in known:
        start, end = f"<!-- table {name} -->\n", "<!-- end -->\n"
        before, _, after = text.partition(start)
        text = before + start + tables[name] + "\n" + end + after.partition(end)[2]
    page.write_text(text, encoding="utf-8")
    print(f"{len(known)} tables in {page}")


def main(recordings: Path) -> None:
    """Renew the page from the folders of the campaigns; a table of a study that they lack stays."""
    tables = studies(recordings / "campaign-studies" / "studies.md")
    tables["validation"] = validation(recordings / "campaign-validation")
    put(PAGE, tables)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
