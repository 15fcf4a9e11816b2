"""The study of the SMA wire: characterization, models, verification, and control of length and force.

Follows Zhang and Yip 2017, see `rigs.muscles.characterization`; the control is beyond the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from bench.analysis import (
    Curve,
    Published,
    Reference,
    TargetResults,
    calibrate_run,
    plot_densities,
    plot_errors,
    plot_panels,
    plot_tracking,
)
from bench.batch import ResultTable, RunSeries, Study, StudyResult, reached_targets, true_errors
from bench.identification import predict_series
from bench.models import Density
from bench.rig import load_rig
from rigs.muscles.characterization import (
    KINDS,
    PAPER,
    TITLES,
    Characterization,
    conclude,
    errors_table,
    identify_models,
    json_key,
    measure,
    plot_lengths,
    start_runs,
)
from rigs.muscles.identification import CALIBRATED as CALIBRATED_SIGNALS, FORCE, LENGTH

if TYPE_CHECKING:
    from bench.base import Pending
    from bench.execution import RunResult

Floats = npt.NDArray[np.float64]

CONTROLLERS = ("open-loop-inverse", "proportional-integral", "closed-loop-inverse")
_CALIBRATED_RIG = """
[roles.response]
signal = "length"

[roles.load]
signal = "force"

[roles.force]
signal = "force"
"""
WEIGHTS = Reference(
    "weights of class M1 (OIML R 111-1, table 1)",
    # 5 mg of the lightest, of 100 g, and the scale of the set; both uniform (JCGM 100:2008, 4.3.7).
    uncertainty=4.9e-5 / 3.0**0.5,
    gain_uncertainty=5e-5 / 3.0**0.5,
    interval_days=365,
)
BLOCKS = Reference(
    "gauge blocks of grade 2 (ISO 3650), on a surface set to 2 µm", uncertainty=2e-6 / 3.0**0.5, interval_days=365
)
CALIBRATED = "closed-loop-inverse"
"""Controller that is tried with calibrated sensors as well."""
LOAD_CHANGE = 1.96
"""What is hung on and taken off again in the session with a changing load, N."""
_PROTOCOLS = {
    "fv": "force-voltage",
    "lv": "length-voltage",
    "lf": "length-force",
    "verification": "length-verification",
}
"""Protocols by the keys of `KINDS`."""
_SHOWN = ("two-stage", "summed", "linear")
"""The paper's models, which are drawn."""


class Quantity(NamedTuple):
    """What is controlled: its protocol, name, signal, and the unit in which it is printed, `scale` times SI."""

    protocol: str
    name: str
    signal: str
    unit: str
    scale: float


_LENGTH = Quantity("length-control", "length", LENGTH, "mm", 1e3)
_FORCE = Quantity("force-control", "force", FORCE, "N", 1.0)


class ControlSession(NamedTuple):
    """A task for each controller: its title, what is controlled, and the parameters of the protocol."""

    title: str
    controlled: Quantity
    settings: Mapping[str, str]


CONTROL = {
    "length_4.9N": ControlSession("length under 4.90 N", _LENGTH, {"load": "4.9"}),
    "length_8.82N": ControlSession("length under 8.82 N", _LENGTH, {"load": "8.82"}),
    "length_changing_load": ControlSession(
        "length, changing load", _LENGTH, {"load": "4.9", "change": str(LOAD_CHANGE)}
    ),
    "force": ControlSession("force, ends held", _FORCE, {}),
}

_LENGTH_RMS, _VERIFIED_RMS = (PAPER[kind, "two-stage"].partition(" / ")[2] for kind in ("lv", "verification"))

TABLES = (
    errors_table("errors, average / RMS in % of the range", beside_paper=True),
    ResultTable(
        "control, 40 targets of 20 s each, absolute errors",
        ("", "controller", "max", "RMS", "median"),
        [
            (
                f"{session.title}, {session.controlled.unit}" if controller == CONTROLLERS[0] else "",
                controller,
                *(f"{{control[{key}][{json_key(controller)}][{what}]:.3f}}" for what in ("max", "rms", "median")),
            )
            for key, session in CONTROL.items()
            for controller in CONTROLLERS
        ],
    ),
    ResultTable(
        "accuracy of the same: errors by the readings and true",
        ("", "controller", "RMS", "true RMS", "true max"),
        [
            (
                f"{session.title}, {session.controlled.unit}" if controller == CONTROLLERS[0] else "",
                controller,
                *(f"{{{entry}[{what}]:.3f}}" for what in ("rms", "true_rms", "true_max")),
            )
            for key, session in CONTROL.items()
            for controller, entry in (
                *((name, f"control[{key}][{json_key(name)}]") for name in CONTROLLERS),
                (f"{CALIBRATED}, calibrated", f"calibrated[{key}]"),
            )
        ],
        "Errors by the readings are repeatability. True ones are those of length and force behind the readings, of "
        "sensors with the systematic errors of their data sheets (docs/reference/sensors.md). Calibrated by gauge "
        "blocks and weights, the length is accurate to {calibration[length]:.4f} mm, the force to "
        "{calibration[force]:.4f} N (standard uncertainties).",
    ),
)


