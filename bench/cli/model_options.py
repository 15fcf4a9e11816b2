"""The options of a model on the command line, and the table of models with their options."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bench.base import ConfigurationError, print_table
from bench.cli.command_support import parse_assignments
from bench.cli.printing import console, print_rows

if TYPE_CHECKING:
    from bench.models import ModelSpec

# Of the Preisach plane.
_FEWEST_LEVELS, _MOST_LEVELS = 2, 1000


@dataclass(frozen=True)
class ModelOptions:
    """The options of a model."""

    levels: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBER[,NUMBER...]",
            help="Levels of the Preisach plane; 20 if not given. Cross-validation chooses of several numbers.",
        ),
    ] = None
    plane: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="LOW HIGH", help="Ends of the Preisach plane; the model's own if not given."),
    ] = None
    options: Annotated[
        list[str] | None,
        typer.Option(
            "-o",
            metavar="NAME=VALUE",
            help="Option of the model, see `bench show MODEL`; also ridge=WEIGHT (penalty on the density's size) and "
            "orientation=rising|falling. Repeatable.",
        ),
    ] = None

    @cached_property
    def levels_to_try(self) -> tuple[int, ...]:
        """Numbers of levels for cross-validation, if several are given."""
        counts = _level_counts(self.levels)
        return counts if len(counts) > 1 else ()

    @cached_property
    def values(self) -> dict[str, Any]:
        """The options of the model's template by name, as far as they are given.

        Raises ConfigurationError if one is given twice, or is none.
        """
        values: dict[str, Any] = {} if self.plane is None else {"plane": self.plane}
        for name, text in parse_assignments("-o", self.options or ()).items():
            if name in values or (name == "levels" and self.levels is not None):
                raise ConfigurationError(f"-o {name}={text}: {name} is given twice")
            values[name] = _value(text)
        counts = _level_counts(self.levels)
        if len(counts) == 1:
            values["levels"] = counts[0]
        return values


def _level_counts(text: str | None) -> tuple[int, ...]:
    if text is None:
        return ()
    counts = tuple(map(_value, text.split(",")))
    if not all(isinstance(count, int) and _FEWEST_LEVELS <= count <= _MOST_LEVELS for count in counts):
        raise ConfigurationError(
            f"--levels {text}: expected whole numbers from {_FEWEST_LEVELS} to {_MOST_LEVELS}, such as 20 or "
            "10,20,40; -o levels=VALUE,VALUE,... takes the levels themselves"
        )
    return counts


def _value(text: str) -> Any:  # noqa: ANN401 - a number, numbers or a word
    """Return the value of `NAME=VALUE`: a number, several numbers, else the text."""
    try:
        if "," in text:
            return tuple(float(part) for part in text.split(","))
        return int(text) if text.lstrip("+-").isdigit() else float(text)
    except ValueError:
        return text


def inverse_of(spec: ModelSpec) -> str:
    """Return how a model is inverted: exact, by a table, numerical, or none."""
    return str(getattr(spec.model, "inverse_method", "none"))


def options_json(spec: ModelSpec) -> dict[str, dict[str, str]]:
    """Return default and meaning of each option of a model, for programs."""
    from bench.identification import model_options

    return {option.name: {"default": option.default, "text": option.text} for option in model_options(spec)}


def print_model(spec: ModelSpec) -> None:
    """Print the summary of a model, its inverse and its options."""
    console.print(spec.summary)
    console.print(f"inverse: {inverse_of(spec)}")
    options = options_json(spec)
    if options:
        rows = [(name, f"{each['text']} (default: {each['default']})") for name, each in options.items()]
        print_rows("options", rows)


def print_models(specs: dict[str, ModelSpec]) -> None:
    """Print a table of models with their options and their inverse."""
    rows = [
        (name, ", ".join(f"{key} ({each['default']})" for key, each in options_json(spec).items()), inverse_of(spec))
        for name, spec in specs.items()
    ]
    print_table(console, ("model", "options with their defaults", "inverse"), rows, "models")
