"""Controllers by name, made from a model file: what protocols and the command line choose from.

A controller is an entry of the group `bench.controllers` under `TASK.NAME`, such as `target.latched` (a sequence of
targets) or `follow.integral` (a moving reference). The entry is a `ControllerSpec`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from bench.base import ConfigurationError, DataError, closest, registry
from bench.control.baselines import IntegralControl, IntegralParameters, LookUp
from bench.control.following import ClosedLoopFollower, FollowingParameters, IntegralFollower, OpenLoopFollower
from bench.control.latched import Latched, LatchParameters
from bench.control.model_filters import GATE, INPUT_ERROR, AdaptationName, ModelFilter, model_filter
from bench.control.opposite_output import OppositeOutput
from bench.control.supervision import Rules, Supervised, SupervisedFollower
from bench.control.tracking import TO_REST, ClosedLoopInverse, CorrectionParameters, OpenLoopInverse
from bench.control.tuning import Spans, tuned
from bench.identification import ModelFile, load_model
from bench.models import FallingInverse, Inverse, Operator, Policy, ResponseDynamics

if TYPE_CHECKING:
    from bench.control.predictive import PredictiveFollower

T = TypeVar("T")
S = TypeVar("S", Supervised, SupervisedFollower)

_END_OF_PLANE = 2.0 * GATE * INPUT_ERROR
"""Part of a plane by which its lower end may lie below the set-point that saturates the specimen.

Derivation: both may be readings of one set-point, and each is within `GATE` standard deviations of it.
"""


@dataclass(frozen=True, kw_only=True)
class ControllerSetup:
    """What a controller is made from.

    Parameters
    ----------
    name : str
        Name under which it was asked for, for messages.
    model : ModelFile
        The identified model.
    limits : (float, float)
        Set-points that it may ask for, input units.
    state : object
        The specimen's memory, a state of the model; None is that at the start of the model's own data.
    policy : {"nearest", "paper"}
        Which answer of the inverse is taken where there are several.
    options : mapping
        Numbers of the controller in place of its defaults, and others that the task has.
    adaptation : {"off", "session", "density"}
        How the model is corrected while it is used.
    period : float
        Time between two set-points of a follower, s.
    dwell : float, optional
        Time in which actuator and specimen come to rest at a set-point, s, as the rig file says.
    """

    name: str = ""
    model: ModelFile
    limits: tuple[float, float]
    state: Any = None
    policy: Policy = "nearest"
    options: Mapping[str, Any] = field(default_factory=dict)
    adaptation: AdaptationName = "off"
    period: float = 0.5
    dwell: float | None = None

    @property
    def rest(self) -> float:
        """Time in which actuator and specimen come to rest at a set-point, s: the rig's, or that of the dynamics.

        Raises ConfigurationError if neither says it.
        """
        return time_to_rest(self.dwell, self.model, f"controller {self.name}")

    @property
    def stretch(self) -> int:
        """Number of periods in which actuator and specimen come to rest; 1 if nothing says it."""
        dynamics = self.model.dynamics
        known = self.dwell is not None or (dynamics is not None and dynamics.time_constant > 0.0)
        return max(1, round(self.rest / self.period)) if known else 1

    @property
    def start(self) -> Any:  # noqa: ANN401 - each operator has its own
        """The specimen's memory."""
        return self.model.initial if self.state is None else self.state

    def inverse(self) -> Inverse[Any]:
        """Return the inverse of a model with memory.

        Raises DataError if the model has no memory.
        """
        if self.model.operator.memoryless:
            raise DataError(
                f"controller {self.name} needs a model with memory, such as a Preisach model; this one is "
                f"{self.model.name}"
            )
        operator = self.model.operator
        inverse = operator.inverse(self.policy)
        # Its kernels are compiled before anything moves, not at the first target.
        inverse.invert(operator.initial_state(), 0.5 * sum(operator.output_range()))
        return inverse

    def model_filter(self) -> ModelFilter | None:
        """Return what corrects the model while it is used, None if nothing does.

        Raises DataError if the model is not of the kind that this needs.
        """
        try:
            return model_filter(self.adaptation, self.model.operator)
        except ValueError as error:
            raise DataError(f"controller {self.name}: {error}") from None

    @property
    def response(self) -> ResponseDynamics | None:
        """How the specimen follows its drive; None if the model's data did not show it."""
        return None if self.model.dynamics is None else self.model.dynamics.response

    @property
    def spans(self) -> Spans:
        """Widths of the model's ranges."""
        return Spans.of(self.model.operator)

    def tuned(self, scaled: Callable[[Spans], T], options: Mapping[str, Any] | None = None) -> T:
        """Return the controller's numbers: scaled to the model's ranges, with `options` in their place.

        Raises ConfigurationError if there is no such number, or its value is not allowed.
        """
        try:
            return tuned(scaled(self.spans), self.options if options is None else options)
        except ValueError as error:
            raise ConfigurationError(f"controller {self.name}: {error}") from None


