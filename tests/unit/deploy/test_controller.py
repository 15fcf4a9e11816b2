"""Exported controllers beside those of the bench, and what they answer where something is wrong."""

import numpy as np
import pytest
from deployed import REACH, Compiled, plane

from bench.base import ConfigurationError, DataError
from bench.control import ControllerSetup, controller_names, make_controller
from bench.deployment import CONTROLLERS, Controller, controller_of_rig, deploy
from bench.identification import ModelFile
from bench.models import IdentifiedDynamics, ResponseDynamics, TwoStage

PERIOD = 0.1
MODEL = ModelFile("plane", plane(20))
# Targets beyond what one direction reaches are passed to through saturation.
SIGNED = ModelFile("signed", plane(20, "signed"))
LATE = ModelFile("late", MODEL.operator, dynamics=IdentifiedDynamics(response=ResponseDynamics(0.3, 2.0)))
LIMITS = (0.2, 9.0)
NUMBERS = {
    "follow.closed-loop-inverse": {"lead": 0.5},
    "follow.open-loop-inverse": {"lead": 0.5},
    "target.closed-loop-inverse": {"arrival": {"tolerance": 0.02, "patience": 2.94, "poll": PERIOD}},
    "target.open-loop-inverse": {"wait": 1.5},
}
_REACHES = list(REACH.values())


def _controller(name):
    return Controller(name, PERIOD, LIMITS, 0.0, NUMBERS[name])


def _session(name, file, count=2000):
    """Return the readings and references of a session, the set-points of the bench, reach and done.

    The drive overshoots, readings are noisy or missing, some references cannot be met.
    """
    operator, (task, _, short) = file.operator, name.partition(".")
    state = operator.saturated_state(-1)
    setup = ControllerSetup(model=file, limits=LIMITS, state=state, options=NUMBERS[name], period=PERIOD)
    controller, rng = make_controller(task, short, setup), np.random.default_rng(1)
    specimen, (low, high) = operator.stream(state), operator.output_range()
    span, drive, speed, reference, is_done = high - low, 0.0, 0.0, 0.0, False
    rows, setpoints, said = [], [], []
    for k in range(count):
        aims = task == "target" and k % 40 == 0
        if aims:
            reference = rng.uniform(low - 0.1 * span, high + 0.1 * span)
        elif task == "follow":
            reference = 0.5 * (low + high) + 0.6 * span * np.sin(0.05 * k) * np.cos(0.0137 * k)
        output = 0.9 * specimen.step(min(max(drive, 0.0), 10.0)) + 0.002 * span * rng.standard_normal()
        measured, chance = drive + 1e-3 * rng.standard_normal(), rng.random()
        output = np.nan if chance < 0.02 else high + 5.0 * span if chance < 0.03 else output
        measured = 1e3 if 0.03 < chance < 0.035 else measured
        rows.append((k * PERIOD - max(k - 1, 0) * PERIOD, measured, output, reference))
        if task == "follow":
            setpoint = controller.update(k * PERIOD, measured, output, reference)
        else:
            ask = (lambda *reading, to=reference: controller.aim(to, *reading)) if aims else controller.update
            command = ask(k * PERIOD, measured, output)
            setpoint, is_done = command.setpoint, command.done
        setpoints.append(setpoint)
        said.append((controller.reach, is_done))
        for _ in range(10):
            speed += 0.1 * PERIOD * (16.0 * (setpoint - drive) - 2.4 * speed)
            drive += 0.1 * PERIOD * speed
    return np.array(rows), np.array(setpoints), said


