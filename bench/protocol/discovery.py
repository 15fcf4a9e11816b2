"""Discovery of protocols: by name in installed packages, and in files of one's own."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
import pkgutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from bench.base import ConfigurationError, closest, registry
from bench.protocol.parameters import ProtocolDefinition


@dataclass(frozen=True)
class Packaged:
    """The protocols of all installed packages.

    Attributes
    ----------
    protocols : dict of str to ProtocolDefinition
        By name, in alphabetical order.
    packages : dict of str to str
        Distribution that each comes from.
    problems : tuple of str
        What could not be imported, and was left out.
    """

    protocols: dict[str, ProtocolDefinition]
    packages: dict[str, str]
    problems: tuple[str, ...]


def packaged_protocols() -> Packaged:
    """Return the protocols of all installed packages.

    An entry of the group `bench.protocols` is a module, or a package whose modules are searched. Raises
    ConfigurationError if two protocols share a name.
    """
    found: dict[str, ProtocolDefinition] = {}
    packages: dict[str, str] = {}
    problems: list[str] = []
    for entry in registry.entries("protocols").values():
        try:
            modules = list(_modules(entry.load(), problems))
        except ConfigurationError as error:
            problems.append(str(error))
            continue
        for definition in (each for module in modules for each in _definitions(module)):
            if definition.name in found:
                raise ConfigurationError(
                    f"two protocols are named {definition.name}: one of package {packages[definition.name]}, "
                    f"one of {entry.package}"
                )
            found[definition.name] = definition
            packages[definition.name] = entry.package
    return Packaged(dict(sorted(found.items())), packages, tuple(problems))


def _modules(module: ModuleType, problems: list[str]) -> Iterator[ModuleType]:
    yield module
    for info in pkgutil.iter_modules(getattr(module, "__path__", ())):
        try:
            inner = importlib.import_module(f"{module.__name__}.{info.name}")
        # A module of the user's own may fail in any way.
        except Exception as error:
            problems.append(
                f"protocol module {module.__name__}.{info.name} cannot be loaded: {type(error).__name__}: {error}"
            )
            continue
        yield from _modules(inner, problems)


def find_protocol(name: str) -> ProtocolDefinition:
    """Return a protocol by its name, or from a file as `path/to/file.py` or `path/to/file.py:NAME`.

    Raises ConfigurationError if there is none, or the file cannot be loaded or holds several.
    """
    path, _, wanted = (name, "", "") if name.endswith(".py") else name.rpartition(":")
    if path.endswith(".py"):
        return _protocol_from_file(Path(path), wanted)
    packaged = packaged_protocols()
    if name not in packaged.protocols:
        if name == "shakedown":
            raise ConfigurationError("there is no protocol 'shakedown'; did you mean bench rig check RIG --exercise?")
        left_out = "".join(f"\n{problem}" for problem in packaged.problems)
        raise ConfigurationError(
            f"there is no protocol {name!r}; {closest(name, packaged.protocols, '`bench list`')} "
            f"(or a file of your own, path/to/file.py){left_out}"
        )
    return packaged.protocols[name]


def source_of(definition: ProtocolDefinition) -> Path | None:
    """Return the file in which a protocol is written; None if there is none, as in a notebook."""
    file = inspect.getsourcefile(definition.generator)
    return Path(file) if file and Path(file).is_file() else None


def digest_of(definition: ProtocolDefinition) -> str | None:
    """Return the SHA-256 of the file in which a protocol is written; None if there is none."""
    file = source_of(definition)
    return None if file is None else hashlib.sha256(file.read_bytes()).hexdigest()


def is_installed(definition: ProtocolDefinition) -> bool:
    """Return whether a protocol is of an installed package, so that its name is enough to find it."""
    module = definition.generator.__module__
    packages = (entry.reference.partition(":")[0] for entry in registry.entries("protocols").values())
    return any(module == package or module.startswith(f"{package}.") for package in packages)


def _protocol_from_file(path: Path, wanted: str) -> ProtocolDefinition:
    if not path.is_file():
        raise ConfigurationError(f"protocol file {path} does not exist")
    spec = importlib.util.spec_from_file_location(f"protocol_file_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ConfigurationError(f"protocol file {path} cannot be loaded as Python")
    registry.import_beside(path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    # A file of the operator's may fail in any way, and may even leave by sys.exit.
    except (Exception, SystemExit) as error:
        del sys.modules[spec.name]
        raise ConfigurationError(f"protocol file {path}: {type(error).__name__}: {error}") from error
    found = {definition.name: definition for definition in _definitions(module)}
    names = ", ".join(found) or "none"
    if wanted:
        if wanted not in found:
            raise ConfigurationError(f"protocol file {path} has no protocol {wanted!r}; it has: {names}")
        return found[wanted]
    if len(found) != 1:
        raise ConfigurationError(f"protocol file {path}: choose one by {path}:NAME; it has: {names}")
    return next(iter(found.values()))


def _definitions(module: ModuleType) -> list[ProtocolDefinition]:
    return [
        value
        for value in vars(module).values()
        if isinstance(value, ProtocolDefinition) and value.generator.__module__ == module.__name__
    ]
