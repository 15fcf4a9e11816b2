"""Model files: an identified model as versioned JSON, with its units and where it comes from.

The file of an operator, version 1, is an object with these keys:

`format`, `version`
    `bench-model` and 1.
`name`
    Under which name it was identified, such as `preisach-nonmonotonic`.
`operator`
    The operator: its `type`, levels, densities or coefficients, ranges and units, as the operator itself
    writes them.
`memory`
    The operator's state at the end of the data that it was identified from: the memory curve of a Preisach
    operator, the list of play states of a Prandtl-Ishlinskii one; null for one without memory.
`provenance`
    `source`, `input`, `output`, `rows`, `skipped`, errors and certificate of the fit, `bench` (version).

The file of a model among voltage, force and length has the format `bench-coupled-model`, that of the whole of a
thermo-piezoelectric actuator `bench-hybrid-model`; both have `model` in place of `operator` and `memory`.
"""

from __future__ import annotations

import importlib.metadata
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench.errors import DataError
from bench.hysteresis import (
    Linear,
    MemoryCurve,
    Operator,
    PrandtlIshlinskii,
    Summed,
    TwoStage,
    coupled_from_json,
    operator_from_json,
)
from bench.identification.hybrid_model import HybridModel

FORMAT = "bench-model"
COUPLED_FORMAT = "bench-coupled-model"
HYBRID_FORMAT = "bench-hybrid-model"
VERSION = 1


Memory = MemoryCurve | tuple[float, ...]


@dataclass(frozen=True)
class ModelFile:
    """The content of a model file.

    Attributes
    ----------
    name : str
        Under which name the operator was identified.
    operator : Operator
        The model itself.
    memory : MemoryCurve, tuple of float, or None
        Its state at the end of the data that it was identified from: a memory curve, the states of the plays, or
        None for a model without memory.
    provenance : mapping
        Where it comes from.
    """

    name: str
    operator: Operator[Any]
    memory: Memory | None
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the file's content."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "name": self.name,
            "operator": self.operator.to_json(),
            "memory": self.memory.to_json() if isinstance(self.memory, MemoryCurve) else self.memory,
            "provenance": {"bench": importlib.metadata.version("actuator-bench"), **self.provenance},
        }

    def save(self, path: Path) -> None:
        """Write the file.

        Raises
        ------
        DataError
            If it cannot be written.
        """
        _write(path, self.to_json())


@dataclass(frozen=True)
class CoupledFile:
    """The content of the file of a model among voltage, force and length.

    Attributes
    ----------
    name : str
        Under which name it was identified.
    model : TwoStage, Summed or Linear
        The model itself.
    provenance : mapping
        Where it comes from.
    """

    name: str
    model: TwoStage | Summed | Linear
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the file's content."""
        return _content(COUPLED_FORMAT, self.name, self.model.to_json(), self.provenance)

    def save(self, path: Path) -> None:
        """Write the file.

        Raises
        ------
        DataError
            If it cannot be written.
        """
        _write(path, self.to_json())


@dataclass(frozen=True)
class HybridFile:
    """The content of the file of a model of a thermo-piezoelectric actuator.

    Attributes
    ----------
    model : HybridModel
        The model.
    provenance : mapping
        Where it comes from.
    """

    model: HybridModel
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the file's content."""
        return _content(HYBRID_FORMAT, "hybrid", self.model.to_json(), self.provenance)

    def save(self, path: Path) -> None:
        """Write the file.

        Raises
        ------
        DataError
            If it cannot be written.
        """
        _write(path, self.to_json())


def load_model(path: Path) -> ModelFile:
    """Read the file of an operator.

    Raises
    ------
    DataError
        If there is none, it is damaged, or its version is unknown.
    """
    return parse_model(_read(path), str(path))


def load_coupled_model(path: Path) -> CoupledFile:
    """Read the file of a model among voltage, force and length; see `load_model`."""
    return parse_coupled_model(_read(path), str(path))


