"""The dashboard: what it records, and that nothing it is connected to can hold a run up."""

import os
import signal
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
import rerun_cli
from cases import cases
from rerun.chunk import RrdReader
from rerun.experimental import ViewerClient

from bench.base import ConfigurationError, DataError, WallClock
from bench.dashboard import Dashboard, picture, rebuild
from bench.dashboard.live import QUEUED_TICKS
from bench.devices import Signal
from bench.identification import ModelFile
from bench.models import (
    Density,
    Linear,
    MemoryCurve,
    Model,
    Polynomial,
    PrandtlIshlinskii,
    Preisach,
    Summed,
    TwoStage,
    uniform_levels,
)
from bench.protocol import TRACES, Settled
from bench.record import FILE_NAME, Event, Journal, Lateness, Record, StepRecord, add_model
from bench.rig import DashboardLayout, XYPlot


def xy_plot(x: str, y: str, x_range: tuple[float, float], y_range: tuple[float, float]) -> XYPlot:
    return XYPlot(input=x, output=y, input_range=x_range, output_range=y_range)


SIGNALS = (
    Signal("tec_setpoint", "°C", "temperature set-point", 3),
    Signal("tec_temperature", "°C", "object temperature", 3),
    Signal("tec_sink_temperature", "°C", "sink temperature", 2),
    Signal("tec_current", "A", "TEC current", 3),
    Signal("tec_voltage", "V", "TEC voltage", 3),
    Signal("psd_position", "m", "tip deflection", 9),
    Signal("curvature", "1/m", "curvature", 2),
)
CONTROL_SIGNALS = SIGNALS + tuple(replace(signal, unit="1/m") for signal in TRACES)
LAYOUT = DashboardLayout(
    input="tec_temperature",
    output="curvature",
    input_range=(15.0, 90.0),
    output_range=(-200.0, 2000.0),
    plane=(30.0, 70.0),
    levels=20,
)
MUSCLE_SIGNALS = (
    Signal("supply_setpoint", "V", "average voltage set-point", 3),
    Signal("supply_voltage", "V", "average output voltage", 3),
    Signal("supply_current", "A", "output current", 2),
    Signal("load_cell_force", "N", "force", 3),
    Signal("wire_end_position", "m", "position", 9),
)
VOLTAGE, FORCE, LENGTH = 1, 3, 4
MUSCLE_LAYOUT = DashboardLayout(
    input="supply_voltage",
    output="load_cell_force",
    input_range=(-0.1, 3.2),
    output_range=(-1.0, 13.0),
    plane=(0.0, 3.0),
    levels=20,
    loops=(
        xy_plot("supply_voltage", "wire_end_position", (-0.1, 3.2), (-8e-3, 6e-3)),
        xy_plot("load_cell_force", "wire_end_position", (-1.0, 13.0), (-8e-3, 6e-3)),
    ),
)
LOOPS = {"/loop": (VOLTAGE, FORCE), "/loops/0": (VOLTAGE, LENGTH), "/loops/1": (FORCE, LENGTH)}
META = {
    "rig": "vo2",
    "rig_title": "VO2 microcantilever (emulated)",
    "protocol": "identify",
    "protocol_summary": "Damped oscillation of the temperature",
    "parameters": {"high": 84.0, "low": 21.0},
    "seed": 7,
    "clock": "virtual",
    "epoch": "2000-01-01T00:00:00+00:00",
    "devices": {"tec": "Meerstetter TEC-1091", "psd": "LabJack T7"},
    "operator": "lab",
    "plan": {"steps": 400, "seconds": 3200.0},
    "git": "0123456789ab",
}
_STYLE = ("radii", "colors", "draw_order", "names", "widths", "values", "markers", "marker_sizes")
# Stopping a thread of Rerun takes long only when a viewer hangs.
PATIENCE = 60.0

Tick = tuple[float, int, tuple[float, ...]]


@pytest.fixture(autouse=True)
def strict() -> Iterator[None]:
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


@pytest.fixture(autouse=True)
def no_thread_left() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    assert set(threading.enumerate()) <= before


def make_model() -> ModelFile:
    levels = uniform_levels(30.0, 70.0, 20)
    middles = (levels[1:] + levels[:-1]) / 2
    alpha, beta = np.meshgrid(middles, middles, indexing="ij")
    density = np.exp(-(((alpha - 63.5) / 3) ** 2) / 2 - ((alpha - beta - 4) / 2.5) ** 2 / 2)[np.tril_indices(20)]
    density *= 900 / (density.sum() * 4.0)
    return ModelFile("preisach", Preisach(levels, density, 1020.0, None, (21.0, 84.0), "°C", "1/m"), None)


def make_run(steps: int, ticks: int) -> Iterator[Tick | StepRecord | Event]:
    """Yield what an engine tells of a damped oscillation between 21 and 84 °C."""
    operator, random = make_model().operator, np.random.default_rng(1)
    memory = MemoryCurve.from_negative_saturation(21.0)

    def row(target: float, temperature: float) -> tuple[float, ...]:
        kappa = operator.step(memory.step(temperature), temperature)[1] - 3.3 * (temperature - 20)
        current = 0.03 * (temperature - 25)
        values = (target, temperature, 24 + current, current, 3.1 * current, kappa * 4.5e-8, kappa)
        return tuple(
            float(v + s * random.normal()) for v, s in zip(values, (0, 0, 0.1, 0.01, 0.01, 5e-9, 2), strict=True)
        )

    yield Event(0.0, "INFO", "phase", "reset")
    temperature, t = 21.0, 0.0
    for step in range(steps):
        if step == steps // 10:
            yield Event(t, "INFO", "phase", "identification")
        if step == steps // 2:
            yield Event(t, "WARN", "pause", "paused by the operator")
            t += 60.0
            yield Event(t, "INFO", "resume", "resumed")
        target = 52.5 - 31.5 * float(np.cos(2 * np.pi * 9 * step / steps) * np.exp(-2.2 * step / steps))
        started, before = t, temperature
        for tick in range(ticks):
            t = started + 8.0 * (tick + 1) / (ticks + 1)
            temperature = target + (before - target) * float(np.exp(-(t - started)))
            yield t, step, row(target, temperature)
        t, temperature = started + 8.0, target + 0.01 * float(random.normal())
        values = row(target, temperature)
        memory = memory.step(values[1])
        yield StepRecord(
            step, started, t, "", "", Settled.DWELL if step != 3 else Settled.NOT_STEADY, {"tec": target}, values
        )
    yield Event(t, "INFO", "safe-state", "tec: safe")
    yield Event(t, "INFO", "end", "completed")


