"""Models that are identified from several runs together, such as those of several inputs.

A package registers how by an entry of the group `bench.identifications`, under the name of the model: a
`WholeIdentification`. `bench campaign` uses it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from bench.base import registry
from bench.identification import ModelFile


@dataclass(frozen=True)
class WholeIdentification:
    """An entry of the group `bench.identifications`: how a model is identified from several runs.

    Attributes
    ----------
    protocols : tuple of str
        Protocols of the runs that it needs, one run of each.
    identify : callable
        Takes the folder of the run by the protocol; returns the model file. Raises DataError if they do not determine
        the model.
    """

    protocols: tuple[str, ...]
    identify: Callable[[Mapping[str, Path]], ModelFile]


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