def parse_coupled_model(content: object, source: str) -> CoupledFile:
    """Make such a model of the content of its file; see `parse_model`."""
    document = _checked(content, source, COUPLED_FORMAT)
    try:
        return CoupledFile(
            name=str(document["name"]),
            model=coupled_from_json(document["model"]),
            provenance=dict(document["provenance"]),
        )
    except KeyError as error:
        raise DataError(f"model file {source} is damaged: key {error} is missing") from None
    except (ValueError, TypeError, AttributeError, OverflowError) as error:
        raise DataError(f"model file {source} is damaged: {error}") from None


def load_hybrid_model(path: Path) -> HybridFile:
    """Read the file of a model of a thermo-piezoelectric actuator; see `load_model`."""
    source = str(path)
    document = _checked(_read(path), source, HYBRID_FORMAT)
    try:
        return HybridFile(HybridModel.from_json(document["model"]), dict(document["provenance"]))
    except KeyError as error:
        raise DataError(f"model file {source} is damaged: key {error} is missing") from None
    except (ValueError, TypeError, AttributeError, OverflowError) as error:
        raise DataError(f"model file {source} is damaged: {error}") from None


def is_coupled_model(content: object) -> bool:
    """Return whether the content of a model file is that of a model among voltage, force and length."""
    return isinstance(content, dict) and content.get("format") == COUPLED_FORMAT


def _content(format_: str, name: str, model: Mapping[str, Any], provenance: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "format": format_,
        "version": VERSION,
        "name": name,
        "model": model,
        "provenance": {"bench": importlib.metadata.version("actuator-bench"), **provenance},
    }


def _write(path: Path, content: Mapping[str, Any]) -> None:
    try:
        path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise DataError(f"model file {path} cannot be written: {error}") from None


def _read(path: Path) -> object:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"model file {path} cannot be read: {error.strerror}") from None
    # Not only a JSONDecodeError: a number of thousands of digits, brackets without end.
    except (ValueError, RecursionError) as error:
        raise DataError(f"model file {path} is damaged: not JSON: {error}") from None


def _checked(content: object, source: str, expected: str) -> dict[str, Any]:
    if not isinstance(content, dict) or content.get("format") != expected:
        raise DataError(f"{source} is not a model file: its `format` is not {expected!r}")
    if content.get("version") != VERSION:
        raise DataError(
            f"model file {source} has version {content.get('version')!r}; this bench reads version {VERSION}"
        )
    return content


def parse_model(content: object, source: str) -> ModelFile:
    """Make a model of the content of the file of an operator.

    Raises
    ------
    DataError
        If it is not one, is damaged, or its version is unknown; names `source`.
    """
    document = _checked(content, source, FORMAT)
    try:
        memory = document["memory"]
        operator = operator_from_json(document["operator"])
        for key in ("input_unit", "output_unit"):
            if not isinstance(getattr(operator, key), str):
                raise TypeError(f"operator: expected a text for {key}, got {getattr(operator, key)!r}")
        return ModelFile(
            name=str(document["name"]),
            operator=operator,
            memory=_parse_memory(memory, operator),
            provenance=dict(document["provenance"]),
        )
    except KeyError as error:
        raise DataError(f"model file {source} is damaged: key {error} is missing") from None
    except (ValueError, TypeError, OverflowError) as error:
        raise DataError(f"model file {source} is damaged: {error}") from None


def _parse_memory(memory: object, operator: Operator[Any]) -> Memory | None:
    if memory is None:
        return None
    if isinstance(operator, PrandtlIshlinskii):
        if not isinstance(memory, list) or not all(
            isinstance(value, int | float) and math.isfinite(value) for value in memory
        ):
            raise ValueError(f"memory: expected a list of finite numbers, got {memory!r}")
        if len(memory) != operator.thresholds.size:
            raise ValueError(f"memory: expected {operator.thresholds.size} play states, got {len(memory)}")
        return tuple(float(value) for value in memory)
    if not isinstance(memory, dict):
        raise TypeError(f"memory: expected an object, got {memory!r}")
    return MemoryCurve.from_json(memory)
