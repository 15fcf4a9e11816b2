"""Registered models: the entries of the group `bench.models`, and the classes that model files name."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from bench.base import ConfigurationError, checks as _checks, registry


@dataclass(frozen=True)
class ModelSpec:
    """An entry of the group `bench.models`: a class of models, and how identification sets one up.

    Parameters
    ----------
    summary : str
        What the model is, in one line.
    model : type
        Its class: an `Operator`, or a whole model with a `kind`, `to_json` and `from_json`.
    template : callable or None
        Takes the inputs and the keyword options of `identify` but the units; returns the operator before the fit.
        None for a model that `identify` cannot make of one input and one output.
    constrained : bool
        Whether the signs of `Operator.nonnegative` are imposed; otherwise the coefficients are free, with penalties
        on the cells of a density (`identify` says which).
    refine : callable or None
        Takes template, inputs, outputs, weights, skip and initial state; returns a template that follows from the
        data, before the fit.
    estimate_state : callable or None
        Takes template, inputs, outputs, weights, skip and smoothing; returns the initial state that they suggest.
    variants : mapping of str to tuple
        Values of options of `template` that a comparison of models tries, in all combinations.
    is_compared : bool
        Whether the model takes part in a comparison that names no models.
    fit_in_time : callable or None
        For a model with time (`TimedModel`), in place of `template`: takes times, inputs, outputs and the keyword
        options `weights`, `skip`, `initial`, units and its own; returns an `Identification`.
    """

    summary: str
    model: type[Any]
    template: Callable[..., Any] | None = None
    constrained: bool = True
    refine: Callable[..., Any] | None = None
    estimate_state: Callable[..., Any] | None = None
    variants: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    is_compared: bool = True
    fit_in_time: Callable[..., Any] | None = None


def identifiable_models() -> dict[str, ModelSpec]:
    """Return the registered models that `identify` can fit, by name; entries that cannot be imported are left out."""
    return {name: spec for name, spec in _specs().items() if spec.template is not None}


def timed_models() -> dict[str, ModelSpec]:
    """Return the registered models with time that can be fitted, by name; what cannot be imported is left out."""
    return {name: spec for name, spec in _specs().items() if spec.fit_in_time is not None}


def find_model(name: str) -> ModelSpec:
    """Return the registered model of a name that `identify` can fit.

    Raises
    ------
    ValueError
        If there is none of this name.
    ConfigurationError
        If its entry cannot be imported.
    """
    if name in registry.entries("models"):
        spec: ModelSpec = registry.load("models", name)
        if spec.template is not None:
            return spec
    raise ValueError(f"model_name: expected one of {', '.join(sorted(identifiable_models()))}, got {name!r}")


def _specs() -> dict[str, ModelSpec]:
    found = {}
    for name, entry in registry.entries("models").items():
        with contextlib.suppress(ConfigurationError):
            found[name] = entry.load()
    return found


def model_class(kind: object) -> type[Any]:
    """Return the registered class of a kind.

    Raises ValueError if no entry of `bench.models` has it.
    """
    # Most kinds are also names: nothing else then need be imported.
    if isinstance(kind, str) and kind in registry.entries("models"):
        model: type[Any] = registry.load("models", kind).model
        if model.kind == kind:
            return model
    classes: Mapping[str, type[Any]] = {spec.model.kind: spec.model for spec in _specs().values()}
    if not isinstance(kind, str) or kind not in classes:
        raise ValueError(
            f"expected a model of the kind {' or '.join(map(repr, sorted(classes)))}, got {kind!r}; other kinds are "
            "registered by packages, as entries of the group bench.models"
        )
    return classes[kind]


def model_from_json(document: Mapping[str, Any]) -> Any:  # noqa: ANN401 - each kind has its class
    """Return the model that the `to_json` of a registered class wrote.

    Raises ValueError if the type is unknown or the object is not what that type expects.
    """
    return model_class(_checks.json_field(document, "type", "model")).from_json(document)
