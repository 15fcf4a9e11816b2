"""The command that shows a run in a viewer: one in progress, or one that has ended, once more."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.base import needed_for, print_plain
from bench.cli.printing import console, show_compilation
from bench.cli.run_names import NEWEST, complete_run, find_run

if TYPE_CHECKING:
    from bench.dashboard import JournalView

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


@show_compilation()
def view(
    run: Annotated[
        str,
        typer.Argument(
            metavar="RUN|ADDRESS",
            help="A run, as in `bench report`; a folder, of whose runs the newest is taken; or the address of a live "
            "view. The newest run if not given.",
            autocompletion=complete_run,
            show_default=False,
        ),
    ] = str(NEWEST),
    speed: Annotated[
        float,
        typer.Option(
            min=0.01, max=1e6, metavar="N", help="Seconds of a run that has ended in a second of the viewer."
        ),
    ] = 1.0,
    port: PortOption = 9877,
    browser: BrowserOption = False,
) -> None:
    """Show a run in a viewer: one in progress as it goes on, one that has ended once more.

    Any other process may do this, as often as you like: the journal is read, and a run in progress does not notice. A
    window opens where there is a display; otherwise the address is printed, for `rerun ADDRESS`. Ends when the window
    is closed, or by Ctrl-C.
    """
    with needed_for("a viewer", "dashboard"):
        from bench.dashboard import JournalView, check_address

    if "://" in run:
        check_address(run)
        with _viewer(run, browser=browser) as is_open:
            _wait(is_open)
        return
    from bench.rig import is_in_use

    folder = find_run(run)
    goes_on = is_in_use(folder.parent if folder.is_file() else folder)
    with suppress(KeyboardInterrupt), JournalView(folder, port) as shown:
        print_plain(console, f"{'watching' if goes_on else 'replaying'} {folder}")
        with _viewer(shown.uri, browser=browser) as is_open:
            print_plain(console, _follow(shown, folder, is_open) if goes_on else _replay(shown, speed, is_open))
            _wait(is_open)


def _follow(shown: JournalView, folder: Path, is_open: Callable[[], bool]) -> str:
    """Show a run as it goes on; return how it ended."""
    from bench.base import WallClock
    from bench.rig import is_in_use

    clock = WallClock()
    while is_open():
        # The lock first: a run that has ended in between has its status by then.
        goes_on = is_in_use(folder)
        if status := shown.follow():
            return f"the run has ended: {status}"
        if not goes_on:
            return "the process of the run is gone: it is unfinished; see bench resume"
        clock.sleep(_LOOK)
    return "the viewer was closed; the run goes on"


def _replay(shown: JournalView, speed: float, is_open: Callable[[], bool]) -> str:
    """Show a run that has ended as if it were carried out once more."""
    from bench.base import WallClock

    entries = shown.entries()
    clock = WallClock()
    done, began = 0, clock.now()
    while done < len(entries) and is_open():
        until = entries[0][0] + speed * (clock.now() - began)
        end = done
        while end < len(entries) and entries[end][0] <= until:
            end += 1
        shown.show([entry for _, entry in entries[done:end]])
        done = end
        clock.sleep(_FRAME)
    return "the replay has ended"


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
