"""What the dashboard costs: bytes of an .rrd, processor time, and memory of a long run."""

import resource
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

rr = pytest.importorskip("rerun")

from bench.dashboard.entries import Entry, Tick  # noqa: E402
from bench.dashboard.live import CHUNK_ROWS  # noqa: E402
from bench.dashboard.writer import Writer  # noqa: E402
from bench.devices import Settled, Signal  # noqa: E402
from bench.record import StepRecord  # noqa: E402

pytestmark = pytest.mark.benchmark

UNITS = ["°C"] * 6 + ["V"] * 5 + ["A"] * 4 + ["m"] * 3 + ["N"] * 2
SIGNALS = [Signal(f"s{i}", unit, f"signal {i}", 3) for i, unit in enumerate(UNITS)]
META = {
    "run": "cost",
    "rig": "rig",
    "rig_title": "Rig",
    "protocol": "protocol",
    "protocol_summary": "",
    "seed": 0,
    "parameters": {},
    "clock": "wall",
    "epoch": "2026-01-01T00:00:00+00:00",
    "devices": {},
    "operator": "",
    "plan": {"steps": 100, "seconds": 3600.0},
    "git": "",
    "dashboard": {"input": "s0", "output": "s6", "input_range": [-5, 5], "output_range": [-5, 5], "plane": [-5, 5]},
}
NOISE = np.random.default_rng(0).normal(size=(1000, len(UNITS))).tolist()


def portions(hours: float, period: float, ticks: int) -> Iterator[list[Entry]]:
    """Yield the entries of a run, so many ticks at a time, with a step each 80."""
    steps = 0
    for first in range(0, round(3600 * hours / period), ticks):
        entries: list[Entry] = []
        for k in range(first, first + ticks):
            entries.append(Tick(period * k, steps, NOISE[k % 1000]))
            if k % 80 == 79:
                t = period * k
                entries.append(StepRecord(steps, t, t, "", "", Settled.DWELL, {}, tuple(NOISE[k % 1000])))
                steps += 1
        yield entries


def megabytes() -> float:
    """Return the memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def test_an_hour_of_20_channels_at_10_hz(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    writer, path = Writer(SIGNALS, META), tmp_path / "run.rrd"
    writer.open(path, None)
    before = time.process_time()
    # Each second, as at the beginning of a run: the most expensive.
    for entries in portions(1.0, 0.1, 10):
        writer.write(entries)
    share = (time.process_time() - before) / 3600
    writer.recording.close()
    size = path.stat().st_size / 1e6
    with capsys.disabled():
        print(f"\nan hour of 20 channels at 10 Hz: {size:.1f} MB, {100 * share:.2f} % of a core")
    assert size < 40.0
    assert share < 0.05


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_the_memory_of_100_hours_is_flat(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    writer, path = Writer(SIGNALS, META), tmp_path / "run.rrd"
    writer.open(path, None)
    used = []
    # With the portions of a long run.
    for entries in portions(100.0, 1.0, CHUNK_ROWS):
        writer.write(entries)
        used.append(megabytes())
    writer.recording.close()
    warm = used[len(used) // 10 :]
    with capsys.disabled():
        print(f"\n100 h at 1 Hz: {warm[0]:.0f} MB, at the end {warm[-1]:.0f} MB; {path.stat().st_size / 1e6:.0f} MB")
    assert warm[-1] - warm[0] < 20.0
