"""What the record of a run says from its beginning: its folder, its metadata, and the state of the software."""

from __future__ import annotations

import getpass
import hashlib
import importlib.metadata
import json
import platform
import re
import shutil
import subprocess
import sys
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any, Self

from bench.base import ConfigurationError, redacted_command, registry, wall_time
from bench.protocol import Plan, ProtocolDefinition, ProtocolParameters, digest_of, is_installed
from bench.record.finding import files_of
from bench.record.kept_files import RIG_FILE_NAME, file_name
from bench.record.rows import FILE_NAME
from bench.rig import RigDescription, Slots

_PACKAGES = (
    "actuator-bench",
    "llvmlite",
    "numba",
    "numpy",
    "pydantic",
    "pymodbus",
    "pyserial",
    "rerun-sdk",
    "scipy",
)
_LONGEST_NAME = 96
_LONGEST_PART = 32
_MORE = "-more"
_COMPARED = (
    "protocol",
    "protocol_source.sha256",
    "parameters",
    "rig",
    "rig_content",
    "seed",
    "clock",
    "interlock_rate",
    "devices",
    "packages",
    "git",
    "host.python",
    "host.system",
)
"""What tells one run from another; the other keys follow from these, or differ always."""


@dataclass(frozen=True)
class Difference:
    """Something that two records say differently: a dotted key of the metadata, and both values; None for none.

    An entry of a list stands in the key by its name, as an interlock by its signal, or by its number from 0.
    """

    key: str
    first: Any
    second: Any

    def __str__(self) -> str:
        """Return key and values on one line."""
        first, second = ("none" if value is None else value for value in (self.first, self.second))
        return f"{self.key}: {first} → {second}"


def metadata(
    protocol: ProtocolDefinition,
    parameters: ProtocolParameters,
    description: RigDescription,
    slots: Slots,
    expected: Plan,
    epoch: datetime,
) -> dict[str, Any]:
    """Return what is known of a run before it starts, by the keys of `bench.record`.

    Parameters
    ----------
    protocol : ProtocolDefinition
        What is carried out.
    parameters : ProtocolParameters
        Of it.
    description : RigDescription
        The connected rig.
    slots : Slots
        The protocol's, bound.
    expected : Plan
        What the protocol will do.
    epoch : datetime
        Time of day at laboratory time 0.
    """
    file = description.file
    layout = protocol.views.layout(slots, file.dashboard) if protocol.views else file.dashboard
    return {
        "rig": file.name,
        "rig_title": file.rig.title,
        "rig_file": file.text,
        "rig_content": file.content,
        "protocol": protocol.name,
        "protocol_summary": protocol.summary,
        "protocol_source": {
            "module": protocol.generator.__module__,
            "installed": is_installed(protocol),
            "sha256": digest_of(protocol),
        },
        "parameters": parameters.model_dump(mode="json"),
        "without_slot": protocol.without_slot(slots),
        "units": protocol.units(file.roles),
        "changed": protocol.changed(parameters, file.roles, file.protocols.get(protocol.name, {})),
        "controls": protocol.controlled(slots),
        "slots": {slot.name: {"device": slot.device, "signal": slot.signal} for slot in slots.values()},
        "plan": {
            "steps": expected.steps,
            "seconds": expected.seconds,
            "at_most": expected.at_most if expected.complete else None,
            "complete": expected.complete,
        },
        "epoch": epoch.isoformat(),
        "devices": {name: str(device.identity) for name, device in description.devices.items()},
        "extents": {each.name: each.extent for each in description.signals if each.extent is not None},
        "limits": {name: (limits.low, limits.high) for name, limits in description.limits.items()},
        "calibration": {
            **{entry.name: entry.settings.model_dump(mode="json") for entry in file.devices},
            **{name: derived.model_dump(mode="json") for name, derived in file.derived.items()},
        },
        "dashboard": layout.model_dump(mode="json") if layout else None,
        "over_time": protocol.views.signals_over_time(slots) if protocol.views else [],
        "operator": current_user(),
        "command": redacted_command(sys.argv),
        "packages": _versions(),
        "git": _git_state(),
        "host": {
            "name": platform.node(),
            "system": platform.platform(),
            "python": platform.python_version(),
            "started": wall_time().isoformat(),
        },
    }


def run_name(protocol: ProtocolDefinition, meta: Mapping[str, Any]) -> str:
    """Return the name of a run without its time: rig, protocol, and what was set differently from the defaults.

    At most 96 letters, digits and `.+_-`, which every file system takes; what is left out counts as `more`. `meta` is
    what `metadata` returns, with the `overrides`.
    """
    files = protocol.file_parameters
    name = "-".join(_in_a_name(each) or "x" for each in (meta["rig"], protocol.name))
    name = name[: _LONGEST_NAME - len(_MORE)].rstrip("-.")
    parts = [f"{key}-{_short(value)}" for key, value in meta["changed"].items() if key not in files]
    # Last what the runs of a series often share: files by the end of their path, and values of the rig file.
    for key in filter(meta["changed"].__contains__, files):
        parts.append(f"{key}-{Path(file_name(meta['changed'][key])).stem}")
    parts += [f"{key.rpartition('.')[2]}-{value}" for key, value in meta["overrides"].items()]
    for part in parts:
        part = _in_a_name(part)[:_LONGEST_PART].rstrip("-.")
        if len(name) + 1 + len(part) + len(_MORE) > _LONGEST_NAME:
            return f"{name}{_MORE}"
        name += f"-{part}"
    return name


