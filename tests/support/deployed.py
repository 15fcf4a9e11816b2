"""Exported C beside the models in Python: compilers, random models and sequences, differences."""

import ctypes
import re
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.base import Floats
from bench.deployment import Controller, Real, deploy
from bench.identification import ModelFile
from bench.models import (
    BoucWen,
    Coupled,
    DeadZones,
    Duhem,
    GeneralizedPrandtlIshlinskii,
    MaxwellSlip,
    Operator,
    PolynomialPlays,
    PolynomialTerm,
    PrandtlIshlinskii,
    Preisach,
    QuadraticTerm,
    Reach,
    ThermalExpansion,
    uniform_levels,
)

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic")
REACH = {0: Reach.MET, 1: Reach.TOO_HIGH, -1: Reach.TOO_LOW}

# Loops over sequences, as a call from Python takes longer than a step.
_DRIVER = """
#include "model.h"
unsigned long size_of_state(void) { return (unsigned long)sizeof(model_state); }
unsigned long size_of_saved(void) { return (unsigned long)model_SAVED_SIZE; }
void steps(model_state *s, const model_real *inputs, const model_real *loads, model_real *outputs, long count) {
    long i;
    (void)loads;
    for (i = 0; i < count; ++i) outputs[i] = model_step(s, inputs[i] LOAD);
}
void follow(model_state *s, const model_real *targets, const model_real *loads, model_real *found, int *reach,
            long count) {
    long i;
    (void)loads;
    for (i = 0; i < count; ++i) {
        model_answer a = model_invert(s, targets[i] LOAD);
        found[3 * i] = a.setpoint;
        found[3 * i + 1] = a.saturating;
        found[3 * i + 2] = a.output;
        reach[2 * i] = a.reach;
        reach[2 * i + 1] = a.count;
        if (a.count == 2) model_step(s, a.saturating LOAD);
        model_step(s, a.setpoint LOAD);
    }
}
"""


_CONTROLLED = """
void control(model_controller *c, const model_real *readings, model_real *setpoints, int *said, long count);
void control(model_controller *c, const model_real *readings, model_real *setpoints, int *said, long count) {
    long i;
    model_controller_init(c, model_NEGATIVE);
    for (i = 0; i < count; ++i, readings += 4) {
        setpoints[i] = model_control(c, readings[0], readings[1], readings[2], readings[3]);
        said[2 * i] = c->reach;
        said[2 * i + 1] = c->done;
    }
}
unsigned long size_of_controller(void) { return (unsigned long)sizeof(model_controller); }
"""


class Found(NamedTuple):
    """Answers of an inverse, an array each: set-points, inputs before them, outputs, reach and count."""

    setpoints: np.ndarray
    saturating: np.ndarray
    outputs: np.ndarray
    reach: np.ndarray
    count: np.ndarray