VERDICT = (
    f"identification: RMS {{lv[two_stage][rms]:.1f}} % of the range, two-stage (paper: {_LENGTH_RMS})",
    f"validation: RMS {{verification[two_stage][rms]:.1f}} % of the range, two-stage (paper: {_VERIFIED_RMS})",
    "tracking: RMS {control[length_4.9N][closed_loop_inverse][rms]:.3f} mm, length, closed loop (paper: not stated)",
)


def carry_out(campaign: RunSeries) -> StudyResult:
    """Run the paper's experiments and the control beyond it, and identify the models.

    The values are errors in percent of the range by `fv`, `lv`, `lf` and `verification`, and those of `control` in
    `units`. Raises BenchError if a run did not complete; its record is kept.
    """
    characterizing = start_runs(campaign)
    calibrated = campaign.part("calibrated", campaign.rig)
    calibrating = {name: calibrated.start(f"calibration-{name}", {}) for name in ("position", "load")}
    calibrations = {
        CALIBRATED_SIGNALS[signal]: calibrate_run(calibrating[name].result().folder, signal, reference)
        for name, signal, reference in (("position", LENGTH, BLOCKS), ("load", FORCE, WEIGHTS))
    }
    calibrated.rig = calibrated.calibrated_rig(calibrations, _CALIBRATED_RIG)
    recharacterizing = start_runs(calibrated, verified=False)
    # Loaded while they run.
    truth = true_quantities(campaign.rig)
    measured = measure(characterizing)
    identified = identify_models(measured, campaign.folder)
    # The sessions wait for the first model; the others are identified beside them.
    first = next(identified)

    def start(series: RunSeries, session: ControlSession, controller: str) -> Pending[RunResult]:
        common = {"model": str(series.folder / "two-stage.json"), "sequence_seed": str(campaign.seed + 1)}
        return series.start(session.controlled.protocol, {"controller": controller, **session.settings, **common})

    runs = {
        key: {controller: start(campaign, session, controller) for controller in CONTROLLERS}
        for key, session in CONTROL.items()
    }
    next(identify_models(measure(recharacterizing), calibrated.folder))
    calibrated_runs = {key: start(calibrated, session, CALIBRATED) for key, session in CONTROL.items()}
    found = conclude(campaign, characterizing, measured, dict([first, *identified]))
    figures = _draw(campaign, found)
    reached = {
        key: {
            controller: reached_targets(campaign.conclude(run), CONTROL[key].controlled.signal)
            for controller, run in entry.items()
        }
        for key, entry in runs.items()
    }
    figures += _draw_control(campaign, reached)
    return StudyResult(
        {
            **found.errors_json(),
            "kkt": {
                json_key(name): max(certificate.kkt_residual for certificate in model.certificates.values())
                for name, model in found.models.items()
            },
            "control": {
                key: {
                    json_key(controller): _errors(campaign.conclude(run), CONTROL[key].controlled, truth)
                    for controller, run in entry.items()
                }
                for key, entry in runs.items()
            },
            "calibrated": {
                key: _errors(calibrated.conclude(run), CONTROL[key].controlled, truth, calibrated=True)
                for key, run in calibrated_runs.items()
            },
            "calibration": {
                quantity.name: calibrations[quantity.name].uncertainty * quantity.scale
                for quantity in (_LENGTH, _FORCE)
            },
            "units": {key: session.controlled.unit for key, session in CONTROL.items()},
        },
        TABLES,
        tuple(figures),
        VERDICT,
    )


PUBLISHED = tuple(
    Published(
        _PROTOCOLS[kind],
        f"{KINDS[kind][0]}: {TITLES[model]}, average / RMS error",
        value,
        "% of the range",
        KINDS[kind][1],
    )
    for (kind, model), value in PAPER.items()
)
"""What the paper states: errors of all runs of a characterization together."""

STUDY = Study(
    "sma",
    "SMA wire: three-dimensional hysteresis, its models, and control of length and force by the complete inverse.",
    "Runs force-voltage, length-voltage, length-force and length-verification, identifies the paper's models, and "
    "brings length and force to 40 targets with each controller. Zhang and Yip, Three-dimensional hysteresis "
    "modeling of robotic artificial muscles with application to shape memory alloy actuators, 2017.",
    carry_out,
    PUBLISHED,
    (
        "bench.models.kernels.inverse_kernels",
        "bench.models.kernels.stream_kernels",
        "bench.models.kernels.actuator_kernels",
        "sim_devices.plants._sma_kernels",
        "sim_devices.instruments._flintec_kernels",
        "sim_devices.transducers._imperfect_kernels",
    ),
)


