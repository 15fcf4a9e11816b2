"""What the dashboard shows of a protocol: its loops, its numbers, its bounds, and the error on its own scale."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from bench.base import Display
from bench.dashboard.bounds import bounds_of, nearest
from bench.dashboard.controlled_run import ControlPlots, ErrorPlot
from bench.dashboard.drawing import Frame
from bench.dashboard.entries import End, Tick, in_parts
from bench.dashboard.writer import Writer
from bench.devices import Signal
from bench.protocol import LATENESS, TRACES, Settled, Slot, Views, find_protocol
from bench.record import Event, Lateness, StepRecord
from bench.rig import DashboardLayout, RoleTable

SIGNALS = (
    Signal("tec_setpoint", "°C", "temperature set-point", 3),
    Signal("tec_temperature", "°C", "object temperature", 3),
    Signal("curvature", "1/m", "curvature", 2),
    *(replace(trace, unit="1/m") for trace in TRACES),
)
INTERLOCKS = [
    {"signal": "tec_temperature", "low": 10.0, "high": 100.0},
    {"signal": "curvature", "high": 9e3, "level": "hold"},
]
META = {
    "run": "run",
    "rig": "vo2",
    "rig_title": "VO2",
    "protocol": "tracking",
    "protocol_summary": "",
    "parameters": {},
    "seed": 0,
    "clock": "wall",
    "epoch": "2026-03-01T12:00:00+00:00",
    "devices": {},
    "operator": "",
    "git": "",
    "controls": "curvature",
    "plan": {"steps": 40, "seconds": 400.0, "complete": True},
    "limits": {"tec": (15.0, 90.0)},
    "rig_content": {"interlocks": INTERLOCKS},
    "dashboard": None,
}
NOTHING = (math.nan,) * 4
VIEWS = "ViewBlueprint:space_origin"


def slot(name: str, signal: str, unit: str, range_: tuple[float, float] | None = None) -> Slot:
    return Slot(name, "", signal, unit, signal, "", Display.of(unit, 3), RoleTable(signal=signal, range=range_))


def targets(errors: list[float], disturbance: float = 1.0) -> list[object]:
    """Return the entries of a controller that reaches one target after another, each with some error."""
    entries: list[object] = [Event(0.0, "INFO", "phase", "closed loop")]
    t = 0.0
    for step, error in enumerate(errors):
        target = 500.0 + 100.0 * step
        for distance in (300.0, 20.0, 2.0 * error):
            t += 1.0
            entries.append(Tick(t, 2 * step, (60.0, 60.1, target + distance, target, target, disturbance, 3.0)))
        for sign in (-1.0, 1.0):
            t += 0.1
            values = (60.0, 60.1, target + error + sign * 5.0, *NOTHING)
            entries.append(StepRecord(2 * step + (sign > 0), t - 0.1, t, "", "reading", Settled.DWELL, {}, values))
    return entries


def seen(entries: list[object]) -> ErrorPlot:
    errors = ErrorPlot(ControlPlots.of(SIGNALS, "curvature", None))
    for part in in_parts(entries):  # type: ignore[arg-type]
        errors.see(part)
    return errors


def written(
    path: Path, entries: list[object], meta: dict[str, object], signals: tuple[Signal, ...] = SIGNALS
) -> tuple[set[str], dict[str, list[object]]]:
    """Return the origins of the views of a recording, and what changes in it."""
    writer = Writer(signals, meta)
    writer.open(path, None)
    writer.write(entries)  # type: ignore[arg-type]
    writer.arrange()
    writer.recording.close()
    reader = RrdReader(path)
    (blueprint,) = reader.blueprints()
    origins = set()
    for chunk in reader.stream(store=blueprint):
        batch = chunk.to_record_batch()
        if VIEWS in batch.schema.names:
            origins.add(batch.column(VIEWS).to_pylist()[0][0])
    values: dict[str, list[object]] = {}
    for chunk in reader.stream():
        if not chunk.is_static:
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                values.setdefault(f"{chunk.entity_path} {name.rpartition(':')[2]}", []).extend(
                    batch.column(name).to_pylist()
                )
    return origins, values


def test_the_loops_of_a_protocol_are_those_of_its_slots() -> None:
    slots = {
        "drive": slot("drive", "supply_voltage", "V", (0.0, 3.0)),
        "force": slot("force", "load_cell_force", "N"),
        "response": slot("response", "wire_end_position", "m", (0.0, 1e-3)),
    }
    rig = DashboardLayout(
        input="supply_voltage",
        output="load_cell_force",
        input_range=(-0.1, 3.2),
        output_range=(-1.0, 12.0),
        plane=(0.2, 2.8),
    )
    layout = find_protocol("force-control").views
    assert layout is not None
    found = layout.layout(slots, rig)
    assert found is not None
    assert (found.input, found.output, found.loops) == ("supply_voltage", "load_cell_force", ())
    assert (found.output_range, found.plane) == ((-1.0, 12.0), (0.2, 2.8))
    # Without a table of the rig by the ranges of the slots, and without these not at all.
    found = Views(loops=(("drive", "response"), ("force", "response"), ("other", "drive"))).layout(slots, None)
    assert found is not None
    assert found.plane == (0.0, 3.0)
    assert found.output_range == pytest.approx((-5e-5, 1.05e-3))
    assert not found.loops
    assert Views(loops=(("force", "response"),)).layout(slots, None) is None
    assert Views(over_time=("force", "other")).signals_over_time(slots) == ["load_cell_force"]


def test_the_error_is_shown_on_the_scale_of_the_last_targets() -> None:
    errors = seen(targets([50.0] * 5))
    # The last target has not ended.
    assert errors.rms() == ("RMS of the last 4 targets", pytest.approx(50.0))
    assert errors.range() == 64.0
    errors = seen([*targets([50.0] * 5 + [0.15] * 10), End("completed", "")])
    assert errors.rms() == ("RMS of the last 10 targets", pytest.approx(0.15))
    assert errors.range() == 0.25
    assert errors.seconds_bright(48.0) == pytest.approx(48.0 - 3.2 * 6)


def test_the_error_of_a_moving_reference_is_shown_on_the_scale_of_the_data() -> None:
    def tick(k: int, error: float) -> Tick:
        return Tick(0.1 * k, 0, (60.0, 60.1, 500.0 + error, 500.0, 500.0, 0.0, 3.0))

    noise = np.random.default_rng(0).normal(scale=8.0, size=4000)
    errors = seen([*(tick(k, 4e3) for k in range(100)), *(tick(k, error) for k, error in enumerate(noise))])
    name, rms = errors.rms()
    assert name == "RMS of the error of late"
    assert rms == pytest.approx(8.0, rel=0.05)
    assert errors.range() is None
    # The reading at the end of the loop is no target.
    errors.see(StepRecord(0, 0.0, 500.0, "", "", Settled.CONTROLLED, {}, (60.0, 60.1, 900.0, *NOTHING)))
    assert errors.rms()[0] == name


def test_only_views_with_something_to_show_are_there(tmp_path: Path) -> None:
    origins, _ = written(tmp_path / "closed.rrd", targets([1.0] * 3), META)
    assert {"/control/tracking", "/control/error", "/control/disturbance", "/numbers"} <= origins
    origins, _ = written(tmp_path / "open.rrd", targets([1.0] * 3, disturbance=math.nan), META)
    assert "/control/error" in origins
    assert "/control/disturbance" not in origins
    entries = [entry for entry in targets([1.0] * 3) if isinstance(entry, StepRecord)]
    origins, _ = written(tmp_path / "none.rrd", entries, META)
    assert not {origin for origin in origins if origin.startswith("/control")}


def test_the_numbers_say_how_it_stands_and_how_it_ended(tmp_path: Path) -> None:
    _, values = written(tmp_path / "run.rrd", [*targets([0.25] * 12), End("failed", "the lamp went out")], META)
    panels = [text[0] for text in values["/numbers text"]]
    assert panels[0].startswith("# closed loop")
    assert "**0:06:40** left" in panels[0]
    assert " end" in panels[0]
    assert panels[-1].startswith("# failed")
    assert "the lamp went out" in panels[-1]
    assert "# 0.250 1/m\n\nRMS of the last 10 targets" in panels[-1]
    assert "**39.900 °C** to the interlock tec_temperature < 100 °C" in panels[-1]


def test_bounds_are_drawn_as_far_as_the_data_go(tmp_path: Path) -> None:
    ticks = [Tick(float(k), 0, (50.0, 51.0, 0.0, *NOTHING)) for k in range(3)]
    _, values = written(tmp_path / "bounds.rrd", list(ticks), META)
    paths = [path for path in values if path.startswith("/signals/temperature/bounds") and "scalars" in path]
    assert {row[0] for path in paths for row in values[path]} == {10.0, 10.5, 15.0, 90.0, 95.0, 100.0}
    assert {len(values[path]) for path in paths} == {2}
    bounds = bounds_of(META, SIGNALS)
    assert [bound.kind for bound in bounds].count("limit") == 2
    found = nearest(bounds, (95.0, 80.0, 0.0, *NOTHING))
    assert found is not None
    assert (found.name, found.margin(80.0)) == ("tec_temperature < 100 °C", 20.0)


def test_an_interlock_of_another_version_has_no_bounds() -> None:
    meta = {"rig_content": {"interlocks": [{"signal": "tec_temperature", "above": 100.0}]}}
    assert bounds_of(meta, SIGNALS) == ()


def test_a_frame_grows_with_the_data() -> None:
    frame = Frame((0.0, 8.0), (0.0, 1.0), "x", "y", 1.0, 1.0)
    assert frame.grown((0.0, 8.0), (0.2, 0.8)) is frame
    grown = frame.grown((-0.5, 8.0), (0.0, 1.3))
    assert (grown.x_range, grown.y_range) == ((-1.0, 8.0), (0.0, 1.375))


@pytest.mark.parametrize(("clock", "is_shown"), [("wall", True), ("x10", True), ("virtual", False)])
def test_how_late_loops_were_is_a_view_where_time_passes(tmp_path: Path, clock: str, *, is_shown: bool) -> None:
    late = Lateness(100.0)
    late.add(3e-4, count=20)
    late.add(2e-3, count=5)
    path = tmp_path / "late.rrd"
    end = End("completed", "", {"sine": late.to_json()})
    origins, _ = written(path, [*targets([1.0]), end], {**META, "clock": clock})
    assert ("/lateness" in origins) is is_shown
    labels = [
        label
        for chunk in RrdReader(path).stream()
        if str(chunk.entity_path) in ("/lateness/names", "/lateness/counts")
        for label in chunk.to_record_batch().column("Points2D:labels").to_pylist()[0]
    ]
    bins = ["≤ 0.1 ms", "≤ 0.2 ms", "≤ 0.5 ms", "≤ 1 ms", "≤ 2 ms"]
    assert sorted(labels) == (sorted([*bins, "0", "0", "20", "0", "5"]) if is_shown else [])


def test_the_error_that_a_witness_sees_is_told_from_the_noise_of_the_sensor(tmp_path: Path) -> None:
    signals = (*SIGNALS, Signal("witness_curvature", "1/m", "curvature", precision=2))
    noisy, true = (30.0, -30.0) * 50, (3.0, -3.0) * 50
    entries = [
        Tick(float(i), 0, (60.0, 60.1, 500.0 + noise, 500.0, math.nan, math.nan, math.nan, 500.0 + error))
        for i, (noise, error) in enumerate(zip(noisy, true, strict=True))
    ]
    errors = ErrorPlot(ControlPlots.of(signals, "curvature", None, "witness_curvature"))
    for part in in_parts(entries):
        errors.see(part)
    assert errors.rms()[1] == pytest.approx(30.0)
    assert errors.rms_of_witness() == pytest.approx(3.0)
    meta = {**META, "controls": "curvature", "slots": {"witness": {"device": "", "signal": "witness_curvature"}}}
    writer = Writer(signals, meta)
    writer.open(tmp_path / "witnessed.rrd", None)
    writer.write(entries)
    writer.write([End("completed", "")])
    writer.recording.close()
    chunks = list(RrdReader(tmp_path / "witnessed.rrd").stream())
    (error,) = [chunk for chunk in chunks if str(chunk.entity_path) == "/control/error" and not chunk.is_static]
    shown = np.array(error.to_record_batch().column("Scalars:scalars").to_pylist())
    assert shown[:, 3] == pytest.approx(true)
    texts = [
        text
        for chunk in chunks
        if str(chunk.entity_path) == "/numbers"
        for row in chunk.to_record_batch().column("TextDocument:text").to_pylist()
        for text in row
    ]
    assert "# 3.00 1/m\n\nRMS of the error of late, by the witness" in texts[-1]


LOOP = DashboardLayout(
    input="tec_temperature", output="curvature", input_range=(20.0, 90.0), output_range=(0.0, 2e3), plane=(30.0, 70.0)
)


def fast_loop(temperature: float, spread: float) -> list[object]:
    """Return the samples of a fast loop, which reads no actuator: the temperature is an old one."""
    return [
        Tick(0.2 * i, 0, (50.0 + spread * math.sin(i / 8), temperature, 500.0 + i, *NOTHING, 0.0)) for i in range(100)
    ]


def drawn(path: Path, entries: list[object]) -> tuple[set[str], list[float]]:
    """Return the origins of the views, and the inputs at which the points of the loop stand."""
    signals, meta = (*SIGNALS, LATENESS), {**META, "controls": "", "dashboard": LOOP.model_dump(mode="json")}
    origins, values = written(path, entries, meta, signals)
    return origins, [position[0] for row in values.get("/loop/data/now positions", []) for position in row]


def test_a_loop_is_shown_once_its_input_has_moved(tmp_path: Path) -> None:
    still, _ = drawn(tmp_path / "still.rrd", fast_loop(55.0, 0.01))
    moved, _ = drawn(tmp_path / "moved.rrd", fast_loop(55.0, 10.0))
    assert moved - still == {"/loop", "/plane"}


def test_the_loop_of_a_fast_loop_is_over_the_set_point(tmp_path: Path) -> None:
    _, inputs = drawn(tmp_path / "fast.rrd", fast_loop(55.0, 10.0))
    assert min(inputs) == pytest.approx(40.0, abs=0.5)
    assert max(inputs) == pytest.approx(60.0, abs=0.5)
