"""The study of the thermo-piezoelectric hybrid: its parts, the model of the whole, and control.

M. Rakotondrabe and I. A. Ivan, *Development and Dynamic Modeling of a New Hybrid Thermopiezoelectric Microactuator*,
IEEE Transactions on Robotics 26(6), 2010. The paper leaves the controller as future work.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from bench.analysis import Published, Reference, calibrate_run, errors_text, plot_fit, plot_tracking
from bench.batch import ResultTable, RunSeries, Study, StudyResult
from bench.identification import measure_errors
from bench.record import Record
from rigs.hybrid.design import Design
from rigs.hybrid.evaluation import (
    HELD,
    HOLD,
    Tracked,
    displacement_characteristic,
    fine_step,
    tracked,
)
from rigs.hybrid.identification import (
    BASE,
    CURRENT,
    DEFLECTION,
    REFERENCE,
    TIP,
    VOLTAGE,
    WITNESS,
    HybridIdentification,
    Samples,
    bandwidth_of,
    hybrid_file,
    identify_hybrid,
    network_of,
    read_loop,
    read_loops,
    signal_names,
    sine_at,
)
from rigs.hybrid.model import PUBLISHED_DYNAMICS

if TYPE_CHECKING:
    from bench.base import Pending
    from bench.execution import RunResult
    from bench.rig import Calibration

Floats = npt.NDArray[np.float64]

WITNESSED = "hybrid-witness"
"""Rig of the loops whose errors count: the same instruments, and a sensor that sees the deflection itself."""

FREQUENCIES = (0.001, 0.002, 0.003, 0.004, 0.005, 0.006, 0.008)
SWEEP_AMPLITUDE = 0.02
"""Amplitude of the current in the measurement of the bandwidth, A: small, as the gain depends on the current."""

CONTROLLERS = ("hybrid", "hybrid-low-pass", "thermal-feedback", "open-loop")
REFERENCES = ("staircase", "ramp", "sine-on-ramp")
SETTLING = 5.0
"""Time from the start from which a reference counts, s."""
RESOLUTION_HOLD = 180.0
"""Length of the one hold that the resolution of the thermal part is taken from, s."""
RESOLUTION_TIME = 60.0
"""Time at its end that counts, s: the transient of the start has gone by then."""
RESONANCES = (-0.03, 0.0, 0.03)
"""Deviation of the plant's resonance from the identified one in the fine steps, as a share."""
ROOM_STEP = 5.0
"""Step of the room temperature, K."""
ROOM_STEP_TIME = 30.0
"""Its time, s."""

SENSITIVITIES = Design().thermal_sensitivity, Design().piezo_sensitivity
"""Deflection per rise (m/K) and per voltage (m/V), from geometry."""


def _part(name: str, value: str, unit: str, paper: str = "–") -> tuple[str, str, str, str]:
    return name, paper, value, unit


def _actuator(name: str, bandwidth: str, *papers: str) -> tuple[str, ...]:
    values = bandwidth, f"{{table_3[{name}][resolution_nm]:.1f}} nm", f"{{table_3[{name}][range_um]:.0f}} µm"
    return (name, *(cell for pair in zip(papers, values, strict=True) for cell in pair))


REFERENCE_UNCERTAINTY = 1e-9
"""Standard uncertainty of the interferometer, m."""
_CALIBRATED_RIG = """
[roles.response]
signal = "displacement"
"""

_PARTS = tuple((part, what) for part in ("hold", "move") for what in ("RMS", "max"))


def _errors_row(title: str, entry: str, true: str = "") -> tuple[str, ...]:
    return (title, *(f"{{{entry}[{true}{part}_{what.lower()}_nm]:.1f}}" for part, what in _PARTS))


