"""A campaign with one worker beside as many as there are cores; on an idle machine."""

import resource
import time

import pytest

from bench.base import Workers, available_cores
from bench.batch import WorkersExecutor, carry_out_tasks, expand, read_campaign

CAMPAIGN = """
[[runs]]
protocol = "damped-oscillation"
rigs = ["vo2"]
seeds = "1..12"
[runs.parameters]
increment = 0.3
"""


def cpu():
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def measured(tasks, number, folder):
    begun, used = time.perf_counter(), cpu()
    with Workers(number) as workers:
        done = carry_out_tasks(tasks, {}, WorkersExecutor(workers, folder))
    assert {each.status for each in done.values()} == {"completed"}
    return time.perf_counter() - begun, cpu() - used


@pytest.mark.benchmark
def test_workers_on_as_many_cores(tmp_path, capsys):
    path = tmp_path / "speed.toml"
    path.write_text(CAMPAIGN)
    tasks = expand(read_campaign(path)).tasks
    cores = available_cores()
    (alone, alone_cpu), (together, together_cpu) = (
        measured(tasks, number, tmp_path / str(number)) for number in (1, cores)
    )
    with capsys.disabled():
        print(
            f"\n{len(tasks)} runs: {alone:.1f} s ({alone_cpu:.1f} s of CPU) with one worker, {together:.1f} s "
            f"({together_cpu:.1f} s of CPU) with {cores}: {alone / together:.2f} times as fast, "
            f"{alone / together / cores:.2f} a worker"
        )
