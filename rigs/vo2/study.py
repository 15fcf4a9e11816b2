"""The study of the VO2-coated microcantilever: characterization, identification, validation, and tracking.

J. Zhang, E. Merced, N. Sepúlveda, X. Tan, *Modeling and Inverse Compensation of Nonmonotonic Hysteresis in
VO2-Coated Microactuators*, IEEE/ASME Transactions on Mechatronics, 2013; here "Zhang et al. 2013".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from bench.analysis import (
    FEWEST_ROWS,
    ColumnNames,
    Dataset,
    FitOptions,
    FollowingResult,
    IdentifiedFile,
    Published,
    Reference,
    TargetResults,
    calibrate_run,
    errors_text,
    following_result,
    identify_model,
    plot_densities,
    plot_errors,
    plot_fit,
    plot_tracking,
    predict,
    read_dataset,
    transients_of,
)
from bench.base import ConfigurationError, DataError
from bench.batch import ResultTable, RunSeries, Study, StudyResult, reached_targets, true_errors
from bench.identification import measure_errors
from bench.models import MemoryCurve
from bench.record import Record
from bench.rig import load_rig
from rigs.vo2.curvature import CantileverCurvature, deflection_to_curvature

if TYPE_CHECKING:
    from bench.base import Pending
    from bench.execution import RunResult

Floats = npt.NDArray[np.float64]

INPUT = "tec_temperature"
OUTPUT = "curvature"

SESSION_OFFSET = 0.2
"""Between the temperatures of film and plate in the validation session, K; its sign alternates with the seed."""

TRACKING_OFFSET = 0.12
"""The same in the tracking sessions, K."""

DEFLECTION = "psd_position"
TIP_ANGLE = "tip_angle"
"""The calibrated signal."""
_CALIBRATED_RIG = f"""
[derived.{OUTPUT}]
source = "{TIP_ANGLE}"
"""
GONIOMETER = Reference(
    "goniometer of 0.01°, mirror parallel to the chip to 0.01°",
    # Zero within a division, and the scale within a division over 45°: uniform (JCGM 100:2008, 4.3.7).
    uncertainty=0.01 / math.sqrt(3.0),
    gain_uncertainty=2.2e-4 / math.sqrt(3.0),
    interval_days=365,
    unit="°",
)

PROPOSED = "preisach-nonmonotonic"
PERIODS = (60, 200)
"""Periods of the sine that is followed, s."""


class PaperModel(NamedTuple):
    """One of the models: its title, its name and options here, and the paper's largest errors, 1/m.

    The errors are those of section IV-B, Figs. 5, 7, 9 and 10; None for a model that the paper does not have.
    """

    title: str
    model: str
    options: Mapping[str, Any]
    identification: float | None = None
    validation: float | None = None


MODELS = {
    "nonmonotonic": PaperModel(
        "proposed model", PROPOSED, {"levels": 20, "plane": (30.0, 70.0), "reference": 20.0}, 46.8, 108.1
    ),
    # The paper's has no penalty.
    "signed": PaperModel(
        "signed Preisach",
        "preisach-signed",
        {"levels": 20, "plane": (21.0, 84.0), "smoothing": 0.0, "ridge": 0.0},
        80.3,
        108.8,
    ),
    # The paper compares cells of 2.0 K with cells of 3.15 K; these are of 2.0 K.
    "signed_same_cells": PaperModel(
        "signed Preisach, same cells",
        "preisach-signed",
        {"levels": 32, "plane": (20.0, 84.0), "smoothing": 0.0, "ridge": 0.0},
    ),
    "polynomial": PaperModel("polynomial, degree 12", "polynomial", {"degree": 12}, 483.0, 478.1),
}

CONTROLLERS = {
    "open_loop_inverse": ("open-loop inverse", "78", "26.7"),
    "polynomial": ("polynomial look-up", "734.2", "320.6"),
    "integral": ("integral", "–", "–"),
    "integral_equal_time": ("integral, time of latched", "–", "–"),
    "closed_loop_inverse": ("closed-loop inverse", "–", "–"),
    "latched": ("latched", "–", "–"),
}
"""Title, and the paper's largest and RMS error, 1/m (section V-B). With - for _ the keys are names of controllers,
but for the one of equal time."""

CALIBRATED = ("open_loop_inverse", "closed_loop_inverse", "latched")
"""Those that are tried with a calibrated detector as well."""

EQUAL_TIME = "integral_equal_time"
"""Integral action with as many seconds a target as the slowest controller took in the same study."""

FOLLOWERS = ("open_loop_inverse", "integral", "closed_loop_inverse")

PARAMETERS = {
    "c0": ("1026.7", "1/m"),
    "k0": ("2.8", "1/(m K)"),
    "k1": ("4.3", "1/(m K)"),
    "κ−": ("-20", "1/m"),
    "κ+": ("1828", "1/m"),
    "κ min": ("-75", "1/m"),
    "κ max": ("1836", "1/m"),
}
"""The paper's parameters of the proposed model, and their units."""

