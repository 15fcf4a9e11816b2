"""The files that a run was given, as its record keeps them, and as a repetition of the run reads them.

A record keeps, by name:

`PARAMETER`
    The file that this parameter of the protocol names, such as `model`.
`rig.toml`
    The rig file. What it extends is in `rig_content` of the metadata.
`faults.toml`, `faults.jsonl`
    The schedule of faults.
`protocol.py`
    The file of a protocol that is not of an installed package.
`modules/PATH`
    The modules beside the rig file and the protocol's file that were imported.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from bench.base import DataError, registry
from bench.protocol import ProtocolDefinition, ProtocolParameters, is_installed, source_of
from bench.rig import RigFile

RIG_FILE_NAME = "rig.toml"
"""Name of the rig file, in the record and in the folder of a run."""
PROTOCOL_NAME = "protocol.py"
_FAULTS = "faults"
_MODULES = "modules"


@dataclass(frozen=True)
class Original:
    """The run that another one repeats.

    Attributes
    ----------
    meta : mapping
        Metadata of its journal.
    files : mapping of str to bytes
        What its record keeps.
    folder : Path
        Where they were unpacked, for as long as the repetition goes on.
    rig : RigFile or None
        Its rig; None if the repetition is on a rig that was named.
    """

    meta: Mapping[str, Any]
    files: Mapping[str, bytes]
    folder: Path
    rig: RigFile | None

    def readable(self, definition: ProtocolDefinition, parameters: ProtocolParameters) -> ProtocolParameters:
        """Return the parameters with the unpacked files in the place of those that they name."""
        paths = definition.files(parameters)
        return parameters.model_copy(
            update={name: str(_place(self.folder, name, path)) for name, path in paths.items()}
        )

    @property
    def faults(self) -> Path | None:
        """The unpacked schedule of faults, if there was one."""
        return next((self.folder / name for name in self.files if PurePosixPath(name).stem == _FAULTS), None)


def given_files(
    definition: ProtocolDefinition, parameters: ProtocolParameters, rig: RigFile, faults: Path | None
) -> dict[str, bytes]:
    """Return the content of every file that a run is given, by its name in the record.

    Parameters
    ----------
    definition : ProtocolDefinition
        The protocol.
    parameters : ProtocolParameters
        Its parameters; those declared with `file=True` name files.
    rig : RigFile
        The rig, with its file's text.
    faults : Path or None
        The schedule of faults.

    Raises
    ------
    DataError
        If a file cannot be read.
    """
    paths = {name: Path(path) for name, path in definition.files(parameters).items()}
    if faults is not None:
        paths[_FAULTS + faults.suffix] = faults
    source = None if is_installed(definition) else source_of(definition)
    if source is not None:
        paths[PROTOCOL_NAME] = source
    for name, path in registry.modules_beside().items():
        if path != source:
            paths[f"{_MODULES}/{name}"] = path
    return {RIG_FILE_NAME: rig.text.encode()} | {name: _content(path) for name, path in paths.items()}


def file_name(path: str) -> str:
    """Return the end of a path, which may be one of another system."""
    return re.split(r"[\\/]", path)[-1]


def unpack(files: Mapping[str, bytes], parameters: Mapping[str, Any], folder: Path) -> None:
    """Write the files of a record into a folder, where the modules among them can then be imported.

    Parameters
    ----------
    files : mapping of str to bytes
        What the record keeps.
    parameters : mapping
        Those of the run; a file that one of them names keeps the end of its path.
    folder : Path
        Empty folder.

    Raises
    ------
    DataError
        If the name of a file leads out of the folder.
    """
    for name, content in files.items():
        path = _place(folder, name, str(parameters[name])) if name in parameters else folder / name
        if not path.resolve().is_relative_to(folder.resolve()):
            raise DataError(f"the record is damaged: it has a file {name!r}")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    registry.import_beside(folder / _MODULES / "any")


def _place(folder: Path, name: str, path: str) -> Path:
    # Two files of one name stay apart.
    return folder / name / (file_name(path) or name)


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path} cannot be kept with the run: {error.strerror}") from None
