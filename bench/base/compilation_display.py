"""The terminal while numba compiles: a first use on a machine takes seconds, before anything else is seen."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from typing import Any, ClassVar, Self

from numba.core import event
from rich.console import Console
from rich.errors import LiveError
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from bench.base.compiled import kernels_of

MESSAGE = "compiling the numerical kernels (once on this machine)"
"""What is printed at the first compilation."""

_KIND = "numba:compile"


def compile_kernels(packages: Iterable[str], console: Console) -> None:
    """Compile the kernels of packages that are not compiled yet, before other processes use them.

    Parameters
    ----------
    packages : iterable of str
        See `bench.base.compiled.kernels_of`.
    console : Console
        Where a line says so once, and a bar is drawn if it is a terminal.
    """
    kernels = kernels_of(packages)
    with CompilationDisplay(console, console, len(kernels)) as display:
        for kernel in kernels:
            kernel.prepare()
            display.advance()


class CompilationDisplay(event.Listener):
    """Says once that kernels are compiled, and draws a bar while one is; what comes from numba's cache is not shown.

    Use it as a context manager: within it numba tells it when a compilation begins and ends. Within another one, it
    takes its place.

    Parameters
    ----------
    console : Console
        Console of the bar, if it is a terminal.
    error_console : Console
        Where the line is printed.
    total : int, optional
        Number of kernels that `advance` counts; without it each one that is compiled is counted.
    """

    _innermost: ClassVar[CompilationDisplay | None] = None
    _said: ClassVar[bool] = False

    def __init__(self, console: Console, error_console: Console, total: int | None = None) -> None:
        self._error_console = error_console
        self._total = total
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("kernels"),
            TimeElapsedColumn(),
            *([] if total is None else [TextColumn("left"), TimeRemainingColumn()]),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task("compiling", start=False, total=total)
        self._depth = 0

    def __enter__(self) -> Self:
        self._outer, CompilationDisplay._innermost = CompilationDisplay._innermost, self
        event.register(_KIND, self)  # type: ignore[no-untyped-call]  # numba ships no types
        return self

    def __exit__(self, *_: object) -> None:
        event.unregister(_KIND, self)  # type: ignore[no-untyped-call]
        CompilationDisplay._innermost = self._outer
        self._progress.stop()

    def advance(self) -> None:
        """Count a kernel."""
        self._progress.advance(self._task)

    def on_start(self, event: Any) -> None:  # noqa: ANN401, ARG002 - numba's form
        """Show the bar; a kernel compiles those that it calls, so compilations are nested."""
        if self is not CompilationDisplay._innermost:
            return
        self._depth += 1
        if self._depth > 1:
            return
        if not CompilationDisplay._said:
            CompilationDisplay._said = True
            self._error_console.print(MESSAGE, highlight=False, soft_wrap=True)
        self._progress.start_task(self._task)
        # Not while the progress of a run is drawn on the same console.
        with suppress(LiveError):
            self._progress.start()

    def on_end(self, event: Any) -> None:  # noqa: ANN401, ARG002 - numba's form
        """Count the kernel, and take the bar away after the outermost one if no number of them is known."""
        if self is not CompilationDisplay._innermost:
            return
        self._depth -= 1
        if self._depth == 0 and self._total is None:
            self.advance()
            self._progress.stop()