@dataclass(frozen=True)
class ControllerSpec:
    """An entry of the group `bench.controllers`: a one-line summary, and what makes the controller of a setup.

    `make` raises a DataError that says what kind of model it needs. One that `adapts` can correct its model.
    """

    summary: str
    make: Callable[[ControllerSetup], Any]
    adapts: bool = False
    numbers: Callable[[ControllerSetup], Any] | None = None
    """Returns the numbers of the controller, a dataclass, for `bench model tune`."""
    tunable: tuple[str, ...] = ()
    """Those of them that it may change, all positive; one of a table as `TABLE.NAME`, those that change together as
    `NAME+NAME`."""
    own_error: Callable[[ControllerSetup], float] | None = None
    """Of a controller without feedback: returns the RMS error that its model leaves by itself, output units."""
    misses: bool = False
    """Whether it may miss targets by design, as one for comparison; its errors then are not judged."""


def time_to_rest(dwell: float | None, model: ModelFile, who: str) -> float:
    """Return the time in which actuator and specimen come to rest at a set-point, s.

    Parameters
    ----------
    dwell : float or None
        As the rig file says; if it does not, the dynamics in the model file tell it.
    model : ModelFile
        The identified model.
    who : str
        Who needs it, for the message.

    Raises
    ------
    ConfigurationError
        If neither says it.
    """
    if dwell is not None:
        return dwell
    dynamics = model.dynamics
    if dynamics is None or dynamics.time_constant == 0.0:
        raise ConfigurationError(
            f"{who}: nothing says how long the specimen takes to come to rest; give "
            "[roles.drive] dwell = ... (s) in the rig file, or identify the model from a run with transients"
        )
    return TO_REST * dynamics.time_constant


def controller_names(task: str) -> tuple[str, ...]:
    """Return the names of the registered controllers of a task, such as `target` or `follow`."""
    prefix = f"{task}."
    return tuple(name.removeprefix(prefix) for name in registry.entries("controllers") if name.startswith(prefix))


def make_controller(task: str, name: str, setup: ControllerSetup) -> Any:  # noqa: ANN401 - by the task
    """Return a controller by name: of `target` a `TargetController`, of `follow` a `Follower`.

    Raises
    ------
    ConfigurationError
        If there is none of this name for the task, or it cannot adapt its model as is asked for.
    DataError
        If the model is not of the kind that the controller needs.
    """
    spec = controller_spec(task, name)
    if setup.adaptation != "off" and not spec.adapts:
        others = [each for each in controller_names(task) if controller_spec(task, each).adapts]
        raise ConfigurationError(
            f"controller {name} does not adapt a model (adaptation = {setup.adaptation}); these do: "
            f"{', '.join(others) or 'none'}"
        )
    return spec.make(replace(setup, name=name))


def controller_spec(task: str, name: str) -> ControllerSpec:
    """Return the entry of a controller.

    Raises ConfigurationError if there is none of this name for the task.
    """
    if name not in (known := controller_names(task)):
        raise ConfigurationError(f"there is no controller {name!r} for the task {task}; {closest(name, known)}")
    spec: ControllerSpec = registry.load("controllers", f"{task}.{name}")
    return spec


Fallback = Literal["none", "open-loop"]
"""What takes the place of a controller that does not converge: nothing, which ends the run, or the open loop."""


