"""Exported controllers beside those of the bench, and what they answer where something is wrong."""

import numpy as np
import pytest
from deployed import Compiled, plane

from bench.base import ConfigurationError, DataError
from bench.control import ControllerSetup, make_controller
from bench.deployment import CONTROLLERS, Controller, controller_of_rig, deploy
from bench.identification import ModelFile
from bench.models import TwoStage

PERIOD = 0.5
MODEL = ModelFile("plane", plane(20))
LIMITS = (0.5, 9.0)
NUMBERS = {"lead": 0.5}


def _controller(name):
    return Controller(name, PERIOD, LIMITS, 0.0, NUMBERS)


def _session(name):
    """Return the readings and references of a session on a specimen of another density, and the set-points."""
    operator = MODEL.operator
    specimen = plane(27).stream()
    low, high = operator.output_range()
    setup = ControllerSetup(
        model=MODEL, limits=LIMITS, state=operator.saturated_state(-1), options=NUMBERS, period=PERIOD
    )
    follower, rng = make_controller("follow", name, setup), np.random.default_rng(1)
    rows, setpoints, measured = [], [], 0.0
    for k in range(300):
        reference = 0.5 * (low + high) + 0.55 * (high - low) * np.sin(0.05 * k) * min(k / 100.0, 1.0)
        output = specimen.step(measured) * 0.9 + 0.01 * rng.standard_normal()
        if k % 37 == 5:
            output = np.nan
        rows.append((PERIOD, measured, output, reference))
        setpoints.append(follower.update(k * PERIOD, measured, output, reference))
        measured += 0.7 * (setpoints[-1] - measured)
    return np.array(rows), np.array(setpoints)


@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("name", CONTROLLERS)
def test_set_points_are_those_of_the_bench(name, real, gcc, tmp_path):
    rows, expected = _session(name)
    compiled = Compiled(MODEL, tmp_path, real, gcc, controller=_controller(name))
    # A set-point follows from an output by the slope there, and with it what of the output is rounding.
    bound = 1e-11 if real == "double" else 5e-4
    assert np.abs(compiled.control(rows) - expected).max() <= bound
    assert np.ptp(expected) > 5.0


def test_what_is_not_finite_or_late_is_answered_by_the_safe_set_point(gcc, tmp_path):
    compiled = Compiled(MODEL, tmp_path, "float", gcc, controller=_controller("closed-loop-inverse"))
    good = [PERIOD, 3.0, MODEL.operator.output_range()[0] + 20.0, MODEL.operator.output_range()[0] + 30.0]
    for column, value in [(0, np.nan), (0, 2.5 * PERIOD), (1, np.nan), (1, np.inf), (3, np.nan), (3, -np.inf)]:
        bad = list(good)
        bad[column] = value
        first, wrong, after = compiled.control(np.array([good, bad, good]))
        assert wrong == 0.0
        assert LIMITS[0] <= first <= LIMITS[1]
        assert LIMITS[0] <= after <= LIMITS[1]
    # A reading beyond all belief, or a missing output, holds or goes on within the limits.
    assert compiled.control(np.array([good, [PERIOD, 1e6, *good[2:]]]))[1] == pytest.approx(
        compiled.control(np.array([good]))[0]
    )


def test_limits_numbers_and_safe_set_point_come_from_rig_and_tuning_file(tmp_path):
    tuning = tmp_path / "tuning.toml"
    tuning.write_text("[tuning.closed-loop-inverse]\nlead = 0.25\nwalk_variance = 4.0\n")
    found = controller_of_rig("closed-loop-inverse", "vo2", 0.5, tuning)
    assert found.limits == (21.0, 84.0)
    assert found.safe == 21.0
    assert found.numbers["lead"] == 0.25
    assert found.numbers["walk_variance"] == 4.0


def test_what_is_wrong_is_said():
    with pytest.raises(ConfigurationError, match="closed-loop-inverse, open-loop-inverse"):
        Controller("integral", PERIOD, LIMITS, 0.0, {})
    with pytest.raises(ConfigurationError, match="--period"):
        controller_of_rig("closed-loop-inverse", "vo2", None, None)
    with pytest.raises(ConfigurationError, match="gain: there is no such number"):
        deploy(MODEL, controller=Controller("closed-loop-inverse", PERIOD, LIMITS, 0.0, {"gain": 1.0}))
    with pytest.raises(ConfigurationError, match="nothing of the model's"):
        deploy(MODEL, controller=Controller("closed-loop-inverse", PERIOD, (20.0, 30.0), 0.0, {}))
    muscle = ModelFile("muscle", TwoStage(plane(8), plane(12), 1.0))
    with pytest.raises(DataError, match="of one input"):
        deploy(muscle, controller=_controller("closed-loop-inverse"))
