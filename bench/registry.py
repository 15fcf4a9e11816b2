"""Parts by name: the entry points that the bench and other packages register.

A package registers its parts in its `pyproject.toml`::

    [project.entry-points."bench.rigs"]          # a package whose *.toml files are rigs
    coil = "coil_bench"

    [project.entry-points."bench.models"]        # see `bench.identification.ModelSpec`
    bouc-wen = "coil_bench.bouc_wen:BOUC_WEN"

The bench registers its own parts in the same way. Nothing is imported before it is asked for, and an entry that
cannot be imported is an error only for those who ask for it.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, Literal, get_args

from bench.errors import ConfigurationError

Group = Literal[
    "rigs",
    "protocols",
    "devices",
    "laboratories",
    "derived_signals",
    "models",
    "controllers",
    "studies",
    "commands",
]
"""What can be registered; the group of the entry points is `bench.` and this name."""

OWN_PACKAGE = "actuator-bench"
_OWN_FOLDERS = ("protocols", "drivers", "sim_devices", "rigs")


@dataclass(frozen=True)
class Entry:
    """One registered part.

    Attributes
    ----------
    group, name : str
        Under which group and name it is registered.
    package : str
        Distribution that registers it.
    reference : str
        `module` or `module:object`.
    """

    group: Group
    name: str
    package: str
    reference: str

    @property
    def own(self) -> bool:
        """Whether it is a part of the bench itself."""
        return self.package == OWN_PACKAGE

    def load(self) -> Any:  # noqa: ANN401 - each group has a type of its own
        """Import it.

        Raises ConfigurationError if it cannot be imported; names entry, package and reason.
        """
        try:
            return metadata.EntryPoint(self.name, self.reference, f"bench.{self.group}").load()
        # The module of another package may fail in any way.
        except Exception as error:
            raise ConfigurationError(
                f"package {self.package}: entry point {self.name} = {self.reference!r} of bench.{self.group} cannot "
                f"be imported: {type(error).__name__}: {error}; mend the package or uninstall it"
            ) from error


@cache
def entries(group: Group) -> Mapping[str, Entry]:
    """Return what is registered in a group, by name, in alphabetical order.

    Raises ConfigurationError if two packages register the same name.
    """
    if group not in get_args(Group):
        raise ValueError(f"group: expected one of {', '.join(get_args(Group))}, got {group!r}")
    found: dict[str, Entry] = {}
    for point in metadata.entry_points(group=f"bench.{group}"):
        package = point.dist.name if point.dist is not None else "unknown"
        entry = Entry(group, point.name, package, point.value)
        other = found.setdefault(point.name, entry)
        if other != entry:
            raise ConfigurationError(
                f"packages {other.package} and {package} both register {point.name!r} in bench.{group}; uninstall one"
            )
    return dict(sorted(found.items()))


def load(group: Group, name: str) -> Any:  # noqa: ANN401 - each group has a type of its own
    """Return a registered part.

    Raises ConfigurationError if there is none of this name, or it cannot be imported.
    """
    known = entries(group)
    if name not in known:
        what = (
            group.replace("_", " ").removesuffix("s").replace("studie", "study").replace("laboratorie", "laboratory")
        )
        raise ConfigurationError(f"there is no {what} {name!r}; there are: {', '.join(known) or 'none'}")
    return known[name].load()


def check_own_packages() -> None:
    """Check that the bench's own folders are not hidden by others of the same name on the import path.

    Raises ConfigurationError if one is; names both folders.
    """
    home = Path(__file__).resolve().parents[1]
    for name in _OWN_FOLDERS:
        spec = importlib.util.find_spec(name)
        # A folder, with or without `__init__.py`, or a single file.
        places = [*(spec.submodule_search_locations or filter(None, [spec.origin]))] if spec else []
        if (home / name).is_dir() and places and Path(places[0]).resolve() != home / name:
            raise ConfigurationError(
                f"{Path(places[0]).resolve()} hides the bench's own package {name!r} ({home / name}); "
                f"run the bench from another folder, or rename that one"
            )


def import_beside(file: Path) -> None:
    """Let the modules in the folder of a file be imported; they come last and hide no installed module."""
    folder = str(file.resolve().parent)
    if folder not in sys.path:
        sys.path.append(folder)
