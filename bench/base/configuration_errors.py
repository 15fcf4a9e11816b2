"""Problems in what a user wrote, as messages: what pydantic finds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from bench.base.names import closest
from bench.base.parsing import comma_remark

_EXPECTED = {
    "bool_parsing": "true or false", "bool_type": "true or false", "dict_type": "a table",
    "finite_number": "a finite number", "float_parsing": "a number", "float_type": "a number",
    "greater_than": "a number > {gt:g}", "greater_than_equal": "a number ≥ {ge:g}",
    "int_from_float": "a whole number", "int_parsing": "a whole number", "int_type": "a whole number",
    "enum": "{expected}", "less_than": "a number < {lt:g}", "less_than_equal": "a number ≤ {le:g}",
    "list_type": "a list", "literal_error": "{expected}", "model_attributes_type": "a table", "model_type": "a table",
    "path_type": "a path", "string_pattern_mismatch": "a text of the form {pattern}",
    "string_too_long": "a text of at most {max_length} characters",
    "string_too_short": "a text of at least {min_length} characters", "string_type": "a text",
    "too_long": "at most {max_length} values", "too_short": "at least {min_length} values", "tuple_type": "a list",
}  # fmt: skip
"""What was expected, by pydantic's type of an error and in the words of its context."""


def explain(problem: Mapping[str, Any]) -> str:
    """Return what is wrong with a value, of an entry of `ValidationError.errors`, in the words of the bench."""
    kind = problem["type"]
    if kind in ("value_error", "assertion_error"):
        return str(problem["msg"]).removeprefix("Value error, ").removeprefix("Assertion failed, ")
    if kind == "missing":
        return "is missing"
    return f"expected {_EXPECTED[kind].format(**problem.get('ctx', {}))}" if kind in _EXPECTED else "is not allowed"


def problems(error: ValidationError, model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """Yield one sentence a problem: key, value, and what is allowed.

    Parameters
    ----------
    error : ValidationError
        What pydantic raised.
    model : type of BaseModel
        The model that was validated.
    prefix : str
        Key under which the model stands in the file, with its final point.
    """
    for problem in error.errors():
        location = problem["loc"]
        # The model itself has no key: its message names one.
        key = (prefix + ".".join(str(part) for part in location)).rstrip(".")
        owner, field = _find(model, location)
        meaning = f" ({field.description})" if field and field.description else ""
        if problem["type"] == "extra_forbidden":
            yield f"{key}: there is no such key; {closest(str(location[-1]), owner.model_fields)}"
        elif problem["type"] == "missing":
            yield f"{key}: is missing{meaning}"
        else:
            value = problem["input"]
            shown = f"{key or 'file'} = {value!r}: " if not isinstance(value, dict) else key and f"{key}: "
            yield f"{shown}{explain(problem)}{meaning}{comma_remark(value)}"


def _find(owner: type[BaseModel], location: Sequence[Any]) -> tuple[type[BaseModel], FieldInfo | None]:
    """Return the innermost table of a location below a table, and the innermost field, which has the description."""
    field: FieldInfo | None = None
    for part in location:
        if part in owner.model_fields:
            field = owner.model_fields[part]
            if part != location[-1] and (nested := _models_in(field.annotation)):
                owner = nested[0]
    return owner, field


def _models_in(annotation: Any) -> list[type[BaseModel]]:  # noqa: ANN401 - any annotation
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for argument in get_args(annotation) for model in _models_in(argument)]
