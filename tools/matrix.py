"""The fault matrix: each fault of each rig, with several seeds, in process on the virtual clock.

    python tools/matrix.py [--rig RIG] [--fault WORD] [--seeds N] [--processes N] [--json FILE]

Each run is judged by the emulated instruments and the plant, not by what the drivers or the journal say of them:

ends    the run ends within its planned time and a margin
safe    every output is off in its instrument at the end; w: by the watchdogs of the instruments, within 10 s
limits  the drive never was beyond the limit of the rig file
names   what ended it names a device of the instrument at fault; . where the run was completed
rows    every step and tick that the engine has counted is in the journal
true    every recorded value is that of the plant within the noise; . where the sensor itself is at fault

The exit code is 1 if anything has failed.
"""

import argparse
import faulthandler
import io
import json
import math
import sys
import tempfile
import zlib
from bisect import bisect_left, bisect_right
from collections import Counter
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import datetime
from functools import cache
from pathlib import Path

from rich.console import Console

from bench.base import BenchError, Workers
from bench.base.clock import VIRTUAL_EPOCH
from bench.execution import Run, carry_out
from bench.protocol import find_protocol
from bench.record import Record
from bench.rig import load_rig

HERE = Path(__file__).parent
RIGS = ("vo2", "sma", "hybrid")
SEEDS = 5
DURATION = 5.0
"""Of a fault that has an end, s."""
MARGIN = 60.0
"""Laboratory time that a run may take beyond its plan, s."""
WATCHDOGS = 10.0
"""After which the watchdogs of the instruments have made every output safe, s."""
LONGEST = 300.0
"""Wall-clock time after which a run hangs, s."""
AGE = 1.5
"""Age that a value may have when it is recorded, s."""
DELAYS = (0.05, 0.12, 0.25, 0.6, 1.2)
"""By which answers are late, by seed, s: shorter and longer than the time-outs of the drivers."""
CHECKS = ("ends", "safe", "limits", "names", "rows", "true")
OUTPUTS = {
    "vo2": ("tec_output",),
    "sma": ("supply_voltage", "stage_torque", "fan"),
    "hybrid": ("tec_output", "amplifier_enable"),
}
LIMITS = {"vo2": ("tec_current", 1.0), "sma": ("supply_voltage", 3.2), "hybrid": ("tec_current", 0.15)}
"""By rig a true value, and the limit of the rig file that it never exceeds."""

SEEN = {
    "vo2": {
        "tec_temperature": ("plate_temperature", 1.0, 0.03),
        "tec_sink_temperature": ("sink_temperature", 1.0, 0.1),
        "tec_current": ("tec_current", 1.0, 0.01),
        "psd_position": ("tip_deflection", 1.0, 0.4e-6),
    },
    "sma": {
        "supply_voltage": ("supply_voltage", 1.0, 0.05),
        "load_cell_force": ("force", 1.0, 0.25),
        "wire_end_position": ("position", 1.0, 0.2e-3),
        "stage_position": ("stage_angle", 4.5e-3, 0.05e-3),
    },
    "hybrid": {
        "tec_current": ("tec_current", 1.0, 0.005),
        "base_temperature": ("base_temperature", 1.0, 0.2),
        "tip_temperature": ("tip_temperature", 1.0, 0.2),
        "displacement_position": ("deflection", 1.0, 0.1e-6),
        "piezo_voltage": ("piezo_voltage", 1.0, 0.15),
    },
}
"""By signal: the true value it comes from, its scale, and how far noise and instrument may bring it off."""
OFFSETS = {"stage_position": -2200 * 2 * math.pi / 4096 * 4.5e-3}

LYING = (".stuck", ".noisy", ".drifting", ".out-of-range", ".freeze")
LYING_TOO = (
    "displaced-spot", "spot-off-the-psd", "unplugged-sensor", "broken-load-cell", "open-thermistor",
    "shorted-thermistor", "out-of-range", "broken-muscle",
)  # fmt: skip
"""Faults by which the sensor itself says what is not, or is beyond its range."""


