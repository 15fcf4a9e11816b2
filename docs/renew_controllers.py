"""Put the tables of two campaigns of controllers into the pages that show them, each between its marks.

`python docs/renew_controllers.py recordings` after the campaigns examples/campaign-robustness.toml and
examples/campaign-following.toml. A table that their folders lack stays as it is.
"""

from __future__ import annotations

import csv
import statistics
import sys
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from renew_measured import put

REFERENCE = Path(__file__).parent / "reference"
CONTROLLERS = {
    "open-loop-inverse": "open-loop inverse",
    "closed-loop-inverse": "closed-loop inverse",
    "fine-step": "",
}
"""Titles of controllers that differ from their names."""
Row = Mapping[str, str]


class Shown(NamedTuple):
    """A table of a campaign: what is shown of its runs, in what unit of so many SI units, and what varies."""

    result: str
    unit: str
    size: float
    varies: str
    nominal: str = ""


FILM = "as identified, film 0.12 K warmer"
PLANT, SENSOR = "emulation.plant", "emulation.displacement_sensor"
ROBUSTNESS = {
    "film-tracking": Shown("tracking_rms", "1/m", 1.0, PLANT, FILM),
    "film-following": Shown("following_rms", "1/m", 1.0, PLANT, FILM),
    "wire-length": Shown("tracking_rms", "µm", 1e-6, PLANT, "as identified, time constant 5 s"),
    "wire-force": Shown("tracking_rms", "mN", 1e-3, PLANT, "as identified, time constant 5 s"),
    "braid-length": Shown("tracking_rms", "µm", 1e-6, PLANT, "as identified, time constant 0.3 s"),
    "braid-force": Shown("tracking_rms", "mN", 1e-3, PLANT, "as identified, time constant 0.3 s"),
    "coil-length": Shown("tracking_rms", "µm", 1e-6, PLANT, "as identified, time constant 8 s"),
    "coil-force": Shown("tracking_rms", "mN", 1e-3, PLANT, "as identified, time constant 8 s"),
    "beam-plants": Shown("loop_true_hold_rms", "nm", 1e-9, PLANT, "as identified"),
    "beam-rooms": Shown("loop_true_hold_rms", "nm", 1e-9, PLANT, "room of 25 °C"),
    "beam-sensors": Shown("loop_hold_rms", "nm", 1e-9, SENSOR, "ideal"),
    "beam-sensors true": Shown("loop_true_hold_rms", "nm", 1e-9, SENSOR, "ideal"),
    "beam-step": Shown("loop_true_hold_rms", "nm", 1e-9, SENSOR, "ideal"),
    "beam-step-plants": Shown("loop_true_hold_rms", "nm", 1e-9, PLANT, "as identified"),
}
"""Tables by the table of the campaign file; docs/reference/robustness.md shows some of them."""
CHANGES = {
    "loop_damping": "plate damped by {} (overshoot of 9 %)",
    "session_offset": "film {} K warmer",
    "major_width": {5.2: "loops 1.3 times as wide", 1.4: "loops 0.35 times as wide"},
    "major_spread": "spread of the switching temperatures × 0.7",
    "wander_sd": "wander of the film × 3",
    "cold_expansion": "thermal expansion × 0.1",
    "transition_curvature": "transition 10 % larger",
    "time_constant": "time constant {} s",
    "pressure_gain": "pressure × 0.9",
    "friction_coefficient": "friction of the braid × 2",
    "bladder_stiffness": "bladder 1.3 times as stiff",
    "friction": "friction × 2",
    "arm_stiffness": "relaxation × 2",
    "piezo_gain": "piezo gain × 0.8",
    "hysteresis_share": "share of the hysteresis × 1.3",
    "creep_share": "creep × 2",
    "convection": "convection × 1.3",
    "contact_resistance": "thermal resistance to the beam × 1.5",
    "resonance_offset": {0.03: "resonance 3 % higher", -0.03: "resonance 3 % lower"},
    "ambient_temperature": "room of {} °C",
    "nonlinearity": "nonlinear by 0.05 % of its range",
    "gain_error": "gain + 0.2 %",
    "latency": "latency of {} s",
    "lag": "lag of {} s",
}
"""Titles of what was changed, by the number of the plant or of the sensor."""


def table(shown: Shown, rows: Sequence[Row]) -> str:
    """Return a table with a row for each change and a column for each controller: median / worst of the sessions."""
    column = f"{shown.result} [{_si(shown.unit)}]"
    cells: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        cells.setdefault(row[shown.varies], {}).setdefault(row.get("controller", ""), []).append(row)
    lines = [
        (
            [title(change, shown.nominal)],
            {name: _cell(runs, column, shown.size) for name, runs in by_controller.items()},
        )
        for change, by_controller in cells.items()
    ]
    return _by_controller([shown.unit], lines)


