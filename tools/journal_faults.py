"""The journal's faults on each rig: what is left of the record, and whether the rig is safe.

    python tools/journal_faults.py [--rig RIG] [--fault WORD] [--clock xN] [--processes N] [--json FILE]

full      the disk is full from step 5 on (a small tmpfs that is filled)
crowded   likewise, and the folder for temporary files is on it
freed     the disk is full from step 5 to step 9
eio       no write to the folder succeeds from step 5 on: the files' descriptors are those of files open for reading
removed   the folder is deleted after step 5
file      the journal alone is deleted after step 5
read-only the medium is remounted read-only after step 5
locked    another program has the journal locked for 60 s of wall-clock time from step 5 on
page      two pages in the middle of the journal are overwritten after step 9: rows on them are lost, and reported

The runs are in process on a paced clock; Linux, and for the first three and read-only who may mount. Columns:

ended     status and exit code of the run
told      steps that the journal had acknowledged
journal   steps that the journal has, read as it is; - if it is not readable
after     steps that are readable after `bench runs repair`
verdict   ok if nothing that was acknowledged is missing or, of damaged pages, unreported, `completed` stands for all
          steps, and every output is off

The exit code is 1 if anything has failed.
"""

import argparse
import io
import json
import multiprocessing
import os
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from rich.console import Console

from bench.base import BenchError, IncompleteRecordWarning
from bench.execution import Run, carry_out
from bench.record import FILE_NAME, Journal, Record, recover
from bench.record.store import Store
from sim_devices.torture.running import Bed, Task

RIGS = ("vo2", "sma", "hybrid")
FAULTS = ("full", "crowded", "freed", "eio", "removed", "file", "read-only", "locked", "page")
MOUNTED = {"full", "crowded", "freed", "read-only"}
AT = {"page": 9}
FREED_AT = 9
LOCKED = 60.0
"""Wall-clock time for which another program has the journal locked, s."""
SIZE = 2 << 20


@dataclass
class Cell:
    """One run, judged."""

    rig: str
    fault: str
    ended: str = "-"
    told: int = 0
    steps: int = 0
    journal: int | None = None
    after: int | None = None
    verdict: str = ""
    reason: str = ""


class Injector:
    """Lets a fault happen after a step of the journal that is written in this process."""

    def __init__(self, fault, folder, clock):
        self.fault, self.folder, self.clock = fault, folder, clock
        self.told = 0
        self.threads = []

    def after_step(self, journal, step):
        self.told = step + 1
        if step + 1 == AT.get(self.fault, 5):
            getattr(self, self.fault.replace("-", "_"))(journal)
        if self.fault == "freed" and step + 1 == FREED_AT:
            (self.folder / "filling").unlink()

    def full(self, _journal):
        with (self.folder / "filling").open("wb", buffering=0) as file:
            try:
                while True:
                    file.write(bytes(4096))
            except OSError:
                return

    crowded = freed = full

    def eio(self, journal):
        """Give every descriptor of a file in the folder that of a file open for reading, now and when it is made."""
        folder = journal.path.parent
        broken = os.open(__file__, os.O_RDONLY)

        def breaking():
            for entry in Path("/proc/self/fd").iterdir():
                try:
                    target = entry.readlink()
                except OSError:
                    continue
                if target.is_relative_to(folder):
                    os.dup2(broken, int(entry.name))

        connect = Store._connect

        def broken_connect(store):
            connect(store)
            if store.path.is_relative_to(folder):
                breaking()

        Store._connect = broken_connect
        breaking()

    def removed(self, journal):
        shutil.rmtree(journal.path.parent)

    def file(self, journal):
        journal.path.unlink()

    def read_only(self, journal):
        # Files that are open for writing would keep it from being remounted.
        self.eio(journal)
        subprocess.run(["mount", "--bind", str(self.folder), str(self.folder)], check=True)
        subprocess.run(["mount", "-o", "remount,bind,ro", str(self.folder)], check=True)

    def locked(self, journal):
        path = journal.path
        taken = threading.Event()

        def hold():
            other = sqlite3.connect(path, isolation_level=None, timeout=10.0)
            other.execute("BEGIN IMMEDIATE")
            taken.set()
            time.sleep(LOCKED)
            other.execute("ROLLBACK")
            other.close()

        self.threads.append(threading.Thread(target=hold))
        self.threads[0].start()
        taken.wait()

    def page(self, journal):
        with sqlite3.connect(journal.path, timeout=10.0) as other:
            other.execute("PRAGMA wal_checkpoint(FULL)").fetchall()
        other.close()
        size = journal.path.stat().st_size
        with journal.path.open("r+b") as file:
            file.seek(size // 2 // 4096 * 4096)
            file.write(b"\xa5" * 8192)


def run_cell(rig, fault, clock):
    """Carry one run out in a process of its own, and judge it."""
    cell = Cell(rig, fault)
    base = Path(tempfile.mkdtemp(prefix="journal-faults-"))
    folder = base / "disk"
    folder.mkdir()
    mounted = fault in MOUNTED
    if (
        mounted
        and subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={SIZE}", "tmpfs", str(folder)], capture_output=True, check=False
        ).returncode
    ):
        cell.verdict = "not tried: nothing may be mounted here"
        return cell
    temporary = folder if fault == "crowded" else base / "temporary"
    temporary.mkdir(exist_ok=True)
    tempfile.tempdir = str(temporary)
    injector = Injector(fault, folder, clock)
    write = Journal.step

    def step(journal, record):
        write(journal, record)
        injector.after_step(journal, record.step)

    Journal.step = step
    try:
        _judge(cell, injector, "x0.4" if fault == "locked" else clock, base)
    finally:
        for thread in injector.threads:
            thread.join()
        if mounted:
            for _ in range(1 + (fault == "read-only")):
                subprocess.run(["umount", "-l", str(folder)], check=False)
        shutil.rmtree(base, ignore_errors=True)
    return cell


