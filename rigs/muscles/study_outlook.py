"""The study of the muscles in the outlook of Zhang and Yip 2017: a McKibben and a super-coiled polymer muscle.

Protocols and models are those of the SMA wire, see `rigs.muscles.characterization`.
"""

from __future__ import annotations

from pathlib import Path

from bench.analysis import Curve, plot_panels
from bench.batch import RunSeries, Study, StudyResult
from rigs.muscles.characterization import Characterization, characterize, errors_table, plot_lengths, start_runs

MUSCLES = {
    "mckibben": ("McKibben muscle", "mckibben"),
    "coiled_polymer": ("super-coiled polymer muscle", "coiled-polymer"),
}
"""Name in tables, and rig, by the key in the JSON."""

TABLES = tuple(
    errors_table(f"{title}: errors, average / RMS in % of the range", f"{key}[{{}}]")
    for key, (title, _) in MUSCLES.items()
)


VERDICT = tuple(
    f"{part}, {rig}: RMS {{{key}[{kind}][two_stage][rms]:.1f}} % of the range (paper: not stated)"
    for key, (_, rig) in MUSCLES.items()
    for part, kind in (("identification", "lv"), ("validation", "verification"))
)


def carry_out(campaign: RunSeries) -> StudyResult:
    """Characterize both muscles and identify the models.

    The values are errors in percent of the range by muscle, and `fv`, `lv`, `lf` and `verification`. Raises
    BenchError if a run did not complete; its record is kept.
    """
    values, figures = {}, []
    parts = {key: campaign.part(key, rig) for key, (_, rig) in MUSCLES.items()}
    runs = {key: start_runs(part) for key, part in parts.items()}
    for key, part in parts.items():
        measured = characterize(part, runs[key])
        values[key] = measured.errors_json()
        figures += _draw(part, measured)
    return StudyResult(values, TABLES, tuple(figures), VERDICT)


STUDY = Study(
    None,
    "McKibben and super-coiled polymer muscles: the same protocols and models as for the SMA wire.",
    "Runs force-voltage, length-voltage, length-force and length-verification on the rigs mckibben and "
    "coiled-polymer, and identifies the models. The outlook of Zhang and Yip, 2017.",
    carry_out,
    kernels=(
        "bench.models.kernels.actuator_kernels",
        "bench.models.kernels.stream_kernels",
        "sim_devices.plants._friction_kernels",
        "sim_devices.instruments._flintec_kernels",
        "sim_devices.transducers._imperfect_kernels",
    ),
)


def _draw(campaign: RunSeries, measured: Characterization) -> list[Path]:
    """Draw the three hysteresis relationships as they were measured."""
    voltages, forces, _ = measured.resting
    paths = [
        campaign.draw(
            "force-voltage",
            plot_panels,
            {"ends held": [Curve("", voltages, forces)]},
            horizontal_label="voltage / V",
            vertical_label="force / N",
            columns=1,
            measured=("ends held",),
        )
    ]
    for kind in ("length-voltage", "length-force"):
        chosen = [series for series in measured.series if series.kind == kind]
        lengths = {"measured": [s.lengths for s in chosen]}
        paths.append(campaign.draw(kind, plot_lengths, kind, chosen, lengths, columns=1))
    return paths
