"""The paper on the thermo-piezoelectric hybrid on the rig `hybrid`: its parts, the model of the whole, and control.

M. Rakotondrabe and I. A. Ivan, *Development and Dynamic Modeling of a New Hybrid Thermopiezoelectric Microactuator*,
IEEE Transactions on Robotics 26(6), 2010; here "Rakotondrabe and Ivan 2010". The controller is what the paper leaves
as future work.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console

from bench.clock import Stopwatch
from bench.hybrid_runs import (
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
    identify_hybrid,
    read_loop,
    read_loops,
    sine_at,
)
from bench.identification import measure_errors
from bench.identification.dynamics import PUBLISHED_DYNAMICS
from bench.identification.thermal_network import Design
from bench.journal import Record
from bench.reproduce.campaign import Campaign, make_table, print_end
from bench.results.figures import Curve, plot_panels, plot_tracking
from bench.results.model_file import ModelFile
from bench.results.report import export_run
from bench.runs import RunResult

Floats = npt.NDArray[np.float64]

DIRECT = "hybrid-direct"
"""Rig of the fast loops: the same laboratory, its instruments called directly."""

FREQUENCIES = (0.001, 0.002, 0.003, 0.004, 0.005, 0.006, 0.008)
SWEEP_AMPLITUDE = 0.02
"""Of the current in the measurement of the bandwidth, A: small, as the gain depends on the current."""

CONTROLLERS = ("hybrid", "hybrid-low-pass", "thermal-feedback", "open-loop")
SETTLING = 5.0
"""Time after a move from which a hold counts, s."""
RESONANCES = (-0.03, 0.0, 0.03)
"""How far the plant's resonance is from where it was identified, in the fine steps."""
ROOM_STEP = 5.0
ROOM_STEP_TIME = 30.0
BAND = 0.02
"""Of the step, within which it counts as settled."""


@dataclass(frozen=True)
class Tracking:
    """What came of a reference: its times (s), and reference and true deflection (m), each of shape (N,).

    `held` and `moving` say where the reference rests, for `SETTLING` already, and where it moves.
    """

    times: Floats
    reference: Floats
    deflection: Floats

    @property
    def errors(self) -> Floats:
        """Deflection less reference, m."""
        return self.deflection - self.reference

    @property
    def moving(self) -> npt.NDArray[np.bool_]:
        """Where the reference moves."""
        return np.abs(np.gradient(self.reference, self.times)) > 1e-12

    @property
    def held(self) -> npt.NDArray[np.bool_]:
        """Where the reference has rested for `SETTLING`, but for the rest at the beginning."""
        moving = self.moving
        last = np.maximum.accumulate(np.where(moving, self.times, -np.inf))
        return ~moving & np.isfinite(last) & (self.times - last >= SETTLING)

    def summary(self) -> dict[str, float]:
        """Return RMS and greatest error in holds and moves, nm; nan where there is none."""
        result = {}
        for name, chosen in (("hold", self.held), ("move", self.moving)):
            errors = self.errors[chosen] * 1e9
            result[f"{name}_rms_nm"] = float(np.sqrt(np.mean(errors**2))) if errors.size else float("nan")
            result[f"{name}_max_nm"] = float(np.abs(errors).max()) if errors.size else float("nan")
        return result