def _judge(cell, injector, clock, base):
    bed = Bed.of(Task(cell.rig, {}))
    run = Run(bed.protocol, {}, cell.rig, injector.folder / "runs", clock=clock, recording=False, rig_file=bed.file)
    result = carry_out(run, Console(file=io.StringIO(), width=200))
    outcome = result.outcome
    safe = bed.safe()
    code = 0 if outcome.error is None else outcome.error.exit_code if isinstance(outcome.error, BenchError) else 1
    cell.ended, cell.reason = f"{outcome.status} ({code})", outcome.reason
    cell.told, cell.steps = injector.told, outcome.steps
    for thread in injector.threads:
        thread.join()
    claims = outcome.status == "completed"
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            with Record(result.folder) as record:
                cell.journal = len(record.steps())
                claims = claims or record.status == "completed"
    except BenchError:
        pass
    reported = any(one.category is IncompleteRecordWarning for one in said)
    try:
        found = recover(result.folder / FILE_NAME, out=base / "recovered.sqlite")
        with Record(found.copy or result.folder) as record:
            cell.after = len(record.steps())
            acknowledged = set(range(injector.told)) <= set(record.steps()["step"].astype(int))
        acknowledged |= cell.fault == "page" and reported
    except BenchError as error:
        acknowledged, cell.reason = False, f"{cell.reason}; then: {error}"
    wrong = []
    if not acknowledged:
        wrong.append("acknowledged steps are lost")
    if claims and (cell.journal is None or cell.journal < outcome.steps or outcome.steps < injector.told):
        wrong.append("completed with less than all rows")
    if safe not in ("ok", "w"):
        wrong.append(safe)
    cell.verdict = "; ".join(wrong) or "ok"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rig", choices=RIGS, action="append")
    parser.add_argument("--fault", default="", help="only faults with this in their name")
    parser.add_argument("--clock", default="x20")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    wanted = [(rig, fault, asked.clock) for fault in FAULTS if asked.fault in fault for rig in asked.rig or RIGS]
    print(f"{'fault':10} {'rig':8} {'ended':15} {'told':>5} {'journal':>8} {'after':>6}  verdict", flush=True)
    done = []
    with multiprocessing.get_context("spawn").Pool(asked.processes, maxtasksperchild=1) as pool:
        for result in [pool.apply_async(run_cell, cell) for cell in wanted]:
            cell = result.get(600.0)
            done.append(cell)
            journal, after = ("-" if count is None else count for count in (cell.journal, cell.after))
            print(
                f"{cell.fault:10} {cell.rig:8} {cell.ended:15} {cell.told:5} {journal:>8} {after:>6}  {cell.verdict}",
                flush=True,
            )
    failed = [cell for cell in done if cell.verdict != "ok"]
    for cell in failed:
        print(f"{cell.fault} on {cell.rig}: {cell.verdict} ({cell.ended}: {cell.reason})")
    print(f"{len(done) - len(failed)} of {len(done)} passed")
    if asked.json is not None:
        asked.json.write_text(json.dumps([asdict(cell) for cell in done], indent=1))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
