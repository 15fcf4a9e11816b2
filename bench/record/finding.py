"""Finds journals, also those that are gone but for their second file, and says how to get at what is left of one."""

from __future__ import annotations

import os
from pathlib import Path

from bench.record.rows import FILE_NAME, RECOVERED_NAME
from bench.record.second_file import NAME as SECOND_NAME, second_files

_TRACES = {FILE_NAME, SECOND_NAME, RECOVERED_NAME}


def find_journals(folder: Path) -> list[Path]:
    """Return the journals of the runs below a folder, and where those were that have left a second file or a copy."""
    return sorted(Path(place) / FILE_NAME for place, _, files in os.walk(folder) if _TRACES.intersection(files))


def files_of(journal: Path) -> list[Path]:
    """Return the files that a journal that is written may have in its folder."""
    companions = [journal.with_name(journal.name + end) for end in ("", "-wal", "-shm", "-journal")]
    return [*companions, journal.with_name(SECOND_NAME)]


def missing(path: Path) -> str:
    """Return what to say of a run, given by its folder or journal, that has no journal."""
    folder = path if path.is_dir() else path.parent
    if path.is_dir() or path.name == FILE_NAME:
        if (copy := folder / RECOVERED_NAME).is_file():
            return (
                f"{path} has lost its {FILE_NAME}; {copy} is a recovered copy of it, to be read in its place, and "
                f"`bench resume {copy}` says how it is resumed"
            )
        if second_files(folder / FILE_NAME):
            return (
                f"{path} has lost its {FILE_NAME}, but a second file has its rows: "
                f"`bench runs repair {folder}` writes {RECOVERED_NAME} from them"
            )
    return f"{path} is not a run: there is no {FILE_NAME}"


def way_back(path: Path) -> str:
    """Return how an error about an unreadable file goes on: by what to do, if it is a journal by its name."""
    return f"; `bench runs repair {path}` says what is left of it" if path.suffix == ".sqlite" else ""


def cause_of(error: Exception) -> str:
    """Return what is wrong with a journal, and what can be done about a lock."""
    if "locked" not in str(error):
        return str(error)
    return (
        f"{error}: another program keeps it, or its folder is on a file system without locks, such as some network "
        "drives; end that program, or use a folder on a disk of this computer"
    )
