"""The results of a campaign: a table of its runs, medians and worst over seeds, CSV and Parquet."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.analysis import write_csv
from bench.base import MissingExtraError, header_with_unit, needed_for, print_plain, write_result
from bench.batch.campaign.expansion import Expansion
from bench.batch.campaign.study_tables import MARKDOWN_NAME, print_over_seeds
from bench.batch.campaign.tasks import ComparisonTask, Done, ModelTask, RunTask, StudyTask

Cell: TypeAlias = float | int | str | None
Row: TypeAlias = dict[tuple[str, str], Cell]
"""Cells by name and unit of their column."""

MOST_ROWS = 40
"""Rows of a table that are printed; files have all of them."""
_NOT_GROUPED = ("steps", "laboratory_time", "wall_time")
_NOT_SHOWN = ("steps", "wall_time", "folder", "table")
MEDIAN, WORST, SPREAD = "median", "worst", "spread"
_PLAIN = ("", "1")
ERRORS = ("max", "rms")
"""What a comparison gives of each model."""


@dataclass(frozen=True)
class ResultsTable:
    """Columns of equal length; `None` where a row has no value.

    Attributes
    ----------
    columns : mapping of (str, str) to list
        Cells by name and unit.
    """

    columns: Mapping[tuple[str, str], Sequence[Cell]]

    @classmethod
    def of(cls, rows: Sequence[Row]) -> ResultsTable:
        """Make a table of rows, each a mapping of (name, unit) to a cell."""
        keys = dict.fromkeys(key for row in rows for key in row)
        return cls({key: [row.get(key) for row in rows] for key in keys})

    @property
    def heads(self) -> list[str]:
        """The heads of the columns, units in brackets."""
        return [header_with_unit(name, "" if unit in _PLAIN else unit) for name, unit in self.columns]

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def write_csv(self, path: Path) -> None:
        """Write it as CSV; raises DataError if that fails."""
        columns = [["" if cell is None else cell for cell in cells] for cells in self.columns.values()]
        write_csv(path, list(zip(self.heads, columns, strict=True)))

    def write_parquet(self, path: Path) -> None:
        """Write it as Parquet, with the unit of each column in its metadata; raises MissingExtraError."""
        with needed_for("a Parquet file", "report"):
            import pyarrow as pa
            import pyarrow.parquet as pq

        fields, arrays = [], []
        for head, ((_, unit), cells) in zip(self.heads, self.columns.items(), strict=True):
            kinds = {type(cell) for cell in cells if cell is not None}
            kind = pa.int64() if kinds <= {int} else pa.float64() if kinds <= {int, float} else pa.string()
            values = cells if kinds <= {int, float} else [None if cell is None else str(cell) for cell in cells]
            fields.append(pa.field(head, kind, metadata={"unit": unit}))
            arrays.append(pa.array(values, kind))
        pq.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields)), path)

    def print(self, title: str, console: Console, most: int = MOST_ROWS) -> None:
        """Print its first rows."""
        table = Table(title=title, title_justify="left")
        for cells, head in zip(self.columns.values(), self.heads, strict=True):
            # Units stand in brackets, which are no markup; a head breaks between words.
            justify: Literal["right", "left"] = "right" if _is_numeric(cells) else "left"
            table.add_column(Text(head.replace("_", " ")), justify=justify, overflow="fold")
        for row in list(zip(*self.columns.values(), strict=True))[:most]:
            table.add_row(*(Text(shown(cell)) for cell in row))
        console.print(table)
        if len(self) > most:
            console.print(f"… and {len(self) - most} rows more")


def shown(cell: Cell) -> str:
    """Return a cell for people."""
    if cell is None:
        return "–"
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell)


def runs_table(expansion: Expansion, done: Mapping[str, Done], table: str) -> ResultsTable:
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
        row = _without_units(table=table, protocol=Path(task.protocol).name, rig=Path(task.rig).stem)
        for key in expansion.varying[table]:
            if key not in ("protocol", "rig", "seed", "faults"):
                value = task.setting(key)
                plain = isinstance(value, (int, float, str)) and not isinstance(value, bool)
                row[(key, expansion.units.get((table, key), ""))] = value if plain else str(value)
        row |= _without_units(faults=Path(task.faults).stem, seed=task.seed, status=found.status, reason=found.reason)
        row |= {(name, unit): value for name, (value, unit) in found.results.items()}
        for model in models.get(task.name, ()):
            left = done[model.name].results if model.name in done else {}
            row |= {(f"{model.table}_{name}", unit): value for name, (value, unit) in left.items()}
        row[("folder", "")] = task.name
        rows.append(row)
    return ResultsTable.of(rows)


def over_seeds(table: ResultsTable, varying: Sequence[str]) -> ResultsTable:
    """Return median, worst (the greatest) and spread of each result over the seeds of a table of runs.

    A parameter that is a seed as well, such as `sequence_seed`, counts as one.
    """
    keys = [key for key in table.columns if key[0] in varying and not key[0].endswith("seed")]
    names = [key[0] for key in table.columns]
    results = [
        key
        for key in list(table.columns)[names.index("reason") + 1 :]
        if key[0] not in (*_NOT_GROUPED, "folder") and _is_numeric(table.columns[key])
    ]
    return _over(table, [("table", ""), *keys], results, "runs")


def comparisons_table(expansion: Expansion, done: Mapping[str, Done]) -> ResultsTable:
    """Return the errors of each model on each run that it was compared on, a row each."""
    rows: list[Row] = []
    for task in expansion.tasks.values():
        if not isinstance(task, ComparisonTask) or not (found := done[task.name].results):
            continue
        for model in task.models:
            row = _without_units(comparison=task.table, model=model, run=task.source)
            for what in ERRORS:
                value, unit = found[f"{model}_{what}"]
                row[(what, unit)] = value
            rows.append(row)
    return ResultsTable.of(rows)


def over_runs(comparisons: ResultsTable) -> ResultsTable:
    """Return median, worst and spread of the errors of each model over the runs of a `comparisons_table`."""
    errors = [key for key in comparisons.columns if key[0] in ERRORS]
    return _over(comparisons, [("comparison", ""), ("model", "")], errors, "runs")


def shown_columns(table: ResultsTable, varying: Sequence[str]) -> ResultsTable:
    """Return the columns of a table of runs that people look at: what varies, and results."""
    alike = [name for name in ("protocol", "rig", "faults", "seed") if name not in varying]
    columns = {
        key: cells
        for key, cells in table.columns.items()
        if key[0] not in (*_NOT_SHOWN, *alike) and (key[0] != "reason" or any(cells))
    }
    return ResultsTable(columns)


def in_one_cell(summary: ResultsTable) -> ResultsTable:
    """Return a table of `over_seeds` with median and worst in one cell, for people."""
    columns: dict[tuple[str, str], Sequence[Cell]] = {}
    for (name, unit), cells in summary.columns.items():
        result, _, which = name.rpartition(" ")
        if which == MEDIAN:
            worst = summary.columns[(f"{result} {WORST}", unit)]
            columns[(result, unit)] = [f"{shown(a)} / {shown(b)}" for a, b in zip(cells, worst, strict=True)]
        elif which not in (WORST, SPREAD) and name != "table":
            columns[(name, unit)] = cells
    return ResultsTable(columns)


def studies_of(expansion: Expansion, done: Mapping[str, Done]) -> dict[str, list[str]]:
    """Return the names of the tasks of each study that were completed, by study and rig."""
    found: dict[str, list[str]] = {}
    for task in expansion.tasks.values():
        if isinstance(task, StudyTask) and done[task.name].status == "completed":
            found.setdefault(" on ".join(filter(None, (task.study, Path(task.rig).stem))), []).append(task.name)
    return found


def studies_table(values: ResultsTable) -> ResultsTable:
    """Return each number of each study over its seeds, of the `study_values`: median, worst and spread."""
    return _over(values, [(name, "") for name in ("study", "rig", "number")], [("value", "")], "seeds", named=False)


def study_values(expansion: Expansion, done: Mapping[str, Done]) -> ResultsTable:
    """Return each number of each study and seed, a row each."""
    return ResultsTable.of(
        [
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
    )


def show_results(expansion: Expansion, done: Mapping[str, Done], folder: Path, console: Console) -> list[Path]:
    """Print the tables of a campaign and write them to files in its folder; return these."""
    summaries: dict[str, ResultsTable] = {}
    tables = {name: runs_table(expansion, done, name) for name in expansion.varying}
    for name, table in tables.items():
        shown_columns(table, expansion.varying[name]).print(name, console)
        if "seed" in expansion.varying[name]:
            summaries[name] = over_seeds(table, expansion.varying[name])
            in_one_cell(summaries[name]).print(f"{name}: median / worst over the seeds", console)
    files = {"results": together(tables.values())} if tables else {}
    if summaries:
        files["summary"] = together(summaries.values())
    comparisons = comparisons_table(expansion, done)
    if len(comparisons):
        compared = over_runs(comparisons)
        compared.print("comparisons, over the runs", console)
        files |= {"comparisons": comparisons, "comparisons-summary": compared}
    values = study_values(expansion, done)
    if len(values):
        texts = [
            print_over_seeds(name, [folder / task for task in tasks], console)
            for name, tasks in studies_of(expansion, done).items()
        ]
        write_result(folder / MARKDOWN_NAME, "\n\n".join(texts) + "\n")
        print_plain(console, f"every number: {folder / 'studies.csv'}")
        files |= {"studies": studies_table(values), "study-values": values}
    return write_tables(files, folder, console)


def write_tables(tables: Mapping[str, ResultsTable], folder: Path, console: Console) -> list[Path]:
    """Write tables as CSV and Parquet files by their name; without pyarrow as CSV only, which is said once."""
    paths = []
    for name, table in tables.items():
        paths.append(folder / f"{name}.csv")
        table.write_csv(paths[-1])
    try:
        for name, table in tables.items():
            table.write_parquet(folder / f"{name}.parquet")
            paths.append(folder / f"{name}.parquet")
    except MissingExtraError as error:
        print_plain(console, f"no Parquet files: {error}")
    return paths


def together(tables: Iterable[ResultsTable]) -> ResultsTable:
    """Return the rows of several tables in one; what varies in one of them is empty in the others."""
    rows = [{key: cells[i] for key, cells in table.columns.items()} for table in tables for i in range(len(table))]
    return ResultsTable.of(rows)


def _over(
    table: ResultsTable,
    keys: Sequence[tuple[str, str]],
    results: Sequence[tuple[str, str]],
    count: str,
    *,
    named: bool = True,
) -> ResultsTable:
    """Return median, worst (the greatest) and spread of results over the rows that have the same cells elsewhere.

    `keys` are the other columns, and `count` is the head of the number of rows. Heads begin with the name of a result
    if there are several.
    """
    groups: dict[tuple[Cell, ...], list[int]] = {}
    for i, cells in enumerate(zip(*(table.columns[key] for key in keys), strict=True)):
        groups.setdefault(cells, []).append(i)
    rows: list[Row] = []
    for group, members in groups.items():
        row = dict(zip(keys, group, strict=True)) | _without_units(**{count: len(members)})
        if count == "runs" and (statuses := table.columns.get(("status", ""))):
            row |= _without_units(completed=sum(statuses[i] == "completed" for i in members))
        for name, unit in results:
            values = _numbers(table.columns[(name, unit)][i] for i in members)
            prefix = f"{name} " if named else ""
            row[(f"{prefix}{MEDIAN}", unit)] = statistics.median(values) if values else None
            row[(f"{prefix}{WORST}", unit)] = max(values, key=abs) if values else None
            row[(f"{prefix}{SPREAD}", unit)] = max(values) - min(values) if values else None
        rows.append(row)
    return ResultsTable.of(rows)


def _without_units(**cells: Cell) -> Row:
    return {(name, ""): cell for name, cell in cells.items()}


def _is_numeric(cells: Sequence[Cell]) -> bool:
    return all(isinstance(cell, (int, float)) or cell is None for cell in cells)


def _numbers(cells: Iterable[Cell]) -> list[float]:
    return [float(cell) for cell in cells if isinstance(cell, (int, float)) and math.isfinite(cell)]
