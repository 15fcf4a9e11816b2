"""What a run was started with, and whether it is still the same."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from bench.errors import ConfigurationError
from bench.protocol.discovery import find_protocol, packaged_protocols
from bench.protocol.parameters import ProtocolDefinition

_COMPARED = ("protocol_sources", "slots", "rig_content", "devices", "packages", "git")
_MOST_NAMED = 8
"""Changes that a message names."""


def protocol_sources(definition: ProtocolDefinition) -> dict[str, str]:
    """Return the SHA-256 of the module of a protocol, and of those that it uses of its own package or folder.

    By the name of the module; by that of the file for one of one's own, which has another module's name each time.
    """
    first = sys.modules[definition.generator.__module__]
    found: dict[str, str] = {}
    waiting = [first]
    while waiting:
        module = waiting.pop()
        file = getattr(module, "__file__", None)
        name = module.__name__ if "." in module.__name__ or file is None else Path(file).name
        if name not in found:
            found[name] = hashlib.sha256(Path(file).read_bytes()).hexdigest() if file else ""
            waiting += [used for used in _used(module) if _belongs(used, first)]
    return dict(sorted(found.items()))


def protocol_file(definition: ProtocolDefinition) -> str:
    """Return the file in which a protocol stands; empty if it stands in none, as in a notebook."""
    return getattr(sys.modules[definition.generator.__module__], "__file__", None) or ""


def find_recorded(name: str, file: str) -> ProtocolDefinition:
    """Return the protocol of a record: the installed one, or that of its file.

    Raises ConfigurationError if it is not there any more.
    """
    packaged = packaged_protocols().protocols.get(name)
    if packaged is not None and (not file or protocol_file(packaged) == file):
        return packaged
    return find_protocol(f"{file}:{name}" if file else name)


def check_unchanged(then: Mapping[str, Any], now: Mapping[str, Any], accepted: bool) -> tuple[str, ...]:
    """Compare what a run was started with and what it would go on with; return what has changed.

    Parameters
    ----------
    then, now : mapping
        Metadata of a run.
    accepted : bool
        Whether changes are accepted.

    Raises
    ------
    ConfigurationError
        If something has changed and that is not accepted; names it.
    """
    found: list[str] = []
    for key in _COMPARED:
        if key in then:
            found += _differences(key, then[key], now.get(key))
    if found and not accepted:
        more = f", and {len(found) - _MOST_NAMED} more" if len(found) > _MOST_NAMED else ""
        raise ConfigurationError(
            f"the run was started with another {'; '.join(found[:_MOST_NAMED])}{more}. Restore that, or go on all "
            "the same with --accept-changes"
        )
    return tuple(found)


def _differences(key: str, then: Any, now: Any) -> Iterator[str]:  # noqa: ANN401 - what JSON holds
    if isinstance(then, Mapping) and isinstance(now, Mapping):
        for name in dict.fromkeys([*then, *now]):
            yield from _differences(f"{key}.{name}", then.get(name), now.get(name))
    elif then != now:
        is_source = key.startswith("protocol_sources.")
        yield key if is_source else f"{key} ({then}, now {now})"


def _used(module: ModuleType) -> Iterator[ModuleType]:
    for value in vars(module).values():
        name = value.__name__ if isinstance(value, ModuleType) else getattr(value, "__module__", None)
        if isinstance(name, str) and name in sys.modules:
            yield sys.modules[name]


def _belongs(module: ModuleType, first: ModuleType) -> bool:
    """Return whether a module is of the same package, or of the same folder where there is none."""
    top = first.__name__.partition(".")[0]
    if "." in first.__name__:
        return module.__name__.partition(".")[0] == top
    here, there = getattr(first, "__file__", None), getattr(module, "__file__", None)
    return here is not None and there is not None and Path(here).parent == Path(there).parent
