"""Identification of the models among voltage, force and length from the runs that characterize a muscle.

A run of `force-voltage` gives the force at resting length, runs of `length-voltage`, `length-force` and
`length-verification` give one series a load or voltage. Only the readings with the label `sample` count.
Everything is in V, N and m.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from bench.analysis import (
    TransientRecording,
    WholeIdentification,
    WholeModel,
    identify_dynamics,
    identify_transients,
    noise_of,
    only_run,
    read_transients,
)
from bench.base import DataError
from bench.identification import (
    SMOOTHING,
    CoupledIdentification,
    Errors,
    FirstStage,
    ModelFile,
    Series,
    identify_first_stage,
    identify_linear,
    identify_second_stage,
    identify_summed,
    measure_series,
)
from bench.models import IdentifiedDynamics, Model, PrandtlIshlinskii, TwoStage
from bench.record import Record
from protocols.muscles.parts import CONDITIONING, SAMPLE

Floats = npt.NDArray[np.float64]

VOLTAGE = "supply_setpoint"
VOLTAGE_READING = "supply_voltage"
FORCE = "load_cell_force"
LENGTH = "wire_end_position"
CALIBRATED = {FORCE: "force", LENGTH: "length"}
"""Derived signals that take the place of these where a rig has them."""

UNITS = ("V", "N", "m")

RESTING_PROTOCOLS = ("force-voltage",)
LENGTH_PROTOCOLS = ("length-voltage", "length-force", "length-verification")

ModelName = Literal["two-stage", "two-stage-prandtl-ishlinskii", "summed", "linear"]
MODELS: tuple[ModelName, ...] = ("two-stage", "two-stage-prandtl-ishlinskii", "summed", "linear")

_COLD_WEIGHT = 100.0
"""Weight of the sample of the cold muscle: the second stage starts from the force there."""
_SMOOTHING = (0.0, *SMOOTHING)
"""Of the densities of each model, chosen by the errors on blocks of the characterization left out of the fit."""
_PLAYS = 15


class Resting(NamedTuple):
    """Force over the voltage with the ends held: V and N, each of shape (N,), and the force of the resets, N."""

    voltages: Floats
    forces: Floats
    pretension: float


def read_resting(run: Path) -> Resting:
    """Return what a run of `force-voltage` measured.

    Raises DataError if it is no such run, or was not completed.
    """
    voltages, forces, _ = np.concatenate(_samples(run, RESTING_PROTOCOLS)).T
    with Record(run) as record:
        return Resting(voltages, forces, float(record.meta["parameters"]["pretension"]))


def read_series(run: Path) -> list[Series]:
    """Return what a run of `length-voltage`, `length-force` or `length-verification` measured.

    A series at one voltage is one over the force, any other is one under a load, which is the mean of the forces that
    were measured. Raises DataError if it is no such run, or was not completed.
    """
    series = []
    for group in _samples(run, LENGTH_PROTOCOLS):
        voltages, forces, lengths = group.T
        if np.ptp(voltages) == 0.0 and len(voltages) > 1:
            series.append(Series.at_voltage(float(voltages[0]), forces, lengths))
        else:
            series.append(Series.under_load(float(forces.mean()), voltages, lengths))
    return series


def identify_resting(resting: Resting) -> FirstStage:
    """Identify the first stage of both models of two stages, which needs no lengths.

    Raises DataError if the data do not determine it.
    """
    try:
        return _first_stage(resting)
    except ValueError as error:
        raise DataError(f"the force over the voltage cannot be identified: {error}") from error


def _first_stage(resting: Resting) -> FirstStage:
    voltages, forces, _ = resting
    weights = np.ones(voltages.size)
    weights[0] = _COLD_WEIGHT
    limits = 0.0, float(voltages.max())
    return identify_first_stage(
        voltages, forces, weights=weights, voltage_range=limits, smoothing=_SMOOTHING, units=UNITS
    )


def identify_muscle(
    name: ModelName, resting: Resting, series: Sequence[Series], first: FirstStage | None = None
) -> CoupledIdentification[Any]:
    """Identify a model among voltage, force and length.

    Parameters
    ----------
    name : str
        `two-stage`, `summed` or `linear` (Zhang and Yip 2017, eqs. 6, 8 and 9), with 20 discretization levels; or
        `two-stage-prandtl-ishlinskii`, with 15 plays in place of the second Preisach operator. The roughness
        penalty of each density is chosen by cross-validation on these data.
    resting : Resting
        Force at resting length.
    series : sequence of Series
        Lengths.
    first : FirstStage, optional
        What `identify_resting` gives, if it is known already.

    Raises
    ------
    DataError
        If the data do not determine the model.
    """
    voltages, forces, pretension = resting
    force_limit = max(float(each.max()) for each in (forces, *(s.forces for s in series)))
    common: Any = {
        "force_limit": force_limit,
        "pretension": pretension,
        "units": UNITS,
        "smoothing": _SMOOTHING,
    }
    limits = 0.0, float(voltages.max())
    try:
        if name == "summed":
            return identify_summed(series, voltage_range=limits, **common)
        if name == "linear":
            return identify_linear(voltages, forces, series, voltage_range=limits, **common)
        second = _plays(force_limit) if name == "two-stage-prandtl-ishlinskii" else None
        return identify_second_stage(first or _first_stage(resting), series, operator=second, **common)
    except ValueError as error:
        raise DataError(f"model {name} cannot be identified: {error}") from error


def identify_muscle_dynamics(model: Model, force_run: Path, length_runs: Sequence[Path]) -> IdentifiedDynamics | None:
    """Identify how a muscle follows its voltage, from the transients of a run with held ends.

    There the force has least error of the model: its first stage alone counts. A run under weights tells the noise of
    the length, and the cycles of the voltage before the samples whether it is heat or a pressure that lags. None of a
    model that is not of two stages, or if the run has no quick readings between its steps.
    """
    if model.kind != TwoStage.kind:
        return None
    first = cast("TwoStage", model).first
    recording = read_transients(force_run, VOLTAGE_READING, _named(force_run, FORCE))
    if recording is None:
        return None
    samples, swings = _parts(recording, SAMPLE), _parts(recording, CONDITIONING)
    found = identify_dynamics(identify_transients(samples), [first.evaluate], ("voltage", "force"), swings)
    under_weights = next((run for run in length_runs if protocol_of(run) == "length-voltage"), None)
    if under_weights is None:
        return found
    lengths = read_transients(under_weights, VOLTAGE_READING, _named(under_weights, LENGTH))
    if lengths is None:
        return found
    return replace(found, noise={**found.noise, "length": noise_of(lengths, lengths.responded)})


def _parts(recording: TransientRecording, label: str) -> list[TransientRecording]:
    """Return the part of a recording from the first to the last step of a label, or none."""
    steps = [step for step in recording.steps if step.label == label]
    return [recording.within(steps[0].started, steps[-1].finished)] if steps else []


def muscle_file(
    name: str,
    found: CoupledIdentification[Any],
    sources: Sequence[Path],
    dynamics: IdentifiedDynamics | None,
) -> ModelFile:
    """Return the model file of an identification from runs."""
    return ModelFile(
        name,
        found.model,
        dynamics=dynamics,
        provenance={
            "sources": [source.name for source in sources],
            "errors": {kind: errors_json(errors) for kind, errors in found.errors.items()},
            "kkt": {stage: certificate.kkt_residual for stage, certificate in found.certificates.items()},
            "smoothing": dict(found.smoothing),
        },
    )


def identify_runs(
    name: ModelName, registered: str, runs: Mapping[str, Sequence[Path]], test: Path | None, _: Mapping[str, Any]
) -> WholeModel:
    """Return a model of a muscle from its runs by protocol, registered under a name.

    Raises DataError if one was not completed, or they do not determine the model.
    """
    force_run = only_run(runs, *RESTING_PROTOCOLS, registered)
    length_runs = [run for protocol in runs if protocol != RESTING_PROTOCOLS[0] for run in runs[protocol]]
    if not length_runs:
        raise DataError(f"model {registered} needs runs of length-voltage or length-force")
    series = [one for run in length_runs for one in read_series(run)]
    found = identify_muscle(name, read_resting(force_run), series)
    errors = dict(found.errors)
    if test is not None:
        errors["verification"] = measure_series(found.model, read_series(test))
    kkt = {stage: fit.kkt_residual for stage, fit in found.certificates.items()}
    rows = [(kind, f"average {e.average_percent:.2f} %, RMS {e.rms_percent:.2f} %") for kind, e in errors.items()]
    rows += [(f"smoothing, {stage}", f"{weight:.0e}") for stage, weight in found.smoothing.items()]
    rows += [(f"KKT residual, {stage}", f"{residual:.1e}") for stage, residual in kkt.items()]
    dynamics = identify_muscle_dynamics(found.model, force_run, length_runs)
    return WholeModel(
        muscle_file(registered, found, [force_run, *length_runs], dynamics),
        f"{registered} from {len(series)} series of lengths",
        tuple(rows),
        {
            "model": registered,
            "series": len(series),
            "errors": {kind: errors_json(e) for kind, e in errors.items()},
            "kkt": kkt,
            "smoothing": dict(found.smoothing),
        },
    )


def _from_runs(name: ModelName, registered: str) -> WholeIdentification:
    protocols = ("force-voltage", "length-voltage", "length-force")
    return WholeIdentification(protocols, partial(identify_runs, name, registered), takes_test=True)


TWO_STAGE = _from_runs("two-stage", "two-stage")
TWO_STAGE_PRANDTL_ISHLINSKII = _from_runs("two-stage-prandtl-ishlinskii", "two-stage-prandtl-ishlinskii")
SUMMED = _from_runs("summed", "summed")
COUPLED_LINEAR = _from_runs("linear", "coupled-linear")


def protocol_of(run: Path) -> str:
    """Return the protocol of a run; empty if its record does not say it."""
    with Record(run) as record:
        return str(record.meta.get("protocol", ""))


def errors_json(errors: Errors) -> dict[str, float]:
    """Return average and RMS errors in percent of the range, for programs."""
    return {"average": errors.average_percent, "rms": errors.rms_percent}


def signal_of(record: Record, name: str) -> str:
    """Return the calibrated signal in place of a sensor's, `FORCE` or `LENGTH`, if a run has it."""
    calibrated = CALIBRATED[name]
    return calibrated if calibrated in (signal.name for signal in record.signals) else name


