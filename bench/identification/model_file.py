"""Model files: an identified model as versioned JSON, with its units and provenance.

A file of version 2 is an object with these keys:

`format`, `version`
    `bench-model` and 2.
`name`
    Under which name the model was identified, such as `preisach-nonmonotonic`.
`kind`
    The class of the model: the `kind` of a class that an entry of `bench.models` names.
`model`
    The content that the model's class writes: its `type` (the kind), coefficients, ranges and units.
`memory`
    The state of an operator, or of a model with time, at the end of the data from which it was identified; null for
    a model without memory or of several inputs.
`initial`
    Its state before the first row of these data, written alike; may be missing: the model's own initial state.
`band`
    The prediction band (`Band` of `bench.identification.bands`); left out if there is none.
`validity`
    The inputs that were fitted (`bench.identification.Validity`); may be missing: then the range of the model.
`dynamics`
    Actuator, response and noise as the transients of the data show them (`bench.models.IdentifiedDynamics`): objects
    `actuator`, `response`, `noise` and `uncertainties`, the number `fastest` and the text `source`; left out if not
    known.
`provenance`
    `source`, `input`, `output`, `rows`, `skipped` (first rows that did not count), `initial` (what was asked for),
    `input_sha256` (of the input column), `orientation`, errors and certificate of the fit, `bench` (version).
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from bench.base import DataError, Floats, json_text, parse_json, write_result
from bench.identification.validity import Beyond, Validity
from bench.models import IdentifiedDynamics, Operator, TimedModel, model_class, model_from_json

if TYPE_CHECKING:
    from bench.identification.bands import Band

FORMAT = "bench-model"
# Derivation: counted.
VERSION = 2
# A record adds when it kept the model.
_KEYS = {
    "kept",
    "format",
    "version",
    "kind",
    "name",
    "model",
    "memory",
    "initial",
    "band",
    "dynamics",
    "validity",
    "provenance",
}
_PROVENANCE: Mapping[str, tuple[type | tuple[type, ...], str]] = {
    "skipped": (int, "a whole number"), "rms": ((int, float), "a number"), "input": (str, "a text"),
    "output": (str, "a text"), "time": (str, "a text"), "input_sha256": (str, "a text"),
}  # fmt: skip
"""What commands take from the provenance, where it is there."""


@dataclass(frozen=True)
class ModelFile:
    """The content of a model file.

    Attributes
    ----------
    name : str
        Under which name the model was identified.
    model : object
        The model itself, of a registered class.
    memory : object
        State of an operator, or of a model with time, at the end of the data from which it was identified; None for
        other models.
    provenance : mapping
        Where it comes from.
    initial : object
        State of an operator before the first row of these data, from which it predicts unless told otherwise; None
        for the operator's own initial state, and for other models.
    band : Band or None
        How far predictions may be from what is measured, if that was calibrated.
    dynamics : IdentifiedDynamics or None
        How actuator and response follow a set-point, and their noise, if that was identified.
    validity : Validity or None
        The inputs that were fitted; None in older files.
    """

    name: str
    model: Any
    memory: Any = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    initial: Any = None
    band: Band | None = None
    dynamics: IdentifiedDynamics | None = None
    validity: Validity | None = None

    @property
    def valid(self) -> Validity:
        """The inputs that were fitted; of an older file the range of the model is all that is known of them."""
        return self.validity or Validity(*self.response.input_range)

    def beyond(self, inputs: ArrayLike, times: Floats | None = None, *, first: int = 0) -> Beyond:
        """Return how far inputs lie beyond those that were fitted; arguments and errors as `Validity.judge`."""
        return self.valid.judge(inputs, times, first=first, unit=self.response.input_unit)

    @property
    def operator(self) -> Operator[Any]:
        """The model, if it is one of one input and one output.

        Raises DataError if it is another.
        """
        if not isinstance(self.model, Operator):
            expected = (
                "without time: identify it with --time none" if isinstance(self.model, TimedModel) else "of one input"
            )
            raise DataError(f"model {self.name} is of the kind {self.model.kind}; expected one {expected}")
        return self.model

    @property
    def response(self) -> Operator[Any] | TimedModel[Any]:
        """The model, if it is one of one input and one output, with time or without.

        Raises DataError if it is another.
        """
        return self.model if isinstance(self.model, TimedModel) else self.operator

    def at_rest(self) -> ModelFile:
        """Return the model of an input that stands still, as controllers take it: a model without time is one.

        Of a model with time it is the operator that its output settles to; `left_out` in its provenance says in words
        what else it has. Raises DataError if it settles to none.
        """
        model = self.model
        if not isinstance(model, TimedModel):
            return self
        now, before = (
            model.at_rest(model.initial_state() if state is None else state) for state in (self.memory, self.initial)
        )
        if now is None or before is None:
            raise DataError(
                f"model {self.name} is of the kind {model.kind}, whose output goes on while the input stands still; "
                "expected one that settles: identify it with --time none"
            )
        left_out = ", ".join(f"{name} {value:.3g} {unit}" for name, (value, unit) in model.parameters().items())
        provenance = {**self.provenance, "left_out": left_out}
        return replace(self, model=now[0], memory=now[1], initial=before[1], band=None, provenance=provenance)

    def to_json(self) -> dict[str, Any]:
        """Return the file's content."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "name": self.name,
            "kind": self.model.kind,
            "model": self.model.to_json(),
            "memory": None if self.memory is None else self.response.state_to_json(self.memory),
            "initial": None if self.initial is None else self.response.state_to_json(self.initial),
            **({} if self.band is None else {"band": self.band.to_json()}),
            **({} if self.dynamics is None else {"dynamics": self.dynamics.to_json()}),
            **({} if self.validity is None else {"validity": self.validity.to_json()}),
            "provenance": {"bench": importlib.metadata.version("actuator-bench"), **self.provenance},
        }

    def save(self, path: str | Path) -> None:
        """Write the file.

        Raises DataError if it cannot be written, or could not be loaded again because the class of the model is not
        registered.
        """
        content = self.to_json()
        text = json_text(content, indent=1)
        reference = f"{type(self.model).__module__}:{type(self.model).__qualname__}"
        try:
            registered = model_class(self.model.kind)
        except ValueError:
            registered = None
        if registered is not type(self.model):
            raise DataError(
                f"model file {path} is not written, as it could not be loaded again: {reference} is not the class "
                f"registered for the kind {self.model.kind!r}; register it in an entry of the group bench.models"
            )
        again = parse_model(parse_json(text), str(path)).to_json()
        if any(again.get(key) != content.get(key) for key in _KEYS - {"kept", "provenance", "validity"}):
            raise DataError(
                f"model file {path} is not written: {reference} does not read what it writes (to_json, from_json)"
            )
        write_result(Path(path), text + "\n")


