"""Studies: series of runs on emulated rigs, and their results as values, tables and figures.

A package registers a `Study` as an entry point of the group `bench.studies`; `bench study NAME` carries it out.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec

import numpy as np
from rich.console import Console
from rich.table import Table

from bench.analysis import Published, RunFolder, TargetResults, target_results
from bench.base import (
    BenchError,
    ConfigurationError,
    DataError,
    Floats,
    MissingExtraError,
    Stopwatch,
    check_extra,
    parse_toml,
    print_plain,
    registry,
    show_table,
)
from bench.protocol import find_protocol
from bench.record import Record, add_model

if TYPE_CHECKING:
    from bench.base import Pending, Workers
    from bench.execution import RunResult
    from bench.identification import ModelFile
    from bench.rig import Calibration

P = ParamSpec("P")

_TELLING = 20
"""Longest setting that is part of a run's name, characters."""
_KERNELS = (
    "bench.models.kernels.memory_kernels",
    "bench.identification.kernels.constrained_fit_kernels",
    "bench.identification.kernels.factor_kernels",
)
"""Kernels of the identification of a Preisach operator, which every study takes."""
_CALIBRATED = """[derived.{}]
kind = "calibrated"
source = "{}"
calibration = "{}"
"""


@dataclass
class RunSeries:
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
    workers : Workers
        Who carries the runs out, and draws the figures.
    figure_format : {"png", "pdf", "svg"}
        Of the figures.
    records : bool
        Whether to make recordings.
    settings : mapping of str to mapping of str to str
        Parameters that are set in each run of a protocol, by the name of the protocol.
    started : list of Pending
        The runs that were started so far, by this campaign and its parts.
    """

    rig: str
    folder: Path
    seed: int
    live: bool
    workers: Workers
    figure_format: str = "png"
    records: bool = True
    settings: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    started: list[Pending[RunResult]] = field(default_factory=list)
    _recordings: dict[Path, Pending[list[Path]]] = field(default_factory=dict)
    _seeds: Iterator[int] = field(init=False)

    def __post_init__(self) -> None:
        (self.folder / "figures").mkdir(parents=True, exist_ok=True)
        self._seeds = (2 * self.seed + k % 2 + 100_000 * (k // 2) for k in itertools.count())

    def part(self, name: str, rig: str) -> RunSeries:
        """Return a campaign on another rig, in a folder of its own below this one."""
        return replace(self, rig=rig, folder=self.folder / name)

    def start(
        self,
        protocol: str,
        settings: Mapping[str, str],
        overrides: Mapping[str, str] | None = None,
        *,
        rig: str | None = None,
    ) -> Pending[RunResult]:
        """Have one protocol carried out beside others, on another rig than the campaign's if one is given.

        Its seed depends on how many were started before it. Its `result()` raises BenchError if the run did not
        complete, or the safe state was not confirmed; its record is kept.
        """
        settings = {**settings, **self.settings.get(protocol, {})}
        telling = [f"{key}={value}" for key, value in settings.items() if len(value) <= _TELLING]
        run = self.workers.submit(
            " ".join([protocol, *telling]),
            _carry_out,
            protocol,
            settings=settings,
            rig=rig or self.rig,
            overrides=dict(overrides or {}),
            seed=next(self._seeds),
            folder=self.folder,
            live=self.live,
        )
        self.started.append(run)
        return run

    def calibrated_rig(self, calibrations: Mapping[str, Calibration], tables: str, *, rig: str | None = None) -> str:
        """Write a rig file that applies calibrations to the campaign's rig, or another; return its path.

        Parameters
        ----------
        calibrations : mapping of str to Calibration
            By the name of the calibrated signal.
        tables : str
            TOML of what takes these signals, such as roles.
        rig : str, optional
            The other rig.
        """
        extended = rig or self.rig
        path = self.folder / f"{Path(extended).name.removesuffix('.toml')}-calibrated.toml"
        # A file is named as from anywhere, a packaged rig by its name.
        base = str(Path(extended).resolve()) if extended.endswith(".toml") else extended
        parts = [f"extends = {json.dumps(base)}\n"]
        for name, calibration in calibrations.items():
            file = self.folder / f"{name}.json"
            calibration.save(file)
            parts.append(_CALIBRATED.format(name, calibration.signal, file.name))
        path.write_text("\n".join([*parts, tables]), encoding="utf-8")
        return str(path)

    def run(
        self, protocol: str, settings: Mapping[str, str], overrides: Mapping[str, str] | None = None
    ) -> RunResult:
        """Carry out one protocol and wait for its end; see `start`."""
        return self.start(protocol, settings, overrides).result()

    def conclude(self, run: Pending[RunResult], identified: Iterable[ModelFile] = ()) -> RunResult:
        """Wait for the end of a run, put models that were identified from it beside it, and have its recording made.

        Nothing may be added later; the recording shows the last model. Raises what its `result()` raises, see
        `start`, and DataError if a model cannot be written.
        """
        # Here, as it takes a while to load and `bench list` reads the studies' names.
        from bench.analysis import export_run

        result = run.result()
        folder = result.folder
        for model in identified:
            add_model(folder, model.name, result.outcome.laboratory_seconds, model.to_json())
        if self.records and folder not in self._recordings:
            self._recordings[folder] = self.workers.submit(
                f"recording of {folder.name}", export_run, folder, "rrd", None
            )
        return result

    def recordings(self) -> list[Path]:
        """Conclude all runs that were started; return their recordings, in the order of the runs."""
        folders = [self.conclude(run).folder for run in self.started]
        return [self._recordings[folder].result()[0] for folder in folders] if self.records else []

    def draw(self, name: str, plot: Callable[Concatenate[Path, P], None], *given: P.args, **named: P.kwargs) -> Path:
        """Have a figure drawn beside what goes on; return its file.

        Parameters
        ----------
        name : str
            Name of the file, without its ending.
        plot : callable
            A function of a module that draws to the path of its first argument.
        given, named
            Its other arguments; can be pickled.
        """
        path = self.folder / "figures" / f"{name}.{self.figure_format}"
        self.workers.submit(f"figure {name}", plot, path, *given, **named)
        return path


def _carry_out(protocol: str, **asked: Any) -> RunResult:  # noqa: ANN401 - fields of `Run`
    """Carry one run of a series out."""
    # Here, as they take a while to load and `bench list` reads the studies' names.
    from bench.base import CompilationDisplay, task_console
    from bench.execution import Run, carry_out

    console = task_console()
    # The recording is made from the journal afterwards, when the density is known and can be drawn with it.
    run = Run(protocol=find_protocol(protocol), clock="virtual", recording=False, **asked)
    with CompilationDisplay(console):
        result = carry_out(run, console)
    if result.outcome.error is not None:
        raise result.outcome.error
    if not result.outcome.is_safe:
        raise BenchError(f"{protocol}: the safe state was not confirmed: {dict(result.outcome.safe_state)}")
    return result


@dataclass(frozen=True)
class ResultTable:
    """One table of a study: title above, heads of the columns, rows of cells, and note below (empty for none).

    Title, cells and note are format strings over the values of the study, such as `{validation[linear][rms]:.1f}`.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""

    def print(self, values: Mapping[str, Any], console: Console) -> None:
        """Print it, with the first column aligned left and all others right; heads are folded before cells."""
        table = Table(title=self.title.format_map(values), title_justify="left", box=None)
        for i, column in enumerate(self.columns):
            table.add_column(column, justify="left" if i == 0 else "right", no_wrap=i == 0)
        for cells in self._cells(values):
            table.add_row(*cells)
        show_table(console, table)
        if self.note:
            console.print(self.note.format_map(values))

    def markdown(self, values: Mapping[str, Any]) -> str:
        """Return it as a table of a Markdown text, the title in bold above and the note below."""
        title = self.title.format_map(values)
        rows = [self.columns, ["---"] * len(self.columns), *self._cells(values)]
        table = "\n".join(f"| {' | '.join(row)} |" for row in rows)
        return "\n\n".join(filter(None, (f"**{title[:1].upper()}{title[1:]}**", table, self.note.format_map(values))))

    def _cells(self, values: Mapping[str, Any]) -> list[list[str]]:
        return [[cell.format_map(values) for cell in row] for row in self.rows]


