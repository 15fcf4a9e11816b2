"""Finds out whether a journal lacks rows that were recorded, which SQLite itself may not say."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench.record.rows import FIRST, NUMBERS, RECOVERED_NAME
from bench.record.second_file import refusal
from bench.record.write_ahead_log import log_damage

Range = tuple[int, int]

_SHOWN = 3
"""Ranges of a table that a message names."""


@dataclass(frozen=True)
class MissingRows:
    """Rows that were recorded and that a journal does not have; false if it has all that are known.

    Attributes
    ----------
    journal : Path
        The journal.
    ranges : mapping of str to sequence of (int, int)
        By table the first and the last number of each range of missing rows.
    quantities : mapping of str to int
        By table how many rows are missing whose numbers nothing says.
    damage : str
        What is wrong with the file or its write-ahead log, so that further rows may be missing; empty if nothing is.
    """

    journal: Path
    ranges: Mapping[str, tuple[Range, ...]] = field(default_factory=dict)
    quantities: Mapping[str, int] = field(default_factory=dict)
    damage: str = ""

    def __bool__(self) -> bool:
        return bool(self.ranges or self.quantities or self.damage)

    def __str__(self) -> str:
        rows = [f"{table} {_in_words(ranges)}" for table, ranges in self.ranges.items()]
        rows += [f"{quantity} of {table}" for table, quantity in self.quantities.items()]
        what = f"lacks rows that were recorded: {', '.join(rows)}" if rows else "may lack the rows that came last"
        why = f" ({self.damage})" if self.damage else ""
        if self.journal.name == RECOVERED_NAME:
            return f"{self.journal} {what}{why}; they were in no file when it was recovered"
        return f"{self.journal} {what}{why}; `bench runs repair {self.journal}` writes a copy of what is left"

    def to_json(self) -> dict[str, Any]:
        """Return it for programs."""
        return {
            "journal": str(self.journal),
            "rows": {table: [list(each) for each in ranges] for table, ranges in self.ranges.items()},
            "quantities": dict(self.quantities),
            "damage": self.damage,
            "message": str(self),
        }


def find_missing_rows(db: sqlite3.Connection, journal: Path, meta: Mapping[str, Any]) -> MissingRows:
    """Compare a journal that nobody writes with all that says how many rows there were.

    These are the numbers of its rows, its count of them at the end of the run, its write-ahead log, and the steps
    that its ticks belong to.
    """
    damage = log_damage(journal.with_name(f"{journal.name}-wal")) or refusal(journal)
    counts = meta.get("counts")
    try:
        ranges = {table: list(_gaps(db, table)) for table in FIRST}
        last = {table: _last(db, table) for table in FIRST}
        if counts is None:
            step = db.execute("SELECT step FROM telemetry ORDER BY tick DESC LIMIT 1").fetchone()
            # The step at the last tick need not be finished, those before it are.
            waiting = {} if step is None else {"steps": int(step[0]) - 1}
        else:
            waiting = {table: int(counts[table]) + FIRST[table] - 1 for table in FIRST if table in counts}
    except (sqlite3.DatabaseError, TypeError, ValueError) as error:
        return MissingRows(journal, damage=damage or str(error))
    for table, end in waiting.items():
        if end > last[table]:
            ranges[table].append((last[table] + 1, end))
    found = {table: tuple(several) for table, several in ranges.items() if several}
    lost = meta.get("recovered", {}).get("lost", {})
    return MissingRows(journal, found, {table: n for table, n in lost.items() if table not in found}, damage)


def _gaps(db: sqlite3.Connection, table: str) -> Iterator[Range]:
    """Yield the first and the last number of each range that a table lacks up to its last row."""
    key, first = NUMBERS[table], FIRST[table]
    quantity, last = db.execute(f"SELECT count(*), max({key}) FROM {table}").fetchone()  # noqa: S608 - own names
    if not quantity or last - first + 1 == quantity:
        return
    for before, number in db.execute(
        f"SELECT lag({key}, 1, {first - 1}) OVER (ORDER BY {key}) AS before, {key} FROM {table}"  # noqa: S608
    ):
        if number > before + 1:
            yield int(before) + 1, int(number) - 1


def _last(db: sqlite3.Connection, table: str) -> int:
    last = db.execute(f"SELECT max({NUMBERS[table]}) FROM {table}").fetchone()[0]  # noqa: S608 - own names
    return FIRST[table] - 1 if last is None else int(last)


def _in_words(ranges: tuple[Range, ...]) -> str:
    shown = [str(first) if first == last else f"{first} to {last}" for first, last in ranges[:_SHOWN]]
    return ", ".join(shown) + (f" and {len(ranges) - _SHOWN} further ranges" if len(ranges) > _SHOWN else "")
