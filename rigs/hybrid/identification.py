"""Identification of the thermo-piezoelectric hybrid from the runs that characterize it.

The runs are loops at a fixed rate; their samples are in the telemetry. Units are SI; temperatures are in °C and a
positive current heats.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.analysis import (
    WholeIdentification,
    WholeModel,
    only_run,
    propagated,
    quantity_text,
    spread_row,
    uncertain_signals,
)
from bench.base import ConfigurationError, DataError
from bench.identification import (
    DynamicsIdentification,
    Errors,
    Identification,
    ModelFile,
    autocorrelation,
    identify_dynamics,
)
from bench.models import Polynomial, PrandtlIshlinskii
from bench.protocol import LATENESS
from bench.record import Record, Table
from bench.rig import Budget
from rigs.hybrid.model import HybridModel, OrderChoice, choose_order, identify_pi, identify_polynomial
from rigs.hybrid.network_identification import NetworkIdentification, identify_network, room_influence

Floats = npt.NDArray[np.float64]

DEFLECTION, BASE, TIP, WITNESS = "response", "base", "tip", "witness"
"""Slots of the runs whose signals are used."""
CURRENT, VOLTAGE = "coarse_setpoint", "fine_setpoint"
"""Set-points of their slots."""

PROTOCOLS = ("current-steps", "thermomechanical", "piezo-loops", "piezo-step")
"""Protocols of the runs from which a hybrid is identified, in the order of `identify_hybrid`."""

REFERENCE = 22.0
"""Reference of the polynomial, °C: the nominal temperature of the room."""

_UNITS = {
    "seebeck": "V/K",
    "electrical_resistance": "Ω",
    "tec_capacity": "J/K",
    **dict.fromkeys(("tec_resistance", "beam_resistance", "beam_side_resistance", "block_side_resistance"), "K/W"),
}
"""Units of the fitted parameters of the network."""
_DRIFT_PASSES = 64
"""Passes in which operator and parabola are fitted in turn; more change less than the sensor's noise."""


@dataclass(frozen=True)
class HybridIdentification:
    """The model of a hybrid, part by part from a run each, with the evidence for it.

    Attributes
    ----------
    model : HybridModel
        The whole.
    network : NetworkIdentification
        From the steps of the current.
    order : OrderChoice
        RMS of the polynomial of each order, and the order chosen.
    polynomial : Identification
        From the static curve.
    piezo : PiezoIdentification
        From the slow loops of the voltage.
    dynamics : DynamicsIdentification
        From the fast step.
    """

    model: HybridModel
    network: NetworkIdentification
    order: OrderChoice
    polynomial: Identification[Polynomial]
    piezo: PiezoIdentification
    dynamics: DynamicsIdentification


@dataclass(frozen=True)
class PiezoIdentification:
    """The operator of the piezo, its errors, and the voltages (V) and deflections (m) that it was fitted to."""

    operator: PrandtlIshlinskii
    errors: Errors
    voltages: Floats
    deflections: Floats


@dataclass(frozen=True)
class Samples:
    """The samples of one fast loop at a period in s; `names` gives the signal by slot, and by `SLOT_setpoint`.

    In the table by signal name, set-points are those sent after the sample was read.
    """

    table: Table
    period: float
    names: Mapping[str, str] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Floats:
        """Return the samples of a slot, of its set-points, or of a signal."""
        return self.table[self.names.get(name, name)]

    @property
    def times(self) -> Floats:
        """Time from the first sample, s."""
        return np.arange(len(self.table), dtype=np.float64) * self.period


def signal_names(record: Record) -> dict[str, str]:
    """Return the signals of a run by slot, and those of set-points by `SLOT_setpoint`."""
    slots = record.meta.get("slots", {})
    setpoints = {f"{slot}_setpoint": f"{bound['device']}_setpoint" for slot, bound in slots.items()}
    return {**{slot: bound["signal"] for slot, bound in slots.items()}, **setpoints}


def read_loops(run: Path) -> dict[str, Samples]:
    """Return the samples of each fast loop of a run by its label.

    Raises DataError if the run was not completed, has no fast loop or two of one label, or left samples out.
    """
    with Record(run) as record:
        if record.status != "completed":
            raise DataError(f"{run}: the run is {record.status}; a model needs a completed one")
        if LATENESS.name not in [signal.name for signal in record.signals]:
            raise DataError(f"{run}: has no fast loop")
        steps = list(record.step_records())
        ticks, names = record.telemetry(), signal_names(record)
    loops = {}
    for step in steps:
        whole = ticks.ticks_of(step)
        rows = np.isfinite(whole[LATENESS.name])
        if not rows.any():
            continue
        table = Table({name: values[rows] for name, values in whole.columns.items()})
        times = table["t"] - table[LATENESS.name]
        if step.label in loops:
            raise DataError(f"{run}: has two loops {step.label!r}; expected one of each label")
        if len(table) < 2 or np.ptp(periods := np.diff(times)) > 1e-3 * periods.mean():
            raise DataError(f"{run}: the loop {step.label!r} left samples out; a model needs all of them")
        loops[step.label] = Samples(table, float(periods.mean()), names)
    if not loops:
        raise DataError(f"{run}: has no fast loop")
    return loops


