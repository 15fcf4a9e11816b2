"""What is installed: rigs with the protocols that fit them, models, controllers and studies."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from bench.base import ConfigurationError, registry
from bench.models import identifiable_models, timed_models
from bench.protocol import fits, packaged_protocols
from bench.rig import load_rig, packaged_rigs


def installed() -> dict[str, Any]:
    """Load everything that is registered; return it by name, as JSON can hold it.

    `rigs` have their titles, `protocols`, `models`, `controllers` (as `TASK.NAME`) and `studies` their summaries.
    `fitting` has the protocols that fit each rig, `take_a_model` those that need a model file, `packages` the
    distributions of parts that are not the bench's own, and `problems` what could not be loaded, and was left out.
    """
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
    protocols = packaged.protocols
    problems += packaged.problems
    packages |= {name: package for name, package in packaged.packages.items() if package != registry.OWN_PACKAGE}
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
    rigs = loaded(packaged_rigs(problems), lambda name, _: load_rig(name))
    models = identifiable_models() | timed_models()
    return {
        "rigs": {name: file.rig.title for name, file in rigs.items()},
        "protocols": {name: definition.summary for name, definition in protocols.items()},
        "models": {
            name: text for name, text in loaded(registry.entries("models"), _summary).items() if name in models
        },
        "controllers": loaded(registry.entries("controllers"), _summary),
        "studies": loaded(registry.entries("studies"), _summary),
        "fitting": {
            rig: [name for name, each in protocols.items() if fits(each, file)] for rig, file in rigs.items()
        },
        "take_a_model": [name for name, definition in protocols.items() if definition.needs_model],
        "packages": packages,
        "problems": list(dict.fromkeys(problems)),
    }


def _summary(_: str, entry: registry.RegisteredPart) -> str:
    summary = getattr(entry.load(), "summary", None)
    if not isinstance(summary, str):
        raise ConfigurationError(
            f"package {entry.package}: entry point {entry.name} = {entry.reference!r} of bench.{entry.group} has no "
            "summary, so it is not what this group registers"
        )
    return summary
