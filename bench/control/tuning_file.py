"""Tuning files: numbers of controllers that were found for a specimen, with where they come from.

A file is TOML: a table `[tuning.CONTROLLER]` for each controller, as a rig file has them in
`[protocols.NAME.tuning.CONTROLLER]`, and a table `[provenance]` with texts and numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator

from bench.base import ConfigurationError, parse_json, parse_toml, toml_value


def load_tuning(path: Path) -> dict[str, dict[str, Any]]:
    """Return the numbers of a tuning file, by controller.

    Raises ConfigurationError if it cannot be read, or is no tuning file.
    """
    try:
        content = parse_toml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigurationError(f"tuning file {path} cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ConfigurationError(f"tuning file {path} is damaged: not TOML: {error}") from None
    tables = content.get("tuning")
    if not isinstance(tables, dict) or not all(isinstance(table, dict) for table in tables.values()):
        raise ConfigurationError(f"{path} is not a tuning file: expected tables [tuning.CONTROLLER]")
    if unknown := content.keys() - {"tuning", "provenance"}:
        raise ConfigurationError(
            f"tuning file {path} has a key {min(unknown)!r}; expected tables [tuning.CONTROLLER] and [provenance]"
        )
    return tables


def _given(value: object) -> object:
    """Return the tables of a text: the name of a tuning file, or JSON."""
    if not isinstance(value, str):
        return value
    if value.lstrip().startswith("{"):
        try:
            return parse_json(value)
        except ValueError as error:
            raise ValueError(f"expected tables of numbers as JSON, or a tuning file: {error}") from None
    try:
        return load_tuning(Path(value))
    except ConfigurationError as error:
        raise ValueError(str(error)) from None


Tuning = Annotated[dict[str, dict[str, Any]], BeforeValidator(_given)]
"""Numbers of controllers: tables as in a rig file, the name of a tuning file, or JSON."""


def tuning_text(tuning: Mapping[str, Mapping[str, Any]], provenance: Mapping[str, str | float]) -> str:
    """Return the text of a tuning file."""
    lines = ["# Numbers of controllers, found by bench model tune; used by --set tuning=FILE.", ""]
    for controller, numbers in tuning.items():
        lines += [f"[tuning.{controller}]", *(f"{name} = {toml_value(value)}" for name, value in numbers.items()), ""]
    lines += ["[provenance]", *(f"{name} = {toml_value(value)}" for name, value in provenance.items())]
    return "\n".join(lines) + "\n"
