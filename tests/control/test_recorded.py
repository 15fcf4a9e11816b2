"""Controllers, filters and references do what they did: short scenes against numbers recorded beside this file.

The numbers of the studies stay what they are only if those of the controllers do. Where a change is meant, write
`recorded.json` anew by `python tests/control/test_recorded.py`, and read the difference.
"""

import json
import math
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from bench.control import (
    AddedSine,
    Approach,
    ApproachedReference,
    DisturbanceEstimator,
    DriftEstimator,
    FollowReference,
    Rules,
    SmoothMoves,
    Spans,
    Supervised,
    agility_for,
    fastest_slope,
    modulated_sine,
    staircase,
    tracking_targets,
)
from bench.control.baselines import IntegralControl, IntegralParameters, LookUp
from bench.control.following import ClosedLoopFollower, FollowingParameters, IntegralFollower, OpenLoopFollower
from bench.control.latched import Latched, LatchParameters
from bench.control.model_filters import model_filter
from bench.control.predictive import PredictionParameters, PredictiveFollower
from bench.control.tracking import Arrival, ClosedLoopInverse, CorrectionParameters, OpenLoopInverse
from bench.models import (
    ActuatorDynamics,
    IdentifiedDynamics,
    Polynomial,
    PrandtlIshlinskii,
    Preisach,
    QuadraticTerm,
    Reach,
    ResponseDynamics,
    uniform_levels,
)
from rigs.hybrid.notch_loop import NotchLoop, NotchLoopParameters

RECORDED = Path(__file__).with_name("recorded.json")
KEPT = 12
"""Values of each series that are recorded, evenly over it, besides its length, mean and deviation."""


def film():
    """Return a model with reversible part, wide and narrow loops, and limits beyond its plane."""
    levels = uniform_levels(0.0, 10.0, 12)
    rows, columns = np.tril_indices(12)
    density = np.exp(-0.15 * (rows + columns - 12.0) ** 2) * (rows - columns >= 1)
    density *= 40.0 / (density @ Preisach(levels, density).cell_areas())
    return Preisach(levels, density, 3.0, QuadraticTerm(-0.4), (-1.0, 12.0), output_unit="1/m")


def opposite(model):
    """Return the model with the opposite output."""
    return model.with_coefficients(-model.coefficients, -model.bias)


def mixed(model):
    """Return the model with a part of its density negative."""
    cells = model.density.size
    signs = np.where(np.arange(cells) % 7 == 3, -0.2, 1.0)
    return model.with_coefficients(np.concatenate([signs * model.density, model.coefficients[cells:]]), model.bias)


class Plant:
    """A model behind an input with a lag, or of second order, with an offset and noise of the output.

    The model may lag behind the input as well, by `behind` (s).
    """

    def __init__(self, model, *, gain=1.04, offset=1.5, lag=0.4, behind=0.0, damping=0.0, seed=5):
        self.model, self.gain, self.offset = model, gain, offset
        self.lag, self.behind, self.damping = lag, behind, damping
        self.rng = np.random.default_rng(seed)
        self.state = model.initial_state()
        self.place, self.speed, self.t = self.state.input, 0.0, 0.0
        self.seen = self.place

    def wait(self, setpoint, seconds):
        steps = max(1, round(seconds / 0.05))
        for _ in range(steps):
            dt = seconds / steps
            if self.damping:
                w = 1.0 / self.lag
                self.speed += dt * (w * w * (setpoint - self.place) - 2.0 * self.damping * w * self.speed)
                self.place += dt * self.speed
            else:
                self.place = setpoint + math.exp(-dt / self.lag) * (self.place - setpoint)
            self.seen = self.place + (math.exp(-dt / self.behind) * (self.seen - self.place) if self.behind else 0.0)
            self.state = self.state.step(self.seen)
        self.t += seconds

    def read(self):
        output = self.gain * self.model.value(self.state) + self.offset + 0.01 * self.rng.normal()
        return self.t, self.place + 1e-3 * self.rng.normal(), output


def traced(controller, plant, command):
    trace = controller.trace
    rows = (command.setpoint, command.wait, command.done, *plant.read()[1:])
    return (*rows, trace.reference, trace.predicted, trace.disturbance, trace.uncertainty)


REACHES = list(Reach)
COLUMNS = ("setpoint", "wait", "done", "input", "output", "reference", "predicted", "disturbance", "uncertainty")


