"""Measure what the default of `bench identify` reaches, and put the table into docs/reference/model-selection.md.

`python docs/renew_selection.py` measures three records of each kind; `--seeds 0` one. The column *before* stays as it
is in the page.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from statistics import median

from renew_measured import put

sys.path.insert(0, str(Path(__file__).parents[1] / "tools" / "benchmarks"))

from selection_quality import CASES, Outcome, case, choose

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "model-selection.md"


def row(cells: list[str], found: list[Outcome]) -> str:
    """Return a row of the table: plant, record and the column before, with what was measured."""
    now, least = (f"{median(getattr(each, name) for each in found):.2f}" for name in ("error", "least"))
    codes = dict.fromkeys(code for each in found for code in each.advice if code != "one-run")
    return f"| {' | '.join([*cells[:3], now, least, ' '.join(codes)])} |"


def renewed(page: str, seeds: list[int]) -> str:
    """Return the table of a page with the records of seeds measured."""
    lines = page.partition("<!-- table synthetic -->")[2].partition("<!-- end -->")[0].strip().splitlines()
    made = lines[:2]
    for line in lines[2:]:
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        assert (cells[0], cells[1]) in CASES
        made.append(row(cells, [choose(case(cells[1], cells[0], seed)) for seed in seeds]))
        print(made[-1], flush=True)
    return "\n".join(made)


def main() -> None:
    """Measure the cases, print them, and renew the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    given = parser.parse_args()
    put(PAGE, {"synthetic": renewed(PAGE.read_text(encoding="utf-8"), given.seeds)})


if __name__ == "__main__":
    main()