TABLES = (
    *(
        ResultTable(
            title,
            ("model", "paper max", "bench max", "bench RMS"),
            [
                (
                    model.title,
                    "–" if (paper := getattr(model, kind)) is None else f"{paper:g}",
                    f"{{{kind}[{key}][max]:.1f}}",
                    f"{{{kind}[{key}][rms]:.1f}}",
                )
                for key, model in MODELS.items()
            ],
            note,
        )
        for kind, title, note in (
            ("identification", "identification, errors in 1/m (Figs. 5, 7 and 9)", ""),
            (
                "validation",
                "validation, errors in 1/m (Fig. 10; session offset {session_offset:+g} K)",
                "KKT residuals: " + ", ".join(f"{model.title} {{kkt[{key}]:.0e}}" for key, model in MODELS.items()),
            ),
        )
    ),
    ResultTable(
        "the proposed model's parameters",
        ("", "paper", "bench", "unit"),
        [(name, paper, f"{{parameters[{name}]:.2f}}", unit) for name, (paper, unit) in PARAMETERS.items()],
    ),
    ResultTable(
        "tracking of 60 targets, errors in 1/m (Fig. 12; session offset {tracking_offset:+g} K)",
        ("controller", "paper max", "paper RMS", "max", "RMS", "median", "s/target"),
        [
            (
                *texts,
                *(f"{{tracking[{key}][{what}]:.2f}}" for what in ("max", "rms", "median")),
                f"{{tracking[{key}][seconds_per_target]:.1f}}",
            )
            for key, texts in CONTROLLERS.items()
        ],
        "Integral action is shown in the time of the open-loop inverse, and in that of the slowest controller.",
    ),
    ResultTable(
        "following a modulated sine at 2 Hz, errors in 1/m",
        ("controller", *(f"{what}, {period} s" for period in PERIODS for what in ("max", "RMS", "true RMS"))),
        [
            (
                CONTROLLERS[key][0],
                *(
                    f"{{continuous[period_{period}][{key}][{what}]:.1f}}"
                    for period in PERIODS
                    for what in ("max", "rms", "true_rms")
                ),
            )
            for key in FOLLOWERS
        ],
    ),
    ResultTable(
        "accuracy at the targets, RMS errors in 1/m by the readings and true",
        ("controller", "RMS", "true RMS", "calibrated: RMS", "true RMS", "true max"),
        [
            (
                title,
                *(f"{{tracking[{key}][{what}]:.2f}}" for what in ("rms", "true_rms")),
                *(
                    f"{{calibrated[{key}][{what}]:.2f}}" if key in CALIBRATED else "–"
                    for what in ("rms", "true_rms", "true_max")
                ),
            )
            for key, (title, *_) in CONTROLLERS.items()
        ],
        "Errors by the readings are repeatability. True ones are those of the curvature behind them, of a PSD "
        "with the systematic errors of its data sheet (docs/reference/sensors.md). Calibrated by a mirror on a "
        "goniometer, detector and lever are accurate to {calibration[accuracy]:.2f} 1/m (standard uncertainty).",
    ),
)


VERDICT = (
    "identification: largest error {identification[nonmonotonic][max]:.1f} 1/m, proposed model (paper: 46.8)",
    "validation: largest error {validation[nonmonotonic][max]:.1f} 1/m, another session (paper: 108.1)",
    "tracking: RMS {tracking[open_loop_inverse][rms]:.1f} 1/m, open loop (paper: 26.7)",
)


