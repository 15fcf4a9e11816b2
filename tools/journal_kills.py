"""Kill runs at random moments on each rig: no step and no event that the journal has acknowledged is lost.

    python tools/journal_kills.py [--rig RIG] [--times N] [--seed N]

Each run is in process, by turns on the virtual clock, where the control thread writes the journal, and on a paced
one, where a thread of its own does. It is killed by SIGKILL up to 30 ms after a random step was acknowledged. POSIX,
as the runs are forks. The exit code is 1 if anything is lost, or a run that was killed claims to be completed.
"""

import argparse
import io
import os
import random
import select
import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

import bench.execution.context
from bench.execution import Run, carry_out
from bench.record import Journal, Record
from sim_devices.torture.excursion import COUNT as STEPS
from sim_devices.torture.running import Bed, Task

RIGS = ("vo2", "sma", "hybrid")
CLOCKS = ("virtual", "x20")
LONGEST_DELAY = 0.03
LONGEST = 120.0
"""Wall-clock time after which a run hangs, s."""


@dataclass(frozen=True)
class Killed:
    """A run that was killed: its folder, and how many steps and events the journal had acknowledged."""

    folder: Path
    steps: int
    events: int


def killed_run(rig, clock, folder, steps, delay):
    """Start a run below a folder, and kill it some seconds after a number of steps was acknowledged."""
    reader, writer = os.pipe()
    process = os.fork()
    if process == 0:
        try:
            _run(rig, clock, folder, writer)
        finally:
            os._exit(0)
    os.close(writer)
    told = b""
    deadline = time.monotonic() + LONGEST
    while told.count(b"s") < steps and time.monotonic() < deadline:
        if select.select([reader], [], [], 1.0)[0]:
            more = os.read(reader, 4096)
            if not more:
                break
            told += more
    time.sleep(delay)
    os.kill(process, signal.SIGKILL)
    while more := os.read(reader, 4096):
        told += more
    os.close(reader)
    os.waitpid(process, 0)
    (found,) = folder.iterdir()
    return Killed(found, told.count(b"s"), told.count(b"e"))


def _run(rig, clock, folder, writer):
    """Carry an excursion out, and say what the journal has acknowledged."""

    class Telling(Journal):
        def step(self, record):
            super().step(record)
            os.write(writer, b"s")

        def event(self, event):
            super().event(event)
            os.write(writer, b"e")

    bench.execution.context.Journal = Telling
    bed = Bed.of(Task(rig, {}))
    run = Run(bed.protocol, {}, rig, folder, clock=clock, recording=False)
    carry_out(run, Console(file=io.StringIO(), width=200))


def lost(killed):
    """Return how many acknowledged steps and events a killed run lacks, and whether it claims to be completed."""
    with Record(killed.folder) as record:
        steps = set(record.steps()["step"].astype(int).tolist())
        events = len(record.events())
        claims = record.status == "completed" and len(steps) < STEPS
    return len(set(range(killed.steps)) - steps), max(0, killed.events - events), claims


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rig", choices=RIGS, action="append")
    parser.add_argument("--times", type=int, default=200, help="trials in all")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    rigs = asked.rig or RIGS
    chance = random.Random(asked.seed)
    for rig in rigs:
        # What is imported and compiled once need not be by each fork.
        with tempfile.TemporaryDirectory() as folder, Path(os.devnull).open("wb") as nowhere:
            _run(rig, "virtual", Path(folder), nowhere.fileno())
    rows = {(rig, clock): [0] * 6 for rig in rigs for clock in CLOCKS}
    for trial in range(asked.times):
        rig, clock = rigs[trial % len(rigs)], CLOCKS[trial // len(rigs) % len(CLOCKS)]
        with tempfile.TemporaryDirectory(prefix="journal-kills-") as folder:
            steps, delay = chance.randint(1, STEPS - 1), LONGEST_DELAY * chance.random()
            killed = killed_run(rig, clock, Path(folder), steps, delay)
            found = (1, killed.steps, killed.events, *lost(killed))
            rows[rig, clock] = [a + b for a, b in zip(rows[rig, clock], found, strict=True)]
    heads = ("kills", "steps", "events", "lost steps", "lost events", "false")
    print(f"{'rig':8} {'clock':8}" + "".join(f"{head:>12}" for head in heads))
    for (rig, clock), row in rows.items():
        print(f"{rig:8} {clock:8}" + "".join(f"{number:12}" for number in row))
    return 1 if any(any(row[3:]) for row in rows.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