def make_control_run(targets: int, ticks: int) -> Iterator[Tick | StepRecord | Event]:
    """Yield what an engine tells of a controller that is given one target after another, 20 ticks a second."""
    operator, random, nothing = make_model().operator, np.random.default_rng(2), (float("nan"),) * 4
    memory = MemoryCurve.from_negative_saturation(21.0)

    def row(temperature: float, traces: tuple[float, ...]) -> tuple[float, ...]:
        nonlocal memory
        memory = memory.step(temperature)
        kappa = operator.evaluate([temperature], memory)[-1] + float(random.normal())
        return (temperature, temperature, 24.0, 1.0, 3.0, kappa * 4.5e-8, kappa, *traces)

    yield Event(0.0, "INFO", "phase", "reset")
    # What a hold shows on the way to a reading is not settled, and no part of the loop.
    yield 2.0, 0, row(35.0, nothing)
    yield StepRecord(0, 0.0, 8.0, "", "reset", Settled.DWELL, {"tec": 21.0}, row(21.0, nothing))
    yield Event(8.0, "INFO", "phase", "closed loop")
    t, step, temperature = 8.0, 1, 21.0
    for target in range(targets):
        goal = 62.0 + 6.0 * float(np.cos(2.4 * target) * np.exp(-target / targets))
        started, before, prior = t, temperature, target == 0
        for tick in range(ticks):
            t = started + 0.05 * (tick + 1)
            temperature = goal + (before - goal) * float(np.exp(started - t)) + 0.003 * float(random.normal())
            values = row(temperature, (20.0 * goal, 20.0 * temperature, 30.0 * target, 6e4 if prior else 5.0))
            if tick == 30:
                values = (*values[:6], float("nan"), *values[7:])
            yield t, step, values
        # A controller ends with a tick and a reading in one instant; then it is read again where it stands.
        yield StepRecord(step, started, t, "", "reach", Settled.DWELL, {"tec": goal}, values)
        yield t + 0.1, step + 1, row(temperature, nothing)
        yield StepRecord(step + 1, t, t + 0.2, "", "reading", Settled.DWELL, {}, row(temperature, nothing))
        t, step = t + 0.2, step + 2
    yield Event(t, "INFO", "end", "completed")


def make_stage(
    ends: tuple[float, float], rise: tuple[float, float], width: float, units: tuple[str, str]
) -> Preisach:
    """Return an operator that rises by `rise` between `ends`, with loops of some width."""
    levels = uniform_levels(*ends, 24)
    middles = (levels[1:] + levels[:-1]) / 2
    alpha, beta = np.meshgrid(middles, middles, indexing="ij")
    density = np.exp(-((((alpha - beta) - width) / width) ** 2) - ((alpha + beta - sum(ends)) / (2 * width)) ** 2)
    stage = Preisach(levels, density[np.tril_indices(24)], input_unit=units[0], output_unit=units[1])
    low, high = rise
    scale = 0.5 * (high - low) / (stage.density @ stage.cell_areas())
    return Preisach(levels, stage.density * scale, 0.5 * (low + high), input_unit=units[0], output_unit=units[1])


def make_wire() -> TwoStage:
    force = make_stage((0.0, 3.0), (0.3, 10.0), 0.6, ("V", "N"))
    return TwoStage(force, make_stage((-11.5, 11.5), (-6e-3, 5e-3), 3.0, ("N", "m")), 0.3)


def make_plays(units: tuple[str, str]) -> PrandtlIshlinskii:
    return PrandtlIshlinskii(
        np.array([0.0, 1.0]),
        np.array([1.0, 0.5]),
        0.0,
        0.0,
        input_range=(-12.0, 12.0),
        input_unit=units[0],
        output_unit=units[1],
    )


def make_muscle_run() -> Iterator[Tick | StepRecord | Event]:
    """Yield what an engine tells of a wire under one load after another, and then between fixed ends."""
    wire, random, t, step = make_wire(), np.random.default_rng(3), 0.0, 0
    state = wire.initial_state()
    swing = [1.5 - 1.5 * float(np.cos(0.35 * n) * np.exp(-n / 60)) for n in range(72)]
    for load in (1.0, 3.5, 6.0, None):
        text = "force over voltage" if load is None else f"length over voltage at {load:g} N"
        yield Event(t, "INFO", "phase", text)
        state, _ = wire.step(state, 0.0, load or 0.3)
        for voltage in swing:
            state, length = (
                wire.move(state, voltage, state.argument) if load is None else wire.step(state, voltage, load)
            )
            noisy = (state.force + 0.02 * random.normal(), length + 2e-5 * random.normal())
            values = (voltage, voltage, 0.8 * voltage, *map(float, noisy))
            yield t + 15.0, step, values
            yield StepRecord(step, t, t + 30.0, "", "", Settled.DWELL, {"supply": voltage}, values)
            t, step = t + 30.0, step + 1
    yield Event(t, "INFO", "end", "completed")


def keep_journal(
    folder: Path,
    entries: list[Tick | StepRecord | Event],
    signals: tuple[Signal, ...] = SIGNALS,
    controls: str = "",
    dashboard: dict[str, object] | None = None,
    models: dict[str, object] | None = None,
) -> Path:
    meta = {**META, "run": folder.name, "controls": controls, "dashboard": dashboard or to_table(LAYOUT)}
    folder.mkdir()
    # The file need not outlive a power cut here.
    journal = Journal(folder / FILE_NAME, signals, meta, flushed=False)
    for entry in entries:
        if isinstance(entry, StepRecord):
            journal.step(entry)
        elif isinstance(entry, Event):
            journal.event(entry)
        else:
            journal.telemetry(*entry)
    journal.finish(status="completed", reason="", finished=1e4, safe_state={"tec": "safe"})
    journal.close()
    if models is None:
        polynomial = Polynomial(np.array([1.0, 2.0]), (20.0, 90.0), input_unit="°C", output_unit="1/m")
        models = {
            "polynomial": ModelFile("polynomial", polynomial, None).to_json(),
            "preisach": make_model().to_json(),
        }
    for i, (name, model) in enumerate(models.items()):
        add_model(folder, name, float(i), model)
    return folder


def to_table(layout: DashboardLayout) -> dict[str, object]:
    return layout.model_dump(mode="json")


def keep_muscle_journal(
    folder: Path, models: dict[str, object], layout: DashboardLayout = MUSCLE_LAYOUT, most: int | None = 20
) -> Path:
    """Return the recording made of a journal of the first entries about a wire with these models."""
    entries = list(make_muscle_run())[:most]
    keep_journal(folder, entries, MUSCLE_SIGNALS, dashboard=to_table(layout), models=models)
    with Record(folder) as record:
        rebuild(record, folder / "rebuilt.rrd")
    return folder / "rebuilt.rrd"


