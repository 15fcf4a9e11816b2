"""`bench identify --model all`: the options of the comparison of models, its table, and errors on test rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.base import aligned, fitting_prefix, prefixed, print_plain, significant
from bench.cli.printing import console, print_rows, warn

if TYPE_CHECKING:
    from bench.analysis import (
        ColumnNames,
        Dataset,
        IdentifiedFile,
        ReadingOptions,
        SelectedModel,
        TestedModel,
    )
    from bench.identification import Candidate, Score

# Rows of the printed table; all are in the file.
_SHOWN = 10


@dataclass(frozen=True)
class Comparing:
    """The options of the comparison of models, and of its test."""

    train: Annotated[
        str | None,
        typer.Option(metavar="START:STOP", help="Rows to fit, from 0, without STOP; others drive the memory."),
    ] = None
    test: Annotated[
        str | None,
        typer.Option(metavar="START:STOP|FILE", help="Rows, or another file or run, to test the model on."),
    ] = None
    table_out: Annotated[
        Path | None, typer.Option(metavar="FILE.csv", help="Table of the models that were compared.")
    ] = None

    @property
    def train_rows(self) -> slice | None:
        """The rows that are fitted; raises ConfigurationError if the option names none."""
        from bench.analysis import parse_rows

        return None if self.train is None else parse_rows("--train", self.train)

    @property
    def test_files(self) -> tuple[Path, ...]:
        """The file on which the model is tested; none if there is none, or rows are given."""
        from bench.analysis import is_rows

        return () if self.test is None or is_rows(self.test) else (Path(self.test),)


def print_choice(found: SelectedModel, comparing: Comparing) -> None:
    """Print the table of a comparison, and write all of it if there is a file for it."""
    _print_table(found)
    print_plain(console, _on_times(found))
    if comparing.table_out is not None:
        found.save(comparing.table_out)
        print_plain(console, f"table: {comparing.table_out}")


def _print_table(found: SelectedModel) -> None:
    """Print the best models, a line each; cells are never cut off."""
    selection = found.selection
    of_runs = selection.on_runs > 0.0
    factor, unit = fitting_prefix(found.unit or "units", selection.on_blocks)
    left_out = "runs" if of_runs else "blocks"
    heads = [
        ("", "deg. of", "training", "score", "% of", left_out, "unseen", "", "CPU"),
        ("  model", "freedom", unit, unit, "range", unit, f"cycles, {unit}", "rows", "s"),
    ]
    usable = [score for score in selection.scores if not score.failure]
    decided = [score for score in usable if score.rows > selection.rows]

    def numbers(score: Score) -> tuple[str, ...]:
        return (
            f"{score.freedom:.1f}",
            significant(factor * score.training, 3),
            significant(factor * score.error, 4),
            significant(100.0 * score.error / selection.span, 3),
            significant(factor * score.blocks_rms, 3),
            significant(factor * score.cycles_rms, 3) if score.cycles else "-",
            str(score.rows),
        )

    # Where the first rows leave no memory, all starts fit alike: one of them stands for the others.
    distinct = {numbers(score): score for score in (*reversed(usable), selection.chosen)}
    shown = sorted(distinct.values(), key=usable.index)[:_SHOWN]
    shown += [score for score in (selection.chosen, *decided) if score not in shown]
    rows = [
        (
            f"{'*' if score is selection.chosen else ' '} {_describe(score.candidate)}",
            *numbers(score),
            f"{score.seconds:.1f}",
        )
        for score in shown
    ]
    print_plain(console, "models by their score, the RMS error on what was left out of the fit")
    for line in aligned([*heads, *rows], numbers_from=1):
        print_plain(console, line)
    more = len(selection.scores) - len(shown)
    # Of a record of one kind of cycle.
    bounded = ", among planes with signs that err at most 1.25 times as much" if selection.is_bounded else ""
    print_plain(console, "* chosen: the fewest degrees of freedom within 2 % of the least score" + bounded)
    failed = len(selection.scores) - len(usable)
    if more > 0:
        unfitted = f", of which {failed} could not be fitted" if failed else ""
        print_plain(console, f"{more} more were tried{unfitted}; --table-out FILE.csv writes all")
    if decided:
        print_plain(
            console,
            f"compared were {selection.rows} of {selection.of} rows; the best of two models were then scored on all "
            "rows, and one of these was chosen",
        )
    blocks = f"contiguous blocks of the {selection.rows} rows compared, with gaps of {selection.gap},"
    print_plain(console, f"left out: {'whole files' if of_runs else blocks} and whole kinds of cycles")
    errors = f"error of the chosen model: {significant(factor * selection.on_blocks, 3)} {unit} on blocks"
    print_plain(
        console,
        f"{errors}, {significant(factor * selection.on_runs, 3)} {unit} on another run" if of_runs else errors,
    )


def read_measured(
    files: Sequence[Path], names: ColumnNames, model: str, comparing: Comparing, reading: ReadingOptions
) -> tuple[Dataset, Dataset | None]:
    """Read the measurements, and the file for tests if there is one, before anything is fitted.

    Where nobody named a column of times and a model with time may use it, it is looked for. Not in several files, as
    times are those of one record. What is in the way of comparing models with time is printed.
    """
    from bench.analysis import FEWEST_ROWS, NO_TIMES, is_comparison, read_dataset, time_names
    from bench.models import timed_models

    several = is_comparison(model)
    is_sought = names.time is None and len(files) == 1 and (several or model in timed_models())
    names = replace(
        names, time=None if names.time == NO_TIMES else names.time, times=time_names(files[0]) if is_sought else ()
    )
    data = read_dataset(files, names, reading, at_least=FEWEST_ROWS)
    if is_sought and several:
        data = data.with_usable_times()
    if not comparing.test_files:
        return data, None
    # Rows that are evenly sampled have no column of times.
    time = None if data.time is None or reading.interval else data.time.name
    wanted = replace(names, weights=None, time=time, times=())
    if is_sought and several and time is not None:
        wanted = replace(wanted, time=None, times=(time,))
    test = read_dataset(comparing.test_files, wanted, reading, at_least=FEWEST_ROWS)
    if test.time is None and time is not None:
        print_plain(console, f"{test.name} has no column {time}: time is left out")
        data = data.without_time()
    return data, test


def _on_times(found: SelectedModel) -> str:
    """Return what became of the times."""
    if not found.selection.has_times:
        return (
            "times are not known, so that no lag, creep, drift, viscosity or friction was tried: --time COLUMN names "
            "them, in a run of the bench --time finished"
        )
    if found.is_timed:
        return "the chosen model takes the times of the rows; --time none leaves them out"
    return "no lag, creep, drift, viscosity or friction lowers the score: the chosen model takes no times"


def _describe(one: Candidate) -> str:
    """Return a model with its settings in short: those that differ from none."""
    own = dict(one.options)
    parts = [f"{one.model} with {one.dynamics.replace(',', ' and ')}" if one.dynamics else one.model]
    parts += [value if isinstance(value, str) else f"{name} {value}" for name, value in own.items() if value]
    falling = "operator falling" if one.dynamics else "falling"
    parts.append(falling if one.orientation == "falling" else "")
    parts.append(f"start {one.initial}" if one.initial else "")
    parts.append(f"smooth {one.smoothing:g}" if one.smoothing else "")
    parts.append(f"ridge {one.ridge:g}" if one.ridge else "")
    return ", ".join(part for part in parts if part and part != "none")


def print_test(found: IdentifiedFile, comparing: Comparing, test: Dataset | None) -> TestedModel | None:
    """Print the errors of a model on the test rows or file, if there are any, and return them."""
    from bench.analysis import error_lines, evaluate_on, evaluate_on_rows

    if comparing.test is None:
        return None
    tested = evaluate_on_rows(found, comparing.test) if test is None else evaluate_on(found, test)
    unit = found.file.response.output_unit
    raw, rezeroed = tested.comparison.raw, tested.comparison.rezeroed
    skipped = f", first {tested.skip} rows left out" if tested.skip else ""
    if warning := tested.beyond.text():
        warn(warning)
    print_rows(
        f"on {tested.source}{skipped}",
        (
            *error_lines(raw, unit),
            (
                "RMS, offset removed",
                f"{prefixed(rezeroed.rms, unit)} (offset {prefixed(tested.comparison.offset, unit)})",
            ),
        ),
    )
    return tested
