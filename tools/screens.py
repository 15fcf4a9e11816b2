"""Draw what a user sees into a folder: the terminal, a report, the dashboard; say what is empty, cut or overlapping.

The terminal is drawn at 60, 80 and 160 columns, report and dashboard dark and light, a site that was built at 1100
and 1440 pixels. Look at the pictures: what is ugly no check finds.
"""

from __future__ import annotations

import argparse
import io
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib.figure
from figure_checks import problems_of
from pictures import SIZE, Browser, empty_views
from rich.console import Console
from rich.text import Text

import bench
from bench.dashboard import rebuild
from bench.dashboard.screenshot import Camera
from bench.record import Record

COLUMNS = (60, 80, 160)
SITE = (1100, 1440)
THEMES = ("dark", "light")

_OVERLAPPING = """() => {
    const found = [];
    const boxes = (parent, query) => [...parent.querySelectorAll(query)]
        .filter(each => each.textContent.trim() && each.checkVisibility())
        .map(each => [each, each.getBoundingClientRect()])
        .filter(([_, box]) => box.width > 1 && box.height > 1);
    const over = (a, b) => Math.min(a.right, b.right) - Math.max(a.left, b.left) > 2
        && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 2;
    const groups = [...document.querySelectorAll('svg')].map(svg => boxes(svg, 'text'));
    groups.push(boxes(document, 'h1, h2, h3, p, th, td, figcaption, summary, pre'));
    for (const group of groups)
        group.forEach(([a, box], i) => group.slice(i + 1).forEach(([b, other]) => {
            if (!a.contains(b) && !b.contains(a) && over(box, other))
                found.push(`${a.textContent.trim().slice(0, 40)} overlaps ${b.textContent.trim().slice(0, 40)}`);
        }));
    for (const [each, box] of groups.at(-1))
        if (box.right > document.documentElement.clientWidth + 1)
            found.push(`${each.textContent.trim().slice(0, 40)} is cut off at the right`);
    return found;
}"""
"""Texts of a page that overlap each other, or are beyond its right edge."""


def make_runs(out: Path) -> tuple[Path, Path, Path]:
    """Carry out a characterization and a run under control; return their folders and the model file."""
    measured = bench.run("damped-oscillation", "vo2", out=out / "runs", half_cycles=12, increment="2 K")
    model = bench.identify(measured, "preisach-nonmonotonic", levels=10, plane=(30.0, 72.0), band=True)
    path = out / "model.json"
    model.file.save(path)
    model.plot().save(out / "fit.png")
    controlled = bench.run("tracking", "vo2", out=out / "runs", model=str(path), controller="latched", count=12)
    return measured.folder, controlled.folder, path


def draw_terminal(out: Path, measured: Path, controlled: Path, page: Any) -> Iterator[str]:
    """Draw what commands print; yield what is wrong."""
    columns = ["--input", "tec_temperature", "--output", "curvature"]
    commands: dict[str, list[str]] = {
        "help": ["--help"],
        "identify-help": ["identify", "--help"],
        "list": ["list"],
        "rehearse": ["rehearse", "damped-oscillation", "--rig", "vo2", "--set", "increment=5K"],
        "identify": ["identify", str(measured), *columns, "--model", "preisach", "--levels", "8"],
        "report": ["report", str(controlled)],
        "runs": ["runs", str(out / "runs")],
        "mistake": ["rehearse", "damped-oscillation", "--rig", "vo2", "--set", "increment=5V"],
    }
    for name, arguments in commands.items():
        for width in COLUMNS:
            environment = {**os.environ, "COLUMNS": str(width), "FORCE_COLOR": "1", "TTY_INTERACTIVE": "0"}
            command = [sys.executable, "-P", "-m", "bench", *arguments]
            done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
            screen = Text.from_ansi((done.stdout + done.stderr).rstrip())
            # Paths and one-line errors are whole, so that they can be copied.
            drawn = [line for line in screen.split() if any(mark in line.plain for mark in "│┃╭╰─")]
            wide = max((line.cell_len for line in drawn), default=0)
            if wide > width:
                yield f"{name} at {width} columns: a table has {wide}"
            if "Traceback" in screen.plain:
                yield f"{name} at {width} columns: a traceback"
            console = Console(record=True, width=width, file=io.StringIO())
            console.print(screen)
            page.set_content(console.export_html(inline_styles=True))
            page.set_viewport_size({"width": 40 + 8 * width, "height": 600})
            page.screenshot(path=out / f"terminal-{name}-{width}.png", full_page=True)