def tell(dashboard: Dashboard, entries: list[Tick | StepRecord | Event]) -> None:
    for entry in entries:
        if isinstance(entry, StepRecord):
            dashboard.step(entry)
        elif isinstance(entry, Event):
            dashboard.event(entry)
        else:
            dashboard.telemetry(*entry)


def make_dashboard(
    path: Path | None,
    *,
    live: bool = False,
    port: int = 0,
    layout: DashboardLayout | None = LAYOUT,
    signals: tuple[Signal, ...] = SIGNALS,
    controls: str = "",
    models: Sequence[ModelFile] = (),
) -> Dashboard:
    meta = {**META, "run": "run", "controls": controls, "dashboard": layout and to_table(layout)}
    return Dashboard(signals, meta, path=path, live=live, port=port, models=models)


def read(path: Path) -> dict[str, dict[str, list[object]]]:
    """Return the columns of each entity of an .rrd, by the last part of the component's name."""
    found: dict[str, dict[str, list[object]]] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        columns = found.setdefault(str(chunk.entity_path), {})
        for field, column in zip(batch.schema, batch.columns, strict=True):
            if "RowId" not in field.name:
                values = column.cast("int64") if field.name == "t" else column
                columns.setdefault(field.name.rpartition(":")[2], []).extend(values.to_pylist())
    return found


def read_views(path: Path) -> dict[str, str]:
    """Return the names of the views of an .rrd's blueprint, by what they show."""
    reader, views = RrdReader(path), {}
    (blueprint,) = reader.blueprints()
    for chunk in reader.stream(store=blueprint):
        batch = chunk.to_record_batch()
        columns = {field.name: column for field, column in zip(batch.schema, batch.columns, strict=True)}
        if "ViewBlueprint:display_name" in columns:
            origin, name = (columns[f"ViewBlueprint:{key}"].to_pylist() for key in ("space_origin", "display_name"))
            views[origin[0][0]] = name[0][0]
    return views


def table(columns: dict[str, list[object]], component: str) -> tuple[np.ndarray, np.ndarray, list[object]]:
    """Return times in s, step numbers and values in order of time; static rows left out."""
    order = np.argsort(np.array(columns["t"], dtype=np.int64), kind="stable")
    t = np.array(columns["t"], dtype=np.float64)[order] / 1e9
    values = columns[component][-len(t) :]
    return t, np.array(columns["step"])[order], [values[i] for i in order]


@pytest.fixture(scope="module")
def entries() -> list[Tick | StepRecord | Event]:
    return list(make_run(400, 5))


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory, entries: list[Tick | StepRecord | Event]) -> Path:
    return keep_journal(tmp_path_factory.mktemp("runs") / "run", entries)


@pytest.fixture(scope="module")
def rebuilt(run_folder: Path) -> Path:
    with Record(run_folder) as record:
        rebuild(record, run_folder / "rebuilt.rrd")
    return run_folder / "rebuilt.rrd"


@pytest.fixture(scope="module")
def muscle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    models = {"two-stage": ModelFile("two-stage", make_wire()).to_json()}
    return keep_muscle_journal(tmp_path_factory.mktemp("runs") / "run", models, most=None)


@pytest.fixture(scope="module")
def control_entries() -> list[Tick | StepRecord | Event]:
    return list(make_control_run(12, 100))


@pytest.fixture(scope="module")
def control_folder(
    tmp_path_factory: pytest.TempPathFactory, control_entries: list[Tick | StepRecord | Event]
) -> Path:
    folder = keep_journal(tmp_path_factory.mktemp("runs") / "run", control_entries, CONTROL_SIGNALS, "curvature")
    with Record(folder) as record:
        rebuild(record, folder / "rebuilt.rrd")
    return folder


def test_a_rebuilt_recording_holds_what_the_journal_holds(run_folder: Path, rebuilt: Path) -> None:
    found = read(rebuilt)
    with Record(run_folder) as record:
        ticks, steps, events = record.telemetry(), list(record.step_records()), record.events()
    t, step, values = table(found["/signals/temperature"], "scalars")
    np.testing.assert_allclose(t, ticks["t"], atol=1e-9)
    np.testing.assert_array_equal(step, ticks["step"])
    temperatures = np.column_stack([ticks[s.name] for s in SIGNALS if s.unit == "°C"])
    np.testing.assert_array_equal(np.array(values), temperatures)
    _, _, micrometres = table(found["/signals/position"], "scalars")
    np.testing.assert_allclose(np.array(micrometres)[:, 0], ticks["psd_position"] * 1e6, rtol=1e-12)

    t, step, values = table(found["/readings/curvature"], "scalars")
    np.testing.assert_allclose(t, [s.finished for s in steps], atol=1e-9)
    np.testing.assert_array_equal(step, [s.step for s in steps])
    np.testing.assert_array_equal(np.array(values)[:, 0], [s.values[6] for s in steps])

    t, _, texts = table(found["/events"], "text")
    np.testing.assert_allclose(t, [e.t for e in events], atol=1e-9)
    assert [text[0].partition("  ")[2] for text in texts] == [e.text for e in events]


def test_loop_and_memory_curve_follow_the_readings(entries: list[Tick | StepRecord | Event], rebuilt: Path) -> None:
    found = read(rebuilt)
    steps = [entry for entry in entries if isinstance(entry, StepRecord)]
    points = np.array([(s.values[1], s.values[6]) for s in steps])
    _, _, path = table(found["/loop/data/path"], "strips")
    segments = np.array(path)[:, 0]
    np.testing.assert_allclose(segments[:, 1], points, rtol=1e-6)
    np.testing.assert_allclose(segments[1:, 0], points[:-1], rtol=1e-6)
    _, _, curves = table(found["/plane/data/memory"], "strips")
    memory = MemoryCurve.from_negative_saturation(points[0, 0])
    for (curve,), value in zip(curves, points[:, 0], strict=True):
        memory = memory.step(value)
        np.testing.assert_allclose(curve, memory.corners(30.0, 70.0), rtol=1e-6)


def test_states_are_told_once_when_they_change(rebuilt: Path) -> None:
    found = read(rebuilt)
    _, _, phases = table(found["/state/phase"], "state")
    assert phases == [["reset"], ["identification"]]
    _, _, states = table(found["/state/run"], "state")
    expected = ["running", "not settled", "running", "paused", "running", "safe", "completed"]
    assert [state[0] for state in states] == expected


def test_the_density_of_a_model_is_drawn(rebuilt: Path) -> None:
    found = read(rebuilt)
    assert len(found["/plane/density"]["buffer"]) == 1
    assert ["preisach", "density [(1/m)/°C²]"] in found["/plane/legend/title"]["labels"]


