"""Tables of rig files, campaigns and the like: what every one of them refuses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidatorFunctionWrapHandler, field_validator


class CheckedTable(BaseModel):
    """Base of tables that come from files: refuses keys that it does not know, and numbers that are none.

    `nan`, `inf`, and `true` or `false` in the place of a number are refused; pydantic itself would take `true` for 1.
    So is a text with a null character, which no name of a file can have.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @field_validator("*", mode="wrap")
    @classmethod
    def _check(cls, value: object, validate: ValidatorFunctionWrapHandler) -> object:
        result = validate(value)
        _compare(value, result)
        return result


def _compare(value: Any, result: Any) -> None:  # noqa: ANN401 - as the file has it, and as the table has it
    """Raise ValueError if a boolean became a number, or a text has a null character."""
    if isinstance(value, bool) and isinstance(result, (int, float)) and not isinstance(result, bool):
        raise ValueError("expected a number, not true or false")
    if isinstance(value, str) and "\0" in value:
        raise ValueError("a text may not have a null character")
    if isinstance(value, list) and isinstance(result, (list, tuple)):
        for pair in zip(value, result, strict=False):
            _compare(*pair)
    if isinstance(value, Mapping) and isinstance(result, Mapping):
        # A text may be part of another table, which looks at it itself.
        for name in (name for name, each in value.items() if not isinstance(each, str)):
            _compare(value[name], result.get(name))
