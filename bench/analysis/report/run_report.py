"""Tables, figures and the page of a run, made from its journal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from bench.analysis.applied import Applied, ComparedModels
from bench.analysis.applied_figures import draw_errors, draw_in
from bench.analysis.export.run_export import make_folder
from bench.analysis.figures.canvas import check_matplotlib
from bench.analysis.figures.planes import plot_coverage, plot_densities
from bench.analysis.model_service import IdentifiedFile
from bench.analysis.report.page.model_parts import errors_parts
from bench.analysis.report.page.pages import PagePart, PageTable, PageText, write_page
from bench.analysis.report.page.run_page import run_page, signals_table
from bench.analysis.report.published import Published
from bench.analysis.report.recorded_run import RecordedRun
from bench.analysis.report.run_figures import draw_loops, draw_signals
from bench.analysis.report.uncertainty_tables import uncertainty_parts
from bench.base import format_duration, print_plain, print_table, show_rows
from bench.identification import ModelFile
from bench.models import MemoryCurve
from bench.record import Event, Record, card_rows, lateness_lines, steps_of

PAGE_NAME = "report.html"
"""Usual file name of the page of a run."""


def report_run(
    run: Path,
    models: Sequence[ModelFile],
    out: Path | None,
    console: Console,
    *,
    figure_format: str = "png",
    published: Sequence[Published] = (),
) -> dict[str, Any]:
    """Print a run's tables, draw its figures, write its page, and compare models on it; return the same for programs.

    Parameters
    ----------
    run : Path
        Folder or journal of the run.
    models : sequence of ModelFile
        Models to compare, besides those that were identified from the run.
    out : Path or None
        Folder of the figures and of the page `report.html`; if None, `report` beside the journal, where the page is.
    console : Console
        Console to print on.
    figure_format : {"png", "pdf", "svg"}
        Format of the figures.
    published : sequence of Published
        Numbers of papers, for the page.

    Raises
    ------
    DataError
        If the run or a model cannot be read.
    MissingExtraError
        If matplotlib or jinja2 is not installed.
    """
    check_matplotlib()
    with Record(run) as record:
        folder = make_folder(out or record.path.parent / "report")
        _print_card(record.meta, console)
        found = RecordedRun.of(record, models)
        if remark := record.remark():
            print_plain(console, remark)
        _print_status(record, len(found.steps), console)
        print_parts([signals_table(found)], console)
        _print_events(found.events, console)
        for line in lateness_lines(record.meta.get("lateness", {})):
            print_plain(console, line)
        figures = _draw(found, folder, figure_format)
        for line in found.control_lines():
            print_plain(console, line)
        print_parts([*uncertainty_parts(found.uncertainty), *errors_parts(found.applied)], console)
        result = found.result
        page = (out or record.path.parent) / PAGE_NAME
        write_page(page, run_page(found, published))
    for path in figures:
        print_plain(console, f"figure: {path}")
    print_plain(console, f"page: {page}")
    return {**result, "figures": [str(path) for path in figures], "page": str(page)}


def draw_comparison(result: ComparedModels, out: Path) -> list[Path]:
    """Draw the residuals of compared models, their outputs and loops; return the files."""
    folder = make_folder(out)
    path = folder / "residuals.png"
    draw_errors(path, result.applied)
    return [path, *draw_in(folder, "models", result.applied)]


def draw_predicted(found: Applied, out: Path) -> list[Path]:
    """Draw the outputs of one model; return the files."""
    return draw_in(make_folder(out), found.file.name, {found.file.name: found})


def draw_identification(found: IdentifiedFile, out: Path) -> list[Path]:
    """Draw loops, errors and density of an identified model; return the files."""
    folder = make_folder(out)
    operator = found.file.response
    name = found.file.name
    paths = draw_in(folder, name, {name: found.applied()})
    for density in operator.densities():
        paths.append(folder / f"{name}-density.png")
        # What the samples of the fit swept; the coverage is that of all.
        swept = found.identification.certificate.swept[: found.coverage.swept.size] if found.coverage else None
        plot_densities(paths[-1], [density], swept)
        if found.coverage is not None and isinstance(found.file.memory, MemoryCurve):
            paths.append(folder / f"{name}-coverage.png")
            swept = found.coverage.swept
            resolution = found.resolution.diagonal[: swept.size] if found.resolution else None
            plot_coverage(paths[-1], density, swept, found.file.memory, resolution)
    return paths


def _print_card(meta: Mapping[str, Any], console: Console) -> None:
    rows = card_rows(meta)
    # A name of any length, on a line of its own.
    print_plain(console, f"{rows.pop('run')}: {meta['rig_title']}")
    title = f"{meta['protocol']} on {meta['rig']}: {meta['protocol_summary']}"
    show_rows(console, title, ((name, Text(text)) for name, text in rows.items()))


def _print_status(record: Record, steps: int, console: Console) -> None:
    style = {"completed": "green", "unfinished": "yellow"}.get(record.status, "red")
    console.print(Text(record.status, style), f"after {steps_of(record.meta, steps)}")
    for text in filter(None, [record.reason, *(f"{name}: {state}" for name, state in record.safe_state.items())]):
        print_plain(console, f"  {text}")


def print_parts(parts: Sequence[PagePart], console: Console, title: str = "") -> None:
    """Print tables and texts of a page; a table without a title has that of its section."""
    for part in parts:
        if isinstance(part, PageTable):
            print_table(console, part.heads, part.rows, part.title or title)
        elif isinstance(part, PageText):
            print_plain(console, part.text)


def _print_events(events: Sequence[Event], console: Console) -> None:
    for event in events:
        if event.level != "INFO" or event.kind == "note":
            print_plain(console, f"{format_duration(event.t):>10}  {event.kind}: {event.text}")


def _draw(run: RecordedRun, folder: Path, figure_format: str) -> list[Path]:
    """Draw signals and loops, and the errors of models, as far as there are readings; return the files."""
    if not len(run.steps):
        return []
    path = folder / f"signals.{figure_format}"
    paths = [path] if draw_signals(path, run) else []
    paths += (path for path, _ in draw_loops(folder, figure_format, run))
    if run.applied:
        paths.append(folder / f"errors.{figure_format}")
        draw_errors(paths[-1], {each.file.name: each for each in run.applied})
    return paths