@dataclass(frozen=True)
class StudyResult:
    """What a study gives.

    Attributes
    ----------
    values : mapping
        Results for programs, by name; all that JSON can hold. Units are in the names.
    tables : tuple of ResultTable
        Results for people, in the order in which they are printed.
    figures : tuple of Path
        Files that were drawn.
    verdict : tuple of str
        A line for each part of the study, its main number beside the paper's; format strings as in the tables.
    """

    values: Mapping[str, Any]
    tables: tuple[ResultTable, ...]
    figures: tuple[Path, ...]
    verdict: tuple[str, ...] = ()


@dataclass(frozen=True)
class Study:
    """What `bench study NAME` carries out.

    Attributes
    ----------
    rig : str or None
        Rig on which it runs; None if it runs on several of its own.
    summary : str
        One line for lists.
    description : str
        For its help: what is done, and the source.
    carry_out : callable
        Runs the protocols of a campaign and evaluates them. Raises `BenchError` if a run did not complete.
    published : tuple of Published
        What papers state of the rig, for the pages of its runs.
    kernels : tuple of str
        Further packages whose kernels its runs take, those of its laboratories among them; see
        `bench.base.compiled.kernels_of`.
    """

    rig: str | None
    summary: str
    description: str
    carry_out: Callable[[RunSeries], StudyResult]
    published: tuple[Published, ...] = ()
    kernels: tuple[str, ...] = ()

    @property
    def all_kernels(self) -> tuple[str, ...]:
        """Packages of all kernels that its runs and identifications take."""
        return (*_KERNELS, *self.kernels)


def prepare(name: str, console: Console) -> None:
    """Compile the kernels of a study, as `reproduce` does before its first run; the Makefile calls it.

    Raises ConfigurationError if there is no such study.
    """
    # Here, as numba is slow to load.
    from bench.base import compile_kernels

    study: Study = registry.load("studies", name)
    compile_kernels(study.all_kernels, console)


