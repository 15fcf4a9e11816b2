"""Tables of rig files, campaigns and the like: what every one of them refuses."""

from __future__ import annotations

from collections.abc import Callable, Iterator
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


def _no_null(value: object) -> object:
    if isinstance(value, str) and "\0" in value:
        raise PydanticCustomError("null_character", "a text may not have a null character")
    return value


_CHECKS = {"float": _no_boolean, "int": _no_boolean, "str": _no_null}


def _check_of(schema: Any) -> Callable[[object], object] | None:  # noqa: ANN401 - a schema, or part of one
    """Return the check that a schema of numbers or texts lacks; a literal 1 would be equal to true."""
    if schema["type"] == "literal":
        numbers = all(isinstance(value, int) and not isinstance(value, bool) for value in schema["expected"])
        return _no_boolean if numbers else None
    return _CHECKS.get(schema["type"])


def _checked(schema: Any) -> Any:  # noqa: ANN401 - a schema, or part of one
    """Return a schema in which every number and every text is checked."""
    if (check := _check_of(schema)) is not None:
        return core_schema.no_info_before_validator_function(check, schema)
    if schema.get("function", {}).get("function") in _CHECKS.values():
        return schema
    changed = dict(schema)
    for key, inner in _inner(schema):
        if isinstance(inner, list):
            changed[key] = [
                (_checked(each[0]), *each[1:]) if isinstance(each, tuple) else _checked(each) for each in inner
            ]
        elif key in ("fields", "choices"):
            # Fields by name, of which one may be `type`, and choices of a union by tag.
            changed[key] = {name: _checked(each) for name, each in inner.items()}
        else:
            changed[key] = _checked(inner)
    return changed


def _inner(schema: Any) -> Iterator[tuple[str, Any]]:  # noqa: ANN401
    for key in _KEYS:
        if schema.get(key) is not None:
            yield key, schema[key]


class CheckedTable(BaseModel):
    """Base of tables that come from files: refuses keys that it does not know, and numbers that are none.

    `nan`, `inf`, and `true` or `false` in the place of a number are refused; pydantic itself would take `true` for 1.
    So is a text with a null character, which no name of a file can have.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:  # noqa: ANN401
        """Return the schema of pydantic, with the checks of numbers and texts."""
        schema: dict[str, Any] = _checked(handler(source))
        return schema
