"""The figures of a run itself: its signals over time, and its loops, both told apart by phases."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.analysis.figures.fits import plot_loops
from bench.analysis.figures.panels import Curve, plot_signals, time_axis
from bench.analysis.report.telemetry_summary import TelemetrySummary
from bench.base import Floats, with_unit
from bench.devices import Signal
from bench.record import Event, Record, Table

_RESET = "reset"
"""Begins the names of phases that only bring the memory into a known state."""


class Phase(NamedTuple):
    """A phase of a run: its name, when it began and ended (laboratory s), and how many steps it has finished."""

    name: str
    start: float
    end: float
    steps: int


def phases(record: Record, steps: Table, events: Sequence[Event]) -> list[Phase]:
    """Return the phases of a run in their order; the last of one that has not ended lasts until its last reading."""
    begun = [(event.t, event.text) for event in events if event.kind == "phase"] or [(0.0, "the whole run")]
    last = max([float(steps["finished"].max())] if len(steps) else [0.0])
    end = float(record.meta.get("finished") or max([last, *(event.t for event in events)]))
    ends = [t for t, _ in begun[1:]] + [end]
    return [
        Phase(name, t, until, int(np.count_nonzero((steps["started"] >= t) & (steps["started"] < max(until, t)))))
        for (t, name), until in zip(begun, ends, strict=True)
    ]


def draw_signals(path: Path, record: Record, steps: Table, summary: TelemetrySummary, found: Sequence[Phase]) -> str:
    """Draw every signal that changes over laboratory time; return a caption, empty if there is nothing to draw.

    A signal that the readings of the steps do not have is drawn from telemetry.
    """
    curves, constant, has_ticks = [], [], False
    ticks = summary.shown
    start, end = _range(steps["finished"], ticks["t"])
    scale, label = time_axis(end - start)
    for signal in record.signals:
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
        curves.append(Curve(_label(signal), scale * times, shown.factor * values))
    if not curves:
        return ""
    plot_signals(path, curves, label, [(phase.name, scale * phase.start, scale * phase.end) for phase in found])
    caption = "Signals over laboratory time" + ("; those without readings from telemetry." if has_ticks else ".")
    if has_ticks and summary.remark:
        caption += f" {summary.remark}"
    return caption + (f" Constant: {', '.join(constant)}." if constant else "")


def draw_loops(
    folder: Path, ending: str, record: Record, steps: Table, summary: TelemetrySummary, found: Sequence[Phase]
) -> Iterator[tuple[Path, str]]:
    """Draw the loops of the dashboard's layout, without the resets; yield their files and captions.

    A loop at a fixed rate is one step of many ticks, which are its samples.
    """
    samples, over, remark = (steps, "finished", "") if len(steps) > 1 else (summary.shown, "t", summary.remark)
    layout = record.meta.get("dashboard")
    if not layout or not len(samples):
        return
    signals = {signal.name: signal for signal in record.signals}
    phase = np.searchsorted([each.start for each in found], samples[over], side="right") - 1
    is_reset = np.array([each.name.startswith(_RESET) for each in found])[phase]
    for i, pair in enumerate([layout, *layout.get("loops", ())]):
        ends = [signals[name] for name in (pair["input"], pair["output"]) if name in signals]
        if len(ends) < 2:
            continue
        inputs, outputs = (each.display.factor * samples[each.name] for each in ends)
        known = np.isfinite(inputs) & np.isfinite(outputs)
        rows = known & ~is_reset
        rows = rows if rows.any() else known
        if not rows.any():
            continue
        path = folder / f"loop{f'-{i}' if i else ''}.{ending}"
        labels = [with_unit(each.name, each.display.unit) for each in ends]
        named = [found[k].name for k in phase[rows]]
        plot_loops(path, inputs[rows], outputs[rows], input_label=labels[0], output_label=labels[1], phases=named)
        left_out = " Resets are left out." if (known & ~rows).any() else ""
        yield path, f"{ends[1].name} over {ends[0].name}, one point a reading.{left_out} {remark}".rstrip()


def _label(signal: Signal) -> str:
    return with_unit(signal.name, signal.display.unit).replace(" / ", "\n/ ")


def _range(*times: Floats) -> tuple[float, float]:
    known = np.concatenate([each[np.isfinite(each)] for each in times])
    return (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