def sine_at(samples: Samples, signal: str, frequency: float) -> complex:
    """Return the complex amplitude of a signal at a frequency (Hz), over the last whole periods but the first.

    The first period is left out: it holds the transient.
    """
    period = 1.0 / (frequency * samples.period)
    # A period need not be a whole number of samples.
    periods = math.floor((len(samples.table) + 1) / period) - 1
    if periods < 1:
        raise DataError(f"a sine of {frequency:g} Hz needs at least two periods; the first is left out")
    last = slice(len(samples.table) - round(periods * period), None)
    times, values = samples.times[last], samples[signal][last]
    # Offset and drift are fitted beside the sine.
    angle = 2.0 * np.pi * frequency * times
    columns = np.column_stack([np.cos(angle), np.sin(angle), np.ones_like(times), times - times.mean()])
    cosine, sine, *_ = np.linalg.lstsq(columns, values, rcond=None)[0]
    return complex(sine, cosine)


def bandwidth_of(frequencies: Floats, gains: Floats) -> float:
    """Return the frequency (Hz) at which a gain has fallen by 3 dB from the one at the lowest, between two of them.

    Raises DataError if it has not fallen so far at the highest.
    """
    wanted = gains[0] / np.sqrt(2.0)
    below = np.flatnonzero(gains <= wanted)
    if below.size == 0:
        raise DataError(f"the gain has not fallen by 3 dB up to {frequencies[-1]:g} Hz")
    k = int(below[0])
    # Straight between two points of the Bode plot.
    return float(
        np.exp(np.interp(-np.log(wanted), -np.log(gains[k - 1 : k + 1]), np.log(frequencies[k - 1 : k + 1])))
    )


def identify_hybrid(
    steps: Path,
    static: Path,
    loops: Path,
    step: Path,
    *,
    plays: int = 15,
    network: NetworkIdentification | None = None,
) -> HybridIdentification:
    """Return the model of a hybrid from its four runs.

    Parameters
    ----------
    steps, static, loops, step : Path
        Runs of `current-steps`, `thermomechanical`, `piezo-loops` and `piezo-step`.
    plays : int
        Number of play operators.
    network : NetworkIdentification, optional
        What `network_of` the first run gives, if it is known already.

    Raises
    ------
    DataError
        If a run is of another kind or was not completed, or a part cannot be identified.
    """
    for run, protocol in zip((steps, static, loops, step), PROTOCOLS, strict=True):
        _check_protocol(run, protocol)
    with Record(static) as record:
        if record.status != "completed":
            raise DataError(f"{static}: the run is {record.status}; a model needs a completed one")
        curve, names = record.steps(), signal_names(record)
    fast = read_loop(step)
    network = network_of(steps) if network is None else network
    try:
        rises, deflections = curve[names[TIP]] - REFERENCE, curve[names[DEFLECTION]]
        order = choose_order(rises, deflections)
        polynomial = identify_polynomial(rises, deflections, order.order)
        piezo = identify_piezo(read_loop(loops), plays)
        dynamics = identify_dynamics(fast[VOLTAGE], fast[DEFLECTION], fast.period)
        model = HybridModel(network.network, polynomial.model, piezo.operator, dynamics.model, REFERENCE)
    except ValueError as error:
        raise _unidentified(error) from error
    return HybridIdentification(model, network, order, polynomial, piezo, dynamics)


def network_of(steps: Path) -> NetworkIdentification:
    """Return the thermal network of a run of `current-steps`; raises DataError as `identify_hybrid`."""
    _check_protocol(steps, PROTOCOLS[0])
    currents = read_loop(steps)
    try:
        return identify_network(currents[CURRENT], currents[BASE], currents[TIP], currents.period)
    except ValueError as error:
        raise _unidentified(error) from error


def network_uncertainty(steps: Path, found: NetworkIdentification) -> dict[str, Budget]:
    """Return the budgets of the fitted parameters of a thermal network, from its run of `current-steps`."""
    samples = read_loop(steps)
    base, tip = samples.names[BASE], samples.names[TIP]
    freedom = found.residuals.size - len(found.uncertainties)
    fitted = [name for name in found.uncertainties if name in _UNITS]
    # Residuals that are alike say less than as many that are not.
    alike = autocorrelation(found.residuals)
    wider = math.sqrt((1.0 + alike) / (1.0 - alike))
    with Record(steps) as record:
        signals = uncertain_signals(record)
    nominal = {name: (float(getattr(found.network, name)), _UNITS[name]) for name in fitted}

    def refit(columns: Mapping[str, Floats]) -> Mapping[str, tuple[float, str]]:
        moved = np.column_stack([columns[base] - samples[BASE], columns[tip] - samples[TIP]])
        logarithms = np.tensordot(found.moves, moved, 2).tolist()
        return {
            name: (nominal[name][0] * math.exp(x), _UNITS[name]) for name, x in zip(fitted, logarithms, strict=True)
        }

    spreads = {
        name: [spread_row(wider * found.uncertainties[name], _UNITS[name], freedom, "covariance of the fit")]
        for name in fitted
    }
    if (room := signals.room((base, tip))) is not None:
        shares = room.contribution * room_influence(found, samples[CURRENT], samples.period, room.time or math.inf)
        # Of what has a normal logarithm with that deviation.
        shares = np.exp(0.5 * shares**2) * np.sqrt(np.expm1(shares**2))
        for name, share in zip(fitted, shares.tolist(), strict=True):
            spreads[name].append(replace(room, contribution=share * nominal[name][0]))
    columns = {base: samples[BASE], tip: samples[TIP]}
    return propagated(
        signals, columns, columns, samples.times, nominal, spreads, lambda others: [refit(each) for each in others]
    )


