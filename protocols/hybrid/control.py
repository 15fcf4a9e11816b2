"""Control of the thermo-piezoelectric hybrid: the tip follows a reference by heat and voltage together."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import numpy as np

from bench.base import Floats
from bench.control import AddedSine, ControllerSetup, Reference, SmoothMoves, Tuning, make_controller, staircase
from bench.identification import load_model
from bench.protocol import (
    Caution,
    FixedRate,
    Messages,
    Note,
    NumberList,
    Phase,
    ProtocolParameters,
    Slots,
    from_slot,
    parameter,
    protocol,
)
from protocols.hybrid import BOTH_LOOPS, FINE, FINE_OVER_TIME, SENSORS, THERMAL, WITNESS
from protocols.preparation import check_order

ControllerName = Literal["hybrid", "hybrid-low-pass", "open-loop", "thermal-feedback"]
ReferenceName = Literal["moves", "staircase", "ramp", "sine-on-ramp", "hold"]

REST = 5.0
"""Time at the start before the reference begins to move, s."""
APPROACH = 200.0
"""Longest time in which the tip comes from where it rests to the beginning of the reference, s."""
_PLACES = 2001
"""Instants at which an accuracy is checked. Derivation: many for each move of a reference."""
MID_RANGING = "mid-ranging"
"""Table of `tuning` with the numbers that the controllers of both parts share."""


class Parameters(ProtocolParameters):
    """What can be set."""

    model: str = parameter(
        ..., unit="", help="file of a hybrid model, as `bench identify --model hybrid` writes it", file=True
    )
    controller: ControllerName = parameter("hybrid", unit="", help="which controller")
    reference: ReferenceName = parameter("moves", unit="", help="what is followed")
    reach: float = parameter(..., unit="m", above=0.0, help="farthest position of either sign that the response sees")
    positions: NumberList = parameter(..., unit="m", help="of moves: positions, one after another")
    low: float = parameter(..., unit="m", help="lowest position of the others")
    high: float = parameter(..., unit="m", help="highest position of the others")
    steps: int = parameter(5, unit="1", low=1, high=1000, help="steps of a staircase each way")
    speed: float = parameter(..., unit="m/s", low=1e-9, high=1e-4, help="greatest speed of the reference")
    hold: float = parameter(60.0, unit="s", low=0, high=36000, help="time at each position")
    amplitude: float = parameter(..., unit="m", low=0, help="amplitude of the sine on a ramp")
    frequency: float = parameter(1.0, unit="Hz", low=1e-3, high=20, help="frequency of the sine on a ramp")
    rate: float = parameter(200.0, unit="Hz", low=50, high=1000, help="samples in a second")
    record_rate: float = parameter(50.0, unit="Hz", low=0.01, high=1000, help="recorded samples in a second")
    lateness: float = parameter(
        0.0, unit="s", low=0, high=0.06, help="time by which the response is read late, as its calibration finds it"
    )
    probe: float = parameter(
        ...,
        unit="m",
        low=0,
        help="height of the square wave at the start, by which the lateness is checked; 0 for no check",
    )
    witness: bool = parameter(False, unit="", help="whether the sensor `witness` beside the loop is recorded too")
    current: float = parameter(
        from_slot("coarse", "high"), unit="A", low=1e-3, help="greatest current of either sign"
    )
    tuning: Tuning = parameter(
        {},
        unit="",
        help=f"numbers of the controllers: table {MID_RANGING} those of all, one of a controller's name its own",
    )


def _places(parameters: Parameters, _: Slots) -> Floats:
    reference, duration = _reference(parameters)
    return np.array([reference(t) for t in np.linspace(0.0, duration, _PLACES).tolist()])


@protocol(needs=THERMAL | FINE, may_use=WITNESS, controls="response", views=BOTH_LOOPS, targets=_places)
def hybrid_control(parameters: Parameters, slots: Slots) -> Messages:
    """Make the tip follow a reference by the thermal and the piezo part together.

    The thermal part takes the range, the piezo part the accuracy. References are smooth moves from position to
    position, a staircase from `low` to `high` and back, a slow ramp there and back, the same with a sine on top, or
    a hold at 0. Where the tip rests far from 0, as in a warm room, a smooth move to 0 comes first.
    """
    p = parameters
    reference, duration = _reference(p)
    numbers = p.tuning.get(MID_RANGING, {}) | p.tuning.get(p.controller, {})
    limits = (-p.current, p.current)
    setup = _setup(p, reference, limits, numbers=numbers, lateness=p.lateness, probe=p.probe)
    controller = make_controller("hybrid", p.controller, setup)
    for name, height in (("amplitude", p.amplitude), ("probe", p.probe)):
        if height > (stroke := numbers["stroke"]):
            raise ValueError(
                f"parameter {name} = {height:g} m is not allowed; allowed: at most the stroke of the piezo part, "
                f"{stroke:g} m"
            )
    accuracy = slots["response"].accuracy
    if accuracy is None:
        yield Note("the response is not calibrated: how far its readings are from the true deflection is not known")
    else:
        yield Note(f"the response is calibrated to a standard uncertainty of {accuracy:.2g} m")
    yield Phase(parameters.controller)
    yield FixedRate(
        controller=controller,
        rate=parameters.rate,
        duration=duration,
        inputs=tuple(slots[name].signal for name in SENSORS),
        actuators=(slots["coarse"].device, slots["fine"].device),
        watched=_watched(parameters, slots),
        record_every=max(1, round(parameters.rate / parameters.record_rate)),
        label=parameters.reference,
        put_off=APPROACH,
    )
    if notice := controller.take_notice():
        yield Caution(notice)


class StepParameters(ProtocolParameters):
    """What can be set."""

    model: str = parameter(
        ..., unit="", help="file of a hybrid model, as `bench identify --model hybrid` writes it", file=True
    )
    step: float = parameter(..., unit="m", help="height of the step")
    stroke: float = parameter(
        ..., unit="m", above=0.0, help="largest deflection of either sign that the piezo part is asked for"
    )
    rest: float = parameter(0.05, unit="s", low=0, high=10, help="time at the deflection of the start before it")
    duration: float = parameter(0.2, unit="s", low=1e-3, high=100, help="time after it")
    rate: float = parameter(20e3, unit="Hz", low=2000, high=1e6, help="samples in a second")
    integral: float = parameter(..., unit="1/s", low=1, high=1000, help="gain of the loop's integral")
    witness: bool = parameter(False, unit="", help="whether the sensor `witness` beside the loop is recorded too")


def _step(parameters: StepParameters, _: Slots) -> Floats:
    return np.array([0.0, parameters.step])


@protocol(needs=FINE, may_use=WITNESS, controls="response", views=FINE_OVER_TIME, targets=_step)
def fine_step(parameters: StepParameters, slots: Slots) -> Messages:
    """Make the piezo part alone follow a step, at a rate that sees its resonance.

    The notch lies at the resonance of the model; the hysteresis is inverted. The rate is for an emulated rig on the
    virtual clock. A step beyond the stroke, less a reserve for the loop, is refused; one that overshoots ends the
    run.
    """
    p = parameters
    limits = (-math.inf, math.inf)
    setup = _setup(p, lambda t: p.step if t >= p.rest else 0.0, limits, integral=p.integral, stroke=p.stroke)
    controller = make_controller("hybrid-fine", "notch", setup)
    low, high = controller.reach
    if not low <= parameters.step <= high:
        raise ValueError(
            f"parameter step = {parameters.step:g} m is not allowed; allowed: {low:.3g} to {high:.3g} m, which the "
            f"piezo part of {Path(parameters.model).name} reaches within a fast loop"
        )
    yield Phase("fine step")
    yield FixedRate(
        controller=controller,
        rate=parameters.rate,
        duration=parameters.rest + parameters.duration,
        inputs=(slots["response"].signal,),
        actuators=(slots["fine"].device,),
        watched=_watched(parameters, slots),
        label="fine step",
    )


def _watched(parameters: Parameters | StepParameters, slots: Slots) -> tuple[str, ...]:
    if not parameters.witness:
        return ()
    if "witness" not in slots:
        raise ValueError("witness: the rig binds no [roles.witness]")
    return (slots["witness"].signal,)


def _setup(
    parameters: Parameters | StepParameters, reference: Reference, limits: tuple[float, float], **options: object
) -> ControllerSetup:
    return ControllerSetup(
        model=load_model(Path(parameters.model), "hybrid"),
        limits=limits,
        options={"reference": reference, "rate": parameters.rate, **options},
    )


def moves_of(parameters: Parameters) -> SmoothMoves:
    """Return the moves that a reference consists of, without its sine."""
    p = parameters
    for name, places in (("positions", p.positions), ("low", (p.low,)), ("high", (p.high,))):
        if abs(place := max(places, key=abs)) > p.reach:
            raise ValueError(
                f"parameter {name}: {place:g} m is not allowed; allowed: {-p.reach:g} to {p.reach:g} m, as far as "
                "reach says"
            )
    if p.reference == "moves":
        return SmoothMoves([0.0, *p.positions], p.speed, hold=p.hold)
    if p.reference != "hold":
        check_order(p, "low < high", "m")
    if p.reference == "staircase":
        return staircase(p.low, p.high, p.steps, p.speed, hold=p.hold)
    if p.reference == "hold":
        return SmoothMoves([0.0, 0.0], p.speed, hold=p.hold)
    return SmoothMoves([0.0, p.low, p.high, p.low], p.speed, hold=p.hold)


def _reference(parameters: Parameters) -> tuple[Reference, float]:
    """Return the reference and its duration, s."""
    moves = moves_of(parameters)
    duration = REST + moves.duration

    def delayed(t: float) -> float:
        return moves(t - REST)

    if parameters.reference == "sine-on-ramp":
        return AddedSine(delayed, parameters.amplitude, parameters.frequency), duration
    return delayed, duration
