"""Skeletons of what a package of one's own adds: a device, a protocol, a model, a rig, each with tests that pass.

A skeleton is a folder of text files that end in `.in`; `$name`, `$module`, `$Class` and `$CONSTANT` stand in their
names and contents for the name that is given, as `string.Template` replaces them.
"""

from __future__ import annotations

import keyword
import re
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from string import Template
from typing import Literal, get_args

from bench.base import ConfigurationError, registry

Part = Literal["device", "protocol", "model", "rig"]
"""What there is a skeleton of."""
PARTS: tuple[Part, ...] = get_args(Part)

_GROUPS: dict[Part, registry.Group] = {
    "device": "devices",
    "protocol": "protocols",
    "model": "models",
    "rig": "rigs",
}
_NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")


def write_skeleton(part: Part, name: str, parent: Path) -> tuple[Path, ...]:
    """Write the skeleton of a part into the new folder `name` of a parent; return its files, in alphabetical order.

    The bench will know the part by its name, which is in lower case with hyphens, such as `micro-balance`. Raises
    ConfigurationError if the name is not allowed or is that of a registered part, the folder exists, or it cannot be
    written.
    """
    module = name.replace("-", "_")
    if not _NAME.fullmatch(name) or keyword.iskeyword(module):
        raise ConfigurationError(
            f"name {name!r} is not allowed: expected lower-case letters and digits, with hyphens between words, such "
            f"as micro-balance"
        )
    registered = registry.entries(_GROUPS[part])
    if name in registered:
        raise ConfigurationError(
            f"name {name!r} is that of a {part} of the package {registered[name].package}; choose another"
        )
    folder = parent / name
    if folder.exists():
        raise ConfigurationError(f"{folder} exists already; choose another name or folder")
    words = name.split("-")
    template = {
        "name": name,
        "module": module,
        "Class": "".join(word.capitalize() for word in words),
        "CONSTANT": "_".join(word.upper() for word in words),
    }
    try:
        return tuple(sorted(_copy(files(__name__) / part, folder, template)))
    except OSError as error:
        raise ConfigurationError(f"{folder} cannot be written: {error}") from None


def _copy(source: Traversable, folder: Path, template: dict[str, str]) -> list[Path]:
    folder.mkdir(parents=True)
    written: list[Path] = []
    for entry in source.iterdir():
        path = folder / Template(entry.name.removesuffix(".in")).substitute(template)
        if entry.is_dir():
            written += _copy(entry, path, template)
        elif entry.name.endswith(".in"):
            path.write_text(Template(entry.read_text(encoding="utf-8")).substitute(template), encoding="utf-8")
            written.append(path)
    return written
