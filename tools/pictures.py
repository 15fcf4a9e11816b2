"""Draw the dashboard of every protocol on every emulated rig, dark and light, and check that no view is empty.

The runs are those of the studies, which `bench study` makes, and short ones of the protocols that they leave out.
A dark picture is drawn by Rerun's viewer without a screen, a light one by its viewer for browsers in Chromium. Runs
and pictures are kept, and made again once the sources change that they come from.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import io
import json
import math
import multiprocessing
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rerun.chunk import RrdReader

import bench
from bench.base import DataError, WallClock
from bench.cli import installed
from bench.dashboard import rebuild
from bench.dashboard.rerun_recording import LOOPBACK, free_port
from bench.dashboard.screenshot import MENU_BAR, Camera
from bench.dashboard.viewers import start_viewer, wait_until_it_listens
from bench.identification import load_model
from bench.identification.model_file import FORMAT
from bench.protocol import find_protocol
from bench.record import FILE_NAME, Record
from bench.rig import load_rig

HERE = Path(__file__).parent
SIZE = (1440, 900)
THEMES = ("dark", "light")
STUDIES = ("vo2", "hybrid", "sma", "muscles")
README = {
    "dashboard": ("vo2", "damped-oscillation", {}),
    "dashboard-tracking": ("vo2", "tracking", {"controller": "latched"}),
    "dashboard-sma": ("sma", "length-control", {}),
    "dashboard-hybrid": ("hybrid-witness", "hybrid-control", {"controller": "hybrid", "reference": "moves"}),
}
"""Rig, protocol and parameters of the pictures in docs, by their names; of the runs of the studies."""

SHORT: dict[str, dict[str, Any]] = {
    "creep": {"duration": 20.0, "settling": 5.0},
    "covering": {"levels": 8},
    "first-order-reversals": {"levels": 8},
    "random-validation": {"count": 60},
    "length-control": {"count": 12},
    "force-control": {"count": 12},
    "hybrid-control": {"hold": 10.0},
    # A model of few samples may be worse than none.
    "tracking": {"count": 12, "controller": "closed-loop-inverse", "fallback": "open-loop"},
    "following": {"duration": 200.0, "period": 100.0, "controller": "open-loop-inverse", "fallback": "open-loop"},
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
LOOK = 400
"""Wall-clock time between two looks at what the browser shows, ms."""

SOURCES = ("bench", "drivers", "protocols", "rigs", "sim_devices")
VIEWS = ("bench/dashboard", "bench/record/lateness.py", "bench/base/units.py")
WITHOUT_EFFECT = ("bench/cli", "bench/contracts", "bench/panel", "bench/rig/maintenance", *VIEWS)
"""Of the sources, those that a run does not depend on."""


@dataclass(frozen=True)
class Wanted:
    """A picture to draw: its name, and the run that it shows."""

    name: str
    rig: str
    protocol: str
    parameters: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Made:
    """A recording to take pictures of, or why there is none; the views that are empty."""

    name: str
    run: str = ""
    rrd: Path | None = None
    said: tuple[str, ...] = ()


def digest_of(places: tuple[str, ...], without: tuple[str, ...] = ()) -> str:
    """Return a digest of the files below places of this repository, and of the versions that a run depends on."""
    digest = hashlib.sha256()
    for name in ("rerun-sdk", "numpy", "numba", "scipy"):
        digest.update(importlib.metadata.version(name).encode())
    for place in places:
        path = HERE.parent / place
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            relative = file.relative_to(HERE.parent).as_posix()
            if file.suffix in (".py", ".toml", ".csv", ".json") and not relative.startswith(without):
                digest.update(relative.encode() + file.read_bytes())
    return digest.hexdigest()[:16]


class Kept:
    """What was made from which sources, in a file beside it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._made: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}

    def of(self, key: str, sources: str) -> Any:
        """Return what was kept under a key, made from these sources; None if there is nothing."""
        made = self._made.get(key)
        return made["value"] if made is not None and made["sources"] == sources else None

    def keep(self, key: str, sources: str, value: Any) -> None:
        """Keep a value under a key."""
        self._made[key] = {"sources": sources, "value": value}
        self._path.write_text(json.dumps(self._made, indent=1), encoding="utf-8")


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
    """Return a model file of a kind that a study has identified from runs of a rig, or of a variant of it."""
    family = rig.split("-")[0]
    of_family = sorted(key for key in runs if key[0].split("-")[0] == family)
    folders = {run.parent: None for key in sorted(of_family, key=lambda key: key[0] != rig) for run in runs[key]}
    for path in (path for folder in folders for path in sorted(folder.glob("*.json"))):
        # Calibration files stand beside them.
        if json.loads(path.read_text(encoding="utf-8"))["format"] == FORMAT and load_model(path).model.kind == kind:
            return path
    raise DataError(f"the studies have no model {kind} of {rig}")


