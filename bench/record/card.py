"""The page about a run for people."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime
from typing import Any

from pydantic import ValidationError

from bench.base import counted, format_duration, prefixed
from bench.rig import Interlock


def run_card(meta: Mapping[str, Any]) -> str:
    """Return a run's metadata as a Markdown page, for the dashboard; see `card_rows`."""
    lines = [
        f"# {meta['rig_title']}",
        "",
        f"**{meta['protocol']}** on **{meta['rig']}**: {meta['protocol_summary']}",
        "",
        "| | |",
        "|---|---|",
    ]
    return "\n".join([*lines, *(f"| {name} | {text} |" for name, text in card_rows(meta).items())])


def card_rows(meta: Mapping[str, Any]) -> dict[str, str]:
    """Return what a run was, from its metadata: a text by its name.

    `missing_rows` in the metadata, a text, says what its record lacks. What has no value is left out, as the
    seed of a run that was imported.
    """
    units = meta.get("units", {})
    started = datetime.fromisoformat(meta["epoch"]).isoformat(sep=" ", timespec="seconds")
    return {
        **({"incomplete": meta["missing_rows"]} if "missing_rows" in meta else {}),
        "run": meta["run"],
        "operator": meta["operator"],
        "started": f"{started} ({meta['clock']} clock)",
        **_expected(meta),
        **({} if meta["seed"] is None else {"seed": str(meta["seed"])}),
        **{f"device {name}": identity for name, identity in meta["devices"].items()},
        **{
            f"parameter {name}": _shown(value, units.get(name, ""))
            for name, value in meta["parameters"].items()
            if value not in (None, "") and name not in meta.get("without_slot", ())
        },
        **({"git": str(meta["git"])} if meta["git"] else {}),
    }


def _shown(value: Any, unit: str) -> str:  # noqa: ANN401 - anything that JSON can hold
    if isinstance(value, Mapping):
        texts = {name: _shown(part, "") for name, part in value.items()}
        nested = {name for name, part in value.items() if isinstance(part, Mapping)}
        return ", ".join(f"{name} ({text})" if name in nested else f"{name} {text}" for name, text in texts.items())
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return text if unit in ("", "1") else f"{text} {unit}"


def _expected(meta: Mapping[str, Any]) -> dict[str, str]:
    """Return the rows about what was expected of the run: its rehearsal if there was one, else its plan."""
    rehearsal, planned = meta.get("rehearsal"), meta["plan"]
    if rehearsal is None:
        steps = counted(planned["steps"], "step")
        if planned.get("complete", True):
            return {"planned": f"{steps}, {_between(planned['seconds'], planned.get('at_most'))}"}
        known = f"{steps}, {format_duration(planned['seconds'])}"
        return {"planned": f"unknown, as readings decide; {known} up to the first that does"}
    length = f"{counted(rehearsal['steps'], 'step')}, {format_duration(rehearsal['seconds'])}"
    if (most := rehearsal["at_most"]) is not None:
        length += f", at most {format_duration(most)}"
    margins = [
        f"{name} {prefixed(each['margin'], each['unit'], 3)}"
        for name, each in rehearsal["extremes"].items()
        if each["margin"] is not None
    ]
    rows = {f"rehearsed on {rehearsal['twin']}": length}
    if margins:
        rows["least margins"] = ", ".join(margins)
    return rows


def _between(seconds: float, most: float | None) -> str:
    """Return a time that lies between two bounds."""
    least = format_duration(seconds)
    return least if most is None or most - seconds < 1.0 else f"{least} to {format_duration(most)}"


def steps_of(meta: Mapping[str, Any], carried_out: int) -> str:
    """Return how many steps a run has carried out, such as `3 of 4 steps` if their number was known before it."""
    expected = expected_steps(meta)
    return counted(carried_out, "step") if expected is None else f"{carried_out} of {counted(expected, 'step')}"


def expected_steps(meta: Mapping[str, Any]) -> int | None:
    """Return how many steps a run was expected to have; None where that was not known before it."""
    if (rehearsal := meta.get("rehearsal")) is not None:
        return int(rehearsal["steps"])
    planned = meta["plan"]
    return int(planned["steps"]) if planned.get("complete", True) else None


def interlocks_of(meta: Mapping[str, Any]) -> list[Interlock]:
    """Return the interlocks that watched a run; none where the record does not say, or of another version."""
    found = []
    for table in (meta.get("rig_content") or {}).get("interlocks", ()):
        with suppress(ValidationError):
            found.append(Interlock.model_validate(table))
    return found
