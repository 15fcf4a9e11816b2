"""The commands that show a run in a viewer: one in progress, or one that has ended, once more."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated

import typer

from bench.base import DataError, needed_for, print_plain
from bench.cli.command_support import console, show_compilation

app = typer.Typer()

_LOOK = 1.0
"""Wall-clock time between two looks into a journal, s."""

_FRAME = 0.25
"""Wall-clock time between two parts of a replay, s."""

PortOption = Annotated[
    int,
    typer.Option(
        min=0, max=65535, help="Port of the loopback address for viewers; the next free one if it is taken."
    ),
]
BrowserOption = Annotated[
    bool,
    typer.Option("--browser", help="Show it in a browser: serves the viewer for browsers on the loopback address."),
]


@app.command()
@show_compilation()
def watch(
    run: Annotated[
        str,
        typer.Argument(
            metavar="[RUN|ADDRESS]",
            help="Folder of a run in progress, a folder with runs of which the newest in progress is taken, or the "
            "address of a live view.",
        ),
    ] = "recordings",
    port: PortOption = 9877,
    browser: BrowserOption = False,
) -> None:
    """Attach a viewer to a run in progress, from any other process and as often as you like.

    The run's journal is read while it is written; the run itself does not notice. A window opens where there is a
    display; otherwise the address is printed, for `rerun ADDRESS`. Ends when the window is closed, or by Ctrl-C.
    """
    with needed_for("a viewer", "dashboard"):
        from bench.dashboard import JournalView, check_address

    if "://" in run:
        check_address(run)
        with _viewer(run, browser=browser) as is_open:
            _wait(is_open)
        return
    from bench.base import WallClock
    from bench.rig import is_in_use

    folder = _run_in_progress(Path(run))
    clock = WallClock()
    with suppress(KeyboardInterrupt), JournalView(folder, port) as view:
        print_plain(console, f"watching {folder}")
        with _viewer(view.uri, browser=browser) as is_open:
            while is_open():
                # The lock first: a run that has ended in between has its status by then.
                goes_on = is_in_use(folder)
                if status := view.follow():
                    print_plain(console, f"the run has ended: {status}")
                    break
                if not goes_on:
                    print_plain(console, "the process of the run is gone: it is unfinished; see bench resume")
                    break
                clock.sleep(_LOOK)
            _wait(is_open)


@app.command()
@show_compilation()
def replay(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run, or its journal.")],
    speed: Annotated[
        float, typer.Option(min=0.01, max=1e6, metavar="N", help="Seconds of the run in a second of the replay.")
    ] = 1.0,
    port: PortOption = 9877,
    browser: BrowserOption = False,
) -> None:
    """Show a run in a viewer as if it were carried out once more, from its journal; nothing moves.

    A window opens where there is a display; otherwise the address is printed, for `rerun ADDRESS`. Ends when the
    window is closed, or by Ctrl-C.
    """
    with needed_for("a viewer", "dashboard"):
        from bench.dashboard import JournalView
    from bench.base import WallClock

    with suppress(KeyboardInterrupt), JournalView(run, port) as view:
        entries = view.entries()
        with _viewer(view.uri, browser=browser) as is_open:
            clock = WallClock()
            shown, began = 0, clock.now()
            while shown < len(entries) and is_open():
                until = entries[0][0] + speed * (clock.now() - began)
                end = shown
                while end < len(entries) and entries[end][0] <= until:
                    end += 1
                view.show([entry for _, entry in entries[shown:end]])
                shown = end
                clock.sleep(_FRAME)
            print_plain(console, "the replay has ended")
            _wait(is_open)


def _run_in_progress(path: Path) -> Path:
    """Return the folder of a run in progress: the one given, or the newest below a folder.

    Raises DataError if there is none.
    """
    from bench.record import FILE_NAME
    from bench.rig import is_in_use

    if path.name == FILE_NAME:
        path = path.parent
    if (path / FILE_NAME).is_file():
        if not is_in_use(path):
            raise DataError(f"{path}: this run is not in progress; bench replay shows it")
        return path
    found = [journal.parent for journal in path.glob(f"*/{FILE_NAME}") if is_in_use(journal.parent)]
    if not found:
        raise DataError(f"{path}: no run is in progress there; bench runs lists those that have ended")
    return max(found, key=lambda folder: (folder / FILE_NAME).stat().st_mtime)


@contextmanager
def _viewer(uri: str, *, browser: bool) -> Iterator[Callable[[], bool]]:
    """Open a viewer meanwhile, or print the address; yield what says whether it is still wanted."""
    import webbrowser

    from bench.dashboard import has_display, open_viewer, web_viewer

    if browser:
        with web_viewer(uri) as address:
            print_plain(console, f"in a browser: {address}")
            if has_display():
                webbrowser.open(address)
            yield lambda: True
    elif has_display():
        viewer = open_viewer(uri)
        yield lambda: viewer.poll() is None
    else:
        print_plain(console, f"no display; for a viewer elsewhere: rerun {uri}")
        yield lambda: True


def _wait(is_open: Callable[[], bool]) -> None:
    """Wait until a viewer is closed, or for Ctrl-C."""
    from bench.base import WallClock

    clock = WallClock()
    while is_open():
        clock.sleep(_LOOK)