def test_every_loop_follows_the_readings(muscle: Path) -> None:
    found = read(muscle)
    steps = [entry for entry in make_muscle_run() if isinstance(entry, StepRecord)]
    for path, axes in LOOPS.items():
        points = np.array([[record.values[column] for column in axes] for record in steps])
        t, step, strips = table(found[f"{path}/data/path"], "strips")
        np.testing.assert_allclose(t, [record.finished for record in steps], atol=1e-9)
        np.testing.assert_array_equal(step, [record.step for record in steps])
        segments = np.array(strips)[:, 0]
        np.testing.assert_allclose(segments[:, 1], points, rtol=1e-6)
        np.testing.assert_allclose(segments[1:, 0], points[:-1], rtol=1e-6)
        now = np.array(table(found[f"{path}/data/now"], "positions")[2])[:, 0]
        np.testing.assert_allclose(now, points, rtol=1e-6)
    assert len(table(found["/plane/data/memory"], "strips")[0]) == len(steps)


def test_every_loop_has_its_axes(muscle: Path) -> None:
    found = read(muscle)
    voltage, force, position = "average output voltage [V]", "force [N]", "position [mm]"
    assert found["/loop/axes/titles"]["labels"] == [[voltage, force]]
    assert found["/loops/0/axes/titles"]["labels"] == [[voltage, position]]
    assert found["/loops/1/axes/titles"]["labels"] == [[force, position]]
    # Voltages below, millimetres beside.
    expected = ["0", "0.5", "1", "1.5", "2", "2.5", "3", "-7.5", "-5", "-2.5", "0", "2.5", "5"]
    assert found["/loops/0/axes/ticks"]["labels"] == [expected]
    # The frame of a loop is as high and wide as that of any other.
    for path, (x, y) in LOOPS.items():
        (matrix,), (shift,) = (found[f"{path}/data"][key][0] for key in ("mat3x3", "translation"))
        ranges = {VOLTAGE: (-0.1, 3.2), FORCE: (-1.0, 13.0), LENGTH: (-8e-3, 6e-3)}
        corners = np.array(list(zip(ranges[x], ranges[y], strict=True)))
        placed = corners * (matrix[0], matrix[4]) + shift[:2]
        np.testing.assert_allclose(placed, [(0.0, 0.0), (1.15, -1.0)], atol=1e-6)


def test_views_are_named_after_what_they_show(muscle: Path, rebuilt: Path) -> None:
    views = read_views(muscle)
    assert {origin: name for origin, name in views.items() if origin.startswith(("/loop", "/plane"))} == {
        "/loop": "load_cell_force over supply_voltage",
        "/loops/0": "wire_end_position over supply_voltage",
        "/loops/1": "wire_end_position over load_cell_force",
        "/plane": "Preisach plane",
        "/planes/H2": "Preisach plane of H2",
    }
    assert {
        "/signals/force": "Force [N]",
        "/events": "Log",
        "/card": "Run card",
        "/state": "Protocol: completed",
    }.items() <= (views.items())
    views = read_views(rebuilt)
    assert views["/loop"] == "VO2 microcantilever (emulated)"
    assert views["/plane"] == "Preisach plane"
    assert not [origin for origin in views if origin.startswith(("/loops", "/planes"))]


def test_both_densities_of_a_two_stage_model_are_drawn(muscle: Path) -> None:
    found = read(muscle)
    assert found["/plane/legend/title"]["labels"] == [["two-stage", "density H1 [N/V²]"]]
    assert found["/planes/H2/legend/title"]["labels"] == [["two-stage", "density H2 [µm/N²]"]]
    assert found["/plane/axes/titles"]["labels"] == [["β [V]", "α [V]"]]
    assert found["/planes/H2/axes/titles"]["labels"] == [["β [N]", "α [N]"]]
    wire = make_wire()
    for path, stage, factor in (("/plane", wire.first, 1.0), ("/planes/H2", wire.second, 1e6)):
        assert len(found[f"{path}/density"]["buffer"]) == 1
        assert found[f"{path}/legend/ends"]["labels"] == [["0", f"{factor * stage.density.max():.3g}"]]
        (matrix,), (shift,) = (found[f"{path}/density"][key][0] for key in ("mat3x3", "translation"))
        # 24 levels of ten pixels each fill the frame, the first row at the top.
        np.testing.assert_allclose([240 * matrix[0], 240 * matrix[4]], [1.15, 1.0], rtol=1e-6)
        np.testing.assert_allclose(shift[:2], [0.0, -1.0], atol=1e-6)
    # What the second stage remembers is no input that is measured: the model follows the readings.
    assert "/plane/data/memory" in found
    state, readings = wire.initial_state(), [e for e in make_muscle_run() if isinstance(e, StepRecord)]
    _, _, curves = table(found["/planes/H2/data/memory"], "strips")
    assert len(curves) == len(readings)
    for reading, (curve,) in zip(readings, curves, strict=True):
        state, _ = wire.step(state, reading.values[VOLTAGE], reading.values[FORCE])
        np.testing.assert_allclose(curve, state.second.corners(-11.5, 11.5), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("model", "planes"),
    [
        (TwoStage(make_plays(("V", "N")), make_wire().second), {"/planes/H2": "density H2 [µm/N²]"}),
        (TwoStage(make_wire().first, make_plays(("N", "m"))), {"/plane": "density H1 [N/V²]"}),
        (TwoStage(make_plays(("V", "N")), make_plays(("N", "m"))), {}),
        (
            Summed(make_wire().second, make_stage((0.0, 3.0), (0.0, 8e-3), 0.6, ("V", "m"))),
            {"/planes/H3": "density H3 [µm/N²]", "/plane": "density H4 [mm/V²]"},
        ),
        (Linear(3.0, 0.5, make_wire().second, (0.0, 3.0), voltage_unit="V"), {"/planes/H5": "density H5 [µm/N²]"}),
    ],
)
def test_stages_that_have_a_density_are_drawn(
    tmp_path: Path, model: TwoStage | Summed | Linear, planes: dict[str, str]
) -> None:
    path = keep_muscle_journal(tmp_path / "run", {"wire": ModelFile("wire", model).to_json()})
    found = read(path)
    titles = {origin: found[origin + "/legend/title"]["labels"][0][1] for origin in planes}
    assert titles == planes
    drawn = {entity.removesuffix("/density") for entity in found if entity.endswith("/density")}
    assert drawn == planes.keys()
    own = {origin for origin in planes if origin != "/plane"}
    assert {origin for origin in read_views(path) if origin.startswith("/planes")} == own