def reproduce_hybrid(*, rig: str, seed: int, out: Path, live: bool, console: Console) -> dict[str, Any]:
    """Run the paper's experiments and the control beyond it, identify the models, and print the tables.

    Parameters
    ----------
    rig : str
        The rig of the characterization: `hybrid`, or a rig file with the same devices and signals.
    seed : int
        Seed of the emulated laboratory's noise.
    out : Path
        Folder for runs, models and figures.
    live : bool
        Whether to serve the live view.
    console : Console
        Where to print.

    Returns
    -------
    dict
        The result for programs; units are in the keys.

    Raises
    ------
    BenchError
        If a run did not complete; its record is kept.
    """
    stopwatch = Stopwatch()
    campaign = Campaign(rig, out / f"reproduce-hybrid-seed-{seed}", seed, live, console)
    sine = campaign.run("current-sine", {})
    steps = campaign.run("current-steps", {})
    static = campaign.run("thermomechanical", {})
    loops = campaign.run("piezo-loops", {})
    step = campaign.run("piezo-step", {})
    whole = campaign.run("hybrid-excitation", {})
    sweep = campaign.run(
        "current-sine",
        {
            "amplitude": str(SWEEP_AMPLITUDE),
            "frequencies": ", ".join(str(f) for f in FREQUENCIES),
            "periods": "3",
        },
    )
    found = identify_hybrid(steps.folder, static.folder, loops.folder, step.folder)
    model = campaign.folder / "hybrid.json"
    sources = [run.folder.name for run in (steps, static, loops, step)]
    ModelFile("hybrid", found.model, provenance={"sources": sources}).save(model)

    # Only the hybrid one has to show that it holds for long.
    tracked = {
        name: _track(campaign, model, {"controller": name, "hold": "60" if name == "hybrid" else "15"})
        for name in CONTROLLERS
    }
    slow = {"speed": "0.5e-6", "low": "-10e-6", "high": "10e-6", "hold": "10"}
    references = {
        name: _track(campaign, model, {"reference": name, **settings})
        for name, settings in (("staircase", {"hold": "15"}), ("ramp", slow), ("sine-on-ramp", slow))
    }
    room = _track(
        campaign,
        model,
        {"reference": "hold", "hold": "120"},
        {"emulation.ambient_step": str(ROOM_STEP), "emulation.ambient_step_time": str(ROOM_STEP_TIME)},
    )
    fine = {offset: _fine_step(campaign, model, offset) for offset in RESONANCES}

    recordings = [export_run(run.folder, "rrd", None)[0] for run in campaign.runs]
    thermal = _thermal(steps, sweep)
    validation = _validate(found, whole)
    control = _control_json(tracked["hybrid"], fine)
    result: dict[str, Any] = {
        "seed": seed,
        "geometry": {
            "thermal_um_per_K": Design().thermal_sensitivity * 1e6,
            "piezo_um_per_V": Design().piezo_sensitivity * 1e6,
        },
        "thermal": thermal,
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
        "whole": validation,
        "control": control,
        "controllers": {name: tracking.summary() for name, tracking in tracked.items()},
        "references": {
            name: {
                "rms_nm": float(np.sqrt(np.mean(tracking.errors[tracking.times > SETTLING] ** 2)) * 1e9),
                "max_nm": float(np.abs(tracking.errors[tracking.times > SETTLING]).max() * 1e9),
            }
            for name, tracking in references.items()
        },
        "room_step_nm": float(np.abs(room.errors[room.times > ROOM_STEP_TIME]).max() * 1e9),
        "fine_steps": {f"{offset:+.0%}": values for offset, values in fine.items()},
        "laboratory_seconds": campaign.laboratory_seconds,
        "wall_seconds": 0.0,
        "folder": str(campaign.folder),
        "recordings": [str(path) for path in recordings],
    }
    result["table_3"] = _table_3(result, found, loops)
    figures = _draw(found, sine, steps, static, step, tracked, campaign.folder / "figures")
    result["figures"] = [str(path) for path in figures]
    result["wall_seconds"] = stopwatch.seconds()
    _print_result(result, console)
    return result


def _track(
    campaign: Campaign, model: Path, settings: Mapping[str, str], overrides: Mapping[str, str] | None = None
) -> Tracking:
    run = campaign.run("hybrid-control", {"model": str(model), "witness": "true", **settings}, overrides, rig=DIRECT)
    samples = read_loop(run.folder)
    return Tracking(samples.times, samples["reference"], samples[WITNESS])