def differences(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[Difference]:
    """Return what the metadata of two runs say differently of protocol, rig, instruments and software.

    Of a list only the entries that are not the same; the order of entries with a name does not count.
    """
    ours, theirs = (dict(_leaves("", {key: _at(meta, key) for key in _COMPARED})) for meta in (first, second))
    return [
        Difference(key, ours.get(key), theirs.get(key))
        for key in {**ours, **theirs}
        if ours.get(key) != theirs.get(key)
    ]


class NewFolder:
    """The folder of a run that is about to start; a context manager that removes it again unless the run does start.

    It stays if it holds anything but what a start puts there.

    Parameters
    ----------
    files : sequence of str
        Names of what a start puts there beside journal and rig file.
    empty_files : sequence of str
        Names of files that it puts there empty; with a content they are something else.
    """

    def __init__(self, files: Sequence[str] = (), empty_files: Sequence[str] = ()) -> None:
        self._files = RIG_FILE_NAME, *files
        self._empty_files = empty_files
        self._made: list[Path] = []
        """The folder, and those above it that were made for it, the innermost first."""

    def make(self, parent: Path, name: str) -> Path:
        """Make the folder: its name, then the time of day; a counter where two runs start in one second.

        Raises ConfigurationError if it cannot be made.
        """
        stamp = wall_time().strftime("%Y%m%d-%H%M%S")
        self._made = [each for each in (parent, *parent.parents) if not each.exists()]
        for suffix in ("", *(f"-{i}" for i in range(2, 1000))):
            folder = parent / f"{name}-{stamp}{suffix}"
            try:
                folder.mkdir(parents=True)
            except FileExistsError:
                continue
            except OSError as error:
                raise ConfigurationError(f"the folder of the run cannot be made: {error}") from None
            self._made.insert(0, folder)
            return folder
        raise ConfigurationError(f"{parent} holds a thousand runs of this second already")

    def keep(self) -> None:
        """Keep the folder: the run starts."""
        self._made = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        # Another run may have its folder beside this one by now.
        with suppress(OSError):
            if self._made and self._made[0].is_dir():
                self._remove_files(self._made[0])
            for folder in self._made:
                folder.rmdir()

    def _remove_files(self, folder: Path) -> None:
        ours = {folder / name for name in self._files} | {*files_of(folder / FILE_NAME)}
        ours |= {path for name in self._empty_files if (path := folder / name).is_file() and not path.stat().st_size}
        if (found := {*folder.iterdir()}) <= ours:
            for path in found:
                path.unlink()


def current_user() -> str:
    """Return the name of the user of this process, or `unknown`."""
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return "unknown"


def _in_a_name(text: str) -> str:
    """Return a text as every file system takes it as a name: letters, digits and `.+_-`."""
    # Letters without their marks.
    plain = "".join(each for each in unicodedata.normalize("NFKD", text) if not unicodedata.combining(each))
    return re.sub(r"[^A-Za-z0-9.+_-]+", "-", plain).strip("-.")


def _short(value: Any) -> str:  # noqa: ANN401 - anything that JSON can hold
    if isinstance(value, dict):
        return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:6]
    if isinstance(value, list):
        return "+".join(map(_short, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def _at(meta: Mapping[str, Any], key: str) -> Any:  # noqa: ANN401 - anything that JSON can hold
    found: Any = meta
    for part in key.split("."):
        found = found.get(part) if isinstance(found, dict) else None
    return found


def _leaves(key: str, value: Any) -> Iterator[tuple[str, Any]]:  # noqa: ANN401 - anything that JSON can hold
    if isinstance(value, Sequence) and not isinstance(value, str):
        value = _by_name(value)
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _leaves(f"{key}.{name}" if key else name, inner)
    else:
        yield key, value


def _by_name(entries: Sequence[Any]) -> dict[str, Any]:
    """Return the entries of a list by their names; several of one name are numbered, those without one from 0."""
    found: dict[str, Any] = {}
    for number, entry in enumerate(entries):
        name = _name_of(entry) if isinstance(entry, Mapping) else ""
        others = sum(other == name or other.startswith(f"{name} #") for other in found) if name else 0
        found[f"{name} #{others + 1}" if others else name or str(number)] = entry
    return found


def _name_of(entry: Mapping[str, Any]) -> str:
    """Return the name of an entry of a list; of an interlock what it watches. Empty if it has none."""
    if isinstance(entry.get("signal"), str):
        return f"{entry['signal']} - {entry['minus']}" if entry.get("minus") else entry["signal"]
    name = entry.get("name")
    return name if isinstance(name, str) else ""


def _versions() -> Mapping[str, str]:
    """Return the versions of the packages that compute, talk to instruments, or register parts."""
    packages = set(_PACKAGES)
    for group in registry.GROUPS:
        # Two packages with one name are refused where the name is asked for.
        with suppress(ConfigurationError):
            packages |= {entry.package for entry in registry.entries(group).values()}
    return {package: version_of(package) for package in sorted(packages)}


@cache
def version_of(package: str) -> str:
    """Return the version of a distribution, or `not installed`."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


@cache
def _git_state() -> str:
    git = shutil.which("git")
    if git is None:
        return "unknown"
    here = Path(__file__).parent

    def ask(*arguments: str) -> str | None:
        # Without locks, which would stay in the repository if this process is killed now.
        words = [git, "--no-optional-locks", *arguments]
        answer = subprocess.run(words, cwd=here, capture_output=True, text=True, check=False)  # noqa: S603
        return answer.stdout.strip() if answer.returncode == 0 else None

    commit = ask("rev-parse", "--short=12", "HEAD")
    if commit is None:
        return "unknown"
    return commit + (" with changes" if ask("status", "--porcelain") else "")
