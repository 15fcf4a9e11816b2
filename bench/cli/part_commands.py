"""The commands about what is installed: list, show and new."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.padding import Padding
from rich.text import Text

from bench.base import ConfigurationError, closest, print_plain
from bench.cli.command_support import JsonOption, write_json
from bench.cli.listing import listing
from bench.cli.printing import console, print_rows, warn
from bench.cli.skeletons import Part


def list_(json_file: JsonOption = None) -> None:
    """List rigs with the protocols that fit them, models, controllers and studies; `bench show NAME` shows one.

    What comes from another package bears its name; an entry that cannot be loaded is named and left out.
    """
    listed = listing()
    _print_listing(listed)
    write_json(json_file, listed)


def show(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME", help="A rig, protocol, model, controller or study; or models, for all their options."
        ),
    ],
    json_file: JsonOption = None,
) -> None:
    """Show a rig, a protocol, a model, a controller or a study in full.

    A protocol is shown with its parameters, a rig with its file: `bench show RIG > desk.toml` gives you a copy to
    fill in.
    """
    from bench.cli.model_options import print_model, print_models
    from bench.cli.run_commands import print_protocol
    from bench.models import identifiable_models, timed_models
    from bench.protocol import find_protocol
    from bench.rig import load_rig

    listed = listing()
    specs = identifiable_models() | timed_models()
    others = {**listed["studies"], **listed["controllers"]}
    if name in listed["rigs"]:
        # Plain, so that it can be redirected into a file.
        text = load_rig(name).text
        typer.echo(text, nl=False, err=console.stderr)
        write_json(json_file, {"name": name, "text": text})
    elif name in listed["protocols"]:
        definition = find_protocol(name)
        print_protocol(definition)
        write_json(json_file, {"name": name, "parameters": [vars(entry) for entry in definition.help()]})
    elif name == "models":
        print_models(specs)
        write_json(json_file, {each: _model_json(spec) for each, spec in specs.items()})
    elif name in specs:
        print_model(specs[name])
        write_json(json_file, {"name": name, **_model_json(specs[name])})
    elif name in others:
        console.print(others[name])
        write_json(json_file, {"name": name, "summary": others[name]})
    else:
        known = closest(name, [*listed["rigs"], *listed["protocols"], *specs, *others], "`bench list`")
        raise ConfigurationError(f"there is no rig, protocol, model, controller or study {name!r}; {known}")


def _model_json(spec: Any) -> dict[str, Any]:  # noqa: ANN401 - a ModelSpec, not imported at start
    from bench.cli.model_options import inverse_of, options_json

    return {"summary": spec.summary, "inverse": inverse_of(spec), "options": options_json(spec)}


def _print_listing(listed: Mapping[str, Any]) -> None:
    def titles(group: str) -> dict[str, str]:
        packages = {name: f" [{package}]" for name, package in listed["packages"].items()}
        return {name: text + packages.get(name, "") for name, text in listed[group].items()}

    alike: dict[tuple[str, ...], dict[str, str]] = {}
    for rig, title in titles("rigs").items():
        alike.setdefault(tuple(listed["fitting"][rig]), {})[rig] = title
    for protocols, rigs in alike.items():
        print_rows("rigs", rigs.items())
        names = ", ".join(name + "*" * (name in listed["take_a_model"]) for name in protocols) or "none"
        text = Text.assemble(("protocols (*: takes a model file):", "dim"), f" {names}")
        console.print(Padding(text, (1, 0, 1, 4), expand=False))
    for group in ("protocols", "models", "controllers"):
        print_rows(group, titles(group).items())
        console.print()
    print_rows("studies, for `bench study`", titles("studies").items())
    console.print()
    for problem in listed["problems"]:
        warn(f"left out: {problem}")


def new(
    part: Annotated[Part, typer.Argument(metavar="PART", help="What it is: device, protocol, model or rig.")],
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="Its name, in lower case with hyphens, such as micro-balance.")
    ],
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder in which the folder NAME is made; this one if not given.")
    ] = Path(),
) -> None:
    """Write a working skeleton of a device, a protocol, a model or a rig, with tests that pass.

    The folder is a package of its own. Installed, its part is known to the bench by its name; nothing of the bench
    is changed.
    """
    from bench.cli.skeletons import write_skeleton

    for file in write_skeleton(part, name, out):
        print_plain(console, str(file))
    folder = out / name
    print_plain(console, f"next: python -m pip install -e {folder} && python -m pytest {folder}")
