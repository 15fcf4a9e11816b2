"""Problems that pydantic finds, as messages for the author of the file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from bench.base.parsing import comma_remark


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
        key = prefix + ".".join(str(part) for part in location)
        owner, field = _find(model, location)
        message = problem["msg"].removeprefix("Value error, ")
        if problem["type"] == "extra_forbidden":
            known = ", ".join(owner.model_fields) if owner else ""
            yield f"{key}: there is no such key; allowed are: {known}"
        elif problem["type"] == "missing":
            meaning = f" ({field.description})" if field and field.description else ""
            yield f"{key}: is missing{meaning}"
        else:
            meaning = f" ({field.description})" if field and field.description else ""
            value = problem["input"]
            shown = f" = {value!r}" if not isinstance(value, dict) else ""
            yield f"{key or 'file'}{shown}: {message}{meaning}{comma_remark(value)}"


def _find(model: type[BaseModel], location: Sequence[Any]) -> tuple[type[BaseModel] | None, FieldInfo | None]:
    owner: type[BaseModel] | None = model
    field: FieldInfo | None = None
    for part in location:
        if owner is None:
            break
        if part in owner.model_fields:
            field = owner.model_fields[part]
            nested = _models_in(field.annotation)
            if nested:
                # The innermost key that is found carries the description.
                owner_next: type[BaseModel] | None = nested[0]
                if part == location[-1]:
                    break
                owner = owner_next
    return owner, field


def _models_in(annotation: Any) -> list[type[BaseModel]]:  # noqa: ANN401 - any annotation
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for argument in get_args(annotation) for model in _models_in(argument)]