def test_the_force_of_a_stage_is_never_taken_for_the_measured_one(tmp_path: Path) -> None:
    first, second = MUSCLE_LAYOUT.plots["loops.1."], MUSCLE_LAYOUT.plots[""]
    layout = MUSCLE_LAYOUT.model_copy(update={"plane": (0.0, 12.0), "loops": (second,), **first.model_dump()})
    path = keep_muscle_journal(tmp_path / "run", {"wire": ModelFile("wire", make_wire()).to_json()}, layout)
    found = read(path)
    assert "/plane/density" not in found
    assert found["/plane/axes/titles"]["labels"] == [["β [N]", "α [N]"]]
    assert found["/planes/H1/axes/titles"]["labels"] == [["β [V]", "α [V]"]]
    assert found["/planes/H2/axes/titles"]["labels"] == [["β [N]", "α [N]"]]
    assert {"/planes/H1", "/planes/H2"} <= read_views(path).keys()


def test_an_operator_over_another_signal_has_its_own_plane(tmp_path: Path) -> None:
    models = {
        "force": ModelFile("force", make_wire().first, None).to_json(),
        "length": ModelFile("length", make_wire().second, None).to_json(),
    }
    path = keep_muscle_journal(tmp_path / "run", models)
    found = read(path)
    assert found["/plane/legend/title"]["labels"] == [["force", "density [N/V²]"]]
    assert found["/planes/length/legend/title"]["labels"] == [["length", "density [µm/N²]"]]
    assert read_views(path)["/planes/length"] == "Preisach plane of length"


@cases("document", [{"format": "bench-other-model", "version": 1}, None])
def test_other_models_are_left_out(tmp_path: Path, document: object) -> None:
    models = {"two-stage": ModelFile("two-stage", make_wire()).to_json(), "other": document}
    found = read(keep_muscle_journal(tmp_path / "run", models))
    assert found["/plane/legend/title"]["labels"] == [["two-stage", "density H1 [N/V²]"]]
    assert found["/planes/H2/legend/title"]["labels"] == [["two-stage", "density H2 [µm/N²]"]]


def test_a_damaged_model_is_named(tmp_path: Path) -> None:
    document = ModelFile("two-stage", make_wire()).to_json()
    with pytest.raises(DataError, match="model two-stage is damaged: key 'model' is missing"):
        keep_muscle_journal(tmp_path / "run", {"two-stage": {k: v for k, v in document.items() if k != "model"}})
    assert not (tmp_path / "run" / "rebuilt.rrd").exists()


@pytest.mark.parametrize("controls", ["", "curvature"])
def test_live_and_rebuilt_recordings_are_equal(tmp_path: Path, request: pytest.FixtureRequest, controls: str) -> None:
    if controls:
        entries, signals = request.getfixturevalue("control_entries"), CONTROL_SIGNALS
        rebuilt = request.getfixturevalue("control_folder") / "rebuilt.rrd"
    else:
        entries, signals, rebuilt = request.getfixturevalue("entries"), SIGNALS, request.getfixturevalue("rebuilt")
    path, models = tmp_path / "live.rrd", [make_model()]
    with make_dashboard(path, signals=signals, controls=controls, models=models) as dashboard:
        tell(dashboard, entries[:777])
        # Whatever is handed over at once makes no difference.
        wait_until(lambda: not dashboard._queue.qsize())
        tell(dashboard, entries[777:])
        dashboard.finish("completed", "")
    assert dashboard.dropped == 0
    live, again = read(tmp_path / "live.rrd"), read(rebuilt)
    assert live.keys() == again.keys()
    for path in live:
        if "/__properties" in path or path == "/card":
            continue
        assert live[path].keys() == again[path].keys(), path
        for component in live[path]:
            if "t" in live[path] and component not in _STYLE:
                mine, theirs = table(live[path], component), table(again[path], component)
                np.testing.assert_array_equal(mine[0], theirs[0])
                np.testing.assert_array_equal(mine[1], theirs[1])
                if component == "scalars":
                    # Where nan is nan's equal.
                    np.testing.assert_array_equal(mine[2], theirs[2], path)
                else:
                    assert mine[2] == theirs[2], path


def test_the_card_says_at_the_end_how_late_loops_were(tmp_path: Path) -> None:
    late = Lateness(100.0)
    late.add(3e-4, count=20)
    path = tmp_path / "late.rrd"
    with make_dashboard(path) as dashboard:
        dashboard.finish("completed", "", {"sine": late.to_json()})
    # The newest one is shown.
    *_, (text,) = read(path)["/card"]["text"]
    assert "lateness of sine: 20 samples at 100 Hz, 0 left out; mean 0.3 ms, worst 0.3 ms" in text
    assert "≤ 0.5 ms        20" in text


def test_a_control_run_shows_reference_error_and_disturbance(control_folder: Path) -> None:
    found = read(control_folder / "rebuilt.rrd")
    with Record(control_folder) as record:
        ticks = record.telemetry()
    reference, output, sigma = ticks["reference"], ticks["curvature"], ticks["disturbance_uncertainty"]
    # The first target has nothing to go by: its uncertainty is beyond all that is shown.
    band = np.where(sigma < 1e3, 2 * sigma, np.nan)
    zero = 0 * reference
    expected = {
        "tracking": [reference, ticks["predicted"], output],
        "error": [zero - band, zero + band, output - reference],
        "disturbance": [ticks["disturbance"] - band, ticks["disturbance"] + band, ticks["disturbance"]],
    }
    for name, series in expected.items():
        t, step, values = table(found[f"/control/{name}"], "scalars")
        np.testing.assert_allclose(t, ticks["t"], atol=1e-9)
        np.testing.assert_array_equal(step, ticks["step"])
        np.testing.assert_allclose(np.array(values), np.column_stack(series), rtol=1e-12)
        assert [len(names) for names in found[f"/control/{name}"]["names"] if names] == [len(series)]
    error = np.array(table(found["/control/error"], "scalars")[2])[:, 2]
    assert np.isnan(error).sum() == 13 + 12  # ticks without a controller, and those without an output
    curvature = np.array(table(found["/signals/curvature"], "scalars")[2])
    np.testing.assert_array_equal(curvature, output[:, None])


