"""The model card: what a person must know of an identified model before using it, as a Markdown page."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.analysis.applied import Applied
from bench.analysis.model_service import IdentifiedFile, certificate_lines
from bench.analysis.tables.data import Quantity
from bench.base import DataError, percent, significant, write_result
from bench.identification import Errors
from bench.models import MemoryCurve, Operator, TimedModel
from bench.record import Record

# Models in the table of those that were compared; all are in the model file.
_SHOWN = 10


def write_card(
    path: Path, found: IdentifiedFile, *, command: str, model: Path | None, figures: Sequence[Path]
) -> None:
    """Write the card of a model as Markdown, UTF-8.

    Parameters
    ----------
    path : Path
        The file to write; figures are linked relative to its folder.
    found : IdentifiedFile
        The model and the fit behind it.
    command : str
        Command line that identifies it again.
    model : Path or None
        The model file, if one was written.
    figures : sequence of Path
        Figures of the fit, if some were drawn.

    Raises
    ------
    DataError
        If the file cannot be written, or the data not read again.
    """
    rows = found.applied()
    measured = rows.measured
    assert measured is not None
    sections = {
        "Data": _table(("", ""), _data(found, rows, measured)),
        "Errors": _table(("error", measured.unit or "output units", "% of the range"), _errors(found)),
        "Certificate": _table(("", ""), certificate_lines(found)),
        "Limits of validity": _table(("", ""), _limits(found)),
    }
    if (band := found.band) is not None:
        held_out = f"{significant(band.band.held_out, 4)} {band.unit}".rstrip()
        sections["Prediction band"] = _table(
            ("", ""), [*band.rows(), ("RMS error of the rows, each left out of the fit", held_out)]
        )
    if (selection := found.file.provenance.get("selection")) is not None:
        unit = selection["unit"] or "output units"
        heads = ("model", f"score, {unit}", "% of the range", f"blocks, {unit}", f"unseen cycles, {unit}", "free", "")
        sections["Models compared"] = _table(heads, _compared(selection["table"]))
    if found.trials is not None:
        sections["Selection"] = _fenced(found.trials.table())
    if found.warnings:
        sections["Warnings"] = "\n".join(f"- {warning}" for warning in found.warnings)
    sections["Reproduce"] = _fenced(command) + f"\n\nactuator-bench {importlib.metadata.version('actuator-bench')}."
    if links := [Path(os.path.relpath(each, path.parent)).as_posix() for each in figures]:
        sections["Figures"] = "\n".join(f"![{Path(link).stem}](<{link}>)" for link in links)
    unit = f" in {rows.unit}" if rows.unit else ""
    of = f"{measured.title}{unit} from {rows.input.title}, identified from {found.data.paths[0].name}"
    head = f"# Model {found.file.name}\n\n{of}"
    parts = [f"{head}{f', in the file {model.name}' if model else ''}."]
    parts += [f"## {title}\n\n{text}" for title, text in sections.items()]
    write_result(path, "\n\n".join(parts) + "\n")


def sha256_of(data: Path) -> str:
    """Return the SHA-256 digest of a file of measurements, or of the journal of a run, in hexadecimal.

    Raises DataError if it cannot be read.
    """
    if data.is_dir():
        with Record(data) as record:
            data = record.path
    try:
        with data.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DataError(f"{data} cannot be read: {error.strerror}") from None


def _data(found: IdentifiedFile, rows: Applied, outputs: Quantity) -> list[tuple[str, str]]:
    skip = found.identification.skip
    first = f", of which the first {skip} drive the memory and count in no error" if skip else ""
    return [
        ("source", found.data.paths[0].name),
        ("SHA-256", sha256_of(found.data.paths[0])),
        *([("layout", found.data.assumptions)] if found.data.assumptions else []),
        ("rows", f"{found.inputs.size}{first}"),
        *([] if rows.time is None else [("sampling rate", _sampling(rows.time))]),
        ("input", _extent(rows.input)),
        ("output", _extent(outputs)),
    ]


def _extent(quantity: Quantity) -> str:
    return f"{quantity.title}, {_between(quantity.values.min(), quantity.values.max(), quantity.unit)}"


def _between(low: float, high: float, unit: str) -> str:
    return f"{low:.6g} to {high:.6g}{f' {unit}' if unit else ', unit unknown'}"


def _errors(found: IdentifiedFile) -> list[tuple[str, str, str]]:
    errors: Errors = found.identification.errors
    return [
        ("largest", significant(errors.maximum, 4), percent(errors.maximum_percent).removesuffix(" %")),
        ("RMS", significant(errors.rms, 4), percent(errors.rms_percent).removesuffix(" %")),
        ("mean absolute", significant(errors.average, 4), percent(errors.average_percent).removesuffix(" %")),
        ("range of the output", significant(errors.span, 4), "100.00"),
    ]


def _compared(table: Sequence[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Return the models that were compared to the end, the best first, at most ten beside the chosen one."""
    whole = [row for row in table if row["note"] in ("", "chosen", "least error")]
    shown = [*whole[:_SHOWN], *(row for row in whole[_SHOWN:] if row["note"] == "chosen")]
    return [
        (
            " ".join(filter(None, (row["model"], row["options"], row["initial"]))),
            *(
                "" if row[name] is None else significant(row[name], 3)
                for name in ("score", "score_percent", "held_out_rms", "units_rms")
            ),
            f"{row['free']:.1f}",
            row["note"],
        )
        for row in shown
    ]