def short_run(wanted: Wanted, out: Path, models: dict[str, Path], runs: dict[tuple[str, str], list[Path]]) -> Path:
    """Carry a protocol out on a rig, on the virtual clock; return its folder."""
    rig, protocol = wanted.rig, wanted.protocol
    settings = SHORT.get(protocol, {}) | wanted.parameters
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
    for each, column in zip(batch.schema, batch.columns, strict=True):
        if each.name.endswith(":scalars"):
            return any(np.isfinite(np.array(row, dtype=np.float64)).any() for row in column.to_pylist() if row)
    return batch.num_rows > 0


def make_study(name: str, folder: Path) -> None:
    """Carry a study out, in place of what there is of it; the runs of `bench study` do not write recordings."""
    shutil.rmtree(folder / name, ignore_errors=True)
    command = [sys.executable, "-P", "-m", "bench", "study", name, "--out", str(folder / name)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise DataError(f"bench study {name}: {done.stderr.strip() or done.stdout.strip()[-500:]}")


def make_recordings(
    wanted: list[Wanted], runs: dict[tuple[str, str], list[Path]], known: list[str], out: Path
) -> list[Made]:
    """Make the recordings of some pictures of one rig; `known` are their runs, or empty if there is none yet."""
    models: dict[str, Path] = {}
    made = []
    for each, run in zip(wanted, known, strict=True):
        # One that fails does not keep the others from being drawn.
        try:
            if not run:
                found = runs.get((each.rig, each.protocol))
                run = str(choose(found, each.parameters) if found else short_run(each, out / "runs", models, runs))
            rrd = out / "recordings" / f"{each.name}.rrd"
            rrd.unlink(missing_ok=True)
            with Record(Path(run)) as record:
                rebuild(record, rrd)
            made.append(Made(each.name, run, rrd, tuple(f"empty: {view}" for view in empty_views(rrd))))
        except Exception as error:
            made.append(Made(each.name, said=(f"{type(error).__name__}: {error}",)))
    return made


class Browser:
    """Chromium, which takes light pictures: one page for all of them, as compiling the viewer takes longest."""

    def __init__(self, page: Any, origin: str) -> None:
        self._page, self._origin = page, origin
        self._rrd = Path()
        page.route(lambda url: LOOPBACK not in url, lambda route: route.abort())
        page.route("**/the-recording", lambda route: route.fulfill(path=self._rrd))
        page.goto(f"{origin}/?theme=light&renderer=webgl&hide_welcome_screen=1&persist=0")
        page.wait_for_function("window._handle", timeout=1e3 * PATIENCE)

    @classmethod
    @contextmanager
    def opened(cls) -> Iterator[Browser]:
        """Open it meanwhile; what is outside of this computer is not asked."""
        from playwright.sync_api import sync_playwright

        port = free_port(0)
        ports = ["--port", str(free_port(0)), "--web-viewer-port", str(port)]
        server = start_viewer(["--serve-web", "--bind", LOOPBACK, *ports])
        graphics = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
        try:
            wait_until_it_listens(server, port, "Rerun's viewer for browsers does not start")
            with sync_playwright() as tools:
                browser = tools.chromium.launch(
                    executable_path=shutil.which("chromium"), args=["--no-sandbox", *graphics]
                )
                page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
                page.set_default_timeout(1e3 * PATIENCE)
                yield cls(page, f"http://{LOOPBACK}:{port}")
                browser.close()
        finally:
            server.terminate()
            server.wait()

    def take(self, rrd: Path, png: Path) -> list[str]:
        """Write a light picture of a recording; return what is wrong with it."""
        self._rrd = rrd
        show = """async ([url, id]) => {
            const data = new Uint8Array(await (await fetch(url)).arrayBuffer());
            window._handle.open_channel(id, id);
            window._handle.send_rrd_to_channel(id, data);
        }"""
        former = self._page.screenshot()
        self._page.evaluate(show, [f"{self._origin}/the-recording", png.stem])
        clock, before, is_drawn = WallClock(), former, False
        while clock.now() < PATIENCE and not is_drawn:
            self._page.wait_for_timeout(LOOK)
            content = self._page.screenshot()
            is_drawn = content == before and content != former and _colours(content) > 500
            before = content
        with Image.open(io.BytesIO(before)) as picture:
            picture.crop((0, MENU_BAR, *picture.size)).save(png)
        return [] if is_drawn else ["the browser does not draw it"]


def _colours(png: bytes) -> int:
    pixels = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).reshape(-1, 3)
    return len(np.unique(pixels, axis=0))