@dataclass(frozen=True)
class Cell:
    """One run of the matrix, judged; `results` are `ok`, `.`, `w` or what is wrong."""

    rig: str
    fault: str
    seed: int
    status: str
    reason: str
    results: dict = field(default_factory=dict)

    @property
    def failures(self):
        return [check for check in CHECKS if self.results[check] not in ("ok", ".", "w")]


@cache
def faults_of(rig):
    """Return the faults of a rig by name."""
    from bench.base import VirtualClock

    file = load_rig(rig)
    return dict(file.laboratory(file.laboratory_settings, VirtualClock(), 0).faults)


def entry(name, fault, seed):
    """Return the entry of the schedule: at an instant by the seed, with an end if it may have one."""
    instant = 4.0 + 24.0 * (zlib.crc32(f"{name} {seed}".encode()) / 2**32)
    found = {"at": round(instant, 3), "fault": name}
    if fault.undo is not None:
        found["duration"] = DURATION
    if "probability" in fault.values:
        # On even seeds every answer of the duration, on odd ones some of them.
        found["values"] = {"probability": 0.3 if seed % 2 else 1.0}
    if name.endswith(".delay"):
        found["values"]["seconds"] = DELAYS[seed % len(DELAYS)]
    return found


def run_cell(rig, name, seed):
    """Carry one run out and judge it."""
    fault = faults_of(rig)[name]
    with tempfile.TemporaryDirectory(prefix="fault-matrix-") as folder:
        schedule = Path(folder) / "faults.jsonl"
        schedule.write_text(json.dumps(entry(name, fault, seed)) + "\n")
        run = Run(
            protocol=find_protocol(f"{HERE / 'excursions.py'}:excursion-{rig}"), settings={}, seed=seed,
            rig=str(HERE / f"{rig}-observed.toml"), folder=Path(folder), clock="virtual", recording=False,
            faults=schedule,
        )  # fmt: skip
        results = dict.fromkeys(CHECKS, "ok")
        outcome = None
        try:
            outcome = carry_out(run, Console(file=io.StringIO(), width=200)).outcome
            status, reason = outcome.status, outcome.reason
        except BenchError as error:
            status, reason = "refused", str(error)
        except Exception as error:
            status, reason = "crashed", f"{type(error).__name__}: {error}"
            results["ends"] = f"{type(error).__name__}: {error}"
        # The rig file has imported the module, which stands beside it.
        (laboratory,) = sys.modules["observed"].latest
        results["limits"] = _limits(laboratory, rig)
        results["safe"] = _safe(laboratory, rig)
        if outcome is not None:
            planned = 2.0 * 16
            if outcome.laboratory_seconds > planned + MARGIN:
                results["ends"] = f"after {outcome.laboratory_seconds:.0f} s"
            (journal,) = Path(folder).glob("*/")
            with Record(journal) as record:
                results["rows"] = _rows(record, outcome)
                results["true"] = _true(record, rig, name, laboratory)
        results["names"] = _named(rig, name, status, reason)
        return Cell(rig, name, seed, status, reason, results)


def _safe(laboratory, rig):
    """Look at the outputs themselves, and again when the watchdogs have expired."""

    def on():
        outputs = laboratory.outputs()
        return {name: outputs[name] for name in OUTPUTS[rig] if outputs[name]}

    if not on():
        return "ok"
    laboratory.clock.sleep(WATCHDOGS)
    return f"on for ever: {still}" if (still := on()) else "w"


def _limits(laboratory, rig):
    name, limit = LIMITS[rig]
    highest = max(abs(values[name]) for _, values in laboratory.seen)
    return "ok" if highest <= 1.01 * limit else f"{name} was {highest:.3g}, beyond {limit:g}"


def _named(rig, name, status, reason):
    if status == "completed":
        return "."
    file = load_rig(rig)
    instrument = name.rpartition(".")[0]
    on_it = [each.name for each in file.devices if getattr(each.settings, "port", "") == f"emulated://{instrument}"]
    wanted = on_it or [each.name for each in file.devices]
    return "ok" if any(device in reason for device in wanted) else f"names none of {', '.join(wanted)}"