def test_loop_and_memory_curve_follow_the_ticks_under_control(
    control_entries: list[Tick | StepRecord | Event], control_folder: Path
) -> None:
    found = read(control_folder / "rebuilt.rrd")
    points = [
        (entry[0], False, entry[2][1], entry[2][6])
        if isinstance(entry, tuple)
        else (entry.finished, True, entry.values[1], entry.values[6])
        for entry in control_entries
        if isinstance(entry, StepRecord) or (isinstance(entry, tuple) and np.isfinite(entry[2][7]))
    ]
    told, is_reading, inputs, outputs = (np.array(column) for column in zip(*points, strict=True))
    t, _, curves = table(found["/plane/data/memory"], "strips")
    reset = MemoryCurve.from_negative_saturation(inputs[0])
    for at, (curve,) in zip(t, curves, strict=True):
        until = np.searchsorted(told, at + 1e-6)
        np.testing.assert_allclose(curve, reset.advance(inputs[:until]).corners(30.0, 70.0), rtol=1e-6)
    # Every reading, and of the ticks what an eye can tell.
    readings = set(np.round(told[is_reading], 6))
    assert readings <= set(np.round(t, 6))
    assert 12 * 20 < len(t) < 12 * 52
    between = [at for at in t if round(at, 6) not in readings]
    assert np.diff(between).min() > 0.099
    latest = np.array(table(found["/loop/data/now"], "positions")[2])[:, 0]
    shown = np.searchsorted(t, told + 1e-6) - 1
    waiting = np.isfinite(outputs) & (told - t[shown] > 0.16)
    assert waiting.any()
    moved = abs(latest[shown] - np.column_stack([inputs, outputs]))[waiting]
    assert np.all(moved <= (0.002 * 40.0 * 1.001, 0.002 * 2200.0 * 1.001))

    strips = [np.array(strip) for (strip,) in table(found["/loop/data/path"], "strips")[2]]
    np.testing.assert_array_equal([strip[-1] for strip in strips], latest)
    np.testing.assert_array_equal([strip[0] for strip in strips[1:]], latest[:-1])
    assert max(len(strip) for strip in strips) > 2
    assert np.isfinite(np.concatenate(strips)).all()


def test_a_controller_that_holds_its_target_is_not_drawn_again(tmp_path: Path) -> None:
    values = (60.0, 60.0, 24.0, 1.0, 3.0, 1e-6, 900.0, 900.0, 900.0, 0.0, 1.0)
    with make_dashboard(tmp_path / "run.rrd", signals=CONTROL_SIGNALS, controls="curvature") as dashboard:
        dashboard.step(StepRecord(0, 0.0, 8.0, "", "", Settled.DWELL, {}, values))
        for tick in range(1_000):
            noise = 0.01 * (-1) ** tick
            dashboard.telemetry(8.0 + tick, 1, (60.0, 60.0 + noise, *values[2:6], 900.0 + noise, *values[7:]))
    found = read(tmp_path / "run.rrd")
    assert len(table(found["/plane/data/memory"], "strips")[0]) == 1
    assert len(table(found["/control/error"], "scalars")[0]) == 1_000


def test_loops_are_drawn_independently_under_control(tmp_path: Path) -> None:
    nan, values = float("nan"), (60.0, 60.0, 24.0, 1.0, 3.0, 1e-6, 900.0, 900.0, 900.0, 0.0, 1.0)
    further = xy_plot("tec_current", "tec_voltage", (-2.0, 2.0), (-4.0, 4.0))
    layout = LAYOUT.model_copy(update={"loops": (further,)})
    rows = [
        (60.0, 900.0, 1.0, 3.0),
        (60.0, 1000.0, 1.0, 3.0),  # moves the first loop
        (60.0, 1000.0, 1.05, 3.0),  # moves the second one
        (65.0, nan, 1.05, 3.5),  # leaves a gap in the first
        (65.0, 1000.0, 1.051, 3.501),  # cannot be told from the last in the second
    ]
    path = tmp_path / "run.rrd"
    with make_dashboard(path, layout=layout, signals=CONTROL_SIGNALS, controls="curvature") as dashboard:
        dashboard.step(StepRecord(0, 0.0, 8.0, "", "", Settled.DWELL, {}, values))
        for i, (temperature, curvature, current, voltage) in enumerate(rows[1:], 1):
            row = (60.0, temperature, 24.0, current, voltage, 1e-6, curvature, *values[7:])
            dashboard.telemetry(8.0 + i, 1, row)
    assert dashboard.dropped == 0
    found = read(path)
    expected = {"/loop": ([0, 1, 4], [0, 1]), "/loops/0": ([0, 2, 3], [2, 3])}
    for loop, (drawn, columns) in expected.items():
        t, _, strips = table(found[f"{loop}/data/path"], "strips")
        np.testing.assert_allclose(t, [8.0 + i for i in drawn])
        np.testing.assert_allclose(
            [strip[0][-1] for strip in strips], [[rows[i][column] for column in columns] for i in drawn], rtol=1e-6
        )
    # A reading that is not a number moves the memory all the same.
    curves = [np.array(curve[0]) for curve in table(found["/plane/data/memory"], "strips")[2]]
    assert [curve[-1, 0] for curve in curves] == [60.0, 60.0, 65.0]


def test_a_control_run_of_a_rig_without_a_loop_still_shows_the_control(
    tmp_path: Path, control_entries: list[Tick | StepRecord | Event]
) -> None:
    path = tmp_path / "run.rrd"
    with make_dashboard(path, layout=None, signals=CONTROL_SIGNALS, controls="curvature") as dashboard:
        tell(dashboard, control_entries)
    assert dashboard.dropped == 0
    found = read(path)
    assert len(table(found["/control/error"], "scalars")[0]) == sum(isinstance(e, tuple) for e in control_entries)
    assert "/signals/curvature" in found
    assert not [path for path in found if path.startswith(("/loop", "/plane"))]


@cases(("signals", "controls"), [(CONTROL_SIGNALS, "x"), (SIGNALS, "curvature")])
def test_what_is_controlled_must_be_among_the_signals(
    tmp_path: Path, signals: tuple[Signal, ...], controls: str
) -> None:
    with pytest.raises(ConfigurationError, match="controls: there is no signal"):
        make_dashboard(tmp_path / "run.rrd", signals=signals, controls=controls)
    assert not (tmp_path / "run.rrd").exists()


def test_readings_that_are_not_numbers_leave_a_gap(tmp_path: Path) -> None:
    values = (20.0, float("nan"), 20.0, 0.0, 0.0, 0.0, 0.0)
    record = StepRecord(0, 0.0, 8.0, "", "", Settled.DWELL, {}, values)
    with make_dashboard(tmp_path / "run.rrd") as dashboard:
        dashboard.step(record)
        dashboard.step(replace(record, step=1, finished=16.0, values=(20.0, 21.0, 20.0, 0.0, 0.0, 0.0, 1.0)))
    assert dashboard.dropped == 0
    found = read(tmp_path / "run.rrd")
    assert table(found["/readings/temperature"], "scalars")[1].tolist() == [0, 1]
    assert table(found["/plane/data/memory"], "strips")[1].tolist() == [1]


