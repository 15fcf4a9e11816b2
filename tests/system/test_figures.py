"""The figures of reports: every axes shows something, no legend covers data, nothing is cut off."""

import io
from dataclasses import replace

import numpy as np
import pytest
from drawn_figures import looking_at_figures
from figure_checks import problems_of
from matplotlib.figure import Figure
from rich.console import Console
from written_run import META, SIGNALS

from bench.analysis import report_run
from bench.devices import Settled, Signal
from bench.protocol import TRACES
from bench.record import FILE_NAME, Event, Journal, StepRecord


def test_what_is_wrong_with_a_figure_is_found():
    figure = Figure()
    full, empty = figure.subplots(2)
    full.plot([0.0, 1.0], [0.0, 1.0], ".", label="covered")
    full.legend(loc="upper right", bbox_to_anchor=(1.1, 1.1))
    full.set_ylabel("a label that is far longer than the axes are high, so that its ends are cut off " * 2)
    empty.plot([0.0, 1.0], [np.nan, np.nan])
    empty.axhline(0.0)
    found = "; ".join(problems_of(figure))
    assert "show nothing finite" in found
    assert "covers 1 points" in found
    assert "is cut off" in found


def write_tracking(folder):
    """Write a run whose traces, unlike its readings, are in the telemetry alone, with a fan that never moves."""
    signals = (
        *SIGNALS[:3],
        *(replace(trace, unit="m", precision=9) for trace in TRACES),
        Signal("fan", "1", "fan", 0),
    )
    folder.mkdir()
    journal = Journal(folder / FILE_NAME, signals, {**META, "controls": "tip", "run": "tracking", "interlocks": []})
    for k, phase in enumerate(("reset", "latched, targets of the generated sequence", "open loop")):
        journal.event(Event(100.0 * k, "INFO", "phase", phase))
        for i in range(20):
            step, t = 20 * k + i, 100.0 * k + 5.0 * i
            heat = 40.0 + 20.0 * np.sin(0.3 * step)
            traces = (1e-6 * heat, 1e-6 * heat, 0.0, 63245.0 if i < 3 else 1e-7)
            journal.telemetry(t + 1.0, step, (heat, heat, 1e-6 * heat, *traces, 0.0))
            none = (np.nan,) * len(TRACES)
            values = (heat, heat, 1e-6 * heat, *none, 0.0)
            journal.step(StepRecord(step, t, t + 5.0, phase, "", Settled.DWELL, {"plate": heat}, values))
    journal.finish(status="completed", reason="", finished=300.0, safe_state={"plate": "safe"})
    journal.close()
    return folder


def test_of_a_run_under_control(tmp_path):
    folder = write_tracking(tmp_path / "run")
    console = Console(file=io.StringIO(), width=160)
    with looking_at_figures() as drawn:
        result = report_run(folder, (), None, console)
    assert {"signals.png", "loop.png", "signals.svg", "loop.svg"} <= set(drawn)
    assert {name: problems for name, problems in drawn.items() if problems} == {}
    # The prior of the filter is no uncertainty, and what never moves needs no room.
    assert result["extremes"]["disturbance_uncertainty"]["high"] == pytest.approx(1e-7)
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "Constant: " in page
    assert "fan 0" in page
    assert "Resets are left out." in page