def load_model(path: Path, kind: str | None = None) -> ModelFile:
    """Read a model file.

    Parameters
    ----------
    path : Path
        The file.
    kind : str or None
        The only kind of model that is accepted; None accepts every registered kind.

    Raises
    ------
    DataError
        If there is none, it is damaged, its version or kind is unknown, or it is of another kind.
    """
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        # Those that are kept with a run.
        kept = ", ".join(map(str, sorted(path.glob("models/*.json"))))
        remedy = f"; in it there is {kept}" if kept else ""
        raise DataError(f"model file {path} cannot be read: {error.strerror}{remedy}") from None
    # Not only a JSONDecodeError: a number of thousands of digits, too.
    except ValueError as error:
        raise DataError(f"model file {path} is damaged: not JSON: {error}") from None
    file = parse_model(content, str(path))
    if kind not in (None, file.model.kind):
        raise DataError(f"model file {path}: expected a model of the kind {kind!r}, got {file.model.kind!r}")
    return file


def is_model(content: object) -> bool:
    """Return whether something is the content of a model file of any version."""
    return isinstance(content, dict) and content.get("format") == FORMAT


def models_among(files: Mapping[str, bytes], source: str) -> dict[str, ModelFile]:
    """Return the model files among the files of a run, by their names there; what is none is left out.

    Raises DataError as `parse_model`.
    """
    found: dict[str, ModelFile] = {}
    for name, content in files.items():
        # A first look, as others may be long tables.
        if content.lstrip()[:1] != b"{":
            continue
        with suppress(ValueError, RecursionError):
            parsed = parse_json(content)
            if is_model(parsed):
                found[name] = parse_model(parsed, f"{source}: {name}")
    return found