def carry_out(campaign: RunSeries) -> StudyResult:
    """Run the paper's experiments, identify its models, and track with every controller.

    Raises BenchError if a run did not complete; its record is kept.
    """
    folder = campaign.folder
    sign = 1.0 if campaign.seed % 2 == 0 else -1.0

    def session(
        protocol: str,
        settings: Mapping[str, str],
        offset: float,
        tuning: Mapping[str, str] | None = None,
        series: RunSeries = campaign,
    ) -> Pending[RunResult]:
        overrides = {"emulation.session_offset": str(sign * offset), **(tuning or {})}
        return series.start(protocol, settings, overrides)

    def model_path(name: str) -> str:
        return str(folder / f"{name}.json")

    characterization, validation = (
        session("damped-oscillation", {}, 0.0),
        session("random-validation", {}, SESSION_OFFSET),
    )
    # Loaded while they run.
    truth = true_curvatures(campaign.rig)
    calibrated = campaign.part("calibrated", campaign.rig)
    mirror = calibrated.run("calibration-mirror", {})
    calibration = calibrate_run(mirror.folder, DEFLECTION, GONIOMETER)
    calibrated.rig = calibrated.calibrated_rig({TIP_ANGLE: calibration}, _CALIBRATED_RIG)
    recharacterization = session("damped-oscillation", {}, 0.0, series=calibrated)
    data = _measured(characterization)
    transients = transients_of(data)

    def identified(key: str) -> IdentifiedFile:
        name, options = MODELS[key].model, MODELS[key].options
        found = identify_model(data, name, FitOptions.of(options), transients)
        found.file.save(Path(model_path(key if MODELS[key].validation is None else name)))
        return found

    def tracking(
        key: str, tuning: Mapping[str, str] | None = None, series: RunSeries = campaign
    ) -> Pending[RunResult]:
        controller = "integral" if key == EQUAL_TIME else key.replace("_", "-")
        model = series.folder / f"{'polynomial' if key == 'polynomial' else PROPOSED}.json"
        settings = {"model": str(model), "controller": controller, "sequence_seed": str(campaign.seed + 1)}
        return session("tracking", settings, TRACKING_OFFSET, tuning, series)

    # The sessions wait for these; the others are identified beside them.
    needed = {key: identified(key) for key in ("nonmonotonic", "polynomial")}
    tracking_runs = {key: tracking(key) for key in CONTROLLERS if key != EQUAL_TIME}
    following_runs = {
        (period, key): session(
            "following",
            {"model": model_path(PROPOSED), "controller": key.replace("_", "-"), "period": str(period)},
            TRACKING_OFFSET,
        )
        for period in PERIODS
        for key in FOLLOWERS
    }
    # The last run waits for this one.
    tracking_runs["latched"].hurry()
    again = _measured(recharacterization)
    proposed = MODELS["nonmonotonic"]
    accurate = identify_model(again, proposed.model, FitOptions.of(proposed.options), transients_of(again)).file
    accurate.save(calibrated.folder / f"{PROPOSED}.json")
    campaign.conclude(recharacterization, [accurate])
    calibrated_runs = {key: tracking(key, series=calibrated) for key in CALIBRATED}
    models = {key: needed.get(key) or identified(key) for key in MODELS}
    with Record(validation.result().folder) as record:
        steps = record.steps()
        inputs, outputs = steps[INPUT], steps[OUTPUT]
    predictions = {key: predict(model.file, inputs) for key, model in models.items()}
    figures = _draw_models(campaign, models, inputs, outputs, predictions)
    # The proposed model last: the recording shows its density.
    kept = [found.file for key, found in reversed(models.items()) if MODELS[key].validation is not None]
    for run in (characterization, validation):
        campaign.conclude(run, kept)
    slowest = reached_targets(tracking_runs["latched"].result(), OUTPUT).summary()["seconds_per_target"]
    tracking_runs[EQUAL_TIME] = tracking(
        EQUAL_TIME, {"protocols.tracking.tuning.integral.duration": str(math.ceil(2.0 * slowest) / 2.0)}
    )
    reached = {key: reached_targets(campaign.conclude(run), OUTPUT) for key, run in tracking_runs.items()}
    followed = {key: _followed(campaign.conclude(run)) for key, run in following_runs.items()}

    def errors_of(run: Pending[RunResult]) -> dict[str, float]:
        found, raw = (reached_targets(campaign.conclude(run), signal) for signal in (OUTPUT, DEFLECTION))
        return {**found.summary(), **true_errors(truth(raw.outputs) - found.targets)}

    figures += _draw_control(campaign, reached, followed)
    return StudyResult(
        {
            "session_offset": sign * SESSION_OFFSET,
            "tracking_offset": sign * TRACKING_OFFSET,
            "identification": {key: model.identification.errors.to_json() for key, model in models.items()},
            "validation": {
                key: measure_errors(outputs, predicted).to_json() for key, predicted in predictions.items()
            },
            "kkt": {key: model.identification.certificate.kkt_residual for key, model in models.items()},
            "parameters": _parameters(models["nonmonotonic"].file.operator),
            "tracking": {key: errors_of(run) for key, run in tracking_runs.items()},
            "continuous": {
                f"period_{period}": {
                    key: {**result.summary(), **true_errors(truth(raw.output) - result.reference)}
                    for key in FOLLOWERS
                    for result, raw in (
                        (followed[period, key], _followed(following_runs[period, key].result(), DEFLECTION)),
                    )
                }
                for period in PERIODS
            },
            "calibrated": {key: errors_of(run) for key, run in calibrated_runs.items()},
            "calibration": {
                "accuracy": math.radians(calibration.uncertainty) / _beam(campaign.rig),
                "coefficients": len(calibration.coefficients),
            },
        },
        TABLES,
        tuple(figures),
        VERDICT,
    )