TABLES = (
    ResultTable(
        "the parts",
        ("", "paper", "bench", "unit"),
        (
            _part("thermal sensitivity f_s, from geometry", "{geometry[thermal_um_per_K]:.3f}", "µm/K"),
            _part("piezo sensitivity d_p, from geometry", "{geometry[piezo_um_per_V]:.4f}", "µm/V"),
            _part("thermal bandwidth", "{thermal[bandwidth_mHz]:.2f}", "mHz", "4"),
            _part(
                "swing at -0.1 and 0.1 A (Fig. 13)",
                "{thermal[swing_um][up]:.0f} and {thermal[swing_um][down]:.0f}",
                "µm",
                "> 100",
            ),
            _part("network, RMS of the base (Fig. 13)", "{network[base_rms_K]:.3f}", "K"),
            _part(
                "polynomial of order {polynomial_order}, RMS (Fig. 14)", "{polynomial_rms_um:.3f}", "µm", "order 4"
            ),
            _part("15 plays, RMS (Fig. 15)", "{prandtl_ishlinskii_rms_percent:.2f}", "%"),
            _part(
                "D(s), real pole and resonance (Fig. 16)",
                "{dynamics[poles_Hz][0]:.1f} and {dynamics[poles_Hz][1]:.1f}",
                "Hz",
                " and ".join(
                    f"{pole / (2 * np.pi):.1f}"
                    for pole in (PUBLISHED_DYNAMICS.real_pole, PUBLISHED_DYNAMICS.frequency)
                ),
            ),
            _part(
                "D(s), DC gain over the static one", "{dynamics[dc_gain]:.3f}", "1", f"{PUBLISHED_DYNAMICS.gain:.3f}"
            ),
            _part("D(s), overshoot", "{dynamics[overshoot_percent]:.1f}", "%", "26.5"),
            _part("model of the whole by itself (eq. 22), RMS", "{whole[rms_um]:.2f} of {whole[span_um]:.0f}", "µm"),
        ),
        "The emulated plant has the paper's D(s): that its poles and its overshoot are found again shows that the "
        "identification works, and is no evidence for the paper's numbers.",
    ),
    ResultTable(
        "Table III: bandwidth (-3 dB), resolution (RMS error of a hold), range",
        ("actuator", "paper", "bench", "paper", "bench", "paper", "bench"),
        (
            _actuator("piezo", "{table_3[piezo][bandwidth_Hz]:.0f} Hz", "> 600 Hz", "< 100 nm", "10 µm"),
            _actuator("thermal", "{thermal[bandwidth_mHz]:.1f} mHz", "4 mHz", "1 µm", "> 100 µm"),
            _actuator(
                "hybrid",
                "{thermal[bandwidth_mHz]:.1f} mHz and {table_3[hybrid][bandwidth_Hz]:.0f} Hz",
                "4 mHz and > 600 Hz",
                "< 100 nm",
                "> 110 µm",
            ),
        ),
        f"The resolution of the thermal part is that of the last {RESOLUTION_TIME:g} s of a hold of "
        f"{RESOLUTION_HOLD:g} s, without the transient of a move.",
    ),
    ResultTable(
        f"six moves at 3 µm/s over {{control[range_um]:.0f}} µm, errors in nm; of each hold of {HOLD:g} s the "
        f"last {HELD:g} s",
        ("controller", *(f"{part} {what}" for part, what in _PARTS)),
        [
            *(_errors_row(name, f"controllers[{name}]") for name in CONTROLLERS),
            _errors_row("hybrid, sensor calibrated", "calibrated"),
        ],
        "Errors are those of what the sensor shows, without its noise: repeatability.",
    ),
    ResultTable(
        "true errors of the same in nm: accuracy",
        ("controller", *(f"{part} {what}" for part, what in _PARTS)),
        [
            *(_errors_row(name, f"controllers[{name}]", "true_") for name in CONTROLLERS),
            _errors_row("hybrid, sensor calibrated", "calibrated", "true_"),
        ],
        "They are those of the tip, with a sensor that has the systematic errors of its data sheet "
        "(docs/reference/sensors.md). Calibrated against an interferometer it is accurate to "
        "{calibration[accuracy_nm]:.1f} nm.",
    ),
    ResultTable(
        "hybrid controller, errors in nm",
        ("reference", "RMS", "max", "true RMS", "true max"),
        [
            *(
                (name, *(f"{{references[{name}][{what}_nm]:.1f}}" for what in ("rms", "max", "true_rms", "true_max")))
                for name in REFERENCES
            ),
            (f"hold, room steps by {ROOM_STEP:g} K", "–", "{room_step_nm:.1f}", "–", "{true_room_step_nm:.1f}"),
        ],
    ),
    ResultTable(
        "fine step of 5 µm at 20 kHz",
        (
            "resonance off by",
            "settling (2 %) / ms",
            "overshoot / %",
            "RMS afterwards / nm",
            "true RMS / nm",
        ),
        [
            (
                f"{offset:+.0%}",
                *(
                    f"{{fine_steps[{offset:+.0%}][{what}]:{digits}}}"
                    for what, digits in (
                        ("settling_ms", ".2f"),
                        ("overshoot_percent", ".2f"),
                        ("rms_nm", ".1f"),
                        ("true_rms_nm", ".1f"),
                    )
                ),
            )
            for offset in RESONANCES
        ],
    ),
)