def dynamics_uncertainty(found: DynamicsIdentification) -> dict[str, Budget]:
    """Return the budgets of poles and damping: gain and offset of a sensor have no influence on them."""
    freedom = float(found.residuals.size - len(found.uncertainties))
    return {
        name: Budget(
            name,
            unit,
            getattr(found.model, name),
            (spread_row(found.uncertainties[name], unit, freedom, "covariance of the fit"),),
            freedom,
        )
        for name, unit in (("real_pole", "rad/s"), ("frequency", "rad/s"), ("damping", ""))
    }


def _check_protocol(run: Path, protocol: str) -> None:
    with Record(run) as record:
        if record.meta.get("protocol") != protocol:
            raise DataError(f"{run}: is a run of {record.meta.get('protocol')}; expected one of {protocol}")


def _unidentified(error: ValueError) -> DataError:
    return DataError(f"the hybrid cannot be identified: {error}")


def hybrid_file(found: HybridIdentification, runs: Sequence[Path]) -> ModelFile:
    """Return the model file of a hybrid that was identified from runs."""
    return ModelFile("hybrid", found.model, provenance={"sources": [run.name for run in runs]})


def identify_runs(runs: Mapping[str, Sequence[Path]], _: Path | None, options: Mapping[str, Any]) -> WholeModel:
    """Return the model of a hybrid from its runs by protocol; raises as `identify_hybrid`."""
    folders = [only_run(runs, name, "hybrid") for name in PROTOCOLS]
    plays = options.get("plays", 15)
    if not isinstance(plays, int) or not 1 <= plays <= 200:
        raise ConfigurationError(f"-o plays={plays}: expected a whole number from 1 to 200")
    found = identify_hybrid(*folders, plays=plays)
    network, dynamics, piezo = found.network, found.dynamics, found.piezo.errors
    uncertain = network_uncertainty(folders[0], network) | dynamics_uncertainty(dynamics)
    rows = (
        ("network, RMS of base and tip", f"{network.base.rms:.3f} and {network.tip.rms:.3f} K"),
        *((name.replace("_", " "), quantity_text(budget)) for name, budget in uncertain.items()),
        (f"polynomial of order {found.order.order}, RMS", f"{found.polynomial.errors.rms * 1e6:.3f} µm"),
        (f"{plays} plays, RMS", f"{piezo.rms_percent:.2f} % of {piezo.span * 1e6:.1f} µm"),
        ("polynomial and plays", "uncertainty not stated"),
    )
    summary = {
        "network_rms_K": {"base": network.base.rms, "tip": network.tip.rms},
        "polynomial_order": found.order.order,
        "polynomial_rms_um": found.polynomial.errors.rms * 1e6,
        "prandtl_ishlinskii_rms_percent": piezo.rms_percent,
        "poles_rad_s": {"real": dynamics.model.real_pole, "resonance": dynamics.model.frequency},
        "damping": dynamics.model.damping,
        "uncertainty": {name: budget.to_json() for name, budget in uncertain.items()},
    }
    return WholeModel(hybrid_file(found, folders), "hybrid", rows, summary)


FROM_RUNS = WholeIdentification(PROTOCOLS, identify_runs, {"plays": "number of play operators, 1 to 200; 15"})


def identify_piezo(samples: Samples, plays: int = 15) -> PiezoIdentification:
    """Return the Prandtl-Ishlinskii operator of slow loops.

    Thermal drift is modelled as a parabola in time and subtracted.
    """
    # A sample is read before its set-point is sent.
    applied = np.append(0.0, samples[VOLTAGE][:-1])
    deflections = samples[DEFLECTION]
    middle = samples.times - samples.times.mean()
    columns = np.column_stack([middle, middle**2])
    drift = np.zeros_like(deflections)
    for _ in range(_DRIFT_PASSES):
        found = identify_pi(applied, deflections - drift, plays=plays, maximum=float(np.abs(applied).max()))
        rest = found.residuals - found.residuals.mean()
        drift = drift + columns @ np.linalg.lstsq(columns, rest, rcond=None)[0]
    return PiezoIdentification(found.model, found.errors, applied, deflections - drift)


def read_loop(run: Path) -> Samples:
    """Return the samples of the one fast loop of a run.

    Raises DataError as `read_loops`, or if there are several.
    """
    loops = read_loops(run)
    if len(loops) != 1:
        raise DataError(f"{run}: expected one fast loop, found {len(loops)}")
    return next(iter(loops.values()))
