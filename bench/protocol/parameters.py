"""Parameters of protocols: their declaration, their defaults from a rig, and their help."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, cast, get_args, get_origin, get_type_hints

from pydantic import Field, ValidationError
from pydantic_core import PydanticUndefined

from bench.base import (
    CheckedTable,
    ConfigurationError,
    Floats,
    closest,
    comma_remark,
    difference_unit,
    explain,
    is_quantity,
    read_quantity,
)
from bench.devices import Device, Signal
from bench.protocol.changes import ParameterChange
from bench.protocol.views import Views
from bench.protocol.vocabulary import Messages
from bench.rig import RoleTable, Slots, check_bound, rate_unit

Needs = Mapping[str, type[Device] | type[Signal]] | Sequence[str]
"""Slots by name with the kind of each, or names of devices and signals of one rig."""

_UNIT_OF = "unit of "
"""Begins the unit of a parameter that is that of a slot, where no rig says which that is."""


@dataclass(frozen=True)
class FromSlot:
    """A default that comes from what the rig file says of a slot; see `from_slot`."""

    slot: str
    take: Callable[[RoleTable], Any]
    text: str
    fallback: Any


def from_slot(
    slot: str,
    what: str | Callable[[RoleTable], Any],
    text: str = "",
    *,
    fallback: Any = None,  # noqa: ANN401
) -> Any:  # noqa: ANN401 - stands for a default of any type
    """Return a default for `parameter` that comes from the rig.

    Parameters
    ----------
    slot : str
        Name of the slot.
    what : str or callable
        Attribute of the slot's `RoleTable`, such as `low`; or a function of it.
    text : str
        What it is, for help texts; made from `what` if not given.
    fallback
        Value where the rig file does not say; without one the parameter must then be given.
    """
    if callable(what):
        return FromSlot(slot, what, text, fallback)
    return FromSlot(slot, lambda table: getattr(table, what), text or f"`{what}` of {slot}", fallback)


def unit_of(slot: str) -> str:
    """Return a unit for `parameter` that is that of a slot; with `/s` behind it, that of its rate of change."""
    return f"@{slot}"


def difference_of(slot: str) -> str:
    """Return a unit for `parameter` that is that of a difference of a slot's values: K of temperatures."""
    return f"Δ@{slot}"


class ProtocolParameters(CheckedTable):
    """Base of a protocol's parameters; declare each with `parameter`."""


def parameter(
    default: Any,  # noqa: ANN401 - of the type of the field
    *,
    unit: str,
    help: str,  # noqa: A002 - the word that the user sees
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    choices: Callable[[], Sequence[str]] | None = None,
    file: bool = False,
    changeable: bool = False,
) -> Any:  # noqa: ANN401 - stands for a field's default
    """Declare a parameter of a protocol.

    Parameters
    ----------
    default
        Value when nothing is said; `...` if it must be given, `from_slot(...)` if the rig says it.
    unit : str
        Its unit; `1` for a count or a plain number, empty for a text, `unit_of(...)` or `difference_of(...)` for that
        of a slot.
    help : str
        What it does, in one sentence without a full stop.
    low, high : float, optional
        The allowed range, both ends included.
    above : float, optional
        In place of `low`: what it has to be greater than.
    choices : callable, optional
        Returns the texts that are allowed, where these are registered by name.
    file : bool
        Whether it is the path of a file that the protocol reads; the content is then kept with the run. An empty text
        stands for no file.
    changeable : bool
        Whether the operator may change it at a pause. The protocol has to read it from its parameters each time.
    """
    extra: dict[str, Any] = {"unit": unit, "choices": choices, "file": file, "changeable": changeable}
    if isinstance(default, FromSlot):
        extra["default"] = default
        default = ...
    return Field(
        default,
        description=help,
        ge=low,
        gt=above,
        le=high,
        json_schema_extra=extra,
        # A default that is a text may stand for another type, such as a list of numbers.
        validate_default=isinstance(default, str),
    )


@dataclass(frozen=True)
class ParameterHelp:
    """One parameter as help texts show it."""

    name: str
    default: str
    unit: str
    allowed: str
    text: str