@pytest.mark.parametrize(
    ("name", "file", "real"),
    [
        *((name, SIGNED, "double") for name in CONTROLLERS),
        ("follow.closed-loop-inverse", MODEL, "float"),
        ("target.closed-loop-inverse", LATE, "double"),
        ("target.closed-loop-inverse", LATE, "float"),
    ],
)
def test_set_points_are_those_of_the_bench(name, file, real, gcc, tmp_path):
    rows, expected, said = _session(name, file)
    compiled = Compiled(file, tmp_path, real, gcc, controller=_controller(name))
    found, answers = compiled.control(rows)
    # In float what of an output is rounding comes through the slope.
    bound = 4.0 * np.spacing(10.0) if real == "double" else 1e-4
    assert np.abs(found - expected).max() <= bound
    assert [(REACH[reach], bool(done)) for reach, done in answers.tolist()] == said
    assert {reach for reach, _ in said} == set(_REACHES)
    assert name.startswith("follow") or any(done for _, done in said)
    assert np.ptp(expected) > 5.0


@pytest.mark.parametrize("name", ["follow.closed-loop-inverse", "target.closed-loop-inverse"])
def test_what_is_not_finite_or_late_is_answered_by_the_safe_set_point(name, gcc, tmp_path):
    compiled = Compiled(MODEL, tmp_path, "float", gcc, controller=_controller(name))
    low = MODEL.operator.output_range()[0]
    good = [PERIOD, 3.0, low + 20.0, low + 30.0]
    (first,), _ = compiled.control(np.array([good]))
    for column, value in [(0, np.nan), (0, 2.5 * PERIOD), (1, np.nan), (1, np.inf), (3, np.nan), (3, -np.inf)]:
        bad = list(good)
        bad[column] = value
        (before, wrong, after), answers = compiled.control(np.array([good, bad, good]))
        assert (before, wrong) == (first, 0.0)
        assert LIMITS[0] <= after <= LIMITS[1]
        assert not answers[:, 1].any()
    # A reading beyond all belief holds.
    (_, held), _ = compiled.control(np.array([good, [PERIOD, 1e6, *good[2:]]]))
    assert held == first


def test_limits_numbers_and_safe_set_point_come_from_rig_and_tuning_file(tmp_path):
    tuning = tmp_path / "tuning.toml"
    tuning.write_text("[tuning.closed-loop-inverse]\nwalk_variance = 4.0\n")
    following = controller_of_rig("follow.closed-loop-inverse", "vo2", 0.5, tuning)
    assert (following.limits, following.safe, following.dwell) == ((21.0, 84.0), 21.0, 8.0)
    assert following.numbers == {"lead": 1.14, "walk_variance": 4.0, "reading_variance": 1.0}
    tracking = controller_of_rig("target.closed-loop-inverse", "vo2", 0.1, None)
    assert tracking.numbers["close_enough"] == 5.0


def test_what_is_wrong_is_said():
    def said(error, file=MODEL, name="follow.closed-loop-inverse", limits=LIMITS, **numbers):
        with pytest.raises(error) as raised:
            deploy(file, controller=Controller(name, PERIOD, limits, 0.0, numbers))
        return str(raised.value)

    for task, name, reason in [
        ("follow", "predictive", "least squares"),
        ("follow", "integral", "no model"),
        ("target", "latched", "both sides"),
        ("target", "polynomial", "no memory"),
    ]:
        assert name in controller_names(task)
        refusal = said(ConfigurationError, name=f"{task}.{name}")
        assert reason in refusal
        assert "follow.open-loop-inverse, target.closed" in refusal
    assert "gain: there is no such number" in said(ConfigurationError, gain=1.0)
    assert "overlap" in said(ConfigurationError, limits=(20.0, 30.0))
    assert "[roles.drive] dwell" in said(ConfigurationError, name="target.open-loop-inverse")
    assert "wait" in said(ConfigurationError, name="target.open-loop-inverse", wait="long")
    assert "of one input" in said(DataError, ModelFile("muscle", TwoStage(plane(8), plane(12), 1.0)))
    with pytest.raises(ConfigurationError, match="--period"):
        controller_of_rig("follow.closed-loop-inverse", "vo2", None, None)
