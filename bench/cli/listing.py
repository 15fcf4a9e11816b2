"""What `bench list` shows, remembered until a file of a package that registers a part changes.

To say it again, every rig, protocol, model and driver is imported: half a second of CPU.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from bench.base import json_text, parse_json, registry, write_whole


def listing() -> dict[str, Any]:
    """Return the installed catalogue, as `bench.cli.catalogue.installed`.

    It is remembered in the user's folder for caches, unless something could not be loaded.
    """
    state = _state()
    # Another environment has another listing, which shall not take the place of this one's.
    file = _folder() / f"catalogue-{hashlib.sha256(sys.prefix.encode()).hexdigest()[:12]}.json"
    with suppress(OSError, ValueError):
        remembered = parse_json(file.read_text(encoding="utf-8"))
        if isinstance(remembered, dict) and remembered.get("state") == state:
            found: dict[str, Any] = remembered["catalogue"]
            return found
    from bench.cli import catalogue

    found = catalogue.installed()
    if not found["problems"]:
        # Where nothing can be remembered, it is said again each time.
        with suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            write_whole(file, json_text({"state": state, "catalogue": found}))
    return found


def _folder() -> Path:
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path("~/AppData/Local").expanduser()
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    return Path(base) / "actuator-bench"


def _state() -> str:
    """Return a digest of what is registered, the installed packages, and the files that are imported for it."""
    digest = hashlib.sha256()
    for text in (sys.version, *_places(), *_files()):
        digest.update(text.encode("utf-8", "surrogateescape") + b"\0")
    return digest.hexdigest()


def _places() -> Iterator[str]:
    """Yield the folders that packages are imported from; installing and removing one changes their times."""
    for folder in sys.path:
        with suppress(OSError):
            yield f"{folder} {Path(folder).stat().st_mtime_ns}"


def _files() -> Iterator[str]:
    """Yield the entries, and the files of the packages that they name."""
    for group in registry.GROUPS:
        for entry in registry.entries(group).values():
            yield f"{group} {entry.name} {entry.package} {entry.reference}"
    for path in registry.files_of_parts((".py", ".toml")).values():
        with suppress(OSError):
            found = path.stat()
            yield f"{path} {found.st_mtime_ns} {found.st_size}"