def make_supervised(
    kind: type[S],
    task: str,
    name: str,
    setup: ControllerSetup,
    rules: Rules,
    *,
    fallback: Fallback = "none",
    **options: Any,  # noqa: ANN401
) -> S:
    """Return a controller by name, which is given up when it does not converge or its model does not hold.

    Parameters
    ----------
    kind : type
        `Supervised` for a sequence of targets, `SupervisedFollower` for a moving reference.
    task, name, setup
        As in `make_controller`.
    rules : Rules
        By which errors it is given up, as the rig file says; what depends on the controller is filled in.
    fallback : {"none", "open-loop"}
        See `Fallback`.
    options
        Numbers of the open loop in place of its defaults.

    Raises
    ------
    ConfigurationError, DataError
        As `make_controller`, for the controller or for its fallback.
    """
    controller = make_controller(task, name, setup)
    spec = controller_spec(task, name)
    own = 0.0 if spec.own_error is None else spec.own_error(setup)
    rules = replace(
        rules,
        allowed=max(rules.allowed, own),
        judges=setup.adaptation == "off" and not spec.misses,
        feedback=spec.own_error is None,
    )
    of_task: Any = setup.stretch if kind is SupervisedFollower else setup.limits
    make: Callable[..., S] = partial(kind, controller, of_task)
    if fallback == "none":
        return make(rules)
    opened = replace(setup, options=options)
    # What it needs of the model is known before anything moves.
    make_controller(task, _OPEN, opened)
    return make(rules, lambda state: make_controller(task, _OPEN, replace(opened, state=state)))


_OPEN = "open-loop-inverse"


@dataclass(frozen=True)
class _Settling:
    wait: float  # s at each set-point, without feedback


def _wait(setup: ControllerSetup) -> float:
    # What is given needs no other source.
    return setup.tuned(lambda _: _Settling(1.0 if "wait" in setup.options else setup.rest)).wait


def _look_up(setup: ControllerSetup) -> LookUp:
    operator = setup.model.operator
    if not operator.memoryless:
        raise DataError(
            f"controller {setup.name} needs a model without memory, such as a polynomial; this one is "
            f"{setup.model.name}"
        )
    return LookUp(operator, setup.limits, wait=_wait(setup))


def _correction(setup: ControllerSetup) -> CorrectionParameters:
    found = CorrectionParameters.scaled(setup.spans)
    response = setup.response
    further = 0.0 if response is None else TO_REST * response.lag
    return replace(found, arrival=replace(found.arrival, patience=found.arrival.patience + further))


def _latch_parameters(setup: ControllerSetup) -> LatchParameters:
    inverse: Any = setup.inverse()
    operator: Any = inverse.opposite.operator if isinstance(inverse, FallingInverse) else inverse.operator
    noise = None if setup.model.dynamics is None else setup.model.dynamics.noise.get("output") or None
    return LatchParameters.of(operator, setup.rest, noise)


def _latched(setup: ControllerSetup) -> Latched | OppositeOutput:
    inverse: Any = setup.inverse()
    if getattr(setup.model.operator, "reversible", None) is None:
        raise DataError(
            f"controller {setup.name} needs a Preisach model with a reversible part, by which a locked output is "
            f"moved; this one is {setup.model.name}"
        )
    options = dict(setup.options)
    correction = tuned(Latched.correction(setup.spans), options.pop("correction", {}))
    numbers = setup.tuned(lambda _: _latch_parameters(setup), options)
    if isinstance(inverse, FallingInverse):
        opposite: Any = inverse.opposite
        return OppositeOutput(Latched(opposite, numbers, setup.start, setup.limits, correction))
    return Latched(inverse, numbers, setup.start, setup.limits, correction)


def _integral(setup: ControllerSetup) -> IntegralParameters:
    low, high = setup.model.operator.evaluate(setup.model.operator.input_range)
    return setup.tuned(partial(IntegralParameters.scaled, dwell=setup.rest, falls=bool(high < low)))