def reaching(controller, plant, shares=(0.3, 0.75, 0.5, 0.55, 0.999, 0.1, 1.4), most=120):
    """Aim at some targets, one beyond the reach, with a reading missing now and then."""
    low, high = film().output_range()
    rows = []
    for number, share in enumerate(shares):
        command = controller.aim(low + share * (high - low), *plant.read())
        for step in range(most):
            lock = [getattr(controller, name, None) for name in ("locked", "tries", "extreme")]
            lock = [math.nan if each is None else float(each) for each in lock]
            rows.append((*traced(controller, plant, command), REACHES.index(controller.reach), *lock))
            if command.done:
                break
            plant.wait(command.setpoint, command.wait)
            t, place, output = plant.read()
            if (step + number) % 17 == 11:
                place, output = (math.nan, output) if step % 2 else (place, math.nan)
            command = controller.update(t, place, output)
    return {
        name: [row[i] for row in rows] for i, name in enumerate((*COLUMNS, "reach", "locked", "tries", "extreme"))
    }


def following(follower, plant, reference, seconds=20.0, period=0.5, pause=None):
    task = FollowReference(follower, reference, period, seconds)
    command = task.begin(*plant.read())
    rows = []
    while not command.done:
        rows.append(traced(task, plant, command))
        plant.wait(command.setpoint, command.wait + (2.0 if len(rows) == pause else 0.0))
        t, place, output = plant.read()
        if len(rows) % 13 == 9:
            place, output = (math.nan, output) if len(rows) % 2 else (place, math.nan)
        command = task.update(t, place, output)
    return {name: [row[i] for row in rows] for i, name in enumerate(COLUMNS)}


def sine(t):
    low, high = film().output_range()
    return 0.5 * (low + high) + 0.4 * (high - low) * math.sin(2.0 * math.pi * t / 14.0)


def learning(name, *, model=None):
    """Let a filter learn from a specimen that differs, with readings far off, and then from the model itself."""
    identified = film() if model is None else model
    rng = np.random.default_rng(2)
    adaptation = model_filter(name, identified)
    state, rows = identified.initial_state(), []
    for number in range(70):
        state, _ = identified.step(state, float(rng.uniform(-0.5, 10.5)))
        output = 1.08 * identified.value(state) + 1.0 + 0.02 * rng.normal()
        if 30 <= number < 33:
            output += 60.0
        if number >= 45:
            output = identified.value(state) + 25.0 * (number >= 60)
        changed = adaptation.update(state, output if number != 7 else math.nan)
        found = [part for each in adaptation.estimates().values() for part in (each.value, each.uncertainty)]
        rows.append([changed, adaptation.uncertainty, adaptation.taken, adaptation.refused, *found])
        rows[-1] += [adaptation.restarts, adaptation.model.value(state)]
    return {str(i): [row[i] for row in rows] for i in range(len(rows[0]))}


def estimating():
    rng = np.random.default_rng(4)
    found = {
        "agility": [
            agility_for(drift=d, noise=n, period=p) for d in (1e-3, 0.5) for n in (0.01, 2.0) for p in (0.1, 3.0)
        ]
    }
    drift, t, rows = DriftEstimator(noise=0.3, agility=0.02), 0.0, []
    for _ in range(40):
        t += float(rng.uniform(0.1, 2.0))
        drift.update(t, 5.0 + 0.2 * t + 0.3 * rng.normal())
        rows.append((drift.drift, min(drift.uncertainty, 1e6), drift.is_steady(0.3)))
    disturbance = DisturbanceEstimator(walk_variance=0.02, reading_variance=0.1)
    for number in range(40):
        disturbance.update(None if number % 7 == 5 else 2.0 + rng.normal())
        if number == 20:
            disturbance.shift(-1.0)
        rows.append((disturbance.value, disturbance.uncertainty, disturbance.gain))
    disturbance.reset()
    found |= {str(i): [row[i] for row in rows] for i in range(3)}
    return found | {"end": [disturbance.value, disturbance.uncertainty]}


def referring():
    times = np.linspace(-1.0, 60.0, 123)
    stairs = staircase(-2.0, 3.0, 4, 1.5, start=0.5, hold=3.0, blend=2.0)
    moves = SmoothMoves([0.0, 4.0, -1.0, -1.2], 2.0)
    put_off = ApproachedReference(sine, 0.5, 3.0)
    put_off.begin(2.0)
    as_it_is = ApproachedReference(sine, 1e6, 3.0)
    as_it_is.begin(2.0)
    others = {
        "stairs": stairs,
        "moves": moves,
        "put off": put_off,
        "as it is": as_it_is,
        "sine": AddedSine(stairs, 0.5, 0.3),
    }
    found = {name: [each(t) for t in times] for name, each in others.items()}
    found |= {"rate": [moves.rate(t) for t in times], "holding": [moves.holding(t, 1.0) for t in times]}
    found["delays"] = [put_off.delay, as_it_is.delay, moves.duration, stairs.duration]
    found["targets"] = tracking_targets(np.random.default_rng(1), -2.0, 5.0, 60)
    found["modulated"] = modulated_sine(times[2:], -2.0, 5.0, 12.0)
    slope = fastest_slope(film().inverse(), times[2:], [sine(t) for t in times[2:]])
    found["slope"] = [slope.rate, slope.time, slope.jump, slope.within(slope.rate), slope.within(0.99 * slope.rate)]
    return found


