"""The prediction band of a model on the dashboard: beside the readings, and about the set-points."""

from pathlib import Path

import numpy as np
import pytest
from other_plants import measured, random_reversals
from rerun.chunk import RrdReader

import bench as bench_functions
from bench.dashboard.entries import End, Tick
from bench.dashboard.writer import Writer
from bench.devices import Signal
from bench.identification import Candidate, ModelFile, calibrate_band, identify, input_half_widths, set_up_problem
from bench.protocol import TRACES, Settled
from bench.record import StepRecord
from bench.rig import DashboardLayout

SIGNALS = (
    Signal("supply_setpoint", "V", "set-point", 3),
    Signal("supply_voltage", "V", "voltage", 3),
    Signal("deflection", "mm", "deflection", 3),
)
CONTROLLED = (*SIGNALS, *(Signal(trace.name, "mm", trace.description, 3) for trace in TRACES))
NOTHING = (float("nan"),) * 4
LAYOUT = DashboardLayout(
    input="supply_voltage", output="deflection", input_range=(-1.1, 1.1), output_range=(-2.0, 2.0), plane=(-1.0, 1.0)
)
META = {
    "run": "run",
    "rig": "rig",
    "rig_title": "Rig",
    "protocol": "tracking",
    "protocol_summary": "",
    "parameters": {},
    "seed": 0,
    "clock": "virtual",
    "epoch": "2026-03-01T12:00:00+00:00",
    "devices": {},
    "operator": "",
    "git": "",
    "plan": {"steps": 40, "seconds": 400.0, "complete": True},
    "dashboard": LAYOUT.model_dump(mode="json"),
}
SHARED = slice(0, 2)
OTHER = slice(2, 4)


@pytest.fixture(scope="module")
def model():
    """A model with a band, of a plant of another structure."""
    rng = np.random.default_rng(0)
    inputs = random_reversals(rng)
    outputs = measured("duhem", inputs, rng)
    options = {"levels": 12, "input_unit": "V", "output_unit": "mm"}
    found = identify("preisach", inputs, outputs, **options)
    band = calibrate_band(set_up_problem(Candidate("preisach", options), inputs, outputs))
    return ModelFile("preisach", found.model, provenance={"input": "v", "output": "y"}, band=band)


def controlled(inputs, outputs):
    """Yield what is recorded of a controller that moves the set-point beside the input: ticks, a reading each 40."""
    nan = float("nan")
    # The memory moves before a controller is at work, too.
    yield Tick(0.0, 0, (0.8, 0.8, 0.0, *NOTHING))
    yield Tick(0.05, 0, (0.8, -1.0, 0.0, *NOTHING))
    for k, (u, y) in enumerate(zip(inputs.tolist(), outputs.tolist(), strict=True)):
        t = 0.1 * (k + 1)
        traces = (y + 0.1, y, 0.0, 0.01)
        yield Tick(t, 1, (u, nan if k == 7 else u, y, *traces))
        if k % 40 == 39:
            yield StepRecord(1, t, t + 0.05, "", "", Settled.DWELL, {}, (u, u, y, *NOTHING))


def readings(inputs, outputs):
    for k, (u, y) in enumerate(zip(inputs.tolist(), outputs.tolist(), strict=True)):
        yield Tick(k + 0.5, k, (u, 0.5 * u, y))
        yield StepRecord(k, float(k), k + 1.0, "", "", Settled.DWELL, {}, (u, u, y))


def written(path, entries, models, *, control=True, batch=1000):
    """Return what `read` finds in the recording of entries."""
    signals = CONTROLLED if control else SIGNALS
    writer = Writer(signals, META | {"controls": "deflection" if control else ""}, models)
    writer.open(path, None)
    everything = [*entries, End("completed", "")]
    for start in range(0, len(everything), batch):
        writer.write(everything[start : start + batch])
    writer.arrange()
    writer.recording.close()
    return read(path)


