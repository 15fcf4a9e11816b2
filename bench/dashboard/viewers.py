"""Viewers of a live view: Rerun's own in a window, or the one for browsers, each on the loopback address."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote, urlsplit

import rerun_cli

from bench.base import ConfigurationError, DataError, WallClock
from bench.dashboard.rerun_recording import LOOPBACK, free_port

_START_SECONDS = 30.0
"""Wall-clock time in which a viewer starts, s. Source: CONTRIBUTING, Checks: tens of seconds."""

Viewer = subprocess.Popen[bytes]


def has_display() -> bool:
    """Return whether a window can be opened."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def open_viewer(uri: str) -> Viewer:
    """Open a window that shows what is served at an address; it stays when this process ends."""
    # The console script is a wrapper that would leave its viewer behind.
    options = ["--connect", uri, "--bind", LOOPBACK, "--port", str(free_port(0)), "--hide-welcome-screen"]
    return start_viewer(options, own_session=True)


@contextmanager
def web_viewer(uri: str) -> Iterator[str]:
    """Serve the viewer for browsers meanwhile; yield the address of the page that shows what is served at `uri`.

    Raises ConfigurationError if it does not start.
    """
    port = free_port(0)
    server = start_viewer(["--serve-web", "--bind", LOOPBACK, "--web-viewer-port", str(port), uri])
    try:
        wait_until_it_listens(server, port, "Rerun's viewer for browsers does not start")
        yield f"http://{LOOPBACK}:{port}/?url={quote(uri, safe='')}"
    finally:
        server.terminate()
        server.wait()


def check_address(uri: str) -> None:
    """Check that something listens at the address of a live view; raises DataError if not."""
    parts = urlsplit(uri)
    try:
        host, port = parts.hostname or "", parts.port or 0
        socket.create_connection((host, port), timeout=_START_SECONDS).close()
    except (OSError, ValueError) as error:
        raise DataError(
            f"{uri}: nothing is shown there ({error}); a run with --live, `bench view` print "
            "addresses such as rerun+http://127.0.0.1:9876/proxy"
        ) from None


def start_viewer(options: list[str], *, own_session: bool = False) -> Viewer:
    """Start Rerun's viewer with options of its command line."""
    command = [str(Path(rerun_cli.__file__).parent / "rerun"), *options]
    return subprocess.Popen(  # noqa: S603 - our own arguments
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        # Ctrl-C in the terminal is for the bench.
        start_new_session=own_session,
    )


def wait_until_it_listens(viewer: Viewer, port: int, problem: str) -> None:
    """Wait until a process listens at a port of the loopback address; raises ConfigurationError if it does not."""
    clock = WallClock()
    while True:
        with socket.socket() as probe:
            if probe.connect_ex((LOOPBACK, port)) == 0:
                return
        if viewer.poll() is not None or clock.now() > _START_SECONDS:
            raise ConfigurationError(problem)
        clock.sleep(0.1)
