"""What the bench can do only with the libraries of an extra: one message says which one to install."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

from bench.base.errors import ConfigurationError

Extra = Literal["cluster", "dashboard", "files", "panel", "report"]


class MissingExtraError(ConfigurationError):
    """The libraries of an extra are not installed."""


@contextmanager
def needed_for(purpose: str, extra: Extra) -> Iterator[None]:
    """Import within this block what `purpose` needs of an extra of the package.

    Raises MissingExtraError if it is not installed; names the purpose, what is missing and how to install it.
    """
    try:
        yield
    except ImportError as error:
        raise MissingExtraError(
            f"{purpose} needs a library that is not installed ({error}): pip install 'actuator-bench[{extra}]'"
        ) from error


def check_extra(purpose: str, module: str, extra: Extra) -> None:
    """Check that a library of an extra is installed, without the time that importing it takes.

    Raises MissingExtraError as `needed_for` does.
    """
    with needed_for(purpose, extra):
        if importlib.util.find_spec(module) is None:
            raise ModuleNotFoundError(f"No module named {module!r}")
