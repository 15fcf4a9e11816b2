"""A picture of a recording as a viewer shows it, without a screen."""

from __future__ import annotations

import socket
import subprocess
from pathlib import Path

import rerun_cli
from rerun.experimental import ViewerClient

from bench.clock import WallClock
from bench.dashboard.recording import LOOPBACK, free_port
from bench.errors import ConfigurationError, DataError

_START_SECONDS = 30.0
_SETTLE_SECONDS = 6.0


def picture(rrd: Path, png: Path, *, at: float | None = None, size: tuple[int, int] = (1600, 1000)) -> list[str]:
    """Draw what a viewer shows of an .rrd file, without a screen; return the errors that the views report.

    Parameters
    ----------
    rrd : Path
        The recording.
    png : Path
        The picture to write.
    at : float or None
        Laboratory time in s to put the cursor at; None for the end.
    size : tuple of int
        Width and height, pixels.

    Raises
    ------
    DataError
        If there is no such recording.
    ConfigurationError
        If the viewer does not start, for lack of a graphics driver for instance.
    """
    if not rrd.is_file():
        raise DataError(f"there is no recording {rrd}")
    port = free_port(0)
    # The console script is a wrapper that would leave its viewer behind, and a viewer that the SDK spawns
    # listens to the whole network.
    command = [Path(rerun_cli.__file__).parent / "rerun", "--headless", "--hide-welcome-screen"]
    options = ["--bind", LOOPBACK, "--port", str(port), "--window-size", f"{size[0]}x{size[1]}"]
    viewer = subprocess.Popen(  # noqa: S603 - our own arguments
        [*map(str, command), *options], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    clock = WallClock()
    try:
        while not _listens(port):
            if viewer.poll() is not None or clock.now() > _START_SECONDS:
                raise ConfigurationError(
                    "Rerun's viewer does not start; without a screen it needs a Vulkan driver, such as the "
                    "one of the packages mesa-vulkan-drivers and libvulkan1"
                )
            clock.sleep(0.1)
        client = ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")
        client.open(str(rrd.absolute()))
        if at is None:
            client.set_time("t", play_state="following")
        else:
            client.set_time("t", duration=at, play_state="paused")
        # The viewer draws while data still arrive, and does not say when it has them all.
        clock.sleep(_SETTLE_SECONDS)
        client.save_screenshot(str(png.absolute()))
        return [
            f"{view.name}: {report.severity}: {report.summary}"
            for view in client.get_state().views
            for report in view.reports
        ]
    finally:
        viewer.terminate()
        viewer.wait()


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((LOOPBACK, port)) == 0
