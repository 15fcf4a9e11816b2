"""The Bouc-Wen oscillator: a mass on a spring, a damper and a hysteretic force.

m y'' + c y' + k y + z = u,   z' = a y' - b |y'| z - d y' |z|

with the measured output y + offset. In the notation of Noël and Schoukens ("Hysteretic benchmark with a dynamic
nonlinearity", Workshop on Nonlinear System Identification Benchmarks 2016) this is ν = 1, a = α, b = β γ and d = β δ;
β apart from γ and δ cannot be identified.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.models.dynamic.model_with_time import TimedModel, check_sequence

Interpolation: TypeAlias = Literal["smooth", "linear", "held"]
Start: TypeAlias = Literal["rest", "periodic"]

_PHASE = 0.015
"""Greatest phase of a substep of the integration, rad.

Derivation: the frequency of the leapfrog method errs by 0.015² / 24, 1e-5; that of Runge and Kutta by less.
"""
_MOST_SUBSTEPS = 200
"""Derivation: they resolve a step of 200 times `_PHASE`, half a wave; data with longer steps do not show the wave."""
_HALF, _WINDOW = 32, 10.0
"""Half length, in samples, and shape of the window of the band-limited interpolation.

Source: Kaiser's formula: a shape of 10 damps by 10 / 0.1102 + 8.7, 99 dB, and needs (99 − 8) / (2.285 · 0.2 π), 64
samples for a transition from 0.8 of the Nyquist frequency to 1.
"""
_EVEN = 1e-6
"""Relative difference of time steps that count as even.

Derivation: over 1000 steps a sample is then off by a thousandth of a step at most.
"""
_SETTLED, _MOST_PERIODS = 18.0, 20
"""Time constants of the linear part after which a periodic response counts as steady, and most periods for it.

