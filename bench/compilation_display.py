"""The terminal while numba compiles: a first use on a machine takes seconds, before anything else is seen."""

from __future__ import annotations

from contextlib import suppress
from types import TracebackType
from typing import Any, Self

from numba.core import event
from rich.console import Console
from rich.errors import LiveError
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

MESSAGE = "compiling the numerical kernels (once on this machine)"
"""What is printed at the first compilation."""

_KIND = "numba:compile"


class CompilationDisplay(event.Listener):
    """Says once that kernels are compiled, and draws a bar while one is; what comes from numba's cache is not shown.

    Use it as a context manager: within it numba tells it when a compilation begins and ends.

    Parameters
    ----------
    console : Console
        Console of the bar, if it is a terminal.
    error_console : Console
        Where the line is printed.
    """

    def __init__(self, console: Console, error_console: Console) -> None:
        self._error_console = error_console
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.completed:.0f} functions"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task("compiling", start=False, total=None)
        self._said = False
        self._depth = 0

    def __enter__(self) -> Self:
        event.register(_KIND, self)  # type: ignore[no-untyped-call]  # numba ships no types
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        event.unregister(_KIND, self)  # type: ignore[no-untyped-call]

    def on_start(self, event: Any) -> None:  # noqa: ANN401, ARG002 - numba's form
        """Show the bar; a kernel compiles those that it calls, so compilations are nested."""
        self._depth += 1
        if self._depth > 1:
            return
        if not self._said:
            self._said = True
            self._error_console.print(MESSAGE, highlight=False, soft_wrap=True)
            self._progress.start_task(self._task)
        # Not while the progress of a run is drawn on the same console.
        with suppress(LiveError):
            self._progress.start()

    def on_end(self, event: Any) -> None:  # noqa: ANN401, ARG002 - numba's form
        """Count the function, and take the bar away after the outermost one."""
        self._depth -= 1
        self._progress.advance(self._task)
        if self._depth == 0:
            self._progress.stop()