def _rows(record, outcome):
    steps = len(record.steps())
    if steps != outcome.steps:
        return f"{steps} steps of {outcome.steps}"
    return "ok" if record.status == outcome.status else f"journal says {record.status}"


def _true(record, rig, name, laboratory):
    if name.endswith(LYING) or name in LYING_TOO:
        return "."
    times = [time for time, _ in laboratory.seen]
    # The journal counts from the start of the run, the laboratory from the start of its clock.
    start = (datetime.fromisoformat(record.meta["epoch"]) - VIRTUAL_EPOCH).total_seconds()
    for table, clock in ((record.telemetry(), "t"), (record.steps(), "finished")):
        for signal, (source, scale, tolerance) in SEEN[rig].items():
            for t, value in zip(table[clock] + start, table[signal], strict=True):
                window = laboratory.seen[max(bisect_left(times, t - AGE) - 1, 0) : bisect_right(times, t) + 1]
                truths = [scale * values[source] + OFFSETS.get(signal, 0.0) for _, values in window]
                if not min(truths) - tolerance <= value <= max(truths) + tolerance:
                    return f"{signal} = {value:.6g} at {t:.2f} s, truly {min(truths):.6g} to {max(truths):.6g}"
    return "ok"


def cells(rigs=RIGS, word="", seeds=SEEDS):
    """Return the cells of the matrix: rig, fault and seed."""
    return [(rig, name, seed) for rig in rigs for name in faults_of(rig) if word in name for seed in range(seeds)]


def judged(wanted, processes):
    """Yield each cell as it is done, in their order; one that hangs is one of its failures."""
    # As a script this module has another name.
    from matrix import run_cell_in_time

    with Workers(processes, Console(), "fault matrix") as workers:
        waiting = [(cell, workers.submit_as(" ".join(map(str, cell)), run_cell_in_time, *cell)) for cell in wanted]
        for (rig, name, seed), pending in waiting:
            try:
                yield pending.result()
            except BenchError as error:
                yield Cell(rig, name, seed, "refused", "", dict.fromkeys(CHECKS, ".") | {"ends": str(error)})


def run_cell_in_time(rig, name, seed):
    """As `run_cell`; a run that hangs says where, and ends its process."""
    faulthandler.dump_traceback_later(LONGEST, exit=True)
    try:
        return run_cell(rig, name, seed)
    finally:
        faulthandler.cancel_dump_traceback_later()


def table(done):
    """Return the matrix as text: a row a rig and fault, with the number of seeds that passed."""
    lines = [f"{'rig':8} {'fault':26} {'ended':24} " + " ".join(f"{check:>6}" for check in CHECKS)]
    rows = {}
    for cell in done:
        rows.setdefault((cell.rig, cell.fault), []).append(cell)
    for (rig, name), row in rows.items():
        marks = []
        for check in CHECKS:
            bad = sum(check in cell.failures for cell in row)
            kinds = {cell.results[check] for cell in row}
            marks.append(
                f"{len(row) - bad}/{len(row)}" if bad else "w" if "w" in kinds else "." if kinds == {"."} else "ok"
            )
        ended = ", ".join(f"{count} {status}" for status, count in Counter(cell.status for cell in row).items())
        lines.append(f"{rig:8} {name:26} {ended:24} " + " ".join(f"{mark:>6}" for mark in marks))
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rig", choices=RIGS, action="append")
    parser.add_argument("--fault", default="", help="only faults with this in their name")
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--processes", type=int, help="one a core if not given")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    done = []
    with suppress(KeyboardInterrupt):
        done.extend(judged(cells(asked.rig or RIGS, asked.fault, asked.seeds), asked.processes))
    print(table(done))
    failed = [cell for cell in done if cell.failures]
    for cell in failed:
        for check in cell.failures:
            how = f"({cell.status}: {cell.reason})"
            print(f"{cell.rig} {cell.fault} seed {cell.seed}: {check}: {cell.results[check]} {how}")
    print(f"{len(done) - len(failed)} of {len(done)} runs passed")
    if asked.json is not None:
        asked.json.write_text(json.dumps([asdict(cell) for cell in done], indent=1))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