def parse_model(content: object, source: str) -> ModelFile:
    """Make a model of the content of its file.

    Raises DataError if it is not one, is damaged, or its version or kind is unknown; names `source`.
    """
    if not isinstance(content, dict) or not is_model(content):
        raise DataError(f"{source} is not a model file: its `format` is not {FORMAT!r}")
    if (version := content.get("version")) != VERSION:
        raise DataError(f"model file {source} has version {version!r}; this bench reads version {VERSION}")
    try:
        if unknown := content.keys() - _KEYS:
            raise ValueError(f"unknown key {min(unknown)!r}; expected {', '.join(sorted(_KEYS))}")
        name = content["name"]
        if not isinstance(name, str):
            raise TypeError(f"name: expected a text, got {name!r}")
        document = content["model"]
        model = model_from_json(document)
        _check_fields(document, model.to_json())
        if content["kind"] != model.kind:
            raise ValueError(f"kind: expected {model.kind!r}, the type of the model, got {content['kind']!r}")
        memory, initial = content["memory"], content.get("initial")
        if isinstance(model, Operator | TimedModel):
            for key in ("input_unit", "output_unit"):
                if not isinstance(getattr(model, key), str):
                    raise TypeError(f"operator: expected a text for {key}, got {getattr(model, key)!r}")
            memory = None if memory is None else model.state_from_json(memory)
            initial = None if initial is None else model.state_from_json(initial)
        elif memory is not None or initial is not None:
            raise ValueError(f"memory: expected none, as a {model.kind} model keeps none, got {memory or initial!r}")
        band = None if content.get("band") is None else _read_band(content["band"])
        known = content.get("dynamics")
        dynamics = None if known is None else IdentifiedDynamics.from_json(known)
        validity = None if content.get("validity") is None else Validity.from_json(content["validity"])
        provenance = dict(content["provenance"])
        for key, (kind, what) in _PROVENANCE.items():
            value = provenance.get(key)
            if value is not None and (isinstance(value, bool) or not isinstance(value, kind)):
                raise TypeError(f"provenance: expected {what} for {key}, got {value!r}")
        return ModelFile(name, model, memory, provenance, initial, band, dynamics, validity)
    except KeyError as error:
        raise DataError(f"model file {source} is damaged: key {error} is missing") from None
    except (ValueError, TypeError, AttributeError, OverflowError) as error:
        raise DataError(f"model file {source} is damaged: {error}") from None


def _check_fields(said: object, held: object) -> None:
    """Raise ValueError if a file says what its model does not hold, or `true` or `false` for a number."""
    if isinstance(said, dict) and isinstance(held, dict):
        for key, value in said.items():
            if key in held:
                _check_fields(value, held[key])
            elif value is not None:
                raise ValueError(f"unknown key {key!r} of the model")
    elif isinstance(said, list) and isinstance(held, list | tuple):
        for each, other in zip(said, held, strict=False):
            _check_fields(each, other)
    elif isinstance(said, bool) and isinstance(held, int | float) and not isinstance(held, bool):
        raise ValueError("expected a number, got true or false")


def _read_band(content: Mapping[str, Any]) -> Band:
    # Here, as a model without a band needs no identification.
    from bench.identification.bands import Band

    return Band.from_json(content)