PUBLISHED = (
    *(
        Published(
            protocol,
            f"{model.title}, largest error",
            f"{largest:g}",
            "1/m",
            source,
            ("models", model.model, "max"),
        )
        for model in MODELS.values()
        for protocol, largest, source in (
            ("damped-oscillation", model.identification, "section IV-B, Figs. 5, 7 and 9"),
            ("random-validation", model.validation, "section IV-B, Fig. 10"),
        )
        if largest is not None
    ),
    *(
        Published("damped-oscillation", f"proposed model, {name}", value, unit, "section IV-B")
        for name, (value, unit) in PARAMETERS.items()
    ),
    *(
        Published(
            "tracking",
            f"{title}, {words} error",
            value,
            "1/m",
            "section V-B, Fig. 12",
            ("tracking", key),
            {"controller": controller.replace("_", "-")},
        )
        for controller, (title, *values) in CONTROLLERS.items()
        for (key, words), value in zip((("max", "largest"), ("rms", "RMS")), values, strict=True)
        if value != "–"
    ),
)
"""What the paper states, beside what runs of the rig measure."""

STUDY = Study(
    "vo2",
    "VO2 microactuator: characterization, identification, validation and tracking, beside the paper's tables.",
    "Runs damped-oscillation, identifies the paper's three models and a signed one of equal cells, validates them in "
    "a session with an offset, and "
    "tracks 60 targets and a modulated sine with each controller. Zhang et al., Modeling and inverse compensation of "
    "nonmonotonic hysteresis in VO2-coated microactuators, 2013.",
    carry_out,
    PUBLISHED,
    (
        "bench.models.kernels.inverse_kernels",
        "bench.models.kernels.stream_kernels",
        "bench.models.kernels.actuator_kernels",
        "sim_devices.plants._vo2_kernels",
        "sim_devices.transducers._imperfect_kernels",
    ),
)


def _measured(run: Pending[RunResult]) -> Dataset:
    return read_dataset([run.result().folder], ColumnNames(INPUT, OUTPUT), at_least=FEWEST_ROWS)


def _followed(run: RunResult, signal: str = OUTPUT) -> FollowingResult:
    with Record(run.folder) as record:
        result = following_result(record, signal)
    if result is None:
        raise DataError(f"{run.folder}: has no reference")
    return result


def true_curvatures(rig: str) -> Callable[[Floats], Floats]:
    """Return what gives the curvatures behind readings (m) of an emulated detector; nan of any other."""
    # Here, as `bench list` reads the names of the studies.
    from rigs.vo2.laboratory import VO2LaboratorySettings
    from sim_devices.plants.grid import changed
    from sim_devices.plants.vo2 import VO2Parameters
    from sim_devices.transducers.data_sheets import PSD

    settings = load_rig(rig).laboratory_settings
    if not isinstance(settings, VO2LaboratorySettings):
        return lambda readings: np.full_like(readings, np.nan)
    plant = changed(VO2Parameters(), settings.plant)
    sensor = settings.characteristic_of("psd", PSD)

    def truth(readings: Floats) -> Floats:
        deflections = sensor.quantities(readings)
        return deflection_to_curvature(deflections, plant.beam_length, plant.residual_curvature)

    return truth


def _beam(rig: str) -> float:
    """Return the length of the beam by the rig file, m."""
    derived = load_rig(rig).derived[OUTPUT]
    if not isinstance(derived, CantileverCurvature):
        raise ConfigurationError(f"{rig}: derived.{OUTPUT}: expected kind = 'cantilever-curvature'")
    return derived.length