def _named(run: Path, name: str) -> str:
    with Record(run) as record:
        return signal_of(record, name)


def _samples(run: Path, protocols: Collection[str]) -> list[Floats]:
    """Return voltages, forces and lengths of each series of a run of one of some protocols, each of shape (N, 3)."""
    with Record(run) as record:
        protocol = record.meta.get("protocol")
        if protocol not in protocols:
            raise DataError(f"{run}: is a run of {protocol}; expected one of {' or '.join(protocols)}")
        if record.status != "completed":
            raise DataError(f"{run}: the run is {record.status}; a model needs a completed one")
        names = [signal.name for signal in record.signals]
        missing = [name for name in (VOLTAGE, FORCE, LENGTH) if name not in names]
        if missing:
            raise DataError(f"{run}: has no signal {', '.join(missing)}; it has: {', '.join(names)}")
        places = [names.index(name) for name in (VOLTAGE, signal_of(record, FORCE), signal_of(record, LENGTH))]
        # A reset, a phase of its own, stands between any two series, also of the same load.
        groups = [
            [[step.values[i] for i in places] for step in steps if step.label == SAMPLE]
            for _, steps in groupby(record.step_records(), key=lambda step: step.phase)
        ]
    series = [np.array(group) for group in groups if group]
    if not series:
        raise DataError(f"{run}: has no readings with the label {SAMPLE!r}")
    return series


def _plays(force_limit: float) -> PrandtlIshlinskii:
    """Return plays for the length over the force less that of the first stage, before the fit."""
    return PrandtlIshlinskii(
        force_limit * np.arange(_PLAYS) / _PLAYS,
        np.zeros(_PLAYS),
        input_range=(-force_limit, force_limit),
        input_unit="N",
        output_unit="m",
    )