Derivation: e⁻¹⁸ is 1.5e-8, the root of the rounding of float64; 20 periods are 18 of a time constant of one, and two
for the hysteresis.
"""


class OscillatorState(NamedTuple):
    """State of an oscillator.

    Attributes
    ----------
    clock : float
        Time of the last sample, s.
    input : float
        Input there, input units.
    position, velocity : float
        y and y', output units and output units / s.
    force : float
        z, input units.
    """

    clock: float
    input: float
    position: float
    velocity: float
    force: float


State: TypeAlias = OscillatorState | Start
"""After a sample, or before the first one: at rest, or the steady state of a sequence that repeats itself."""


def check_fields(model: Any, *numbers: str) -> None:  # noqa: ANN401 - either oscillator
    """Make numbers of the fields of an oscillator; raise ValueError if one is wrong."""
    for name in numbers:
        object.__setattr__(model, name, _checks.number(name, getattr(model, name)))
    if model.mass == 0.0:
        raise ValueError("mass: expected a number other than 0")
    low, high = (_checks.number("input_range", value) for value in model.input_range)
    object.__setattr__(model, "input_range", (low, high))
    words = get_args(Interpolation)
    if model.interpolation not in words:
        raise ValueError(f"interpolation: expected one of {', '.join(words)}, got {model.interpolation!r}")


@dataclass(frozen=True, eq=False)
class BoucWenOscillator(TimedModel[State]):
    """A mass on a spring, a damper and a Bouc-Wen force; equations at the head of this module.

    Parameters
    ----------
    mass, damping, stiffness : float
        m, c and k: input units per output unit, and s² and s. m > 0, or all negative for an output of opposite sign.
    hysteretic_stiffness : float
        a, input units per output unit.
    loop_rate, loop_shape : float
        b and d, 1 / output unit.
    offset : float
        Output at rest, output units.
    input_range : tuple of float
        Range of the inputs from which it was identified, input units.
    interpolation : {"smooth", "linear", "held"}
        The input between samples: band-limited (a cubic spline on uneven times), a straight line, or held.
    input_unit, output_unit : str
        Units, for labels.

    Raises
    ------
    ValueError
        If a number is not finite, m is 0, or a word is unknown.
    """

    kind: ClassVar[str] = "bouc-wen-oscillator"
    starts: ClassVar[tuple[str, ...]] = get_args(Start)

    mass: float
    damping: float
    stiffness: float
    hysteretic_stiffness: float
    loop_rate: float
    loop_shape: float
    offset: float
    input_range: tuple[float, float]
    interpolation: Interpolation = "smooth"
    input_unit: str = ""
    output_unit: str = ""

    def __post_init__(self) -> None:
        check_fields(self, *_NAMES, "offset")

    @property
    def vector(self) -> Floats:
        """m, c, k, a, b and d, shape (6,)."""
        return np.array([getattr(self, name) for name in _NAMES])

    def run(self, times: ArrayLike, inputs: ArrayLike, state: State | None = None) -> tuple[Floats, OscillatorState]:
        """Return the outputs of a sequence, shape (N,), and the state after it; see `TimedModel.run`.

        Raises ValueError also if the response grows without bounds, or a periodic start meets uneven times.
        """
        clock, sequence = check_sequence(times, inputs=inputs)
        substeps = substeps_for(self.vector, clock)
        at = np.zeros(3)
        if isinstance(state, OscillatorState):
            gap = clock[0] - state.clock if clock[0] > state.clock else clock[1] - clock[0]
            between = np.linspace(state.input, sequence[0], 2 * substeps + 1)[None]
            at = np.array([state.position, state.velocity, state.force])
            integrate(self.vector, between, np.array([gap]), at)
        driven = Drive.of(clock, sequence, self.interpolation, substeps, periodic=state == "periodic")
        outputs, finite = respond(driven, self.vector, at)
        if not finite:
            raise ValueError(f"inputs: the response of this {self.kind} grows without bounds")
        position, velocity, force = at.tolist()
        return outputs + self.offset, OscillatorState(
            float(clock[-1]), float(sequence[-1]), position, velocity, force
        )

    def initial_state(self) -> State:
        """Return "rest": y = y' = z = 0."""
        return "rest"

    def start(self, word: str) -> State:
        """Return the word itself: "rest" or "periodic"."""
        return "periodic" if word == "periodic" else "rest"

    def parameters(self) -> Mapping[str, tuple[float, str]]:
        """Return the parameters, and frequency and damping of small oscillations."""
        force, length = self.input_unit or "input", self.output_unit or "output"
        stiffness = self.stiffness + self.hysteretic_stiffness
        small = stiffness / self.mass
        found = {
            "mass": (self.mass, f"{force} s²/{length}"),
            "damping": (self.damping, f"{force} s/{length}"),
            "stiffness": (self.stiffness, f"{force}/{length}"),
            "hysteretic stiffness": (self.hysteretic_stiffness, f"{force}/{length}"),
            "loop rate": (self.loop_rate, f"1/{length}"),
            "loop shape": (self.loop_shape, f"1/{length}"),
            "offset": (self.offset, self.output_unit),
        }
        if small > 0.0:
            found["natural frequency"] = math.sqrt(small) / (2.0 * math.pi), "Hz"
            found["damping ratio"] = abs(self.damping) / (2.0 * math.sqrt(stiffness * self.mass)), ""
        return found

    def state_to_json(self, state: State) -> Any:  # noqa: ANN401
        """Return a state as a list of numbers, or the word of a start."""
        return list(state) if isinstance(state, OscillatorState) else state

    def state_from_json(self, document: Any) -> State:  # noqa: ANN401
        """Return the state that `state_to_json` wrote; ValueError if it is none."""
        if document in self.starts:
            return self.start(document)
        if not isinstance(document, list) or len(document) != len(OscillatorState._fields):
            raise ValueError(f"memory: expected {len(OscillatorState._fields)} numbers, got {document!r}")
        return OscillatorState(*(_checks.number("memory", value) for value in document))


_NAMES = ("mass", "damping", "stiffness", "hysteretic_stiffness", "loop_rate", "loop_shape")


