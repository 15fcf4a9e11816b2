"""Compile into numba's cache what the tests use.

In one process, before the tests: otherwise each of their workers compiles most of it. What is missing here is
compiled by the test that needs it.
"""

import math
from pathlib import Path

import numpy as np

import bench
from bench.control.adaptation import Adapter
from bench.control.dynamics import ActuatorDynamics, IdentifiedDynamics, ResponseDynamics
from bench.control.predictive import PredictiveFollower
from bench.hysteresis import (
    BoucWen,
    Duhem,
    GeneralizedPrandtlIshlinskii,
    KrasnoselskiiPokrovskii,
    MaxwellSlip,
    PrandtlIshlinskii,
    Preisach,
    QuadraticTerm,
    uniform_levels,
)
from bench.hysteresis.inverse import PreisachInverse
from bench.identification import identify
from bench.identification.cholesky_factor import CholeskyFactor
from bench.identification.collapse import collapse
from bench.identification.least_squares import fit
from bench.timed import BoucWenOscillator, Hammerstein, LinearPart, PreisachOscillator, RateDependentPlays
from bench.transients.actuator import identify_actuator
from bench.transients.recording import Recording
from bench.transients.response import late_parts
from bench.twin.specimen import Dynamics, Specimen
from rigs.hybrid.control import HybridController, MidRangingParameters
from rigs.hybrid.design import Design
from rigs.hybrid.estimates import ThermalNoise
from rigs.hybrid.model import PUBLISHED_DYNAMICS, HybridModel, identify_polynomial


def operators() -> None:
    """Evaluate, invert, adapt and identify operators."""
    levels = uniform_levels(0.0, 1.0, 4)
    density = np.ones(10)
    inputs = np.array([0.0, 1.0, 0.2, 0.8, 0.4, 0.6, 0.1, 0.9])
    operator = Preisach(levels, density, 0.0, None, (0.0, 1.0))
    state = operator.initial_state().advance(inputs)
    operator.segment(state, 1)
    operator.segment(state, -1)
    operator.output_range()
    outputs = operator.evaluate(inputs)
    regressor = operator.regressor(inputs)
    regressor.dense()
    regressor.product(np.ones(regressor.shape[1]))
    fit(regressor, outputs)
    # Equal columns: one of them depends on the other.
    fit(operator.regressor([0.0, 1.0, 0.0, 1.0]), [0.0, 1.0, 0.0, 1.0])
    slow = np.interp(np.linspace(0.0, 3.0, 400), np.arange(4.0), [0.0, 1.0, 0.1, 0.8])
    factor = CholeskyFactor()
    factor.append(np.eye(2), np.ones(2))
    factor.length(np.array([1]), np.ones(1))
    collapse(operator.regressor(slow), operator.evaluate(slow), np.ones(400))
    inverse = PreisachInverse(operator)
    inverse.invert(state, 0.1)
    inverse.follow([0.1, 0.2])
    stream = inverse.stream(state)
    stream.find(0.1)
    stream.step(0.1)
    stream.move(0.2)
    PrandtlIshlinskii([0.0, 0.1], [1.0, 1.0]).stream().step(0.2)
    Adapter(operator).update(0.5, 0.1).update(0.8, 0.3)
    follower = PredictiveFollower(inverse, IdentifiedDynamics(ActuatorDynamics(frequency=2.0)))
    for t in (0.0, 0.5):
        follower.update(t, 0.2, 0.1, 0.2)
    identify("preisach-nonmonotonic", inputs, outputs, input_range=(0.0, 1.0), plane=(0.0, 1.0), reference=0.0)
    identify("prandtl-ishlinskii", inputs, outputs, input_range=(0.0, 1.0))
    identify("preisach", slow, operator.evaluate(slow), levels=6, smoothing=1e-3)


def element_operators() -> None:
    """Evaluate the operators of elements."""
    span, inputs = (0.0, 1.0), np.array([0.2, 0.8, 0.4])
    for each in (
        BoucWen(1.0, 1.0, input_range=span),
        BoucWen(1.0, 1.0, exponent=2.0, input_range=span),
        Duhem([1.0], [1.0], input_range=span),
        GeneralizedPrandtlIshlinskii([0.0], [1.0], input_range=span),
        KrasnoselskiiPokrovskii([0.0], [1.0], 1.0),
        MaxwellSlip([1.0], [1.0]),
    ):
        each.evaluate(inputs)
        each.regressor(inputs)
        each.stream().step(0.2)


