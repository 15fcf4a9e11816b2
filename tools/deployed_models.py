"""Exported C beside the models in Python, for long: random models, instructions, speed.

`compare` tries 200 random models of all families over 100 000 steps each, in `float` and `double`, and prints the
greatest differences; `table` prints the instructions of the worst steps and inverses as Markdown, for
docs/reference/deploy.md; `speed` the time of a step beside that of the compiled kernel in Python, by turns.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))
from deployed import (  # type: ignore[import-not-found]
    RANDOM,
    Compiled,
    Probe,
    differences,
    instructions,
    plane,
    probes_of,
    random_sequence,
)

from bench.deployment import deploy
from bench.identification import ModelFile
from bench.models import Operator


def compare(models: int, steps: int, targets: int) -> None:
    """Print the greatest differences by family."""
    worst: dict[tuple[str, str], list[float]] = defaultdict(lambda: [0.0, 0.0, 0.0, 0.0])
    families = list(RANDOM)
    for seed in range(models):
        family = families[seed % len(families)]
        model = RANDOM[family](np.random.default_rng(1000 + seed))
        low, high = model.output_range()
        beyond = 0.05 * (high - low)
        for real in ("double", "float"):
            inputs = random_sequence(*model.input_range, steps, seed, real)
            wanted = random_sequence(low - beyond, high + beyond, targets, seed + 1, real)
            with tempfile.TemporaryDirectory() as folder:
                compiled = Compiled(ModelFile(family, model), Path(folder), real)
                found = differences(model, model.initial_state(), compiled, inputs, wanted, real)
            row = worst[family, real]
            row[:] = [row[0] + 1, *(max(pair) for pair in zip(row[1:], found, strict=True))]
    print(f"{'family':32}{'numbers':9}{'models':>7}{'outputs':>10}{'set-points':>12}{'other reach':>12}")
    for (family, real), (count, outputs, setpoints, other) in sorted(worst.items()):
        print(f"{family:32}{real:9}{count:7.0f}{outputs:10.2g}{setpoints:12.2g}{other:12.0f}")
    print("double: ulp of the range; float: parts of the range")


def table(probes: int) -> None:
    """Print the instructions of the worst of random steps and inverses, and how many of these are within 6,000."""
    print("| `float`; planes of 40 levels | step | inverse | inverses within 6,000 |\n|---|---|---|---|")
    for kind, name in (
        ("", "density ≥ 0"),
        ("thermal", "with a reversible part that falls"),
        ("signed", "density with 30 % below 0"),
        ("balanced", "density with 50 % below 0"),
    ):
        model = plane(40, kind)
        steps, inverses = _counts(model, probes_of(model, probes, 1))
        within = 100.0 * np.mean(inverses <= 6000)
        print(f"| {name} | {steps.max():,} | {inverses.max():,} | {within:.1f} % |")
    for family in list(RANDOM)[6:]:
        model, rng = RANDOM[family](np.random.default_rng(5)), np.random.default_rng(1)
        spans = (model.input_range, model.output_range())
        tried = [
            Probe(rng.uniform(*spans[0], 5).tolist(), float(rng.uniform(*spans[inverts])), inverts=bool(inverts))
            for inverts in (0, 1) * (probes // 10)
        ]
        steps, inverses = _counts(model, tried)
        print(f"| {family} | {steps.max():,} | {inverses.max():,} | {100.0 * np.mean(inverses <= 6000):.1f} % |")


def _counts(model: Operator, probes: list[Probe]) -> tuple[np.ndarray, np.ndarray]:
    """Return the instructions of steps and of inverses."""
    with tempfile.TemporaryDirectory() as folder:
        deploy(ModelFile("mine", model)).write(Path(folder))
        found = np.array(instructions(Path(folder), probes, "valgrind"))
    inverts = np.array([each.inverts for each in probes])
    return found[~inverts], found[inverts]


def speed(steps: int) -> None:
    """Print the time of a step in C and in the compiled kernel, for this processor: medians of turns by pairs."""
    print(f"{'family':32}{'C, ns':>8}{'Python, ns':>12}{'ratio':>8}")
    for family in RANDOM:
        model = RANDOM[family](np.random.default_rng(5))
        inputs = random_sequence(*model.input_range, steps, 1)
        with tempfile.TemporaryDirectory() as folder:
            compiled = Compiled(ModelFile(family, model), Path(folder), "double", "gcc", "-O3", "-march=native")
            turns = np.array([[_taken(run, inputs) for run in (compiled.steps, model.evaluate)] for _ in range(40)])
        (ours, theirs), ratio = np.median(turns[1:], axis=0), np.median(turns[1:, 0] / turns[1:, 1])
        print(f"{family:32}{ours:8.1f}{theirs:12.1f}{ratio:8.2f}")


def _taken(run: Callable[[np.ndarray], object], inputs: np.ndarray) -> float:
    """Return the time of a step, ns."""
    begin = time.perf_counter()
    run(inputs)
    return 1e9 * (time.perf_counter() - begin) / inputs.size


def main() -> None:
    """Do what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["compare", "table", "speed"])
    parser.add_argument("--models", type=int, default=200)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--targets", type=int, default=300)
    parser.add_argument("--probes", type=int, default=1000)
    given = parser.parse_args()
    if given.what == "compare":
        compare(given.models, given.steps, given.targets)
    elif given.what == "table":
        table(given.probes)
    else:
        speed(given.steps)


if __name__ == "__main__":
    main()