@dataclass(frozen=True, eq=False)
class Drive:
    """An input as the integration needs it.

    Attributes
    ----------
    inputs : ndarray, shape (N - 1, 2 S + 1)
        Input at the ends and middles of the substeps of each step.
    steps : ndarray, shape (N - 1,)
        s.
    closing : ndarray, shape (1, 2 S + 1), or None
        The same from the last sample to the first of the next period, for a sequence that repeats itself.
    """

    inputs: Floats
    steps: Floats
    closing: Floats | None

    @classmethod
    def of(
        cls, times: Floats, inputs: Floats, interpolation: Interpolation, substeps: int, *, periodic: bool
    ) -> Drive:
        """Return the drive of a sequence, shape (N,).

        Raises ValueError if it shall repeat itself on uneven times.
        """
        steps = np.diff(times)
        even = bool(np.ptp(steps) <= _EVEN * steps.mean() + 8.0 * np.finfo(float).eps * np.abs(times).max())
        if periodic and not even:
            raise ValueError("times: a periodic start needs even steps; start from rest")
        whole = np.append(inputs, inputs[0]) if periodic else inputs
        parts = 2 * substeps
        rows = _upsampled(times, whole, interpolation, parts, even=even, periodic=periodic)
        count = steps.size
        return cls(np.ascontiguousarray(rows[:count]), steps, rows[count:] if periodic else None)

    def respond(
        self, integrate: Callable[[Floats, Floats], tuple[Floats, bool]], decay: float
    ) -> tuple[Floats, bool]:
        """Return what the integration of the sequence returns; from the steady state if it repeats itself.

        Parameters
        ----------
        integrate : callable
            From inputs and steps as above to the response at the samples and whether it stayed finite; keeps the
            state from call to call.
        decay : float
            Rate at which free oscillations decay, 1/s; 0 if it is not known.
        """
        if self.closing is not None:
            turns = decay * float(self.steps.sum() + self.steps[-1])
            for _ in range(min(math.ceil(_SETTLED / turns), _MOST_PERIODS) if turns > 0.0 else _MOST_PERIODS):
                outputs, finite = integrate(self.inputs, self.steps)
                if not finite:
                    return outputs, False
                integrate(self.closing, self.steps[-1:])
        return integrate(self.inputs, self.steps)


def respond(driven: Drive, parameters: Floats, state: Floats) -> tuple[Floats, bool]:
    """Return y at the samples, shape (N,), and whether it stayed finite; `state` is that at the end then."""
    m, c, k, a = parameters[:4]
    decay = abs(c / (2.0 * m)) if (k + a) / m > 0.0 else 0.0
    return driven.respond(lambda inputs, steps: integrate(parameters, inputs, steps, state), decay)


def integrate(parameters: Floats, inputs: Floats, steps: Floats, state: Floats) -> tuple[Floats, bool]:
    """Return y at the samples and whether it stayed finite; arguments as the kernel `oscillate`."""
    from bench.models.kernels import dynamic_kernels as _kernels

    outputs = np.empty(steps.size + 1)
    finite = _kernels.oscillate(inputs, steps, parameters, state, outputs)
    return outputs, bool(finite)


def substeps_for(parameters: Floats, times: Floats) -> int:
    """Return the number of substeps of a time step that keep the integration exact beside the data."""
    m, _, k, a = parameters[:4]
    fastest = math.sqrt(abs((k + a) / m)) * float(np.diff(times).max())
    return int(np.clip(math.ceil(fastest / _PHASE), 1, _MOST_SUBSTEPS))


def _upsampled(
    times: Floats, inputs: Floats, interpolation: Interpolation, parts: int, *, even: bool, periodic: bool
) -> Floats:
    """Return the input at `parts` + 1 evenly spaced points of each step, ends included, shape (N - 1, parts + 1)."""
    shares = np.arange(parts + 1) / parts
    count = inputs.size - 1
    if interpolation == "held":
        return np.repeat(inputs[:-1, None], parts + 1, axis=1)
    if interpolation == "linear":
        return inputs[:-1, None] + np.diff(inputs)[:, None] * shares
    if even and periodic:
        fine = np.fft.irfft(np.fft.rfft(inputs[:-1]), count * parts) * parts
        fine = np.append(fine, fine[0])
    elif even:
        from scipy.signal import upfirdn

        places = np.arange(-_HALF * parts, _HALF * parts + 1) / parts
        kernel = np.sinc(places) * np.kaiser(places.size, _WINDOW)
        padded = np.pad(inputs, _HALF, mode="reflect", reflect_type="odd") if count >= _HALF else None
        if padded is None:
            padded = np.pad(inputs, _HALF, mode="edge")
        fine = upfirdn(kernel, padded, up=parts)[2 * _HALF * parts :][: count * parts + 1]
    else:
        from scipy.interpolate import CubicSpline

        grid = times[:-1, None] + np.diff(times)[:, None] * shares
        return np.asarray(CubicSpline(times, inputs)(grid))
    rows = np.lib.stride_tricks.sliding_window_view(fine, parts + 1)[::parts]
    return np.ascontiguousarray(rows)
