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
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, Literal, get_args

from bench.base.errors import ConfigurationError
from bench.base.names import closest

Group = Literal[
    "rigs",
    "protocols",
    "devices",
    "laboratories",
    "derived_signals",
    "models",
    "identifications",
    "controllers",
    "studies",
    "commands",
]
"""What can be registered; the group of the entry points is `bench.` and this name."""
GROUPS: tuple[Group, ...] = get_args(Group)
_LISTED = ("rigs", "protocols", "models", "controllers", "studies")
"""Groups whose parts `bench list` names."""

OWN_PACKAGE = "actuator-bench"
_OWN_FOLDERS = ("protocols", "drivers", "sim_devices", "rigs")
_OWN = ("bench", *_OWN_FOLDERS)


@dataclass(frozen=True)
class RegisteredPart:
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


def _packages() -> list[tuple[str, metadata.Distribution]]:
    """Return the packages that register a part, each with its name."""
    found = []
    # Of hundreds of packages few do: the entry points of the others are not parsed.
    for package in metadata.distributions():
        text = package.read_text("entry_points.txt")
        if text is None or "[bench." not in text:
            continue
        name = package.name
        # Of two of one name on the import path, the first hides the other.
        if metadata.distribution(name).read_text("entry_points.txt") == text:
            found.append((name, package))
    return found


@cache
def _all_entries() -> tuple[RegisteredPart, ...]:
    """Return everything that is registered, in all groups."""
    groups = {f"bench.{group}": group for group in GROUPS}
    return tuple(
        RegisteredPart(groups[point.group], point.name, package, point.value)
        for package, distribution in _packages()
        for point in distribution.entry_points
        if point.group in groups
    )


def forget() -> None:
    """Look again for what is registered, as the import path has changed."""
    _all_entries.cache_clear()
    entries.cache_clear()


@cache
def entries(group: Group) -> Mapping[str, RegisteredPart]:
    """Return what is registered in a group, by name, in alphabetical order.

    Raises ConfigurationError if two packages register the same name.
    """
    if group not in GROUPS:
        raise ValueError(f"group: expected one of {', '.join(GROUPS)}, got {group!r}")
    found: dict[str, RegisteredPart] = {}
    for entry in _all_entries():
        if entry.group != group:
            continue
        other = found.setdefault(entry.name, entry)
        if other != entry:
            raise ConfigurationError(
                f"packages {other.package} and {entry.package} both register {entry.name!r} in bench.{group}; "
                "uninstall one"
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
        raise ConfigurationError(
            f"there is no {what} {name!r}; {closest(name, known, '`bench list`' if group in _LISTED else '')}"
        )
    return known[name].load()


def _tops() -> set[str]:
    """Return the top modules of the packages that register a part."""
    parts = (entry for group in GROUPS for entry in entries(group).values())
    return {entry.reference.partition(":")[0].partition(".")[0] for entry in parts}


def _places(top: str) -> list[str]:
    """Return the folders of a package, or the file of a module; none if it cannot be found."""
    try:
        spec = importlib.util.find_spec(top)
    except (ImportError, ValueError):
        # What runs as a script has none.
        spec = None
    return [*(spec.submodule_search_locations or filter(None, [spec.origin]))] if spec else []


def files_of_parts(suffixes: tuple[str, ...]) -> dict[str, Path]:
    """Return the files of the packages that register a part, those with these suffixes, by `PACKAGE/PATH/IN/IT`."""
    found: dict[str, Path] = {}
    for top in {"bench"} | _tops():
        for place in map(Path, _places(top)):
            names = [f"{folder}{os.sep}{name}" for folder, _, names in os.walk(place) for name in names]
            files = [Path(name) for name in names or [str(place)] if name.endswith(suffixes)]
            found |= {f"{top}/{file.relative_to(place).as_posix()}": file for file in files}
    return dict(sorted(found.items()))


def check_own_packages() -> None:
    """Check that the bench's own folders are not hidden by others of the same name on the import path.

    Raises ConfigurationError if one is; names both folders.
    """
    home = Path(__file__).resolve().parents[2]
    for name in _OWN_FOLDERS:
        # A folder, with or without `__init__.py`, or a single file.
        places = _places(name)
        if (home / name).is_dir() and places and Path(places[0]).resolve() != home / name:
            raise ConfigurationError(
                f"{Path(places[0]).resolve()} hides the bench's own package {name!r} ({home / name}); "
                f"run the bench from another folder, or rename that one"
            )


_beside: set[Path] = set()
"""The folders of the rig and protocol files that were read."""


def import_beside(file: Path) -> None:
    """Let the modules in the folder of a file be imported; they come last and hide no installed module."""
    folder = file.resolve().parent
    _beside.add(folder)
    if str(folder) not in sys.path:
        sys.path.append(str(folder))


def forget_beside(folder: Path) -> None:
    """Take back `import_beside` for all files below a folder."""
    gone = {each for each in _beside if each.is_relative_to(folder.resolve())}
    _beside.difference_update(gone)
    sys.path[:] = [entry for entry in sys.path if not entry or Path(entry) not in gone]


def modules_beside() -> dict[str, Path]:
    """Return the imported modules in the folders of rig and protocol files that were read: each by its path there."""
    folders = tuple(f"{folder}{os.sep}" for folder in _beside)
    found: dict[str, Path] = {}
    for name, module in sorted(sys.modules.items()):
        file = getattr(module, "__file__", None) or ""
        # By text first: there are thousands of modules.
        if not file.startswith(folders) or not file.endswith(".py") or name.partition(".")[0] in _OWN:
            continue
        path = Path(file)
        within = Path(*name.split("."), "__init__.py" if path.stem == "__init__" else "").with_suffix(".py")
        # A file that was loaded under another name, or lies deeper, is not beside; what is gone cannot be read.
        if any(path == folder / within for folder in _beside) and path.is_file():
            found[within.as_posix()] = path
    return found


def check_import(module: str) -> None:
    """Check that a file may have a module imported, as importing runs its code.

    It may, if the module is of the bench, of a package that registers a part, or in the folder of a rig or protocol
    file that was read; or if the program has imported it already.

    Raises ConfigurationError if it may not; says how to register it.
    """
    top = module.partition(".")[0]
    if not top or module in sys.modules or top in _OWN:
        return
    # Without a place there is nothing to import, and the import says so.
    places = _places(top)
    if not places or Path(places[0]).resolve().parent in _beside or top in _tops():
        return
    raise ConfigurationError(
        f"module {module} ({places[0]}) may not be imported, as it is neither of the bench, "
        "nor of a package that registers a part, nor beside the rig file; move it there, or register it in the "
        f"""pyproject.toml of its package: [project.entry-points."bench.devices"] NAME = "{module}:CLASS\""""
    )
