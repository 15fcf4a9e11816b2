"""A campaign file: which protocols run on which rigs, with which parameters, seeds and faults.

`docs/reference/campaign.md` has an example of each table. Paths are relative to the file. Unknown keys are errors.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from bench.analysis import Session
from bench.base import CheckedTable, ConfigurationError, parse_toml, problems, reason

_NAME = r"[A-Za-z0-9][A-Za-z0-9_.-]{0,60}"
_RANGE = re.compile(r"(\d+)\.\.(\d+)")
_MOST_SEEDS = 100_000
REFERENCE = "@"
"""Before the name of a table of models, in the place of the path of a model file."""


def _listed(value: object) -> object:
    """Return a single value as a list of one."""
    return [value] if isinstance(value, str) else value


def _seeds(value: object) -> object:
    """Return the seeds of a range such as `0..9`, both ends included; a single seed as a list of one."""
    if isinstance(value, int) and not isinstance(value, bool):
        return [value]
    if not isinstance(value, str):
        return value
    found = _RANGE.fullmatch(value.strip())
    if found is None or not 0 <= int(found[2]) - int(found[1]) < _MOST_SEEDS:
        raise ValueError(f"expected a list such as [0, 1, 5], or a range such as '0..9' of at most {_MOST_SEEDS}")
    return list(range(int(found[1]), int(found[2]) + 1))


def _each_once(values: tuple[Any, ...]) -> tuple[Any, ...]:
    if not values:
        raise ValueError("expected at least one")
    for i, value in enumerate(values):
        if value in values[:i]:
            raise ValueError(f"{value!r} is there twice")
    return values


Names = Annotated[tuple[str, ...], BeforeValidator(_listed), AfterValidator(_each_once)]
Seeds = Annotated[
    tuple[Annotated[int, Field(ge=0, le=2**31 - 1)], ...],
    BeforeValidator(_seeds),
    AfterValidator(_each_once),
    Field(description="seeds of the laboratory: a list, or a range such as '0..9'"),
]


class RunsTable(CheckedTable):
    """A table `[[runs]]`: a grid of runs."""

    name: str = Field(default="", pattern=f"^({_NAME})?$", description="its name; the protocol's if not given")
    protocol: Names = Field(description="protocol, path/to/file.py[:NAME], or a list of these")
    rigs: Names = Field(description="emulated rig, path/to/rig.toml, or a list of these")
    seeds: Seeds = (0,)
    seed_offset: int = Field(
        default=0,
        ge=0,
        le=2**31 - 1,
        description="added to each seed, so that two tables with the same seeds do not have the same noise",
    )
    parameters: dict[str, Any] = Field(
        default_factory=dict,
        description="parameters of the protocol; a list is an axis of the grid, a list in a list is a value",
    )
    overrides: dict[str, Any] = Field(
        default_factory=dict,
        description="values of the rig file by dotted key; a list is an axis of the grid, a table in it one value",
    )
    faults: Names = Field(default=("",), description="files of faults, an axis of the grid; '' is none")
    interlock_rate: float | None = Field(
        default=None, ge=0.01, le=50, description="looks at the interlocks in a laboratory second, Hz"
    )

    @model_validator(mode="after")
    def _has_name(self) -> Self:
        if not self.name and (len(self.protocol) > 1 or ".py" in self.protocol[0]):
            raise ValueError("name is missing; a table with several protocols, or one from a file, needs one")
        return self if self.name else self.model_copy(update={"name": self.protocol[0]})


class ModelsTable(CheckedTable):
    """A table `[[models]]`: a model that is identified from each run of a table; other keys are its options.

    One that takes several runs is identified from those of a rig and seed together.
    """

    model_config = ConfigDict(extra="allow")

    name: str = Field(pattern=f"^{_NAME}$", description="its name, which runs refer to as '@NAME'")
    runs: Names = Field(description="name of an earlier table [[runs]], or a list of these")
    model: str = Field(min_length=1, description="model, as `bench list` names it")
    input: str = Field(default="", description="input column; the signal of the slot `drive` if not given")
    output: str = Field(default="", description="output column; the signal of the slot `response` if not given")
    seed: int | None = Field(
        default=None,
        ge=0,
        description="seed of its run; that of the run that uses the model if not given",
    )

    @property
    def options(self) -> dict[str, Any]:
        """The options of the identification, by name."""
        return dict(self.model_extra or {})


class ComparisonsTable(CheckedTable):
    """A table `[[comparisons]]`: the errors of models on each run of a table."""

    name: str = Field(pattern=f"^{_NAME}$", description="its name, before those of the models in the results")
    runs: str = Field(min_length=1, description="name of a table [[runs]]")
    models: Names = Field(description="names of tables [[models]]; of each the model of the run's rig and seed")
    recalibrate: str = Field(
        default="", description="what is estimated of each session first: some of offset, gain, drift, input-offset"
    )
    recalibrate_rows: int | None = Field(default=None, ge=1, description="first rows for that; all if not given")

    @model_validator(mode="after")
    def _can_be_read(self) -> Self:
        Session.parse(self.recalibrate or None, self.recalibrate_rows)
        return self


class StudiesTable(CheckedTable):
    """A table `[[studies]]`: a study with several seeds."""

    name: str = Field(min_length=1, description="study, as `bench list` names it")
    rigs: Names = Field(default=("",), description="rigs, an axis of the grid; '' is that of the study")
    seeds: Seeds = (0,)


class CampaignTables(CheckedTable):
    """The tables of a campaign file, in their order."""

    most_runs: int = Field(default=10_000, ge=1, le=1_000_000, description="most runs that the file may ask for")
    runs: tuple[RunsTable, ...] = ()
    models: tuple[ModelsTable, ...] = ()
    comparisons: tuple[ComparisonsTable, ...] = ()
    studies: tuple[StudiesTable, ...] = ()


@dataclass(frozen=True)
class CampaignFile:
    """A campaign file that was read; names in it were not looked up yet."""

    path: Path  # where it was read from
    tables: CampaignTables

    def each(self, kind: str) -> Iterator[tuple[str, Any]]:
        """Yield the tables of a kind with their places for messages, such as `night.toml: runs.0 (characterize)`."""
        for number, table in enumerate(getattr(self.tables, kind)):
            yield f"{self.path}: {kind}.{number} ({table.name})", table

    def beside(self, name: str) -> str:
        """Return a path of the file, which is relative to its folder; anything else as it is."""
        return str(self.path.parent / name) if name else name


def read_campaign(path: Path) -> CampaignFile:
    """Read a campaign file.

    Raises ConfigurationError if it cannot be read, or a table is wrong; names file, table, key and what is allowed.
    """
    try:
        content = parse_toml(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"campaign file {path} cannot be read: {reason(error)}") from None
    except ValueError as error:
        raise ConfigurationError(f"{path}: not valid TOML: {error}") from None
    try:
        tables = CampaignTables.model_validate(content)
    except ValidationError as error:
        raise ConfigurationError("\n".join(f"{path}: {line}" for line in problems(error, CampaignTables))) from None
    file = CampaignFile(path, tables)
    if not tables.runs and not tables.studies:
        raise ConfigurationError(f"{path}: asks for nothing; expected tables [[runs]] or [[studies]]")
    for kind in ("runs", "models", "comparisons", "studies"):
        names = set[str]()
        for where, table in file.each(kind):
            if table.name in names:
                raise ConfigurationError(
                    f"{where}: name = {table.name!r}: an earlier table has this name; give it another"
                )
            names.add(table.name)
    return file


def axes(table: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Return the values of each key of a grid: those of a list, or the single one."""
    return {key: value if isinstance(value, list) else [value] for key, value in table.items()}


def dotted(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the values of a table and of those within it by dotted key."""
    found: dict[str, Any] = {}
    for key, value in table.items():
        found |= dotted(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {prefix + key: value}
    return found
