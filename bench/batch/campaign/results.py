"""The results of a campaign: a table of its runs, medians and worst over seeds, CSV and Parquet."""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal, TypeAlias

from rich.console import Console

from bench.analysis import Column, TypedTable, write_table
from bench.base import MissingExtraError, header_with_unit, print_plain, print_table, write_result
from bench.batch.campaign.expansion import Expansion
from bench.batch.campaign.study_tables import MARKDOWN_NAME, print_over_seeds
from bench.batch.campaign.tasks import ComparisonTask, Done, ModelTask, Results, RunTask, StudyTask

Cell: TypeAlias = float | int | str | None
Row: TypeAlias = dict[tuple[str, str], Cell]
"""Cells by name and unit of their column; a table is a sequence of rows, whose columns need not be the same."""

MOST_ROWS = 40
"""Rows of a table that are printed; files have all of them."""
_NOT_GROUPED = ("steps", "laboratory_time", "wall_time", "folder")
_NOT_SHOWN = ("steps", "wall_time", "folder", "table")
MEDIAN, WORST, SPREAD = "median", "worst", "spread"
ERRORS = ("max", "rms")
"""What a comparison gives of each model."""


def columns_of(table: Sequence[Row]) -> dict[tuple[str, str], list[Cell]]:
    """Return the columns of a table; `None` where a row has no value."""
    keys = dict.fromkeys(key for row in table for key in row)
    return {key: [row.get(key) for row in table] for key in keys}


def typed(table: Sequence[Row]) -> TypedTable:
    """Return a table as it is written to files; a column of mixed cells is one of texts."""
    heads, values = [], []
    for (name, unit), cells in columns_of(table).items():
        kinds = {type(cell) for cell in cells if cell is not None}
        kind: Literal["integer", "number", "text"] = (
            "integer" if kinds <= {int} else "number" if kinds <= {int, float} else "text"
        )
        heads.append(Column(name, unit, kind, ""))
        values.append([str(cell) if kind == "text" and cell is not None else cell for cell in cells])
    return TypedTable(tuple(heads), iter([values]))


def print_first_rows(table: Sequence[Row], title: str, console: Console) -> None:
    """Print the first rows of a table, the numbers at its right end aligned right."""
    columns = columns_of(table)
    texts = [i for i, cells in enumerate(columns.values(), start=1) if not _is_numeric(cells)]
    rows = [[shown(row.get(key)) for key in columns] for row in table[:MOST_ROWS]]
    # A head breaks between words.
    heads = [header_with_unit(*key).replace("_", " ") for key in columns]
    print_table(console, heads, rows, title, numbers_from=max(texts, default=0))
    if len(table) > MOST_ROWS:
        console.print(f"… and {len(table) - MOST_ROWS} rows more")


def shown(cell: Cell) -> str:
    """Return a cell for people."""
    if cell is None:
        return "–"
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell)


def runs_table(expansion: Expansion, done: Mapping[str, Done], table: str) -> list[Row]:
    """Return the runs of one table of a campaign file: what varies, how each ended, and its results."""
    models: dict[str, list[ModelTask]] = {}
    for task in expansion.tasks.values():
        if isinstance(task, ModelTask):
            models.setdefault(task.sources[0], []).append(task)
    rows: list[Row] = []
    for task in expansion.tasks.values():
        if not isinstance(task, RunTask) or task.table != table:
            continue
        found = done[task.name]
        settings = task.settings
        row = _without_units(table=table, protocol=settings["protocol"], rig=settings["rig"])
        for key, unit in expansion.varying[table].items():
            if key not in ("protocol", "rig", "seed", "faults"):
                value = settings[key]
                plain = isinstance(value, (int, float, str)) and not isinstance(value, bool)
                row[(key, unit)] = value if plain else str(value)
        row |= _without_units(faults=Path(task.faults).stem, seed=task.seed, status=found.status, reason=found.reason)
        row |= _with_units(found.results)
        for model in models.get(task.name, ()):
            row |= _with_units(done[model.name].results, f"{model.table}_")
        row[("folder", "")] = task.name
        rows.append(row)
    return rows


def over_seeds(table: Sequence[Row], varying: Collection[str]) -> list[Row]:
    """Return median, worst (the greatest) and spread of each result over the seeds of a table of runs.

    A parameter that is a seed as well, such as `sequence_seed`, counts as one.
    """
    columns = columns_of(table)
    keys = [key for key in columns if key[0] in varying and not key[0].endswith("seed")]
    after_reason = [*columns][[*columns].index(("reason", "")) + 1 :]
    results = [key for key in after_reason if key[0] not in _NOT_GROUPED and _is_numeric(columns[key])]
    return _over(table, [("table", ""), *keys], results, "runs")


def comparisons_table(expansion: Expansion, done: Mapping[str, Done]) -> list[Row]:
    """Return the errors of each model on each run that it was compared on, a row each."""
    rows: list[Row] = []
    for task in expansion.tasks.values():
        if not isinstance(task, ComparisonTask) or not (found := done[task.name].results):
            continue
        for model in task.models:
            row = _without_units(comparison=task.table, model=model, run=task.source)
            rows.append(row | _with_units({what: found[f"{model}_{what}"] for what in ERRORS}))
    return rows


def shown_columns(table: Sequence[Row], varying: Collection[str]) -> list[Row]:
    """Return the columns of a table of runs that people look at: what varies, and results."""
    left_out = {*_NOT_SHOWN, *({"protocol", "rig", "faults", "seed"} - {*varying})}
    if not any(row[("reason", "")] for row in table):
        left_out.add("reason")
    return [{key: cell for key, cell in row.items() if key[0] not in left_out} for row in table]


