"""The Preisach oscillator: a mass on a damper and a restoring force with the memory of a Preisach operator.

m y'' + c y' + F[y] = u

with the measured output y + offset. F is a Preisach operator of the displacement with a linear part, the spring.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.models.density import Density
from bench.models.documents import Parts
from bench.models.dynamic.model_with_time import TimedModel, check_sequence
from bench.models.dynamic.oscillator import Drive, Interpolation, Start, check_fields, substeps_for
from bench.models.memory import MemoryCurve
from bench.models.operator import operator_from_json
from bench.models.operators.preisach import Preisach


class PreisachOscillatorState(NamedTuple):
    """State of a Preisach oscillator.

    Attributes
    ----------
    clock : float
        Time of the last sample, s.
    input : float
        Input there, input units.
    velocity : float
        y', output units / s.
    memory : MemoryCurve
        Memory of the restoring force; its input is y, output units.
    """

    clock: float
    input: float
    velocity: float
    memory: MemoryCurve


State: TypeAlias = PreisachOscillatorState | Start
"""After a sample, or before the first one: at rest, or the steady state of a sequence that repeats itself."""


@dataclass(frozen=True, eq=False)
class PreisachOscillator(TimedModel[State]):
    """A mass, a damper and a Preisach operator as restoring force; equation at the head of this module.

    At rest y = y' = 0, and the memory is demagnetised about 0; the force there is F's own.

    Parameters
    ----------
    mass, damping : float
        m and c: input units s² and s per output unit. m > 0, or negative for an output of opposite sign.
    force : Preisach
        F: from y, output units, to a force, input units.
    offset : float
        Output at y = 0, output units.
    input_range, interpolation, input_unit, output_unit
        As `BoucWenOscillator`.

    Raises
    ------
    ValueError
        If a number is not finite, m is 0, the force is no Preisach operator, or a word is unknown.
    """

    kind: ClassVar[str] = "preisach-oscillator"
    starts: ClassVar[tuple[str, ...]] = get_args(Start)
    parts: ClassVar[Parts] = {"force": operator_from_json}

    mass: float
    damping: float
    force: Preisach
    offset: float
    input_range: tuple[float, float]
    interpolation: Interpolation = "smooth"
    input_unit: str = ""
    output_unit: str = ""

    def __post_init__(self) -> None:
        check_fields(self, "mass", "damping", "offset")
        if self.force.kind != Preisach.kind:
            raise ValueError("force: expected a Preisach operator")

    @property
    def stiffness(self) -> float:
        """Slope of the spring, the linear part of the force, at y = 0; input units per output unit."""
        term = self.force.reversible
        if term is None:
            return 0.0
        breaks, quadratics = term.pieces()
        return float(quadratics[int(np.searchsorted(breaks, 0.0)), 1])

    @property
    def tangent(self) -> float:
        """Mean slope of the force over its plane, input units per output unit."""
        low, high = self.force.plane
        ends = self.force.evaluate([low, high], self.force.saturated_state(-1, low))
        return float(ends[1] - ends[0]) / (high - low)

    @property
    def least_slope(self) -> float:
        """Least slope of the force on its major loop, times the sign of the mass; input units per output unit."""
        rising = np.linspace(*self.force.plane, 401)
        sign = math.copysign(1.0, self.mass)
        slopes = [
            np.diff(self.force.evaluate(branch, self.force.saturated_state(direction, branch[0]))) / np.diff(branch)
            for direction, branch in ((-1, rising), (1, rising[::-1]))
        ]
        return float((sign * np.concatenate(slopes)).min())

    def run(
        self, times: ArrayLike, inputs: ArrayLike, state: State | None = None
    ) -> tuple[Floats, PreisachOscillatorState]:
        """Return the outputs of a sequence, shape (N,), and the state after it; see `TimedModel.run`.

        Raises ValueError also if the response grows without bounds, or a periodic start meets uneven times.
        """
        clock, sequence = check_sequence(times, inputs=inputs)
        motion, after = self.motion(clock, sequence, state)
        if after is None:
            raise ValueError(f"inputs: the response of this {self.kind} grows without bounds")
        return motion[:, 0] + self.offset, after

    def motion(
        self, times: Floats, inputs: Floats, state: State | None = None
    ) -> tuple[Floats, PreisachOscillatorState | None]:
        """Return y, y' and F[y] at the samples, shape (N, 3), and the state after; None if they grew infinite."""
        stiffest = max(abs(self.stiffness), abs(self.tangent)) * math.copysign(1.0, self.mass)
        # Of a drive twice as many points are known.
        parts = math.ceil(0.5 * substeps_for(np.array([self.mass, self.damping, stiffest, 0.0]), times))
        driven = Drive.of(times, inputs, self.interpolation, parts, periodic=state == "periodic")
        start = state if isinstance(state, PreisachOscillatorState) else None
        integration = _Integration(self, self.rest if start is None else start.memory, driven.inputs.size)
        if start is not None:
            integration.state[1] = start.velocity
            gap = times[0] - start.clock if times[0] > start.clock else times[1] - times[0]
            integration.run(np.linspace(start.input, inputs[0], 2 * parts + 1)[None], np.array([gap]))
        motion, finite = driven.respond(integration.run, abs(self.damping / (2.0 * self.mass)))
        if not finite:
            return motion, None
        velocity = float(integration.state[1])
        return motion, PreisachOscillatorState(float(times[-1]), float(inputs[-1]), velocity, integration.memory())

    @property
    def rest(self) -> MemoryCurve:
        """The demagnetised memory at y = 0: as after an oscillation that faded away from the ends of the plane."""
        return demagnetised(self.force.levels)

    def densities(self) -> tuple[Density, ...]:
        """Return that of the force."""
        return self.force.densities()

    def initial_state(self) -> State:
        """Return "rest"."""
        return "rest"

    def start(self, word: str) -> State:
        """Return the word itself: "rest" or "periodic"."""
        return "periodic" if word == "periodic" else "rest"

    def parameters(self) -> Mapping[str, tuple[float, str]]:
        """Return mass, damping, the spring and the mean slope of the force, and the frequency with the latter."""
        force, length = self.input_unit or "input", self.output_unit or "output"
        found = {
            "mass": (self.mass, f"{force} s²/{length}"),
            "damping": (self.damping, f"{force} s/{length}"),
            "linear stiffness": (self.stiffness, f"{force}/{length}"),
            "mean stiffness": (self.tangent, f"{force}/{length}"),
            "offset": (self.offset, self.output_unit),
        }
        if self.tangent / self.mass > 0.0:
            found["frequency"] = math.sqrt(self.tangent / self.mass) / (2.0 * math.pi), "Hz"
        return found

    def state_to_json(self, state: State) -> Any:  # noqa: ANN401
        """Return a state as an object, or the word of a start."""
        if not isinstance(state, PreisachOscillatorState):
            return state
        return {**state._asdict(), "memory": self.force.state_to_json(state.memory)}

    def state_from_json(self, document: Any) -> State:  # noqa: ANN401
        """Return the state that `state_to_json` wrote; ValueError if it is none."""
        if document in self.starts:
            return self.start(document)
        if not isinstance(document, dict) or set(document) != set(PreisachOscillatorState._fields):
            raise ValueError(
                f"memory: expected an object with {', '.join(PreisachOscillatorState._fields)}, got {document!r}"
            )
        clock, present, velocity = (_checks.number(name, document[name]) for name in ("clock", "input", "velocity"))
        return PreisachOscillatorState(clock, present, velocity, self.force.state_from_json(document["memory"]))


