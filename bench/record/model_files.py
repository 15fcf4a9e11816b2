"""The models that were identified from a run, in files beside its journal."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from bench.base import DataError, json_text, parse_json, write_whole
from bench.record.rows import FILE_NAME

FOLDER = "models"

_KEPT = "kept"
"""Key that a model's file has beside those of a model file: `t`, laboratory time in s that its data reach to, and
`position` in the order in which models came."""


def add_model(path: Path, name: str, t: float, model: Mapping[str, Any]) -> None:
    """Keep a model with the run that it was identified from; one of the same name is replaced.

    It becomes the file `models/NAME.json` beside the journal, which is not touched; characters that no file name has
    on some system become %XX.

    Parameters
    ----------
    path : Path
        The journal, or the folder of the run.
    name : str
        Name of the model.
    t : float
        Laboratory time in s that its data reach to.
    model : mapping
        The model file's content.

    Raises
    ------
    DataError
        If there is no run, or the file cannot be written.
    """
    folder = path if path.is_dir() else path.parent
    if not (folder / FILE_NAME if path.is_dir() else path).is_file():
        raise DataError(f"{path} is not a run: there is no {FILE_NAME}")
    folder /= FOLDER
    position = 1 + max((position for position, _, _ in _kept(folder)), default=0)
    file = folder / f"{quote(name, safe=' ')}.json"
    content = {**model, _KEPT: {"t": t, "position": position}} if isinstance(model, dict) else model
    try:
        folder.mkdir(exist_ok=True)
        write_whole(file, json_text(content, indent=1) + "\n")
    except OSError as error:
        raise DataError(f"model file {file} cannot be written: {error.strerror}") from None


def models_beside(folder: Path) -> dict[str, Any]:
    """Return the content of the model files in a run's folder, by name, the newest last.

    Raises DataError if one is damaged.
    """
    found = sorted(_kept(folder / FOLDER), key=lambda entry: entry[0])
    return {name: content for _, name, content in found}


def _kept(folder: Path) -> list[tuple[int, str, Any]]:
    """Return position, name and content of each model file."""
    result = []
    for file in sorted(folder.glob("*.json")):
        try:
            content = parse_json(file.read_text(encoding="utf-8"))
            # What was put there by hand comes first.
            kept = content.pop(_KEPT, {}) if isinstance(content, dict) else {}
            result.append((int(kept.get("position", 0)), unquote(file.stem), content))
        except (OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
            raise DataError(f"model file {file} is damaged: {error}") from None
    return result
