"""Models that are identified from several runs together, such as those of several inputs.

A package registers how by an entry of the group `bench.identifications`, under the name of the model: a
`WholeIdentification`. `bench identify` and campaigns use it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench.base import ConfigurationError, DataError, registry
from bench.identification import ModelFile
from bench.record import Record


@dataclass(frozen=True)
class WholeModel:
    """A model that was identified from several runs.

    Attributes
    ----------
    file : ModelFile
        The model file.
    title : str
        What it is and from what.
    rows : tuple of (str, str)
        The evidence for it, for people.
    summary : dict of str to Any
        The same for programs.
    """

    file: ModelFile
    title: str
    rows: tuple[tuple[str, str], ...]
    summary: dict[str, Any]


@dataclass(frozen=True)
class WholeIdentification:
    """An entry of the group `bench.identifications`: how a model is identified from several runs.

    Attributes
    ----------
    protocols : tuple of str
        Protocols of the runs that a campaign gives it, one run of each.
    identify : callable
        Takes the folders of runs by protocol, a run to test the model on or None, and options by name; returns a
        `WholeModel`. Raises DataError if the runs do not determine the model, ConfigurationError for an option.
    options : mapping of str to str
        What each option means.
    takes_test : bool
        Whether it takes a run to test the model on.
    """

    protocols: tuple[str, ...]
    identify: Callable[[Mapping[str, Sequence[Path]], Path | None, Mapping[str, Any]], WholeModel]
    options: Mapping[str, str] = field(default_factory=dict)
    takes_test: bool = False

    def of_runs(self, runs: Sequence[Path], test: Path | None, options: Mapping[str, Any]) -> WholeModel:
        """Return the model of runs in any order.

        Raises ConfigurationError for an option or a test that it does not take, else as `identify`.
        """
        for name in options:
            if name not in self.options:
                raise ConfigurationError(
                    f"-o {name}: the model has no such option; it has: {', '.join(self.options) or 'none'}"
                )
        if test is not None and not self.takes_test:
            raise ConfigurationError("--test: this model is not tested on another run")
        by_protocol: dict[str, list[Path]] = {}
        for run in runs:
            with Record(run) as record:
                by_protocol.setdefault(str(record.meta.get("protocol", "")), []).append(run)
        return self.identify(by_protocol, test, options)


def only_run(runs: Mapping[str, Sequence[Path]], protocol: str, model: str) -> Path:
    """Return the one run of a protocol; raises DataError if there is none, or several."""
    found = runs.get(protocol, ())
    if len(found) != 1:
        given = ", ".join(f"{len(folders)} of {name}" for name, folders in runs.items())
        raise DataError(f"model {model} needs one run of {protocol}; given are: {given}")
    return found[0]


def whole_identification(model: str) -> WholeIdentification | None:
    """Return how a model is identified from several runs; None if it is not registered as such.

    Raises ConfigurationError if its entry cannot be imported.
    """
    if model not in registry.entries("identifications"):
        return None
    found: WholeIdentification = registry.load("identifications", model)
    return found


def whole_models() -> tuple[str, ...]:
    """Return the names of the models that are identified from several runs."""
    return tuple(registry.entries("identifications"))