class Compiled:
    """An exported model, compiled as a library, and its state.

    What is `coupled` takes a force with each voltage and target.
    """

    def __init__(
        self,
        file: ModelFile,
        folder: Path,
        real: Real,
        compiler: str = "gcc",
        *options: str,
        period: float | None = None,
        controller: Controller | None = None,
    ) -> None:
        self.deployment = deploy(file, real=real, period=period, controller=controller)
        self.deployment.write(folder)
        load = ", loads[i]" if isinstance(file.model, Coupled) else ""
        controlled = "" if controller is None else _CONTROLLED
        (folder / "driver.c").write_text(_DRIVER.replace(" LOAD", load) + controlled)
        library = folder / "model.so"
        run([compiler, *STRICT, "-O2", *options, "-fPIC", "-c", "model.c", "-o", "model.o"], folder)
        run([compiler, "-O2", *options, "-shared", "-fPIC", "driver.c", "model.o", "-o", str(library), "-lm"], folder)
        self._library = ctypes.CDLL(str(library))
        self._dtype = np.float32 if real == "float" else np.float64
        self._library.size_of_state.restype = self._library.size_of_saved.restype = ctypes.c_ulong
        self._state = ctypes.create_string_buffer(self.size_of_state)
        self.init(0)

    @property
    def size_of_state(self) -> int:
        """Bytes of a state."""
        size: int = self._library.size_of_state()
        return size

    def init(self, start: int) -> None:
        """Start from the memory at the end, that before the data, or negative or positive saturation."""
        self._library.model_init(self._state, start)

    def steps(self, inputs: Floats, loads: Floats | None = None) -> Floats:
        """Return the outputs of a sequence."""
        values, forces = self._arrays(inputs, loads)
        outputs = np.empty_like(values)
        arrays = (_pointer(each) for each in (values, forces, outputs))
        self._library.steps(self._state, *arrays, ctypes.c_long(values.size))
        return outputs.astype(np.float64)

    def follow(self, targets: Floats, loads: Floats | None = None) -> Found:
        """Answer target after target, and move there."""
        values, forces = self._arrays(targets, loads)
        found, reach = np.empty((values.size, 3), self._dtype), np.empty((values.size, 2), np.int32)
        arrays = (_pointer(each) for each in (values, forces, found, reach))
        self._library.follow(self._state, *arrays, ctypes.c_long(values.size))
        return Found(*found.T.astype(np.float64), *reach.T)

    def _arrays(self, *sequences: Floats | None) -> list[Any]:
        count = 0 if sequences[0] is None else sequences[0].size
        return [np.ascontiguousarray(np.zeros(count) if each is None else each, self._dtype) for each in sequences]

    def control(self, readings: Floats) -> tuple[Floats, np.ndarray]:
        """Return set-points, and a row of reach and done each, to time passed, measured input, output and reference.

        Readings have the shape (N, 4).
        """
        rows, setpoints = np.ascontiguousarray(readings, self._dtype), np.empty(len(readings), self._dtype)
        said = np.empty((len(rows), 2), np.int32)
        self._library.size_of_controller.restype = ctypes.c_ulong
        state = ctypes.create_string_buffer(self._library.size_of_controller())
        arrays = (_pointer(each) for each in (rows, setpoints, said))
        self._library.control(state, *arrays, ctypes.c_long(len(rows)))
        return setpoints.astype(np.float64), said

    def save(self) -> bytes:
        """Return the state as bytes."""
        saved = ctypes.create_string_buffer(self._library.size_of_saved())
        self._library.model_save(self._state, saved)
        return saved.raw

    def restore(self, saved: bytes) -> bool:
        """Take a state from bytes; return whether they are whole."""
        return bool(self._library.model_restore(self._state, saved))


def run(command: list[str], folder: Path, given: str = "") -> str:
    """Run a compiler or a program; return what it prints. What it complains of is the message of the error."""
    done = subprocess.run(command, cwd=folder, input=given, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(command)}: {done.stderr}"
    return done.stdout


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


_COUNTED = """
#include <stdio.h>
#include "model.h"
volatile model_real kept;
__attribute__((noinline)) static void probe(model_state *s, model_real value, int inverts) {
    if (inverts) kept = model_invert(s, value).setpoint;
    else kept = model_step(s, value);
}
int main(void) {
    model_state s;
    int count, inverts;
    double value;
    while (scanf("%d %d", &inverts, &count) == 2) {
        model_init(&s, model_NEGATIVE);
        for (; scanf("%lf", &value) == 1 && count > 0; --count) model_step(&s, (model_real)value);
        probe(&s, (model_real)value, inverts);
    }
    return 0;
}
"""


class Probe(NamedTuple):
    """A step or an inverse after a sequence from negative saturation."""

    inputs: Sequence[float]
    value: float
    inverts: bool