def notched():
    plays = PrandtlIshlinskii(np.array([0.0, 1.0, 3.0]), np.array([1.0, 0.3, 0.2]), input_range=(-20.0, 20.0))
    parameters = NotchLoopParameters(rate=2e4, integral=400.0, stroke=12.0)
    loop = NotchLoop(plays, 4300.0, 0.01, lambda t: 4.0 * math.sin(60.0 * t) + 1.5 * (t > 0.01), parameters)
    stream, rows = plays.stream(None), []
    for k in range(900):
        reading = stream.value if k % 97 else math.nan
        (voltage,) = loop.update(k / 2e4, (reading,))
        stream.step(voltage)
        rows.append((voltage, loop.trace.reference, loop.trace.disturbance))
    return {str(i): [row[i] for row in rows] for i in range(3)} | {"reach": loop.reach}


def stretching(**arguments):
    loop = Approach(3.0, slopes=(0.5, 4.0), largest_step=0.8, tolerance=0.02, **arguments)
    place, rows, t = 0.0, [], 0.0
    command = loop.begin(t, place, 0.0)
    while not command.done and len(rows) < 60:
        place, t = command.setpoint, t + command.wait
        rows.append((place, command.wait))
        # Slack at first, then a spring that stiffens.
        command = loop.update(t, place, 1.4 * max(place - 1.0, 0.0) ** 1.3 + 0.02 * math.sin(3.0 * t))
    return {"place": [row[0] for row in rows], "wait": [row[1] for row in rows]}


SECOND = IdentifiedDynamics(ActuatorDynamics(delay=0.2, frequency=2.5, damping=0.6, rate=6.0))
FIRST = IdentifiedDynamics(ActuatorDynamics(delay=0.7, frequency=3.0, gain=0.98, offset=0.1))
LAGGING = IdentifiedDynamics(response=ResponseDynamics(lag=1.0, power=2.0))


def predictive(dynamics, **options):
    plant = options.pop("plant", {})
    adaptation = options.pop("adaptation", None)
    limits = options.pop("limits", None)
    follower = PredictiveFollower(film().inverse(), dynamics, None, limits, adaptation=adaptation)
    found = following(follower, Plant(film(), **plant), sine, 12.0, **options)
    return found | {"horizon": [follower.horizon], "lags": [lag.surprise for lag in follower._lags]}


def latched(operator):
    return Latched(operator.inverse(), LatchParameters.of(operator, 8.0))


def spans():
    return Spans.of(film())


def numbers():
    """Return what the controllers take for a model if nothing else is said, and for an actuator that rests in 8 s."""
    scaled = {
        "closed loop": CorrectionParameters.scaled(spans()),
        "following": FollowingParameters.scaled(spans()),
        "predictive": PredictionParameters.scaled(spans(), 0.5),
        "integral": IntegralParameters.scaled(spans(), 8.0),
        "latched": LatchParameters.of(film(), 8.0),
        "latched, correction": Latched.correction(spans()),
    }
    return {
        f"{controller}: {name}": list(value.values()) if isinstance(value, dict) else [value]
        for controller, parameters in scaled.items()
        for name, value in asdict(parameters).items()
    }


BEHIND = ResponseDynamics(lag=0.8)


