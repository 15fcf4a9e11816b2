"""`bench study`: a registered study, or a campaign file, on emulated rigs."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bench.base import AbortError, ConfigurationError, print_plain, write_result
from bench.cli.command_support import (
    FigureFormatOption,
    JsonOption,
    LiveOption,
    check_outputs,
    parse_assignments,
    write_json,
)
from bench.cli.printing import console, error_console, show_compilation

if TYPE_CHECKING:
    from bench.batch import Executor


def command_of(name: str, study: Any) -> Callable[..., None]:  # noqa: ANN401 - as `bench.batch.Study`
    """Return the function of the command that carries a study out."""

    def carry_out_study(
        rig: Annotated[
            str | None,
            typer.Option("--rig", metavar="RIG", help="Another rig with the same signals."),
        ] = None,
        set_: Annotated[
            list[str] | None,
            typer.Option(
                "--set",
                metavar="PROTOCOL.KEY=VALUE",
                help="Set a parameter in each run of a protocol; repeatable.",
            ),
        ] = None,
        seed: Annotated[
            int, typer.Option(min=0, help="Seed of all noise in the emulated laboratory and of random sequences.")
        ] = 0,
        out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for runs, models and figures.")] = Path(
            "recordings"
        ),
        live: LiveOption = False,
        workers: Annotated[
            int | None,
            typer.Option(min=1, help="Runs that go on beside each other; as many as there are cores if not given."),
        ] = None,
        figures: FigureFormatOption = "png",
        json_file: JsonOption = None,
    ) -> None:
        from bench.batch import reproduce

        check_outputs(folder=out)
        settings: dict[str, dict[str, str]] = {}
        for name_of_parameter, text in parse_assignments("--set", set_ or []).items():
            protocol, dot, parameter = name_of_parameter.partition(".")
            if not dot:
                raise ConfigurationError(f"--set {name_of_parameter}={text}: expected PROTOCOL.KEY=VALUE")
            settings.setdefault(protocol, {})[parameter] = text
        result = reproduce(
            name,
            study,
            rig=rig,
            seed=seed,
            out=out,
            live=live,
            console=console,
            workers=workers,
            figure_format=figures,
            settings=settings,
        )
        write_json(json_file, result)

    carry_out_study.__doc__ = f"{study.summary}\n\n{study.description}"
    return carry_out_study


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
        WorkersExecutor,
        carry_out_tasks,
        done_before,
        expand,
        opened_folder,
        read_campaign,
        show_results,
    )

    stopwatch = Stopwatch()
    check_outputs(json_file=json_file, folder=out, read=[file])
    expansion = expand(read_campaign(file))
    folder = Path("recordings") / file.stem if out is None else out
    if scheduler is not None:
        from bench.batch import check_address

        check_address(scheduler)
    with ExitStack() as stack:
        if not dry_run:
            stack.enter_context(_saying_how_to_go_on(folder))
            stack.enter_context(opened_folder(folder))
        before = done_before(expansion.tasks, folder)
        console.print(expansion.announcement(before.done, 1 if scheduler else workers or available_cores()))
        if dry_run:
            for line in expansion.listing(before.done):
                print_plain(console, line)
            write_json(json_file, {name: task.describe() for name, task in expansion.tasks.items()})
            return
        write_result(folder / "campaign.toml", file.read_text(encoding="utf-8-sig"))
        for line in before.put_in_place(folder):
            print_plain(console, line)
        executor: Executor
        if scheduler is not None:
            from bench.batch import ClusterExecutor

            executor = stack.enter_context(ClusterExecutor(scheduler, folder, console))
        else:
            pool = Workers(workers, console, file.stem, kernels=expansion.kernels)
            executor = WorkersExecutor(stack.enter_context(pool), folder)
        done = dict(before.done)
        if not console.is_terminal:
            already = len(before.done)
            stack.enter_context(_saying_how_far(lambda: len(done) - already, len(expansion.tasks) - already))
        done = carry_out_tasks(expansion.tasks, done, executor)
    files = show_results(expansion, done, folder, console)
    failed = {name: each for name, each in done.items() if not each.carried_out}
    for name, each in failed.items():
        print_plain(error_console, f"{each.status}: {name}: {each.reason}")
    print_plain(
        console,
        f"{len(done) - len(failed)} of {len(done)} carried out, {len(before.done)} of them before, "
        f"in {stopwatch.seconds():.1f} s: {folder}",
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
    if failed:
        sys.exit(1)


@contextmanager
def _saying_how_far(count: Callable[[], int], tasks: int) -> Iterator[None]:
    """Print a line now and then: how many tasks are done, where no terminal draws it."""
    from bench.base import Stopwatch, format_duration

    over, since = Event(), Stopwatch()

    def say() -> None:
        while not over.wait(SAID_EVERY):
            print_plain(console, f"{format_duration(since.seconds()):>10}  {count()} of {tasks} done")

    thread = Thread(target=say, name="progress", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@contextmanager
def _saying_how_to_go_on(folder: Path) -> Iterator[None]:
    try:
        yield
    except AbortError as error:
        raise AbortError(f"{error}; what is done is in {folder}, and the same command goes on from there") from None
