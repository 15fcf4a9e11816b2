"""The muscles of the outlook of Zhang and Yip 2017, a McKibben and a super-coiled polymer one, beside the wire.

See `bench.reproduce.sma`, whose protocols and models these are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from bench.clock import Stopwatch
from bench.reproduce.campaign import Campaign, print_end
from bench.reproduce.sma import Characterization, characterize, errors_table
from bench.results.figures import Curve, plot_panels
from bench.results.report import export_run


@dataclass(frozen=True)
class Muscle:
    """One muscle: its key in the JSON, its name in tables, its rig, and parameters by protocol."""

    key: str
    title: str
    rig: str
    settings: Mapping[str, Mapping[str, str]]


_CONTRACTS_FAR = {"slack": "-19e-3"}
_SLOW = {"dwell": "60"}
_SLOW_ON_STAGE = {"dwell": "60", "slack": "-10e-3"}

MUSCLES = (
    Muscle(
        "mckibben", "McKibben muscle", "mckibben", {"force-voltage": _CONTRACTS_FAR, "length-force": _CONTRACTS_FAR}
    ),
    Muscle(
        "coiled_polymer",
        "super-coiled polymer muscle",
        "coiled-polymer",
        {
            "force-voltage": _SLOW_ON_STAGE,
            "length-voltage": _SLOW,
            "length-force": _SLOW_ON_STAGE,
            "length-verification": _SLOW,
        },
    ),
)
"""Their time constants are 0.3 s and 8 s, so that the latter is given twice the dwell."""


def reproduce_muscles(*, seed: int, out: Path, live: bool, console: Console) -> dict[str, Any]:
    """Characterize both muscles, identify the models, and print a table each.

    Parameters
    ----------
    seed : int
        Seed of the emulated laboratories' noise and of the random voltages.
    out : Path
        Folder for runs, models and figures.
    live : bool
        Whether to serve the live view.
    console : Console
        Where to print.

    Returns
    -------
    dict
        The result for programs: errors in percent of the range by muscle, and `fv`, `lv`, `lf`, `verification`.

    Raises
    ------
    BenchError
        If a run did not complete; its record is kept.
    """
    stopwatch = Stopwatch()
    folder = out / f"reproduce-muscles-seed-{seed}"
    result: dict[str, Any] = {"seed": seed}
    laboratory, recordings, figures = 0.0, [], []
    for muscle in MUSCLES:
        campaign = Campaign(muscle.rig, folder / muscle.key, seed, live, console)
        settings = {key: dict(values) for key, values in muscle.settings.items()}
        settings.setdefault("length-verification", {})["sequence_seed"] = str(seed + 1)
        measured = characterize(campaign, settings)
        result[muscle.key] = measured.errors_json()
        console.print(errors_table(measured, {}, f"{muscle.title}: errors, average / RMS in % of the range"))
        measured.keep_model(campaign)
        recordings += [str(export_run(run.folder, "rrd", None)[0]) for run in campaign.runs]
        figures += [str(path) for path in _draw(measured, campaign.folder / "figures")]
        laboratory += campaign.laboratory_seconds
    result |= {
        "laboratory_seconds": laboratory,
        "wall_seconds": stopwatch.seconds(),
        "folder": str(folder),
        "figures": figures,
        "recordings": recordings,
    }
    print_end(result, console)
    return result


def _draw(measured: Characterization, folder: Path) -> list[Path]:
    """Draw the three hysteresis relationships as they were measured."""
    voltages, forces, _ = measured.resting
    paths = [folder / f"{name}.png" for name in ("force-voltage", "length-voltage", "length-force")]
    plot_panels(
        paths[0],
        {"ends held": [Curve("", voltages, forces)]},
        horizontal_label="voltage / V",
        vertical_label="force / N",
        columns=1,
    )
    for path, kind in zip(paths[1:], ("length-voltage", "length-force"), strict=True):
        over_voltage = kind == "length-voltage"
        plot_panels(
            path,
            {
                "measured": [
                    Curve(
                        f"{s.forces[0]:.2f} N" if over_voltage else f"{s.voltages[0]:g} V",
                        s.voltages if over_voltage else s.forces,
                        s.lengths * 1e3,
                    )
                    for s in measured.series
                    if s.kind == kind
                ]
            },
            horizontal_label="voltage / V" if over_voltage else "force / N",
            vertical_label="length / mm",
            columns=1,
        )
    return paths