def _fine_step(campaign: Campaign, model: Path, offset: float) -> dict[str, float]:
    """Carry out a fine step; return settling time (ms), overshoot (%) and the RMS error afterwards (nm)."""
    run = campaign.run(
        "fine-step",
        {"model": str(model), "witness": "true"},
        {"emulation.resonance_offset": str(offset)},
        rig=DIRECT,
    )
    samples = read_loop(run.folder)
    reference, deflection = samples["reference"], samples[WITNESS]
    height = float(reference[-1] - reference[0])
    start = int(np.flatnonzero(reference != reference[0])[0])
    errors = (deflection - reference[-1])[start:] / height
    outside = np.flatnonzero(np.abs(errors) > BAND)
    settled = int(outside[-1]) + 1 if outside.size else 0
    return {
        "settling_ms": settled * samples.period * 1e3,
        "overshoot_percent": max(0.0, float(errors.max()) * 100.0),
        "rms_nm": float(np.sqrt(np.mean((errors[len(errors) // 2 :] * height) ** 2)) * 1e9),
    }


def _control_json(tracking: Tracking, fine: Mapping[float, Mapping[str, float]]) -> dict[str, float]:
    """Return the results of the hybrid controller; of the fine steps the worst."""
    summary = tracking.summary()
    held = tracking.reference[tracking.held]
    return {
        "hold_rms_nm": summary["hold_rms_nm"],
        "hold_max_nm": summary["hold_max_nm"],
        "move_rms_nm": summary["move_rms_nm"],
        "range_um": float(np.ptp(held) * 1e6),
        "fine_step_settling_ms": max(values["settling_ms"] for values in fine.values()),
        "fine_step_overshoot_percent": max(values["overshoot_percent"] for values in fine.values()),
    }


def _thermal(steps: RunResult, sweep: RunResult) -> dict[str, Any]:
    deflection = read_loop(steps.folder)[DEFLECTION]
    by_label = read_loops(sweep.folder)
    frequencies = np.array(FREQUENCIES)
    gains = np.array([abs(sine_at(by_label[f"{f:g} Hz"], DEFLECTION, f)) for f in FREQUENCIES])
    rest = float(deflection[0])
    return {
        "bandwidth_mHz": bandwidth_of(frequencies, gains) * 1e3,
        "swing_um": {"up": float(deflection.max() - rest) * 1e6, "down": float(rest - deflection.min()) * 1e6},
    }


def _dynamics(found: HybridIdentification) -> dict[str, Any]:
    dynamics = found.dynamics.model
    measures = dynamics.measure_step()
    top = float(found.piezo.voltages.max())
    # The static operator's answer to the same step, from rest.
    operator = found.model.hysteresis
    static = float(np.ptp(operator.evaluate([0.0, top])))
    return {
        "poles_Hz": [dynamics.real_pole / (2.0 * np.pi), dynamics.frequency / (2.0 * np.pi)],
        "dc_gain": dynamics.gain * top / static,
        "overshoot_percent": measures.overshoot * 100.0,
        "gain_um_per_V": dynamics.gain * 1e6,
    }


def _validate(found: HybridIdentification, whole: RunResult) -> dict[str, float]:
    """Simulate the whole model by itself on the run with heat and voltage at once; return the errors, µm."""
    samples = read_loop(whole.folder)
    response = found.model.simulate(
        samples[CURRENT], samples[VOLTAGE], samples.period, float(np.mean(samples[BASE][:1]))
    )
    measured = samples[DEFLECTION] - samples[DEFLECTION][0]
    errors = measure_errors(measured, response.deflections)
    return {"rms_um": errors.rms * 1e6, "max_um": errors.maximum * 1e6, "span_um": errors.span * 1e6}


def _table_3(result: Mapping[str, Any], found: HybridIdentification, loops: RunResult) -> dict[str, dict[str, float]]:
    """Return bandwidth (Hz), resolution (nm, RMS error of a hold) and range (µm) of the three actuators."""
    loop = read_loop(loops.folder)[DEFLECTION]
    thermal = result["thermal"]["bandwidth_mHz"] * 1e-3
    fine = found.dynamics.model.bandwidth()
    swing = result["thermal"]["swing_um"]
    # Up and down at 0.1 A: what the paper's temperature variation of 20 °C gives.
    heat = swing["up"] + swing["down"]
    return {
        "piezo": {
            "bandwidth_Hz": fine,
            "resolution_nm": result["fine_steps"]["+0%"]["rms_nm"],
            "range_um": float(np.ptp(loop)) * 1e6,
        },
        "thermal": {
            "bandwidth_Hz": thermal,
            "resolution_nm": result["controllers"]["thermal-feedback"]["hold_rms_nm"],
            "range_um": heat,
        },
        "hybrid": {
            "bandwidth_Hz": fine,
            "resolution_nm": result["control"]["hold_rms_nm"],
            "range_um": heat + float(np.ptp(loop)) * 1e6,
        },
    }


def _draw(
    found: HybridIdentification,
    sine: RunResult,
    steps: RunResult,
    static: RunResult,
    step: RunResult,
    tracked: Mapping[str, Tracking],
    folder: Path,
) -> list[Path]:
    paths: list[Path] = []

    def path(name: str) -> Path:
        paths.append(folder / f"{name}.png")
        return paths[-1]

    def simulated(samples: Samples) -> Floats:
        """Return the temperature of the base by the network, with the room as it was in the identification."""
        network = found.network.network
        return network.simulate(samples[CURRENT], samples.period, found.network.ambient)[:, 2]

    around, stepped = read_loop(sine.folder), read_loop(steps.folder)
    second = slice(len(around.table) // 2, None)
    plot_panels(
        path("figure-12-static-temperature"),
        {
            "": [
                Curve("measured", around[CURRENT][second], around[BASE][second]),
                Curve("model", around[CURRENT][second], simulated(around)[second]),
            ]
        },
        horizontal_label="current / A",
        vertical_label="temperature of the base / °C",
        columns=1,
    )
    plot_panels(
        path("figure-13-temperature-steps"),
        {
            "": [
                Curve("measured", stepped.times, stepped[BASE]),
                Curve("model", stepped.times, simulated(stepped)),
            ]
        },
        horizontal_label="time / s",
        vertical_label="temperature of the base / °C",
        columns=1,
    )
    with Record(static.folder) as record:
        curve = record.steps()
    rises = curve[TIP] - REFERENCE
    order = np.argsort(rises)
    slope = Design().thermal_sensitivity
    plot_panels(
        path("figure-14-thermomechanical"),
        {
            "": [
                Curve("measured", rises, curve[DEFLECTION] * 1e6),
                Curve("linear, from geometry", rises[order], slope * rises[order] * 1e6),
                Curve(
                    f"polynomial, order {found.order.order}",
                    rises[order],
                    found.model.polynomial.evaluate(rises[order]) * 1e6,
                ),
            ]
        },
        horizontal_label="temperature of the tip less 22 °C / K",
        vertical_label="deflection / µm",
        columns=1,
    )
    piezo = found.piezo
    plot_panels(
        path("figure-15-hysteresis"),
        {
            "": [
                Curve("measured", piezo.voltages, piezo.deflections * 1e6),
                Curve("Prandtl-Ishlinskii", piezo.voltages, piezo.operator.evaluate(piezo.voltages) * 1e6),
                Curve("linear, from geometry", piezo.voltages, Design().piezo_sensitivity * piezo.voltages * 1e6),
            ]
        },
        horizontal_label="voltage / V",
        vertical_label="deflection / µm",
        columns=1,
    )
    fast = read_loop(step.folder)
    residuals = found.dynamics.residuals
    plot_panels(
        path("figure-16-step"),
        {
            "": [
                Curve("measured", fast.times * 1e3, fast[DEFLECTION] * 1e6),
                Curve("D(s)", fast.times * 1e3, (fast[DEFLECTION] - residuals) * 1e6),
            ]
        },
        horizontal_label="time / ms",
        vertical_label="deflection / µm",
        columns=1,
    )
    for name, tracking in tracked.items():
        # Without the first seconds, in which the controller finds its way to the beginning.
        shown = tracking.times > SETTLING
        plot_tracking(
            path(f"control-moves-{name}"),
            tracking.reference[shown] * 1e6,
            {name: tracking.deflection[shown] * 1e6},
            horizontal=tracking.times[shown],
            horizontal_label="time / s",
            output_label="deflection / µm",
            error_label="error / µm",
        )
    return paths


def _print_result(result: Mapping[str, Any], console: Console) -> None:
    published = PUBLISHED_DYNAMICS
    dynamics, thermal, control = result["dynamics"], result["thermal"], result["control"]
    console.print(
        make_table(
            "the parts",
            ("", "paper", "bench", "unit"),
            [
                (
                    "thermal sensitivity f_s, from geometry",
                    "–",
                    f"{result['geometry']['thermal_um_per_K']:.3f}",
                    "µm/K",
                ),
                ("piezo sensitivity d_p, from geometry", "–", f"{result['geometry']['piezo_um_per_V']:.4f}", "µm/V"),
                ("thermal bandwidth", "4", f"{thermal['bandwidth_mHz']:.2f}", "mHz"),
                (
                    "swing at -0.1 and 0.1 A (Fig. 13)",
                    "> 100",
                    f"{thermal['swing_um']['up']:.0f} and {thermal['swing_um']['down']:.0f}",
                    "µm",
                ),
                ("network, RMS of the base (Fig. 13)", "–", f"{result['network']['base_rms_K']:.3f}", "K"),
                (
                    f"polynomial of order {result['polynomial_order']}, RMS (Fig. 14)",
                    "order 4",
                    f"{result['polynomial_rms_um']:.3f}",
                    "µm",
                ),
                ("15 plays, RMS (Fig. 15)", "–", f"{result['prandtl_ishlinskii_rms_percent']:.2f}", "%"),
                (
                    "D(s), real pole and resonance (Fig. 16)",
                    f"{published.real_pole / (2 * np.pi):.1f} and {published.frequency / (2 * np.pi):.1f}",
                    " and ".join(f"{pole:.1f}" for pole in dynamics["poles_Hz"]),
                    "Hz",
                ),
                ("D(s), DC gain over the static one", f"{published.gain:.3f}", f"{dynamics['dc_gain']:.3f}", "1"),
                (
                    "D(s), overshoot",
                    f"{published.measure_step().overshoot * 100:.1f}",
                    f"{dynamics['overshoot_percent']:.1f}",
                    "%",
                ),
                (
                    "model of the whole by itself (eq. 22), RMS",
                    "–",
                    f"{result['whole']['rms_um']:.2f} of {result['whole']['span_um']:.0f}",
                    "µm",
                ),
            ],
        )
    )
    papers = {
        "piezo": ("> 600 Hz", "< 100 nm", "10 µm"),
        "thermal": ("4 mHz", "1 µm", "> 100 µm"),
        "hybrid": ("4 mHz and > 600 Hz", "< 100 nm", "> 110 µm"),
    }
    rows = []
    for name, entry in result["table_3"].items():
        bandwidth = (
            f"{entry['bandwidth_Hz']:.0f} Hz" if name != "thermal" else f"{entry['bandwidth_Hz'] * 1e3:.1f} mHz"
        )
        if name == "hybrid":
            bandwidth = f"{thermal['bandwidth_mHz']:.1f} mHz and {bandwidth}"
        values = (bandwidth, f"{entry['resolution_nm']:.1f} nm", f"{entry['range_um']:.0f} µm")
        rows.append((name, *(part for pair in zip(papers[name], values, strict=True) for part in pair)))
    console.print(
        make_table(
            "Table III: bandwidth (-3 dB), resolution (RMS error of a hold), range",
            ("actuator", "paper", "bench", "paper", "bench", "paper", "bench"),
            rows,
        )
    )
    rows = [
        (name, *(f"{entry[f'{part}_{what}_nm']:.1f}" for part in ("hold", "move") for what in ("rms", "max")))
        for name, entry in result["controllers"].items()
    ]
    console.print(
        make_table(
            f"six moves at 3 µm/s over {control['range_um']:.0f} µm, true errors in nm",
            ("controller", "hold RMS", "hold max", "move RMS", "move max"),
            rows,
        )
    )
    rows = [
        (name, f"{entry['rms_nm']:.1f}", f"{entry['max_nm']:.1f}") for name, entry in result["references"].items()
    ]
    rows.append((f"hold, room steps by {ROOM_STEP:g} K", "–", f"{result['room_step_nm']:.1f}"))
    console.print(make_table("hybrid controller, true errors in nm", ("reference", "RMS", "max"), rows))
    rows = [
        (offset, f"{entry['settling_ms']:.2f}", f"{entry['overshoot_percent']:.2f}", f"{entry['rms_nm']:.1f}")
        for offset, entry in result["fine_steps"].items()
    ]
    console.print(
        make_table(
            "fine step of 5 µm at 20 kHz",
            ("resonance off by", "settling (2 %) / ms", "overshoot / %", "RMS afterwards / nm"),
            rows,
        )
    )
    print_end(result, console)