@dataclass(frozen=True)
class ProtocolDefinition:
    """A protocol that can be run: its name, its parameters, and its generator function.

    Attributes
    ----------
    name, summary, description : str
        For lists and help texts.
    needs : mapping or tuple of str
        Slots with the kind of each; or names of devices and signals, for a script that is written for one rig.
    may_use : mapping
        Slots that it uses where the rig binds them.
    controls : str
        Slot or signal that its controllers control; empty if it has none.
    parameters : type of ProtocolParameters
        What can be set.
    generator : callable
        Takes the parameters, and the slots where it asks for some.
    views : Views or None
        What the dashboard shows of it; None for all that the rig file lays out.
    targets : callable or None
        Takes parameters and slots; returns the values to which the controlled signal is brought, shape (N,).
    """

    name: str
    summary: str
    description: str
    needs: Mapping[str, type[Device] | type[Signal]] | tuple[str, ...]
    controls: str
    parameters: type[ProtocolParameters]
    generator: Callable[..., Messages]
    may_use: Mapping[str, type[Device] | type[Signal]] = field(default_factory=dict)
    views: Views | None = None
    targets: Callable[[Any, Slots], Floats] | None = None

    @property
    def slots(self) -> Mapping[str, type[Device] | type[Signal]]:
        """The slots that it asks for, with the kind of each."""
        return self.needs if isinstance(self.needs, Mapping) else {}

    @property
    def names(self) -> tuple[str, ...]:
        """The devices and signals that it names."""
        return () if isinstance(self.needs, Mapping) else self.needs

    @property
    def needs_model(self) -> bool:
        """Whether a model file has to be given."""
        info = self.parameters.model_fields.get("model")
        return info is not None and info.is_required()

    @property
    def file_parameters(self) -> tuple[str, ...]:
        """The names of the parameters that name files."""
        return tuple(name for name in self.parameters.model_fields if self._extra(name).get("file"))

    @property
    def changeable(self) -> tuple[str, ...]:
        """The names of the parameters that may be changed at a pause."""
        return tuple(name for name in self.parameters.model_fields if self._extra(name).get("changeable"))

    def change(
        self,
        parameters: ProtocolParameters,
        name: str,
        value: Any,  # noqa: ANN401
        roles: Mapping[str, RoleTable] | None = None,
    ) -> Any:  # noqa: ANN401
        """Change a parameter of a protocol that goes on, which sees it when it reads it next.

        Parameters
        ----------
        parameters : ProtocolParameters
            Those that the protocol was started with.
        name : str
            The parameter.
        value
            Its new value, also as a text.
        roles : mapping of str to RoleTable, optional
            The roles that the rig file binds, for units in messages.

        Returns
        -------
        any
            The value as JSON holds it.

        Raises
        ------
        ConfigurationError
            If it may not be changed at a pause, or not to this value; nothing is changed then.
        """
        if name not in self.changeable:
            known = ", ".join(self.changeable) or "none"
            raise ConfigurationError(
                f"protocol {self.name}: {name!r} cannot be changed at a pause; parameters that can: {known}"
            )
        changed = self.parse({**parameters.model_dump(), name: value}, roles)
        # Of the object that the protocol has; no other way is open to it, as values are frozen.
        parameters.__dict__[name] = getattr(changed, name)
        return changed.model_dump(mode="json")[name]

    def files(self, parameters: ProtocolParameters) -> dict[str, str]:
        """Return the paths of the files that the parameters name, by the name of the parameter."""
        return {name: path for name in self.file_parameters if (path := str(getattr(parameters, name)))}

    def changed(
        self, parameters: ProtocolParameters, roles: Mapping[str, RoleTable], defaults: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return the parameters that differ from their defaults on a rig, as JSON holds them, by name.

        `roles` and `defaults` are those of `parse`. A parameter that must be given differs always.
        """
        given = parameters.model_dump(mode="json")
        own = {name: info.default for name, info in self.parameters.model_fields.items() if not info.is_required()}
        usual = own | self._from_roles(roles) | dict(defaults)
        try:
            validated = self.parameters.model_validate(given | usual).model_dump(mode="json")
            usual = {name: validated[name] for name in usual}
        except ValidationError:
            # Defaults that do not fit the others are compared as they are written.
            pass
        return {name: value for name, value in given.items() if name not in usual or value != usual[name]}

    def controlled(self, slots: Slots) -> str:
        """Return the signal that its controllers control; empty if it has none."""
        return slots[self.controls].signal if self.controls in self.slots else self.controls

    def start(self, parameters: ProtocolParameters, slots: Slots) -> Messages:
        """Return its messages from the first."""
        return self.generator(parameters, slots) if self.slots else self.generator(parameters)

    def parse(
        self,
        settings: Mapping[str, Any],
        roles: Mapping[str, RoleTable] | None = None,
        defaults: Mapping[str, Any] | None = None,
        *,
        path: str = "",
    ) -> ProtocolParameters:
        """Make parameters from texts such as those of `--set`, and from what a rig file says.

        Parameters
        ----------
        settings : mapping
            What was set, as text or as values.
        roles : mapping of str to RoleTable, optional
            The roles that the rig file binds.
        defaults : mapping, optional
            The rig file's own table of this protocol; settings come before it, it comes before the roles.
        path : str
            The rig file, for messages.

        Raises
        ------
        ConfigurationError
            If a name is unknown or a value is missing or not allowed; it names all that is wrong.
        """
        for name in defaults or {}:
            if name not in self.parameters.model_fields:
                known = closest(name, self.parameters.model_fields)
                raise ConfigurationError(f"{path}: protocols.{self.name}.{name}: there is no such parameter; {known}")
        if roles is not None:
            # Before the parameters, whose defaults then are missing too.
            check_bound(self.name, self.slots, roles, path)
        merged = self._from_roles(roles or {}) | dict(defaults or {}) | self._in_units(settings, roles or {})
        try:
            parameters = self.parameters.model_validate(merged)
        except ValidationError as error:
            from_file = {
                name: f"{path}: protocols.{self.name}.{name}: " for name in defaults or {} if name not in settings
            }
            raise ConfigurationError("\n".join(self._explain(error, from_file, roles or {}))) from None
        for name in self.parameters.model_fields:
            choices = self._extra(name).get("choices")
            if choices is not None and getattr(parameters, name) not in choices():
                raise ConfigurationError(
                    f"protocol {self.name}: parameter {name} = {getattr(parameters, name)!r} is not allowed; "
                    f"{closest(str(getattr(parameters, name)), choices())}"
                )
        return parameters

    def help(
        self, roles: Mapping[str, RoleTable] | None = None, defaults: Mapping[str, Any] | None = None
    ) -> tuple[ParameterHelp, ...]:
        """Return what there is to set; with a rig's roles and table, its defaults and units.

        What belongs to a slot that the rig does not bind is left out.
        """
        given = self._from_roles(roles or {}) | dict(defaults or {})
        hidden = () if roles is None else self.without_slot(roles)
        names = (name for name in self.parameters.model_fields if name not in hidden)
        return tuple(self._parameter_help(name, roles or {}, given) for name in names)

    def without_slot(self, roles: Container[str]) -> tuple[str, ...]:
        """Return the parameters that are of a slot which is used only where a rig binds it, and this one does not."""
        missing = tuple(f"@{slot}" for slot in self.may_use if slot not in roles)
        return tuple(name for name in self.parameters.model_fields if str(self._extra(name).get("unit")) in missing)

    def units(self, roles: Mapping[str, RoleTable]) -> dict[str, str]:
        """Return the units of the parameters on a rig, by name; those of texts and plain numbers are left out."""
        return {
            entry.name: entry.unit
            for entry in self.help(roles)
            if entry.unit not in ("", "1") and not entry.unit.startswith(_UNIT_OF)
        }

    def _extra(self, name: str) -> dict[str, Any]:
        extra = self.parameters.model_fields[name].json_schema_extra
        return cast("dict[str, Any]", extra) if isinstance(extra, dict) else {}

    def _in_units(self, settings: Mapping[str, Any], roles: Mapping[str, RoleTable]) -> dict[str, Any]:
        """Return settings in which `3K`, `300 µm` or a list of such texts are numbers in the parameters' units."""
        found, wrong = dict(settings), []
        for name, value in settings.items():
            unit = self._unit(name, roles) if name in self.parameters.model_fields else ""
            if not isinstance(value, str) or not unit or unit.startswith(_UNIT_OF):
                continue
            parts = value.split(",")
            if any(is_quantity(part) for part in parts):
                try:
                    found[name] = ",".join(str(read_quantity(part, unit)) for part in parts)
                except ValueError as error:
                    wrong.append(f"protocol {self.name}: parameter {name}: {error}")
        if wrong:
            raise ConfigurationError("\n".join(wrong))
        return found

    def _from_roles(self, roles: Mapping[str, RoleTable]) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name in self.parameters.model_fields:
            default = self._extra(name).get("default")
            if isinstance(default, FromSlot):
                value = default.take(roles[default.slot]) if default.slot in roles else None
                value = default.fallback if value is None else value
                if value is not None:
                    found[name] = value
        return found

    def _parameter_help(self, name: str, roles: Mapping[str, RoleTable], given: Mapping[str, Any]) -> ParameterHelp:
        info = self.parameters.model_fields[name]
        extra = self._extra(name)
        unit = self._unit(name, roles)
        low = next((m.ge for m in info.metadata if getattr(m, "ge", None) is not None), None)
        above = next((m.gt for m in info.metadata if getattr(m, "gt", None) is not None), None)
        high = next((m.le for m in info.metadata if getattr(m, "le", None) is not None), None)
        if extra.get("choices") is not None:
            allowed = ", ".join(extra["choices"]())
        elif low is not None and high is not None:
            allowed = f"{low:g} to {high:g}"
        elif above is not None:
            allowed = f"> {above:g}" + ("" if high is None else f", ≤ {high:g}")
        elif low is not None:
            allowed = f"≥ {low:g}"
        elif high is not None:
            allowed = f"≤ {high:g}"
        elif get_origin(info.annotation) is Literal:
            allowed = ", ".join(map(str, get_args(info.annotation)))
        elif info.annotation is bool:
            allowed = "true, false"
        elif get_origin(info.annotation) is tuple:
            allowed = "numbers with commas between them"
        elif extra.get("file"):
            allowed = "a file"
        else:
            allowed = "any text" if info.annotation is str else "any number"
        source = extra.get("default")
        if name in given:
            default = "of the rig file" if isinstance(given[name], dict) else str(given[name])
        elif isinstance(source, FromSlot):
            default = f"the rig's: {source.text}"
        else:
            default = "must be given" if info.default is PydanticUndefined else str(info.default)
        return ParameterHelp(name, default, unit, allowed, info.description or "")

    def _unit(self, name: str, roles: Mapping[str, RoleTable]) -> str:
        unit = str(self._extra(name).get("unit", ""))
        if "@" not in unit:
            return unit
        difference, _, slot = unit.partition("@")
        slot, slash, _ = slot.partition("/")
        unit = (roles[slot].unit if slot in roles else None) or f"{_UNIT_OF}{slot}"
        return rate_unit(unit) if slash else difference_unit(unit) if difference else unit

    def _allowed(self, name: str, roles: Mapping[str, RoleTable]) -> str:
        """Return what a parameter may be, with its unit, for a message."""
        entry = self._parameter_help(name, roles, {})
        if entry.unit in ("", "1"):
            return entry.allowed
        if not entry.unit.startswith(_UNIT_OF):
            return f"{entry.allowed} {entry.unit}"
        slot, slash, _ = entry.unit.removeprefix(_UNIT_OF).partition("/")
        return f"{entry.allowed}, in the unit of the {slot}{' per second' if slash else ''}"

    def _explain(
        self, error: ValidationError, from_file: Mapping[str, str], roles: Mapping[str, RoleTable]
    ) -> Iterator[str]:
        for problem in error.errors():
            name = ".".join(str(part) for part in problem["loc"]) or "parameters"
            if problem["type"] == "extra_forbidden":
                known = closest(name, self.parameters.model_fields)
                yield f"protocol {self.name}: there is no parameter {name!r}; {known}"
            elif name in self.parameters.model_fields:
                given = "is missing" if problem["type"] == "missing" else f"= {problem['input']!r} is not allowed"
                if problem["type"] == "missing" and isinstance(source := self._extra(name).get("default"), FromSlot):
                    given += f" (the rig file does not say {source.text})"
                elif problem["type"] == "missing" and not self._extra(name).get("file"):
                    given += f" (nor does the rig file say it: [protocols.{self.name}] {name} = ...)"
                why = "" if problem["type"] == "missing" else f" ({explain(problem)}){comma_remark(problem['input'])}"
                yield (
                    f"{from_file.get(name, '')}protocol {self.name}: parameter {name} {given}; "
                    f"allowed: {self._allowed(name, roles)}{why}"
                )
            else:
                yield f"protocol {self.name}: {explain(problem)}"


@dataclass(frozen=True)
class OpenParameters:
    """The parameters of a protocol that goes on, as they may be changed at a pause.

    Attributes
    ----------
    definition : ProtocolDefinition
        The protocol.
    parameters : ProtocolParameters
        Those that it was started with.
    roles : mapping of str to RoleTable
        The roles that its rig file binds, for units.
    """

    definition: ProtocolDefinition
    parameters: ProtocolParameters
    roles: Mapping[str, RoleTable]

    def changeable(self) -> dict[str, str]:
        """Return those that may be changed, with value, unit and what is allowed."""
        found: dict[str, str] = {}
        for entry in self.definition.help(self.roles):
            if entry.name in self.definition.changeable:
                unit = f" {entry.unit}" if entry.unit not in ("", "1") else ""
                value = getattr(self.parameters, entry.name)
                shown = f"{value:g}" if isinstance(value, float) else str(value)
                found[entry.name] = f"{shown}{unit}, {entry.text} ({entry.allowed})"
        return found

    def change(self, step: int, name: str, value: str) -> ParameterChange:
        """Change one from the reading of a step on; raises ConfigurationError if that is not allowed."""
        former = self.parameters.model_dump(mode="json").get(name)
        return ParameterChange(step, name, self.definition.change(self.parameters, name, value, self.roles), former)


def protocol(
    *,
    needs: Needs,
    may_use: Mapping[str, type[Device] | type[Signal]] | None = None,
    controls: str = "",
    views: Views | None = None,
    targets: Callable[[Any, Slots], Floats] | None = None,
) -> Callable[[Callable[..., Messages]], ProtocolDefinition]:
    """Make a generator function a protocol.

    Its name is the function's, with dashes; its first argument is annotated with its parameters' class; its second,
    if it asks for slots, is `slots: Slots`; its docstring is its help.

    Parameters
    ----------
    needs : mapping of str to type, or sequence of str
        Slots by name: the role that the device of the slot has to play (a `Device` class), or `Signal` where
        something is only measured. A sequence names devices and signals of one rig instead.
    may_use : mapping of str to type, optional
        Slots that it uses where the rig binds them.
    controls : str
        Slot (or signal) that the protocol's controllers control, if it has any: what they think of it (`TRACES`) is
        then recorded beside the rig's signals.
    views : Views, optional
        What the dashboard shows of it, by its slots; all that the rig file lays out if not given.
    targets : callable, optional
        Takes parameters and slots; returns the values to which the controlled signal is brought, shape (N,). An
        accuracy that is asked of a run is checked there, otherwise over the range of the slot.

    Raises
    ------
    TypeError
        If the function is not of this form.
    """
    if isinstance(needs, str):
        raise TypeError(f"needs: expected a sequence of names, such as ({needs!r},), got the text {needs!r}")

    def define(function: Callable[..., Messages]) -> ProtocolDefinition:
        name = function.__qualname__
        if not inspect.isgeneratorfunction(function):
            raise TypeError(f"{name}: a protocol is a generator, and this function yields nothing")
        hints = [hint for key, hint in get_type_hints(function).items() if key != "return"]
        takes_slots = isinstance(needs, Mapping)
        if (
            len(inspect.signature(function).parameters) != 1 + takes_slots
            or len(hints) != 1 + takes_slots
            or not (isinstance(hints[0], type) and issubclass(hints[0], ProtocolParameters))
        ):
            second = " and `slots: Slots`" if takes_slots else ""
            raise TypeError(f"{name}: a protocol takes one argument, annotated with a ProtocolParameters{second}")
        description = inspect.getdoc(function)
        if not description:
            raise TypeError(f"{name}: a protocol has a docstring, which is its help")
        return ProtocolDefinition(
            name=function.__name__.replace("_", "-"),
            summary=description.splitlines()[0].rstrip("."),
            description=description,
            needs=dict(needs) if isinstance(needs, Mapping) else tuple(needs),
            controls=controls,
            parameters=hints[0],
            generator=function,
            may_use=dict(may_use or {}),
            views=views,
            targets=targets,
        )

    return define