VERDICT = (
    "identification: RMS {prandtl_ishlinskii_rms_percent:.2f} % of the loop, 15 plays (paper: not stated)",
    "validation: RMS {whole[rms_um]:.2f} of {whole[span_um]:.0f} µm, model of the whole (paper: not stated)",
    "tracking: RMS {control[hold_rms_nm]:.1f} nm of a hold, hybrid controller (paper: < 100)",
)


class _Runs(NamedTuple):
    """The runs of the characterization, in their order; the sweep is for the bandwidth."""

    sine: RunResult
    steps: RunResult
    static: RunResult
    loops: RunResult
    step: RunResult
    whole: RunResult
    sweep: RunResult


def _carry_out(campaign: RunSeries) -> StudyResult:
    frequencies = ", ".join(map(str, FREQUENCIES))
    sweep = {"amplitude": str(SWEEP_AMPLITUDE), "frequencies": frequencies, "periods": "3"}
    started = [
        campaign.start(protocol, settings)
        for protocol, settings in (
            ("current-sine", {}),
            ("current-steps", {}),
            ("thermomechanical", {}),
            ("piezo-loops", {}),
            ("piezo-step", {}),
            ("hybrid-excitation", {}),
            ("current-sine", sweep),
        )
    ]
    # Identified beside the runs that it does not need.
    _, steps, static, loops, step, _, _ = started
    network = network_of(campaign.conclude(steps).folder)
    sources = [campaign.conclude(run).folder for run in (steps, static, loops, step)]
    found = identify_hybrid(*sources, network=network)
    model = campaign.folder / "hybrid.json"
    hybrid_file(found, sources).save(model)

    tracking_runs = {name: _start(campaign, model, {"controller": name, "hold": f"{HOLD:g}"}) for name in CONTROLLERS}
    thermal_run = _start(
        campaign,
        model,
        {"controller": "thermal-feedback", "reference": "hold", "hold": f"{RESOLUTION_HOLD:g}"},
    )
    slow = {"speed": "0.5e-6", "low": "-10e-6", "high": "10e-6", "hold": "10"}
    reference_runs = {
        name: _start(campaign, model, {"reference": name, **({"hold": "15"} if name == "staircase" else slow)})
        for name in REFERENCES
    }
    room_run = _start(
        campaign,
        model,
        {"reference": "hold", "hold": "120"},
        {"emulation.ambient_step": str(ROOM_STEP), "emulation.ambient_step_time": str(ROOM_STEP_TIME)},
    )
    fine_runs = {
        f"{offset:+.0%}": campaign.start(
            "fine-step",
            {"model": str(model), "witness": "true"},
            {"emulation.resonance_offset": str(offset)},
            rig=WITNESSED,
        )
        for offset in RESONANCES
    }
    sweep_run = campaign.start("calibration-displacement", {"sweeps": "1"}, rig=WITNESSED)
    # A long run needs its result; left to the end, it would go on alone.
    sweep_run.hurry()
    runs = _Runs(*(campaign.conclude(run) for run in started))
    figures = list(_draw_models(campaign, found, runs))
    calibration = _calibrated(campaign.conclude(sweep_run).folder)
    calibrated = campaign.calibrated_rig({"displacement": calibration}, _CALIBRATED_RIG, rig=WITNESSED)
    calibrated_run = _start(campaign, model, {"controller": "hybrid", "hold": f"{HOLD:g}"}, rig=calibrated)
    calibrated_run.hurry()
    sensor = displacement_characteristic(WITNESSED)
    moves = {name: tracked(campaign.conclude(run).folder, sensor) for name, run in tracking_runs.items()}
    calibrated_moves = tracked(campaign.conclude(calibrated_run).folder, sensor, calibration)
    figures += _draw_control(campaign, moves)
    thermal = tracked(campaign.conclude(thermal_run).folder, sensor).shown
    references = {name: tracked(campaign.conclude(run).folder, sensor) for name, run in reference_runs.items()}
    room = tracked(campaign.conclude(room_run).folder, sensor).measures(after=ROOM_STEP_TIME)
    fine = {name: fine_step(campaign.conclude(run).folder, sensor) for name, run in fine_runs.items()}

    values: dict[str, Any] = {
        "geometry": dict(
            zip(("thermal_um_per_K", "piezo_um_per_V"), (value * 1e6 for value in SENSITIVITIES), strict=True)
        ),
        "thermal": _thermal(runs),
        "polynomial_rms_um": found.order.rms[found.order.order - 1] * 1e6,
        "polynomial_order": found.order.order,
        "polynomial_rms_um_by_order": [value * 1e6 for value in found.order.rms],
        "prandtl_ishlinskii_rms_percent": found.piezo.errors.rms_percent,
        "dynamics": _dynamics(found),
        "network": {
            "base_rms_K": found.network.base.rms,
            "tip_rms_K": found.network.tip.rms,
            "bandwidth_mHz": found.model.bandwidth() * 1e3,
        },
        "whole": _validate(found, runs.whole),
        "control": _control(moves["hybrid"], fine),
        "controllers": {name: each.summary() for name, each in moves.items()},
        "calibrated": calibrated_moves.summary(),
        "calibration": {
            "accuracy_nm": calibration.uncertainty * 1e9,
            "repeatability_nm": calibration.repeatability * 1e9,
            "coefficients": len(calibration.coefficients),
        },
        "references": {name: each.measures(after=SETTLING) for name, each in references.items()},
        "room_step_nm": room["max_nm"],
        "true_room_step_nm": room["true_max_nm"],
        "fine_steps": fine,
    }
    resolution = thermal.measures(thermal.times >= thermal.times[-1] - RESOLUTION_TIME)["rms_nm"]
    values["table_3"] = _table_3(values, found, runs.loops, resolution)
    return StudyResult(values, TABLES, tuple(figures), VERDICT)


