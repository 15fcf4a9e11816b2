"""What the bench can do only with the libraries of an extra: one message says which one to install."""

from __future__ import annotations

import importlib.metadata
import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit
from urllib.request import url2pathname

from bench.base.errors import ConfigurationError
from bench.base.parsing import parse_json

Extra = Literal["cluster", "dashboard", "files", "fmu", "panel", "report"]


class MissingExtraError(ConfigurationError):
    """The libraries of an extra are not installed."""


def how_to_install(extra: str) -> str:
    """Return the command that installs an extra, from where the bench itself was installed.

    That is a checkout or a wheel on this computer (PEP 610, `direct_url.json`), else an index.
    """
    recorded = importlib.metadata.distribution("actuator-bench").read_text("direct_url.json") or "{}"
    source = urlsplit(parse_json(recorded).get("url", ""))
    place = Path(url2pathname(source.path))
    return f"pip install '{place if source.scheme == 'file' and place.exists() else 'actuator-bench'}[{extra}]'"


@contextmanager
def needed_for(purpose: str, extra: Extra) -> Iterator[None]:
    """Import within this block what `purpose` needs of an extra of the package.

    Raises MissingExtraError if it is not installed; names the purpose, what is missing and how to install it.
    """
    try:
        yield
    except ImportError as error:
        raise MissingExtraError(
            f"{purpose} needs a library that is not installed ({error}): {how_to_install(extra)}"
        ) from error


def check_extra(purpose: str, module: str, extra: Extra) -> None:
    """Check that a library of an extra is installed, without the time that importing it takes.

    Raises MissingExtraError as `needed_for` does.
    """
    with needed_for(purpose, extra):
        if importlib.util.find_spec(module) is None:
            raise ModuleNotFoundError(f"No module named {module!r}")