def demagnetised(levels: Floats) -> MemoryCurve:
    """Return the memory at 0 after an oscillation about 0 that faded, by levels, away from the ends of a plane."""
    above, below = levels[levels > 0.0][::-1].tolist(), levels[levels < 0.0].tolist()
    return MemoryCurve(tuple(value for pair in zip(above, below, strict=False) for value in pair), 0.0)


class _Integration:
    """State and memory of an integration, from call to call."""

    def __init__(self, model: PreisachOscillator, memory: MemoryCurve, most: int) -> None:
        lattice = model.force.lattice
        self.parameters = np.array([model.mass, model.damping, lattice.offset])
        self.plane, self.below, self.terms = lattice.plane, lattice.below, lattice.terms
        low, high = model.force.plane
        left, height, _ = memory.staircase(low, high)
        self.state = np.array([memory.input, 0.0])
        self.count = len(left)
        # As many as there are substeps; pages that are never used take no memory.
        room = len(left) + most + 2
        stack, indices = np.empty((3, room)), np.empty((2, room), dtype=np.int64)
        stack[0, : self.count], stack[1, : self.count] = left, height
        self.pieces = stack[0], stack[1], stack[2], indices[0], indices[1]

    def run(self, inputs: Floats, steps: Floats) -> tuple[Floats, bool]:
        """Return y, y' and F at the samples, shape (N, 3), and whether they stayed finite."""
        from bench.models.kernels import dynamic_kernels as _kernels

        motion = np.empty((steps.size + 1, 3))
        self.count, finite = _kernels.oscillate_on_plane(
            inputs, steps, self.parameters, self.plane, self.below, self.terms, self.pieces, self.count, self.state,
            motion,
        )  # fmt: skip
        return motion, bool(finite)

    def memory(self) -> MemoryCurve:
        """Return the memory: the corners within the plane are all that the force knows of the past."""
        present = float(self.state[0])
        left, height = self.pieces[0][: self.count].tolist(), self.pieces[1][: self.count].tolist()
        curve = MemoryCurve((), float(self.plane[0][0]))
        for edge, top in zip(left, height, strict=True):
            curve = curve.step(edge).step(top)
        return curve.step(present)
