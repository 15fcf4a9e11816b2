"""The study of the muscles in the outlook of Zhang and Yip 2017: a McKibben and a super-coiled polymer muscle.

Protocols and models are those of the SMA wire, see `rigs.muscles.characterization`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from bench.campaign import Campaign, Study, StudyResult
from bench.results.figures import Curve, plot_panels
from rigs.muscles.characterization import Characterization, characterize, errors_table, plot_lengths


class Specimen(NamedTuple):
    """One muscle: its name in tables, its rig, and parameters by protocol."""

    title: str
    rig: str
    settings: Mapping[str, Mapping[str, str]]


_CONTRACTS_FAR = {"slack": "-19e-3"}
_SLOW = {"dwell": "60"}
_SLOW_ON_STAGE = {"dwell": "60", "slack": "-10e-3"}

SPECIMENS = {
    "mckibben": Specimen(
        "McKibben muscle", "mckibben", {"force-voltage": _CONTRACTS_FAR, "length-force": _CONTRACTS_FAR}
    ),
    "coiled_polymer": Specimen(
        "super-coiled polymer muscle",
        "coiled-polymer",
        {
            "force-voltage": _SLOW_ON_STAGE,
            "length-voltage": _SLOW,
            "length-force": _SLOW_ON_STAGE,
            "length-verification": _SLOW,
        },
    ),
}
"""Their time constants are 0.3 s and 8 s, so that the latter is given twice the dwell."""

TABLES = tuple(
    errors_table(f"{specimen.title}: errors, average / RMS in % of the range", f"{key}[{{}}]")
    for key, specimen in SPECIMENS.items()
)


def carry_out(campaign: Campaign) -> StudyResult:
    """Characterize both muscles and identify the models.

    The values are errors in percent of the range by muscle, and `fv`, `lv`, `lf` and `verification`.

    Raises
    ------
    BenchError
        If a run did not complete; its record is kept.
    """
    values, figures = {}, []
    for key, specimen in SPECIMENS.items():
        part = campaign.part(key, specimen.rig)
        measured = characterize(part, specimen.settings)
        measured.keep_model(part)
        values[key] = measured.errors_json()
        figures += _draw(part, measured)
    return StudyResult(values, TABLES, tuple(figures))


STUDY = Study(
    None,
    "McKibben and super-coiled polymer muscles: the same protocols and models as for the SMA wire.",
    "Runs force-voltage, length-voltage, length-force and length-verification on the rigs mckibben and "
    "coiled-polymer, and identifies the models. The outlook of Zhang and Yip, 2017.",
    carry_out,
)


def _draw(campaign: Campaign, measured: Characterization) -> list[Path]:
    """Draw the three hysteresis relationships as they were measured."""
    voltages, forces, _ = measured.resting
    paths = [campaign.figure("force-voltage")]
    plot_panels(
        paths[0],
        {"ends held": [Curve("", voltages, forces)]},
        horizontal_label="voltage / V",
        vertical_label="force / N",
        columns=1,
    )
    for kind in ("length-voltage", "length-force"):
        paths.append(campaign.figure(kind))
        chosen = [series for series in measured.series if series.kind == kind]
        plot_lengths(paths[-1], kind, chosen, {"measured": [s.lengths for s in chosen]}, columns=1)
    return paths