def true_quantities(rig: str, overrides: Mapping[str, str] | None = None) -> Mapping[str, Callable[[Floats], Floats]]:
    """Return by signals what gives the quantities behind readings of an emulated rig, but for noise.

    There is none for a rig with another laboratory.
    """
    # Here, as `bench list` reads the names of the studies.
    from rigs.muscles.laboratory import MuscleLaboratorySettings
    from sim_devices.transducers.data_sheets import LOAD_CELL, POSITION

    settings = load_rig(rig, overrides).laboratory_settings
    if not isinstance(settings, MuscleLaboratorySettings):
        return {}
    return {
        LENGTH: settings.characteristic_of("position_sensor", POSITION, settings.rest_position).quantities,
        FORCE: settings.characteristic_of("force_sensor", LOAD_CELL).quantities,
    }


def _errors(
    run: RunResult,
    controlled: Quantity,
    truth: Mapping[str, Callable[[Floats], Floats]],
    *,
    calibrated: bool = False,
) -> dict[str, float]:
    raw = reached_targets(run, controlled.signal)
    results = reached_targets(run, CALIBRATED_SIGNALS[controlled.signal]) if calibrated else raw
    summary = results.summary()
    behind = truth.get(controlled.signal)
    true = np.full_like(raw.outputs, np.nan) if behind is None else behind(raw.outputs)
    found = {
        **{key: summary[key] for key in ("max", "rms", "median")},
        **true_errors(true - results.targets),
    }
    return {key: value * controlled.scale for key, value in found.items()}


def _draw(campaign: RunSeries, measured: Characterization) -> list[Path]:
    voltages, forces, _ = measured.resting
    models = {name: found for name, found in measured.models.items() if name in _SHOWN}
    names = {title: name for name, title in TITLES.items()}
    fitted = {TITLES[name]: forces - models[name].residuals["force-voltage"] for name in ("two-stage", "linear")}
    paths = [
        campaign.draw(
            "figure-06-force-voltage",
            plot_panels,
            {title: [Curve("", voltages, values)] for title, values in {"measured": forces, **fitted}.items()},
            horizontal_label="voltage / V",
            vertical_label="force / N",
            columns=3,
            measured=("measured",),
            names=names,
        )
    ]
    for name, kind in (("figure-07-length-voltage", "length-voltage"), ("figure-08-length-force", "length-force")):
        chosen = [series for series in measured.series if series.kind == kind]
        modelled = {
            TITLES[which]: [predict_series(found.model, s) for s in chosen] for which, found in models.items()
        }
        lengths = {"measured": [s.lengths for s in chosen], **modelled}
        paths.append(campaign.draw(name, plot_lengths, kind, chosen, lengths))
    two_stage = models["two-stage"]
    densities = two_stage.model.densities()
    # The columns of each fit begin with the cells of its density.
    swept = [
        two_stage.certificates[stage].swept[: _cells(density)]
        for stage, density in zip(("first", "second"), densities, strict=True)
    ]
    paths.append(campaign.draw("figure-09-densities", plot_densities, densities, swept))
    for panel, kind in (("a", "length-voltage"), ("b", "length-force")):
        residuals = {TITLES[which]: found.residuals[kind] * 1e3 for which, found in models.items()}
        paths.append(
            campaign.draw(
                f"figure-10{panel}-errors-{kind}", plot_errors, residuals, error_label="error / mm", names=names
            )
        )
    paths.append(
        campaign.draw(
            "figure-11-verification",
            plot_errors,
            {
                TITLES[which]: np.concatenate(
                    [s.lengths - predict_series(found.model, s) for s in measured.verification]
                )
                * 1e3
                for which, found in models.items()
            },
            error_label="error / mm",
            inputs=(np.concatenate([s.voltages for s in measured.verification]), "voltage / V"),
            names=names,
        )
    )
    return paths


def _cells(density: Density) -> int:
    return int(np.count_nonzero(np.isfinite(density.values)))


def _draw_control(campaign: RunSeries, reached: Mapping[str, Mapping[str, TargetResults]]) -> list[Path]:
    paths = []
    for key, results in reached.items():
        _, name, _, unit, scale = CONTROL[key].controlled
        paths.append(
            campaign.draw(
                f"control-{key.replace('_', '-')}",
                plot_tracking,
                results[CONTROLLERS[-1]].targets * scale,
                {controller: each.outputs * scale for controller, each in results.items()},
                output_label=f"{name} / {unit}",
                error_label=f"error / {unit}",
            )
        )
    return paths
