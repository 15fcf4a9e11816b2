"""Model files: an identified operator as versioned JSON, with its units, where it comes from, and its memory.

Version 1 is an object with these keys:

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
from bench.hysteresis import MemoryCurve, Operator, PrandtlIshlinskii, operator_from_json

FORMAT = "bench-model"
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
        try:
            path.write_text(json.dumps(self.to_json(), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        except OSError as error:
            raise DataError(f"model file {path} cannot be written: {error}") from None


def load_model(path: Path) -> ModelFile:
    """Read a model file.

    Raises
    ------
    DataError
        If there is none, it is damaged, or its version is unknown.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"model file {path} cannot be read: {error.strerror}") from None
    # Not only a JSONDecodeError: a number of thousands of digits, brackets without end.
    except (ValueError, RecursionError) as error:
        raise DataError(f"model file {path} is damaged: not JSON: {error}") from None
    return parse_model(content, str(path))


def parse_model(content: object, source: str) -> ModelFile:
    """Make a model of the content of a model file.

    Raises
    ------
    DataError
        If it is not one, is damaged, or its version is unknown; names `source`.
    """
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise DataError(f"{source} is not a model file: its `format` is not {FORMAT!r}")
    if content.get("version") != VERSION:
        raise DataError(
            f"model file {source} has version {content.get('version')!r}; this bench reads version {VERSION}"
        )
    try:
        memory = content["memory"]
        operator = operator_from_json(content["operator"])
        for key in ("input_unit", "output_unit"):
            if not isinstance(getattr(operator, key), str):
                raise TypeError(f"operator: expected a text for {key}, got {getattr(operator, key)!r}")
        return ModelFile(
            name=str(content["name"]),
            operator=operator,
            memory=_parse_memory(memory, operator),
            provenance=dict(content["provenance"]),
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
