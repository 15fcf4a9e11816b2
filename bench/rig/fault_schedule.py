"""A schedule of faults for an emulated laboratory, from a file.

TOML, with a table a fault::

    [[fault]]
    at = 30.0                       # s of laboratory time from the start of the run
    fault = "heater.delay"          # as `bench rig emulate` and its control socket name it
    values = { seconds = 0.4 }      # what is chosen of it; the others have their defaults
    duration = 5.0                  # s; without it, for ever or once

    [[fault]]
    rate = 6.0                      # an hour, at random instants
    seed = 1
    until = 3600.0                  # s from the start of the run
    fault = "meter.drop"

or JSON lines (`.jsonl`), with the same keys in an object a line.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol, Self, runtime_checkable

from pydantic import Field, ValidationError, model_validator

from bench.base import CheckedTable, ConfigurationError, parse_json, parse_toml, problems

_LONGEST = 1e9
_HIGHEST_RATE = 36_000.0


class ScheduledFault(CheckedTable):
    """A fault at an instant, or again and again at random instants."""

    fault: str = Field(min_length=1, description="name of a fault of the laboratory")
    at: float | None = Field(default=None, ge=0, le=_LONGEST, description="laboratory time from the start, s")
    rate: float | None = Field(default=None, gt=0, le=_HIGHEST_RATE, description="how often, on average, 1/h")
    seed: int | None = Field(default=None, ge=0, description="seed of the instants; the laboratory's if not given")
    until: float | None = Field(default=None, gt=0, le=_LONGEST, description="end of a rate, s from the start")
    values: dict[str, float] = Field(default_factory=dict, description="what is chosen of the fault, by name")
    duration: float | None = Field(default=None, gt=0, le=_LONGEST, description="time after which it ends, s")

    @model_validator(mode="after")
    def _has_an_instant(self) -> Self:
        if (self.at is None) == (self.rate is None):
            raise ValueError("needs at (s) or rate (1/h), and not both")
        if self.rate is None and (self.seed is not None or self.until is not None):
            raise ValueError("seed and until belong to a rate")
        return self


@runtime_checkable
class FaultyLaboratory(Protocol):
    """A laboratory in which faults can be scheduled."""

    def schedule(self, faults: Sequence[ScheduledFault]) -> None:
        """Let faults happen, their instants counted from now.

        Raises ConfigurationError if the laboratory has no such fault, or it does not take its values; none is
        scheduled then.
        """


def read_schedule(path: Path) -> tuple[ScheduledFault, ...]:
    """Read a schedule of faults.

    Raises ConfigurationError if the file cannot be read, or something in it is wrong; names file and entry.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path} is not a text in UTF-8: {error}") from None
    found = []
    for number, entry in enumerate(_entries(path, text), 1):
        try:
            found.append(ScheduledFault.model_validate(entry))
        except ValidationError as error:
            raise ConfigurationError(f"{path}: fault {number}: {next(problems(error, ScheduledFault))}") from None
    if not found:
        raise ConfigurationError(f"{path} has no faults; expected tables [[fault]], or lines of JSON")
    return tuple(found)


def schedule_faults(laboratory: object, faults: Sequence[ScheduledFault], path: Path) -> None:
    """Hand a schedule to the laboratory of a run; its instants count from now.

    Raises ConfigurationError if there is no emulated laboratory, or it cannot carry the schedule out.
    """
    if not isinstance(laboratory, FaultyLaboratory):
        raise ConfigurationError(f"--faults {path}: the rig has no emulated laboratory with faults")
    try:
        laboratory.schedule(faults)
    except ConfigurationError as error:
        raise ConfigurationError(f"{path}: {error}") from None


def _entries(path: Path, text: str) -> list[Any]:
    try:
        if path.suffix == ".jsonl":
            return [parse_json(line) for line in text.splitlines() if line.strip()]
        content = parse_toml(text)
    except ValueError as error:
        form = "JSON lines" if path.suffix == ".jsonl" else "TOML"
        raise ConfigurationError(f"{path} is not {form}: {error}") from None
    unknown = [key for key in content if key != "fault"]
    if unknown or not isinstance(content.get("fault", []), list):
        raise ConfigurationError(f"{path}: {(unknown or ['fault'])[0]}: expected tables [[fault]] only")
    return list(content.get("fault", []))
