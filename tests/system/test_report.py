"""Reports of runs of every kind: results in fitting prefixes, with the precision of the controlled signal."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cases import cases
from rich.console import Console

from bench.analysis import FOLLOW, REACH, READING, report_run
from bench.base import fitting_prefix, format_numbers, with_unit
from bench.devices import Signal
from bench.identification import ModelFile
from bench.models import Hammerstein, LinearPart, Polynomial
from bench.protocol import TRACES, Settled
from bench.record import FILE_NAME, Journal, StepRecord, add_model

META = {
    "run": "run",
    "rig": "rig",
    "rig_title": "A rig",
    "protocol": "tracking",
    "protocol_summary": "Reach targets",
    "parameters": {},
    "seed": 0,
    "clock": "virtual",
    "epoch": "2000-01-01T00:00:00+00:00",
    "devices": {},
    "operator": "lab",
    "plan": {"steps": 4, "seconds": 32.0},
    "git": "0123456789ab",
}
DRIVE = Signal("drive", "V", "drive", 3)
LENGTH = Signal("length", "m", "position", 9)
CURVATURE = Signal("response", "1/m", "curvature", 2)
STRAIN = Signal("strain", "1", "strain", 6)


@pytest.fixture
def report(tmp_path):
    """Report a run that was off its two targets, or its moving reference, by given errors; return JSON and text."""

    def make(output, errors, *, moving=False, controlled=True, models=(), figure_format="png"):
        traces = tuple(replace(trace, unit=output.unit, precision=output.precision) for trace in TRACES)
        journal = Journal(
            tmp_path / FILE_NAME,
            (DRIVE, output, *(traces if controlled else ())),
            {**META, "controls": output.name if controlled else ""},
        )
        scale = max(abs(error) for error in errors)
        for i, error in enumerate(errors):
            target, t = 10.0 * scale * (i + 1), 20.0 * i
            beside = (target, target, 0.0, scale) if controlled else ()
            values = (1.0 + i, target + error, *beside)
            if moving:
                journal.telemetry(t, i, values)
                journal.step(StepRecord(i, t, t + 8.0, "", FOLLOW, Settled.DWELL, {}, values))
                continue
            journal.step(StepRecord(2 * i, t, t + 8.0, "", REACH, Settled.DWELL, {}, values))
            journal.step(StepRecord(2 * i + 1, t + 8.0, t + 9.0, "", READING, Settled.DWELL, {}, values))
        journal.finish(status="completed", reason="", finished=40.0, safe_state={})
        journal.close()
        for model in models:
            add_model(tmp_path, model.name, 40.0, model.to_json())
        console = Console(file=io.StringIO(), width=200)
        return report_run(tmp_path, (), None, console, figure_format=figure_format), console.file.getvalue()

    return make


@pytest.mark.parametrize(
    ("output", "errors", "said"),
    [
        (LENGTH, (23e-9, 21e-9), "error max 23 nm, error rms 22 nm, error median 22 nm, 8.0 s a target"),
        (CURVATURE, (8.125, 4.125), "error max 8.12 1/m, error rms 6.44 1/m, error median 6.12 1/m, 8.0 s a target"),
        (STRAIN, (375e-6, 105e-6), "error max 0.000375, error rms 0.000275, error median 0.000240, 8.0 s a target"),
    ],
)
def test_targets(report, output, errors, said):
    content, text = report(output, errors)
    assert f"tracking: {said}\n" in text
    assert content["tracking"]["max"] == pytest.approx(max(errors))


@pytest.mark.parametrize(
    ("output", "errors", "said"),
    [
        (LENGTH, (30e-6, -10e-6), "error max 30.000 µm, error rms 22.361 µm"),
        (STRAIN, (2e-6, -1e-6), "error max 0.0000020, error rms 0.0000016"),
    ],
)
def test_a_moving_reference(report, output, errors, said):
    content, text = report(output, errors, moving=True)
    assert f"following: {said}\n" in text
    assert content["following"]["max"] == pytest.approx(errors[0])


def test_extremes_of_the_controlled_signal_and_its_traces_and_figures_for_papers(report):
    content, text = report(LENGTH, (0.375e-3, 0.105e-3), figure_format="pdf")
    assert "tracking: error max 0.375 mm, error rms 0.275 mm, error median 0.240 mm, 8.0 s a target\n" in text
    assert {Path(path).suffix for path in content["figures"]} == {".pdf"}
    assert all(Path(path).stat().st_size > 0 for path in content["figures"])
    rows = {cells[1]: cells[3:8:2] for line in text.splitlines() if (cells := line.split()) and cells[0] == "│"}
    assert rows["length"] == ["4.125", "7.605", "mm"]
    assert rows["reference"] == ["3.750", "7.500", "mm"]
    assert rows["drive"] == ["1.000", "2.000", "V"]


@pytest.mark.parametrize(
    ("output", "unit", "row"),
    [
        (LENGTH, "m", ["line", "polynomial", "0.25", "0.25", "0.25", "mm", "6.67"]),
        (STRAIN, "1", ["line", "polynomial", "0.00025", "0.00025", "0.00025", "", "6.67"]),
    ],
)
def test_models_on_a_run_of_steps(report, output, unit, row):
    # A line through both points, less a quarter of a millimetre.
    line = Polynomial(np.array([5.625e-3]), (0.0, 3.0), 5.75e-3, "V", unit)
    model = ModelFile("line", line, None, {"input": "drive", "output": output.name})
    content, text = report(output, (0.375e-3, 0.375e-3), controlled=False, models=(model,))
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in text.splitlines() if "│" in line]
    assert row in rows
    assert content["models"]["line"]["rms"] == pytest.approx(0.25e-3)
    assert "tracking" not in content


def test_a_model_with_time_at_the_times_of_the_steps(report, tmp_path):
    # Of drives 1 and 2 V it gives 1 and 2 mm, and a drift of 0.1 mm in the 20 s between the readings.
    line = Polynomial(np.array([1.5e-3]), (0.0, 3.0), 1.5e-3, "V", "m")
    model = ModelFile("drifting", Hammerstein(line, LinearPart(), 5e-6), None, {"input": "drive", "output": "length"})
    content, text = report(LENGTH, (1e-3, 0.0), controlled=False, models=(model,))
    # Measured are 11 and 20 mm.
    assert content["models"]["drifting"]["max"] == pytest.approx(20e-3 - 2.1e-3)
    assert "drifting" in text
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "parameters of drifting" in page
    assert "hammerstein" in page


class TestUnits:
    @cases(
        ("unit", "greatest", "expected"),
        [
            ("m", 8e-3, (1e3, "mm")),
            ("m", 1e-3, (1e3, "mm")),
            ("m", 0.9e-3, (1e6, "µm")),
            ("A", 2.0, (1.0, "A")),
            ("m", 5e-9, (1e9, "nm")),
            ("m", 1e-12, (1e9, "nm")),
            ("N", 0.0, (1.0, "N")),
            ("°C", 1e-3, (1.0, "°C")),
            ("1/m", 1e-3, (1.0, "1/m")),
        ],
    )
    def test_prefix(self, unit, greatest, expected):
        assert fitting_prefix(unit, greatest) == expected

    def test_numbers(self):
        assert format_numbers([None, 0.000375], "m", 9) == ["–", "0.375", "mm"]
        assert format_numbers([None, None], "m", 9) == ["–", "–", "m"]
        assert format_numbers([float("nan"), 1.0], "V", 2) == ["nan", "1.00", "V"]
        assert format_numbers([0.25], "1", 1) == ["0.2", ""]

    def test_labels(self):
        assert with_unit("force", "N") == "force / N"
        assert with_unit("strain", "1") == with_unit("strain", "") == "strain"