def _predictive(setup: ControllerSetup) -> PredictiveFollower:
    # Heavy imports, for this one controller.
    from bench.control.predictive import PredictionParameters, PredictiveFollower

    parameters = setup.tuned(partial(PredictionParameters.scaled, period=setup.period))
    inverse, dynamics = setup.inverse(), setup.model.dynamics
    if dynamics is None:
        raise DataError(
            f"controller {setup.name} needs the dynamics of actuator and response, which model {setup.model.name} "
            "lacks; identify it from a run, whose transients show them, not from a table"
        )
    return PredictiveFollower(inverse, dynamics, setup.start, setup.limits, parameters, setup.model_filter())


def _own_error(setup: ControllerSetup) -> float:
    return float(setup.model.provenance.get("rms", 0.0))


OPEN_LOOP_INVERSE = ControllerSpec(
    "the inverse of the model, without feedback",
    lambda s: OpenLoopInverse(
        s.inverse(), s.start, s.limits, wait=_wait(s), adaptation=s.model_filter(), response=s.response
    ),
    adapts=True,
    numbers=lambda s: _Settling(s.rest),
    tunable=("wait",),
    own_error=_own_error,
)
CLOSED_LOOP_INVERSE = ControllerSpec(
    "the inverse of the model, corrected by the measured disturbance",
    lambda s: ClosedLoopInverse(
        s.inverse(), s.start, s.limits, s.tuned(lambda _: _correction(s)), s.model_filter(), s.response
    ),
    adapts=True,
    numbers=_correction,
    tunable=("close_enough", "walk_variance", "arrival.tolerance", "arrival.hold", "corrections"),
)
LATCHED = ControllerSpec(
    "backs off at the target, where the hysteresis holds the output",
    _latched,
    numbers=_latch_parameters,
    tunable=("wander", "noise", "steepest", "farthest"),
)
POLYNOMIAL = ControllerSpec("the look-up table of a model without memory", _look_up, misses=True)
INTEGRAL = ControllerSpec(
    "integral action without a model",
    lambda s: IntegralControl(s.limits, _integral(s)),
    numbers=lambda s: _integral(replace(s, options={})),
    tunable=("gain", "period"),
    misses=True,
)
OPEN_LOOP_FOLLOWER = ControllerSpec(
    "the inverse of the model, without feedback",
    lambda s: OpenLoopFollower(s.inverse(), s.start, s.limits, s.tuned(FollowingParameters.scaled), s.model_filter()),
    adapts=True,
    own_error=_own_error,
)
CLOSED_LOOP_FOLLOWER = ControllerSpec(
    "the inverse of the model, corrected by the measured disturbance",
    lambda s: ClosedLoopFollower(
        s.inverse(), s.start, s.limits, s.tuned(FollowingParameters.scaled), s.model_filter()
    ),
    adapts=True,
)
PREDICTIVE_FOLLOWER = ControllerSpec(
    "set-points of a horizon by model, dynamics and coming reference, within the limits", _predictive, adapts=True
)
INTEGRAL_FOLLOWER = ControllerSpec(
    "integral action without a model", lambda s: IntegralFollower(s.limits, _integral(s)), misses=True
)


def load_model_for(path: str, *, input_unit: str, output_unit: str) -> ModelFile:
    """Read a model file for a rig, whose signals have the given units; of a model with time, its operator at rest.

    Raises DataError if it cannot be read, its units are others, or it does not come to rest.
    """
    model = load_model(Path(path)).at_rest()
    for what, unit, expected in (
        ("input", model.operator.input_unit, input_unit),
        ("output", model.operator.output_unit, output_unit),
    ):
        if unit != expected:
            raise DataError(
                f"model file {path}: its {what} is in {unit or 'no unit'}, that of the rig in {expected}; "
                f"identify the model from columns with units, such as '{what} [{expected}]'"
            )
    return model


def saturated_below(operator: Operator[Any], value: float) -> bool:
    """Return whether an input brings a specimen of this model to negative saturation from any state.

    To 0.4 % of the plane: where measured inputs set its ends, these are readings of set-points, with their noise.
    """
    if operator.plane is None:
        return True
    low, high = operator.plane
    return math.isfinite(value) and value <= low + _END_OF_PLANE * (high - low)
