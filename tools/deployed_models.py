"""Exported C beside the models in Python, for long: random models, instructions, speed.

`compare` tries 200 random models of all families over 100 000 steps each, in `float` and `double`, and prints the
greatest differences; `table` prints the instructions of the worst steps and inverses as Markdown, for
docs/reference/deploy.md; `speed` the time of a step beside that of the compiled kernel in Python, by turns.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))
from deployed import (  # type: ignore[import-not-found]
    RANDOM,
    Compiled,
    differences,
    instructions,
    plane,
    random_sequence,
    shrinking,
)

from bench.deployment import deploy
from bench.identification import ModelFile


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


def table(valgrind: str) -> None:
    """Print the instructions of the worst step and inverse that sequences meant for it have found."""
    print("| plane of 40 levels, `float` | step | inverse |\n|---|---|---|")
    for kind, name in (
        ("", "density ≥ 0"),
        ("thermal", "with a reversible part that falls"),
        ("signed", "of both signs"),
    ):
        model = plane(40, kind)
        low, high = model.output_range()
        room = 2 * model.order + 2
        with tempfile.TemporaryDirectory() as folder:
            deploy(ModelFile("plane", model)).write(Path(folder))

            def count(reversals: int, value: float, *, inverts: bool, folder: str = folder) -> int:
                inputs = shrinking(0.0, 10.0, reversals)
                return instructions(Path(folder), inputs, value, inverts=inverts, valgrind=valgrind)

            full = 2 * room + 1
            steps = [count(full + more, value, inverts=False) for more in (-1, 0) for value in (0.0, 5.001, 10.0)]
            values = [low + part * (high - low) for part in (-0.1, 0.3, 0.55, 0.95)]
            inverses = [count(reversals, value, inverts=True) for reversals in (1, 20, full) for value in values]
        print(f"| {name} | {max(steps):,} | {max(inverses):,} |")


def speed(steps: int) -> None:
    """Print the time of a step in C and in the compiled kernel, by turns, the best of ten; for this processor."""
    print(f"{'family':32}{'C, ns':>8}{'Python, ns':>12}{'ratio':>8}")
    for family in RANDOM:
        model = RANDOM[family](np.random.default_rng(5))
        inputs = random_sequence(*model.input_range, steps, 1)
        with tempfile.TemporaryDirectory() as folder:
            compiled = Compiled(ModelFile(family, model), Path(folder), "double", "gcc", "-O3", "-march=native")
            taken = dict.fromkeys((compiled.steps, model.evaluate), math.inf)
            for _ in range(10):
                for run, best in taken.items():
                    begin = time.perf_counter()
                    run(inputs)
                    taken[run] = min(best, 1e9 * (time.perf_counter() - begin) / steps)
        ours, theirs = taken.values()
        print(f"{family:32}{ours:8.1f}{theirs:12.1f}{ours / theirs:8.2f}")


def main() -> None:
    """Do what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["compare", "table", "speed"])
    parser.add_argument("--models", type=int, default=200)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--targets", type=int, default=300)
    given = parser.parse_args()
    if given.what == "compare":
        compare(given.models, given.steps, given.targets)
    elif given.what == "table":
        table("valgrind")
    else:
        speed(given.steps)


if __name__ == "__main__":
    main()
