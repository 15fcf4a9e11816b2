"""A word on the terminal when numba compiles: a first use on a machine takes seconds, before anything else."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, ClassVar, Self

from numba.core import event
from rich.console import Console

from bench.base.compiled import kernels_of
from bench.base.patience import say_share, show_patience

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
    with CompilationDisplay(console), show_patience("compiling", console):
        for number, kernel in enumerate(kernels):
            say_share("kernels", number / len(kernels))
            kernel.prepare()


class CompilationDisplay(event.Listener):
    """Says once in a process that kernels are compiled; of what comes from numba's cache nothing is said.

    Use it as a context manager: within it numba tells it when a compilation begins.

    Parameters
    ----------
    console : Console
        Where the line is printed.
    """

    _said: ClassVar[bool] = False

    def __init__(self, console: Console) -> None:
        self._console = console

    def __enter__(self) -> Self:
        event.register(_KIND, self)  # type: ignore[no-untyped-call]  # numba ships no types
        return self

    def __exit__(self, *_: object) -> None:
        event.unregister(_KIND, self)  # type: ignore[no-untyped-call]

    def on_start(self, event: Any) -> None:  # noqa: ANN401, ARG002 - numba's form
        """Print the line, if it is the first compilation."""
        if not CompilationDisplay._said:
            CompilationDisplay._said = True
            self._console.print(MESSAGE, soft_wrap=True)

    def on_end(self, event: Any) -> None:  # noqa: ANN401 - numba's form
        """Do nothing."""
