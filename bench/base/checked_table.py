"""Tables of rig files, campaigns and the like: what every one of them refuses."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

_KEYS = (
    "schema", "items_schema", "keys_schema", "values_schema", "extras_schema", "choices", "steps", "definitions",
    "fields",
)  # fmt: skip
"""Where a schema has others."""


def _no_boolean(value: object) -> object:
    if isinstance(value, bool):
        raise PydanticCustomError("number_type", "expected a number, not true or false")
    return value


def _with_numbers(schema: Any) -> Any:  # noqa: ANN401 - a schema, or part of one
    """Return a schema in which every number is checked."""
    if schema["type"] in ("float", "int"):
        return core_schema.no_info_before_validator_function(_no_boolean, schema)
    if schema.get("function", {}).get("function") is _no_boolean:
        return schema
    changed = dict(schema)
    for key, inner in _inner(schema):
        if isinstance(inner, list):
            changed[key] = [
                (_with_numbers(each[0]), *each[1:]) if isinstance(each, tuple) else _with_numbers(each)
                for each in inner
            ]
        elif key in ("fields", "choices"):
            # Fields by name, of which one may be `type`, and choices of a union by tag.
            changed[key] = {name: _with_numbers(each) for name, each in inner.items()}
        else:
            changed[key] = _with_numbers(inner)
    return changed


def _inner(schema: Any) -> Iterator[tuple[str, Any]]:  # noqa: ANN401
    for key in _KEYS:
        if schema.get(key) is not None:
            yield key, schema[key]


class CheckedTable(BaseModel):
    """Base of tables that come from files: refuses keys that it does not know, and numbers that are none.

    `nan`, `inf`, and `true` or `false` in the place of a number are refused; pydantic itself would take `true` for 1.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:  # noqa: ANN401
        """Return the schema of pydantic, with numbers that may not be `true` or `false`."""
        schema: dict[str, Any] = _with_numbers(handler(source))
        return schema