@cases(
    ("key", "change"),
    [
        ("dashboard: input", {"input": "x"}),
        ("dashboard: output", {"output": "x"}),
        (r"dashboard: loops\.0\.input", {"loops": (MUSCLE_LAYOUT.loops[0].model_copy(update={"input": "x"}),)}),
        (
            r"dashboard: loops\.1\.output",
            {"loops": (MUSCLE_LAYOUT.loops[0], MUSCLE_LAYOUT.loops[1].model_copy(update={"output": "x"}))},
        ),
    ],
)
def test_a_layout_must_name_signals_that_there_are(tmp_path: Path, key: str, change: dict[str, object]) -> None:
    with pytest.raises(ConfigurationError, match=f"{key}: there is no signal 'x'"):
        make_dashboard(tmp_path / "run.rrd", layout=MUSCLE_LAYOUT.model_copy(update=change), signals=MUSCLE_SIGNALS)
    assert not (tmp_path / "run.rrd").exists()


def loop_table(input_range: tuple[float, float], output_range: tuple[float, float]) -> dict[str, object]:
    return {"input": "a", "output": "b", "input_range": input_range, "output_range": output_range}


@cases(
    ("change", "key"),
    [
        ({"plane": (70.0, 30.0)}, "plane"),
        ({"loops": [loop_table((1.0, 1.0), (0.0, 1.0))]}, r"loops\.0\.input_range"),
    ],
)
def test_a_layout_must_be_possible(tmp_path: Path, change: dict[str, object], key: str) -> None:
    folder = keep_journal(tmp_path / "run", [], dashboard={**to_table(LAYOUT), **change})
    with Record(folder) as record, pytest.raises(DataError, match=rf"damaged: dashboard\.{key}"):
        rebuild(record, folder / "run.rrd")
    assert not (folder / "run.rrd").exists()


def test_a_file_is_never_overwritten(tmp_path: Path, run_folder: Path) -> None:
    path = tmp_path / "run.rrd"
    path.write_bytes(b"precious")
    with pytest.raises(ConfigurationError, match="never overwritten"):
        make_dashboard(path)
    with Record(run_folder) as record, pytest.raises(ConfigurationError, match="never overwritten"):
        rebuild(record, path)
    assert path.read_bytes() == b"precious"


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="no folder"):
        make_dashboard(tmp_path / "none" / "run.rrd")


def test_a_dashboard_must_lead_somewhere() -> None:
    with pytest.raises(ValueError, match="file or a live view"):
        make_dashboard(None)


def test_a_taken_port_gives_the_next_one() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with make_dashboard(None, live=True, port=port) as dashboard:
            assert dashboard.uri is not None
            found = int(dashboard.uri.partition("127.0.0.1:")[2].partition("/")[0])
            assert port < found < port + 50
            wait_for_server(found)


def test_no_free_port_is_an_error() -> None:
    with socket.create_server(("127.0.0.1", 65535)), pytest.raises(ConfigurationError, match="no port"):
        make_dashboard(None, live=True, port=65535)


def test_the_server_is_not_reachable_from_outside() -> None:
    with make_dashboard(None, live=True) as dashboard:
        port = port_of(dashboard)
        wait_for_server(port)
        # 127.0.0.2 is this machine, too, but not the address that the server is bound to.
        with socket.socket() as other:
            assert other.connect_ex(("127.0.0.2", port)) != 0


def test_clients_that_never_read_hold_nothing_up(tmp_path: Path) -> None:
    dashboard = make_dashboard(tmp_path / "run.rrd", live=True)
    port = port_of(dashboard)
    wait_for_server(port)
    clients = [socket.create_connection(("127.0.0.1", port)) for _ in range(3)]
    clients[1].sendall(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0]))
    clients[2].sendall(b"nonsense")
    # While none of them reads, everything is taken and the file is completed.
    feed(dashboard, 20_000)
    wait_until(lambda: not dashboard._queue.qsize())
    dashboard.close()
    wait_until(lambda: not dashboard._thread.is_alive())
    for client in clients:
        client.close()
    assert dashboard.dropped == 0
    assert len(table(read(tmp_path / "run.rrd")["/signals/temperature"], "scalars")[0]) == 20_000


@pytest.mark.seeds
def test_a_viewer_that_hangs_holds_nothing_up(tmp_path: Path) -> None:
    dashboard = make_dashboard(tmp_path / "run.rrd", live=True)
    assert dashboard.uri is not None
    wait_for_server(port_of(dashboard))
    # What a viewer does with what it gets, without a window.
    command = [str(Path(rerun_cli.__file__).parent / "rerun"), "--save", str(tmp_path / "viewer.rrd"), dashboard.uri]
    viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        feed(dashboard, 300)
        wait_until(lambda: (tmp_path / "viewer.rrd").exists() and (tmp_path / "viewer.rrd").stat().st_size > 10_000)
        os.kill(viewer.pid, signal.SIGSTOP)
        batches = feed_batches(dashboard, until=lambda: not dashboard.viewer_keeps_up)
        os.kill(viewer.pid, signal.SIGCONT)
        more = feed_batches(dashboard, until=lambda: dashboard.viewer_keeps_up)
        os.kill(viewer.pid, signal.SIGSTOP)
        again = feed_batches(dashboard, until=lambda: not dashboard.viewer_keeps_up)
        dashboard.close()
        # The file is completed while the viewer is still stopped.
        rows = 300 + 250 * (batches + more + again)
        wait_until(lambda: rows == len(read(tmp_path / "run.rrd").get("/signals/temperature", {}).get("scalars", [])))
        found = read(tmp_path / "run.rrd")
    finally:
        viewer.kill()
        viewer.wait()
    dashboard._thread.join(PATIENCE)
    assert dashboard.dropped == 0
    assert len(table(found["/signals/temperature"], "scalars")[0]) == rows
    said = [text[0].partition("  ")[2] for text in found["/events"]["text"]]
    assert [text.partition(";")[0] for text in said] == [
        "the viewer has stalled",
        "the viewer has resumed",
        "the viewer has stalled",
    ]


def test_what_rerun_cannot_take_is_dropped_counted_and_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    let_go, original = threading.Event(), rr.RecordingStream.send_columns

    def stand_still(self: rr.RecordingStream, *arguments: object, **options: object) -> None:
        let_go.wait(PATIENCE)
        original(self, *arguments, **options)

    monkeypatch.setattr(rr.RecordingStream, "send_columns", stand_still)
    dashboard = make_dashboard(tmp_path / "run.rrd")
    # Rerun stands still until it is let go; had the control thread waited for it, nothing would be lost.
    feed(dashboard, 2 * QUEUED_TICKS)
    # What matters more than telemetry still has room.
    dashboard.step(StepRecord(7, 0.0, 8.0, "", "", Settled.DWELL, {}, (0.0,) * len(SIGNALS)))
    lost = dashboard.dropped
    assert lost > 0
    let_go.set()
    dashboard.close()
    found = read(tmp_path / "run.rrd")
    assert len(table(found["/signals/temperature"], "scalars")[0]) == 2 * QUEUED_TICKS - lost
    assert table(found["/readings/temperature"], "scalars")[1].tolist() == [7]
    assert f"{lost} entries are missing" in found["/events"]["text"][-1][0]