def instructions(folder: Path, probes: Sequence[Probe], valgrind: str) -> list[int]:
    """Return the instructions of each probe of the model in a folder, by Valgrind."""
    (folder / "counted.c").write_text(_COUNTED)
    run(["gcc", "-std=gnu99", "-O2", "-g", "counted.c", "model.c", "-o", "counted", "-lm"], folder)
    lines = [[int(each.inverts), len(each.inputs), *each.inputs, each.value] for each in probes]
    text = "\n".join(" ".join(map(repr, line)) for line in lines)
    count = ["--tool=callgrind", "--toggle-collect=probe", "--dump-after=probe", "--callgrind-out-file=counted.out"]
    run([valgrind, *count, "./counted"], folder, text)
    found = []
    for number in range(1, len(probes) + 1):
        totals = re.search(
            r"^(?:summary|totals): (\d+)", (folder / f"counted.out.{number}").read_text(), re.MULTILINE
        )
        assert totals
        found.append(int(totals.group(1)))
    return found


def plane(levels: int, kind: str = "") -> Preisach:
    """Return a plane of so many levels with a random density; `thermal`, `signed` (30 % below 0) or `balanced`."""
    rng = np.random.default_rng(levels)
    order = levels - 1
    density = rng.exponential(1.0, order * (order + 1) // 2)
    if kind in ("signed", "balanced"):
        density *= np.where(rng.random(density.size) < (0.3 if kind == "signed" else 0.5), -1.0, 1.0)
    term = ThermalExpansion(10.0, 3.0, 2.0, 8.0, 0.0) if kind == "thermal" else None
    return Preisach(uniform_levels(0.0, 10.0, order), density, reversible=term)


def shrinking(low: float, high: float, reversals: int) -> list[float]:
    """Return an oscillation about the middle that shrinks evenly: each reversal is remembered."""
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    return [middle + half * (1.0 - k / (reversals + 1)) * (-1.0) ** k for k in range(reversals)]


def probes_of(model: Preisach, count: int, seed: int) -> list[Probe]:
    """Return random probes of a plane: with few corners and with more than there is room for, spread and close.

    Targets of inverses are random, beyond the range, or just beyond what one direction reaches.
    """
    rng = np.random.default_rng(seed)
    (low, high), (least, greatest) = model.input_range, model.output_range()
    full, found = 4 * model.order + 5, []
    for _ in range(count):
        reversals = int(rng.choice([1, 2, 5, 20, 60, full - 1, full]))
        ends = (low, high) if rng.random() < 0.5 else np.sort(rng.uniform(low, high, 2)).tolist()
        inputs = [float(rng.choice([low, high])), *shrinking(*ends, reversals)]
        if rng.random() < 0.25:
            inputs = rng.uniform(low, high, reversals).tolist()
        found.append(Probe(inputs, float(rng.uniform(low, high)), inverts=False))
        state = model.initial_state().advance(inputs)
        ways = [model.evaluate(np.linspace(state.input, end, 400), state) for end in (low, high)]
        targets = [rng.uniform(least, greatest), least - 1.0, greatest + 1.0]
        targets += [extreme + side * 1e-4 for way in ways for extreme, side in ((way.max(), 1.0), (way.min(), -1.0))]
        found.append(Probe(inputs, float(rng.choice(targets)), inverts=True))
    return found


def random_sequence(low: float, high: float, count: int, seed: int, real: str = "double") -> np.ndarray:
    """Return inputs with reversals of every size, saturations and returns to equal values."""
    rng = np.random.default_rng(seed)
    span = high - low
    values = rng.uniform(low, high, count)
    walk = np.clip(np.cumsum(rng.normal(0.0, 0.03 * span, count)) + 0.5 * (low + high), low, high)
    blocks = rng.integers(0, 4, count // 50 + 1).repeat(50)[:count]
    values = np.where(blocks == 0, walk, values)
    # A grid, so that inputs come back to equal values, and levels are met.
    values = np.where(blocks == 1, low + span * np.round((values - low) / span * 16.0) / 16.0, values)
    at = np.arange(count) % 50
    shrinking = 0.5 * (low + high) + 0.5 * span * (1.0 - at / 50.0) * (-1.0) ** at
    values = np.where(blocks == 2, shrinking, values)
    saturated = rng.random(count) < 0.01
    values[saturated] = np.where(rng.random(saturated.sum()) < 0.5, low, high)
    repeated = np.flatnonzero(rng.random(count) < 0.05)
    values[repeated[repeated > 2]] = values[repeated[repeated > 2] - 2]
    return values.astype(np.float32).astype(np.float64) if real == "float" else values


def _preisach(rng: np.random.Generator, sign: str = "") -> Preisach:
    order = int(rng.integers(1, 41))
    low = float(rng.uniform(-5.0, 30.0))
    levels = uniform_levels(low, low + float(rng.uniform(0.5, 60.0)), order)
    if rng.random() < 0.3:
        levels = np.sort(np.concatenate([levels[[0, -1]], rng.uniform(levels[0], levels[-1], order - 1)]))
    density = rng.exponential(1.0, order * (order + 1) // 2) * (rng.random(order * (order + 1) // 2) < 0.7)
    density[0] = 1.0
    if sign == "signed":
        density *= np.where(rng.random(density.size) < 0.3, -1.0, 1.0)
    elif sign == "falling":
        density *= -1.0
    width = levels[-1] - levels[0]
    scale = float(density @ Preisach(levels, np.abs(density)).cell_areas()) or 1.0
    beyond = float(rng.choice([0.0, 0.1])) * width
    term: Any = None
    if sign == "quadratic":
        term = QuadraticTerm(0.5 / width * scale, None if rng.random() < 0.5 else 0.3 * scale / width**2, levels[0])
    elif sign == "polynomial":
        term = PolynomialTerm(tuple(scale * rng.normal(0.0, 0.3, 4)), levels[0] - beyond, levels[-1] + beyond, 32)
    elif sign == "thermal":
        slope = 0.4 * scale / width
        term = ThermalExpansion(slope, 0.2 * slope, levels[0] + 0.2 * width, levels[0] + 0.8 * width, levels[0])
    return Preisach(
        levels, density, bias=float(rng.normal(0.0, 0.1 * abs(scale))), reversible=term,
        input_range=(levels[0] - beyond, levels[-1] + beyond),
    )  # fmt: skip


def _zones(rng: np.random.Generator, reach: float, sign: float = 1.0) -> DeadZones | None:
    if rng.random() < 0.4:
        return None
    count = int(rng.integers(1, 5))
    return DeadZones(np.sort(rng.uniform(-reach, reach, count)), sign * rng.uniform(0.3, 2.0, count + 1))


def _plays(rng: np.random.Generator) -> PrandtlIshlinskii:
    count = int(rng.integers(1, 20))
    thresholds = np.concatenate([[0.0], np.sort(rng.uniform(0.01, 4.0, count - 1))])
    weights = np.concatenate([[1.0], rng.uniform(0.0, 1.0, count - 1)])
    if rng.random() < 0.2:
        weights[0] = 0.0  # A plateau at each reversal: the numerical inverse.
    return PrandtlIshlinskii(
        thresholds, weights * rng.choice([-1.0, 1.0]), float(rng.normal()), float(rng.normal()), _zones(rng, 4.0),
        _zones(rng, 10.0), (-5.0, 5.0),
    )  # fmt: skip


def _generalized(rng: np.random.Generator) -> GeneralizedPrandtlIshlinskii:
    count = int(rng.integers(1, 15))
    thresholds = np.concatenate([[0.0], np.sort(rng.uniform(0.01, 0.9, count - 1))])
    weights = rng.uniform(0.1, 1.0, count) * (
        rng.choice([-1.0, 1.0]) if rng.random() < 0.8 else rng.choice([-1.0, 1.0], count)
    )
    steepness, offset = rng.uniform(0.3, 3.0), rng.uniform(0.0, 0.6)
    return GeneralizedPrandtlIshlinskii(
        thresholds, weights, steepness, offset, steepness, -offset, bias=float(rng.normal()), input_range=(-2.0, 3.0)
    )


def _maxwell(rng: np.random.Generator) -> MaxwellSlip:
    count = int(rng.integers(1, 15))
    slips = np.sort(rng.uniform(0.05, 3.0, count))
    sign = rng.choice([-1.0, 1.0]) if rng.random() < 0.8 else rng.choice([-1.0, 1.0], count)
    return MaxwellSlip(slips, rng.uniform(0.1, 1.0, count) * sign, float(np.mean(sign)) * 0.5, 0.3, 0.1, (-4.0, 5.0))


def _polynomial_plays(rng: np.random.Generator) -> PolynomialPlays:
    count, powers = int(rng.integers(1, 10)), int(rng.integers(1, 4))
    thresholds = np.sort(rng.uniform(0.05, 1.9, count))
    weights = rng.normal(0.0, 0.2, powers * count)
    return PolynomialPlays(
        rng.normal(0.0, 1.0, int(rng.integers(1, 6))) + 0.5, thresholds, weights, (-1.0, 4.0), 0.2, powers=powers
    )


def _bouc_wen(rng: np.random.Generator) -> BoucWen:
    exponent = float(rng.choice([1.0, 1.5, 2.0]))
    return BoucWen(
        1.0,
        float(rng.uniform(-0.8, 2.0)),
        0.1,
        float(rng.uniform(0.5, 5.0)),
        float(rng.uniform(-0.4, 2.0)),
        exponent,
        2.0,
        0.0,
        (-2.0, 3.0),
    )


def _duhem(rng: np.random.Generator) -> Duhem:
    degree = int(rng.integers(1, 6))
    f = rng.normal(0.0, 0.3, degree)
    f[0] = 1.0
    g = rng.normal(0.0, 0.2, degree)
    return Duhem(f, g, float(rng.uniform(0.2, 8.0)), 0.5, 0.0, (-1.0, 4.0))


RANDOM: dict[str, Callable[[np.random.Generator], Any]] = {
    "preisach": _preisach,
    "preisach, falling": lambda rng: _preisach(rng, "falling"),
    "preisach, signed": lambda rng: _preisach(rng, "signed"),
    "preisach, quadratic": lambda rng: _preisach(rng, "quadratic"),
    "preisach, polynomial": lambda rng: _preisach(rng, "polynomial"),
    "preisach, thermal": lambda rng: _preisach(rng, "thermal"),
    "prandtl-ishlinskii": _plays,
    "generalized-prandtl-ishlinskii": _generalized,
    "maxwell-slip": _maxwell,
    "polynomial-plays": _polynomial_plays,
    "bouc-wen": _bouc_wen,
    "duhem": _duhem,
}
"""Random models by family."""


class Differences(NamedTuple):
    """Greatest differences from Python, and answers whose reach is another.

    Of outputs, in ulp of the output range (double) or as its part (float). Of set-points likewise, or of the outputs
    that Python gives at them if that is less: on a plateau any set-point will do.
    """

    outputs: float
    setpoints: float
    disagreements: int


def differences(
    operator: Operator[Any], state: Any, compiled: Compiled, inputs: Floats, targets: Floats, real: Real
) -> Differences:
    """Compare a run over inputs, then the answers to targets, from the start of the memory."""
    low, high = operator.output_range()
    first, last = operator.input_range
    units = high - low, last - first
    if real == "double":
        units = float(np.spacing(max(abs(low), abs(high), high - low))), float(np.spacing(max(abs(first), abs(last))))
    compiled.init(0)
    stream = operator.stream(state)
    expected = np.array([stream.step(value) for value in inputs.tolist()])
    outputs = float(np.abs(compiled.steps(inputs) - expected).max() / units[0])
    state, inverse, worst, disagreements = stream.state, operator.inverse(), 0.0, 0
    answers = compiled.follow(targets)
    for k, target in enumerate(targets.tolist()):
        known = inverse.invert(state, target)
        moved = [answers.saturating[k], answers.setpoints[k]][2 - answers.count[k] :]
        there = operator.evaluate(moved, state)[-1]
        off = abs(answers.setpoints[k] - known.setpoints[-1]) / units[1], abs(there - known.outputs[-1]) / units[0]
        worst = max(worst, *([min(off)] if len(moved) == len(known.setpoints) else [off[1]]))
        disagreements += REACH[int(answers.reach[k])] is not known.reach
        state = operator.advance(state, moved)
    return Differences(outputs, worst, disagreements)