def _limits(found: IdentifiedFile) -> list[tuple[str, str]]:
    known = found.file.valid
    rows = f"{known.rows} fitted, {known.skipped} first ones skipped, {known.left_out} others not fitted"
    return [
        ("inputs", f"{known.text(found.file.response.input_unit)}; beyond them the errors are unknown"),
        *([] if found.data.time else [("rates", "no time was read; the errors hold at the rate of these data")]),
        ("rows", rows),
        ("memory before the first row", _memory(found)),
    ]


def _sampling(time: Quantity) -> str:
    steps = np.diff(time.values)
    low, middle, high = steps.min(), np.median(steps), steps.max()
    uneven = f"; uneven steps of {low:.4g} to {high:.4g} {time.unit}" if high - low > 1e-3 * middle else ""
    duration = significant(time.values[-1] - time.values[0], 4)
    return f"{significant(1.0 / middle, 4)} Hz over {duration} {time.unit}{uneven}"


def _memory(found: IdentifiedFile) -> str:
    operator, state = found.file.response, found.identification.initial_state
    text = _memory_text(operator, state)
    how = found.file.provenance.get("initial")
    if how == "skip":
        return f"unknown; taken as {text}, and the rows that it reaches are left out"
    return f"estimated: {text}" if how == "estimate" else text


def _memory_text(operator: Operator[Any] | TimedModel[Any], state: Any) -> str:  # noqa: ANN401 - each has its own
    if isinstance(operator, TimedModel):
        return str(operator.state_to_json(state))
    if operator.memoryless:
        return "none: the output depends on the present input alone"
    for direction, name in ((-1, "negative saturation"), (1, "positive saturation")):
        if state == operator.saturated_state(direction):
            return name
    if state is None or state == operator.initial_state():
        return "the initial state of the model"
    if isinstance(state, MemoryCurve):
        before = "negative" if state.saturation < 0 else "positive"
        extrema = ", ".join(f"{value:.6g}" for value in state.extrema)
        return f"{before} saturation{f', then {extrema}' if extrema else ''}, then {state.input:.6g}"
    return f"{operator.state_to_json(state)}"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---", *["---:" if len(head) > 2 else "---"] * (len(head) - 1)], *rows]
    return "\n".join(f"| {' | '.join(_cell(cell) for cell in line)} |" for line in lines)


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def _fenced(text: str) -> str:
    return f"```\n{text.strip(chr(10))}\n```"