def test_closing_is_bounded_when_rerun_stands_still(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    let_go = threading.Event()
    monkeypatch.setattr("bench.dashboard.live._CLOSE_SECONDS", 0.5)
    monkeypatch.setattr(rr.RecordingStream, "send_columns", lambda *_, **__: let_go.wait(PATIENCE))
    dashboard = make_dashboard(tmp_path / "run.rrd")
    feed(dashboard, 1_000)
    dashboard.close()
    # Closing came back although the thread still waits for Rerun.
    assert dashboard._thread.is_alive()
    let_go.set()
    dashboard._thread.join(PATIENCE)


def test_a_refused_entry_does_not_end_the_view(tmp_path: Path) -> None:
    class OfTheWrongShape(Model):
        def densities(self) -> tuple[Density, ...]:
            return (Density("", np.array([0.0, 1.0, 2.0]), np.array([[1.0]]), "°C"),)

    models = [ModelFile("of the wrong shape", OfTheWrongShape())]
    with make_dashboard(tmp_path / "run.rrd", models=models) as dashboard:
        wait_until(lambda: dashboard.dropped == 1)
        feed(dashboard, 10)
    found = read(tmp_path / "run.rrd")
    assert len(table(found["/signals/temperature"], "scalars")[0]) == 10
    assert "1 entries are missing" in found["/events"]["text"][-1][0]


def test_the_control_thread_only_puts_entries_into_the_queue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, control_entries: list[Tick | StepRecord | Event]
) -> None:
    callers, original = [], rr.RecordingStream.send_columns

    def note_the_caller(self: rr.RecordingStream, *arguments: object, **options: object) -> None:
        callers.append(threading.current_thread())
        original(self, *arguments, **options)

    monkeypatch.setattr(rr.RecordingStream, "send_columns", note_the_caller)
    with make_dashboard(tmp_path / "run.rrd", signals=CONTROL_SIGNALS, controls="curvature") as dashboard:
        tell(dashboard, control_entries)
    assert set(callers) == {dashboard._thread}
    # Batches, not rows: each entity is written at most once for every 200 entries or second.
    assert len(callers) < len(control_entries)


def test_a_picture_needs_a_recording(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no recording"):
        picture(tmp_path / "none.rrd", tmp_path / "none.png")


@pytest.mark.usefixtures("vulkan")
def test_the_viewer_draws_it_without_complaint(
    tmp_path: Path, rebuilt: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    late, screenshot = [TimeoutError("deadline has elapsed")] * 2, ViewerClient.save_screenshot

    def late_at_first(self: ViewerClient, *arguments: str) -> None:
        if late:
            raise late.pop()
        screenshot(self, *arguments)

    # On a busy machine the viewer answers too late for its client.
    monkeypatch.setattr(ViewerClient, "save_screenshot", late_at_first)
    png = tmp_path / "dashboard.png"
    assert picture(rebuilt, png, at=1700.0, size=(1280, 800)) == []
    pixels = read_png(png)
    # Without the menu bar of the viewer.
    assert pixels.shape[:2] == (764, 1280)
    # Loop, memory curve and plots fill it with colours; an empty viewer is nearly uniform.
    assert len(np.unique(pixels[:, :, :3].reshape(-1, 3), axis=0)) > 1_000
    # The middle: the loop above the plane.
    middle = pixels[:, 480:920, :3].astype(int)
    assert ((abs(middle[:400] - (236, 100, 46))).sum(axis=2) < 60).sum() > 200
    assert ((abs(middle[300:] - (22, 168, 150))).sum(axis=2) < 60).sum() > 200


@pytest.mark.usefixtures("vulkan")
@pytest.mark.seeds
def test_the_viewer_shows_three_loops_and_two_planes_at_once(tmp_path: Path, muscle: Path) -> None:
    png = tmp_path / "dashboard.png"
    assert picture(muscle, png, at=8000.0) == []
    pixels = read_png(png)
    assert pixels.shape[:2] == (964, 1600)
    # The middle: two loops; a loop and a density; a density.
    middle = pixels[40:820, 540:1190, :3].astype(int)
    cells = [cell for row in np.array_split(middle, 3) for cell in np.array_split(row, 2, axis=1)]
    for cell in cells[:3]:
        for colour in ((236, 100, 46), (58, 132, 232), (22, 168, 150)):
            assert (abs(cell - colour).sum(axis=2) < 60).sum() > 10
    for cell, is_drawn in zip(cells[3:], (True, True, False), strict=True):
        assert ((abs(cell - (244, 160, 40)).sum(axis=2) < 60).sum() > 20) == is_drawn


def test_a_recording_that_stops_is_complete_until_then(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    with make_dashboard(path) as dashboard:
        feed(dashboard, 5)
        wait_until(lambda: not dashboard._queue.qsize())
        dashboard.stop_recording()
        feed_batches(dashboard, lambda: dashboard._file is not None and not dashboard._file.recording.is_written)
        size = path.stat().st_size
        feed(dashboard, 1000, start=1000)
    assert path.stat().st_size == size
    assert len(read(path)) > 0


def feed(dashboard: Dashboard, ticks: int, start: int = 0) -> None:
    """Report ticks as fast as an emulated laboratory does."""
    values = tuple(float(i) for i in range(len(SIGNALS)))
    for i in range(start, start + ticks):
        dashboard.telemetry(0.1 * i, i, values)


def feed_batches(dashboard: Dashboard, until: Callable[[], bool]) -> int:
    """Report ticks in many batches until something happens; return how many."""
    batches, clock = 0, WallClock()
    while not until():
        assert clock.now() < PATIENCE, "it does not happen"
        feed(dashboard, 250, start=250 * batches)
        batches += 1
        while dashboard._queue.qsize():
            clock.sleep(0.001)
    return batches


def port_of(dashboard: Dashboard) -> int:
    assert dashboard.uri is not None
    return int(dashboard.uri.partition("127.0.0.1:")[2].partition("/")[0])


def wait_for_server(port: int) -> None:
    def answers() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    wait_until(answers)


def wait_until(condition: Callable[[], bool]) -> None:
    clock = WallClock()
    while not condition():
        assert clock.now() < PATIENCE, "it does not happen"
        clock.sleep(0.05)


def read_png(path: Path) -> np.ndarray:
    from matplotlib.image import imread

    return (imread(path) * 255).astype(np.uint8)