def every_picture(only: str) -> list[Wanted]:
    """Return the pictures to draw: all protocols on all emulated rigs, then those of the documents."""
    fitting = {rig: protocols for rig, protocols in installed()["fitting"].items() if load_rig(rig).emulated}
    pictures = [Wanted(f"{rig}-{protocol}", rig, protocol) for rig in fitting for protocol in fitting[rig]]
    pictures += [Wanted(name, *what) for name, what in README.items()]
    return [each for each in pictures if only in each.name]


def main() -> int:
    """Draw the pictures; return 1 if a view is empty or reports an error."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("recordings/pictures"), help="folder of pictures and runs")
    parser.add_argument("--only", default="", help="only pictures whose name, RIG-PROTOCOL, has this in it")
    parser.add_argument("--themes", default=",".join(THEMES), help="dark, light, or both")
    parser.add_argument("--processes", type=int, default=2, help="studies and rigs at once")
    parser.add_argument("--docs", action="store_true", help="put those of the documents there")
    options = parser.parse_args()
    themes = options.themes.split(",")
    wanted = every_picture(options.only)
    if not wanted:
        sys.exit(f"--only {options.only}: there is no such picture")
    studies = options.out / "studies"
    for folder in (studies, options.out / "runs", options.out / "recordings"):
        folder.mkdir(parents=True, exist_ok=True)
    kept = Kept(options.out / "made.json")
    of_runs, of_views = digest_of(SOURCES, WITHOUT_EFFECT), digest_of(VIEWS)
    clock, problems = WallClock(), []
    with ExitStack() as stack:
        context = multiprocessing.get_context("spawn")
        # A process of its own for each rig: what one of them leaves behind is not in the runs of the next.
        workers = stack.enter_context(
            ProcessPoolExecutor(options.processes, mp_context=context, max_tasks_per_child=1)
        )
        missing = {name for name in STUDIES if kept.of(f"study {name}", of_runs) is None}
        futures = {workers.submit(make_study, name, studies): name for name in STUDIES if name in missing}
        for done in as_completed(futures):
            done.result()
            kept.keep(f"study {futures[done]}", of_runs, True)
            print(f"{clock.now():.0f} s: study {futures[done]}", flush=True)
        runs = study_runs(studies)
        drawings: dict[Future[list[Made]], str] = {}
        for rig in dict.fromkeys(each.rig for each in wanted):
            todo, known = [], []
            for each in (each for each in wanted if each.rig == rig):
                settings = f"{of_runs} {SHORT.get(each.protocol)} {each.parameters}"
                run = kept.of(f"run {each.name}", settings) or ""
                drawn = [kept.of(f"{theme} {each.name}", f"{run} {of_views}") for theme in themes]
                if run and all(drawn):
                    continue
                todo.append(each)
                known.append(run)
            if todo:
                drawings[workers.submit(make_recordings, todo, runs, known, options.out)] = rig
        camera = stack.enter_context(Camera(SIZE)) if drawings and "dark" in themes else None
        browser = stack.enter_context(Browser.opened()) if drawings and "light" in themes else None
        parameters = {each.name: (each.protocol, each.parameters) for each in wanted}
        taken: dict[tuple[str, str], Path] = {}
        for done in as_completed(drawings):
            for made in done.result():
                said = list(made.said)
                if made.rrd is not None:
                    protocol, asked = parameters[made.name]
                    kept.keep(f"run {made.name}", f"{of_runs} {SHORT.get(protocol)} {asked}", made.run)
                    for theme, viewer in (("dark", camera), ("light", browser)):
                        if viewer is not None:
                            png = options.out / f"{made.name}-{theme}.png"
                            # A viewer would add a recording to itself that it has already.
                            if (made.run, theme) in taken:
                                shutil.copyfile(taken[made.run, theme], png)
                            else:
                                said += viewer.take(made.rrd, png)
                                taken[made.run, theme] = png
                            if not said:
                                kept.keep(f"{theme} {made.name}", f"{made.run} {of_views}", True)
                    made.rrd.unlink()
                print(f"{clock.now():.0f} s: {made.name}: {'; '.join(said) or 'drawn'}", flush=True)
                problems += [f"{made.name}: {each}" for each in said]
    if options.docs:
        for each in wanted:
            if each.name in README:
                for theme in themes:
                    name = each.name if theme == "dark" else f"{each.name}-{theme}"
                    image = Image.open(options.out / f"{each.name}-{theme}.png").convert("RGB")
                    image.save(HERE.parent / "docs" / f"{name}.png", optimize=True)
    print(
        "\n".join([*problems, f"{len(problems)} problems" if problems else "every view shows something"]), flush=True
    )
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