def hybrid_controller() -> None:
    """Control a hybrid cantilever, with a reading and without."""
    rises = np.linspace(-20.0, 20.0, 9)
    plays = PrandtlIshlinskii(np.array([0.0, 10.0]), np.full(2, 1e-7), input_range=(-40.0, 40.0))
    polynomial = identify_polynomial(rises, -7e-6 * rises, 2).model
    model = HybridModel(Design().network(), polynomial, plays, PUBLISHED_DYNAMICS)
    noise = ThermalNoise(thermistor=1.0, deflection=1.0, base=1.0, tip=1.0, heat=1.0, offset=1.0)
    parameters = MidRangingParameters(
        period=5e-3, every=1, maximum_current=0.1, gain=1.0, integral_time=1.0, lead=1.0, window=1.0, filter_time=1.0,
        integral=1.0, stroke=1e-6, approach=1e-6, noise=noise,
    )  # fmt: skip
    controller = HybridController(model, lambda _: 0.0, parameters)
    for deflection in (0.0, math.nan, math.nan):
        controller.update(0.0, (deflection, 22.0, 22.0))


def third_order() -> None:
    """Simulate the dynamics of a fast actuator."""
    PUBLISHED_DYNAMICS.simulate(np.ones(2), 1e-3)


def twin() -> None:
    """Move the specimen of a twin."""
    operator = Preisach(uniform_levels(0.0, 1.0, 4), np.ones(10), 0.0, None, (0.0, 1.0))
    response = ResponseDynamics(shares=(0.1,), times=(1.0,))
    Specimen((operator,), Dynamics(0.02, ActuatorDynamics(frequency=1.0), response), 0.0).advance(np.ones(4))


def transients() -> None:
    """Identify what follows the set-points of a recording."""
    times = 0.1 * np.arange(80.0)
    changes, setpoints = np.array([0.0, 2.0, 4.0, 6.0]), np.array([1.0, 0.0, 2.0, 0.5])
    driven = setpoints[np.searchsorted(changes, times, side="right") - 1]
    columns = {"input": driven, "output": np.convolve(driven, np.full(4, 0.25))[:80]}
    recording = Recording(
        Path(), {}, (), (), times, np.zeros(80, dtype=bool), columns, changes, setpoints, "input", "output",
        (times, np.zeros(80)),
    )  # fmt: skip
    recording.on_grid(0.05, 0.0, 8.0)
    late_parts(driven, 0.1, (0.2, 0.4))
    identify_actuator([recording])


def timed() -> None:
    """Evaluate models with time."""
    times, inputs = np.arange(4.0), np.array([0.0, 1.0, 0.2, 0.8])
    plays = PrandtlIshlinskii(np.array([0.0, 0.2]), np.ones(2))
    Hammerstein(plays, LinearPart(0.5, (0.1, 0.1))).evaluate(times, inputs)
    BoucWenOscillator(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, (0.0, 1.0), "linear").evaluate(times, inputs)
    force = Preisach(uniform_levels(-1.0, 1.0, 4), np.zeros(10), reversible=QuadraticTerm(1.0))
    PreisachOscillator(1.0, 1.0, force, 0.0, (0.0, 1.0), "linear").evaluate(times, inputs)
    slow = RateDependentPlays(np.array([0.0, 0.2]), np.array([0.0, 0.5]), np.ones(2), (0.0, 1.0))
    slow.columns(times, inputs)
    slow.follow(times, slow.evaluate(times, inputs))


def laboratories() -> None:
    """Open each, which compiles its loops, and read it once, as single readings have loops of their own."""
    for rig in ("vo2", "sma", "mckibben", "coiled-polymer", "hybrid"):
        with bench.open_rig(rig) as opened:
            opened.glance()


if __name__ == "__main__":
    operators()
    element_operators()
    hybrid_controller()
    third_order()
    twin()
    transients()
    timed()
    laboratories()