def published_of(run: Path) -> tuple[Published, ...]:
    """Return what studies state of the rig of a run, or of the rig that its file extends.

    Raises DataError if there is no such run.
    """
    with Record(run) as record:
        rigs = {record.meta["rig"]}
        # The text of a file may be of a later version.
        with suppress(ValueError, KeyError):
            rigs.add(parse_toml(record.meta["rig_file"])["extends"])
    found: list[Published] = []
    for name in registry.entries("studies"):
        # A study of somebody else that cannot be imported is no matter of this run.
        with suppress(ConfigurationError):
            study = registry.load("studies", name)
            if isinstance(study, Study) and study.rig in rigs:
                found += study.published
    return tuple(found)


def reproduce(
    name: str,
    study: Study,
    *,
    rig: str | None = None,
    seed: int,
    out: Path,
    live: bool,
    console: Console,
    workers: int | None = None,
    figure_format: str = "png",
    settings: Mapping[str, Mapping[str, str]] | None = None,
) -> dict[str, Any]:
    """Carry out a study, export the recordings of its runs, and print its tables.

    The result has `seed`, the values of the study, `laboratory_seconds`, `wall_seconds`, `folder`, `figures` and
    `recordings`.

    Parameters
    ----------
    name : str
        Name of the study; names the folder `reproduce-NAME-seed-SEED`.
    study : Study
        What to carry out.
    rig : str, optional
        Another rig with the same devices and signals; the study's own if not given.
    seed : int
        Seed of the noise of the emulated laboratory, and of random sequences.
    out : Path
        Where that folder is made.
    live : bool
        Whether to serve the live view of each run; they are then carried out one after another.
    console : Console
        Where to print.
    workers : int, optional
        How many runs, figures and recordings are worked at beside each other; as many as there are cores if not
        given. The values do not depend on it.
    figure_format : {"png", "pdf", "svg"}
        Of the figures.
    settings : mapping of str to mapping of str to str, optional
        Parameters that are set in each run of a protocol, such as `{"tracking": {"count": "20"}}`.

    Raises
    ------
    ConfigurationError
        If a rig is given to a study that runs on several, a live view is asked for with several workers, a protocol
        or a parameter that is set does not exist, or matplotlib is not installed.
    BenchError
        If a run did not complete; its record is kept.
    """
    if rig is not None and study.rig is None:
        raise ConfigurationError(f"--rig {rig}: the study {name} runs on several rigs of its own")
    if live and workers not in (None, 1):
        raise ConfigurationError(f"--workers {workers}: with the live view runs follow one another; leave it out")
    settings = settings or {}
    for protocol in settings:
        find_protocol(protocol)
    check_extra("a figure", "matplotlib", "report")
    try:
        check_extra("an .rrd file", "rerun", "dashboard")
        recorded = True
    except MissingExtraError as error:
        print_plain(console, f"no recordings: {error}")
        recorded = False
    # Here, as numba is slow to load.
    from bench.base import CompilationDisplay, Workers

    stopwatch = Stopwatch()
    folder = out / f"reproduce-{name}-seed-{seed}"
    with Workers(1 if live else workers, console, name, study.all_kernels) as pool, CompilationDisplay(console):
        on = rig or study.rig or ""
        campaign = RunSeries(on, folder, seed, live, pool, figure_format, recorded, settings)
        found = study.carry_out(campaign)
        recordings = campaign.recordings()
    runs = [run.result() for run in campaign.started]
    carried_out = {RunFolder(run.folder).meta["protocol"] for run in runs if settings}
    for protocol in settings.keys() - carried_out:
        print_plain(console, f"note: parameters of {protocol} are set, but the study has no run of it")
    values = {
        "seed": seed,
        **found.values,
        "laboratory_seconds": sum(run.outcome.laboratory_seconds for run in runs),
        "wall_seconds": stopwatch.seconds(),
        "folder": str(campaign.folder),
        "figures": [str(path) for path in found.figures],
        "recordings": [str(path) for path in recordings],
    }
    for table in found.tables:
        table.print(values, console)
        console.print()
    time = f"{values['laboratory_seconds'] / 3600:.1f} h of laboratory time in {values['wall_seconds']:.1f} s"
    for line in (*(line.format_map(values) for line in found.verdict), f"time: {time} (paper: not stated)"):
        print_plain(console, line)
    print_plain(console, f"next: `bench runs {values['folder']}` lists the runs; figures and recordings are there")
    return values


def reached_targets(run: RunResult, signal: str) -> TargetResults:
    """Return how well a run brought a signal to its targets.

    Raises DataError if it had no targets.
    """
    with Record(run.folder) as record:
        results = target_results(record, signal)
    if results is None:
        raise DataError(f"{run.folder}: has no targets")
    return results


def true_errors(errors: Floats) -> dict[str, float]:
    """Return `true_max` and `true_rms` of errors against a true quantity, in its unit."""
    return {"true_max": float(np.abs(errors).max()), "true_rms": float(np.sqrt(np.mean(errors**2)))}