def _start(
    campaign: RunSeries,
    model: Path,
    settings: Mapping[str, str],
    overrides: Mapping[str, str] | None = None,
    rig: str = WITNESSED,
) -> Pending[RunResult]:
    return campaign.start("hybrid-control", {"model": str(model), "witness": "true", **settings}, overrides, rig=rig)


def _calibrated(sweep: Path) -> Calibration:
    """Return the calibration of the displacement sensor from a sweep beside the witness."""
    with Record(sweep) as record:
        names = signal_names(record)
    interferometer = Reference("interferometer", REFERENCE_UNCERTAINTY, 365, signal=names[WITNESS])
    return calibrate_run(sweep, names[DEFLECTION], interferometer)


def _control(moves: Tracked, fine: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Return the results of the hybrid controller; of the fine steps the worst."""
    summary, tracking = moves.summary(), moves.shown
    return {
        **{key: summary[key] for key in ("hold_rms_nm", "hold_max_nm", "move_rms_nm")},
        "range_um": float(np.ptp(tracking.reference[tracking.held]) * 1e6),
        **{
            f"fine_step_{key}": max(values[key] for values in fine.values())
            for key in ("settling_ms", "overshoot_percent")
        },
    }


def _thermal(runs: _Runs) -> dict[str, Any]:
    deflection = read_loop(runs.steps.folder)[DEFLECTION]
    by_label = read_loops(runs.sweep.folder)
    gains = np.array([abs(sine_at(by_label[f"{f:g} Hz"], DEFLECTION, f)) for f in FREQUENCIES])
    rest = float(deflection[0])
    return {
        "bandwidth_mHz": bandwidth_of(np.array(FREQUENCIES), gains) * 1e3,
        "swing_um": {"up": float(deflection.max() - rest) * 1e6, "down": float(rest - deflection.min()) * 1e6},
    }


def _dynamics(found: HybridIdentification) -> dict[str, Any]:
    dynamics = found.dynamics.model
    top = float(found.piezo.voltages.max())
    # The static operator's response to the same step, from rest.
    static = float(np.ptp(found.model.hysteresis.evaluate([0.0, top])))
    return {
        "poles_Hz": [dynamics.real_pole / (2.0 * np.pi), dynamics.frequency / (2.0 * np.pi)],
        "dc_gain": dynamics.gain * top / static,
        "overshoot_percent": dynamics.overshoot() * 100.0,
        "gain_um_per_V": dynamics.gain * 1e6,
    }


def _validate(found: HybridIdentification, whole: RunResult) -> dict[str, float]:
    """Simulate the whole model open-loop on the run with heat and voltage at once; return the errors, µm."""
    samples = read_loop(whole.folder)
    response = found.model.simulate(
        samples[CURRENT], samples[VOLTAGE], samples.period, float(np.mean(samples[BASE][:1]))
    )
    errors = measure_errors(samples[DEFLECTION] - samples[DEFLECTION][0], response.deflections)
    return {"rms_um": errors.rms * 1e6, "max_um": errors.maximum * 1e6, "span_um": errors.span * 1e6}


def _table_3(
    values: Mapping[str, Any], found: HybridIdentification, loops: RunResult, thermal_nm: float
) -> dict[str, dict[str, float]]:
    """Return bandwidth (Hz), resolution (nm, RMS error of a hold) and range (µm) of the three actuators."""
    fine = found.dynamics.model.bandwidth()
    reach = float(np.ptp(read_loop(loops.folder)[DEFLECTION])) * 1e6
    # Up and down at 0.1 A: the paper's temperature variation of 20 °C.
    heat = sum(values["thermal"]["swing_um"].values())
    rows = {
        "piezo": (fine, values["fine_steps"]["+0%"]["rms_nm"], reach),
        "thermal": (values["thermal"]["bandwidth_mHz"] * 1e-3, thermal_nm, heat),
        "hybrid": (fine, values["control"]["hold_rms_nm"], heat + reach),
    }
    keys = ("bandwidth_Hz", "resolution_nm", "range_um")
    return {name: dict(zip(keys, row, strict=True)) for name, row in rows.items()}


_NAMES = {"linear, from geometry": "linear", "Prandtl-Ishlinskii": "prandtl-ishlinskii", "polynomial": "polynomial"}
"""Names of models by their titles, which decide the colours."""
_PERIODS = 12
"""Periods of the resonance that the figure of the step shows."""


def _draw_models(campaign: RunSeries, found: HybridIdentification, runs: _Runs) -> Iterator[Path]:
    """Have the paper's figures drawn; yield their files."""

    def draw(
        name: str,
        label: str,
        quantity: str,
        unit: str,
        horizontal: Floats,
        measured: Floats,
        modelled: Mapping[str, Floats],
    ) -> Path:
        return campaign.draw(
            name,
            plot_fit,
            horizontal,
            measured,
            modelled,
            horizontal_label=label,
            output_label=f"{quantity} / {unit}",
            error_label=f"residual / {unit}",
            titles={title: errors_text(measure_errors(measured, each), unit) for title, each in modelled.items()},
            names=_NAMES,
        )

    def draw_base(name: str, samples: Samples, label: str, horizontal: Floats, shown: slice = slice(None)) -> Path:
        """Draw measured and simulated temperature of the base, with the air as identified."""
        network = found.network.network
        base = network.simulate(samples[CURRENT], samples.period, found.network.ambient)[:, 2]
        modelled = {"thermal network": base[shown]}
        return draw(name, label, "temperature of the base", "°C", horizontal[shown], samples[BASE][shown], modelled)

    around, stepped = read_loop(runs.sine.folder), read_loop(runs.steps.folder)
    second = slice(len(around.table) // 2, None)
    yield draw_base("figure-12-static-temperature", around, "current / A", around[CURRENT], second)
    yield draw_base("figure-13-temperature-steps", stepped, "time / s", stepped.times)
    with Record(runs.static.folder) as record:
        curve, names = record.steps(), signal_names(record)
    rises, deflections = curve[names[TIP]] - REFERENCE, curve[names[DEFLECTION]]
    by_heat, by_voltage = SENSITIVITIES
    yield draw(
        "figure-14-thermomechanical",
        "temperature of the tip less 22 °C / K",
        "deflection",
        "µm",
        rises,
        deflections * 1e6,
        {
            "linear, from geometry": by_heat * rises * 1e6,
            "polynomial": found.model.polynomial.evaluate(rises) * 1e6,
        },
    )
    piezo = found.piezo
    yield draw(
        "figure-15-hysteresis",
        "voltage / V",
        "deflection",
        "µm",
        piezo.voltages,
        piezo.deflections * 1e6,
        {
            "Prandtl-Ishlinskii": piezo.operator.evaluate(piezo.voltages) * 1e6,
            "linear, from geometry": by_voltage * piezo.voltages * 1e6,
        },
    )
    fast = read_loop(runs.step.folder)
    # The ringing of a third of a second would be a solid block.
    begun = fast.times[int(np.argmax(np.abs(np.diff(fast[VOLTAGE])) > 0.0))]
    end = begun + _PERIODS * 2.0 * np.pi / found.dynamics.model.frequency
    shown = (fast.times >= begun - 1e-3) & (fast.times <= end)
    deflection = fast[DEFLECTION] * 1e6
    yield draw(
        "figure-16-step",
        "time after the step / ms",
        "deflection",
        "µm",
        (fast.times[shown] - begun) * 1e3,
        deflection[shown],
        {"D(s)": (deflection - found.dynamics.residuals * 1e6)[shown]},
    )


def _draw_control(campaign: RunSeries, moves: Mapping[str, Tracked]) -> Iterator[Path]:
    """Have each controller's moves drawn; yield the files."""
    for name, each in moves.items():
        tracking = each.true
        # Without the first seconds, in which the controller finds the start.
        shown = tracking.times > SETTLING
        yield campaign.draw(
            f"control-moves-{name}",
            plot_tracking,
            tracking.reference[shown] * 1e6,
            {name: tracking.deflection[shown] * 1e6},
            horizontal=tracking.times[shown],
            horizontal_label="time / s",
            output_label="deflection / µm",
            error_label="error / µm",
        )


_RESOLUTION = "resolution of the {}"
_RANGE = "range of the {}"

PUBLISHED = (
    Published("current-sine", "thermal bandwidth", "4", "mHz", "Table III"),
    Published("current-steps", "swing at -0.1 and 0.1 A", "> 100", "µm", "Fig. 13"),
    Published("thermomechanical", "order of the polynomial", "4", "", "Fig. 14"),
    Published(
        "piezo-step", "real pole of D(s)", f"{PUBLISHED_DYNAMICS.real_pole / (2 * np.pi):.1f}", "Hz", "Fig. 16"
    ),
    Published(
        "piezo-step", "resonance of D(s)", f"{PUBLISHED_DYNAMICS.frequency / (2 * np.pi):.1f}", "Hz", "Fig. 16"
    ),
    Published("piezo-step", "DC gain over the static one", f"{PUBLISHED_DYNAMICS.gain:.3f}", "", "Fig. 16"),
    Published("piezo-step", "overshoot", "26.5", "%", "Fig. 16"),
    Published("piezo-step", "bandwidth of the piezo", "> 600", "Hz", "Table III"),
    Published("piezo-loops", _RANGE.format("piezo"), "10", "µm", "Table III"),
    Published("hybrid-control", _RESOLUTION.format("thermal actuator"), "1", "µm", "Table III"),
    Published("hybrid-control", _RESOLUTION.format("hybrid"), "< 100", "nm", "Table III"),
    Published("hybrid-control", _RANGE.format("hybrid"), "> 110", "µm", "Table III"),
)
"""What the paper states, beside runs of the rig."""

STUDY = Study(
    rig="hybrid",
    summary="Thermo-piezoelectric hybrid: parts, model of the whole, and control to nanometres over its range",
    description="Rakotondrabe and Ivan, Development and dynamic modeling of a new hybrid thermopiezoelectric "
    "microactuator, 2010.",
    carry_out=_carry_out,
    published=PUBLISHED,
    kernels=(
        "bench.identification.kernels.mode_kernels",
        "bench.models.kernels.play_stream_kernels",
        "sim_devices.plants._hybrid_kernels",
        "sim_devices.plants._voltage_course_kernels",
        "sim_devices.transducers",
        "rigs.hybrid",
    ),
)