SCENES = {
    "open loop": lambda: reaching(OpenLoopInverse(film().inverse(), wait=1.5), Plant(film())),
    "open loop, overshooting": lambda: reaching(
        OpenLoopInverse(film().inverse(), wait=8.0), Plant(film(), damping=0.3)
    ),
    "open loop, learning": lambda: reaching(
        OpenLoopInverse(film().inverse(), wait=2.0, adaptation=model_filter("session", film())), Plant(film())
    ),
    "closed loop": lambda: reaching(ClosedLoopInverse(film().inverse()), Plant(film())),
    "closed loop, overshooting": lambda: reaching(
        ClosedLoopInverse(
            film().inverse(), None, (0.5, 9.0), CorrectionParameters(0.1, 0.3, 0.1, Arrival(0.05, hold=0.3))
        ),
        Plant(film(), damping=0.35),
    ),
    "closed loop, learning": lambda: reaching(
        ClosedLoopInverse(film().inverse(), adaptation=model_filter("density", film())), Plant(film())
    ),
    "latched": lambda: reaching(latched(film()), Plant(film(), gain=1.0, lag=0.1), most=400),
    "latched, off by a gain": lambda: reaching(latched(film()), Plant(film(), gain=0.9, lag=0.1), most=250),
    "open loop behind a lag": lambda: reaching(
        OpenLoopInverse(film().inverse(), wait=1.5, response=BEHIND), Plant(film(), behind=0.8)
    ),
    "closed loop behind a lag": lambda: reaching(
        ClosedLoopInverse(film().inverse(), response=BEHIND), Plant(film(), behind=0.8)
    ),
    "numbers": numbers,
    "look-up": lambda: reaching(LookUp(Polynomial([3.0, 0.4], (0.0, 10.0), 5.0), wait=8.0), Plant(film())),
    "integral": lambda: reaching(
        IntegralControl((0.0, 10.0), IntegralParameters.scaled(spans(), 8.0)), Plant(film())
    ),
    "supervised": lambda: reaching(
        Supervised(ClosedLoopInverse(film().inverse()), (0.0, 10.0), Rules(allowed=0.02)),
        Plant(film(), offset=0.2),
        (0.3, 0.7, 0.5),
    ),
    "following in open loop": lambda: following(
        OpenLoopFollower(film().inverse(), parameters=FollowingParameters(0.5, 0.1, lead=1.2)), Plant(film()), sine
    ),
    "following in closed loop": lambda: following(ClosedLoopFollower(film().inverse()), Plant(film()), sine),
    "following by the integral": lambda: following(
        IntegralFollower((0.5, 9.5), IntegralParameters.scaled(spans(), 8.0)), Plant(film(), lag=0.2), sine
    ),
    "predictive, second order": lambda: predictive(SECOND, plant={"damping": 0.6}, pause=9),
    "predictive, first order": lambda: predictive(FIRST, limits=(1.0, 8.5)),
    "predictive, lagging": lambda: predictive(LAGGING, plant={"lag": 0.05}),
    "predictive, learning": lambda: predictive(FIRST, adaptation=model_filter("session", film())),
    "session filter": lambda: learning("session"),
    "session filter of plays": lambda: learning(
        "session", model=PrandtlIshlinskii(np.array([0.0, 1.0]), np.array([2.0, 1.0]), input_range=(-1.0, 11.0))
    ),
    "density filter": lambda: learning("density"),
    "density filter of one that falls": lambda: learning("density", model=opposite(film())),
    "density filter of one with both signs": lambda: learning("density", model=mixed(film())),
    "estimators": estimating,
    "references": referring,
    "notch loop": notched,
    "approach": lambda: stretching(),
    "approach that holds": lambda: stretching(duration=20.0, period=0.7),
    "overshoots": lambda: {
        "overshoot": [ActuatorDynamics(frequency=2.0, damping=d).overshoot for d in (0.0, 0.2, 0.7, 0.99, 1.0, 1.5)],
        "time": [ActuatorDynamics(frequency=2.0, damping=d).time_constant for d in (0.0, 0.2, 0.7, 1.5)],
    },
}


def summary(series):
    """Return length, mean, deviation and some values of a series; what is no number counts as −1000."""
    values = np.nan_to_num(np.asarray(series, dtype=np.float64), nan=-1e3, posinf=1e9, neginf=-1e9)
    places = np.unique(np.linspace(0, values.size - 1, KEPT).round().astype(int))
    return [values.size, *(float(f"{each:.9g}") for each in (values.mean(), values.std(), *values[places]))]


@pytest.mark.parametrize("scene", SCENES)
def test_a_scene_is_what_it_was(scene):
    found = {name: summary(series) for name, series in SCENES[scene]().items()}
    expected = json.loads(RECORDED.read_text(encoding="utf-8"))[scene]
    assert found.keys() == expected.keys()
    for name, numbers in expected.items():
        assert found[name] == pytest.approx(numbers, rel=1e-6, abs=1e-7), name


if __name__ == "__main__":
    recorded = {scene: {name: summary(series) for name, series in run().items()} for scene, run in SCENES.items()}
    parts = []
    for scene, series in recorded.items():
        rows = ",\n".join(f"  {json.dumps(name)}: {numbers}" for name, numbers in series.items())
        parts.append(f" {json.dumps(scene)}: {{\n{rows}\n }}")
    RECORDED.write_text("{\n" + ",\n".join(parts) + "\n}\n", encoding="utf-8")
