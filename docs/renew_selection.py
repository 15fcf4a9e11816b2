"""Measure what the default of `bench identify` reaches, and put the tables into docs/reference/model-selection.md.

`python docs/renew_selection.py FOLDER 0` measures all cases of seed 0, and keeps each in a file of the folder: a run
that is stopped goes on there. A case that an earlier state of the code left is measured anew. `--measured` names a
folder with two measured sessions, identification.csv and validation.csv. `--kind KIND` measures that kind of record
over all seeds instead.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from statistics import median

from renew_measured import put

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "benchmarks"))

from selection_quality import CASES, KINDS, MEASURED, WITHIN, Case, Outcome, case, choose, measured_case

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "reference" / "model-selection.md"


def state() -> str:
    """Return a digest of the code on which the errors depend."""
    parts = [ROOT / "bench" / name for name in ("hysteresis", "identification", "timed")]
    files = sorted(file for part in parts for file in part.rglob("*.py"))
    files.append(ROOT / "tests" / "benchmarks" / "selection_quality.py")
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:16]


STATE = state()


def outcome(folder: Path, plant: str, kind: str, one: Callable[[], Case]) -> Outcome:
    """Return and print what a folder holds of a case in this state of the code; measure it if that is nothing."""
    file = folder / f"{plant} {kind}.json".replace(" ", "-")
    kept = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    if kept.pop("state", "") == STATE:
        found = Outcome(**kept)
    else:
        found = choose(one())
        folder.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({"state": STATE, **asdict(found)}, indent=1), encoding="utf-8")
    show(f"{plant} {kind}", found)
    return found


def show(what: str, found: Outcome) -> None:
    """Print a case, with what was chosen, what is best by hand, and how many settings come near that."""
    print(
        f"{what:36}{found.error:6.2f} /{found.least:6.2f}  {found.ratio:5.2f}  {found.near:3} of {found.tried} near  "
        f"{found.seconds:5.1f} s  "
        f"{found.chosen} | {found.best}",
        flush=True,
    )


def table(found: Mapping[tuple[str, str], Outcome]) -> str:
    """Return a row for each kind of record and a column for each plant: default / best by hand, ratio."""
    plants = list(dict.fromkeys(plant for plant, _ in found))
    kinds = [kind for kind in (*KINDS, *MEASURED) if any(name == kind for _, name in found)]
    lines = [["record", *plants], ["---"] * (len(plants) + 1)]
    lines += [[kind, *(cell(found.get((plant, kind))) for plant in plants)] for kind in kinds]
    within = sum(each.ratio <= WITHIN for each in found.values())
    rows = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"{rows}\n\nWithin {WITHIN:g} times the best: {within} of {len(found)}."


def over_seeds(found: Mapping[str, list[Outcome]]) -> str:
    """Return a row for each plant: median and greatest ratio, how many are within the bound, and the greatest other.

    That is the ratio to the error of a cubic with three plays.
    """
    lines = [
        "| plant | median ratio | greatest | within | by a cubic with plays |",
        "| --- | --- | --- | --- | --- |",
    ]
    for plant, each in found.items():
        ratios = [one.ratio for one in each]
        within = sum(ratio <= WITHIN for ratio in ratios)
        simple = max(one.error / one.simple for one in each)
        row = f"{median(ratios):.2f} | {max(ratios):.2f} | {within} of {len(ratios)} | {simple:.2f}"
        lines.append(f"| {plant} | {row} |")
    return "\n".join(lines)


def cell(found: Outcome | None) -> str:
    """Return the errors of default and best by hand and their ratio; beyond the bound with how much is within it."""
    if found is None:
        return ""
    beyond = f"**{found.ratio:.2f}** ({found.near} of {found.tried})"
    ratio = f"{found.ratio:.2f}" if found.ratio <= WITHIN else beyond
    return f"{found.error:.2f} / {found.least:.2f}, {ratio}"


def main() -> None:
    """Measure the cases, print them, and renew the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("seeds", type=int, nargs="*")
    parser.add_argument("--measured", type=Path)
    parser.add_argument("--kind", choices=KINDS)
    given = parser.parse_args()

    def of_seed(plant: str, kind: str, seed: int) -> Outcome:
        return outcome(given.folder / str(seed), plant, kind, partial(case, kind, plant, seed))

    tables = {}
    if given.kind is not None:
        plants = [plant for plant, kind in CASES if kind == given.kind]
        tables[given.kind] = over_seeds(
            {plant: [of_seed(plant, given.kind, seed) for seed in given.seeds] for plant in plants}
        )
    else:
        for seed in given.seeds:
            tables[f"seed {seed}"] = table({(plant, kind): of_seed(plant, kind, seed) for plant, kind in CASES})
    if given.measured is not None:
        name = given.measured.name.replace("_", " ")
        tables["measured"] = table({
            (name, kind): outcome(given.folder, name, kind, partial(measured_case, given.measured, kind))
            for kind in MEASURED
        })  # fmt: skip
    put(PAGE, tables)


if __name__ == "__main__":
    main()
