"""The figures of a run itself: its signals over time, and its loops, both told apart by phases."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.analysis.figures.fits import plot_loops
from bench.analysis.figures.panels import Curve, plot_signals, time_axis
from bench.analysis.report.recorded_run import RecordedRun
from bench.base import Floats, with_unit
from bench.devices import Signal
from bench.rig import SETPOINT

_RESET = "reset"
"""Begins the names of phases that only bring the memory into a known state."""


def draw_signals(path: Path, run: RecordedRun) -> str:
    """Draw every signal that changes over laboratory time; return a caption, empty if there is nothing to draw.

    A signal that the readings of the steps do not have is drawn from telemetry.
    """
    curves, constant, has_ticks = [], [], False
    steps, ticks = run.steps, run.summary.shown
    start, end = _range(steps["finished"], ticks["t"])
    scale, label = time_axis(end - start)
    for signal in run.record.signals:
        is_read = np.isfinite(steps[signal.name]).sum() > 1
        times, values = (steps["finished"], steps[signal.name]) if is_read else (ticks["t"], ticks[signal.name])
        known = values[np.isfinite(values)]
        if not known.size:
            continue
        shown = signal.display
        if known.size < 2 or shown.number(float(known.min())) == shown.number(float(known.max())):
            constant.append(f"{signal.name} {shown.number(float(known[0]))} {shown.unit}".rstrip())
            continue
        has_ticks |= not is_read
        curves.append(Curve(with_unit(signal.name, shown.unit), scale * times, shown.factor * values))
    if not curves:
        return ""
    plot_signals(path, curves, label, [(phase.name, scale * phase.start, scale * phase.end) for phase in run.phases])
    caption = "Signals over laboratory time" + ("; those without readings from telemetry." if has_ticks else ".")
    if has_ticks and run.summary.remark:
        caption += f" {run.summary.remark}"
    return caption + (f" Constant: {', '.join(constant)}." if constant else "")


class Loop(NamedTuple):
    """A loop of the dashboard's layout, one point a reading; in units of the signals."""

    input: Signal
    output: Signal
    inputs: Floats
    outputs: Floats
    phases: list[str]  # of each point
    is_whole: bool  # whether no resets were left out

    @property
    def labels(self) -> tuple[str, str]:
        """The labels of its axes."""
        return with_unit(self.input.name, self.input.display.unit), with_unit(
            self.output.name, self.output.display.unit
        )

    def curve(self, shown: Loop) -> Curve:
        """Return its points in the units in which another one is shown."""
        return Curve("", shown.input.display.factor * self.inputs, shown.output.display.factor * self.outputs)


def loops_of(run: RecordedRun) -> list[Loop]:
    """Return the loops of the dashboard's layout, without the resets.

    A loop at a fixed rate is one step of many ticks, which are its samples. A run in which nothing was set, such as a
    calibration by hand, has no loops.
    """
    steps, phases = run.steps, run.phases
    samples, over = (steps, "finished") if len(steps) > 1 else (run.summary.shown, "t")
    layout = run.meta.get("dashboard")
    if not layout or not len(samples) or _is_left_alone(run):
        return []
    signals = {signal.name: signal for signal in run.record.signals}
    phase = np.searchsorted([each.start for each in phases], samples[over], side="right") - 1
    is_reset = np.array([each.name.startswith(_RESET) for each in phases])[phase]
    found = []
    for pair in [layout, *layout.get("loops", ())]:
        if not {pair["input"], pair["output"]} <= signals.keys():
            continue
        inputs, outputs = samples[pair["input"]], samples[pair["output"]]
        known = np.isfinite(inputs) & np.isfinite(outputs)
        rows = known & ~is_reset
        rows = rows if rows.any() else known
        if rows.any():
            ends = signals[pair["input"]], signals[pair["output"]]
            names = [phases[k].name for k in phase[rows]]
            found.append(Loop(*ends, inputs[rows], outputs[rows], names, not (known & ~rows).any()))
    return found


def draw_loops(folder: Path, ending: str, run: RecordedRun) -> Iterator[tuple[Path, str]]:
    """Draw the loops of a run; yield their files and captions."""
    remark = run.summary.remark if len(run.steps) <= 1 else ""
    for i, loop in enumerate(loops_of(run)):
        path = folder / f"loop{f'-{i}' if i else ''}.{ending}"
        _, inputs, outputs = loop.curve(loop)
        plot_loops(path, inputs, outputs, input_label=loop.labels[0], output_label=loop.labels[1], phases=loop.phases)
        left_out = "" if loop.is_whole else " Resets are left out."
        yield path, f"{loop.output.name} over {loop.input.name}, one point a reading.{left_out} {remark}".rstrip()


def _is_left_alone(run: RecordedRun) -> bool:
    """Return whether a run of several steps has set-points that never change; one that was imported has none."""
    names = [signal.name for signal in run.record.signals if signal.name.endswith(SETPOINT)]
    return len(run.steps) > 1 and bool(names) and all(np.unique(run.steps[name]).size == 1 for name in names)


def _range(*times: Floats) -> tuple[float, float]:
    known = np.concatenate([each[np.isfinite(each)] for each in times])
    return (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