def silent(shown: Shown, rows: Sequence[Row]) -> list[str]:
    """Return controller and change where the median error is beyond twice the nominal one, and a run is silent."""
    column = f"{shown.result} [{_si(shown.unit)}]"
    cells: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if row["status"] == "completed":
            cells.setdefault((row.get("controller", ""), row[shown.varies]), []).append(row)
    errors = {key: statistics.median(float(run[column]) for run in runs) for key, runs in cells.items()}
    return [
        f"{name}, {title(change, shown.nominal)}"
        for (name, change), error in errors.items()
        if error > 2.0 * errors.get((name, "{}"), error) and not all(run["reason"] for run in cells[name, change])
    ]


def title(change: str, nominal: str) -> str:
    """Return what a row is called; a change is the TOML text of a table."""
    changed = tomllib.loads(f"changed = {change}")["changed"]
    if not changed:
        return nominal
    name, value = next(iter(changed.items()))
    known = CHANGES[name]
    return known.format(value) if isinstance(known, str) else known[value]


def following(rows: Sequence[Row]) -> str:
    """Return the table of followers: a row for each rig and reference, a column for each controller."""
    sizes = {"1/m": 1.0, "µm": 1e-6, "nm": 1e-9}
    cells: dict[tuple[str, str, str], dict[str, list[Row]]] = {}
    for row in rows:
        if not row.get("controller"):
            continue
        unit = {"vo2": "1/m", "hybrid": "nm"}.get(row["rig"], "µm")
        reference = f"sine, {float(row['period [s]']):g} s" if row.get("period [s]") else "file"
        cells.setdefault((row["rig"], unit, reference), {}).setdefault(row["controller"], []).append(row)
    lines = [
        (
            [f"`{rig}`, {unit}", reference],
            {name: _cell(runs, f"following_rms [{_si(unit)}]", sizes[unit]) for name, runs in by_controller.items()},
        )
        for (rig, unit, reference), by_controller in cells.items()
    ]
    return _by_controller(["rig", "reference"], lines)


def _by_controller(heads: Sequence[str], lines: Sequence[tuple[list[str], dict[str, str]]]) -> str:
    """Return a table of lines: their titles, and a cell for each controller."""
    names = list(dict.fromkeys(name for _, cells in lines for name in cells))
    whole = [
        [*heads, *(CONTROLLERS.get(name, name) or "fine step" for name in names)],
        ["---"] * (len(heads) + len(names)),
        *([*titles, *(cells[name] for name in names)] for titles, cells in lines),
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in whole)


def _cell(runs: Sequence[Row], column: str, size: float) -> str:
    """Return median / worst of the runs that were completed, and how many were stopped or warned."""
    completed = [run for run in runs if run["status"] == "completed"]
    stopped, warned = len(runs) - len(completed), sum(bool(run["reason"]) for run in completed)
    if not completed:
        return "stopped"
    values = [float(run[column]) / size for run in completed]
    text = " / ".join(f"{float(f'{value:.3g}'):g}" for value in (statistics.median(values), max(values)))
    for count, what in ((stopped, "stopped"), (warned, "warned")):
        if count:
            text += f", {what}" if count == len(runs) else f", {count} {what}"
    return text


def _si(unit: str) -> str:
    return {"µm": "m", "nm": "m", "mN": "N"}.get(unit, unit)


def _rows(folder: Path) -> list[Row]:
    file = folder / "results.csv"
    if not file.exists():
        return []
    with file.open(encoding="utf-8", newline="") as lines:
        return list(csv.DictReader(lines))


def main(recordings: Path) -> None:
    """Renew the pages from the folders of the campaigns."""
    rows, tables = _rows(recordings / "campaign-robustness"), {}
    for name, shown in ROBUSTNESS.items():
        if chosen := [row for row in rows if row["table"] == name.partition(" ")[0]]:
            tables[name] = table(shown, chosen)
            for each in silent(shown, chosen):
                print(f"{name}: {each}: beyond twice the nominal error, and not every run was stopped or warned")
    put(REFERENCE / "robustness.md", tables)
    if rows := _rows(recordings / "campaign-following"):
        put(REFERENCE / "predictive-control.md", {"following": following(rows)})


if __name__ == "__main__":
    main(Path(sys.argv[1]))
