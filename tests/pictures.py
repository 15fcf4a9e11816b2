"""Draw the dashboard of every protocol on every emulated rig, dark and light, and check that no view is empty.

The runs are those of the studies, which `bench reproduce` makes, and short ones of the protocols that they leave out.
A dark picture is drawn by Rerun's viewer without a screen, a light one by its viewer for browsers in Chromium.
"""

from __future__ import annotations

import argparse
import io
import math
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rerun.chunk import RrdReader

import bench
from bench.catalogue import Catalogue
from bench.clock import WallClock
from bench.dashboard import rebuild
from bench.dashboard.from_journal import JournalView
from bench.dashboard.screenshot import Camera
from bench.dashboard.viewers import web_viewer
from bench.errors import DataError
from bench.journal import FILE_NAME, Record
from bench.model_file import load_model
from bench.protocol import find_protocol
from bench.rig_file import load_rig

HERE = Path(__file__).parent
SIZE = (1440, 900)
STUDIES = ("vo2", "sma", "muscles", "hybrid")
README = {
    "dashboard": ("vo2", "damped-oscillation", {}),
    "dashboard-tracking": ("vo2", "tracking", {"controller": "latched"}),
    "dashboard-sma": ("sma", "length-control", {}),
    "dashboard-hybrid": ("hybrid-witness", "hybrid-control", {"controller": "hybrid", "reference": "moves"}),
}
"""Rig, protocol and parameters of the pictures in README.md, by their names."""

SHORT: dict[str, dict[str, Any]] = {
    "creep": {"duration": 20.0, "settling": 5.0},
    "covering": {"levels": 8},
    "first-order-reversals": {"levels": 8},
    "random-validation": {"count": 60},
    "length-control": {"count": 12},
    "force-control": {"count": 12},
    "hybrid-control": {"hold": 10.0},
    "tracking": {"count": 12, "controller": "closed-loop-inverse"},
    "following": {"duration": 200.0, "period": 100.0, "controller": "open-loop-inverse"},
}
"""Parameters of the protocols that no study carries out on a rig."""

KINDS = {
    "length-control": "two-stage",
    "force-control": "two-stage",
    "hybrid-control": "hybrid",
    "fine-step": "hybrid",
}
"""Models of the protocols that take one of their own kind."""

PATIENCE = 120.0


def study_runs(folder: Path) -> dict[tuple[str, str], list[Path]]:
    """Return the runs below a folder by rig and protocol."""
    found: dict[tuple[str, str], list[Path]] = {}
    for journal in sorted(folder.rglob(FILE_NAME)):
        with Record(journal) as record:
            found.setdefault((record.meta["rig"], record.meta["protocol"]), []).append(journal.parent)
    return found


def choose(runs: list[Path], wanted: dict[str, Any]) -> Path:
    """Return the first run with these parameters, which is also the one of defaults."""
    for run in runs:
        with Record(run) as record:
            if wanted.items() <= record.meta["parameters"].items():
                return run
    return runs[0]


def study_model(runs: dict[tuple[str, str], list[Path]], rig: str, kind: str) -> Path:
    """Return a model file of a kind that a study has identified from runs of a rig."""
    folders = {run.parent for (of_rig, _), found in runs.items() if of_rig == rig for run in found}
    for path in (path for folder in sorted(folders) for path in sorted(folder.glob("*.json"))):
        if load_model(path).model.kind == kind:
            return path
    raise DataError(f"the studies have no model {kind} of {rig}")


def short_run(
    rig: str, protocol: str, out: Path, models: dict[str, Path], runs: dict[tuple[str, str], list[Path]]
) -> Path:
    """Carry a protocol out on a rig, on the virtual clock; return its folder."""
    settings = dict(SHORT.get(protocol, {}))
    definition = find_protocol(protocol)
    if protocol in KINDS:
        settings["model"] = str(study_model(runs, rig, KINDS[protocol]))
    elif definition.needs_model:
        if rig not in models:
            models[rig] = identified(rig, out)
        settings["model"] = str(models[rig])
    if protocol == "sequence":
        table = out / f"{rig}-setpoints.csv"
        role = load_rig(rig).roles["drive"]
        values = [role.at(0.5 + 0.5 * math.cos(0.4 * n) * math.exp(-n / 60)) for n in range(80)]
        rows = [f"{value},{role.dwell}" for value in values]
        table.write_text("\n".join(["input,dwell", *rows, ""]), encoding="utf-8")
        settings["setpoints"] = str(table)
    return Path(bench.run(protocol, rig, out=out, clock="virtual", **settings).folder)


def identified(rig: str, out: Path) -> Path:
    """Return the file of a Preisach model of the drive and the response of a rig."""
    run = bench.run("damped-oscillation", rig, out=out, clock="virtual", half_cycles=20)
    with Record(run.folder) as record:
        slots, parameters = record.meta["slots"], record.meta["parameters"]
    found = bench.identify(
        run,
        "preisach",
        input=slots["drive"]["signal"],
        output=slots["response"]["signal"],
        plane=(parameters["low"], parameters["high"]),
        smoothing=1e-3,
    )
    path = out / f"{rig}-preisach.json"
    found.file.save(path)
    return path


