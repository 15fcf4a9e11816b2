"""The command that writes the skeleton of a device, a protocol, a model or a rig."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bench.base import print_plain
from bench.cli.printing import console
from bench.cli.skeletons import Part


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
