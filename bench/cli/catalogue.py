"""What is installed: rigs with the protocols that fit them, models, controllers and studies."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from bench.base import ConfigurationError, registry
from bench.models import identifiable_models, timed_models
from bench.protocol import ProtocolDefinition, fits, packaged_protocols
from bench.rig import RigFile, load_rig, packaged_rigs


@dataclass(frozen=True)
class Catalogue:
    """What is installed, by name.

    Attributes
    ----------
    rigs : mapping of str to RigFile
        Rigs.
    protocols : mapping of str to ProtocolDefinition
        Protocols.
    models, controllers, studies : mapping of str to str
        Their summaries; controllers as `TASK.NAME`.
    packages : mapping of str to str
        Distribution by the name of what is not the bench's own.
    problems : tuple of str
        What could not be loaded, and was left out.
    """

    rigs: Mapping[str, RigFile]
    protocols: Mapping[str, ProtocolDefinition]
    models: Mapping[str, str]
    controllers: Mapping[str, str]
    studies: Mapping[str, str]
    packages: Mapping[str, str]
    problems: tuple[str, ...]

    @classmethod
    def of_installed(cls) -> Catalogue:
        """Load everything that is registered."""
        problems: list[str] = []
        packages: dict[str, str] = {}

        def loaded(
            what: Mapping[str, registry.RegisteredPart], load: Callable[[str, registry.RegisteredPart], Any]
        ) -> dict[str, Any]:
            found = {}
            for name, entry in what.items():
                try:
                    found[name] = load(name, entry)
                except ConfigurationError as error:
                    problems.append(str(error))
                    continue
                if not entry.own:
                    packages[name] = entry.package
            return found

        packaged = packaged_protocols()
        problems += packaged.problems
        packages |= {name: package for name, package in packaged.packages.items() if package != registry.OWN_PACKAGE}
        models = identifiable_models() | timed_models()
        # Not listed by themselves; what another package cannot load is named all the same.
        groups: tuple[registry.Group, ...] = (
            "devices",
            "laboratories",
            "derived_signals",
            "identifications",
            "commands",
        )
        for group in groups:
            foreign = {name: entry for name, entry in registry.entries(group).items() if not entry.own}
            loaded(foreign, lambda _, entry: entry.load())
        return cls(
            rigs=loaded(packaged_rigs(problems), lambda name, _: load_rig(name)),
            protocols=packaged.protocols,
            models={
                name: text for name, text in loaded(registry.entries("models"), _summary).items() if name in models
            },
            controllers=loaded(registry.entries("controllers"), _summary),
            studies=loaded(registry.entries("studies"), _summary),
            packages=packages,
            problems=tuple(dict.fromkeys(problems)),
        )

    def fitting(self, rig: str) -> tuple[str, ...]:
        """Return the protocols that fit a rig."""
        return tuple(name for name, definition in self.protocols.items() if fits(definition, self.rigs[rig]))

    def to_json(self) -> dict[str, Any]:
        """Return the catalogue for programs."""
        return {
            "rigs": {name: file.rig.title for name, file in self.rigs.items()},
            "protocols": {name: definition.summary for name, definition in self.protocols.items()},
            "models": dict(self.models),
            "controllers": dict(self.controllers),
            "studies": dict(self.studies),
            "fitting": {rig: list(self.fitting(rig)) for rig in self.rigs},
            "take_a_model": [name for name, definition in self.protocols.items() if definition.needs_model],
            "packages": dict(self.packages),
            "problems": list(self.problems),
        }


def _summary(_: str, entry: registry.RegisteredPart) -> str:
    summary = getattr(entry.load(), "summary", None)
    if not isinstance(summary, str):
        raise ConfigurationError(
            f"package {entry.package}: entry point {entry.name} = {entry.reference!r} of bench.{entry.group} has no "
            "summary, so it is not what this group registers"
        )
    return summary