def _parameters(operator: Any) -> dict[str, float]:  # noqa: ANN401 - the non-monotonic model
    low, high = float(operator.levels[0]), float(operator.levels[-1])
    values = (
        operator.bias,
        *operator.reversible.coefficients.tolist(),
        operator.value(MemoryCurve.from_negative_saturation(low)),
        operator.value(MemoryCurve.from_positive_saturation(high)),
        *operator.output_range(),
    )
    return dict(zip(PARAMETERS, values, strict=True))


def _draw_models(
    campaign: RunSeries,
    models: Mapping[str, IdentifiedFile],
    inputs: Floats,
    outputs: Floats,
    predictions: Mapping[str, Floats],
) -> list[Path]:
    temperature, curvature, error = "temperature / °C", "curvature / (1/m)", "error / (1/m)"
    proposed = models["nonmonotonic"]
    residuals = {key: model.identification.residuals for key, model in models.items()}
    names = {model.title: model.model for model in MODELS.values()}
    title = MODELS["nonmonotonic"].title
    paths = [
        campaign.draw(
            "figure-05a-loops",
            plot_fit,
            proposed.inputs,
            proposed.outputs,
            {title: proposed.outputs - residuals["nonmonotonic"]},
            horizontal_label=temperature,
            output_label=curvature,
            error_label=error,
            titles={title: errors_text(proposed.identification.errors, "1/m")},
            names=names,
        )
    ]
    for errors_figure, density_figure, key in (
        ("figure-05b-error-proposed", "figure-06-density-proposed", "nonmonotonic"),
        ("figure-07-error-signed", "figure-08-density-signed", "signed"),
        ("figure-09-error-polynomial", None, "polynomial"),
    ):
        paths.append(
            campaign.draw(
                errors_figure,
                plot_errors,
                {MODELS[key].title: residuals[key]},
                error_label=error,
                names=names,
                published=_published([key], "identification"),
            )
        )
        if density_figure is not None:
            swept = models[key].coverage
            paths.append(
                campaign.draw(
                    density_figure,
                    plot_densities,
                    models[key].file.operator.densities(),
                    None if swept is None else swept.swept,
                )
            )
    paths.append(
        campaign.draw(
            "figure-10-validation",
            plot_errors,
            {
                MODELS[key].title: outputs - predicted
                for key, predicted in predictions.items()
                if MODELS[key].validation is not None
            },
            error_label=error,
            inputs=(inputs, temperature),
            names=names,
            published=_published(MODELS, "validation"),
        )
    )
    return paths


def _published(keys: Iterable[str], kind: str) -> dict[str, float]:
    """Return the paper's largest errors of its models by their titles, 1/m."""
    found = {MODELS[key].title: getattr(MODELS[key], kind) for key in keys}
    return {title: value for title, value in found.items() if value is not None}


def _draw_control(
    campaign: RunSeries, reached: Mapping[str, TargetResults], followed: Mapping[tuple[int, str], FollowingResult]
) -> list[Path]:
    output, error = "curvature / (1/m)", "error / (1/m)"
    names = {title: key.replace("_", "-") for key, (title, *_) in CONTROLLERS.items()}
    largest = {title: float(value) for title, value, _ in CONTROLLERS.values() if value != "–"}
    paths = []
    for name, keys in (
        ("figure-12-open-loop", ("open_loop_inverse", "polynomial")),
        ("figure-12-closed-loop", ("closed_loop_inverse", "latched")),
    ):
        outputs = {CONTROLLERS[key][0]: reached[key].outputs for key in keys}
        targets = reached[keys[0]].targets
        paths.append(
            campaign.draw(
                name,
                plot_tracking,
                targets,
                outputs,
                output_label=output,
                error_label=error,
                names=names,
                published=largest,
            )
        )
    for period in PERIODS:
        results = {key: followed[period, key] for key in FOLLOWERS}
        times = results["closed_loop_inverse"].times
        paths.append(
            campaign.draw(
                f"following-period-{period}",
                plot_tracking,
                results["closed_loop_inverse"].reference,
                {CONTROLLERS[key][0]: np.interp(times, each.times, each.output) for key, each in results.items()},
                horizontal=times,
                horizontal_label="time / s",
                output_label=output,
                error_label=error,
                names=names,
            )
        )
    return paths
