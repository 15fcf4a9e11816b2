"""The CPU time in which the dynamics of a recording are identified, and of a further model of it. Prints both."""

import time
from pathlib import Path
from statistics import median

import numpy as np
import pytest

from bench.analysis import TransientRecording, identify_dynamics, identify_transients
from bench.models import Preisach, uniform_levels
from bench.models.kernels import actuator_kernels as _kernels

pytestmark = pytest.mark.benchmark

GRID = 0.01
"""s."""
PERIOD, HOLD, HOLDS = 0.67, 8.0, 400


def recording(model):
    """An actuator of second order, and a response behind a lag of 4 s."""
    rng = np.random.default_rng(1)
    setpoints = 45.0 + 20.0 * np.sin(0.7 * np.arange(HOLDS)) * np.linspace(1.0, 0.1, HOLDS)
    held = np.repeat(setpoints, round(HOLD / GRID))
    drive, seen = np.empty((2, held.size))
    _kernels.move(45.0, 0.0, held, drive, GRID, 2.2, 0.9, 15.0)
    _kernels.hold_back(45.0, drive, seen, GRID, 4.0, 1.0)
    rows = np.arange(round(PERIOD / GRID), held.size, round(PERIOD / GRID))
    noise = 1e-3 * rng.standard_normal((2, rows.size))
    return TransientRecording(
        path=Path("run"), meta={}, signals=(), steps=(), times=GRID * (rows + 1), is_reading=np.ones(rows.size, bool),
        columns={"drive": drive[rows] + noise[0], "response": model.evaluate(seen)[rows] + noise[1]},
        changes=HOLD * np.arange(HOLDS), setpoints=setpoints, drive="drive", response="response",
        ticks=(np.empty(0), np.empty(0)),
    )  # fmt: skip


def seconds(call):
    """Return the CPU time of a call, s: the median of some."""
    found = []
    for _ in range(5):
        start = time.thread_time()
        call()
        found.append(time.thread_time() - start)
    return median(found)


def test_what_does_not_depend_on_the_model_is_found_once(capsys):
    model = Preisach(uniform_levels(20.0, 70.0, 20), np.linspace(0.2, 1.0, 210), 0.0, None, (20.0, 70.0))
    measured = recording(model)
    transients = identify_transients([measured])
    dynamics = identify_dynamics(transients, [model.evaluate])
    assert dynamics.actuator.frequency == pytest.approx(2.2, rel=0.1)
    assert dynamics.response.lag == pytest.approx(4.0, rel=0.1)
    first = seconds(lambda: identify_transients([measured]))
    further = seconds(lambda: identify_dynamics(transients, [model.evaluate]))
    with capsys.disabled():
        print(f"\ndrive {1e3 * first:.0f} ms, response {1e3 * further:.0f} ms of CPU, {measured.times.size} rows")
    assert further < first
