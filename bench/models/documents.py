"""Models as JSON objects: the fields of a frozen dataclass, under the `type` of its class."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields
from typing import Any, ClassVar, Self, TypeAlias

import numpy as np

from bench.base import checks as _checks
from bench.models.density import Density

Parts: TypeAlias = Mapping[str, Callable[[Any], Any]]
"""By field, what makes its value of JSON."""


class Document:
    """Base of frozen dataclasses that are written as JSON and read again.

    Attributes
    ----------
    kind : str
        The class's name in files.
    parts : mapping of str to callable
        What makes the value of a field of JSON, for fields whose JSON is an object of its own.
    added : tuple of str
        Fields that files of earlier versions lack; these files mean their defaults.
    """

    kind: ClassVar[str]
    parts: ClassVar[Parts] = {}
    added: ClassVar[tuple[str, ...]] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the model as a JSON object: its `type`, then its fields."""
        kept = [field.name for field in fields(self) if field.init]  # type: ignore[arg-type]
        return {"type": self.kind} | {name: _plain(getattr(self, name)) for name in kept}

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> Self:
        """Return the model that `to_json` wrote; a field may be missing if its default is None or an empty text.

        Raises ValueError if a key is missing or a value is wrong.
        """
        kind = _checks.json_field(document, "type", cls.kind)
        if kind != cls.kind:
            raise ValueError(f"{cls.kind}: expected type {cls.kind!r}, got {kind!r}")
        values: dict[str, Any] = {}
        for field in fields(cls):  # type: ignore[arg-type]
            is_optional = field.default in (None, "") or field.name in cls.added
            if not field.init or (is_optional and field.name not in document):
                continue
            value = _checks.json_field(document, field.name, cls.kind)
            part = cls.parts.get(field.name)
            if value is None and field.default is MISSING:
                raise ValueError(f"{cls.kind}: expected a value for {field.name!r}, got none")
            values[field.name] = value if part is None or value is None else part(value)
        return cls(**values)


class Model(Document):
    """Base of what a model file holds: an operator, or a model of several inputs or of a whole actuator."""

    def densities(self) -> tuple[Density, ...]:
        """Return the densities on Preisach planes that there are to draw; by default none."""
        return ()


def _plain(value: Any) -> Any:  # noqa: ANN401 - anything that a field holds
    """Return a value as JSON can hold it."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    return value.to_json() if hasattr(value, "to_json") else value