def empty_views(rrd: Path) -> list[str]:
    """Return the names of the views of a recording below whose origin there is nothing that changes in time."""
    reader = RrdReader(rrd)
    (blueprint,) = reader.blueprints()
    views: dict[str, str] = {}
    for chunk in reader.stream(store=blueprint):
        batch = chunk.to_record_batch()
        columns = {field.name: column for field, column in zip(batch.schema, batch.columns, strict=True)}
        if "ViewBlueprint:display_name" in columns:
            origin, name = (columns[f"ViewBlueprint:{key}"].to_pylist() for key in ("space_origin", "display_name"))
            views[origin[0][0]] = name[0][0]
    filled = {str(chunk.entity_path) for chunk in reader.stream() if _has_values(chunk)}
    return [
        name
        for origin, name in views.items()
        if not any(path == origin or path.startswith(f"{origin}/") for path in filled)
    ]


def _has_values(chunk: Any) -> bool:
    batch = chunk.to_record_batch()
    if str(chunk.entity_path) == "/card":
        return True
    if not any(field.name == "t" for field in batch.schema):
        return False
    for field, column in zip(batch.schema, batch.columns, strict=True):
        if field.name.endswith(":scalars"):
            return any(np.isfinite(np.array(row, dtype=np.float64)).any() for row in column.to_pylist() if row)
    return batch.num_rows > 0


class Browser:
    """Chromium, which takes light pictures."""

    def __init__(self, page: Any) -> None:
        self._page = page

    @classmethod
    @contextmanager
    def opened(cls) -> Iterator[Browser]:
        """Open it meanwhile; what is outside of this computer is not asked."""
        from playwright.sync_api import sync_playwright

        options = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
        with sync_playwright() as tools:
            browser = tools.chromium.launch(executable_path=shutil.which("chromium"), args=options)
            page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
            page.route(lambda url: "127.0.0.1" not in url, lambda route: route.abort())
            yield cls(page)
            browser.close()

    def take(self, run: Path, png: Path) -> None:
        """Write a light picture of a run."""
        with JournalView(run, 0) as view, web_viewer(view.uri) as address:
            view.follow()
            self._page.goto(f"{address}&theme=light&renderer=webgl&hide_welcome_screen=1")
            clock, before = WallClock(), b""
            while clock.now() < PATIENCE:
                self._page.wait_for_timeout(3000)
                content = self._page.screenshot()
                if content == before and _colours(content) > 500:
                    break
                before = content
            png.write_bytes(before)


def _colours(png: bytes) -> int:
    pixels = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).reshape(-1, 3)
    return len(np.unique(pixels, axis=0))


def main() -> int:
    """Draw the pictures; return 1 if a view is empty or reports an error."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("recordings/pictures"), help="folder of pictures and runs")
    parser.add_argument("--studies", type=Path, help="folder of studies that have been made already")
    parser.add_argument("--only", default="", help="only pictures whose name, RIG-PROTOCOL, has this in it")
    parser.add_argument("--themes", default="dark,light", help="dark, light, or both")
    parser.add_argument("--readme", action="store_true", help="only the pictures of README.md, and put them there")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    studies = options.studies or options.out / "studies"
    if options.studies is None:
        for name in STUDIES:
            command = [sys.executable, "-P", "-m", "bench", "reproduce", name, "--out", str(studies)]
            subprocess.run(command, check=True)
    runs = study_runs(studies)
    models: dict[str, Path] = {}
    catalogue = Catalogue.of_installed()
    pairs = [(rig, name) for rig in catalogue.rigs if load_rig(rig).emulated for name in catalogue.fitting(rig)]
    wanted: dict[str, tuple[str, str, dict[str, Any]]] = {
        f"{rig}-{protocol}": (rig, protocol, {}) for rig, protocol in pairs
    }
    if options.readme:
        wanted = dict(README)
    wanted = {name: each for name, each in wanted.items() if options.only in name}
    if not wanted:
        sys.exit(f"--only {options.only}: there is no such picture")
    problems: list[str] = []
    with ExitStack() as stack:
        camera = stack.enter_context(Camera(SIZE))
        browser = stack.enter_context(Browser.opened()) if "light" in options.themes else None
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for name, (rig, protocol, parameters) in wanted.items():
            try:
                found = runs.get((rig, protocol))
                run = choose(found, parameters) if found else short_run(rig, protocol, options.out, models, runs)
                rrd, png = scratch / f"{name}.rrd", options.out / f"{name}-dark.png"
                with Record(run) as record:
                    rebuild(record, rrd)
                said = [f"empty: {view}" for view in empty_views(rrd)]
                if "dark" in options.themes:
                    said += camera.take(rrd, png)
                    if options.readme:
                        image = Image.open(png).convert("RGB")
                        image.save(HERE.parent / "docs" / f"{name}.png", optimize=True)
                if browser is not None:
                    browser.take(run, options.out / f"{name}-light.png")
                rrd.unlink()
            # One that fails does not keep the others from being drawn.
            except Exception as error:
                said = [f"{type(error).__name__}: {error}"]
            print(f"{name}: {'; '.join(said) or 'drawn'}", flush=True)
            problems += [f"{name}: {each}" for each in said]
    print(f"{len(problems)} problems" if problems else "every view shows something", flush=True)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
