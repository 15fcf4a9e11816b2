"""The rate of a loop against the number of its devices: CPU time in process, and the rate over ptys.

Prints a table and how late the samples were; asserts how the cost grows, not how much it is.
"""

import os
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from bench.base import Interrupts
from bench.execution import Run, carry_out
from bench.record import Record, lateness_lines
from bench.rig import read_endpoints
from sim_devices.serving.process import serve

sys.path.append(str(Path(__file__).parents[2] / "tests" / "support"))

from following_supplies import hardware_of, rig_of, supplies

pytestmark = pytest.mark.benchmark

SAMPLES = 300
SELDOM = {"telemetry.period": "60"}
"""Overrides for a loop alone, without the ticks of the telemetry."""
SECONDS = 10.0
FASTEST = 10_000.0
"""Rate that no line reaches, Hz: the loop runs as fast as it can."""


def carried_out(tmp_path, count, *, rate, duration, text=None, recording=False, **keys):
    rig = tmp_path / f"supplies{count}.toml"
    rig.write_text(text or rig_of(count), encoding="utf-8")
    run = Run(
        protocol=supplies,
        settings={"count": count, "rate": rate, "duration": duration},
        rig=str(rig),
        folder=tmp_path / "runs",
        recording=recording,
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
        # What a run costs without its loop is taken away; the rate leaves the lines their time.
        short, long = (
            [
                carried_out(tmp_path, count, rate=1.0, duration=samples, clock="virtual", overrides=SELDOM)
                for _ in range(2)
            ]
            for samples in (1, SAMPLES)
        )
        (before, few), (after, many) = min(short, key=_cpu), min(long, key=_cpu)
        costs[count] = (after - before) / (many["samples"] - few["samples"])
    with capsys.disabled():
        print("\ndevices  CPU time a sample, µs  a device, µs")
        for count, cost in costs.items():
            print(f"{count:>7}  {1e6 * cost:>21.0f}  {1e6 * cost / count:>12.0f}")
    # A device costs as much as any other; on top comes the emulated plant, which advances whole with each query.
    assert costs[16] / 16 < 4.0 * costs[1]


@pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals")
@pytest.mark.timeout(600)
def test_rate_over_ptys_on_the_wall_clock(tmp_path, capsys):
    """As with instruments on serial lines: no part of the bench knows that they are emulated by another process."""
    rows, shown = [], []
    for count in (1, 2, 4, 8):
        emulated = tmp_path / f"emulated{count}.toml"
        emulated.write_text(rig_of(count), encoding="utf-8")
        with serve(str(emulated), clock="x1") as served:
            (ports,) = (each.instruments for each in read_endpoints(served.endpoints_file).served.values())
            text = hardware_of(count, {name: endpoint.port for name, endpoint in ports.items()})
            for rate in (100.0, FASTEST):
                before = os.times()
                cost, late = carried_out(tmp_path, count, rate=rate, duration=SECONDS, recording=True, text=text)
                after = os.times()
                # The guardian has ended; what it took to start is in it.
                guardian = sum(after[2:4]) - sum(before[2:4])
                rows.append((count, rate, late, cost / late["samples"], guardian / late["samples"]))
            shown += [f"{count} devices", *lateness_lines({"sine": rows[-2][2]})]
    with capsys.disabled():
        print(
            "\ndevices  asked, Hz  samples/s  left out  mean late, ms  worst, ms  CPU a sample, ms: bench  guardian"
        )
        for count, rate, late, cost, guardian in rows:
            reached = f"{late['samples'] / SECONDS:>9.1f}  {late['left_out']:>8}"
            lateness = f"{1e3 * late['mean']:>13.2f}  {1e3 * late['worst']:>9.1f}"
            print(f"{count:>7}  {rate:>9.0f}  {reached}  {lateness}  {1e3 * cost:>23.2f}  {1e3 * guardian:>8.2f}")
        print("\n".join(shown))
    assert all(late["samples"] > 0 for _, _, late, *_ in rows)
