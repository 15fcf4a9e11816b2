"""A step's durable record beside one fdatasync of the same disk, by turns in one run; and a slow disk in a fast loop.

Set TMPDIR to a folder on the disk that is to be measured. Prints, asserts no time but the ratio.
"""

import os
import statistics
import tempfile
import time
from pathlib import Path

import pytest

from bench.devices import Settled, Signal
from bench.record import FILE_NAME, Journal, StepRecord
from bench.record.store import Store

pytestmark = pytest.mark.benchmark

STEPS = 400
SIGNALS = tuple(Signal(f"signal_{i}", "V", "a signal") for i in range(8))
VALUES = tuple(0.1 * i for i in range(8))
SLOW_DISK = 6e-3
TICK = 1e-3
GOAL = 1.5


def step_of(number):
    return StepRecord(number, 1.0, 2.0, "phase", "label", Settled.DWELL, {"tec": 20.0}, VALUES)


def durable_steps():
    """Return the medians of one fdatasync, of a step with a tick before it, and of its CPU, s; by turns."""
    sync = getattr(os, "fdatasync", os.fsync)
    synced, written, cpu = [], [], []
    with tempfile.TemporaryDirectory(dir=os.environ.get("TMPDIR", "/tmp")) as folder:
        journal = Journal(Path(folder) / FILE_NAME, SIGNALS, {})
        with (Path(folder) / "beside").open("wb", buffering=0) as beside:
            for number in range(STEPS):
                began = time.perf_counter()
                beside.write(bytes(4096))
                sync(beside.fileno())
                synced.append(time.perf_counter() - began)
                began, busy = time.perf_counter(), time.process_time()
                journal.telemetry(1.0, number, VALUES)
                journal.step(step_of(number))
                written.append(time.perf_counter() - began)
                cpu.append(time.process_time() - busy)
        journal.close()
    return [statistics.median(times) for times in (synced, written, cpu)]


def test_a_durable_step_costs_little_more_than_one_fdatasync(capsys):
    """The medians of five records."""
    runs = [durable_steps() for _ in range(5)]
    ratio = statistics.median(step / one for one, step, _ in runs)
    with capsys.disabled():
        one, step, cpu = (1e6 * statistics.median(column) for column in zip(*runs, strict=True))
        print(
            f"\nfdatasync {one:.0f} us, a durable step {step:.0f} us, {cpu:.0f} us of it CPU: {ratio:.2f} times",
            end="",
        )
    # A ratio of medians, on one disk.
    assert ratio <= GOAL


def test_a_disk_of_6_ms_does_not_hold_up_a_loop_of_1_khz(capsys, monkeypatch, tmp_path):
    """How late the ticks of a loop are whose journal needs 6 ms for each commit, written by a thread of its own."""
    write = Store.write

    def slow(store, entries):
        time.sleep(SLOW_DISK)
        write(store, entries)

    monkeypatch.setattr(Store, "write", slow)
    late = {}
    for name, patience in (("caller", None), ("thread", 1.0)):
        journal = Journal(tmp_path / f"{name}.sqlite", SIGNALS, {}, patience=patience)
        calls = []
        start = time.perf_counter()
        for tick in range(1000):
            while (now := time.perf_counter()) < start + tick * TICK:
                time.sleep(0)
            journal.telemetry(tick * TICK, 0, VALUES)
            calls.append(time.perf_counter() - now)
        journal.close()
        late[name] = sum(call > TICK for call in calls), max(calls)
    with capsys.disabled():
        for name, (count, longest) in late.items():
            print(
                f"\n{name}: {count} of 1000 calls longer than 1 ms, the longest {1e3 * longest:.2f} ms",
                end="",
            )
    assert late["thread"][0] <= late["caller"][0]
