"""The rate of a loop against the number of its devices: CPU time in process, and the rate over ptys.

Prints a table; asserts that a device costs as much as any other, not how much.
"""

import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from bench.interrupts import Interrupts
from bench.journal import Record
from bench.runs import Run, carry_out
from sim_devices.serving.process import serve

sys.path.append(str(Path(__file__).parents[1] / "bench"))

from following_supplies import rig_of, supplies

pytestmark = pytest.mark.benchmark

SAMPLES = 400
FASTEST = 10_000.0
"""Rate that no line reaches, Hz: the loop runs as fast as it can."""


def carried_out(tmp_path, count, *, rate, duration, **keys):
    rig = tmp_path / f"supplies{count}.toml"
    rig.write_text(rig_of(count), encoding="utf-8")
    run = Run(
        protocol=supplies,
        settings={"count": count, "rate": rate, "duration": duration},
        rig=str(rig),
        folder=tmp_path / "runs",
        recording=False,
        rehearse=False,
        **keys,
    )
    before = time.process_time()
    result = carry_out(run, Console(quiet=True), Interrupts())
    assert result.outcome.status == "completed", result.outcome.reason
    with Record(result.folder) as record:
        return time.process_time() - before, record.meta["lateness"]["sine"]


def _cpu(found):
    return found[0]


def test_cpu_time_a_sample_in_process(tmp_path, capsys):
    costs = {}
    for count in (1, 2, 4, 8, 16):
        # What a run costs without its loop is taken away; the rate leaves the lines the time that they take.
        short, long = (
            [carried_out(tmp_path, count, rate=20.0, duration=samples / 20.0, clock="virtual") for _ in range(3)]
            for samples in (1, SAMPLES)
        )
        (before, few), (after, many) = min(short, key=_cpu), min(long, key=_cpu)
        costs[count] = (after - before) / (many["samples"] - few["samples"])
    with capsys.disabled():
        print("\ndevices  CPU time a sample, µs  a device, µs")
        for count, cost in costs.items():
            print(f"{count:>7}  {1e6 * cost:>21.0f}  {1e6 * cost / count:>12.0f}")
    assert costs[16] / 16 < 2.0 * costs[1]


@pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals")
@pytest.mark.timeout(600)
def test_rate_over_ptys_on_the_wall_clock(tmp_path, capsys):
    rows = []
    for count in (1, 2, 4, 8):
        rig = tmp_path / f"supplies{count}.toml"
        rig.write_text(rig_of(count), encoding="utf-8")
        with serve(str(rig), clock="x1") as served:
            for rate in (100.0, FASTEST):
                _, late = carried_out(tmp_path, count, rate=rate, duration=3.0, attach=served.endpoints_file)
                rows.append((count, rate, late))
    with capsys.disabled():
        print("\ndevices  asked, Hz  samples/s  left out  mean late, ms  worst, ms")
        for count, rate, late in rows:
            print(
                f"{count:>7}  {rate:>9.0f}  {late['samples'] / 3.0:>9.1f}  {late['left_out']:>8}  "
                f"{1e3 * late['mean']:>13.2f}  {1e3 * late['worst']:>9.1f}"
            )
    assert all(late["samples"] > 0 for *_, late in rows)
