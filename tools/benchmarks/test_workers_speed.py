"""Runs on all cores, beside the same runs one after another."""

import sys
from pathlib import Path

import pytest

from bench.base import Stopwatch, Workers, available_cores

sys.path.append(str(Path(__file__).parents[2] / "tests" / "support"))
import worker_tasks

RUNS_A_CORE = 4


@pytest.mark.benchmark
def test_runs_on_all_cores_beside_the_same_one_by_one(tmp_path, capsys):
    """Validations of vo2 on the virtual clock, in worker processes that are warm."""
    cores = available_cores()
    runs = RUNS_A_CORE * cores
    with Workers(max(2, cores)) as workers:

        def start():
            return workers.submit(worker_tasks.virtual_run, tmp_path)

        for task in [start() for _ in range(cores)]:
            task.result()
        stopwatch = Stopwatch()
        for _ in range(runs):
            start().result()
        alone = stopwatch.seconds()
        stopwatch = Stopwatch()
        for task in [start() for _ in range(runs)]:
            task.result()
        together = stopwatch.seconds()
    with capsys.disabled():
        print(
            f"\n{runs} runs: {alone:.1f} s one by one, {together:.1f} s on {cores} cores, "
            f"{alone / together / cores:.2f} times the number of cores as fast"
        )