def draw_report(out: Path, folder: Path, page: Any) -> Iterator[str]:
    """Draw the report of a run, dark and light; yield what is wrong with its figures and texts."""
    save, wrong = matplotlib.figure.Figure.savefig, []

    def look(figure: Any, path: Path, **options: Any) -> None:
        wrong.extend(f"{path.name} of {folder.name}: {problem}" for problem in problems_of(figure))
        save(figure, path, **options)

    matplotlib.figure.Figure.savefig = look  # type: ignore[method-assign]
    try:
        found = bench.report(folder)
    finally:
        matplotlib.figure.Figure.savefig = save  # type: ignore[method-assign]
    yield from wrong
    for theme in THEMES:
        page.emulate_media(color_scheme=theme)
        page.set_viewport_size({"width": 1100, "height": 800})
        page.goto(Path(found["page"]).absolute().as_uri())
        page.screenshot(path=out / f"report-{folder.name[:24]}-{theme}.png", full_page=True)
        yield from (f"report of {folder.name}, {theme}: {text}" for text in page.evaluate(_OVERLAPPING))


def draw_site(out: Path, site: Path, page: Any) -> Iterator[str]:
    """Draw the home page of the documents; yield what is wrong."""
    for width in SITE:
        page.set_viewport_size({"width": width, "height": 900})
        page.goto((site / "index.html").absolute().as_uri())
        page.screenshot(path=out / f"site-{width}.png")
        yield from (f"site at {width}: {text}" for text in page.evaluate(_OVERLAPPING))


def draw_dashboards(out: Path, runs: tuple[Path, ...]) -> Iterator[str]:
    """Draw the dashboards of runs, dark and light; yield what is wrong."""
    recordings = []
    for run in runs:
        rrd = out / f"dashboard-{run.name[:24]}.rrd"
        rrd.unlink(missing_ok=True)
        with Record(run) as record:
            rebuild(record, rrd)
        yield from (f"{rrd.stem}: empty: {view}" for view in empty_views(rrd))
        recordings.append(rrd)
    with Camera(SIZE) as camera:
        for rrd in recordings:
            yield from camera.take(rrd, rrd.with_name(f"{rrd.stem}-dark.png"))
    with Browser.opened() as browser:
        for rrd in recordings:
            yield from browser.take(rrd, rrd.with_name(f"{rrd.stem}-light.png"))
    for rrd in recordings:
        rrd.unlink()


def main() -> int:
    """Draw the screens; return 1 if something is wrong with one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("recordings/screens"), help="folder of the pictures")
    parser.add_argument("--site", type=Path, help="folder of the site, as `make docs` builds it")
    parser.add_argument("--without-dashboard", action="store_true", help="leave out what needs a Vulkan driver")
    options = parser.parse_args()
    out = options.out
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    from playwright.sync_api import sync_playwright

    measured, controlled, _ = make_runs(out)
    problems: list[str] = []
    with sync_playwright() as tools:
        browser = tools.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page()
        problems += draw_terminal(out, measured, controlled, page)
        for folder in (measured, controlled):
            problems += draw_report(out, folder, page)
        if options.site is not None:
            problems += draw_site(out, options.site, page)
        browser.close()
    if not options.without_dashboard:
        problems += draw_dashboards(out, (measured, controlled))
    for problem in problems:
        print(problem)
    print(f"{len(problems)} problems; pictures in {out}")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
