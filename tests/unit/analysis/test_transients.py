"""The dynamics that a model file keeps: identified from transients, and read again."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from cases import cases

from bench.analysis import TransientRecording, identify_dynamics, identify_transients, noise_of
from bench.analysis.transients.actuator import at_rows
from bench.base import DataError
from bench.identification import ModelFile, parse_model
from bench.models import ActuatorDynamics, IdentifiedDynamics, Preisach, ResponseDynamics, uniform_levels
from bench.models.kernels import actuator_kernels as _kernels

LEVELS = uniform_levels(0.0, 3.0, 10)
MODEL = Preisach(LEVELS, np.linspace(0.2, 1.0, 55), 0.0, None, (0.0, 3.0))
QUIET = 1e-3
"""Noise of drive and response, in their units."""


SINE = np.abs(3.0 * np.sin(1.3 * np.arange(1, 31)))


def recording(lag, power, *, period=1.0, hold=20.0, error=0.0, setpoints=SINE):
    """A drive that follows its set-point at once, and the lagged response of a specimen beside `MODEL`."""
    rng = np.random.default_rng(1)
    changes = hold * np.arange(float(len(setpoints)))
    grid = 0.01 * np.arange(1, round(len(setpoints) * hold / 0.01) + 1)
    drive = setpoints[np.searchsorted(changes, grid - 1e-9, side="right") - 1]
    held, level = np.empty(grid.size), 0.0
    remains = math.exp(-0.01 / lag) if lag else 0.0
    for k, value in enumerate((drive**power).tolist()):
        held[k] = level = value + (level - value) * remains
    # At rest the specimen is off by an amount of its own in each hold.
    off = error * rng.standard_normal(len(setpoints))
    response = MODEL.evaluate(held ** (1.0 / power)) + off[np.searchsorted(changes, grid - 1e-9, side="right") - 1]
    rows = np.arange(round(period / 0.01), grid.size, round(period / 0.01)) - 1
    noise = QUIET * rng.standard_normal((2, rows.size))
    return TransientRecording(
        path=Path("run"), meta={}, signals=(), steps=(), times=grid[rows], is_reading=np.zeros(rows.size, dtype=bool),
        columns={"drive": drive[rows] + noise[0], "response": response[rows] + noise[1]}, changes=changes,
        setpoints=setpoints, drive="drive", response="response", ticks=(np.empty(0), np.empty(0)),
    )  # fmt: skip


@cases("power", [1.0, 2.0])
def test_a_lag_and_its_power_are_found_beside_errors_at_rest(power):
    found = identify_dynamics(identify_transients([recording(4.0, power, error=0.05)]), [MODEL.evaluate])
    assert found.actuator.order == 0
    assert found.response.power == power
    assert found.response.lag == pytest.approx(4.0, rel=0.05)
    assert 0.0 < found.uncertainties["lag"] < 0.2


@cases("power", [1.0, 2.0])
def test_moves_over_the_whole_range_tell_the_power_that_lags(power):
    # The small steps speak for the other power, as those of a specimen that relaxes may do.
    small = recording(4.0, 3.0 - power, setpoints=2.0 + 0.2 * SINE)
    swings = recording(4.0, power, setpoints=np.array([3.0, 0.0, 3.0, 0.0]))
    transients = identify_transients([small])
    assert identify_dynamics(transients, [MODEL.evaluate]).response.power == 3.0 - power
    found = identify_dynamics(transients, [MODEL.evaluate], swings=[swings])
    assert found.response.power == power
    assert found.response.lag == pytest.approx(4.0, rel=0.15)


def test_a_lag_that_no_reading_shows_is_none_and_said_to_be_short():
    found = identify_dynamics(identify_transients([recording(0.02, 1.0)]), [MODEL.evaluate])
    assert found.response.lag == 0.0
    assert found.fastest == pytest.approx(1.0 / 3.0, rel=0.1)


def test_noise_is_that_of_readings_late_in_a_hold():
    found = recording(2.0, 1.0)
    assert noise_of(found, found.responded) == pytest.approx(QUIET, rel=0.3)


def test_a_part_of_a_recording_keeps_the_set_point_that_stood():
    whole = recording(2.0, 1.0)
    part = whole.within(50.0 + whole.zero, 90.0 + whole.zero)
    assert part.times[0] == 0.0
    assert part.setpoints.tolist() == whole.setpoints[2:5].tolist()
    assert part.changes[0] == 0.0
    np.testing.assert_array_equal(part.driven, whole.driven[(whole.times >= 50.0) & (whole.times <= 90.0)])


@cases("step", [0.02, 0.0131])
@cases(
    "dynamics",
    [
        ActuatorDynamics(frequency=2.5),
        ActuatorDynamics(frequency=2.5, rate=0.7),
        ActuatorDynamics(frequency=3.0, damping=0.2),
        ActuatorDynamics(frequency=9.0, damping=2.5),
        ActuatorDynamics(frequency=9.0, damping=0.4, rate=2.0),
    ],
)
def test_positions_at_rows_are_those_of_the_grid(dynamics, step):
    found, initial, end = recording(2.0, 1.0, period=0.37, hold=4.003), 0.4, 100.0
    numbers = step, dynamics.frequency, dynamics.damping, dynamics.rate
    setpoints = found.on_grid(step, initial, end)
    starts, held = found.holds(step, initial, end)
    np.testing.assert_allclose(np.repeat(held, np.diff(starts)), setpoints, atol=1e-9)
    moved = np.empty(setpoints.size)
    _kernels.move(initial, 0.0, setpoints, moved, *numbers)
    times = found.times[found.times <= end] - 0.5
    rows = np.empty(times.size)
    _kernels.move_to_rows(initial, starts, held, times, rows, *numbers)
    np.testing.assert_allclose(rows, at_rows(times, moved, initial, step, 0.0), atol=1e-9)


DYNAMICS = IdentifiedDynamics(
    ActuatorDynamics(delay=0.1, frequency=2.0, damping=0.9),
    ResponseDynamics(lag=4.0, power=2.0),
    {"input": 0.01, "output": 0.5},
    {"lag": 0.1},
    0.7,
    "run",
)


def test_dynamics_are_kept_in_a_model_file(tmp_path):
    ModelFile("preisach", MODEL, dynamics=DYNAMICS).save(tmp_path / "model.json")
    content = json.loads((tmp_path / "model.json").read_text(encoding="utf-8"))
    assert content["version"] == 2
    assert content["dynamics"]["actuator"]["rate"] is None
    assert parse_model(content, "here").dynamics == DYNAMICS
    del content["dynamics"]
    assert parse_model(content, "here").dynamics is None


@cases(
    ("change", "said"),
    [
        ({"response": {"lag": -1.0}}, "response.lag"),
        ({"response": {"power": 3.0}}, "power"),
        ({"noise": {"output": math.nan}}, "noise.output"),
        ({"actuator": {"speed": 1.0}}, "speed"),
    ],
)
def test_damaged_dynamics_are_refused(change, said):
    content = ModelFile("preisach", MODEL, dynamics=DYNAMICS).to_json()
    content["dynamics"] |= change
    with pytest.raises(DataError, match=said):
        parse_model(content, "here")
