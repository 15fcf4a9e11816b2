"""What the record of a run says from its beginning: its folder, its metadata, and the state of the software."""

from __future__ import annotations

import getpass
import importlib.metadata
import platform
import shutil
import subprocess
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

from bench.binding import Slots
from bench.clock import wall_time
from bench.description import RigDescription
from bench.errors import ConfigurationError
from bench.past.changes import protocol_file, protocol_sources
from bench.protocol import Plan, ProtocolDefinition, ProtocolParameters

RIG_FILE_NAME = "rig.toml"
"""Name of the rig file in the folder of a run."""

_PACKAGES = ("actuator-bench", "numba", "numpy", "pymodbus", "pyserial", "rerun-sdk", "scipy")


def metadata(
    protocol: ProtocolDefinition,
    parameters: ProtocolParameters,
    description: RigDescription,
    slots: Slots,
    expected: Plan,
    epoch: datetime,
) -> dict[str, Any]:
    """Return what is known of a run before it starts, by the keys of `bench.journal`.

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
    return {
        "rig": file.name,
        "rig_title": file.rig.title,
        "rig_file": file.text,
        "rig_content": file.content,
        "protocol": protocol.name,
        "protocol_summary": protocol.summary,
        "protocol_file": protocol_file(protocol),
        "protocol_sources": protocol_sources(protocol),
        "parameters": parameters.model_dump(mode="json"),
        "controls": protocol.controlled(slots),
        "slots": {slot.name: {"device": slot.device, "signal": slot.signal} for slot in slots.values()},
        "plan": {"steps": expected.steps, "seconds": expected.seconds, "at_most": expected.at_most},
        "epoch": epoch.isoformat(),
        "devices": {name: str(device.identity) for name, device in description.devices.items()},
        "calibration": {
            **{entry.name: entry.settings.model_dump(mode="json") for entry in file.devices},
            **{name: derived.model_dump(mode="json") for name, derived in file.derived.items()},
        },
        "dashboard": file.dashboard.model_dump(mode="json") if file.dashboard else None,
        "operator": _operator(),
        "command": sys.argv,
        "packages": {package: _version(package) for package in _PACKAGES},
        "git": _git_state(),
        "host": {
            "name": platform.node(),
            "system": platform.platform(),
            "python": platform.python_version(),
            "started": wall_time().isoformat(),
        },
    }


def make_folder(parent: Path, name: str) -> Path:
    """Make the folder of a run: its name, then the time of day; a counter where two runs start in one second.

    Raises ConfigurationError if it cannot be made.
    """
    stamp = wall_time().strftime("%Y%m%d-%H%M%S")
    for suffix in ("", *(f"-{i}" for i in range(2, 1000))):
        folder = parent / f"{name}-{stamp}{suffix}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise ConfigurationError(f"the folder of the run cannot be made: {error}") from None
        return folder
    raise ConfigurationError(f"{parent} holds a thousand runs of this second already")


def _operator() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return "unknown"


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _git_state() -> str:
    git = shutil.which("git")
    if git is None:
        return "unknown"
    here = Path(__file__).parent

    def ask(*arguments: str) -> str | None:
        answer = subprocess.run([git, *arguments], cwd=here, capture_output=True, text=True, check=False)  # noqa: S603
        return answer.stdout.strip() if answer.returncode == 0 else None

    commit = ask("rev-parse", "--short=12", "HEAD")
    if commit is None:
        return "unknown"
    return commit + (" with changes" if ask("status", "--porcelain") else "")
