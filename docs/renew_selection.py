"""Measure what the default of `bench identify` reaches, and put the tables into docs/reference/model-selection.md.

`python docs/renew_selection.py FOLDER 0 1 2` measures all cases of three seeds, and keeps each in a file of the
folder: a run that is stopped goes on there. A case that an earlier state of the code left is measured anew.
`--measured` names a folder with two measured sessions, identification.csv and validation.csv. `--kind KIND` measures
that kind of record alone, beside a cubic with plays. `--jobs N` measures N cases at once.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import partial
from pathlib import Path
from statistics import median

from renew_measured import put

sys.path.insert(0, str(Path(__file__).parents[1] / "tools" / "benchmarks"))

from selection_quality import CASES, KINDS, MEASURED, WITHIN, Case, Outcome, case, choose, measured_case

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "reference" / "model-selection.md"


def state() -> str:
    """Return a digest of the code on which the errors depend."""
    parts = [ROOT / "bench" / name for name in ("models", "identification")]
    files = sorted(file for part in parts for file in part.rglob("*.py"))
    files.append(ROOT / "tools" / "benchmarks" / "selection_quality.py")
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:16]


STATE = state()


def outcome(folder: Path, plant: str, kind: str, one: Callable[[], Case]) -> Outcome:
    """Return what a folder holds of a case in this state of the code; measure it if that is nothing."""
    file = folder / f"{plant} {kind}.json".replace(" ", "-")
    kept = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    if kept.pop("state", "") == STATE:
        found = Outcome(**kept)
    else:
        found = choose(one())
        folder.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({"state": STATE, **asdict(found)}, indent=1), encoding="utf-8")
    return found


def show(what: str, found: Outcome) -> None:
    """Print a case, with what was chosen, what is best by hand, and how many settings come near that."""
    print(
        f"{what:36}{found.error:6.2f} /{found.least:6.2f}  {found.ratio:5.2f}  {found.near:3} of {found.tried} near  "
        f"{found.seconds:5.1f} s  "
        f"{found.chosen} | {found.best}",
        flush=True,
    )


def table(found: Mapping[tuple[str, str], list[Outcome]]) -> str:
    """Return a row for each kind of record and a column for each plant: default / best by hand, ratio."""
    plants = list(dict.fromkeys(plant for plant, _ in found))
    kinds = [kind for kind in (*KINDS, *MEASURED) if any(name == kind for _, name in found)]
    lines = [["record", *plants], ["---"] * (len(plants) + 1)]
    lines += [[kind, *(cell(found.get((plant, kind), [])) for plant in plants)] for kind in kinds]
    rows = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    within = sum(ratio_of(each) <= WITHIN for each in found.values())
    singly = [one.ratio <= WITHIN for each in found.values() for one in each]
    alone = f", and {sum(singly)} of {len(singly)} single records" if len(singly) > len(found) else ""
    return f"{rows}\n\nWithin {WITHIN:g} times the best: {within} of {len(found)}{alone}."


def ratio_of(found: list[Outcome]) -> float:
    """Return the median ratio over seeds."""
    return median(one.ratio for one in found)


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


def cell(found: list[Outcome]) -> str:
    """Return the median errors of default and best by hand, their median ratio, and the greatest over seeds.

    Of a single record beyond the bound, how many different errors are within it.
    """
    if not found:
        return ""
    ratio = ratio_of(found)
    text = f"{ratio:.2f}" if ratio <= WITHIN else f"**{ratio:.2f}**"
    if len(found) > 1:
        text += f" ({max(one.ratio for one in found):.2f})"
    elif ratio > WITHIN:
        text += f" ({found[0].near} of {found[0].tried})"
    error, least = (median(getattr(one, name) for one in found) for name in ("error", "least"))
    return f"{error:.2f} / {least:.2f}, {text}"


def main() -> None:
    """Measure the cases, print them, and renew the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("seeds", type=int, nargs="*")
    parser.add_argument("--measured", type=Path)
    parser.add_argument("--kind", choices=KINDS)
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args()

    wanted = [each for each in CASES if given.kind in (None, each[1])]
    synthetic = [(given.folder / str(seed), plant, kind, seed) for seed in given.seeds for plant, kind in wanted]
    tasks = [(folder, plant, kind, partial(case, kind, plant, seed)) for folder, plant, kind, seed in synthetic]
    if given.measured is not None:
        name = given.measured.name.replace("_", " ")
        tasks += [(given.folder, name, kind, partial(measured_case, given.measured, kind)) for kind in MEASURED]
    found: dict[tuple[str, str], list[Outcome]] = {}
    with ProcessPoolExecutor(given.jobs) as pool:
        for (_, plant, kind, _), one in zip(tasks, pool.map(outcome, *zip(*tasks, strict=True)), strict=True):
            show(f"{plant} {kind}", one)
            found.setdefault((plant, kind), []).append(one)
    measured = {each: found.pop(each) for each in list(found) if each not in CASES}
    tables = {}
    if given.kind is not None:
        tables[given.kind] = over_seeds({plant: each for (plant, _), each in found.items()})
    elif found:
        tables["synthetic"] = table(found)
    if measured:
        tables["measured"] = table(measured)
    put(PAGE, tables)


if __name__ == "__main__":
    main()
