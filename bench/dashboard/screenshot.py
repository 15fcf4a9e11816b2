"""Pictures of recordings as a viewer shows them, without a screen."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Self, TypeVar

from PIL import Image
from rerun.experimental import ViewerClient

from bench.base import ConfigurationError, DataError, WallClock
from bench.dashboard.rerun_recording import LOOPBACK, free_port
from bench.dashboard.viewers import start_viewer, wait_until_it_listens

_PATIENCE = 120.0
"""Wall-clock time within which the viewer of a busy machine answers and has drawn a picture, s.

Source: CONTRIBUTING, Checks: a wall-clock bound is tens of seconds; it may draw in software, beside other processes.
"""

_NO_DRIVER = (
    "Rerun's viewer does not start; without a screen it needs a Vulkan driver, such as the one of the packages "
    "mesa-vulkan-drivers and libvulkan1"
)

MENU_BAR = 36
"""Height of the menu bar of Rerun's viewer, pixels: it warns of the computer that draws, not of the run.

Source: a picture of Rerun 0.41.
"""

_LOOK = 1.5
"""Wall-clock time between two looks at what it has drawn, s. Derivation: eighty looks within `_PATIENCE`."""

_LAST_MOMENT = 1.0
"""Wall-clock time that a viewer has to end once it does not answer, s. Derivation: twenty looks, 0.05 s apart."""

T = TypeVar("T")


class Camera:
    """A viewer without a screen, which takes pictures of recordings; a context manager.

    Raises ConfigurationError if the viewer does not start, for lack of a graphics driver for instance.
    """

    def __init__(self, size: tuple[int, int] = (1600, 1000)) -> None:
        port = free_port(0)
        # A viewer that the SDK spawns listens to the whole network.
        options = ["--headless", "--hide-welcome-screen", "--bind", LOOPBACK, "--port", str(port)]
        self._viewer = start_viewer([*options, "--window-size", f"{size[0]}x{size[1]}"])
        self._clock = WallClock()
        self._is_used = self._has_drawn = False
        try:
            wait_until_it_listens(self._viewer, port, _NO_DRIVER)
            self._client = self._patiently(lambda: ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy"))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the viewer."""
        self._viewer.terminate()
        self._viewer.wait()

    def take(self, rrd: Path, png: Path, at: float | None = None) -> list[str]:
        """Write a picture of a recording at a laboratory time (s), its end if None; return what its views report.

        The menu bar of the viewer is left out.

        Raises DataError if there is no such recording; ConfigurationError if the viewer does not answer.
        """
        if not rrd.is_file():
            raise DataError(f"there is no recording {rrd}")
        client = self._client
        if self._is_used:
            self._patiently(lambda: client.close("all"))
        self._is_used = True
        self._patiently(lambda: client.open(str(rrd.absolute())))
        if at is None:
            self._patiently(lambda: client.set_time("t", play_state="following"))
        else:
            self._patiently(lambda: client.set_time("t", duration=at, play_state="paused"))
        # The viewer draws while data still arrive, and does not say when it has them all: two equal pictures do.
        before, end = b"", self._clock.now() + _PATIENCE
        with tempfile.TemporaryDirectory(prefix="bench-picture-") as scratch:
            look = Path(scratch) / "look.png"
            while self._clock.now() < end:
                self._clock.sleep(_LOOK)
                self._patiently(lambda: client.save_screenshot(str(look)))
                content = look.read_bytes()
                self._has_drawn = True
                if content == before and self._patiently(client.get_state).views:
                    break
                before = content
        with Image.open(BytesIO(before)) as picture:
            picture.crop((0, MENU_BAR, *picture.size)).save(png)
        return [
            f"{view.name}: {report.severity}: {report.summary}"
            for view in self._patiently(client.get_state).views
            for report in view.reports
        ]

    def _has_died(self) -> bool:
        """Return whether the viewer has ended: it stops to answer a moment before."""
        end = self._clock.now() + _LAST_MOMENT
        while self._viewer.poll() is None and self._clock.now() < end:
            self._clock.sleep(0.05)
        return self._viewer.poll() is not None

    def _patiently(self, ask: Callable[[], T]) -> T:
        """Ask the viewer, again if it takes too long, as on a busy machine; raises ConfigurationError in the end."""
        end = self._clock.now() + _PATIENCE
        while True:
            try:
                return ask()
            # The client waits a few seconds only, and says so in several ways.
            except (TimeoutError, ConnectionError, RuntimeError) as error:
                # Without a driver it listens for a moment, and dies before it has drawn anything.
                if self._has_died():
                    problem = "Rerun's viewer has died while it drew" if self._has_drawn else _NO_DRIVER
                    raise ConfigurationError(problem) from error
                if self._clock.now() > end:
                    raise ConfigurationError(f"Rerun's viewer does not answer: {error}") from error
                self._clock.sleep(0.2)


def picture(rrd: Path, png: Path, *, at: float | None = None, size: tuple[int, int] = (1600, 1000)) -> list[str]:
    """Draw what a viewer shows of an .rrd file, without a screen; return the errors that the views report.

    `at` is the laboratory time in s to put the cursor at, None for the end. Raises as `Camera` does.
    """
    if not rrd.is_file():
        raise DataError(f"there is no recording {rrd}")
    with Camera(size) as camera:
        return camera.take(rrd, png, at)
