"""The options of a model: what its template takes besides the inputs, with defaults, kinds and what each means."""

from __future__ import annotations

import difflib
import inspect
import types
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from bench.base import Floats
from bench.models import ModelSpec, Operator, find_model

_OF_ALL = ("weights", "skip", "initial", "orientation")
"""Keywords of a fit in time that are no options of one model."""


UNITS = ("input_unit", "output_unit")
"""Options that every model takes."""


@dataclass(frozen=True)
class OptionHelp:
    """What an option of a template means: metadata of its annotation, `Annotated[float, OptionHelp("…")]`."""

    text: str  # meaning and unit, in a line
    default: str = ""  # the default in words, where its value is None


@dataclass(frozen=True)
class ModelOption:
    """An option that identification of a model takes."""

    name: str  # keyword of the template
    default: str  # the default as text; empty if there is none
    text: str  # meaning and unit; empty if the template does not say
    kinds: tuple[Any, ...]  # the types that its annotation allows; empty if any


def model_options(spec: ModelSpec) -> tuple[ModelOption, ...]:
    """Return the options of a model, as its template takes them, or its fit if it is one with time.

    What the columns give, and what every model takes, is left out.
    """
    given = _all_options(spec.template) if spec.template is not None else _all_options(spec.fit_in_time, after=3)
    return tuple(option for option in given if not option.name.endswith("_unit") and option.name not in _OF_ALL)


def template_of(spec: ModelSpec, inputs: Floats, options: Mapping[str, Any]) -> Operator[Any]:
    """Return the operator before the fit, by options that may hold its units."""
    assert spec.template is not None
    own = {name: value for name, value in options.items() if name not in UNITS}
    template: Any = spec.template(inputs, **own)
    begun: Operator[Any] = replace(template, **{name: options[name] for name in UNITS if name in options})
    return begun


def check_options(model_name: str, options: Mapping[str, Any]) -> None:
    """Check that a model takes options of these names, and values of these kinds.

    Raises ValueError if it does not: names the options that there are, with their defaults.
    """
    units = {name: ModelOption(name, "", "", (str,)) for name in UNITS}
    known = units | {option.name: option for option in _all_options(find_model(model_name).template)}
    for name, value in options.items():
        if name not in known:
            raise ValueError(f"options of {model_name}: {_unknown(name, tuple(known.values()))}")
        kinds = known[name].kinds
        if kinds and not any(_fits(value, kind) for kind in kinds):
            expected = " or ".join(text for kind in kinds if (text := _kind_text(kind)))
            raise ValueError(f"{name}: expected {expected}, got {value!r}")


def _unknown(name: str, known: tuple[ModelOption, ...]) -> str:
    own = [option for option in known if not option.name.endswith("_unit")]
    close = difflib.get_close_matches(name, [option.name for option in own], n=1)
    listed = ", ".join(f"{option.name} ({option.default})" if option.default else option.name for option in own)
    question = f"; did you mean {close[0]}?" if close else ";"
    return f"there is no {name}{question} there are: {listed or 'none'}"


def _all_options(function: Callable[..., Any] | None, after: int = 1) -> tuple[ModelOption, ...]:
    if function is None:
        return ()
    parameters = [
        each
        for each in list(inspect.signature(function).parameters.values())[after:]
        if each.kind is not inspect.Parameter.VAR_KEYWORD
    ]
    try:
        hints = get_type_hints(function, include_extras=True)
    # Annotations of another package may name what is imported for a type checker only.
    except NameError:
        hints = {}
    return tuple(_option(parameter, hints.get(parameter.name, Any)) for parameter in parameters)


def _option(parameter: inspect.Parameter, hint: Any) -> ModelOption:  # noqa: ANN401 - any annotation
    notes = [note for note in getattr(hint, "__metadata__", ()) if isinstance(note, OptionHelp)]
    plain = hint.__origin__ if hasattr(hint, "__metadata__") else hint
    default = parameter.default
    text = "" if default is inspect.Parameter.empty else "none" if default is None else str(default)
    return ModelOption(
        name=parameter.name,
        default=notes[0].default if notes and notes[0].default else text,
        text=notes[0].text if notes else "",
        kinds=_kinds(plain),
    )


def _kinds(hint: Any) -> tuple[Any, ...]:  # noqa: ANN401
    """Return the parts of a union that can be checked; none at all if one cannot."""
    parts = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    checkable = (bool, int, float, str, type(None), tuple[float, float], tuple[float, ...])
    return parts if all(part in checkable or get_origin(part) is Literal for part in parts) else ()


def _fits(value: Any, kind: Any) -> bool:  # noqa: ANN401
    if kind is type(None):
        return value is None
    if get_origin(kind) is Literal:
        return isinstance(value, str) and value in get_args(kind)
    if kind is str or kind is bool:
        return isinstance(value, kind)
    if get_origin(kind) is tuple:
        if isinstance(value, str) or np.ndim(value) != 1:
            return False
        wanted = 2 if get_args(kind)[-1] is not Ellipsis else len(value)
        return len(value) == wanted and all(_fits(each, float) for each in value)
    allowed = (int, np.integer) if kind is int else (int, float, np.integer, np.floating)
    return isinstance(value, allowed) and not isinstance(value, bool)


def _kind_text(kind: Any) -> str:  # noqa: ANN401
    if get_origin(kind) is Literal:
        return "one of " + ", ".join(get_args(kind))
    if get_origin(kind) is tuple:
        return "two numbers" if get_args(kind)[-1] is not Ellipsis else "numbers"
    return {int: "an integer", float: "a number", str: "a text", bool: "true or false"}.get(kind, "")
