"""The files that a campaign reads beside its own, such as programs, rig files, faults and data, and their hashes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection
from functools import cache
from pathlib import Path

from bench.base import ConfigurationError, registry
from bench.record import version_of

PROGRAMS = (".py",)
PROGRAMS_AND_RIGS = (".py", ".toml")
"""Suffixes of the files beside a rig file or a protocol file that it may import or extend."""
_LIBRARIES = ("llvmlite", "numba", "numpy", "pydantic", "pymodbus", "scipy", "simpleeval")
"""Whose versions may change a number."""


def digest(content: object) -> str:
    """Return the hash of what JSON can hold."""
    text = json.dumps(content, sort_keys=True, ensure_ascii=False, default=str)
    return hashlib.sha256(text.encode("utf-8", "backslashreplace")).hexdigest()


@cache
def code_digest() -> str:
    """Return the hash of the programs: the bench, the packages that register parts, the versions of libraries."""
    versions = {name: version_of(name) for name in _LIBRARIES}
    files = registry.files_of_parts(PROGRAMS_AND_RIGS).items()
    return digest(versions | {name: hashlib.sha256(file.read_bytes()).hexdigest() for name, file in files})


def files_of(path: Path, beside: Collection[str] = ()) -> list[Path]:
    """Return a file, and those beside it with one of these suffixes; raises OSError if they cannot be listed."""
    others = (file for file in sorted(path.parent.iterdir()) if file.suffix in beside and file.is_file())
    return list(dict.fromkeys([path, *others]))


def file_digest(path: Path, beside: Collection[str] = ()) -> str:
    """Return the hash of a file, and of those beside it with one of these suffixes, by their names.

    Raises ConfigurationError if one cannot be read.
    """
    try:
        return digest({each.name: hashlib.sha256(each.read_bytes()).hexdigest() for each in files_of(path, beside)})
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be read: {error.strerror}") from None
