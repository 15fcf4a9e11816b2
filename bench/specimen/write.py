"""Runs in, the rig file of a twin out."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from bench.base import ConfigurationError
from bench.rig import load_rig
from bench.specimen.identify import identify_twin
from bench.specimen.rig_text import rig_text
from bench.specimen.twin import IdentifiedTwin


def write_twin(runs: Sequence[Path], rig: str, out: Path, model: Path | None = None) -> IdentifiedTwin:
    """Make a twin of the specimen of some runs, and write its rig file.

    Parameters
    ----------
    runs : sequence of Path
        Folders of runs on the rig.
    rig : str
        Name of a packaged rig, or path of a rig file.
    out : Path
        Rig file of the twin; it must not exist.
    model : Path, optional
        File of the model.

    Raises
    ------
    ConfigurationError
        If the file exists, is none of the ending `.toml`, or cannot be written; or there is no such rig.
    DataError
        If a run or the model cannot be used; nothing is written.
    """
    if out.suffix != ".toml":
        raise ConfigurationError(f"--out {out}: expected a name that ends in .toml, as all rig files do")
    if out.exists():
        raise ConfigurationError(f"--out {out} exists already; a twin is never overwritten")
    # Identification takes its time: first what would make it vain.
    if not os.access(out.parent, os.W_OK):
        reason = "no permission" if out.parent.is_dir() else f"there is no folder {out.parent}"
        raise ConfigurationError(f"--out {out} cannot be written: {reason}")
    file = load_rig(rig)
    twin = identify_twin(runs, file, model)
    text = rig_text(twin, file, rig, out)
    try:
        with out.open("x", encoding="utf-8") as stream:
            stream.write(text)
    except OSError as error:
        raise ConfigurationError(f"--out {out} cannot be written: {error.strerror}") from None
    return twin