def in_one_cell(summary: Sequence[Row]) -> list[Row]:
    """Return a table of `over_seeds` with median and worst in one cell, for people."""
    rows = []
    for row in summary:
        cells: Row = {}
        for (name, unit), cell in row.items():
            result, _, which = name.rpartition(" ")
            if which == MEDIAN:
                cells[(result, unit)] = f"{shown(cell)} / {shown(row[(f'{result} {WORST}', unit)])}"
            elif which not in (WORST, SPREAD) and name != "table":
                cells[(name, unit)] = cell
        rows.append(cells)
    return rows


def studies_of(expansion: Expansion, done: Mapping[str, Done]) -> dict[str, list[str]]:
    """Return the names of the tasks of each study that were completed, by study and rig."""
    found: dict[str, list[str]] = {}
    for task in expansion.tasks.values():
        if isinstance(task, StudyTask) and done[task.name].status == "completed":
            found.setdefault(" on ".join(filter(None, (task.study, Path(task.rig).stem))), []).append(task.name)
    return found


def study_values(expansion: Expansion, done: Mapping[str, Done]) -> list[Row]:
    """Return each number of each study and seed, a row each."""
    return [
        _without_units(
            study=task.study,
            rig=Path(task.rig).stem,
            seed=task.seed,
            status=done[task.name].status,
            number=name,
            value=value,
        )
        for task in expansion.tasks.values()
        if isinstance(task, StudyTask)
        for name, (value, _) in done[task.name].results.items()
    ]


def show_results(expansion: Expansion, done: Mapping[str, Done], folder: Path, console: Console) -> list[Path]:
    """Print the tables of a campaign and write them to files in its folder; return these."""
    results: list[Row] = []
    summary: list[Row] = []
    for name, varying in expansion.varying.items():
        table = runs_table(expansion, done, name)
        print_first_rows(shown_columns(table, varying), name, console)
        results += table
        if "seed" in varying:
            of_seeds = over_seeds(table, varying)
            print_first_rows(in_one_cell(of_seeds), f"{name}: median / worst over the seeds", console)
            summary += of_seeds
    files = {"results": results, "summary": summary}
    if comparisons := comparisons_table(expansion, done):
        errors = [key for key in columns_of(comparisons) if key[0] in ERRORS]
        compared = _over(comparisons, [("comparison", ""), ("model", "")], errors, "runs")
        print_first_rows(compared, "comparisons, over the runs", console)
        files |= {"comparisons": comparisons, "comparisons-summary": compared}
    if values := study_values(expansion, done):
        texts = [
            print_over_seeds(name, [folder / task for task in tasks], console)
            for name, tasks in studies_of(expansion, done).items()
        ]
        write_result(folder / MARKDOWN_NAME, "\n\n".join(texts) + "\n")
        print_plain(console, f"every number: {folder / 'studies.csv'}")
        keys = [(name, "") for name in ("study", "rig", "number")]
        files |= {"studies": _over(values, keys, [("value", "")], "seeds", named=False), "study-values": values}
    return write_tables({name: table for name, table in files.items() if table}, folder, console)


def write_tables(tables: Mapping[str, Sequence[Row]], folder: Path, console: Console) -> list[Path]:
    """Write tables as CSV and Parquet files by their name; without pyarrow as CSV only, which is said once."""
    paths = []
    try:
        for suffix, (name, table) in itertools.product(("csv", "parquet"), tables.items()):
            write_table(folder / f"{name}.{suffix}", typed(table), {})
            paths.append(folder / f"{name}.{suffix}")
    except MissingExtraError as error:
        print_plain(console, f"no Parquet files: {error}")
    return paths


def _over(
    table: Sequence[Row],
    keys: Sequence[tuple[str, str]],
    results: Sequence[tuple[str, str]],
    count: str,
    *,
    named: bool = True,
) -> list[Row]:
    """Return median, worst (the greatest) and spread of results over the rows that have the same cells elsewhere.

    `keys` are the other columns, and `count` is the head of the number of rows. Heads begin with the name of a result
    if there are several.
    """
    groups: dict[tuple[Cell, ...], list[Row]] = {}
    for each in table:
        groups.setdefault(tuple(each.get(key) for key in keys), []).append(each)
    rows: list[Row] = []
    for group, members in groups.items():
        row = dict(zip(keys, group, strict=True)) | _without_units(**{count: len(members)})
        if count == "runs" and any(("status", "") in each for each in members):
            row |= _without_units(completed=sum(each[("status", "")] == "completed" for each in members))
        for name, unit in results:
            values = _numbers(each.get((name, unit)) for each in members)
            prefix = f"{name} " if named else ""
            row[(f"{prefix}{MEDIAN}", unit)] = statistics.median(values) if values else None
            row[(f"{prefix}{WORST}", unit)] = max(values, key=abs) if values else None
            row[(f"{prefix}{SPREAD}", unit)] = max(values) - min(values) if values else None
        rows.append(row)
    return rows


def _with_units(results: Results, prefix: str = "") -> Row:
    """Return results as cells; a plain number has no unit."""
    return {(prefix + name, "" if unit == "1" else unit): value for name, (value, unit) in results.items()}


def _without_units(**cells: Cell) -> Row:
    return {(name, ""): cell for name, cell in cells.items()}


def _is_numeric(cells: Sequence[Cell]) -> bool:
    return all(isinstance(cell, (int, float)) or cell is None for cell in cells)


def _numbers(cells: Iterable[Cell]) -> list[float]:
    return [float(cell) for cell in cells if isinstance(cell, (int, float)) and math.isfinite(cell)]