def read(path):
    """Return vectors, texts and names of lines of a recording, by entity and kind."""
    found = {}
    for chunk in RrdReader(path).stream():
        frame = chunk.to_record_batch()
        for name in frame.schema.names:
            kind = name.rpartition(":")[2]
            if kind in ("scalars", "text", "names"):
                found.setdefault((str(chunk.entity_path), kind), []).extend(frame.column(name).to_pylist())
    return {key: np.array(rows, dtype=float) if key[1] == "scalars" else rows for key, rows in found.items()}


BAND = ("/control/error/band", "scalars")
SETPOINT_BAND = ("/signals/voltage/setpoint_band", "scalars")


def ticks_of(lines, inputs):
    """Return the places of the ticks of `controlled`, but for that without an input, among all rows."""
    return np.delete(np.arange(len(lines)), [40 * (k + 1) + k - 1 for k in range(inputs.size // 40)])


def merged(lines):
    """Return lower and upper ends, and where they are those within the inputs fitted."""
    own = np.isfinite(lines[:, 0])
    assert not (own & np.isfinite(lines[:, 2])).any()
    return np.where(own, lines[:, 0], lines[:, 2]), np.where(own, lines[:, 1], lines[:, 3]), own


def test_the_band_beside_the_readings_is_that_of_predict(tmp_path, model):
    rng = np.random.default_rng(1)
    inputs = random_reversals(rng)
    outputs = measured("duhem", inputs, rng)
    found = written(tmp_path / "run.rrd", controlled(inputs, outputs), [model])
    # A tick without a measured input is left out; a reading after the controller is one row more.
    seen = np.delete(inputs, 7)
    predicted = model.operator.evaluate(seen, model.operator.advance(model.operator.initial_state(), [0.8, -1.0]))
    ticks = ticks_of(found[BAND], inputs)
    lower, upper, own = merged(found[BAND][ticks])
    # As the error: less the reference, in the unit of its plot.
    about = predicted - np.delete(outputs + 0.1, 7)
    np.testing.assert_allclose(found[BAND][ticks, 4], about, atol=1e-12)
    np.testing.assert_allclose(lower, about - model.band.half_width, atol=1e-9)
    np.testing.assert_allclose(upper, about + model.band.half_width, atol=1e-9)
    assert own.all()


def test_inputs_beyond_those_fitted_are_marked_and_counted(tmp_path, model):
    rng = np.random.default_rng(2)
    inputs = 1.2 * random_reversals(rng)
    beyond = np.delete(np.abs(inputs) > 1.0, 7)
    found = written(tmp_path / "run.rrd", controlled(inputs, measured("duhem", inputs, rng)), [model])
    ticks = ticks_of(found[BAND], inputs)
    np.testing.assert_array_equal(np.isfinite(found[BAND][ticks, OTHER]).all(axis=1), beyond)
    np.testing.assert_array_equal(np.isfinite(found[BAND][ticks, SHARED]).all(axis=1), ~beyond)
    panel = found["/numbers", "text"][-1][0]
    assert "inputs beyond those fitted, -1 to 1 V" in panel


def test_the_panel_says_how_many_readings_are_within_it(tmp_path, model):
    rng = np.random.default_rng(3)
    inputs = random_reversals(rng)
    outputs = measured("duhem", inputs, rng)
    share = {}
    for name, moved in (("same", 0.0), ("moved", 0.5)):
        found = written(tmp_path / f"{name}.rrd", readings(inputs, outputs + moved), [model], control=False)
        (line,) = (row for row in found["/numbers", "text"][-1][0].split("\n\n") if "readings within it" in row)
        assert f"of {inputs.size} readings" in line
        share[name] = float(line.strip("*").split()[0])
    assert 80.0 <= share["same"] <= 100.0
    assert share["moved"] < 10.0


def test_a_run_without_control_has_it_at_the_readings(tmp_path, model):
    rng = np.random.default_rng(4)
    inputs = random_reversals(rng)
    found = written(tmp_path / "run.rrd", readings(inputs, measured("duhem", inputs, rng)), [model], control=False)
    lines = found["/signals/mm/band", "scalars"]
    lower, upper, _ = merged(lines)
    # What a hold shows on the way to a reading moves no memory here, as in the identification.
    np.testing.assert_allclose(0.5 * (upper - lower), model.band.half_width, rtol=1e-9)


def test_the_band_about_the_setpoints_is_that_of_invert(tmp_path, model):
    inputs = np.repeat(random_reversals(np.random.default_rng(5))[::9], 12)
    found = written(tmp_path / "run.rrd", controlled(inputs, np.zeros(inputs.size)), [model])
    path = inputs[np.append(True, np.diff(inputs) != 0.0)]
    state = model.operator.advance(model.operator.initial_state(), [0.8])
    expected = input_half_widths(model.operator, path, model.band.half_width, state)
    lower, upper, _ = merged(found[SETPOINT_BAND][ticks_of(found[SETPOINT_BAND], inputs)])
    # Each is there until the next, a hole where the output hardly moves with the input.
    moves = np.cumsum(np.append(False, np.diff(inputs) != 0.0))
    np.testing.assert_allclose(0.5 * (upper - lower), np.delete(expected[moves], 7), rtol=1e-6)
    assert np.isfinite(expected).mean() > 0.7
    assert np.nanmedian(expected) < 0.2


@pytest.mark.parametrize("batch", [1, 7, 83])
def test_what_is_handed_over_at_once_makes_no_difference(tmp_path, model, batch):
    rng = np.random.default_rng(6)
    inputs = random_reversals(rng)[:100]
    entries = list(controlled(inputs, measured("duhem", inputs, rng)))
    together = written(tmp_path / "together.rrd", entries, [model])
    parted = written(tmp_path / "parted.rrd", entries, [model], batch=batch)
    for key in (BAND, SETPOINT_BAND):
        np.testing.assert_allclose(parted[key], together[key], rtol=1e-9, atol=1e-12)
    assert parted["/numbers", "text"] == together["/numbers", "text"]


def test_models_without_a_band_or_of_other_units_have_none(tmp_path, model):
    inputs = random_reversals(np.random.default_rng(7))[:50]
    plain = ModelFile("preisach", model.model)
    for name, models in (("none", []), ("plain", [plain])):
        found = written(tmp_path / f"{name}.rrd", controlled(inputs, inputs), models)
        assert not any("band" in path for path, _ in found)
        assert "band" not in found["/numbers", "text"][-1][0]


@pytest.mark.slow
def test_a_run_under_control_records_it(bench, tmp_path):
    """The model on the dashboard follows the readings as the controller's does."""
    found = bench_functions.identify(
        Path(__file__).parents[3] / "recordings" / "reference" / "vo2-damped-oscillation",
        "preisach-nonmonotonic",
        input="tec_temperature",
        output="curvature",
        levels=6,
        plane=(30.0, 70.0),
        band=True,
    )
    found.file.save(tmp_path / "model.json")
    options = (f"model={tmp_path / 'model.json'}", "controller=open-loop-inverse", "count=3", "readings=2")
    code, _, err = bench(
        *("run", "tracking", "--rig", "vo2", "--clock", "virtual", "--out", tmp_path / "runs"),
        *(part for option in options for part in ("--set", option)),
    )
    assert code == 0, err
    (path,) = (tmp_path / "runs").glob("*/run.rrd")
    values = read(path)
    reference, predicted, _ = values["/control/tracking", "scalars"].T
    about = (predicted - reference)[np.isfinite(predicted)]
    # But for a few ticks, as the dashboard's memory sees more readings of a noisy input than the controller's.
    near = np.abs(about[:, None] - values[BAND][:, 4]).min(axis=1)
    assert np.median(near) < 1e-9
    assert near.max() < 1.0
    assert np.isfinite(values["/signals/temperature/setpoint_band", "scalars"]).any()
    panel = values["/numbers", "text"][-1][0]
    assert "of 6 readings within it" in panel
    # The page and its figures have it, too.
    assert bench("report", path.parent, "--figures", "svg")[0] == 0
    assert "90 % prediction band" in (path.parent / "report" / "errors.svg").read_text(encoding="utf-8")
    assert "prediction band of preisach-nonmonotonic" in (path.parent / "report.html").read_text(encoding="utf-8")
