"""The command that carries out a campaign."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Annotated, Self

import typer

from bench.base import AbortError, print_plain, write_result
from bench.cli.command_support import JsonOption, check_outputs, write_json
from bench.cli.printing import console, error_console, show_compilation

if TYPE_CHECKING:
    from rich.console import Console

    from bench.batch import CampaignTask, Done, Executor, Expansion

SAID_EVERY = 10.0
"""Wall-clock seconds between two lines about a campaign whose output is no terminal."""


@show_compilation()
def campaign(
    file: Annotated[Path, typer.Argument(metavar="FILE.toml", help="Campaign file; docs/reference/campaign.md.")],
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the campaign; recordings/FILE if not given.")
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Worker processes; one a core if not given."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Scheduler of dask.distributed in the place of worker processes: tls://HOST:PORT, or "
            "tcp://127.0.0.1:PORT.",
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check everything, and list what would be carried out.")
    ] = False,
    json_file: JsonOption = None,
) -> None:
    """Carry out all runs, identifications and studies of a campaign file on emulated rigs, and tabulate the results.

    Everything is checked before the first run. What an earlier start has done is not done again; a campaign that was
    ended, or killed, goes on when it is started again. A run that an interlock or a fault ends is a result.

    Exit codes: 0 all that was asked for was carried out; 1 something was not; 2 the file is wrong.
    """
    from bench.base import Stopwatch, Workers, available_cores
    from bench.batch import (
        UNFINISHED,
        WorkersExecutor,
        all_carried_out,
        carry_out_tasks,
        done_before,
        expand,
        holder,
        opened_folder,
        read_campaign,
    )
    from bench.rig import Locks

    stopwatch = Stopwatch()
    check_outputs(json_file=json_file, folder=out, read=[file])
    expansion = expand(read_campaign(file))
    folder = Path("recordings") / file.stem if out is None else out
    if scheduler is not None:
        from bench.batch import check_address

        check_address(scheduler)
    before = done_before(expansion.tasks, folder)
    _announce(expansion, before.done, 1 if scheduler else workers or available_cores())
    if dry_run:
        _list(expansion, before.done)
        write_json(json_file, {name: task.describe() for name, task in expansion.tasks.items()})
        return
    with ExitStack() as stack:
        stack.enter_context(_saying_how_to_go_on(folder))
        opened_folder(folder, file.read_text(encoding="utf-8-sig"), stack.enter_context(Locks(holder(folder))))
        # Another process may have been at work here until it was locked.
        before = done_before(expansion.tasks, folder)
        for line in before.put_in_place(folder):
            print_plain(console, line)
        executor: Executor
        if scheduler is not None:
            from bench.batch import ClusterExecutor

            executor = stack.enter_context(ClusterExecutor(scheduler, folder, console))
        else:
            pool = Workers(workers, console, file.stem, kernels=expansion.kernels)
            executor = WorkersExecutor(stack.enter_context(pool), folder)
        if not console.is_terminal:
            left = len(expansion.tasks) - len(before.done)
            executor = stack.enter_context(SayingExecutor(executor, left, console))
        done = carry_out_tasks(expansion.tasks, before.done, executor)
        shutil.rmtree(folder / UNFINISHED, ignore_errors=True)
    files = _show(expansion, done, folder)
    failed = {name: each for name, each in done.items() if not each.carried_out}
    for name, each in failed.items():
        print_plain(error_console, f"{each.status}: {name}: {each.reason}")
    console.print(
        f"{len(done) - len(failed)} of {len(done)} carried out, {len(before.done)} of them before, "
        f"in {stopwatch.seconds():.1f} s: {folder}",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )
    write_json(
        json_file,
        {
            "folder": str(folder),
            "files": [str(path) for path in files],
            "tasks": {
                name: {"status": each.status, "reason": each.reason, "results": dict(each.results)}
                for name, each in done.items()
            },
        },
    )
    if not all_carried_out([*done.values()]):
        sys.exit(1)


class SayingExecutor:
    """An executor that prints a line now and then: how many tasks are done, where no terminal draws it.

    `every` is the wall-clock time between two lines, s.
    """

    def __init__(self, executor: Executor, tasks: int, console: Console, every: float = SAID_EVERY) -> None:
        self._executor, self._tasks, self._console, self._every = executor, tasks, console, every
        self._done = 0
        self._over = Event()
        self._thread = Thread(target=self._say, name="progress", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def submit(self, task: CampaignTask) -> None:
        """Have a task carried out."""
        self._executor.submit(task)

    def next_done(self) -> tuple[CampaignTask, Done]:
        """Wait for the next task that is done; return it with what it has left."""
        found = self._executor.next_done()
        self._done += 1
        return found

    def _say(self) -> None:
        from bench.base import Stopwatch, format_duration

        since = Stopwatch()
        while not self._over.wait(self._every):
            text = f"{format_duration(since.seconds()):>10}  {self._done} of {self._tasks} done"
            print_plain(self._console, text)


@contextmanager
def _saying_how_to_go_on(folder: Path) -> Iterator[None]:
    try:
        yield
    except AbortError as error:
        raise AbortError(f"{error}; what is done is in {folder}, and the same command goes on from there") from None


def _announce(expansion: Expansion, before: dict[str, Done], cores: int) -> None:
    left = [name for name in expansion.tasks if name not in before]
    estimate = expansion.estimate(left)
    counts = dict.fromkeys(("run", "model", "comparison", "study"), 0)
    for name in left:
        counts[expansion.tasks[name].kind] += 1
    plural = {"run": "runs", "model": "models", "comparison": "comparisons", "study": "studies"}
    text = ", ".join(f"{count} {kind if count == 1 else plural[kind]}" for kind, count in counts.items() if count)
    line = f"{text or 'nothing'} to do" + (f", {len(before)} done before" if before else "")
    if estimate.laboratory_seconds:
        on = "1 core" if cores == 1 else f"{cores} cores"
        hours, wall = estimate.laboratory_seconds / 3600, _duration(estimate.wall_seconds / cores)
        line += f"; {hours:.1f} h of laboratory time, {wall} on {on}"
        if estimate.unknown:
            line += f", and {estimate.unknown} tasks of unknown length"
    console.print(line, highlight=False)


def _duration(seconds: float) -> str:
    # The pace of the plant alone is known: what a run takes besides counts among short ones.
    if seconds < 60:
        return "less than a minute"
    return f"about {seconds / 60:.0f} min" if seconds < 5400 else f"about {seconds / 3600:.1f} h"


def _list(expansion: Expansion, before: dict[str, Done]) -> None:
    for name in expansion.tasks:
        planned = expansion.plans.get(name)
        parts = [name, f"{planned[0]:.0f} s" if planned else "", before[name].status if name in before else ""]
        print_plain(console, ", ".join(filter(None, parts)))


def _show(expansion: Expansion, done: dict[str, Done], folder: Path) -> list[Path]:
    """Print the tables and write them to files; return these."""
    from bench.batch import (
        MARKDOWN_NAME,
        ResultsTable,
        comparisons_table,
        in_one_cell,
        over_runs,
        over_seeds,
        print_over_seeds,
        runs_table,
        shown_columns,
        studies_of,
        studies_table,
        study_values,
        together,
        write_tables,
    )

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
    studies = studies_table(expansion, done)
    if len(studies):
        texts = [
            print_over_seeds(name, [folder / task for task in tasks], console)
            for name, tasks in studies_of(expansion, done).items()
        ]
        write_result(folder / MARKDOWN_NAME, "\n\n".join(texts) + "\n")
        print_plain(console, f"every number: {folder / 'studies.csv'}")
        files |= {"studies": studies, "study-values": study_values(expansion, done)}
    return write_tables(files, folder, console)
