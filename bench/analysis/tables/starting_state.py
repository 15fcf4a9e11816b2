"""How a model is applied to measurements: where it starts from, which first rows count, and at which times."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, get_args

from bench.analysis.tables.dataset import digest
from bench.base import ConfigurationError, Floats
from bench.identification import ModelFile
from bench.models import Hammerstein, Operator, TimedModel, TimedSequence

Start: TypeAlias = Literal["file", "negative", "positive", "skip"]


@dataclass(frozen=True)
class StartingState:
    """State of a model before the first row, and the number of first rows left out of errors."""

    state: Any
    skip: int


def starting_state(
    model: ModelFile,
    inputs: Floats | None = None,
    *,
    initial: str | None = None,
    skip: int | None = None,
    continue_memory: bool = False,
) -> StartingState:
    """Return where a model starts from.

    Parameters
    ----------
    model : ModelFile
        The model.
    inputs : ndarray, shape (N,), or None
        The inputs that follow, in the unit of the model; None if they are not known yet.
    initial : {"file", "negative", "positive", "skip"} or None
        "file": the state at the start of the model's own data. On these data the rows that its identification left
        out are left out again, on others as many as their inputs leave unknown if it was identified with "skip",
        unless these are more than half.
        "negative", "positive": saturation at the low or the high end of the operating range. "skip": unknown, so
        that the rows are left out until the inputs have overwritten the memory. Default "file". A model with time has
        words of its own: `TimedModel.starts`.
    skip : int or None
        Number of first rows to leave out instead; with "skip" at least.
    continue_memory : bool
        Start from the state at the end of the model's own data.

    Raises
    ------
    ConfigurationError
        If `initial` is none of these or given beside `continue_memory`, or `skip` leaves no row.
    """
    operator = model.response
    words = ("file", *operator.starts) if isinstance(operator, TimedModel) else get_args(Start)
    if initial not in (None, *words):
        raise ConfigurationError(f"--initial {initial}: expected one of {', '.join(words)}")
    if continue_memory and initial is not None:
        raise ConfigurationError(f"--initial {initial} and --continue-memory exclude each other")
    if inputs is None and initial == "skip":
        raise ConfigurationError("--initial skip: there are no measured rows to leave out")
    if inputs is not None and skip is not None and not 0 <= skip < inputs.size:
        raise ConfigurationError(f"--skip {skip}: there are {inputs.size} rows; at least one must be left")
    if continue_memory:
        return StartingState(model.memory, skip or 0)
    if isinstance(operator, TimedModel):
        if initial not in (None, "file", "skip"):
            return StartingState(operator.start(initial), skip or 0)
    elif initial in ("negative", "positive"):
        return StartingState(operator.saturated_state(-1 if initial == "negative" else 1), skip or 0)
    state = operator.initial_state() if model.initial is None else model.initial
    if inputs is None or (skip is not None and initial != "skip"):
        return StartingState(state, skip or 0)
    if initial != "skip" and model.provenance.get("input_sha256") == digest(inputs):
        return StartingState(state, int(model.provenance.get("skipped", 0)))
    unknown = 0
    if "skip" in (initial, model.provenance.get("initial")):
        unknown = operator.unknown_until(inputs)
        unknown = unknown if initial == "skip" else left_out(unknown, inputs.size)
    return StartingState(state, max(skip or 0, unknown))


def left_out(unknown: int, rows: int) -> int:
    """Return how many first rows nobody asked to leave out are: those of unknown memory, unless half of all are."""
    return 0 if unknown > rows // 2 else unknown


def foreign_drift(file: ModelFile, inputs: Floats) -> str:
    """Return a warning if a model's drift is applied to inputs, shape (N,), of another record; else an empty text."""
    model = file.model
    own = file.provenance.get("input_sha256")
    if not isinstance(model, Hammerstein) or not model.drift or own in (None, digest(inputs)):
        return ""
    value, unit = model.parameters()["drift"]
    return (
        f"{file.name} has a drift of {value:.3g} {unit}, which is that of its own record, from its first row on; "
        "--recalibrate offset,drift estimates what it is in this one"
    )


def bind_times(file: ModelFile, times: Floats | None) -> Operator[Any] | TimedSequence:
    """Return what evaluates inputs: the operator, or the model with time at these times, s.

    Raises ConfigurationError if a model with time has none.
    """
    model = file.response
    if not isinstance(model, TimedModel):
        return model
    if times is None:
        raise ConfigurationError(
            f"model {file.name} needs the time of each row: give --time COLUMN, or --format interval=TIME"
        )
    return model.at(times)
