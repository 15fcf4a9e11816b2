"""What the reproductions of the papers share: one session after another on a rig, and how results are told."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from bench.errors import BenchError
from bench.protocol import find_protocol
from bench.runs import Run, RunResult, carry_out


@dataclass
class Campaign:
    """A series of runs on one rig, on the virtual clock, each with noise of its own.

    Attributes
    ----------
    rig : str
        Name of the rig, or path of a rig file.
    folder : Path
        Where the runs go; made if it is not there.
    seed : int
        From which the seeds of the runs come; no two runs of any two seeds below 50 000 share theirs.
    live : bool
        Whether to serve the live view.
    console : Console
        Where to print.
    runs : list of RunResult
        What was carried out so far.
    """

    rig: str
    folder: Path
    seed: int
    live: bool
    console: Console
    runs: list[RunResult] = field(default_factory=list)
    _seeds: Iterator[int] = field(init=False)

    def __post_init__(self) -> None:
        (self.folder / "figures").mkdir(parents=True, exist_ok=True)
        self._seeds = (2 * self.seed + k % 2 + 100_000 * (k // 2) for k in itertools.count())

    def run(
        self,
        protocol: str,
        settings: Mapping[str, str],
        overrides: Mapping[str, str] | None = None,
        *,
        rig: str | None = None,
    ) -> RunResult:
        """Carry out one protocol, on another rig than the campaign's if one is given.

        Raises
        ------
        BenchError
            If it did not complete, or the safe state was not confirmed; its record is kept.
        """
        definition = find_protocol(protocol)
        result = carry_out(
            Run(
                protocol=definition,
                settings=settings,
                rig=rig or self.rig,
                overrides=overrides or {},
                seed=next(self._seeds),
                clock="virtual",
                folder=self.folder,
                live=self.live,
                # Made from the journal afterwards, when the density is known and can be drawn with it.
                recording=False,
            ),
            self.console,
        )
        if result.outcome.error is not None:
            raise result.outcome.error
        if not result.outcome.is_safe:
            raise BenchError(f"{protocol}: the safe state was not confirmed: {dict(result.outcome.safe_state)}")
        self.runs.append(result)
        return result

    @property
    def laboratory_seconds(self) -> float:
        """Laboratory time of all runs, s."""
        return sum(run.outcome.laboratory_seconds for run in self.runs)


def make_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    """Return a table with its first column to the left and all others to the right."""
    table = Table(title=title, title_justify="left")
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i == 0 else "right")
    for row in rows:
        table.add_row(*row)
    return table


def print_end(result: Mapping[str, Any], console: Console) -> None:
    """Print how long it took and where everything is, from `laboratory_seconds`, `folder` and the like."""
    laboratory, wall = result["laboratory_seconds"], result["wall_seconds"]
    console.print(
        f"{laboratory / 3600:.1f} h of laboratory time in {wall:.1f} s: {laboratory / wall:.0f} times as fast",
        highlight=False,
    )
    console.print(f"runs, models and recordings: {result['folder']}", highlight=False, soft_wrap=True)
    console.print(f"figures: {result['folder']}/figures", highlight=False, soft_wrap=True)
    console.print("open a recording with `rerun FILE`:", highlight=False)
    for path in result["recordings"]:
        console.print(f"  {path}", highlight=False, soft_wrap=True)
