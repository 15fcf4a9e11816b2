"""The tables of a study over several seeds: each number by its median, the least and the greatest one."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from bench.base import parse_json, write_json_file
from bench.batch.study import ResultTable, StudyResult

FILE_NAME = "study.json"
"""In the folder of a study: its values and tables."""
MARKDOWN_NAME = "studies.md"
"""In the folder of a campaign: the tables of its studies."""


@dataclass(frozen=True)
class OverSeeds:
    """One number of a study with several seeds."""

    values: tuple[float, ...]  # one a seed, at least one

    def __format__(self, specification: str) -> str:
        """Return `median (least–greatest)`, each as a number would be; one number if they are alike."""
        numbers = [value for value in self.values if not math.isnan(value)] or [math.nan]
        least, greatest = (format(limit(numbers), specification) for limit in (min, max))
        if least == greatest:
            return least
        return f"{format(statistics.median(numbers), specification)} ({least}{_between(least)}{greatest})"


def write_study(found: StudyResult, folder: Path) -> None:
    """Write values and tables of a study with one seed into its folder."""
    content = {"values": found.values, "tables": [asdict(table) for table in found.tables]}
    write_json_file(folder / FILE_NAME, content)


def print_over_seeds(name: str, folders: Sequence[Path], console: Console) -> str:
    """Print the tables of a study over the folders of its seeds, as `bench study` prints those of one.

    Returns them as Markdown.
    """
    contents = [parse_json((folder / FILE_NAME).read_text(encoding="utf-8")) for folder in folders]
    values = over_seeds([content["values"] for content in contents])
    head = f"{name}, {len(folders)} seeds: median (least–greatest)"
    console.print(head)
    tables = [ResultTable(**table) for table in contents[0]["tables"]]
    for table in tables:
        table.print(values, console)
    return "\n\n".join([f"## {head}", *(table.markdown(values) for table in tables)])


def over_seeds(values: Sequence[Any]) -> Any:  # noqa: ANN401 - as JSON holds it
    """Return what all seeds have of the values of a study, with `OverSeeds` in place of numbers.

    Text is that of the first seed.
    """
    first = values[0]
    if isinstance(first, Mapping):
        return {
            key: over_seeds([each[key] for each in values]) for key in first if all(key in each for each in values)
        }
    if isinstance(first, list):
        return [over_seeds(each) for each in zip(*values, strict=False)]
    if first is None or (isinstance(first, (int, float)) and not isinstance(first, bool)):
        # JSON has null for a number that is not there.
        return OverSeeds(tuple(math.nan if value is None else value for value in values))
    return first


def _between(least: str) -> str:
    return " to " if least.startswith("-") else "–"
